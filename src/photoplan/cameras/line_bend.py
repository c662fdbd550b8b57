"""What of a line's directions depends on the distance from the axis, alike on either side of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LineBend:
    """Odd powers of the distance r from the axis: r (a + b r²). Where the line passes the axis it has a kink."""

    place: _Floats
    """Where column 0 lies in the focal plane, (2,)."""
    step: _Floats
    """From column to column, (2,)."""
    a: _Floats
    """Tangents (2,) in the unit of distance."""
    b: _Floats
    """Tangents (2,) in its third power."""

    def __call__(self, column: _Floats) -> _Floats:
        """Tangents (n, 2) of columns (n,)."""
        r = np.linalg.norm(self.place + column[:, None] * self.step, axis=1)[:, None]
        return np.asarray(r * (self.a + self.b * r**2))

    def slope(self, column: _Floats) -> _Floats:
        """Their change (n, 2) from column to column; none in the kink itself."""
        at = self.place + column[:, None] * self.step
        r = np.linalg.norm(at, axis=1)
        with np.errstate(invalid="ignore"):
            change = np.where(r > 0, at @ self.step / r, 0.0)
        return np.asarray(change[:, None] * (self.a + 3 * self.b * r[:, None] ** 2))
