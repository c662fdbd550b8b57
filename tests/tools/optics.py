"""Images of edges through optics that are no sum of Gaussians: diffraction, defocus, movement, stray light.

Everything follows from the transfer function along the edge's normal by a Fourier transform on a fine grid, none of it
from the package or its model: the slice of an optical transfer function times that of the square pixel, divided by
2 π i f, is the transform of the edge profile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import cos, pi, radians, sin

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import j1

Array = NDArray[np.float64]
#: Lines for each pixel and pixels of the period of the Fourier transform.
FINE, PERIOD = 32, 2048


@dataclass(frozen=True)
class Optics:
    """Optics by their transfer function at cycles per pixel along x and along y, real."""

    name: str
    transfer: Callable[[Array, Array], Array]

    def modulation(self, frequency: Array, angle_deg: float) -> Array:
        """Transfer with the square pixel along a direction; negative where it turns its sign."""
        fx, fy = frequency * cos(radians(angle_deg)), frequency * sin(radians(angle_deg))
        return self.transfer(fx, fy) * np.sinc(fx) * np.sinc(fy)

    def mtf50(self, angle_deg: float) -> float:
        """First frequency with modulation one half."""
        f = np.linspace(0.0, 2.0, 8001)
        i = int(np.argmax(self.modulation(f, angle_deg) < 0.5))
        return brentq(lambda x: float(self.modulation(np.array([x]), angle_deg)[0]) - 0.5, f[i - 1], f[i])

    @lru_cache(maxsize=2)  # noqa: B019
    def profiles(self, angle_deg: float) -> tuple[Array, Array, Array]:
        """Places in pixels, line spread function, edge profile from 0 to 1 at the border of the period."""
        frequency = np.arange(FINE * PERIOD // 2 + 1) / PERIOD
        line = np.fft.fftshift(np.fft.irfft(self.modulation(frequency, angle_deg) * FINE))
        at = (np.arange(line.size) - line.size // 2) / FINE
        # Integral by cubic splines; what the wings hold beyond the period is spread evenly by the transform.
        edge = CubicSpline(at, line).antiderivative()(at)
        return at, line, edge - edge[line.size // 2] + 0.5

    def image(self, shape: tuple[int, int], angle_deg: float, through: tuple[float, float]) -> Array:
        """Edge from 0 to 1 through (column, row), its bright side towards the angle from +x to +y."""
        rows, columns = np.mgrid[: shape[0], : shape[1]]
        distance = (columns - through[0]) * cos(radians(angle_deg)) + (rows - through[1]) * sin(radians(angle_deg))
        at, _, edge = self.profiles(angle_deg)
        near = np.abs(at) < np.abs(distance).max() + 1.0
        return CubicSpline(at[near], edge[near])(distance)

    def fwhm(self, angle_deg: float) -> float:
        """Full width at half maximum of the line spread function with the pixel."""
        at, line, _ = self.profiles(angle_deg)
        near = np.abs(at) < 12.0
        at, line = at[near], line[near] - line[near].max() / 2
        inside = np.flatnonzero(line > 0.0)
        a, b = inside[0], inside[-1]
        left = at[a - 1] - line[a - 1] / (line[a] - line[a - 1]) / FINE
        return float(at[b] + line[b] / (line[b] - line[b + 1]) / FINE - left)


def gaussian(sigma: float) -> Optics:
    """Gaussian of a standard deviation, pixels."""
    return Optics("gaussian", lambda x, y: np.exp(-2.0 * (pi * sigma) ** 2 * (x * x + y * y)))


def diffraction(wavelength_times_number: float) -> Optics:
    """Circular aperture in focus; λN in pixels, the reciprocal of the highest frequency."""

    def transfer(x: Array, y: Array) -> Array:
        part = np.clip(np.hypot(x, y) * wavelength_times_number, 0.0, 1.0)
        return 2.0 / pi * (np.arccos(part) - part * np.sqrt(1.0 - part**2))

    return Optics("diffraction", transfer)


def defocus(radius: float) -> Optics:
    """Even disc, geometrical optics."""

    def transfer(x: Array, y: Array) -> Array:
        u = 2.0 * pi * radius * np.maximum(np.hypot(x, y), 1e-9)
        return 2.0 * j1(u) / u

    return Optics("defocus", transfer)


def motion(length: float, direction_deg: float, sigma: float) -> Optics:
    """Even movement over a length in pixels, in a direction, in front of a Gaussian."""
    cx, cy = length * cos(radians(direction_deg)), length * sin(radians(direction_deg))
    return Optics("motion", lambda x, y: np.sinc(x * cx + y * cy) * np.exp(-2.0 * (pi * sigma) ** 2 * (x * x + y * y)))


def stray(share: float, reach: float, sigma: float) -> Optics:
    """A Gaussian, of whose light a share is spread exponentially: density exp(−r / reach) around each point."""

    def transfer(x: Array, y: Array) -> Array:
        square = x * x + y * y
        wide = (1.0 + (2.0 * pi * reach) ** 2 * square) ** -1.5
        return (1.0 - share) * np.exp(-2.0 * (pi * sigma) ** 2 * square) + share * wide

    return Optics("stray", transfer)


def haze(share: float, reach: float, sigma: float) -> Optics:
    """A Gaussian, of whose light a share is spread by a wide Gaussian."""

    def transfer(x: Array, y: Array) -> Array:
        square = x * x + y * y
        core, wide = (np.exp(-2.0 * (pi * s) ** 2 * square) for s in (sigma, reach))
        return (1.0 - share) * core + share * wide

    return Optics("haze", transfer)


CLASSES = ("gaussian", "diffraction", "defocus", "motion", "stray", "haze")


def any_optics(name: str, random: np.random.Generator) -> Optics:
    """Optics of one of `CLASSES` with random figures."""
    pick = random.uniform
    return {
        "gaussian": lambda: gaussian(pick(0.35, 1.1)),
        "diffraction": lambda: diffraction(pick(1.0, 3.0)),
        "defocus": lambda: defocus(pick(0.5, 2.0)),
        "motion": lambda: motion(pick(1.0, 3.0), pick(0.0, 180.0), pick(0.3, 0.6)),
        "stray": lambda: stray(0.08, 8.0, pick(0.4, 0.8)),
        "haze": lambda: haze(0.08, 8.0, pick(0.4, 0.8)),
    }[name]()
