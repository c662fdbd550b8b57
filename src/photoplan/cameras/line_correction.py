"""Corrections of a line camera's trajectory: boresight, lever arm and clock, and splines of position and attitude."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.pushbroom_rays import LineTrack
from photoplan.errors import InputError
from photoplan.geometry.pose import Course, rotations, times

_Floats = NDArray[np.float64]
#: From the axes of frame images (x along the flight, y to the left, z up) to those of a line camera.
TURNED = np.diag([1.0, -1.0, -1.0])


def spline_weights(t: _Floats, first: float, step: float, knots: int) -> tuple[NDArray[np.int64], _Floats]:
    """The four coefficients of a uniform cubic spline that count at times (n,), and their weights; each (n, 4).

    Coefficients stand at `first`, `first + step` …; the spline is whole between the second and the last but one, and
    goes on as its ends are beyond.
    """
    at = np.clip((np.asarray(t, float) - first) / step, 1.0, knots - 2.0 - 1e-9)
    row = np.floor(at).astype(np.int64)
    u = at - row
    w = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=-1) / 6.0
    return row[..., None] + np.arange(-1, 3), np.asarray(w)


@dataclass(frozen=True, eq=False)
class TrackSpline:
    """Corrections that change with time: coefficients of uniform cubic splines."""

    first: float
    """Time of the first coefficient, seconds, as the track counts them."""
    step: float
    """From coefficient to coefficient, seconds."""
    coefficients: _Floats
    """East, north, up (metres), then small rotations about the camera's x, y, z (radians), (k, 6)."""

    def __post_init__(self) -> None:
        c = np.array(self.coefficients, float)
        if c.ndim != 2 or len(c) < 4 or c.shape[1] != 6 or not np.isfinite(c).all():
            raise InputError(f"corrections over time of shape {c.shape}; needed are 4 rows or more of 6 finite numbers")
        if not (np.isfinite([self.first, self.step]).all() and self.step > 0):
            raise InputError(f"corrections over time from {self.first:g} s on, every {self.step:g} s")

    @classmethod
    def over(cls, known: tuple[float, float], step: float) -> TrackSpline:
        """Return a correction of zero over a time."""
        count = max(1, int(np.ceil((known[1] - known[0]) / step - 1e-9)))
        return cls(known[0] - step, step, np.zeros((count + 3, 6)))

    @property
    def times(self) -> _Floats:
        """Return the times of the coefficients, (k,)."""
        return np.asarray(self.first + self.step * np.arange(len(self.coefficients)))

    def __call__(self, t: _Floats) -> _Floats:
        """Corrections (n, 6) at times (n,)."""
        columns, w = spline_weights(t, self.first, self.step, len(self.coefficients))
        return np.asarray(np.einsum("nj,njk->nk", w, self.coefficients[columns]))


@dataclass(frozen=True, eq=False)
class LineCorrection:
    """Correction of a trajectory; axes are those of frame images: x along the flight, y to the left, z up."""

    boresight: _Floats
    """Small rotations about the camera's x, y, z, (3,), radians."""
    lever_arm: _Floats
    """Added to the way from the recorded point to the projection centre, in the camera's axes, (3,), metres."""
    time_offset: float = 0.0
    """Added to the times of the trajectory, seconds."""
    spline: TrackSpline | None = None

    @classmethod
    def none(cls) -> LineCorrection:
        """Nothing is added."""
        return cls(np.zeros(3), np.zeros(3))

    def track(self, given: LineTrack) -> LineTrack:
        """The corrected trajectory."""
        late, known = self.time_offset, (given.known[0] + self.time_offset, given.known[1] + self.time_offset)
        boresight = _turns((TURNED @ self.boresight)[None])

        def positions(t: _Floats) -> _Floats:
            R = rotations(given.attitudes(t - late))
            return np.asarray(given.positions(t - late) + R @ (TURNED @ self.lever_arm))

        def attitudes(t: _Floats) -> _Floats:
            return times(given.attitudes(t - late), boresight)

        mounted = replace(given, positions=positions, attitudes=attitudes, known=known)
        return mounted if self.spline is None else displaced(mounted, self.spline, map_axes(given))


def displaced(given: LineTrack, course: Course, axes: _Floats) -> LineTrack:
    """A trajectory with something added: east, north, up (`axes`; metres), small rotations about x, y, z (radians)."""

    def positions(t: _Floats) -> _Floats:
        return np.asarray(given.positions(t) + course(t)[:, :3] @ axes.T)

    def attitudes(t: _Floats) -> _Floats:
        return times(given.attitudes(t), _turns(course(t)[:, 3:] @ TURNED))

    return replace(given, positions=positions, attitudes=attitudes)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Accuracy of a trajectory: covariances of its poses over time."""

    times: _Floats
    """Growing, (k,), seconds as the track counts them; before and after them it is as at the ends."""
    covariance: _Floats
    """East, north, up (metres), then small rotations about the camera's x, y, z (radians), (k, 6, 6)."""

    @cached_property
    def _roots(self) -> _Floats:
        """Symmetric roots of the covariances: they change over time as smoothly as these."""
        scale = np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 1e-300))
        values, axes = np.linalg.eigh(self.covariance / (scale[:, :, None] * scale[:, None, :]))
        root = (axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ np.swapaxes(axes, 1, 2)
        return np.asarray(scale[:, :, None] * root)

    def course(self, change: _Floats) -> Course:
        """Return what one of six independent errors, or a part of some, (6,), does to poses at times (n,): (n, 6)."""
        moved = self._roots @ change
        return lambda t: np.stack([np.interp(t, self.times, column) for column in moved.T], axis=1)


def map_axes(track: LineTrack) -> _Floats:
    """East, north and up in the axes of the body, (3, 3), at the middle of a trajectory; up is away from the centre."""
    up = track.positions(np.array([np.mean(track.known)]))[0]
    up = up / np.linalg.norm(up)
    east = np.cross([0.0, 0.0, 1.0], up)
    east = east / max(float(np.linalg.norm(east)), 1e-12)
    return np.stack([east, np.cross(up, east), up], axis=1)


def _turns(v: _Floats) -> _Floats:
    """Quaternions (n, 4) of rotation vectors (n, 3)."""
    half = np.linalg.norm(v, axis=1, keepdims=True) / 2
    return np.concatenate([np.cos(half), v / 2 * np.sinc(half / np.pi)], axis=1)
