"""Earth curvature and refraction: strict, as a correction, and all cameras' inverse pairs."""

from __future__ import annotations

import numpy as np
import pytest
from camera_examples import LENSES, numeric_derivative
from pyproj import Proj, Transformer
from tools.resolution import curvature_displacement

from photoplan.cameras.base import Camera, project
from photoplan.cameras.curvature import Refraction, WarpedCamera, _profile, curved_camera
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.framed import CurvatureCorrection, corrected_camera, oriented_camera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.errors import InputError, UsageError
from photoplan.geometry.local import LocalFrame, earth_radius
from photoplan.geometry.pose import Pose, rotation_opk

UTM = "EPSG:25832"
#: Transverse Mercator with scale 1 on its meridian: nothing but curvature differs from Cartesian space near it.
UNSCALED = "+proj=tmerc +lat_0=47 +lon_0=13.333333333333334 +k=1 +x_0=0 +y_0=0 +ellps=GRS80 +units=m"
SPHERE = "+proj=tmerc +lat_0=47 +lon_0=13.333333333333334 +k=1 +x_0=0 +y_0=0 +R=6380000 +units=m"
FILM = Interior.metric((23000, 23000), 150.0, 0.01)
WIDE = Interior.metric((26460, 17004), 100.0, 0.004)
STATION = np.array([561_234.5, 5_287_654.5, 5200.0])
ATTITUDES = {"vertical": (0.02, -0.03, 1.2), "tilted": (0.7, -0.2, -2.0), "oblique": (1.2, 0.1, 0.4)}
KINDS = [
    {"refraction": True},
    {"earth_curvature": "strict"},
    {"earth_curvature": "strict", "refraction": True},
    {"earth_curvature": "correction"},
    {"earth_curvature": "correction", "refraction": True},
]
every_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda k: "+".join(map(str, k.values())))
every_attitude = pytest.mark.parametrize("attitude", ATTITUDES.values(), ids=ATTITUDES.keys())


def camera_of(kind: dict, attitude: tuple, lens: str = "none") -> Camera:
    pose = Pose.from_angles(STATION, attitude)
    return oriented_camera(WIDE, LENSES[lens], pose, crs=UTM, mean_ground=400.0, **kind)


