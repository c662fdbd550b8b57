"""Rational polynomials as cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from affine import Affine
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer
from rasterio.warp import Resampling, reproject
from tools.rpc_images import CRS, camera, functions, gdal_form

from photoplan.cameras.base import project
from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.rpc import BOUND, RationalFunctions, RpcCamera, terms
from photoplan.errors import InputError, UsageError
from photoplan.geometry.local import GeodeticGround


def places(n: int = 200, seed: int = 1) -> np.ndarray:
    """Longitude, latitude and height inside the polynomials, (n, 3)."""
    rpc = functions()
    return np.random.default_rng(seed).uniform(-1, 1, (n, 3)) * rpc.ground_scale + rpc.ground_offset


def test_positions_are_gdals_but_for_half_a_pixel() -> None:
    """GDAL counts from the corner of the upper-left pixel, photoplan from its centre."""
    rpc, at = functions(), places()
    with RPCTransformer(RPC.from_gdal(gdal_form(rpc))) as gdal:
        rows, cols = gdal.rowcol(*at.T, op=lambda v: v)
    mine = rpc(at)
    assert np.abs(mine - np.column_stack([cols, rows]) + 0.5).max() < 1e-6


def test_first_numerator_terms_are_longitude_latitude_height() -> None:
    """The order of the twenty terms, by the derivatives of a polynomial with one of them each."""
    rpc, n = functions(), np.array([0.3, -0.5, 0.7])
    L, P, H = n
    terms = [1, L, P, H, L * P, L * H, P * H, L * L, P * P, H * H]
    terms += [P * L * H, L**3, L * P * P, L * H * H, L * L * P, P**3, P * H * H, L * L * H, P * P * H, H**3]
    at = n * rpc.ground_scale + rpc.ground_offset
    for k, term in enumerate(terms):
        coefficients = np.zeros((4, 20))
        coefficients[1::2, 0] = 1.0
        coefficients[::2, 1] = 1.0
        coefficients[0, k] += 1.0
        found = replace(rpc, coefficients=coefficients)(at)
        assert found[0] == pytest.approx((L + term) * rpc.image_scale[0] + rpc.image_offset[0], abs=1e-9)


def powers() -> np.ndarray:
    """Of longitude, latitude and height in the twenty terms, from what the terms of primes are."""
    primes = np.log([2.0, 3.0, 5.0])
    logs = np.log(terms(np.exp(primes)))
    every = np.stack(np.meshgrid(*[range(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return every[np.abs(logs[:, None] - every @ primes).argmin(axis=1)]


@pytest.mark.parametrize("part", [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)])
def test_scales_may_be_negative(part: tuple[float, float]) -> None:
    """Planet counts latitudes southwards: LAT_SCALE is −0.0234."""
    rpc, ground = functions(), np.array([1.0, part[0], part[1]])
    other = rpc.coefficients * np.prod(ground ** powers(), axis=1)
    other[2] *= -1
    turned = RationalFunctions(
        image_offset=rpc.image_offset,
        image_scale=(rpc.image_scale[0], -rpc.image_scale[1]),
        ground_offset=rpc.ground_offset,
        ground_scale=tuple(np.array(rpc.ground_scale) * ground),
        coefficients=other,
    )
    assert (turned(places()) == rpc(places())).all()
    assert turned.heights == rpc.heights and min(turned.ground_scale) > 0


def test_scales_may_be_whole_degrees() -> None:
    """SkySat does not scale: the image is a hundredth of its box, whose border lies hundreds of images away."""
    rpc = functions()
    unit = np.array([1.0, 1.0, rpc.ground_scale[2]])
    other = rpc.coefficients * np.prod((unit / rpc.ground_scale) ** powers(), axis=1)
    seen = replace(rpc, ground_scale=tuple(unit), coefficients=other)
    assert np.abs(seen(places()) - rpc(places())).max() < 1e-8
    assert (np.abs(seen.coefficients[::2, 1:3]) > 3).any()
    other[0, 7] = 1e6
    with pytest.raises(InputError, match="images away"):
        replace(seen, coefficients=other)


def with_factor(slope: float, beside: float) -> RationalFunctions:
    """Sample L + 0.1 P and line −P + 0.1 H, each over and times (1 + slope L); `beside`: not quite."""
    coefficients = np.zeros((4, 20))
    coefficients[0, [1, 2, 7, 4]] = 1.0, 0.1, slope, 0.1 * slope
    coefficients[2, [2, 3, 4, 5]] = -1.0, 0.1, -slope, 0.1 * slope
    coefficients[1::2, 0], coefficients[1::2, 1] = 1.0, slope
    coefficients[0, 0] = beside
    return replace(functions(), coefficients=coefficients)


def test_numerator_and_denominator_may_share_a_factor() -> None:
    """Fitted without restraint, they vanish together inside the image, and positions go straight on."""
    found, plain = with_factor(-2.0, 0.0)(places()), with_factor(0.0, 0.0)(places())
    known = np.isfinite(found[:, 0])
    assert known.mean() > 0.99 and np.abs(found - plain)[known].max() < 1e-6
    # A pole is one: behind it there is no position.
    behind = places()[:, 0] > functions().ground_offset[0] + 0.5 * functions().ground_scale[0]
    assert np.isnan(with_factor(-2.0, 0.5)(places())[behind]).all()


@pytest.mark.parametrize("correction", [None, Affine2D(1.0 + 1e-4, 2e-4, -3.5, -1e-4, 1.0 - 2e-4, 8.25)])
def test_rays_are_the_inverse_and_derivatives_are_right(correction: Affine2D | None) -> None:
    seen = replace(camera(), correction=correction)
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 1, (300, 2)) * seen.size
    heights = rng.uniform(-100.0, 700.0, 300)
    XYZ, d = seen.rays(xy, heights)
    assert np.abs(project(seen, XYZ) - xy).max() < 1e-8
    assert np.array_equal(XYZ[:, 2], heights)
    step = 1.0
    A = seen.derivatives(XYZ)
    for k, axis in enumerate(np.eye(3) * step):
        slope = (project(seen, XYZ + axis) - project(seen, XYZ - axis)) / (2 * step)
        assert np.abs(A[..., k] - slope).max() < 2e-9
    assert np.linalg.norm(d, axis=1) == pytest.approx(1.0)
    assert (d[:, 2] < 0).all()
    assert np.abs(project(seen, XYZ + d) - xy).max() < 5e-6


def test_a_correction_moves_positions_by_itself() -> None:
    plain = camera()
    shifted = replace(plain, correction=Affine2D(1, 0, 1.25, 0, 1, -2.5))
    XYZ = plain.rays(np.array([[10.0, 20.0], [2500.0, 4000.0]]), 300.0)[0]
    assert project(shifted, XYZ) - project(plain, XYZ) == pytest.approx(np.array([[1.25, -2.5]] * 2))


def test_beyond_the_polynomials_there_is_nothing() -> None:
    rpc, seen = functions(), camera()
    middle = np.array(rpc.ground_offset)
    for k, scale in enumerate(rpc.ground_scale):
        step = np.zeros(3)
        step[k] = scale
        assert np.isfinite(rpc(middle + 0.999 * BOUND * step)).all()
        assert np.isnan(rpc(middle + 1.001 * BOUND * step)).all()
        assert np.isnan(rpc(middle - 40 * step)).all()
    assert np.isnan(seen.project_homogeneous([[6e5, 5.34e6, 9000.0], [np.nan, 5.34e6, 300.0], [1e9, 0, 0]])).all()
    for xy, height in (((1500.0, 2200.0), 9000.0), ((40_000.0, 0.0), 300.0), ((np.nan, 0.0), 300.0)):
        assert np.isnan(seen.rays(xy, height)[0]).all()
    pole = rpc.coefficients.copy()
    pole[1, 1] = -1.0
    assert np.isnan(replace(rpc, coefficients=pole)(middle + np.array([0.1, 0, 0]))).all()
    with pytest.raises(UsageError, match="height"):
        seen.rays([0.0, 0.0])


def test_longitudes_of_a_file_may_be_counted_from_greenwich_all_round() -> None:
    rpc, at = functions(), places(20)
    lon, lat, height = rpc.ground_offset
    assert replace(rpc, ground_offset=(lon - 360.0, lat, height))(at) == pytest.approx(rpc(at), abs=1e-7)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"image_scale": (0.0, 1.0)}, "scales 0, 1"),
        ({"ground_scale": (0.1, 0.0, 500.0)}, "none of them is 0"),
        ({"ground_offset": (16.0, float("nan"), 0.0)}, "not a finite number"),
        ({"ground_offset": (16.0, 5_340_000.0, 0.0)}, "nowhere on earth"),
        ({"coefficients": np.zeros((4, 20))}, "denominator vanishes"),
        ({"coefficients": np.ones((4, 1)) * (np.arange(20) == 0)}, "does not change"),
        ({"coefficients": np.zeros((4, 19))}, "RPC00B has 4 × 20"),
    ],
)
def test_numbers_that_cannot_be_are_named(changes: dict, told: str) -> None:
    with pytest.raises(InputError, match=told):
        replace(functions(), **changes)


def test_the_vantage_holds_all_that_is_seen() -> None:
    seen = camera()
    v = seen.vantage
    assert not v.central
    xy = np.random.default_rng(3).uniform(0, 1, (200, 2)) * seen.size
    for height in (v.floor, 300.0, float(v.point[2])):
        XYZ = seen.rays(xy, height)[0]
        assert np.linalg.norm(XYZ[:, :2] - v.point[:2], axis=1).max() < v.reach


def test_heights_above_the_sea_are_brought_to_the_ellipsoid() -> None:
    """What the ground's heights lack to the ellipsoid is what the positions differ by."""

    class Undulated(GeodeticGround):
        def __call__(self, XYZ: np.ndarray) -> np.ndarray:
            return super().__call__(np.asarray(XYZ) + np.array([0, 0, 44.0]))

        def to_map(self, geodetic: np.ndarray) -> np.ndarray:
            return super().to_map(geodetic) - np.array([0, 0, 44.0])

    plain = camera()
    seen = RpcCamera(plain.functions, Undulated(plain.ground.crs), plain.size)
    xy = np.array([[100.0, 100.0], [2900.0, 4000.0]])
    assert np.abs(seen.rays(xy, 256.0)[0] + np.array([0, 0, 44.0]) - plain.rays(xy, 300.0)[0]).max() < 1e-6
    assert seen.vantage.point[2] == pytest.approx(plain.vantage.point[2] - 44.0, abs=1e-6)


