"""Heights at points, profiles and contour lines."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.crs import crs_label
from photoplan.geometry.heights import height_label
from photoplan.io.product import check_output
from photoplan.io.tables import Dialect, csv_line
from photoplan.io.terrain.model_write import replacing
from photoplan.io.terrain.text import PointTable, PointTableFormat
from photoplan.io.vector_layer import ContourRow, LabelRow, contour_files, read_features, write_contours
from photoplan.plain import pick
from photoplan.project.ground import OpenTerrain, open_terrain
from photoplan.requests.terrain import ContourRequest, ProfileRequest, SampleRequest
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.seen import profile
from photoplan.terrain.contours import (
    ContourLine,
    Labeller,
    SurfacePart,
    decimals_of,
    grid_parts,
    trace_contours,
    unit_parts,
)
from photoplan.terrain.shading import ContourOptions

PART = 100_000
"""Points that are in memory at once."""
_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "\\t": "\t", "space": " "}


@dataclass(frozen=True)
class SampleReport(Result):
    """What came out."""

    path: Path
    points: int
    outside: int
    """Points where there is no model: their columns are empty."""
    low: float
    high: float
    sigma: float
    """Root mean square of the standard deviations, metres; NaN: unknown."""
    crs: str
    height_system: str | None

    def json_fields(self) -> dict[str, Any]:
        """The path as file."""
        own = ("points", "outside", "low", "high", "sigma", "crs", "height_system")
        return pick(self, *own, file="path")

    def messages(self) -> Sequence[str]:
        """Return counts and the range of heights."""
        sigma = f", sigma {self.sigma:.3f} m" if self.sigma == self.sigma else ""
        heights = f" · {self.low:.3f} to {self.high:.3f} m{sigma}" if self.outside < self.points else ""
        return [
            f"{self.points} points, {self.outside} without a model{heights} · {crs_label(self.crs)} · "
            f"heights {height_label(self.height_system)}"
        ]


def dtm_sample(request: SampleRequest, events: Events = SILENT) -> SampleReport:
    """Write the points' table with two more columns, part by part.

    Raises
    ------
    UsageError
        The output exists or is an input; a column has the name of a new one.
    InputError
        The terrain or the table cannot be used; a line that cannot be read is named.
    """
    inputs = [request.model, request.points]
    check_output(request.output, inputs, overwrite=request.overwrite)
    terrain = open_terrain(request.model, request.crs)
    if request.points_crs is not None:
        terrain, _ = terrain.in_crs(request.points_crs)
    dialect = Dialect(delimiter=_DELIMITERS.get(request.delimiter or "", request.delimiter),
                      decimal_comma=request.decimal_comma)  # fmt: skip
    table = PointTable(request.points, PointTableFormat(request.x, request.y, dialect, request.header))
    taken = [name for name in request.names if name in table.names]
    if taken:
        raise UsageError(f"{request.points}: has a column {taken[0]} already; name the new ones: `names` HEIGHT SIGMA")
    count = outside = known = 0
    low, high, squares = np.inf, -np.inf, 0.0
    delimiter = table.delimiter
    with (
        replacing(request.output, inputs, request.overwrite) as part,
        part.open("w", encoding="utf-8", newline="") as file,
    ):
        if request.header:
            file.write(csv_line([*table.names, *request.names], delimiter))
        for points in table.parts(PART):
            heights, sigmas = _values(terrain, points.xy)
            texts = [_texts(values, request, delimiter) for values in (heights, sigmas)]
            file.writelines(csv_line([*row, h, s], delimiter) for row, h, s in zip(points.rows, *texts))
            there = np.isfinite(heights)
            count, outside = count + len(heights), outside + int((~there).sum())
            if there.any():
                low, high = min(low, float(heights[there].min())), max(high, float(heights[there].max()))
            good = sigmas[np.isfinite(sigmas)]
            known, squares = known + len(good), squares + float((good**2).sum())
    sigma = float(np.sqrt(squares / known)) if known else np.nan
    if outside == count:
        low = high = np.nan
    return SampleReport(
        path=request.output,
        points=count,
        outside=outside,
        low=low,
        high=high,
        sigma=sigma,
        crs=terrain.crs,
        height_system=terrain.height_system,
    )


def _values(terrain: OpenTerrain, XY: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    errors = terrain.errors
    return terrain.surface.heights(XY), np.full(len(XY), np.nan) if errors is None else errors.sigmas(XY)


def _texts(values: NDArray[np.float64], request: SampleRequest, delimiter: str) -> list[str]:
    """Numbers as the table writes them; empty (between spaces: nan) where there is none."""
    form = f"%.{request.digits}f"
    texts = ["" if value != value else form % value for value in values.tolist()]
    # A field of spaces between spaces would vanish.
    if delimiter == " ":
        texts = [text or "nan" for text in texts]
    return [text.replace(".", ",") for text in texts] if request.decimal_comma else texts


TABLES = (".csv", ".txt")
MOST_POINTS = 1_000_000
"""Points of the lines at most."""
_LINE_NAMES = ("line", "line_id", "profile")


@dataclass(frozen=True, eq=False)
class Profile:
    """The surface over one line; straight between its points."""

    name: str
    distance: NDArray[np.float64]
    """Along the line, ascending, metres; twice the same at a wall."""
    xy: NDArray[np.float64]
    heights: NDArray[np.float64]
    """Metres; NaN at the first and last point where there is no surface."""
    sigmas: NDArray[np.float64]
    """Standard deviations of the heights, metres; NaN: unknown."""

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.distance[-1])

    @property
    def range(self) -> tuple[float, float] | None:
        """Lowest and highest, metres; None: there is no surface."""
        known = self.heights[np.isfinite(self.heights)]
        return (float(known.min()), float(known.max())) if known.size else None

    def json_fields(self) -> dict[str, Any]:
        """Figures."""
        low, high = self.range or (None, None)
        return {"line": self.name, "length": self.length, "points": len(self.distance), "low": low, "high": high}


@dataclass(frozen=True)
class Profiles(Result):
    """Profiles over lines, and the tables that were written."""

    files: tuple[Path, ...]
    profiles: tuple[Profile, ...]

    def __iter__(self) -> Iterator[Profile]:
        return iter(self.profiles)

    def __len__(self) -> int:
        return len(self.profiles)

    def written(self) -> Sequence[Path]:
        """Return the tables."""
        return self.files

    def messages(self) -> Sequence[str]:
        """Return length, points and range of heights of each profile."""
        return [
            f"{p.name}: {p.length:.2f} m, {len(p.distance)} points, "
            + ("no surface" if p.range is None else "{:.3f} to {:.3f} m".format(*p.range))
            for p in self.profiles
        ]


def dtm_profile(request: ProfileRequest, events: Events = SILENT) -> Profiles:
    """Compute the profiles and write them.

    Raises
    ------
    UsageError
        An output exists, is an input, or of no known kind.
    InputError
        The terrain or the lines cannot be used, or they are in different CRSs.
    """
    inputs = [request.model, request.lines]
    tables = tuple(path for path in request.outputs if path.suffix.lower() != ".png")
    for path in tables:
        if path.suffix.lower() not in TABLES:
            raise UsageError(f"{path}: {path.suffix or 'no suffix'}; profiles are written as .csv and .png")
        check_output(path, inputs, overwrite=request.overwrite)
    terrain = open_terrain(request.model, request.crs)
    found = profiles_of(terrain, _lines(request, terrain), request.tolerance)
    for path in tables:
        with replacing(path, inputs, request.overwrite) as part:
            _write_table(part, found)
    return Profiles(tables, tuple(found))


def profiles_of(
    terrain: OpenTerrain, lines: Sequence[tuple[str, NDArray[np.float64]]], tolerance: float = 0.001
) -> list[Profile]:
    """Profiles over lines (name, vertices (n, 2)) in the terrain's CRS."""
    found = []
    for name, vertices in lines:
        try:
            distance, X, Y, Z = profile(terrain.surface, vertices, tolerance)
        except UsageError as error:
            raise UsageError(f"line {name!r}: {error}") from None
        xy = np.column_stack([X, Y])
        sigmas = np.full(len(xy), np.nan) if terrain.errors is None else terrain.errors.sigmas(xy)
        found.append(
            Profile(name=name, distance=distance, xy=xy, heights=Z, sigmas=np.where(np.isnan(Z), np.nan, sigmas))
        )
    return found


