"""Descriptions become the cameras they mean: units, signs, fiducial marks of a printed example."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera as ComputingCamera
from photoplan.errors import InputError
from photoplan.geometry.pose import Pose
from photoplan.io.camera.model import BrownLens, FilmEntry, FrameEntry, OpenCVLens, RadialTableLens
from photoplan.io.project.model import Image, fiducial_fit, image_size, interior_of, lens_of

IMAGE = Image(name="a", file="a.tif", camera="c", center=(0, 0, 0), angles=(0, 0, 0))
# Ecker 1991, §8.1; rows counted upwards there, so the film counts as mirrored.
QUARRY = FilmEntry(
    type="film",
    camera_constant_mm=153.24,
    principal_point_mm=(-0.001, 0.003),
    fiducials_mm={
        "1": (105.999, -106.016),
        "2": (-106.012, -106.006),
        "3": (-105.997, 105.993),
        "4": (106.007, 105.993),
    },
    size=(2300, 2300),
)
SCAN = {"1": (68.0, 131.5), "2": (62.0, 2248.0), "3": (2182.0, 2253.0), "4": (2189.0, 141.0)}


def project_at(camera: Any, points: Any, image: Image = IMAGE) -> np.ndarray:
    """Image points of camera directions (x right, y up, scene at z < 0)."""
    pose = Pose(np.zeros(3), np.eye(3))
    made = ComputingCamera(interior_of(camera, image), lens_of(camera), pose)
    return project(made, points)


def test_one_camera_described_in_pixels_and_in_millimetres() -> None:
    size, c, pixel = (640, 1152), 120.0, 0.144
    ways = [
        FrameEntry(size=size, focal_px=c / pixel, principal_point_px=(319.5 + 2, 575.5 + 3)),
        FrameEntry(size=size, camera_constant_mm=c, pixel_size_um=144.0, principal_point_mm=(2 * pixel, -3 * pixel)),
        FrameEntry(size=size, camera_constant_mm=c, pixel_size_um=144.0, principal_point_px=(321.5, 578.5)),
        FrameEntry(size=size, camera_constant_mm=c, sensor_size_mm=(92.16, 165.888), principal_point_px=(321.5, 578.5)),
    ]
    points = np.array([[0.0, 0, -1], [0.1, 0.2, -1], [-0.3, 0.1, -2]])
    expected = [[321.5, 578.5], [321.5 + 0.1 * c / pixel, 578.5 - 0.2 * c / pixel]]
    for camera in ways:
        np.testing.assert_allclose(project_at(camera, points)[:2], expected, atol=1e-9)
        np.testing.assert_allclose(camera.pixels.focal, c / pixel, rtol=1e-12)
        np.testing.assert_allclose(camera.pixels.point, (321.5, 578.5), atol=1e-9)


def test_the_default_principal_point_is_the_middle() -> None:
    camera = FrameEntry(size=(4, 3), focal_px=(10.0, 20.0))
    np.testing.assert_allclose(project_at(camera, [0.1, 0.1, -1.0]), [1.5 + 1.0, 1.0 - 2.0])


def test_opencv_lens_in_opencvs_own_frame() -> None:
    """x right, y down, z forwards: the formulas of its documentation, written out here."""
    k1, k2, p1, p2, k3, k4, k5, k6 = 0.1, -0.02, 0.003, -0.004, 0.005, 0.01, -0.006, 0.007
    lens = OpenCVLens(type="opencv", k1=k1, k2=k2, p1=p1, p2=p2, k3=k3, k4=k4, k5=k5, k6=k6)
    camera = FrameEntry(size=(2000, 1500), focal_px=(1500.0, 1490.0), principal_point_px=(990.0, 760.0), lens=lens)
    x, y = 0.31, -0.22
    r2 = x * x + y * y
    g = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    np.testing.assert_allclose(project_at(camera, [x, -y, -1.0]), [990 + 1500 * u, 760 + 1490 * v], atol=1e-9)


def test_browns_lens_in_every_unit_axis_and_meaning() -> None:
    c, pixel = 100.0, 0.005
    k1, p1, p2, b2 = -0.05, 1e-3, -2e-3, 1e-4
    size: Any = (8000, 6000)
    base: dict[str, Any] = {"size": size, "camera_constant_mm": c, "pixel_size_um": pixel * 1000}
    tangent = BrownLens(type="brown", k1=k1, p1=p1, p2=p2, b2=b2)
    mm = BrownLens(type="brown", unit="mm", k1=k1 / c**2, p1=p1 / c, p2=p2 / c, b2=b2)
    down = BrownLens(type="brown", y_axis="down", k1=k1, p1=p1, p2=-p2, b2=-b2)
    f = c / pixel
    px = BrownLens(type="brown", unit="px", k1=k1 / f**2, p1=p1 / f, p2=p2 / f, b2=b2)
    points = np.array([[0.1, 0.12, -1], [-0.15, 0.05, -1]])
    expected = project_at(FrameEntry(**base, lens=tangent), points)
    assert np.abs(expected - project_at(FrameEntry(**base), points)).max() > 1
    for lens in (mm, down, px):
        np.testing.assert_allclose(project_at(FrameEntry(**base, lens=lens), points), expected, atol=1e-8)
    correction = lens_of(FrameEntry(**base, lens=tangent.model_copy(update={"meaning": "correction"})))
    t = np.array([0.1, 0.12])
    np.testing.assert_allclose(lens_of(FrameEntry(**base, lens=tangent)).distort(correction.distort(t)), t, atol=1e-12)


def test_a_reports_radial_table_by_angle_and_by_radius() -> None:
    """The report OSL/1785: camera constant 152.299 mm, 4 µm outwards at 15°, 3 µm inwards at 30°."""
    angles = (7.5, 15.0, 22.7, 30.0, 35.0, 40.0)
    um = (3.0, 4.0, 1.0, -3.0, -4.0, 3.0)
    radii = tuple(float(152.299 * np.tan(np.radians(a))) for a in angles)
    base: dict[str, Any] = {"size": (23000, 23000), "camera_constant_mm": 152.299, "pixel_size_um": 10.0}
    by_angle = FrameEntry(**base, lens=RadialTableLens(type="radial_table", angles_deg=angles, distortion_um=um))
    by_radius = FrameEntry(**base, lens=RadialTableLens(type="radial_table", radii_mm=radii, distortion_um=um))
    for angle, shift in ((15.0, 4.0), (30.0, -3.0)):
        at = np.array([np.tan(np.radians(angle)), 0.0, -1.0])
        plain = project_at(FrameEntry(**base), at)
        for camera in (by_angle, by_radius):
            np.testing.assert_allclose((project_at(camera, at) - plain) * 10.0, [shift, 0.0], atol=1e-6)


def test_fault_15_the_quarrys_fiducials_and_the_name_of_the_image() -> None:
    image = IMAGE.model_copy(update={"fiducials": SCAN})
    mirrored = QUARRY.model_copy(update={"mirrored": True})
    v = fiducial_fit(mirrored, image).residuals
    # Ecker 1991, §8.1: ±0.23 and ±1.11 pixel.
    np.testing.assert_allclose(np.abs(v).mean(axis=0), [0.23, 1.11], atol=0.005)
    with pytest.raises(InputError, match=r"image 'a': .*mirrored"):
        fiducial_fit(QUARRY, image)
    exact = fiducial_fit(mirrored.model_copy(update={"interior": "bilinear"}), image)
    np.testing.assert_allclose(exact.residuals, 0, atol=1e-9)


def test_film_sends_the_principal_point_where_the_marks_say() -> None:
    image = IMAGE.model_copy(
        update={"fiducials": {n: (1150 + 10 * x, 1140 - 10 * y) for n, (x, y) in QUARRY.fiducials_mm.items()}}
    )
    axis = project_at(QUARRY, [0.0, 0.0, -1.0], image)
    np.testing.assert_allclose(axis, [1150 - 0.01, 1140 - 0.03], atol=1e-9)
    np.testing.assert_allclose(project_at(QUARRY, [0.1, 0.0, -1.0], image) - axis, [153.24, 0], atol=1e-9)


def test_sizes_come_from_the_image_or_its_camera() -> None:
    assert image_size(QUARRY, IMAGE) == (2300, 2300)
    assert image_size(QUARRY, IMAGE.model_copy(update={"size": (5, 6)})) == (5, 6)
    with pytest.raises(InputError, match="'a': its size"):
        image_size(QUARRY.model_copy(update={"size": None}), IMAGE)
