"""Lenses: inverse pairs, derivatives, conventions, and what they do outside the image."""

from __future__ import annotations

import numpy as np
import pytest
from camera_examples import INTERIORS, LENSES, OSL_1785_ANGLES, OSL_1785_C, OSL_1785_MICROMETRES, numeric_derivative
from hypothesis import given, settings
from hypothesis import strategies as st

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import (
    Brown,
    FieldLimited,
    Fisheye,
    Interior,
    Lens,
    NoLens,
    OpenCV,
    RadialTable,
    Reversed,
    field_limited,
)
from photoplan.errors import InputError
from photoplan.geometry.pose import Pose

every_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
distorting = pytest.mark.parametrize("lens", list(LENSES.values())[1:], ids=list(LENSES)[1:])
inside = np.random.default_rng(2).uniform(-0.6, 0.6, (300, 2))
DIGITAL = INTERIORS["digital"]


def polar(radius: float, n: int = 90) -> np.ndarray:
    phi = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return radius * np.stack([np.cos(phi), np.sin(phi)], axis=-1)


@every_lens
def test_distort_and_undistort_are_inverse(lens: Lens) -> None:
    np.testing.assert_allclose(lens.undistort(lens.distort(inside)), inside, atol=1e-12)
    real = 0.8 * inside
    np.testing.assert_allclose(lens.distort(lens.undistort(real)), real, atol=1e-12)


@every_lens
@settings(max_examples=40, deadline=None)
@given(x=st.floats(-0.7, 0.7), y=st.floats(-0.7, 0.7))
def test_inverse_pair_anywhere_in_the_field(lens: Lens, x: float, y: float) -> None:
    np.testing.assert_allclose(lens.undistort(lens.distort([x, y])), [x, y], atol=1e-12)


@every_lens
def test_jacobian_against_differences(lens: Lens) -> None:
    # The table's second derivative jumps at its knots: differences over a small step.
    step = 1e-5 if isinstance(lens, RadialTable) else 1e-3
    atol = 1e-8 if isinstance(lens, RadialTable) else 1e-9
    np.testing.assert_allclose(lens.jacobian(inside), numeric_derivative(lens.distort, inside, step), atol=atol)


@every_lens
def test_shapes_are_kept_nan_stays_and_the_axis_is_fixed(lens: Lens) -> None:
    t = inside[:24].reshape(2, 3, 4, 2).copy()
    t[0, 0, 0] = np.nan
    for f in (lens.distort, lens.undistort):
        out = f(t)
        assert out.shape == t.shape
        assert np.isnan(out[0, 0, 0]).all()
        assert np.isfinite(out[1]).all()
    assert lens.jacobian(t).shape == (2, 3, 4, 2, 2)
    np.testing.assert_array_equal(lens.distort([0.0, 0.0]), [0.0, 0.0])
    np.testing.assert_allclose(lens.undistort([0.0, 0.0]), [0.0, 0.0], atol=1e-15)


@distorting
def test_lenses_do_not_change_their_input(lens: Lens) -> None:
    before = inside.copy()
    lens.distort(inside), lens.undistort(inside), lens.jacobian(inside)
    np.testing.assert_array_equal(inside, before)


@every_lens
def test_lenses_are_values(lens: Lens) -> None:
    assert hash(lens) == hash(lens)
    with pytest.raises(AttributeError):
        lens.k1 = 1.0  # type: ignore[attr-defined]


# Conventions


def test_opencv_lens_against_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    for k in (
        (0.0136, 0.0386, -0.00168, 0.00107, 0.0, 0.0, 0.0, 0.0),
        (0.11, -0.02, 8e-4, -5e-4, 0.011, 0.2, -0.03, 0.004),
    ):
        # OpenCV: x right, y down, z forward.
        XYZ = np.column_stack([inside[:, 0], -inside[:, 1], np.ones(len(inside))])
        xy, _ = cv2.projectPoints(XYZ, np.zeros(3), np.zeros(3), np.eye(3), np.array(k))
        ours = OpenCV(*k).distort(inside)
        np.testing.assert_allclose(ours, xy[:, 0] * (1, -1), atol=1e-14)