def _lines(request: ProfileRequest, terrain: OpenTerrain) -> list[tuple[str, NDArray[np.float64]]]:
    """Name and vertices of each line."""
    if request.lines.suffix.lower() in (*TABLES, ".xyz"):
        return _lines_of_table(request)
    lines = []
    for item in read_features(request.lines, "LineString", crs=terrain.crs).items:
        parts = shapely.get_parts(item.geometry)
        for number, part in enumerate(parts, 1):
            name = item.name if len(parts) == 1 else f"{item.name}.{number}"
            lines.append((name, shapely.get_coordinates(part)))
    return lines


def _lines_of_table(request: ProfileRequest) -> list[tuple[str, NDArray[np.float64]]]:
    dialect = Dialect(decimal_comma=request.decimal_comma)
    table = PointTable(request.lines, PointTableFormat(request.x, request.y, dialect))
    column = _line_column(request, table)
    names: list[str] = []
    points = []
    for part in table.parts(100_000):
        names += ["1" if column is None else row[column] for row in part.rows]
        points.append(part.xy)
        if len(names) > MOST_POINTS:
            raise InputError(f"{request.lines}: more than {MOST_POINTS} points; give fewer lines at a time")
    xy = np.concatenate(points)
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        groups.setdefault(name, []).append(i)
    short = [name for name, which in groups.items() if len(np.unique(xy[which], axis=0)) < 2]
    if short:
        raise InputError(f"{request.lines}: line {short[0]!r} has fewer than two different points")
    return [(name, xy[which]) for name, which in groups.items()]


