"""A camera in the coordinates of a frame: over a wall or a vault, or along another image."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera, ImageField, Parts, Tremor, Vantage, project
from photoplan.errors import UsageError
from photoplan.geometry.frames import Frame
from photoplan.geometry.grid import Breaks

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
