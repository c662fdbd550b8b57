"""Push-broom (line) cameras: projection, rays, and chips of detectors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Part, Parts, Vantage
from photoplan.cameras.pushbroom_rays import (
    FOUND,
    LineLook,
    LineSight,
    LineTrack,
    LineTremor,
    Moments,
    meet,
    radius_below,
    smoothed,
    to_sphere,
    vantage_over,
)
from photoplan.errors import InputError, UsageError
from photoplan.geometry.local import BodyGround, NearGround, near_ground

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
        """Return what of a turbulent flight changes from line to line; None: the trajectory is smooth."""
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
        """Return what it sees in the axes of the body, from the origin of `near`."""
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


#: Gaps between chips up to this, columns, are shown by the columns beside them; in wider ones nothing is seen.
_FILLED = 1.0
#: Columns at the edge of a chip that are left to another that sees the same.
_LEFT = 2.0


@dataclass(frozen=True, eq=False)
class ChippedLine:
    """A line camera of several chips: a camera for each, all of the same columns of one image.

    Chips may stand one behind the other: what they see at one moment lies apart then, and each finds a ground point at
    a moment of its own. Where they overlap, that chip counts which sees a point two columns inside or more, of both the
    one of lower columns; `moments` names all. Between chips that lie more than a column apart nothing is seen.
    """

    chips: tuple[LineCamera, ...]
    """Cameras of the chips, of the whole image's columns; each look states its own part of them."""

    def __post_init__(self) -> None:
        ends = [each.look.ends for each in self.chips]
        whole = ends[0][0] == -0.5 and ends[-1][1] == self.size[0] - 0.5
        if not whole or any(a[1] != b[0] for a, b in pairwise(ends)):
            raise InputError("chips of a line do not cover its columns one after the other")
        for k, gap in enumerate(self.gaps):
            if not gap > -(ends[k][1] - ends[k][0]) / 2:
                raise InputError(f"chip {k + 2} of the line lies over half of chip {k + 1}, or beside it in reverse")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.chips[0].size

    @property
    def field(self) -> None:
        """All is in the first factor."""
        return None

    @property
    def track(self) -> LineTrack:
        """Return where it was."""
        return self.chips[0].track

    @property
    def ground(self) -> BodyGround:
        """Over which it is."""
        return self.chips[0].ground

    def along(self, track: LineTrack) -> ChippedLine:
        """The same line on another way."""
        return ChippedLine(tuple(each.along(track) for each in self.chips))

    def calm(self) -> ChippedLine:
        """The same on a flight without tremor."""
        return ChippedLine(tuple(each.calm() for each in self.chips))

    @cached_property
    def gaps(self) -> tuple[float, ...]:
        """Columns that are missing between chips; below 0: they overlap."""
        out = []
        for one, other in pairwise(self.chips):
            end, begin = one.look.ends[1], other.look.ends[0]
            away = other.look.tangents(np.array([begin])) - one.look.tangents(np.array([end]))
            out.append(float((away @ one.look.axes[0])[0]) / one.look.pitch)
        return tuple(out)

    @cached_property
    def breaks(self) -> Parts:
        """A part for each chip; where chips overlap, the parts are those without their edges, and then the whole."""
        gaps = (0.0, *self.gaps, 0.0)
        filled = [gap / 2 if 0.0 < gap <= _FILLED else 0.0 for gap in gaps]
        left = [_LEFT * (gap < 0.0) for gap in gaps]
        parts = [Part(each, *each.look.ends, a, b) for each, a, b in zip(self.chips, filled, filled[1:])]
        # A chip shows little at its very edge: first what it sees well, then the rest.
        well = [
            replace(part, before=part.before - a, after=part.after - b) for part, a, b in zip(parts, left, left[1:])
        ]
        return Parts((*well, *(replace(part, rest=True) for part in parts)) if any(left) else tuple(parts))

    @property
    def vantage(self) -> Vantage:
        """Return that of its first chip, whose line goes straight on."""
        return self.chips[0].vantage

    def project_homogeneous(self, XYZ: ArrayLike) -> _Floats:
        """See `LineCamera.project_homogeneous`."""
        XYZ = np.asarray(XYZ, float)
        found = np.stack([each.project_homogeneous(XYZ) for each in self.chips])
        return self._chosen(found, found[..., 0] / found[..., 2])

    def derivatives(self, XYZ: ArrayLike) -> _Floats:
        """See `LineCamera.derivatives`."""
        h = np.stack([each.project_homogeneous(XYZ) for each in self.chips])
        found = np.stack([each.derivatives(XYZ) for each in self.chips])
        flat = self._chosen(found.reshape(*found.shape[:-2], 6), h[..., 0] / h[..., 2])
        return flat.reshape(found.shape[1:])

    def rays(self, xy: ArrayLike, height: ArrayLike | None = None) -> tuple[_Floats, _Floats]:
        """See `LineCamera.rays`."""
        xy = np.asarray(xy, float)
        chip = self.chip(xy[..., 0])
        found = [np.stack(each.rays(xy, height)) for each in self.chips]
        point, tangent = np.where(np.isnan(xy[..., :1]), np.nan, np.choose(chip[..., None], found))
        return point, tangent

    def body_rays(self, xy: _Floats) -> tuple[_Floats, _Floats]:
        """See `LineCamera.body_rays`."""
        chip = self.chip(xy[:, 0])[:, None]
        S, d = (np.choose(chip, each) for each in zip(*(one.body_rays(xy) for one in self.chips)))
        return S, d

    def moments(self, XYZ: ArrayLike) -> Moments:
        """See `LineCamera.moments`; of every chip by itself."""
        points, places = [], []
        for each in self.chips:
            found = each.moments(XYZ)
            low, high = each.look.ends
            mine = (found.xy[:, 0] >= low) & (found.xy[:, 0] <= high)
            points.append(found.point[mine])
            places.append(found.xy[mine])
        point, xy = np.concatenate(points), np.concatenate(places)
        order = np.lexsort((xy[:, 1], point))
        return Moments(point[order], xy[order])

    def chip(self, column: _Floats) -> NDArray[np.int64]:
        """Number of the chip that has a column."""
        return np.searchsorted([each.look.ends[1] for each in self.chips[:-1]], np.nan_to_num(column), side="right")

    def _chosen(self, found: _Floats, columns: _Floats) -> _Floats:
        """Return the values (chips, ..., k) of the first chip that sees the columns (chips, ...)."""
        out = np.full(found.shape[1:], np.nan)
        count = len(self.chips)
        for number, part in reversed(list(enumerate(self.breaks.parts))):
            k = number % count
            low = -np.inf if k == 0 else part.first - part.before
            high = np.inf if k == count - 1 else part.end + part.after
            mine = (columns[k] >= low) & (columns[k] <= high)
            out[mine] = found[k][mine]
        return out


