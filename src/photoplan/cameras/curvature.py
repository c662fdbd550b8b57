"""Curved earth: refraction, vertical displacement, and cameras over maps with curvature."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import ImageField, Vantage
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, Lens
from photoplan.errors import UsageError
from photoplan.geometry.grid import Placement
from photoplan.geometry.local import LocalFrame, earth_radius
from photoplan.geometry.pose import Pose, dot, solve3


@dataclass(frozen=True)
class EarthBend:
    """Ground at a horizontal distance s from the camera is lowered by b s² (Ecker 1991, eq. 5.6 and 5.7).

    b = (1 − k) / 2R for an earth of radius R and a coefficient of refraction k. A warp for `WarpedCamera`.
    """

    center: tuple[float, float]
    """X0, Y0 of the camera in map coordinates, metres."""
    bend: float
    """b, 1/m."""

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map points (..., 3) to where they lie over a plane that touches the earth below the camera."""
        out = np.array(XYZ, float)
        out[..., 2] -= self.bend * self._squared(out)
        return out

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """Points over the plane back to the map."""
        out = np.array(displaced, float)
        with np.errstate(invalid="ignore"):  # what lies on no map is at infinity
            out[..., 2] += self.bend * self._squared(out)
        return out

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Derivative of the displaced by the given point, shape (..., 3, 3)."""
        XYZ = np.asarray(XYZ, float)
        J = np.broadcast_to(np.eye(3), (*XYZ.shape, 3)).copy()
        J[..., 2, :2] = -2.0 * self.bend * (XYZ[..., :2] - self.center)
        return J

    def _squared(self, XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
        away = XYZ[..., :2] - self.center
        return dot(away, away)


@dataclass(frozen=True)
class Exaggeration:
    """Heights are stretched about one that stays (Ecker 1991, eq. 5.9). A warp for `WarpedCamera`."""

    reference: float
    """The height that stays, metres."""
    factor: float

    def __post_init__(self) -> None:
        if not 0.01 <= self.factor <= 1000:
            raise UsageError(f"exaggeration {self.factor}; a factor from 0.01 to 1000 is needed")

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) with stretched heights."""
        return self._stretched(XYZ, self.factor)

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) with their own heights."""
        return self._stretched(displaced, 1.0 / self.factor)

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Derivative of the displaced by the given point, shape (..., 3, 3)."""
        return np.broadcast_to(np.diag([1.0, 1.0, self.factor]), (*np.shape(XYZ), 3))

    def _stretched(self, XYZ: ArrayLike, factor: float) -> NDArray[np.float64]:
        out = np.array(XYZ, float)
        out[..., 2] = self.reference + (out[..., 2] - self.reference) * factor
        return out


