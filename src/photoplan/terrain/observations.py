"""Observations of terrain, and the settings of building a model from them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photoplan.errors import GeometryError, UsageError
from photoplan.surfaces.units import LINE_KINDS, POINT_KINDS, MeasuredLine, MeasuredTerrain, UnitLayout

Family = Literal["gaussian", "matern", "exponential"]
FAMILIES: tuple[Family, ...] = get_args(Family)
"""Families of covariance functions; the place of each is its number in the kernels."""

#: Filter values of classes that are not given, as parts of that of mass points: lines and spots are measured with care.
SHARE = {"mass": 1.0, "spot": 0.25, "breakline": 0.25, "formline": 0.25, "border": 0.25, "hole": 0.25}


@dataclass(frozen=True)
class BuildSettings:
    """All that decides a model beside its data."""

    grid_width: float | None = None
    """Finest side of a mesh, metres; None: from the density of the points, and half of that beside breaklines."""
    unit_meshes: int = 64
    """Meshes of the finest width along the side of a computing unit; a power of two."""
    adapt: float | None = None
    """A unit's grid is widened while its surface stays within this, metres; 0: all units have the finest width;
    None: a quarter of the unit's mean standard deviation."""
    family: Family | Literal["auto"] = "auto"
    """Family of the covariance function; auto: the one that predicts the points best from each other."""
    filters: dict[str, float] = field(default_factory=dict)
    """Filter value (standard deviation of measurement, metres) by class of points or lines. Mass points that have none
    are estimated from the data, other classes take their share (`SHARE`) of it. Where all mass points have one, what
    the ground adds to it is estimated; zero stays zero."""
    gross: float = 5.0
    """Normalised residual beyond which a point is a gross error and left out; 0: none is sought."""
    reach: float | None = None
    """Gaps wider than twice this are not bridged, metres; None: ten times the spacing of the points."""

    def __post_init__(self) -> None:
        for name in ("grid_width", "reach"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise UsageError(f"{name.replace('_', ' ')} {value}; a positive number of metres is needed")
        if self.adapt is not None and not (np.isfinite(self.adapt) and self.adapt >= 0):
            raise UsageError(f"adapt {self.adapt}; a tolerance in metres, zero or more, is needed")
        if not 4 <= self.unit_meshes <= 1024 or self.unit_meshes & (self.unit_meshes - 1):
            raise UsageError(f"units of {self.unit_meshes} meshes; a power of two from 4 to 1024 is needed")
        if self.family != "auto" and self.family not in FAMILIES:
            raise UsageError(f"covariance family {self.family!r}; families are auto, {', '.join(FAMILIES)}")
        for kind, sigma in self.filters.items():
            if kind not in (*POINT_KINDS, *LINE_KINDS):
                raise UsageError(f"filter value for {kind!r}; classes are {', '.join((*POINT_KINDS, *LINE_KINDS))}")
            if not (np.isfinite(sigma) and sigma >= 0):
                raise UsageError(f"filter value {sigma} for {kind}; metres, zero or more, are needed")
        if not (np.isfinite(self.gross) and self.gross >= 0):
            raise UsageError(f"limit of gross errors {self.gross}; zero or more is needed")


def paraboloids(step: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Design matrices of z = a + b x + c y + d x²/2 + e x y + f y²/2, with x and y in units of the widest step.

    The coefficients are the height, the slopes and the second derivatives at the place: divide slopes by the unit and
    second derivatives by its square.
    """
    unit = np.abs(step).max(axis=(1, 2))
    unit = np.where(unit > 0, unit, 1.0)
    x, y = np.moveaxis(step / unit[:, None, None], 2, 0)
    return np.stack([np.ones_like(x), x, y, x**2 / 2, x * y, y**2 / 2], axis=2), unit


#: Points at which the spacing is measured.
_SAMPLE = 20_000
#: Neighbours among which another line is looked for.
_NEAR = 48
#: Copies of a breakline's points lie this part of the spacing beside it, one on each side.
_BESIDE = 1e-6


@dataclass(frozen=True, eq=False)
class TerrainLines:
    """Vertices of all lines in one array; the lines that separate their two sides come first."""

    xyz: NDArray[np.float64]
    """Vertices, shape (v, 3), relative to the origin; Z may be NaN in borders."""
    right: NDArray[np.float64]
    """Heights on the right, shape (v,); equal to Z but at two-sided breaklines."""
    start: NDArray[np.int64]
    """First vertex of each line, and v; shape (l + 1,)."""
    separating: int
    """Number of breaklines."""
    lines: tuple[MeasuredLine, ...]
    """The lines themselves, in this order."""
    beside: NDArray[np.float64]
    """Steps from each vertex to the left of its line, shape (v, 2), metres; zero at lines that do not separate."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Heights with their variances: points first, then the points of lines, those of breaklines once on each side."""

    origin: NDArray[np.float64]
    """X, Y, Z that all coordinates are relative to."""
    xyz: NDArray[np.float64]
    """Data, shape (n, 3), metres."""
    points: int
    """Number of mass points and spot heights among them."""
    parts: NDArray[np.float64]
    """Variance of each datum = the first column (m²) + the second · the variance of mass points, shape (n, 2)."""
    known_noise: float | None
    """Standard deviation of mass points where that of each is known, the root of the mean square, metres; None: else.

    What is known is the accuracy of measuring. Stubble and stones, which neighbours do not share either, come on top
    of it: the variance of mass points is that of both, and not below what is known.
    """
    group: NDArray[np.int32]
    """Group of each point, shape (points,)."""
    record: NDArray[np.int64]
    """Place of each point in its group, shape (points,)."""
    line: NDArray[np.int64]
    """Number of the form line that each datum is of, −1: of none, shape (n,)."""
    lines: TerrainLines
    barriers: tuple[NDArray[np.float64], NDArray[np.int64]]
    """Vertices (v, 2) and beginnings of breaklines, cut so that no piece turns far."""
    barrier_boxes: NDArray[np.float64]
    """xmin, ymin, xmax, ymax of each of these pieces."""
    spacing: float
    """Side of the square that one point has to itself on average, metres."""

    @cached_property
    def rounding(self) -> float:
        """Standard deviation of rounding where all heights are whole millimetres, metres; else 0."""
        Z = self.xyz[: self.points, 2] * 1000
        whole = len(Z) > 0 and bool((np.abs(Z - np.rint(Z)) < 1e-3).all())
        return 0.001 / np.sqrt(12) if whole else 0.0

    def noise(self, mass: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variances of all data, shape (n,), m², from the standard deviation of mass points at each of them."""
        return np.maximum(self.parts[:, 0] + self.parts[:, 1] * mass**2, 0.0)


def told_by(seen: Observations) -> Observations:
    """The data from which covariance functions are estimated: the points, or form lines where these are most of all.

    Points along a form line say nothing of the ground between lines: they are taken as far apart as lines are.
    """
    some = np.flatnonzero(seen.line >= 0)
    if len(some) <= seen.points:
        return seen
    _, first = np.unique(np.floor(seen.xyz[some, :2] / lines_apart(seen)), axis=0, return_index=True)
    kept = np.concatenate([np.arange(seen.points), some[np.sort(first)]])
    if len(kept) - seen.points <= seen.points:
        return seen
    return replace(seen, xyz=seen.xyz[kept], points=len(kept), parts=seen.parts[kept], line=seen.line[kept])


def lines_apart(seen: Observations) -> float:
    """Distance from a point of a form line to the nearest one of another, the median, metres."""
    every = np.flatnonzero(seen.line >= 0)
    xy, line = seen.xyz[every, :2], seen.line[every]
    some = np.arange(0, len(xy), max(1, len(xy) // _SAMPLE))
    distance, near = cKDTree(xy).query(xy[some], k=min(_NEAR, len(xy)))
    other = line[near] != line[some, None]
    other[:, -1] = True
    return max(float(np.median(distance[np.arange(len(some)), other.argmax(axis=1)])), 1e-6)


def _variances(
    given: NDArray[np.float64], share: NDArray[np.float64], points: int
) -> tuple[NDArray[np.float64], float | None]:
    """Variances as `Observations.parts` has them, and the known noise of mass points."""
    unknown = np.isnan(given)
    fixed, factor = np.where(unknown, 0.0, given) ** 2, np.where(unknown, share, 0.0) ** 2
    mass = given[:points][share[:points] == 1]
    if not len(mass) or np.isnan(mass).any():
        return np.column_stack([fixed, factor]), None
    noise = float(np.sqrt(np.mean(mass**2)))
    if noise > 0:  # a point of noise zero is to be met
        ground = np.flatnonzero(given[:points] > 0)
        factor[ground] = share[ground] ** 2
        fixed[ground] -= factor[ground] * noise**2
    return np.column_stack([fixed, factor]), noise


def observe(measured: MeasuredTerrain, settings: BuildSettings) -> Observations:
    """Arrays of clean measurements."""
    lines = [line for line in measured.lines if line.kind == "breakline"]
    others = [line for line in measured.lines if line.kind != "breakline"]
    stacks = [group.xyz for group in measured.points] + [line.xyz for line in lines + others]
    if not stacks:
        raise GeometryError("no points and no lines; a terrain model needs at least three points")
    everything = np.vstack(stacks)
    heights = everything[np.isfinite(everything[:, 2])]
    _check_rank(heights)
    origin = np.array([*np.floor(everything[:, :2].mean(axis=0)), np.floor(heights[:, 2].mean())])
    points = np.vstack([np.empty((0, 3)), *(group.xyz for group in measured.points)]) - origin
    known = np.unique(heights[:, :2] - origin[:2], axis=0)
    spacing = spacing_of(known)
    table = _line_table(lines, others, origin, spacing)
    data, given, share, number = _line_data(table, spacing, settings)
    group_given = [_sigma(g.sigma, settings.filters.get(g.kind)) for g in measured.points]
    sizes = [len(g.xyz) for g in measured.points]
    barriers = _straight_pieces(table.xyz[: table.start[table.separating], :2], table.start[: table.separating + 1])
    known = np.concatenate([np.repeat(group_given, sizes), given])
    shares = np.concatenate([np.repeat([SHARE[g.kind] for g in measured.points], sizes), share])
    parts, known_noise = _variances(known, shares, len(points))
    return Observations(
        origin=origin,
        xyz=np.vstack([points, data]),
        points=len(points),
        parts=parts,
        known_noise=known_noise,
        group=np.repeat(np.arange(len(sizes), dtype=np.int32), sizes),
        record=np.concatenate([np.arange(n) for n in sizes]) if sizes else np.empty(0, np.int64),
        line=np.concatenate([np.full(len(points), -1), number]),
        lines=table,
        barriers=barriers,
        barrier_boxes=_boxes(*barriers),
        spacing=spacing,
    )


def spacing_of(xy: NDArray[np.float64]) -> float:
    """Side of the square that one of the points has to itself, metres: from the sixth neighbour, the median."""
    neighbours = min(7, len(xy))
    step = max(1, len(xy) // _SAMPLE)
    distance = cKDTree(xy).query(xy[::step], k=[neighbours])[0]
    return float(np.median(distance) * np.sqrt(np.pi / max(1, neighbours - 1)))


def _check_rank(xyz: NDArray[np.float64]) -> None:
    if len(xyz) < 3:
        raise GeometryError(f"{len(xyz)} points with heights; a terrain model needs at least three")
    centred = xyz[:, :2] - xyz[:, :2].mean(axis=0)
    extent = np.linalg.svd(centred.T @ centred, compute_uv=False)
    if extent[1] <= 1e-12 * extent[0]:
        raise GeometryError("all points lie on one line: the slope across it is unknown; add points beside it")


def _sigma(own: float | None, of_class: float | None) -> float:
    value = own if own is not None else of_class
    return np.nan if value is None else float(value)


def _line_table(
    lines: list[MeasuredLine], others: list[MeasuredLine], origin: NDArray[np.float64], spacing: float
) -> TerrainLines:
    ordered = lines + others
    xyz = np.vstack([np.empty((0, 3)), *(line.xyz for line in ordered)]) - origin
    right = np.concatenate([np.empty(0), *(line.xyz[:, 2] if line.right is None else line.right for line in ordered)])
    start = np.concatenate([[0], np.cumsum([len(line.xyz) for line in ordered])]).astype(np.int64)
    beside = np.zeros((len(xyz), 2))
    for k in range(len(lines)):
        part = slice(start[k], start[k + 1])
        beside[part] = _left_of(xyz[part, :2]) * spacing * _BESIDE
    return TerrainLines(
        xyz=xyz, right=right - origin[2], start=start, separating=len(lines), lines=tuple(ordered), beside=beside
    )


def _left_of(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit steps to the left of a polyline at its vertices, along the bisector."""
    step = np.diff(xy, axis=0)
    step /= np.maximum(np.linalg.norm(step, axis=1), 1e-12)[:, None]
    closed = len(xy) > 3 and np.array_equal(xy[0], xy[-1])
    before = np.vstack([step[-1:] if closed else step[:1], step])
    after = np.vstack([step, step[:1] if closed else step[-1:]])
    left = np.stack([-(before + after)[:, 1], (before + after)[:, 0]], axis=1)
    size = np.linalg.norm(left, axis=1)
    # Where a line turns back on itself, straight ahead is between its two sides.
    left = np.where(size[:, None] < 1e-6, before, left)
    return left / np.maximum(np.linalg.norm(left, axis=1), 1e-12)[:, None]


def _line_data(
    table: TerrainLines, spacing: float, settings: BuildSettings
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Points along lines at most a spacing apart with their known standard deviations, shares and form lines."""
    xyz, given, share, number = [np.empty((0, 3))], [np.empty(0)], [np.empty(0)], [np.empty(0, np.int64)]
    for k, line in enumerate(table.lines):
        part = slice(table.start[k], table.start[k + 1])
        if not np.isfinite(table.xyz[part, 2]).all():
            continue
        columns = np.column_stack([table.xyz[part], table.right[part], table.beside[part]])
        dense = _densify(columns, spacing)
        sides = [dense[:, :3]]
        if k < table.separating:
            left, right = dense[:, :3].copy(), dense[:, [0, 1, 3]].copy()
            left[:, :2] += dense[:, 4:]
            right[:, :2] -= dense[:, 4:]
            sides = [left, right]
        for side in sides:
            xyz.append(side)
            given.append(np.full(len(side), _sigma(line.sigma, settings.filters.get(line.kind))))
            share.append(np.full(len(side), SHARE[line.kind]))
            number.append(np.full(len(side), k if line.kind == "formline" else -1))
    return np.vstack(xyz), np.concatenate(given), np.concatenate(share), np.concatenate(number)


def _densify(rows: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Rows between the vertices of a line, so that no two are further apart than `spacing`."""
    length = np.linalg.norm(np.diff(rows[:, :2], axis=0), axis=1)
    count = np.maximum(1, np.ceil(length / spacing).astype(int))
    segment = np.repeat(np.arange(len(length)), count)
    t = (np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)) / count[segment]
    between = rows[segment] + (rows[segment + 1] - rows[segment]) * t[:, None]
    # Between vertices the line's own direction says where its sides are; the bisectors only hold at vertices.
    step = np.diff(rows[:, :2], axis=0) / np.maximum(length, 1e-12)[:, None]
    size = np.linalg.norm(rows[0, 4:])
    inner = t > 0
    between[inner, 4] = -step[segment[inner], 1] * size
    between[inner, 5] = step[segment[inner], 0] * size
    return np.vstack([between, rows[-1:]])


def _straight_pieces(
    xy: NDArray[np.float64], start: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Lines cut where they have turned by a right angle from where they began: no piece winds around a point."""
    vertices: list[NDArray[np.float64]] = []
    for first, last in itertools.pairwise(start):
        line = xy[first:last]
        step = np.diff(line, axis=0)
        heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
        begin = 0
        for k in range(1, len(heading)):
            if abs(heading[k] - heading[begin]) > np.pi / 2:
                vertices.append(line[begin : k + 1])
                begin = k
        vertices.append(line[begin:])
    sizes = [len(v) for v in vertices]
    return (np.vstack([np.empty((0, 2)), *vertices]), np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64))


def _boxes(xy: NDArray[np.float64], start: NDArray[np.int64]) -> NDArray[np.float64]:
    if len(start) < 2:
        return np.empty((0, 4))
    low, high = np.minimum.reduceat(xy, start[:-1]), np.maximum.reduceat(xy, start[:-1])
    return np.concatenate([low, high], axis=1)


#: Points that a leaf holds at most.
CAPACITY = 24
#: A leaf is not smaller than this many meshes.
_SMALLEST = 2


@dataclass(frozen=True, eq=False)
class Leaves:
    """Squares that cover all units, sorted by unit."""

    middle: NDArray[np.float64]
    """X, Y of the middles, shape (n, 2), in the coordinates that were given."""
    half: NDArray[np.float64]
    """Half sides, shape (n,), metres."""
    unit: NDArray[np.int64]
    """Number of each leaf's unit, row · columns + column, shape (n,)."""
    count: NDArray[np.int64]
    """Points inside, shape (n,)."""
    order: NDArray[np.int64]
    """Points in the order of leaves, shape (p,)."""
    first: NDArray[np.int64]
    """Points of leaf i are order[first[i]:first[i] + count[i]]."""

    def of_unit(self, unit: int) -> NDArray[np.int64]:
        """Leaves of a unit."""
        return np.arange(np.searchsorted(self.unit, unit), np.searchsorted(self.unit, unit, side="right"))


def quadtree(xy: NDArray[np.float64], layout: UnitLayout, meshes: int) -> Leaves:
    """Quarter each unit until a leaf holds at most `CAPACITY` points or is two meshes wide."""
    deepest = max(0, int(np.log2(meshes / _SMALLEST)))
    place = np.stack([xy[:, 0] - layout.left, layout.top - xy[:, 1]], axis=1) / layout.side
    column = np.clip(place[:, 0].astype(np.int64), 0, layout.columns - 1)
    row = np.clip(place[:, 1].astype(np.int64), 0, layout.rows - 1)
    inside = np.clip(((place - np.stack([column, row], axis=1)) * 2**deepest).astype(np.int64), 0, 2**deepest - 1)
    key = (row * layout.columns + column) << (2 * deepest) | _interleave(inside)
    order = np.argsort(key, kind="stable")
    key = key[order]
    cells = np.arange(layout.columns * layout.rows, dtype=np.int64)
    found: list[tuple[NDArray[np.int64], int]] = []
    for level in range(deepest + 1):
        shift = 2 * (deepest - level)
        count = np.searchsorted(key, (cells + 1) << shift) - np.searchsorted(key, cells << shift)
        split = (count > CAPACITY) & (level < deepest)
        found.append((cells[~split], level))
        cells = (cells[split, None] << 2 | np.arange(4)).ravel()
    code = np.concatenate([c << (2 * (deepest - level)) for c, level in found])
    levels = np.concatenate([np.full(len(c), level) for c, level in found])
    sort = np.argsort(code)
    code, levels = code[sort], levels[sort]
    first = np.searchsorted(key, code)
    count = np.searchsorted(key, code + (np.int64(1) << (2 * (deepest - levels)))) - first
    unit = code >> (2 * deepest)
    half = layout.side / 2.0 ** (levels + 1)
    corner = _separate(code & ((1 << (2 * deepest)) - 1)) * (layout.side / 2**deepest)
    x = layout.left + (unit % layout.columns) * layout.side + corner[:, 0] + half
    y = layout.top - (unit // layout.columns) * layout.side - corner[:, 1] - half
    return Leaves(middle=np.stack([x, y], axis=1), half=half, unit=unit, count=count, order=order, first=first)


def _interleave(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Column and row (n, 2) to one number whose bits alternate, so that quarters are ranges."""
    code = np.zeros(len(cells), np.int64)
    for bit in range(12):
        code |= ((cells[:, 0] >> bit) & 1) << (2 * bit) | ((cells[:, 1] >> bit) & 1) << (2 * bit + 1)
    return code


def _separate(code: NDArray[np.int64]) -> NDArray[np.int64]:
    """Inverse of `_interleave`."""
    cells = np.zeros((len(code), 2), np.int64)
    for bit in range(12):
        cells[:, 0] |= ((code >> (2 * bit)) & 1) << bit
        cells[:, 1] |= ((code >> (2 * bit + 1)) & 1) << bit
    return cells


def patches_at(leaves: Leaves, some: NDArray[np.int64]) -> NDArray[np.float64]:
    """Middle and half side of leaves, shape (n, 3)."""
    return np.column_stack([leaves.middle[some], leaves.half[some]])
