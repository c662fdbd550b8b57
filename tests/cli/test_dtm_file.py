"""`photoplan dtm info`, `sample`, `export`: through the command line, with the faults of their inputs."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import Here
from tools.recorded import recorded
from tools.small_block import write_terrain
from tools.small_model import EMPTY, LAYOUT, hills, write_small, write_units_of

from photoplan.io.terrain.model import ModelReader
from photoplan.surfaces.hybrid import HybridSurface

INSIDE = (500_090.3, 5_299_990.4)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "m.gpkg"
    write_small(path)
    return path


class TestInfo:
    def test_a_model(self, photoplan: Here, model: Path) -> None:
        said = photoplan("dtm", "info", model)
        assert said.code == 0
        facts = dict(line.split("  ", 1) for line in said.out.splitlines() if line[0] != " ")
        assert "11 of 40 m" in facts["units"] and "1 empty" in facts["units"]
        assert "EGM96 height (EPSG:5773)" in facts["heights"]
        assert facts["lines"].strip() == "1 border, 1 breakline, 1 formline, 1 of them two-sided; 17 vertices"
        assert photoplan("info", model).out == said.out

    def test_figures_and_gross_errors(self, photoplan: Here, model: Path) -> None:
        said = photoplan("dtm", "info", model, "--json", "--gross")
        found = json.loads(said.out)
        assert found["crs"] == "EPSG:32633" and found["height_system"] == "EPSG:5773"
        assert found["bounds"] == list(LAYOUT.bounds)
        assert found["widths"] == [{"width": 5.0, "units": 8}, {"width": 2.5, "units": 3}]
        assert found["posts"] == 8 * 81 + 3 * 289
        assert found["points"] == sum(10 * c + r for c in range(4) for r in range(3) if (c, r) != EMPTY)
        assert found["gross_errors"][0]["name"] == "p 17" and found["gross"] == 1
        assert found["spread"] == pytest.approx(1.01)
        assert found["suspect_points"][0]["name"] == "p 18" and found["suspects"] == 1
        listed = photoplan("dtm", "info", model, "--gross").out
        assert "\np 17  mass" in listed and "suspect: p 18  mass" in listed

    def test_a_raster_is_shown_as_by_info(self, photoplan: Here, tmp_path: Path) -> None:
        dem = write_terrain(tmp_path / "dem.tif")
        assert photoplan("dtm", "info", dem).out == photoplan("info", dem).out != ""

    def test_what_is_no_terrain(self, photoplan: Here, tmp_path: Path) -> None:
        (tmp_path / "a.gpkg").write_text("no")
        said = photoplan("dtm", "info", tmp_path / "a.gpkg")
        assert said.code == 3 and "a.gpkg: no terrain model" in said.err
        assert photoplan("dtm", "info", tmp_path / "absent.gpkg").code == 3


def table(path: Path, text: str, encoding: str = "utf-8") -> Path:
    path.write_bytes(text.encode(encoding))
    return path


class TestSample:
    def test_columns_height_and_sigma(self, photoplan: Here, model: Path, tmp_path: Path) -> None:
        """Heights of the surface to the last digit; the columns of the input as they were."""
        rng = np.random.default_rng(3)
        xy = rng.uniform([499_990, 5_299_870], [500_170, 5_300_010], (500, 2)).round(3)
        xmin, ymin, xmax, ymax = LAYOUT.bounds
        rows = "\n".join(f"{i},{x:.3f},text {i},{y:.3f}" for i, (x, y) in enumerate(xy))
        points = table(tmp_path / "p.csv", f"id,x,remark,y\n{rows}\n")
        said = photoplan("dtm", "sample", model, points, "--output", tmp_path / "out.csv", "--json")
        assert said.code == 0
        found = list(csv.DictReader((tmp_path / "out.csv").open()))
        assert list(found[0]) == ["id", "x", "remark", "y", "height", "sigma"]
        assert [row["remark"] for row in found] == [f"text {i}" for i in range(500)]
        surface = HybridSurface(ModelReader(model))
        heights, sigmas = surface.heights(xy), surface.sigmas(xy)
        for row, height, sigma in zip(found, heights, sigmas):
            assert row["height"] == ("" if np.isnan(height) else f"{height:.4f}")
            assert row["sigma"] == ("" if np.isnan(sigma) else f"{sigma:.4f}")
        report = json.loads(said.out)
        outside = int(np.isnan(heights).sum())
        assert report["points"] == 500 and report["outside"] == outside
        assert recorded(tmp_path / "out.run.json", "sample", model, points)["product"]["outside"] == outside
        assert 0 < outside < 500 and report["height_system"] == "EPSG:5773"
        assert report["sigma"] == pytest.approx(np.sqrt(np.nanmean(sigmas**2)))
        beyond = (xy < [xmin, ymin]).any(axis=1) | (xy > [xmax, ymax]).any(axis=1)
        assert np.isnan(heights[beyond]).all()

    def test_many_parts(self, photoplan: Here, model: Path, tmp_path: Path) -> None:
        """The table is read in parts: none is lost or doubled between them."""
        from photoplan.products.dtm import lines as dtm_sample

        points = table(tmp_path / "p.csv", "x,y\n" + "".join(f"{500_000 + i / 10},5299990\n" for i in range(1000)))
        photoplan("dtm", "sample", model, points, "-o", tmp_path / "a.csv")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(dtm_sample, "PART", 7)
            photoplan("dtm", "sample", model, points, "-o", tmp_path / "b.csv")
        assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
        assert len((tmp_path / "a.csv").read_text().splitlines()) == 1001

    def test_a_raster_has_no_sigma(self, photoplan: Here, tmp_path: Path) -> None:
        dem = write_terrain(tmp_path / "dem.tif")
        points = table(tmp_path / "p.csv", "x,y\n500300,5300200\n")
        photoplan("dtm", "sample", dem, points, "-o", tmp_path / "o.csv")
        (row,) = csv.DictReader((tmp_path / "o.csv").open())
        assert 90 < float(row["height"]) < 110 and row["sigma"] == ""

    def test_points_in_another_crs(self, photoplan: Here, model: Path, tmp_path: Path) -> None:
        points = table(tmp_path / "p.csv", "name,lon,lat\nA,15.0012,47.8528\n")
        said = photoplan("dtm", "sample", model, points, "-o", tmp_path / "o.csv", "--points-crs", "EPSG:4326")
        assert said.code == 0, said.err
        (row,) = csv.DictReader((tmp_path / "o.csv").open())
        assert 140 < float(row["height"]) < 160

    @pytest.mark.parametrize(
        ("text", "encoding", "options"),
        [
            ("x,y\r\n{x},{y}\r\n", "utf-8", ()),
            ("\ufeffx,y\n{x},{y}\n", "utf-8", ()),
            ("x;y;n\n{xc};{yc};a\n", "utf-8", ("--decimal-comma",)),
            ("x\ty\n{x}\t{y}", "utf-8", ()),
            ("East North\n {x}   {y}\n", "utf-8", ()),
            ('n,x,y\n"a, b",{x},{y}\n', "utf-8", ()),
            ("{x} {y} 12\n", "utf-8", ("--no-header",)),
            ("7,{y},{x}\n", "utf-8", ("--no-header", "--x", "3", "--y", "2")),
            ("a,Rechts,Hoch\n\n1,{x},{y}\n\n", "utf-8", ("--x", "rechts", "--y", "hoch")),
        ],
    )
    def test_fault_18_read_as_declared(
        self, photoplan: Here, model: Path, tmp_path: Path, text: str, encoding: str, options: tuple[str, ...]
    ) -> None:
        x, y = (str(v) for v in INSIDE)
        points = table(tmp_path / "p.txt", text.format(x=x, y=y, xc=x.replace(".", ","), yc=y.replace(".", ",")))
        said = photoplan("dtm", "sample", model, points, "-o", tmp_path / "o.csv", *options, "--json")
        assert said.code == 0, said.err
        height = float(HybridSurface(ModelReader(model)).heights(np.array([INSIDE]))[0])
        assert json.loads(said.out)["low"] == pytest.approx(height, abs=1e-9)
        line = (tmp_path / "o.csv").read_text().splitlines()[-1]
        assert f"{height:.4f}" in line.replace(",", ".") if "--decimal-comma" in options else f"{height:.4f}" in line

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("x,y\n1,2\n1,nan\n", r"p.csv:3: y = 'nan' is not a number"),
            ("x,y\n1,inf\n", r"p.csv:2: y = 'inf' is not a number"),
            ("x,y\n1,2\n\n3\n", "p.csv:4: 1 columns, the first line has 2"),
            ("x,y\n1,2,3\n", "p.csv:2: 3 columns, the first line has 2; is the decimal sign a comma?"),
            (
                "x;y\n1,5;2,5\n",
                "p.csv:2: x = '1,5' is not a number; write decimals with a point (--decimal-comma",
            ),
            ("x,y\n", "p.csv: holds a header and no point"),
            ("\n\n", "p.csv: holds no line with data"),
            ("", "p.csv: holds no line with data"),
            ("1,2\n3,4\n", "p.csv:1: the first line holds numbers"),
            ("a,b\n3,4\n", "p.csv:1: no column for X in a, b; name it with --x NAME"),
            ("x,easting,x,y\n3,4,5,6\n", "p.csv:1: 2 columns 'x' for X; the columns are x, easting, x, y"),
            ("x,y\n1_0,4\n", "p.csv:2: x = '1_0' is not a number"),
            ('x,y\n1,"2\n', "p.csv:2: cannot be split into columns"),
            ("x,y\n1,\0\n", "p.csv:2: holds a zero byte"),
            ("x,y,height\n1,2,3\n", "p.csv: has a column height already"),
        ],
    )
    def test_fault_18_refused_with_the_line(
        self, photoplan: Here, model: Path, tmp_path: Path, text: str, message: str
    ) -> None:
        points = table(tmp_path / "p.csv", text)
        said = photoplan("dtm", "sample", model, points, "-o", tmp_path / "o.csv")
        assert said.code in (2, 3) and message in said.err, said.err
        assert [p.name for p in tmp_path.iterdir()] == ["p.csv"]

    def test_fault_18_not_utf8(self, photoplan: Here, model: Path, tmp_path: Path) -> None:
        points = table(tmp_path / "p.csv", "x,y,ü\n1,2,ä\n", "latin-1")
        said = photoplan("dtm", "sample", model, points, "-o", tmp_path / "o.csv")
        assert said.code == 3 and "not UTF-8" in said.err

    def test_fault_13_output(self, photoplan: Here, model: Path, tmp_path: Path) -> None:
        points = table(tmp_path / "p.csv", "x,y\n1,2\n")
        (tmp_path / "o.csv").write_text("precious")
        said = photoplan("dtm", "sample", model, points, "-o", tmp_path / "o.csv")
        assert said.code == 2 and "exists already" in said.err
        assert (tmp_path / "o.csv").read_text() == "precious"
        for target in (points, model):
            link = tmp_path / f"link{target.suffix}"
            link.symlink_to(target)
            for output in (target, link):
                said = photoplan("dtm", "sample", model, points, "-o", output, "--overwrite")
                assert said.code == 2 and "the output is the input" in said.err
        assert points.read_text() == "x,y\n1,2\n"


class TestExport:
    def test_raster_is_the_surface(self, photoplan: Here, model: Path, tmp_path: Path) -> None:
        """Pixels lie on the posts of the finest width; CRS and height system are stated, and read again."""
        said = photoplan("dtm", "export", model, "-o", tmp_path / "o.tif", "--sigma", tmp_path / "s.tif")
        assert said.code == 0 and said.out.split() == [str(tmp_path / "o.tif"), str(tmp_path / "s.tif")]
        with rasterio.open(tmp_path / "o.tif") as file:
            heights, transform = file.read(1), file.transform
            assert np.isnan(file.nodata)
        assert (transform.a, transform.c, transform.f) == (2.5, LAYOUT.left - 1.25, LAYOUT.top + 1.25)
        rows, columns = np.mgrid[: heights.shape[0], : heights.shape[1]]
        XY = np.stack([LAYOUT.left + 2.5 * columns, LAYOUT.top - 2.5 * rows], axis=-1)
        expected = HybridSurface(ModelReader(model)).heights(XY)
        assert np.allclose(heights, expected, atol=2e-5, equal_nan=True)
        with rasterio.open(tmp_path / "s.tif") as file:
            sigmas = file.read(1)
        # At the posts of a unit those of the prediction; coarser units do not follow the hills between their posts.
        assert np.allclose(sigmas[:16:2, :16:2], 0.05, atol=1e-6) and 0.05 < np.nanmax(sigmas) < 0.1
        assert np.allclose(sigmas, HybridSurface(ModelReader(model)).sigmas(XY), atol=1e-6, equal_nan=True)
        facts = json.loads(photoplan("info", tmp_path / "o.tif", "--json").out)
        assert facts["heights"] == "EGM96 height (EPSG:5773), in metre"

    def test_resolution_and_bounds(self, photoplan: Here, model: Path, tmp_path: Path) -> None:
        bounds = ("500010", "5299960", "500030", "5299990")
        said = photoplan(
            "dtm", "export", model, "-o", tmp_path / "o.tif", "--resolution", 1, "--bounds", *bounds, "--json"
        )
        assert json.loads(said.out)["columns"] == 20 and json.loads(said.out)["rows"] == 30
        with rasterio.open(tmp_path / "o.tif") as file:
            heights = file.read(1)
        X, Y = np.meshgrid(500_010.5 + np.arange(20), 5_299_989.5 - np.arange(30))
        assert np.abs(heights - hills(X, Y)).max() < 0.03

    @pytest.mark.parametrize("suffix", ["obj", "ply", "xml", "xyz", "csv"])
    def test_every_format(self, photoplan: Here, model: Path, tmp_path: Path, suffix: str) -> None:
        path = tmp_path / f"o.{suffix}"
        said = photoplan("dtm", "export", model, "-o", path)
        assert said.code == 0 and said.out.strip() == str(path)
        assert path.stat().st_size > 20_000
        assert list(tmp_path.iterdir()) == [path]

    def test_wrong_use(self, photoplan: Here, model: Path, tmp_path: Path) -> None:
        dem = write_terrain(tmp_path / "dem.tif")
        for words, message in (
            ((model, "-o", tmp_path / "o.doc"), ".doc; by the suffix is written: .tif"),
            ((model, "-o", tmp_path / "o.obj", "--resolution", 1), "belong to a raster"),
            ((dem, "-o", tmp_path / "o.obj"), "a raster has no triangles"),
            ((dem, "-o", tmp_path / "o.tif", "--sigma", tmp_path / "s.tif"), "has no standard deviations"),
            ((model, "-o", model), "by the suffix"),
            ((dem, "-o", dem, "--overwrite"), "the output is the input"),
            ((model, "-o", tmp_path / "absent" / "o.obj"), "no such folder; make it first"),
        ):
            said = photoplan("dtm", "export", *words)
            assert said.code == 2 and message in said.err, said
        said = photoplan("dtm", "export", model, "-o", tmp_path / "o.tif", "--bounds", 0, 0, 10, 10)
        assert said.code == 3 and "covers 500000 5299880" in said.err
        assert [p.name for p in tmp_path.iterdir()] == ["dem.tif"]

    def test_fault_08_a_damaged_unit_stops_it(self, photoplan: Here, model: Path, tmp_path: Path) -> None:
        import sqlite3

        spoilt = tmp_path / "m.gpkg"
        spoilt.write_bytes(model.read_bytes())
        with sqlite3.connect(spoilt) as db:
            db.execute("UPDATE photoplan_terrain_units SET checksum = 1 WHERE id = 6")
        db.close()
        for name in ("o.obj", "o.tif"):
            said = photoplan("dtm", "export", spoilt, "-o", tmp_path / name)
            assert said.code == 3 and "m.gpkg: unit column 2 row 1: damaged" in said.err
        assert [p.name for p in tmp_path.iterdir()] == ["m.gpkg"]


def test_a_raster_exported_and_a_model_of_it_agree(photoplan: Here, tmp_path: Path) -> None:
    """Export of a model whose heights have a large datum keeps a micrometre."""
    from tools.small_model import grid_unit

    write_units_of(tmp_path / "m.gpkg", LAYOUT, lambda c, r: grid_unit(LAYOUT, c, r, 8))
    photoplan("dtm", "export", tmp_path / "m.gpkg", "-o", tmp_path / "p.xyz")
    points = np.loadtxt(tmp_path / "p.xyz")
    assert len(points) == 33 * 25
    assert np.abs(points[:, 2] - hills(points[:, 0], points[:, 1])).max() < 1e-4
