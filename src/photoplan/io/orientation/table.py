"""Exterior orientations as a file states them, before they are brought into a project."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.geometry.bounds import odd_angles, odd_place
from photoplan.geometry.pose import ANGLE_UNITS, angles_from_rotation, rotation_from_angles
from photoplan.geometry.units import agreed_metres, metric_heights, metric_system, unit_label
from photoplan.io.orientation.form import Direction

#: By the letters that spell an order of rotations.
ANGLE_NAMES = {"o": "omega", "p": "phi", "k": "kappa"}
#: From camera axes x right, y down, z forwards to x right, y up, z backwards, and back.
FLIP = np.diag([1.0, -1.0, -1.0])


def angle_in_radians(value: NDArray[np.float64], unit: str) -> NDArray[np.float64]:
    """Angles of a unit (deg, gon, rad) in radians."""
    return value * (2 * np.pi / ANGLE_UNITS[unit])


@dataclass(frozen=True)
class OrientedImage:
    """One line of an orientation table."""

    name: str
    center: tuple[float, float, float]
    """Projection centre in the table's system, in its units (metres once `read_orientation_block` returns it)."""
    angles: tuple[float, float, float]
    """Angles in the table's unit, in the sequence of its rotation order."""
    camera: str | None = None
    """Name of the camera, where the table states it."""
    line: int | None = None
    """Line in the file."""
    fiducials: dict[str, tuple[float, float]] | None = None
    """Measured fiducial marks [column, row], where the table states them."""


