"""Straight lines through measured points with known standard deviations, by weighted least squares."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.chances import chance_chi_square
from photoplan.adjustment.linear import solve
from photoplan.errors import InputError

#: Level of significance at which the scatter about the line is taken as larger than stated.
_SIGNIFICANT = 0.01


@dataclass(frozen=True)
class StraightLine:
    """y = offset + slope · x."""

    offset: float
    slope: float
    covariance: tuple[float, float, float]
    """Variance of the offset, covariance, variance of the slope."""
    chi_square: float
    """Weighted sum of squared residuals with the stated standard deviations."""
    degrees: int

    @property
    def offset_sigma(self) -> float:
        """Standard deviation of the offset."""
        return sqrt(self.covariance[0])

    @property
    def slope_sigma(self) -> float:
        """Standard deviation of the slope."""
        return sqrt(self.covariance[2])

    def at(self, x: ArrayLike) -> NDArray[np.float64]:
        """y at x, same shape."""
        return np.asarray(self.offset + self.slope * np.asarray(x, float))


def fit_line(x: ArrayLike, y: ArrayLike, sigma: ArrayLike) -> StraightLine:
    """Line by weighted least squares.

    Where the residuals are significantly (1 %) larger than the standard deviations allow, those of the result are
    enlarged to the scatter that was found.
    """
    x, y, sigma = (np.asarray(v, np.float64) for v in (x, y, sigma))
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(sigma).all() and (sigma > 0).all()):
        raise InputError("a straight line needs finite points with positive standard deviations")
    if len(x) < 2 or np.ptp(x) == 0:
        raise InputError(f"{len(x)} points with {len(set(x.tolist()))} different abscissas; a line needs 2")
    # Shifted and scaled, so that the normal equations are well conditioned whatever the unit of x.
    shift = float(np.average(x, weights=sigma**-2.0))
    scale = float(np.abs(x - shift).max()) or 1.0
    fit = solve(np.column_stack([np.ones_like(x), (x - shift) / scale]), y, sigma**-2.0)
    scattered = fit.redundancy and chance_chi_square(fit.square, fit.redundancy) < _SIGNIFICANT
    back = np.array([[1.0, -shift / scale], [0.0, 1.0 / scale]])
    offset, slope = back @ fit.unknowns
    c = back @ (fit.covariance if scattered else fit.cofactors) @ back.T
    covariance = float(c[0, 0]), float(c[0, 1]), float(c[1, 1])
    return StraightLine(
        offset=float(offset), slope=float(slope), covariance=covariance, chi_square=fit.square, degrees=fit.redundancy
    )


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
    """Characteristic curve of patches."""
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
        density=d,
        signal=y,
        transmission=transmission,
        used=used,
        gamma=line.slope,
        gamma_sigma=line.slope_sigma,
        slope=slope,
        error_percent=float(100 * np.abs(deviation).max() / v.max()),
        used_range_percent=float(100 * y.max() / saturation),
    )
