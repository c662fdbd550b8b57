"""Spread function from one profile along the pixels, by normalised sums: the source's own way (Kölbl 2006, table 1)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from photoplan.adjustment.least_squares import solve
from photoplan.errors import InputError
from photoplan.quality.curves import SpreadFunction


@dataclass(frozen=True, eq=False)
class ProfileSpread:
    """Spread function that an edge profile shows."""

    spread: SpreadFunction
    shift: float
    """Place of the object's edge beside the border of two pixels, -0.5 to 0.5 pixels along the profile."""
    border: int
    """The profile's pixel before that border, counted from 0."""
    residual: float
    """Root mean square of what the spread function leaves of the normalised profile's differences."""
    beyond: float
    """Share of the light that falls outside of the spread function's reach (stray light)."""


def normalised_edge(profile: NDArray[np.float64], levels: tuple[float, float] | None = None) -> NDArray[np.float64]:
    """Profile across an edge as values from -1 to +1 (Kölbl 2006, table 1, column 6).

    Parameters
    ----------
    profile : ndarray, shape (n,)
        Grey values across an edge, in linear light, rising or falling.
    levels : tuple of float, optional
        Grey values far before and behind the edge; None: the profile's first and last one.

    Raises
    ------
    InputError
        Fewer than four values, one that is not finite, or no step.
    """
    values = np.asarray(profile, np.float64)
    if values.ndim != 1 or values.size < 4:
        raise InputError(f"an edge profile has at least four values; given is shape {values.shape}")
    if not np.isfinite(values).all():
        raise InputError("an edge profile has finite values only")
    first, last = (float(values[0]), float(values[-1])) if levels is None else levels
    if first == last:
        raise InputError(f"no edge: both ends of the profile have the grey value {first:g}")
    return (2.0 * values - (first + last)) / (last - first)


def spread_from_edge(
    profile: NDArray[np.float64],
    levels: tuple[float, float] | None = None,
    half: int | None = None,
    *,
    symmetric: bool = True,
) -> ProfileSpread:
    """Spread function from one profile across an edge that runs along the pixels.

    Half the differences of neighbouring normalised values are the shares of light, if the object's edge lies on the
    border of two pixels (Kölbl 2006, table 1, column 7). Where it lies beside, one object pixel has a mixed value: the
    differences are the spread function convolved with (1 - s, s). Shift and spread function are then found together,
    by least squares. That is exact for objects of whole pixels; a real edge is explained by `spread_of_edge`.

    Parameters
    ----------
    profile : ndarray, shape (n,)
        Grey values across the edge, in linear light.
    levels : tuple of float, optional
        Grey values far before and behind the edge; None: the profile's first and last one.
    half : int, optional
        How many pixels the spread function reaches to each side; None: as far as the profile.
    symmetric : bool
        Whether both sides are equal. If not, an asymmetry cannot be told from a shift of the edge: the spread
        function's centroid is then put at 0.

    Raises
    ------
    InputError
        No edge, or a profile too short for `half`.
    """
    rise = np.diff(normalised_edge(profile, levels)) / 2.0
    places = np.arange(rise.size, dtype=float)
    total = float(rise.sum())
    if not total > 0.0:
        raise InputError("no edge: the profile does not rise from one level to the other")
    centroid = float(rise @ places) / total
    border = round(centroid)
    if not 0 <= border < rise.size:
        raise InputError("no edge: its place lies outside of the profile")
    reach = min(border, rise.size - 1 - border) if half is None else half
    if reach < 1 or border - reach < 0 or border + reach >= rise.size:
        raise InputError(
            f"the profile has {border + 1} pixels before the edge and {rise.size - border} behind it; a spread "
            f"function that reaches {max(reach, 1)} pixels needs one more on each side"
        )
    if symmetric:
        shift, values, residual = _symmetric(rise, border, reach)
    else:
        shift, values, residual = _unsymmetric(rise, border, reach, centroid - border)
    return ProfileSpread(
        spread=SpreadFunction.normalised(values),
        shift=shift,
        border=border,
        residual=residual,
        beyond=1.0 - float(values.sum()),
    )


def _taps(count: int, shift: float, border: int, reach: int) -> NDArray[np.float64]:
    """Design matrix, shape (count, 2 reach + 1): differences of a profile from the spread function's values."""
    matrix = np.zeros((count, 2 * reach + 1))
    side = 1 if shift >= 0.0 else -1
    for column in range(2 * reach + 1):
        row = border - reach + column
        matrix[row, column] += 1.0 - abs(shift)
        if 0 <= row + side < count:
            matrix[row + side, column] += abs(shift)
    return matrix


def _symmetric(rise: NDArray[np.float64], border: int, reach: int) -> tuple[float, NDArray[np.float64], float]:
    fold = np.zeros((2 * reach + 1, reach + 1))
    for k in range(-reach, reach + 1):
        fold[reach + k, abs(k)] = 1.0

    def fitted(shift: float) -> tuple[NDArray[np.float64], float]:
        matrix = _taps(rise.size, shift, border, reach) @ fold
        fit = solve(matrix, rise)
        return fit.unknowns, fit.square

    found = minimize_scalar(lambda s: fitted(s)[1], bounds=(-0.5, 0.5), method="bounded", options={"xatol": 1e-10})
    # An edge on the border is the common case of the source; the search ends beside 0 by its own tolerance.
    shift = 0.0 if fitted(0.0)[1] <= found.fun + 1e-15 else float(found.x)
    side, square = fitted(shift)
    return shift, np.asarray(fold @ side, np.float64), float(np.sqrt(square / rise.size))


def _unsymmetric(
    rise: NDArray[np.float64], border: int, reach: int, shift: float
) -> tuple[float, NDArray[np.float64], float]:
    shift = float(np.clip(shift, -0.5, 0.5))
    matrix = _taps(rise.size, shift, border, reach)
    fit = solve(matrix, rise)
    return shift, fit.unknowns, float(np.sqrt(fit.square / rise.size))
