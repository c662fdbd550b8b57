"""A lens that is two polynomials of third degree."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.lenses.inverse import newton_inverse
from photoplan.errors import InputError

#: Exponents of x and y of the terms, in their order.
_TERMS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
Ten = tuple[float, ...]


@dataclass(frozen=True)
class Cubic:
    """x' and y' as sums of 1, x, y, x², x y, y², x³, x² y, x y², y³, each with ten coefficients; tangents, y up."""

    x: Ten
    y: Ten

    def __post_init__(self) -> None:
        if len(self.x) != len(_TERMS) or len(self.y) != len(_TERMS):
            raise InputError(
                f"{len(self.x)} and {len(self.y)} coefficients of cubic polynomials; ten and ten are needed"
            )
        if not all(math.isfinite(v) for v in chain(self.x, self.y)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")

    @classmethod
    def from_y_down(cls, c: float, x: Ten, y: Ten) -> Cubic:
        """From coefficients that act on coordinates in the unit of the camera constant `c`, with y down."""
        scale = [c ** (i + j - 1) * (-1) ** j for i, j in _TERMS]
        return cls(tuple(v * s for v, s in zip(x, scale)), tuple(-v * s for v, s in zip(y, scale)))

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        terms = np.stack([t[..., 0] ** i * t[..., 1] ** j for i, j in _TERMS], axis=-1)
        return np.asarray(terms @ np.array([self.x, self.y]).T)

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method; NaN where there is no solution."""
        t = np.asarray(t, float)
        return newton_inverse(self.distort, self.jacobian, t, t)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        x, y = t[..., 0], t[..., 1]
        by_x = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in _TERMS], axis=-1)
        by_y = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in _TERMS], axis=-1)
        A = np.array([self.x, self.y]).T
        return np.stack([by_x @ A, by_y @ A], axis=-1)
