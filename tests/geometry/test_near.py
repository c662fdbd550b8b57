"""The axes of a body around a place, without the rounding of large numbers."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.geometry.local import EARTH_RADII, BodyGround, near_ground

UTM = BodyGround("EPSG:32633", "ellipsoidal", EARTH_RADII)
MOON = BodyGround(
    "+proj=stere +lat_0=-80 +lon_0=40 +R=1737400 +units=m +no_defs", "ellipsoidal", (1737400.0, 1737400.0)
)


@pytest.mark.parametrize(
    ("ground", "middle", "half"),
    [(UTM, (600_000.0, 5_340_000.0), 4000.0), (UTM, (300_000.0, 200_000.0), 60_000.0), (MOON, (9e4, -2e4), 30_000.0)],
    ids=["aerial", "satellite", "moon"],
)
def test_places_are_those_of_the_ground_without_their_rounding(
    ground: BodyGround, middle: tuple[float, float], half: float
) -> None:
    rng = np.random.default_rng(1)
    corners = np.array(middle) + half * np.array([[-1.0, -1.0], [1.0, 1.0]])
    near = near_ground(ground, corners)
    assert near.coefficients is not None
    XYZ = np.column_stack([rng.uniform(*corners, (300, 2)), rng.uniform(-500.0, 9000.0, 300)])
    assert np.abs(near(XYZ) + near.origin - ground(XYZ)).max() < 4e-9
    # Over short even steps third differences of a smooth surface are far below the rounding of places.
    line = np.column_stack([middle[0] + 0.125 * np.arange(200), np.full(200, middle[1]), np.full(200, 300.0)])
    rough, smooth = (np.abs(np.diff(each, 3, axis=0)).max() for each in (ground(line), near(line)))
    print(f"\n{rough:.1e} and {smooth:.1e} m")
    assert smooth < 1e-10 < rough


def test_far_away_and_over_wide_areas_places_are_those_of_the_ground() -> None:
    corners = np.array([[596_000.0, 5_336_000.0], [604_000.0, 5_344_000.0]])
    near = near_ground(UTM, corners)
    XYZ = np.array([[700_000.0, 5_340_000.0, 10.0], [600_000.0, 5_340_000.0, 10.0], [np.nan, 0.0, 0.0]])
    found = near(XYZ)
    assert np.array_equal(found[0], UTM(XYZ[:1])[0] - near.origin) and np.isnan(found[2]).all()
    wide = near_ground(MOON, np.array([[-1e6, -1e6], [1e6, 1e6]]))
    assert wide.coefficients is None
    assert np.array_equal(wide(XYZ[1:2] / 10), MOON(XYZ[1:2] / 10) - wide.origin)


def test_places_without_a_map_are_left_out() -> None:
    XYZ = np.array([[600_000.0, 5_340_000.0, 10.0]])
    corners = np.array([[596_000.0, 5_336_000.0], [np.nan, np.nan], [604_000.0, 5_344_000.0]])
    assert np.array_equal(near_ground(UTM, corners)(XYZ), near_ground(UTM, corners[::2])(XYZ))
    assert np.array_equal(near_ground(UTM, corners[1:2])(XYZ), UTM(XYZ))


def test_points_are_put_onto_their_rays() -> None:
    corners = np.array([[596_000.0, 5_336_000.0], [604_000.0, 5_344_000.0]])
    near = near_ground(UTM, corners)
    rng = np.random.default_rng(2)
    XYZ = np.column_stack([rng.uniform(*corners, (200, 2)), rng.uniform(0.0, 900.0, 200)])
    S = near(np.column_stack([XYZ[:, :2] + rng.uniform(-3000.0, 3000.0, (200, 2)), np.full(200, 8000.0)]))
    d = near(XYZ) - S
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    off = XYZ + rng.uniform(-3e-8, 3e-8, (200, 3)) * [1.0, 1.0, 0.0]
    # Northings are rounded to 5e-10 m.
    assert np.abs(near.sharpened(off, S, d) - XYZ).max() < 2e-9
    # What is further away than by rounding, is not moved.
    away = XYZ + np.array([0.01, 0.0, 0.0])
    assert np.array_equal(near.sharpened(away, S, d), away)
