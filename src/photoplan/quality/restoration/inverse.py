"""The exact inverse of a spread function by its band matrix, and whether there is one (Kölbl 2006, §2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import svdvals, toeplitz

from photoplan.errors import InputError
from photoplan.quality.spread import SpreadFunction

#: Rows of the band matrix: its borders do not reach the middle any more (Kölbl 2006, §3, takes 20).
BAND_ROWS = 61
#: Frequencies at which transfer functions are examined.
_FREQUENCIES = np.linspace(0.0, 0.5, 1001)


@dataclass(frozen=True)
class Condition:
    """Whether a spread function can be inverted exactly."""

    neighbour_ratio: float
    """A / Z; exact restoration needs less than 1/2: two objects one pixel apart do not fuse (Kölbl 2006, §2)."""
    least_transfer: float
    """Smallest modulus of the transfer function up to 0.5 cycles/pixel; 0: a frequency is lost."""
    at_frequency: float
    """Where it is, cycles per pixel."""
    smallest_singular: float
    """Smallest singular value of the band matrix."""
    largest_singular: float
    """Largest singular value of the band matrix."""

    @property
    def number(self) -> float:
        """Condition number of the band matrix: largest by smallest singular value."""
        return self.largest_singular / self.smallest_singular if self.smallest_singular > 0.0 else float("inf")

    @property
    def holds(self) -> bool:
        """Whether the exact inverse exists and means something."""
        return self.neighbour_ratio < 0.5 and self.least_transfer > 1e-6 and self.number < 1e6

    def __str__(self) -> str:
        verdict = "holds" if self.holds else "does not hold"
        return (
            f"A/Z = {self.neighbour_ratio:.3f} (limit 0.5), singular values {self.smallest_singular:.3f} to "
            f"{self.largest_singular:.3f}, least transfer {self.least_transfer:.3f} at {self.at_frequency:.2f} "
            f"cycles/px: the condition {verdict}"
        )


def band_matrix(spread: SpreadFunction, rows: int = BAND_ROWS) -> NDArray[np.float64]:
    """Band matrix that makes image values of object values, shape (rows, rows) (Kölbl 2006, eq. 2)."""
    half = spread.half
    down, right = np.zeros(rows), np.zeros(rows)
    count = min(half + 1, rows)
    # Image i = sum over objects j of values[half + i - j]: below the diagonal the light that moved onwards.
    down[:count] = spread.values[half : half + count]
    right[:count] = spread.values[half::-1][:count]
    return np.asarray(toeplitz(down, right))


def condition_of(spread: SpreadFunction) -> Condition:
    """Condition of the exact inverse."""
    side = spread.side()
    transfer = np.abs(spread.transfer(_FREQUENCIES))
    least = int(np.argmin(transfer))
    singular = svdvals(band_matrix(spread))
    return Condition(
        neighbour_ratio=float(side[1] / side[0])
        if side.size > 1 and side[0] > 0.0
        else float("inf" if side[0] <= 0.0 else 0.0),
        least_transfer=float(transfer[least]),
        at_frequency=float(_FREQUENCIES[least]),
        smallest_singular=float(singular[-1]),
        largest_singular=float(singular[0]),
    )


def exact_inverse(spread: SpreadFunction, half: int = 5, rows: int = BAND_ROWS) -> NDArray[np.float64]:
    """The one-dimensional filter that undoes a spread function: the middle row of the inverse band matrix (eq. 3).

    Parameters
    ----------
    half : int
        How many values of the row are kept to each side.
    rows : int
        Size of the band matrix, odd.

    Returns
    -------
    ndarray, shape (2 half + 1,)
        Not divided by its sum: what is cut off on both sides is missing in it.

    Raises
    ------
    InputError
        The band matrix has no inverse.
    """
    if rows % 2 == 0 or rows < 2 * half + 1:
        raise InputError(f"the band matrix has an odd number of rows, at least {2 * half + 1}; given: {rows}")
    try:
        inverse = np.linalg.inv(band_matrix(spread, rows))
    except np.linalg.LinAlgError:
        raise InputError("the band matrix of the spread function has no inverse: a frequency is lost") from None
    middle = rows // 2
    # A row of the inverse is read along the objects that give to it; as a filter it is turned round.
    return np.asarray(inverse[middle, middle - half : middle + half + 1][::-1].copy())
