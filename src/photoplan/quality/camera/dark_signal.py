"""Dark signal: what a sensor shows without light, how it grows with the exposure and with temperature.

The mean grey value of dark frames grows with the exposure by the dark current, and the current doubles every few
degrees: I(T) = I₀ 2^((T − T₀)/T_d) (EMVA 1288 release 4 linear, sections 3 and 7).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np

from photoplan.errors import InputError
from photoplan.quality.camera.frame_statistics import Level, check_level, cut_off
from photoplan.quality.camera.straight_line import StraightLine, fit_line


@dataclass(frozen=True)
class DarkCurrent:
    """Dark current of a sensor at one temperature."""

    offset_dn: float
    """Grey value at no exposure."""
    offset_dn_sigma: float
    current_dn_s: float
    """Grey values per second."""
    current_dn_s_sigma: float
    line: StraightLine


@dataclass(frozen=True)
class DoublingTemperature:
    """By how many degrees the dark current doubles."""

    doubling_k: float
    doubling_k_sigma: float
    reference_c: float
    """Mean temperature."""
    current_at_reference: float
    """In the unit that was given."""


def dark_current(exposures_ms: Sequence[float], levels: Sequence[Level]) -> DarkCurrent:
    """Line of the mean dark grey value over the exposure."""
    cut = cut_off(levels, " of the dark frames")
    if cut:
        raise InputError(
            f"{cut}, so that their mean and noise are not those of the signal; raise the camera's black level"
        )
    if any(level.saturated_share > 1e-2 for level in levels):
        raise InputError("over 1 % of the samples of dark frames are saturated; take shorter exposures")
    if len(set(exposures_ms)) < 3:
        raise InputError(f"{len(set(exposures_ms))} different exposures of dark frames; the dark current needs 3")
    if any(level.frames < 2 for level in levels):
        raise InputError("a single dark frame at an exposure; the noise of its mean needs two or more")
    for level in levels:
        check_level(level)
    seconds = np.array(exposures_ms, float) / 1000.0
    sigma = np.array([max(level.mean_sigma, 1e-9) for level in levels])
    line = fit_line(seconds, [level.mean for level in levels], sigma)
    return DarkCurrent(
        offset_dn=line.offset,
        offset_dn_sigma=line.offset_sigma,
        current_dn_s=line.slope,
        current_dn_s_sigma=line.slope_sigma,
        line=line,
    )


def doubling_temperature(
    temperatures_c: Sequence[float], currents: Sequence[float], sigmas: Sequence[float]
) -> DoublingTemperature:
    """Doubling temperature from dark currents at two temperatures or more."""
    t, i, s = (np.array(v, float) for v in (temperatures_c, currents, sigmas))
    if len(set(t.tolist())) < 2:
        raise InputError(f"{len(set(t.tolist()))} temperature; the doubling temperature needs two or more")
    weak = i <= 3 * s
    if weak.any():
        k = int(np.argmax(weak))
        raise InputError(
            f"the dark current at {t[k]:g} °C is {i[k]:.3g} ± {s[k]:.2g}, not significantly positive; take longer "
            "exposures or leave this temperature out"
        )
    reference = float(t.mean())
    line = fit_line(t - reference, np.log(i), s / i)
    if line.slope <= 2 * line.slope_sigma:
        raise InputError("the dark current does not grow with temperature; check the temperatures of the frames")
    doubling = log(2.0) / line.slope
    current = float(np.exp(line.offset))
    return DoublingTemperature(doubling, doubling * line.slope_sigma / line.slope, reference, current)
