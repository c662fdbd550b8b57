"""Monoplotting: ground points from points of one image and a surface, with their standard deviations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera
from photoplan.errors import UsageError
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.objects import without_objects
from photoplan.surfaces.shifted import intersect

REASONS = {
    "": "met",
    "outside": "outside the image",
    "no ray": "its lens, polynomials or trajectory have no ray there",
    "up": "looks above the horizon",
    "below": "the camera is below the terrain",
    "none": "meets no terrain",
}
"""Why an image point has no ground point."""
#: Places along each ray at which holes of the terrain are looked for.
HOLE_STEPS = 64


@dataclass(frozen=True)
class MonoplotErrors:
    """Standard deviations that ground points inherit."""

    image: float = 0.5
    """Standard deviation of each image coordinate, pixels."""
    terrain: float | Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Standard deviation of terrain heights, metres: one number, or a function of map points (n, 2), if known."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviations of the projection centre, X, Y, Z, metres."""
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviations of the three rotations about `axes`, radians."""
    axes: NDArray[np.float64] | None = None
    """Axes of these rotations in ground space, shape (3, 3), a row for each; None: X, Y, Z."""

    def __post_init__(self) -> None:
        numbers = [self.image, *self.position, *self.angles]
        if isinstance(self.terrain, int | float):
            numbers.append(self.terrain)
        if not all(math.isfinite(n) and n >= 0 for n in numbers):
            raise UsageError(f"standard deviations {numbers}; zero or positive numbers are needed")


@dataclass(frozen=True, eq=False)
class MonoplotPoints:
    """Ground points of image points, in their order."""

    XYZ: NDArray[np.float64]
    """Shape (n, 3), metres; NaN where there is none."""
    covariance: NDArray[np.float64]
    """Shape (n, 3, 3), m²; NaN where there is no point, or the terrain's standard deviation is unknown."""
    angle: NDArray[np.float64]
    """Angle between ray and terrain, radians, shape (n,): the flatter, the less exact; below 0 the terrain is seen
    from behind."""
    hole: NDArray[np.bool_]
    """True where the ray crosses a place without terrain before it meets some, shape (n,)."""
    reasons: NDArray[np.str_]
    """Keys of `REASONS`, shape (n,)."""

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Standard deviations of X, Y, Z, shape (n, 3), metres."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def monoplot(
    camera: Camera,
    xy: ArrayLike,
    terrain: Terrain,
    height_range: tuple[float, float],
    errors: MonoplotErrors,
    mesh: float,
) -> MonoplotPoints:
    """Return where the rays of image points first meet a surface.

    With A = ∂(x, y)/∂(X, Y, Z) and the terrain's slope s = ∂h/∂(X, Y), small changes obey

        ( A  ) dP = ( dxy − A (dP of the camera's motion) )
        (−s 1)      ( dh                                  )

    whose solution carries the covariances of image point, orientation and terrain over to the ground point. The slope
    is that between points half a mesh away on both sides.
    """
    xy = np.asarray(xy, float).reshape(-1, 2)
    reasons = _before(camera, xy, terrain, height_range)
    XYZ = np.full((len(xy), 3), np.nan)
    asked = np.flatnonzero(reasons == "")
    if len(asked):
        XYZ[asked] = intersect(camera, xy[asked], terrain, height_range)
    reasons[np.isnan(XYZ[:, 0]) & (reasons == "")] = "none"
    slope = _slope(terrain, XYZ[:, :2], mesh / 2)
    direction = _directions(camera, xy, XYZ[:, 2])
    normal = np.column_stack([-slope, np.ones(len(xy))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    angle = np.where(np.isnan(XYZ[:, 0]), np.nan, np.arcsin(np.clip(-(normal * direction).sum(axis=1), -1, 1)))
    covariance = _covariance(camera, XYZ, slope, errors)
    return MonoplotPoints(
        XYZ=XYZ,
        covariance=covariance,
        angle=angle,
        hole=_holes(camera, xy, XYZ, terrain, height_range[1]),
        reasons=reasons,
    )


def _before(
    camera: Camera, xy: NDArray[np.float64], terrain: Terrain, height_range: tuple[float, float]
) -> NDArray[np.str_]:
    """Reasons that are known before the terrain is looked at."""
    reasons = np.full(len(xy), "", "U8")
    if not np.isfinite(height_range).all():
        reasons[:] = "none"
        return reasons
    width, height = camera.size
    inside = (xy >= -0.5).all(axis=1) & (xy[:, 0] <= width - 0.5) & (xy[:, 1] <= height - 0.5)
    reasons[~inside] = "outside"
    direction = _directions(camera, xy, np.full(len(xy), height_range[0]))
    reasons[inside & np.isnan(direction[:, 2])] = "no ray"
    reasons[inside & (direction[:, 2] >= 0)] = "up"
    # A camera below a bridge is not below the ground.
    vantage = camera.vantage
    if vantage.central and float(without_objects(terrain).heights(vantage.point[:2])) > vantage.point[2]:
        reasons[:] = "below"
    return reasons


def _directions(camera: Camera, xy: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions of the rays near some heights, (n, 3)."""
    if not np.isfinite(heights).any():
        return np.full((len(xy), 3), np.nan)
    return camera.rays(xy, float(np.nanmean(heights)))[1]


def _slope(terrain: Terrain, XY: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """∂h/∂X, ∂h/∂Y at map points (n, 2); one-sided beside holes, level where nothing is known around."""
    here = terrain.heights(XY)
    slope = np.empty_like(XY)
    for k in range(2):
        step = np.zeros(2)
        step[k] = reach
        up, down = terrain.heights(XY + step), terrain.heights(XY - step)
        both = (up - down) / (2 * reach)
        one = np.where(np.isfinite(up), up - here, here - down) / reach
        slope[:, k] = np.where(np.isfinite(both), both, np.where(np.isfinite(one), one, 0.0))
    return slope


def _covariance(
    camera: Camera, XYZ: NDArray[np.float64], slope: NDArray[np.float64], errors: MonoplotErrors
) -> NDArray[np.float64]:
    """Covariance matrices (n, 3, 3) of ground points."""
    out = np.full((len(XYZ), 3, 3), np.nan)
    if errors.terrain is None:
        return out
    there = np.isfinite(XYZ[:, 0])
    P, n = XYZ[there], int(there.sum())
    A = camera.derivatives(P)
    # A camera that moves by t and turns by ε about its centre shows P where it would have shown P − t − ε × (P − C).
    r = P - camera.vantage.point
    axes = np.eye(3) if errors.axes is None else errors.axes
    turned = np.stack([np.cross(axis, r) for axis in axes], axis=-1)
    motion = np.concatenate([A, A @ turned], axis=2)
    orientation = (motion * np.square([*errors.position, *errors.angles])) @ motion.transpose(0, 2, 1)
    inner = np.zeros((n, 3, 3))
    inner[:, :2, :2] = orientation + errors.image**2 * np.eye(2)
    heights = errors.terrain(P[:, :2]) if callable(errors.terrain) else errors.terrain
    inner[:, 2, 2] = np.square(heights)
    M = np.zeros((n, 3, 3))
    M[:, :2], M[:, 2, :2], M[:, 2, 2] = A, -slope[there], 1.0
    regular = np.abs(np.linalg.det(M)) > 1e-12
    inverse = np.full_like(M, np.nan)
    inverse[regular] = np.linalg.inv(M[regular])
    out[there] = inverse @ inner @ inverse.transpose(0, 2, 1)
    return out


def _holes(
    camera: Camera, xy: NDArray[np.float64], XYZ: NDArray[np.float64], terrain: Terrain, high: float
) -> NDArray[np.bool_]:
    """Return whether rays cross places without terrain between the highest terrain and the point."""
    crossed = np.zeros(len(xy), bool)
    there = np.flatnonzero(np.isfinite(XYZ[:, 0]))
    if not len(there):
        return crossed
    top = min(high, float(camera.vantage.point[2]))
    origin, direction = camera.rays(xy[there], top)
    t = (top - origin[:, 2]) / direction[:, 2]
    start = origin + t[:, None] * direction
    for part in np.linspace(0, 1, HOLE_STEPS, endpoint=False):
        place = start + part * (XYZ[there] - start)
        crossed[there] |= np.isnan(terrain.heights(place[:, :2]))
    return crossed
