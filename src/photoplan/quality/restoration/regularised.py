"""Restoration filters where the exact inverse would amplify noise too much: least squares over all scenes with edges.

The restored pixel shall be what an ideal aperture of one pixel would have seen. Among all kernels of a given size the
one is taken whose expected square error is least, for scenes of edges in any place and direction (power spectrum
proportional to frequency to the power of -3) and white noise. Unlike the exact inverse of the band matrix it
regards that edges do not lie on the borders of pixels, so that frequencies above 0.5 cycles/pixel fold back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.mtf_curve import MtfCurve

Transfer = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Modulation at frequencies u along rows and v along columns, cycles per pixel; arrays that broadcast."""

#: Frequencies per axis and pixel at which spectra are summed.
_GRID = 64
#: How many times the frequency square is repeated to each side, for what folds back.
_FOLDS = 2
#: Power spectrum of edges of any place and direction against frequency.
_EXPONENT = 3.0


@dataclass(frozen=True)
class SceneStatistics:
    """What a filter is designed for, in grey values of linear light."""

    noise: float
    """Standard deviation of the noise."""
    contrast: float
    """Root mean square difference of neighbouring pixels of the image, without the share of the noise."""

    def __post_init__(self) -> None:
        if not self.noise >= 0.0 or not self.contrast > 0.0:
            raise InputError(
                f"noise {self.noise:g}, contrast {self.contrast:g}; needed are noise of 0 or more and contrast above 0"
            )


def curve_transfer(x: MtfCurve, y: MtfCurve) -> Transfer:
    """Transfer function of two MTF curves; between the axes it goes over with the squared cosine of the direction.

    Beyond the last frequency of a curve it is 0.
    """

    def transfer(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        square = u**2 + v**2
        frequency = np.sqrt(square)
        share = np.where(square > 0.0, u**2 / np.where(square > 0.0, square, 1.0), 0.5)
        along_x = np.interp(frequency, x.frequency, x.modulation, right=0.0)
        along_y = np.interp(frequency, y.frequency, y.modulation, right=0.0)
        return np.asarray(share * along_x + (1.0 - share) * along_y)

    return transfer


def regularised_filter(
    transfer: Transfer, scene: SceneStatistics, half: int = 5, aperture: float = 1.0
) -> NDArray[np.float64]:
    """Kernel of least expected square error, symmetric in x and in y.

    Parameters
    ----------
    transfer : Transfer
        Of the image, real and symmetric.
    scene : SceneStatistics
    half : int
        How many pixels the kernel reaches to each side.
    aperture : float
        Side of the ideal aperture, pixels; below 1 the result is sharper and noisier.

    Returns
    -------
    ndarray, shape (2 half + 1, 2 half + 1)
        Sum 1.
    """
    seen, wanted, power = _spectra(transfer, aperture)
    scale = (scene.contrast / power) ** 2
    total = scale * seen + scene.noise**2
    frequency = _frequencies()
    waves = np.cos(2.0 * pi * np.outer(frequency, np.arange(half + 1)))
    waves[:, 1:] *= 2.0
    # A quadrant of the kernel is unknown; its waves are products of one per axis.
    basis = (waves[:, None, :, None] * waves[None, :, None, :]).reshape(_GRID**2, -1)
    normal = basis.T @ (basis * total.reshape(-1, 1)) / _GRID**2
    right = basis.T @ (scale * wanted).ravel() / _GRID**2
    at_zero = np.multiply.outer(*2 * (np.where(np.arange(half + 1) > 0, 2.0, 1.0),)).ravel()
    quadrant = _with_sum_one(normal, right, at_zero).reshape(half + 1, half + 1)
    rows = np.concatenate([quadrant[:0:-1], quadrant])
    return np.concatenate([rows[:, :0:-1], rows], axis=1)


def _frequencies() -> NDArray[np.float64]:
    return (np.arange(_GRID) + 0.5) / _GRID - 0.5


def _spectra(transfer: Transfer, aperture: float) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Folded power of the image, folded cross power with the ideal image, rms difference of neighbours.

    All for a scene whose spectrum has the factor 1.
    """
    frequency = _frequencies()
    seen, wanted = np.zeros((_GRID, _GRID)), np.zeros((_GRID, _GRID))
    difference = 0.0
    for down in range(-_FOLDS, _FOLDS + 1):
        for right in range(-_FOLDS, _FOLDS + 1):
            v, u = frequency[:, None] + down, frequency[None, :] + right
            scene = np.hypot(u, v) ** -_EXPONENT
            image = transfer(u, v)
            power = image**2 * scene
            seen += power
            wanted += image * scene * np.sinc(aperture * u) * np.sinc(aperture * v)
            difference += float((power * 2.0 * (np.sin(pi * u) ** 2 + np.sin(pi * v) ** 2)).mean())
    return seen, wanted, float(np.sqrt(difference))


def _with_sum_one(
    normal: NDArray[np.float64], right: NDArray[np.float64], at_zero: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Least squares under the condition that the kernel's sum is 1, so that brightness stays."""
    count = right.size
    # Without noise some kernels cost nothing; a trace of noise keeps the equations solvable and changes no figure.
    bordered = np.zeros((count + 1, count + 1))
    bordered[:count, :count] = normal + np.eye(count) * 1e-9 * np.trace(normal) / count
    bordered[:count, count] = bordered[count, :count] = at_zero
    return np.asarray(np.linalg.solve(bordered, np.append(right, 1.0))[:count])
