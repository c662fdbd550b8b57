"""Photon transfer: gain, linearity, saturation, EMVA 1288."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, inf, isfinite, log10, nan, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfc

from photoplan.adjustment.least_squares import solve, spread
from photoplan.adjustment.statistics import chance_chi_square, chance_t
from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError
from photoplan.findings import with_sigma
from photoplan.quality.camera.geometry import fit_line
from photoplan.quality.camera.sensor import Level, check_level, cut_off

#: Variance of rounding to whole grey values (Behr 1989, eq. 3.14); of other steps times their square.
QUANTISATION = 1.0 / 12.0
#: Below this variance rounding hides the noise (EMVA 1288 release 4 linear, eq. 53, 54).
LEAST_VARIANCE = 0.24
#: Share of saturated samples beyond which the variance is cut off.
_SATURATED_SHARE = 1e-3
#: Chance of a false alarm below which a response is called bent, and levels scattered beyond their noise.
LEVEL = 0.001
#: Chance below which a bend is modelled: one that is missed makes the gain wrong, one too many only less certain.
_MODELLED = 0.05
#: Part of the signal that the bend of a sensor's response takes at the brightest level, standard deviation of sensors.
_USUAL_BEND = 0.05
#: Part of the range up to saturation in which variance and mean are taken as linear (EMVA 1288, as for eq. 50).
_RANGE = 0.7


@dataclass(frozen=True)
class VarianceCurve:
    """Temporal variance = value + slope · (mean − origin) + bend · (mean − origin)²."""

    origin: float
    """Grey value without light; where it is not known, that of the darkest level."""
    value: float
    slope: float
    bend: float
    """0 for a line."""
    covariance: tuple[tuple[float, ...], ...]
    """Covariances of value, slope and, if there is one, bend."""
    chi_square: float
    degrees: int

    @property
    def scatter(self) -> float:
        """Root mean square of the residuals in units of what the noise of the variances allows."""
        return sqrt(self.chi_square / self.degrees) if self.degrees else nan

    @property
    def fits(self) -> bool:
        """Return whether the residuals may be noise alone."""
        return not self.degrees or chance_chi_square(self.chi_square, self.degrees) >= LEVEL

    @property
    def chance_straight(self) -> float:
        """Chance that a response without bend looks as bent."""
        return 1.0 if len(self.covariance) < 3 else chance_t(self.bend / sqrt(self.covariance[2][2]), self.degrees)

    def at(self, mean: ArrayLike) -> Floats:
        """Variance at mean grey values, same shape."""
        x = np.asarray(mean, float) - self.origin
        return np.asarray(self.value + x * (self.slope + x * self.bend))


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """Result of photon transfer."""

    gain: float
    """K, grey values per electron, of little light."""
    gain_sigma: float
    read_noise_dn: float
    """Standard deviation of dark noise without rounding, grey values; NaN where `read_noise_refused` says why."""
    read_noise_dn_sigma: float
    read_noise_e: float
    """The same in electrons."""
    read_noise_e_sigma: float
    read_noise_refused: str
    full_well_dn: float
    """Signal of full elements, grey values above bias; NaN if the variance does not fall again."""
    full_well_dn_sigma: float
    full_well_e: float
    full_well_e_sigma: float
    bias_dn: float
    """Grey value without signal; NaN if unknown."""
    curve: VarianceCurve
    mean: Floats
    """Grey values of the levels, increasing."""
    variance: Floats
    used: Mask
    """Levels that the curve was fitted to."""

    @property
    def bent(self) -> bool:
        """Return whether the response is not linear, with a chance of error of 1 ‰."""
        return self.curve.chance_straight < LEVEL

    @property
    def compression_percent(self) -> float:
        """Part of the signal that the bend of the response has taken at the brightest level used; 0 for a line."""
        return -100 * self._reach * self.curve.bend / (3 * self.gain)

    @property
    def compression_percent_sigma(self) -> float:
        """Its standard deviation."""
        return 100 * self._reach * sqrt(self.curve.covariance[-1][-1]) / (3 * self.gain) if self.curve.bend else 0.0

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what the levels show against a line."""
        notes = []
        if self.curve.bend:
            notes.append(
                f"the response {'is not' if self.bent else 'may not be'} linear (chance of a straight one "
                f"{self.curve.chance_straight:.1g}): its bend takes "
                f"{with_sigma(self.compression_percent, self.compression_percent_sigma, '%')} at the brightest level "
                "used; the gain is that of little light"
            )
        if not self.curve.fits:
            notes.append(
                f"the levels scatter {self.curve.scatter:.2g} times as much about the curve as the noise of their "
                "variances allows; standard deviations are enlarged by that. Does the lamp or the camera's gain change?"
            )
        return tuple(notes)

    @property
    def _reach(self) -> float:
        return float(self.mean[self.used].max()) - self.curve.origin


