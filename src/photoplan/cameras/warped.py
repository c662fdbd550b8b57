"""A frame camera in ground coordinates that are not Cartesian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import ImageField, Vantage
from photoplan.cameras.frame import FrameCamera
from photoplan.errors import UsageError

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
            d = _solve(J, v)
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
        """Where the rays would meet the heights over a sphere of the given curvature."""
        nadir = np.column_stack([np.broadcast_to(self.center[:2], (len(v), 2)), heights])
        d = _solve(self._warp_with_jacobian(nadir)[1], v)
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
            p -= _solve(warp.jacobian(p), miss)
            if not (np.abs(miss) > 1e-9).any():
                break
        p[~(np.abs(miss) < 1e-6).all(axis=1)] = np.nan
    return p.reshape(wanted.shape)


def _solve(J: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """x of J x = v for (n, 3, 3) and (n, 3) by Cramer's rule, which leaves NaN where there is no solution."""
    a, b, c = J[..., 0], J[..., 1], J[..., 2]
    bc = np.cross(b, c)
    det = (a * bc).sum(axis=-1)
    x = np.stack([(v * bc).sum(-1), (v * np.cross(c, a)).sum(-1), (v * np.cross(a, b)).sum(-1)], axis=-1)
    return x / det[..., None]
