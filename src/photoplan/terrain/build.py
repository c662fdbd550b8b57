"""A hybrid terrain model from measurements: from the stochastic model to units with their triangles."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from photoplan.errors import InputError
from photoplan.events import SILENT, Events, Map
from photoplan.surfaces.mesh import build_faces, on_grid, thin
from photoplan.surfaces.units import LineElement, MeasuredTerrain, MeshFaces, Unit, UnitFigures, UnitLayout
from photoplan.terrain.clean import domain_of
from photoplan.terrain.fit import TerrainFit, fit
from photoplan.terrain.observations import BuildSettings, Observations, observe
from photoplan.terrain.predict import Domain, calibrated, predict_lines, predict_unit, with_chords

#: Gaps are bridged up to twice this many spacings.
_REACH = 10.0
#: Finest grid width in spacings of the points, before it is made a round number.
_WIDTH = 0.5
_ROUND = (1.0, 1.25, 1.6, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
#: Part of a unit's standard deviation by which a wider grid may change its surface.
_ADAPT = 0.25
#: Units of a model at most: a wider spread of points needs a wider grid.
_MOST_UNITS = 1_000_000
#: Cells from the edge of the domain to the posts that data surround: it is 1.5 beyond the outermost data.
_RIM = 2.5


@dataclass(frozen=True, eq=False)
class BuildPlan:
    """Plan of a terrain model, which can be inspected before anything is computed."""

    seen: Observations
    layout: UnitLayout
    """Units, in the CRS of the measurements."""
    width: float
    """Grid width, metres; half of it in units that breaklines pass, unless a width was asked for."""
    reach: float
    """Gaps wider than twice this stay open, metres."""
    polygon: Any | None
    """Polygon of the border lines, in the CRS; None: there are none."""
    settings: BuildSettings

    @property
    def finest(self) -> float:
        """Grid width where breaklines pass, metres; `width` where there are none."""
        halved = self.settings.grid_width is None and any(x.kind == "breakline" for x in self.seen.lines.lines)
        return self.width / 2 if halved else self.width


@dataclass(frozen=True, eq=False)
class Built:
    """A model in memory."""

    plan: BuildPlan
    fit: TerrainFit
    units: dict[tuple[int, int], Unit]
    """Units that are not empty, by column and row."""
    lines: tuple[LineElement, ...]
    """With their intersections with the grid."""
    figures: tuple[UnitFigures, ...] = field(default=())
    """Figures of all units, row by row."""
    sigma: float = np.nan
    """Root mean square of the standard deviations of posts that data surround, metres; of all posts if none is."""


def plan_build(measured: MeasuredTerrain, settings: BuildSettings) -> BuildPlan:
    """Grid width, units and borders for clean measurements.

    Raises
    ------
    GeometryError
        Fewer than three points, or all on one line.
    InputError
        The points are so far apart that the model would have too many units.
    """
    seen = observe(measured, settings)
    width = settings.grid_width or _nice(_WIDTH * seen.spacing)
    if any(np.isnan(line.xyz[:, 2]).any() for line in measured.lines):
        measured = _with_dense_borders(measured, width)
        seen = observe(measured, settings)
    side = width * settings.unit_meshes
    xy = np.vstack([seen.xyz[: seen.points, :2], seen.lines.xyz[:, :2]]) + seen.origin[:2]
    low, high = np.floor(xy.min(axis=0) / side), np.ceil((xy.max(axis=0) + 1e-6 * side) / side)
    columns, rows = np.maximum(high - low, 1).astype(int).tolist()
    if columns * rows > _MOST_UNITS:
        raise InputError(
            f"points from {xy.min(axis=0)} to {xy.max(axis=0)} with a grid of {width:g} m make {columns} × {rows} "
            f"units, at most {_MOST_UNITS} are allowed; is there a point far from all others? Else give `grid_width`"
        )
    layout = UnitLayout(left=float(low[0] * side), top=float(high[1] * side), side=side, columns=columns, rows=rows)
    reach = settings.reach or _REACH * seen.spacing
    return BuildPlan(seen=seen, layout=layout, width=width, reach=reach, polygon=domain_of(measured), settings=settings)


def _with_dense_borders(measured: MeasuredTerrain, width: float) -> MeasuredTerrain:
    """Borders without heights with vertices at most a mesh apart: their heights are predicted there, not in between.

    Where a border runs along another line it keeps that line's vertices.
    """
    sides: Counter[tuple[tuple[float, float], tuple[float, float]]] = Counter()
    for line in measured.lines:
        ends = [tuple(v) for v in line.xyz[:, :2].tolist()]
        sides.update((min(a, b), max(a, b)) for a, b in itertools.pairwise(ends))
    lines = []
    for line in measured.lines:
        if np.isfinite(line.xyz[:, 2]).all():
            lines.append(line)
            continue
        rows = [line.xyz[:1]]
        for a, b in itertools.pairwise(line.xyz):
            side = tuple(a[:2].tolist()), tuple(b[:2].tolist())
            length = float(np.hypot(*(b - a)[:2]))
            count = 1 if sides[min(side), max(side)] > 1 else max(1, int(np.ceil(length / width)))
            t = np.arange(1, count)[:, None] / count
            between = a + (b - a) * t
            between[:, 2] = np.nan
            rows += [between, b[None]]
        lines.append(replace(line, xyz=np.vstack(rows)))
    return replace(measured, lines=tuple(lines))


def _nice(width: float) -> float:
    """The largest round number that is not larger."""
    power = 10.0 ** np.floor(np.log10(width))
    return round(float(max(f * power for f in _ROUND if f * power <= width)), 12)


def build_terrain(plan: BuildPlan, run: Map = map, events: Events = SILENT) -> Built:
    """Compute a model: covariance functions, gross errors, lines, posts, triangles."""
    settings, layout, seen = plan.settings, plan.layout, plan.seen
    local = replace(layout, left=layout.left - seen.origin[0], top=layout.top - seen.origin[1])
    count = layout.columns * layout.rows
    found = fit(seen, local, settings, run, events)
    domain = _domain(plan)
    events.begin("held-out blocks", unit="units")
    found = calibrated(found, domain.places(), settings.unit_meshes, run)
    events.begin("lines", unit="units")
    lines = predict_lines(found, run)
    events.begin("heights", count, "units")
    meshes_of = settings.unit_meshes * _finer(plan, lines).ravel()
    posts = run(lambda u: _thinned(plan, predict_unit(found, u, domain, int(meshes_of[u]), plan.reach)), range(count))
    units = {(u % layout.columns, u // layout.columns): unit for u, unit in enumerate(posts) if unit is not None}
    meshes = np.zeros((layout.rows, layout.columns), np.int64)
    for (column, row), unit in units.items():
        meshes[row, column] = unit.meshes
    events.begin("chords of lines", unit="lines")
    lines = with_chords(found, [on_grid(line, layout, meshes) for line in lines], run)
    units = _with_faces(plan, units, lines, run, events)
    sigmas = _surrounded(plan, domain, units)
    every = np.concatenate([np.empty(0), *sigmas.values()])
    sigma = float(np.sqrt((every**2).mean())) if len(every) else np.nan
    return Built(
        plan=plan,
        fit=found,
        units=units,
        lines=tuple(lines),
        figures=tuple(_figures(plan, found, units, lines, sigmas)),
        sigma=sigma,
    )


def _surrounded(
    plan: BuildPlan, domain: Domain, units: dict[tuple[int, int], Unit]
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Standard deviations of the posts of each unit that lie inside the outline of the data by a spacing.

    The domain reaches a spacing beyond the data: heights there are extrapolated, and their standard deviations, many
    times larger, would say nothing of the model that is used. All posts count where no post of the model lies inside.
    """
    inner = distance_transform_edt(domain.near) > _RIM
    origin = plan.seen.origin
    inside, everywhere = {}, {}
    for key, unit in units.items():
        along = np.arange(unit.meshes + 1) * unit.width
        row = ((domain.top - (unit.top - along - origin[1])) / domain.cell).astype(int)
        column = ((unit.left + along - origin[0] - domain.left) / domain.cell).astype(int)
        # Posts outside the raster have no height.
        rows, columns = (np.clip(k, 0, n - 1) for k, n in zip((row, column), inner.shape))
        known = np.isfinite(unit.sigmas)
        everywhere[key] = unit.sigmas[known].astype(float)
        inside[key] = unit.sigmas[known & inner[np.ix_(rows, columns)]].astype(float)
    return inside if any(len(s) for s in inside.values()) else everywhere


