"""The spread function of an image in one direction, as shares of light per pixel."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError

#: Full width at half maximum of a Gaussian with standard deviation 1.
GAUSSIAN_WIDTH = 2.0 * sqrt(2.0 * log(2.0))


@dataclass(frozen=True, eq=False)
class SpreadFunction:
    """Which share of the light of an object pixel falls on the pixels around it, in one direction.

    The image is the object convolved with it (Kölbl 2006, eq. 1 and 2); Kölbl's Z, A, B are the values at 0, 1, 2.
    """

    values: NDArray[np.float64]
    """Shares from -half to +half pixels, an odd number of values, sum 1."""
    sigma: NDArray[np.float64] | None = None
    """Their standard deviations; None if unknown."""

    def __post_init__(self) -> None:
        values = np.array(self.values, np.float64)
        if values.ndim != 1 or values.size % 2 == 0:
            raise InputError(f"a spread function has an odd number of values in one row; given is shape {values.shape}")
        if not np.isfinite(values).all():
            raise InputError("a spread function has finite values only")
        total = float(values.sum())
        if abs(total - 1.0) > 1e-6:
            raise InputError(
                f"the values of a spread function add up to 1, no light is lost; given: {total:.6g} "
                "(SpreadFunction.normalised divides by the sum)"
            )
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    @classmethod
    def normalised(cls, values: NDArray[np.float64] | list[float]) -> SpreadFunction:
        """Spread function of values that are divided by their sum."""
        numbers = np.array(values, np.float64)
        total = float(numbers.sum())
        if not total > 0.0:
            raise InputError(f"values of a spread function have a positive sum; given: {total:.6g}")
        return cls(numbers / total)

    @classmethod
    def symmetric(cls, half: NDArray[np.float64] | list[float]) -> SpreadFunction:
        """Spread function from its centre Z and the values A, B, … on one side; divided by their sum."""
        side = np.asarray(half, np.float64)
        return cls.normalised(np.concatenate([side[:0:-1], side]))

    @property
    def half(self) -> int:
        """How many pixels it reaches to each side."""
        return int(self.values.size // 2)

    @property
    def asymmetry(self) -> float:
        """Half the sum of the differences between both sides: 0 if symmetric."""
        return float(np.abs(self.values - self.values[::-1]).sum() / 4.0)

    def side(self) -> NDArray[np.float64]:
        """Centre Z and the means of both sides A, B, …, shape (half + 1,)."""
        both = (self.values + self.values[::-1]) / 2.0
        return both[self.half :]

    def transfer(self, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Optical transfer function at frequencies in cycles per pixel, same shape, 1 at 0."""
        offsets = np.arange(-self.half, self.half + 1)
        return np.exp(-2j * pi * np.multiply.outer(np.asarray(frequency, float), offsets)) @ self.values

    def gaussian_fwhm(self) -> float:
        """Full width at half maximum of the Gaussian with the same second moment, pixels; NaN if there is none."""
        offsets = np.arange(-self.half, self.half + 1.0)
        mean = float(self.values @ offsets)
        variance = float(self.values @ (offsets - mean) ** 2)
        return GAUSSIAN_WIDTH * sqrt(variance) if variance >= 0.0 else float("nan")


def gaussian_modulation(fwhm: float, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modulation of a Gaussian spread function of a full width at half maximum in pixels, at cycles per pixel."""
    sigma = fwhm / GAUSSIAN_WIDTH
    return np.asarray(np.exp(-2.0 * (pi * sigma * np.asarray(frequency, float)) ** 2))
