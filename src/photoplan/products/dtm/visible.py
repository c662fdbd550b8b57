"""Maps of what can be seen from points of a terrain model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.engine.executors import available_cpus
from photoplan.engine.steps import Steps, steps
from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.local import earth_radius
from photoplan.geometry.units import metric_system
from photoplan.io.polygons import read_features
from photoplan.io.product import check_output
from photoplan.io.result_log import ResultLog
from photoplan.io.tables import Columns, read_table
from photoplan.plain import advised, pick
from photoplan.products.dtm.raster import GridOptions, write_grid
from photoplan.project.open_terrain import OpenTerrain, open_terrain
from photoplan.requests.terrain import VisibleRequest
from photoplan.targets.map import MapTarget
from photoplan.terrain.visibility import Observer, SightSettings, horizon, needed_heights, parts

TILE = 512
#: Bytes of one post while one observer is looked at: heights, those relative to the eye, pyramid, result.
POST_BYTES = 34
COLUMNS = Columns(
    roles={
        "x": ("x", "e", "east", "easting"),
        "y": ("y", "n", "north", "northing"),
        "h": ("h", "height", "eye"),
        "name": ("name", "id", "point"),
    },
    needed=("x", "y"),
    row="point",
)


@dataclass(frozen=True)
class VisibleRow:
    """Figures of one observer."""

    name: str
    X: float
    Y: float
    eye: float
    """Height of the eye, metres."""
    visible: float
    """Area that is seen, m²."""
    looked_at: float
    """Area with heights inside the radius, m²."""
    missing: float
    """Area inside the radius and the map without heights, m²: it blocks nothing, and nothing is said about it."""

    def json_fields(self) -> dict[str, Any]:
        """Areas in m²."""
        places = {"observer": "name", "x": "X", "y": "Y", "eye_height": "eye"}
        return pick(self, **places, visible_area="visible", area="looked_at", area_without_model="missing")


@dataclass(frozen=True)
class VisibleReport(Result):
    """What came out."""

    path: Path
    bands: tuple[str, ...]
    resolution: float
    earth_radius: float
    horizon: float
    """Distance of the horizon of a smooth earth for the first observer, metres."""
    rows: tuple[VisibleRow, ...]
    earth: str
    """Radius of the earth and refraction, in words."""

    def json_fields(self) -> dict[str, Any]:
        """An infinite horizon (flat earth) becomes null."""
        return pick(self, "path", "bands", "resolution", "earth_radius", "horizon", observers="rows")

    def summary(self) -> Sequence[str]:
        """Return a line for each observer."""
        return [
            f"observer {row.name}: eye at {row.eye:.2f} m, sees {row.visible:.6g} m² of {row.looked_at:.6g} m² "
            f"({row.visible / row.looked_at if row.looked_at else 0.0:.1%}); {row.missing:.6g} m² without heights"
            for row in self.rows
        ]

    def messages(self) -> Sequence[str]:
        """Return bands, pixel size and the model of the earth."""
        far = f"; horizon of a smooth earth {self.horizon:.0f} m" if math.isfinite(self.horizon) else ""
        return [f"bands: {', '.join(self.bands)}; pixel {self.resolution:g} m; {self.earth}{far}"]


def dtm_visible(request: VisibleRequest, events: Events = SILENT) -> VisibleReport:
    """Compute and write a visibility map.

    Raises
    ------
    UsageError
        The output exists or is an input, or a number makes no sense.
    InputError
        The model or the observers cannot be used.
    ResourceError
        The grid does not fit the memory.
    """
    inputs = [request.model, *([request.file] if request.file else [])]
    check_output(request.output, inputs, overwrite=request.overwrite, raster=True)
    terrain = open_terrain(request.model, request.crs)
    places = _places(request, terrain)
    radius = earth_radius(metric_system(terrain.crs).crs, (places[0][1], places[0][2]))
    sight = SightSettings(
        target_height=request.height_target,
        radius=request.radius,
        curvature=request.curvature,
        refraction=request.refraction,
        earth_radius=radius,
    )
    grid = _grid(request, terrain, places)
    _check_memory(grid, len(places), request)
    heights = read_grid(terrain, grid)
    options = GridOptions.of(
        request, "visibility", inputs, events, tile=TILE, resampling="average" if request.minimum_height else "nearest"
    )
    events.begin("lines of sight", len(places) * parts(heights), "parts")
    workers = available_cpus() if request.workers is None else request.workers
    log = ResultLog.beside(request.output, f"{options.key} {grid}", locked=False)
    with log, steps(request.output.name, workers, events, log) as run:
        bands, rows = _look(request, terrain, grid, heights, places, sight, run)
    names = [row.name for row in rows]
    if len(rows) > 1:
        names.insert(0, "least of all" if request.minimum_height else "count")

    def tile(window: Window) -> NDArray[Any]:
        right, bottom = window.stop
        return bands[:, window.row : bottom, window.col : right]

    write_grid(request.output, grid.placement, bands.dtype, len(bands), _nodata(request), tile, options)
    log.remove()
    far = horizon(rows[0].eye - float(terrain.surface.heights(np.array(places[0][1:3]))), sight)
    return VisibleReport(
        path=request.output,
        bands=tuple(names),
        resolution=grid.resolution,
        earth_radius=radius,
        horizon=far,
        rows=tuple(rows),
        earth=f"R = {radius / 1000:.0f} km, k = {request.refraction:g}" if request.curvature else "flat earth",
    )


def _nodata(request: VisibleRequest) -> Any:
    return "auto" if request.minimum_height else 255


Place = tuple[str, float, float, float]
"""Name, X, Y and height of the eye above ground."""


def _places(request: VisibleRequest, terrain: OpenTerrain) -> list[Place]:
    places = [(str(i + 1), x, y, request.height_observer) for i, (x, y) in enumerate(request.points)]
    if request.file is not None:
        places += named_points(request.file, terrain.crs, request.height_observer)
    if not places:
        raise UsageError("no observer; give `points` X Y or `observers` FILE")
    if len(places) > 254:
        raise UsageError(f"{len(places)} observers; at most 254 are counted in one map")
    xmin, ymin, xmax, ymax = terrain.bounds
    for name, x, y, height in places:
        if not (math.isfinite(height) and height >= 0):
            raise UsageError(f"observer {name}: eye {height} m above ground; zero or more metres are needed")
        if not (xmin <= x <= xmax and ymin <= y <= ymax):
            raise InputError(
                f"observer {name} at {x:.10g} {y:.10g} is outside {terrain.path}, which covers {xmin:.10g} {ymin:.10g} "
                f"{xmax:.10g} {ymax:.10g}"
            )
    return places


def named_points(path: Path, crs: str, height: float = 0.0) -> list[Place]:
    """Points of a table (x, y and optionally name, h) or of a vector file in a CRS; `height` where none is stated."""
    if path.suffix.lower() in (".csv", ".txt", ".tsv", ".xyz", ".dat"):
        table = read_table(path, COLUMNS)
        eyes, xy = table.numbers("h", empty=True), table.numbers("x", "y")
        own = np.where(np.isnan(eyes), height, eyes)
        names = table.labels("name", "line {line}")
        return [(name, float(x), float(y), float(h)) for name, (x, y), h in zip(names, xy, own)]
    items = read_features(path, "Point", crs=crs).items
    at = [shapely.get_coordinates(item.geometry).tolist() for item in items]
    if any(len(each) > 1 for each in at):
        raise InputError(f"{path}: holds multipoints; split them into points")
    return [(item.name, x, y, height) for item, ((x, y),) in zip(items, at)]


def _grid(request: VisibleRequest, terrain: OpenTerrain, places: Sequence[Place]) -> MapGrid:
    """The part of the model that any observer looks at."""
    xy = np.array([place[1:3] for place in places])
    low = np.maximum(xy.min(axis=0) - request.radius, terrain.bounds[:2])
    high = np.minimum(xy.max(axis=0) + request.radius, terrain.bounds[2:])
    if request.resolution is not None:
        bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        return MapGrid.covering(bounds, request.resolution, terrain.crs)
    return own_grid(terrain, (float(low[0]), float(low[1])), (float(high[0]), float(high[1])))


def own_grid(terrain: OpenTerrain, low: tuple[float, float], high: tuple[float, float]) -> MapGrid:
    """The grid of a model's own pixels between two corners: of a raster, the middles of the pixels are its posts."""
    mesh, left, top = terrain.resolution, terrain.bounds[0], terrain.bounds[3]
    col0, row0 = math.floor((low[0] - left) / mesh + 1e-6), math.floor((top - high[1]) / mesh + 1e-6)
    col1, row1 = math.ceil((high[0] - left) / mesh - 1e-6), math.ceil((top - low[1]) / mesh - 1e-6)
    return MapGrid(
        left=left + col0 * mesh,
        top=top - row0 * mesh,
        resolution=mesh,
        width=max(1, col1 - col0),
        height=max(1, row1 - row0),
        crs=terrain.crs,
    )


