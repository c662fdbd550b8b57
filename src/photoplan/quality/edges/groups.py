"""Groups of edges, enhancement and sharpness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, inf, isfinite, nan, radians, sqrt
from typing import Any, Protocol

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import ndtri, stdtrit

from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError
from photoplan.plain import pick
from photoplan.quality.curves import MtfCurve, gaussian_modulation
from photoplan.quality.edges.response import EdgeMeasurement, spread_from_response
from photoplan.quality.restoration.design import Sharpness

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


def _between(v: Floats, s: Floats, keep: Floats) -> float:
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


#: Mean of over- and undershoot from which an image counts as enhanced, parts of the contrast. Diffraction and ideal
#: optics leave none; noise and the interpolation of colours leave one or two hundredths.
LEAST = 0.02
#: How many standard deviations it must be above that.
_CLEAR = 2.0
#: With fewer edges a warning says so.
_FEW = 3


class EnhancedEdge(Protocol):
    """What is needed of the measurement of an edge."""

    @property
    def overshoot(self) -> float:
        """How far the profile rises above the bright level, parts of the contrast."""
        ...

    @property
    def undershoot(self) -> float:
        """How far it falls below the dark level, parts of the contrast."""
        ...


@dataclass(frozen=True)
class Enhancement:
    """Whether an image was sharpened, by its edges."""

    enhanced: bool
    """The mean of over- and undershoot is above 2 % by two standard deviations."""
    size: float
    """Mean of over- and undershoot over the edges, parts of the contrast."""
    sigma: float
    """Its standard deviation; NaN for a single edge without errors."""
    overshoot: CombinedValue
    undershoot: CombinedValue
    edges: int
    """Edges that were used."""
    share: float
    """Part of the edges of which both over- and undershoot are above 2 %."""

    @property
    def warning(self) -> str:
        """What a user must know; empty if nothing was found."""
        if not self.enhanced:
            return ""
        few = f" (by {self.edges} edge{'s' if self.edges > 1 else ''} only)" if self.edges < _FEW else ""
        return (
            f"edges are enhanced{few}: overshoot {100 * self.overshoot.value:.1f} %, undershoot "
            f"{100 * self.undershoot.value:.1f} % of the contrast. The image was sharpened; its MTF is that of lens "
            "and sharpening together, and restoration is limited: noise grew already. Use the unsharpened image "
            "if there is one"
        )

    def json_fields(self) -> dict[str, Any]:
        """Means flat, with the warning."""
        return {
            **pick(self, "enhanced", "size", "sigma", "edges", "share"),
            "overshoot": self.overshoot.value,
            "overshoot_sigma": self.overshoot.sigma,
            "undershoot": self.undershoot.value,
            "undershoot_sigma": self.undershoot.sigma,
            "warning": self.warning or None,
        }


def enhancement_of(edges: Sequence[EnhancedEdge]) -> Enhancement:
    """Judge edge enhancement by the over- and undershoot of all measured edges."""
    known = [e for e in edges if isfinite(e.overshoot) and isfinite(e.undershoot)]
    if not known:
        raise InputError("edge enhancement cannot be judged without a measured edge")
    over = combine([e.overshoot for e in known], [_sigma(e, "overshoot_sigma") for e in known])
    under = combine([e.undershoot for e in known], [_sigma(e, "undershoot_sigma") for e in known])
    both = combine(
        [(e.overshoot + e.undershoot) / 2 for e in known],
        [float(np.hypot(_sigma(e, "overshoot_sigma"), _sigma(e, "undershoot_sigma"))) / 2 for e in known],
    )
    share = float(np.mean([min(e.overshoot, e.undershoot) > LEAST for e in known]))
    sigma = both.sigma if isfinite(both.sigma) else 0.0
    enhanced = both.value - _CLEAR * sigma > LEAST
    return Enhancement(
        enhanced=enhanced,
        size=both.value,
        sigma=both.sigma,
        overshoot=over,
        undershoot=under,
        edges=len(known),
        share=share,
    )


def _sigma(edge: EnhancedEdge, name: str) -> float:
    """Standard deviation of a figure; NaN where the measurement states none."""
    value = getattr(edge, name, nan)
    return float(value) if value is not None else nan


#: Edges that a direction needs.
LEAST_EDGES = 3
#: Pixels to each side that are asked of a spread function; less where edges are not seen as far.
_HALF = 5
#: A mean curve ends where the share of edges that know it falls below this.
_KNOWN = 0.5
#: Share by which the MTF50 of edges may differ from the upper quartile.
_AGREE = 0.08
#: Standard deviation by which the modulation of edges differs besides what they state.
_ALIKE = 0.01
#: Where mean spread and transfer functions are tabulated: pixels, cycles per pixel.
_POSITIONS = np.linspace(-10.0, 10.0, 401)
_FREQUENCIES = np.linspace(0.0, 1.0, 201)


def sharpness_of(edges: Sequence[EdgeMeasurement]) -> tuple[Sharpness, Sharpness, tuple[str, ...]]:
    """Spread function and MTF along rows (x) and along columns (y).

    Edges of the object that are not sharp themselves, such as those of shadows and embankments, are left out, as Kölbl
    sought the sharpest (2006, §3): the edges count whose MTF50 agrees with the upper quartile to 8 % or two of their
    own standard deviations. An edge counts for the direction that brightness rises in, with the cosine of twice its
    angle to it: edges that run diagonally count for neither. It also counts by its length and the square of its
    contrast over noise, up to four times the median edge, so that none decides alone.

    Where one direction has fewer than three edges, that of the other stands for it.
    """
    found = {name: _along(edges, axis) for name, axis in (("x", 0.0), ("y", 90.0))}
    x, y = found["x"], found["y"]
    if x is None and y is None:
        raise InputError(
            f"{len(edges)} edges in all directions; at least {LEAST_EDGES} along rows, or along columns, are needed. "
            "Give images with more edges, or a filter"
        )
    if x is None or y is None:
        one = x or y
        assert one is not None
        return one, one, ("x" if x is None else "y",)
    return x, y, ()


def _along(edges: Sequence[EdgeMeasurement], axis: float) -> Sharpness | None:
    """Sharpness in the direction of an axis, degrees; None if too few edges show it."""
    shares = np.array([max(0.0, cos(2.0 * radians(edge.angle_deg - axis))) for edge in edges])
    used = [edge for edge, share in zip(edges, shares, strict=True) if share > 0.1]
    if len(used) < LEAST_EDGES:
        return None
    # A profile of few phases is a model between its samples, and no help beyond 0.5 cycles/pixel.
    sampled = np.array([edge.sampling == "super-sampled" for edge in used])
    trusted = sampled if sampled.sum() >= LEAST_EDGES else np.ones(len(used), bool)
    strength = np.array([min(edge.snr, 1e6) ** 2 * edge.length for edge in used])
    strength = np.minimum(strength, 4.0 * np.median(strength[trusted])) * shares[shares > 0.1]
    used, strength = [edge for edge, kept in zip(used, trusted, strict=True) if kept], strength[trusted]
    keep = _sharp(used, strength)
    return _together([edge for edge, kept in zip(used, keep, strict=True) if kept], strength[keep])


def _sharp(edges: Sequence[EdgeMeasurement], strength: Floats) -> Mask:
    """Which edges agree with the upper quartile of all; at least the three that are nearest to it."""
    mtf50 = np.array([edge.mtf50 for edge in edges])
    sigma = np.array([sigma_of_interval(edge.mtf50_interval, edge.confidence, edge.freedom) for edge in edges])
    known = np.isfinite(mtf50)
    if known.sum() < LEAST_EDGES:
        return np.ones(mtf50.size, bool)
    order = np.argsort(np.where(known, mtf50, np.inf))
    share = np.cumsum(np.where(known, strength, 0.0)[order])
    quartile = float(mtf50[order][int(np.searchsorted(share, 0.75 * share[-1]))])
    apart = np.where(known, np.abs(mtf50 - quartile), np.inf)
    keep = apart <= np.maximum(2.0 * np.nan_to_num(sigma), _AGREE * quartile)
    keep[np.argsort(apart)[:LEAST_EDGES]] = True
    return np.asarray(keep)


def _together(edges: Sequence[EdgeMeasurement], weights: Floats) -> Sharpness:
    responses = [
        np.interp(_POSITIONS, edge.esf.positions, edge.esf.values, left=np.nan, right=np.nan) for edge in edges
    ]
    response = _mean(np.array(responses), weights[:, None])
    known = np.isfinite(response)
    reach = float(np.abs(_POSITIONS[known]).max()) if known.any() else 0.0
    reach = min(reach, -float(_POSITIONS[known].min()), float(_POSITIONS[known].max())) if known.any() else 0.0
    half = min(_HALF, int(reach - 0.5))
    if half < 1:
        raise InputError("the edges are not seen far enough to both sides for a spread function")
    spread, _ = spread_from_response(_POSITIONS[known], response[known], half)
    curves = [np.interp(_FREQUENCIES, edge.mtf.frequency, edge.mtf.modulation, right=np.nan) for edge in edges]
    own = np.array([_own_sigma(edge.mtf) for edge in edges])
    # What an edge knows of light that is spread far differs more from edge to edge than what it knows of the rest.
    each = weights[:, None] / (own**2 + _ALIKE**2)
    curve = _mean(np.array(curves), each)
    sigma = _sigma_of_mean(np.array(curves) - curve, own, each)
    known = np.isfinite(curve)
    end = int(np.argmin(known)) if not known.all() else known.size
    return Sharpness(spread, MtfCurve(_FREQUENCIES[:end], curve[:end], sigma[:end]))


def _own_sigma(curve: MtfCurve) -> Floats:
    """Standard deviations that an edge states; 0 if it states none."""
    if curve.sigma is None:
        return np.zeros(_FREQUENCIES.size)
    return np.interp(_FREQUENCIES, curve.frequency, np.nan_to_num(curve.sigma))


def _sigma_of_mean(apart: Floats, own: Floats, weights: Floats) -> Floats:
    """Standard deviation of a mean curve: the larger of what edges state and what they differ by; all (edges, n)."""
    known = np.isfinite(apart)
    share = np.where(known, weights, 0.0)
    share /= np.maximum(share.sum(axis=0), 1e-300)
    count = np.maximum(known.sum(axis=0), 2)
    stated = (share**2 * own**2).sum(axis=0)
    scatter = (share**2 * np.where(known, apart, 0.0) ** 2).sum(axis=0) * count / (count - 1)
    return np.asarray(np.sqrt(np.maximum(stated, scatter)))


def _mean(values: Floats, weights: Floats) -> Floats:
    """Weighted mean over the edges that know a place; NaN where too few do. Shapes (edges, n) to (n,)."""
    known = np.isfinite(values)
    each = np.where(known, weights, 0.0)
    total = each.sum(axis=0)
    enough = total >= _KNOWN * weights.sum(axis=0)
    mean = np.where(known, values, 0.0) * each
    return np.where(enough, mean.sum(axis=0) / np.where(enough, total, 1.0), np.nan)
