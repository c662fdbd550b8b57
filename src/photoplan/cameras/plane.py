"""Plane transformations between image plane and pixels: affine and bilinear."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import GeometryError, InputError, UsageError


def _affine(xy: ArrayLike, a: tuple[float, float, float, float, float, float]) -> NDArray[np.float64]:
    """Points (..., 2) by a1 to a6 of an affine transformation."""
    xy = np.asarray(xy, float)
    x, y, out = xy[..., 0], xy[..., 1], np.empty_like(xy)
    out[..., 0] = a[0] * x + a[1] * y + a[2]
    out[..., 1] = a[3] * x + a[4] * y + a[5]
    return out


@dataclass(frozen=True)
class Affine2D:
    """x' = a1 x + a2 y + a3, y' = a4 x + a5 y + a6 (Ecker 1991, eq. 4.2; Behr 1989, eq. 5.2).

    `f @ g` is g followed by f (with a bilinear g: Ecker 1991, appendix A), `~f` the inverse.
    """

    a1: float
    a2: float
    a3: float
    a4: float
    a5: float
    a6: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")
        if self.determinant == 0.0:
            raise GeometryError(f"{self!r} maps the plane onto a line; its inverse does not exist")

    @property
    def determinant(self) -> float:
        """a1 a5 − a2 a4; negative where one system has y up and the other y down."""
        return self.a1 * self.a5 - self.a2 * self.a4

    def __call__(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Transform points, shapes (..., 2)."""
        return _affine(xy, (self.a1, self.a2, self.a3, self.a4, self.a5, self.a6))

    def inverse(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Points back, shapes (..., 2)."""
        return _affine(xy, self._inverted)

    def derivative(self, xy: ArrayLike) -> NDArray[np.float64]:
        """∂(x', y') / ∂(x, y), shape (..., 2, 2)."""
        J = np.array([[self.a1, self.a2], [self.a4, self.a5]])
        return np.broadcast_to(J, (*np.shape(xy), 2))

    @property
    def _inverted(self) -> tuple[float, float, float, float, float, float]:
        """a1 to a6 of the inverse."""
        d = self.determinant
        a1, a2, a4, a5 = self.a5 / d, -self.a2 / d, -self.a4 / d, self.a1 / d
        return a1, a2, -(a1 * self.a3 + a2 * self.a6), a4, a5, -(a4 * self.a3 + a5 * self.a6)

    def __invert__(self) -> Affine2D:
        return Affine2D(*self._inverted)

    def __matmul__(self, other: Affine2D | Bilinear2D) -> Affine2D | Bilinear2D:
        first, second = (self.a1, self.a2, self.a3), (self.a4, self.a5, self.a6)
        if isinstance(other, Bilinear2D):
            g, h = astuple(other)[:4], astuple(other)[4:]
            x, y = ([p * u + q * v for u, v in zip(g, h)] for p, q, _ in (first, second))
            x[3] += self.a3
            y[3] += self.a6
            return Bilinear2D(*x, *y)
        if isinstance(other, Affine2D):
            g, h = astuple(other)[:3], astuple(other)[3:]
            x, y = ([p * u + q * v for u, v in zip(g, h)] for p, q, _ in (first, second))
            x[2] += self.a3
            y[2] += self.a6
            return Affine2D(*x, *y)
        return NotImplemented


@dataclass(frozen=True)
class Bilinear2D:
    """x' = b1 x + b2 y + b3 x y + b4, y' = b5 x + b6 y + b7 x y + b8 (Ecker 1991, eq. 4.3).

    Invertible where its determinant keeps the sign that it has at x = y = 0, so the origin should lie in the image.
    The inverse is not bilinear: it is the method `inverse`, there is no `~`.
    """

    b1: float
    b2: float
    b3: float
    b4: float
    b5: float
    b6: float
    b7: float
    b8: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")
        if self.determinant == 0.0:
            raise GeometryError(f"{self!r} is singular at x = y = 0; the origin must lie inside the image")

    @property
    def determinant(self) -> float:
        """Determinant of the derivative at the origin; negative where one system has y up and the other y down."""
        return self.b1 * self.b6 - self.b2 * self.b5

    def __call__(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Transform points, shapes (..., 2)."""
        xy = np.asarray(xy, float)
        x, y = xy[..., 0], xy[..., 1]
        out = np.empty_like(xy)
        out[..., 0] = self.b1 * x + (self.b2 + self.b3 * x) * y + self.b4
        out[..., 1] = self.b5 * x + (self.b6 + self.b7 * x) * y + self.b8
        return out

    def inverse(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Points back, shapes (..., 2), in closed form; NaN where no point of the origin's sheet is mapped there."""
        xy = np.asarray(xy, float)
        u, v = xy[..., 0] - self.b4, xy[..., 1] - self.b8
        # Eliminating y (or x) leaves A x² + B x + C = 0. Its discriminant is the squared determinant of the derivative,
        # so the root with the origin's sign lies on the origin's sheet; this form of it also holds for A = 0.
        d = self.determinant
        mixed = self.b7 * u - self.b3 * v
        sign = math.copysign(1.0, d)
        with np.errstate(all="ignore"):
            out = np.empty_like(xy)
            C = self.b6 * u - self.b2 * v
            B = mixed - d
            out[..., 0] = 2.0 * C / (sign * np.sqrt(B * B - 4.0 * (self.b3 * self.b5 - self.b1 * self.b7) * C) - B)
            C = self.b5 * u - self.b1 * v
            B = mixed + d
            out[..., 1] = 2.0 * C / (-sign * np.sqrt(B * B - 4.0 * (self.b3 * self.b6 - self.b2 * self.b7) * C) - B)
        return out

    def derivative(self, xy: ArrayLike) -> NDArray[np.float64]:
        """∂(x', y') / ∂(x, y), shape (..., 2, 2)."""
        xy = np.asarray(xy, float)
        x, y = xy[..., 0], xy[..., 1]
        J = np.empty((*xy.shape, 2))
        J[..., 0, 0] = self.b1 + self.b3 * y
        J[..., 0, 1] = self.b2 + self.b3 * x
        J[..., 1, 0] = self.b5 + self.b7 * y
        J[..., 1, 1] = self.b6 + self.b7 * x
        return J

    def __matmul__(self, other: Affine2D) -> Bilinear2D:
        """An affine transformation followed by this one, where that is bilinear again: axes kept or exchanged."""
        if isinstance(other, Bilinear2D):
            raise UsageError("two bilinear transformations in succession are not bilinear (Ecker 1991, eq. A.8)")
        if not isinstance(other, Affine2D):
            return NotImplemented
        a = other
        if a.a1 * a.a4 != 0.0 or a.a2 * a.a5 != 0.0:
            raise UsageError("a bilinear transformation after a rotation or shear is not bilinear")
        rows = []
        for p, q, m, s in (astuple(self)[:4], astuple(self)[4:]):
            rows += [
                p * a.a1 + q * a.a4 + m * (a.a1 * a.a6 + a.a3 * a.a4),
                p * a.a2 + q * a.a5 + m * (a.a2 * a.a6 + a.a3 * a.a5),
                m * (a.a1 * a.a5 + a.a2 * a.a4),
                p * a.a3 + q * a.a6 + m * a.a3 * a.a6 + s,
            ]
        return Bilinear2D(*rows)
