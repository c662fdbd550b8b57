"""What the report of a built terrain model shows: maps and samples, computed from the model in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import MapGrid
from photoplan.report.dtm.covariance import CovarianceTest, covariance_test
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.measured import MeasuredTerrain
from photoplan.surfaces.units import MemoryUnits
from photoplan.targets.map import MapTarget
from photoplan.terrain.build import Built

T = TypeVar("T", bound=np.generic)
#: Longer side of the map, pixels.
_SIDE = 900
#: Points of a class that are looked at, and normalised residuals that are kept.
_SAMPLE, _RESIDUALS = 100_000, 1_000_000
#: Vertices of all lines in the map at most.
_VERTICES = 400_000

#: Kinds of points and lines.
WORDS = {
    "mass": "mass points",
    "spot": "spot heights",
    "breakline": "breaklines",
    "formline": "form lines",
    "border": "border lines",
    "hole": "holes",
}


@dataclass(frozen=True, eq=False)
class ReportMap:
    """Heights and standard deviations of a model on the pixels of a small map."""

    left: float
    """X of the outer left edge, metres."""
    top: float
    """Y of the outer upper edge, metres."""
    resolution: float
    """Side of a pixel, metres."""
    heights: NDArray[np.float32]
    """Shape (rows, columns), row 0 in the north, metres; NaN: no surface."""
    sigmas: NDArray[np.float32]
    """Standard deviations, the same shape."""
    lines: tuple[tuple[str, NDArray[np.float64]], ...] = ()
    """Kind and vertices (n, 2) of lines, metres."""

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top, metres."""
        rows, columns = self.heights.shape
        return (self.left, self.left + columns * self.resolution, self.top - rows * self.resolution, self.top)


@dataclass(frozen=True, eq=False)
class FilterEffect:
    """Measured minus filtered heights of one class."""

    name: str
    """What the class is called."""
    count: int
    """Members of the class, of which `xy` may be a part."""
    sigma: float
    """Filter value, metres; NaN: differs within the class."""
    xy: NDArray[np.float64]
    """Places, shape (n, 2), metres."""
    differences: NDArray[np.float64]
    """Shape (n,), metres; NaN: no surface there."""


@dataclass(frozen=True)
class PlottedError:
    """A point that was left out, or a suspect."""

    name: str
    X: float
    Y: float
    height: float
    """As measured, metres."""
    difference: float
    """Measured height minus the model's, metres; NaN: no surface there."""
    normalised: float
    """Difference from what its neighbours predict, in standard deviations."""


@dataclass(frozen=True, eq=False)
class BuildSamples:
    """What the report shows beside the model's own figures: a map, and samples where there is much."""

    map: ReportMap
    normalised: NDArray[np.float64]
    """Normalised residuals of points that were used, or a sample of them."""
    spread: float
    """Of all of them; NaN: too few points."""
    covariance: CovarianceTest
    effects: tuple[FilterEffect, ...]
    gross: tuple[PlottedError, ...]
    suspects: tuple[PlottedError, ...]
    """Points that are used, but look like parts of gross errors."""


def samples_of(built: Built, measured: MeasuredTerrain) -> BuildSamples:
    """Computed from the model in memory: the same for the same model."""
    fit = built.fit
    surface = HybridSurface(MemoryUnits(built.plan.layout, built.units))
    z = fit.residuals[:, 2]
    used = z[(fit.noise[: fit.seen.points] >= 0) & np.isfinite(z)]
    return BuildSamples(
        map=_map(built, surface),
        normalised=_thin(used, _RESIDUALS),
        spread=float(used.std()) if len(used) >= 20 else np.nan,
        covariance=covariance_test(fit),
        effects=_effects(built, measured, surface),
        gross=_errors(built, measured, surface, fit.gross, fit.residuals[fit.gross]),
        suspects=_errors(built, measured, surface, fit.suspects[:, 0].astype(np.int64), fit.suspects[:, 2:]),
    )


def _map(built: Built, surface: HybridSurface) -> ReportMap:
    """The model on the pixels of a map that just holds its units."""
    layout = built.plan.layout
    rows, columns = zip(*((row, column) for column, row in built.units)) if built.units else ((0,), (0,))
    left, top = layout.corner(min(columns), min(rows))
    right, bottom = layout.corner(max(columns) + 1, max(rows) + 1)
    resolution = max(right - left, top - bottom) / _SIDE
    target = MapTarget(MapGrid.covering((left, bottom, right, top), resolution, None))
    grid = target.grid
    heights = np.full((grid.height, grid.width), np.nan, np.float32)
    sigmas = heights.copy()
    for part in grid.window.tiles(256):
        inside = np.s_[part.row : part.stop[1], part.col : part.stop[0]]
        heights[inside], sigmas[inside] = surface.relief_with_sigma(target, part)
    known = np.isfinite(heights)
    if known.any():
        # Units reach further than the model: the map ends where it does.
        row, column = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        kept = np.s_[row[0] : row[-1] + 1, column[0] : column[-1] + 1]
        heights, sigmas = heights[kept], sigmas[kept]
        left, top = grid.left + column[0] * resolution, grid.top - row[0] * resolution
    return ReportMap(
        left=left, top=top, resolution=resolution, heights=heights, sigmas=sigmas, lines=_lines(built, resolution)
    )