def photon_transfer(
    bright: Sequence[Level],
    dark: Sequence[Level] = (),
    exposures_ms: Sequence[float] = (),
    black_level: float = nan,
    step: float = 1.0,
) -> PhotonTransfer:
    """Gain, read noise and full well from levels of different brightness.

    Parameters
    ----------
    bright : sequence of Level
        Flat frames, two or more at each level.
    dark : sequence of Level
        Dark frames, the shortest exposure first; its mean is the bias.
    exposures_ms : sequence of float, optional
        Of the dark frames. Where they show a dark current, the bias is the grey value at no exposure.
    black_level : float
        The bias where there are no dark frames; NaN: unknown, and the read noise is refused.
    step : float
        Distance of neighbouring grey values.

    Raises
    ------
    InputError
        Fewer than three levels are neither saturated nor cut off at black, or the variance does not grow with the mean.
    """
    levels = sorted((x for x in bright if x.frames >= 2), key=lambda x: x.mean)
    if len(levels) < len(bright):
        raise InputError(f"{len(bright) - len(levels)} levels have a single frame; variance needs two or more of each")
    for level in levels:
        check_level(level)
    usable = [k for k, level in enumerate(dark) if level.frames >= 2 and not level.is_cut_off]
    usable_dark = [dark[k] for k in usable]
    everything = [*levels, *usable_dark]
    mean = np.array([x.mean for x in everything])
    variance = np.array([x.temporal_variance for x in everything])
    degrees = np.array([x.degrees for x in everything])
    sound = np.array([x.saturated_share <= _SATURATED_SHARE and not x.is_cut_off for x in everything])
    peak = _peak(mean[: len(levels)], variance[: len(levels)], degrees[: len(levels)])
    # Behind the peak of the variance the brightest level shows where elements are full.
    top = levels[-1].mean if peak is not None else mean.max(initial=0.0)
    low = mean.min(initial=top)
    below = mean <= low + _RANGE * (top - low)
    used = sound & ((peak is None) | (below & (mean <= mean[peak or 0])))
    if np.count_nonzero(used[: len(levels)]) < 3:
        raise InputError(
            f"{np.count_nonzero(used[: len(levels)])} of {len(levels)} levels can be used (not saturated, not cut off "
            "at black, below 70 % of saturation); photon transfer needs 3"
        )
    bias, bias_sigma = _bias(usable_dark, [exposures_ms[k] for k in usable if exposures_ms], black_level)
    curve = _curve(mean[used], variance[used], degrees[used], bias if np.isfinite(bias) else low)
    gain_sigma = sqrt(curve.covariance[1][1])
    if curve.slope <= 3 * gain_sigma:
        raise InputError(
            f"the variance does not grow with the mean (slope {with_sigma(curve.slope, gain_sigma)}); these are "
            "not raw frames of a linear sensor, or their levels are too close together"
        )
    read = _read_noise(curve, bias, bias_sigma, dark, step)
    well = _full_well(levels, peak, curve)
    return PhotonTransfer(
        gain=curve.slope,
        gain_sigma=gain_sigma,
        read_noise_dn=read[0],
        read_noise_dn_sigma=read[1],
        read_noise_e=read[2],
        read_noise_e_sigma=read[3],
        read_noise_refused=read[4],
        full_well_dn=well[0],
        full_well_dn_sigma=well[1],
        full_well_e=well[2],
        full_well_e_sigma=well[3],
        bias_dn=bias,
        curve=curve,
        mean=mean,
        variance=variance,
        used=used,
    )


