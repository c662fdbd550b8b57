"""Which images see a target of a surface, and what of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera
from photoplan.cameras.base import project as project_points
from photoplan.cameras.framed import FramedCamera
from photoplan.errors import GeometryError
from photoplan.events import Events
from photoplan.geometry.cylinder import CylinderFrame
from photoplan.geometry.frames import Frame, ImageFrame
from photoplan.io.project.model import Project
from photoplan.products.orthophoto.look import look_at
from photoplan.products.surface.settings import Bounds
from photoplan.project.scene import map_order, open_scene

#: Points along a side of a target that are projected to see which images show it.
_POINTS = 33
#: Metres by which a place of a target lies beside a ray that meets it.
_SAME = 1e-3


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
    """Images that see a part of a target at a height, and a line for each that sees none."""
    u, v = (np.linspace(bounds[k], bounds[k + 2], _POINTS) for k in (0, 1))
    uvh = np.stack([*np.meshgrid(u, v), np.full((_POINTS, _POINTS), height)], axis=-1).reshape(-1, 3)
    names, blind = project.oriented(names)
    events.done(len(blind))
    seen, behind = {}, 0
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
