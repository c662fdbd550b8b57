"""`photoplan dtm profile`: the surface over lines, through the command line."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import shapely
from tools.command import Here
from tools.recorded import recorded
from tools.small_block import write_terrain
from tools.small_model import CRS, LAYOUT, LINED, WALL, write_small

from photoplan.io.terrain.model import ModelReader
from photoplan.surfaces.hybrid import HybridSurface

ACROSS = [(500_045.0, 5_299_928.0), (500_078.0, 5_299_957.0)]
BEYOND = [(500_010.0, 5_299_885.0), (500_155.0, 5_299_940.0)]
HEAD = ["line", "distance", "x", "y", "height", "sigma"]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "m.gpkg"
    write_small(path)
    return path


@pytest.fixture
def lines(tmp_path: Path) -> Path:
    path = tmp_path / "lines.csv"
    rows = [("across", *p) for p in ACROSS] + [("beyond", *p) for p in BEYOND]
    path.write_text("line,x,y\n" + "".join(f"{n},{x},{y}\n" for n, x, y in rows))
    return path


def read(path: Path) -> dict[str, np.ndarray]:
    """Columns distance, x, y, height, sigma of each line; NaN where empty."""
    rows = list(csv.reader(path.open()))
    assert rows[0] == HEAD
    names = dict.fromkeys(row[0] for row in rows[1:])
    return {n: np.array([[float(v or "nan") for v in row[1:]] for row in rows[1:] if row[0] == n]) for n in names}


def test_straight_between_points_is_the_surface(photoplan: Here, model: Path, lines: Path, tmp_path: Path) -> None:
    said = photoplan("dtm", "profile", model, lines, "-o", tmp_path / "o.csv", "--tolerance", 0.002)
    assert said.code == 0 and said.out.strip() == str(tmp_path / "o.csv")
    assert recorded(tmp_path / "o.run.json", "profile", model, lines)["settings"]["tolerance"] == 0.002
    found = read(tmp_path / "o.csv")
    surface = HybridSurface(ModelReader(model))
    for points, ends in ((found["across"], ACROSS), (found["beyond"], BEYOND)):
        d, z = points[:, 0], points[:, 3]
        length = float(np.hypot(*np.subtract(ends[1], ends[0])))
        assert d[0] == 0 and d[-1] == pytest.approx(length, abs=1e-4) and (np.diff(d) >= 0).all()
        at = np.linspace(0.01, length - 0.01, 999)
        XY = np.array(ends[0]) + at[:, None] / length * np.subtract(ends[1], ends[0])
        # Away from points with two heights, where the table jumps.
        clear = np.abs(at[:, None] - d).min(axis=1) > 0.01
        assert np.allclose(np.interp(at, d, z)[clear], surface.heights(XY)[clear], atol=0.0025, equal_nan=True)
        off = np.abs(points[:, 4] - surface.sigmas(points[:, 1:3]))
        assert np.nanmax(off) < 1e-4
        assert np.nanmax(points[:, 4]) >= 0.05 - 1e-9


def test_a_wall_has_two_heights_at_one_place(photoplan: Here, model: Path, lines: Path, tmp_path: Path) -> None:
    photoplan("dtm", "profile", model, lines, "-o", tmp_path / "o.csv")
    points = read(tmp_path / "o.csv")["across"]
    left, top = LAYOUT.corner(*LINED)
    on_wall = np.abs((points[:, 1] - left) - (top - points[:, 2])) < 1e-3
    assert on_wall.sum() == 2
    assert float(np.diff(points[on_wall, 3])[0]) == pytest.approx(WALL, abs=1e-3)


def test_gaps_are_empty(photoplan: Here, model: Path, lines: Path, tmp_path: Path) -> None:
    said = photoplan("dtm", "profile", model, lines, "-o", tmp_path / "o.csv", "--json")
    points = read(tmp_path / "o.csv")["beyond"]
    assert np.isnan(points[-1, 3]) and np.isnan(points[-1, 4]) and not np.isnan(points[0, 3])
    figures = {p["line"]: p for p in json.loads(said.out)["profiles"]}
    assert figures["beyond"]["length"] == pytest.approx(points[-1, 0], abs=1e-4)
    assert figures["across"]["high"] - figures["across"]["low"] >= WALL - 0.6


def test_lines_of_a_vector_file(photoplan: Here, model: Path, lines: Path, tmp_path: Path) -> None:
    path = tmp_path / "l.gpkg"
    shapes = shapely.to_wkb(np.array([shapely.LineString(ACROSS), shapely.LineString(BEYOND)]))
    names = np.array(["across", "beyond"], object)
    place = {"layer": "l", "driver": "GPKG", "geometry_type": "LineString"}
    pyogrio.raw.write(path, shapes, [names], ["name"], crs=CRS, **place)
    photoplan("dtm", "profile", model, path, "-o", tmp_path / "a.csv")
    photoplan("dtm", "profile", model, lines, "-o", tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()
    path.unlink()
    pyogrio.raw.write(path, shapes, [names], ["name"], crs="EPSG:32632", **place)
    said = photoplan("dtm", "profile", model, path, "-o", tmp_path / "c.csv")
    assert said.code == 3 and "EPSG:32632, the model is in EPSG:32633; reproject" in said.err


@pytest.mark.drawn
def test_a_picture(photoplan: Here, model: Path, lines: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    said = photoplan("dtm", "profile", model, lines, "-o", tmp_path / "o.png", "-o", tmp_path / "o.csv")
    assert said.code == 0
    assert (tmp_path / "o.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "o.csv").is_file()


def test_a_picture_without_the_library(photoplan: Here, model: Path, lines: Path, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib.figure", None)
        said = photoplan("dtm", "profile", model, lines, "-o", tmp_path / "o.png")
    assert said.code == 2 and "pip install 'photoplan[report]'" in said.err
    assert not (tmp_path / "o.png").exists()


def test_over_a_raster(photoplan: Here, tmp_path: Path) -> None:
    dem = write_terrain(tmp_path / "dem.tif")
    lines = tmp_path / "l.csv"
    lines.write_text("x,y\n500100,5300100\n500400,5300200\n500500,5300000\n")
    assert photoplan("dtm", "profile", dem, lines, "-o", tmp_path / "o.csv").code == 0
    points = read(tmp_path / "o.csv")["1"]
    assert np.isfinite(points[:, 3]).all() and np.isnan(points[:, 4]).all()


@pytest.mark.parametrize(
    ("text", "words", "code", "message"),
    [
        ("x,y\n1,2\n", (), 3, "line '1' has fewer than two different points"),
        ("line,x,y\na,1,2\nb,3,4\nb,5,6\n", (), 3, "line 'a' has fewer than two"),
        ("x,y\n1,2\n3,x\n", (), 3, "l.csv:3: y = 'x' is not a number"),
        ("x,y\n1,2\n3,4\n", ("--line", "road"), 3, "no column 'road'; the columns are x, y"),
        ("x,y\n1,2\n3,4\n", ("-o", "o.doc"), 2, "profiles are written as .csv and .png"),
    ],
)
def test_faults(
    photoplan: Here, model: Path, tmp_path: Path, text: str, words: tuple[str, ...], code: int, message: str
) -> None:
    (tmp_path / "l.csv").write_text(text)
    said = photoplan("dtm", "profile", model, tmp_path / "l.csv", "-o", tmp_path / "o.csv", *words)
    assert said.code == code and message in said.err, said.err
    assert [p.name for p in tmp_path.iterdir()] == ["l.csv"]


def test_fault_13_output(photoplan: Here, model: Path, lines: Path) -> None:
    said = photoplan("dtm", "profile", model, lines, "-o", lines, "--overwrite")
    assert said.code == 2 and "the output is the input" in said.err
