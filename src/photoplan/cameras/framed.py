"""Cameras in the coordinates of a wall or vault, cameras with corrected image points, and the parts of both."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera, CentralCamera, ImageField, Parts, Projection, Tremor, Vantage, project
from photoplan.cameras.curvature import Refraction, Warp, WarpedCamera, curved_camera, inverse_by_newton
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, Lens
from photoplan.cameras.pushbroom_rays import heights_of, meet, vantage_over
from photoplan.errors import InputError, UsageError
from photoplan.geometry.frames import Frame
from photoplan.geometry.grid import Breaks
from photoplan.geometry.local import MEAN_RADIUS, BodyGround, LocalFrame, earth_radius
from photoplan.geometry.pose import Pose

#: How earth curvature may be regarded.
EARTH_CURVATURE = ("none", "correction", "strict")


def oriented_camera(
    interior: Interior,
    lens: Lens,
    pose: Pose,
    *,
    crs: str | None = None,
    earth_curvature: str = "none",
    refraction: bool = False,
    mean_ground: float = 0.0,
) -> CentralCamera:
    """A camera in map coordinates from its interior and exterior orientation.

    Parameters
    ----------
    interior, lens
        Interior orientation and lens.
    pose : Pose
        Projection centre in map coordinates, angles relative to the map's axes at the station.
    crs : str, optional
        The projected CRS; needed for ``"strict"``.
    earth_curvature : str
        ``"none"``: map coordinates are Cartesian (orientations that were adjusted in map coordinates with their own
        correction, small blocks); ``"correction"``: image-coordinate correction (Ecker 1991, eq. 4.16);
        ``"strict"``: through a local tangential system at the station.
    refraction : bool
        Whether the standard atmosphere bends the rays; heights are then those above sea level, roughly.
    mean_ground : float
        Height of the ground below the camera, metres; ``"correction"`` refers to it.

    Raises
    ------
    UsageError
        `earth_curvature` is unknown, or ``"strict"`` without a CRS.
    InputError
        The lens folds back inside the image, or the CRS cannot be used.
    """
    if earth_curvature not in EARTH_CURVATURE:
        raise UsageError(f"earth curvature {earth_curvature!r}; allowed are {', '.join(EARTH_CURVATURE)}")
    X, Y, Z = pose.center.tolist()
    before: tuple[Warp, ...] = (Refraction((X, Y, Z)),) if refraction else ()
    if earth_curvature == "strict":
        if crs is None:
            raise UsageError("strict earth curvature needs the CRS of the map coordinates")
        return curved_camera(interior, lens, pose, LocalFrame(crs, (X, Y), mean_ground), before)
    frame = FrameCamera(interior, lens, pose)
    if earth_curvature == "correction":
        radius = MEAN_RADIUS if crs is None else earth_radius(crs, (X, Y))
        return corrected_camera(frame, mean_ground, radius + mean_ground, before)
    return WarpedCamera(frame, before, pose.center) if before else frame


def taken_apart(camera: Projection) -> tuple[FrameCamera, tuple[Warp, ...], float] | None:
    """A camera as one with straight rays, and the warps and the curvature, 1/m, that lead from the map to its space.

    None: its rays do not meet in a point.
    """
    if isinstance(camera, WarpedCamera):
        return camera.frame, camera.warps, camera.curvature
    return (camera, (), 0.0) if isinstance(camera, FrameCamera) else None


@dataclass(frozen=True)
class CurvatureCorrection:
    """Ecker 1991, eq. 4.16, for computations that treat map coordinates as if they were Cartesian.

    The equation states by how much the image coordinates that are computed from map coordinates are too long:

        Δx = x / 2R · (r² (Z0 − Z) / c² − 2 Z),    heights above the nadir point.

    Here the same amount is taken off in the equivalent vertical image, as a displacement of the ground towards the
    nadir. For a vertical image that is the equation itself; for a tilted one it stays right, where the
    equation about the principal point would not. Terms of second order in distance / R are neglected.

    Points whose ray is so flat that the formula runs back (d² > R (Z0 − Z) / 2, more than 15 flying heights away even
    from 14 km) and points above the camera give NaN.
    """

    center: tuple[float, float, float]
    """Projection centre X0, Y0, Z0 in map coordinates, metres."""
    nadir_height: float
    """Height of the ground below the camera, metres."""
    radius: float
    """Earth radius increased by that height, metres."""

    def __post_init__(self) -> None:
        if not self.radius > 0:
            raise InputError(f"earth radius {self.radius}; a positive number of metres is needed")

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map points (..., 3) to the points that a Cartesian projection takes to their true image."""
        out = np.array(XYZ, float)
        dx, dy, factor, _ = self._terms(out)
        out[..., 0] = self.center[0] + dx * factor
        out[..., 1] = self.center[1] + dy * factor
        return out

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Derivative of the displaced by the given point, shape (..., 3, 3)."""
        XYZ = np.asarray(XYZ, float)
        dx, dy, factor, depth = self._terms(XYZ)
        by_x, by_y = -dx / (self.radius * depth), -dy / (self.radius * depth)
        by_z = (1.0 - (dx * dx + dy * dy) / (2.0 * depth * depth)) / self.radius
        J = np.zeros((*XYZ.shape, 3))
        J[..., 0, 0], J[..., 0, 1], J[..., 0, 2] = factor + dx * by_x, dx * by_y, dx * by_z
        J[..., 1, 0], J[..., 1, 1], J[..., 1, 2] = dy * by_x, factor + dy * by_y, dy * by_z
        J[..., 2, 2] = 1.0
        return J

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """Return where displaced points (..., 3) are; NaN where there is no such point."""
        return inverse_by_newton(self, displaced)

    def _terms(
        self, XYZ: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Distances from the nadir, the factor that shortens them, and the depth below the camera."""
        dx, dy = XYZ[..., 0] - self.center[0], XYZ[..., 1] - self.center[1]
        depth = self.center[2] - XYZ[..., 2]
        d2 = dx * dx + dy * dy
        with np.errstate(invalid="ignore"):
            depth = np.where((depth > 0) & (d2 <= 0.5 * self.radius * depth), depth, np.nan)
        factor = 1.0 - (d2 / depth - 2.0 * (XYZ[..., 2] - self.nadir_height)) / (2.0 * self.radius)
        return dx, dy, factor, depth


