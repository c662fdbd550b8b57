"""Prediction of terrain heights, and their test on held-out blocks."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, map_coordinates
from scipy.spatial import cKDTree

from photoplan.events import Map
from photoplan.kernels.prediction import predict
from photoplan.surfaces.units import LineElement, Unit, between_data
from photoplan.terrain.covariance import Neighbours
from photoplan.terrain.fit import (
    REACH,
    HeldOut,
    Surroundings,
    TerrainFit,
    calibrate,
    choose,
    joined,
    lines_of,
    signal_share,
    unit_of,
)
from photoplan.terrain.observations import Observations, lines_apart, paraboloids, patches_at, quadtree

#: A prepared polygon builds its index when it is first asked, and GEOS does not guard that against other threads.
_ONE_AT_A_TIME = threading.Lock()

#: A wall closes this part of the spacing before its end.
_END = 0.005
#: Cells of the raster that says what is near data, at most; more area means larger cells.
_MOST_CELLS = 30_000_000


#: Part of the rounding error of heights that is left in a surface through several of them.
_ROUNDED = 1 / 3
#: Distance from a line at which the slope beside it is taken, in spacings.
_BESIDE = 0.2
#: Nearness of a line, see `_beside`, from which on second differences may cross it: 1.2 spacings.
_LINE_NEAR = 0.4
#: Cells that are looked at for the widest gaps.
_PLACES = 20_000


@dataclass(frozen=True, eq=False)
class Domain:
    """A raster of cells near data, and the polygon of border lines if there is one."""

    left: float
    top: float
    cell: float
    """Side of a cell, metres."""
    near: NDArray[np.bool_]
    """Cells near data, shape (rows, columns), row 0 in the north."""
    polygon: Any | None
    """Shapely polygon of the border lines in the same coordinates; None: there are none."""

    @classmethod
    def of(cls, xy: NDArray[np.float64], spacing: float, reach: float, polygon: Any | None) -> Domain:
        """Close the gaps between data (n, 2): what lies further than `reach` from data is outside, unless data surround
        it. The outline of the data is kept: it grows by one spacing only.
        """
        low, high = xy.min(axis=0), xy.max(axis=0)
        extent = high - low + 2 * reach
        cell = max(spacing, float(np.sqrt(extent[0] * extent[1] / _MOST_CELLS)))
        margin = int(np.ceil(reach / cell)) + 2
        columns, rows = (np.ceil((high - low) / cell).astype(int) + 1 + 2 * margin).tolist()
        left, top = low[0] - (margin + 0.5) * cell, high[1] + (margin + 0.5) * cell
        occupied = np.zeros((rows, columns), bool)
        occupied[((top - xy[:, 1]) / cell).astype(int), ((xy[:, 0] - left) / cell).astype(int)] = True
        grown = distance_transform_edt(~occupied) * cell <= reach
        closed = distance_transform_edt(grown) * cell > reach
        near = binary_dilation(closed | occupied, np.ones((3, 3), bool))
        if polygon is not None:
            shapely.prepare(polygon)
        return cls(left=float(left), top=float(top), cell=cell, near=near, polygon=polygon)

    def places(self) -> NDArray[np.float64]:
        """Middles of some cells that have a surface, shape (n, 2), evenly taken."""
        row, column = np.nonzero(self.near)
        step = max(1, len(row) // _PLACES)
        xy = np.column_stack([self.left + (column + 0.5) * self.cell, self.top - (row + 0.5) * self.cell])[::step]
        return np.asarray(xy[self.contains(xy)])

    def contains(self, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether places (n, 2) have a surface."""
        rows, columns = self.near.shape
        column = np.floor((xy[:, 0] - self.left) / self.cell).astype(int)
        row = np.floor((self.top - xy[:, 1]) / self.cell).astype(int)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        inside[inside] = self.near[row[inside], column[inside]]
        if self.polygon is not None and inside.any():
            with _ONE_AT_A_TIME:
                inside[inside] = shapely.contains_xy(self.polygon, xy[inside])
        return inside


