"""Brightness that drifts and flickers, short and long term (Behr 1989, §4.2.4, table 4.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from photoplan.adjustment.chances import chance_t
from photoplan.errors import InputError
from photoplan.quality.camera.approach import check_times

Array = NDArray[np.float64]

#: Measurements below which long and short term cannot be told apart.
LEAST_MEASUREMENTS = 10
_EVEN = 0.05
"""Largest difference of an interval from their median, as part of it, at which they count as equal."""
_CLASSES = 12


@dataclass(frozen=True, eq=False)
class Variation:
    """How much grey values differ over a lapse of time: from flicker, where it is short, to drift."""

    lapse: Array
    """Seconds, shape (k,)."""
    structure: Array
    """Root of half the mean squared difference of two values this lapse apart; for white noise, its sigma; (k,)."""
    pairs: NDArray[np.int64]
    """Of values, shape (k,)."""
    allan: Array
    """Allan deviation of means over the lapse; for white noise it falls by its root; NaN: not enough means, (k,)."""


@dataclass(frozen=True, eq=False)
class BrightnessDrift:
    """The figures of table 4.1, and what of them is flicker, drift and trend."""

    count: int
    mean: float
    """Ī"""
    minimum: float
    """I_min"""
    maximum: float
    """I_max"""
    sigma: float
    """σ_I: standard deviation of one measurement, of all about their mean."""
    largest_step: float
    """Δ_I: largest difference of two successive measurements."""
    short_sigma: float
    """Standard deviation within the interval of two measurements, from successive differences."""
    long_sigma: float
    """What is left of `sigma` without it; 0 if nothing."""
    sigma_of_short: float
    """Standard deviation of `short_sigma` itself."""
    neumann: float
    """Mean squared successive difference over variance: 2 for white noise, less for drift (von Neumann)."""
    neumann_probability: float
    """Chance that white noise gives as little."""
    trend: float
    """Grey values per hour, straight line by least squares."""
    sigma_trend: float
    """Its standard deviation, with the correlation of successive residuals taken into account."""
    trend_probability: float
    """Chance that a series without trend gives as much."""
    pixel_noise: float | None
    """σ that the noise of the pixels leaves in the mean of the window; None: not known."""
    variation: Variation
    times: Array
    values: Array

    @property
    def drifts(self) -> bool:
        """Whether the values are not white noise, with a chance of error of 1 %."""
        return self.neumann_probability < 0.01

    @property
    def has_trend(self) -> bool:
        """Whether there is a trend, with a chance of error of 1 %."""
        return self.trend_probability < 0.01


def brightness_drift(
    times: Array, values: Array, pixel_noise: float | None = None, name: str = "series"
) -> BrightnessDrift:
    """Figures of repeated measurements of one constant brightness."""
    t, y = check_times(times, name), np.asarray(values, float)
    if y.shape != t.shape or not np.isfinite(y).all():
        raise InputError(f"{name}: {y.size} finite grey values at {t.size} times are needed, one per frame")
    n = len(y)
    if n < LEAST_MEASUREMENTS:
        raise InputError(f"{name}: {n} measurements; at least {LEAST_MEASUREMENTS} are needed to speak of drift")
    sigma = float(y.std(ddof=1))
    if sigma == 0.0:
        raise InputError(
            f"{name}: all {n} measurements are exactly {y[0]:g}: saturated, or the same frame again; nothing drifts"
        )
    steps = np.diff(y)
    squares = float((steps**2).mean())
    short = math.sqrt(squares / 2.0)
    neumann = squares / (sigma**2 * (n - 1) / n)
    # Moments of the ratio for white noise (von Neumann 1941): mean 2n/(n−1), variance 4n²(n−2)/((n+1)(n−1)³).
    z = (neumann - 2.0 * n / (n - 1)) / math.sqrt(4.0 * n**2 * (n - 2) / ((n + 1) * (n - 1) ** 3))
    trend, sigma_trend, probability = _trend(t, y)
    return BrightnessDrift(
        count=n,
        mean=float(y.mean()),
        minimum=float(y.min()),
        maximum=float(y.max()),
        sigma=sigma,
        largest_step=float(np.abs(steps).max()),
        short_sigma=short,
        long_sigma=math.sqrt(max(sigma**2 - short**2, 0.0)),
        # Of n−1 differences that overlap: variance of their mean square is (3n−4)/(n−1)² σ⁴ for white noise.
        sigma_of_short=short * math.sqrt(3.0 * n - 4.0) / (n - 1) / 2.0,
        neumann=neumann,
        neumann_probability=float(special.ndtr(z)),
        trend=trend,
        sigma_trend=sigma_trend,
        trend_probability=probability,
        pixel_noise=pixel_noise,
        variation=_variation(t, y),
        times=t,
        values=y,
    )


def _trend(t: Array, y: Array) -> tuple[float, float, float]:
    """Slope per hour, its standard deviation and the chance of as much without trend.

    Successive residuals of a drifting brightness resemble each other: n of them count as n (1 − r) / (1 + r), with r
    the correlation of neighbours. A straight line through them makes r too small, by about (2 + 4 r) / n.
    """
    hours = (t - t.mean()) / 3600.0
    n, square = len(y), float(hours @ hours)
    slope = float(hours @ y) / square
    residuals = y - y.mean() - slope * hours
    rss = float(residuals @ residuals)
    if rss <= 1e-24 * float(y @ y):
        return slope, 0.0, 0.0 if slope else 1.0
    r = float(residuals[1:] @ residuals[:-1]) / rss
    r += (2.0 + 4.0 * max(r, 0.0)) / n
    r = min(r, 0.98) if r > 2.0 / math.sqrt(n) else 0.0
    count = max(n * (1.0 - r) / (1.0 + r), 3.0)
    freedom = max(count - 2.0, 1.0)
    sigma = math.sqrt(rss / (n - 2.0) / square * n / count)
    return slope, sigma, chance_t(slope / sigma, freedom)


def _variation(t: Array, y: Array) -> Variation:
    """Structure function over classes of lapse that double, and Allan deviation where the intervals are equal."""
    n = len(t)
    intervals = np.diff(t)
    step = float(np.median(intervals))
    even = bool((np.abs(intervals - step) <= _EVEN * step).all())
    lapses, structure, pairs, allan = [], [], [], []
    for power in range(_CLASSES):
        m = 2**power
        if m > n // 2:
            break
        # The same number of measurements apart, and for uneven times only those about as far apart in time.
        apart = t[m:] - t[:-m]
        use = np.ones(n - m, bool) if even else np.abs(apart - m * step) <= 0.5 * m * step
        if use.sum() < 3:
            continue
        lapses.append(float(apart[use].mean()))
        structure.append(math.sqrt(float(((y[m:] - y[:-m])[use] ** 2).mean()) / 2.0))
        pairs.append(int(use.sum()))
        allan.append(_allan(y, m) if even else math.nan)
    return Variation(np.array(lapses), np.array(structure), np.array(pairs, np.int64), np.array(allan))


def _allan(y: Array, m: int) -> float:
    """Deviation of overlapping means of m values: root of half the mean square of differences of adjacent means."""
    total = np.concatenate([[0.0], np.cumsum(y - y.mean())])
    means = (total[m:] - total[:-m]) / m
    if len(means) <= m:
        return math.nan
    return math.sqrt(float(((means[m:] - means[:-m]) ** 2).mean()) / 2.0)
