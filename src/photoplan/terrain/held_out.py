"""Blocks of data are held out and predicted from the rest: what standard deviations are worth, by distance to data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photoplan.events import Map
from photoplan.terrain.calibration import HeldOut, Surroundings, calibrate, joined
from photoplan.terrain.covariance import Neighbours
from photoplan.terrain.fit import TerrainFit, unit_of
from photoplan.terrain.leaves import quadtree
from photoplan.terrain.observations import Observations, lines_apart
from photoplan.terrain.paraboloids import paraboloids
from photoplan.terrain.predict import raw_at

#: Half sides of blocks in spacings, as far as the model has such gaps.
_SIZES = (0.3, 1.0, 2.0, 4.0, 8.0)
#: Rounds, and the part of the data and their number that are held out in each.
_ROUNDS, _PART, _MOST = 2, 0.1, 3000
#: A block that is a larger part of the data is left.
_LARGEST = 0.2
#: Half length of pieces of form lines in distances between lines.
_PIECE = 4.0
#: Heights around a datum that tell how much the ground bends.
_BENT = 12
#: Data of a block that are predicted, and of a line.
_ASKED = 24


def calibrated(found: TerrainFit, places: NDArray[np.float64], meshes: int, run: Map = map) -> TerrainFit:
    """The fit with standard deviations calibrated by blocks of its own data."""
    seen = found.seen
    gaps = cKDTree(seen.xyz[:, :2]).query(places)[0] / seen.spacing if len(places) else np.ones(1)
    rng = np.random.default_rng(len(seen.xyz))
    rounds = [_round(found, float(np.quantile(gaps, 0.998)), meshes, rng, run) for _ in range(_ROUNDS)]
    return replace(found, calibration=calibrate(joined(rounds)))


def _round(found: TerrainFit, gap: float, meshes: int, rng: np.random.Generator, run: Map) -> HeldOut:
    seen = found.seen
    block = _blocks(found, gap, rng)
    asked = _asked(block)
    rest = without(found, block >= 0, meshes)
    unit = unit_of(seen.xyz[asked, :2], found.layout)
    groups = [asked[unit == u] for u in np.unique(unit)]

    def one(some: NDArray[np.int64]) -> NDArray[np.float64]:
        u = int(unit_of(seen.xyz[some[:1], :2], found.layout)[0])
        raw = raw_at(rest, u, np.ascontiguousarray(seen.xyz[some, :2]), chosen=False)
        around = raw.around
        return np.column_stack(
            [raw.height, raw.sigma, raw.lost, around.signal, around.distance, around.beside, around.rough]
        )

    predicted = np.vstack([np.empty((0, 7)), *run(one, groups)])
    at = np.concatenate([np.empty(0, np.int64), *groups])
    ground = np.where(at < seen.points, found.ground[unit_of(seen.xyz[at, :2], found.layout)], 0.0)
    noise = np.maximum(found.noise[at] - ground, 0.0) * found.least_noise
    known = np.isfinite(predicted).all(axis=1) & np.isfinite(seen.xyz[at, 2]) & (predicted[:, 1] > 0)
    at, predicted = at[known], predicted[known]
    _, number = np.unique(block[at], return_inverse=True)
    error = predicted[:, 0] - seen.xyz[at, 2]
    return HeldOut(
        error=error,
        sigma=predicted[:, 1],
        noise=noise[known] + predicted[:, 2],
        around=Surroundings(*predicted[:, 3:].T),
        block=number.ravel(),
        bend=_bends(seen, at),
    )


def _bends(seen: Observations, some: NDArray[np.int64]) -> NDArray[np.float64]:
    """How much the ground bends at data: second derivatives of a paraboloid through the heights around, 1/m.

    Their own heights have no part in it: noise would bend the ground where its errors are large.
    """
    known = np.flatnonzero(np.isfinite(seen.xyz).all(axis=1))
    if len(known) <= _BENT:
        return np.zeros(len(some))
    near = known[cKDTree(seen.xyz[known, :2]).query(seen.xyz[some, :2], k=np.arange(2, _BENT + 2))[1]]
    d = seen.xyz[near] - seen.xyz[some, None]
    A, size = paraboloids(d[..., :2])
    second = (np.linalg.pinv(A, rcond=1e-6) @ d[..., 2:])[:, 3:, 0] / size[:, None] ** 2
    return np.sqrt((second**2 * (1.0, 2.0, 1.0)).sum(axis=1))


def without(found: TerrainFit, held: NDArray[np.bool_], meshes: int) -> TerrainFit:
    """The same stochastic model for fewer data, of which no patch has chosen yet."""
    seen, kept = found.seen, ~held
    some = kept[: seen.points]
    vertices = seen.lines.xyz[:, :2]
    lines = held.copy()
    lines[: seen.points] = False
    if lines.any():
        vertices = vertices[cKDTree(seen.xyz[lines, :2]).query(vertices)[0] > 0]
    fewer = replace(
        seen,
        xyz=seen.xyz[kept],
        points=int(some.sum()),
        parts=seen.parts[kept],
        line=seen.line[kept],
        group=seen.group[some],
        record=seen.record[some],
    )
    leaves = quadtree(np.vstack([fewer.xyz[: fewer.points, :2], vertices]), found.layout, meshes)
    order = leaves.order[leaves.order < fewer.points]
    return replace(
        found,
        seen=fewer,
        leaves=leaves,
        neighbours=Neighbours.of(fewer.xyz[:, :2], fewer.points, order),
        noise=found.noise[kept],
        residuals=found.residuals[some],
        lost=found.lost[kept],
    )


def _blocks(found: TerrainFit, gap: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Number of the block of each datum, −1: it is kept."""
    seen = found.seen
    block = np.full(len(seen.xyz), -1)
    points = np.flatnonzero(found.noise[: seen.points] >= 0)
    count = 0
    if len(points) > 10:
        tree = cKDTree(seen.xyz[points, :2])
        sizes = [size for k, size in enumerate(_SIZES) if k < 2 or _SIZES[k - 1] < gap]
        budget = min(_PART * len(points), _MOST) / len(sizes)
        for size in sizes:
            left = budget
            while left > 0:
                middle = seen.xyz[points[rng.integers(len(points))], :2]
                inside = points[tree.query_ball_point(middle, size * seen.spacing, p=np.inf)]
                left -= len(inside)
                if len(inside) <= _LARGEST * len(points):
                    block[inside] = count
                    count += 1
    lines = np.flatnonzero(seen.line >= 0)
    if len(lines) > len(points):
        _pieces(seen, lines, block, count, rng)
    return block


def _pieces(
    seen: Observations, lines: NDArray[np.int64], block: NDArray[np.int64], count: int, rng: np.random.Generator
) -> None:
    """Number pieces of form lines: points along a line say nothing of the ground beside it."""
    tree = cKDTree(seen.xyz[lines, :2])
    apart = lines_apart(seen)
    left = _PART * len(lines)
    while left > 0:
        middle = lines[rng.integers(len(lines))]
        near = lines[tree.query_ball_point(seen.xyz[middle, :2], _PIECE * apart)]
        near = near[seen.line[near] == seen.line[middle]]
        left -= len(near)
        if len(near) <= _LARGEST * len(lines):
            block[near] = count
            count += 1


def _asked(block: NDArray[np.int64]) -> NDArray[np.int64]:
    """Data of each block that are predicted, at most so many, evenly taken."""
    held = np.flatnonzero(block >= 0)
    held = held[np.argsort(block[held], kind="stable")]
    parts = np.split(held, np.flatnonzero(np.diff(block[held])) + 1)
    return np.concatenate([np.empty(0, np.int64), *(part[:: max(1, -(-len(part) // _ASKED))] for part in parts)])
