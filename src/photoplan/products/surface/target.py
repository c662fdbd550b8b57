"""What a surface lies over: a map, a wall, or what an image sees; and which images see it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera
from photoplan.cameras.base import project as project_points
from photoplan.cameras.framed import FramedCamera
from photoplan.errors import GeometryError, UsageError
from photoplan.events import Events
from photoplan.geometry.bounds import HIGHEST_FLIGHT, area_fault, odd_place
from photoplan.geometry.cylinder import CylinderFrame
from photoplan.geometry.frames import Frame, ImageFrame, WallFrame
from photoplan.io.project.model import Project
from photoplan.plan.footprint import image_border
from photoplan.products.orthophoto.look import look_at
from photoplan.products.surface.settings import Bounds
from photoplan.project.scene import Scene, map_order, open_scene

#: Points along a side of a target that are projected to see which images show it.
_POINTS = 33
#: Metres over which an image's projection is taken apart; from a straight line it differs by less than this part.
_APART, _STRAIGHT = 1024.0, 1e-6
#: Nearest of what an image shows, metres.
_NEAR = 0.001
#: Metres by which a place of a target lies beside a ray that meets it.
_SAME = 1e-3
_FORMS = (
    "`map`, `wall:X,Y,Z,AZIMUTH[,TILT]`, `vault:X,Y,Z,AZIMUTH,RADIUS[,TILT]`, `column:X,Y,Z,AZIMUTH,RADIUS` or "
    "`image:NAME[,DISTANCE]`"
)
#: Radii of vaults and columns, metres.
_RADII = (0.01, 10_000.0)
#: How many numbers each target has; what they are.
_NUMBERS = {
    "wall": (
        (4, 5),
        "`wall:X,Y,Z,AZIMUTH[,TILT]`: a point of the wall in the project's CRS, the azimuth of its outward normal from "
        "north by east (-360 to 360), and by how much that is raised (-90 to 90), degrees",
    ),
    "vault": (
        (5, 6),
        "`vault:X,Y,Z,AZIMUTH,RADIUS[,TILT]`: a point of its axis in the project's CRS, the azimuth of the axis from "
        f"north by east (-360 to 360), the radius ({_RADII[0]:g} to {_RADII[1]:g} m), and by how much the axis rises "
        "(-90 to 90), degrees",
    ),
    "column": (
        (5, 5),
        "`column:X,Y,Z,AZIMUTH,RADIUS`: a point of its axis in the project's CRS, the azimuth that its middle faces, "
        f"from north by east (-360 to 360), and the radius ({_RADII[0]:g} to {_RADII[1]:g} m)",
    ),
}


@dataclass(frozen=True, eq=False)
class SeenTarget:
    """What an image sees of a target."""

    name: str
    camera: Camera
    """In the target's coordinates."""
    bounds: Bounds
    """Of everything that it sees there."""
    heights: tuple[float, float]
    """Between which that lies."""
    gsd: float
    """Its mean ground sampling distance, metres."""


def seen_places(one: SeenTarget, bounds: Bounds) -> NDArray[np.bool_]:
    """Which points of a lattice over the bounds, the same for all, an image sees on the mean of its heights."""
    u, v = (bounds[k] + (bounds[k + 2] - bounds[k]) * (np.arange(_POINTS) + 0.5) / _POINTS for k in (0, 1))
    at = project_points(one.camera, np.stack([*np.meshgrid(u, v), np.full((_POINTS,) * 2, sum(one.heights) / 2)], -1))
    return _inside(one.camera, at)