def _curve(mean: Floats, variance: Floats, degrees: NDArray[np.int_], origin: float) -> VarianceCurve:
    """A line, or a parabola where that is significantly better and not all of the levels are needed for it."""
    bent = _polynomial(mean, variance, degrees, origin, 2) if len(mean) > 4 else None
    return (
        bent
        if bent is not None and bent.chance_straight < _MODELLED
        else _polynomial(mean, variance, degrees, origin, 1)
    )


def _polynomial(mean: Floats, variance: Floats, degrees: NDArray[np.int_], origin: float, degree: int) -> VarianceCurve:
    """Variance over mean; weights by the variance of a variance, from the curve itself."""
    reach = float(np.abs(mean - origin).max()) or 1.0
    design = np.vander((mean - origin) / reach, degree + 1, increasing=True)
    expected = np.maximum(variance, 1e-12)
    fit = solve(design, variance, degrees / (2.0 * expected**2))
    for _ in range(4):
        A, y, weight = design, variance, degrees / (2.0 * expected**2)
        if degree == 2:
            # That a sensor's response bends by little is one more observation: it counts where the levels say less.
            usual = 3.0 * _USUAL_BEND * abs(fit.unknowns[1])
            A, y, weight = np.vstack([A, [0.0, 0.0, 1.0]]), np.append(y, 0.0), np.append(weight, usual**-2.0)
        fit = solve(A, y, weight)
        expected = np.maximum(design @ fit.unknowns, 0.1 * expected)
    scale = reach ** -np.arange(3.0)
    Q = fit.cofactors * np.multiply.outer(scale[: degree + 1], scale[: degree + 1])
    value, slope, bend = (float(v) for v in np.pad(fit.unknowns, (0, 2 - degree)) * scale)
    found = VarianceCurve(
        origin=origin,
        value=value,
        slope=slope,
        bend=bend,
        covariance=tuple(map(tuple, Q.tolist())),
        chi_square=fit.square,
        degrees=fit.redundancy,
    )
    # Residuals that are significantly larger than the noise of the variances enlarge what is stated.
    return found if found.fits else replace(found, covariance=tuple(map(tuple, (Q * found.scatter**2).tolist())))


def _peak(mean: Floats, variance: Floats, degrees: NDArray[np.int_]) -> int | None:
    """Level of the largest variance, if the variance falls significantly behind it."""
    if not len(mean):
        return None
    top = int(np.argmax(variance))
    behind = variance[top + 1 :]
    limit = variance[top] * (1 - 5 * np.sqrt(2.0 / degrees[top]))
    return top if behind.size and behind[-1] < limit else None


def _bias(dark: Sequence[Level], exposures_ms: Sequence[float], black_level: float) -> tuple[float, float]:
    """Grey value without light and dark current, and its sigma."""
    if not dark:
        return black_level, 0.0
    timed = [(t, level) for t, level in zip(exposures_ms, dark) if level.saturated_share <= _SATURATED_SHARE]
    if len({t for t, _ in timed}) >= 3:
        sigma = [max(level.mean_sigma, 1e-9) for _, level in timed]
        line = fit_line([t for t, _ in timed], [level.mean for _, level in timed], sigma)
        if line.slope > 3 * line.slope_sigma:
            return line.offset, line.offset_sigma
    return dark[0].mean, dark[0].mean_sigma


def _no_read_noise(total: float, total_sigma: float, bias: float, dark: Sequence[Level], step: float) -> str:
    """Return why there is no read noise; empty if there is."""
    cut = cut_off(dark, " of the dark frames")
    if cut:
        return f"{cut}, so that their noise is not that of the sensor; raise the camera's black level"
    if not np.isfinite(bias):
        return "the grey value without light is not known; add dark frames or camera.black_level_dn"
    if total < LEAST_VARIANCE * step**2:
        return (
            f"the variance without light is {total:.3g} DN²; below {LEAST_VARIANCE * step**2:.3g} DN² rounding hides "
            "the noise: raise the camera's gain"
        )
    if total - QUANTISATION * step**2 < 2 * total_sigma:
        return f"the variance without light is {with_sigma(total, total_sigma, 'DN²')}: not significant"
    return ""


