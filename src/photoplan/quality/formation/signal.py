"""From electrons to stored grey values: gain that adapts, edge enhancement, tone curve, rounding."""

from __future__ import annotations

from math import exp

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.quality.formation.sensor_parts import AutomaticGain, Enhancement, Quantisation, Tone

_Array = NDArray[np.float64]


def next_gain(automatic: AutomaticGain, gain: float, mean: float) -> float:
    """Gain of the next frame, relative to the fixed one.

    Parameters
    ----------
    automatic : AutomaticGain
    gain : float
        Of this frame.
    mean : float
        Mean of this frame above the offset, in grey values at gain 1.
    """
    wanted = automatic.target / mean if mean > 0.0 else automatic.most
    wanted = min(max(wanted, automatic.least), automatic.most)
    share = 1.0 - exp(-1.0 / automatic.frames) if automatic.frames > 0.0 else 1.0
    return gain + (wanted - gain) * share


def enhanced(grey: _Array, enhancement: Enhancement) -> _Array:
    """Grey values of one band with over- and undershoot beside edges."""
    width = (enhancement.width if enhancement.direction == "both" else 0.0, enhancement.width)
    smooth = ndimage.gaussian_filter(grey, width, mode="nearest")
    return np.asarray(grey + enhancement.amount * (grey - smooth))


def toned(grey: _Array, tone: Tone) -> _Array:
    """Stored grey values of linear ones."""
    if tone.curve == "table":
        points = np.array(tone.table)
        return np.asarray(np.interp(grey, points[:, 0], points[:, 1]))
    part = np.maximum(grey / tone.white, 0.0)
    if tone.curve == "gamma":
        return np.asarray(tone.white * part ** (1.0 / tone.gamma))
    # IEC 61966-2-1
    curve = np.where(part <= 0.0031308, 12.92 * part, 1.055 * part ** (1.0 / 2.4) - 0.055)
    return np.asarray(tone.white * curve)


def quantised(grey: _Array, quantisation: Quantisation) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Whole grey values within the range, as the smallest unsigned type that holds them."""
    whole = np.clip(np.floor(grey + 0.5), 0, quantisation.most)
    return whole.astype(np.uint8) if quantisation.bits <= 8 else whole.astype(np.uint16)
