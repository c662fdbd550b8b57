"""Measurements in perspective views: picked points, visible areas."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.engine.executors import available_cpus
from photoplan.engine.run import steps
from photoplan.errors import UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.product import check_output
from photoplan.io.store import recording
from photoplan.io.tables import Columns, read_table, write_table
from photoplan.io.vector_layer import label_polygons, write_features
from photoplan.plain import pick as attributes
from photoplan.products.dtm.rasters import GridOptions, write_grid
from photoplan.products.view.camera import ViewCamera, ViewGround, open_view_ground, view_camera
from photoplan.products.view.make import camera_request, seen_surface
from photoplan.requests.view import AreaRequest, PickRequest
from photoplan.surfaces.seen import LinesOfSight, Seen, ground_size

#: Side of the windows in which places are asked, pixels.
TILE = 256
#: Pixels along the longer side of a map whose resolution is not stated.
_USUAL = 1000
#: Pixels of a map at most: all of them are held, one byte each.
_MOST = 400_000_000
SEEN, HIDDEN, NO_TERRAIN = 1, 0, 255


@dataclass(frozen=True)
class VisibleArea(Result):
    """Areas of the map that a view shows."""

    output: Path
    seen: float
    """Area that the picture shows, on the map, m²."""
    looked_at: float
    """Area of the map with terrain, m²."""
    resolution: float

    def messages(self) -> Sequence[str]:
        """Return the areas."""
        share = self.seen / self.looked_at if self.looked_at else 0.0
        areas = f"{self.seen / 1e6:.6g} of {self.looked_at / 1e6:.6g} km² are seen ({share:.1%})"
        return [f"{areas}; pixel {self.resolution:g} m"]

    def json_fields(self) -> dict[str, Any]:
        """Return areas in m²."""
        return attributes(self, "output", "resolution", visible_area="seen", area="looked_at")


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
    output = request.output
    if output.suffix.lower() not in (".tif", ".tiff", ".gpkg"):
        raise UsageError(f"{output}: a visible area is written as .tif (a raster) or .gpkg (a polygon)")
    inputs = request.files_read()
    check_output(output, inputs, overwrite=request.overwrite)
    with recording("view area", request, inputs) as record:
        ground = open_view_ground(request.source, request.crs, request.water)
        check_output(output, ground.files, overwrite=request.overwrite)
        camera = view_camera(camera_request(request, request.matrix), ground, request.force)
        grid = _grid(request, ground, camera)
        sight = LinesOfSight(camera.target, seen_surface(ground, request.farthest, request.bound))
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
    far, (x, y, _) = request.farthest, camera.target.center.tolist()
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
        settings={**camera.json_fields(), "farthest_m": request.farthest, "error_bound_m": request.bound},
        inputs=ground.files,
        workers=request.workers,
        overwrite=request.overwrite,
        resampling="nearest",
    )
    write_grid(request.output, grid.placement, np.uint8, 1, NO_TERRAIN,
               lambda window: found[None, *window.slices(grid.window)], options)  # fmt: skip


#: Ground is what a ray meets if it lies no farther behind that than so much of its distance, and so many metres.
_SAME, _SAME_METRES = 1e-5, 0.05
#: Columns and rows beyond this belong to no picture.
_FAR = 1e6
NUMBERS = ("x", "y", "E", "N", "H", "distance", "incidence_deg", "pixel_m")


@dataclass(frozen=True)
class Picked:
    """A pixel and the ground that belongs to it."""

    name: str
    x: float
    y: float
    """Pixel: column, row; NaN: the point lies behind the camera."""
    E: float
    N: float
    H: float
    """Ground, metres; NaN: sky."""
    distance: float
    incidence_deg: float
    pixel_m: float
    """Side of the pixel on the ground."""
    surface: str
    """`terrain`, the name of an object, or `sky`; of a hidden point what hides it."""
    seen: bool
    """True if a pixel shows ground, or if a point is in the picture and nothing hides it."""

    def __str__(self) -> str:
        if self.E != self.E:
            return f"{self.name}: {self.x:.3f} {self.y:.3f} = sky: sky"
        if self.H != self.H:
            return f"{self.name}: {self.E:.3f} {self.N:.3f}: not seen (the terrain has no height there)"
        where = f"{self.E:.3f} {self.N:.3f} {self.H:.3f}"
        if self.x != self.x:
            return f"{self.name}: behind the camera = {where}: not seen"
        state = self.surface if self.seen else f"not seen ({self.surface})"
        away = f"{self.distance:.2f} m away, pixel {self.pixel_m:.3g} m"
        return f"{self.name}: {self.x:.3f} {self.y:.3f} = {where}: {state}, {away}"

    def json_fields(self) -> dict[str, Any]:
        """Return all of it."""
        return vars(self)


@dataclass(frozen=True)
class PickReport(Result):
    """Pixels and points with the ground that belongs to them."""

    picked: tuple[Picked, ...]
    output: Path | None

    def summary(self) -> Sequence[str]:
        """Return a line for each, unless they are written as a table."""
        return [str(each) for each in self.picked] if self.output is None else ()


def pick(request: PickRequest) -> tuple[Picked, ...]:
    """Return the ground of pixels, and pixels of ground points, in the order of the request; see `pick_points`."""
    return pick_points(request).picked


def pick_points(request: PickRequest, events: Events = SILENT) -> PickReport:
    """Find the ground of pixels, and pixels of ground points, and write them as a table if it is asked for.

    Raises
    ------
    UsageError
        Nothing is asked, a pixel lies beyond all pictures, or the output exists.
    InputError
        A file cannot be used.
    GeometryError
        The point of view lies below the ground.
    """
    if not (request.pixels or request.points or request.file):
        raise UsageError("nothing to pick; give `pixels` X Y, `points` X Y or a `file` of points")
    for x, y in request.pixels:
        if not max(abs(x), abs(y)) <= _FAR:
            raise UsageError(f"`pixel` {x:g} {y:g}; positions up to {_FAR:g} are allowed, also outside the picture")
    if request.output is not None:
        check_output(request.output, [request.source], overwrite=request.overwrite)
    with recording("view pick", request, request.files_read()) as record:
        ground = open_view_ground(request.source, request.crs, request.water)
        camera = view_camera(camera_request(request, request.matrix), ground, request.force)
        found = [*_of_pixels(request, ground, camera), *_of_points(request, ground, camera)]
        if request.output is not None:
            write_table(
                request.output,
                ("name", *NUMBERS, "surface", "seen"),
                [[_text(v) for v in vars(each).values()] for each in found],
            )
        record([request.output], {"camera": camera, "picked": len(found), "seen": sum(each.seen for each in found)})
    return PickReport(tuple(found), request.output)


def _of_pixels(request: PickRequest, ground: ViewGround, camera: ViewCamera) -> list[Picked]:
    if not request.pixels:
        return []
    surface = seen_surface(ground, request.farthest, request.bound)
    seen = surface.at(camera.target, np.array(request.pixels, float))
    names = [f"pixel {k}" for k in range(1, len(request.pixels) + 1)]
    return _told(names, ground, camera, seen, seen.owner >= 0)


def _of_points(request: PickRequest, ground: ViewGround, camera: ViewCamera) -> list[Picked]:
    names, XYZ = _points(request, ground)
    if not len(XYZ):
        return []
    target = camera.target
    uvh = target.to_view(XYZ)
    surface = seen_surface(ground, request.farthest, request.bound)
    met = surface.at(target, uvh[:, :2])
    with np.errstate(invalid="ignore"):
        inside = ((uvh[:, :2] >= -0.5) & (uvh[:, :2] <= np.array(target.bundle.size) - 0.5)).all(axis=1)
        free = ~(met.uvh[:, 2] < uvh[:, 2] * (1 - _SAME) - _SAME_METRES)
    shown = inside & free & (uvh[:, 2] > 0) & (target.distance(uvh) <= request.farthest)
    own = Seen(XYZ=XYZ, uvh=uvh, normal=met.normal, towards=met.towards, owner=met.owner, lost=met.lost)
    return _told(names, ground, camera, own, shown)


def _points(request: PickRequest, ground: ViewGround) -> tuple[list[str], NDArray[np.float64]]:
    names = [f"point {k}" for k in range(1, len(request.points) + 1)]
    rows = [[*point, np.nan][:3] for point in request.points]
    if request.file is not None:
        roles = {
            "x": ("x", "e", "east", "easting"),
            "y": ("y", "n", "north", "northing"),
            "z": ("z", "h", "height"),
            "name": ("name", "id", "point"),
        }
        table = read_table(request.file, Columns(roles=roles, needed=("x", "y"), row="point"))
        heights = table.numbers("z", empty=True).ravel()
        rows += np.column_stack([table.numbers("x", "y"), heights]).tolist()
        names += list(table.labels("name", "line {line}"))
    XYZ = np.array(rows, float).reshape(-1, 3)
    level = np.isnan(XYZ[:, 2])
    if level.any():
        XYZ[level, 2] = ground.terrain.heights(XYZ[level, :2])
    return names, XYZ


def _told(
    names: list[str], ground: ViewGround, camera: ViewCamera, seen: Seen, shown: NDArray[np.bool_]
) -> list[Picked]:
    surfaces = ("sky", "terrain", *ground.objects)
    away = camera.target.distance(seen.uvh)
    size, incidence = ground_size(camera.target, seen), np.degrees(seen.incidence)
    numbers = np.column_stack([seen.uvh[:, :2], seen.XYZ, away, incidence, size]).tolist()
    return [
        Picked(name=name, surface=surfaces[owner + 1], seen=bool(is_shown), **dict(zip(NUMBERS, row)))
        for name, row, owner, is_shown in zip(names, numbers, seen.owner, shown)
    ]


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4f}" if np.isfinite(value) else ""
    return str(value)