def heights_at(
    fit: TerrainFit, unit: int, xy: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Predicted heights of places (n, 2) in or near a unit."""
    raw = raw_at(fit, unit, xy)
    # Residuals that are smaller than rounding do not show that the surface is better known.
    sigma = np.maximum(
        raw.sigma * fit.calibration.factor(raw.around), np.minimum(raw.sigma, _ROUNDED * fit.seen.rounding)
    )
    sigma = np.sqrt(sigma**2 + raw.lost)
    return raw.height, sigma, raw.around.distance * fit.seen.spacing


@dataclass(frozen=True, eq=False)
class Raw:
    """Prediction before its standard deviations are calibrated."""

    height: NDArray[np.float64]
    """Relative to the origin of the observations, shape (n,), metres; NaN: none."""
    sigma: NDArray[np.float64]
    """Standard deviation by the covariance functions, metres."""
    lost: NDArray[np.float64]
    """Variance of ground that the filter took for noise, m²."""
    around: Surroundings


def raw_at(fit: TerrainFit, unit: int, xy: NDArray[np.float64], chosen: bool = True) -> Raw:
    """Return what the covariance functions say at places (n, 2) in or near a unit."""
    sums = np.zeros((len(xy), 6))
    sums[:, 3] = np.inf
    low, high = xy.min(axis=0), xy.max(axis=0)
    some = _leaves_near(fit, unit, low, high)
    middle, half = fit.leaves.middle[some], fit.leaves.half[some]
    wanted, start = _targets(middle, REACH * half, xy)
    busy = np.diff(start) > 0
    some, middle, half = some[busy], middle[busy], half[busy]
    start = np.concatenate([[0], np.cumsum(np.diff(start)[busy])])
    if len(some):
        ids = fit.neighbours.query(middle)
        patches = patches_at(fit.leaves, some)
        lines = lines_of(fit, patches, ids)
        shares = fit.shares[some] if chosen else choose(fit, some)
        about = fit.squares, fit.lost, fit.usual
        predict(
            fit.seen.xyz, fit.noise, ids, patches, xy, wanted, start, *lines, fit.models(some), shares, *about, sums
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        height, sigma, rough = sums[:, 0] / sums[:, 1], sums[:, 2] / sums[:, 1], sums[:, 4] / sums[:, 1]
        lost = sums[:, 5] / sums[:, 1]
    sigma = np.sqrt(sigma**2 + _ground_at(fit, xy))
    around = Surroundings(signal_share(sigma, fit.whole.noise), sums[:, 3] / fit.seen.spacing, _beside(fit, xy), rough)
    return Raw(height, sigma, lost, around)


def _beside(fit: TerrainFit, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how near lines are, 1 to 0; 0 where there are only points, or only lines."""
    seen = fit.seen
    if not len(seen.xyz) > seen.points > 0:
        return np.zeros(len(xy))
    away = fit.neighbours.near[-1].tree.query(xy)[0] / seen.spacing
    return np.asarray(1 / (1 + away**2))


def _ground_at(fit: TerrainFit, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what may be ground, m², linear between the middles of units: else it would step at borders."""
    layout = fit.layout
    ground = fit.ground.reshape(layout.rows, layout.columns)
    column = (xy[:, 0] - layout.left) / layout.side - 0.5
    row = (layout.top - xy[:, 1]) / layout.side - 0.5
    found: NDArray[np.float64] = map_coordinates(ground, [row, column], order=1, mode="nearest")
    return found


def _leaves_near(fit: TerrainFit, unit: int, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.int64]:
    """Leaves of a unit and of the units beside it whose patches meet a rectangle."""
    columns, rows = fit.layout.columns, fit.layout.rows
    row, column = divmod(unit, columns)
    near = [
        fit.leaves.of_unit(r * columns + c)
        for r in range(max(0, row - 1), min(rows, row + 2))
        for c in range(max(0, column - 1), min(columns, column + 2))
    ]
    some = np.concatenate(near)
    reach = REACH * fit.leaves.half[some][:, None]
    middle = fit.leaves.middle[some]
    kept: NDArray[np.int64] = some[((middle + reach > low) & (middle - reach < high)).all(axis=1)]
    return kept


def _targets(
    middle: NDArray[np.float64], reach: NDArray[np.float64], xy: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Places inside each square, as numbers and beginnings."""
    order = np.argsort(xy[:, 1], kind="stable")
    y = xy[order, 1]
    first = np.searchsorted(y, middle[:, 1] - reach)
    last = np.searchsorted(y, middle[:, 1] + reach)
    found = []
    for k in range(len(middle)):
        band = order[first[k] : last[k]]
        found.append(band[np.abs(xy[band, 0] - middle[k, 0]) < reach[k]])
    sizes = [len(f) for f in found]
    return (np.concatenate(found) if found else np.empty(0, np.int64)), np.concatenate([[0], np.cumsum(sizes)])


def predict_unit(fit: TerrainFit, unit: int, domain: Domain, meshes: int, reach: float) -> Unit | None:
    """Posts of a unit, NaN outside the domain and far from data; None if there are none.

    Heights are relative to the origin of the observations; the unit's place is absolute.
    """
    row, column = divmod(unit, fit.layout.columns)
    left, top = fit.layout.corner(column, row)
    step = fit.layout.side / meshes
    k = np.arange(meshes + 1)
    x, y = np.meshgrid(left + k * step, top - k * step)
    xy = np.column_stack([x.ravel(), y.ravel()])
    inside = domain.contains(xy)
    if not inside.any():
        return None
    heights, sigmas = np.full(len(xy), np.nan), np.full(len(xy), np.nan)
    heights[inside], sigmas[inside], distance = heights_at(fit, unit, xy[inside])
    lines = np.where(_beside(fit, xy) > _LINE_NEAR, np.nan, heights).reshape(x.shape)
    between, power = between_data(lines, round(fit.seen.spacing / step))
    # At data nothing is between them; half a spacing away it is all.
    f = np.minimum(distance / fit.seen.spacing, 0.5)
    between = between.ravel()[inside] * (4 * f * (1 - f)) ** (power / 2)
    sigmas[inside] = np.fmax(sigmas[inside], between)
    far = np.flatnonzero(inside)[distance > reach]
    heights[far] = sigmas[far] = np.nan
    if not np.isfinite(heights).any():
        return None
    shape = (meshes + 1, meshes + 1)
    origin = fit.seen.origin
    return Unit(
        left=left + origin[0],
        top=top + origin[1],
        side=fit.layout.side,
        heights=heights.reshape(shape).astype(np.float32),
        sigmas=sigmas.reshape(shape).astype(np.float32),
        datum=float(origin[2]),
    )


def predict_lines(fit: TerrainFit, run: Map = map) -> list[LineElement]:
    """Lines with filtered heights: at each vertex of a breakline the mean of what its two sides say, of a wall each.

    Vertices that lines share have one height.
    """
    lines = fit.seen.lines
    count = len(lines.xyz)
    if not count:
        return []
    columns, rows = fit.layout.columns, fit.layout.rows
    column = np.clip(((lines.xyz[:, 0] - fit.layout.left) / fit.layout.side).astype(int), 0, columns - 1)
    row = np.clip(((fit.layout.top - lines.xyz[:, 1]) / fit.layout.side).astype(int), 0, rows - 1)
    unit = row * columns + column
    left, right = np.full((count, 2), np.nan), np.full((count, 2), np.nan)

    def one(some: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        xy, beside = lines.xyz[some, :2], lines.beside[some]
        heights, sigmas, _ = heights_at(fit, int(unit[some[0]]), np.vstack([xy + beside, xy - beside]))
        n = len(some)
        return np.column_stack([heights[:n], sigmas[:n]]), np.column_stack([heights[n:], sigmas[n:]])

    groups = [np.flatnonzero(unit == number) for number in np.unique(unit)]
    for some, sides in zip(groups, run(one, groups)):
        left[some], right[some] = sides
    return _elements(fit, left, right)


def with_chords(fit: TerrainFit, lines: list[LineElement], run: Map = map) -> list[LineElement]:
    """Return lines whose intersections with the grid have the representation error of the chords in their sigmas.

    Between two measured vertices a curved line leaves its chord by a quarter of its second differences at most, as a
    parabola. Across the line that is a height by the slopes of the ground on both sides.
    """

    def one(line: LineElement) -> LineElement:
        own = np.flatnonzero(~line.on_grid)
        if len(own) < 3 or len(own) == len(line.xyz) or line.kind == "border" or not np.isfinite(line.xyz).all():
            return line
        vertices = line.xyz[own]
        second = np.zeros((len(own), 3))
        second[1:-1] = np.diff(vertices, 2, axis=0)
        second[0], second[-1] = second[1], second[-2]
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line.xyz[:, :2], axis=0).T)))
        at = along[own]
        new = np.flatnonzero(line.on_grid)
        first = np.clip(np.searchsorted(at, along[new], side="right") - 1, 0, len(at) - 2)
        t = (along[new] - at[first]) / np.maximum(at[first + 1] - at[first], 1e-9)
        bend = second[first] + t[:, None] * (second[first + 1] - second[first])
        step = vertices[first + 1, :2] - vertices[first, :2]
        normal = np.column_stack([-step[:, 1], step[:, 0]]) / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
        steepness = _slopes(fit, line, new, normal)
        across = (bend[:, :2] * normal).sum(axis=1)
        chord = 0.5 * t * (1 - t) * np.hypot(bend[:, 2], steepness * across)
        sigmas = line.sigmas.copy()
        sigmas[new] = np.hypot(sigmas[new], chord)
        return replace(line, sigmas=sigmas)

    return list(run(one, lines))


