"""Photon transfer: temporal variance against mean grey value gives gain, read noise and full well.

Photons arrive independently, so the variance of electrons is their number, and with a gain K (grey values per electron)
the variance in squared grey values grows as K times the mean (Janesick 2007, ch. 5; EMVA 1288 release 4 linear,
section 2.4: σ²_y = σ²_read + K (μ_y − μ_bias)). Electrons of the dark current obey the same law, so dark frames lie on
the same line.

A response that bends, y = K e − a e², has the variance (K − 2 a e)² e = K y − 3 (a / K) y² + …: three times the bend of
its mean. Where the levels show one, a parabola takes the place of the line, and K is its slope at black.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot, nan, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.chances import chance_chi_square, chance_t
from photoplan.adjustment.linear import solve
from photoplan.errors import InputError
from photoplan.quality.camera.frame_statistics import Level, check_level, cut_off
from photoplan.quality.camera.straight_line import fit_line

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
    """Of value, slope and, where there is one, bend."""
    chi_square: float
    degrees: int

    @property
    def scatter(self) -> float:
        """Root mean square of the residuals in units of what the noise of the variances allows."""
        return sqrt(self.chi_square / self.degrees) if self.degrees else nan

    @property
    def fits(self) -> bool:
        """Whether the residuals may be noise alone."""
        return not self.degrees or chance_chi_square(self.chi_square, self.degrees) >= LEVEL

    @property
    def chance_straight(self) -> float:
        """Chance that a response without bend looks as bent."""
        return 1.0 if len(self.covariance) < 3 else chance_t(self.bend / sqrt(self.covariance[2][2]), self.degrees)

    def at(self, mean: ArrayLike) -> NDArray[np.float64]:
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
    mean: NDArray[np.float64]
    """Grey values of the levels, increasing."""
    variance: NDArray[np.float64]
    used: NDArray[np.bool_]
    """Levels that the curve was fitted to."""

    @property
    def bent(self) -> bool:
        """Whether the response is not linear, with a chance of error of 1 ‰."""
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
        """What the levels say against a line."""
        notes = []
        if self.curve.bend:
            notes.append(
                f"the response {'is not' if self.bent else 'may not be'} linear (chance of a straight one "
                f"{self.curve.chance_straight:.1g}): its bend takes {self.compression_percent:.2g} ± "
                f"{self.compression_percent_sigma:.2g} % at the brightest level used; the gain is that of little light"
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
            f"the variance does not grow with the mean (slope {curve.slope:.3g} ± {gain_sigma:.2g}); these are "
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


def _curve(
    mean: NDArray[np.float64], variance: NDArray[np.float64], degrees: NDArray[np.int_], origin: float
) -> VarianceCurve:
    """A line, or a parabola where that is significantly better and not all of the levels are needed for it."""
    bent = _polynomial(mean, variance, degrees, origin, 2) if len(mean) > 4 else None
    return (
        bent
        if bent is not None and bent.chance_straight < _MODELLED
        else _polynomial(mean, variance, degrees, origin, 1)
    )


def _polynomial(
    mean: NDArray[np.float64], variance: NDArray[np.float64], degrees: NDArray[np.int_], origin: float, degree: int
) -> VarianceCurve:
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


def _peak(mean: NDArray[np.float64], variance: NDArray[np.float64], degrees: NDArray[np.int_]) -> int | None:
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
    """Why there is no read noise; empty: there is."""
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
        return f"the variance without light is {total:.3g} ± {total_sigma:.2g} DN²: not significant"
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
