"""Images with a camera and a pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, Strict, model_validator

from photoplan.errors import InputError
from photoplan.geometry.rotation import ANGLE_UNITS
from photoplan.io.camera.model import CameraEntry, Fiducials, Name, NotNegative, Triple
from photoplan.io.project.image import Deviation, ImageEntry

#: Metres (or units of an angle or a camera's parameter) beyond which a standard deviation says nothing.
_MOST_DEVIATION = 1e6
_ANGLES = {"o": "omega", "p": "phi", "k": "kappa"}

Correlation = tuple[Annotated[float, Strict(), Field(ge=-1, le=1)], ...]


def turned_angles(angles: Sequence[float], unit: str, order: str) -> Triple:
    """Return angles of a camera system that is turned by half a circle about its x axis, within half a circle.

    Half a turn about x adds to ω, and reverses the sense of the rotations between ω and the camera.
    """
    half = ANGLE_UNITS[unit] / 2
    turned = [round(sign * angle, 12) + 0.0 for sign, angle in zip(_senses(order), angles)]
    at = order.index("o")
    turned[at] = round(angles[at] - half if angles[at] > 0 else angles[at] + half, 12) + 0.0
    return (turned[0], turned[1], turned[2])


def _senses(order: str) -> list[float]:
    """Return −1 for each angle whose sense half a turn of the camera about x reverses, else 1."""
    return [-1.0 if k > order.index("o") else 1.0 for k in range(3)]


def turned_correlation(correlation: Sequence[float], order: str, camera: CameraEntry) -> tuple[float, ...]:
    """Return the correlations after `turned_angles`: those of reversed angles and of what is odd in x change sign."""
    signs = [1.0, 1.0, 1.0, *_senses(order)]
    signs += [-1.0 if name in camera.odd_in_x else 1.0 for name in camera.sigma or {}]
    size = int((1 + np.sqrt(1 + 8 * len(correlation))) / 2)
    if size > len(signs):
        raise InputError(f"correlation has {len(correlation)} numbers, more than orientation and camera have")
    pairs = zip(*np.tril_indices(size, -1))
    return tuple(float(r * signs[i] * signs[j]) for r, (i, j) in zip(correlation, pairs))


class Image(ImageEntry):
    """One image with a pose: oriented, or to be oriented."""

    camera: Name
    center: Triple | None = None
    """Projection centre X0, Y0, Z0 in the project's CRS and the orientation's height system, metres; None: the image
    is not oriented yet."""
    angles: Triple | None = None
    """Three angles in the sequence and unit that [orientation] states."""
    sigma_center: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """Standard deviations of the projection centre, metres, as `photoplan adjust` and `resect` found them."""
    sigma_angles: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """Standard deviations of the angles, in their unit."""
    correlation: Correlation | None = None
    """The correlation matrix of centre, angles and, after a calibration, what `sigma` of the camera lists, below its
    diagonal, row by row; None: they are not correlated."""
    approximate: Annotated[bool, Strict()] | None = None
    """Whether center and angles are initial values that `photoplan adjust` could not improve: products leave the image
    out."""
    fiducials: Fiducials | None = None
    """Measured fiducial marks of a film scan: name = [column, row], pixels."""

    @model_validator(mode="after")
    def _both(self) -> Self:
        if (self.center is None) != (self.angles is None):
            raise ValueError("center and angles go together: give both, or none for an image that is not oriented")
        if self.correlation is not None and (self.sigma_center is None or self.sigma_angles is None):
            raise ValueError("correlation goes with sigma_center and sigma_angles")
        return self

    @property
    def geometry_file(self) -> None:
        """Its geometry stands in the project."""
        return None

    @property
    def described_by(self) -> str:
        """Its camera."""
        return self.camera

    def deviations(self, cameras: Mapping[str, CameraEntry], rotation: str) -> tuple[Deviation, ...]:
        """See `ImageEntry.deviations`: of centre, angles and camera."""
        if self.sigma_center is None or self.sigma_angles is None:
            raise InputError(
                f"image {self.name!r}: nothing is known of the accuracy of its orientation; `photoplan adjust` and "
                "`resect` write sigma_center and sigma_angles, or state them in [[images]]"
            )
        of_camera = cameras[self.camera].sigma or {}
        sigma = np.array([*self.sigma_center, *self.sigma_angles, *of_camera.values()])
        if sigma.max() > _MOST_DEVIATION:
            raise InputError(
                f"image {self.name!r}: a standard deviation of {sigma.max():.3g} in orientation or camera is no "
                "accuracy"
            )
        names = ["X0", "Y0", "Z0", *(_ANGLES[letter] for letter in rotation), *(f"camera {name}" for name in of_camera)]
        R, joined = self._correlations(len(of_camera))
        values, axes = np.linalg.eigh(R)
        if joined and values[0] < -1e-3:
            raise InputError(f"image {self.name!r}: correlation is that of no covariance; `photoplan adjust` writes it")
        together = "orientation" if joined <= 6 else "orientation and camera"
        largest = np.abs(axes).argmax(axis=0)
        return tuple(
            (together if k < joined else names[k], axis * np.sqrt(max(value, 0.0)) * sigma)
            for k, value, axis in zip(largest.tolist(), values, axes.T)
        )

    def _correlations(self, of_camera: int) -> tuple[NDArray[np.float64], int]:
        """Correlation matrix of centre, angles and so many parameters of the camera; how many first ones it states."""
        size, given = 6 + of_camera, np.array(self.correlation or (), float)
        joined = {0: 0, 15: 6, size * (size - 1) // 2: size}.get(len(given))
        if joined is None:
            raise InputError(
                f"image {self.name!r}: correlation has {len(given)} numbers; 15 for centre and angles, or "
                f"{size * (size - 1) // 2} for them and the {of_camera} parameters of its camera"
            )
        R = np.eye(size)
        R[:joined, :joined][np.tril_indices(joined, -1)] = given
        return np.tril(R) + np.tril(R, -1).T, joined

    def moved(
        self, change: NDArray[np.float64], cameras: Mapping[str, CameraEntry]
    ) -> tuple[Image, Mapping[str, CameraEntry]]:
        """See `ImageEntry.moved`."""
        camera = cameras[self.camera]
        center, angles = (np.array(part) for part in self.pose_numbers)
        update = {"center": tuple(center + change[:3]), "angles": tuple(angles + change[3:6])}
        by_name = dict(zip(camera.sigma or {}, change[6:].tolist()))
        return self.model_copy(update=update), {**cameras, self.camera: camera.moved(by_name, self.camera)}

    def scene_turned(self, unit: str, order: str, camera: CameraEntry) -> Image:
        """Return the image with its angles for a scene on the other side of the image, see `turned_angles`."""
        update: dict[str, object] = {}
        if self.angles is not None:
            update["angles"] = turned_angles(self.angles, unit, order)
        if self.correlation:
            update["correlation"] = turned_correlation(self.correlation, order, camera)
        return self.model_copy(update=update) if update else self

    @property
    def unoriented(self) -> str | None:
        """See `ImageEntry`."""
        if self.center is None:
            return "has no orientation; `photoplan resect` or `photoplan adjust` determines it"
        return "its orientation is approximate: `photoplan adjust` could not determine it" if self.approximate else None

    @property
    def pose_numbers(self) -> tuple[Triple, Triple]:
        """Projection centre and angles as stated."""
        if self.center is None or self.angles is None:
            raise InputError(f"image {self.name!r} {self.unoriented}")
        return self.center, self.angles