def test_gdals_warper_looks_for_pixels_at_the_same_places() -> None:
    """Map, ellipsoid and polynomials together; only the first and last pixel of its lines GDAL computes exactly."""
    seen = camera((300, 440))
    x, y = seen.rays((150.0, 220.0), 300.0)[0][:2]
    pixel, places = 4.0, np.array([[c, r] for r in range(3) for c in range(2)])
    rows, cols = np.mgrid[0.0:440.0, 0.0:300.0]
    found = np.full((2, 3, 2), np.nan)
    reproject(
        np.stack([cols, rows]),
        found,
        rpcs=RPC.from_gdal(gdal_form(seen.functions)),
        src_crs="EPSG:4326",
        dst_crs=CRS,
        dst_transform=Affine(pixel, 0, x - pixel, 0, -pixel, y + pixel),
        resampling=Resampling.bilinear,
        RPC_HEIGHT=250.0,
    )
    XY = (x, y) + pixel * (places - (0.5, 0.5)) * (1, -1)
    mine = project(seen, np.column_stack([XY, np.full(len(XY), 250.0)]))
    assert np.abs(found.reshape(2, -1).T - mine).max() < 1e-8


@pytest.mark.parametrize(("row", "term"), [(0, 9), (0, 16), (2, 10), (2, 3), (3, 0)])
def test_fault_30_a_coefficient_that_leads_far_away_is_refused(row: int, term: int) -> None:
    coefficients = functions().coefficients.copy()
    coefficients[row, term] = 1000.0 if row % 2 == 0 else 1e-6
    with pytest.raises(InputError, match=f"the {'sample' if row < 2 else 'line'} at the border .* fresh copy"):
        replace(functions(), coefficients=coefficients)