def test_fisheye_lens_against_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    k = np.array([0.05, -0.012, 0.003, -0.0004])
    XYZ = np.column_stack([inside[:, 0], -inside[:, 1], np.ones(len(inside))])[:, None]
    xy, _ = cv2.fisheye.projectPoints(XYZ, np.zeros(3), np.zeros(3), np.eye(3), k)
    np.testing.assert_allclose(Fisheye(*k).distort(inside), xy[:, 0] * (1, -1), atol=1e-14)


def test_whole_camera_against_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    pose = Pose.from_angles([500.0, 800.0, 300.0], [0.1, -0.2, 2.0])
    k = (0.0135891, 0.03861561, -0.00167842, 0.00106552)
    XYZ = np.random.default_rng(3).uniform([400, 700, 0], [600, 900, 60], (500, 3))
    R = np.diag([1.0, -1.0, -1.0]) @ pose.R_ground_camera.T
    K = np.array([[1435.5, 0, 999.5 + 3.2], [0, 1432.9, 562.0 - 5.1], [0, 0, 1]])
    xy, _ = cv2.projectPoints(XYZ, cv2.Rodrigues(R)[0], -R @ pose.center, K, np.array(k))
    ours = project(FrameCamera(DIGITAL, OpenCV(*k), pose), XYZ)
    seen = (np.abs(ours - 1000) < 1000).all(axis=1)
    assert seen.sum() > 100
    np.testing.assert_allclose(ours[seen], xy[seen, 0], atol=1e-9)


def test_brown_in_millimetres_moves_points_by_the_stated_millimetres() -> None:
    c, k, p = 153.24, (-2.1e-7, 3.0e-12, 0.0), (1.5e-6, -2.5e-6)
    x, y = 60.0, -80.0
    r2 = x * x + y * y
    radial = k[0] * r2 + k[1] * r2**2
    expected = [
        x + x * radial + p[0] * (r2 + 2 * x * x) + 2 * p[1] * x * y,
        y + y * radial + p[1] * (r2 + 2 * y * y) + 2 * p[0] * x * y,
    ]
    lens = Brown.from_image_units(c, k=k, p=p)
    np.testing.assert_allclose(lens.distort([x / c, y / c]) * c, expected, rtol=1e-14)


def test_brown_affinity_and_shear_act_on_the_distorted_x() -> None:
    plain, skewed = Brown(0.1, p1=0.01), Brown(0.1, p1=0.01, b1=0.002, b2=-0.003)
    d = plain.distort(inside)
    np.testing.assert_allclose(skewed.distort(inside), d + [[1.0, 0.0]] * (d @ [0.002, -0.003])[:, None], atol=1e-15)


def test_brown_with_y_down_is_the_mirrored_lens() -> None:
    k, p, b = (0.1, -0.02, 0.003), (1e-3, -2e-3), (3e-4, 5e-4)
    flip = np.array([1.0, -1.0])
    down = Brown(*k, *p, *b).distort(inside * flip) * flip
    np.testing.assert_allclose(Brown.from_y_down(k=k, p=p, b=b).distort(inside), down, atol=1e-15)


def test_opencv_with_four_coefficients_is_brown_with_exchanged_decentring() -> None:
    k1, k2, p1, p2 = 0.1, -0.02, 1e-3, -2e-3
    np.testing.assert_allclose(
        OpenCV(k1, k2, p1, p2).distort(inside), Brown(k1, k2, 0, p2, -p1).distort(inside), atol=1e-15
    )


def test_reversed_lens_corrects_what_was_measured() -> None:
    correction = Brown(-0.05, p1=1e-3)
    measured = 0.7 * inside
    ideal = correction.distort(measured)  # x_ideal = x_measured + Δx(x_measured)
    np.testing.assert_allclose(Reversed(correction).distort(ideal), measured, atol=1e-13)
    np.testing.assert_array_equal(Reversed(correction).undistort(measured), ideal)


# The radial table


