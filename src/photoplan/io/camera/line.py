"""Line cameras from files: support data (ISD), DIMAP, strips of our own form, and corrections of trajectories.

CSM: times of lines count from the centre of the image; half a line is added for the middle of the exposure. Positions
and attitudes are brought to even steps in the body's axes and interpolated by Lagrange's polynomials of eight values.
With u without and d with distortion in the focal plane, both in millimetres, distortions are those of
`photoplan.io.camera.satellite`, and (USGS, usgscsm, `Distortion.cpp`, and for THEMIS ISIS, `ThemisIrDistortionMap.cpp`;
public domain; names are their own)

    kaguyalism      ux = dx + boresight_x + x0 + x1 r + x2 r² + x3 r³, uy likewise, r of d, positive on either side
    kplo_shadowcam  ux = dx, uy = dy (1 + k dy²)
    lrolrocnac      ux = dx, uy = dy / (1 + k dy²)
    themisir        dx = p_k ux, dy = (1 + p_alpha1) uy + p_alpha2 uy²

DIMAP, the physical model of a Pléiades system product: positions are Lagrange's polynomials of eight values of the
ephemeris, attitudes polynomials of the second of the day in each element of a quaternion (scalar first, from the camera
to WGS 84), directions of the detectors polynomials of the column in two angles, which count as they are and not by
their tangents. The model's start is the middle of the first line's exposure, its column 0 the middle of the first
pixel. What no text states was found with a product's own grid of locations, which is met to 0.2 mm.

Strips are TOML beside a table of the flight: a record of positions and angles at its own rate, in a projected CRS;
angles turn the axes of the map (grid east, grid north, up) at each place into those of the record. Camera axes are
those of frame images: x in the direction of flight, y to the left, z up; a detector at x, y (mm) in the focal plane of
a positive looks along (x, y, −c). Detectors are polynomials of the column, or a table with a position of each element.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from xml.etree.ElementTree import Element

import numpy as np
from numpy.polynomial import Chebyshev, polynomial
from pydantic import Field, model_validator

from photoplan.arrays import Floats
from photoplan.cameras.correctable import LineCorrection, PoseErrors, TrackSpline
from photoplan.cameras.pushbroom import ChippedLine, LineCamera
from photoplan.cameras.pushbroom_rays import LineBend, LineLook, LineTrack
from photoplan.errors import HeightSystemError, InputError
from photoplan.geometry.bounds import odd_angles, odd_place
from photoplan.geometry.local import EARTH_RADII, BodyGround
from photoplan.geometry.pose import (
    FLIP,
    EvenTable,
    angle_in_radians,
    between,
    conjugate,
    continuous,
    cubic,
    odd_step,
    quaternions,
    rotation_from_angles,
    rotation_opk,
    rotations,
    times,
)
from photoplan.io.camera.model import Entry, Name, Number, Pixels, Positive, Triple
from photoplan.io.camera.satellite import FORM, FRAME_MODEL, LENSES, Isd, lens_of, not_known
from photoplan.io.files import format_hint, read_entries, read_head, read_json, read_text, read_xml

#: Nothing that holds a trajectory and what belongs to an image is larger.
MAX_BYTES = 200_000_000


@dataclass(frozen=True, eq=False)
class StatedLine:
    """A line camera of a file."""

    file: Path
    form: str
    """The file's format, in words."""
    track: LineTrack
    look: LineLook
    radii: tuple[float, float]
    """Equatorial and polar radius of the body, metres."""
    beside: float | None = None
    """Largest distance of elements of a table of detectors from the curve that stands for them, columns; None without a
    table."""
    chips: tuple[LineLook, ...] = ()
    """All chips of a line that has several, with `look` the first; empty if it has one."""
    lens: str | None = None
    """Focal length and kind of distortion in words; None: the file states directions alone."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.look.columns, self.track.lines

    def camera(self, crs: str, heights: str) -> LineCamera | ChippedLine:
        """The camera over a ground; a CRS of another body is an InputError."""
        ground = BodyGround(crs, heights, self.radii)
        if self.chips:
            return ChippedLine(tuple(LineCamera(self.track, look, ground) for look in self.chips))
        return LineCamera(self.track, self.look, ground)

    def describe(self) -> dict[str, str]:
        """In words, by name."""
        first, last = math.ceil(self.track.oriented[0] - 1e-3), math.floor(self.track.oriented[1] + 1e-3)
        oriented = f"{first} to {last}"
        t0, rate = float(self.track.time(np.zeros(1))[0]), float(self.track.rates[0])
        ends = [[round((t - t0) / rate, 1) for t in gap] for gap in self.track.gaps]
        gaps = ", ".join(f"{a:g} to {b:g}" for a, b in ends if b > 0 and a < self.size[1])
        table = "" if self.beside is None else f"; elements lie up to {self.beside:.2g} columns beside a smooth curve"
        chips = f"; {len(self.chips)} chips" if self.chips else ""
        whole = self.track.oriented == (-0.5, self.size[1] - 0.5)
        return {
            "line camera": self.form,
            "image": f"{self.size[0]} columns, {self.size[1]} lines of {1000 * rate:.6g} ms",
            "oriented lines": "all" if whole else f"{oriented} only; the others have no position or attitude",
            "directions": f"{1e6 * self.look.pitch:.4g} µrad from column to column in the middle{table}{chips}",
            **({} if self.lens is None else {"focal length": self.lens}),
            **({} if not gaps else {"gaps": f"of the record: lines {gaps} have no orientation"}),
            "body": f"radii {self.radii[0] / 1000:.3f} and {self.radii[1] / 1000:.3f} km",
        }


#: From y down to y up, and back.
_UP = np.array([1.0, -1.0])


def look(isd: Isd) -> LineLook:
    """Directions of the detectors: places in the focal plane without distortion, over the focal length."""
    plane, summing = isd.focal_plane(), isd.summing("sample")
    to_plane = np.linalg.inv(plane.to_detector)
    place = np.asarray(to_plane @ (np.array([plane.first[0], 0.5 * summing + plane.first[1]]) - plane.axis), float)
    step = np.asarray(to_plane[:, 1] * summing, float)
    kind = isd.distortion

    def places(column: Floats) -> Floats:
        return np.asarray(place + column[:, None] * step)

    if kind is None or kind in LENSES:
        c, lens = lens_of(isd, kind)
        return LineLook.of(lambda column: lens.undistort(places(column) * (_UP / c)) * _UP, isd.samples)
    if kind not in _PLANE:
        raise not_known(kind, [*LENSES, *_PLANE])
    undistorted = _PLANE[kind](isd)
    bend = None
    if kind == "kaguyalism":
        odd = _kaguya(isd)[[1, 3]] / plane.focal
        bend = LineBend(place, step, *odd) if odd.any() else None
    return LineLook.of(lambda column: undistorted(places(column)) / plane.focal, isd.samples, bend=bend)


_Plane = Callable[[Floats], Floats]


def _even(isd: Isd) -> _Plane:
    """Return the part that depends on even powers of the distance; for the odd ones see `LineBend`."""
    shift = [isd.numbers(f"optical_distortion.kaguyalism.boresight_{axis}", ()) for axis in "xy"]
    k = _kaguya(isd)
    return lambda d: np.asarray(d + shift + k[0] + (d**2).sum(axis=1, keepdims=True) * k[2])


def _kaguya(isd: Isd) -> Floats:
    """Coefficients (4, 2) of rising powers of the distance, for x and y."""
    return np.array([isd.coefficients(f"kaguyalism.{axis}", 4) for axis in "xy"]).T


def _shadowcam(isd: Isd) -> _Plane:
    (k,) = isd.coefficients("kplo_shadowcam.coefficients", 1)
    return lambda d: d * np.stack([np.ones(len(d)), 1.0 + k * d[:, 1] ** 2], axis=1)


def _lroc(isd: Isd) -> _Plane:
    (k,) = isd.coefficients("lrolrocnac.coefficients", 1)
    return lambda d: d / np.stack([np.ones(len(d)), 1.0 + k * d[:, 1] ** 2], axis=1)


def _themis(isd: Isd) -> _Plane:
    k, one, two = (isd.numbers(f"optical_distortion.themisir.{name}", ()) for name in ("p_k", "p_alpha1", "p_alpha2"))
    if not k > 0:
        raise InputError(f"optical_distortion.themisir.p_k is {k:g}: a scale, above 0")

    def undistorted(d: Floats) -> Floats:
        with np.errstate(invalid="ignore"):
            root = np.sqrt((1.0 + one) ** 2 + 4.0 * two * d[:, 1])
        return np.stack([d[:, 0] / k, 2.0 * d[:, 1] / (1.0 + one + root)], axis=1)

    return undistorted


_PLANE: dict[str, Callable[[Isd], _Plane]] = {
    "kaguyalism": _even,
    "kplo_shadowcam": _shadowcam,
    "lrolrocnac": _lroc,
    "themisir": _themis,
}


#: Positions get at least so many even steps: Lagrange's polynomials want neighbours.
_CSM_ROWS = 25


def read_csm(isd: Any, path: Path) -> StatedLine:
    """Return the line camera of the contents of an ISD."""
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
        return StatedLine(
            file=path, form=FORM, track=_csm_track(source), look=look(source), radii=source.radii, lens=lens
        )
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def _csm_track(isd: Isd) -> LineTrack:
    """Trajectory in the axes of the body, and the times of the lines."""
    at = isd.moments("instrument_position")
    if len(at) < 2:
        raise InputError("instrument_position holds a single moment; a trajectory has two at least")
    positions, speeds = isd.positions()
    t = np.linspace(at[0], at[-1], max(len(at), _CSM_ROWS))
    body = rotations(isd.turns("body_rotation", t))
    fixed = np.einsum("nij,nj->ni", body, cubic(at, positions, speeds, t))
    # Attitudes are known at the moments of both tables.
    when = np.union1d(isd.moments("instrument_pointing"), isd.moments("body_rotation"))
    if len(when) < 2:
        raise InputError("instrument_pointing holds a single moment; a trajectory has two at least")
    q = times(isd.turns("body_rotation", when), conjugate(isd.turns("instrument_pointing", when)))
    even = np.linspace(when[0], when[-1], len(when))
    attitudes = continuous(between(when, q, even))
    rows, began, lasts = _csm_clock(isd)
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


def _csm_clock(isd: Isd) -> tuple[Floats, Floats, Floats]:
    """Rows from which on lines last as they do, their times, and how long a line lasts.

    CSM counts from the upper edge of the first line, photoplan from its middle: half a line, and half a line of time.
    """
    rates = isd.numbers("line_scan_rate", (-1, 3))
    if not len(rates):
        raise InputError("line_scan_rate is empty")
    line, began, lasts = rates.T
    return line - 0.5, began + 0.5 * lasts, lasts


_DIMAP = "Pléiades physical model (DIMAP)"
_MODEL = ".//Sensor_Model_Characteristics"
_ATTITUDES = "Sensor_Attitudes/Polynomial_Models"
_MAX_SIZE, _MAX_DEGREE = 10_000_000, 20


def _read_dimap(path: Path) -> StatedLine:
    root = read_xml(path, MAX_BYTES)
    model = root.find(_MODEL)
    if model is None:
        raise InputError(f"{path}: an XML document of <{root.tag}> without the physical model of a line camera")
    try:
        columns, lines = (int(_dimap_number(root, f".//Raster_Dimensions/{name}")) for name in ("NCOLS", "NROWS"))
        if not (2 <= columns <= _MAX_SIZE and 1 <= lines <= _MAX_SIZE):
            raise InputError(f"an image of {columns} × {lines} pixels")
        return StatedLine(
            file=path,
            form=_DIMAP,
            track=_dimap_track(model, lines),
            look=_dimap_look(model, columns),
            radii=EARTH_RADII,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _dimap_track(model: Element, lines: int) -> LineTrack:
    starts, ends = (_second(_dimap_text(model, f"UTC_Sensor_Model_Range/{name}")) for name in ("START", "END"))
    period = 1e-3 * _dimap_number(model, "SENSOR_LINE_PERIOD")
    points = model.findall("Sensor_Ephemeris/Point_List/Point")
    if len(points) < 2:
        raise InputError("fewer than two points of Sensor_Ephemeris")
    # From the first line on: seconds of the day are rounded to what the satellite flies 50 nm in.
    when = np.array([_second(_dimap_text(point, "UTC_TIME")) for point in points]) - starts
    positions = np.array([_dimap_numbers(point, "LOCATION_VALUES", 3) for point in points])
    step = float(when[1] - when[0])
    if np.abs(np.diff(when) - step).max() > 1e-6:
        raise InputError("the points of Sensor_Ephemeris are not evenly spaced in time")
    odd = odd_step(when, positions)
    if odd is not None:
        raise InputError(f"Sensor_Ephemeris: {odd}")
    table = EvenTable(float(when[0]), step, positions)
    offset, scale = (_dimap_number(model, f"Sensor_Attitudes/{name}") for name in ("OFFSET", "SCALE"))
    cubics = [_dimap_numbers(model, f"{_ATTITUDES}/{name}/COEFFICIENTS") for name in _quaternion_names(model)]
    offset, ends = offset - starts, ends - starts
    if not (period > 0 and scale > 0):
        raise InputError(f"a line of {period:g} s, or attitudes over {scale:g} s")

    def attitudes(t: Floats) -> Floats:
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


def _dimap_look(model: Element, columns: int) -> LineLook:
    """Directions by the angles PsiX along the flight and PsiY across it."""
    path = "Sensor_Viewing_Model/Viewing_Directions/{}_Model/COEFFICIENTS"
    psi_x, psi_y = (_dimap_numbers(model, path.format(name)) for name in ("PsiX", "PsiY"))

    def tangents(column: Floats) -> Floats:
        return np.stack([polynomial.polyval(column, psi_y), -polynomial.polyval(column, psi_x)], axis=-1)

    return LineLook.of(tangents, columns)


def _dimap_text(element: Element, name: str) -> str:
    found = element.findtext(name)
    if found is None or not found.strip():
        raise InputError(f"{name.removeprefix('.//')} is missing")
    return found.strip()


def _dimap_numbers(element: Element, name: str, count: int | None = None) -> list[float]:
    words = _dimap_text(element, name).split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{name}: {' '.join(words)[:80]!r} given; numbers are needed") from None
    if (count is not None and len(values) != count) or len(values) > _MAX_DEGREE or not np.isfinite(values).all():
        raise InputError(f"{name}: {len(values)} values, or such that are not finite")
    return values


def _dimap_number(element: Element, name: str) -> float:
    return _dimap_numbers(element, name, 1)[0]


def _second(text: str) -> float:
    """Second of the day; a day that ends during the image is not known by the model's polynomials either."""
    try:
        at = datetime.fromisoformat(text.removesuffix("Z")[:26])
        parts = text.removesuffix("Z").split(":")
        return at.hour * 3600 + at.minute * 60 + float(parts[2])
    except (ValueError, IndexError):
        raise InputError(f"{text[:40]!r} is not a time") from None