def _slopes(fit: TerrainFit, line: LineElement, some: NDArray[np.int64], normal: NDArray[np.float64]) -> Any:
    """Root mean square of the slopes on both sides of a line at some of its vertices; 0 where there is no ground."""
    apart = _BESIDE * fit.seen.spacing
    origin = fit.seen.origin
    slopes = []
    for side in (1.0, -1.0):
        low = line.xyz[some, 2] if side > 0 or line.right is None else line.right[some]
        xy = line.xyz[some, :2] - origin[:2] + side * apart * normal
        unit = unit_of(xy, fit.layout)
        beside = np.full(len(some), np.nan)
        for number in np.unique(unit).tolist():
            beside[unit == number] = heights_at(fit, number, np.ascontiguousarray(xy[unit == number]))[0]
        slopes.append((beside + origin[2] - low) / apart)
    return np.sqrt((np.nan_to_num(np.stack(slopes)) ** 2).mean(axis=0))


def _elements(fit: TerrainFit, left: NDArray[np.float64], right: NDArray[np.float64]) -> list[LineElement]:
    lines = fit.seen.lines
    walls = np.concatenate([np.full(len(line.xyz), line.right is not None) for line in lines.lines])
    weight = 1 / np.maximum(np.stack([left[:, 1], right[:, 1]]), 1e-9) ** 2
    both = (weight * np.stack([left[:, 0], right[:, 0]])).sum(axis=0) / weight.sum(axis=0)
    sigma = (weight * np.stack([left[:, 1], right[:, 1]])).sum(axis=0) / weight.sum(axis=0)
    both = np.where(np.isfinite(both), both, lines.xyz[:, 2])
    both, sigma = _shared(lines.xyz[:, :2], both, sigma, ~walls)
    origin = fit.seen.origin
    found = []
    for k, line in enumerate(lines.lines):
        part = slice(lines.start[k], lines.start[k + 1])
        wall = line.right is not None
        heights = np.where(np.isfinite(left[part, 0]), left[part, 0], lines.xyz[part, 2]) if wall else both[part]
        other = np.where(np.isfinite(right[part, 0]), right[part, 0], lines.right[part]) if wall else None
        columns = np.column_stack(
            [
                line.xyz[:, :2],
                heights + origin[2],
                np.zeros(len(heights)) if other is None else other + origin[2],
                np.maximum(left[part, 1], right[part, 1]) if wall else sigma[part],
            ]
        )
        if wall:
            columns = _to_the_end(columns, _END * fit.seen.spacing)
        found.append(
            LineElement(
                name=line.name,
                kind=line.kind,
                code=line.code,
                xyz=columns[:, :3].copy(),
                right=columns[:, 3].copy() if wall else None,
                sigmas=columns[:, 4].copy(),
                on_grid=np.zeros(len(columns), bool),
            )
        )
    return found


