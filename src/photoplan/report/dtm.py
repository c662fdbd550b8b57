"""Reports of terrain models, profiles and contours."""

from __future__ import annotations

import itertools
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from photoplan.arrays import Floats, Floats32, Ints
from photoplan.errors import PhotoplanWarning, UsageError
from photoplan.geometry.crs import crs_label
from photoplan.geometry.grid import MapGrid
from photoplan.kernels.prediction import sides_of
from photoplan.products.dtm.build import BuildReport
from photoplan.products.dtm.lines import ContourFacts, Profile, Profiles
from photoplan.report.page import (
    BLUE,
    INK,
    PURPLE,
    RED,
    SKY,
    SOFT,
    Cell,
    axes_of,
    draw_normalised,
    figure,
    figure_of,
    headline,
    mpl,
    page,
    png,
    section,
    styled,
    table,
    text,
)
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.units import MeasuredTerrain, MemoryUnits
from photoplan.targets.map import MapTarget
from photoplan.terrain.build import BuildPlan, Built
from photoplan.terrain.clean import Finding
from photoplan.terrain.covariance import Covariance, near_lines
from photoplan.terrain.fit import ClassFigures, SigmaFactor, TerrainFit
from photoplan.terrain.observations import FAMILIES

#: Neighbourhoods that are looked at, points of each, and classes of distance.
_BLOCKS, _POINTS, _CLASSES = 160, 60, 14
#: So many times as many neighbourhoods are tried, since breaklines part some.
_ROUNDS = 8
#: Squared difference of side coordinates from which points lie on two sides of a breakline; 4 across its middle.
_PARTED = 0.4
#: Factor between measured and expected covariances that is told. One field of known covariance scatters by 1.4.
_DIFFER = 2.0
#: Argument at which (1 + t) exp(−t) is one half.
_MATERN_HALF = 1.6783469900166605


@dataclass(frozen=True, eq=False)
class CovarianceTest:
    """Covariance over distance: what was fitted, and what the data show."""

    distance: Floats
    """Shape (n,), metres, from 0."""
    whole: Floats
    """The function of the whole area, shape (n,), m²."""
    low: Floats
    """The tenth and the ninetieth of a hundred units at each distance, shape (n,), m²."""
    high: Floats
    classes: Floats
    """Mean distance of the pairs of each class, shape (k,), metres."""
    empirical: Floats
    """Mean product of the pairs' residuals from a plane, shape (k,), m²; NaN: no pairs."""
    expected: Floats
    """Expectations of these means by the fitted functions, shape (k,), m²."""
    pairs: Ints
    """Pairs in each class, shape (k,)."""

    noise: float = 0.0
    """Variance of the noise of mass points, m²: what is smaller cannot be told from it."""

    @property
    def ratio(self) -> float:
        """Factor by which the means are those expected, by least squares over all classes; NaN: no pairs."""
        known = np.isfinite(self.empirical) & np.isfinite(self.expected)
        weight = self.pairs[known] * self.expected[known]
        scale = float((weight * self.expected[known]).sum())
        return float((weight * self.empirical[known]).sum()) / scale if scale > 0 else np.nan

    @property
    def warning(self) -> str:
        """Return a warning if measured and expected covariances differ by more than chance and noise; else empty."""
        first = int(np.argmax(self.pairs > 0))
        measured, expected = float(self.empirical[first]), float(self.expected[first])
        if not abs(measured - expected) > self.noise / 2 or 1 / _DIFFER <= self.ratio <= _DIFFER:
            return ""
        return (
            f"the covariance of neighbouring points is {measured:.3g} m² where the fitted functions let expect "
            f"{expected:.3g} m²: they are fitted to predict points from their neighbours, but in gaps and at edges "
            f"standard deviations may be too {'large' if self.ratio < 1 else 'small'}"
        )


def correlation_at(family: str, t: Floats) -> Floats:
    """Correlation at distances in half-value distances: ½ at 1."""
    if family == "gaussian":
        return np.asarray(np.exp(-np.log(2) * t**2))
    if family == "matern":
        return np.asarray((1 + _MATERN_HALF * t) * np.exp(-_MATERN_HALF * t))
    return np.asarray(np.exp(-np.log(2) * t))


