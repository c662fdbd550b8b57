"""Heights and their standard deviations at the posts of units and along lines, by linear prediction."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, map_coordinates

from photoplan.events import Map
from photoplan.kernels.patch import predict
from photoplan.surfaces.representation import between_data
from photoplan.surfaces.units import LineElement, Unit
from photoplan.terrain.calibration import Surroundings, signal_share
from photoplan.terrain.fit import REACH, TerrainFit, choose, lines_of, unit_of
from photoplan.terrain.leaves import patches_at

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
        """Whether places (n, 2) have a surface."""
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
    """What the covariance functions say at places (n, 2) in or near a unit."""
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
    """How near lines are, 1 to 0; 0 where there are only points, or only lines."""
    seen = fit.seen
    if not len(seen.xyz) > seen.points > 0:
        return np.zeros(len(xy))
    away = fit.neighbours.near[-1].tree.query(xy)[0] / seen.spacing
    return np.asarray(1 / (1 + away**2))


def _ground_at(fit: TerrainFit, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """What may be ground, m², linear between the middles of units: else it would step at borders."""
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
