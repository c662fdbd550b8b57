"""Rays of push-broom (line) cameras: look angles, trajectory, jitter from line to line."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import ClassVar, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera, Vantage
from photoplan.errors import InputError
from photoplan.geometry.local import BodyGround, NearGround
from photoplan.geometry.pose import Course, continuous, cubic_convolution, rotations
from photoplan.kernels.linear_pushbroom import project_linear_pushbroom

_Floats = NDArray[np.float64]
#: Lines by which tables may end before the image, since large times are rounded.
_SLACK = 1e-3
#: No line of a camera is exposed for less or more, seconds.
_SHORTEST, _LONGEST = 1e-8, 1e5
#: Lines over which the mean rate at the ends is taken.
_AVERAGED = 128
#: Rows beyond either end of the image that have poses of their own: a part of its height, and lines.
_ROOM = (0.25, 256.0)


@dataclass(frozen=True, eq=False)
class LineTrack:
    """From the lines of an image to position and rotation, in the axes of a body."""

    lines: int
    """Rows of the image."""
    knots: _Floats
    """Rows (n,) from which on the clock has another rate."""
    moments: _Floats
    """Their times (n,), seconds; there may be a pause before any of them."""
    rates: _Floats
    """Seconds from line to line (n,), from each of them on."""
    positions: Course
    """Projection centres (n, 3), metres."""
    attitudes: Course
    """Quaternions (n, 4) of the rotation from camera axes to those of the body, scalar first."""
    known: tuple[float, float]
    """First and last moment of which both are known, seconds."""
    per_line: bool = False
    """Whether only whole rows have poses of their own: what lies between them is then interpolated as grey values are,
    by cubic convolution. An image shows nothing of how a camera shook between two lines; geometry that went its own
    way there would be another one than that of the resampled grey values. For clocks without pauses."""

    gaps: tuple[tuple[float, float], ...] = ()
    """Moments between which nothing is known after all: the record has a gap; seconds."""

    def __post_init__(self) -> None:
        ends = self.moments[:-1] + self.rates[:-1] * np.diff(self.knots)
        late = ends > self.moments[1:] + _SLACK * self.rates[:-1]
        if not ((self.rates > 0).all() and (np.diff(self.knots) > 0).all()) or late.any():
            raise InputError("the times of the image's lines do not grow from line to line")
        odd = self.rates[(self.rates < _SHORTEST) | (self.rates > _LONGEST)]
        if len(odd):
            raise InputError(f"lines of {odd[0]:g} s; from {_SHORTEST:g} to {_LONGEST:g} s are taken")
        first, last = self.oriented
        if not (last > first):
            began, ended = self.time(np.array([0.0, self.lines - 1.0]))
            raise InputError(
                f"no line of the image is oriented: they were taken from {began:.3f} to {ended:.3f} s, positions and "
                f"attitudes are known from {self.known[0]:.3f} to {self.known[1]:.3f} s"
            )

    @cached_property
    def oriented(self) -> tuple[float, float]:
        """First and last row of the image, fractions included, whose position and attitude are known."""
        begins = np.maximum(np.concatenate([[-0.5], self.knots[1:]]), -0.5)
        ends = np.minimum(np.concatenate([self.knots[1:], [np.inf]]), self.lines - 0.5)
        first, last = (self.knots + (known - self.moments) / self.rates for known in self.known)
        first, last = np.maximum(begins, first), np.minimum(ends, last)
        some = last > first
        if not some.any():
            return -0.5, -0.5
        low, high = float(first[some].min()), float(last[some].max())
        # Tables that are to cover the image do so but for the rounding of large times.
        return low if low > -0.5 + _SLACK else -0.5, high if high < self.lines - 0.5 - _SLACK else self.lines - 0.5

    def is_oriented(self, line: _Floats) -> NDArray[np.bool_]:
        """Return whether position and attitude are known at rows (n,)."""
        slack = _SLACK * self.rates.max()
        t = self.time(line)
        inside = (t >= self.known[0] - slack) & (t <= self.known[1] + slack)
        for begin, end in self.gaps:
            inside &= (t <= begin + slack) | (t >= end - slack)
        return np.asarray(inside)

    def __call__(self, line: _Floats, origin: _Floats | float = 0.0) -> tuple[_Floats, _Floats]:
        """Positions (n, 3) and rotations (n, 3, 3) of rows (n,), whole numbers at the middle of a line's exposure.

        Positions are counted from `origin`, (3,). Beyond what is known the camera flies on as it flew at the end: what
        lies just outside the image has positions.
        """
        if self.per_line:
            S, q = self._between(line, origin)
        else:
            S, q = self._flown(line)
            S = S - origin
        return S, rotations(q)

    @cached_property
    def poses(self) -> tuple[int, _Floats]:
        """The first row, and positions and quaternions (n, 7) from it on: of the image and a room around it."""
        first, last = self.whole_rows
        S, q = self._flown(np.arange(first, last + 1.0))
        inside = np.concatenate([S, continuous(q)], axis=1)
        room = round(_ROOM[0] * self.lines + _ROOM[1]) + 2
        # Beyond what is known the camera flies on as it flew on average at the end.
        some = min(_AVERAGED, last - first)
        before, after = np.arange(-room - first, 0.0), np.arange(1.0, self.lines + room - last)
        ahead = inside[0] + before[:, None] * (inside[some] - inside[0]) / some
        beyond = inside[-1] + after[:, None] * (inside[-1] - inside[-1 - some]) / some
        return -room, np.concatenate([ahead, inside, beyond])

    @property
    def whole_rows(self) -> tuple[int, int]:
        """First and last whole row whose pose is known, of the image and the room around it."""
        room = round(_ROOM[0] * self.lines + _ROOM[1]) + 2
        first, last = (self.knots[0] + (known - self.moments[0]) / self.rates[0] for known in self.known)
        first, last = max(float(np.ceil(first - _SLACK)), -room), min(float(np.floor(last + _SLACK)), self.lines + room)
        if last <= first:
            raise InputError("positions and attitudes are known at fewer than two lines of the image")
        return int(first), int(last)

    def _between(self, line: _Floats, origin: _Floats | float) -> tuple[_Floats, _Floats]:
        """Positions (n, 3) from an origin, and quaternions (n, 4), between the lines."""
        first, poses = self.poses
        at = np.clip(np.asarray(line, float) - first, 1.0, len(poses) - 2.0)
        row = np.minimum(np.floor(at), len(poses) - 3.0)
        weights = cubic_convolution(at - row)
        row = np.nan_to_num(row, nan=1.0).astype(np.int64)
        values = poses[row]
        # Against the row itself, and that from the origin: positions are large, and sums of them are rounded.
        values[:, :3] -= origin
        for k in (-1, 1, 2):
            values = values + weights[:, k + 1, None] * (poses[row + k] - poses[row])
        return values[:, :3], values[:, 3:]

    def _flown(self, line: _Floats) -> tuple[_Floats, _Floats]:
        """Positions (n, 3) and quaternions (n, 4) as the courses have them."""
        t = self.time(line)
        inside = np.clip(t, *self.known)
        beyond = (t - inside)[:, None]
        S, q = self.positions(inside), self.attitudes(inside)
        away = beyond[:, 0] != 0
        if away.any():
            step = self.rates.max()
            back = inside[away] - np.sign(beyond[away, 0]) * step
            turns = beyond[away] / (inside[away] - back)[:, None]
            S[away] += turns * (S[away] - self.positions(back))
            before = self.attitudes(back)
            before *= np.where(np.einsum("nk,nk->n", before, q[away]) < 0, -1.0, 1.0)[:, None]
            q[away] += turns * (q[away] - before)
        return S, q

    def time(self, line: _Floats) -> _Floats:
        """Times (n,) of the middle of the exposure of rows (n,), seconds."""
        stretch = np.clip(np.searchsorted(self.knots, line, side="right") - 1, 0, None)
        return np.asarray(self.moments[stretch] + self.rates[stretch] * (line - self.knots[stretch]))


@dataclass(frozen=True, eq=False)
class LineBend:
    """Odd powers of the distance r from the axis: r (a + b r²). Where the line passes the axis it has a kink."""

    place: _Floats
    """Place of column 0 in the focal plane, (2,)."""
    step: _Floats
    """From column to column, (2,)."""
    a: _Floats
    """Tangents (2,) in the unit of distance."""
    b: _Floats
    """Tangents (2,) in its third power."""

    def __call__(self, column: _Floats) -> _Floats:
        """Tangents (n, 2) of columns (n,)."""
        r = np.linalg.norm(self.place + column[:, None] * self.step, axis=1)[:, None]
        return np.asarray(r * (self.a + self.b * r**2))

    def slope(self, column: _Floats) -> _Floats:
        """Their change (n, 2) from column to column; none in the kink itself."""
        at = self.place + column[:, None] * self.step
        r = np.linalg.norm(at, axis=1)
        with np.errstate(invalid="ignore"):
            change = np.where(r > 0, at @ self.step / r, 0.0)
        return np.asarray(change[:, None] * (self.a + 3 * self.b * r[:, None] ** 2))


_DEGREE = 16
#: The curve leaves what it stands for by less than this, in columns.
_TOLERANCE = 1e-9
#: Coefficients below this are left out, in columns.
_NOTHING = 1e-11
#: Angle between detectors below which there is no such camera.
_FINEST = 1e-12
#: Columns beyond either end of the line over which the curve goes on, by its width; further out it is straight.
_ROOM_LINE_LOOK = 0.05


@dataclass(frozen=True, eq=False)
class LineLook:
    """Directions of a line's detectors in camera axes, as tangents (X/Z, Y/Z): any lens, any place in the focal plane.

    Lens distortion, the place of the line and the pitch of its detectors are one smooth curve, kept as Chebyshev
    polynomials of the column. Camera axes are those of the file; the camera looks along +Z.
    """

    columns: int
    coefficients: _Floats
    """Shape (degree + 1, 2); over the columns of `span` as −1 to 1."""
    part: tuple[int, int] | None = None
    """First and end column of those that are its own, of a line of several chips; None: all."""
    bend: LineBend | None = None
    """Distortion in addition to the polynomials."""

    @classmethod
    def of(
        cls,
        tangents: Callable[[_Floats], _Floats],
        columns: int,
        part: tuple[int, int] | None = None,
        bend: LineBend | None = None,
    ) -> LineLook:
        """The curve of a function from columns (n,) to tangents (n, 2), with a bend on top of it."""
        low, high = _span(part or (0, columns))
        nodes = chebyshev.chebpts1(4 * _DEGREE)
        values = tangents((low + high) / 2 + (high - low) / 2 * nodes)
        if not np.isfinite(values).all():
            raise InputError("detectors of the line have no direction; are the numbers of its lens right?")
        coefficients = chebyshev.chebfit(nodes, values, _DEGREE)
        look = cls(columns, np.asarray(coefficients, float), part, bend)
        if not look.pitch > _FINEST:
            raise InputError(
                f"the line's detectors are {look.pitch:.3g} rad apart, which no telescope tells; is its focal length "
                "in millimetres?"
            )
        # Most lenses are of low degree; what is next to nothing is not computed a million times.
        tiny = np.abs(coefficients).max(axis=1) < _NOTHING * look.pitch
        look = cls(columns, look.coefficients[: max(2, len(tiny) - int(np.argmin(tiny[::-1])))], part, bend)
        miss = float(np.abs(chebyshev.chebval(nodes, look.coefficients).T - values).max())
        if miss > _TOLERANCE * look.pitch:
            raise InputError(f"the line's lens is not smooth: polynomials miss it by {miss / look.pitch:.2g} columns")
        if not (look.along(look.ends[1]) > look.along(look.ends[0])):
            raise InputError("the directions of the line's detectors turn back")
        return look

    def tangents(self, column: _Floats) -> _Floats:
        """Tangents (n, 2) of columns (n,); straight on where the line has ended."""
        inside = np.clip(column, *self.span)
        values, away = chebyshev.chebval(self._unit(inside), self.coefficients).T, column - inside
        if self.bend is not None:
            values = values + self.bend(inside)
        return np.asarray(values + self.slope(inside) * away[:, None] if np.any(away) else values)

    def slope(self, column: _Floats) -> _Floats:
        """Change of the tangents (n, 2) from column to column."""
        inside = np.clip(column, *self.span)
        change = chebyshev.chebval(self._unit(inside), self._slopes).T
        return np.asarray(change if self.bend is None else change + self.bend.slope(inside))

    @property
    def span(self) -> tuple[float, float]:
        """First and last column over which the curve goes on."""
        return _span(self.part or (0, self.columns))

    @property
    def ends(self) -> tuple[float, float]:
        """Outer edges of its first and last column."""
        first, end = self.part or (0, self.columns)
        return first - 0.5, end - 0.5

    @property
    def _outer(self) -> _Floats:
        """Its first and last column."""
        return np.add(self.ends, (0.5, -0.5))

    @cached_property
    def axes(self) -> _Floats:
        """Unit vectors along the line, from the first to the last column, and across it, (2, 2)."""
        first, last = self.tangents(self._outer)
        e = (last - first) / np.linalg.norm(last - first)
        return np.array([e, [-e[1], e[0]]])

    @cached_property
    def pitch(self) -> float:
        """Tangent of a column in the middle of the line."""
        return float(np.linalg.norm(self.slope(np.array([sum(self.ends) / 2]))))

    @cached_property
    def is_wide(self) -> bool:
        """Return whether it looks further to the sides than ahead."""
        middle = self.tangents(self._outer).mean(axis=0)
        half = abs(self.along(self.ends[1]) - self.along(self.ends[0])) / 2
        return bool(half > abs(middle @ self.axes[1]))

    def along(self, column: float) -> float:
        """Tangent along the line's chord."""
        return float(self.tangents(np.array([column]))[0] @ self.axes[0])

    def column(self, along: _Floats) -> _Floats:
        """The columns (n,) with these tangents along the chord (n,), by Newton's method."""
        first, last = self._along_ends
        at = self.ends[0] + (along - first) * (self.ends[1] - self.ends[0]) / (last - first)
        values, slopes = self._chord
        e = self.axes[0]
        for _ in range(12):
            inside = np.clip(at, *self.span)
            unit = self._unit(inside)
            value, slope = chebyshev.chebval(unit, values), chebyshev.chebval(unit, slopes)
            if self.bend is not None:
                value, slope = value + self.bend(inside) @ e, slope + self.bend.slope(inside) @ e
            step = (value + slope * (at - inside) - along) / slope
            at = at - step
            if not (np.abs(step) > 1e-11 * self.columns).any():
                break
        return np.asarray(at)

    @cached_property
    def _chord(self) -> tuple[_Floats, _Floats]:
        """Polynomials of the tangents along the chord, and of their change from column to column; without the bend."""
        return self.coefficients @ self.axes[0], self._slopes @ self.axes[0]

    @cached_property
    def _along_ends(self) -> tuple[float, float]:
        """Tangents of the ends along the chord."""
        return self.along(self.ends[0]), self.along(self.ends[1])

    @cached_property
    def _slopes(self) -> _Floats:
        low, high = self.span
        return np.asarray(chebyshev.chebder(self.coefficients) * 2.0 / (high - low))

    def _unit(self, column: _Floats) -> _Floats:
        low, high = self.span
        return (2.0 * column - (low + high)) / (high - low)