def _domain(plan: BuildPlan) -> Domain:
    seen = plan.seen
    data = seen.xyz[:, :2]
    polygon = plan.polygon
    if polygon is not None:
        polygon = shapely.transform(polygon, lambda xy: xy - seen.origin[:2])
    return Domain.of(data, seen.spacing, plan.reach, polygon)


def _finer(plan: BuildPlan, lines: list[LineElement]) -> NDArray[np.int64]:
    """Factor of the meshes along units' sides (rows, columns): 2 where breaklines pass and no width is asked for.

    Beside a breakline the surface bends more than elsewhere.
    """
    if plan.settings.grid_width is not None:
        return np.ones((plan.layout.rows, plan.layout.columns), np.int64)
    passing = _passing(plan.layout, [line for line in lines if line.kind == "breakline"])
    return np.where(passing > 0, 2, 1)


def _thinned(plan: BuildPlan, unit: Unit | None) -> Unit | None:
    """The unit with the widest grid that still shows its surface."""
    if unit is None or plan.settings.adapt == 0:
        return unit
    tolerance = plan.settings.adapt
    if tolerance is None:
        tolerance = _ADAPT * float(np.nanmean(unit.sigmas))
    valid = np.isfinite(unit.heights)
    whole = valid[1:, 1:] & valid[1:, :-1] & valid[:-1, 1:] & valid[:-1, :-1]
    # Single posts at the edge of the data, without a whole mesh, leave nothing that a wider grid could keep.
    return thin(unit, tolerance) if whole.any() else unit


