"""Filters that undo the aperture of a scanner (Ecker 1991, §4.3.1, eq. 4.5 and 4.6, after He 1989)."""

from __future__ import annotations

from math import pi
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.apertures import disc_transfer

#: Frequencies per axis over which the series of the inverse is summed.
_GRID = 256
#: Where less than this of a frequency is left, the aperture cannot be undone.
LEAST_TRANSFER = 0.05


def aperture_transfer(
    shape: Literal["square", "round"], ratio: float, u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Transfer function of an aperture."""
    if shape == "square":
        return np.asarray(np.sinc(ratio * u) * np.sinc(ratio * v))
    return disc_transfer(ratio / 2.0, np.hypot(u, v))


def aperture_filter(shape: Literal["square", "round"], ratio: float = 1.0, half: int = 4) -> NDArray[np.float64]:
    """Filter that undoes an aperture: the Fourier series of the inverse transfer function up to 0.5 cycles per step.

    With ratio 1 and nine values a side these are He's matrices; the square one is printed divided by its sum, the
    round one before that.
    """
    if not 0.0 < ratio <= 10.0:
        raise InputError(f"aperture by step {ratio:g}; allowed are numbers above 0 up to 10")
    if not 1 <= half <= 50:
        raise InputError(f"a filter of {half} pixels to each side; allowed are 1 to 50")
    frequency = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    transfer = aperture_transfer(shape, ratio, frequency[None, :], frequency[:, None])
    least = float(transfer.min())
    if least < LEAST_TRANSFER:
        raise InputError(
            f"a {shape} aperture of {ratio:g} steps leaves {max(least, 0.0):.3f} of a frequency that the scan shows; "
            "undoing it would amplify noise without bound. Use a regularised filter, or ratios up to "
            f"{_largest_ratio(shape):.2f}"
        )
    waves = np.cos(2.0 * pi * np.outer(np.arange(-half, half + 1), frequency))
    series = waves @ (1.0 / transfer) @ waves.T / _GRID**2
    return np.asarray(series / series.sum())


def _largest_ratio(shape: Literal["square", "round"]) -> float:
    """The largest ratio, in hundredths, at which everything up to the corner of the frequency square is left."""
    corner = np.array(0.5)
    ratios = np.arange(1.0, 3.0, 0.01)
    left = [float(aperture_transfer(shape, float(r), corner, corner)) for r in ratios]
    return float(ratios[int(np.argmax(np.array(left) < LEAST_TRANSFER)) - 1])
