"""Other readings of the same orientation numbers: units, rotation orders, axes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.rotation import ANGLE_UNITS, ROTATION_ORDERS, rotation_from_angles

#: What units are called.
NAMES = {"deg": "degrees", "gon": "gon", "rad": "radians"}
#: True and declared units that are thought of, by the project's. `photoplan init` writes tables of gon and radians in
#: degrees, so what was declared there may have been any.
_UNITS = {
    "deg": (("gon", "deg"), ("rad", "deg"), ("deg", "gon"), ("deg", "rad")),
    "gon": (("rad", "gon"), ("deg", "gon")),
    "rad": (("gon", "rad"), ("deg", "rad")),
}


@dataclass(frozen=True)
class OtherReading:
    """One way to read three angles and a projection centre."""

    unit: str | None = None
    """Unit that the numbers are in, a key of `ANGLE_UNITS`; None: as declared."""
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
    declared: str = "deg"
    """Unit that is declared."""

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

    def sentence(self, mirrored: bool = False) -> str:
        """Say what the user would have to declare or repair; `mirrored`: the scan is stated to be mirrored.

        A film that was scanned the right way round but whose marks run the other way, with angles that look up, is
        described with the scene at z > 0: turning the angles alone would mirror the ground.
        """
        if mirrored and (self.camera_flipped or self.ground_flipped):
            scene = (
                "the orientation looks like one with the scene at z > 0, whose marks and angles both run the other "
                'way; set `scene = "z > 0"` under [orientation] and remove `mirrored` from the camera'
            )
            return "; ".join([*replace(self, camera_flipped=False, ground_flipped=False)._parts(), scene])
        return "; ".join(self._parts())

    def _parts(self) -> list[str]:
        parts = []
        if self.unit is not None:
            parts.append(
                f"the angles look like {NAMES[self.unit]} that were declared as {NAMES[self.declared]}; "
                f"declare `angle_unit` {self.unit}"
            )
        if self.order is not None:
            parts.append(f"the rotation order looks like {self.order}; declare `rotation` {self.order}")
        if self.transposed:
            parts.append("the rotation looks like ground to camera; declare `rotation_direction` ground-to-camera")
        if self.camera_flipped:
            parts.append("the camera's axes look like y down, z forwards, as in computer vision")
        if self.ground_flipped:
            parts.append("omega looks turned by 180°, as for ground axes Y south, Z down")
        if self.swapped:
            parts.append("X and Y of the projection centres look exchanged")
        return parts

    def apply(
        self, center: NDArray[np.float64], angles: NDArray[np.float64], order: str
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Projection centre (3,) and R_ground_camera (3, 3) of declared numbers (radians) under this reading."""
        if self.unit is not None:
            angles = angles * (ANGLE_UNITS[self.declared] / ANGLE_UNITS[self.unit])
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


DECLARED = OtherReading()


def readings(order: str, unit: str = "deg") -> list[OtherReading]:
    """All readings with one change, then those with two; `order` and `unit` are those of the project."""
    others = [o for o in ROTATION_ORDERS if o != order]
    units = [partial(OtherReading, unit=true, declared=stated) for true, stated in _UNITS[unit]]
    one = [made() for made in units]
    one += [OtherReading(transposed=True), OtherReading(camera_flipped=True)]
    one += [OtherReading(ground_flipped=True), OtherReading(swapped=True)]
    one += [OtherReading(order=o) for o in others]
    two = [made(order=o) for made in units for o in others]
    two += [made(transposed=True) for made in units]
    two += [made(camera_flipped=True) for made in units] + [made(ground_flipped=True) for made in units]
    two += [OtherReading(order=o, transposed=True) for o in others]
    two += [OtherReading(order=o, camera_flipped=True) for o in others]
    two += [OtherReading(transposed=True, camera_flipped=True), OtherReading(transposed=True, ground_flipped=True)]
    return one + two
