"""Maps, geocentric coordinates and tangential systems: inverse pairs, derivatives, and pyproj as a witness."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Transformer

from photoplan.errors import InputError
from photoplan.geometry.crs import topocentric_poses
from photoplan.geometry.local import (
    enu_axes,
    enu_poses,
    geocentric_of_geodetic,
    geocentric_poses,
    geodetic_of_geocentric,
    is_local_crs,
    is_wgs84_geographic,
    map_poses,
    topocentric_of_map,
)

PLACES = {
    "EPSG:32632": (4.6e5, 5.24e6),
    "EPSG:2056": (2.64e6, 1.2e6),
    "EPSG:2154": (7e5, 6.6e6),
    "EPSG:3031": (8e5, 9e5),
}
PLACES |= {"EPSG:32760": (3.1e5, 6.2e6)}
on_every_map = pytest.mark.parametrize("crs", PLACES)


def points(crs: str, n: int = 20) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.column_stack([np.array(PLACES[crs]) + rng.uniform(-5e3, 5e3, (n, 2)), rng.uniform(0, 3000, n)])


def witness(crs: str) -> Any:
    """Map to geocentric coordinates of the same datum, by pyproj."""
    own = CRS(crs)
    assert own.geodetic_crs is not None
    datum = own.geodetic_crs.to_json_dict()["datum" if "datum" in own.geodetic_crs.to_json_dict() else "datum_ensemble"]
    ellipsoid = own.ellipsoid
    assert ellipsoid is not None and datum
    to_degrees = Transformer.from_crs(own, own.geodetic_crs, always_xy=True)
    cart = Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=cart +a={ellipsoid.semi_major_metre} +rf={ellipsoid.inverse_flattening}"
    )

    def convert(XYZ: np.ndarray) -> np.ndarray:
        lon, lat = to_degrees.transform(XYZ[:, 0], XYZ[:, 1])
        return np.column_stack(cart.transform(lon, lat, XYZ[:, 2]))

    return convert


@on_every_map
def test_geocentric_points_are_pyprojs_and_come_back(crs: str) -> None:
    XYZ = points(crs)
    earth, axes = geocentric_poses(crs, XYZ)
    np.testing.assert_allclose(earth, witness(crs)(XYZ), rtol=0, atol=2e-8)
    back, again = map_poses(crs, earth)
    np.testing.assert_allclose(back, XYZ, rtol=0, atol=2e-8)
    # Derivatives over ±100 m are good to 1e-10.
    np.testing.assert_allclose(again, axes, rtol=0, atol=2e-10)


@on_every_map
def test_axes_are_those_of_the_map(crs: str) -> None:
    """Grid north and up as differences of pyproj's coordinates over 200 m; grid east is at right angles."""
    XYZ = points(crs, 5)
    _, axes = geocentric_poses(crs, XYZ)
    convert = witness(crs)
    for column, step in ((1, [0.0, 100.0, 0.0]), (2, [0.0, 0.0, 100.0])):
        flat = XYZ * [1.0, 1.0, 0.0 if column == 1 else 1.0]
        d = convert(flat + step) - convert(flat - step)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        np.testing.assert_allclose(axes[:, :, column], d, atol=2e-9)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-12)
    np.testing.assert_allclose(axes @ np.swapaxes(axes, 1, 2), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-12)


@on_every_map
def test_tangential_system_and_map_are_inverse(crs: str) -> None:
    if crs == "EPSG:2056":
        # Datums that differ by metres have no exact step without Switzerland's grid.
        pytest.skip("WGS 84 to CH1903+ is a transformation of limited accuracy; inverse pairs are tested elsewhere")
    XYZ = points(crs)
    lon, lat = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*XYZ[0, :2])
    origin = (lat, lon, 100.0)
    enu, R = topocentric_of_map(origin, crs, XYZ)
    back, R_back = topocentric_poses(origin, crs, enu)
    np.testing.assert_allclose(back, XYZ, rtol=0, atol=1e-8)
    np.testing.assert_allclose(R, R_back, atol=1e-15)


def test_geodetic_points_in_one_system() -> None:
    points = np.array([[47.3, 8.2, 500.0], [47.31, 8.25, 900.0], [47.2, 8.1, 10.0]])
    origin, enu, R = enu_poses(points)
    for k, point in enumerate(points):
        earth = geocentric_of_geodetic(tuple(point))
        np.testing.assert_allclose(enu_axes(*origin[:2]).T @ enu[k] + geocentric_of_geodetic(origin), earth, atol=1e-8)
        np.testing.assert_allclose(geodetic_of_geocentric(earth), point, atol=1e-8)
        # Up at the point is the direction to a point above it.
        above = geocentric_of_geodetic((point[0], point[1], point[2] + 1000.0)) - earth
        np.testing.assert_allclose(R[k, :, 2], enu_axes(*origin[:2]) @ above / 1000.0, atol=1e-9)
    assert np.abs(enu.mean(axis=0)).max() < 1e-6


def test_refusals_and_kinds() -> None:
    with pytest.raises(InputError, match="counts longitudes from Paris"):
        geocentric_poses("EPSG:27572", [[6e5, 2.4e6, 0.0]])
    with pytest.raises(InputError, match="no place in"):
        map_poses("EPSG:32632", [[0.0, 0.0, np.nan]])
    local = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'
    assert is_local_crs(local, "x") and not is_local_crs("EPSG:32632", "x")
    with pytest.raises(InputError, match=r"x: .* local system in foot"):
        is_local_crs(local.replace('"metre",1', '"foot",0.3048'), "x")
    assert is_wgs84_geographic("EPSG:4326", "x") and is_wgs84_geographic("EPSG:4258", "x")
    assert not is_wgs84_geographic("EPSG:4314", "x") and not is_wgs84_geographic("EPSG:32632", "x")
