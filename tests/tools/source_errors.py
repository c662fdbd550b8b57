"""Sources whose errors are known: cameras moved along the axes of a covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from photoplan.cameras.frame import FrameCamera
from photoplan.geometry.pose import Pose, small_rotations
from photoplan.plan.accuracy import IndependentError, SourceErrors

_STEP = 1 / 16


def moved(camera: FrameCamera, change: np.ndarray) -> FrameCamera:
    """A camera with another centre (metres) and small rotations about its own axes."""
    pose = camera.pose
    R = pose.R_ground_camera @ small_rotations(change[None, 3:6])[0]
    return replace(camera, pose=Pose(pose.center + change[:3], R))


def pose_errors(camera: FrameCamera, covariance: np.ndarray, image: float = 0.0) -> SourceErrors:
    """A frame camera with the covariance (6, 6) of a bundle adjustment."""
    variances, axes = np.linalg.eigh(covariance)
    columns = (axes * np.sqrt(np.maximum(variances, 0.0))).T
    causes = tuple(
        IndependentError("orientation", moved(camera, _STEP * c), moved(camera, -_STEP * c), _STEP) for c in columns
    )
    return SourceErrors(camera, causes, image)