def corrected_camera(
    frame: FrameCamera, nadir_height: float, radius: float, before: tuple[Warp, ...] = ()
) -> WarpedCamera:
    """A frame camera in map coordinates with earth curvature as a correction (Ecker 1991, §4.6.5.2)."""
    X, Y, Z = frame.center.tolist()
    correction = CurvatureCorrection((X, Y, Z), nadir_height, radius)
    return WarpedCamera(frame, (*before, correction), frame.center, 1.0 / radius)


_Floats = NDArray[np.float64]
#: Points on a side of the grid over an image that is followed to the ground: a body may fill little of it.
_SIDE = 33


@dataclass(frozen=True, eq=False)
class BodyFrameCamera:
    """A frame image in the axes of its body, over the ground of a project.

    What the body itself hides, on its far side, has no position.
    """

    frame: FrameCamera
    """The camera in the axes of the body."""
    ground: BodyGround

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.frame.size

    @property
    def field(self) -> ImageField | None:
        """Lens of the frame camera."""
        return self.frame.field

    @property
    def breaks(self) -> None:
        """The mapping is smooth."""
        return None

    @cached_property
    def vantage(self) -> Vantage:
        """Above the middle of what it sees."""
        w, h = self.size
        rows, columns = np.linspace(-0.5, h - 0.5, _SIDE), np.linspace(-0.5, w - 0.5, _SIDE)
        xy = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        return vantage_over(self.ground, self.frame.center[None], lambda level: self.rays(xy, level)[0])

    def project_homogeneous(self, XYZ: ArrayLike) -> _Floats:
        """Ground (..., 3) to ideal (x·w, y·w, w), w = depth in metres; NaN behind the body."""
        P = self.ground(XYZ)
        out = self.frame.project_homogeneous(P)
        out[self._hidden(P)] = np.nan
        return out

    def derivatives(self, XYZ: ArrayLike) -> _Floats:
        """∂(x, y)/∂(X, Y, Z), shape (..., 2, 3), pixels per metre; NaN behind the camera and the body."""
        P = self.ground(XYZ)
        out = self.frame.derivatives(P) @ self.ground.jacobian(XYZ)
        out[self._hidden(P)] = np.nan
        return np.asarray(out)

    def rays(self, xy: ArrayLike, height: ArrayLike | None = None) -> tuple[_Floats, _Floats]:
        """Image points (..., 2) to rays: the point of the ray at `height` and its tangent there, each (..., 3).

        `height` is one number or one for each point. NaN where a ray passes the body.
        """
        if height is None:
            raise UsageError("rays over a body are curved on the map; give a height")
        xy = np.asarray(xy, float)
        S, d = self.frame.rays(xy.reshape(-1, 2))
        point, tangent = meet(self.ground, S, d, np.broadcast_to(np.asarray(height, float), xy.shape[:-1]).ravel())
        return point.reshape(*xy.shape[:-1], 3), tangent.reshape(*xy.shape[:-1], 3)

    def _hidden(self, P: _Floats) -> NDArray[np.bool_]:
        """Return whether the lowest ground there may be lies between the camera and points (..., 3) of the body."""
        a, b = (radius + heights_of(self.ground)[0] for radius in self.ground.radii)
        s = self.frame.center / (a, a, b)
        way = P / (a, a, b) - s
        # Where on the way the centre of the body, a sphere now, is nearest.
        part = np.clip(-(way @ s) / (way**2).sum(axis=-1), 0.0, 1.0)
        return np.asarray(((s + part[..., None] * way) ** 2).sum(axis=-1) < 1.0)


