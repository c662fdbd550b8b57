"""Characteristic curve from a grey wedge: grey values over the transmission of patches of known density.

Behr 1989, §4.2.2 and fig. 4.12: which grey values a range of densities takes, where the curve is straight, and how much
of the scale of grey values stays unused. Transmission is 10^−D.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.quality.camera.straight_line import fit_line


@dataclass(frozen=True, eq=False)
class GreyWedge:
    """Result for one wedge at one illumination."""

    density: NDArray[np.float64]
    """Increasing."""
    signal: NDArray[np.float64]
    """Grey values above black."""
    transmission: NDArray[np.float64]
    used: NDArray[np.bool_]
    """Patches that are neither saturated nor black."""
    gamma: float
    """Slope of the logarithm of the signal over that of the transmission; 1 for a linear sensor."""
    gamma_sigma: float
    slope: float
    """Grey values per transmission, line through the origin."""
    error_percent: float
    """Largest deviation from that line, % of the largest signal used."""
    used_range_percent: float
    """Part of the scale up to saturation that the brightest patch takes."""


def grey_wedge(density: ArrayLike, signal: ArrayLike, sigma: ArrayLike, saturation: float) -> GreyWedge:
    """Characteristic curve of patches.

    Parameters
    ----------
    density, signal, sigma : array, shape (n,)
        Optical density, mean grey value above black and its standard deviation.
    saturation : float
        Grey value above black at which the sensor saturates.

    Raises
    ------
    InputError
        Two patches have one density, fewer than three are neither saturated nor black, or a denser patch is brighter.
    """
    order = np.argsort(np.asarray(density, float), kind="stable")
    d, y, s = (np.asarray(v, float)[order] for v in (density, signal, sigma))
    if (np.diff(d) <= 0).any():
        raise InputError("two patches have the same density; measure each once")
    used = (y < 0.98 * saturation) & (y > np.maximum(5 * s, 0.002 * saturation))
    if np.count_nonzero(used) < 3:
        raise InputError(
            f"{np.count_nonzero(used)} of {d.size} patches are neither saturated nor black; a grey wedge needs 3"
        )
    rises = np.diff(y) > 5 * np.hypot(s[1:], s[:-1]) + 0.01 * saturation
    if rises.any():
        k = int(np.argmax(rises))
        raise InputError(
            f"the patch of density {d[k + 1]:g} is brighter ({y[k + 1]:.4g} DN) than that of {d[k]:g} ({y[k]:.4g} DN); "
            "check the densities and the patches' places"
        )
    transmission = 10.0**-d
    t, v = transmission[used], y[used]
    # A patch is even to about 1 %, whatever its noise.
    relative = np.hypot(np.maximum(s[used], 1e-9) / v, 0.01)
    line = fit_line(np.log10(t), np.log10(v), relative / np.log(10.0))
    slope = float(np.sum(v / t) / v.size)
    deviation = v - slope * t
    return GreyWedge(
        d,
        y,
        transmission,
        used,
        line.slope,
        line.slope_sigma,
        slope,
        float(100 * np.abs(deviation).max() / v.max()),
        float(100 * y.max() / saturation),
    )
