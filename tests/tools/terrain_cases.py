"""Grounds whose standard deviations are judged, with the classes of places that they are judged in."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photoplan.surfaces.units import MeasuredLine, MeasuredTerrain
from photoplan.terrain.build import Built
from tools.build_terrain import built, directly, line, scattered, terrain
from tools.rough_terrain import Ground, bench_edges, benches, fractal, sampled

__all__ = ["CASES", "spreads"]

Classes = Callable[[NDArray[np.float64]], NDArray[np.str_]]
Case = Callable[[int], tuple[Ground, MeasuredTerrain, Classes | None]]
SIDE = 80.0
_DISTANCES = (0.0, 0.5, 1.0, 1.5, 3.0, 9.0)


def rough(slope: float, noise: float = 0.05, gaps: bool = False) -> Case:
    """Fractal ground, with six gaps 3 to 8 spacings wide if wanted."""

    def case(seed: int) -> tuple[Ground, MeasuredTerrain, None]:
        ground, xy = fractal(slope, 161, seed, 0.5), scattered(SIDE, 1600, seed)
        for k, middle in enumerate(np.random.default_rng(seed).uniform(12, 68, (6 if gaps else 0, 2))):
            xy = xy[(np.abs(xy - middle) > (3, 5, 8)[k % 3]).any(axis=1)]
        return ground, terrain(sampled(ground, xy, noise, seed)), None

    return case


def terraces(seed: int) -> tuple[Ground, MeasuredTerrain, None]:
    edges = [line(xyz, name=f"e{k}") for k, xyz in enumerate(bench_edges())]
    return benches, terrain(sampled(benches, scattered(60.0, 1200, seed), 0.03, seed), *edges), None


def _axis(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of the embankment and the cliff, straight between vertices a metre apart."""
    vertices = np.arange(SIDE + 1)
    return np.interp(x, vertices, 40 + 3 * np.sin(vertices / 15))


def _dike(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    away = np.abs(xy[:, 1] - _axis(xy[:, 0]))
    waves = 0.02 * np.sin(xy[:, 0] / 6) * np.cos(xy[:, 1] / 7)
    return np.asarray(100 + np.clip((8 - away) / 1.5, 0, 4) + waves)


def embankment(seed: int) -> tuple[Ground, MeasuredTerrain, Classes]:
    """4 m high, with its edges as breaklines, in a plain with waves of 2 cm."""
    x = np.arange(SIDE + 1)
    edges = [np.column_stack([x, _axis(x) + by]) for by in (-8, -2, 2, 8)]
    lines = [line(np.column_stack([xy, _dike(xy)]), name=f"edge{k}") for k, xy in enumerate(edges)]
    xyz = sampled(_dike, scattered(SIDE, 1600, seed), 0.03, seed)

    def classes(xy: NDArray[np.float64]) -> NDArray[np.str_]:
        away = np.abs(xy[:, 1] - _axis(xy[:, 0]))
        return np.where(away < 10, "embankment", np.where(away < 20, "beside it", "plain"))

    return _dike, terrain(xyz, *lines), classes


def cliff(seed: int) -> tuple[Ground, MeasuredTerrain, Classes]:
    """A wall of 10 m between smooth ground below and ground ten times as rough above."""
    field = fractal(3.0, 161, seed, 0.5)

    def above(xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(xy[:, 1] > _axis(xy[:, 0]))

    def ground(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(above(xy), 10 + 2 * field(xy), 0.2 * field(xy))

    x = np.arange(SIDE + 1)
    xy = np.column_stack([x, _axis(x)])
    wall = line(np.column_stack([xy, 10 + 2 * field(xy)]), name="wall", right=0.2 * field(xy))
    xyz = sampled(ground, scattered(SIDE, 1600, seed), 0.05, seed)
    return ground, terrain(xyz, wall), lambda xy: np.where(above(xy), "above", "below")


def contours(seed: int) -> tuple[Ground, MeasuredTerrain, None]:
    """Form lines only, every half metre."""
    field, k = fractal(3.0, 161, seed, 0.5), np.arange(161) * 0.5

    def ground(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(field(xy) + 4 * np.sin(xy[:, 0] / 14) * np.cos(xy[:, 1] / 11))

    x, y = np.meshgrid(k, k)
    z = ground(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
    contourpy = pytest.importorskip("contourpy")  # it comes with matplotlib
    pieces = contourpy.contour_generator(k, k, z)
    lines: list[MeasuredLine] = []
    for level in np.arange(np.ceil(2 * z.min()), 2 * z.max()) / 2:
        some = [xy for xy in pieces.lines(level) if len(xy) > 4]
        lines += [line(np.column_stack([xy, np.full(len(xy), level)]), "formline", f"{level} {len(xy)}") for xy in some]
    return ground, MeasuredTerrain((), tuple(lines)), None


CASES: dict[str, Case] = {
    "slope 2": rough(2.0),
    "slope 2.5": rough(2.5),
    "slope 2.5, much noise": rough(2.5, noise=0.3),
    "slope 3": rough(3.0),
    "gaps": rough(2.5, gaps=True),
    "terraces": terraces,
    "embankment": embankment,
    "cliff": cliff,
    "contours": contours,
}


@dataclass
class _Sums:
    count: int = 0
    squares: float = 0.0


def spreads(name: str, seeds: range, places: int, **settings: float) -> tuple[dict[str, float], Built]:
    """Root mean squares of true errors over stated standard deviations, by class of places; and the last model."""
    sums: dict[str, _Sums] = {}
    for seed in seeds:
        ground, measured, classes = CASES[name](seed)
        model = built(measured, **settings)
        xyz = np.vstack([group.xyz for group in measured.points] + [line.xyz for line in measured.lines])
        low, high = xyz[:, :2].min(axis=0) + 1, xyz[:, :2].max(axis=0) - 1
        xy = np.random.default_rng(seed + 77).uniform(low, high, (places, 2))
        heights, sigmas = directly(model, xy)
        z = (heights - ground(xy)) / sigmas
        seen = model.plan.seen
        away = cKDTree(seen.xyz[:, :2] + seen.origin[:2]).query(xy)[0] / seen.spacing
        groups = {"all": np.isfinite(z)}
        for a, b in itertools.pairwise(_DISTANCES):
            groups[f"{a:g} to {b:g} spacings"] = np.isfinite(z) & (away >= a) & (away < b)
        if classes is not None:
            groups |= {c: np.isfinite(z) & (classes(xy) == c) for c in np.unique(classes(xy)).tolist()}
        for group, some in groups.items():
            one = sums.setdefault(group, _Sums())
            one.count += int(some.sum())
            one.squares += float((z[some] ** 2).sum())
    least = places * len(seeds) / 200
    return {g: float(np.sqrt(s.squares / s.count)) for g, s in sums.items() if s.count >= least}, model
