"""The frame camera: Ecker 1991, eq. 3.1–3.4 and appendix B."""

from __future__ import annotations

import numpy as np
import pytest
from camera_examples import INTERIORS, LENSES, numeric_derivative
from hypothesis import given, settings
from hypothesis import strategies as st

from photoplan.cameras.base import project
from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, Lens, NoLens
from photoplan.errors import InputError, UsageError
from photoplan.geometry.pose import Pose, rotation_opk

POSE = Pose.from_angles([4321.5, 8765.25, 1300.0], [0.05, -0.08, 1.9])
every_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
every_interior = pytest.mark.parametrize("interior", INTERIORS.values(), ids=INTERIORS.keys())


def ground(n: int = 300, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return POSE.center + rng.uniform([-700, -700, -1300], [700, 700, -900], (n, 3))


def collinearity(XYZ: np.ndarray, pose: Pose, c: float, x0: float, y0: float) -> np.ndarray:
    """Ecker 1991, eq. 3.1, letter by letter."""
    r, (X0, Y0, Z0), (X, Y, Z) = pose.R_ground_camera, pose.center, XYZ.T
    N = r[0, 2] * (X - X0) + r[1, 2] * (Y - Y0) + r[2, 2] * (Z - Z0)
    x = x0 - c * (r[0, 0] * (X - X0) + r[1, 0] * (Y - Y0) + r[2, 0] * (Z - Z0)) / N
    y = y0 - c * (r[0, 1] * (X - X0) + r[1, 1] * (Y - Y0) + r[2, 1] * (Z - Z0)) / N
    return np.stack([x, y], axis=-1)


def test_projection_is_the_collinearity_equation() -> None:
    a = Affine2D(9.9, 0.2, 1150.0, 0.1, -10.1, 1160.0)
    camera = FrameCamera(Interior(153.24, (0.016, 0.007), a, (2300, 2300)), NoLens(), POSE)
    expected = a(collinearity(ground(), POSE, 153.24, 0.016, 0.007))
    np.testing.assert_allclose(project(camera, ground()), expected, atol=1e-9)


def test_rays_are_the_inverse_equation() -> None:
    camera = FrameCamera(Interior(153.24, (0.016, 0.007), Affine2D(1, 0, 0, 0, 1, 0), (100, 100)), NoLens(), POSE)
    x, y, Z = 31.0, -77.0, 222.0
    r, (X0, Y0, Z0) = POSE.R_ground_camera, POSE.center
    u = np.array([x - 0.016, y - 0.007, -153.24])  # eq. 3.2
    X = X0 + (Z - Z0) * (r[0] @ u) / (r[2] @ u)
    Y = Y0 + (Z - Z0) * (r[1] @ u) / (r[2] @ u)
    origin, d = camera.rays([x, y])
    np.testing.assert_allclose(origin + d * (Z - Z0) / d[2], [X, Y, Z], rtol=1e-14)


@every_interior
def test_orientation_of_axes(interior: Interior) -> None:
    """A vertical image with κ = 0: east is right, north is up."""
    camera = FrameCamera(interior, NoLens(), Pose(np.array([0.0, 0.0, 1000.0]), np.eye(3)))
    middle, east, north = project(camera, [[0, 0, 0], [100, 0, 0], [0, 100, 0]])
    assert (east - middle) @ [1, 0] > 50 * abs((east - middle) @ [0, 1])
    assert (north - middle) @ [0, -1] > 50 * abs((north - middle) @ [1, 0])
    assert np.linalg.norm(middle - np.array(interior.size) / 2) < 60


def test_appendix_b_projection_and_affine_as_one_matrix() -> None:
    a = Affine2D(9.9, 0.2, 1150.0, 0.1, -10.1, 1160.0)
    c, x0, y0 = 153.24, 0.016, 0.007
    camera = FrameCamera(Interior(c, (x0, y0), a, (2300, 2300)), NoLens(), POSE)
    r = POSE.R_ground_camera
    # Eq. B.6, B.7, and B.8 with the sign that B.5 has.
    x0_, y0_ = a.a1 * x0 + a.a2 * y0 + a.a3, a.a4 * x0 + a.a5 * y0 + a.a6
    rx, ry, rz = a.a1 * r[:, 0] + a.a2 * r[:, 1], a.a4 * r[:, 0] + a.a5 * r[:, 1], r[:, 2]
    d = ground() - POSE.center
    xs = np.stack([x0_ - c * (d @ rx) / (d @ rz), y0_ - c * (d @ ry) / (d @ rz)], axis=-1)
    np.testing.assert_allclose(project(camera, ground()), xs, atol=1e-9)
    h = np.column_stack([ground(), np.ones(len(d))]) @ camera.matrix().T
    np.testing.assert_allclose(h[:, :2] / h[:, 2:], xs, atol=1e-8)
    np.testing.assert_allclose(h, camera.project_homogeneous(ground()), rtol=1e-9)


@every_lens
@every_interior
def test_homogeneous_coordinates_are_linear_whatever_the_lens(lens: Lens, interior: Interior) -> None:
    camera = FrameCamera(interior, lens, POSE)
    a, b = ground(seed=1), ground(seed=2)
    f = np.linspace(-2, 3, len(a))[:, None]
    mixed = camera.project_homogeneous(a + f * (b - a))
    expected = camera.project_homogeneous(a) * (1 - f) + camera.project_homogeneous(b) * f
    np.testing.assert_allclose(mixed, expected, rtol=1e-10, atol=1e-8)


@every_lens
@every_interior
def test_w_is_the_depth(lens: Lens, interior: Interior) -> None:
    camera = FrameCamera(interior, lens, POSE)
    np.testing.assert_allclose(camera.project_homogeneous(ground())[:, 2], -POSE.to_camera(ground())[:, 2], rtol=1e-13)


@every_lens
@every_interior
def test_project_and_rays_are_inverse(lens: Lens, interior: Interior) -> None:
    camera = FrameCamera(interior, lens, POSE)
    margin = np.random.default_rng(7).uniform(-0.5, 1.5, (400, 2))  # also beside the image
    xy = margin * interior.size
    origin, d = camera.rays(xy)
    np.testing.assert_array_equal(origin, np.broadcast_to(POSE.center, origin.shape))
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1.0, rtol=1e-14)
    reached = np.isfinite(d[:, 0])
    assert reached.mean() > 0.99
    np.testing.assert_allclose(project(camera, origin + 1234.5 * d)[reached], xy[reached], rtol=1e-11, atol=1e-9)


