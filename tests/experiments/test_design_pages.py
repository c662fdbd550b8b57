"""The Python on the design pages and in the documentation runs, and prints what the page says."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: A block of Python and, where one follows at once, the text that it prints.
BLOCK = re.compile(r"^```python\n(.*?)^```$(?:\n\n```text\n(.*?)^```$)?", re.M | re.S)
SNIPPETS = [
    pytest.param(code, printed, id=f"{page.stem}-{number}")
    for page in [*sorted((ROOT / "design").glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
    # Its blocks build on each other: `test_reference_pages` runs it as a whole.
    if page.stem != "arrays"
    for number, (code, printed) in enumerate(BLOCK.findall(page.read_text("utf-8")), 1)
]


@pytest.mark.parametrize(("code", "printed"), SNIPPETS)
def test_snippet_runs(code, printed, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})
    if printed:
        assert capsys.readouterr().out.rstrip() == printed.rstrip()


def test_every_design_page_has_a_snippet():
    pages = sorted((ROOT / "design").glob("[0-9][0-9][0-9]-*.md"))
    assert len(pages) >= 4
    for page in pages:
        assert "```python" in page.read_text("utf-8"), page.name
