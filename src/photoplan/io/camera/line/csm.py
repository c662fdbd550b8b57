"""Support data of the Community Sensor Model (ISD, JSON): line cameras of planetary missions.

Times of lines count from the centre of the image; half a line is added for the middle of the exposure. Positions and
attitudes are brought to even steps in the body's axes and interpolated by Lagrange's polynomials of eight values.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.pushbroom_rays import LineTrack
from photoplan.errors import InputError
from photoplan.geometry.pose import EvenTable, between, conjugate, continuous, cubic, rotations, times
from photoplan.io.camera.isd import FORM, FRAME_MODEL, Isd
from photoplan.io.camera.line.csm_lens import look
from photoplan.io.camera.line.model import StatedLine

_Floats = NDArray[np.float64]
#: Positions get at least so many even steps: Lagrange's polynomials want neighbours.
_ROWS = 25


def read(isd: Any, path: Path) -> StatedLine:
    """The line camera of an ISD."""
    if not isinstance(isd, dict) or "line_scan_rate" not in isd:
        name = isd.get("name_model", "") if isinstance(isd, dict) else ""
        if name == FRAME_MODEL:
            raise InputError(f"{path}: support data of a frame camera; state the file as `frame`, not as `line`")
        raise InputError(
            f"{path}: support data without line_scan_rate{f' (of {name})' if name else ''}: no line camera"
        )
    source = Isd(isd, path)
    try:
        lens = f"{source.focal_plane().focal:.6g} mm, distortion {source.distortion or 'none'}"
        return StatedLine(file=path, form=FORM, track=_track(source), look=look(source), radii=source.radii, lens=lens)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def _track(isd: Isd) -> LineTrack:
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
    attitudes = continuous(between(when, q, even))
    rows, began, lasts = _clock(isd)
    centre = isd.numbers("center_ephemeris_time", ())
    sense = -1.0 if (lasts < 0).all() else 1.0
    if sense < 0:
        # Later lines were taken earlier, as in images that were turned over. Poses belong to lines: time may run
        # backwards, too.
        t, fixed, even, attitudes = -t[::-1], fixed[::-1], -even[::-1], attitudes[::-1]
    courses = [EvenTable.over(t, fixed), EvenTable.over(even, attitudes)]
    courses = [replace(each, start=each.start - sense * centre) for each in courses]
    known = max(each.start for each in courses), min(each.end for each in courses)
    # Of attitudes there are two tables; where one has ended nothing is known (of a single value: it holds always).
    for name in ("instrument_pointing", "body_rotation"):
        its = np.sort(sense * (isd.moments(name) - centre))
        known = (max(known[0], its[0]), min(known[1], its[-1])) if len(its) > 1 else known
    return LineTrack(
        lines=isd.lines,
        knots=rows,
        moments=sense * began,
        rates=sense * lasts,
        positions=courses[0],
        attitudes=courses[1],
        known=known,
    )


def _clock(isd: Isd) -> tuple[_Floats, _Floats, _Floats]:
    """Rows from which on lines last as they do, their times, and how long a line lasts.

    CSM counts from the upper edge of the first line, photoplan from its middle: half a line, and half a line of time.
    """
    rates = isd.numbers("line_scan_rate", (-1, 3))
    if not len(rates):
        raise InputError("line_scan_rate is empty")
    line, began, lasts = rates.T
    return line - 0.5, began + 0.5 * lasts, lasts