@every_lens
@settings(max_examples=30, deadline=None)
@given(
    angles=st.tuples(*[st.floats(-3.1, 3.1)] * 3),
    xy=st.tuples(st.floats(0, 1999), st.floats(0, 1124)),
    s=st.floats(1.0, 1e4),
)
def test_inverse_pair_for_every_attitude(lens: Lens, angles: tuple, xy: tuple, s: float) -> None:
    camera = FrameCamera(INTERIORS["digital"], lens, Pose([10.0, 20.0, 30.0], rotation_opk(*angles)))
    origin, d = camera.rays(xy)
    np.testing.assert_allclose(project(camera, origin + s * d), xy, atol=1e-9)


@every_lens
@every_interior
def test_derivatives_against_differences(lens: Lens, interior: Interior) -> None:
    camera = FrameCamera(interior, lens, POSE)
    P = ground(60)
    # A radial table's curvature jumps at its knots: a small step.
    step = 1e-2 if "Table" in type(lens).__name__ else 0.5
    D = camera.derivatives(P)
    numeric = numeric_derivative(lambda p: project(camera, p), P, step)
    np.testing.assert_allclose(D, numeric, atol=1e-6 * np.abs(D).max())


@every_lens
def test_points_behind_are_never_projected(lens: Lens) -> None:
    camera = FrameCamera(INTERIORS["digital"], lens, POSE)
    behind = 2 * POSE.center - ground(50)
    h = camera.project_homogeneous(behind)
    assert (h[:, 2] < 0).all()
    assert np.isnan(project(camera, behind)).all()  # a polynomial of a point behind means nothing
    assert np.isnan(project(camera, behind)).all()
    assert np.isnan(camera.derivatives(behind)).all()
    assert np.isnan(project(camera, POSE.center)).all()
    assert np.isnan(camera.project_homogeneous([np.nan, 0.0, 0.0])).all()


