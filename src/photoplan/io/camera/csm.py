"""Support data of the Community Sensor Model (ISD, JSON): entries, lenses, and frame cameras of planetary missions.

Names and meaning are those of the USGS's tools (ale, usgscsm; public domain). Positions and attitudes are those of an
inertial frame, the body turns in it by a table of its own. Quaternions are scalar first and lead from the inertial
frame to the camera and to the body.

With u without and d with distortion in the focal plane, both in millimetres, r² = x² + y² (usgscsm, `Distortion.cpp`;
names are its own):

    radial      u = d (1 − k0 − k1 r² − k2 r⁴), r of d
    transverse  dx, dy = cubic polynomials of u with ten coefficients each, in the order of `Cubic`
    dawnfc      d = u (1 + k r²), r of u
    radtan      d / f = OpenCV's lens of u / f: k1, k2, p1, p2, k3

Cameras look along z; x and y of the focal plane, millimetres, lead to lines and samples of the detector from the outer
corner of its first pixel, so that the middle of that pixel is at 0.5. Line and sample of the image are those of the
detector less the first that was read, over how many were summed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.body_frame import BodyFrameCamera
from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses import Brown, Cubic, Lens, NoLens, OpenCV, Reversed
from photoplan.cameras.pushbroom_rays import to_sphere
from photoplan.errors import InputError
from photoplan.geometry.local import BodyGround
from photoplan.geometry.pose import FLIP, Pose, between, conjugate, cubic, odd_step, quaternions, rotations, times
from photoplan.io.files import read_json

_Floats = NDArray[np.float64]
FORM = "CSM support data (ISD)"
#: What `name_model` of frame cameras says.
FRAME_MODEL = "USGS_ASTRO_FRAME_SENSOR_MODEL"
#: An image and its tables hold no more than this.
_MAX_SIZE, _MAX_ROWS = 10_000_000, 2_000_000
#: No number of an ISD, in whatever unit, is larger.
_LARGEST = 1e30


@dataclass(frozen=True, eq=False)
class FocalPlane:
    """Positions of detectors, in lines and samples of the whole detector from its outer corner, each (2,)."""

    to_detector: _Floats
    """(x, y) in the focal plane, millimetres, to (line, sample), shape (2, 2)."""
    axis: _Floats
    """Line and sample of the optical axis."""
    first: _Floats
    """Line and sample at which the image begins."""
    focal: float
    """Focal length, millimetres."""


class Isd:
    """Entries of an ISD, checked when they are asked for."""

    def __init__(self, isd: dict[str, Any], path: Path) -> None:
        self._isd, self._path = isd, path
        lines, samples = self.numbers("image_lines", ()), self.numbers("image_samples", ())
        if not (1 <= lines <= _MAX_SIZE and 2 <= samples <= _MAX_SIZE):
            raise InputError(f"{path}: an image of {samples:g} × {lines:g} pixels")
        self.lines, self.samples = int(lines), int(samples)

    def has(self, name: str) -> bool:
        """Return whether an entry (a.b) is there."""
        return self.find(name) is not None

    def numbers(self, name: str, shape: tuple[int, ...]) -> Any:
        """Finite numbers of an entry (a.b) in a shape; −1 stands for any length."""
        found = self.find(name)
        if found is None:
            raise InputError(f"{self._path}: {name} is missing")
        try:
            values = np.array(found, float)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{self._path}: {name} is not a table of numbers") from None
        fits = values.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, values.shape))
        if not fits or not (np.abs(values) <= _LARGEST).all() or values.shape[:1] > (_MAX_ROWS,):
            raise InputError(f"{self._path}: {name} holds numbers of shape {values.shape}, or such as cannot be")
        return values if shape else float(values)

    @property
    def radii(self) -> tuple[float, float]:
        """Equatorial and polar radius, metres."""
        unit = self._unit("radii")
        a, b = (unit * self.numbers(f"radii.{name}", ()) for name in ("semimajor", "semiminor"))
        if not (0 < b <= a):
            raise InputError(f"{self._path}: radii of {a:g} and {b:g} m")
        return a, b

    @property
    def distortion(self) -> str | None:
        """Kind of the optical distortion; None: there is none."""
        kinds = self.find("optical_distortion")
        if kinds is None:
            return None
        return str(next(iter(kinds), "")) if isinstance(kinds, dict) else ""

    def coefficients(self, name: str, count: int) -> list[float]:
        """So many coefficients of the optical distortion; more or fewer have no certain meaning."""
        found = self.numbers(f"optical_distortion.{name}", (-1,))
        if len(found) != count:
            raise InputError(
                f"optical_distortion.{name} has {len(found)} numbers, not {count}: which they are is not said"
            )
        return [float(v) for v in found]

    def focal_plane(self) -> FocalPlane:
        """The focal plane."""
        rows = [self.numbers(f"focal2pixel_{name}", (3,)) for name in ("lines", "samples")]
        A = np.array([row[1:] for row in rows])
        if abs(np.linalg.det(A)) < 1e-12:
            raise InputError("focal2pixel_lines and focal2pixel_samples are parallel")
        centre = np.array([self.numbers(f"detector_center.{name}", ()) for name in ("line", "sample")])
        first = np.array([self.numbers(f"starting_detector_{name}", ()) for name in ("line", "sample")])
        focal = self.numbers("focal_length_model.focal_length", ())
        if not focal > 0:
            raise InputError(f"a focal length of {focal:g} mm")
        return FocalPlane(A, centre + [row[0] for row in rows], first, focal)

    def summing(self, name: str) -> float:
        """Return how many lines or samples ("line", "sample") of the detector are one of the image."""
        found = float(self.numbers(f"detector_{name}_summing", ()))
        if not found > 0:
            raise InputError(f"{self._path}: {found:g} {name}s of the detector in one of the image")
        return found

    def moments(self, name: str) -> _Floats:
        """Times of a table, seconds of the ephemeris; rising, in whichever direction the file states them."""
        found = self.numbers(f"{name}.ephemeris_times", (-1,))
        steps = np.diff(found)
        if len(found) < 1 or not ((steps > 0).all() or (steps < 0).all()):
            raise InputError(f"{self._path}: the times of {name} neither rise nor fall throughout")
        return np.sort(found)

    def _of_moments(self, name: str, values: _Floats) -> _Floats:
        """Rows of a table in the order of its `moments`."""
        found = self.numbers(f"{name}.ephemeris_times", (-1,))
        return values[::-1] if len(found) > 1 and found[0] > found[-1] else values

    def positions(self) -> tuple[_Floats, _Floats | None]:
        """Positions and velocities of the camera in the inertial frame, metres."""
        unit = self._unit("instrument_position")
        count = len(self.moments("instrument_position"))
        positions = self._of_moments(
            "instrument_position", unit * self.numbers("instrument_position.positions", (count, 3))
        )
        if len(positions) > 2 and (odd := odd_step(self.moments("instrument_position"), positions)) is not None:
            raise InputError(f"{self._path}: instrument_position: {odd}")
        stated = self.has("instrument_position.velocities")
        if not stated:
            return positions, None
        speeds = unit * self.numbers("instrument_position.velocities", positions.shape)
        return positions, self._of_moments("instrument_position", speeds)

    def turns(self, name: str, t: _Floats) -> _Floats:
        """Quaternions (n, 4) from the inertial frame by a table and its constant rotation, at times (n,)."""
        moments = self.moments(name)
        table = self._of_moments(name, self.numbers(f"{name}.quaternions", (len(moments), 4)))
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
        unit = self.find(f"{name}.unit")
        if unit not in (None, "km", "m"):
            raise InputError(f"{self._path}: {name} is stated in {unit!r}; km or m is known")
        return 1.0 if unit == "m" else 1000.0

    def find(self, name: str) -> Any:
        """An entry (a.b) as it stands; None: there is none."""
        found: Any = self._isd
        for word in name.split("."):
            found = found.get(word) if isinstance(found, dict) else None
        return found


def _quaternion(R: _Floats) -> _Floats:
    """The unit quaternion (4,) of a rotation matrix (3, 3), scalar first."""
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InputError("a constant rotation is none")
    return quaternions(R[None])[0]


def lens_of(isd: Isd, kind: str | None) -> tuple[float, Lens]:
    """The camera constant, millimetres, and the lens by its tangents, of one of `LENSES`; None: there is none."""
    f = isd.focal_plane().focal
    return (f, NoLens()) if kind is None else LENSES[kind](isd, f)


def not_known(kind: str, known: list[str]) -> InputError:
    """Return the error for another distortion."""
    return InputError(
        f"the distortion {kind!r} is not known; {', '.join(known)} are. Where all its coefficients are 0, or are "
        "not needed, take optical_distortion out of the file"
    )


def _radial(isd: Isd, f: float) -> tuple[float, Lens]:
    # As usgscsm reads them: the first is the constant part, and those that are not there are 0.
    found = [float(v) for v in isd.numbers("optical_distortion.radial.coefficients", (-1,))]
    if not found or any(found[3:]):
        raise InputError(
            f"optical_distortion.radial.coefficients has {len(found)} numbers; 1 to 3 are known (k0, k1, k2), and more "
            "must be 0"
        )
    k0, k1, k2 = (*found, 0.0, 0.0)[:3]
    if not k0 < 1.0:
        raise InputError(f"radial distortion with a constant part of {k0:g}")
    # The constant part changes the scale of the image, and nothing else.
    c = f / (1.0 - k0)
    lens = Brown.from_image_units(c, k=(-k1 / (1.0 - k0), -k2 / (1.0 - k0)))
    return c, Reversed(lens) if k1 or k2 else NoLens()


def _transverse(isd: Isd, f: float) -> tuple[float, Lens]:
    x, y = (tuple(isd.coefficients(f"transverse.{axis}", 10)) for axis in "xy")
    return f, Cubic.from_y_down(f, x, y)


def _dawn(isd: Isd, f: float) -> tuple[float, Lens]:
    return f, Brown.from_image_units(f, k=tuple(isd.coefficients("dawnfc.coefficients", 1)))


def _radtan(isd: Isd, f: float) -> tuple[float, Lens]:
    k1, k2, p1, p2, k3 = isd.coefficients("radtan.coefficients", 5)
    return f, OpenCV(k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)


#: Camera constant and lens of every distortion that is a lens.
LENSES: dict[str, Callable[[Isd, float], tuple[float, Lens]]] = {
    "radial": _radial,
    "transverse": _transverse,
    "dawnfc": _dawn,
    "radtan": _radtan,
}


#: Support data of a frame are small.
_MAX_BYTES = 20_000_000
#: Suffixes of support data.
SUFFIXES = (".json", ".isd")


@dataclass(frozen=True, eq=False)
class StatedFrame:
    """A frame camera with its orientation, as a file states them."""

    file: Path
    frame: FrameCamera
    """In the axes of the body."""
    radii: tuple[float, float]
    """Equatorial and polar radius of the body, metres."""
    focal: float
    """Focal length, millimetres."""
    distortion: str | None
    """Its name; None: there is none."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.frame.size

    def camera(self, crs: str, heights: str) -> BodyFrameCamera:
        """The camera over a ground; a CRS of another body is an InputError."""
        return BodyFrameCamera(self.frame, BodyGround(crs, heights, self.radii))

    def describe(self) -> dict[str, str]:
        """In words, by name."""
        x, y = self.size[0] / 2.0 - 0.5, self.size[1] / 2.0 - 0.5
        d = self.frame.rays(np.array([(x - 0.5, y), (x + 0.5, y)]))[1]
        away = float(np.linalg.norm(self.frame.center))
        return {
            "frame camera": FORM,
            "image": f"{self.size[0]} columns, {self.size[1]} lines",
            "focal length": f"{self.focal:.6g} mm, distortion {self.distortion or 'none'}",
            "directions": f"{1e6 * float(np.linalg.norm(d[1] - d[0])):.4g} µrad from column to column in the middle",
            "position": f"{away / 1000:.3f} km from the middle of the body",
            "body": f"radii {self.radii[0] / 1000:.3f} and {self.radii[1] / 1000:.3f} km",
        }


