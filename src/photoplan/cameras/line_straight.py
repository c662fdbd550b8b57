"""A line camera on a flight that is straight and even and does not turn: what turbulent ones are compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.line_look import LineLook
from photoplan.geometry.body import BodyGround
from photoplan.kernels.straight import seen_straight

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StraightFlight:
    """An image of one detector line that is carried on evenly; a `Projection`."""

    look: LineLook
    ground: BodyGround
    lines: int
    """Rows of the image."""
    middle: float
    """Row at which it is at `place`."""
    place: _Floats
    """Projection centre there, in the axes of the body, (3,), metres."""
    speed: _Floats
    """How it moves on from row to row, (3,), metres."""
    R: _Floats
    """From camera axes to those of the body, (3, 3)."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.look.columns, self.lines

    field: ClassVar[None] = None
    """All is in the first factor."""
    breaks: ClassVar[None] = None
    """It is smooth."""

    def seen(self, P: _Floats) -> _Floats:
        """Positions (n, 2) of points (n, 3) in the axes of the body; NaN behind the camera. Rows may be any."""
        d, out = np.ascontiguousarray((P - self.place) @ self.R), np.empty((len(P), 2))
        coefficients = np.ascontiguousarray(self.look.coefficients)
        seen_straight(d, self.speed @ self.R, (coefficients, *self.look.span, sum(self.look.ends) / 2), out)
        out[:, 1] += self.middle
        return out

    def project_homogeneous(self, XYZ: ArrayLike) -> _Floats:
        """See `LineCamera.project_homogeneous`."""
        XYZ = np.asarray(XYZ, float)
        P = self.ground(XYZ).reshape(-1, 3)
        xy = self.seen(P)
        w = np.ones(len(P))
        if self.look.is_wide:
            w = (P - self.place - (xy[:, 1:] - self.middle) * self.speed) @ self.R[:, 2]
        w[np.isnan(xy[:, 0])] = np.nan
        return np.column_stack([xy * w[:, None], w]).reshape(XYZ.shape)
