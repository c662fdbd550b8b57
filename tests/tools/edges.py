"""Images of ideal edges, exact to rounding: half plane ⊗ spread function ⊗ square pixel, for any angle and place.

Independent of the package's own model: the pixel is integrated by Gauss' quadrature of high order, over a spread
function that is a sum of Gaussians (also off-centre ones, so that it can be asymmetric and have long tails).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, radians, sin

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr


@dataclass(frozen=True)
class Spread:
    """Optical spread function across an edge: a sum of Gaussians (weight, centre, standard deviation)."""

    parts: tuple[tuple[float, float, float], ...]

    def edge(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return sum(w * ndtr((x - c) / s) for w, c, s in self.parts)

    def line(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return sum(w * np.exp(-0.5 * ((x - c) / s) ** 2) / (s * np.sqrt(2 * pi)) for w, c, s in self.parts)

    def transfer(self, f: NDArray[np.float64]) -> NDArray[np.complex128]:
        return sum(w * np.exp(-2 * (pi * s * f) ** 2 - 2j * pi * f * c) for w, c, s in self.parts)


def gaussian(sigma: float) -> Spread:
    return Spread(((1.0, 0.0, sigma),))


#: Coma-like core and tails of stray light out to many pixels.
TAILED = Spread(((0.72, 0.0, 0.6), (0.18, 0.7, 0.9), (0.10, -0.3, 4.0)))


def _pixel(angle_deg: float, order: int = 10) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places across the edge and weights of a quadrature over the pixel: both boxes of Gauss' order."""
    x, w = np.polynomial.legendre.leggauss(order)
    a, b = 0.5 * x * cos(radians(angle_deg)), 0.5 * x * sin(radians(angle_deg))
    return np.add.outer(a, b).ravel(), np.multiply.outer(w / 2, w / 2).ravel()


def edge_image(
    shape: tuple[int, int],
    angle_deg: float,
    through: tuple[float, float],
    spread: Spread,
    levels: tuple[float, float] = (0.0, 1.0),
) -> NDArray[np.float64]:
    """Image (rows, columns) of an edge through (column, row), its bright side towards the angle from +x to +y."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    distance = (columns - through[0]) * cos(radians(angle_deg)) + (rows - through[1]) * sin(radians(angle_deg))
    return levels[0] + (levels[1] - levels[0]) * pixel_edge(distance, angle_deg, spread)


def pixel_edge(distance: NDArray[np.float64], angle_deg: float, spread: Spread) -> NDArray[np.float64]:
    """Exact profile at distances, through a fine table (cubic with exact slopes: an error below 1e-6)."""
    from scipy.interpolate import CubicHermiteSpline

    # Farther away an edge is as dark or as bright as it becomes.
    reach = 1.0 + max(abs(c) + 9.0 * s for _, c, s in spread.parts)
    distance = np.clip(distance, -reach, reach)
    low, high = distance.min() - 0.1, distance.max() + 0.1
    at = np.arange(low, high + 0.04, 0.04)
    shift, weight = _pixel(angle_deg)
    value, slope = np.zeros_like(at), np.zeros_like(at)
    for s, w in zip(shift, weight):
        value += w * spread.edge(at + s)
        slope += w * spread.line(at + s)
    return CubicHermiteSpline(at, value, slope)(distance)


def line_spread(distance: NDArray[np.float64], angle_deg: float, spread: Spread) -> NDArray[np.float64]:
    shift, weight = _pixel(angle_deg)
    return sum(w * spread.line(distance + s) for s, w in zip(shift, weight))


def modulation(frequency: NDArray[np.float64], angle_deg: float, spread: Spread) -> NDArray[np.float64]:
    f = np.asarray(frequency, float)
    pixel = np.sinc(f * cos(radians(angle_deg))) * np.sinc(f * sin(radians(angle_deg)))
    return np.abs(spread.transfer(f) * pixel)


def true_mtf50(angle_deg: float, spread: Spread) -> float:
    """First frequency with modulation one half."""
    f = np.linspace(0.0, 1.5, 3001)
    i = int(np.argmax(modulation(f, angle_deg, spread) < 0.5))
    return brentq(lambda x: float(modulation(np.array([x]), angle_deg, spread)[0]) - 0.5, f[i - 1], f[i])


def true_fwhm(angle_deg: float, spread: Spread) -> float:
    """Full width at half maximum of the line spread function with the pixel, along the normal."""
    x = np.linspace(-6.0, 6.0, 3001)
    y = line_spread(x, angle_deg, spread)
    half = y.max() / 2
    inside = np.flatnonzero(y > half)
    a, b = inside[0], inside[-1]
    left = x[a - 1] + (half - y[a - 1]) / (y[a] - y[a - 1]) * (x[1] - x[0])
    return float(x[b] + (y[b] - half) / (y[b] - y[b + 1]) * (x[1] - x[0]) - left)