def covariance_test(fit: TerrainFit) -> CovarianceTest:
    """Fitted functions over distance, and the covariance of the points' heights above local planes.

    A plane through a neighbourhood takes a part of the signal with it. So the fitted functions are not compared with
    the products of residuals r = P z themselves, but their expectation is, P (C + N) Pᵀ. Neighbourhoods that
    breaklines part are left out: the functions let their two sides differ as they like, and it is the points of the
    line that tie them together.
    """
    reach = 4.0 * fit.whole.length
    distance = np.linspace(0.0, reach, 81)
    curves = np.array([_curve(unit, distance) for unit, m in zip(fit.units, fit.members) if len(m) >= 10])
    if not len(curves):
        curves = _curve(fit.whole, distance)[None]
    low, high = np.percentile(curves, [10, 90], axis=0)
    blocks = (_block(fit, leaf) for leaf in _leaves(fit))
    pairs = list(itertools.islice((block for block in blocks if len(block[0])), _BLOCKS))
    d, product, expected = (
        (np.concatenate([np.empty(0), *parts]) for parts in zip(*pairs)) if pairs else [np.empty(0)] * 3
    )
    edge = float(np.percentile(d, 90)) if len(d) else reach
    number = np.clip((d / edge * _CLASSES).astype(int), 0, _CLASSES)
    count = np.bincount(number, minlength=_CLASSES + 1)[:_CLASSES]

    def mean(values: Floats) -> Floats:
        with np.errstate(invalid="ignore"):
            return np.asarray(np.bincount(number, values, minlength=_CLASSES + 1)[:_CLASSES] / count)

    return CovarianceTest(
        distance=distance,
        whole=_curve(fit.whole, distance),
        low=low,
        high=high,
        classes=mean(d),
        empirical=mean(product),
        expected=mean(expected),
        pairs=count,
        noise=fit.whole.noise**2,
    )


def _curve(covariance: Covariance, distance: Floats) -> Floats:
    return covariance.variance * correlation_at(covariance.name, distance / covariance.length)


