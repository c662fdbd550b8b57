"""Visibility over walls, hills and the round earth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from photoplan.engine.run import steps
from photoplan.errors import InputError, UsageError
from photoplan.terrain.analysis import Observer, SightSettings, horizon, needed_heights

FLAT_EARTH = SightSettings(curvature=False)


def need(heights, mesh, observer, settings=FLAT_EARTH, only_whether=False, workers=1):
    heights = np.asarray(heights, np.float32)
    with steps("terrain", workers) as run:
        return needed_heights(heights, mesh, observer, settings, only_whether=only_whether, run=run)


@pytest.mark.parametrize(("column", "row"), [(20.0, 30.0), (20.37, 30.61)])
def test_shadow_of_a_wall_follows_similar_triangles(column, row):
    """Behind a wall of height w at distance a, the line over its edge is at h + (w − h) d / a at distance d."""
    eye, wall, at = 1.7, 5.0, 40
    heights = np.zeros((61, 120))
    heights[:, at] = wall
    found = need(heights, 2.0, Observer(column, row, eye))
    i = np.arange(120)
    edge = eye + (wall - eye) * (i - column) / (at - column)
    behind = np.maximum(edge[at + 1 :], 0)
    np.testing.assert_allclose(found[30, at + 1 :], behind, rtol=1e-5)
    np.testing.assert_allclose(found[3, at + 1 :], behind, rtol=1e-5)
    assert found[:, : at - 1].max() == 0 and found[:, at].max() == 0


def test_shadow_of_a_low_wall_has_the_length_of_similar_triangles():
    """Seen from 10 m over a wall of 2 m at 100 m, the ground appears again 25 m behind the wall."""
    heights = np.zeros((5, 400))
    heights[:, 200] = 2.0
    seen = np.isfinite(need(heights, 0.5, Observer(0.0, 2.0, 10.0), only_whether=True))
    hidden = np.flatnonzero(~seen[2])
    assert hidden[0] == 201 and hidden[-1] * 0.5 == pytest.approx(125.0, abs=0.5)


def test_behind_a_hill_the_tangent_bounds_the_view():
    """Over a parabola z = −x²/2a the tangent from the eye at x0 touches it at x0 + √(2 a h)."""
    a, h, x0 = 500.0, 20.0, -100.0
    x = np.arange(-300, 301) * 1.0
    heights = np.tile(-(x**2) / (2 * a), (3, 1))
    touch = x0 + math.sqrt(2 * a * h)
    found = need(heights, 1.0, Observer(200.0, 1.0, -(x0**2) / (2 * a) + h))[1]
    assert found[(x > 2 * x0 - touch + 2) & (x < touch - 2)].max() < 1e-4
    slope = -touch / a
    tangent = -(touch**2) / (2 * a) + slope * (x - touch)
    far = x > touch + 2
    np.testing.assert_allclose(found[far], (tangent - heights[1])[far], atol=2e-3)


@pytest.mark.parametrize("k", [0.0, 0.13])
def test_horizon_of_the_sphere(k):
    settings = SightSettings(refraction=k)
    h = 10.0
    far = math.sqrt(2 * 6_380_000 * h / (1 - k))
    assert horizon(h, settings) == pytest.approx(far, rel=1e-9)
    seen = np.isfinite(need(np.zeros((3, 3000)), 10.0, Observer(0.0, 1.0, h), settings, True))[1]
    assert np.flatnonzero(seen)[-1] * 10.0 == pytest.approx(far, rel=5e-3)
    # A target of height t appears over the horizon as far as both horizons together.
    both = SightSettings(target_height=5.0, refraction=k)
    seen = np.isfinite(need(np.zeros((3, 3000)), 10.0, Observer(0.0, 1.0, h), both, True))[1]
    assert np.flatnonzero(seen)[-1] * 10.0 == pytest.approx(far + horizon(5.0, settings), rel=5e-3)


def test_corrections_are_those_of_ecker():
    """Ecker 1991, table 5.1: 0.08, 7.84 and 783.70 m at 1, 10 and 100 km; refraction takes 13 % of it."""
    none = SightSettings(refraction=0.0)
    for s, drop in ((1e3, 0.08), (1e4, 7.84), (1e5, 783.70)):
        assert s**2 * none.bend == pytest.approx(drop, abs=0.005)
        assert s**2 * SightSettings().bend == pytest.approx(0.87 * drop, abs=0.005)
    assert FLAT_EARTH.bend == 0 and horizon(2.0, FLAT_EARTH) == math.inf


def test_who_sees_is_seen():
    """Reciprocity: with equal heights above ground, B sees A where A sees B."""
    rng = np.random.default_rng(3)
    j, i = np.mgrid[:40, :40]
    heights = 6 * np.sin(i / 5.0) * np.cos(j / 7.0) + rng.normal(0, 0.3, (40, 40))
    heights = heights.astype(np.float32)
    settings = SightSettings(target_height=1.5, earth_radius=5e4)
    places = rng.integers(0, 40, (12, 2))
    table = np.array(
        [
            need(heights, 10.0, Observer(float(c), float(r), float(heights[r, c]) + 1.5), settings)[
                places[:, 0], places[:, 1]
            ]
            for r, c in places
        ]
    )
    sees = table <= 1.5 + 1e-4
    clear = np.abs(table - 1.5) > 1e-3
    clear |= table <= 1.5
    np.testing.assert_array_equal((sees & clear & clear.T), (sees & clear & clear.T).T)
    assert 0.2 < sees.mean() < 0.9


def test_holes_block_nothing_and_have_no_answer():
    heights = np.zeros((21, 60))
    heights[:, 30:33] = np.nan
    found = need(heights, 1.0, Observer(5.0, 10.0, 1.0))
    assert np.isnan(found[:, 30:33]).all() and np.nanmax(found) == 0
    heights[:, 31] = 50.0  # the ridge's flanks are missing, its posts are there
    assert need(heights, 1.0, Observer(5.0, 10.0, 1.0))[10, 40] > 10


def test_threads_change_nothing():
    rng = np.random.default_rng(8)
    heights = rng.normal(0, 2, (150, 170))
    one, two = (need(heights, 5.0, Observer(80.2, 60.7, 3.0), SightSettings(), workers=n) for n in (1, 3))
    np.testing.assert_array_equal(one, two)


def test_wrong_use():
    with pytest.raises(InputError, match="outside"):
        need(np.zeros((5, 5)), 1.0, Observer(9.0, 1.0, 2.0))
    with pytest.raises(InputError, match="two"):
        need(np.zeros((1, 5)), 1.0, Observer(0.0, 0.0, 2.0))
    for wrong in ({"radius": 0.0}, {"refraction": 1.0}, {"target_height": -1.0}, {"earth_radius": 0.0}):
        with pytest.raises(UsageError):
            SightSettings(**wrong)


@pytest.mark.bench
def test_four_megapixels_take_seconds():
    import time

    j, i = np.mgrid[:2000, :2000]
    heights = (80 * np.sin(i / 190) * np.cos(j / 230) + 5 * np.sin(i / 17 + j / 23)).astype(np.float32)
    started = time.perf_counter()
    need(heights, 1.0, Observer(900.0, 1100.0, float(heights[1100, 900]) + 1.7), SightSettings(), True, 2)
    assert time.perf_counter() - started < 10
