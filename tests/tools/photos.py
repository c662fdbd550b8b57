"""Simulated photographs for tests of orientation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera, project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, Lens, NoLens
from photoplan.geometry.pose import Pose, rotation_opk
from photoplan.orientation.resection import MeasuredPoints

#: A wide-angle aerial camera: 153 mm, 230 mm format scanned with 20 µm.
AERIAL = Interior.metric((11500, 11500), 153.0, 0.02)
#: A map place with large coordinates, as in projects.
PLACE = np.array([500_000.0, 5_400_000.0, 0.0])


def at(x: float, y: float, z: float) -> NDArray[np.float64]:
    """A position relative to `PLACE`."""
    return PLACE + np.array([x, y, z])


def aerial_pose(rng: np.random.Generator, height: float = 1500.0, tilt: float = 0.03) -> Pose:
    """A near-vertical pose with any heading."""
    omega, phi = rng.normal(0.0, tilt, 2)
    center = at(*rng.uniform(-500.0, 500.0, 2), height)
    return Pose(center, rotation_opk(omega, phi, rng.uniform(-np.pi, np.pi)))


def ground_below(
    rng: np.random.Generator, pose: Pose, count: int, relief: float, interior: Interior = AERIAL
) -> NDArray[np.float64]:
    """Points that the image sees, spread over it, at heights from 0 to `relief`, (count, 3)."""
    width, height = interior.size
    xy = rng.uniform(0.05, 0.95, (count, 2)) * (width, height)
    origin, d = FrameCamera(interior, NoLens(), pose).rays(xy)
    Z = rng.uniform(0.0, relief, count) if relief > 0 else np.zeros(count)
    return origin + d * ((Z - origin[:, 2]) / d[:, 2])[:, None]


def measured(
    camera: Camera, XYZ: NDArray[np.float64], rng: np.random.Generator, sigma: float = 0.5, control: float = 0.0
) -> MeasuredPoints:
    """Measurements of ground points with noise in the image (pixels) and in control (metres); 0: exact."""
    n = len(XYZ)
    xy = project(camera, XYZ) + rng.normal(0.0, 1.0, (n, 2)) * sigma
    given = XYZ + rng.normal(0.0, 1.0, (n, 3)) * control
    names = tuple(f"P{k + 1}" for k in range(n))
    covariance = np.broadcast_to(np.eye(3) * control**2, (n, 3, 3))
    return MeasuredPoints(names, xy, np.full((n, 2), sigma or 0.5), given, covariance)


def frame(pose: Pose, interior: Interior = AERIAL, lens: Lens | None = None) -> FrameCamera:
    """A plain camera."""
    return FrameCamera(interior, lens or NoLens(), pose)


def turned_by(a: Pose, b: Pose) -> float:
    """Angle between two poses, radians."""
    R = a.R_ground_camera.T @ b.R_ground_camera
    v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(np.linalg.norm(v), np.trace(R) - 1.0))
