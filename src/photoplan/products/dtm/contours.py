"""Contour lines of a terrain model as a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

from photoplan.errors import GeometryError, UsageError
from photoplan.io.contour_file import ContourRow, LabelRow, contour_files, write_contours
from photoplan.io.product import check_output
from photoplan.products.dtm.contours_picture import ContourPicture
from photoplan.project.open_terrain import OpenTerrain, open_terrain
from photoplan.surfaces.raster import RasterSurface
from photoplan.terrain.contours.labels import Labeller, decimals_of
from photoplan.terrain.contours.parts import SurfacePart, grid_parts, unit_parts
from photoplan.terrain.contours.run import ContourLine, ContourOptions, trace_contours

#: Meshes along the side of a piece of a height grid.
SIDE = 512
#: Labels of a line stand this many text heights apart, and a text is so-manieth part of the terrain's extent high.
LABEL_SPACING, LABEL_PART = 60.0, 200.0


@dataclass(frozen=True)
class ContourRequest:
    """What is asked."""

    model: Path
    output: Path
    """Its ending chooses the format: .gpkg, .shp, .geojson or .dxf."""
    options: ContourOptions
    _: KW_ONLY
    bounds: tuple[float, float, float, float] | None = None
    """Only the meshes that touch xmin, ymin, xmax, ymax."""
    labels: bool = False
    """Find places for labels too."""
    label_all: bool = False
    """Label every contour, not index contours alone."""
    text_height: float | None = None
    """Height of labels, metres on the ground; None: a two-hundredth of the longer side."""
    label_spacing: float | None = None
    """Distance of labels along a line, metres; None: sixty text heights."""
    crs: str | None = None
    """CRS of a model that does not state its own."""
    preview: Path | None = None
    """A small PNG to look at."""
    overwrite: bool = False


@dataclass(eq=False)
class ContourFacts:
    """What was made."""

    files: list[Path]
    preview: Path | None = None
    lines: int = 0
    closed: int = 0
    depressions: int = 0
    vertices: int = 0
    length: float = 0.0
    """Metres."""
    low: float = math.nan
    """Lowest contour, metres; NaN: there are none."""
    high: float = math.nan
    labels: int = 0
    text_height: float | None = None

    def add(self, line: ContourLine) -> None:
        """Count a line."""
        self.lines += 1
        self.closed += line.closed
        self.depressions += line.depression
        self.vertices += len(line.xy)
        self.length += line.length
        self.low = line.height if math.isnan(self.low) else min(self.low, line.height)
        self.high = line.height if math.isnan(self.high) else max(self.high, line.height)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `--json`; heights are null if there are no contours."""
        return {
            "files": [str(file) for file in self.files],
            "preview": self.preview and str(self.preview),
            "lines": self.lines,
            "closed": self.closed,
            "depressions": self.depressions,
            "vertices": self.vertices,
            "length": self.length,
            "lowest": None if math.isnan(self.low) else self.low,
            "highest": None if math.isnan(self.high) else self.high,
            "labels": self.labels,
            "text_height": self.text_height,
        }


@dataclass(eq=False)
class _Run:
    """Lines on their way from the terrain to the file."""

    facts: ContourFacts
    labeller: Labeller | None
    label_all: bool
    picture: ContourPicture | None
    labels: list[LabelRow] = field(default_factory=list)

    def rows(self, lines: Iterable[ContourLine]) -> Iterator[ContourRow]:
        for line in lines:
            self.facts.add(line)
            if self.labeller is not None and (line.index or self.label_all):
                size = self.labeller.size
                new = [LabelRow(a.X, a.Y, a.height, a.angle, a.text, size) for a in self.labeller.place(line)]
                self.labels += new
            if self.picture is not None:
                self.picture.add(line)
            yield ContourRow(line.xy, line.height, line.index, line.depression)


def make_contours(
    request: ContourRequest, begin: Callable[[int], Callable[[int, int], None]] | None = None
) -> ContourFacts:
    """Trace and write contours; memory does not grow with the terrain.

    Parameters
    ----------
    request
        What of, where to.
    begin
        Called with the number of parts of the terrain before the first one; returns what is called with the numbers of
        parts and meshes that are finished.

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
    if request.preview is not None:
        if request.preview.resolve() == request.output.resolve():
            raise UsageError(f"{request.preview}: the preview has the name of the output; choose another one")
        check_output(request.preview, [request.model], overwrite=request.overwrite)
    terrain = open_terrain(request.model, request.crs)
    bounds = _bounds(request, terrain)
    facts = ContourFacts([])
    picture = None if request.preview is None else ContourPicture(bounds)
    run = _Run(facts, _labeller(request, bounds), request.label_all or request.options.index == 0, picture)
    parts, count = _parts(terrain, request)
    report = (lambda parts, meshes: None) if begin is None else begin(count)
    lines = trace_contours(_counted(parts, report), request.options)
    labels = (lambda: run.labels) if request.labels else None
    facts.files = write_contours(
        request.output, run.rows(lines), labels, terrain.crs, inputs=[request.model], overwrite=request.overwrite
    )
    facts.labels = len(run.labels)
    facts.text_height = None if run.labeller is None else run.labeller.size
    if picture is not None and request.preview is not None:
        picture.write(request.preview, [(a.X, a.Y, a.angle, a.text) for a in run.labels], facts.text_height or 1.0)
        facts.preview = request.preview
    return facts


def _bounds(request: ContourRequest, terrain: OpenTerrain) -> tuple[float, float, float, float]:
    if request.bounds is None:
        return terrain.bounds
    a, b = terrain.bounds, request.bounds
    if not (b[0] < b[2] and b[1] < b[3]):
        raise UsageError(f"bounds {b}; needed are xmin ymin xmax ymax with xmin < xmax and ymin < ymax")
    if not (a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]):
        raise GeometryError(
            f"bounds {' '.join(f'{v:.10g}' for v in b)} do not meet {terrain.path}, which covers "
            f"{' '.join(f'{v:.10g}' for v in a)}"
        )
    return max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])


def _labeller(request: ContourRequest, bounds: tuple[float, float, float, float]) -> Labeller | None:
    if not request.labels:
        return None
    extent = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    size = request.text_height or float(f"{extent / LABEL_PART:.2g}")
    spacing = request.label_spacing or LABEL_SPACING * size
    return Labeller(size, spacing, decimals_of(request.options.interval, request.options.base))


def _parts(terrain: OpenTerrain, request: ContourRequest) -> tuple[Iterator[SurfacePart], int]:
    """Parts of the terrain, and about how many there are."""
    if terrain.model is not None:
        layout = terrain.model.layout
        bent = request.options.smooth or request.options.simplify
        lines = terrain.model.lines if bent else None
        return unit_parts(terrain.model, request.bounds, lines), layout.columns * layout.rows
    surface = terrain.surface
    assert isinstance(surface, RasterSurface)
    columns, rows = surface.grid.size
    parts = grid_parts(surface.grid, surface.origin, surface.mesh, request.bounds, SIDE)
    return parts, -(-(columns - 1) // SIDE) * -(-(rows - 1) // SIDE)


def _counted(parts: Iterable[SurfacePart], report: Callable[[int, int], None]) -> Iterator[SurfacePart]:
    for part in parts:
        yield part
        report(1, (part.heights.shape[0] - 1) * (part.heights.shape[1] - 1))