def _inside(camera: Camera, at: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which image points (..., 2) lie on pixels; NaN does not."""
    return np.asarray(((at > -0.5) & (at < np.array(camera.size) - 0.5)).all(axis=-1))


def over_map(project: Project, names: Sequence[str], force: bool, events: Events) -> tuple[list[SeenTarget], list[str]]:
    """Images that see terrain, and a line for each that sees none; see `look_at`."""
    looked, blind = look_at(project, names, force, events)
    prints = [(one, one.look.footprint) for one in looked]
    seen = [
        SeenTarget(
            name=one.name,
            camera=one.scene.camera,
            bounds=print_.bounds,
            heights=print_.height_range,
            gsd=one.look.gsd,
        )
        for one, print_ in prints
        if print_.bounds is not None
    ]
    return seen, blind


def over_frame(
    project: Project, names: Sequence[str], frame: Frame, bounds: Bounds, height: float, events: Events
) -> tuple[list[SeenTarget], list[str]]:
    """Images that see a part of a target at a height, and a line for each that sees none.

    Raises
    ------
    GeometryError
        All images stand behind the target.
    """
    u, v = (np.linspace(bounds[k], bounds[k + 2], _POINTS) for k in (0, 1))
    uvh = np.stack([*np.meshgrid(u, v), np.full((_POINTS, _POINTS), height)], axis=-1).reshape(-1, 3)
    seen, blind, behind = {}, [], 0
    for name in (names[place] for place in map_order(project, names)):
        camera = FramedCamera(open_scene(project, name).camera, frame, bounds)
        at = project_points(camera, uvh)
        # From behind nothing of a wall is seen, nor the far side of a column.
        point, way = camera.rays(at, height)
        along = np.abs((uvh - point) - ((uvh - point) * way).sum(axis=1)[:, None] * way).max(axis=1)
        inside = _inside(camera, at) & (way[:, 2] < 0) & (along < _SAME)
        events.done()
        if not inside.any():
            stands = frame.inverse(camera.camera.vantage.point)
            behind += bool(stands[2] <= height)
            here = ", from u {:.6g}, v {:.6g}, h {:.6g}".format(*stands) if np.isfinite(stands).all() else ""
            blind.append(f"{name}: shows nothing of the target inside the bounds at the height {height:g}{here}")
            continue
        low, high = uvh[inside, :2].min(axis=0).tolist(), uvh[inside, :2].max(axis=0).tolist()
        areas = np.abs(np.linalg.det(camera.derivatives(uvh[inside])[..., :2]))
        gsd = float(np.mean(areas**-0.5))
        seen[name] = SeenTarget(name=name, camera=camera, bounds=(*low, *high), heights=(height, height), gsd=gsd)
    if behind == len(names):
        helps = "the azimuth of a wall is that of its outward normal, towards them"
        if isinstance(frame, CylinderFrame):
            helps = "a vault is seen from inside its radius, a column from outside"
        elif isinstance(frame, ImageFrame):
            helps = "they stand nearer to what is seen than its distance"
        raise GeometryError(
            f"all images stand behind the target at the height {height:g}: {helps}\n  " + "\n  ".join(blind[:12])
        )
    return [seen[name] for name in names if name in seen], blind


def _straight(scene: Scene, name: str) -> Camera:
    """The camera of a scene, whose rays are straight on the ground and meet in a point, so that a target can follow it.

    Raises
    ------
    GeometryError
        They are not, or do not.
    """
    camera = scene.camera
    try:
        camera.rays(np.zeros((1, 2)))
    except UsageError:
        way = "it is a line or satellite image; choose another one"
        if camera.vantage.central:
            way = 'state earth_curvature = "none" and no refraction in [orientation]; so near neither counts'
        raise GeometryError(
            f"image {name!r}: its rays are not straight on the ground, so that no surface lies along it: {way}"
        ) from None
    return camera


def frame_of(project: Project, text: str) -> tuple[Frame | None, Bounds | None]:
    """The frame of a target as a user states it, and the bounds that it has by itself; None: it is the map, has none.

    Raises
    ------
    UsageError
        It is none, or says too little.
    GeometryError, InputError
        Of an image: it cannot be a target, or cannot be opened.
    """
    kind, _, rest = text.partition(":")
    if text == "map":
        return None, None
    if kind in _NUMBERS:
        numbers = _numbers(rest)
        counts, form = _NUMBERS[kind]
        more = numbers[4:] if kind == "wall" else numbers[5:]
        good = len(numbers) in counts and abs(numbers[3]) <= 360 and abs(sum(more)) <= 90
        if not good or (kind != "wall" and not _RADII[0] <= numbers[4] <= _RADII[1]):
            raise UsageError(f"target {text}: give {form}")
        x, y, z, *others = numbers
        odd = odd_place((x, y, z), camera=False) or area_fault(project.crs, (x, y))
        if odd is not None:
            raise UsageError(f"target {text}: {odd}")
        if kind == "wall":
            return WallFrame.facing((x, y, z), *others), None
        make = CylinderFrame.vault if kind == "vault" else CylinderFrame.column
        return make((x, y, z), *others), None
    if kind != "image" or not rest:
        raise UsageError(f"target {text}; give {_FORMS}")
    name, _, last = rest.rpartition(",")
    if not name or any(image.name == rest for image in project.images):
        return _along(project, rest, None, text)
    return _along(project, name, next(iter(_numbers(last)), math.nan), text)


def _numbers(text: str) -> list[float]:
    """Finite numbers between commas; none if any of them is none."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        return []
    return numbers if all(math.isfinite(n) for n in numbers) else []


def _along(project: Project, name: str, distance: float | None, text: str) -> tuple[Frame, Bounds]:
    """The frame of an image, and the bounds of its picture."""
    scene = open_scene(project, project.any_image(name).name)
    camera = _straight(scene, name)
    center = camera.vantage.point
    # Of a camera in a plane picture (x·w, y·w, w) are linear in XYZ, and w is the depth.
    L, twice = (camera.project_homogeneous(center + length * np.eye(3)).T / length for length in (_APART, _APART / 2))
    if not (np.isfinite(L).all() and np.abs(L - twice).max() <= _STRAIGHT * np.abs(L).max()):
        raise GeometryError(f"target {text}: a fisheye image of more than 126° lies in no plane; choose another one")
    normal = -L[2] / np.linalg.norm(L[2])
    right = L[0] - (L[0] @ normal) * normal
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(normal, right), normal])
    if distance is None:
        low, high = scene.footprint.height_range
        distance = float((center[2] - (low + high) / 2) / normal[2]) if normal[2] > 0 else math.nan
        if not _NEAR <= distance <= HIGHEST_FLIGHT:
            raise UsageError(f"target {text}: the axis of the image meets no terrain; say `image:{name},DISTANCE`")
    if not _NEAR <= distance <= HIGHEST_FLIGHT:
        raise UsageError(
            f"target {text}: give a distance from {_NEAR:g} to {HIGHEST_FLIGHT:g} m: `image:NAME,DISTANCE`"
        )
    frame = ImageFrame(tuple(center.tolist()), tuple(map(tuple, axes.tolist())), distance)  # type: ignore[arg-type]
    p = camera.rays(image_border(camera.size))[1] @ axes.T
    uv = p[:, :2] / np.where(p[:, 2:] < 0, -p[:, 2:], np.nan) * distance
    return frame, (*np.nanmin(uv, axis=0).tolist(), *np.nanmax(uv, axis=0).tolist())
