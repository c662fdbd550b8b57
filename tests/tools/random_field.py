"""Random terrain with a known covariance function: stationary Gaussian fields, exact at the nodes of a grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["correlation", "random_field"]

#: Argument at which (1 + t) exp(−t) is one half.
_MATERN = 1.6783469900166605


def correlation(d: NDArray[np.float64], family: str) -> NDArray[np.float64]:
    """Correlation at distances in half-value distances: ½ at 1."""
    if family == "gaussian":
        return 0.5 ** (d**2)
    if family == "exponential":
        return 0.5**d
    return (1 + _MATERN * d) * np.exp(-_MATERN * d)


def random_field(family: str, length: float, nodes: int, step: float, seed: int) -> NDArray[np.float64]:
    """Heights of variance 1 with the half-value distance `length` on a square grid, shape (nodes, nodes).

    The covariance matrix of a field on a torus is diagonalised by the Fourier transform; the torus is wide enough that
    its other side does not matter.
    """
    size = 2 * nodes
    away = np.minimum(np.arange(size), size - np.arange(size)) * step
    spectrum = np.fft.fft2(correlation(np.hypot(away[:, None], away[None]) / length, family)).real
    noise = np.random.default_rng(seed).normal(size=(size, size))
    field = np.fft.ifft2(np.sqrt(np.maximum(spectrum, 0)) * np.fft.fft2(noise)).real
    return field[:nodes, :nodes]
