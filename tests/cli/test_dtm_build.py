"""`photoplan dtm build`: from files to a model, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tools.build_terrain import scattered
from tools.command import Here
from tools.landxml import write_landxml

from photoplan.io.disk import FileLock
from photoplan.io.terrain.model import ModelReader
from photoplan.surfaces.hybrid import HybridSurface

EAST, NORTH = 500_000.0, 5_300_000.0
SHIFT = np.array([EAST, NORTH, 0.0])
FIELDS = ("points", "lines", "units", "covariance", "variance", "length", "noise", "sigma", "gross", "gross_errors",
          "findings", "crs", "seconds", "spread")  # fmt: skip


def ground(count: int = 700, noise: float = 0.05) -> np.ndarray:
    """A roof along X = 20 with one point too high by two metres."""
    xy = scattered(40.0, count, 3)
    z = 250 - 0.5 * np.abs(xy[:, 0] - 20) + 0.02 * xy[:, 1] + np.random.default_rng(4).normal(0, noise, len(xy))
    z[len(xy) // 3] += 2.0
    return np.column_stack([xy, z]) + SHIFT


def ridge() -> np.ndarray:
    y = np.linspace(0, 40, 41)
    return np.column_stack([np.full(41, 20.0), y, 250 + 0.02 * y]) + SHIFT


@pytest.fixture
def survey(tmp_path: Path) -> Path:
    return write_landxml(tmp_path / "survey.xml", ground(350), {"ridge": ridge()})


def write_text(path: Path, xyz: np.ndarray, header: str = "x,y,z\n") -> Path:
    path.write_text(header + "".join(f"{x:.3f},{y:.3f},{z:.3f}\n" for x, y, z in xyz))
    return path


def left(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.name.startswith("."))


class TestBuilt:
    def test_model_record_and_report(self, photoplan: Here, survey: Path, tmp_path: Path) -> None:
        out = tmp_path / "model.gpkg"
        said = photoplan("dtm", "build", survey, "-o", out, "--height-system", "EPSG:5773")
        assert said.code == 0, said.err
        assert said.out.splitlines()[0] == str(out) and "gross error" in said.err
        reader = ModelReader(out)
        assert reader.header.crs.endswith("32633") or "32633" in reader.header.crs
        XY = np.random.default_rng(5).uniform(3, 37, (500, 2)) + SHIFT[:2]
        z = 250 - 0.5 * np.abs(XY[:, 0] - EAST - 20) + 0.02 * (XY[:, 1] - NORTH)
        error = HybridSurface(reader).heights(XY) - z
        assert np.sqrt(np.mean(error**2)) < 0.05
        record = json.loads((tmp_path / "model.run.json").read_text())
        assert record["kind"] == "terrain model" and record["product"]["gross"] == 1
        assert record["inputs"][0]["path"] == survey.name and record["peak_memory_bytes"] > 0
        page = tmp_path / "model.report.html"
        assert str(page) in said.out
        text = page.read_text()
        assert "system not stated" not in text and "heights: EPSG:5773" in text
        assert left(tmp_path) == [] or left(tmp_path) == [".model.gpkg.lock"]

    def test_a_level_surface_is_reported_even_quietly(self, photoplan: Here, tmp_path: Path) -> None:
        level = write_text(tmp_path / "p.csv", ground(60) * [1, 1, 0])
        said = photoplan("dtm", "build", level, "-o", tmp_path / "m.gpkg", "--crs", "EPSG:32633", "-q", "--no-report")
        assert said.code == 0 and "heights are 0 m: the surface is level" in said.err
        said = photoplan("dtm", "build", level, "-o", tmp_path / "n.gpkg", "--crs", "EPSG:32633", "--no-report")
        assert said.err.count("the surface is level") == 1

    def test_files_without_anything_are_refused_by_name(self, photoplan: Here, tmp_path: Path) -> None:
        place = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
        empty = tmp_path / "empty.geojson"
        empty.write_text(json.dumps({"type": "FeatureCollection", "features": [], "crs": place}))
        level = write_text(tmp_path / "p.csv", ground(60) * [1, 1, 0] + [0, 0, -9999])
        for file, words in ((empty, ()), (level, ("--crs", "EPSG:32633", "--nodata", -9999))):
            said = photoplan("dtm", "build", file, "-o", tmp_path / "m.gpkg", *words, "--no-report")
            assert said.code == 3 and f"{file}: " in said.err and "holds no" in said.err, said

    def test_what_was_converted_or_left_out_is_printed_once_also_quietly(self, photoplan: Here, tmp_path: Path) -> None:
        ezdxf = pytest.importorskip("ezdxf")
        document = ezdxf.new("R2010", setup=False)
        document.header["$INSUNITS"] = 2  # feet
        for x, y, z in ground(60) / 0.3048:
            document.modelspace().add_point((x, y, z))
        document.modelspace().add_3dface([(EAST / 0.3048 + k % 2, NORTH / 0.3048 + k // 2, 820) for k in (0, 1, 3)])
        document.saveas(tmp_path / "d.dxf")
        words = ("--crs", "EPSG:32633", "--height-system", "EPSG:5773", "--no-report")
        for k, quiet in enumerate(((), ("-q",))):
            said = photoplan("dtm", "build", tmp_path / "d.dxf", "-o", tmp_path / f"{k}.gpkg", *words, *quiet)
            assert said.code == 0, said.err
            notes = [line.strip() for line in said.err.splitlines() if "d.dxf: " in line]
            assert all(note.startswith("note: ") for note in notes), said.err
            assert len(set(notes)) == len(notes) >= 2, said.err

    def test_json_gives_the_figures(self, photoplan: Here, survey: Path, tmp_path: Path) -> None:
        said = photoplan("dtm", "build", survey, "-o", tmp_path / "m.gpkg", "--json", "-q", "--no-report")
        assert said.code == 0 and said.err == ""
        facts = json.loads(said.out)
        assert set(FIELDS) <= facts.keys()
        assert facts["gross"] == 1 and facts["lines"] == {"breakline": 1} and facts["report"] is None
        assert facts["noise"] == pytest.approx(0.05, rel=0.3)
        told = json.loads(photoplan("dtm", "info", tmp_path / "m.gpkg", "--json").out)
        for name in ("length", "noise", "sigma", "spread"):
            assert told[name] == facts[name], name
        assert told["signal"] == pytest.approx(np.sqrt(facts["variance"]))
        (wrong,) = facts["gross_errors"]
        assert f"(record {len(ground(350)) // 3 + 1})" in wrong["name"] and wrong["residual"] == pytest.approx(
            2, abs=0.3
        )

    @pytest.mark.slow
    def test_level_ground_is_as_noisy_as_its_points(self, photoplan: Here, tmp_path: Path) -> None:
        xy = scattered(40.0, 700, 3)
        level = np.column_stack([xy, 250 + np.random.default_rng(4).normal(0, 0.05, len(xy))])
        points, model = write_text(tmp_path / "lake.csv", level + SHIFT), tmp_path / "m.gpkg"
        said = photoplan("dtm", "build", points, "-o", model, "--crs", "EPSG:32633", "--json", "-q", "--no-report")
        assert said.code == 0, said.err
        assert json.loads(said.out)["noise"] == pytest.approx(0.05, rel=0.12)

    def test_dry_run_writes_nothing(self, photoplan: Here, survey: Path, tmp_path: Path) -> None:
        before = sorted(tmp_path.iterdir())
        said = photoplan("dtm", "build", survey, "-o", tmp_path / "m.gpkg", "--dry-run")
        assert said.code == 0 and "points, 1 breakline" in said.out and "grid" in said.out
        assert sorted(tmp_path.iterdir()) == before

    def test_options_reach_the_model(self, photoplan: Here, tmp_path: Path) -> None:
        survey, out = write_landxml(tmp_path / "s.xml", ground(), {"ridge": ridge()}), tmp_path / "m.gpkg"
        words = (
            "--grid-width",
            1,
            "--adapt",
            0,
            "--unit-meshes",
            16,
            "--filter",
            "mass=0.08",
            "--covariance",
            "matern",
        )
        said = photoplan("dtm", "build", survey, "-o", out, *words, "--gross", 0, "--json", "--no-report")
        facts = json.loads(said.out)
        assert facts["grid_widths"].keys() == {"1"} and facts["noise"] == pytest.approx(0.08, rel=1e-4)
        assert facts["covariance"] == "matern" and facts["gross"] == 0
        assert ModelReader(out).layout.side == 16

    @pytest.mark.slow
    def test_fault_26_any_number_of_workers_gives_the_same_model(
        self, photoplan: Here, survey: Path, tmp_path: Path
    ) -> None:
        found = set()
        for workers in (1, 2):
            out = tmp_path / f"m{workers}.gpkg"
            words = ("--workers", workers, "--unit-meshes", 16, "--no-report")
            assert photoplan("dtm", "build", survey, "-o", out, *words).code == 0
            found.add(ModelReader(out).header.identity)
        assert len(found) == 1


class TestRefused:
    def refuse(self, photoplan: Here, code: int, *words: object) -> str:
        said = photoplan("dtm", "build", *words)
        assert said.code == code, said
        assert said.out == ""
        return said.err

    def test_fault_13_output_that_exists_or_is_an_input(self, photoplan: Here, survey: Path, tmp_path: Path) -> None:
        out = tmp_path / "m.gpkg"
        out.write_text("mine")
        assert "--overwrite" in self.refuse(photoplan, 2, survey, "-o", out)
        assert out.read_text() == "mine"
        same = survey.rename(tmp_path / "same.gpkg")
        self.refuse(photoplan, 2, same, "-o", same, "--overwrite")
        out.unlink()
        out.symlink_to(same)
        self.refuse(photoplan, 2, same, "-o", out, "--overwrite")

    def test_fault_20_crs_missing(self, photoplan: Here, tmp_path: Path) -> None:
        said = self.refuse(photoplan, 3, write_text(tmp_path / "p.csv", ground()), "-o", tmp_path / "m.gpkg")
        assert "p.csv" in said and "--crs" in said

    @pytest.mark.parametrize("crs", ["EPSG:2272", "EPSG:4326"])
    def test_fault_20_crs_in_feet_or_degrees(self, photoplan: Here, tmp_path: Path, crs: str) -> None:
        path = write_text(tmp_path / "p.csv", ground())
        self.refuse(photoplan, 3, path, "-o", tmp_path / "m.gpkg", "--crs", crs)
        assert not (tmp_path / "m.gpkg").exists()

    def test_fault_18_header_only(self, photoplan: Here, tmp_path: Path) -> None:
        path = tmp_path / "p.csv"
        path.write_text("x,y,z\n")
        said = self.refuse(photoplan, 3, path, "-o", tmp_path / "m.gpkg", "--crs", "EPSG:32633")
        assert "p.csv" in said and "line" in said

    def test_fault_18_a_line_that_is_no_point(self, photoplan: Here, tmp_path: Path) -> None:
        path = tmp_path / "p.csv"
        path.write_text("x,y,z\n1,2,3\n4,5,six\n")
        said = self.refuse(photoplan, 3, path, "-o", tmp_path / "m.gpkg", "--crs", "EPSG:32633")
        assert "p.csv" in said and "3" in said

    def test_fault_16_points_on_one_line(self, photoplan: Here, tmp_path: Path) -> None:
        t = np.linspace(0, 50, 30)
        path = write_text(tmp_path / "p.csv", np.column_stack([t, 2 * t, t]) + SHIFT)
        said = self.refuse(photoplan, 3, path, "-o", tmp_path / "m.gpkg", "--crs", "EPSG:32633")
        assert "line" in said and not (tmp_path / "m.gpkg").exists()

    def test_a_model_is_a_geopackage(self, photoplan: Here, survey: Path, tmp_path: Path) -> None:
        assert ".gpkg" in self.refuse(photoplan, 2, survey, "-o", tmp_path / "m.tif")

    @pytest.mark.parametrize("words", ["--filter mass", "--filter trees=1", "--filter mass=-1", "--unit-meshes 48",
                                       "--covariance cubic", "--grid-width 0"])  # fmt: skip
    def test_options_that_cannot_be(self, photoplan: Here, survey: Path, tmp_path: Path, words: str) -> None:
        self.refuse(photoplan, 2, survey, "-o", tmp_path / "m.gpkg", *words.split())
        assert not (tmp_path / "m.gpkg").exists()

    def test_fault_26_two_runs_on_one_output(self, photoplan: Here, survey: Path, tmp_path: Path) -> None:
        lock = FileLock(tmp_path / ".m.gpkg.lock")
        lock.acquire()
        try:
            said = photoplan("dtm", "build", survey, "-o", tmp_path / "m.gpkg", "--no-report")
        finally:
            lock.release()
        assert said.code != 0 and "m.gpkg" in said.err and not (tmp_path / "m.gpkg").exists()


def test_fault_19_crossing_breaklines_of_different_height_are_reported(photoplan: Here, tmp_path: Path) -> None:
    x = np.linspace(2, 38, 37)
    lines = {"ridge": ridge(), "pipe": np.column_stack([x, np.full(37, 20.0), np.full(37, 240.0)]) + SHIFT}
    path = write_landxml(tmp_path / "s.xml", ground(200), lines)
    said = photoplan("dtm", "build", path, "-o", tmp_path / "m.gpkg", "--dry-run")
    assert said.code == 0
    (finding,) = [text for text in said.out.splitlines() if "cross" in text]
    assert "ridge" in finding and "pipe" in finding
    said = photoplan("dtm", "build", path, "-o", tmp_path / "m.gpkg", "--json", "--no-report")
    assert said.code == 0
    found = [f for f in json.loads(said.out)["findings"] if "cross" in f["text"] or "cross" in f["kind"]]
    assert len(found) == 1
    assert abs(found[0]["X"] - EAST - 20) < 0.1 and abs(found[0]["Y"] - NORTH - 20) < 0.1
