"""Rasters and polygons of catchments and flow lengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.engine.steps import steps
from photoplan.errors import InputError, ResourceError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.naming import together, when_named
from photoplan.io.polygons import check_vectors, label_polygons, write_features
from photoplan.io.product import check_output
from photoplan.io.result_log import ResultLog
from photoplan.plain import advised, pick
from photoplan.products.dtm.raster import GridOptions, write_grid
from photoplan.products.dtm.visible import Place, named_points, own_grid, read_grid
from photoplan.project.open_terrain import OpenTerrain, open_terrain
from photoplan.requests.terrain import FlowRequest
from photoplan.terrain.flow import CELL_BYTES, Flow, flow_of, snapped

TILE = 512
BANDS = ("upstream area m²", "flow length m", "longest way here m", "direction", "catchment", "depth of filling m")
"""What the bands of the raster hold; NaN without terrain."""


@dataclass(frozen=True)
class OutletRow:
    """Figures of one outlet."""

    name: str
    X: float
    Y: float
    """Middle of the outlet's cell."""
    area: float
    """Area whose water comes by, m²."""
    own: float
    """The same without the catchments of outlets above, m²."""
    longest: float
    """Length of the longest way to it, metres."""

    def json_fields(self) -> dict[str, Any]:
        """Areas in m², the way in metres."""
        places = {"outlet": "name", "x": "X", "y": "Y"}
        return pick(self, **places, upstream_area="area", own_area="own", longest_way="longest")


@dataclass(frozen=True)
class FlowReport(Result):
    """What came out."""

    path: Path
    catchments: Path | None
    resolution: float
    area: float
    """Area with terrain, m²."""
    outflow: float
    """Sum of the areas of all cells where water leaves, m²: the same, or something is lost."""
    pits: float
    """Area that was raised by filling, m²."""
    pit_volume: float
    """Volume of the filling, m³."""
    rows: tuple[OutletRow, ...]

    def json_fields(self) -> dict[str, Any]:
        """Areas in m², the volume in m³."""
        more = {"outflow_area": "outflow", "filled_area": "pits", "filled_volume": "pit_volume", "outlets": "rows"}
        return {**pick(self, "path", "catchments", "resolution", "area", **more), "bands": BANDS}

    def summary(self) -> Sequence[str]:
        """Return areas and pits, and a line for each outlet."""
        return [
            f"area {self.area:.8g} m², leaves by its edge {self.outflow:.8g} m²; "
            f"pits filled on {self.pits:.6g} m² with {self.pit_volume:.6g} m³",
            *(
                f"outlet {row.name} at {row.X:.10g} {row.Y:.10g}: {row.area:.8g} m² upstream, "
                f"longest way {row.longest:.6g} m"
                for row in self.rows
            ),
        ]

    def messages(self) -> Sequence[str]:
        """Return the bands and the cell size."""
        return [f"bands: {', '.join(BANDS)}; cells {self.resolution:g} m"]


def dtm_flow(request: FlowRequest, events: Events = SILENT) -> FlowReport:
    """Compute and write flow over a model.

    Raises
    ------
    UsageError
        An output exists or is an input, or an option makes no sense.
    InputError
        The model or the outlets cannot be used.
    ResourceError
        The grid does not fit the memory.
    """
    inputs = [request.model, *([request.outlets] if request.outlets else [])]
    for path in (request.output, request.catchments):
        if path is not None:
            check_output(path, inputs, overwrite=request.overwrite, raster=path == request.output)
    if request.catchments is not None:
        check_vectors(request.catchments)
    terrain = open_terrain(request.model, request.crs)
    points = [] if request.outlets is None else named_points(request.outlets, terrain.crs)
    grid = _grid(request, terrain)
    heights = read_grid(terrain, grid)
    options = GridOptions.of(
        request, "flow", inputs, events, tile=TILE, resampling="nearest", tags={"BANDS": "; ".join(BANDS)}
    )
    log = ResultLog.beside(request.output, f"{options.key} {grid}", locked=False)
    snapping = bool(points) and request.snap > 0
    events.begin("flow", 1 + snapping, "steps")
    with log, steps(request.output.name, 1, events, log) as run:
        # Upstream areas do not depend on outlets.
        area = next(run(partial(_area, grid.resolution), [heights])) if snapping else _there(heights)
        cells = _cells(request, grid, area, points)
        (flow,) = run(partial(flow_of, cell=grid.resolution, outlets=cells, method=request.method), [heights])
    rows = [_row(flow, grid, number, name, cell) for number, ((name, *_), cell) in enumerate(zip(points, cells), 1)]
    depth = flow.filled - heights
    with together():
        if request.catchments is not None:
            _write_catchments(request.catchments, grid, flow, rows, terrain.crs)
        _write(request, grid, flow, depth, options)
        when_named(log.remove)
    pixel = grid.resolution**2
    return FlowReport(
        path=request.output,
        catchments=request.catchments,
        resolution=grid.resolution,
        area=float(np.isfinite(heights).sum()) * pixel,
        outflow=float(flow.area[flow.leaves].sum()),
        pits=float((depth > 0).sum()) * pixel,
        pit_volume=float(np.nansum(depth, dtype=float)) * pixel,
        rows=tuple(rows),
    )