@dataclass(frozen=True, eq=False)
class MapProjection:
    """From the ground straight down onto the pixels of a raster, whatever the height (Ecker 1991, eq. 5.3).

    All of it is linear, so that over any target whose ground is projective it is exact in one box of anchors; only
    another CRS bends it.
    """

    placement: Placement
    carry: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Takes X, Y of the product's CRS (..., 2) to the raster's; None if they are the same."""

    field: ClassVar[None] = None
    """Nothing happens in the raster."""
    breaks: ClassVar[None] = None
    """Maps are smooth."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the raster, pixels."""
        return self.placement.size

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground (..., 3) to (x, y, 1)."""
        XY = np.asarray(XYZ, float)[..., :2]
        if self.carry is not None:
            XY = self.carry(XY)
        a, b, c, d, e, f = self.placement.coefficients
        X, Y = XY[..., 0] - c, XY[..., 1] - f
        det = a * e - b * d
        return np.stack([(e * X - b * Y) / det - 0.5, (a * Y - d * X) / det - 0.5, np.ones_like(X)], axis=-1)


_ITERATIONS = 20


class Warp(Protocol):
    """A smooth displacement of the ground, close to a rigid motion."""

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) to displaced points; NaN where it is not defined."""
        ...

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Derivative of the displaced by the given point, shape (..., 3, 3)."""
        ...

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """Displaced points (..., 3) back to where they are; NaN where there is no such point."""
        ...


@dataclass(frozen=True, eq=False)
class WarpedCamera:
    """Ground points are displaced by the warps, one after the other, then projected by a frame camera."""

    frame: FrameCamera
    """The camera in the warped, Cartesian space."""
    warps: tuple[Warp, ...]
    """Refraction, earth curvature, local system: what leads from the map to that space."""
    center: NDArray[np.float64]
    """Projection centre in map coordinates, shape (3,)."""
    curvature: float = 0.0
    """1 / earth radius where the warps bend the ground, per metre; finds the start of iterations, not the result."""

    def __post_init__(self) -> None:
        center = np.array(self.center, float)
        center.setflags(write=False)
        object.__setattr__(self, "center", center)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.frame.size

    @property
    def field(self) -> ImageField | None:
        """The frame camera's: what happens in the image is the same."""
        return self.frame.field

    @property
    def breaks(self) -> None:
        """Warps are smooth."""
        return None

    @property
    def vantage(self) -> Vantage:
        """The projection centre."""
        return Vantage(self.center)

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground (..., 3) to ideal (x·w, y·w, w), w = depth in the warped space; NaN where a warp is not defined."""
        return self.frame.project_homogeneous(self._warp(XYZ))

    def derivatives(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(x, y)/∂(X, Y, Z), shape (..., 2, 3), pixels per metre; NaN behind the camera."""
        warped, J = self._warp_with_jacobian(XYZ)
        return self.frame.derivatives(warped) @ J

    def rays(self, xy: ArrayLike, height: ArrayLike | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Image points (..., 2) to rays: the point of the ray at `height` and its tangent there, each (..., 3).

        `height` is one number or one for each point. Rays that do not reach it in front of the camera give NaN.
        """
        if height is None:
            raise UsageError("rays of a camera with earth curvature or refraction are curved; give a height")
        xy = np.asarray(xy, float)
        shape = (*xy.shape[:-1], 3)
        _, v = self.frame.rays(xy.reshape(-1, 2))
        heights = np.broadcast_to(np.asarray(height, float), shape[:-1]).ravel()
        with np.errstate(all="ignore"):
            point = self._meet(v, heights)
            J = self._warp_with_jacobian(point)[1]
            d = solve3(J, v)
            d /= np.linalg.norm(d, axis=-1, keepdims=True)
        return point.reshape(shape), d.reshape(shape)

    def _warp(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        p = np.asarray(XYZ, float)
        for warp in self.warps:
            p = warp(p)
        return p

    def _warp_with_jacobian(self, XYZ: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        p = np.asarray(XYZ, float)
        J = np.broadcast_to(np.eye(3), (*p.shape, 3))
        for warp in self.warps:
            J = warp.jacobian(p) @ J
            p = warp(p)
        return p, J

    def _meet(self, v: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points at given heights whose images lie on the rays with directions v in the warped space, (n, 3).

        Newton's method in X, Y: the displaced point minus the projection centre must be parallel to v.
        """
        origin = self.frame.center
        # Two directions across each ray; a point lies on it when it has no component along either.
        helper = np.where(np.abs(v[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        across = np.cross(v, helper)
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        frame = np.stack([across, np.cross(v, across)], axis=1)
        p = self._start(v, heights)
        for _ in range(_ITERATIONS):
            warped, J = self._warp_with_jacobian(p)
            miss = np.einsum("nij,nj->ni", frame, warped - origin)
            A = frame @ J[:, :, :2]
            det = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
            step = np.empty_like(miss)
            step[:, 0] = (A[:, 1, 1] * miss[:, 0] - A[:, 0, 1] * miss[:, 1]) / det
            step[:, 1] = (A[:, 0, 0] * miss[:, 1] - A[:, 1, 0] * miss[:, 0]) / det
            p[:, :2] -= step
            # Map coordinates are rounded to about 1e-9 m, which flat rays magnify.
            reach = np.abs(p[:, :2] - self.center[:2]).sum(axis=1)
            if not (np.abs(step).max(axis=1) > 4e-9 + 1e-12 * reach).any():
                break
        away = self._warp(p) - origin
        along = (away * v).sum(axis=-1)
        off = np.linalg.norm(np.einsum("nij,nj->ni", frame, away), axis=-1)
        p[~((along > 0) & (off < 1e-9 * along + 1e-7))] = np.nan
        return p

    def _start(self, v: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the rays would meet the heights over a sphere of the given curvature."""
        nadir = np.column_stack([np.broadcast_to(self.center[:2], (len(v), 2)), heights])
        d = solve3(self._warp_with_jacobian(nadir)[1], v)
        above = self.center[2] - heights
        bend = self.curvature * (d[:, 0] ** 2 + d[:, 1] ** 2)
        root = np.sqrt(np.maximum(d[:, 2] ** 2 - 2.0 * bend * above, 0.0))
        s = -2.0 * above / (d[:, 2] + np.copysign(root, d[:, 2]))
        s = np.where(s > 0, s, np.nan)
        p = self.center + s[:, None] * d
        p[:, 2] = heights
        return p


def inverse_by_newton(warp: Warp, displaced: ArrayLike) -> NDArray[np.float64]:
    """The inverse of a warp that knows none of its own, to 1e-9 m; NaN where it is not found."""
    wanted = np.asarray(displaced, float)
    p = wanted.reshape(-1, 3).copy()
    miss = np.full_like(p, np.nan)
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            miss = warp(p) - wanted.reshape(-1, 3)
            p -= solve3(warp.jacobian(p), miss)
            if not (np.abs(miss) > 1e-9).any():
                break
        p[~(np.abs(miss) < 1e-6).all(axis=1)] = np.nan
    return p.reshape(wanted.shape)


# ICAO standard atmosphere: temperature falls by 6.5 K/km from 288.15 K to 11 km and stays; density follows from
# hydrostatic equilibrium. Refractivity n − 1 is proportional to density.
_LAPSE = 0.0065 / 288.15
_POWER = 9.80665 / (287.053 * 0.0065) - 1.0
_TROPOPAUSE = 11_000.0
_SCALE_HEIGHT = 287.053 * 216.65 / 9.80665
_SEA_LEVEL = 277.0e-6
_TOP = _SEA_LEVEL * (1.0 - _LAPSE * _TROPOPAUSE) ** _POWER

#: Below this difference of heights the integral is replaced by its series, metres.
_NEAR = 2.0


def _profile(z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """n − 1 at height z, and its integral from sea level to z."""
    u = 1.0 - _LAPSE * np.minimum(z, _TROPOPAUSE)
    fall = np.exp(-np.maximum(z - _TROPOPAUSE, 0.0) / _SCALE_HEIGHT)
    inside = _SEA_LEVEL * u**_POWER
    value = inside * fall
    integral = (_SEA_LEVEL - inside * u) / (_LAPSE * (_POWER + 1.0)) + _TOP * _SCALE_HEIGHT * (1.0 - fall)
    return value, integral


def _slopes(z: float) -> tuple[float, float, float]:
    """First three derivatives of n − 1."""
    value = float(_profile(np.asarray(z))[0])
    if z >= _TROPOPAUSE:
        return -value / _SCALE_HEIGHT, value / _SCALE_HEIGHT**2, -value / _SCALE_HEIGHT**3
    q = _LAPSE / (1.0 - _LAPSE * z)
    first, second = -_POWER * q * value, _POWER * (_POWER - 1.0) * q**2 * value
    return first, second, -(_POWER - 2.0) * q * second


@dataclass(frozen=True)
class Refraction:
    """Apparent place of a ground point, seen from a camera through the standard atmosphere.

    In horizontal layers of air (Snell) a ray that arrives at height H under the angle α from the nadir left the ground
    at h under the chord α − K tan α, with K = ∫ (n − n_H) dz / (H − h) from h to H. For the standard atmosphere
    that is the closed formula of Saastamoinen 1972 (*Refraction*, Photogrammetric Engineering 38), here continued above
    11 km. The point then seems to lie higher on its own vertical by

        K s² / (H − h),   s = distance to the camera,

    which holds in every direction of view, stays finite near the horizon, and reads k s² / 2R in surveyors' terms.
    Applied to the ground, it is right for tilted images too. A warp for `WarpedCamera`, in map coordinates; heights
    are those above sea level.
    """

    center: tuple[float, float, float]
    """Projection centre X0, Y0, Z0 in map coordinates, metres."""

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground points (..., 3) to the places where they seem to be."""
        out = np.array(XYZ, float)
        rise, _ = self._rise(out[..., 2])
        out[..., 2] += rise * ((out - self.center) ** 2).sum(axis=-1)
        return out

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Derivative of the displaced by the true point, shape (..., 3, 3)."""
        XYZ = np.asarray(XYZ, float)
        away = XYZ - self.center
        rise, change = self._rise(XYZ[..., 2])
        J = np.zeros((*XYZ.shape, 3))
        J[..., 0, 0] = J[..., 1, 1] = 1.0
        J[..., 2, :] = 2.0 * rise[..., None] * away
        J[..., 2, 2] += 1.0 + change * (away**2).sum(axis=-1)
        return J

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """Return the true places of displaced points (..., 3); NaN if there is no such point."""
        return inverse_by_newton(self, displaced)

    def _rise(self, h: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """K / (H − h) at ground heights h, per metre, and its derivative by h."""
        H = self.center[2]
        n_H, integral_H = _profile(np.asarray(H))
        n, integral = _profile(h)
        drop = H - h
        near = np.abs(drop) < _NEAR
        D = np.where(near, 1.0, drop)
        far_rise = (integral_H - integral - D * n_H) / D**2
        far_change = (2.0 * far_rise - (n - n_H) / D) / D
        first, second, third = _slopes(H)
        near_rise = -first / 2.0 + drop * (second / 6.0 - drop * third / 24.0)
        near_change = -second / 6.0 + drop * third / 12.0
        return np.where(near, near_rise, far_rise), np.where(near, near_change, far_change)

    def angle(self, alpha: float, height: float) -> float:
        """K tan α: how much farther from the nadir a point at `height` seems to lie, radians."""
        rise, _ = self._rise(np.asarray(height, float))
        return float(rise) * (self.center[2] - height) * math.tan(alpha)


def local_pose(pose: Pose, local: LocalFrame) -> Pose:
    """Pose in the local system of a pose whose angles refer to the map's axes at the station.

    The map's axes (grid east, grid north, height) are turned by the meridian convergence and by the tilt of the
    station's horizon against the origin's.
    """
    return Pose(local.to_local(pose.center), local.axes(pose.center) @ pose.R_ground_camera)


def curved_camera(
    interior: Interior, lens: Lens, pose: Pose, local: LocalFrame, before: tuple[Warp, ...] = ()
) -> WarpedCamera:
    """A camera in map coordinates that projects strictly in a local tangential system (Ecker 1991, §4.6.5.1)."""
    frame = FrameCamera(interior, lens, local_pose(pose, local))
    radius = earth_radius(local.crs, pose.center[:2])
    return WarpedCamera(frame, (*before, local), pose.center, 1.0 / radius)


#: Side of an image that holds every place of a map, pixels of the map's unit.
_SIDE = 1 << 30


@dataclass(frozen=True)
class SunProjection:
    """Ground along the sun's rays onto a plane across them; 1 pixel is a metre."""

    direction: tuple[float, float, float]
    """Unit vector towards the sun: east, north, up."""

    @property
    def size(self) -> tuple[int, int]:
        """Larger than any map."""
        return _SIDE, _SIDE

    field: ClassVar[None] = None
    """Rays are straight."""
    breaks: ClassVar[None] = None
    """They have no breaks."""

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground (..., 3) to (x, y, 1)."""
        east, north, _ = self.direction
        level = math.hypot(east, north)
        right = (north / level, -east / level, 0.0) if level > 1e-9 else (1.0, 0.0, 0.0)
        # Down in the image: away from the zenith, across the rays.
        down = np.cross(right, self.direction)
        XYZ = np.asarray(XYZ, float)
        x, y = (XYZ @ np.asarray(axis) + _SIDE / 2 for axis in (right, down))
        return np.stack([x, y, np.ones_like(x)], axis=-1)
