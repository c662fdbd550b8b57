"""Where a line camera was, and how it was turned, when it took each of its lines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.motion import Course, continuous, cubic_convolution, rotations

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
        """Whether position and attitude are known at rows (n,)."""
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
