"""What is known of the accuracy of points never makes the surface worse."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from tools.build_terrain import built, directly, line, scattered, terrain
from tools.rough_terrain import Ground, bench_edges, benches, fractal, sampled

from photoplan.surfaces.units import MeasuredLine, MeasuredTerrain
from photoplan.terrain.build import Built

SIDE = 60.0
HELD = np.random.default_rng(9).uniform(2, SIDE - 2, (1500, 2))


def error(ground: Ground, measured: MeasuredTerrain, **settings) -> tuple[float, Built]:  # type: ignore[no-untyped-def]
    model = built(measured, gross=0.0, adapt=0.0, grid_width=4.0, unit_meshes=4, **settings)
    heights, _ = directly(model, HELD)
    return float(np.sqrt(np.mean((heights - ground(HELD)) ** 2))), model


def hills(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(2.0 * np.sin(xy[:, 0] / 9) * np.cos(xy[:, 1] / 7))


def check(ground: Ground, lines: list[MeasuredLine], count: int, noise: float, seed: int, family: str = "auto") -> None:
    xyz = sampled(ground, scattered(SIDE, count, seed), noise, seed)
    unknown, _ = error(ground, terrain(xyz, *lines), family=family)
    of_class, _ = error(ground, terrain(xyz, *lines), filters={"mass": noise}, family=family)
    own, _ = error(ground, terrain(xyz, *lines, sigma=noise), family=family)
    print(f"unknown {unknown:.4f}, by class {of_class:.4f}, own {own:.4f} m")
    assert max(of_class, own) <= 1.03 * unknown  # which of two all but equal functions is found, is chance


@pytest.mark.slow
@pytest.mark.parametrize("lines", [True, False])
def test_terraces(lines: bool) -> None:
    """With their 15 edges: 16 mm became 7 mm when known noise began to be used in the estimation."""
    edges = [line(xyz, name=f"e{k}") for k, xyz in enumerate(bench_edges())] if lines else []
    check(benches, edges, 1200, 0.03, 0)


@pytest.mark.parametrize(
    "ground, count, noise, family",
    [
        (hills, 300, 0.1, "auto"),
        pytest.param(fractal(3.0, 61, 1), 900, 0.3, "auto", marks=pytest.mark.slow),
        pytest.param(hills, 300, 0.3, "exponential", marks=pytest.mark.slow),
    ],
)
def test_hills_and_rough_ground(ground: Ground, count: int, noise: float, family: str) -> None:
    check(ground, [], count, noise, 2, family)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["auto", "gaussian", "matern", "exponential"])
@pytest.mark.parametrize("count", [250, 900, 2500])
@pytest.mark.parametrize("slope", [2.0, 2.5, 3.0, 3.5, None])
def test_terrains_densities_families(
    slope: float | None, count: int, family: str, request: pytest.FixtureRequest
) -> None:
    if (slope, count, family) == (3.5, 2500, "exponential"):
        reason = "4.0 % worse with noise of 0.03 m: the exponential function does not fit ground this smooth"
        request.applymarker(pytest.mark.xfail(reason=reason, strict=True))
    for noise in (0.03, 0.3):
        check(hills if slope is None else fractal(slope, 61, count), [], count, noise, 3, family)


def test_what_the_ground_adds_to_the_accuracy_of_measuring_is_found() -> None:
    """Points measured to 2 cm in stubble of 15 cm: filtered as if nothing had been stated; exact if zero is."""
    xyz = sampled(hills, scattered(SIDE, 500, 4), 0.15, 4)
    unknown, _ = error(hills, terrain(xyz))
    stated, model = error(hills, terrain(xyz, sigma=0.02))
    assert stated <= 1.03 * unknown
    assert model.fit.whole.noise == pytest.approx(0.15, rel=0.15)
    _, exact = error(hills, terrain(xyz, sigma=0.0))
    assert exact.fit.noise.max() < 1e-9


def test_the_estimation_is_the_same_where_some_noise_is_known() -> None:
    """Spots of known noise among mass points do not end the estimation at the first of them."""
    xyz = sampled(hills, scattered(SIDE, 500, 5), 0.1, 5)
    groups = terrain(xyz[::2]).points + terrain(xyz[1::2], sigma=0.1, kind="spot").points
    mixed, _ = error(hills, MeasuredTerrain(groups))
    unknown, _ = error(hills, terrain(xyz))
    assert mixed <= 1.03 * unknown