def _span(part: tuple[int, int]) -> tuple[float, float]:
    first, end = part
    room = 1.0 + _ROOM_LINE_LOOK * (end - first)
    return first - 0.5 - room, end - 0.5 + room


@dataclass(frozen=True, eq=False)
class StraightFlight:
    """An image of one detector line that is carried on evenly; a `Projection`."""

    look: LineLook
    ground: BodyGround
    lines: int
    """Rows of the image."""
    middle: float
    """Row at which it is at `place`."""
    place: _Floats
    """Projection centre there, in the axes of the body, (3,), metres."""
    speed: _Floats
    """Movement from row to row, (3,), metres."""
    R: _Floats
    """From camera axes to those of the body, (3, 3)."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.look.columns, self.lines

    field: ClassVar[None] = None
    """All is in the first factor."""
    breaks: ClassVar[None] = None
    """It is smooth."""

    def seen(self, P: _Floats) -> _Floats:
        """Positions (n, 2) of points (n, 3) in the axes of the body; NaN behind the camera. Rows may be any."""
        d, out = np.ascontiguousarray((P - self.place) @ self.R), np.empty((len(P), 2))
        coefficients = np.ascontiguousarray(self.look.coefficients)
        project_linear_pushbroom(d, self.speed @ self.R, (coefficients, *self.look.span, sum(self.look.ends) / 2), out)
        out[:, 1] += self.middle
        return out

    def project_homogeneous(self, XYZ: ArrayLike) -> _Floats:
        """See `LineCamera.project_homogeneous`."""
        XYZ = np.asarray(XYZ, float)
        P = self.ground(XYZ).reshape(-1, 3)
        xy = self.seen(P)
        w = np.ones(len(P))
        if self.look.is_wide:
            w = (P - self.place - (xy[:, 1:] - self.middle) * self.speed) @ self.R[:, 2]
        w[np.isnan(xy[:, 0])] = np.nan
        return np.column_stack([xy * w[:, None], w]).reshape(XYZ.shape)


#: A moment is found when it changes by less than this, lines; or by less than the second and not less than before.
FOUND, _ROUNDED = 1e-10, 1e-6
#: Steps over which the slope is taken anew, lines.
_SMOOTH = 1e-3
_ITERATIONS = 40
#: Misses that are computed together.
_TOGETHER = 400_000


@dataclass(frozen=True, eq=False)
class LineSight:
    """A trajectory and the directions of a line."""

    track: LineTrack
    look: LineLook
    origin: _Floats | float = 0.0
    """Place in the axes of the body, (3,), from which all places are counted here."""

    def rays(self, xy: _Floats) -> tuple[_Floats, _Floats]:
        """Projection centres and unit directions of image points (n, 2), each (n, 3)."""
        S, R = self.track(xy[:, 1], self.origin)
        d = np.concatenate([self.look.tangents(xy[:, 0]), np.ones((len(xy), 1))], axis=1)
        return S, np.einsum("nij,nj->ni", R, d / np.linalg.norm(d, axis=1, keepdims=True))

    def tangents(self, P: _Floats, y: _Floats) -> _Floats:
        """Tangents (n, 2) of points, from where the camera was at rows (n,); NaN behind it."""
        S, R = self.track(y, self.origin)
        d = np.einsum("nij,ni->nj", R, P - S)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(d[:, 2:] > 0, d[:, :2] / d[:, 2:], np.nan))

    def across(self, P: _Floats, y: _Floats) -> tuple[_Floats, _Floats]:
        """Return how far points lie beside the line at rows (n,), as tangents, and their columns."""
        tangents = self.tangents(P, y)
        e, n = self.look.axes
        column = self.look.column(tangents @ e)
        return (tangents - self.look.tangents(column)) @ n, column

    def found(self, P: _Floats, start: _Floats, low: float, high: float, close: float = FOUND) -> _Floats:
        """Positions (n, 2) of points (n, 3) by the secant method, from rows (n,) on; NaN outside `low` to `high`."""
        out = np.full((len(P), 2), np.nan)
        todo = np.flatnonzero(np.isfinite(P).all(axis=1) & np.isfinite(start))
        with np.errstate(all="ignore"):
            at = np.clip(start[todo], low, high)
            miss, _ = self.across(P[todo], at)
            slope = self.across(P[todo], at + 1.0)[0] - miss
            step = -miss / slope
            for _ in range(_ITERATIONS if len(todo) else 0):
                at = at + step
                before, (miss, column) = miss, self.across(P[todo], at)
                # Over small steps the slope is rounding; it does not change over them.
                slope = np.where(np.abs(step) > _SMOOTH, (miss - before) / step, slope)
                step, last = -miss / slope, step
                settled = (np.abs(step) < _ROUNDED) & (np.abs(step) > np.abs(last) / 2)
                found = (np.abs(step) < close) | settled
                out[todo[found]] = np.column_stack([column, at + step])[found]
                # Only what is still on its way goes on; twice the room is left for a step too far.
                going = ~found & (np.abs(at + step - (low + high) / 2) < high - low)
                todo, at, step = todo[going], at[going], step[going]
                miss, slope = miss[going], slope[going]
                if not len(todo):
                    break
        out[(out[:, 1] < low) | (out[:, 1] > high)] = np.nan
        return out

    def crossings(self, P: _Floats, near: _Floats, reach: int) -> tuple[NDArray[np.int64], _Floats, NDArray[np.bool_]]:
        """Return where points (n, 3) pass through the line, as far as `reach` rows from rows `near` (n,).

        How far a point lies beside the line between the rows is interpolated as the poses are, so that what passes
        there and back within a row is found too.
        """
        parts = [(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, bool))]
        many = max(1, _TOGETHER // (2 * reach + 4))
        for first in range(0, len(P), many):
            some = slice(first, first + many)
            rows = np.floor(near[some])[:, None] + np.arange(-reach - 1.0, reach + 3.0)
            each = np.repeat(P[some], rows.shape[1], axis=0)
            miss = self.across(each, np.asarray(rows.ravel()))[0].reshape(rows.shape)
            ends, values = _monotone(*(miss[:, k : k + rows.shape[1] - 3] for k in range(4)))
            below = values <= 0
            passes = (below[..., 1:] != below[..., :-1]) & np.isfinite(values).all(axis=-1, keepdims=True)
            k, j, piece = np.nonzero(passes)
            row = rows[k, j + 1]
            between = np.stack([row + ends[k, j, piece], row + ends[k, j, piece + 1]], axis=1)
            parts.append((k + first, between, below[k, j, 0] != below[k, j, -1]))
        point, between, stays = (np.concatenate(column) for column in zip(*parts))
        return point, between, stays

    def between(self, P: _Floats, rows: _Floats) -> _Floats:
        """Positions (n, 2) of points (n, 3) that pass through the line between two rows (n, 2): regula falsi.

        NaN where they do not.
        """
        low, high = rows[:, 0].copy(), rows[:, 1].copy()
        below, above = self.across(P, low)[0], self.across(P, high)[0]
        todo = np.flatnonzero((below <= 0) != (above <= 0))
        out = np.full((len(P), 2), np.nan)
        out[todo, 1], side = low[todo], np.zeros(len(P))
        for _ in range(_ITERATIONS if len(todo) else 0):
            a, b, fa, fb = low[todo], high[todo], below[todo], above[todo]
            now = (a * fb - b * fa) / (fb - fa)
            miss, out[todo, 0] = self.across(P[todo], now)
            step = np.abs(now - out[todo, 1])
            out[todo, 1] = now
            left = (miss <= 0) == (fa <= 0)
            # Illinois: an end that stays counts half.
            low[todo], below[todo] = np.where(left, now, a), np.where(left, miss, np.where(side[todo] < 0, fa / 2, fa))
            high[todo], above[todo] = np.where(left, b, now), np.where(left, np.where(side[todo] > 0, fb / 2, fb), miss)
            side[todo] = np.where(left, 1.0, -1.0)
            todo = todo[(step > FOUND) & (high[todo] - low[todo] > FOUND)]
            if not len(todo):
                break
        return out


def _monotone(a: _Floats, b: _Floats, c: _Floats, d: _Floats) -> tuple[_Floats, _Floats]:
    """Places (..., 4) from 0 to 1 between which the cubic convolution of values at −1, 0, 1, 2 keeps its direction.

    And its values there, (..., 4).
    """
    c1, c2, c3 = (c - a) / 2, a - 2.5 * b + 2 * c - d / 2, (d - a) / 2 + 1.5 * (b - c)
    with np.errstate(all="ignore"):
        root = np.sqrt(np.maximum(c2 * c2 - 3 * c1 * c3, 0.0))
        # The two roots of the derivative; q does not cancel.
        q = -(c2 + np.copysign(root, c2))
        turns = np.stack([q / (3 * c3), c1 / q], axis=-1)
    turns = np.sort(np.clip(np.nan_to_num(turns, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0), axis=-1)
    t = np.concatenate([np.zeros((*b.shape, 1)), turns, np.ones((*b.shape, 1))], axis=-1)
    values = ((c3[..., None] * t + c2[..., None]) * t + c1[..., None]) * t + b[..., None]
    values[..., 0], values[..., -1] = b, c
    return t, values


def to_sphere(S: _Floats, d: _Floats, radius: ArrayLike) -> _Floats:
    """Distances (n,) along rays to the near side of a sphere; NaN where they pass it. From inside, to the far side."""
    along = np.einsum("ni,ni->n", S, d)
    with np.errstate(invalid="ignore"):
        half = np.sqrt(along**2 - np.einsum("ni,ni->n", S, S) + np.square(radius))
    near = -along - half
    return np.asarray(np.where(near > 0, near, -along + half))


_Rows = NDArray[np.int64]
#: Lines between the knots of the smooth part, at least; twice as many, and so on, until it flies evenly.
_KNOTS = 128
#: Evenly: a point that stays in the line's way is met this much earlier or later than half way along, at most.
_EVEN = (0.6, 1.7)
#: What moves a pixel by less than this from where the smooth part has it is not worth a table.
_LEAST = 0.05
#: Lines whose largest shift is kept.
_BLOCK = 64
#: The lowest ground, metres: from there shifts are largest.
_LOWEST = -500.0
#: Shifts are looked for at columns as near as this to those that are asked for, in so many steps at most.
_NEAR, _TURNS = 0.05, 4
#: Lines at which it is told how often ground is seen.
_TOLD = 300
#: Rows by which the smooth part may bend between the points that enclose a piece of ground, and to which it is found.
_AROUND, _ROUGHLY = 16.0, 0.5
#: Parts begin and end at multiples of so many lines, so that pieces of ground beside each other have the same.
_SHARED = 256


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments at which points are seen."""

    point: _Rows
    """Number of the point, (k,), not decreasing."""
    xy: _Floats
    """Position in the image, (k, 2)."""


