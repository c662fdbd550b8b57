"""What a line camera sees in the axes of a body: rays of its pixels, and moments at which points are seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.line_look import LineLook
from photoplan.cameras.line_track import LineTrack

_Floats = NDArray[np.float64]
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
        """How far points lie beside the line at rows (n,), as tangents, and their columns."""
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
        """Where points (n, 3) pass through the line, as far as `reach` rows from rows `near` (n,).

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