def _grid(request: FlowRequest, terrain: OpenTerrain) -> MapGrid:
    if request.resolution is None:
        grid = own_grid(terrain, terrain.bounds[:2], terrain.bounds[2:])
    else:
        grid = MapGrid.covering(terrain.bounds, request.resolution, terrain.crs)
    need = grid.width * grid.height * CELL_BYTES
    if need > request.memory:
        raise ResourceError(
            f"{grid.width} × {grid.height} cells take {advised(need / 2**30, 3)} GiB, allowed are "
            f"{request.memory / 2**30:.1f}: water knows no tiles; give a coarser `resolution` or more `memory`"
        )
    return grid


def _area(cell: float, heights: NDArray[np.float32]) -> NDArray[np.float64]:
    return flow_of(heights, cell).area


def _there(heights: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.where(np.isnan(heights), np.nan, 1.0)


def _cells(
    request: FlowRequest, grid: MapGrid, area: NDArray[np.float64], points: Sequence[Place]
) -> list[tuple[int, int]]:
    """Row and column of every outlet, moved to the flow where that is wanted."""
    cells: list[tuple[int, int]] = []
    for name, x, y, _ in points:
        column, row = grid.to_pixel((x, y))
        try:
            cells.append(snapped(area, float(row), float(column), request.snap / grid.resolution))
        except InputError:
            raise InputError(
                f"{request.outlets}: outlet {name} at {x:.10g} {y:.10g} has no terrain within {request.snap:g} m; "
                "move it, or give a larger `snap`"
            ) from None
        other = cells.index(cells[-1])
        if other < len(cells) - 1:
            raise InputError(
                f"{request.outlets}: outlets {points[other][0]} and {name} come to lie in one cell; leave one out, or "
                "give a smaller `snap` or `resolution`"
            )
    return cells


def _row(flow: Flow, grid: MapGrid, number: int, name: str, cell: tuple[int, int]) -> OutletRow:
    X, Y = grid.to_map((cell[1], cell[0]))
    own = float((flow.catchment == number).sum()) * grid.resolution**2
    return OutletRow(
        name=name, X=float(X), Y=float(Y), area=float(flow.area[cell]), own=own, longest=float(flow.longest[cell])
    )


def _write(request: FlowRequest, grid: MapGrid, flow: Flow, depth: NDArray[np.float32], options: GridOptions) -> None:
    def tile(window: Window) -> NDArray[np.float32]:
        right, bottom = window.stop
        part = slice(window.row, bottom), slice(window.col, right)
        none = np.isnan(depth[part])
        bands: list[NDArray[Any]] = [
            flow.area[part],
            flow.length[part],
            flow.longest[part],
            np.where(none, np.nan, flow.direction[part]),
            np.where(none, np.nan, flow.catchment[part]),
            depth[part],
        ]
        return np.stack(bands).astype(np.float32)

    write_grid(request.output, grid.placement, np.float32, len(BANDS), "auto", tile, options)


def _write_catchments(path: Path, grid: MapGrid, flow: Flow, rows: Sequence[OutletRow], crs: str) -> None:
    found = label_polygons(flow.catchment, grid)
    numbers = np.array([*found], np.int32)
    if rows:
        names = [rows[number - 1].name for number in numbers]
        upstream, longest = (
            np.array([getattr(rows[n - 1], key) for n in numbers], float) for key in ("area", "longest")
        )
    else:
        row, column = np.nonzero(flow.leaves)
        order = np.argsort(flow.catchment[row, column])
        names = [str(number) for number in numbers]
        upstream, longest = (a[row, column][order].astype(float) for a in (flow.area, flow.longest))
    own = shapely.area(np.array([*found.values()], object)) if found else np.empty(0)
    columns = {
        "number": numbers,
        "name": np.array(names, object),
        "own_area": own,
        "upstream_area": upstream,
        "longest_way": longest,
    }
    write_features(path, "MultiPolygon", [*found.values()], columns, crs, "catchments")
