"""Images with a camera and a pose: what a project states of them becomes a camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photoplan.cameras.base import CentralCamera
from photoplan.cameras.build import oriented_camera
from photoplan.geometry.heights import height_step
from photoplan.geometry.pose import Pose
from photoplan.geometry.rotation import rotation_from_angles
from photoplan.io.camera.model import CameraEntry
from photoplan.io.orientation.table import angle_in_radians
from photoplan.io.project.cameras import interior_of, lens_of
from photoplan.io.project.model import Orientation, Project
from photoplan.io.project.posed import Image
from photoplan.orientation.plausibility import JudgedView
from photoplan.project.ground import Ground
from photoplan.project.image_size import check_camera_size


def stated_pose(project: Project, image: Image) -> Pose:
    """Exterior orientation of an image as the project states it, in the orientation's height system."""
    orientation = project.orientation
    center, angles = image.pose_numbers
    radians = angle_in_radians(np.array(angles), orientation.angle_unit)
    return Pose(np.array(center, float), rotation_from_angles(radians, orientation.rotation))


def pose_of(project: Project, image: Image, ground: Ground) -> Pose:
    """Exterior orientation of an image, in the height system that the ground has."""
    stated = stated_pose(project, image)
    center = stated.center.copy()
    center[2] = height_step(ground.height_systems[1], ground.working_system, project.crs)(center)
    return Pose(center, stated.R_ground_camera)


def posed_camera(project: Project, image: Image, ground: Ground, size: tuple[int, int]) -> CentralCamera:
    """Camera of an image by the project's numbers; `size` is that of its file, another one stated is an InputError."""
    description = project.cameras[image.camera]
    check_camera_size(project, image, size)
    interior = interior_of(description, image, size)
    pose = pose_of(project, image, ground)
    nadir = float(ground.bare.heights(pose.center[:2]))
    return oriented_camera(
        interior,
        lens_of(description),
        pose,
        crs=project.crs,
        earth_curvature=project.orientation.earth_curvature,
        refraction=project.orientation.refraction,
        mean_ground=nadir if np.isfinite(nadir) else 0.0,
    )


#: Points on a side of the grid over an image.
_POINTS = 5


def view_of(image: Image, camera: CameraEntry, orientation: Orientation, center: ArrayLike) -> JudgedView:
    """View of a project's image."""
    interior, lens = interior_of(camera, image), lens_of(camera)
    w, h = interior.size
    part = np.linspace(0.0, 1.0, _POINTS)
    x, y = (g.ravel() for g in np.meshgrid(part * (w - 1), part * (h - 1)))
    middle, half = np.array([(w - 1) / 2, (h - 1) / 2]), np.array([0.5, 0.0])
    xy = np.concatenate([[middle, middle + half, middle - half], np.column_stack([x, y])])
    t = lens.undistort(interior.tangent_to_pixel.inverse(xy))
    pixel = float(np.linalg.norm(t[1] - t[2]))
    angles = angle_in_radians(np.array(image.pose_numbers[1]), orientation.angle_unit)
    points = np.delete(t, [1, 2], axis=0)
    return JudgedView(
        name=image.name,
        center=np.asarray(center, float),
        angles=angles,
        order=orientation.rotation,
        tangents=points,
        pixel=pixel,
        unit=orientation.angle_unit,
        mirrored=camera.fiducial_system is not None and camera.fiducial_system.mirrored,
    )
