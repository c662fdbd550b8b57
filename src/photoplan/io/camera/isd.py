"""Entries of support data of the Community Sensor Model (ISD, JSON), whatever the kind of camera.

Names and meaning are those of the USGS's tools (ale, usgscsm; public domain). Positions and attitudes are those of an
inertial frame, the body turns in it by a table of its own. Quaternions are scalar first and lead from the inertial
frame to the camera and to the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.pose import between, odd_step, quaternions, times

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
    """Where detectors lie, in lines and samples of the whole detector from its outer corner, each (2,)."""

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
        """Whether an entry (a.b) is there."""
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
        """How many lines or samples ("line", "sample") of the detector are one of the image."""
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
