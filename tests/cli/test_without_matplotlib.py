"""Without matplotlib commands do their work and say how to get the picture that they leave out."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_register_command import MAP, write
from tools.command import Here

from photoplan.kernels.jit import COMPILED

SOURCE = Path(__file__).parents[2] / "src/photoplan/cli"
SAID = "no picture: it needs matplotlib (pip install 'photoplan[report]')"


@pytest.mark.skipif(not COMPILED, reason="many patches")
@pytest.mark.parametrize("options", [[], ["--quiet"], ["--no-picture"], ["--dry-run"]])
def test_a_picture_that_is_left_out_is_told(
    photoplan: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str]
) -> None:
    monkeypatch.setattr("photoplan.report.page.has_matplotlib", lambda: False)
    images = [write(tmp_path / f"{name}.tif", (60, 50), **MAP) for name in "ab"]
    said = photoplan("register", *images, "-o", tmp_path / "v.gpkg", *options)
    assert said.code == 0, said.err
    assert (SAID in said.err) == (not options)
    assert not (tmp_path / "v.png").exists()


def test_commands_ask_in_one_place() -> None:
    """So that none leaves its picture out without a word."""
    assert [path.name for path in SOURCE.rglob("*.py") if "has_matplotlib" in path.read_text()] == ["output.py"]