@every_lens
def test_any_shape_of_points(lens: Lens) -> None:
    camera = FrameCamera(INTERIORS["digital"], lens, POSE)
    P = ground(24)
    for shape in ((24,), (4, 6), (2, 3, 4), (0,)):
        cube = P[: int(np.prod(shape))].reshape(*shape, 3)
        flat = cube.reshape(-1, 3)
        h = camera.project_homogeneous(cube)
        assert h.shape == cube.shape
        np.testing.assert_array_equal(h.reshape(-1, 3), camera.project_homogeneous(flat))
        assert camera.derivatives(cube).shape == (*shape, 2, 3)
        assert camera.rays(cube[..., :2])[1].shape == cube.shape
    np.testing.assert_array_equal(camera.project_homogeneous(P[0]), camera.project_homogeneous(P[:1])[0])


def test_coordinates_far_from_the_origin_keep_their_digits() -> None:
    """Map coordinates of millions of metres cost no more than their own rounding, 1e-9 m."""
    near = FrameCamera(INTERIORS["digital"], LENSES["opencv four"], POSE)
    shift = np.array([2.0**19, 2.0**22, 0.0])
    far = FrameCamera(INTERIORS["digital"], LENSES["opencv four"], Pose(POSE.center + shift, POSE.R_ground_camera))
    np.testing.assert_allclose(project(far, ground() + shift), project(near, ground()), atol=2e-8)


def test_a_lens_or_a_bilinear_interior_is_no_matrix() -> None:
    with pytest.raises(UsageError):
        FrameCamera(INTERIORS["digital"], LENSES["brown"], POSE).matrix()
    with pytest.raises(UsageError):
        FrameCamera(INTERIORS["film"], NoLens(), POSE).matrix()


# Interior orientation


def test_digital_and_metric_interior_agree() -> None:
    digital = Interior.digital((1000, 800), (5000.0, 5000.0), (12.0, -7.0))
    metric = Interior.metric((1000, 800), 50.0, 0.01, (0.12, 0.07))  # y down in pixels, up in millimetres
    t = np.random.default_rng(8).uniform(-0.1, 0.1, (50, 2))
    np.testing.assert_allclose(digital.tangent_to_pixel(t), metric.tangent_to_pixel(t), atol=1e-10)
    np.testing.assert_allclose(digital.tangent_to_pixel([0.0, 0.0]), [499.5 + 12, 399.5 - 7])
    oblong = Interior.metric((1000, 800), 50.0, (0.01, 0.02))
    np.testing.assert_allclose(oblong.tangent_to_pixel([0.02, 0.02]), [499.5 + 100, 399.5 - 50])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Interior.digital((0, 10), (5.0, 5.0)), "size"),
        (lambda: Interior.digital((10, 10), (5.0, -5.0)), "focal"),
        (lambda: Interior.metric((10, 10), 0.0, 0.01), "camera constant"),
        (lambda: Interior.metric((10, 10), 50.0, 0.0), "pixel"),
        (lambda: Interior.metric((10, 10), 50.0, 0.01, (np.nan, 0.0)), "principal point"),
    ],
)
def test_interior_orientation_that_cannot_be(make: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        make()  # type: ignore[operator]


# Plane homography, eq. 3.4


def test_a_plane_is_projected_by_the_matrix_without_its_third_column() -> None:
    camera = FrameCamera(INTERIORS["digital"], NoLens(), POSE)
    XY = POSE.center[:2] + np.random.default_rng(9).uniform(-600, 600, (100, 2))
    P = camera.matrix()
    plane = np.column_stack([P[:, 0], P[:, 1], P[:, 3] + 77.0 * P[:, 2]])
    xyw = np.column_stack([XY, np.ones(100)]) @ plane.T
    expected = project(camera, np.column_stack([XY, np.full(100, 77.0)]))
    np.testing.assert_allclose(xyw[:, :2] / xyw[:, 2:], expected, atol=1e-6)
