"""Standard deviation of volumes against simulated errors."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from tools.function_surface import FunctionSurface
from tools.thinned import some

from photoplan.errors import UsageError
from photoplan.surfaces.base import LevelSurface
from photoplan.terrain.volume import ErrorModel, volume_sigma

FLAT = LevelSurface(0.0)


def simulated(polygon, sigma, length: float, trials: int = 500) -> float:
    """Spread of the integral of random fields with correlation exp(−r²/L²), made of plane waves."""
    rng = np.random.default_rng(11)
    xmin, ymin, xmax, ymax = polygon.bounds
    step = min(length / 4, 0.4)
    x, y = np.meshgrid(np.arange(xmin + step / 2, xmax, step), np.arange(ymin + step / 2, ymax, step))
    inside = shapely.contains_xy(polygon, x, y)
    x, y = x[inside], y[inside]
    weight = sigma(x, y) * step**2
    totals = []
    for _ in range(trials):
        k = rng.normal(0, math.sqrt(2) / length, (60, 2))
        phase = rng.uniform(0, 2 * math.pi, 60)
        waves = np.cos(np.outer(x, k[:, 0]) + np.outer(y, k[:, 1]) + phase)
        totals.append(math.sqrt(2 / 60) * (waves.sum(axis=1) * weight).sum())
    return float(np.std(totals))


@pytest.mark.parametrize("length", some([1.0, 4.0, 30.0], 1, 2))
def test_standard_deviation_is_that_of_simulated_errors(length):
    """Regions much wider than the correlation, comparable to it, and within it."""
    polygon = shapely.Polygon([(0, 0), (12, 1), (9, 10), (2, 8)])

    def sigma(x, y):
        return 0.1 + 0.02 * x

    errors = (ErrorModel(lambda XY: sigma(XY[:, 0], XY[:, 1]), length), ErrorModel(0.0, 1.0))
    found = volume_sigma(FLAT, LevelSurface(1.0), errors, polygon, 0.5)
    assert found.net == pytest.approx(simulated(polygon, sigma, length), rel=0.08)
    assert found.fill == pytest.approx(found.net) and found.cut == 0


def test_large_regions_follow_the_closed_formula():
    box = shapely.box(0, 0, 60, 50)
    found = volume_sigma(FLAT, LevelSurface(1.0), (ErrorModel(0.1, 1.0), ErrorModel(0.2, 1.0)), box, 1.0)
    assert found.net == pytest.approx(math.sqrt(math.pi * 3000 * (0.01 + 0.04)), rel=0.01)
    sparse = volume_sigma(FLAT, LevelSurface(1.0), (ErrorModel(0.1, 0.02), ErrorModel(0.2, 0.02)), box, 0.5)
    assert sparse.net == pytest.approx(0.02 * found.net, rel=0.01), "too many cells: the closed formula itself"


def test_errors_of_full_correlation_act_like_a_bias():
    box = shapely.box(0, 0, 10, 10)
    stiff = volume_sigma(FLAT, LevelSurface(1.0), (ErrorModel(0.1, 1e4), ErrorModel(0.0, 1.0)), box, 0.5)
    bias = volume_sigma(FLAT, LevelSurface(1.0), (ErrorModel(0.0, 1.0), ErrorModel(0.0, 1.0)), box, 0.5, bias=0.1)
    assert stiff.net == pytest.approx(10.0, rel=1e-3) and bias.net == pytest.approx(10.0)


def test_cut_and_fill_have_the_deviation_of_their_own_area():
    step = FunctionSurface(lambda x, y: np.where(x < 25, -1.0, 1.0))
    box = shapely.box(0, 0, 100, 40)
    found = volume_sigma(FLAT, step, (ErrorModel(0.1, 1.0), ErrorModel(0.0, 1.0)), box, 0.5, bias=0.01)
    assert found.cut == pytest.approx(math.sqrt(math.pi * 1000 * 0.01 + 10**2), rel=0.02)
    assert found.fill == pytest.approx(math.sqrt(math.pi * 3000 * 0.01 + 30**2), rel=0.02)
    assert found.net == pytest.approx(math.sqrt(math.pi * 4000 * 0.01 + 40**2), rel=0.02)


def test_heights_without_standard_deviation_are_reported():
    half = ErrorModel(lambda XY: np.where(XY[:, 0] < 5, 0.1, np.nan), 1.0)
    found = volume_sigma(FLAT, LevelSurface(1.0), (half, ErrorModel(0.1, 1.0)), shapely.box(0, 0, 10, 10), 0.5)
    assert found.unknown == pytest.approx(50)


def test_figures_are_checked():
    for wrong in ({"sigma": -1.0, "length": 1.0}, {"sigma": 0.1, "length": 0.0}):
        with pytest.raises(UsageError):
            ErrorModel(**wrong)
    with pytest.raises(UsageError, match="bias"):
        volume_sigma(FLAT, FLAT, (ErrorModel(0.1, 1.0),) * 2, shapely.box(0, 0, 1, 1), 1.0, bias=-1)
