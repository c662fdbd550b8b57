"""Other readings of the same orientation numbers: units, rotation orders, axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.rotation import ROTATION_ORDERS, rotation_from_angles

__all__ = ["DECLARED", "Reading", "readings"]

#: Factor from the declared unit to the true one, and what that means.
UNITS = {
    "gon": (0.9, "gon that were declared as degrees; declare --angle-unit gon"),
    "rad": (180.0 / np.pi, "radians that were declared as degrees; declare --angle-unit rad"),
    "gon to deg": (1 / 0.9, "degrees that were declared as gon; declare --angle-unit deg"),
    "rad to deg": (
        np.pi / 180.0,
        "degrees that were declared as radians; declare --angle-unit deg",
    ),
}


@dataclass(frozen=True)
class Reading:
    """One way to read three angles and a projection centre."""

    unit: str | None = None
    """Key of `UNITS`; None: as declared."""
    order: str | None = None
    """Rotation order; None: as declared."""
    transposed: bool = False
    """The matrix takes ground to camera."""
    camera_flipped: bool = False
    """The camera's axes are y down, z forwards."""
    ground_flipped: bool = False
    """The ground's axes are Y south, Z down."""
    swapped: bool = False
    """X and Y of the projection centre are exchanged."""

    @property
    def changes(self) -> int:
        """Differences from the declared reading."""
        return sum(
            (
                self.unit is not None,
                self.order is not None,
                self.transposed,
                self.camera_flipped,
                self.ground_flipped,
                self.swapped,
            )
        )

    @property
    def sentence(self) -> str:
        """What the user would have to declare or repair."""
        parts = []
        if self.unit is not None:
            parts.append(f"the angles look like {UNITS[self.unit][1]}")
        if self.order is not None:
            parts.append(f"the rotation order looks like {self.order}; declare --rotation {self.order}")
        if self.transposed:
            parts.append("the rotation looks like ground to camera; declare --rotation-direction ground-to-camera")
        if self.camera_flipped:
            parts.append("the camera's axes look like y down, z forwards, as in computer vision")
        if self.ground_flipped:
            parts.append("omega looks turned by 180°, as for ground axes Y south, Z down")
        if self.swapped:
            parts.append("X and Y of the projection centres look exchanged")
        return "; ".join(parts)

    def apply(
        self, center: NDArray[np.float64], angles: NDArray[np.float64], order: str
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Projection centre (3,) and R_ground_camera (3, 3) of declared numbers (radians) under this reading."""
        if self.unit is not None:
            angles = angles * UNITS[self.unit][0]
        if self.order is not None:
            # An angle keeps its axis; only the sequence of rotations changes.
            named = dict(zip(order, angles))
            order, angles = self.order, np.array([named[letter] for letter in self.order])
        R = rotation_from_angles(angles, order)
        if self.transposed:
            R = R.T
        if self.camera_flipped:
            R = R * (1.0, -1.0, -1.0)
        if self.ground_flipped:
            R = np.array([[1.0], [-1.0], [-1.0]]) * R
        return (center[[1, 0, 2]] if self.swapped else center), R


DECLARED = Reading()


def readings(order: str) -> list[Reading]:
    """All readings with one change, then those with two; `order` is the declared one."""
    others = [o for o in ROTATION_ORDERS if o != order]
    units = list(UNITS)
    one = [Reading(unit=u) for u in units]
    one += [Reading(transposed=True), Reading(camera_flipped=True), Reading(ground_flipped=True), Reading(swapped=True)]
    one += [Reading(order=o) for o in others]
    two = [Reading(unit=u, order=o) for u in units for o in others]
    two += [Reading(unit=u, transposed=True) for u in units]
    two += [Reading(unit=u, camera_flipped=True) for u in units] + [Reading(unit=u, ground_flipped=True) for u in units]
    two += [Reading(order=o, transposed=True) for o in others]
    two += [Reading(order=o, camera_flipped=True) for o in others]
    two += [Reading(transposed=True, camera_flipped=True), Reading(transposed=True, ground_flipped=True)]
    return one + two
