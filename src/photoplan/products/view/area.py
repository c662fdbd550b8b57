"""The visible area of a view: which places of the map its picture shows, as a raster or as a polygon."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.engine.executors import available_cpus
from photoplan.engine.steps import steps
from photoplan.errors import UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.polygons import label_polygons, write_features
from photoplan.io.product import check_output
from photoplan.io.run_record import recording
from photoplan.plain import pick
from photoplan.products.dtm.raster import GridOptions, write_grid
from photoplan.products.view.camera import ViewCamera, view_camera
from photoplan.products.view.ground import ViewGround, open_view_ground
from photoplan.products.view.job import seen_surface
from photoplan.products.view.make import ViewRequest, camera_request
from photoplan.surfaces.seen_lines import LinesOfSight

#: Side of the windows in which places are asked, pixels.
TILE = 256
#: Pixels along the longer side of a map whose resolution is not stated.
_USUAL = 1000
#: Pixels of a map at most: all of them are held, one byte each.
_MOST = 400_000_000
SEEN, HIDDEN, NO_TERRAIN = 1, 0, 255


@dataclass(frozen=True)
class AreaRequest:
    """What is asked."""

    view: ViewRequest
    output: Path
    """``.tif``: 1 seen, 0 not seen, 255 no terrain; ``.gpkg``: a multipolygon along the edges of those pixels."""
    resolution: float | None = None
    """Side of a pixel of the map, metres; None: a thousandth of its longer side, rounded to 1, 2 or 5."""
    workers: int | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class VisibleArea:
    """What came out."""

    output: Path
    seen: float
    """Area that the picture shows, on the map, m²."""
    looked_at: float
    """Area of the map with terrain, m²."""
    resolution: float

    def json_fields(self) -> dict[str, Any]:
        """Areas in m²."""
        return pick(self, "output", "resolution", visible_area="seen", area="looked_at")


def visible_area(request: AreaRequest, events: Events = SILENT) -> VisibleArea:
    """Find what a view shows of the map, and write it.

    The middle of each pixel is asked, on the ground or on the roof above it, whether it lies in the picture and nothing
    is in the way of the ray to a place a tenth of a pixel of the picture above it. Walls have no area on a map.

    Raises
    ------
    UsageError
        The output exists or is of no such format, or terrain without end has no `farthest`.
    InputError
        A file cannot be used.
    GeometryError
        The point of view lies below the ground.
    """
    view, output = request.view, request.output
    if output.suffix.lower() not in (".tif", ".tiff", ".gpkg"):
        raise UsageError(f"{output}: a visible area is written as .tif (a raster) or .gpkg (a polygon)")
    inputs = [each for each in (view.source, view.matrix) if each is not None]
    check_output(output, inputs, overwrite=request.overwrite)
    with recording("view area", request, inputs) as record:
        ground = open_view_ground(view.source, view.crs, view.water)
        check_output(output, ground.files, overwrite=request.overwrite)
        camera = view_camera(camera_request(view), ground, view.force)
        grid = _grid(request, ground, camera)
        sight = LinesOfSight(camera.target, seen_surface(ground, view.farthest, view.bound))
        found = _all(partial(window_of_area, sight, grid), grid, request, events)
        result = VisibleArea(
            output,
            int((found == SEEN).sum()) * grid.resolution**2,
            int((found != NO_TERRAIN).sum()) * grid.resolution**2,
            grid.resolution,
        )
        if output.suffix.lower() == ".gpkg":
            _write_polygon(output, found, grid)
            record([output], {"camera": camera, "area": result})
    if output.suffix.lower() != ".gpkg":
        _write_raster(request, found, grid, ground, camera)
    return result


def window_of_area(sight: LinesOfSight, grid: MapGrid, window: Window) -> NDArray[np.uint8]:
    """A window of the map, shape (height, width): `SEEN`, `HIDDEN` or `NO_TERRAIN`."""
    v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
    XY = grid.to_map(np.stack([u, v], axis=-1)).reshape(-1, 2)
    XYZ = np.column_stack([XY, sight.surface.terrain.heights(XY)])
    there = np.isfinite(XYZ[:, 2])
    out = np.full(len(XYZ), NO_TERRAIN, np.uint8)
    out[there] = np.where(sight.points(XYZ[there]).shown, SEEN, HIDDEN)
    return out.reshape(window.height, window.width)


def _all(window_of: Any, grid: MapGrid, request: AreaRequest, events: Events) -> NDArray[np.uint8]:
    """All windows of the map together."""
    out = np.empty((grid.height, grid.width), np.uint8)
    windows = [*grid.window.tiles(TILE)]
    events.begin("visible area", len(windows), "tiles")
    with steps(request.output.name, available_cpus() if request.workers is None else request.workers, events) as run:
        for window, values in zip(windows, run(window_of, windows, pixels=lambda window: window.size)):
            out[window.slices(grid.window)] = values
    return out


def _grid(request: AreaRequest, ground: ViewGround, camera: ViewCamera) -> MapGrid:
    """The map of all terrain that is not too far away."""
    far, (x, y, _) = request.view.farthest, camera.target.center.tolist()
    box = np.array([x - far, y - far, x + far, y + far])
    if ground.bounds is not None:
        box[:2], box[2:] = np.maximum(box[:2], ground.bounds[:2]), np.minimum(box[2:], ground.bounds[2:])
    if not np.isfinite(box).all():
        raise UsageError("the terrain has no end; say how far to look (`farthest`)")
    size = box[2:] - box[:2]
    if (size <= 0).any():
        raise UsageError(f"no terrain within {far:g} m (`farthest`) of the standpoint {x:.2f} {y:.2f}")
    step = request.resolution
    if step is None:
        step = _rounded(float(size.max()) / _USUAL)
    grid = MapGrid.covering((float(box[0]), float(box[1]), float(box[2]), float(box[3])), step, ground.crs)
    if grid.width * grid.height > _MOST:
        raise UsageError(
            f"resolution {step:g} m gives {grid.width} × {grid.height} pixels, more than {_MOST:.0e}; choose a larger "
            "`resolution`, or look less far (`farthest`)"
        )
    return grid


def _rounded(step: float) -> float:
    """The next larger of 1, 2 and 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(k * power for k in (1, 2, 5, 10) if k * power >= step * (1 - 1e-9))


def _write_polygon(path: Path, found: NDArray[np.uint8], grid: MapGrid) -> None:
    shapes = [*label_polygons((found == SEEN).astype(np.int32), grid).values()]
    area = np.array([shape.area for shape in shapes], float)
    write_features(path, "MultiPolygon", shapes, {"area_m2": area}, grid.crs, "visible_area")


def _write_raster(
    request: AreaRequest, found: NDArray[np.uint8], grid: MapGrid, ground: ViewGround, camera: ViewCamera
) -> None:
    options = GridOptions(
        kind="view area",
        settings={**camera.json_fields(), "farthest_m": request.view.farthest, "error_bound_m": request.view.bound},
        inputs=ground.files,
        workers=request.workers,
        overwrite=request.overwrite,
        resampling="nearest",
    )
    write_grid(request.output, grid.placement, np.uint8, 1, NO_TERRAIN,
               lambda window: found[None, *window.slices(grid.window)], options)  # fmt: skip