def test_radial_table_returns_the_report() -> None:
    lens = RadialTable.from_angles(OSL_1785_ANGLES, OSL_1785_MICROMETRES, OSL_1785_C)
    t = np.stack([np.zeros(6), np.tan(np.radians(OSL_1785_ANGLES))], axis=-1)
    shift = (lens.distort(t) - t)[:, 1] * OSL_1785_C * 1000
    np.testing.assert_allclose(shift, OSL_1785_MICROMETRES, atol=1e-9)


def test_radial_table_by_radius_and_by_angle_agree() -> None:
    radii = OSL_1785_C * np.tan(np.radians(OSL_1785_ANGLES))
    a = RadialTable.from_angles(OSL_1785_ANGLES, OSL_1785_MICROMETRES, OSL_1785_C)
    b = RadialTable.from_radii([0.0, *radii], [0.0, *OSL_1785_MICROMETRES], OSL_1785_C)
    np.testing.assert_allclose(a.distort(inside), b.distort(inside), atol=1e-16)


def test_radial_table_never_leaves_the_values_of_its_two_neighbours() -> None:
    lens = LENSES["radial table"]
    knots = np.tan(np.radians([0.0, *OSL_1785_ANGLES]))
    values = np.array([0.0, *OSL_1785_MICROMETRES])
    r = np.linspace(0.0, knots[-1], 2000)
    t = np.stack([r, 0 * r], axis=-1)
    shift = (lens.distort(t) - t)[:, 0] * OSL_1785_C * 1000
    i = np.clip(np.searchsorted(knots, r, side="right") - 1, 0, 5)
    low, high = np.minimum(values[i], values[i + 1]), np.maximum(values[i], values[i + 1])
    assert (shift >= low - 1e-9).all()
    assert (shift <= high + 1e-9).all()


def test_radial_table_invents_nothing_beyond_its_last_knot() -> None:
    lens = LENSES["radial table"]
    last = np.tan(np.radians(40.0))
    for r in (last, last * 1.01, last * 1.3):
        assert (lens.distort([0.0, r])[1] - r) * OSL_1785_C * 1000 == pytest.approx(3.0, abs=1e-9)
    # The derivative is continuous there.
    before, after = (lens.jacobian([0.0, last * f])[1, 1] for f in (1 - 1e-10, 1 + 1e-10))
    assert before == pytest.approx(after, abs=1e-11)