def seen_points(camera: Camera, n: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image points, and where and how their rays pass heights between 0 and 1000 m, up to 100 km away."""
    rng = np.random.default_rng(11)
    xy = rng.uniform(0, 1, (n, 2)) * camera.size
    P, d = camera.rays(xy, rng.uniform(0, 1000, n))
    keep = np.hypot(*(P - STATION)[:, :2].T) < 100e3
    assert keep.sum() > 0.6 * n
    return xy[keep], P[keep], d[keep]


@every_kind
@every_attitude
@pytest.mark.parametrize("lens", ["none", "brown"])
def test_project_and_rays_are_inverse(kind: dict, attitude: tuple, lens: str) -> None:
    camera = camera_of(kind, attitude, lens)
    xy, P, d = seen_points(camera)
    # Y = 5.3e6 m is itself rounded to 1e-9 m, and the smallest pixel on the ground is 0.17 m.
    np.testing.assert_allclose(project(camera, P), xy, rtol=1e-11, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1.0, rtol=1e-13)
    assert (((P - STATION) * d).sum(axis=-1) > 0).all()


@every_kind
@every_attitude
def test_rays_touch_the_curved_ray(kind: dict, attitude: tuple) -> None:
    """A point at a small distance along the tangent is seen at the same place, up to the square of the distance."""
    camera = camera_of(kind, attitude)
    xy, P, d = seen_points(camera)
    miss = [np.abs(project(camera, P + s * d) - xy).max() for s in (200.0, 400.0)]
    assert miss[0] < 0.02
    assert miss[1] < 4.5 * miss[0] + 1e-6


@every_kind
@every_attitude
def test_derivatives_against_differences(kind: dict, attitude: tuple) -> None:
    camera = camera_of(kind, attitude, "brown")
    _, P, _ = seen_points(camera, 100)
    D = camera.derivatives(P)
    numeric = numeric_derivative(lambda p: project(camera, p), P, 5.0)
    np.testing.assert_allclose(D, numeric, atol=1e-6 * np.abs(D).max(axis=(1, 2)).min())


@every_kind
def test_shapes_behind_and_nan(kind: dict) -> None:
    camera = camera_of(kind, ATTITUDES["vertical"], "opencv four")
    _, P, _ = seen_points(camera, 24)
    cube = P.reshape(2, 3, 4, 3) if len(P) == 24 else P[:12].reshape(1, 3, 4, 3)
    h = camera.project_homogeneous(cube)
    assert h.shape == cube.shape
    np.testing.assert_array_equal(h.reshape(-1, 3), camera.project_homogeneous(cube.reshape(-1, 3)))
    assert camera.derivatives(cube).shape == (*cube.shape[:-1], 2, 3)
    assert camera.rays(cube[..., :2], 300.0)[0].shape == cube.shape
    above = STATION + np.array([[0.0, 0.0, 3000.0], [10.0, 20.0, 1.0]])
    assert np.isnan(project(camera, above)).all()
    assert np.isnan(project(camera, [np.nan, 1.0, 2.0])).all()
    np.testing.assert_array_equal(camera.center, STATION)
    assert camera.size == WIDE.size


@every_kind
def test_rays_that_never_reach_a_height_give_nan(kind: dict) -> None:
    horizontal = camera_of(kind, (np.pi / 2, 0.0, 0.0))
    P, d = horizontal.rays([[13229.5, 2000.0], [13229.5, 15000.0]], 400.0)
    assert np.isnan(P[0]).all()  # looks up
    assert np.isnan(d[0]).all()
    assert np.isfinite(P[1]).all()  # looks down
    assert np.isnan(camera_of(kind, ATTITUDES["vertical"]).rays([100.0, 100.0], 6000.0)[0]).all()  # above the camera


@every_kind
def test_rays_need_a_height(kind: dict) -> None:
    with pytest.raises(UsageError, match="height"):
        camera_of(kind, ATTITUDES["vertical"]).rays([0.0, 0.0])


# Strict


@every_attitude
def test_strict_curvature_against_geocentric_coordinates(attitude: tuple) -> None:
    """Collinearity in geocentric space, made from pyproj's own parts and the printed equation 3.1."""
    to_earth = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=utm +zone=32 +ellps=GRS80 +step +proj=cart +ellps=GRS80"
    )
    utm = Proj(UTM)
    lon, lat = utm(*STATION[:2], inverse=True)
    gamma = np.radians(utm.get_factors(lon, lat).meridian_convergence)
    lon, lat = np.radians([lon, lat])
    enu = np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    ).T
    # Grid north lies γ clockwise of true north.
    grid = np.array([[np.cos(gamma), np.sin(gamma), 0], [-np.sin(gamma), np.cos(gamma), 0], [0, 0, 1.0]])
    R = enu @ grid @ rotation_opk(*attitude)
    camera = oriented_camera(WIDE, NoLens(), Pose.from_angles(STATION, attitude), crs=UTM, earth_curvature="strict")
    _, P, _ = seen_points(camera)
    d = np.stack(to_earth.transform(*P.T), axis=-1) - np.stack(to_earth.transform(*STATION))
    xy = -WIDE.c * (d @ R[:, :2]) / (d @ R[:, 2:])
    np.testing.assert_allclose(project(camera, P), WIDE.plane_to_pixel(xy), atol=1e-6)


def test_origin_of_the_local_system_does_not_matter() -> None:
    pose = Pose.from_angles(STATION, ATTITUDES["tilted"])
    near = curved_camera(WIDE, NoLens(), pose, LocalFrame(UTM, (STATION[0], STATION[1])))
    far = curved_camera(WIDE, NoLens(), pose, LocalFrame(UTM, (STATION[0] + 60e3, STATION[1] - 40e3), 800.0))
    _, P, _ = seen_points(near)
    np.testing.assert_allclose(project(far, P), project(near, P), atol=1e-5)


# Correction


