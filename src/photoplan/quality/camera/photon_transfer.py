"""Photon transfer: temporal variance against mean grey value gives gain, read noise and full well.

Photons arrive independently, so the variance of electrons is their number, and with a gain K (grey values per electron)
the variance in squared grey values grows as K times the mean (Janesick 2007, ch. 5; EMVA 1288 release 4 linear,
section 2.4: σ²_y = σ²_read + K (μ_y − μ_bias)). Electrons of the dark current obey the same law, so dark frames lie on
the same line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan, sqrt

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.camera.frame_statistics import Level, check_level
from photoplan.quality.camera.straight_line import StraightLine, fit_line

#: Variance of rounding to whole grey values (Behr 1989, eq. 3.14); of other steps times their square.
QUANTISATION = 1.0 / 12.0
#: Below this variance rounding hides the noise (EMVA 1288 release 4 linear, eq. 53, 54).
LEAST_VARIANCE = 0.24
#: Share of zeros beyond which black is cut off and mean and variance are not those of the signal.
ZERO_SHARE = 0.005
#: Share of saturated samples beyond which the variance is cut off.
_SATURATED_SHARE = 1e-3
#: Part of the range up to saturation in which variance and mean are taken as linear (EMVA 1288, as for eq. 50).
_RANGE = 0.7


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """Result of photon transfer."""

    gain: float
    """K, grey values per electron."""
    gain_sigma: float
    read_noise_dn: float
    """Standard deviation of dark noise without rounding, grey values; NaN where `read_noise_refused` says why."""
    read_noise_dn_sigma: float
    read_noise_e: float
    """The same in electrons."""
    read_noise_e_sigma: float
    read_noise_refused: str
    full_well_dn: float
    """Signal at the peak of the variance, grey values above bias; NaN if the variance does not fall again."""
    full_well_dn_sigma: float
    full_well_e: float
    full_well_e_sigma: float
    bias_dn: float
    """Grey value without signal; NaN if unknown."""
    line: StraightLine
    mean: NDArray[np.float64]
    """Grey values of the levels, increasing."""
    variance: NDArray[np.float64]
    used: NDArray[np.bool_]
    """Levels that the line was fitted to."""


def is_clipped_dark(level: Level) -> bool:
    """Whether black is cut off: more zeros than noise about a positive bias would give."""
    return level.zero_share > ZERO_SHARE


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
    clipped = [level for level in dark if is_clipped_dark(level)]
    usable = [k for k, level in enumerate(dark) if level.frames >= 2 and not is_clipped_dark(level)]
    usable_dark = [dark[k] for k in usable]
    everything = [*levels, *usable_dark]
    mean = np.array([x.mean for x in everything])
    variance = np.array([x.temporal_variance for x in everything])
    degrees = np.array([x.degrees for x in everything])
    sound = np.array([x.saturated_share <= _SATURATED_SHARE and x.zero_share <= ZERO_SHARE for x in everything])
    peak = _peak(mean[: len(levels)], variance[: len(levels)], degrees[: len(levels)])
    top = mean[peak] if peak is not None else mean.max(initial=0.0)
    low = mean.min(initial=top)
    used = sound & ((mean <= low + _RANGE * (top - low)) | (peak is None))
    if np.count_nonzero(used[: len(levels)]) < 3:
        raise InputError(
            f"{np.count_nonzero(used[: len(levels)])} of {len(levels)} levels can be used (not saturated, not cut off "
            "at black, below 70 % of saturation); photon transfer needs 3"
        )
    line = _line(mean[used], variance[used], degrees[used])
    if line.slope <= 3 * line.slope_sigma:
        raise InputError(
            f"the variance does not grow with the mean (slope {line.slope:.3g} ± {line.slope_sigma:.2g}); these are "
            "not raw frames of a linear sensor, or their levels are too close together"
        )
    bias, bias_sigma = _bias(usable_dark, [exposures_ms[k] for k in usable if exposures_ms], black_level)
    read = _read_noise(line, bias, bias_sigma, clipped, step)
    well = _full_well(mean[: len(levels)], peak, line, bias if np.isfinite(bias) else low)
    return PhotonTransfer(line.slope, line.slope_sigma, *read, *well, bias, line, mean, variance, used)


def _line(mean: NDArray[np.float64], variance: NDArray[np.float64], degrees: NDArray[np.int_]) -> StraightLine:
    """Variance over mean; weights by the variance of a variance, from the line itself."""
    expected = np.maximum(variance, 1e-12)
    for _ in range(4):
        line = fit_line(mean, variance, expected * np.sqrt(2.0 / degrees))
        expected = np.maximum(line.at(mean), 0.1 * expected)
    return line


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


def _no_read_noise(total: float, total_sigma: float, bias: float, clipped: Sequence[Level], step: float) -> str:
    """Why there is no read noise; empty: there is."""
    if clipped:
        share = 100 * max(level.zero_share for level in clipped)
        return (
            f"black is cut off: {share:.3g} % of the samples of the dark frames are zero, so that their noise is not "
            "that of the sensor; raise the camera's black level"
        )
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
    line: StraightLine, bias: float, bias_sigma: float, clipped: Sequence[Level], step: float
) -> tuple[float, float, float, float, str]:
    """Read noise in grey values and electrons with sigmas, and why there is none."""
    total = float(line.at(bias))
    total_sigma = sqrt(line.sigma_at(bias) ** 2 + (line.slope * bias_sigma) ** 2) if np.isfinite(bias) else nan
    refused = _no_read_noise(total, total_sigma, bias, clipped, step)
    if refused:
        return nan, nan, nan, nan, refused
    read = sqrt(total - QUANTISATION * step**2)
    read_sigma = total_sigma / (2 * read)
    _, c01, c11 = line.covariance
    # The variance at the bias and the slope are correlated.
    with_slope = c01 + bias * c11
    relative = (read_sigma / read) ** 2 + c11 / line.slope**2 - with_slope / (read**2 * line.slope)
    in_electrons = read / line.slope
    return read, read_sigma, in_electrons, in_electrons * sqrt(max(relative, 0.0)), ""


def _full_well(
    mean: NDArray[np.float64], peak: int | None, line: StraightLine, bias: float
) -> tuple[float, float, float, float]:
    if peak is None:
        return nan, nan, nan, nan
    signal = float(mean[peak] - bias)
    gap = float(mean[min(peak + 1, len(mean) - 1)] - mean[max(peak - 1, 0)])
    sigma = gap / 2 / sqrt(3.0)  # anywhere between the neighbouring levels
    electrons = signal / line.slope
    relative = (sigma / signal) ** 2 + (line.slope_sigma / line.slope) ** 2
    return signal, sigma, electrons, electrons * sqrt(relative)
