"""Photographs from a few metres: tenths of a millimetre are printed, and a camera that looks along X is no worse."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from tools.command import inside

from photoplan.cameras.base import project as project_points
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.geometry.pose import Pose, rotation_from_angles
from photoplan.plain import shown_metres
from photoplan.report.adjust import plain

SIZE, C = (4000, 3000), 3200.0


def facade(folder: Path, angles: tuple[float, float, float]) -> Path:
    """An image of twelve targets 5 m away, measured to 0.2 px; without curvature."""
    rng = np.random.default_rng(2)
    pose = Pose(np.array([500_010.0, 5_400_020.0, 301.7]), rotation_from_angles(np.radians(angles), "opk"))
    t = np.column_stack([rng.uniform(-0.55, 0.55, 12), rng.uniform(-0.42, 0.42, 12), np.full(12, -1.0)])
    XYZ = pose.to_ground(t * rng.uniform(4.0, 6.0, 12)[:, None])
    camera = FrameCamera(Interior.digital(SIZE, (C, C), (0.0, 0.0)), NoLens(), pose)
    xy = project_points(camera, XYZ) + rng.normal(0, 0.2, (12, 2))
    points = [f"K{k},a,{x:.3f},{y:.3f}" for k, (x, y) in enumerate(xy)]
    (folder / "points.csv").write_text("\n".join(["point,image,x,y", *points]) + "\n")
    control = [f"K{k},{X:.6f},{Y:.6f},{Z:.6f}" for k, (X, Y, Z) in enumerate(XYZ)]
    (folder / "control.csv").write_text("\n".join(["name,x,y,z", *control]) + "\n")
    project = folder / "project.toml"
    project.write_text(
        f"""crs = "EPSG:32632"
[orientation]
height_system = "ellipsoidal"
angle_unit = "deg"
rotation = "opk"
earth_curvature = "none"
[observations]
image_points = ["points.csv"]
control = ["control.csv"]
sigma_image = 0.2
sigma_control = [0.0, 0.0]
[cameras.cam]
type = "frame"
size = [{SIZE[0]}, {SIZE[1]}]
focal_px = {C}
[[images]]
name = "a"
file = "a.tif"
camera = "cam"
"""
    )
    return project


def test_resection_from_5_m_prints_two_figures_of_its_standard_deviations(tmp_path: Path) -> None:
    said = inside("resect", facade(tmp_path, (88.0, 20.0, 2.0)), "--dry-run")
    assert said.code == 0, said.err
    sigmas = re.findall(r"[XYZ]0 \S+ ± (\S+) m", said.out)
    assert len(sigmas) == 3
    assert all(float(s) < 1e-3 and len(s.lstrip("0.")) == 2 for s in sigmas), sigmas


def test_at_a_phi_of_90_degrees_the_rotation_is_known_though_omega_and_kappa_are_not(tmp_path: Path) -> None:
    """Angles are singular there; the covariance of the rotation vector says what is known, as in any direction."""
    found = {}
    for phi in (0.0, 90.0):
        folder = tmp_path / f"{phi:g}"
        folder.mkdir()
        said = inside("resect", facade(folder, (0.0, phi, 0.0)), "--dry-run", "--json", "-q")
        assert said.code == 0, said.err
        found[phi] = json.loads(said.out)["images"][0]
    sigma = {phi: np.degrees(np.sqrt(np.diag(image["covariance_rotation"]))) for phi, image in found.items()}
    assert (sigma[0.0] < 0.02).all()
    # About the camera's own axes it is the same photograph.
    np.testing.assert_allclose(np.sort(sigma[90.0]), np.sort(sigma[0.0]), rtol=0.3)
    angles = found[90.0]["sigma_angles"]
    assert max(angles) > 1.0 > max(found[0.0]["sigma_angles"])


@pytest.mark.parametrize(
    ("value", "said"), [(0.000123, "0.00012"), (0.0499, "0.050"), (1.23456, "1.235"), (0.0, "0.000")]
)
def test_lengths_of_summaries_and_reports_have_two_figures_and_millimetres(value: float, said: str) -> None:
    assert shown_metres(value, value) == f"{said} m"
    assert plain(value) == said
