"""Line cameras: every line of the image has its own position and rotation (Schlüter 2001, §2)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Vantage
from photoplan.cameras.body_sight import meet, radius_below, vantage_over
from photoplan.cameras.line_look import LineLook
from photoplan.cameras.line_sight import FOUND, LineSight, to_sphere
from photoplan.cameras.line_track import LineTrack
from photoplan.cameras.line_tremor import LineTremor, Moments, smoothed
from photoplan.errors import InputError, UsageError
from photoplan.geometry.body import BodyGround
from photoplan.geometry.near import NearGround, near_ground

_Floats = NDArray[np.float64]
#: Rows beyond either end of the image that still have positions: a part of its height, and lines.
_ROOM = (0.25, 256.0)
#: Half the time over which the change of what a shaken line sees is taken, lines.
_SHORT = 1e-3


@dataclass(frozen=True, eq=False)
class LineCamera:
    """An image of one detector line that was carried over the ground, over the ground of a project.

    A ground point is seen at the moment at which it lies in the plane (or the cone, with a lens) of the line; `project`
    finds it by the secant method from a linear start; where a turbulent flight sees it several times, see `moments`.
    Rows are counted by lines; the centre of a line's exposure is a whole number.
    """

    track: LineTrack
    look: LineLook
    ground: BodyGround

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.look.columns, self.track.lines

    @property
    def field(self) -> None:
        """All is in the first factor."""
        return None

    def along(self, track: LineTrack) -> LineCamera:
        """The same line on another way."""
        return LineCamera(track, self.look, self.ground)

    def calm(self) -> LineCamera:
        """The same on a flight without tremor."""
        return self if self.breaks is None else self.breaks.smooth

    @cached_property
    def breaks(self) -> LineTremor[LineCamera] | None:
        """What of a turbulent flight changes from line to line; None: the trajectory is smooth."""
        if not self.track.per_line:
            return None
        return smoothed(self)

    @cached_property
    def near(self) -> NearGround:
        """The ground that it sees."""
        _, S, d, r = self._spread
        # Grids of heights may end before the image does.
        return near_ground(self.ground, self.ground.bare.to_map(S + r[:, None] * d)[:, :2])

    @cached_property
    def sight(self) -> LineSight:
        """What it sees in the axes of the body, from the origin of `near`."""
        return LineSight(self.track, self.look, self.near.origin)

    def moments(self, XYZ: ArrayLike) -> Moments:
        """All moments at which ground points (n, 3) are seen: where turbulence is strong, more than one.

        `project` takes the first by which the point lies on the other side of the line of detectors at the next whole
        row: what turns back within a row does not count there. Moments outside the image and at lines without
        orientation are not among them.
        """
        P = self.near(np.asarray(XYZ, float).reshape(-1, 3))
        if self.breaks is None:
            xy = self.seen_from(P)
            point = np.flatnonzero(np.isfinite(xy[:, 0]))
            xy = xy[point]
        else:
            point, rows, _ = self.breaks.passages(P)
            xy = self.sight.between(P[point], rows)
        inside = ((xy >= -0.5) & (xy <= np.array(self.size) - 0.5)).all(axis=1) & ~self.unoriented(xy[:, 1])
        return Moments(point[inside], xy[inside])

    def project_homogeneous(self, XYZ: ArrayLike) -> _Floats:
        """Ground (..., 3) to (x·w, y·w, w); NaN behind the camera, and at lines whose orientation is not known.

        Along a line the mapping is projective: w is the depth in the camera at the moment at which a point is seen.
        Across it is parallel; where a line looks further ahead than to the sides, w is 1.
        """
        XYZ = np.asarray(XYZ, float)
        P = self.near(XYZ.reshape(-1, 3))
        xy = self.seen_from(P)
        out = np.full((len(P), 3), np.nan)
        seen = np.flatnonzero(np.isfinite(xy[:, 0]))
        S, R = self.track(xy[seen, 1], self.near.origin)
        w = np.einsum("ni,ni->n", R[:, :, 2], P[seen] - S) if self.look.is_wide else np.ones(len(seen))
        out[seen] = np.column_stack([xy[seen] * w[:, None], w])
        return out.reshape(XYZ.shape)

    def derivatives(self, XYZ: ArrayLike) -> _Floats:
        """∂(x, y)/∂(X, Y, Z), shape (..., 2, 3), pixels per metre; NaN where there is no position."""
        XYZ = np.asarray(XYZ, float)
        flat = XYZ.reshape(-1, 3)
        P = self.near(flat)
        x, y = self.seen_from(P).T
        with np.errstate(all="ignore"):
            S, R = self.track(y, self.near.origin)
            d = np.einsum("nij,ni->nj", R, P - S)
            tangents = d[:, :2] / d[:, 2:]
            by_ground = (R[:, :, :2] - R[:, :, 2:] * tangents[:, None, :]) / d[:, 2, None, None]
            half = 0.5 if self.breaks is None else _SHORT
            later, earlier = self.sight.tangents(P, y + half), self.sight.tangents(P, y - half)
            # The tangents of the ground point are those of its column: they change together.
            J = np.stack([self.look.slope(x), (earlier - later) / (2 * half)], axis=-1)
            A = np.linalg.solve(np.where(np.isfinite(J), J, np.eye(2)), np.swapaxes(by_ground, 1, 2))
            out = A @ self.ground.jacobian(flat)
        out[np.isnan(x)] = np.nan
        return np.asarray(out.reshape(*XYZ.shape[:-1], 2, 3))

    def rays(self, xy: ArrayLike, height: ArrayLike | None = None) -> tuple[_Floats, _Floats]:
        """Image points (..., 2) to rays: the point of the ray at `height` and its tangent there, each (..., 3).

        `height` is one number or one for each point. NaN at lines whose orientation is not known, and where a ray does
        not meet the height.

        Raises
        ------
        UsageError
            `height` is missing.
        """
        if height is None:
            raise UsageError("rays of a line camera begin at no common point; give a height")
        xy = np.asarray(xy, float)
        flat = xy.reshape(-1, 2)
        S, d = self._known_rays(self.sight, flat)
        heights = np.broadcast_to(np.asarray(height, float), xy.shape[:-1]).ravel()
        point, tangent = meet(self.ground, S + self.near.origin, d, heights)
        point = self.near.sharpened(point, S, d)
        return point.reshape(*xy.shape[:-1], 3), tangent.reshape(*xy.shape[:-1], 3)

    def body_rays(self, xy: _Floats) -> tuple[_Floats, _Floats]:
        """Projection centres and unit directions of image points (n, 2) in the axes of the body, each (n, 3)."""
        return self._known_rays(LineSight(self.track, self.look), xy)

    def _known_rays(self, sight: LineSight, xy: _Floats) -> tuple[_Floats, _Floats]:
        """Rays of what it sees, NaN at rows whose orientation is not known."""
        unknown = ~np.isfinite(xy).all(axis=1) | self.unoriented(xy[:, 1])
        S, d = sight.rays(np.nan_to_num(xy))
        S[unknown], d[unknown] = np.nan, np.nan
        return S, d

    @cached_property
    def vantage(self) -> Vantage:
        """Above the middle of what it sees: the highest ground there is, but not above the camera."""
        first, last = self.track.oriented
        rows, columns = np.linspace(first, last, 17), np.linspace(-0.5, self.size[0] - 0.5, 9)
        xy = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        return vantage_over(self.ground, self.body_rays(xy)[0], lambda level: self.rays(xy, level)[0])

    def unoriented(self, y: _Floats) -> NDArray[np.bool_]:
        """Rows inside the image whose orientation is not known."""
        inside = (y >= -0.5) & (y <= self.size[1] - 0.5)
        return np.asarray(inside & ~self.track.is_oriented(y))

    def seen_from(self, P: _Floats, close: float = FOUND) -> _Floats:
        """Positions (n, 2) of points (n, 3) from the origin of `near`; on smooth flights to `close` lines."""
        room = self._room
        tremor = self.breaks
        if tremor is None:
            out = self.sight.found(P, self._start(P), *room, close)
        else:
            out = np.full((len(P), 2), np.nan)
            point, rows = tremor.first(P)
            out[point] = self.sight.between(P[point], rows)
        out[(out[:, 1] < room[0]) | (out[:, 1] > room[1]) | self.unoriented(out[:, 1])] = np.nan
        return out

    @property
    def _room(self) -> tuple[float, float]:
        """First and last row that have positions."""
        room = _ROOM[0] * self.size[1] + _ROOM[1]
        return -room, self.size[1] - 1 + room

    def _start(self, P: _Floats) -> _Floats:
        """Rows at which to begin."""
        origin, scale, coefficients = self._linear
        return np.asarray(coefficients[0] + ((P - origin) / scale) @ coefficients[1:])

    @cached_property
    def _linear(self) -> tuple[_Floats, float, _Floats]:
        """Rows as a linear function of the place, over the points of rays down to the ground and a tenth above it."""
        y, S, d, r = self._spread
        places = np.concatenate([S + part * r[:, None] * d for part in (0.9, 1.0)]) - self.near.origin
        origin, scale = places.mean(axis=0), float(np.ptp(places, axis=0).max())
        A = np.column_stack([np.ones(len(places)), (places - origin) / scale])
        return origin, scale, np.linalg.lstsq(A, np.tile(y, 2), rcond=1e-9)[0]

    @cached_property
    def _spread(self) -> tuple[_Floats, _Floats, _Floats, _Floats]:
        """Rows (n,) spread over the image, with their rays in the axes of the body and the way (n,) to the ground."""
        first, last = self.track.oriented
        rows, columns = np.linspace(first, last, 9), np.linspace(0, self.size[0] - 1, 5)
        xy = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        S, d = self.body_rays(xy)
        r = to_sphere(S, d, radius_below(self.ground, S))
        good = np.isfinite(r)
        if not good.any():
            raise InputError("the camera does not look at the body; are positions and attitudes in the same axes?")
        return xy[good, 1], S[good], d[good], r[good]
