"""Support data of the Community Sensor Model (ISD, JSON): line cameras of planetary missions.

Names and meaning are those of the USGS's tools (ale, usgscsm; public domain). Times of lines count from the centre of
the image; half a line is added for the middle of the exposure. Positions and attitudes are those of an inertial frame,
the body turns in it by a table of its own. Quaternions are scalar first and lead from the inertial frame to the camera
and to the body. They are brought to even steps in the body's axes and interpolated by Lagrange's polynomials of eight
values.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.line_look import LineLook
from photoplan.cameras.line_track import LineTrack
from photoplan.errors import InputError
from photoplan.geometry.motion import (
    EvenTable,
    between,
    conjugate,
    continuous,
    cubic,
    odd_step,
    quaternions,
    rotations,
    times,
)
from photoplan.io.camera.line.model import StatedLine

_Floats = NDArray[np.float64]
FORM = "CSM support data (ISD)"
MODEL = "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
#: Positions get at least so many even steps: Lagrange's polynomials want neighbours.
_ROWS = 25
#: An image and its tables hold no more than this.
_MAX_SIZE, _MAX_ROWS = 10_000_000, 2_000_000


def read(isd: Any, path: Path) -> StatedLine:
    """The line camera of an ISD.

    Raises
    ------
    InputError
        It is of another kind of camera, or a number is missing or wrong.
    """
    if not isinstance(isd, dict) or "line_scan_rate" not in isd:
        name = isd.get("name_model", "") if isinstance(isd, dict) else ""
        raise InputError(
            f"{path}: support data without line_scan_rate{f' (of {name})' if name else ''}: no line camera"
        )
    source = _Isd(isd, path)
    try:
        return StatedLine(path, FORM, _track(source), _look(source), source.radii)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


class _Isd:
    """Entries of an ISD, checked when they are asked for."""

    def __init__(self, isd: dict[str, Any], path: Path) -> None:
        self._isd, self._path = isd, path
        lines, samples = self.numbers("image_lines", ()), self.numbers("image_samples", ())
        if not (1 <= lines <= _MAX_SIZE and 2 <= samples <= _MAX_SIZE):
            raise InputError(f"{path}: an image of {samples:g} × {lines:g} pixels")
        self.lines, self.samples = int(lines), int(samples)

    def has(self, name: str) -> bool:
        """Whether an entry (a.b) is there."""
        return self._find(name) is not None

    def numbers(self, name: str, shape: tuple[int, ...]) -> Any:
        """Finite numbers of an entry (a.b) in a shape; −1 stands for any length."""
        found = self._find(name)
        if found is None:
            raise InputError(f"{self._path}: {name} is missing")
        try:
            values = np.array(found, float)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{self._path}: {name} is not a table of numbers") from None
        fits = values.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, values.shape))
        if not fits or not np.isfinite(values).all() or values.shape[:1] > (_MAX_ROWS,):
            raise InputError(f"{self._path}: {name} holds numbers of shape {values.shape}, or such that are not finite")
        return values if shape else float(values)

    @property
    def radii(self) -> tuple[float, float]:
        """Equatorial and polar radius, metres."""
        unit = self._unit("radii")
        a, b = (unit * self.numbers(f"radii.{name}", ()) for name in ("semimajor", "semiminor"))
        if not (0 < b <= a):
            raise InputError(f"{self._path}: radii of {a:g} and {b:g} m")
        return a, b

    def moments(self, name: str) -> _Floats:
        """Times of a table, seconds of the ephemeris."""
        found = self.numbers(f"{name}.ephemeris_times", (-1,))
        if len(found) < 1 or not (np.diff(found) > 0).all():
            raise InputError(f"{self._path}: the times of {name} do not grow")
        return np.asarray(found)

    def positions(self) -> tuple[_Floats, _Floats | None]:
        """Positions and velocities of the camera in the inertial frame, metres."""
        unit = self._unit("instrument_position")
        positions = unit * self.numbers("instrument_position.positions", (len(self.moments("instrument_position")), 3))
        if len(positions) > 2 and (odd := odd_step(self.moments("instrument_position"), positions)) is not None:
            raise InputError(f"{self._path}: instrument_position: {odd}")
        stated = self.has("instrument_position.velocities")
        speeds = unit * self.numbers("instrument_position.velocities", positions.shape) if stated else None
        return positions, speeds

    def turns(self, name: str, t: _Floats) -> _Floats:
        """Quaternions (n, 4) from the inertial frame by a table and its constant rotation, at times (n,)."""
        moments = self.moments(name)
        table = self.numbers(f"{name}.quaternions", (len(moments), 4))
        length = np.linalg.norm(table, axis=1)
        if (np.abs(length - 1) > 1e-3).any():
            raise InputError(
                f"{self._path}: a quaternion of {name} has the length {length[np.argmax(abs(length - 1))]:g}, not 1"
            )
        turned = between(moments, table / length[:, None], t)
        if not self.has(f"{name}.constant_rotation"):
            return turned
        return times(_quaternion(self.numbers(f"{name}.constant_rotation", (9,)).reshape(3, 3)), turned)

    def _unit(self, name: str) -> float:
        unit = self._find(f"{name}.unit")
        if unit not in (None, "km", "m"):
            raise InputError(f"{self._path}: {name} is stated in {unit!r}; km or m is known")
        return 1.0 if unit == "m" else 1000.0

    def _find(self, name: str) -> Any:
        found: Any = self._isd
        for word in name.split("."):
            found = found.get(word) if isinstance(found, dict) else None
        return found


def _quaternion(R: _Floats) -> _Floats:
    """The unit quaternion (4,) of a rotation matrix (3, 3), scalar first."""
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InputError("a constant rotation is none")
    return quaternions(R[None])[0]


def _track(isd: _Isd) -> LineTrack:
    """Trajectory in the axes of the body, and the times of the lines."""
    at = isd.moments("instrument_position")
    if len(at) < 2:
        raise InputError("instrument_position holds a single moment; a trajectory has two at least")
    positions, speeds = isd.positions()
    t = np.linspace(at[0], at[-1], max(len(at), _ROWS))
    body = rotations(isd.turns("body_rotation", t))
    fixed = np.einsum("nij,nj->ni", body, cubic(at, positions, speeds, t))
    # Attitudes are known at the moments of both tables.
    when = np.union1d(isd.moments("instrument_pointing"), isd.moments("body_rotation"))
    if len(when) < 2:
        raise InputError("instrument_pointing holds a single moment; a trajectory has two at least")
    q = times(isd.turns("body_rotation", when), conjugate(isd.turns("instrument_pointing", when)))
    even = np.linspace(when[0], when[-1], len(when))
    courses = [
        EvenTable.over(t, fixed),
        EvenTable.over(even, continuous(between(when, q, even))),
    ]
    courses = [replace(each, start=each.start - isd.numbers("center_ephemeris_time", ())) for each in courses]
    known = max(each.start for each in courses), min(each.end for each in courses)
    # Of attitudes there are two tables; where one has ended nothing is known (of a single value: it holds always).
    for name in ("instrument_pointing", "body_rotation"):
        its = isd.moments(name) - isd.numbers("center_ephemeris_time", ())
        known = (max(known[0], its[0]), min(known[1], its[-1])) if len(its) > 1 else known
    return LineTrack(isd.lines, *_clock(isd), courses[0], courses[1], known)


def _clock(isd: _Isd) -> tuple[_Floats, _Floats, _Floats]:
    """Rows from which on lines last as they do, their times, and how long a line lasts.

    CSM counts from the upper edge of the first line, photoplan from its middle: half a line, and half a line of time.
    """
    rates = isd.numbers("line_scan_rate", (-1, 3))
    if not len(rates):
        raise InputError("line_scan_rate is empty")
    line, began, lasts = rates.T
    return line - 0.5, began + 0.5 * lasts, lasts


def _look(isd: _Isd) -> LineLook:
    """Directions of the detectors: places in the focal plane (mm) without distortion, over the focal length."""
    to_line, to_sample = (isd.numbers(f"focal2pixel_{name}", (3,)) for name in ("lines", "samples"))
    A = np.array([to_line[1:], to_sample[1:]])
    if abs(np.linalg.det(A)) < 1e-12:
        raise InputError("focal2pixel_lines and focal2pixel_samples are parallel")
    centre = [isd.numbers(f"detector_center.{name}", ()) for name in ("line", "sample")]
    first = [isd.numbers(f"starting_detector_{name}", ()) for name in ("line", "sample")]
    summing = isd.numbers("detector_sample_summing", ())
    focal = isd.numbers("focal_length_model.focal_length", ())
    if not (focal > 0 and summing > 0):
        raise InputError(f"a focal length of {focal:g} mm, or {summing:g} samples in one")

    def tangents(column: _Floats) -> _Floats:
        detector = np.stack([np.full_like(column, first[0]), (column + 0.5) * summing + first[1]], axis=-1)
        return _undistorted((detector - centre - [to_line[0], to_sample[0]]) @ np.linalg.inv(A).T, isd) / focal

    return LineLook.of(tangents, isd.samples)


def _undistorted(xy: _Floats, isd: _Isd) -> _Floats:
    """Focal plane coordinates (n, 2), mm, as they would be without distortion."""
    if not isd.has("optical_distortion"):
        return xy
    kinds = isd._find("optical_distortion")
    kind = next(iter(kinds), "") if isinstance(kinds, dict) else ""
    if kind == "radial":
        k = isd.numbers("optical_distortion.radial.coefficients", (3,))
        rr = (xy**2).sum(axis=-1, keepdims=True)
        return np.asarray(xy * (1.0 - (k[0] + rr * (k[1] + rr * k[2]))))
    if kind == "lrolrocnac":
        k = isd.numbers("optical_distortion.lrolrocnac.coefficients", (1,))
        return np.asarray(np.stack([xy[:, 0], xy[:, 1] / (1.0 + k[0] * xy[:, 1] ** 2)], axis=-1))
    raise InputError(f"the distortion {kind!r} is not known; radial and lrolrocnac are")
