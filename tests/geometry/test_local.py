"""Local tangential systems against pyproj's own computations."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from pyproj import Proj, Transformer
from tools.ign_block import altered_height, unaltered_height

from photoplan.errors import InputError
from photoplan.geometry.local import LocalFrame, earth_radius

#: Transverse Mercator, Lambert, an oblique one, grads from Paris, one of equal area, the southern hemisphere.
PLACES = {
    "EPSG:25832": (561_000.0, 5_287_000.0),
    "EPSG:2154": (831_000.0, 6_284_000.0),
    "EPSG:2056": (2_683_000.0, 1_247_000.0),
    "EPSG:27572": (650_000.0, 2_400_000.0),
    "EPSG:3035": (4_500_000.0, 2_900_000.0),
    "EPSG:32735": (400_000.0, 6_200_000.0),
}
everywhere = pytest.mark.parametrize(("crs", "at"), PLACES.items(), ids=PLACES.keys())


def around(at: tuple[float, float], reach: float, n: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.array([*at, 0.0]) + rng.uniform([-reach, -reach, -400], [reach, reach, 9000], (n, 3))


@everywhere
def test_to_local_and_to_map_are_inverse(crs: str, at: tuple[float, float]) -> None:
    frame = LocalFrame(crs, at, 500.0)
    P = around(at, 100e3)
    # Geocentric coordinates are 6.4e6 m, their last digit is 1e-9 m.
    np.testing.assert_allclose(frame.to_map(frame.to_local(P)), P, atol=2e-8)
    enu = np.random.default_rng(1).uniform(-50e3, 50e3, (100, 3)) * [1, 1, 0.1]
    np.testing.assert_allclose(frame.to_local(frame.to_map(enu)), enu, atol=2e-8)
    np.testing.assert_allclose(frame.to_local([*at, 500.0]), 0.0, atol=1e-8)
    assert frame.to_local(P.reshape(4, 50, 3)).shape == (4, 50, 3)
    orbit = P + np.array([0.0, 0.0, 800e3])
    np.testing.assert_allclose(frame.to_map(frame.to_local(orbit)), orbit, atol=2e-8)


@pytest.mark.parametrize(
    ("crs", "projection", "ellps"),
    [
        ("EPSG:25832", "+proj=utm +zone=32 +ellps=GRS80", "GRS80"),
        (
            "EPSG:2154",
            "+proj=lcc +lat_0=46.5 +lon_0=3 +lat_1=49 +lat_2=44 +x_0=700000 +y_0=6600000 +ellps=GRS80",
            "GRS80",
        ),
    ],
)
def test_against_topocentric_coordinates_of_proj(crs: str, projection: str, ellps: str) -> None:
    at = PLACES[crs]
    lon, lat = Proj(projection)(*at, inverse=True)
    pipeline = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv {projection} +step +proj=cart +ellps={ellps} "
        f"+step +proj=topocentric +ellps={ellps} +lon_0={lon!r} +lat_0={lat!r} +h_0=320"
    )
    P = around(at, 80e3)
    expected = np.stack(pipeline.transform(*P.T), axis=-1)
    np.testing.assert_allclose(LocalFrame(crs, at, 320.0).to_local(P), expected, atol=2e-8)


@everywhere
def test_jacobian_against_differences(crs: str, at: tuple[float, float]) -> None:
    frame = LocalFrame(crs, at)
    P = around(at, 50e3, 20)
    step = 1000.0
    numeric = np.stack(
        [
            (8 * (frame(P + e) - frame(P - e)) - (frame(P + 2 * e) - frame(P - 2 * e))) / (12 * step)
            for e in np.eye(3) * step
        ],
        axis=-1,
    )
    np.testing.assert_allclose(frame.jacobian(P), numeric, atol=3e-10)


@everywhere
def test_convergence_and_scale_against_proj(crs: str, at: tuple[float, float]) -> None:
    frame, proj = LocalFrame(crs, (at[0] + 5000.0, at[1])), Proj(crs)
    if crs == "EPSG:27572":  # pyproj's factors do not know grads; the Lambert zones' scale is 1 to a part in a thousand
        assert abs(frame.scale(at) - 1.0) < 1e-3
        np.testing.assert_allclose(np.linalg.det(frame.jacobian([*at, 0.0])), 1.0, atol=2e-3)
        return
    factors = proj.get_factors(*proj(*at, inverse=True))
    if crs != "EPSG:3035":
        assert convergence(frame, at) == pytest.approx(np.radians(factors.meridian_convergence), abs=1e-9)
        assert frame.scale(at) == pytest.approx(factors.meridional_scale, rel=1e-8)
    else:  # equal-area: scale depends on direction, the product of its extremes is 1
        assert np.linalg.det(frame.jacobian([*at, 0.0])) == pytest.approx(1.0, abs=1e-8)


def test_convergence_is_positive_east_of_the_meridian_on_the_northern_hemisphere() -> None:
    frame = LocalFrame("EPSG:25832", (600_000.0, 5_300_000.0))
    assert convergence(frame, [600_000.0, 5_300_000.0]) > 0.01
    assert convergence(frame, [400_000.0, 5_300_000.0]) < -0.01
    assert convergence(frame, [500_000.0, 5_300_000.0]) == pytest.approx(0.0, abs=1e-12)


@everywhere
def test_axes_are_a_rotation_that_follows_the_map(crs: str, at: tuple[float, float]) -> None:
    frame = LocalFrame(crs, at)
    station = np.array([at[0] + 20e3, at[1] - 10e3, 3000.0])
    R = frame.axes(station)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    north, up = (frame(station + e) - frame(station) for e in (np.array([0, 100.0, 0]), np.array([0, 0, 100.0])))
    np.testing.assert_allclose(R[:, 1], north / np.linalg.norm(north), atol=2e-5)
    np.testing.assert_allclose(R[:, 2], up / np.linalg.norm(up), atol=1e-9)
    # At the origin only the convergence is left.
    gamma = convergence(frame, at)
    expected = [[np.cos(gamma), np.sin(gamma), 0], [-np.sin(gamma), np.cos(gamma), 0], [0, 0, 1]]
    np.testing.assert_allclose(frame.axes([*at, 0.0]), expected, atol=1e-9)


def test_the_earth_falls_away_by_the_square_of_the_distance() -> None:
    crs, at = "EPSG:25832", PLACES["EPSG:25832"]
    frame, R = LocalFrame(crs, at), earth_radius(crs, PLACES["EPSG:25832"])
    for d in (1000.0, 5000.0, 20_000.0):
        drop = -np.mean([frame([at[0] + x, at[1] + y, 0.0])[2] for x, y in ((d, 0), (-d, 0), (0, d), (0, -d))])
        assert drop == pytest.approx(d * d / (2 * R), rel=2e-3)
    assert abs(R - 6_383_000) < 5000


def test_linear_alteration_is_undone_exactly() -> None:
    Zs, Zg, k = np.array([1769.986, 5000.0]), 52.6, np.array([0.99991, 1.0004])
    altered = altered_height(Zs, Zg, k)
    np.testing.assert_allclose(altered - Zg, k * (Zs - Zg), rtol=1e-15)
    np.testing.assert_allclose(unaltered_height(altered, Zg, k), Zs, rtol=1e-15)


def test_fault_20_geographic_or_foreign_coordinates_are_refused() -> None:
    with pytest.raises(InputError, match="projected"):
        LocalFrame("EPSG:4326", (11.0, 48.0))
    with pytest.raises(InputError, match="metres"):
        LocalFrame("EPSG:2225", (6_000_000.0, 2_000_000.0))
    with pytest.raises(InputError, match="no position"):
        LocalFrame("EPSG:25832", (np.nan, 5_000_000.0))


def test_frames_are_values() -> None:
    a, b = LocalFrame("EPSG:25832", (5e5, 5e6)), LocalFrame("EPSG:25832", (5e5, 5e6))
    assert a == b
    assert hash(a) == hash(b)


def convergence(frame: LocalFrame, XY: ArrayLike) -> NDArray[np.float64]:
    """Meridian convergence at map points (..., 2), radians: positive where grid north is east of true north."""
    XY = np.asarray(XY, float)
    lon, lat = frame._projection.radians(XY)
    at = np.concatenate([XY, np.zeros((*XY.shape[:-1], 1))], axis=-1)
    grid_north = frame.jacobian(at)[..., 1] @ frame._R_local_earth
    sin, cos = np.sin(lon), np.cos(lon)
    east = grid_north[..., 1] * cos - grid_north[..., 0] * sin
    away = grid_north[..., 0] * cos + grid_north[..., 1] * sin
    north = grid_north[..., 2] * np.cos(lat) - away * np.sin(lat)
    return np.arctan2(east, north)
