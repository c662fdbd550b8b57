"""Orientations that are spoilt, and how proposed control fits the true ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import project as into_image
from photoplan.io.points import read_ground_points, read_image_points
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.project.scene import open_scene

__all__ = ["residuals", "spoilt"]


def spoilt(path: Path, metres: float, degrees: float, seed: int = 1) -> None:
    """Move every projection centre and turn every angle by so much, up or down."""
    rng = np.random.default_rng(seed)
    changes = {}
    for image in load_project(path).images:
        center, angles = image.pose_numbers
        signs = rng.choice([-1.0, 1.0], 6)
        changes[image.name] = {
            "center": (np.array(center) + metres * signs[:3]).tolist(),
            "angles": (np.array(angles) + degrees * signs[3:]).tolist(),
        }
    edit_project(path, ProjectChanges(images=changes))


def residuals(true: Path, control: Path) -> NDArray:
    """Measured minus computed image points of proposed control with the true orientations, pixels."""
    ground, points = read_ground_points(control), read_image_points(control.with_name(f"{control.stem}_points.csv"))
    XYZ = ground.XYZ[[ground.names.index(n) for n in points.points]]
    out = np.empty((len(points), 2))
    for k, name in enumerate(points.images):
        here = points.image == k
        out[here] = points.xy[here] - into_image(open_scene(load_project(true), name).camera, XYZ[points.point[here]])
    return out
