"""Contour lines of a terrain model as a file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.io.contour_file import ContourRow, LabelRow, contour_files, write_contours
from photoplan.io.product import check_output
from photoplan.plain import pick
from photoplan.project.open_terrain import OpenTerrain, open_terrain
from photoplan.requests.terrain import ContourRequest
from photoplan.surfaces.raster import RasterSurface
from photoplan.terrain.contours.labels import Labeller, decimals_of
from photoplan.terrain.contours.parts import SurfacePart, grid_parts, unit_parts
from photoplan.terrain.contours.run import ContourLine, trace_contours
from photoplan.terrain.options import ContourOptions

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