def _line_column(request: ProfileRequest, table: PointTable) -> int | None:
    lower = [name.casefold() for name in table.names]
    if request.line_column is None:
        wanted = next((name for name in _LINE_NAMES if name in lower), None)
        return None if wanted is None else lower.index(wanted)
    if request.line_column.casefold() not in lower:
        raise InputError(
            f"{request.lines}: no column {request.line_column!r}; the columns are {', '.join(table.names)[:200]}"
        )
    return lower.index(request.line_column.casefold())


def _write_table(part: Path, profiles: Sequence[Profile]) -> None:
    with part.open("w", encoding="utf-8", newline="") as file:
        file.write(csv_line(["line", "distance", "x", "y", "height", "sigma"]))
        for p in profiles:
            for d, (x, y), z, s in zip(p.distance, p.xy, p.heights, p.sigmas):
                height, sigma = (f"{v:.4f}" if np.isfinite(v) else "" for v in (z, s))
                file.write(csv_line([p.name, f"{d:.4f}", f"{x:.4f}", f"{y:.4f}", height, sigma]))


#: Meshes along the side of a piece of a height grid.
SIDE = 512
#: Longer side of a sketch, pixels; and vertices after which further lines are left out of it.
SKETCH_SIDE, SKETCH_MOST = 1400, 2_000_000
#: Labels of a line stand this many text heights apart, and a text is so-manieth part of the terrain's extent high.
LABEL_SPACING, LABEL_PART = 60.0, 200.0


@dataclass(eq=False)
class ContourSketch:
    """Lines at the resolution of a small picture."""

    bounds: tuple[float, float, float, float]
    lines: dict[str, list[NDArray[np.float64]]] = field(default_factory=lambda: {"plain": [], "index": [], "low": []})
    """By kind: vertices (n, 2)."""
    count: int = 0
    """Vertices."""

    @property
    def pixel(self) -> float:
        """Side of a pixel of the picture, metres."""
        xmin, ymin, xmax, ymax = self.bounds
        return max(xmax - xmin, ymax - ymin) / SKETCH_SIDE

    def add(self, line: ContourLine) -> None:
        """Take a line."""
        if self.count > SKETCH_MOST:
            return
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line.xy, axis=0).T))])
        if along[-1] < self.pixel:
            return
        # One vertex in every stretch of a pixel, and the last one.
        keep = np.append(np.diff(np.floor(along / self.pixel), prepend=-1)[:-1] > 0, True)
        xy = line.xy[keep]
        self.count += len(xy)
        self.lines["index" if line.index else "low" if line.depression else "plain"].append(xy)


@dataclass(eq=False)
class ContourFacts(Result):
    """What was made."""

    files: list[Path]
    lines: int = 0
    closed: int = 0
    depressions: int = 0
    vertices: int = 0
    length: float = 0.0
    """Metres."""
    lowest: float = math.nan
    """Metres; NaN: there are no contours."""
    highest: float = math.nan
    labels: list[LabelRow] = field(default_factory=list)
    text_height: float | None = None
    sketch: ContourSketch | None = None
    options: ContourOptions | None = None

    def add(self, line: ContourLine) -> None:
        """Count a line."""
        self.lines += 1
        self.closed += line.closed
        self.depressions += line.depression
        self.vertices += len(line.xy)
        self.length += line.length
        self.lowest = line.height if math.isnan(self.lowest) else min(self.lowest, line.height)
        self.highest = line.height if math.isnan(self.highest) else max(self.highest, line.height)

    def json_fields(self) -> dict[str, Any]:
        """Labels as their number."""
        own = ("files", "lines", "closed", "depressions", "vertices", "length", "lowest", "highest", "text_height")
        return {**pick(self, *own), "labels": len(self.labels)}

    def written(self) -> Sequence[Path]:
        """Return the contours, and the labels if they have a file of their own."""
        return self.files

    def messages(self) -> Sequence[str]:
        """Return counts and the range of heights."""
        if not self.lines and self.options is not None:
            return [f"no contour: no level of {self.options.base:g} + n × {self.options.interval:g} m is passed"]
        labels = "" if self.text_height is None else f", {len(self.labels)} labels {self.text_height:g} m high"
        return [
            f"{self.lines} contours from {self.lowest:.10g} to {self.highest:.10g} m, {self.length / 1000:.6g} km, "
            f"{self.vertices} vertices; {self.closed} closed, {self.depressions} round hollows{labels}"
        ]


