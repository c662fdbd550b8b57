"""The snippets on the design pages run, and so does the Python of the documentation that says so."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SNIPPETS = [
    pytest.param(block, id=f"{page.stem}-{number}")
    for page in sorted((ROOT / "design").glob("*.md"))
    for number, block in enumerate(re.findall(r"^```python\n(.*?)^```$", page.read_text("utf-8"), re.M | re.S), 1)
]


@pytest.mark.parametrize("block", SNIPPETS)
def test_design_snippet_runs(block):
    exec(compile(block, "snippet", "exec"), {"__name__": "snippet"})


def test_every_design_page_has_a_snippet():
    pages = sorted((ROOT / "design").glob("[0-9][0-9][0-9]-*.md"))
    assert len(pages) >= 4
    for page in pages:
        assert "```python" in page.read_text("utf-8"), page.name
