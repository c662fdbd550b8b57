"""Periodic parts of a series with gaps: least-squares spectrum beside a trend, and their adjustment."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.iterate import levenberg
from photoplan.adjustment.linear import solve

Array = NDArray[np.float64]

#: Frequencies that are tried within the width of a spectral line, so that none is passed by.
_OVERSAMPLING = 4
_LONGEST = 1.5
"""Least number of periods in the series: fewer cannot be told from a curve."""
_ALARM = 0.001
"""Chance of a false alarm, for `Spectrum.level`."""
_AT_ONCE = 256
_KEPT = 4_000_000
"""Cosines that are kept in memory."""


@dataclass(frozen=True)
class Harmonic:
    """An oscillation: amplitude · sin(2π t / period + phase), with t the line counted from the window's first."""

    period: float
    """Lines."""
    sigma_period: float
    amplitude: float
    """Pixels."""
    sigma_amplitude: float
    phase: float
    """Radians, −π to π, at the window's first line."""
    sigma_phase: float
    probability: float
    """Chance that noise alone makes as strong an oscillation at any of the frequencies that were tried."""

    def at(self, t: Array) -> Array:
        """Its part at lines."""
        return self.amplitude * np.sin(2.0 * math.pi * np.asarray(t, float) / self.period + self.phase)

    def hertz(self, line_time: float, interlaced: bool) -> float:
        """Frequency in Hz; of an interlaced image, two successive lines count as one line of a field."""
        return (2.0 if interlaced else 1.0) / (self.period * line_time)


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Share of the sum of squares that an oscillation of each frequency explains beside the base functions."""

    frequency: Array
    """Cycles per line, shape (k,)."""
    power: Array
    """0 to 1, shape (k,)."""
    level: float
    """Power that noise alone exceeds anywhere with a chance of 1 ‰."""

    @property
    def best(self) -> int:
        """Index of the strongest frequency."""
        return int(self.power.argmax())


class Waves:
    """Cosines and sines of all frequencies at the lines of one series; kept where they are few."""

    def __init__(self, t: Array) -> None:
        extent = float(t[-1] - t[0]) + 1.0
        low, high = _LONGEST / extent, 0.5 - 1.0 / extent
        self.extent = extent
        self.frequency = np.linspace(low, high, max(2, math.ceil((high - low) * extent * _OVERSAMPLING)))
        self._t = t - t[0]
        self._kept = list(self._parts()) if len(t) * len(self.frequency) <= _KEPT else None

    def parts(self) -> Iterable[tuple[slice, Array, Array]]:
        """Some frequencies at a time: which, cosines and sines of shape (n, some)."""
        return self._parts() if self._kept is None else self._kept

    def _parts(self) -> Iterator[tuple[slice, Array, Array]]:
        for first in range(0, len(self.frequency), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            angle = 2.0 * math.pi * np.multiply.outer(self._t, self.frequency[part])
            yield part, np.cos(angle), np.sin(angle)


def spectrum(waves: Waves, y: Array, base: Array) -> Spectrum:
    """Least-squares spectrum: at every frequency the base functions are adjusted anew (Lomb, Scargle)."""
    frequency = waves.frequency
    Q, _ = np.linalg.qr(base)
    rest = y - Q @ (Q.T @ y)
    rss0 = max(float(rest @ rest), 1e-300)
    power = np.empty(len(frequency))
    for part, c, s in waves.parts():
        power[part] = _explained(c, s, Q, rest) / rss0
    freedom = len(y) - base.shape[1] - 3
    trials = max(1.0, float(frequency[-1] - frequency[0]) * waves.extent)
    single = -math.expm1(math.log1p(-_ALARM) / trials)
    return Spectrum(frequency, np.clip(power, 0.0, 1.0), 1.0 - single ** (2.0 / freedom))


def false_alarm(found: Spectrum, freedom: int, extent: float) -> float:
    """Chance that noise alone has its strongest power this high."""
    single = (1.0 - float(found.power[found.best])) ** (freedom / 2.0)
    trials = max(1.0, float(found.frequency[-1] - found.frequency[0]) * extent)
    return -math.expm1(trials * math.log1p(-min(single, 1.0 - 1e-12)))


def _explained(c: Array, s: Array, Q: Array, rest: Array) -> Array:
    """Sum of squares that cosine and sine explain, after both are freed of what the base can do."""
    of_c, of_s = Q.T @ c, Q.T @ s
    cc = np.einsum("ij,ij->j", c, c) - (of_c * of_c).sum(axis=0)
    ss = np.einsum("ij,ij->j", s, s) - (of_s * of_s).sum(axis=0)
    cs = np.einsum("ij,ij->j", c, s) - (of_c * of_s).sum(axis=0)
    # The rest is free of the base already.
    yc, ys = rest @ c, rest @ s
    det = cc * ss - cs**2
    with np.errstate(divide="ignore", invalid="ignore"):
        out = (yc**2 * ss - 2.0 * yc * ys * cs + ys**2 * cc) / det
    return np.where(det > 1e-6 * np.maximum(cc * ss, 1e-12), out, 0.0)


@dataclass(frozen=True, eq=False)
class AdjustedPeriod:
    """Base functions and oscillations adjusted together."""

    unknowns: Array
    """Of the base functions, shape (k,)."""
    sigmas: Array
    harmonics: tuple[Harmonic, ...]
    residuals: Array
    """Computed minus measured, shape (n,)."""
    sigma0: float
    """Standard deviation of one value."""


def adjust_periods(t: Array, y: Array, base: Array, frequencies: list[float], chances: list[float]) -> AdjustedPeriod:
    """Adjust the base functions and the frequency, amplitude and phase of every oscillation by least squares."""
    # About its middle, frequency and phase of an oscillation are nearly uncorrelated.
    middle = float(t.mean())
    limit, k = 0.5 / (float(t[-1] - t[0]) + 1.0), base.shape[1]

    def equations(f: Array) -> tuple[Array, Array]:
        A = _design(t - middle, base, f)
        found = solve(A, y)
        return np.column_stack([A, _by_frequency(t - middle, f, found.unknowns[k:])]), found.residuals

    def moved(f: Array, step: Array) -> Array:
        return np.clip(f + np.clip(step[len(step) - len(f) :], -limit, limit), 1e-6, 0.5 - 1e-6)

    found = levenberg(np.array(frequencies), equations, moved)
    f, cofactors = found.state, solve(found.A, y).cofactors
    unknowns = solve(_design(t - middle, base, f), y).unknowns
    covariance = cofactors * found.sigma0**2
    harmonics = tuple(_harmonic(i, k, f, unknowns, covariance, middle, chances) for i in range(len(f)))
    return AdjustedPeriod(
        unknowns=unknowns[:k],
        sigmas=np.sqrt(np.diag(covariance)[:k]),
        harmonics=harmonics,
        residuals=found.v,
        sigma0=found.sigma0,
    )


def _design(t: Array, base: Array, f: Array) -> Array:
    angle = 2.0 * math.pi * np.multiply.outer(t, f)
    return np.column_stack(
        [base, *(part for i in range(len(f)) for part in (np.cos(angle[:, i]), np.sin(angle[:, i])))]
    )


def _by_frequency(t: Array, f: Array, found: Array) -> Array:
    """Derivatives of every oscillation with respect to its frequency."""
    angle = 2.0 * math.pi * np.multiply.outer(t, f)
    a, b = found[0::2], found[1::2]
    return 2.0 * math.pi * t[:, None] * (b * np.cos(angle) - a * np.sin(angle))


def _harmonic(
    i: int, k: int, f: Array, found: Array, covariance: Array, middle: float, chances: list[float]
) -> Harmonic:
    """Amplitude, phase and period with their standard deviations; the phase is moved to line 0."""
    a, b = found[k + 2 * i], found[k + 2 * i + 1]
    amplitude = math.hypot(a, b)
    index = [k + 2 * i, k + 2 * i + 1, k + 2 * len(f) + i]
    C = covariance[np.ix_(index, index)]
    of_amplitude = np.array([a, b, 0.0]) / max(amplitude, 1e-300)
    # phase = atan2(a, b) − 2π f · middle
    of_phase = np.array([b, -a, 0.0]) / max(amplitude, 1e-300) ** 2 - [0.0, 0.0, 2.0 * math.pi * middle]
    phase = math.remainder(math.atan2(a, b) - 2.0 * math.pi * f[i] * middle, math.tau)
    return Harmonic(
        period=1.0 / float(f[i]),
        sigma_period=math.sqrt(C[2, 2]) / float(f[i]) ** 2,
        amplitude=amplitude,
        sigma_amplitude=math.sqrt(of_amplitude @ C @ of_amplitude),
        phase=phase,
        sigma_phase=math.sqrt(of_phase @ C @ of_phase),
        probability=chances[i],
    )
