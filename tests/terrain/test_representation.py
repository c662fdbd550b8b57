"""Standard deviations hold what posts, triangles and filters cannot follow; a step at a breakline is no roughness."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from tools.build_terrain import built, line, scattered, surface_of, terrain

from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.units import representation
from photoplan.terrain.build import Built
from photoplan.terrain.observations import BuildSettings, observe

Height = Callable[[NDArray[np.float64]], NDArray[np.float64]]
NORMAL = (0.8, 1.25)


def ridge(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return 100 + 0.02 * xy[:, 0] + 8 * np.exp(-(((xy[:, 1] - 60) / 25) ** 2))


def normalised(
    model: Built, truth: Height, low: float, high: float
) -> tuple[float, HybridSurface, NDArray[np.float64]]:
    """Root mean square of errors over stated standard deviations at random places; the surface, and the places."""
    xy = np.random.default_rng(7).uniform(low, high, (4000, 2))
    surface = surface_of(model)
    ratio = (surface.heights(xy) - truth(xy)) / surface.sigmas(xy)
    return float(np.sqrt((ratio**2).mean())), surface, xy


@pytest.mark.parametrize("filters", [{}, {"mass": 0.02}])
@pytest.mark.parametrize("width", [None, 5.0])
def test_a_ridge_between_posts_is_in_the_standard_deviation(filters: dict[str, float], width: float | None) -> None:
    k = np.arange(0.0, 125.0, 5.0)
    xy = np.stack(np.meshgrid(k, k), axis=-1).reshape(-1, 2)
    model = built(terrain(np.column_stack([xy, ridge(xy).round(3)])), filters=filters, grid_width=width)
    found, surface, places = normalised(model, ridge, 10, 110)
    assert NORMAL[0] < found < NORMAL[1]
    # At the crest the error between posts is the mesh's, at the posts it is that of the prediction.
    step = model.units[0, 0].width
    crest = np.abs(places[:, 1] - 60) < 10
    errors = surface.heights(places[crest]) - ridge(places[crest])
    assert np.sqrt((surface.sigmas(places[crest]) ** 2).mean()) == pytest.approx(np.sqrt((errors**2).mean()), rel=0.35)
    posts = np.array([[10 * step, 50.0]])
    assert surface.sigmas(posts)[0] < 0.3 * surface.sigmas(posts + step / 2)[0]


def quarry(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two scarps of 60 degrees and a bench along a curve."""
    s = xy[:, 0] - (75 + 8 * np.sin(xy[:, 1] / 30))
    steps = np.interp(s, (-1e3, 0, 8.66, 28.66, 37.32, 1e3), (300, 300, 285, 284, 269, 262))
    return np.asarray(steps + 0.02 * xy[:, 1] + 1.5 * np.sin(xy[:, 0] / 45) * np.cos(xy[:, 1] / 55))


def test_the_step_beside_breaklines_is_not_in_the_standard_deviation() -> None:
    rng = np.random.default_rng(1)
    xy = scattered(200.0, 625, 3)
    y = np.arange(-4.0, 206.0, 6.0)
    edges = []
    for off in (0.0, 8.66, 28.66, 37.32):
        at = np.column_stack([75 + 8 * np.sin(y / 30) + off, y])
        edges.append(line(np.column_stack([at, quarry(at) + rng.normal(0, 0.02, len(y))]), name=f"edge {off}"))
    points = np.column_stack([xy, quarry(xy) + rng.normal(0, 0.1, len(xy))])
    model = built(terrain(points, *edges), filters={"mass": 0.10, "breakline": 0.02})
    assert NORMAL[0] < normalised(model, quarry, 10, 190)[0] < NORMAL[1]


@pytest.mark.slow
@pytest.mark.parametrize(("power", "width"), [(1.0, None), (1.0, 4.0), (1.8, 4.0)])
def test_rough_ground_between_wide_posts(power: float, width: float | None) -> None:
    rng = np.random.default_rng(5)
    size, turn, phase = np.geomspace(0.03, 8, 300), *rng.uniform(0, 2 * np.pi, (2, 300))
    waves = np.stack([size * np.cos(turn), size * np.sin(turn)])
    amplitude = (size / size[0]) ** (-power / 2)
    amplitude *= 4 / np.sqrt((amplitude**2).sum() / 2)

    def ground(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((amplitude * np.cos(xy @ waves + phase)).sum(axis=1))

    xy = scattered(100.0, 2500, 5)
    points = np.column_stack([xy, ground(xy) + rng.normal(0, 0.05, len(xy))])
    assert NORMAL[0] < normalised(built(terrain(points), grid_width=width), ground, 5, 95)[0] < NORMAL[1]


def test_a_step_across_a_line_is_no_curvature() -> None:
    heights = np.zeros((9, 9), np.float32)
    heights[:, 4:] = 10.0
    crossings = np.column_stack([np.full(9, 3.5), np.arange(9.0)])
    assert representation(heights, crossings).terms.max() == 0
    assert representation(heights).terms.max() > 1


def test_the_middle_of_a_parabola_is_off_by_an_eighth_of_its_second_difference() -> None:
    x = np.arange(17.0)
    found = representation(np.tile(0.5 * x**2, (17, 1)).astype(np.float32))
    assert found.power == 2
    np.testing.assert_allclose(np.sqrt(found.terms[0]), 1 / 8, rtol=1e-6)
    np.testing.assert_allclose(found.terms[1:], 0, atol=1e-12)


def test_uncorrelated_ground_is_off_by_one_and_a_half_times_its_variance_between_posts() -> None:
    found = representation(np.random.default_rng(2).normal(size=(129, 129)).astype(np.float32))
    assert found.power == 1
    assert found.terms[:2].mean() == pytest.approx(1.5, rel=0.05)


def test_rounding_to_millimetres_is_an_error_of_measurement() -> None:
    xyz = np.column_stack([scattered(10.0, 25, 1), np.linspace(0, 1.0123456, 25)])
    assert observe(terrain(xyz), BuildSettings()).rounding == 0
    xyz[:, 2] = xyz[:, 2].round(3)
    assert observe(terrain(xyz), BuildSettings()).rounding == pytest.approx(0.001 / np.sqrt(12))
