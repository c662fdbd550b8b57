"""What apertures let through of frequencies: discs of even light, and the pupil of a perfect lens."""

from __future__ import annotations

from math import pi

import numpy as np
from numpy.typing import NDArray
from scipy import special

_Array = NDArray[np.float64]


def disc_transfer(radius: float, f: _Array) -> _Array:
    """Transfer function of an even disc: 2 J1(2π r f) / (2π r f)."""
    z = 2.0 * pi * radius * f
    small = z < 1e-6
    return np.where(small, 1.0, 2.0 * special.j1(z) / np.where(small, 1.0, z))


def pupil_transfer(part: _Array) -> _Array:
    """Transfer function of a circular pupil without aberrations, in incoherent light, at a part v of its limit.

    2/π (arccos v − v √(1 − v²)), the autocorrelation of a disc (Goodman, Introduction to Fourier Optics, chapter 6);
    0 from v = 1 on.
    """
    v = np.clip(part, 0.0, 1.0)
    return np.asarray(2.0 / pi * (np.arccos(v) - v * np.sqrt(1.0 - v * v)))