def _read_noise(
    curve: VarianceCurve, bias: float, bias_sigma: float, dark: Sequence[Level], step: float
) -> tuple[float, float, float, float, str]:
    """Read noise in grey values and electrons with sigmas, and why there is none."""
    total, C, K = curve.value, curve.covariance, curve.slope
    total_sigma = sqrt(C[0][0] + (K * bias_sigma) ** 2)
    refused = _no_read_noise(total, total_sigma, bias, dark, step)
    if refused:
        return nan, nan, nan, nan, refused
    read = sqrt(total - QUANTISATION * step**2)
    read_sigma = total_sigma / (2 * read)
    # The variance at the bias and the slope are correlated.
    relative = (read_sigma / read) ** 2 + C[1][1] / K**2 - C[0][1] / (read**2 * K)
    return read, read_sigma, read / K, read / K * sqrt(max(relative, 0.0)), ""


def _full_well(levels: Sequence[Level], peak: int | None, curve: VarianceCurve) -> tuple[float, float, float, float]:
    """Signal of full elements and electrons, with sigmas: that of the brightest level, behind the peak of the variance.

    What it may still lack is a part of its distance from the level before, in which fewer elements are full.
    """
    if peak is None:
        return nan, nan, nan, nan
    last, before = levels[-1], levels[-2]
    signal = last.mean - curve.origin
    sigma = hypot(last.mean_sigma, (last.mean - before.mean) / sqrt(12.0))
    # y = K e − a e² with a = −K · bend / 3, solved for e.
    electrons = signal / curve.slope * (1 - curve.bend * signal / (3 * curve.slope))
    return signal, sigma, electrons, electrons * hypot(sigma / signal, sqrt(curve.covariance[1][1]) / curve.slope)


#: Parts of saturation between which levels count (EMVA 1288 release 4 linear).
LOW, HIGH = 0.05, 0.95


@dataclass(frozen=True, eq=False)
class Linearity:
    """Result for one series of levels."""

    exposure: Floats
    """Exposures of the levels, increasing, in the unit that was given (ms, photons …)."""
    signal: Floats
    """Grey values above black."""
    response: Floats
    """Signal over exposure."""
    response_sigma: Floats
    segment: Floats
    """Slope between each level and the one before; NaN for the first."""
    used: Mask
    """Levels between 5 % and 95 % of saturation."""
    offset: float
    slope: float
    """Line of least relative deviations."""
    slope_sigma: float
    deviation_percent: Floats
    """Relative deviation from the line, %."""
    error_percent: float
    """Linearity error: mean absolute deviation of the used levels."""
    error_percent_sigma: float
    """With what noise alone is expected to add to the error."""
    error_min_percent: float
    """Largest negative deviation of the used levels."""
    error_max_percent: float


def linearity(
    exposure: ArrayLike, signal: ArrayLike, sigma: ArrayLike, saturation: float, usable: ArrayLike | None = None
) -> Linearity:
    """Linearity error and response of levels."""
    order = np.argsort(np.asarray(exposure, float), kind="stable")
    x, y, s = (np.asarray(v, float)[order] for v in (exposure, signal, sigma))
    if x.size and (x[0] <= 0 or (np.diff(x) <= 0).any()):
        raise InputError("exposures must be positive and differ from level to level")
    used = (y >= LOW * saturation) & (y <= HIGH * saturation)
    if usable is not None:
        used &= np.asarray(usable, bool)[order]
    _refuse_falling(x, y, s, HIGH * saturation)
    if np.count_nonzero(used) < 3:
        raise InputError(
            f"{np.count_nonzero(used)} of {x.size} levels lie between 5 % and 95 % of saturation ({saturation:.4g} "
            "DN); linearity needs 3"
        )
    u, v = x[used], y[used]
    design = np.column_stack([1 / v, u / v])  # minimises the sum of ((y − a − b x) / y)²
    fit = solve(design, np.ones_like(u))
    offset, slope = fit.unknowns
    fitted = offset + slope * x
    deviation = 100 * (y - fitted) / fitted
    error = float(np.abs(deviation[used]).mean())
    relative = s[used] / v
    error_sigma = _error_sigma(deviation[used], np.eye(u.size) - design @ fit.influence, 100 * relative)
    with np.errstate(invalid="ignore"):
        segment = np.concatenate([[np.nan], np.diff(y) / np.diff(x)])
    return Linearity(
        exposure=x,
        signal=y,
        response=y / x,
        response_sigma=s / x,
        segment=segment,
        used=used,
        offset=float(offset),
        slope=float(slope),
        slope_sigma=float(np.sqrt((fit.influence[1] ** 2) @ relative**2)),
        deviation_percent=deviation,
        error_percent=error,
        error_percent_sigma=error_sigma,
        error_min_percent=float(deviation[used].min()),
        error_max_percent=float(deviation[used].max()),
    )


