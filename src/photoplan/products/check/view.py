"""What the check of orientations needs to know of a project's image."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photoplan.io.camera.model import CameraEntry
from photoplan.io.orientation.table import angle_in_radians
from photoplan.io.project.cameras import interior_of, lens_of
from photoplan.io.project.model import Image, Orientation
from photoplan.orientation.plausibility import View

#: Points on a side of the grid over an image.
POINTS = 5


def view_of(image: Image, camera: CameraEntry, orientation: Orientation, center: ArrayLike) -> View:
    """View of a project's image.

    Parameters
    ----------
    image : Image
    camera : CameraEntry
        Description of its camera.
    orientation : Orientation
        What its angles mean.
    center : array_like, shape (3,)
        Projection centre in the terrain's height system.
    """
    interior, lens = interior_of(camera, image), lens_of(camera)
    w, h = interior.size
    part = np.linspace(0.0, 1.0, POINTS)
    x, y = (g.ravel() for g in np.meshgrid(part * (w - 1), part * (h - 1)))
    middle, half = np.array([(w - 1) / 2, (h - 1) / 2]), np.array([0.5, 0.0])
    xy = np.concatenate([[middle, middle + half, middle - half], np.column_stack([x, y])])
    t = lens.undistort(interior.tangent_to_pixel.inverse(xy))
    pixel = float(np.linalg.norm(t[1] - t[2]))
    angles = angle_in_radians(np.array(image.pose_numbers[1]), orientation.angle_unit)
    points = np.delete(t, [1, 2], axis=0)
    return View(
        image.name, np.asarray(center, float), angles, orientation.rotation, points, pixel, orientation.angle_unit
    )