@pytest.mark.parametrize(
    ("radii", "shifts", "said"),
    [
        ([10.0, 20.0], [1.0], "as many"),
        ([20.0, 10.0], [1.0, 2.0], "increase"),
        ([0.0, 10.0], [1.0, 2.0], "axis"),
        ([10.0, np.nan], [1.0, 2.0], "finite"),
        ([10.0, 20.0], [0.0, -15e3], "folds"),
    ],
)
def test_fault_18_radial_table_that_cannot_be(radii: list[float], shifts: list[float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        RadialTable.from_radii(radii, shifts, 150.0)


# Outside the image


@distorting
@pytest.mark.parametrize("interior", INTERIORS.values(), ids=INTERIORS.keys())
def test_field_limited_lens_is_the_lens_inside_the_image(lens: Lens, interior: Interior) -> None:
    field = field_limited(lens, interior)
    real = interior.tangent_to_pixel.inverse(np.random.default_rng(4).uniform(0, 1, (400, 2)) * interior.size)
    ideal = field.undistort(real)
    np.testing.assert_allclose(lens.distort(ideal), real, atol=1e-12)
    np.testing.assert_array_equal(field.distort(ideal), lens.distort(ideal))
    assert np.hypot(*ideal.T).max() < field.radius


@distorting
def test_field_limited_lens_has_an_exact_inverse_everywhere(lens: Lens) -> None:
    field = field_limited(lens, DIGITAL)
    rng = np.random.default_rng(5)
    t = rng.normal(size=(600, 2)) * 10.0 ** rng.uniform(-2, 4, (600, 1))
    np.testing.assert_allclose(field.undistort(field.distort(t)), t, rtol=1e-11, atol=1e-11)


@distorting
def test_field_limited_lens_is_smooth_across_its_edge_and_never_folds(lens: Lens) -> None:
    field = field_limited(lens, DIGITAL)
    below, above = (polar(field.radius * (1 + d)) for d in (-1e-10, 1e-10))
    np.testing.assert_allclose(field.distort(above), field.distort(below), atol=1e-9)
    np.testing.assert_allclose(field.jacobian(above), field.jacobian(below), atol=1e-7)
    for factor in (0.5, 1.0, 1.2, 3.0, 100.0):
        assert (np.linalg.det(field.jacobian(polar(field.radius * factor))) > 0).all()
    radii = np.linalg.norm(field.distort(np.stack([polar(field.radius * f) for f in (1, 2, 4, 8)])), axis=-1)
    assert (np.diff(radii, axis=0) > 0).all()


@distorting
def test_field_limited_jacobian_outside_against_differences(lens: Lens) -> None:
    field = field_limited(lens, DIGITAL)
    t = polar(1.7 * field.radius)
    np.testing.assert_allclose(field.jacobian(t), numeric_derivative(field.distort, t, 1e-3), atol=1e-9)


def test_ground_beside_the_image_is_not_folded_into_it() -> None:
    lens = Brown(k1=-0.25)  # folds at r = 1.15; the corner of this image has the real radius 0.45
    interior = Interior.digital((1600, 1200), (2222.0, 2222.0))
    t = np.stack([np.linspace(0.0, 2.2, 100), np.zeros(100)], axis=-1)
    assert lens.distort(t)[-1, 0] < 0.45
    assert (np.diff(field_limited(lens, interior).distort(t)[:, 0]) > 0).all()


@pytest.mark.parametrize("lens", [Brown(k1=-0.9), OpenCV(k1=-1.0), OpenCV(k4=3.0), Fisheye(-0.8, 0, 0, -0.5)])
def test_lens_that_folds_inside_the_image_is_refused_by_name(lens: Lens) -> None:
    wide = Interior.digital((2000, 1500), (900.0, 900.0))
    with pytest.raises(InputError, match=rf"{type(lens).__name__}\(.*not invertible.*radius"):
        FrameCamera(wide, lens, Pose(np.zeros(3), np.eye(3)))


def test_field_radius_beyond_the_fold_is_refused() -> None:
    with pytest.raises(InputError, match="not invertible"):
        FieldLimited(Brown(k1=-0.25), 1.3)
    with pytest.raises(InputError, match="field radius"):
        FieldLimited(NoLens(), 0.0)


def test_fisheye_image_that_reaches_beyond_90_degrees() -> None:
    lens, interior = Fisheye(0.01), Interior.digital((2000, 2000), (500.0, 500.0))
    camera = FrameCamera(interior, lens, Pose(np.zeros(3), np.eye(3)))
    _, d = camera.rays([[0.0, 0.0], [999.5, 999.5], [999.5, 1700.0]])
    assert np.isnan(d[0]).all()
    np.testing.assert_allclose(d[1], [0, 0, -1], atol=1e-12)
    # r' = 700.5 / 500 is θ (1 + 0.01 θ²): 78 degrees.
    theta = np.arccos(-d[2, 2])
    assert theta * (1 + 0.01 * theta**2) == pytest.approx(700.5 / 500)


@pytest.mark.parametrize("make", [lambda v: Brown(k1=v), lambda v: OpenCV(p1=v), lambda v: Fisheye(k4=v)])
def test_coefficients_that_are_no_numbers_are_refused(make: object) -> None:
    with pytest.raises(InputError, match="finite"):
        make(np.nan)  # type: ignore[operator]


def test_undistort_gives_nan_where_the_lens_never_reaches() -> None:
    lens = Brown(k1=-0.25)  # its largest real radius is 0.77
    assert np.isnan(lens.undistort([[0.9, 0.0]])).all()
    assert np.isfinite(lens.undistort([[0.7, 0.0]])).all()
    assert np.isnan(Fisheye().undistort([[1.6, 0.0]])).all()
