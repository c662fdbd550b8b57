"""Orientations that cannot be are refused, with the reading of the measurements that would fit."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from tools.plain_block import SIZE, pixels

from photoplan.geometry.pose import rotation_from_angles
from photoplan.products.film import ResectRequest, resect_project

CENTER = np.array([500_200.0, 500_900.0, 1400.0])


def made(folder: Path, change: str = "", n: int = 9) -> Path:
    """A vertical image of nine control points, and what is written otherwise."""
    rng = np.random.default_rng(4)
    X = CENTER + np.column_stack([rng.uniform(-500, 500, n), rng.uniform(-350, 350, n), rng.uniform(-1250, -1000, n)])
    if change == "rough":
        X = CENTER + np.array([[-450, 300, -1000], [450, 300, -1250], [-450, -300, -1250], [450, -300, -1000]])
    xy = pixels(X, CENTER, rotation_from_angles(np.radians([1.2, -0.8, 12.0]))) + rng.normal(0, 0.4, (n, 2))
    if change == "exchanged":
        X = X[:, [1, 0, 2]]
    elif change == "upwards":
        xy[:, 1] = SIZE[1] - 1 - xy[:, 1]
    elif change == "feet":
        X = X / [1.0, 1.0, 0.3048]
    elif change in ("depths", "rough"):
        X = X * [1.0, 1.0, -1.0]
        xy += rng.normal(0, 3.0 if change == "rough" else 0.0, xy.shape)
    elif change == "names":
        X = X[rng.permutation(n)]
    folder.mkdir(exist_ok=True)
    rows = [f"K{k},a,{x:.3f},{y:.3f}" for k, (x, y) in enumerate(xy)]
    (folder / "points.csv").write_text("\n".join(["point,image,x,y", *rows]) + "\n")
    rows = [f"K{k},{x:.3f},{y:.3f},{z:.3f}" for k, (x, y, z) in enumerate(X)]
    (folder / "control.csv").write_text("\n".join(["name,x,y,z", *rows]) + "\n")
    (folder / "project.toml").write_text(
        f"""crs = "EPSG:32632"
[orientation]
height_system = "ellipsoidal"
[observations]
image_points = ["points.csv"]
control = ["control.csv"]
sigma_image = 0.5
sigma_control = [0.05, 0.05]
[cameras.cam]
type = "frame"
size = [{SIZE[0]}, {SIZE[1]}]
focal_px = 3600.0
[[images]]
name = "a"
file = "a.tif"
camera = "cam"
"""
    )
    return folder / "project.toml"


def test_what_is_right_is_written(tmp_path: Path) -> None:
    result = resect_project(ResectRequest(made(tmp_path)))
    assert result.written() and not result.failed
    np.testing.assert_allclose(result.images[0].center, CENTER, atol=1.0)


@pytest.mark.parametrize(
    ("change", "says", "fits"),
    [
        ("exchanged", "the camera lies [0-9]+ m below its ground points and looks up", "with X and Y of control exch"),
        ("upwards", "the camera lies [0-9]+ m below its ground points and looks up", "with y of image points upwards"),
        ("feet", "(residuals of [0-9]+ px are|points do not fit)", "with heights of control in feet, 9 of 9 points"),
        ("depths", ".", "with Z of control counted downwards, or away from the camera, 9 of 9 points"),
    ],
)
def test_impossible_poses_are_refused_and_what_fits_is_named(tmp_path: Path, change: str, says: str, fits: str) -> None:
    path = made(tmp_path, change)
    before = path.read_text()
    result = resect_project(ResectRequest(path))
    assert not result.written() and not result.images
    assert path.read_text() == before
    assert re.search(says, result.failed["a"]), result.failed
    assert fits in result.failed["a"]
    assert "9 of 9 points fit to 0." in result.failed["a"]


def test_a_reading_that_fits_much_better_is_named_whatever_was_stated(tmp_path: Path) -> None:
    """Four points, measured to some 4 px where 0.5 px are stated."""
    result = resect_project(ResectRequest(made(tmp_path, "rough", n=4)))
    assert "with Z of control counted downwards" in result.failed["a"]


def test_where_nothing_fits_this_is_said(tmp_path: Path) -> None:
    result = resect_project(ResectRequest(made(tmp_path, "names")))
    assert not result.written()
    assert "do not determine" in result.failed["a"]


@pytest.mark.slow
def test_a_block_with_exchanged_axes_is_refused(tmp_path: Path) -> None:
    from tools.adjust_project import MIDDLE, Make, write_project

    from photoplan.errors import GeometryError
    from photoplan.products.adjust.run import AdjustRequest, adjust_project

    made = write_project(tmp_path, Make(pixel_noise=0.3, curvature="none", start=(np.nan, np.nan)))
    rows = (tmp_path / "control.csv").read_text().splitlines()
    out = [rows[0]]
    for row in rows[1:]:
        name, x, y, *rest = row.split(",")
        # About the same place, so that nothing else tells.
        x, y = float(y) - MIDDLE[1] + MIDDLE[0], float(x) - MIDDLE[0] + MIDDLE[1]
        out.append(",".join([name, f"{x:.4f}", f"{y:.4f}", *rest]))
    (tmp_path / "control.csv").write_text("\n".join(out) + "\n")
    before = made.path.read_text()
    with pytest.raises(GeometryError, match="below its ground points and looks up"):
        adjust_project(AdjustRequest(made.path))
    assert made.path.read_text() == before


def test_a_camera_constant_wrong_by_a_factor_of_two_is_refused(tmp_path: Path) -> None:
    from tools.adjust_project import Make, write_project

    from photoplan.errors import GeometryError
    from photoplan.products.adjust.run import AdjustRequest, adjust_project

    wrong = {"focal_px": 7200.0}
    made = write_project(tmp_path, Make(pixel_noise=0.3, curvature="none", stated=wrong))
    with pytest.raises(GeometryError, match=r"camera constant of camera 'cam': 0\.5.* times what is stated"):
        adjust_project(AdjustRequest(made.path))
