"""The profile of an ideal edge seen through Gaussian optics and square pixels, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

#: A side of the pixel shorter than this, seen along the edge, is replaced by its variance (an error below 1e-13).
SHORT_SIDE = 1e-3
#: Narrowest Gaussian in pixels: keeps derivatives finite when a sharpened edge rises faster than one pixel allows.
LEAST_BLUR = 0.05


@dataclass(frozen=True)
class PixelEdge:
    """Half plane ⊗ Gaussian ⊗ square pixel, across the edge: a Gaussian and boxes |cos| and |sin| of the angle wide.

    Seen across an edge, the unit square of a pixel is a trapezoid, the convolution of both boxes. Integrals of the
    normal distribution give edge profile, line spread function and their derivatives without any sampling.
    """

    blur: float
    """Standard deviation of the Gaussian, pixels."""
    angle: float
    """Angle between the normal of the edge and the columns' axis, radians."""

    @property
    def sides(self) -> tuple[float, float]:
        """Widths of both boxes, pixels, the wider one first."""
        sides = sorted((abs(cos(self.angle)), abs(sin(self.angle))), reverse=True)
        return sides[0], sides[1]

    @property
    def total(self) -> float:
        """Standard deviation of the whole line spread function, pixels: Gaussian and pixel, which add 1/12."""
        return sqrt(self.blur**2 + 1.0 / 12.0)

    def profile(
        self, distance: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Edge profile from 0 to 1, line spread function and its derivative at distances in pixels, same shape."""
        wide, narrow = self.sides
        if narrow < SHORT_SIDE:
            blur = sqrt(self.blur**2 + narrow**2 / 12.0)
            lower, upper = _integrals(distance - wide / 2, blur), _integrals(distance + wide / 2, blur)
            slope = (_density(distance + wide / 2, blur) - _density(distance - wide / 2, blur)) / wide
            return (upper[1] - lower[1]) / wide, (upper[0] - lower[0]) / wide, slope
        outer, inner = (wide + narrow) / 2, (wide - narrow) / 2
        terms = [_integrals(distance + shift, self.blur) for shift in (outer, inner, -inner, -outer)]
        rise = [(t[0] - t[1] - t[2] + t[3]) / (wide * narrow) for t in zip(*terms)]
        return rise[2], rise[1], rise[0]

    def transfer(self, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transfer function at cycles per pixel along the normal, same shape, real: it is symmetric."""
        wide, narrow = self.sides
        gaussian = np.exp(-2.0 * (pi * self.blur * frequency) ** 2)
        return np.asarray(gaussian * np.sinc(frequency * wide) * np.sinc(frequency * narrow))


def _density(x: NDArray[np.float64], blur: float) -> NDArray[np.float64]:
    return np.asarray(np.exp(-0.5 * (x / blur) ** 2) / (blur * sqrt(2.0 * pi)))


def _integrals(x: NDArray[np.float64], blur: float) -> tuple[NDArray[np.float64], ...]:
    """The normal distribution function, its integral and its second integral."""
    share, density = ndtr(x / blur), blur**2 * _density(x, blur)
    return share, x * share + density, 0.5 * ((x * x + blur * blur) * share + x * density)
