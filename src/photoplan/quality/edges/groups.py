"""Measurements of several edges combined: robust weighted means with intervals, mean MTF curves, field cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import ndtri, stdtrit

from photoplan.errors import InputError
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.spread import gaussian_modulation

Array = NDArray[np.float64]

#: Residuals beyond so many standard deviations count less.
_CRITICAL = 2.5
#: Highest frequency that the Gaussian is compared at, cycles per pixel: what lies above is aliasing.
NYQUIST = 0.5
#: Frequencies of a mean curve for each cycle per pixel.
_FINE = 100


@dataclass(frozen=True)
class CombinedValue:
    """A mean of several edges."""

    value: float
    """NaN if no edge has the figure."""
    interval: tuple[float, float]
    """In which the mean lies with the confidence asked for; NaN for a single edge without an interval of its own."""
    sigma: float
    """Standard deviation of the mean."""
    scatter: float
    """Standard deviation of single edges about the mean beyond what their own noise explains; 0 if it explains all."""
    edges: int
    """Edges that have the figure."""


def combine(
    values: Sequence[float],
    sigmas: Sequence[float],
    confidence: float = 0.95,
    *,
    freedom: float = inf,
    least: float = -inf,
) -> CombinedValue:
    """Mean of figures that have errors of their own and differ from edge to edge besides.

    Weights are 1 / (σ² + τ²): τ, what edges differ by beyond their noise, follows from their spread (the estimate of
    Paule and Mandel 1982), so that neither the sharpest measured edge decides alone nor a noisy one counts in full.
    Edges far from the others get less weight (Huber, 2.5 standard deviations). The standard deviation of the mean is
    that of the weighted residuals (Hartung and Knapp 2001), but not less than the edges' own errors make it. These are
    known by `freedom` degrees each, only the rest follows from the few edges: the interval is that of Student's
    distribution with the degrees of freedom that both have together (after Satterthwaite 1946): σ² over the sum of
    rest² / (n − 1) and of the edges' parts by their own.
    """
    if not 0.0 < confidence < 1.0:
        raise InputError(f"confidence {confidence:g}; it lies between 0 and 1")
    v, s = np.asarray(values, float), np.asarray(sigmas, float)
    known = np.isfinite(v)
    v, s = v[known], s[known]
    n = len(v)
    if n == 0:
        return CombinedValue(value=nan, interval=(nan, nan), sigma=nan, scatter=nan, edges=0)
    good = np.isfinite(s) & (s > 0.0)
    s = np.where(good, s, float(np.median(s[good])) if good.any() else 0.0)
    # An error that is stated as far too small must not decide alone.
    s = np.maximum(s, 0.2 * float(np.median(s)))
    if n == 1:
        reach = _quantile(confidence, freedom) * float(s[0]) if good.any() else nan
        return CombinedValue(
            value=float(v[0]),
            interval=(max(float(v[0]) - reach, least), float(v[0]) + reach),
            sigma=float(s[0]),
            scatter=0.0,
            edges=1,
        )
    keep = np.ones(n)
    mean = float(np.median(v))
    tau2 = 0.0
    for _ in range(20):
        tau2 = _between(v, s, keep)
        total = np.maximum(s**2 + tau2, 1e-300)
        weight = keep / total
        new = float(weight @ v / weight.sum())
        far = np.abs(v - new) / np.sqrt(total)
        following = np.minimum(1.0, _CRITICAL / np.maximum(far, 1e-12)) if n > 3 else keep
        done = abs(new - mean) <= 1e-9 * max(abs(new), 1e-12) and np.allclose(following, keep, atol=1e-6)
        mean, keep = new, following
        if done:
            break
    weight = keep / np.maximum(s**2 + tau2, 1e-300)
    share = weight / weight.sum()
    sigma = sqrt(float(share @ (v - mean) ** 2) / (n - 1))
    # Less than the edges' own errors allow is luck, not accuracy.
    parts = share**2 * s**2
    own = float(parts.sum())
    sigma = max(sigma, sqrt(own))
    rest = max(sigma**2 - own, 0.0)
    # Each edge's part is known by its own degrees of freedom, alike edges together by as many times more.
    unsure = rest / (n - 1) + float(parts @ parts) / (max(own, 1e-300) * freedom)
    reach = _quantile(confidence, sigma**2 / unsure if unsure > 1e-9 * sigma**2 else inf) * sigma
    return CombinedValue(
        value=mean, interval=(max(mean - reach, least), mean + reach), sigma=sigma, scatter=sqrt(tau2), edges=n
    )


def _between(v: Array, s: Array, keep: Array) -> float:
    """Variance between edges: that with which the weighted squares add up to their expectation."""
    n = len(v)

    def excess(tau2: float) -> float:
        weight = keep / np.maximum(s**2 + tau2, 1e-300)
        mean = float(weight @ v / weight.sum())
        return float(weight @ (v - mean) ** 2) - (float(keep.sum()) * (n - 1) / n)

    low, high = 0.0, float(np.var(v)) * n + 1e-300
    if excess(0.0) <= 0.0:
        return 0.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return (low + high) / 2


def mean_curve(curves: Sequence[MtfCurve]) -> MtfCurve:
    """Mean of MTF curves at common frequencies, with the standard deviation of the mean.

    Weights are those of the curves' standard deviations, as in `combine`; the frequencies end where the first curve
    does, at 1 at the latest.
    """
    if not curves:
        raise InputError("a mean of MTF curves needs one curve at least")
    end = min(1.0, *(float(c.frequency[-1]) for c in curves))
    frequency = np.linspace(0.0, end, max(2, round(_FINE * end) + 1))
    values = np.array([np.interp(frequency, c.frequency, c.modulation) for c in curves])
    sigmas = np.array(
        [
            np.full(len(frequency), nan) if c.sigma is None else np.interp(frequency, c.frequency, c.sigma)
            for c in curves
        ]
    )
    mean, sigma = np.ones(len(frequency)), np.zeros(len(frequency))
    for k in range(1, len(frequency)):
        one = combine(values[:, k].tolist(), sigmas[:, k].tolist())
        mean[k], sigma[k] = one.value, one.sigma
    return MtfCurve(frequency, mean, sigma)


@dataclass(frozen=True)
class GaussianFit:
    """The Gaussian that is nearest to an MTF."""

    fwhm: float
    """Full width at half maximum of its spread function, pixels."""
    rms: float
    """Root mean square of the differences of both MTFs up to half a cycle per pixel."""


def fit_gaussian(curve: MtfCurve) -> GaussianFit:
    """The Gaussian whose MTF has the least squares of differences from a curve up to half a cycle per pixel."""
    below = curve.frequency <= NYQUIST + 1e-9
    frequency, modulation = curve.frequency[below], curve.modulation[below]

    def squares(fwhm: float) -> float:
        return float(((gaussian_modulation(fwhm, frequency) - modulation) ** 2).mean())

    tried = np.geomspace(0.05, 40.0, 60)
    k = int(np.argmin([squares(f) for f in tried]))
    low, high = tried[max(k - 1, 0)], tried[min(k + 1, len(tried) - 1)]
    found = minimize_scalar(squares, bounds=(low, high), method="bounded", options={"xatol": 1e-6})
    return GaussianFit(float(found.x), sqrt(float(found.fun)))


def field_cell(col: float, row: float, size: tuple[int, int], cells: int) -> tuple[int, int]:
    """Row and column of the cell of the field that a place lies in, the field cut into cells × cells."""
    across = min(max(int((col + 0.5) / size[0] * cells), 0), cells - 1)
    down = min(max(int((row + 0.5) / size[1] * cells), 0), cells - 1)
    return down, across


def sigma_of_interval(interval: tuple[float, float], confidence: float = 0.95, freedom: float = inf) -> float:
    """Standard deviation, of so many degrees of freedom, that an interval stands for; NaN if it has no ends."""
    low, high = interval
    if not (isfinite(low) and isfinite(high)):
        return nan
    return (high - low) / 2 / _quantile(confidence, freedom)


def _quantile(confidence: float, freedom: float) -> float:
    """How many standard deviations an interval reaches to each side."""
    part = 0.5 + confidence / 2
    return float(stdtrit(freedom, part) if isfinite(freedom) else ndtri(part))


def quantiles(values: Sequence[float], parts: Sequence[float]) -> list[float]:
    """Quantiles of the values that are known; NaN if none is."""
    known = np.asarray([v for v in values if isfinite(v)])
    return [float(np.quantile(known, p)) if known.size else nan for p in parts]
