"""Picking in views: the ground of single pixels, and the pixels of ground points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.io.product import check_output
from photoplan.io.run_record import recording
from photoplan.io.tables import Columns, read_table, write_table
from photoplan.products.view.camera import ViewCamera, view_camera
from photoplan.products.view.ground import ViewGround, open_view_ground
from photoplan.products.view.job import seen_surface
from photoplan.products.view.make import ViewRequest, camera_request
from photoplan.surfaces.seen import Seen, ground_size

#: Ground is what a ray meets if it lies no farther behind that than so much of its distance, and so many metres.
_SAME, _SAME_METRES = 1e-5, 0.05
#: Columns and rows beyond this belong to no picture.
_FAR = 1e6
NUMBERS = ("x", "y", "E", "N", "H", "distance", "incidence_deg", "pixel_m")


@dataclass(frozen=True)
class PickRequest:
    """What is asked."""

    view: ViewRequest
    pixels: tuple[tuple[float, float], ...] = ()
    """Column, row."""
    points: tuple[tuple[float, ...], ...] = ()
    """X, Y or X, Y, Z; without Z on the ground."""
    file: Path | None = None
    """More ground points: a table with columns x, y and optionally z, name."""
    output: Path | None = None
    """Table of what was picked; None: it is only returned."""
    overwrite: bool = False


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
    """Of a pixel whether it shows ground; of a point whether it is in the picture and nothing hides it."""

    def json_fields(self) -> dict[str, Any]:
        """All of it."""
        return vars(self)


def pick(request: PickRequest) -> tuple[Picked, ...]:
    """Ground of pixels, and pixels of ground points, in the order of the request.

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
        check_output(request.output, [request.view.source], overwrite=request.overwrite)
    inputs = [request.view.source, request.file, request.view.matrix]
    with recording("view pick", request, inputs) as record:
        ground = open_view_ground(request.view.source, request.view.crs, request.view.water)
        camera = view_camera(camera_request(request.view), ground, request.view.force)
        found = [*_of_pixels(request, ground, camera), *_of_points(request, ground, camera)]
        if request.output is not None:
            write_table(
                request.output,
                ("name", *NUMBERS, "surface", "seen"),
                [[_text(v) for v in vars(each).values()] for each in found],
            )
        record([request.output], {"camera": camera, "picked": len(found), "seen": sum(each.seen for each in found)})
    return tuple(found)


def _of_pixels(request: PickRequest, ground: ViewGround, camera: ViewCamera) -> list[Picked]:
    if not request.pixels:
        return []
    surface = seen_surface(ground, request.view.farthest, request.view.bound)
    seen = surface.at(camera.target, np.array(request.pixels, float))
    names = [f"pixel {k}" for k in range(1, len(request.pixels) + 1)]
    return _told(names, ground, camera, seen, seen.owner >= 0)


def _of_points(request: PickRequest, ground: ViewGround, camera: ViewCamera) -> list[Picked]:
    names, XYZ = _points(request, ground)
    if not len(XYZ):
        return []
    target = camera.target
    uvh = target.to_view(XYZ)
    surface = seen_surface(ground, request.view.farthest, request.view.bound)
    met = surface.at(target, uvh[:, :2])
    with np.errstate(invalid="ignore"):
        inside = ((uvh[:, :2] >= -0.5) & (uvh[:, :2] <= np.array(target.bundle.size) - 0.5)).all(axis=1)
        free = ~(met.uvh[:, 2] < uvh[:, 2] * (1 - _SAME) - _SAME_METRES)
    shown = inside & free & (uvh[:, 2] > 0) & (target.distance(uvh) <= request.view.farthest)
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
