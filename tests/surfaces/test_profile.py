"""Profiles: straight lines between their points are the surface; walls have two heights, gaps none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.hybrid_models import line, model, random_lines
from tools.thinned import examples

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.seen import profile
from photoplan.surfaces.units import UnitLayout

LAYOUT = UnitLayout(500_000.3, 5_300_000.7, 12.34, 2, 2)


@dataclasses.dataclass(frozen=True, eq=False)
class Posts:
    """A height grid in memory."""

    heights: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        return self.heights.shape[1], self.heights.shape[0]

    def read(self, window: Window) -> np.ndarray:
        return self.heights[window.row : window.stop[1], window.col : window.stop[0]]


def check(surface, polyline, bound: float) -> tuple[np.ndarray, ...]:
    """Points between those of the profile lie on the surface, and gaps are gaps."""
    distance, X, Y, Z = profile(surface, polyline)
    assert (np.diff(distance) >= 0).all()
    polyline = np.asarray(polyline, float)
    assert distance[-1] == pytest.approx(np.hypot(*np.diff(polyline, axis=0).T).sum(), abs=1e-5)
    along = np.append(0, np.cumsum(np.hypot(*np.diff(polyline, axis=0).T)))
    there = np.isfinite(Z)
    for got, axis in ((X, 0), (Y, 1)):
        np.testing.assert_allclose(got[there], np.interp(distance[there], along, polyline[:, axis]), atol=1e-5)
    wide = np.flatnonzero(np.diff(distance) > 1e-4)
    for t in (0.02, 0.31, 0.5, 0.77, 0.98):
        d, z = (v[wide] + t * (v[wide + 1] - v[wide]) for v in (distance, Z))
        XY = np.stack([np.interp(d, along, polyline[:, axis]) for axis in (0, 1)], axis=1)
        np.testing.assert_allclose(z, surface.heights(XY), atol=bound)
    return distance, X, Y, Z


@settings(max_examples=examples(15, 40), deadline=None)
@given(seed=st.integers(0, 100_000))
def test_between_its_points_a_profile_is_the_surface(seed: int) -> None:
    rng = np.random.default_rng(seed)
    surface, _ = model(LAYOUT, rng.choice([1, 2, 4, 8], (2, 2)), random_lines(rng, LAYOUT, 5, walls=True))
    xmin, ymin, xmax, ymax = LAYOUT.bounds
    polyline = rng.uniform([xmin - 3, ymin - 3], [xmax + 3, ymax + 3], (4, 2))
    check(surface, polyline, 1.01e-3)


def test_a_profile_over_a_wall_has_both_heights_there() -> None:
    wall = line([(500_005, 5_300_010, 254.0), (500_005, 5_299_970, 254.0)], [251.0, 251.0])
    surface, _ = model(LAYOUT, 4, [wall], lambda X, Y: np.where(X > 500_005, 254.0, 251.0))
    distance, X, _, Z = check(surface, [(500_001, 5_299_990), (500_009, 5_299_991.0)], 1e-9)
    at = np.flatnonzero(np.abs(X - 500_005) < 1e-6)
    assert len(at) == 2 and distance[at[0]] == pytest.approx(distance[at[1]]) and Z[at].tolist() == [251, 254]
    _, _, _, along = profile(surface, [(500_005, 5_299_999), (500_005, 5_299_980)])
    np.testing.assert_allclose(along, 254.0)


def test_a_profile_meets_lines_and_grid_lines() -> None:
    ditch = line([(500_000, 5_299_995.2, 249.0), (500_030, 5_299_995.2, 249.0)])
    surface, _ = model(LAYOUT, 2, [ditch], lambda X, Y: 250 + 0 * X)
    _, _, Y, Z = check(surface, [(500_007.7, 5_299_999), (500_007.7, 5_299_991)], 1e-9)
    assert Z[np.argmin(np.abs(Y - 5_299_995.2))] == pytest.approx(249, abs=1e-6)
    assert np.abs(Y - (LAYOUT.top - LAYOUT.side / 2)).min() < 1e-6


def test_the_parabola_over_a_mesh_is_met_to_the_tolerance() -> None:
    layout = UnitLayout(0, 0, 10.0, 1, 1)
    surface, _ = model(layout, 1, [], lambda X, Y: 250 + 0.08 * X * -Y)  # 8 m in one corner
    for tolerance, points in ((1.0, 3), (0.1, 6), (0.001, 46)):
        distance, _, _, Z = profile(surface, [(0, 0), (10, -10)], tolerance)
        assert len(Z) == points
        between = np.linspace(0, distance[-1], 1001)
        true = surface.heights(np.stack([between, -between], axis=1) / np.sqrt(2))
        error = np.abs(np.interp(between, distance, Z) - true).max()
        assert 0.25 * tolerance < error <= tolerance


def test_gaps_are_marked_once_at_both_ends() -> None:
    layout = UnitLayout(0, 0, 10.0, 1, 1)
    surface, _ = model(layout, 10, [], lambda X, Y: np.where((X > 2) & (X < 6), np.nan, 250.0))
    distance, _, _, Z = profile(surface, [(-2, -4.5), (12, -4.5)])
    lost = distance[np.isnan(Z)]
    np.testing.assert_allclose(lost, [0, 2, 4, 8, 12, 14], atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_a_profile_over_a_raster(seed: int) -> None:
    rng = np.random.default_rng(seed)
    heights = rng.uniform(0, 3, (7, 9)).astype(np.float32)
    heights[3, 4] = np.nan
    surface = RasterSurface(Posts(heights), (1000.0, 2000.0), (2.0, 1.5))
    check(surface, rng.uniform((997, 1989), (1019, 2003), (3, 2)), 1.01e-3)


def test_what_cannot_be_a_profile_is_refused() -> None:
    surface, _ = model(LAYOUT, 1, [])
    for polyline in ([(1, 2)], [(1, 2), (1, 2)], [(1, 2, 3), (4, 5, 6)], [(1, 2), (np.nan, 4)], np.empty((0, 2))):
        with pytest.raises(UsageError, match="polyline"):
            profile(surface, polyline)
    with pytest.raises(UsageError, match="tolerance 0"):
        profile(surface, [(1, 2), (3, 4)], 0)
    with pytest.raises(UsageError, match="another CRS"):
        profile(dataclasses.replace(surface, to_model_crs=lambda XY: XY), [(1, 2), (3, 4)])