@dataclass(frozen=True, eq=False)
class LineMiss:
    """Image residuals of ground points against where they were measured."""

    miss: _Floats
    """From there to where they are seen, (n, 2), pixels; NaN: behind the camera, or the row has no orientation."""
    by_place: _Floats
    """Its derivatives by places in the axes of the body, (n, 2, 3), pixels per metre."""


def measured(camera: LineCamera | ChippedLine, steady: LineCamera | ChippedLine, XYZ: _Floats, xy: _Floats) -> LineMiss:
    """Compare ground points (n, 3) with measured positions (n, 2), at the moments of the measured rows.

    A step of Newton's method from where the point was measured to where `camera` sees it. On a turbulent flight a point
    may be seen several times, and not at all at the next iteration of an adjustment: what was measured tells which
    moment is meant, and what is left there changes smoothly with the trajectory. Rows are counted by the pace of
    `steady`, the same flight without tremor: where a shaken line stands still on the ground, rows say nothing.
    """
    if isinstance(camera, LineCamera):
        assert isinstance(steady, LineCamera)
        return _of_line(camera, steady, XYZ, xy)
    assert isinstance(steady, ChippedLine)
    miss, by_place, chip = np.empty((len(xy), 2)), np.empty((len(xy), 2, 3)), camera.chip(xy[:, 0])
    for k, (one, calm) in enumerate(zip(camera.chips, steady.chips)):
        mine = chip == k
        part = _of_line(one, calm, XYZ[mine], xy[mine])
        miss[mine], by_place[mine] = part.miss, part.by_place
    return LineMiss(miss, by_place)


def _of_line(camera: LineCamera, steady: LineCamera, XYZ: _Floats, xy: _Floats) -> LineMiss:
    P, (x, y) = camera.near(XYZ), xy.T
    S, R = camera.track(y, camera.near.origin)
    with np.errstate(all="ignore"):
        d = np.einsum("nij,ni->nj", R, P - S)
        d[~(d[:, 2] > 0) | camera.unoriented(y)] = np.nan
        tangents = d[:, :2] / d[:, 2:]
        by_place = (R[:, :, :2] - R[:, :, 2:] * tangents[:, None, :]) / d[:, 2, None, None]
        calm = LineSight(steady.track, steady.look, camera.near.origin)
        later, earlier = calm.tangents(P, y + 0.5), calm.tangents(P, y - 0.5)
        J = np.stack([camera.look.slope(x), earlier - later], axis=-1)
        good = np.asarray(np.isfinite(J).all(axis=(1, 2)))
        A = np.linalg.solve(
            np.where(good[:, None, None], J, np.eye(2)),
            np.concatenate([(tangents - camera.look.tangents(x))[:, :, None], np.swapaxes(by_place, 1, 2)], axis=2),
        )
    A[~good] = np.nan
    return LineMiss(A[:, :, 0], A[:, :, 1:])