def _to_the_end(rows: NDArray[np.float64], last: float) -> NDArray[np.float64]:
    """Rows of a wall, shape (n, c), with one more at a distance `last` before each end, linear between.

    At its end a wall has one height. It would close from its last vertex or grid line on.
    """
    length = np.hypot(*np.diff(rows[:, :2], axis=0).T)
    first, final = (min(last / max(side, 1e-9), 0.25) for side in (length[0], length[-1]))
    begin = rows[0] + (rows[1] - rows[0]) * first
    end = rows[-1] + (rows[-2] - rows[-1]) * final
    return np.vstack([rows[:1], begin, rows[1:-1], end, rows[-1:]])


def _shared(
    xy: NDArray[np.float64], heights: NDArray[np.float64], sigmas: NDArray[np.float64], free: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The mean at places that several lines share."""
    _, place = np.unique(xy, axis=0, return_inverse=True)
    place = place.ravel()
    use = free & np.isfinite(heights)
    number = np.bincount(place, use)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(place, np.where(use, heights, 0.0)) / number
        spread = np.bincount(place, np.where(use, sigmas, 0.0)) / number
    return np.where(use, mean[place], heights), np.where(use, spread[place], sigmas)


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
    """Return how much the ground bends at data: second derivatives of a paraboloid through the heights around, 1/m.

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
