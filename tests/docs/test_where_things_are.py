"""The page on where things are names files that exist, and its operation runs as a command."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from click.testing import CliRunner

from photoplan.cli.verb import Verb

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "explanation" / "where-things-are.md").read_text("utf-8")


def test_every_file_that_is_named_exists() -> None:
    paths = re.findall(r"`((?:[a-z_]+/)+(?:[a-z_]+\.py)?|[a-z]+\.py)`", PAGE)
    assert len(paths) > 40
    missing = [p for p in paths if not ((ROOT / p).exists() or (ROOT / "src" / "photoplan" / p).exists())]
    assert not missing


def test_every_name_that_is_called_exists() -> None:
    """Classes and functions beside the file that holds them."""
    source = "".join(path.read_text("utf-8") for path in (ROOT / "src" / "photoplan").rglob("*.py"))
    for name in ("Lens", "Fisheye", "OpenCVFisheyeLens", "OrientationFormat", "TerrainPicture", "ProductPlan", "Work"):
        assert f"`{name}`" in PAGE and re.search(rf"^class {name}\b", source, re.M), name
    for name in ("make_picture", "slope_picture", "write_grid"):
        assert f"`{name}`" in PAGE and f"def {name}(" in source, name
    assert all(f"{name}: " in source or f"\n{name} = " in source for name in ("AnyLens", "FORMATS", "CSV"))


def test_the_operation_runs_as_a_command(tmp_path: Path) -> None:
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", dtype="uint8", count=1, width=4, height=2) as file:
        file.write(np.array([[[250, 200, 10, 0], [0, 0, 0, 0]]], np.uint8))
    (code,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)
    made: dict[str, Any] = {"__name__": "bright"}
    exec(compile(code, "bright.py", "exec", dont_inherit=True), made)
    verb = Verb("Count bright pixels.", "Count the bright pixels of RASTER.", "", "")

    def run(request: Any, **options: Any) -> None:
        print("\n".join(made["count_bright"](request).summary()))

    said = CliRunner().invoke(verb.command_of(made["BrightRequest"], "bright", run), [str(tmp_path / "a.tif")])
    assert (said.exit_code, said.output) == (0, "bright pixels  0.25\n"), said.output
