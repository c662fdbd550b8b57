"""Targets of a project: walls, vaults, columns and images that products lie on instead of the map."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from photoplan.cameras.base import Camera
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.geometry.bounds import HIGHEST_FLIGHT, odd_place
from photoplan.geometry.frames import CylinderFrame, Frame, ImageFrame, WallFrame
from photoplan.geometry.heights import HeightStep
from photoplan.io.files import explain
from photoplan.io.project.model import PlacedTarget, Project, StatedTarget
from photoplan.plan.footprint import Bounds, image_border
from photoplan.project.ground import ground_of, open_relief
from photoplan.project.scene import Scene, open_scene

#: Metres over which an image's projection is taken apart; from a straight line it differs by less than this part.
_APART, _STRAIGHT = 1024.0, 1e-6
#: Nearest of what an image shows, metres.
_NEAR = 0.001
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


def _straight(scene: Scene, name: str) -> Camera:
    """The camera of a scene, whose rays are straight on the ground and meet in a point, so that a target can
    follow it.
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


def target_frame(project: Project, text: str) -> tuple[Frame | None, Bounds | None]:
    """The frame of a target as a user states it, and the bounds that it has by itself; None: it is the map, has none.

    A user states heights in the system of the orientation; the frame is in that of the cameras.
    """
    stated = stated_target(project, text)
    frame, own = _stated_frame(project, stated.frame)
    return frame, stated.bounds or own


def _stated_frame(project: Project, text: str) -> tuple[Frame | None, Bounds | None]:
    """The frame that a text describes, which is no name of a target, and the bounds that it has by itself."""
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
        odd = odd_place((x, y, z), camera=False) or project.area_fault((x, y))
        if odd is not None:
            raise UsageError(f"target {text}: {odd}")
        z = float(ground_of(project).into_working(project.crs)((x, y, z)))
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


def stated_target(project: Project, text: str) -> StatedTarget:
    """Return the target of a project of this name, or the one that the text describes."""
    return project.targets.get(text) or StatedTarget(frame=text)


def with_target(
    project: Project,
    text: str,
    bounds: Bounds | None = None,
    relief: str | None = None,
    sigma: str | None = None,
) -> Project:
    """Return a project whose products lie on a target.

    Parameters
    ----------
    project : Project
    text : str
        `map`, the name of one of the project's targets, or a frame as the option `target` takes it.
    bounds : (float, float, float, float), optional
        Lowest u, v and highest u, v, metres; None for those that the target states or has.
    relief : str, optional
        Offset of the surface along the frame's normal, metres, or a raster of offsets; None for what the target states.
    sigma : str, optional
        Standard deviation of the offsets, metres, or a raster of it.

    Raises
    ------
    UsageError
        The target has no bounds, or options are set for the map that only a target has.
    InputError
        The relief cannot be used, or lies over another target.
    """
    if text == "map":
        if relief is not None or sigma is not None:
            raise UsageError("`relief` and `relief_sigma` require `target`; over the map the terrain is the surface")
        return project
    asked = {
        name: _number_or_path(value) for name, value in (("relief", relief), ("sigma", sigma)) if value is not None
    }
    values = {**dict(stated_target(project, text)), **asked}
    try:
        stated = StatedTarget(**values)
    except ValidationError as error:
        raise UsageError(explain(error, values, f"target {text}")) from None
    frame, own = _stated_frame(project, stated.frame)
    if frame is None:
        return project
    if isinstance(stated.relief, str):
        path = project.resolve(stated.relief)
        surface, over = open_relief(path)
        if over is not None and _stated_frame(project, over)[0] != frame:
            raise InputError(f"{path}: its heights lie over {over}, not over {stated.frame}")
        own = surface.bounds
    around = bounds or stated.bounds or own
    if around is None:
        raise UsageError(f"target {text}: it has no end; set `bounds`, u and v on it in metres")
    if not (all(map(math.isfinite, around)) and around[0] < around[2] and around[1] < around[3]):
        raise UsageError(f"target {text}: bounds {around} are empty; they are lowest u, lowest v, highest u, highest v")
    placed = PlacedTarget(**{**dict(stated), "space": frame, "bounds": around})
    return project.model_copy(update={"target": placed})


def _number_or_path(text: str) -> float | str:
    """Return the number that a text is, or else the path, from the working folder."""
    try:
        return float(text)
    except ValueError:
        return str(Path(text).absolute())


def at_heights(frame: Frame, step: HeightStep) -> Frame:
    """A frame with its origin in another height system: the step between them is the same all over a target."""
    if step.definition is None or not isinstance(frame, WallFrame | CylinderFrame | ImageFrame):
        return frame
    x, y, _ = frame.origin
    return replace(frame, origin=(x, y, float(step(frame.origin))))


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
