"""Aerial strips: our own form, TOML beside a table of the flight.

The flight is a record of positions and angles at its own rate, in a projected CRS; angles turn the axes of the map
(grid east, grid north, up) at each place into those of the record. Camera axes are those of frame images: x in the
direction of flight, y to the left, z up; a detector at x, y (mm) in the focal plane of a positive looks along
(x, y, −c).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from photoplan.cameras.pushbroom_rays import LineTrack
from photoplan.errors import HeightSystemError, InputError
from photoplan.geometry.bounds import odd_angles, odd_place
from photoplan.geometry.local import EARTH_RADII, BodyGround
from photoplan.geometry.pose import (
    ANGLE_UNITS,
    continuous,
    cubic,
    odd_step,
    quaternions,
    rotation_from_angles,
    rotation_opk,
)
from photoplan.io.camera.line.detectors import StripDetectors, looks_of
from photoplan.io.camera.line.model import MAX_BYTES, StatedLine
from photoplan.io.camera.line.number_table import read_numbers
from photoplan.io.camera.model import Entry, Name, Number, Pixels, Positive
from photoplan.io.files import read_entries, read_head

_Floats = NDArray[np.float64]
FORM = "aerial strip (photoplan)"
MARK = "photoplan strip 1"
#: A record that is silent for this many times its usual step has a gap.
_GAP = 10.0
_COLUMNS = "time,x,y,z,omega,phi,kappa"
#: From the camera axes of frame images to those of a line camera, which looks along +z.
_TURNED = np.diag([1.0, -1.0, -1.0])


#: What is further from nought is no time, no place in an aircraft, no angle.
_Seconds = Annotated[Number, Field(ge=-1e12, le=1e12)]
_Arm = Annotated[Number, Field(ge=-1000.0, le=1000.0)]
_Turn = Annotated[Number, Field(ge=-360.0, le=360.0)]


class StripClock(Entry):
    """``[clock]``: when lines were taken."""

    first: _Seconds
    """Middle of the exposure of the first line, in the time of the flight's record; seconds."""
    line: Positive
    """From line to line, seconds."""


class StripFlight(Entry):
    """``[flight]``: the record of positions and angles."""

    file: Annotated[str, Field(max_length=4000)]
    """CSV with the header ``time,x,y,z,omega,phi,kappa``, or NPY of shape (n, 7)."""
    crs: Name
    height_system: Name
    angle_unit: Literal["deg", "gon", "rad"] = "deg"
    rotation: Literal["opk", "pok", "kpo", "kop", "okp", "pko"] = "opk"
    """Order of the rotations, the primary one first; the columns stay as they are."""
    time_offset: _Seconds = 0.0
    """Added to the times of the record, seconds."""
    lever_arm: tuple[_Arm, _Arm, _Arm] = (0.0, 0.0, 0.0)
    """From the recorded point to the projection centre, in the axes of the record, metres."""
    boresight: tuple[_Turn, _Turn, _Turn] = (0.0, 0.0, 0.0)
    """ω, φ, κ from the axes of the camera to those of the record, degrees."""


class StripFile(Entry):
    """A whole file."""

    format: Literal["photoplan strip 1"]
    lines: Pixels
    clock: StripClock
    flight: StripFlight
    detectors: Annotated[dict[Name, StripDetectors], Field(min_length=1, max_length=1000)]


def is_it(path: Path) -> bool:
    """Whether a TOML file is of this form."""
    return MARK in read_head(path)


def names(path: Path) -> list[str]:
    """Names of the lines of detectors; a file that cannot be used is an InputError."""
    return list(read_entries(path, StripFile, MAX_BYTES).detectors)


def files_beside(path: Path) -> list[Path]:
    """The record of the flight that a strip names, and tables of its detectors."""
    strip = read_entries(path, StripFile, MAX_BYTES)
    tables = dict.fromkeys(each.table for each in strip.detectors.values() if each.table is not None)
    return [path.parent / name for name in (strip.flight.file, *tables)]


