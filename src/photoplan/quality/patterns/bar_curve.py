"""Frequency groups of bars joined to a contrast transfer function, and its conversion into an MTF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, pi

import numpy as np

from photoplan.errors import InputError
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.patterns.bars import BarContrast, fundamental_of_square

#: Bars with less bend than this have a flat middle, where their levels are those of wide areas.
FLAT = 0.02
#: With less bend the duty can be read from the profile.
_SHARP = 0.05


@dataclass(frozen=True, eq=False)
class BarCurve:
    """Transfer of bars against frequency."""

    groups: tuple[BarContrast, ...]
    """By increasing frequency."""
    low: float
    """Light of wide dark areas."""
    high: float
    """Light of wide bright areas."""
    levels_from: str
    """Where these levels come from, in words."""
    contrast: MtfCurve
    """Contrast transfer of square waves (CTF), from the extremes; not an MTF."""
    mtf: MtfCurve
    """Modulation transfer, from the fundamental waves."""


def bar_curve(groups: Sequence[BarContrast], levels: tuple[float, float] | None = None) -> BarCurve:
    """Contrast transfer and MTF of frequency groups."""
    if not groups:
        raise InputError("no group of bars is given")
    ordered = tuple(sorted(groups, key=lambda group: group.frequency))
    frequency = np.array([group.frequency for group in ordered])
    close = np.flatnonzero(np.diff(frequency) <= 1e-9)
    if close.size:
        raise InputError(f"two groups of bars have the frequency {frequency[close[0]]:.4g} cycles per pixel; keep one")
    low, high, source = _levels(ordered, levels)
    modulation = (high - low) / (high + low)
    # An object's contrast that is measured itself is as uncertain as the widest bars, and all figures with it.
    own = 0.0 if levels is not None else ordered[0].modulation_sigma / ordered[0].modulation
    contrast = np.array([group.modulation / modulation for group in ordered])
    contrast_sigma = np.array([group.modulation_sigma / modulation for group in ordered])
    contrast_sigma[1:] = np.hypot(contrast_sigma[1:], contrast[1:] * own)
    duties, duty_sigma = _duties(ordered, low, high)
    share = np.array([_fundamental(duty, low, high) for duty in duties])
    transfer = np.array([group.fundamental for group in ordered]) / share
    transfer_sigma = np.array([group.fundamental_sigma for group in ordered]) / share
    transfer_sigma = np.sqrt(transfer_sigma**2 + transfer**2 * (duty_sigma**2 + own**2))
    return BarCurve(
        groups=ordered,
        low=low,
        high=high,
        levels_from=source,
        contrast=MtfCurve.from_zero(frequency, contrast, contrast_sigma),
        mtf=MtfCurve.from_zero(frequency, transfer, transfer_sigma),
    )


def _levels(groups: Sequence[BarContrast], levels: tuple[float, float] | None) -> tuple[float, float, str]:
    if levels is not None:
        if not 0.0 <= levels[0] < levels[1] < np.inf:
            raise InputError(f"levels of {levels[0]:g} and {levels[1]:g}; the first is the lower one and not negative")
        return levels[0], levels[1], "as given"
    widest = groups[0]
    if widest.bend > FLAT:
        raise InputError(
            f"the widest bars, {1 / widest.frequency:.1f} pixels a period, have no flat middle (bend "
            f"{widest.bend:.3f}, at most {FLAT}), so that the object's contrast is unknown; add wider bars or give the "
            "grey values of wide dark and bright areas"
        )
    return widest.low, widest.high, f"widest bars, {1 / widest.frequency:.1f} pixels a period"


def _duties(groups: Sequence[BarContrast], low: float, high: float) -> tuple[list[float], float]:
    """Duty of each group, and the relative standard deviation of the fundamental wave that its error makes.

    Blur moves the duty of narrow bars towards a half: theirs is that of the widest group, if that is sharp, and else
    follows from the mean level.
    """
    sharp = [group.duty for group in groups if group.bend < _SHARP and not group.aligned]
    if sharp:
        return [g.duty if g.bend < _SHARP and not g.aligned else sharp[0] for g in groups], 0.002
    means = [(group.mean - low) / (high - low) for group in groups]
    return [min(max(mean, 0.2), 0.8) for mean in means], 0.01


def _fundamental(duty: float, low: float, high: float) -> float:
    """Fundamental wave through the mean of bars of these levels."""
    return (high - low) * fundamental_of_square(duty) / (low + duty * (high - low))


def coltman_factor(k: int) -> float:
    """Factor of the contrast at k times the frequency in Coltman's series; 0 for even k and those with a square.

    J. W. Coltman, "The specification of imaging properties by response to a sine wave input", Journal of the Optical
    Society of America 44 (1954) 468–471.
    """
    if k % 2 == 0:
        return 0.0
    primes = [p for p in range(3, k + 1, 2) if k % p == 0 and all(p % q for q in range(3, p, 2))]
    if any(k % (p * p) == 0 for p in primes):
        return 0.0
    return float((-1.0) ** len(primes) * (-1.0) ** ((k - 1) // 2) / k)


def coltman_mtf(contrast: MtfCurve) -> MtfCurve:
    """MTF from a contrast transfer function of square waves with equal bars, by Coltman's series.

    MTF(f) = π/4 [C(f) + C(3f)/3 − C(5f)/5 + C(7f)/7 + C(11f)/11 − …]. C is interpolated linearly; beyond the last
    frequency it is 0, and what this may miss is in the standard deviations.
    """
    given = np.zeros(contrast.frequency.size) if contrast.sigma is None else contrast.sigma
    last, end = float(contrast.frequency[-1]), float(contrast.modulation[-1])
    factors = {k: coltman_factor(k) for k in range(1, 32, 2)}
    modulation, sigma = [], []
    for f in contrast.frequency[1:]:
        seen = {k: factor for k, factor in factors.items() if k * f <= last * (1.0 + 1e-12)}
        at, weights = np.array(list(seen)) * f, pi / 4.0 * np.array(list(seen.values()))
        # Contrast falls on, at least in proportion to the frequency.
        missed = next(
            (abs(factor) * end * last / (k * f) for k, factor in factors.items() if factor and k not in seen), 0.0
        )
        modulation.append(weights @ np.interp(at, contrast.frequency, contrast.modulation))
        noise = np.linalg.norm(weights * np.interp(at, contrast.frequency, given))
        sigma.append(hypot(float(noise), pi / 4.0 * missed))
    return MtfCurve.from_zero(contrast.frequency[1:], modulation, sigma)