class _LineImage(Camera, Hashable, Protocol):
    """Image of a line, as far as it is needed here."""

    @property
    def track(self) -> LineTrack: ...
    @property
    def look(self) -> LineLook: ...
    @property
    def ground(self) -> BodyGround: ...
    @property
    def near(self) -> NearGround: ...
    @property
    def sight(self) -> LineSight: ...
    def along(self, track: LineTrack) -> Self: ...
    def seen_from(self, P: _Floats, close: float = FOUND) -> _Floats: ...
    def moments(self, XYZ: ArrayLike) -> Moments: ...


_L = TypeVar("_L", bound=_LineImage)


@dataclass(frozen=True, eq=False)
class LineTremor(Generic[_L]):
    """A trajectory as a smooth one, and shifts against it that change from line to line (see `cameras.base.Tremor`)."""

    smooth: _L
    """Camera of the smooth part of the trajectory."""
    rough: _L
    """The whole."""
    largest: _Floats
    """Largest shifts along x and y of blocks of lines, the first before, the last behind the image, (k, 2), pixels."""

    def part(self, XYZ: _Floats) -> StraightPart | None:
        """See `Tremor`."""
        seen = self.smooth.seen_from(self.smooth.near(XYZ.reshape(-1, 3)), _ROUGHLY)[:, 1]
        seen = seen[np.isfinite(seen)]
        if not len(seen):
            return None
        rows = self._rows(float(seen.min()) - _AROUND, float(seen.max()) + _AROUND)
        # Lines whose orientation is not known are not looked at; between the lines their neighbours count, too.
        begin, end = self.rough.track.oriented
        first, last = max(rows[0], int(np.floor(begin))), min(rows[1], int(np.ceil(end)))
        if last <= first:
            return None
        first, last = max(first // _SHARED * _SHARED, int(np.floor(begin))), -(-last // _SHARED) * _SHARED
        return _straight_part(self.rough, first, min(last, int(np.ceil(end))))

    def _rows(self, low: float, high: float) -> tuple[int, int]:
        """First and last row at which anything can be seen that the smooth part sees from row `low` to `high` on."""
        begin = np.arange(len(self.largest)) * _BLOCK - _BLOCK
        far = self.largest[:, 1]
        some = (begin + _BLOCK + far >= low) & (begin - far <= high)
        if not some.any():
            return int(np.floor(low)), int(np.ceil(high))
        first = np.maximum(begin, low - far)[some].min()
        return int(np.floor(first)), int(np.ceil(np.minimum(begin + _BLOCK, high + far)[some].max()))

    def passages(self, P: _Floats) -> tuple[_Rows, _Floats, NDArray[np.bool_]]:
        """Return where points (n, 3), from the origin of `rough.near`, pass the line; see `LineSight.crossings`.

        From the first point to the last, and of each from the first row to the last.
        """
        near = self.smooth.seen_from(P + (self.rough.near.origin - self.smooth.near.origin))[:, 1]
        block = np.clip(np.nan_to_num(near) // _BLOCK + 1, 0, len(self.largest) - 1).astype(np.int64)
        reach = np.where(np.isfinite(near), self._local[block], -1)
        parts = [(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, bool))]
        for each in np.unique(reach[reach >= 0]).tolist():
            mine = np.flatnonzero(reach == each)
            point, rows, stays = self.rough.sight.crossings(P[mine], near[mine], each)
            parts.append((mine[point], rows, stays))
        point, rows, stays = (np.concatenate(column) for column in zip(*parts))
        order = np.lexsort((rows[:, 0], point))
        return point[order], rows[order], stays[order]

    def first(self, P: _Floats) -> tuple[_Rows, _Floats]:
        """The passage of each point that counts: number of the point (k,), and the rows between which it is (k, 2).

        That is the first by which it is on the other side at the next line, from the line before the image on; where
        there is none, the last before.
        """
        point, rows, stays = self.passages(P)
        point, rows = point[stays], rows[stays]
        line = np.floor(rows[:, 0])
        order = np.lexsort((np.where(line >= -1, line, 1e9 - line), point))
        point, rows = point[order], rows[order]
        one = np.r_[True, point[1:] != point[:-1]] if len(point) else np.empty(0, bool)
        return point[one], rows[one]

    def told(self, height: float) -> str:
        """See `Tremor`; of pixels spread over the image."""
        width, lines = self.rough.size
        rows = np.unique(np.linspace(0, lines - 1, _TOLD).round())
        columns = np.linspace(0, width - 1, 5)
        ground = self.rough.rays(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2), height)[0]
        ground = ground[np.isfinite(ground[:, 0])]
        x, y = self.largest[1:-1].max(axis=0)
        shaken = (
            f"a turbulent flight: lines lie up to {x:.1f} pixels beside, {y:.1f} before or behind the smooth course"
        )
        count = np.bincount(self.rough.moments(ground).point, minlength=len(ground)) if len(ground) else np.zeros(1)
        if not (count > 1).any():
            return f"{shaken}; no ground is seen twice"
        return (
            f"{shaken}; {100 * (count > 1).mean():.2g} % of the pixels show ground that is seen several times, up to "
            f"{count.max()} times: the first moment counts"
        )

    @cached_property
    def _local(self) -> _Rows:
        """Rows as far as which passages can lie from a block of lines, to powers of two, (k,)."""
        count = len(self.largest)
        away = np.maximum(np.abs(np.arange(count)[:, None] - np.arange(count)[None]) - 1, 0) * _BLOCK
        far = np.where(away <= self.largest[None, :, 1], self.largest[None, :, 1], 0.0).max(axis=1)
        return np.asarray(2 ** np.ceil(np.log2(np.maximum(far, 1.0) + 1.0)), np.int64)