def read(path: Path, name: str | None) -> StatedLine:
    """The line camera of a strip, by the name of its detectors; None: there is one line of them."""
    strip = read_entries(path, StripFile, MAX_BYTES)
    known = ", ".join(strip.detectors)
    if name is None and len(strip.detectors) > 1:
        raise InputError(f"{path}: has several lines of detectors ({known}); say which by `detectors = NAME`")
    detectors = strip.detectors.get(name or next(iter(strip.detectors)))
    if detectors is None:
        raise InputError(f"{path}: no line of detectors {name!r}; there are {known}")
    try:
        looks, beside = looks_of(detectors, path.parent, MAX_BYTES)
        chips = looks if len(looks) > 1 else ()
        return StatedLine(
            file=path,
            form=FORM,
            track=_track(strip, path),
            look=looks[0],
            radii=EARTH_RADII,
            beside=beside,
            chips=chips,
        )
    except HeightSystemError:
        raise
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path.parent)) else f"{path}: {text}") from None


def _track(strip: StripFile, path: Path) -> LineTrack:
    flight = strip.flight
    table = _record(path.parent / flight.file)
    _judge(table, flight, path.parent / flight.file)
    t = table[:, 0] + flight.time_offset - strip.clock.first
    ground = BodyGround(flight.crs, flight.height_system, EARTH_RADII)
    places = ground(table[:, 1:4])
    axes = ground.jacobian(table[:, 1:4])
    if not (np.isfinite(places).all() and np.isfinite(axes).all()):
        raise InputError(f"positions of {flight.file} have no place in {flight.crs}; are they in this CRS?")
    # Grid east, grid north and up in the axes of the earth.
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = table[:, 4:] * (2 * np.pi / ANGLE_UNITS[flight.angle_unit])
    record = axes @ rotation_from_angles(angles[:, ["opk".index(k) for k in flight.rotation]], flight.rotation)
    S = places + record @ np.array(flight.lever_arm)
    q = continuous(quaternions(record @ rotation_opk(*np.radians(flight.boresight)) @ _TURNED))
    # Attitudes too without kinks at the records: where these are as far apart as lines, a late clock lies between them.
    speed, turning = (np.gradient(each, t, axis=0, edge_order=2 if len(t) > 2 else 1) for each in (S, q))
    clock = np.array([0.0]), np.array([0.0]), np.array([strip.clock.line])
    known = float(t[0]), float(t[-1])
    return LineTrack(
        strip.lines,
        *clock,
        positions=lambda when: cubic(t, S, speed, when),
        attitudes=lambda when: cubic(t, q, turning, when),
        known=known,
        gaps=_gaps(t),
        per_line=True,
    )


def _record(path: Path) -> _Floats:
    """The table of the flight, shape (n, 7)."""
    table = read_numbers(path, _COLUMNS, MAX_BYTES)
    if len(table) < 2:
        raise InputError(f"{path}: one row; two or more are needed")
    if not (np.diff(table[:, 0]) > 0).all():
        row = int(np.argmin(np.diff(table[:, 0]))) + 1
        raise InputError(f"{path}: the time of row {row + 1} ({table[row, 0]:g}) is not after that of the row before")
    return table


def _gaps(t: _Floats) -> tuple[tuple[float, float], ...]:
    """Where a record is silent for much longer than from row to row otherwise."""
    step = np.diff(t)
    long = np.flatnonzero(step > _GAP * np.median(step))
    return tuple((float(t[k]), float(t[k + 1])) for k in long)


def _judge(table: _Floats, flight: StripFlight, path: Path) -> None:
    """Refuse what is finite and still cannot be meant."""
    worst = np.abs(table[:, 4:]).max(axis=1).argmax()
    odd = odd_angles(table[worst, 4:].tolist(), flight.angle_unit, _COLUMNS.split(",")[4:])
    if odd is not None:
        raise InputError(f"{path}: row {worst + 1}: {odd}")
    low, high = table[:, 3].argmin(), table[:, 3].argmax()
    for row in {int(np.abs(table[:, 1:3]).max(axis=1).argmax()), int(low), int(high)}:
        odd = odd_place(table[row, 1:4].tolist(), camera=True)
        if odd is not None:
            raise InputError(f"{path}: row {row + 1}: {odd}")
    odd = odd_step(table[:, 0], table[:, 1:4])
    if odd is not None:
        raise InputError(f"{path}: {odd}; correct the record, or leave rows out")
