"""A terrain model in the formats of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.heights import crs_with_heights
from photoplan.io.naming import together
from photoplan.io.product import check_output
from photoplan.io.terrain.export import TIN_SUFFIXES, replacing, write_points, write_tin
from photoplan.products.dtm.raster import GridOptions, write_grid
from photoplan.project.open_terrain import OpenTerrain, open_terrain
from photoplan.requests.terrain import ExportRequest
from photoplan.targets.map import MapTarget

RASTERS = (".tif", ".tiff")
POINTS = (".xyz", ".csv")
EXPORTS = (*RASTERS, *TIN_SUFFIXES, *POINTS)
"""Suffixes that are written."""
_TILE = 512


@dataclass(frozen=True)
class ExportReport(Result):
    """What was written."""

    paths: tuple[Path, ...]
    figures: dict[str, Any]
    """Counts, or size and resolution of the raster."""

    def json_fields(self) -> dict[str, Any]:
        """Figures beside the files."""
        return {"files": self.paths, **self.figures}

    def written(self) -> Sequence[Path]:
        """Return the files."""
        return self.paths

    def messages(self) -> Sequence[str]:
        """Return the figures in a line."""
        return [" · ".join(f"{key.replace('_', ' ')} {value:.6g}" for key, value in self.figures.items())]


def dtm_export(request: ExportRequest, events: Events = SILENT) -> ExportReport:
    """Write a terrain model in another format.

    Raises
    ------
    UsageError
        The suffix is not known, the output exists or is an input, or options do not fit the format.
    InputError
        The file is no terrain model, or bounds lie outside of it.
    ResourceError
        The disk is full.
    """
    kind = _kind(request)
    for path in filter(None, (request.output, request.sigma)):
        check_output(path, [request.model], overwrite=request.overwrite)
    if request.sigma is not None and request.sigma.resolve() == request.output.resolve():
        raise UsageError(f"{request.sigma}: heights and standard deviations need a file each")
    terrain = open_terrain(request.model, request.crs)
    if kind in RASTERS:
        return _export_raster(request, terrain, events)
    if terrain.model is None:
        raise UsageError(f"{request.model}: a raster has no triangles or lines; export it as .tif, or with gdal2xyz")
    reader = terrain.model
    events.begin(request.output.name, sum(1 for _ in reader.units()), "units")
    with replacing(request.output, [request.model], request.overwrite) as part:
        if kind in POINTS:
            figures = write_points(part, kind, reader, reader.lines(), events)
            counts = {"posts": figures.vertices, "line_points": figures.line_points}
        else:
            system = {"crs": terrain.crs, "height_system": terrain.height_system}
            figures = write_tin(part, kind, reader, request.model.stem, events, **system)
            counts = {"vertices": figures.vertices, "triangles": figures.faces, "wall_triangles": figures.walls}
    return ExportReport((request.output,), counts)


def _kind(request: ExportRequest) -> str:
    kind = request.output.suffix.lower()
    if kind not in EXPORTS:
        raise UsageError(f"{request.output}: {kind or 'no suffix'}; by the suffix is written: {', '.join(EXPORTS)}")
    raster_only = (request.resolution, request.bounds, request.sigma)
    if kind not in RASTERS and any(option is not None for option in raster_only):
        raise UsageError(f"{request.output}: resolution, bounds and sigma belong to a raster (.tif)")
    return kind


def _grid(request: ExportRequest, terrain: OpenTerrain) -> MapGrid:
    crs = crs_with_heights(terrain.crs, terrain.height_system)
    bounds = request.bounds or terrain.bounds
    terrain.refuse_apart(bounds)
    if request.resolution is not None or request.bounds is not None:
        return MapGrid.covering((*bounds[:2], *bounds[2:]), request.resolution or terrain.resolution, crs)
    width = terrain.resolution
    xmin, ymin, xmax, ymax = terrain.bounds
    # Pixels of a raster are its own; those of a model lie centred on its posts, the outer ones included.
    edge = width / 2 if terrain.model is not None else 0.0
    columns, rows = (round((b - a + 2 * edge) / width) for a, b in ((xmin, xmax), (ymin, ymax)))
    return MapGrid(left=xmin - edge, top=ymax + edge, resolution=width, width=columns, height=rows, crs=crs)


def _export_raster(request: ExportRequest, terrain: OpenTerrain, events: Events) -> ExportReport:
    grid, surface, errors = _grid(request, terrain), terrain.surface, terrain.errors
    target = MapTarget(grid)
    options = GridOptions.of(request, "heights", [request.model], events, tile=_TILE)

    def heights(window: Window) -> NDArray[np.float32]:
        return surface.relief(target, window)[None]

    def sigmas(window: Window) -> NDArray[np.floating]:
        assert errors is not None
        return errors(target, window)[None]

    if request.sigma is not None and errors is None:
        raise UsageError(f"{request.model}: a raster of heights has no standard deviations; leave `sigma` out")
    paths = [request.output]
    with together():
        facts = write_grid(request.output, grid.placement, np.float32, 1, "auto", heights, options)
        if request.sigma is not None:
            of_sigmas = replace(options, kind="standard deviations")
            write_grid(request.sigma, grid.placement, np.float32, 1, "auto", sigmas, of_sigmas)
            paths.append(request.sigma)
    size = {"columns": grid.width, "rows": grid.height, "resolution": grid.resolution}
    return ExportReport(tuple(paths), {**size, "share_with_height": facts.valid_share})
