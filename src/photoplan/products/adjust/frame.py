"""The system in which a project's block is adjusted, and what the earth's curvature and the air add there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.corrected import CurvatureCorrection
from photoplan.cameras.refraction import Refraction
from photoplan.errors import HeightSystemError
from photoplan.geometry.heights import OPTIONS, check_height_system, declared_pair, height_step
from photoplan.geometry.local import MEAN_RADIUS, LocalFrame, earth_radius
from photoplan.geometry.pose import Pose
from photoplan.io.project.model import Project
from photoplan.orientation.bundle.block import Bend, BlockCamera, BlockImage
from photoplan.orientation.bundle.frame import BlockFrame
from photoplan.project.ground import ground_of

_Floats = NDArray[np.float64]


def block_frame(project: Project, XYZ: _Floats) -> BlockFrame:
    """The system of a project's block.

    Parameters
    ----------
    project : Project
    XYZ : ndarray, shape (n, 3)
        Projection centres and ground points, from which the middle of the block is taken; metres, NaN is left out.

    Raises
    ------
    HeightSystemError
        Earth curvature is strict and the orientation's height system is not stated, or cannot be joined to the
        ellipsoid.
    """
    if project.orientation.earth_curvature != "strict":
        same = height_step("same", "same", project.crs)
        return BlockFrame(project.crs, None, same, same)
    system = orientation_system(project)
    working = "same" if system == "same" else "ellipsoidal"
    XY = XYZ[np.isfinite(XYZ[:, :2]).all(axis=1), :2]
    low, high = XY.min(axis=0), XY.max(axis=0)
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    inward = height_step(system, working, project.crs, bounds)
    middle = (low + high) / 2
    return BlockFrame(
        project.crs,
        LocalFrame(project.crs, (float(middle[0]), float(middle[1]))),
        inward,
        height_step(working, system, project.crs, bounds),
    )


def orientation_system(project: Project) -> str:
    """Height system of orientations and control.

    Raises
    ------
    HeightSystemError
        It is not stated, or cannot be known.
    """
    stated = project.height_system
    if stated is None:
        raise HeightSystemError(
            "strict earth curvature, satellites and strips are computed with ellipsoidal heights, and the height "
            "system of orientation and control is not stated; give height_system in [orientation]; allowed are "
            f"{OPTIONS}"
        )
    system = check_height_system(stated, "orientation")
    if system != "same" or project.terrain is None:
        return system
    if project.terrain.height_system is not None:
        return declared_pair(project.terrain.height_system, system)[1]
    return ground_of(project).height_systems[1]


def nadir_heights(project: Project, XY: _Floats, otherwise: float) -> _Floats:
    """Height of the ground below stations (n, 2), metres: the terrain's, or `otherwise` where there is none."""
    if project.terrain is None:
        return np.full(len(XY), otherwise)
    heights = np.asarray(ground_of(project).bare.heights(XY), float)
    return np.where(np.isfinite(heights), heights, otherwise)


def make_bend(
    project: Project, frame: BlockFrame, images: tuple[BlockImage, ...], cameras: dict[str, BlockCamera], nadir: _Floats
) -> Bend | None:
    """What earth curvature (as a correction) and refraction add to the central projection; None if nothing.

    Parameters
    ----------
    project : Project
    frame : BlockFrame
    images : tuple of BlockImage
        All images of the block, in its order.
    cameras : dict
    nadir : ndarray, shape (n,)
        Height of the ground below each image, metres.
    """
    correction = project.orientation.earth_curvature == "correction"
    refraction = project.orientation.refraction
    if not (correction or refraction):
        return None
    radii = [earth_radius(project.crs, image.pose.center[:2]) if correction else MEAN_RADIUS for image in images]

    def warp_of(k: int, center: _Floats) -> Callable[[_Floats], _Floats]:
        X, Y, Z = (float(v) for v in center)
        refract = Refraction((X, Y, Z)) if refraction else None
        curve = CurvatureCorrection((X, Y, Z), float(nadir[k]), radii[k] + float(nadir[k])) if correction else None

        def warp(points: _Floats) -> _Floats:
            points = points if refract is None else refract(points)
            return points if curve is None else curve(points)

        return warp

    def bend(image: NDArray[np.int64], poses: tuple[Pose, ...], points: _Floats) -> _Floats:
        on_map = points if frame.local is None else frame.local.to_map(points)
        shift = np.empty((len(points), 2))
        order = np.argsort(image, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(image[order])) + 1):
            if not len(part):
                continue
            k = int(image[part[0]])
            center = poses[k].center if frame.local is None else frame.local.to_map(poses[k].center)
            moved = warp_of(k, center)(on_map[part])
            moved = moved if frame.local is None else frame.local.to_local(moved)
            camera = cameras[images[k].camera]
            shift[part] = _pixels(images[k], camera, poses[k], moved) - _pixels(
                images[k], camera, poses[k], points[part]
            )
        return shift

    return bend


def _pixels(image: BlockImage, camera: BlockCamera, pose: Pose, points: _Floats) -> _Floats:
    p = pose.to_camera(points)
    t = p[:, :2] / np.where(p[:, 2] < 0, -p[:, 2], np.nan)[:, None]
    return image.plane_to_pixel(camera.c * camera.lens.distort(t) + np.array(camera.principal_point))
