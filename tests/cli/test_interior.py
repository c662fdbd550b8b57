"""`photoplan interior`: figures of known scans, plots, the model of a camera, and marks that are wrong (fault 15)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from tools.command import Here, inside
from tools.film_scan import Film, Scan
from tools.recorded import recorded

from photoplan.io.project.file import load_project

FILM = Film((0.0, 0.0, 1500.0))
MARKS = Scan(FILM, np.zeros((1, 1), np.uint8)).marks

Marks = Mapping[str, tuple[float, float]]


def table(points: Marks) -> str:
    return "{ " + ", ".join(f"{n} = [{x:.4f}, {y:.4f}]" for n, (x, y) in points.items()) + " }"


def project(folder: Path, scans: Mapping[str, Marks | None], more: str = "", dpi: float | None = 200.0) -> Path:
    """A project with a small file for each scan, which states its resolution."""
    path = folder / "project.toml"
    text = [
        'format = 1\ncrs = "EPSG:31256"\n',
        f'[cameras.RC]\ntype = "film"\ncamera_constant_mm = 153.0\nfiducials_mm = {table(FILM.marks)}\n{more}',
        f"size = [{FILM.size}, {FILM.size}]  # of all scans\n",
        '[cameras.phone]\ntype = "frame"\nsize = [40, 30]\nfocal_px = 40.0\n',
    ]
    for name, marks in scans.items():
        with rasterio.open(folder / f"{name}.tif", "w", driver="GTiff", width=8, height=8, count=1, dtype="uint8") as f:
            f.write(np.zeros((1, 8, 8), np.uint8))
            if dpi:
                f.update_tags(TIFFTAG_XRESOLUTION=dpi, TIFFTAG_YRESOLUTION=dpi, TIFFTAG_RESOLUTIONUNIT=2)
        text.append(f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\ncamera = "RC"\n')
        text.append("" if marks is None else f"fiducials = {table(marks)}\n")
    path.write_text("".join(text))
    return path


def noisy(sd: float = 0.1, seed: int = 0) -> Marks:
    v = np.random.default_rng(seed).normal(0.0, sd, (8, 2))
    return {n: (x + e[0], y + e[1]) for (n, (x, y)), e in zip(MARKS.items(), v)}


def test_figures_are_those_that_the_scan_was_made_with(photoplan: Here, tmp_path: Path) -> None:
    said = photoplan("interior", project(tmp_path, {"a": MARKS}), "--json")
    assert said.code == 0
    (image,) = json.loads(said.out)["images"]
    assert image["shrinkage_permille"] == pytest.approx([0.28, 0.17], abs=2e-3)
    assert image["rotation_deg"] == pytest.approx(0.7, abs=1e-4)
    assert image["shear_mrad"] == pytest.approx(0.0, abs=2e-3)
    assert image["pixel_um"] == pytest.approx([127.0 * (1 + 2.8e-4), 127.0 * (1 + 1.7e-4)], rel=1e-5)
    assert image["scan_pitch_um"] == pytest.approx([127.0, 127.0])
    assert image["sigma0_px"] < 1e-4
    assert (image["model"], image["redundancy"], image["mirrored"], image["note"]) == ("affine", 10, False, None)


def test_a_scan_through_the_back_is_mirrored_and_not_upside_down(photoplan: Here, tmp_path: Path) -> None:
    """As `photoplan fiducials` counts: left and right are exchanged, then the picture is turned."""
    back = {n: (FILM.size - 1 - x, y) for n, (x, y) in MARKS.items()}
    said = photoplan("interior", project(tmp_path, {"a": back}, "mirrored = true\n"), "--json")
    (image,) = json.loads(said.out)["images"]
    assert image["mirrored"]
    assert image["rotation_deg"] == pytest.approx(-0.7, abs=1e-4)


def test_residuals_in_micrometres_and_pixels(photoplan: Here, tmp_path: Path) -> None:
    """One mark is measured 0.6 px too far to the right: residuals are transformed minus measured, y up on the film."""
    x, y = MARKS["6"]
    marks = {**MARKS, "6": (x + 0.6, y)}
    path = project(tmp_path, {"a": marks})
    (image,) = json.loads(photoplan("interior", path, "--json").out)["images"]
    rows = {m["name"]: m for m in image["marks"]}
    assert -0.6 < rows["6"]["residual_px"][0] < -0.2
    assert rows["6"]["residual_px"][0] == min(m["residual_px"][0] for m in rows.values())
    turn = math.radians(0.7)
    for m in rows.values():
        column, row = (127.0 * v for v in m["residual_px"])
        want = (math.cos(turn) * column + math.sin(turn) * row, math.sin(turn) * column - math.cos(turn) * row)
        assert m["residual_um"] == pytest.approx(want, rel=1e-3, abs=5e-3)
    assert image["sigma0_um"] == pytest.approx(127.0 * image["sigma0_px"], rel=1e-3)
    said = photoplan("interior", path)
    assert f"{rows['6']['residual_um'][0]:+8.1f}" in said.out
    assert "film shrinkage x" in said.out


@pytest.mark.parametrize(("model", "redundancy"), [("similarity", 12), ("affine", 10), ("bilinear", 8)])
def test_models(photoplan: Here, tmp_path: Path, model: str, redundancy: int) -> None:
    path = project(tmp_path, {"a": noisy()})
    before = path.read_text()
    (image,) = json.loads(photoplan("interior", path, "--model", model, "--json").out)["images"]
    assert (image["model"], image["redundancy"]) == (model, redundancy)
    assert 0.04 < image["sigma0_px"] < 0.3
    assert path.read_text() == before


def test_the_model_is_written_to_the_camera_alone(photoplan: Here, tmp_path: Path) -> None:
    path = project(tmp_path, {"a": noisy()})
    before = path.read_text()
    said = photoplan("interior", path, "--model", "similarity", "--write")
    assert said.code == 0, said.err
    assert "'RC': interior = 'similarity' written" in said.err
    assert load_project(path).cameras["RC"].interior == "similarity"  # type: ignore[union-attr]
    added = [line for line in path.read_text().splitlines() if line not in before.splitlines()]
    assert added == ['interior = "similarity"']
    assert path.with_suffix(".previous.toml").read_text() == before
    recorded(path.with_name(f"{path.stem}.interior.run.json"), "interior", path)
    refused = photoplan("interior", path, "--write")
    assert refused.code == 2
    assert "--model" in refused.err


def test_scan_resolution(photoplan: Here, tmp_path: Path) -> None:
    """What the file states, an option instead, nothing, and a tag that cannot be true."""
    path = project(tmp_path, {"a": MARKS})
    (image,) = json.loads(photoplan("interior", path, "--scan-resolution", "127.127um", "--json").out)["images"]
    assert image["shrinkage_permille"] == pytest.approx([0.28 - 1.0, 0.17 - 1.0], abs=2e-3)
    assert photoplan("interior", path, "--scan-resolution", "fine").code == 2
    for dpi, note in ((None, "states no resolution"), (72.0, "the file says 72 dpi, its marks say 199.9")):
        path = project(tmp_path, {"a": MARKS}, dpi=dpi)
        (image,) = json.loads(photoplan("interior", path, "--json").out)["images"]
        assert image["shrinkage_permille"] is None
        assert note in image["note"]
    (tmp_path / "a.tif").unlink()
    said = photoplan("interior", path)
    assert said.code == 0
    assert "the scan cannot be opened" in said.out


@pytest.mark.drawn
def test_plot_and_report(photoplan: Here, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    scans = {f"scan_{k}": noisy(seed=k) for k in range(3)}
    path = project(tmp_path, {**scans, "bare": None})
    outputs = ["--plot", tmp_path / "r.png", "--report", tmp_path / "r.html"]
    said = photoplan("interior", path, *outputs)
    assert said.code == 0, said.err
    assert "marks not measured in bare" in said.err
    assert str(tmp_path / "r.png") in said.out
    with rasterio.open(tmp_path / "r.png") as picture:
        assert min(picture.shape) > 500
        assert np.ptp(picture.read(1)) > 100
    text = (tmp_path / "r.html").read_text()
    assert text.count("<tr>") == 2 + 3 + 3 * 8
    assert "Residual vectors" in text
    before = (tmp_path / "r.png").read_bytes()
    again = photoplan("interior", path, *outputs)
    assert again.code == 2
    assert "--overwrite" in again.err
    assert photoplan("interior", path, *outputs, "--overwrite").code == 0
    assert (tmp_path / "r.png").read_bytes() == before
    mine = photoplan("interior", path, "--plot", path, "--overwrite")
    assert mine.code == 2
    assert "is the input" in mine.err


def test_vectors_are_drawn_to_one_round_scale() -> None:
    pytest.importorskip("matplotlib")
    from photoplan.report.orientation import vector_scale

    plane = np.array(list(FILM.marks.values()))
    for longest, want in ((56.0, 1000.0), (5.6, 10_000.0), (560.0, 100.0), (60.0, 700.0)):
        panel = SimpleNamespace(plane_mm=plane, residuals_um=np.full((8, 2), longest / math.sqrt(2)))
        assert vector_scale([panel]) == pytest.approx(want)


def test_fault_15_wrong_marks_are_named_and_the_others_computed(photoplan: Here, tmp_path: Path) -> None:
    good = noisy()
    path = project(
        tmp_path,
        {
            "fine": good,
            "swapped": {**good, "1": good["3"], "3": good["1"]},
            "mirrored": {n: (FILM.size - x, y) for n, (x, y) in good.items()},
            "off": {**good, "7": (good["7"][0] + 40, good["7"][1])},
        },
    )
    said = photoplan("interior", path)
    assert said.code == 4
    assert said.out.startswith("fine  affine, 8 marks")
    assert "3 of 4 images failed" in said.err
    assert "image 'swapped': fiducial marks '1' and '3' are exchanged" in said.err
    assert "image 'mirrored': the scan is mirrored" in said.err
    assert "image 'off': fiducial marks: '7' is wrong" in said.err
    before = path.read_text()
    assert photoplan("interior", path, "--model", "bilinear", "--write").code == 4
    assert path.read_text() == before
    alone = photoplan("interior", path, "--images", "swapped")
    assert alone.code == 3
    assert "exchanged" in alone.err


def test_fault_15_nothing_to_orient(photoplan: Here, tmp_path: Path) -> None:
    path = project(tmp_path, {"a": None})
    said = photoplan("interior", path)
    assert said.code == 3
    assert "no fiducial marks are measured in a" in said.err
    path.write_text(path.read_text().replace('camera = "RC"', 'camera = "phone"'))
    said = photoplan("interior", path)
    assert said.code == 3
    assert "none of 1 images is the scan of a film" in said.err
    assert photoplan("interior", path, "--images", "b").code == 2
    assert photoplan("interior", tmp_path / "nothing.toml").code == 3


def test_the_size_of_a_scan_that_is_there_is_not_asked_for(tmp_path: Path, shared: Path) -> None:
    """The example of the how-to page on film states no size."""
    text = (shared / "cases/film_size/project.toml").read_text()
    (tmp_path / "project.toml").write_text(text)
    said = inside("interior", tmp_path / "project.toml")
    assert said.code == 3
    assert "and its file cannot be read; give the scan, or state the size" in said.err
    with rasterio.open(tmp_path / "s.tif", "w", driver="GTiff", width=1100, height=1100, count=1, dtype="uint8"):
        pass
    said = inside("interior", tmp_path / "project.toml")
    assert said.code == 0, said.err
    assert "sigma0" in said.out
    assert (tmp_path / "project.toml").read_text() == text