def _leaves(fit: TerrainFit) -> list[int]:
    """Leaves that hold points, in an order in which the first of them already cover the area evenly."""
    rich = np.flatnonzero(fit.leaves.count >= 3)
    step = max(1, -(-len(rich) // _BLOCKS))
    return [leaf for first in range(min(step, _ROUNDS)) for leaf in rich[first::step].tolist()]


def _block(fit: TerrainFit, leaf: int) -> tuple[Floats, Floats, Floats]:
    """Distances of all pairs of a neighbourhood's points, products of their residuals, and these products' means."""
    seen = fit.seen
    tree = fit.neighbours.near[0]
    near = np.atleast_1d(tree.tree.query(fit.leaves.middle[leaf], k=min(_POINTS, len(tree.numbers)))[1])
    some = tree.numbers[near]
    some = some[(some < seen.points) & (fit.noise[some] >= 0)]
    if len(some) < 8:
        return np.empty(0), np.empty(0), np.empty(0)
    xy = seen.xyz[some, :2]
    if _apart(fit, xy).max() > _PARTED:
        return np.empty(0), np.empty(0), np.empty(0)
    centred = xy - xy.mean(axis=0)
    plane = np.column_stack([np.ones(len(xy)), centred / max(float(np.abs(centred).max()), 1e-9)])
    q = np.linalg.qr(plane)[0]
    without = np.eye(len(xy)) - q @ q.T
    r = without @ (seen.xyz[some, 2] - seen.xyz[some, 2].mean())
    expected = without @ (_matrix(fit, leaf, xy) + np.diag(fit.noise[some])) @ without
    first, second = np.triu_indices(len(xy), 1)
    d = np.hypot(*(xy[first] - xy[second]).T)
    return d, r[first] * r[second], expected[first, second]


def _apart(fit: TerrainFit, xy: Floats) -> Floats:
    """Squared differences of the side coordinates of places (n, 2): not zero where breaklines part them."""
    vertices, start = near_lines(fit.seen, xy.min(axis=0), xy.max(axis=0))
    sides = np.zeros((len(xy), max(1, len(start) - 1)))
    if len(start) > 1:
        sides_of(np.ascontiguousarray(xy), vertices, start, len(start) - 1, sides)
    return np.asarray(((sides[:, None] - sides[None]) ** 2).sum(axis=2))


def _matrix(fit: TerrainFit, leaf: int, xy: Floats) -> Floats:
    """Covariances of the signal at places (n, 2), by the functions that the leaf's patch uses."""
    d2 = ((xy[:, None] - xy[None]) ** 2).sum(axis=2)
    apart = _apart(fit, xy)
    total = np.zeros_like(d2)
    for share, (family, variance, length, gap) in zip(fit.shares[leaf], fit.models(np.array([leaf]))[0]):
        t = np.sqrt(d2 / length**2 + apart * gap**2 / 4)
        total += share * variance * correlation_at(FAMILIES[int(family)], t)
    return total


MOST = 12
"""Profiles of one picture at most."""
_GROUND, _BAND = "#5b4a33", "#d9a441"


def profile_picture(profiles: Profiles) -> bytes:
    """A PNG: a panel for each profile, all in one scale."""
    if len(profiles) > MOST:
        raise UsageError(f"{len(profiles)} lines; a picture shows at most {MOST}: give fewer, or write a .csv alone")
    figure = mpl.figure.Figure(figsize=(10, 1.0 + 2.4 * len(profiles)), layout="constrained", dpi=110)
    axes = figure.subplots(len(profiles), 1, squeeze=False)[:, 0]
    span = max(high - low for low, high in map(_range, profiles))
    length = max(float(p.distance[-1]) for p in profiles)
    for panel, item in zip(axes, profiles):
        _panel(panel, item, span, length)
    axes[-1].set_xlabel("distance along the line [m]")
    # The layout decides how large the panels are, and so how much heights are exaggerated.
    figure.draw_without_rendering()
    for panel, item in zip(axes, profiles):
        box = panel.get_window_extent()
        factor = (box.height / (1.1 * span)) / (box.width / length)
        panel.set_title(f"{item.name}  (heights × {factor:.2g})", loc="left", fontsize=10)
    return png(figure, dpi=110)


def _panel(panel: Any, item: Profile, span: float, length: float) -> None:
    d, z, s = item.distance, item.heights, item.sigmas
    if np.isfinite(s).any():
        panel.fill_between(d, z - 2 * s, z + 2 * s, color=_BAND, alpha=0.5, linewidth=0, label="± 2 σ")
        panel.legend(loc="upper right", fontsize=8, frameon=False)
    panel.plot(d, z, color=_GROUND, linewidth=1.2)
    low, high = _range(item)
    middle = (low + high) / 2
    panel.set_ylim(middle - 0.55 * span, middle + 0.55 * span)
    panel.set_xlim(0, length)
    panel.set_ylabel("height [m]")
    panel.ticklabel_format(useOffset=False)
    panel.set_title(item.name, loc="left", fontsize=10)
    panel.grid(alpha=0.3)


def _range(item: Profile) -> tuple[float, float]:
    """Lowest and highest of all that is drawn, at least 0.1 m apart."""
    band = 2 * np.nan_to_num(item.sigmas)
    drawn = np.concatenate([item.heights - band, item.heights + band])
    drawn = drawn[np.isfinite(drawn)]
    if not drawn.size:
        return 0.0, 1.0
    low, high = float(drawn.min()), float(drawn.max())
    return (low, high) if high - low > 0.1 else (low - 0.05, high + 0.05)


def contours_picture(facts: ContourFacts) -> bytes:
    """Contours and their labels as PNG."""
    sketch = facts.sketch
    assert sketch is not None
    xmin, ymin, xmax, ymax = sketch.bounds
    inches = (xmax - xmin) / sketch.pixel / 100, (ymax - ymin) / sketch.pixel / 100
    figure = mpl.figure.Figure(figsize=(max(inches[0], 1), max(inches[1], 1)), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    for kind, colour, width in (("plain", "#a8763e", 0.5), ("low", "#4a78a8", 0.5), ("index", "#7a4a14", 1.1)):
        lines = mpl.collections.LineCollection(sketch.lines[kind], colors=colour, linewidths=width)
        axes.add_collection(lines)
    axes.set(xlim=(xmin, xmax), ylim=(ymin, ymax), aspect="equal")
    points = max(5.0, 72 / 100 * (facts.text_height or 1.0) / sketch.pixel)
    style = {"ha": "center", "va": "center", "size": points, "color": "#5a3208"}
    for label in facts.labels:
        box = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
        axes.text(label.X, label.Y, label.text, rotation=label.angle, bbox=box, **style)
    return png(figure, dpi=100, facecolor="white")


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
    heights: Floats32
    """Shape (rows, columns), row 0 in the north, metres; NaN: no surface."""
    sigmas: Floats32
    """Standard deviations, the same shape."""
    lines: tuple[tuple[str, Floats], ...] = ()
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
    """Name of the class."""
    count: int
    """Members of the class, of which `xy` may be a part."""
    sigma: float
    """Filter value, metres; NaN: differs within the class."""
    xy: Floats
    """Places, shape (n, 2), metres."""
    differences: Floats
    """Shape (n,), metres; NaN: no surface there."""


@dataclass(frozen=True)
class PlottedError:
    """A point that was left out, or a suspect."""

    name: str
    X: float
    Y: float
    height: float
    """Height as measured, metres."""
    difference: float
    """Measured height minus the model's, metres; NaN: no surface there."""
    normalised: float
    """Difference from what its neighbours predict, in standard deviations."""


@dataclass(frozen=True, eq=False)
class BuildSamples:
    """Contents of the report besides the model's own figures: a map, and samples if there is much."""

    map: ReportMap
    normalised: Floats
    """Normalised residuals of points that were used, or a sample of them."""
    spread: float
    """Spread of all of them; NaN if there are too few points."""
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


def _lines(built: Built, resolution: float) -> tuple[tuple[str, Floats], ...]:
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
    parts: dict[str, list[tuple[Floats, Floats]]] = {}
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


def _along(xyz: Floats) -> Floats:
    """Distance along a line up to each vertex, as a part of the whole."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xyz[:, :2], axis=0).T))])
    return length / max(float(length[-1]), 1e-12)


def _one(sigma: Floats) -> float:
    """The value, if all have the same; NaN otherwise."""
    return float(sigma[0]) if len(sigma) and np.ptp(sigma) <= 1e-9 * sigma[0] else np.nan


def _errors(
    built: Built, measured: MeasuredTerrain, surface: HybridSurface, some: Ints, residuals: Floats
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


LINE_COLOURS = {"breakline": "#7a1f00", "formline": PURPLE, "border": INK, "hole": INK}
_WIDTH = 7.2
#: Numbers in the map of gross errors.
_NUMBERED = 30
#: Points in a map at most.
_DOTS = 60_000


@styled
def draw_heights(area: ReportMap) -> bytes:
    """Heights as shaded tints, with lines."""
    fig, axes = _map_plots(area)
    low, high = _limits(area.heights, 0.5)
    norm = mpl.colors.Normalize(low, high)
    tints = _lighter("cividis")
    rgb = tints(norm(np.nan_to_num(area.heights, nan=low)))[..., :3] * _shade(area)[..., None]
    rgb[~np.isfinite(area.heights)] = 1.0
    axes.imshow(np.clip(rgb, 0, 1), extent=area.extent, interpolation="nearest")
    _lines_plots(axes, area)
    _bar(fig, axes, tints, norm, "height m")
    return png(fig)


@styled
def draw_sigmas(area: ReportMap) -> bytes:
    """Standard deviations."""
    fig, axes = _map_plots(area)
    low, high = _limits(area.sigmas, 1.0)
    norm = mpl.colors.Normalize(max(0.0, low), high)
    tints = mpl.colormaps["viridis_r"]
    axes.imshow(area.sigmas, extent=area.extent, cmap=tints, norm=norm, interpolation="nearest")
    _bar(fig, axes, tints, norm, "standard deviation m", extend="both")
    return png(fig)


@styled
def draw_covariance(facts: CovarianceTest) -> bytes:
    """Fitted functions, and the test by the covariance of residuals."""
    fig = figure_of(_WIDTH, 3.1)
    fitted, test = fig.subplots(1, 2)
    square = 1e4
    fitted.fill_between(
        facts.distance, facts.low * square, facts.high * square, color=SKY, alpha=0.4, linewidth=0, label="units"
    )
    fitted.plot(facts.distance, facts.whole * square, color=BLUE, linewidth=1.8, label="whole area")
    fitted.set(title="fitted functions", xlabel="distance m", ylabel="covariance cm²")
    fitted.set(xlim=(0, facts.distance[-1]), ylim=(0, None))
    fitted.legend(loc="upper right")
    known = facts.pairs > 0
    size = 12 + 40 * facts.pairs[known] / max(1, facts.pairs.max())
    test.axhline(0, color=SOFT, linewidth=0.8)
    test.plot(facts.classes[known], facts.expected[known] * square, color=BLUE, linewidth=1.8, label="expected")
    test.scatter(facts.classes[known], facts.empirical[known] * square, s=size, color=RED, zorder=3, label="measured")
    test.set(title="heights above local planes", xlabel="distance m", xlim=(0, None))
    test.legend(loc="upper right")
    return png(fig)


@styled
def draw_filter_histograms(effects: Sequence[FilterEffect]) -> bytes:
    """A histogram for each class, all in one scale."""
    columns = min(3, len(effects))
    rows = -(-len(effects) // columns)
    fig = figure_of(_WIDTH, 0.4 + 2.0 * rows)
    panels = fig.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    reach = 100 * _reach(effects)
    for panel, effect in zip(panels, effects):
        d = 100 * effect.differences[np.isfinite(effect.differences)]
        bins = np.linspace(-reach, reach, 51)
        weights = np.full(len(d), 100 / len(d))
        panel.hist(np.clip(d, -reach, reach), bins=bins, weights=weights, color=BLUE)
        panel.axvline(0, color=INK, linewidth=0.8)
        panel.set_title(effect.name)
        panel.set(xlabel="measured − filtered cm", xlim=(-reach, reach))
    for panel in panels[::columns]:
        panel.set_ylabel("share %")
    for panel in panels[len(effects) :]:
        panel.set_visible(False)
    return png(fig)


@styled
def draw_filter_map(effects: Sequence[FilterEffect], area: ReportMap) -> bytes:
    """Draw where heights were changed, and in which direction."""
    fig, axes = _map_plots(area)
    _grey_relief(axes, area)
    xy = np.concatenate([effect.xy for effect in effects])
    d = 100 * np.concatenate([effect.differences for effect in effects])
    step = max(1, -(-len(d) // _DOTS))
    known = np.flatnonzero(np.isfinite(d))[::step]
    reach = 100 * _reach(effects)
    norm = mpl.colors.Normalize(-reach, reach)
    tints = mpl.colormaps["RdBu"]
    size = float(np.clip(3e4 / max(1, len(known)), 0.6, 14))
    axes.scatter(*xy[known].T, c=d[known], cmap=tints, norm=norm, s=size, linewidths=0, rasterized=True, zorder=3)
    _bar(fig, axes, tints, norm, "measured − filtered cm", extend="both")
    return png(fig)


@styled
def draw_gross(errors: Sequence[PlottedError], suspects: Sequence[PlottedError], area: ReportMap) -> bytes:
    """Gross errors on the relief; those above the model point up, those below it down; suspects are circles."""
    fig, axes = _map_plots(area)
    _grey_relief(axes, area)
    xy = np.array([(error.X, error.Y) for error in errors]).reshape(-1, 2)
    up = np.array([error.normalised > 0 for error in errors], bool)
    for some, marker, colour, name in ((up, "^", RED, "too high"), (~up, "v", BLUE, "too low")):
        if some.any():
            axes.scatter(*xy[some].T, marker=marker, s=28, color=colour, edgecolor="white", linewidth=0.5, label=name)
    if suspects:
        places = np.array([(error.X, error.Y) for error in suspects])
        axes.scatter(*places.T, s=30, facecolor="none", edgecolor=PURPLE, linewidth=1.1, label="suspects")
    for k, (x, y) in enumerate(xy[:_NUMBERED], 1):
        axes.annotate(str(k), (x, y), (4, 3), textcoords="offset points", fontsize=7.5, color=INK, zorder=5)
    fig.legend(loc="outside lower center", ncols=3)
    return png(fig)


def _map_plots(area: ReportMap) -> tuple[Any, Any]:
    """A figure with one panel of the map's proportions and map coordinates along it."""
    left, right, bottom, top = area.extent
    ratio = (top - bottom) / (right - left)
    height = float(np.clip(5.9 * ratio, 2.2, 8.2)) + 0.7
    fig, axes = axes_of(_WIDTH, height)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="X m", ylabel="Y m")
    axes.grid(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(5, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(mpl.ticker.FuncFormatter(lambda v, _: f"{v:.12g}"))
    return fig, axes


def _bar(fig: Any, axes: Any, tints: Any, norm: Any, label: str, extend: str = "neither") -> None:
    colours = mpl.cm.ScalarMappable(norm, tints)
    bar = fig.colorbar(colours, ax=axes, shrink=0.8, aspect=28, pad=0.02, extend=extend)
    bar.set_label(label)
    bar.outline.set_visible(False)


def _lines_plots(axes: Any, area: ReportMap) -> None:
    for kind in sorted({kind for kind, _ in area.lines}):
        some = [xy for k, xy in area.lines if k == kind]
        dashes, colour = {"formline": "--", "hole": ":"}.get(kind, "-"), LINE_COLOURS.get(kind, INK)
        drawn = {"linewidths": 0.5, "linestyles": dashes, "label": WORDS.get(kind, kind)}
        axes.add_collection(mpl.collections.LineCollection(some, colors=colour, **drawn))
    if area.lines:
        axes.figure.legend(loc="outside lower center", ncols=4)


def _limits(values: Floats32, percent: float) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, [percent, 100 - percent])
    return float(low), float(max(high, low + 1e-6 * max(1.0, abs(low)) + 1e-4))


def _reach(effects: Sequence[FilterEffect]) -> float:
    """Difference that nearly all stay below, metres."""
    every = np.abs(np.concatenate([effect.differences for effect in effects]))
    return max(float(np.nanpercentile(every, 99.5)), 1e-4)


def _shade(area: ReportMap) -> Floats:
    """Brightness of the surface lit from the north-west at 45°, relative to level ground; 1 where it is unknown."""
    z = area.heights.astype(float)
    if min(z.shape) < 2:
        return np.ones(z.shape)
    low, high = _limits(area.heights, 0.5)
    # Flat land is exaggerated so that its forms show.
    size = np.hypot(*z.shape) * area.resolution
    factor = float(np.clip(0.05 * size / (high - low), 1.0, 8.0))
    south, east = np.gradient(z * factor, area.resolution)
    light = (1.0 + (east + south) * np.sqrt(0.5)) / np.sqrt(1.0 + east**2 + south**2)
    return np.nan_to_num(np.clip(0.35 + 0.65 * light, 0.25, 1.25), nan=1.0)


def _grey_relief(axes: Any, area: ReportMap) -> None:
    grey = np.clip(0.86 * _shade(area), 0, 1)
    grey[~np.isfinite(area.heights)] = 1.0
    axes.imshow(grey, extent=area.extent, cmap="gray", vmin=0, vmax=1, interpolation="nearest")


def _lighter(name: str) -> Any:
    """A colour map mixed with white, as a ground for shading and lines."""
    colours = mpl.colormaps[name](np.linspace(0, 1, 256))
    colours[:, :3] = 0.62 * colours[:, :3] + 0.38
    return mpl.colors.ListedColormap(colours)


#: Rows of a list at most: more are counted.
MOST_ROWS = 2000
#: Notes of one kind that are spelled out.
MOST_NOTES = 50


def build_report(model: BuildReport) -> str:
    """Return the report of a model; a covariance function that does not fit its points is warned of."""
    samples = samples_of(model.built, model.measured)
    if samples.covariance.warning:
        warnings.warn(f"warning: {samples.covariance.warning}", PhotoplanWarning, stacklevel=2)
    return build_page(model, model.inputs, samples)


def build_page(model: BuildReport, inputs: Sequence[Path], samples: BuildSamples) -> str:
    """The report as one HTML document without links to anything outside it.

    Names and texts are escaped; what they contain is shown and never obeyed.
    """
    parts = [
        headline(_headline(model, samples)),
        section("The surface", _surface(samples.map)),
        section("How well the model fits its points", _fit(model.built, samples)),
        section("What the filter did", _effect(samples)),
        section("Gross errors", _gross(model.built.plan.settings.gross, samples)),
        section("What was found in the measurements", _notes(model)),
        section("Inputs and settings", _record(model.built.plan, inputs)),
    ]
    return page(model.path.stem, _systems(model.measured), parts)


def _headline(model: BuildReport, samples: BuildSamples) -> list[tuple[str, str, str]]:
    """Figure, what it is, and what to compare it with."""
    built, whole = model.built, model.built.fit.whole
    counts = _counts(model.measured)
    points = sum(count for kind, count in counts if "point" in kind or "spot" in kind)
    lines = sum(count for _, count in counts) - points
    full = Counter(built.plan.layout.side / f.meshes for f in built.figures if f.meshes > 0)
    widths = ", ".join(f"{width:g} m in {_number(count)}" for width, count in sorted(full.items()))
    limit = built.plan.settings.gross
    return [
        (_number(points), "points", "; ".join(f"{kind} {_number(n)}" for kind, n in counts if n)),
        (_number(lines), "lines", "with their intersections with the grid"),
        (
            _number(full.total()),
            "computing units",
            f"{widths}; {_number(len(built.figures) - full.total())} units are empty",
        ),
        (_metres(built.sigma), "standard deviation of heights", "root mean square over the posts that data surround"),
        (_metres(whole.noise), "noise of mass points", "their filter value"),
        (
            f"{np.sqrt(whole.variance):.3g} m",
            "standard deviation of the signal",
            f"{whole.name} covariance function, half its value at {whole.length:.3g} m",
        ),
        (_plain(samples.spread, 2), "spread of normalised residuals", "1 where the stochastic model fits"),
        (
            _number(len(samples.gross)),
            "gross errors",
            "none were sought" if limit == 0 else f"beyond {limit:g} standard deviations, left out",
        ),
        (_time(model.figures["seconds"]), "to build the model", ""),
    ]


def _surface(area: ReportMap) -> list[str]:
    kinds = [WORDS.get(kind, kind) for kind in sorted({kind for kind, _ in area.lines})]
    return [
        figure(
            draw_heights(area),
            "Map of heights",
            f"Heights, shaded as if lit from the north-west. {'Lines: ' + ', '.join(kinds) + '. ' if kinds else ''}"
            "White: no surface, outside the border lines or too far from data.",
        ),
        figure(
            draw_sigmas(area),
            "Map of standard deviations",
            "Standard deviation of the predicted height. It grows where points are sparse and towards the edges.",
        ),
    ]


def _fit(built: Built, samples: BuildSamples) -> list[str]:
    return [
        figure(
            draw_normalised(samples.normalised, built.plan.settings.gross, "points"),
            "Histogram of normalised residuals",
            "Difference of each point from what its neighbours predict, in its standard deviations, beside the normal "
            "curve. A narrower histogram means that standard deviations are too large, a wider one that they are too "
            "small. The model's standard deviations follow the spread around each place, and what held-out blocks say.",
        ),
        figure(
            draw_covariance(samples.covariance),
            "Covariance functions",
            "Left: the fitted function of the whole area, and the range of eight in ten units. Right: covariance of "
            "the heights above a plane through each neighbourhood (dots), and what the fitted functions let expect of "
            "it after the same plane is taken away (line).",
        ),
        *([f"<p><strong>{text(samples.covariance.warning)}</strong></p>"] if samples.covariance.warning else []),
        *_held_out(built.fit.calibration, built.fit.seen.spacing),
    ]


def _held_out(found: SigmaFactor, spacing: float) -> list[str]:
    """Return what held-out blocks show of the standard deviations."""
    classes, bent = ([c for c in each if c.count] for each in (found.classes, found.bends))
    if not classes:
        return []
    parts = [f"{100 * (c.furthest - c.nearest):.0f} %" for c in bent]
    words = ("weakest", *("next" for _ in parts[2:]), "strongest")
    bends = [(f"{word} {part}", c) for word, part, c in zip(words, parts, bent)]
    return [
        "<p>Blocks of heights were held out and predicted from all others. Their errors, divided by the standard "
        "deviations, have this spread (1: standard deviations are right; more: they are too small):</p>",
        _classes("distance to data", [(_distances(c.nearest * spacing, c.furthest * spacing), c) for c in classes]),
        "<p>The same by curvature of the ground. Nothing is corrected by it: at edges and crests without lines, "
        "standard deviations may be too small.</p>",
        _classes("curvature", bends),
    ]


def _distances(nearest: float, furthest: float) -> str:
    return f"{nearest:.3g} to {furthest:.3g} m" if np.isfinite(furthest) else f"over {nearest:.3g} m"


def _classes(what: str, named: Sequence[tuple[str, ClassFigures]]) -> str:
    rows: list[list[str | Cell]] = []
    for where, c in named:
        after = f"{c.after:.2f}" if c.enough else "too few blocks"
        words = (_number(c.count), _number(c.blocks), f"{c.before:.2f}", after)
        rows.append([where, *(Cell(word, number=True) for word in words)])
    return table([what, "heights", "blocks", "as predicted", "as stated in the model"], rows)


def _effect(samples: BuildSamples) -> list[str]:
    effects = [effect for effect in samples.effects if np.isfinite(effect.differences).any()]
    if not effects:
        return ["<p>No point or line with heights lies on the surface.</p>"]
    rows = []
    for effect in samples.effects:
        d = effect.differences[np.isfinite(effect.differences)]
        figures = [_number(effect.count), _plain(effect.sigma)]
        if len(d):
            figures += [_plain(float(d.mean()), sign=True)]
            figures += [_plain(float(v)) for v in (np.sqrt((d**2).mean()), np.abs(d).max())]
        else:
            figures += ["–"] * 3
        row: list[str | Cell] = [effect.name, *(Cell(text, number=True) for text in figures)]
        rows.append(row)
    shown = sum(len(effect.differences) for effect in effects)
    every = sum(effect.count for effect in effects)
    sample = f" Shown are {_number(shown)} of {_number(every)} heights, evenly taken." if shown < every else ""
    return [
        table(["class", "number", "filter value m", "mean m", "root mean square m", "largest m"], rows),
        figure(
            draw_filter_histograms(effects),
            "Histograms of measured minus filtered heights",
            f"Measured minus filtered heights by class; gross errors are not among them.{sample}",
        ),
        figure(
            draw_filter_map(effects, samples.map),
            "Map of measured minus filtered heights",
            "Places of one colour that hang together are features that the filter took for noise, or errors of a whole "
            "series of measurements.",
        ),
    ]


def _gross(limit: float, samples: BuildSamples) -> list[str]:
    if not samples.gross and not samples.suspects:
        return ["<p>None were sought.</p>" if limit == 0 else "<p>None was found.</p>"]
    order = sorted(samples.gross, key=lambda g: -abs(g.normalised))
    parts = [
        figure(
            draw_gross(order, samples.suspects, samples.map),
            "Map of gross errors",
            "Where gross errors lie; the largest have the numbers of the list. Circles: suspects.",
        )
    ]
    if order:
        parts += [
            "<p>Points that contradict what their neighbours predict, alone or as a small group whose border breaks "
            "off all round. They were not used.</p>",
            *_errors_page(order),
        ]
    if samples.suspects:
        parts += [
            "<p>Suspects: small groups of points whose border breaks off in part, or that lie at the edge of the data. "
            "They were used; normalised residuals are those that each group has without itself. Is there a rock, a "
            "roof, a heap? Else take them out.</p>",
            *_errors_page(samples.suspects),
        ]
    return parts


def _errors_page(order: Sequence[PlottedError]) -> list[str]:
    rows: list[Sequence[str | Cell]] = [
        [
            Cell(str(k), number=True),
            g.name,
            *(Cell(text, number=True) for text in (f"{g.X:.2f}", f"{g.Y:.2f}", f"{g.height:.3f}")),
            Cell(_plain(g.difference, 3, sign=True), number=True),
            Cell(_plain(g.normalised, 1, sign=True), number=True),
        ]
        for k, g in enumerate(order[:MOST_ROWS], 1)
    ]
    parts = [table(["no.", "point", "X m", "Y m", "height m", "above the model m", "normalised residual"], rows)]
    if len(order) > MOST_ROWS:
        parts.append(f"<p>and {_number(len(order) - MOST_ROWS)} more.</p>")
    return parts


def _notes(model: BuildReport) -> list[str]:
    notes = (*(Finding("while reading", note) for note in model.measured.notes), *model.findings)
    if not notes:
        return ["<p>Nothing: lines meet in common points, no two points coincide.</p>"]
    rows: list[Sequence[str | Cell]] = []
    for kind in dict.fromkeys(note.kind for note in notes):
        some = [note for note in notes if note.kind == kind]
        for k, note in enumerate(some[:MOST_NOTES]):
            place = f"{note.X:.2f}, {note.Y:.2f}" if np.isfinite([note.X, note.Y]).all() else ""
            rows.append([kind if k == 0 else "", note.text, Cell(place, number=True)])
        if len(some) > MOST_NOTES:
            rows.append(["", f"and {_number(len(some) - MOST_NOTES)} more of this kind", ""])
    return [table(["kind", "finding", "X, Y m"], rows)]


def _record(plan: BuildPlan, inputs: Sequence[Path]) -> list[str]:
    return [
        table(["input", ""], [[path.name, _size(path)] for path in inputs]),
        table(["setting", "value"], _settings(plan)),
    ]


def _systems(measured: MeasuredTerrain) -> str:
    plan = "CRS not stated" if measured.crs is None else crs_label(measured.crs)
    return f"{plan}; heights: {measured.height_system or 'system not stated'}"


def _counts(measured: MeasuredTerrain) -> tuple[tuple[str, int], ...]:
    points: Counter[str] = Counter()
    for group in measured.points:
        points[group.kind] += len(group.xyz)
    lines = Counter(line.kind for line in measured.lines)
    return tuple((word, points.get(kind, 0) + lines.get(kind, 0)) for kind, word in WORDS.items())  # type: ignore[call-overload]


def _size(path: Path) -> str:
    """Size and folder of a file."""
    try:
        size = f"{path.stat().st_size / 1e6:.3g} MB, in "
    except OSError:
        size = "in "
    return f"{size}{path.absolute().parent}"


def _settings(plan: BuildPlan) -> list[list[str | Cell]]:
    settings = plan.settings
    given = settings.filters
    finer = f", {plan.finest:g} m where breaklines pass" if plan.finest < plan.width else ""
    own = "" if settings.grid_width else " (from the spacing of the points)"
    adapt = "a quarter of each unit's standard deviation" if settings.adapt is None else f"{settings.adapt:g} m"
    return [
        ["grid width", f"{plan.width:g} m{finer}{own}"],
        ["computing units", f"{plan.layout.side:g} m along a side: {settings.unit_meshes} grid widths"],
        ["grids widened within", "no, all have the finest width" if settings.adapt == 0 else adapt],
        ["covariance family", f"{settings.family}" + (" (the likeliest)" if settings.family == "auto" else "")],
        ["filter values", ", ".join(f"{WORDS[k]} {v:g} m" for k, v in given.items()) or "estimated from the data"],
        ["gross errors", f"beyond {settings.gross:g} standard deviations" if settings.gross else "not sought"],
        ["gaps bridged up to", f"{2 * plan.reach:.4g} m"],
        ["spacing of the points", f"{plan.seen.spacing:.3g} m"],
    ]


def _number(value: int) -> str:
    """With thin spaces between thousands."""
    return f"{value:,}".replace(",", "\u202f")


def _metres(value: float) -> str:
    return f"{value:.3f} m" if np.isfinite(value) else "–"


def _plain(value: float, digits: int = 3, sign: bool = False) -> str:
    if not np.isfinite(value):
        return "–"
    return (f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}").replace("-", "−")


def _time(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    return f"{int(seconds // 60)} min {seconds % 60:.0f} s"
