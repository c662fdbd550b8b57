"""A modulation transfer function as a curve with standard deviations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError


@dataclass(frozen=True, eq=False)
class MtfCurve:
    """Modulation against spatial frequency."""

    frequency: NDArray[np.float64]
    """Cycles per pixel, increasing from 0, shape (n,)."""
    modulation: NDArray[np.float64]
    """Modulation transfer, 1 at frequency 0, shape (n,)."""
    sigma: NDArray[np.float64] | None = None
    """Standard deviations of the modulation, shape (n,); None if unknown."""

    def __post_init__(self) -> None:
        frequency, modulation = np.array(self.frequency, float), np.array(self.modulation, float)
        if frequency.ndim != 1 or frequency.shape != modulation.shape or frequency.size < 2:
            raise InputError(
                f"an MTF has as many frequencies as modulations, at least two; given: {frequency.shape} and "
                f"{modulation.shape}"
            )
        if frequency[0] != 0.0 or not (np.diff(frequency) > 0.0).all():
            raise InputError("the frequencies of an MTF increase from 0")
        object.__setattr__(self, "frequency", frequency)
        object.__setattr__(self, "modulation", modulation)

    @classmethod
    def from_zero(cls, frequency: ArrayLike, modulation: ArrayLike, sigma: ArrayLike) -> MtfCurve:
        """Curve of measured frequencies, with modulation 1 at frequency 0 before them."""
        rest = zip((0.0, 1.0, 0.0), (frequency, modulation, sigma))
        return cls(*(np.concatenate([[first], np.asarray(values, float)]) for first, values in rest))

    def at(self, frequency: float) -> float:
        """Modulation at a frequency in cycles per pixel, linear between its neighbours; NaN beyond the last one."""
        return float(np.interp(frequency, self.frequency, self.modulation, right=np.nan))

    def falls_to(self, modulation: float) -> float:
        """The first frequency at which the curve falls to a modulation; NaN if it stays above."""
        below = np.flatnonzero(self.modulation <= modulation)
        if below.size == 0 or below[0] == 0:
            return float("nan")
        i = int(below[0])
        high, low = self.modulation[i - 1], self.modulation[i]
        part = (high - modulation) / (high - low)
        return float(self.frequency[i - 1] + part * (self.frequency[i] - self.frequency[i - 1]))

    @property
    def mtf50(self) -> float:
        """Frequency at modulation 0.5, cycles per pixel; NaN if it is not reached."""
        return self.falls_to(0.5)

    def mtf50_interval(self, sigmas: float = 1.96) -> tuple[float, float]:
        """Frequencies at which the curve less and plus so many standard deviations falls to 0.5.

        The last frequency of the curve where that is not reached; equal where the standard deviations are unknown.
        """
        margin = 0.0 if self.sigma is None else sigmas * np.asarray(self.sigma, float)
        ends = [MtfCurve(self.frequency, self.modulation + sign * margin).mtf50 for sign in (-1.0, 1.0)]
        low, high = (float(np.nan_to_num(end, nan=self.frequency[-1])) for end in ends)
        return low, high

    @property
    def mtf10(self) -> float:
        """Frequency at modulation 0.1, cycles per pixel; NaN if it is not reached."""
        return self.falls_to(0.1)