@dataclass(frozen=True, eq=False)
class OrientationTable:
    """All images of an orientation file and what the numbers mean."""

    file: Path
    images: tuple[OrientedImage, ...]
    angle_unit: str = "deg"
    rotation: str = "opk"
    direction: Direction = "camera-to-ground"
    crs: str | None = None
    """Horizontal CRS; None if the file does not state it."""
    crs_file: Path | None = None
    """The file that states it, where it is another one."""
    height_system: str | None = None
    """None if the file does not state it."""
    origin: tuple[float, float, float] | None = None
    """Latitude, longitude (degrees, WGS 84) and height of a local tangential system (east, north, up), where positions
    and rotations refer to one; None where they refer to `crs`."""
    true_metres: bool = False
    """Whether the poses were computed in a Cartesian system of true metres (geocentric, or about a point) and brought
    into `crs` place by place; else they were adjusted in map coordinates, whose scale and curvature they absorbed."""
    positions: NDArray[np.float64] | None = None
    """Latitude, longitude (degrees, WGS 84) and height that a receiver measured, shape (n, 3), where the file states
    them beside the poses; NaN for images without. They were not used to place the poses."""
    notes: tuple[str, ...] = ()
    """What a user should know of how the file was read."""
    map_unit: float = 1.0
    """Metres in the unit in which the file states X and Y; `in_metres` has converted them."""
    height_unit: float | None = None
    """Metres upwards in the unit of Z that the file states, converted like X and Y; None: it states no height system,
    and Z is as in the file."""

    def in_metres(self) -> OrientationTable:
        """The table with X and Y in metres, and Z too if the file states its height system."""
        if self.crs is None:
            return self
        system = metric_system(self.crs, f"{self.file}: CRS")
        heights, rise = self.height_system, None
        if heights is not None:
            heights, rise = metric_heights(heights, f"{self.file}: heights")
        if (system.scale, rise or 1.0) == (1.0, 1.0):
            return replace(self, height_unit=rise)
        factors = np.array([system.scale, system.scale, rise or 1.0])
        units = "" if system.scale == 1.0 else f"X and Y in {unit_label(system.scale)}"
        units += "" if rise is None else f"{', ' if units else ''}heights in {unit_label(rise)}"
        X, Y, Z = (np.array([image.center for image in self.images]) * factors).T.tolist()
        images = tuple(replace(image, center=center) for image, center in zip(self.images, zip(X, Y, Z)))
        return replace(
            self,
            images=images,
            crs=system.crs,
            height_system=heights,
            notes=(*self.notes, f"{self.file.name}: {units}; converted to metres"),
            map_unit=system.scale,
            height_unit=rise,
        )

    def heights_in_metres(self, declared: str | None) -> OrientationTable:
        """The table with Z in metres, by the unit that the file states, else by that of a declared height system."""
        where = f"{self.file}: heights"
        word = (declared or "same").strip().casefold()
        system = None
        if word not in ("same", "ellipsoidal"):
            system = metric_heights(declared or "", "declared height system")[1]
        if self.height_unit is not None:
            if system is not None:
                agreed_metres(abs(self.height_unit), system, where, in_one_file=False)
            return self
        if system is None and self.map_unit == 1.0:
            return self
        rise = agreed_metres(None, system, where, in_one_file=False)
        if rise == 1.0:
            return self
        images = tuple(
            replace(image, center=(image.center[0], image.center[1], image.center[2] * rise)) for image in self.images
        )
        return replace(self, images=images, height_unit=rise)

    def __post_init__(self) -> None:
        if not self.images:
            raise InputError(f"{self.file}: holds no image")
        first: dict[str, OrientedImage] = {}
        for image in self.images:
            if image.name in first:
                lines = [str(i.line) for i in (first[image.name], image) if i.line is not None]
                where = f" (lines {' and '.join(lines)})" if lines else ""
                raise InputError(f"{self.file}: image {image.name!r} is given twice{where}; keep one of them")
            first[image.name] = image
            odd = odd_angles(image.angles, self.angle_unit, [ANGLE_NAMES[letter] for letter in self.rotation])
            if odd is None and self.crs is not None:
                odd = odd_place(image.center, camera=True)
            if odd is not None:
                line = f":{image.line}" if image.line is not None else ""
                raise InputError(f"{self.file}{line}: image {image.name!r}: {odd}")

    @property
    def cartesian(self) -> bool:
        """Whether the poses are right in true metres, so that ground of the map needs `earth_curvature` strict."""
        return self.true_metres or self.origin is not None

    @cached_property
    def centers(self) -> NDArray[np.float64]:
        """Projection centres, shape (n, 3)."""
        return np.array([i.center for i in self.images], float)

    @cached_property
    def rotations(self) -> NDArray[np.float64]:
        """R_ground_camera of every image, shape (n, 3, 3), in the axes of the table's system."""
        angles = angle_in_radians(np.array([i.angles for i in self.images], float), self.angle_unit)
        R = np.stack([rotation_from_angles(a, self.rotation) for a in angles])
        return R if self.direction == "camera-to-ground" else np.swapaxes(R, 1, 2)

    def opk_degrees(self) -> NDArray[np.float64]:
        """ω, φ, κ in degrees, shape (n, 3); numbers that are already so stay untouched."""
        if (self.angle_unit, self.rotation, self.direction) == ("deg", "opk", "camera-to-ground"):
            return np.array([i.angles for i in self.images], float)
        return degrees_of(self.rotations)


def degrees_of(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """ω, φ, κ in degrees of matrices (n, 3, 3); rounded to 1e-12°, below the noise of the conversion."""
    # Adding zero turns −0.0 into 0.0.
    angles = np.array([angles_from_rotation(R) for R in rotations], np.float64)
    return np.asarray(np.round(np.degrees(angles), 12) + 0.0, np.float64)


def posed(
    name: str,
    center: ArrayLike,
    R_ground_camera: NDArray[np.float64],
    camera: str | None = None,
    line: int | None = None,
) -> OrientedImage:
    """An image whose rotation is given by a matrix (3, 3), with ω, φ, κ in degrees; `center` is X, Y, Z, metres."""
    X, Y, Z = np.asarray(center, float).tolist()
    omega, phi, kappa = degrees_of(R_ground_camera[None])[0].tolist()
    return OrientedImage(name=name, center=(X, Y, Z), angles=(omega, phi, kappa), camera=camera, line=line)