def _error_sigma(deviation: Floats, residual: Floats, sigma: Floats) -> float:
    """Standard deviation of a mean of absolute deviations, which share the noise of the line.

    Noise alone makes an amount larger than 0, so what it is expected to add to each counts as well.
    """
    scatter = (np.sign(deviation) @ residual / deviation.size) * sigma
    spread = np.maximum(np.sqrt(residual**2 @ sigma**2), 1e-12)
    # What all deviations together have beyond twice the noise: less may be noise alone.
    share = max(0.0, 1 - 2 * float(np.sum(spread**2)) / max(float(np.sum(deviation**2)), 1e-300))
    true = np.abs(deviation) * np.sqrt(share)
    # The mean of the amount of a Gaussian variable about `true`, less that.
    added = spread * np.sqrt(2 / np.pi) * np.exp(-0.5 * (true / spread) ** 2) - true * erfc(true / spread / np.sqrt(2))
    return float(np.hypot(np.sqrt(scatter @ scatter), added.mean()))


def _refuse_falling(x: Floats, y: Floats, s: Floats, top: float) -> None:
    """A signal that falls while the exposure grows is no series of exposures."""
    noise = 5 * np.hypot(s[1:], s[:-1]) + 0.01 * np.maximum(np.abs(y[:-1]), 1.0)
    falls = (np.diff(y) < -np.nan_to_num(noise)) & (y[:-1] < top)
    if falls.any():
        k = int(np.argmax(falls))
        raise InputError(
            f"the signal falls from {y[k]:.4g} to {y[k + 1]:.4g} DN while the exposure grows from {x[k]:g} to "
            f"{x[k + 1]:g}; check the exposures of the frames, the lamp, and that automatic gain is off"
        )


#: Share of samples at the largest grey value from which on a level is clipped.
_CLIPPED = 0.01
#: Share at the last level from which on it shows saturation, not a bright spot.
_MOSTLY = 0.5
#: Standard deviations below the level of a full sensor down to which its samples lie.
_SPREAD = 4.0
#: Part of the response that is lost where a level departs from the line.
_DEPARTED = 0.05


@dataclass(frozen=True)
class Saturation:
    """Level of saturation, and its cause."""

    level_dn: float
    """Mean grey value of the most exposed level: what saturation looks like."""
    rule: str
    """``clipping``, ``response`` or ``variance``."""
    last_unsaturated: float
    """Largest exposure without the sign."""
    first_saturated: float
    exposure: float
    """Exposure at which the line of the darker levels reaches `level_dn`; NaN if it lies not between the two."""
    exposure_sigma: float


@dataclass(frozen=True)
class FullWell:
    """A sensor that is full below the largest grey value that is written."""

    level_dn: float
    """Grey value of its full elements, their median."""
    least_dn: float
    """Grey value from which on a sample may be one of a full element."""


def full_well(mean: ArrayLike, temporal_variance: float, step: float = 1.0) -> FullWell:
    """Grey values of full elements, from frames in which most elements are full."""
    values = np.asarray(mean, float)
    level = float(np.median(values))
    pattern = spread(values, level)
    noise = sqrt(pattern**2 + (temporal_variance if isfinite(temporal_variance) else 0.0) + step**2 / 12)
    return FullWell(level, level - _SPREAD * noise)