def test_correction_is_equation_4_16_for_a_vertical_image() -> None:
    pose = Pose(np.array([1000.0, 2000.0, 4700.0]), rotation_opk(0.0, 0.0, 0.8))
    plain = FrameCamera(FILM, NoLens(), pose)
    corrected = corrected_camera(plain, 200.0, 6_380_200.0)
    XYZ = np.random.default_rng(12).uniform([-2000, -1000, -500], [4000, 5000, 1200], (200, 3))
    middle = (np.array(FILM.size) - 1) / 2
    x = (project(plain, XYZ) - middle) * 0.01  # millimetres
    true = (project(corrected, XYZ) - middle) * 0.01
    r, Z, Z0 = np.linalg.norm(x, axis=1), XYZ[:, 2] - 200.0, 4500.0
    factor = (r**2 * (Z0 - Z) / 150.0**2 - 2 * Z) / (2 * 6_380_200.0)
    np.testing.assert_allclose(x - true, x * factor[:, None], atol=1e-10)
    displacement = curvature_displacement(r / 1000, 0.150, Z0, Z, 6_380_200.0)
    np.testing.assert_allclose(np.linalg.norm(x - true, axis=1), np.abs(displacement) * 1000, atol=1e-10)


def residual_of_correction(scale: float, attitude: tuple, crs: str) -> tuple[float, float]:
    """Largest effect of curvature, and largest difference of the two methods, micrometres in the image."""
    pose = Pose(np.array([120.0, -80.0, 0.15 * scale]), rotation_opk(*attitude))
    cameras = [
        oriented_camera(FILM, NoLens(), pose, crs=crs, earth_curvature=kind)
        for kind in ("none", "strict", "correction")
    ]
    rng = np.random.default_rng(13)
    xy = rng.uniform(0, 1, (400, 2)) * FILM.size
    P, _ = cameras[1].rays(xy, 0.15 * scale * rng.uniform(-0.3, 0.2, 400))
    none, strict, correction = (project(c, P) for c in cameras)
    return 10 * np.linalg.norm(none - strict, axis=1).max(), 10 * np.linalg.norm(correction - strict, axis=1).max()


@pytest.mark.parametrize("attitude", [(0.0, 0.0, 0.5), (0.05, -0.04, 2.0), (0.5, 0.2, 0.1)])
def test_strict_and_correction_agree_to_first_order(attitude: tuple) -> None:
    """The effect grows with the flying height, what the correction leaves of it with its square."""
    effect, left = residual_of_correction(30_000, attitude, SPHERE)
    assert effect > 60.0
    assert left < 0.01 * effect
    double_effect, double_left = residual_of_correction(60_000, attitude, SPHERE)
    assert double_effect == pytest.approx(2 * effect, rel=0.02)
    assert double_left == pytest.approx(4 * left, rel=0.1)
    # On the ellipsoid the radius depends on the direction, by up to 0.34 % of it.
    effect, left = residual_of_correction(30_000, attitude, UNSCALED)
    assert left < 0.01 * effect


def test_correction_ends_where_its_formula_runs_back() -> None:
    warp = CurvatureCorrection((0.0, 0.0, 1000.0), 0.0, 6.38e6)
    d = np.linspace(0, 56_000, 2000)  # up to d² = R h / 2
    out = warp(np.stack([d, 0 * d, 0 * d], axis=-1))[:, 0]
    assert (np.diff(out) > 0).all()
    assert np.isnan(warp([60_000.0, 0.0, 0.0])[:2]).all()
    assert np.isnan(warp([10.0, 0.0, 1000.0])[:2]).all()
    with pytest.raises(InputError, match="radius"):
        CurvatureCorrection((0.0, 0.0, 1.0), 0.0, 0.0)


# Refraction


def traced(H: float, h: float, alpha: float) -> tuple[float, float]:
    """Horizontal distance at which a ray that arrives at H under `alpha` left h, by Snell through 20 000 layers."""
    z = np.linspace(h, H, 20_001)
    z = (z[1:] + z[:-1]) / 2
    at_H, at_z = _profile(np.array(H))[0], _profile(z)[0]
    sine = np.sin(alpha) * (1 + at_H) / (1 + at_z)
    return float((sine / np.sqrt(1 - sine**2)).mean() * (H - h)), H - h


@pytest.mark.parametrize("H", [300.0, 2000.0, 9000.0, 16_000.0])
@pytest.mark.parametrize("h", [-100.0, 250.0])
@pytest.mark.parametrize("alpha", [0.1, 0.7, 1.2])
def test_refraction_against_a_traced_ray(H: float, h: float, alpha: float) -> None:
    d, D = traced(H, h, alpha)
    x, _, z = Refraction((0.0, 0.0, H))([d, 0.0, h])
    seen = np.arctan2(x, H - z)
    bend = alpha - np.arctan2(d, D)
    assert bend > 0
    assert seen - alpha == pytest.approx(0.0, abs=0.003 * bend)


