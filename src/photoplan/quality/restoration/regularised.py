"""What error a restoration filter is expected to leave, and the filter of its size that leaves the least.

The restored pixel shall be what an ideal aperture of one pixel would have seen. For a scene of a known power spectrum
and white noise the expected square error is a square form of the filter's values, so that the best filter of a size
follows from linear equations: a Wiener filter, but of few values, and regarding the frequencies above 0.5 cycles/pixel
that fold back. What is not known of the modulation transfer acts like more noise (E|H|² is the square of the mean and
the variance), so that an uncertain spread function is inverted less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.restoration.compression import at_frequencies
from photoplan.quality.restoration.scene import FOLDS, SceneStatistics, Transfer, frequency_grid

Array = NDArray[np.float64]


def curve_transfer(x: MtfCurve, y: MtfCurve) -> Transfer:
    """Transfer function of two MTF curves; between the axes it goes over with the squared cosine of the direction.

    Beyond the last frequency of a curve it is 0. Curves without standard deviations count as known.
    """

    def transfer(u: Array, v: Array) -> tuple[Array, Array]:
        square = u**2 + v**2
        frequency = np.sqrt(square)
        share = np.where(square > 0.0, u**2 / np.where(square > 0.0, square, 1.0), 0.5)
        along = [
            [
                np.zeros_like(frequency) if values is None else np.interp(frequency, curve.frequency, values, right=0.0)
                for values in (curve.modulation, curve.sigma)
            ]
            for curve in (x, y)
        ]
        modulation, sigma = (share * one + (1.0 - share) * other for one, other in zip(*along, strict=True))
        return modulation, sigma

    return transfer


def sharpest(transfer: Transfer, sigmas: float = 1.96) -> Transfer:
    """The sharpest that a transfer function may be, by so many standard deviations; it counts as known."""

    def known(u: Array, v: Array) -> tuple[Array, Array]:
        modulation, sigma = transfer(u, v)
        # A sharpened image has modulations above 1.
        return np.maximum(modulation, np.minimum(modulation + sigmas * sigma, 1.0)), np.zeros_like(sigma)

    return known


@dataclass(frozen=True, eq=False)
class Expectation:
    """Expected square errors of the filters of an image; all over one frequency square, what folds back included."""

    seen: Array
    """Power of the image, noise included."""
    cross: Array
    """Cross power of the image with the ideal one."""
    ideal: Array
    """Power of the ideal image."""

    @classmethod
    def of(
        cls, transfer: Transfer, scene: SceneStatistics, aperture: float = 1.0, kept: Array | None = None
    ) -> Expectation:
        """What is expected of an image."""
        u, v = frequency_grid()
        power, (modulation, sigma) = scene.power(u, v), transfer(u, v)
        ideal = np.sinc(aperture * u) * np.sinc(aperture * v)
        seen = ((modulation**2 + sigma**2) * power).sum(axis=0)
        seen += scene.noise_power(u[0] + FOLDS, v[0] + FOLDS)
        cross = (modulation * ideal * power).sum(axis=0)
        if kept is not None:
            cross = cross * at_frequencies(kept, u[0] + FOLDS, v[0] + FOLDS)
        return cls(seen, cross, (ideal**2 * power).sum(axis=0))

    @classmethod
    def mean(cls, each: Sequence[Expectation]) -> Expectation:
        """Mean of expectations, each of them in units of the error that the image has as it is."""
        shares = [1.0 / (len(each) * max(one.error(np.ones((1, 1))), 1e-300) ** 2) for one in each]
        names = ("seen", "cross", "ideal")
        return cls(*(sum(s * getattr(one, name) for s, one in zip(shares, each, strict=True)) for name in names))

    def gain(self, kernel: Array) -> float:
        """Expected error after a filter by that of the image as it is."""
        return self.error(kernel) / max(self.error(np.ones((1, 1))), 1e-300)

    def error(self, kernel: Array) -> float:
        """Expected root mean square difference to the ideal image after a filter, in the light of the scene."""
        base = frequency_grid()[0][0, 0]
        left, right = (
            np.exp(-2j * pi * np.outer(base, np.arange(side) - side // 2)) for side in np.asarray(kernel).shape
        )
        response = left @ kernel @ right.T
        square = (np.abs(response) ** 2 * self.seen - 2.0 * response.real * self.cross + self.ideal).mean()
        return sqrt(max(float(square), 0.0))

    def best(self, half: tuple[int, int]) -> Array:
        """Kernel of least expected error, symmetric in x and in y, sum 1."""
        # A quadrant of the kernel is unknown; its waves are products of one per axis.
        down, right = (_waves(frequency_grid()[0][0, 0], reach) for reach in half)
        count = self.seen.size
        basis = (down[:, None, :, None] * right[None, :, None, :]).reshape(count, -1)
        normal = basis.T @ (basis * self.seen.reshape(-1, 1)) / count
        at_zero = np.multiply.outer(*(np.where(np.arange(reach + 1) > 0, 2.0, 1.0) for reach in half)).ravel()
        quadrant = _with_sum_one(normal, basis.T @ self.cross.ravel() / count, at_zero)
        quadrant = quadrant.reshape(half[0] + 1, half[1] + 1)
        rows = np.concatenate([quadrant[:0:-1], quadrant])
        return np.concatenate([rows[:, :0:-1], rows], axis=1)


def _waves(frequency: Array, half: int) -> Array:
    """Real waves of the values 0 to half to both sides of a symmetric kernel, shape (frequencies, half + 1)."""
    waves = np.cos(2.0 * pi * np.outer(frequency, np.arange(half + 1)))
    waves[:, 1:] *= 2.0
    return np.asarray(waves)


def _with_sum_one(normal: Array, right: Array, at_zero: Array) -> Array:
    """Least squares under the condition that the kernel's sum is 1, so that brightness stays."""
    count = right.size
    # Without noise some kernels cost nothing; a trace of noise keeps the equations solvable and changes no figure.
    bordered = np.zeros((count + 1, count + 1))
    bordered[:count, :count] = normal + np.eye(count) * 1e-9 * np.trace(normal) / count
    bordered[:count, count] = bordered[count, :count] = at_zero
    return np.asarray(np.linalg.solve(bordered, np.append(right, 1.0))[:count])
