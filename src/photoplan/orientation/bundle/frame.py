"""The Cartesian system in which a block is adjusted, the way there and back from map coordinates, and what the
earth's curvature and the air add there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.corrected import CurvatureCorrection
from photoplan.cameras.curved import local_pose
from photoplan.cameras.observed import GroundPoints, ObservedAttitudes, ObservedPositions
from photoplan.cameras.refraction import Refraction
from photoplan.geometry.heights import HeightStep
from photoplan.geometry.local import MEAN_RADIUS, LocalFrame, earth_radius
from photoplan.geometry.pose import Pose
from photoplan.geometry.rotation import angles_from_rotation, small_rotations
from photoplan.orientation.bundle.block import Bend, BlockCamera, BlockImage

_Floats = NDArray[np.float64]
#: Step for the derivatives of angles, radians.
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class BlockFrame:
    """From map X, Y and height (in the orientation's height system) to the block's system and back.

    Without a local system the map is taken for Cartesian, and the two are one.
    """

    crs: str
    local: LocalFrame | None
    """East, north, up near the block's middle, for strict earth curvature."""
    inward: HeightStep
    """From the orientation's height system to the one that is computed in."""
    outward: HeightStep

    def points(self, XYZ: ArrayLike) -> _Floats:
        """Map points (..., 3) to block points; NaN where a coordinate is NaN and a local system mixes it in."""
        XYZ = np.array(XYZ, float)
        if self.local is None:
            return XYZ
        XYZ[..., 2] = self.inward(XYZ)
        return self.local.to_local(XYZ)

    def map_points(self, points: ArrayLike) -> _Floats:
        """Block points (..., 3) to map points."""
        if self.local is None:
            return np.array(points, float)
        XYZ = self.local.to_map(points)
        XYZ[..., 2] = self.outward(XYZ)
        return XYZ

    def jacobian(self, XYZ: ArrayLike) -> _Floats:
        """∂ block / ∂ map at map points (..., 3), shape (..., 3, 3); the height systems' own slope is left out."""
        XYZ = np.array(XYZ, float)
        if self.local is None:
            return np.broadcast_to(np.eye(3), (*XYZ.shape, 3)).copy()
        XYZ[..., 2] = self.inward(XYZ)
        return self.local.jacobian(XYZ)

    def map_covariance(self, covariance: _Floats, XYZ: ArrayLike) -> _Floats:
        """Covariances (..., 3, 3) of block coordinates as those of map coordinates, at map points."""
        if self.local is None:
            return np.array(covariance)
        back = np.linalg.inv(self.jacobian(XYZ))
        return back @ covariance @ np.swapaxes(back, -1, -2)

    def map_vectors(self, vectors: _Floats, XYZ: ArrayLike) -> _Floats:
        """Small vectors (..., 3) of block coordinates as those of map coordinates, at map points."""
        if self.local is None:
            return np.array(vectors)
        return np.asarray((np.linalg.inv(self.jacobian(XYZ)) @ vectors[..., None])[..., 0])

    def pose(self, pose: Pose) -> Pose:
        """Map pose, whose angles refer to the map's axes at the station, to a block pose."""
        if self.local is None:
            return pose
        center = np.array(pose.center)
        center[2] = self.inward(center)
        return local_pose(Pose(center, pose.R_ground_camera), self.local)

    def map_pose(self, pose: Pose) -> Pose:
        """Inverse of `pose`."""
        if self.local is None:
            return pose
        center = self.local.to_map(pose.center)
        R = self.local.axes(center).T @ pose.R_ground_camera
        center[2] = self.outward(center)
        return Pose(center, R)

    def ground(self, ground: GroundPoints, near: _Floats) -> GroundPoints:
        """Ground points in the block's system."""
        if self.local is None:
            return ground
        known = np.isfinite(ground.XYZ)
        place = np.where(known, ground.XYZ, near)
        XYZ = np.where(known, self.points(place), np.nan)
        J = self.jacobian(place)
        variance = np.where(known, ground.sigma, 0.0) ** 2
        covariance = J @ (variance[..., None] * np.swapaxes(J, -1, -2))
        if ground.covariance is not None:
            covariance = J @ ground.covariance @ np.swapaxes(J, -1, -2)
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        covariance[~known.all(axis=1)] = np.nan
        return GroundPoints(
            names=ground.names, XYZ=XYZ, sigma=np.where(known, sigma, np.nan), check=ground.check, covariance=covariance
        )

    def positions(self, positions: ObservedPositions) -> ObservedPositions:
        """Observed positions in the block's system; covariances between coordinates are left out."""
        if self.local is None:
            return positions
        J = self.jacobian(positions.XYZ)
        sigma = np.sqrt((J**2 @ positions.sigma[..., None] ** 2)[..., 0])
        return ObservedPositions(
            images=positions.images,
            XYZ=self.points(positions.XYZ),
            sigma=sigma,
            strip=positions.strip,
            time=positions.time,
        )

    def attitudes(self, attitudes: ObservedAttitudes, centers: _Floats) -> ObservedAttitudes:
        """Observed attitudes in the block's system; `centers` (n, 3) are the stations in the map."""
        if self.local is None:
            return attitudes
        at = np.array(centers)
        at[:, 2] = self.inward(at)
        R = self.local.axes(at) @ attitudes.R_ground_camera
        return ObservedAttitudes(attitudes.images, R, attitudes.sigma)


def angle_derivatives(R: _Floats, order: str) -> _Floats:
    """∂ angles / ∂ small rotations about the camera's x, y, z (R ← R · exp[δ]×), shape (3, 3), for an order of angles.

    By central differences; large where the angles are not determined (the second one near a right angle).
    """
    J = np.empty((3, 3))
    for axis, turn in enumerate(small_rotations(_STEP * np.eye(3))):
        difference = angles_from_rotation(R @ turn, order) - angles_from_rotation(R @ turn.T, order)
        J[:, axis] = (difference + np.pi) % (2 * np.pi) - np.pi
    return J / (2 * _STEP)


def make_bend(
    frame: BlockFrame,
    images: Sequence[BlockImage],
    cameras: Mapping[str, BlockCamera],
    nadir: _Floats,
    curved: bool,
    refracted: bool,
) -> Bend | None:
    """What earth curvature (as a correction) and refraction add to the central projection; None if nothing.

    images: all of the block, in its order; nadir: height of the ground below each, metres; curved, refracted: which
    of them are to be regarded.
    """
    if not (curved or refracted):
        return None
    radii = [earth_radius(frame.crs, image.pose.center[:2]) if curved else MEAN_RADIUS for image in images]

    def warp_of(k: int, center: _Floats) -> Callable[[_Floats], _Floats]:
        X, Y, Z = (float(v) for v in center)
        refract = Refraction((X, Y, Z)) if refracted else None
        curve = CurvatureCorrection((X, Y, Z), float(nadir[k]), radii[k] + float(nadir[k])) if curved else None

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