def test_refraction_is_saastamoinens_formula_below_11_km() -> None:
    """2335 / (H − h) [(1 − 0.02257 h)^5.256 − (1 − 0.02257 H)^5.256] − 277.0 (1 − 0.02257 H)^4.256, µrad, km."""
    for H, h in ((1.0, 0.0), (3.0, 0.5), (9.0, 0.2)):
        K = (
            2335 / (H - h) * ((1 - 0.02257 * h) ** 5.256 - (1 - 0.02257 * H) ** 5.256)
            - 277.0 * (1 - 0.02257 * H) ** 4.256
        )
        assert Refraction((0.0, 0.0, 1000 * H)).angle(np.pi / 4, 1000 * h) * 1e6 == pytest.approx(K, rel=0.01)


def test_refraction_moves_image_points_outwards_and_nothing_at_the_nadir() -> None:
    pose = Pose(np.array([0.0, 0.0, 4500.0]), np.eye(3))
    plain, bent = FrameCamera(FILM, NoLens(), pose), oriented_camera(FILM, NoLens(), pose, refraction=True)
    P = np.array([[0.0, 0.0, 0.0], [3000.0, 0.0, 0.0], [0.0, -3000.0, 0.0]])
    shift = project(bent, P) - project(plain, P)
    np.testing.assert_allclose(shift[0], 0.0, atol=1e-12)
    # About 46 µrad · (r + r³ / c²) at r = 100 mm is 6.7 µm: 0.67 pixel of 10 µm.
    np.testing.assert_allclose(shift[1:], [[0.68, 0.0], [0.0, 0.68]], atol=0.03)


@pytest.mark.parametrize(("H", "step"), [(5000.0, 2e-6), (11_020.0, 6e-5)])
def test_refraction_is_smooth_through_the_cameras_height_and_the_tropopause(H: float, step: float) -> None:
    """The rise of some centimetres at a distance of 5 km changes by no more than `step` from 0.12 m to 0.12 m."""
    warp = Refraction((0.0, 0.0, H))
    z = np.linspace(H - 120.0, H + 120.0, 2001)
    P = np.stack([np.full_like(z, 5000.0), 0 * z, z], axis=-1)
    rise = warp(P)[:, 2] - z
    assert np.isfinite(rise).all()
    assert (rise > 0).all()
    assert np.abs(np.diff(rise)).max() < step
    J = warp.jacobian(P[::100])
    np.testing.assert_allclose(J, numeric_derivative(warp, P[::100], 0.02), atol=2e-7)


# The choice


def test_kinds_of_camera() -> None:
    pose = Pose.from_angles(STATION, ATTITUDES["vertical"])
    assert isinstance(oriented_camera(WIDE, NoLens(), pose), FrameCamera)
    for kind in KINDS:
        assert isinstance(oriented_camera(WIDE, NoLens(), pose, crs=UTM, **kind), WarpedCamera)
    with pytest.raises(UsageError, match="exact"):
        oriented_camera(WIDE, NoLens(), pose, earth_curvature="exact")
    with pytest.raises(UsageError, match="CRS"):
        oriented_camera(WIDE, NoLens(), pose, earth_curvature="strict")


def test_correction_refers_to_the_ground_below_the_camera() -> None:
    pose = Pose.from_angles(STATION, ATTITUDES["tilted"])
    chosen = oriented_camera(WIDE, NoLens(), pose, crs=UTM, earth_curvature="correction", mean_ground=700.0)
    radius = earth_radius(UTM, (STATION[0], STATION[1])) + 700.0
    built = corrected_camera(FrameCamera(WIDE, NoLens(), pose), 700.0, radius)
    _, P, _ = seen_points(built)
    np.testing.assert_array_equal(project(chosen, P), project(built, P))
    without_crs = oriented_camera(WIDE, NoLens(), pose, earth_curvature="correction", mean_ground=700.0)
    assert 0 < np.abs(project(without_crs, P) - project(built, P)).max() < 0.3


def test_fault_20_strict_curvature_needs_a_projected_crs_in_metres() -> None:
    pose = Pose.from_angles(STATION, ATTITUDES["vertical"])
    with pytest.raises(InputError, match="projected"):
        oriented_camera(WIDE, NoLens(), pose, crs="EPSG:4326", earth_curvature="strict")
