"""Linearity: how exactly grey values are proportional to the light.

The linearity error is that of EMVA 1288 release 4 linear, eq. 58–63: a line fitted to the levels between 5 % and 95 %
of saturation by least squares of the relative deviations, and the mean of their absolute values in percent. The
response between neighbouring levels shows where a curve bends (Behr 1989, §4.2.2 and fig. 4.12).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfc

from photoplan.adjustment.linear import solve
from photoplan.errors import InputError

#: Parts of saturation between which levels count (EMVA 1288 release 4 linear).
LOW, HIGH = 0.05, 0.95


@dataclass(frozen=True, eq=False)
class Linearity:
    """Result for one series of levels."""

    exposure: NDArray[np.float64]
    """Of the levels, increasing, in the unit that was given (ms, photons …)."""
    signal: NDArray[np.float64]
    """Grey values above black."""
    response: NDArray[np.float64]
    """Signal over exposure."""
    response_sigma: NDArray[np.float64]
    segment: NDArray[np.float64]
    """Slope between each level and the one before; NaN for the first."""
    used: NDArray[np.bool_]
    """Levels between 5 % and 95 % of saturation."""
    offset: float
    slope: float
    """Line of least relative deviations."""
    slope_sigma: float
    deviation_percent: NDArray[np.float64]
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


def _error_sigma(deviation: NDArray[np.float64], residual: NDArray[np.float64], sigma: NDArray[np.float64]) -> float:
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


def _refuse_falling(x: NDArray[np.float64], y: NDArray[np.float64], s: NDArray[np.float64], top: float) -> None:
    """A signal that falls while the exposure grows is no series of exposures."""
    noise = 5 * np.hypot(s[1:], s[:-1]) + 0.01 * np.maximum(np.abs(y[:-1]), 1.0)
    falls = (np.diff(y) < -np.nan_to_num(noise)) & (y[:-1] < top)
    if falls.any():
        k = int(np.argmax(falls))
        raise InputError(
            f"the signal falls from {y[k]:.4g} to {y[k + 1]:.4g} DN while the exposure grows from {x[k]:g} to "
            f"{x[k + 1]:g}; check the exposures of the frames, the lamp, and that automatic gain is off"
        )
