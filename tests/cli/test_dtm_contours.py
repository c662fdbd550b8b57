"""`photoplan dtm contours` from models to files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
from tools.dem_file import X0, Y0, write_dem
from tools.recorded import recorded
from tools.small_model import write_small

from photoplan.errors import UsageError
from photoplan.io import disk
from photoplan.io.disk import FileLock
from photoplan.io.vector_layer import ContourRow, write_contours


def hill_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    hollow = 8 * np.exp(-((x - 95) ** 2 + (y - 20) ** 2) / 90)
    return 100 + 30 * np.exp(-((x - 50) ** 2 + (y - 40) ** 2) / 900) - hollow


@pytest.fixture
def hill(tmp_path: Path) -> Path:
    """A round hill of 30 m with a hollow beside it."""
    return write_dem(
        tmp_path / "hill.tif",
        hill_height,
        (121, 81),
    )


def rows(path: Path, layer: str | None = None) -> dict[str, Any]:
    meta, _, geometry, columns = pyogrio.raw.read(path, layer=layer)
    return {"crs": meta["crs"], "geometry": shapely.from_wkb(geometry)} | dict(zip(meta["fields"], columns))


@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".geojson", ".dxf"])
def test_contours_and_labels_in_every_format(hill: Path, tmp_path: Path, photoplan: Any, suffix: str) -> None:
    out = tmp_path / "out" / f"höhen{suffix}"
    out.parent.mkdir()
    arguments = ["dtm", "contours", hill, "--interval", 2, "--labels", "--text-height", 1.5, "-o", out, "--json"]
    said = photoplan(*arguments)
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert facts["lines"] > 10 and facts["labels"] > 2 and facts["depressions"] == 4
    assert recorded(out.with_suffix(".run.json"), "contours", hill)["product"]["lines"] == facts["lines"]
    if suffix == ".dxf":
        found = rows(out)
        text = found["Layer"] == "CONTOUR_LABEL"
        assert text.sum() == facts["labels"]
        lines = found["geometry"][~text]
        index = found["Layer"][~text] == "CONTOUR_INDEX"
        labels = found["geometry"][text]
        heights = shapely.get_coordinates(lines, include_z=True)[:, 2]
        assert set(found["Text"][text]) <= {"100", "110", "120", "130"}
    else:
        found = rows(out, "contours" if suffix == ".gpkg" else None)
        lines, index = found["geometry"], found["is_index"] == 1
        other = (out, "labels") if suffix == ".gpkg" else (out.with_name(f"höhen_labels{suffix}"), None)
        label_rows = rows(*other)
        labels = label_rows["geometry"]
        assert set(label_rows["text"]) <= {"100", "110", "120", "130"}
        assert set(label_rows["size"]) == {1.5}
        heights = np.repeat(found["height"], shapely.get_num_coordinates(lines))
        np.testing.assert_array_equal(heights, shapely.get_coordinates(lines, include_z=True)[:, 2])
        assert found["depression"].sum() == 4
        assert "MGI" in str(found["crs"]) or "31287" in str(found["crs"])
    assert len(lines) == facts["lines"] and len(labels) == facts["labels"]
    assert facts["length"] == pytest.approx(shapely.length(lines).sum(), rel=1e-6)
    assert index.sum() > 0
    assert shapely.get_z(shapely.get_point(lines[index], 0)) == pytest.approx(
        10 * np.round(shapely.get_z(shapely.get_point(lines[index], 0)) / 10)
    )
    # On the surface, to the curvature inside a mesh.
    xy = shapely.get_coordinates(lines) - [X0, Y0]
    assert np.abs(hill_height(*xy.T) - heights).max() < 0.06
    before = {p.name: p.read_bytes() for p in out.parent.iterdir()}
    assert not any(name.startswith(".") for name in before)
    said = photoplan(*arguments)
    assert said.code == 2 and "exists already" in said.err
    assert {p.name: p.read_bytes() for p in out.parent.iterdir()} == before
    assert photoplan(*arguments, "--overwrite").code == 0


@pytest.mark.drawn
def test_a_model_file_with_a_wall(tmp_path: Path, photoplan: Any) -> None:
    """Lines end on both sides of the wall, and a preview shows them."""
    model = tmp_path / "model.gpkg"
    write_small(model)
    out, png = tmp_path / "c.gpkg", tmp_path / "c.png"
    said = photoplan("dtm", "contours", model, "--interval", 0.5, "--smooth", "--simplify", "-o", out, "--preview", png)
    assert said.code == 0, said.err
    assert said.out.split() == [str(out), str(png)]
    assert "contours from" in said.err
    assert png.read_bytes()[:4] == b"\x89PNG"
    lines = rows(out, "contours")["geometry"]
    wall = shapely.LineString([(500_040, 5_299_960), (500_080, 5_299_920)])
    ends = shapely.points(np.concatenate([shapely.get_coordinates(line)[[0, -1]] for line in lines]))
    assert (shapely.distance(ends, wall) < 1e-6).sum() >= 8
    # Whatever rounding lets reach over the wall is the very end of a line.
    over = shapely.intersection(lines, wall)
    inner = shapely.difference(over, shapely.buffer(shapely.boundary(lines), 1e-6))
    assert shapely.is_empty(inner).all()


def test_bounds_and_nothing_to_trace(hill: Path, tmp_path: Path, photoplan: Any) -> None:
    out = tmp_path / "c.gpkg"
    bounds = [X0 + 30, Y0 + 20, X0 + 60, Y0 + 45]
    assert photoplan("dtm", "contours", hill, "--interval", 1, "--bounds", *bounds, "-o", out, "-q").code == 0
    assert shapely.box(*bounds).buffer(1.0).contains(shapely.box(*shapely.total_bounds(rows(out)["geometry"])))
    said = photoplan("dtm", "contours", hill, "--interval", 1, "--bounds", 0, 0, 5, 5, "-o", tmp_path / "d.gpkg")
    assert said.code == 3 and "do not meet" in said.err
    said = photoplan("dtm", "contours", hill, "--interval", 500, "--labels", "-o", tmp_path / "e.gpkg")
    assert said.code == 0 and "no contour" in said.err
    assert len(rows(tmp_path / "e.gpkg", "contours")["geometry"]) == 0


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--interval", "1", "-o", "c.txt"], 2, ".gpkg"),
        (["--interval", "0", "-o", "c.gpkg"], 2, "interval"),
        (["--interval", "1", "--band", "0.5", "-o", "c.gpkg"], 2, "band"),
        (["--interval", "1e-7", "-o", "c.gpkg"], 2, "larger interval"),
        (["--interval", "1", "-o", "c.gpkg", "--preview", "c.gpkg"], 2, "preview"),
        (["--interval", "1", "-o", "absent/c.gpkg"], 2, "absent"),
    ],
)
def test_wrong_use_leaves_nothing(
    hill: Path,
    tmp_path: Path,
    photoplan: Any,
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    code: int,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    said = photoplan("dtm", "contours", hill, *options)
    assert said.code == code and message in said.err, said.err
    assert [p.name for p in tmp_path.iterdir()] == ["hill.tif"]


def test_fault_13_the_model_is_not_overwritten(tmp_path: Path, photoplan: Any) -> None:
    model = tmp_path / "model.gpkg"
    write_small(model)
    before = model.read_bytes()
    said = photoplan("dtm", "contours", model, "--interval", 1, "-o", model, "--overwrite")
    assert said.code == 2 and "is the input" in said.err
    (tmp_path / "link.gpkg").symlink_to(model)
    said = photoplan("dtm", "contours", model, "--interval", 1, "-o", tmp_path / "link.gpkg", "--overwrite")
    assert said.code == 2 and "is the input" in said.err
    assert model.read_bytes() == before


def test_fault_04_a_full_disk_leaves_the_old_file(
    hill: Path, tmp_path: Path, photoplan: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import errno

    from photoplan.io import store as naming

    out = tmp_path / "c.gpkg"
    out.write_bytes(b"old")

    def full(path: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(naming, "sync_file", full)
    said = photoplan("dtm", "contours", hill, "--interval", 1, "-o", out, "--overwrite")
    assert said.code == 5 and "No space left" in said.err
    assert out.read_bytes() == b"old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.gpkg", "hill.tif"]
    assert disk.free_megabytes(tmp_path) > 0


def test_fault_03_what_a_killed_run_left_is_cleared_away(hill: Path, tmp_path: Path, photoplan: Any) -> None:
    left = tmp_path / ".c.gpkg.partial"
    left.mkdir()
    (left / "c.gpkg").write_bytes(b"torn")
    said = photoplan("dtm", "contours", hill, "--interval", 5, "-o", tmp_path / "c.gpkg", "-q")
    assert said.code == 0, said.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.gpkg", "c.run.json", "hill.tif"]


def test_fault_26_two_runs_on_one_output(hill: Path, tmp_path: Path, photoplan: Any) -> None:
    with FileLock(tmp_path / ".c.gpkg.lock"):
        said = photoplan("dtm", "contours", hill, "--interval", 5, "-o", tmp_path / "c.gpkg")
        assert said.code == 2 and "another run" in said.err
    assert [p.name for p in tmp_path.iterdir()] == ["hill.tif"]


def test_fault_13_the_writer_refuses_before_it_takes_a_line(tmp_path: Path) -> None:
    def lines() -> Iterator[ContourRow]:
        raise AssertionError("a line was asked for")
        yield

    (tmp_path / "c_labels.shp").write_bytes(b"old")
    with pytest.raises(UsageError, match="exists already"):
        write_contours(tmp_path / "c.shp", lines(), list, "EPSG:32633")
    assert [p.name for p in tmp_path.iterdir()] == ["c_labels.shp"]
