"""The system in which a project's block is adjusted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import HeightSystemError
from photoplan.geometry.heights import OPTIONS, check_height_system, declared_pair, height_step
from photoplan.geometry.local import LocalFrame
from photoplan.io.project.model import Project
from photoplan.orientation.bundle.frame import BlockFrame
from photoplan.project.ground import ground_of

_Floats = NDArray[np.float64]


def block_frame(project: Project, XYZ: _Floats) -> BlockFrame:
    """The system of a project's block."""
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
    """Height system of orientations and control."""
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