def read_numbers(path: Path, columns: str, max_bytes: int) -> Floats:
    """The numbers (n, k) of a table: CSV that begins with the names of its columns, or NPY."""
    count = columns.count(",") + 1
    try:
        if path.suffix.lower() == ".npy":
            if path.stat().st_size > max_bytes:
                raise InputError(f"{path}: {path.stat().st_size} bytes; no table of a strip has more than {max_bytes}")
            table = _from_npy(path)
        else:
            header, _, body = read_text(path, max_bytes).partition("\n")
            if header.replace(" ", "").strip().lower() != columns:
                raise InputError(f"{path}: the first line is {header[:80]!r}; it has to be {columns}")
            if not body.strip():
                raise InputError(f"{path}: holds nothing but its first line")
            table = np.loadtxt(body.splitlines(), delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        # What NumPy advises behind the semicolon is for who programs.
        raise InputError(f"{path}: cannot be read ({str(error).partition(';')[0]})") from None
    if table.ndim != 2 or table.shape[1] != count:
        raise InputError(f"{path}: a table of shape {table.shape}; needed are {count} numbers in each row")
    wrong = ~np.isfinite(table).all(axis=1)
    if wrong.any():
        raise InputError(f"{path}: row {int(np.argmax(wrong)) + 1} holds a number that is not finite")
    return np.ascontiguousarray(table)


def _from_npy(path: Path) -> Floats:
    try:
        table = np.load(path, allow_pickle=False, mmap_mode="r")
        kind = table.dtype
    except (OSError, ValueError):
        raise
    except Exception as error:
        # Its header is a line of Python: a damaged one ends in whatever the parser raises.
        raise ValueError(f"no array in NPY form: {error}") from None
    if kind.kind not in "fiu":
        raise ValueError(f"it holds {kind}: real numbers are needed")
    return np.asarray(table, float)


_Polynomial = Annotated[tuple[Number, ...], Field(min_length=1, max_length=16)]
_ELEMENTS = "x,y"
#: Degree of the curve through a table; elements lie no further beside it than this, in units of their distance.
_DEGREE, _BESIDE = 15, 0.05


class StripChip(Entry):
    """One of ``chips``: what several chips of a line have of their own."""

    columns: Pixels
    x_mm: _Polynomial | None = None
    """Coefficients as those of a line, by the chip's own columns; None with a table, or for 0."""
    y_mm: _Polynomial | None = None


class StripDetectors(Entry):
    """``[detectors.NAME]``: one line of detectors."""

    columns: Pixels
    focal_mm: Positive
    x_mm: _Polynomial | None = None
    """Positions of the detectors in the direction of flight: coefficients of the powers of the column, mm; None for
    0."""
    y_mm: _Polynomial | None = None
    """The same across it, to the left."""
    table: Annotated[str, Field(min_length=1, max_length=4000)] | None = None
    """Instead of both: a file with a row for each element, mm: CSV with the header ``x,y``, or NPY (columns, 2)."""
    chips: Annotated[tuple[StripChip, ...], Field(min_length=2, max_length=64)] | None = None
    """Chips of a line that is made of several, in the order of their columns: each follows a smooth curve of its
    own."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        own = [] if self.chips is None else [chip.y_mm for chip in self.chips]
        if self.table is None and self.y_mm is None and (not own or None in own):
            raise ValueError("state y_mm (and x_mm), or a table of the elements; of chips, each has y_mm")
        stated = (self.x_mm, self.y_mm, *own, *(chip.x_mm for chip in self.chips or ()))
        if self.table is not None and any(each is not None for each in stated):
            raise ValueError("a table of the elements takes the place of x_mm and y_mm; state one of both")
        if self.chips is not None and (self.x_mm is not None or self.y_mm is not None):
            raise ValueError("x_mm and y_mm of a line of several chips are those of each chip")
        if self.chips is not None and sum(chip.columns for chip in self.chips) != self.columns:
            raise ValueError(f"chips of {sum(chip.columns for chip in self.chips)} columns in a line of {self.columns}")
        return self


def looks_of(detectors: StripDetectors, folder: Path, max_bytes: int) -> tuple[tuple[LineLook, ...], float | None]:
    """Directions of a line, or of its chips, and how far the elements of its table lie beside them, in columns.

    None: no table.
    """
    whole = StripChip(columns=detectors.columns, x_mm=detectors.x_mm, y_mm=detectors.y_mm)
    chips, table, file = detectors.chips or (whole,), None, Path()
    if detectors.table is not None:
        file = folder / detectors.table
        table = read_numbers(file, _ELEMENTS, max_bytes)
        if len(table) != detectors.columns:
            raise InputError(f"{file}: {len(table)} rows; needed are x and y of {detectors.columns} elements")
    looks, beside, first = [], 0.0, 0
    for chip in chips:
        end = first + chip.columns
        if table is None:
            curve = _stated(chip)
        else:
            curve, away = _through(table[first:end], file, first)
            beside = max(beside, away)
        part = None if detectors.chips is None else (first, end)
        looks.append(LineLook.of(_tangents(curve, first, detectors.focal_mm), detectors.columns, part))
        first = end
    return tuple(looks), None if table is None else beside


_Curve = tuple[Callable[[Floats], Floats], Callable[[Floats], Floats]]


def _stated(chip: StripChip) -> _Curve:
    x_mm, y_mm = (np.array(each or (0.0,)) for each in (chip.x_mm, chip.y_mm))
    return lambda c: np.asarray(polynomial.polyval(c, x_mm), float), lambda c: np.asarray(
        polynomial.polyval(c, y_mm), float
    )


def _tangents(curve: _Curve, first: int, focal_mm: float) -> Callable[[Floats], Floats]:
    """Directions by the columns of the image, of a curve by those of a chip."""
    x, y = curve
    return lambda column: np.asarray(np.stack([x(column - first), -y(column - first)], axis=-1) / focal_mm)


def _through(table: Floats, file: Path, first: int) -> tuple[_Curve, float]:
    """Curves x, y of the column through elements, and how far these lie beside them, in columns.

    first: elements of the line before them.
    """
    column = np.arange(len(table), dtype=float)
    degree = min(_DEGREE, max(1, len(table) // 8))
    x, y = (Chebyshev.fit(column, values, degree) for values in table.T)
    pitch = float(np.hypot(*(np.ptp(values) for values in table.T))) / max(len(table) - 1, 1)
    away = np.hypot(x(column) - table[:, 0], y(column) - table[:, 1]) / max(pitch, 1e-12)
    worst = int(np.argmax(away))
    if not away[worst] <= _BESIDE:
        raise InputError(
            f"{file}: element {first + worst + 1} lies {away[worst]:.3g} columns beside a smooth curve through all; at "
            f"most {_BESIDE:g} can be used. Is a number wrong? Of several chips in one line, state `chips`"
        )
    return (x, y), float(away[worst])


_STRIP = "aerial strip (photoplan)"
MARK = "photoplan strip 1"
#: A record that is silent for this many times its usual step has a gap.
_GAP = 10.0
_COLUMNS = "time,x,y,z,omega,phi,kappa"


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


def _read_strip(path: Path, name: str | None) -> StatedLine:
    """Read a strip, by the name of its detectors, or None if there is one line of them."""
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
            form=_STRIP,
            track=_strip_track(strip, path),
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


def _strip_track(strip: StripFile, path: Path) -> LineTrack:
    flight = strip.flight
    table = _strip_record(path.parent / flight.file)
    _judge_strip(table, flight, path.parent / flight.file)
    t = table[:, 0] + flight.time_offset - strip.clock.first
    ground = BodyGround(flight.crs, flight.height_system, EARTH_RADII)
    places = ground(table[:, 1:4])
    axes = ground.jacobian(table[:, 1:4])
    if not (np.isfinite(places).all() and np.isfinite(axes).all()):
        raise InputError(f"positions of {flight.file} have no place in {flight.crs}; are they in this CRS?")
    # Grid east, grid north and up in the axes of the earth.
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = angle_in_radians(table[:, 4:], flight.angle_unit)
    record = axes @ rotation_from_angles(angles[:, ["opk".index(k) for k in flight.rotation]], flight.rotation)
    S = places + record @ np.array(flight.lever_arm)
    q = continuous(quaternions(record @ rotation_opk(*np.radians(flight.boresight)) @ FLIP))
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


def _strip_record(path: Path) -> Floats:
    """The table of the flight, shape (n, 7)."""
    table = read_numbers(path, _COLUMNS, MAX_BYTES)
    if len(table) < 2:
        raise InputError(f"{path}: one row; two or more are needed")
    if not (np.diff(table[:, 0]) > 0).all():
        row = int(np.argmin(np.diff(table[:, 0]))) + 1
        raise InputError(f"{path}: the time of row {row + 1} ({table[row, 0]:g}) is not after that of the row before")
    return table


def _gaps(t: Floats) -> tuple[tuple[float, float], ...]:
    """Return the times in which a record is silent for much longer than from row to row otherwise."""
    step = np.diff(t)
    long = np.flatnonzero(step > _GAP * np.median(step))
    return tuple((float(t[k]), float(t[k + 1])) for k in long)


def _judge_strip(table: Floats, flight: StripFlight, path: Path) -> None:
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


def _read_isd(path: Path) -> StatedLine:
    return read_csm(read_json(path, MAX_BYTES), path)


#: Reader of every format that states a single line, by file suffix.
LINE_FORMATS: dict[str, Callable[[Path], StatedLine]] = {".json": _read_isd, ".isd": _read_isd, ".xml": _read_dimap}


def read_line(path: Path, detectors: str | None = None) -> StatedLine:
    """Read a line camera: CSM support data (ISD, JSON), DIMAP with a physical model, or an aerial strip (TOML)."""
    kind = path.suffix.lower()
    if kind == ".toml":
        return _read_strip(path, detectors)
    if kind not in LINE_FORMATS:
        known = ", ".join([*LINE_FORMATS, ".toml"])
        raise InputError(f"{path}: not a file of a line camera ({known}){format_hint(path)}")
    if detectors is not None:
        raise InputError(f"{path}: holds a single line of detectors; take `detectors = {detectors!r}` out")
    return LINE_FORMATS[kind](path)


def describe_line(path: Path) -> dict[str, str]:
    """Return a line camera in words; of several lines of detectors the first, and the names of all."""
    if path.suffix.lower() != ".toml":
        return read_line(path).describe()
    names = list(read_entries(path, StripFile, MAX_BYTES).detectors)
    return {**read_line(path, names[0]).describe(), "detectors": ", ".join(names)}


def line_files(path: Path) -> list[Path]:
    """Return the file of a line camera, and those that it names; faults in them are reported when they are read."""
    if path.suffix.lower() != ".toml":
        return [path]
    try:
        strip = read_entries(path, StripFile, MAX_BYTES)
    except InputError:
        return [path]
    tables = dict.fromkeys(each.table for each in strip.detectors.values() if each.table is not None)
    return [path, *(path.parent / name for name in (strip.flight.file, *tables))]


def is_line(path: Path) -> bool:
    """Return whether a file states a line camera; a file that cannot be read does not."""
    kind = path.suffix.lower()
    try:
        if kind == ".toml":
            return MARK in read_head(path)
        if kind == ".xml":
            return read_xml(path, MAX_BYTES).find(_MODEL) is not None
        return kind in LINE_FORMATS and "line_scan_rate" in read_json(path, MAX_BYTES)
    except (InputError, TypeError):
        return False


_Row = tuple[Number, Number, Number, Number, Number, Number]
_Triangle = Annotated[tuple[Number, ...], Field(min_length=21, max_length=21)]


class _SplineEntries(Entry):
    """``[spline]``: coefficients of uniform cubic splines."""

    first: Number
    step: Positive
    coefficients: Annotated[tuple[_Row, ...], Field(min_length=4, max_length=1_000_000)]
    sigma: tuple[_Row, ...] | None = None


class _AccuracyEntries(Entry):
    """``[accuracy]``: how exactly the corrected trajectory is known."""

    times: Annotated[tuple[Number, ...], Field(min_length=1, max_length=100_000)]
    covariance: Annotated[tuple[_Triangle, ...], Field(min_length=1, max_length=100_000)]


#: Standard deviations beyond which nothing is known of a trajectory, metres and radians.
_MOST = np.repeat([1e6, 1.0], 3)
#: What is larger is no error of a mount but another mount, which belongs into the strip.
_SmallTurn = Annotated[Number, Field(ge=-10.0, le=10.0)]


class CorrectionFile(Entry):
    """A whole file."""

    format: Literal["photoplan line correction 1"]
    boresight_deg: tuple[_SmallTurn, _SmallTurn, _SmallTurn] = (0.0, 0.0, 0.0)
    lever_arm_m: Triple = (0.0, 0.0, 0.0)
    time_offset_s: Number = 0.0
    covariance: Annotated[tuple[Number, ...], Field(max_length=28)] | None = None
    """Covariances of boresight, lever arm and time offset in these units: the lower triangle by rows, 28 numbers."""
    spline: _SplineEntries | None = None
    accuracy: _AccuracyEntries | None = None


def read_pose_errors(path: Path) -> PoseErrors | None:
    """Return the standard deviations of a corrected trajectory; None if the file does not state them."""
    found = read_entries(path, CorrectionFile, MAX_BYTES).accuracy
    if found is None:
        return None
    when, C = np.array(found.times), np.zeros((len(found.times), 6, 6))
    if len(found.covariance) != len(when) or not (np.diff(when) > 0).all():
        raise InputError(
            f"{path}: [accuracy]: {len(when)} times, {len(found.covariance)} rows; needed is a row for "
            "each, later and later"
        )
    row, column = np.tril_indices(6)
    C[:, row, column] = C[:, column, row] = np.array(found.covariance)
    C *= _units()[:, None] * _units()
    sigma = np.sqrt(np.maximum(np.diagonal(C, axis1=1, axis2=2), 0.0))
    bad = np.flatnonzero(
        (np.linalg.eigvalsh(C / np.maximum(sigma[:, :, None] * sigma[:, None], 1e-300))[:, 0] < -1e-3)
        | (sigma > _MOST).any(axis=1)
    )
    if len(bad):
        raise InputError(
            f"{path}: [accuracy]: row {bad[0] + 1} is no covariance of a trajectory; `photoplan adjust` writes it"
        )
    return PoseErrors(when, C)


def read_line_correction(path: Path) -> LineCorrection:
    """Corrections of a trajectory."""
    found = read_entries(path, CorrectionFile, MAX_BYTES)
    spline = None
    if found.spline is not None:
        values = np.array(found.spline.coefficients) * _units()
        try:
            spline = TrackSpline(found.spline.first, found.spline.step, values)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    return LineCorrection(np.radians(found.boresight_deg), np.array(found.lever_arm_m), found.time_offset_s, spline)


def line_correction_text(
    found: LineCorrection, covariance: Floats | None, sigma: Floats | None, errors: PoseErrors | None = None
) -> str:
    """The file."""
    lines = [
        'format = "photoplan line correction 1"',
        "# About x (along the flight), y (to the left) and z (up) of the camera; degrees.",
        f"boresight_deg = {_list(np.degrees(found.boresight))}",
        "# Added to the way from the recorded point to the projection centre, along the same axes; metres.",
        f"lever_arm_m = {_list(found.lever_arm)}",
        "# Added to the times of the flight's record; seconds.",
        f"time_offset_s = {found.time_offset!r}",
    ]
    if covariance is not None:
        unit = np.repeat([180.0 / np.pi, 1.0, 1.0], [3, 3, 1])
        lines.append("# Lower triangle by rows, of these seven.")
        lines.append(f"covariance = {_list((covariance * np.outer(unit, unit))[np.tril_indices(7)], 9)}")
    if found.spline is not None:
        lines += [
            "",
            "# Cubic splines: coefficients from `first` (seconds from the image's own zero) every `step` seconds;",
            "# east, north, up of the flight's middle (metres), then small rotations about x, y, z (degrees).",
            "[spline]",
            f"first = {found.spline.first!r}",
            f"step = {found.spline.step!r}",
            *_table("coefficients", found.spline.coefficients / _units(), 12),
        ]
        if sigma is not None and np.isfinite(sigma).all():
            lines += _table("sigma", sigma / _units(), 4)
    if errors is not None and np.isfinite(errors.covariance).all():
        row, column = np.tril_indices(6)
        lines += [
            "",
            "# How exactly the corrected trajectory is known: at times (seconds from the image's own zero), the",
            "# covariance of east, north, up (metres) and small rotations about x, y, z (degrees); lower triangles.",
            "[accuracy]",
            f"times = {_list(errors.times)}",
            *_table("covariance", (errors.covariance / (_units()[:, None] * _units()))[:, row, column], 6),
        ]
    return "\n".join(lines) + "\n"


def _units() -> Floats:
    return np.repeat([1.0, np.pi / 180.0], 3)


def _table(name: str, rows: Floats, digits: int) -> list[str]:
    return [f"{name} = [", *(f"    {_list(row, digits)}," for row in rows), "]"]


def _list(values: Floats, digits: int = 15) -> str:
    return "[" + ", ".join(repr(float(f"{v:.{digits}g}")) for v in values) + "]"