def read_frame(path: Path) -> StatedFrame:
    """The frame camera of an ISD."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: not a file of a frame camera with its orientation ({', '.join(SUFFIXES)})")
    return frame_of(read_json(path, _MAX_BYTES), path)


def is_frame(path: Path) -> bool:
    """Return whether a file states a frame camera; a file that cannot be read does not."""
    if path.suffix.lower() not in SUFFIXES:
        return False
    try:
        isd = read_json(path, _MAX_BYTES)
    except InputError:
        return False
    return isinstance(isd, dict) and isd.get("name_model") == FRAME_MODEL


def frame_of(isd: Any, path: Path) -> StatedFrame:
    """The frame camera of the contents of a file; see `read_frame`."""
    name = isd.get("name_model") if isinstance(isd, dict) else None
    if name != FRAME_MODEL:
        advice = "; state the file as `line`" if isinstance(isd, dict) and "line_scan_rate" in isd else ""
        raise InputError(f"{path}: support data of {name or 'no name_model'}, not of {FRAME_MODEL}{advice}")
    source = Isd(isd, path)
    try:
        if source.has("jitter"):
            raise InputError("its lines were exposed one after the other (jitter); such cameras are not known")
        kind = source.distortion
        if kind is not None and kind not in LENSES:
            raise not_known(kind, list(LENSES))
        c, lens = lens_of(source, kind)
        focal = source.focal_plane().focal
        frame = FrameCamera(_interior(source, c), lens, _pose(source))
        _refuse_away(frame, max(source.radii))
        distortion = kind if lens != NoLens() else None
        return StatedFrame(file=path, frame=frame, radii=source.radii, focal=focal, distortion=distortion)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def _interior(isd: Isd, c: float) -> Interior:
    """From tangents to pixels, with a camera constant in millimetres."""
    plane = isd.focal_plane()
    summing = np.array([isd.summing("line"), isd.summing("sample")])
    # Rows: line and sample. The middle of the first pixel is 0 here; y of tangents is up.
    A = plane.to_detector * (1.0, -1.0) / summing[:, None]
    line, sample = ((plane.axis - plane.first) / summing - 0.5).tolist()
    (a4, a5), (a1, a2) = A.tolist()
    return Interior(c, (0.0, 0.0), Affine2D(a1=a1, a2=a2, a3=sample, a4=a4, a5=a5, a6=line), (isd.samples, isd.lines))


def _pose(isd: Isd) -> Pose:
    """Projection centre and axes in those of the body, at the middle of the exposure."""
    t = np.array([isd.numbers("center_ephemeris_time", ())])
    for name in ("instrument_position", "instrument_pointing", "body_rotation"):
        at = isd.moments(name)
        # A single value holds always; a table only as far as it goes.
        if len(at) > 1 and not at[0] <= t[0] <= at[-1]:
            raise InputError(f"{name} is stated from {at[0]:.3f} to {at[-1]:.3f} s, the image is of {t[0]:.3f} s")
    at = isd.moments("instrument_position")
    positions, speeds = isd.positions()
    inertial = positions if len(at) == 1 else cubic(at, positions, speeds, t)
    body = isd.turns("body_rotation", t)
    center = rotations(body)[0] @ inertial[0]
    return Pose(center, rotations(times(body, conjugate(isd.turns("instrument_pointing", t))))[0] @ FLIP)


def _refuse_away(frame: FrameCamera, radius: float) -> None:
    """Refuse a camera that would see its body if it looked the other way."""
    columns, rows = (np.linspace(-0.5, side - 0.5, 9) for side in frame.size)
    S, d = frame.rays(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
    if not (to_sphere(S, d, radius) > 0).any() and (to_sphere(S, -d, radius) > 0).any():
        raise InputError(
            "the camera looks away from its body: positions and pointing are not in the same axes, or the focal plane "
            "is meant to lie behind the lens, which is not known here"
        )