def _check_memory(grid: MapGrid, count: int, request: VisibleRequest) -> None:
    pixel = 4 if request.minimum_height else 1
    need = grid.width * grid.height * (POST_BYTES + pixel * (count + (count > 1)))
    if need > request.memory:
        raise ResourceError(
            f"{grid.width} × {grid.height} posts and {count} observers take {advised(need / 2**30, 3)} GiB, allowed "
            f"are {request.memory / 2**30:.1f}; give a `radius`, a coarser `resolution`, fewer observers or more "
            "`memory`"
        )


def read_grid(terrain: OpenTerrain, grid: MapGrid) -> NDArray[np.float32]:
    """Heights at all pixel centres of a grid, read by tiles; NaN = no surface."""
    heights = np.empty((grid.height, grid.width), np.float32)
    target = MapTarget(grid)
    for window in grid.window.tiles(TILE):
        right, bottom = window.stop
        heights[window.row : bottom, window.col : right] = terrain.surface.relief(target, window)
    return heights


def _look(
    request: VisibleRequest,
    terrain: OpenTerrain,
    grid: MapGrid,
    heights: NDArray[np.float32],
    places: Sequence[Place],
    sight: SightSettings,
    run: Steps,
) -> tuple[NDArray[Any], list[VisibleRow]]:
    """Bands of the map (sum or least first if there are several observers), and figures."""
    several = len(places) > 1
    kind = np.float32 if request.minimum_height else np.uint8
    bands = np.zeros((len(places) + several, *heights.shape), kind)
    rows = []
    for i, (name, X, Y, above) in enumerate(places):
        ground = float(terrain.surface.heights(np.array([X, Y])))
        if not math.isfinite(ground):
            raise InputError(f"observer {name} at {X:.10g} {Y:.10g}: {request.model} has no height there")
        column, row = grid.to_pixel((X, Y))
        observer = Observer(float(column), float(row), ground + above, name)
        need = needed_heights(
            heights, grid.resolution, observer, sight, only_whether=not request.minimum_height, run=run
        )
        known = np.isfinite(need) | np.isposinf(need)
        seen = need <= request.height_target
        bands[i + several] = need if request.minimum_height else np.where(known, seen, 255)
        rows.append(_row(request, grid, heights, observer, known, seen, (X, Y)))
    if several:
        each = bands[1:]
        if request.minimum_height:
            np.fmin.reduce(each, axis=0, out=bands[0])
        else:
            nobody = (each == 255).all(axis=0)
            # Beyond the radius of one observer, but not of another: not seen by the one.
            each[(each == 255) & ~nobody] = 0
            bands[0] = np.where(nobody, 255, each.sum(axis=0))
    return bands, rows


def _row(
    request: VisibleRequest,
    grid: MapGrid,
    heights: NDArray[np.float32],
    observer: Observer,
    known: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    XY: tuple[float, float],
) -> VisibleRow:
    pixel = grid.resolution**2
    across = np.square(np.arange(grid.width) - observer.column)
    down = np.square(np.arange(grid.height) - observer.row)
    holes = sum(
        int((np.isnan(heights[j]) & (across + down[j] <= (request.radius / grid.resolution) ** 2)).sum())
        for j in range(grid.height)
    )
    return VisibleRow(
        observer.name, *XY, observer.eye, float(seen.sum()) * pixel, float(known.sum()) * pixel, holes * pixel
    )