@dataclass(frozen=True, eq=False)
class StraightPart:
    """Some lines against a flight that is straight and does not turn (see `cameras.base.TremorPart`).

    From there a point is met earlier or later by a time that grows with its distance, and at a column that does not
    depend on it: what is left of the trajectory is linear in the height.
    """

    smooth: StraightFlight
    rough: _LineImage
    rows: tuple[int, int]

    def shifts(self, columns: _Floats, rows: _Floats, heights: Sequence[float]) -> _Floats:
        """See `TremorPart`."""
        rough, ground = self.rough, self.rough.ground
        S, R = rough.track(rows)
        known = rough.track.is_oriented(rows) | (rows < 0.0) | (rows > rough.size[1] - 1.0)
        sea = np.linalg.norm(S, axis=1) - ground.height(S)
        wanted = np.broadcast_to(columns, (len(rows), len(columns)))
        S, real = np.repeat(S, len(columns), axis=0), wanted
        out = []
        for height in heights:
            radius = np.repeat(sea + self._lift(height), len(columns))
            for _ in range(_TURNS):
                tangents = rough.look.tangents(real.ravel()).reshape(*real.shape, 2)
                d = tangents @ np.swapaxes(R[:, :, :2], 1, 2) + R[:, None, :, 2]
                d = (d / np.linalg.norm(d, axis=2, keepdims=True)).reshape(-1, 3)
                seen = self.smooth.seen(S + to_sphere(S, d, radius)[:, None] * d).reshape(*real.shape, 2)
                miss = wanted - seen[..., 0]
                shift = np.stack([real - seen[..., 0], rows[:, None] - seen[..., 1]], axis=-1)
                real = real + miss
                if not (np.abs(miss) > _NEAR).any():
                    break
            out.append(np.where(known[:, None, None], shift, np.nan))
        return np.stack(out)

    def _lift(self, height: float) -> float:
        """Height above the ellipsoid of a height on the ground of the project, in the middle."""
        flight, ground = self.smooth, self.rough.ground
        S, d = flight.place[None], flight.R @ np.array([*flight.look.tangents(self._middle)[0], 1.0])
        d = d[None] / np.linalg.norm(d)
        below = S + to_sphere(S, d, np.linalg.norm(S, axis=1) - ground.height(S) + height)[:, None] * d
        lift = height + float((ground.height(below) - ground.to_map(below)[:, 2])[0])
        return lift if np.isfinite(lift) else height

    @property
    def _middle(self) -> _Floats:
        """Column in the middle of the line, (1,)."""
        return np.array([(self.rough.size[0] - 1) / 2])