def find_saturation(
    exposure: ArrayLike, mean: ArrayLike, black: float, saturated_share: ArrayLike, variance: ArrayLike | None = None
) -> Saturation | None:
    """Saturation of levels with growing exposure; None where none of them shows a sign of it."""
    x, y, share = (np.asarray(v, float) for v in (exposure, mean, saturated_share))
    if x.size < 4 or (np.diff(x) <= 0).any():
        raise InputError(f"{x.size} levels; saturation needs four of increasing exposure")
    if not isfinite(black):
        black = _black_of_line(x[: max(3, x.size // 2)], y[: max(3, x.size // 2)])
    signal = y - black
    found = {
        "clipping": _first(share > _CLIPPED) if share[-1] >= _MOSTLY else None,
        "response": _first_departure(x, signal),
        "variance": None if variance is None else _first_collapse(np.asarray(variance, float)),
    }
    if found["clipping"] == 0:
        raise InputError("every level has saturated samples; take shorter exposures")
    known = {rule: k for rule, k in found.items() if k is not None and k > 0}
    if not known:
        return None
    rule = min(known, key=lambda name: (known[name], list(known).index(name)))
    first = known[rule]
    level = float(y[-1])
    response = float(np.median(signal[:first] / x[:first]))
    # Of a median, whose variance is π / 2 times that of a mean.
    spread = float(np.std(signal[:first] / x[:first])) * sqrt(pi / 2 / max(first - 1, 1))
    at = (level - black) / response if response > 0 else inf
    # Clipped shares begin before the mean arrives: the crossing may lie a little outside of the two levels.
    inside = 0.8 * x[first - 1] <= at <= 1.2 * x[first]
    sigma = at * spread / response if inside and first > 1 else nan
    return Saturation(
        level_dn=level,
        rule=rule,
        last_unsaturated=float(x[first - 1]),
        first_saturated=float(x[first]),
        exposure=at if inside else nan,
        exposure_sigma=sigma,
    )


def _black_of_line(x: Floats, y: Floats) -> float:
    """Grey value at no exposure of the line of least relative deviations; not below 0, nor above the darkest level."""
    below = np.maximum(y, 1e-300)
    offset, _ = solve(np.column_stack([1 / below, x / below]), np.ones_like(x)).unknowns
    return float(np.clip(offset, 0.0, max(0.0, float(y[0]))))


def _first(signs: Mask) -> int | None:
    """The first level from which on all show the sign."""
    without = np.flatnonzero(~signs)
    first = int(without[-1]) + 1 if without.size else 0
    return first if first < signs.size else None


def _first_departure(x: Floats, signal: Floats) -> int | None:
    """Level from which on the response stays below that of the darker ones, with a flat end."""
    with np.errstate(invalid="ignore", divide="ignore"):
        response = signal / x
    reference = float(np.median(response[: max(2, x.size // 2)]))
    first = _first(response < (1 - _DEPARTED) * reference)
    if first is None or first == x.size:
        return None
    last_slope = (signal[-1] - signal[-2]) / (x[-1] - x[-2])
    return first if last_slope < 0.1 * reference else None


def _first_collapse(variance: Floats) -> int | None:
    """Level behind the largest variance, where the last is less than half of it."""
    if not np.isfinite(variance).all():
        return None
    top = int(np.argmax(variance))
    return top + 1 if top + 1 < variance.size and variance[-1] < 0.5 * variance[top] else None


#: Part of the signal at saturation up to which levels count, by the standard.


@dataclass(frozen=True, eq=False)
class EmvaPoints:
    """Levels of one measurement: bright and dark at the same exposure; arrays of shape (n,)."""

    photons: Floats
    """Mean photons per pixel; NaN: unknown (then neither efficiency nor threshold)."""
    mean: Floats
    variance: Floats
    dark_mean: Floats
    dark_variance: Floats
    samples: Floats
    """Degrees of freedom of each variance."""
    mean_sigma: Floats
    """Standard deviation of the signal (mean less dark mean), the flicker of the lamp included."""

    def __post_init__(self) -> None:
        shapes = set()
        for name in ("photons", "mean", "variance", "dark_mean", "dark_variance", "samples", "mean_sigma"):
            array = np.array(getattr(self, name), np.float64)
            array.setflags(write=False)
            shapes.add(array.shape)
            object.__setattr__(self, name, array)
        if len(shapes) != 1 or self.mean.ndim != 1 or self.mean.size < 5:
            raise InputError(f"{self.mean.size} levels; the EMVA 1288 sheet needs five, each with all of its figures")

    def sorted(self) -> EmvaPoints:
        """By growing signal."""
        order = np.argsort(self.photons if np.isfinite(self.photons).all() else self.mean, kind="stable")
        return EmvaPoints(*(getattr(self, name)[order] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class EmvaSheet:
    """The figures; NaN where `refused` says why."""

    gain: float
    """K, DN per electron."""
    gain_sigma: float
    responsivity: float
    """R, DN per photon."""
    responsivity_sigma: float
    quantum_efficiency_percent: float
    quantum_efficiency_percent_sigma: float
    temporal_dark_noise_dn: float
    temporal_dark_noise_e: float
    temporal_dark_noise_e_sigma: float
    saturation_photons: float
    saturation_e: float
    saturation_e_sigma: float
    threshold_photons: float
    """Absolute sensitivity threshold: photons at which signal and noise are equal."""
    threshold_e: float
    dynamic_range: float
    dynamic_range_db: float
    snr_max: float
    snr_max_db: float
    linearity: Linearity | None
    saturation_index: int
    """Level of the largest variance."""
    used: Mask
    """Levels between 0 and 70 % of saturation."""
    refused: Mapping[str, str]


def emva_sheet(points: EmvaPoints, step: float = 1.0) -> EmvaSheet:
    """The sheet of a measurement, whose grey values have a distance of `step`."""
    p = points.sorted()
    refused: dict[str, str] = {}
    signal, variance = p.mean - p.dark_mean, p.variance - p.dark_variance
    top = int(np.argmax(p.variance))
    reached = top + 1 < p.mean.size and p.variance[-1] < 0.5 * p.variance[top]
    if not reached:
        refused["saturation"] = (
            "the variance does not fall at the brightest levels: saturation was not reached; take longer exposures"
        )
    used = (signal <= _RANGE * signal[top]) & (np.arange(signal.size) <= top)
    if np.count_nonzero(used & (signal > 0)) < 3:
        raise InputError("fewer than three levels lie between dark and 70 % of saturation")
    weights = np.sqrt(2.0 / p.samples[used]) * np.hypot(p.variance[used], p.dark_variance[used])
    gain, gain_sigma = _through_origin(signal[used], variance[used], weights)
    if not gain > 3 * gain_sigma:
        raise InputError("the variance does not grow with the signal; these are not raw frames of a linear sensor")
    light = _responsivity(p, signal, used, refused)
    efficiency = 100 * light[0] / gain
    efficiency_sigma = efficiency * sqrt((light[1] / light[0]) ** 2 + (gain_sigma / gain) ** 2) if light[0] > 0 else nan
    dark_dn, dark_e, dark_sigma = _dark_noise(p, (gain, gain_sigma), step, refused)
    well = _saturation(p, signal, top if reached else None, gain, gain_sigma, light[0])
    threshold_e = sqrt(p.dark_variance[0] / gain**2 + 0.25) + 0.5 if isfinite(dark_e) else nan
    threshold = threshold_e / (light[0] / gain) if light[0] > 0 else nan
    rng = well[0] / threshold if isfinite(well[0]) and isfinite(threshold) else _ratio(well[1], threshold_e)
    snr = sqrt(well[1]) if isfinite(well[1]) else nan
    return EmvaSheet(
        gain=gain,
        gain_sigma=gain_sigma,
        responsivity=light[0],
        responsivity_sigma=light[1],
        quantum_efficiency_percent=efficiency,
        quantum_efficiency_percent_sigma=efficiency_sigma,
        temporal_dark_noise_dn=dark_dn,
        temporal_dark_noise_e=dark_e,
        temporal_dark_noise_e_sigma=dark_sigma,
        saturation_photons=well[0],
        saturation_e=well[1],
        saturation_e_sigma=well[2],
        threshold_photons=threshold,
        threshold_e=threshold_e,
        dynamic_range=rng,
        dynamic_range_db=_db(rng),
        snr_max=snr,
        snr_max_db=_db(snr),
        linearity=_linearity(p, signal, top if reached else None, refused),
        saturation_index=top,
        used=used,
        refused=refused,
    )


def _ratio(a: float, b: float) -> float:
    return a / b if isfinite(a) and b > 0 else nan


def _db(ratio: float) -> float:
    return 20 * log10(ratio) if isfinite(ratio) and ratio > 0 else nan


def _through_origin(x: Floats, y: Floats, sigma: ArrayLike) -> tuple[float, float]:
    """Slope of an unweighted line through the origin, and its sigma by propagation, or by the scatter where larger."""
    slope = float(x @ y / (x @ x))
    stated = float(np.sqrt(np.sum((x * np.asarray(sigma)) ** 2)) / (x @ x))
    # Each residual by itself, since the noise may grow with x; enlarged by what the line took of it.
    residual = (y - slope * x) / np.sqrt(np.maximum(1 - x**2 / (x @ x), 0.1))
    scatter = float(np.sqrt(np.sum((x * residual) ** 2)) / (x @ x))
    return slope, max(stated, scatter)


def _responsivity(p: EmvaPoints, signal: Floats, used: Mask, refused: dict[str, str]) -> tuple[float, float]:
    if not np.isfinite(p.photons).all() or not (p.photons > 0).all():
        refused["quantum efficiency"] = (
            "photons per pixel are not stated; give photons_per_pixel, or irradiance_uw_cm2 with wavelength_nm, "
            "exposure_ms and camera.pixel_size_um"
        )
        return nan, nan
    return _through_origin(p.photons[used], signal[used], p.mean_sigma[used])


def _dark_noise(
    p: EmvaPoints, gain_of: tuple[float, float], step: float, refused: dict[str, str]
) -> tuple[float, float, float]:
    """Return the noise of the shortest exposure: grey values, electrons, sigma."""
    gain, gain_sigma = gain_of
    least, rounding = LEAST_VARIANCE * step**2, QUANTISATION * step**2
    variance = float(p.dark_variance[0])
    if not isfinite(variance):
        refused["dark noise"] = "there are no dark frames, two or more at an exposure"
        return nan, nan, nan
    if variance < least:
        refused["dark noise"] = (
            f"the dark variance is {variance:.3g} DN²; below {least:.3g} DN² rounding hides the noise, the "
            f"standard states it as below {0.4 * step / gain:.3g} electrons"
        )
        return sqrt(variance), nan, nan
    noise = sqrt(variance - rounding) / gain
    relative = variance * sqrt(2.0 / p.samples[0]) / (2 * (variance - rounding))
    return sqrt(variance), noise, noise * sqrt(relative**2 + (gain_sigma / gain) ** 2)


def _saturation(
    p: EmvaPoints, signal: Floats, top: int | None, gain: float, gain_sigma: float, responsivity: float
) -> tuple[float, float, float]:
    """Saturation capacity in photons and electrons, and the sigma of the latter by the spacing of the levels."""
    if top is None:
        return nan, nan, nan
    gap = float(signal[min(top + 1, signal.size - 1)] - signal[max(top - 1, 0)]) / 2 / sqrt(3.0)
    relative = sqrt((gap / signal[top]) ** 2 + (gain_sigma / gain) ** 2)
    if isfinite(responsivity):
        photons = float(p.photons[top])
        electrons = photons * responsivity / gain
        return photons, electrons, electrons * relative
    electrons = float(signal[top]) / gain
    return nan, electrons, electrons * relative


def _linearity(p: EmvaPoints, signal: Floats, top: int | None, refused: dict[str, str]) -> Linearity | None:
    if not np.isfinite(p.photons).all():
        refused["linearity error"] = "photons per pixel are not stated"
        return None
    limit = float(signal[top]) if top is not None else float(signal.max()) / 0.95
    end = signal.size if top is None else top + 1
    try:
        return linearity(p.photons[:end], signal[:end], p.mean_sigma[:end], limit)
    except InputError as error:
        refused["linearity error"] = str(error)
        return None
