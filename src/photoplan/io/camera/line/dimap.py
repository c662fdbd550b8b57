"""DIMAP: the physical model of a Pléiades system product.

Positions are Lagrange's polynomials of eight values of the ephemeris, attitudes polynomials of the second of the day in
each element of a quaternion (scalar first, from the camera to WGS 84), directions of the detectors polynomials of the
column in two angles, which count as they are and not by their tangents. The model's start is the middle of the first
line's exposure, its column 0 the middle of the first pixel. What no text states was found with a product's own grid of
locations, which is met to 0.2 mm.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from photoplan.cameras.pushbroom_rays import LineLook, LineTrack
from photoplan.errors import InputError
from photoplan.geometry.local import EARTH_RADII
from photoplan.geometry.pose import EvenTable, odd_step
from photoplan.io.camera.line.model import StatedLine

_Floats = NDArray[np.float64]
FORM = "Pléiades physical model (DIMAP)"
_MODEL = ".//Sensor_Model_Characteristics"
_ATTITUDES = "Sensor_Attitudes/Polynomial_Models"
_MAX_SIZE, _MAX_DEGREE = 10_000_000, 20


def is_it(root: Element) -> bool:
    """Whether a document is of this kind."""
    return root.find(_MODEL) is not None


def read(root: Element, path: Path) -> StatedLine:
    """The line camera of a document."""
    model = root.find(_MODEL)
    assert model is not None
    try:
        columns, lines = (int(_number(root, f".//Raster_Dimensions/{name}")) for name in ("NCOLS", "NROWS"))
        if not (2 <= columns <= _MAX_SIZE and 1 <= lines <= _MAX_SIZE):
            raise InputError(f"an image of {columns} × {lines} pixels")
        return StatedLine(
            file=path, form=FORM, track=_track(model, lines), look=_look(model, columns), radii=EARTH_RADII
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _track(model: Element, lines: int) -> LineTrack:
    starts, ends = (_second(_text(model, f"UTC_Sensor_Model_Range/{name}")) for name in ("START", "END"))
    period = 1e-3 * _number(model, "SENSOR_LINE_PERIOD")
    points = model.findall("Sensor_Ephemeris/Point_List/Point")
    if len(points) < 2:
        raise InputError("fewer than two points of Sensor_Ephemeris")
    # From the first line on: seconds of the day are rounded to what the satellite flies 50 nm in.
    when = np.array([_second(_text(point, "UTC_TIME")) for point in points]) - starts
    positions = np.array([_numbers(point, "LOCATION_VALUES", 3) for point in points])
    step = float(when[1] - when[0])
    if np.abs(np.diff(when) - step).max() > 1e-6:
        raise InputError("the points of Sensor_Ephemeris are not evenly spaced in time")
    odd = odd_step(when, positions)
    if odd is not None:
        raise InputError(f"Sensor_Ephemeris: {odd}")
    table = EvenTable(float(when[0]), step, positions)
    offset, scale = (_number(model, f"Sensor_Attitudes/{name}") for name in ("OFFSET", "SCALE"))
    cubics = [_numbers(model, f"{_ATTITUDES}/{name}/COEFFICIENTS") for name in _quaternion_names(model)]
    offset, ends = offset - starts, ends - starts
    if not (period > 0 and scale > 0):
        raise InputError(f"a line of {period:g} s, or attitudes over {scale:g} s")

    def attitudes(t: _Floats) -> _Floats:
        return np.stack([polynomial.polyval((t - offset) / scale, each) for each in cubics], axis=-1)

    clock = np.array([0.0]), np.array([0.0]), np.array([period])
    known = max(table.start, offset - scale, -period), min(table.end, offset + scale, ends + period)
    return LineTrack(lines, *clock, table, attitudes, known)


def _quaternion_names(model: Element) -> list[str]:
    """Names of the four elements of quaternions."""
    attitudes = model.find(_ATTITUDES)
    found = [] if attitudes is None else [e.tag for e in attitudes if e.find("COEFFICIENTS") is not None]
    if len(found) != 4:
        raise InputError(f"{len(found)} polynomials of attitudes; four elements of a quaternion are known")
    return sorted(found)


def _look(model: Element, columns: int) -> LineLook:
    """Directions by the angles PsiX along the flight and PsiY across it."""
    path = "Sensor_Viewing_Model/Viewing_Directions/{}_Model/COEFFICIENTS"
    psi_x, psi_y = (_numbers(model, path.format(name)) for name in ("PsiX", "PsiY"))

    def tangents(column: _Floats) -> _Floats:
        return np.stack([polynomial.polyval(column, psi_y), -polynomial.polyval(column, psi_x)], axis=-1)

    return LineLook.of(tangents, columns)


def _text(element: Element, name: str) -> str:
    found = element.findtext(name)
    if found is None or not found.strip():
        raise InputError(f"{name.removeprefix('.//')} is missing")
    return found.strip()


def _numbers(element: Element, name: str, count: int | None = None) -> list[float]:
    words = _text(element, name).split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{name}: {' '.join(words)[:80]!r} given; numbers are needed") from None
    if (count is not None and len(values) != count) or len(values) > _MAX_DEGREE or not np.isfinite(values).all():
        raise InputError(f"{name}: {len(values)} values, or such that are not finite")
    return values


def _number(element: Element, name: str) -> float:
    return _numbers(element, name, 1)[0]


def _second(text: str) -> float:
    """Second of the day; a day that ends during the image is not known by the model's polynomials either."""
    try:
        at = datetime.fromisoformat(text.removesuffix("Z")[:26])
        parts = text.removesuffix("Z").split(":")
        return at.hour * 3600 + at.minute * 60 + float(parts[2])
    except (ValueError, IndexError):
        raise InputError(f"{text[:40]!r} is not a time") from None
