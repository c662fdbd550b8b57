"""`photoplan control` on some images of the drone block whose orientation is spoilt."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import Here
from tools.proposed import residuals, spoilt
from tools.real_projects import drone_project
from tools.recorded import recorded

from photoplan.io.points import read_ground_points, read_image_points
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project

IMAGES = ("DJI_0025", "DJI_0026", "DJI_0027")


@pytest.fixture(scope="module")
def true(block: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drone_project(block, tmp_path_factory.mktemp("control"), *IMAGES)


@pytest.fixture
def near(true: Path, tmp_path: Path) -> Path:
    path = tmp_path / "project.toml"
    path.write_text(true.read_text())
    spoilt(path, 5.0, 0.2)
    return path


def words(block: Path, project: Path, *more: object) -> list[object]:
    ortho = block / "ref_ortho_from_cloud.tif"
    return ["control", project, "--ortho", ortho, "--height-sigma", 0.1, "--search", 10, "--workers", 1, *more]


def test_control_is_proposed_that_fits_the_true_orientation(
    photoplan: Here, block: Path, true: Path, near: Path
) -> None:
    said = photoplan(*words(block, near))
    assert said.code == 0, said
    control = near.with_name("control.csv")
    assert said.out.splitlines()[:2] == [str(control), str(near.with_name("control_points.csv"))]
    error = residuals(true, control)
    print(f"{len(error)} points, rms {np.sqrt((error**2).mean()):.2f} px")
    assert len(error) >= 60
    assert np.sqrt((error**2).mean()) <= 2.0  # measured: 0.84; the orthophoto's pixels are four pixels of the images
    assert np.sqrt((error.mean(axis=0) ** 2).sum()) <= 0.5
    observations = load_project(near).observations
    assert observations.control == ("control.csv",) and observations.image_points == ("control_points.csv",)
    ground, points = read_ground_points(control), read_image_points(near.with_name("control_points.csv"))
    np.testing.assert_allclose(ground.sigma[:, :2], 0.2)  # one pixel of the orthophoto
    assert (ground.sigma[:, 2] >= 0.1).all() and not ground.check.any()
    assert (points.sigma >= 0.1).all()
    spread = np.ptp(ground.XYZ, axis=0)
    assert min(spread[:2]) > 40
    record = recorded(near.with_name("control.run.json"), "control", near)
    assert record["product"]["points"] == len(ground) and record["settings"]["grid"] == 8


def test_json_and_refusal_of_files_that_exist(photoplan: Here, block: Path, near: Path) -> None:
    images = ["--images", IMAGES[0], "--ortho-sigma", 0.05, "--grid", 4]
    found = json.loads(photoplan(*words(block, near, *images, "--json")).out)
    (image,) = found["images"]
    assert image["image"] == IMAGES[0] and image["kept"] == found["points"] <= image["matched"] <= image["tried"]
    assert found["sigma"]["plane"] == pytest.approx(0.05) and np.hypot(*image["shift"]) > 20
    assert image["tried"] == image["kept"] + sum(image["reasons"].values())
    said = photoplan(*words(block, near, *images))
    assert said.code == 2 and "--overwrite" in said.err


def test_dry_run_writes_nothing(photoplan: Here, block: Path, near: Path) -> None:
    before = near.read_text()
    said = photoplan(*words(block, near, "--dry-run"))
    assert said.code == 0 and "patches at 0.2 m" in said.out
    assert near.read_text() == before and not near.with_name("control.csv").exists()


def test_orthophoto_of_another_place_is_refused(photoplan: Here, block: Path, near: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.tif"
    with rasterio.open(block / "ref_ortho_from_cloud.tif") as source:
        pixels, profile = source.read(), source.profile
    for crs, shift, message in (
        ("EPSG:32633", 0.0, "transform it with"),
        (None, 0.0, "its CRS is needed"),
        (profile["crs"], 9000.0, "no textured place"),
    ):
        there = profile["transform"] @ rasterio.Affine.translation(shift, 0)
        with rasterio.open(other, "w", **{**profile, "crs": crs, "transform": there}) as out:
            out.write(pixels)
        said = photoplan("control", near, "--ortho", other, "--height-sigma", 0.1)
        assert said.code == 3 and message in said.err, said


def test_control_far_from_the_search_is_refused(photoplan: Here, block: Path, near: Path) -> None:
    spoilt(near, 25.0, 0.0)
    said = photoplan(*words(block, near, "--search", 2, "--images", IMAGES[0], "--grid", 4))
    assert said.code == 3 and "--search" in said.err
    assert not near.with_name("control.csv").exists()


def test_images_without_orientation_are_told(photoplan: Here, block: Path, near: Path) -> None:
    edit_project(near, ProjectChanges(images={n: {"center": None, "angles": None} for n in IMAGES}))
    said = photoplan(*words(block, near))
    assert said.code == 3 and "none of the images has an approximate orientation" in said.err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--radius", 2], "--radius 2"),
        (["--grid", 0], "--grid 0"),
        (["--height-sigma", -1], "--height-sigma -1"),
        (["--ortho-sigma", 0], "a positive number of metres"),
        (["--search", 900], "at most 600 are searched"),
    ],
)
def test_wrong_use(photoplan: Here, block: Path, near: Path, options: list[object], message: str) -> None:
    said = photoplan(*words(block, near, *options))
    assert said.code == 2 and message in said.err, said


def test_orthophotos_of_two_resolutions_are_refused(photoplan: Here, block: Path, near: Path, tmp_path: Path) -> None:
    """Patches of the second one were compared at the first one's scale: none was ever found."""
    coarse = tmp_path / "coarse.tif"
    with rasterio.open(block / "ref_ortho_from_cloud.tif") as source:
        pixels, profile = source.read()[:, ::2, ::2], source.profile
    profile |= {"transform": profile["transform"] @ rasterio.Affine.scale(2)}
    with rasterio.open(coarse, "w", **profile | {"width": pixels.shape[2], "height": pixels.shape[1]}) as out:
        out.write(pixels)
    said = photoplan(*words(block, near, "--ortho", coarse))
    assert said.code == 3 and "pixels of 0.4 m, those of" in said.err and "are 0.2 m" in said.err
    assert not near.with_name("control.csv").exists()


def test_what_no_patch_can_reach(photoplan: Here, block: Path, near: Path) -> None:
    said = photoplan(*words(block, near, "--correlation", 2))
    assert said.code == 2 and "--correlation 2" in said.err
    said = photoplan(*words(block, near, "--correlation", 0.9999, "--images", IMAGES[0], "--grid", 3))
    assert said.code == 3 and "no patch of the orthophoto was found in an image: " in said.err and " unlike" in said.err