def _with_faces(
    plan: BuildPlan, units: dict[tuple[int, int], Unit], lines: list[LineElement], run: Map, events: Events
) -> dict[tuple[int, int], Unit]:
    boxes = shapely.STRtree([shapely.LineString(line.xyz[:, :2]) for line in lines])
    keys = list(units)

    def one(key: tuple[int, int]) -> MeshFaces | None:
        column, row = key
        unit = units[column, row]
        edge = 1e-6 * unit.side  # a line on the border, rounded by one bit, still touches
        box = shapely.box(unit.left - edge, unit.top - unit.side - edge, unit.left + unit.side + edge, unit.top + edge)
        some = [lines[k] for k in np.sort(boxes.query(box))]
        around = {
            "north": (column, row - 1),
            "south": (column, row + 1),
            "west": (column - 1, row),
            "east": (column + 1, row),
        }
        neighbours = {side: units[key] for side, key in around.items() if key in units}
        return build_faces(unit, some, neighbours, plan.polygon)

    events.begin("triangles", len(keys), "units")
    return {key: replace(units[key], faces=faces) for key, faces in zip(keys, run(one, keys))}


def _figures(
    plan: BuildPlan,
    found: TerrainFit,
    units: dict[tuple[int, int], Unit],
    lines: list[LineElement],
    sigmas: dict[tuple[int, int], NDArray[np.float64]],
) -> list[UnitFigures]:
    layout = plan.layout
    passing = _passing(layout, lines)
    figures = []
    for number in range(layout.columns * layout.rows):
        column, row = number % layout.columns, number // layout.columns
        unit = units.get((column, row))
        covariance, members = found.units[number], found.members[number]
        gross = int((found.noise[members] < 0).sum())
        z = found.residuals[members, 2][found.noise[members] >= 0]
        z = z[np.isfinite(z)]
        low = high = sigma = np.nan
        if unit is not None:
            heights = [unit.heights.ravel() + unit.datum]
            heights += [] if unit.faces is None else [unit.faces.vertices[:, 2]]
            everything = np.concatenate(heights)
            low, high = float(np.nanmin(everything)), float(np.nanmax(everything))
            some = sigmas[column, row]
            sigma = float(np.sqrt((some**2).mean())) if len(some) else np.nan
        figures.append(
            UnitFigures(
                column=column,
                row=row,
                meshes=0 if unit is None else unit.meshes,
                low=low,
                high=high,
                points=len(members),
                lines=int(passing[row, column]),
                variance=covariance.variance,
                length=covariance.length,
                noise=covariance.noise,
                sigma=sigma,
                spread=float(z.std()) if len(z) >= 20 else np.nan,
                gross=gross,
            )
        )
    return figures


def _passing(layout: UnitLayout, lines: list[LineElement]) -> NDArray[np.int64]:
    """Number of lines that pass each unit."""
    count = np.zeros((layout.rows, layout.columns), np.int64)
    for line in lines:
        middle = (line.xyz[1:, :2] + line.xyz[:-1, :2]) / 2
        column = np.clip(((middle[:, 0] - layout.left) / layout.side).astype(int), 0, layout.columns - 1)
        row = np.clip(((layout.top - middle[:, 1]) / layout.side).astype(int), 0, layout.rows - 1)
        cells = np.unique(row * layout.columns + column)
        count.flat[cells] += 1
    return count
