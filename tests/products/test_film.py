"""A film scan goes the same way as a digital image, only its interior orientation comes from fiducial marks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.real_projects import drone_project

from photoplan.errors import InputError
from photoplan.io.project.file import load_project, parse_project
from photoplan.io.project.model import Project
from photoplan.products.orthophoto.plan import plan_orthophotos, render

CAMERA = "DJI FC300S half-res"
BOUNDS = (576690.0, 5188125.0, 576745.0, 5188175.0)
MARKS = {"1": (100.0, 80.0), "2": (1890.0, 90.0), "3": (1900.0, 1040.0), "4": (110.0, 1050.0)}


@pytest.fixture(scope="module")
def digital(block: Path, tmp_path_factory: pytest.TempPathFactory) -> Project:
    return load_project(drone_project(block, tmp_path_factory.mktemp("film"), "DJI_0032"))


def as_film(project: Project, marks: dict[str, tuple[float, float]], interior: str = "affine") -> Project:
    """The same image described as the scan of a film with pixels of about 10 µm and four fiducial marks."""
    camera = project.cameras[CAMERA]
    fx, fy = camera.pixels.focal  # type: ignore[union-attr]
    col, row = camera.pixels.point  # type: ignore[union-attr]
    data = project.model_dump(mode="json", exclude_none=True)
    data["cameras"][CAMERA] = {
        "type": "film",
        "camera_constant_mm": fx / 100,
        "interior": interior,
        "fiducials_mm": {n: [(x - col) / 100, (row - y) * fx / fy / 100] for n, (x, y) in MARKS.items()},
        "lens": data["cameras"][CAMERA]["lens"],
    }
    data["images"][0] |= {"fiducials": {n: list(at) for n, at in marks.items()}, "size": [2000, 1125]}
    return parse_project(data, project.folder, "film")


@pytest.mark.parametrize("interior", ["affine", "bilinear"])
def test_the_scan_gives_the_same_orthophoto_as_the_digital_image(digital: Project, interior: str) -> None:
    want, good = render(plan_orthophotos(digital, resolution=0.1), "DJI_0032")
    got, valid = render(plan_orthophotos(as_film(digital, MARKS, interior), resolution=0.1), "DJI_0032")
    assert good.sum() > 100_000
    assert np.mean(valid != good) < 1e-4
    assert np.abs(got.astype(int) - want)[:, valid & good].max() <= 1


def test_a_scan_with_a_margin_gives_the_same_orthophoto(digital: Project, tmp_path: Path) -> None:
    """The picture lies 37 columns further right and 11 rows further down in its scan, and so do its marks."""
    with rasterio.open(digital.resolve(digital.images[0].file)) as image:
        pixels = np.pad(image.read(), ((0, 0), (11, 5), (37, 20)))
    profile = {"driver": "GTiff", "count": 3, "dtype": "uint8", "nodata": 0}
    with rasterio.open(tmp_path / "scan.tif", "w", width=2057, height=1141, **profile) as scan:
        scan.write(pixels)
    film = as_film(digital, {name: (x + 37, y + 11) for name, (x, y) in MARKS.items()})
    moved = film.images[0].model_copy(update={"file": str(tmp_path / "scan.tif"), "size": (2057, 1141)})
    want, good = render(plan_orthophotos(digital, resolution=0.1, bounds=BOUNDS), "DJI_0032")
    got, valid = render(
        plan_orthophotos(film.model_copy(update={"images": (moved,)}), resolution=0.1, bounds=BOUNDS), "DJI_0032"
    )
    both = valid & good
    assert both.sum() > 0.99 * good.sum() > 50_000
    assert np.mean(np.abs(got.astype(int) - want)[:, both] <= 1) > 0.9999


def test_fault_15_exchanged_marks_are_named(digital: Project) -> None:
    exchanged = {**MARKS, "1": MARKS["2"], "2": MARKS["1"]}
    with pytest.raises(InputError, match="DJI_0032"):
        plan_orthophotos(as_film(digital, exchanged), resolution=0.1)