_Doubles = NDArray[np.float64]

#: Points along a side of the target from the nearest of which a ray is followed, times that it is, and pixels by which
#: it may miss then.
_POINTS, _TIMES, _OFF = 17, 5, 1e-6
#: Lines of sight are cut into at most so many pieces, as these of them need.
_MOST_PIECES, _SAMPLE = 128, 256
#: Metres before a place of a ray from which it is followed, if it begins nowhere.
_BEFORE = 100_000.0


@dataclass(frozen=True, eq=False)
class FramedCamera:
    """Points of a frame go to the ground, then to the image."""

    camera: Camera
    frame: Frame
    around: tuple[float, float, float, float]
    """Least and largest u and v of what is looked at: u, v, u, v."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.camera.size

    @property
    def field(self) -> ImageField | None:
        """The camera's: what happens in the image is the same."""
        return self.camera.field

    @property
    def breaks(self) -> Breaks | Tremor | Parts | None:
        """The camera's; parts of an image lie in the frame, too."""
        breaks = self.camera.breaks
        if not isinstance(breaks, Parts):
            return breaks
        return Parts(tuple(replace(p, projection=replace(self, camera=p.projection)) for p in breaks.parts))  # type: ignore[arg-type]

    @property
    def vantage(self) -> Vantage:
        """Return where it looks from.

        Where the frame ends in front, its heights bound what is seen, and the camera is central no more. One that is
        not central itself looks from as far away as the target is long.
        """
        own = self.camera.vantage
        low, high = self.frame.heights
        if not own.central:
            u, v = (self.around[k] + self.around[k + 2] for k in (0, 1))
            long = max(self.around[k + 2] - self.around[k] for k in (0, 1))
            return Vantage(np.array([u / 2, v / 2, min(high, long)]), low, math.inf)
        point = self.frame.inverse(own.point)
        if math.isinf(high):
            return Vantage(point, low)
        return Vantage(np.array([*np.nan_to_num(point[:2]), self.frame.top(point)]), low, math.inf)

    def project_homogeneous(self, XYZ: ArrayLike) -> _Doubles:
        """Points of the frame (..., 3) to ideal (x·w, y·w, w), shape (..., 3); NaN where the frame has no ground."""
        return self.camera.project_homogeneous(self.frame(XYZ))

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[_Doubles, _Doubles]:
        """Image points (..., 2) to rays in the frame: a point, that at `height` where it matters, and unit directions.

        NaN where the ray does not get there. Rays that are bent on the ground are found at the height.
        """
        height = 0.0 if height is None else height
        try:
            return self.frame.lines(*self.camera.rays(xy), height)
        except UsageError:
            pass
        xy = np.asarray(xy, float)
        flat = xy.reshape(-1, 2)
        found = self._met_from_a_point if self.camera.vantage.central else self._met_by_tangents
        with np.errstate(all="ignore"):
            points, ways = found(flat, self._near(flat, height), height)
            ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        return points.reshape(*xy.shape[:-1], 3), ways.reshape(*xy.shape[:-1], 3)

    def derivatives(self, XYZ: ArrayLike) -> _Doubles:
        """∂(x, y)/∂(u, v, h), shape (..., 2, 3), pixels per metre; NaN behind the camera."""
        return self.camera.derivatives(self.frame(XYZ)) @ self.frame.jacobian(XYZ)

    def sight_paths(self, uvh: _Doubles, tolerance: float) -> _Doubles:
        """Lines of sight from places of the frame (n, 3) to the camera, in so many pieces that they follow the bends of
        the frame to a tolerance, metres; shape (n, k, 3). u goes on beyond half a turn."""
        here = self.frame(uvh)
        if self.camera.vantage.central:
            there = np.broadcast_to(self.camera.vantage.point, here.shape)
        else:
            _, way = self.camera.rays(project(self.camera, here), here[:, 2])  # type: ignore[arg-type]
            there = here - self.vantage.point[2] * way
        way, some, pieces = there - here, slice(None, None, max(1, len(here) // _SAMPLE)), 4
        unit = (way[some] / np.linalg.norm(way[some], axis=-1, keepdims=True))[:, None]
        while pieces < _MOST_PIECES:
            line, path = self._pieces(uvh[some], here[some], way[some], 2 * pieces)
            # On the ground: close to the axis a turn is short. Along the line a difference does not matter.
            off = self.frame((path[:, :-1:2] + path[:, 2::2]) / 2) - line[:, 1::2]
            off -= (off * unit).sum(axis=-1, keepdims=True) * unit
            if np.nanmax(np.linalg.norm(off, axis=-1), initial=0.0) <= tolerance:
                break
            pieces *= 2
        return self._pieces(uvh, here, way, pieces)[1]

    def _pieces(self, uvh: _Doubles, here: _Doubles, way: _Doubles, pieces: int) -> tuple[_Doubles, _Doubles]:
        """Lines (n, k, 3) on the ground and in the frame, the pieces shortest where they begin: there it bends most."""
        line = here[:, None] + np.linspace(0.0, 1.0, pieces + 1)[:, None] ** 2 * way[:, None]
        path = self.frame.inverse(line)
        path[:, 0] = uvh
        if math.isfinite(self.frame.turn):
            path[..., 0] = np.unwrap(path[..., 0], axis=1, period=self.frame.turn)
        return line, path

    def _met_from_a_point(self, xy: _Doubles, uvh: _Doubles, height: float) -> tuple[_Doubles, _Doubles]:
        """Places at a height whose images are xy (n, 2), from places near them; by Newton's method, as level rays meet
        no Z. And the ways there."""
        for _ in range(_TIMES):
            J, miss = self.derivatives(uvh)[:, :, :2], xy - project(self, uvh)
            known = np.isfinite(J).all(axis=(1, 2)) & np.isfinite(miss).all(axis=1)
            step = np.full_like(miss, np.nan)
            step[known] = np.linalg.solve(J[known], miss[known, :, None])[..., 0]
            uvh = uvh + np.column_stack([step, np.zeros(len(step))])
        uvh[~(np.abs(project(self, uvh) - xy).max(axis=1) < _OFF)] = np.nan
        way = self.frame(uvh) - self.camera.vantage.point
        return uvh, np.asarray(np.linalg.solve(self.frame.jacobian(uvh), way[..., None])[..., 0])

    def _met_by_tangents(self, xy: _Doubles, uvh: _Doubles, height: float) -> tuple[_Doubles, _Doubles]:
        """Return where rays meet a height: their tangents do, at the Z where they met it before; and the ways there.

        A line on a turbulent flight sees a place several times, but each pixel has one ray.
        """
        for _ in range(_TIMES):
            origin, way = self.camera.rays(xy, self.frame(uvh)[:, 2])  # type: ignore[arg-type]
            uvh, ways = self.frame.lines(origin - _BEFORE * way, way, height)
            uvh = uvh + ((height - uvh[:, 2:]) / ways[:, 2:]) * ways
        return uvh, ways

    def _near(self, xy: _Doubles, height: float) -> _Doubles:
        """Places of the target that are seen nearest to image points (n, 2), shape (n, 3)."""
        u, v = (np.linspace(self.around[k], self.around[k + 2], _POINTS) for k in (0, 1))
        uvh = np.stack([*np.meshgrid(u, v), np.full((_POINTS, _POINTS), height)], axis=-1).reshape(-1, 3)
        at = project(self, uvh)
        seen = np.isfinite(at).all(axis=1)
        if not seen.any():
            return np.full((len(xy), 3), np.nan)
        _, nearest = scipy.spatial.cKDTree(at[seen]).query(np.where(np.isfinite(xy), xy, 0.0))
        return np.asarray(uvh[seen][nearest])
