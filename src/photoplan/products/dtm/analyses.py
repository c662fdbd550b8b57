"""Volumes, visibility, and flow of water."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.engine.executors import available_cpus
from photoplan.engine.run import Steps, steps
from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.grid import USUAL_TILE, MapGrid, Window, check_resolution, refuse_absurd
from photoplan.geometry.heights import common_system
from photoplan.geometry.local import earth_radius
from photoplan.geometry.units import metric_system
from photoplan.io.product import check_output
from photoplan.io.store import ResultLog, together, when_named
from photoplan.io.tables import Columns, read_table
from photoplan.io.vector_layer import Feature, check_vectors, label_polygons, read_features, write_features
from photoplan.plain import advised, pick
from photoplan.products.dtm.rasters import GridOptions, write_grid
from photoplan.project.ground import OpenTerrain, open_terrain
from photoplan.requests.terrain import FlowRequest, VisibleRequest, VolumeRequest
from photoplan.targets.map import MapTarget
from photoplan.terrain.analysis import (
    CELL_BYTES,
    Flow,
    Observer,
    SightSettings,
    flow_of,
    horizon,
    needed_heights,
    parts,
    snapped,
)
from photoplan.terrain.volume import TILE, ErrorModel, Volume, VolumeSettings, VolumeSigma, volume_between, volume_sigma


@dataclass(frozen=True)
class VolumeRow:
    """Figures of one polygon."""

    name: str
    volume: Volume
    sigma: VolumeSigma | None

    def json_fields(self) -> dict[str, Any]:
        """m³, m², metres."""
        v, s = self.volume, self.sigma
        errors = {f"integration_error_{name}": f"error_{name}" for name in ("cut", "fill", "net")}
        sigmas = {f"sigma_{name}": None if s is None else getattr(s, name) for name in ("cut", "fill", "net")}
        own = pick(
            v, "cut", "fill", "net", "area", "cell", area_without_model="missing", within_tolerance="settled", **errors
        )
        return {"polygon": self.name, **own, **sigmas}


@dataclass(frozen=True)
class VolumeReport(Result):
    """What came out."""

    rows: tuple[VolumeRow, ...]
    height_system: str
    notes: tuple[str, ...]
    """What a reader of the figures must know."""
    difference: Path | None

    def json_fields(self) -> dict[str, Any]:
        """The rows as volumes."""
        return pick(self, "height_system", "difference", "notes", volumes="rows")

    def summary(self) -> Sequence[str]:
        """Return the table of volumes."""
        w = max(7, *(len(row.name) for row in self.rows))
        lines = [f"{'polygon':<{w}}  {'cut m³':>14} {'fill m³':>14} {'net m³':>14} {'area m²':>13} {'no model m²':>13}"]
        for name, v, s in ((row.name, row.volume, row.sigma) for row in self.rows):
            areas = f"{v.area:>13.1f} {v.missing:>13.1f}"
            lines.append(f"{name:<{w}}  {v.cut:>14.2f} {v.fill:>14.2f} {v.net:>14.2f} {areas}")
            changes = f"{v.error_cut:>13.2g}i {v.error_fill:>13.2g}i {v.error_net:>13.2g}i"
            lines.append(f"{'':<{w}}  {changes}  cells {v.cell:g} m")
            if s is not None:
                lines.append(f"{'':<{w}}  {s.cut:>13.2f}σ {s.fill:>13.2f}σ {s.net:>13.2f}σ")
        return [*lines, "i: change with the last halving of the cells; σ: standard deviation from that of the heights"]

    def messages(self) -> Sequence[str]:
        """Return the height system and the notes."""
        return [f"height system: {self.height_system}", *noted(self.notes)]


def dtm_volume(request: VolumeRequest, events: Events = SILENT) -> VolumeReport:
    """Volumes from terrain A to terrain B.

    Raises
    ------
    UsageError
        The raster of differences exists, or is an input.
    HeightSystemError
        The height systems differ, or are not stated.
    InputError
        A file cannot be used, CRSs differ, or the two models have nothing in common.
    """
    inputs = [request.a, request.b, *([request.polygons] if request.polygons else [])]
    if request.difference is not None:
        check_output(request.difference, inputs, overwrite=request.overwrite, raster=True)
    a, b = (open_terrain(path, request.crs) for path in (request.a, request.b))
    system = common_system({t.path: t.height_system for t in (a, b)}, request.height_system) or "same, not named"
    if not same_crs(a.crs, b.crs):
        raise InputError(
            f"{a.path} is in {crs_label(a.crs)}, {b.path} in {crs_label(b.crs)}; bring both into one CRS first"
        )
    items = _polygons(request.polygons, a, b)
    cell = request.resolution or min(a.resolution, b.resolution)
    check_resolution(cell / 2)
    for item in items:
        xmin, ymin, xmax, ymax = item.geometry.bounds
        halves = 2 * (xmax - xmin) / cell, 2 * (ymax - ymin) / cell
        refuse_absurd(halves, USUAL_TILE, f"{item.name}: resolution {cell:g} m, halved to see how exact it is,")
    settings = VolumeSettings(cell, 0.0 if request.resolution else request.tolerance)
    errors, notes = _errors(request, a, b)
    options = GridOptions.of(request, "difference", inputs, events, tile=TILE)
    log = None
    if request.difference is not None:
        log = ResultLog.beside(request.difference, f"{options.key} {settings}", locked=False)
    events.begin("volumes", 0, "windows")
    rows = []
    # One window at once: a prepared polygon makes its index when it is first asked, whoever else asks it meanwhile.
    with log or nullcontext(), steps("volumes", 1, events, log) as run:

        def counted(function: Callable[[Any], Any], windows: Iterable[Any]) -> Iterator[Any]:
            # How often cells are halved is not known beforehand: each round adds its windows to the total.
            every = list(windows)
            events.more(len(every))
            return run(function, every)

        for item in items:
            volume, sigma = volume_between(a.surface, b.surface, item.geometry, settings, counted), None
            if errors is not None:
                of_errors = partial(volume_sigma, a.surface, b.surface, errors, cell=cell, bias=request.bias)
                (sigma,) = counted(of_errors, [item.geometry])
            rows.append(VolumeRow(item.name, volume, sigma))
    notes += [note for row in rows for note in _notes(row)]
    if log is not None and request.difference is not None:
        _write_difference(request.difference, (a, b), items, cell, options)
        log.remove()
    return VolumeReport(tuple(rows), system, tuple(notes), request.difference)


def _notes(row: VolumeRow) -> list[str]:
    """What is to be said about one polygon."""
    notes = []
    if row.sigma is not None and row.sigma.unknown > 0:
        notes.append(f"{row.name}: on {row.sigma.unknown:.6g} m² a model has no standard deviation")
    if not row.volume.settled:
        notes.append(f"{row.name}: not within the tolerance; see the change with the last halving of the cells")
    return notes


def _polygons(path: Path | None, a: OpenTerrain, b: OpenTerrain) -> tuple[Feature, ...]:
    """The polygons, or the rectangle that both models share."""
    common = np.maximum(a.bounds[:2], b.bounds[:2]), np.minimum(a.bounds[2:], b.bounds[2:])
    if not (common[0] < common[1]).all():
        raise InputError(f"{a.path} covers {_text(a.bounds)}, {b.path} {_text(b.bounds)}: they have nothing in common")
    if path is None:
        return (Feature("all", shapely.box(*common[0], *common[1])),)
    read = read_features(path, "Polygon", crs=a.crs)
    return tuple(Feature(item.name, shapely.force_2d(item.geometry)) for item in read.items)


def _text(bounds: tuple[float, float, float, float]) -> str:
    return " ".join(f"{v:.10g}" for v in bounds)


def _errors(
    request: VolumeRequest, a: OpenTerrain, b: OpenTerrain
) -> tuple[tuple[ErrorModel, ErrorModel] | None, list[str]]:
    """How both models err, or why the volumes have no standard deviation."""
    models = []
    for letter, terrain, given in (("a", a, request.sigma_a), ("b", b, request.sigma_b)):
        sigma = given if given is not None else _own(terrain)
        if sigma is None:
            return None, [f"no standard deviation: {terrain.path} has none of its own; give `sigma_{letter}` METRES"]
        models.append(ErrorModel(sigma, request.correlation or terrain.resolution))
    return (models[0], models[1]), []


def _own(terrain: OpenTerrain) -> Callable[[NDArray[np.float64]], NDArray[np.float64]] | None:
    return None if terrain.errors is None else terrain.errors.sigmas


def _write_difference(
    path: Path, both: tuple[OpenTerrain, OpenTerrain], items: tuple[Feature, ...], cell: float, options: GridOptions
) -> None:
    """B − A as a raster over all polygons."""
    a, b = both
    bounds = shapely.total_bounds(np.array([item.geometry for item in items], object))
    grid = MapGrid.covering(tuple(float(v) for v in bounds), cell, a.crs)  # type: ignore[arg-type]
    target = MapTarget(grid)

    def tile(window: Window) -> NDArray[np.float32]:
        return np.asarray(b.surface.relief(target, window) - a.surface.relief(target, window))[None]

    write_grid(path, grid.placement, np.float32, 1, "auto", tile, options)


TILE_VISIBLE = 512
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
        request,
        "visibility",
        inputs,
        events,
        tile=TILE_VISIBLE,
        resampling="average" if request.minimum_height else "nearest",
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
    for window in grid.window.tiles(TILE_VISIBLE):
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


TILE_FLOW = 512
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
    grid = _grid_flow(request, terrain)
    heights = read_grid(terrain, grid)
    options = GridOptions.of(
        request, "flow", inputs, events, tile=TILE_FLOW, resampling="nearest", tags={"BANDS": "; ".join(BANDS)}
    )
    log = ResultLog.beside(request.output, f"{options.key} {grid}", locked=False)
    snapping = bool(points) and request.snap > 0
    events.begin("flow", 1 + snapping, "steps")
    with log, steps(request.output.name, 1, events, log) as run:
        # Upstream areas do not depend on outlets.
        area = next(run(partial(_area, grid.resolution), [heights])) if snapping else _there(heights)
        cells = _cells(request, grid, area, points)
        (flow,) = run(partial(flow_of, cell=grid.resolution, outlets=cells, method=request.method), [heights])
    rows = [
        _row_flow(flow, grid, number, name, cell) for number, ((name, *_), cell) in enumerate(zip(points, cells), 1)
    ]
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


def _grid_flow(request: FlowRequest, terrain: OpenTerrain) -> MapGrid:
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


def _row_flow(flow: Flow, grid: MapGrid, number: int, name: str, cell: tuple[int, int]) -> OutletRow:
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