@lru_cache(maxsize=64)
def _straight_part(rough: _LineImage, first: int, last: int) -> StraightPart:
    return StraightPart(_straightened(rough, first, last), rough, (first, last))


def smoothed(camera: _L) -> LineTremor[_L] | None:
    """A trajectory without what changes from line to line, and that; None: there is next to nothing of it."""
    knots = _KNOTS
    while True:
        smooth = camera.along(_smooth_track(camera.track, knots))
        largest, even = _largest(camera, smooth)
        if even or knots >= 2 * camera.track.lines:
            break
        knots *= 2
    return LineTremor(smooth, camera, largest) if largest[1:-1].max() > _LEAST else None


def _straightened(camera: _LineImage, first: int, last: int) -> StraightFlight:
    """Positions at an even speed and one attitude, as the lines from `first` to `last` have on average."""
    start, poses = camera.track.poses
    some = poses[first - start : last + 1 - start]
    place, q = some[:, :3].mean(axis=0), some[:, 3:].mean(axis=0)
    away = np.arange(first, last + 1.0) - (first + last) / 2
    return StraightFlight(
        look=camera.look,
        ground=camera.ground,
        lines=camera.track.lines,
        middle=(first + last) / 2,
        place=place,
        speed=away @ (some[:, :3] - place) / (away @ away),
        R=rotations(q[None])[0],
    )