def _lines(built: Built, resolution: float) -> tuple[tuple[str, NDArray[np.float64]], ...]:
    """Lines for the map; where there are very many vertices, every so-manieth."""
    vertices = sum(len(line.xyz) for line in built.lines)
    step = max(1, -(-vertices // _VERTICES))
    drawn = []
    for line in built.lines:
        xy = line.xyz[:, :2]
        if step > 1 and np.ptp(xy, axis=0).max() < resolution:
            continue
        drawn.append((line.kind, np.vstack([xy[:-1:step], xy[-1:]])))
    return tuple(drawn)


def _thin(values: NDArray[T], most: int) -> NDArray[T]:
    """Evenly taken members, at most so many."""
    return values[:: max(1, -(-len(values) // most))]


def _effects(built: Built, measured: MeasuredTerrain, surface: HybridSurface) -> tuple[FilterEffect, ...]:
    """Measured minus filtered heights, by class."""
    fit, seen = built.fit, built.fit.seen
    kinds = np.array([group.kind for group in measured.points])[seen.group] if seen.points else np.empty(0, str)
    sigma = np.sqrt(np.maximum(fit.noise, 0.0))
    found = []
    for kind in ("mass", "spot"):
        some = np.flatnonzero((kinds == kind) & (fit.noise[: seen.points] >= 0))
        if not len(some):
            continue
        shown = _thin(some, _SAMPLE)
        xyz = seen.xyz[shown] + seen.origin
        d = xyz[:, 2] - surface.heights(xyz[:, :2])
        found.append(
            FilterEffect(name=WORDS[kind], count=len(some), sigma=_one(sigma[some]), xy=xyz[:, :2], differences=d)
        )
    return (*found, *_line_effects(built))


def _line_effects(built: Built) -> list[FilterEffect]:
    """The same for vertices of lines that have heights."""
    lines = built.plan.seen.lines
    origin = built.plan.seen.origin
    parts: dict[str, list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = {}
    for k, element in enumerate(built.lines):
        part = slice(lines.start[k], lines.start[k + 1])
        xyz = lines.xyz[part] + origin
        if not np.isfinite(xyz[:, 2]).all():
            continue
        # The element has further vertices on the grid's edges; along the line, both have one course.
        filtered = np.interp(_along(xyz), _along(element.xyz), element.xyz[:, 2])
        parts.setdefault(element.kind, []).append((xyz[:, :2], xyz[:, 2] - filtered))
    found = []
    known = _line_sigma(built)
    for kind in parts:
        xy, d = (np.concatenate(values) for values in zip(*parts[kind]))
        step = max(1, -(-len(d) // _SAMPLE))
        name = f"vertices of {WORDS[kind]}"
        found.append(
            FilterEffect(name=name, count=len(d), sigma=known.get(kind, np.nan), xy=xy[::step], differences=d[::step])
        )
    return found


def _line_sigma(built: Built) -> dict[str, float]:
    """Filter value of each class of lines, where it is one for all."""
    lines, settings = built.plan.seen.lines.lines, built.plan.settings
    found: dict[str, float] = {}
    for kind in {line.kind for line in lines}:
        given = {
            line.sigma if line.sigma is not None else settings.filters.get(kind) for line in lines if line.kind == kind
        }
        only = next(iter(given))
        found[kind] = float(only) if len(given) == 1 and only is not None else np.nan
    return found


def _along(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance along a line up to each vertex, as a part of the whole."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xyz[:, :2], axis=0).T))])
    return length / max(float(length[-1]), 1e-12)


def _one(sigma: NDArray[np.float64]) -> float:
    """The value, if all have the same; NaN otherwise."""
    return float(sigma[0]) if len(sigma) and np.ptp(sigma) <= 1e-9 * sigma[0] else np.nan


def _errors(
    built: Built,
    measured: MeasuredTerrain,
    surface: HybridSurface,
    some: NDArray[np.int64],
    residuals: NDArray[np.float64],
) -> tuple[PlottedError, ...]:
    if not len(some):
        return ()
    seen = built.fit.seen
    xyz = seen.xyz[some] + seen.origin
    difference = xyz[:, 2] - surface.heights(xyz[:, :2])
    names = [measured.points[seen.group[k]].label(int(seen.record[k])) for k in some.tolist()]
    return tuple(
        PlottedError(name=name, X=float(X), Y=float(Y), height=float(Z), difference=float(d), normalised=float(z))
        for name, (X, Y, Z), d, z in zip(names, xyz, difference, residuals[:, 2])
    )
