"""Terrain models built in memory from made-up measurements."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.engine.run import steps
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.units import MeasuredLine, MeasuredTerrain, MemoryUnits, PointGroup
from photoplan.terrain.build import Built, build_terrain, plan_build
from photoplan.terrain.observations import BuildSettings
from photoplan.terrain.predict import heights_at

__all__ = ["built", "directly", "line", "scattered", "surface_of", "terrain", "unit_of"]


def terrain(xyz: ArrayLike, *lines: MeasuredLine, sigma: float | None = None, kind: Any = "mass") -> MeasuredTerrain:
    xyz = np.asarray(xyz, float)
    names = np.array([f"n{k}" for k in range(len(xyz))])
    return MeasuredTerrain((PointGroup("p", kind, xyz, np.arange(1, len(xyz) + 1), sigma, names),), lines)


def line(xyz: ArrayLike, kind: Any = "breakline", name: str = "line", **more: Any) -> MeasuredLine:
    return MeasuredLine(name, kind, np.asarray(xyz, float), **more)


def built(measured: MeasuredTerrain, workers: int = 2, **settings: Any) -> Built:
    with steps("terrain", workers) as run:
        return build_terrain(plan_build(measured, BuildSettings(**settings)), run)


def surface_of(model: Built) -> HybridSurface:
    return HybridSurface(MemoryUnits(model.plan.layout, model.units))


def unit_of(model: Built, XY: NDArray[np.float64]) -> NDArray[np.int64]:
    """Number of the unit in which each place lies."""
    layout = model.plan.layout
    column = np.clip(((XY[:, 0] - layout.left) / layout.side).astype(int), 0, layout.columns - 1)
    row = np.clip(((layout.top - XY[:, 1]) / layout.side).astype(int), 0, layout.rows - 1)
    return np.asarray(row * layout.columns + column)


def directly(model: Built, XY: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Heights and standard deviations by prediction at the places themselves, without posts between."""
    origin, unit = model.plan.seen.origin, unit_of(model, XY)
    heights, sigmas = np.full(len(XY), np.nan), np.full(len(XY), np.nan)
    for number in np.unique(unit).tolist():
        some = unit == number
        z, s, _ = heights_at(model.fit, number, np.ascontiguousarray(XY[some] - origin[:2]))
        heights[some], sigmas[some] = z + origin[2], s
    return heights, sigmas


def scattered(side: float, count: int, seed: int) -> NDArray[np.float64]:
    """Places spread over a square almost evenly: a shifted grid, shape (count, 2) or a little more."""
    rng = np.random.default_rng(seed)
    n = int(np.ceil(np.sqrt(count)))
    k = np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2)
    return np.asarray((k + rng.uniform(0.02, 0.98, k.shape)) * (side / n))
