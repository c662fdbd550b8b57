"""`photoplan dtm shade`, `slope` and `tint` from models to pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from tools.dem_file import X0, Y0, write_dem
from tools.small_model import write_small

from photoplan.terrain.shading import RAMPS


@pytest.fixture
def ramp_dem(tmp_path: Path) -> Path:
    """A plane that rises by a tenth to the east, with a hole."""
    return write_dem(
        tmp_path / "plane.tif", lambda x, y: np.where((x > 20) & (x < 25) & (y < 5), np.nan, 50 + 0.1 * x), (61, 41)
    )


def read(path: Path) -> tuple[np.ndarray, Any]:
    with rasterio.open(path) as file:
        return file.read(), file.profile | {"tags": file.tags(), "mask": file.dataset_mask(), "bounds": file.bounds}


@pytest.mark.drawn
def test_hillshade_of_a_plane(ramp_dem: Path, tmp_path: Path, photoplan: Any) -> None:
    out, png = tmp_path / "s.tif", tmp_path / "s.png"
    arguments = ["dtm", "shade", ramp_dem, "--azimuth", 270, "--altitude", 30, "-o", out, "--preview", png]
    said = photoplan(*arguments, "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert (facts["kind"], facts["azimuth"], facts["width"]) == ("hillshade", 270.0, 62)
    values, profile = read(out)
    light = (0.5 + 0.1 * np.cos(np.radians(30))) / np.hypot(1, 0.1)
    # West of the sun: the plane rises to the east, so it faces west.
    assert set(np.unique(values[0, 5:20, 5:15])) == {round(1 + 254 * light)}
    assert profile["nodata"] == 0 and (profile["mask"] == 0).any()
    assert profile["tags"]["PHOTOPLAN_KIND"] == "hillshade"
    assert png.read_bytes()[:4] == b"\x89PNG"
    said = photoplan(*arguments)
    assert said.code == 2 and "exists already" in said.err
    assert photoplan(*arguments, "--overwrite").code == 0


def test_slope_classes_and_aspect(ramp_dem: Path, tmp_path: Path, photoplan: Any) -> None:
    bounds = ["--bounds", X0 + 2, Y0 + 2, X0 + 12, Y0 + 12, "--resolution", 0.5, "-q"]
    assert photoplan("dtm", "slope", ramp_dem, *bounds, "-o", tmp_path / "d.tif").code == 0
    assert photoplan("dtm", "slope", ramp_dem, *bounds, "--percent", "-o", tmp_path / "p.tif").code == 0
    assert photoplan("dtm", "slope", ramp_dem, *bounds, "--aspect", "-o", tmp_path / "a.tif").code == 0
    classes = ["--percent", "--classes", "5,9.5,20"]
    assert photoplan("dtm", "slope", ramp_dem, *bounds, *classes, "-o", tmp_path / "c.tif").code == 0
    for name, expected, off in (("d", np.degrees(np.arctan(0.1)), 2e-3), ("p", 10.0, 4e-3), ("a", 270.0, 0.05)):
        values, profile = read(tmp_path / f"{name}.tif")
        assert (profile["dtype"], np.isnan(profile["nodata"])) == ("float32", True)
        np.testing.assert_allclose(values, expected, atol=off)
        assert profile["bounds"] == (X0 + 2, Y0 + 2, X0 + 12, Y0 + 12)
    values, profile = read(tmp_path / "c.tif")
    assert set(np.unique(values)) == {3}
    with rasterio.open(tmp_path / "c.tif") as file:
        assert file.colormap(1)[1][:3] == (255, 255, 212) and file.colormap(1)[4][:3] == (120, 30, 10)


def test_tints_of_a_ramp_file_and_a_built_in_ramp(ramp_dem: Path, tmp_path: Path, photoplan: Any) -> None:
    ramp = tmp_path / "ramp.txt"
    ramp.write_text("# height r g b\n50 0 0 0\n56, 120, 60, 240\n")
    assert photoplan("dtm", "tint", ramp_dem, "--ramp", ramp, "-o", tmp_path / "f.tif", "-q").code == 0
    values, profile = read(tmp_path / "f.tif")
    with rasterio.open(tmp_path / "f.tif") as file:
        x = file.xy(10, 30)[0] - X0
    np.testing.assert_allclose(values[:, 10, 30], np.array([120, 60, 240]) * 0.1 * x / 6, atol=0.6)
    assert profile["nodata"] is None and 0 < (profile["mask"] == 0).sum() < 60
    options = ["--ramp", "grey", "--heights", 50, 56, "--classes", 3, "--shade"]
    assert photoplan("dtm", "tint", ramp_dem, *options, "-o", tmp_path / "g.tif", "-q").code == 0
    low, high = np.array(RAMPS["grey"])
    assert len(np.unique(read(tmp_path / "g.tif")[0][0, :30, 2:58])) <= 4
    assert low[0] < high[0]


def test_pictures_of_a_model_file(tmp_path: Path, photoplan: Any) -> None:
    """The wall of the small model is one line of steep pixels; slopes beside it are those of the hills."""
    model = tmp_path / "model.gpkg"
    write_small(model)
    out = tmp_path / "s.tif"
    assert photoplan("dtm", "slope", model, "--resolution", 0.5, "-o", out, "-q").code == 0
    values, _ = read(out)
    with rasterio.open(out) as file:
        row, column = file.index(500_060.1, 5_299_940.1)
    assert values[0, row - 1 : row + 2, column - 1 : column + 2].max() > 60
    assert np.nanmax(values[0, row - 12 : row - 4, column + 2 : column + 20]) < 30
    assert photoplan("dtm", "tint", model, "--shade", "-o", tmp_path / "t.tif", "-q").code == 0


@pytest.mark.parametrize(
    ("verb", "options", "code", "message"),
    [
        ("shade", ["--altitude", "0"], 2, "altitude"),
        ("slope", ["--classes", "5,a"], 2, "numbers with commas"),
        ("slope", ["--classes", "5,4"], 2, "rising"),
        ("slope", ["--aspect", "--percent"], 2, "--aspect"),
        ("tint", ["--ramp", "absent.txt"], 3, "built in are"),
        ("tint", ["--classed"], 2, "ramp file"),
        ("tint", ["--heights", "5", "5"], 2, "rising"),
        ("shade", ["--bounds", "0", "0", "1", "1"], 3, "do not meet"),
        ("shade", ["--preview", "a.tif"], 2, "preview"),
    ],
)
def test_wrong_use_leaves_nothing(
    ramp_dem: Path, tmp_path: Path, photoplan: Any, monkeypatch: pytest.MonkeyPatch, verb: str, options: list[str],
    code: int, message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    said = photoplan("dtm", verb, ramp_dem, *options, "-o", "a.tif")
    assert said.code == code and message in said.err, said.err
    assert [p.name for p in tmp_path.iterdir()] == ["plane.tif"]


def test_fault_13_the_model_is_not_overwritten(ramp_dem: Path, photoplan: Any) -> None:
    before = ramp_dem.read_bytes()
    said = photoplan("dtm", "shade", ramp_dem, "-o", ramp_dem, "--overwrite")
    assert said.code == 2 and "is the input" in said.err
    assert ramp_dem.read_bytes() == before