@dataclass(eq=False)
class _Run:
    """Lines on their way from the terrain to the file."""

    facts: ContourFacts
    labeller: Labeller | None
    label_all: bool

    def rows(self, lines: Iterable[ContourLine]) -> Iterator[ContourRow]:
        for line in lines:
            self.facts.add(line)
            if self.labeller is not None and (line.index or self.label_all):
                size = self.labeller.size
                new = [
                    LabelRow(X=a.X, Y=a.Y, height=a.height, angle=a.angle, text=a.text, size=size)
                    for a in self.labeller.place(line)
                ]
                self.facts.labels += new
            if self.facts.sketch is not None:
                self.facts.sketch.add(line)
            yield ContourRow(line.xy, line.height, line.index, line.depression)


def make_contours(request: ContourRequest, events: Events = SILENT) -> ContourFacts:
    """Trace and write contours; memory does not grow with the terrain.

    Parameters
    ----------
    request
        What of, where to.
    events
        Told of parts of the terrain.

    Raises
    ------
    UsageError
        An output exists, is an input, or has an unknown ending; or a number makes no sense.
    InputError
        The model cannot be used, or does not meet the bounds.
    ResourceError
        The disk is full.
    """
    for file in contour_files(request.output, request.labels):
        check_output(file, [request.model], overwrite=request.overwrite)
    terrain = open_terrain(request.model, request.crs)
    bounds = _bounds(request, terrain)
    facts = ContourFacts([], sketch=None if request.preview is None else ContourSketch(bounds), options=request.options)
    run = _Run(facts, _labeller(request, bounds), request.label_all or request.options.index == 0)
    parts, count = contour_parts(terrain, request.options, request.bounds)
    events.begin("contours", count, "parts")
    lines = trace_contours(_counted(parts, count, events), request.options)
    labels = (lambda: facts.labels) if request.labels else None
    facts.files = write_contours(
        request.output, run.rows(lines), labels, terrain.crs, inputs=[request.model], overwrite=request.overwrite
    )
    facts.text_height = None if run.labeller is None else run.labeller.size
    return facts


def _bounds(request: ContourRequest, terrain: OpenTerrain) -> tuple[float, float, float, float]:
    if request.bounds is None:
        return terrain.bounds
    a, b = terrain.bounds, request.bounds
    terrain.refuse_apart(b)
    return max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])


def _labeller(request: ContourRequest, bounds: tuple[float, float, float, float]) -> Labeller | None:
    if not request.labels:
        return None
    extent = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    size = request.text_height or float(f"{extent / LABEL_PART:.2g}")
    spacing = request.label_spacing or LABEL_SPACING * size
    return Labeller(size, spacing, decimals_of(request.options.interval, request.options.base))


def contour_parts(
    terrain: OpenTerrain, options: ContourOptions, bounds: tuple[float, float, float, float] | None
) -> tuple[Iterator[SurfacePart], int]:
    """Return parts of the terrain, and about how many there are."""
    if terrain.model is not None:
        layout = terrain.model.layout
        bent = options.smooth or options.simplify
        lines = terrain.model.lines if bent else None
        return unit_parts(terrain.model, bounds, lines), layout.columns * layout.rows
    surface = terrain.surface
    assert isinstance(surface, RasterSurface)
    columns, rows = surface.grid.size
    parts = grid_parts(surface.grid, surface.origin, surface.mesh, bounds, SIDE)
    return parts, -(-(columns - 1) // SIDE) * -(-(rows - 1) // SIDE)


def _counted(parts: Iterable[SurfacePart], count: int, events: Events) -> Iterator[SurfacePart]:
    for part in parts:
        yield part
        events.done(1, (part.heights.shape[0] - 1) * (part.heights.shape[1] - 1))
        count -= 1
    events.done(count)  # parts outside the bounds or without terrain
