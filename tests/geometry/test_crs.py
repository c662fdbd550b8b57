"""CRSs: refused where unfit (fault 20), joined exactly, rotations of axes right."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pyproj import Proj

from photoplan.errors import InputError
from photoplan.geometry.crs import (
    canonical_crs,
    crs_step,
    grid_rotation,
    parse_crs,
    require_projected_metres,
    same_crs,
    split_compound,
    topocentric_poses,
)

NGI = "+proj=tmerc +lat_0=0 +lon_0=25 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"


@pytest.mark.parametrize(
    ("crs", "says"),
    [
        ("EPSG:4326", "geographic"),
        ("EPSG:4979", "geographic"),
        ("EPSG:4978", "geocentric"),
        ("EPSG:2225", "US survey foot"),
        ("EPSG:32615+5703", "EPSG:5703"),
        ("EPSG:5703", "not projected"),
        ("EPSG:999999", "EPSG:nnnn"),
        ("", "EPSG:nnnn"),
        ("metres", "EPSG:nnnn"),
    ],
)
def test_fault_20_unfit_crs_is_refused_with_what_is_needed(crs: str, says: str) -> None:
    with pytest.raises(InputError, match=says) as error:
        require_projected_metres(crs, "project.toml: crs")
    assert str(error.value).startswith("project.toml: crs")


@pytest.mark.parametrize(
    ("number", "absurd"),
    [
        ("0.9996", "-1e300"),
        ("0.9996", "1e300"),
        ("0.9996", "0"),
        ("6378137.0", "1e300"),
        ("6378137.0", "6378.137"),
        ("500000.0", "1e300"),
        ('"Meter",1.0', '"Meter",1e300'),
        ('"Meter",1.0', '"Meter",-1'),
        ("298.257223563", "0.5"),
    ],
)
def test_fault_30_well_formed_nonsense_is_no_reference_system(number: str, absurd: str) -> None:
    """Numbers of any size are good WKT; what PROJ cannot compute with, or what maps no metre to a metre, is refused."""
    usual = parse_crs("EPSG:32615").to_wkt("WKT1_ESRI")
    assert parse_crs(usual, "a.prj").is_projected and number in usual
    with pytest.raises(InputError, match=r"a\.prj: .* is not a coordinate reference system"):
        parse_crs(usual.replace(number, absurd), "a.prj")


#: Vesta and Jupiter, a 22nd of the earth and eleven times as large.
OTHERS = [f"+proj=eqc +lat_ts=-16 +lon_0=-83 +a={a} +b={b} +units=m" for a, b in ((289e3, 229e3), (71492e3, 66854e3))]


@pytest.mark.parametrize("crs", ["EPSG:32615", "EPSG:2154", "EPSG:31287", NGI, *OTHERS])
def test_projected_metres_are_taken(crs: str) -> None:
    assert require_projected_metres(crs).is_projected


def test_one_crs_in_many_spellings_is_the_same() -> None:
    wkt1 = parse_crs("EPSG:32615").to_wkt("WKT1_GDAL")
    assert same_crs("EPSG:32615", wkt1)
    assert same_crs("EPSG:32615+5703", "EPSG:32615")
    assert same_crs("EPSG:4326", "+proj=longlat +datum=WGS84 +no_defs")
    assert not same_crs("EPSG:32615", "EPSG:32616")
    assert not same_crs("EPSG:32615", "EPSG:26915")


@pytest.mark.parametrize("crs", ["EPSG:32615", NGI, "EPSG:5703", "EPSG:31287"])
def test_canonical_form_means_the_same_and_is_stable(crs: str) -> None:
    short = canonical_crs(parse_crs(crs).to_wkt())
    assert parse_crs(short) == parse_crs(crs)
    assert canonical_crs(short) == short
    assert len(short) < 120


def test_a_compound_crs_states_the_height_system() -> None:
    assert split_compound("EPSG:32615+5703") == ("EPSG:32615", "EPSG:5703")
    assert split_compound("EPSG:4979") == ("EPSG:4326", "ellipsoidal")
    assert split_compound("EPSG:32615") == ("EPSG:32615", None)


def test_steps_are_inverse_to_each_other_and_keep_nan() -> None:
    XY = np.array([[576661.8, 5188164.8], [np.nan, 1.0], [400000.0, 5100000.0]])
    there, back = crs_step("EPSG:32615", "EPSG:32614"), crs_step("EPSG:32614", "EPSG:32615")
    out = there(XY)
    assert np.isnan(out[1]).all()
    np.testing.assert_allclose(back(out)[[0, 2]], XY[[0, 2]], atol=1e-6)
    assert "UTM zone 14N" in there.operation
    assert there.accuracy == 0.0


def test_x_is_east_whatever_the_authority_says() -> None:
    # EPSG:2193 (New Zealand) and EPSG:4167 state the northern axis first.
    XY = crs_step("EPSG:4167", "EPSG:2193")([[173.0, -41.0]])
    assert abs(XY[0, 0] - 1_600_000) < 1e-3
    assert 5_400_000 < XY[0, 1] < 5_500_000


def test_steps_pickle_and_serve_threads() -> None:
    step = pickle.loads(pickle.dumps(crs_step("EPSG:32615", "EPSG:32614")))
    XY = np.random.default_rng(1).uniform((4e5, 5.1e6), (6e5, 5.2e6), (200, 2))
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(step, [XY] * 8))
    assert all(np.array_equal(r, results[0]) for r in results)


def test_a_point_nowhere_on_the_earth_is_named() -> None:
    with pytest.raises(InputError, match="has no coordinates in EPSG:2154"):
        crs_step("EPSG:32615", "EPSG:2154")([[1e30, 8.9e30]])


def test_fault_01_no_inexact_operation_and_the_missing_grid_is_named() -> None:
    # NAD27 to NAD83 is exact only by a grid that no wheel brings along.
    with pytest.raises(InputError, match=r"us_noaa_conus\.tif|\.tif|no exact|inexact"):
        crs_step("EPSG:26715", "EPSG:26915")(np.array([[500000.0, 5_000_000.0]]))


def test_grid_rotation_is_the_difference_of_convergences() -> None:
    lonlat = np.array([[-91.99, 46.84], [-93.5, 40.0]])
    a, b = Proj("EPSG:32615"), Proj("EPSG:32614")
    XY = np.column_stack(a(*lonlat.T))
    R = grid_rotation(crs_step("EPSG:32615", "EPSG:32614"), XY)
    convergence = [p.get_factors(*lonlat.T).meridian_convergence for p in (a, b)]
    # Convergence is the azimuth of grid north, clockwise positive; axes turn by the difference.
    angle = np.degrees(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    np.testing.assert_allclose(angle, convergence[1] - convergence[0], atol=1e-6)
    # And, independent of any sign convention: a short step in the source arrives turned.
    step = crs_step("EPSG:32615", "EPSG:32614")
    moved = step(XY + np.array([0.0, 1.0])) - step(XY)
    np.testing.assert_allclose(moved / np.linalg.norm(moved, axis=1)[:, None], R[:, :2, 1], atol=1e-6)


def test_topocentric_origin_has_only_convergence_and_far_points_also_the_tilt_of_the_horizon() -> None:
    lat, lon, h = 46.84, -91.99, 150.0
    XYZ, R = topocentric_poses((lat, lon, h), "EPSG:32615", [[0, 0, 0], [0, 5000.0, 0], [5000.0, 0, 0]])
    x, y = Proj("EPSG:32615")(lon, lat)
    np.testing.assert_allclose(XYZ[0], [x, y, h], atol=1e-6)
    gamma = np.radians(Proj("EPSG:32615").get_factors(lon, lat).meridian_convergence)
    # True north lies to the left of grid north where convergence is positive.
    np.testing.assert_allclose(R[0] @ [0, 1, 0], [-np.sin(gamma), np.cos(gamma), 0], atol=1e-9)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-12)
    # 5 km away the tangential plane is d²/2R above the ellipsoid and the vertical is inclined by d/R.
    for k in (1, 2):
        assert abs(XYZ[k, 2] - h - 5000**2 / 2 / 6.378e6) < 0.02
        inclination = np.arccos(R[k, 2, 2])
        assert abs(inclination - 5000 / 6.378e6) < 0.01 * 5000 / 6.378e6
    # Up of the origin leans away from the origin, seen from the point.
    lean = R[1] @ [0, 0, 1]
    assert lean[1] < 0