def _smooth_track(track: LineTrack, knots: int) -> LineTrack:
    """Splines through the poses of all lines; its times are rows."""
    first, poses = track.poses
    begin, end = track.whole_rows
    from scipy.interpolate import make_lsq_spline  # noqa: PLC0415 - frame images start without it

    rows, poses = np.arange(begin, end + 1.0), poses[begin - first : end + 1 - first]
    origin = poses.mean(axis=0)
    inner = np.linspace(rows[0], rows[-1], max(1, len(rows) // knots) + 1)
    spline = make_lsq_spline(rows, poses - origin, np.r_[[inner[0]] * 3, inner, [inner[-1]] * 3], k=3)
    within = rows[0], rows[-1]

    def at(row: _Floats) -> _Floats:
        # Beyond its ends a spline swings.
        inside = np.clip(row, *within)
        return np.asarray(spline(inside) + origin + (row - inside)[:, None] * spline(inside, 1))

    return _by_rows(track, lambda row: at(row)[:, :3], lambda row: at(row)[:, 3:])


def _by_rows(track: LineTrack, positions: Course, attitudes: Course) -> LineTrack:
    """A trajectory whose times are rows."""
    return replace(
        track,
        knots=np.zeros(1),
        moments=np.zeros(1),
        rates=np.ones(1),
        positions=positions,
        attitudes=attitudes,
        known=(-1e9, 1e9),
        per_line=False,
    )


def _largest(camera: _LineImage, calm: _LineImage) -> tuple[_Floats, bool]:
    """Largest shifts of blocks of lines, (k, 2), and whether the smooth part flies evenly.

    The first block lies before the image, the last behind it.
    """
    rough, smooth = (LineSight(each.track, each.look) for each in (camera, calm))
    lines, columns = rough.track.lines, np.array([0.0, (rough.look.columns - 1) / 2, rough.look.columns - 1.0])
    rows = np.arange(-_BLOCK, (-(-lines // _BLOCK) + 1) * _BLOCK, dtype=float)
    y, x = np.repeat(rows, 3), np.tile(columns, len(rows))
    S, d = rough.rays(np.column_stack([x, y]))
    P = S + to_sphere(S, d, np.linalg.norm(S, axis=1) - camera.ground.height(S) + _LOWEST)[:, None] * d
    miss, column = smooth.across(P, y)
    slope = smooth.across(P, y + 1.0)[0] - miss
    usual = np.median(slope)
    shift = np.abs(np.column_stack([x - column, miss / np.where(slope * usual > 0.1 * usual**2, slope, usual)]))
    part = slope / usual
    even = bool((part > _EVEN[0]).all() and (part < _EVEN[1]).all())
    blocks = np.nan_to_num(shift).reshape(-1, 3 * _BLOCK, 2).max(axis=1)
    # Shifts are those of a straight flight from line to line; they hold to a tenth.
    return 1.1 * blocks + 0.01, even


#: Heights of any ground, metres: of the earth, and of other bodies, where they are at most this part of the radius.
_EARTH, _ELSEWHERE, _PART = (-500.0, 9_000.0), (-10_000.0, 25_000.0), 0.1
#: Heights above the ellipsoid are at most this much more than those above a geoid, metres.
_HIGHEST_GEOID = 110.0
#: Heights are met when they were missed by less than this before the last step, metres.
_CLOSE = 1e-8


def heights_of(ground: BodyGround) -> tuple[float, float]:
    """Between which heights all ground of the body lies, metres."""
    low, high = _EARTH if ground.on_earth else _ELSEWHERE
    room = _PART * ground.radii[1]
    return max(low, -room), min(high, room)


def radius_below(ground: BodyGround, S: _Floats) -> _Floats:
    """Radius of the body below points (n, 3), metres."""
    return np.asarray(np.linalg.norm(S, axis=1) - ground.height(S))


def meet(ground: BodyGround, S: _Floats, d: _Floats, heights: _Floats) -> tuple[_Floats, _Floats]:
    """Rays from points (n, 3) with unit directions (n, 3), in the axes of the body, at heights (n,)."""
    with np.errstate(all="ignore"):
        # The ellipsoid at these heights, nearly, is the unit sphere in units of its semi-axes.
        axes = np.stack([ground.ellipsoid.a + heights] * 2 + [ground.ellipsoid.b + heights], axis=1)
        way = np.linalg.norm(d / axes, axis=1)
        r = to_sphere(S / axes, d / axes / way[:, None], 1.0) / way
        for _ in range(12):
            at = S + r[:, None] * d
            point = ground.to_map(at)
            miss = point[:, 2] - heights
            r = r - miss / np.einsum("ni,ni->n", ground.ellipsoid.up(at), d)
            # The step that was taken gains three digits and more.
            if not (np.abs(miss) > _CLOSE).any():
                break
        at = S + r[:, None] * d
        point = ground.to_map(at)
        # Places far away from the body are rounded.
        point[~((np.abs(point[:, 2] - heights) < 1e-6 + 1e-14 * r) & (r > 0))] = np.nan
        point[:, 2] = np.where(np.isnan(point[:, 0]), np.nan, heights)
        half = ground.reach / 2 * d
        tangent = ground.to_map(at + half) - ground.to_map(at - half)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return point, tangent


def vantage_over(ground: BodyGround, centers: _Floats, seen: Callable[[float], _Floats]) -> Vantage:
    """Above the middle of what a camera sees: the highest ground there is, but not above the camera."""
    low, high = heights_of(ground)
    flying = ground.to_map(centers)[:, 2]
    if np.isnan(flying).all():
        # A satellite may stand beside the grid of the heights of what it shows.
        flying = ground.height(centers) - _HIGHEST_GEOID
    high = min(high, float(np.nanmin(flying)) - 1.0)
    feet = np.concatenate([seen(level)[:, :2] for level in (min(low, high - 1.0), high)])
    if np.isnan(feet).all():
        raise InputError(
            "the image does not show the ground of the project where its heights are known; is its CRS that of the "
            "right body, and does the grid of its height system reach as far?"
        )
    middle = (np.nanmin(feet, axis=0) + np.nanmax(feet, axis=0)) / 2
    reach = 1.1 * float(np.nanmax(np.linalg.norm(feet - middle, axis=1)))
    return Vantage(np.array([*middle, high]), low, reach)
