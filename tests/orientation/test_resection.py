"""Space resection: exact observations, noise, gross errors, and what points do not determine."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tools.photos import AERIAL, PLACE, aerial_pose, at, frame, ground_below, measured, turned_by
from tools.thinned import some, thinned

from photoplan.cameras.base import Camera
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.framed import oriented_camera
from photoplan.cameras.lenses import Brown, Interior, Lens, NoLens, OpenCV
from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.errors import GeometryError, UsageError
from photoplan.geometry.pose import Pose, rotation_opk
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.model import AdjustSettings, Block, BlockCamera, BlockImage
from photoplan.orientation.resection import ResectSettings, resect, resect_direct, tangents_of

UNKNOWN_C = ResectSettings(camera_constant_known=False)


@pytest.mark.parametrize(
    ("relief", "tilt"), some([(0.0, 0.0), (300.0, 0.2), (0.0, 0.2), (300.0, 0.0), (0.0, 0.03), (300.0, 0.03)], 0, 1)
)
def test_exact_observations_give_the_pose(relief: float, tilt: float) -> None:
    rng = np.random.default_rng(3)
    for count in (4, 5, 8, 30):
        pose = aerial_pose(rng, tilt=tilt)
        X = ground_below(rng, pose, count, relief)
        found = resect(measured(frame(pose), X, rng, 0.0), AERIAL, NoLens())
        assert np.abs(found.pose.center - pose.center).max() < 1e-5
        assert turned_by(found.pose, pose) < 1e-8
        assert found.rms < 1e-6
        assert found.redundancy == 2 * count - 6
        assert not found.rejected.any()


def test_a_horizontal_photograph_with_a_lens() -> None:
    rng = np.random.default_rng(4)
    lens = Brown(k1=-0.12, k2=0.03, p1=1e-3)
    interior = Interior.digital((6000, 4000), (5000.0, 5000.0), (30.0, -20.0))
    pose = Pose(at(0, 0, 900.0), rotation_opk(np.radians(88.0), np.radians(20.0), 0.03))
    t = rng.uniform(-0.5, 0.5, (12, 2)) * (1.0, 0.6)
    far = rng.uniform(500.0, 8000.0, 12)
    X = pose.to_ground(np.column_stack([t * far[:, None], -far]))
    camera = FrameCamera(interior, lens, pose)
    found = resect(measured(camera, X, rng, 0.0), interior, lens)
    assert np.abs(found.pose.center - pose.center).max() < 1e-4
    assert turned_by(found.pose, pose) < 1e-8
    np.testing.assert_allclose(tangents_of(interior, lens, measured(camera, X, rng, 0.0).xy), t, atol=1e-10)


@pytest.mark.parametrize("curvature", ["none", "correction", "strict"])
def test_curvature_and_refraction_at_6_km(curvature: str) -> None:
    rng = np.random.default_rng(5)
    pose = Pose(at(120.0, -80.0, 6300.0), rotation_opk(0.05, -0.04, 2.0))

    def camera_of(interior: Interior, lens: Lens, pose: Pose) -> Camera:
        return oriented_camera(
            interior, lens, pose, crs="EPSG:32632", earth_curvature=curvature, refraction=True, mean_ground=300.0
        )

    X = ground_below(rng, pose, 9, 800.0)
    points = measured(camera_of(AERIAL, NoLens(), pose), X, rng, 0.0)
    found = resect(points, AERIAL, NoLens(), camera_of=camera_of)
    assert np.abs(found.pose.center - pose.center).max() < 1e-3
    assert turned_by(found.pose, pose) < 1e-8
    assert found.rms < 1e-5
    plain = resect(points, AERIAL, NoLens())
    assert np.abs(plain.pose.center - pose.center).max() > 0.05, "the effect is there"


@pytest.mark.parametrize("start", [NoLens(), Brown(k1=-0.02), OpenCV(k4=0.001)], ids=["none", "brown", "opencv"])
def test_coefficients_of_the_lens_are_found(start: Lens) -> None:
    """Radial and decentring distortion of one image over hills, exactly and within their standard deviations."""
    rng = np.random.default_rng(61)
    interior = Interior.digital((4000, 3000), (3100.0, 3100.0), (12.0, -8.0))
    more = {"k4": 0.001} if isinstance(start, OpenCV) else {}
    true = type(start)(k1=-0.08, k2=0.02, **more) if more else Brown(k1=-0.08, k2=0.02, p1=1e-3)
    free = ("c", "x0", "y0", "k1", "k2") if more else ("c", "x0", "y0", "k1", "k2", "p1")
    pose = Pose(at(0, 0, 1200.0), rotation_opk(0.5, 0.2, 0.4))
    X = ground_below(rng, pose, 60, 500.0, interior)
    middle = Interior.digital((4000, 3000), (3050.0, 3050.0))
    exact = resect(measured(FrameCamera(interior, true, pose), X, rng, 0.0), middle, start, ResectSettings(free))
    assert [getattr(exact.lens, k) for k in free[3:]] == pytest.approx([getattr(true, k) for k in free[3:]], abs=1e-7)
    assert np.abs(exact.pose.center - pose.center).max() < 1e-3
    noisy = resect(measured(FrameCamera(interior, true, pose), X, rng, 0.3), middle, start, ResectSettings(free))
    off = [getattr(noisy.lens, k) - getattr(true, k) for k in free[3:]]
    assert (np.abs(off) < 4.0 * np.sqrt(np.diag(noisy.covariance))[9:]).all()
    assert (np.sqrt(np.diag(noisy.covariance))[9:] < 0.05).all()


def test_fault_16_coefficients_that_points_do_not_determine_are_named() -> None:
    """Points on one circle about the principal point tell k1 not from the camera constant."""
    rng = np.random.default_rng(62)
    pose = Pose(at(0, 0, 1500.0), rotation_opk(0.0, 0.0, 0.7))
    around = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    t = 0.4 * np.column_stack([np.cos(around), np.sin(around)])
    far = rng.uniform(1200.0, 1800.0, 12)
    X = pose.to_ground(np.column_stack([t * far[:, None], -far]))
    points = measured(frame(pose), X, rng, 0.0)
    with pytest.raises(GeometryError, match=r"12 control points do not determine .*k1"):
        resect(points, AERIAL, NoLens(), ResectSettings(free=("k1", "c")))
    with pytest.raises(GeometryError, match=r"4 control points for 9 unknowns \(pose, k1, k2, k3\); at least 5"):
        resect(
            measured(frame(pose), X[::3], rng, 0.5), AERIAL, NoLens(), ResectSettings(free=("k1", "k2", "k3")), name="a"
        )


@pytest.mark.slow
def test_camera_constant_and_principal_point_of_hilly_terrain() -> None:
    rng = np.random.default_rng(6)
    interior = Interior.digital((4000, 3000), (3100.0, 3100.0), (12.0, -8.0))
    pose = Pose(at(0, 0, 1200.0), rotation_opk(0.9, 0.2, 0.4))
    X = ground_below(rng, pose, 15, 400.0, interior)
    points = measured(FrameCamera(interior, NoLens(), pose), X, rng, 0.0)
    # Nothing is known of c; a stated value of half its size must not matter.
    guess = Interior.digital((4000, 3000), (1500.0, 1500.0), (12.0, -8.0))
    found = resect(points, guess, NoLens(), UNKNOWN_C)
    assert abs(found.interior.c - 3100.0) < 1e-3
    assert np.abs(found.pose.center - pose.center).max() < 1e-3
    middle = Interior.digital((4000, 3000), (3000.0, 3000.0))
    both = resect(points, middle, NoLens(), ResectSettings(free=("y0", "x0", "c")))
    assert both.free == ("c", "x0", "y0")
    np.testing.assert_allclose((both.interior.c, *both.interior.principal_point), (3100.0, 12.0, 8.0), atol=1e-3)
    assert both.covariance.shape == (9, 9)


@thinned("runs", 60, 200)
def test_errors_are_as_large_as_the_covariance_says(runs: int) -> None:
    rng = np.random.default_rng(7)
    ratios = []
    for _ in range(runs):
        pose = aerial_pose(rng, tilt=0.2)
        X = ground_below(rng, pose, 15, 200.0)
        found = resect(measured(frame(pose), X, rng, 0.5, 0.08), AERIAL, NoLens())
        R = pose.R_ground_camera.T @ found.pose.R_ground_camera
        turn = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
        error = np.concatenate([found.pose.center - pose.center, turn])
        ratios.append(error @ np.linalg.solve(found.covariance, error) / 6)
        assert not found.rejected.any() or found.rejected.sum() == 1
    # The mean of F(6, 24) is 24 / 22.
    assert abs(np.mean(ratios) / (24 / 22) - 1.0) < 0.1


@pytest.mark.parametrize("free", [(), ("c", "x0", "y0")])
def test_it_is_the_bundle_adjustment_of_one_image(free: tuple[str, ...]) -> None:
    """Control eliminated point by point, or as unknowns of a block: one adjustment."""
    rng = np.random.default_rng(21)
    pose = aerial_pose(rng, tilt=0.2)
    points = measured(frame(pose), ground_below(rng, pose, 14, 400.0), rng, 0.5, 0.05)
    found = resect(points, AERIAL, NoLens(), ResectSettings(free=free))
    block = Block(
        {"k": BlockCamera(AERIAL.c, AERIAL.principal_point, NoLens(), free)},
        (BlockImage("a", "k", AERIAL.plane_to_pixel, Pose(pose.center + 5.0, pose.R_ground_camera)),),
        ImagePoints(("a",), points.names, np.zeros(14, int), np.arange(14), points.xy, points.sigma),
        GroundPoints(points.names, points.XYZ, np.full((14, 3), 0.05), np.zeros(14, bool)),
    )
    other = adjust_block(block, AdjustSettings(robust=False, variance_components=False))
    deviation = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.pose.center - other.poses[0].center) < 1e-3 * deviation[:3]).all()
    assert turned_by(found.pose, other.poses[0]) < 1e-3 * deviation[3:6].min()
    assert abs(found.sigma0 - other.sigma0) < 1e-4
    assert found.redundancy == other.redundancy
    scale = np.outer(deviation[:6], deviation[:6])
    np.testing.assert_allclose(found.covariance[:6, :6] / scale, other.pose_covariance[0] / scale, atol=2e-3)
    if free:
        camera = other.cameras[0]
        assert abs(camera.c - found.interior.c) < 1e-3 * deviation[6]
        np.testing.assert_allclose(np.sqrt(np.diag(camera.covariance)), deviation[6:], rtol=1e-3)


def test_redundancy_numbers_sum_to_the_redundancy() -> None:
    rng = np.random.default_rng(8)
    pose = aerial_pose(rng)
    X = ground_below(rng, pose, 10, 100.0)
    found = resect(measured(frame(pose), X, rng, 0.4, 0.05), AERIAL, NoLens())
    assert abs(np.nansum(found.redundancies) - found.redundancy) < 1e-6
    assert (found.redundancies > 0).all() and (found.redundancies < 1).all()
    assert abs(found.rms**2 * 20 - (found.residuals**2).sum()) < 1e-9


@pytest.mark.parametrize("control", [False, True])
def test_fault_17_gross_errors_are_named_and_leave_the_pose_alone(control: bool) -> None:
    rng = np.random.default_rng(9)
    for count, gross in ((7, 1), (10, 2), (14, 4), (40, 12)):
        pose = aerial_pose(rng, tilt=0.1)
        points = measured(frame(pose), ground_below(rng, pose, count, 150.0), rng, 0.5)
        wrong = rng.choice(count, gross, replace=False)
        if control:
            XYZ = points.XYZ.copy()
            XYZ[wrong, 1] += rng.choice([-1, 1], gross) * rng.uniform(30.0, 400.0, gross)
            points = dataclasses.replace(points, XYZ=XYZ)
        else:
            xy = points.xy.copy()
            xy[wrong] += rng.choice([-1, 1], (gross, 2)) * rng.uniform(40.0, 2000.0, (gross, 2))
            points = dataclasses.replace(points, xy=xy)
        found = resect(points, AERIAL, NoLens())
        assert sorted(np.flatnonzero(found.rejected)) == sorted(wrong)
        assert np.abs(found.pose.center - pose.center).max() < 2.0
        assert np.abs(found.normalised[found.rejected]).max(axis=1).min() > 4.0


def test_fault_17_points_leave_until_none_is_beyond_the_limit() -> None:
    rng = np.random.default_rng(22)
    pose = aerial_pose(rng)
    points = measured(frame(pose), ground_below(rng, pose, 60, 150.0), rng, 0.5)
    strict = resect(points, AERIAL, NoLens(), ResectSettings(critical=2.0))
    assert 1 <= strict.rejected.sum() < 20
    limit = 2.0 * max(1.0, strict.sigma0)
    assert np.abs(strict.normalised[~strict.rejected]).max() < 1.05 * limit
    assert np.abs(strict.normalised[strict.rejected]).max(axis=1).min() > 0.95 * 2.0
    assert not resect(points, AERIAL, NoLens(), ResectSettings(critical=5.0)).rejected.any()


def test_a_gross_error_among_four_points_is_reported_not_guessed() -> None:
    rng = np.random.default_rng(10)
    pose = aerial_pose(rng)
    points = measured(frame(pose), ground_below(rng, pose, 4, 100.0), rng, 0.5)
    xy = points.xy.copy()
    xy[2] += 60.0
    found = resect(dataclasses.replace(points, xy=xy), AERIAL, NoLens())
    assert not found.rejected.any()
    assert "do not tell which" in found.notes[0]


def test_a_stated_accuracy_that_is_too_good_rejects_nothing() -> None:
    rng = np.random.default_rng(11)
    pose = aerial_pose(rng)
    points = measured(frame(pose), ground_below(rng, pose, 12, 100.0), rng, 5.0)
    found = resect(dataclasses.replace(points, sigma=np.full((12, 2), 0.5)), AERIAL, NoLens())
    assert not found.rejected.any()
    assert 6.0 < found.sigma0 < 14.0


def test_fault_16_too_few_points() -> None:
    rng = np.random.default_rng(12)
    pose = aerial_pose(rng)
    X = ground_below(rng, pose, 4, 100.0)
    two = measured(frame(pose), X[:2], rng, 0.0)
    with pytest.raises(GeometryError, match=r"image 'a': 2 control points for 6 unknowns \(pose\); at least 3"):
        resect(two, AERIAL, NoLens(), name="a")
    with pytest.raises(GeometryError, match=r"for 9 unknowns \(pose, c, x0, y0\); at least 5"):
        resect(measured(frame(pose), X, rng, 0.0), AERIAL, NoLens(), ResectSettings(free=("c", "x0", "y0")))


@thinned("poses", 8, 20)
def test_three_points_need_an_approximate_pose_or_leave_several(poses: int) -> None:
    rng = np.random.default_rng(13)
    refused = 0
    for _ in range(poses):
        pose = aerial_pose(rng)
        points = measured(frame(pose), ground_below(rng, pose, 3, 100.0), rng, 0.0)
        near = Pose(pose.center + np.array([5, -6, 5]), pose.R_ground_camera @ rotation_opk(0.004, 0.003, 0.01))
        found = resect(points, AERIAL, NoLens(), near=near)
        assert np.abs(found.pose.center - pose.center).max() < 1e-4
        assert "no redundancy" in found.notes[0]
        try:
            alone = resect(points, AERIAL, NoLens())
            assert np.abs(alone.pose.center - pose.center).max() < 1e-4
        except GeometryError as error:
            refused += "3 points leave" in str(error)
    assert refused > 0.25 * poses


@pytest.mark.parametrize("count", [4, pytest.param(5, marks=pytest.mark.slow)])
@thinned("poses", 20, 100)
def test_few_noisy_points_never_give_another_pose(count: int, poses: int) -> None:
    rng = np.random.default_rng(1)
    refused = 0
    for k in range(poses):
        pose = aerial_pose(rng, tilt=0.03 if k % 2 else 0.2)
        X = ground_below(rng, pose, count, 300.0)
        points = measured(frame(pose), X, rng, 0.5)
        t = tangents_of(AERIAL, NoLens(), points.xy)
        try:
            found = resect_direct(t, X, 0.5 / 7650.0).pose
        except GeometryError as error:
            refused += "positions of the camera possible" in str(error)
            continue
        assert np.abs(found.center - pose.center).max() < 60.0
    assert refused <= 0.05 * poses


def test_fault_16_a_fourth_point_beside_the_first_decides_nothing() -> None:
    rng = np.random.default_rng(23)
    refused = 0
    for _ in range(10):
        pose = aerial_pose(rng)
        X = ground_below(rng, pose, 3, 100.0)
        X = np.concatenate([X, X[:1] + np.array([0.05, 0.02, 0.0])])
        try:
            found = resect(measured(frame(pose), X, rng, 0.0), AERIAL, NoLens())
            assert np.abs(found.pose.center - pose.center).max() < 1e-3
        except GeometryError as error:
            refused += "4 points leave" in str(error)
    assert refused >= 4
    same = measured(frame(pose), np.repeat(X[:1], 5, axis=0), rng, 0.0)
    with pytest.raises(GeometryError, match="lie on one line"):
        resect(same, AERIAL, NoLens())


def test_fault_16_control_on_a_line() -> None:
    rng = np.random.default_rng(14)
    pose = aerial_pose(rng)
    along = np.linspace(-600, 600, 7)
    X = np.column_stack([pose.center[0] + along, pose.center[1] + 0.3 * along, 50 + 0.1 * along])
    with pytest.raises(GeometryError, match=r"all 7 points lie on one line"):
        resect(measured(frame(pose), X, rng, 0.0), AERIAL, NoLens(), name="a")
    # Nearly: half a metre beside a line of 1200 m, measured with 0.5 px.
    X[:, 1] += rng.normal(0, 0.5, 7)
    with pytest.raises(GeometryError, match=r"do not determine .*rotation about"):
        resect(measured(frame(pose), X, rng, 0.5), AERIAL, NoLens(), name="a")


def test_fault_16_flat_terrain_with_free_camera_constant() -> None:
    rng = np.random.default_rng(15)
    pose = Pose(at(0, 0, 1500.0), rotation_opk(0.0, 0.0, 0.7))
    points = measured(frame(pose), ground_below(rng, pose, 12, 0.0), rng, 0.5)
    with pytest.raises(GeometryError, match=r"12 control points do not determine (Z0 and c|c and Z0) apart") as error:
        resect(points, AERIAL, NoLens(), ResectSettings(free=("c",)), name="a")
    said = str(error.value)
    assert "nan" not in said
    assert "hold a parameter fixed" in said
    # The numbers are true: both one percent, c in millimetres.
    assert "c +1.53" in said and "Z0 +15" in said
    with pytest.raises(GeometryError, match="do not determine"):
        resect(points, AERIAL, NoLens(), UNKNOWN_C)
    # With c held fixed, or relief, or tilt, the same points do.
    assert resect(points, AERIAL, NoLens()).pose is not None
    hilly = measured(frame(pose), ground_below(rng, pose, 12, 400.0), rng, 0.5)
    assert abs(resect(hilly, AERIAL, NoLens(), UNKNOWN_C).interior.c - 153.0) < 1.0


def test_fault_16_the_dangerous_cylinder() -> None:
    """Three points and a projection centre on the upright circular cylinder through them: no pose to first order."""
    angles = np.radians([10.0, 130.0, 250.0])
    X = PLACE + np.column_stack([800 * np.cos(angles), 800 * np.sin(angles), np.zeros(3)])
    pose = Pose(at(800 * np.cos(1.0), 800 * np.sin(1.0), 1500.0), rotation_opk(0.3, -0.3, 0.0))
    rng = np.random.default_rng(16)
    with pytest.raises(GeometryError, match="do not determine"):
        resect(measured(frame(pose), X, rng, 0.0), AERIAL, NoLens(), near=pose)


def test_unknown_names_of_parameters_are_refused() -> None:
    with pytest.raises(UsageError, match=r"'k9'; resection of one image allows c, x0, y0, k1"):
        ResectSettings(free=("c", "k9"))


def test_the_direct_start_is_the_same_every_time() -> None:
    rng = np.random.default_rng(17)
    pose = aerial_pose(rng)
    X = ground_below(rng, pose, 60, 100.0)
    points = measured(frame(pose), X, rng, 0.5)
    t = tangents_of(AERIAL, NoLens(), points.xy)
    a, b = resect_direct(t, X, 1e-4), resect_direct(t, X, 1e-4)
    assert (a.pose.center == b.pose.center).all()


@pytest.mark.parametrize("seed", range(6))
def test_three_points_on_a_cylinder_with_the_camera_do_not_lead_far_from_the_stated_pose(seed: int) -> None:
    """There noise leaves no closed solution near the truth; the only one left lay 90 m away."""
    rng = np.random.default_rng(seed)
    pose = Pose(at(0.0, 0.0, 300.0), rotation_opk(0.0, -0.1, 1.0))
    a = np.array([0.3, 2.5, 4.7])
    X = at(60.0, 0.0, 0.0) + np.column_stack([60.0 * np.cos(a), 60.0 * np.sin(a), np.zeros(3)])
    interior = Interior.digital((4000, 3000), (3200.0, 3200.0))
    points = measured(FrameCamera(interior, NoLens(), pose), X, rng, 0.5, 0.02)
    near = Pose(pose.center + np.array([2.0, 1.0, -3.0]), pose.R_ground_camera)
    try:
        found = resect(points, interior, NoLens(), near=near)
    except GeometryError as error:
        assert "do not determine" in str(error)
    else:
        off = np.abs(found.pose.center - pose.center)
        assert (off < 5.0 * np.sqrt(np.diag(found.covariance)[:3])).all()


@pytest.mark.slow
@pytest.mark.parametrize("count", [6, 9, 14])
def test_few_points_tell_within_how_many_standard_deviations_errors_lie(count: int) -> None:
    """sigma0 of 6, 12 and 22 redundant observations: normalised errors follow Student's distribution."""
    inside, squares = [], []
    for seed in range(120):
        rng = np.random.default_rng(seed)
        pose = aerial_pose(rng, tilt=0.2)
        exact = measured(frame(pose), ground_below(rng, pose, count, 200.0), rng, 0.0)
        noise = rng.normal(0, 0.5, exact.xy.shape)
        points = dataclasses.replace(exact, xy=exact.xy + noise, sigma=np.full(exact.xy.shape, 0.5))
        found = resect(points, AERIAL, NoLens())
        assert found.redundancy == 2 * count - 6
        z = (found.pose.center - pose.center) / np.sqrt(np.diag(found.covariance)[:3])
        inside.append(np.abs(z) < found.reach_95)
        squares.append(z**2 * (found.redundancy - 2) / found.redundancy)
    print(count, f"inside {np.mean(inside):.3f}", f"normalised, of Student's variance {np.sqrt(np.mean(squares)):.3f}")
    assert found.reach_95 > 2.05
    assert 0.92 < np.mean(inside) < 0.98
    assert 0.88 < np.sqrt(np.mean(squares)) < 1.12
