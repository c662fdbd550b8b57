"""A filter kernel made ready for use: the fastest way that gives its result."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.kernels.convolve import CHUNK, EVEN_TAPS, GENERAL_TAPS, convolve_even, convolve_general
from photoplan.kernels.jit import is_ready
from photoplan.quality.restoration.filters import FilterKernel

#: Columns of zeros that a source has before and behind its pixels, for vectors and unrolled loops.
LEFT, RIGHT = max(EVEN_TAPS), CHUNK + max(GENERAL_TAPS)
#: Part of a kernel's largest value by which mirrored values of a symmetric one may differ: the rounding of its making.
SAME = 1e-9
_ALL = np.empty((0, 0), bool)


@dataclass(frozen=True, eq=False)
class Convolution:
    """One kernel, convolved in float32.

    Kernels that are the same upside down and left to right, to `SAME` of their largest value, are folded to a quarter;
    all others are summed as they are. The result of a pixel differs from exact arithmetic by at most
    ``2e-7 · (rows + columns) · Σ|weights|`` times the largest pixel below the kernel (rounding of float32 sums).
    """

    kernel: FilterKernel
    even: bool = field(init=False)
    """Whether the fast way for symmetric kernels is taken."""
    _weights: NDArray[np.float32] = field(init=False, repr=False)
    """As the compiled code wants them, filled up with columns of zeros."""
    _tag: tuple[int, ...] = field(init=False, repr=False)
    _zeros: int = field(init=False, repr=False)
    """Columns of zeros before the kernel's first."""

    def __post_init__(self) -> None:
        # A convolution turns the kernel round: its weights by the order of the pixels that they are for.
        values = self.kernel.values[::-1, ::-1]
        m, n = (side // 2 for side in values.shape)
        differs = max(float(np.abs(values - turned).max()) for turned in (values[::-1], values[:, ::-1]))
        even = differs <= SAME * float(np.abs(values).max())
        if even:
            taps = min(EVEN_TAPS, key=lambda t: -(-n // t) * t)
            zeros = -n % taps if n else taps
            part, before = values[m:, n:], zeros
        else:
            taps = min(GENERAL_TAPS, key=lambda t: -(-(2 * n + 1) // t) * t)
            zeros = -(2 * n + 1) % taps
            part, before = values, 0
        weights = np.ascontiguousarray(np.pad(part, ((0, 0), (0, zeros))), np.float32)
        for name, value in (("even", even), ("_weights", weights), ("_tag", (0,) * taps), ("_zeros", before)):
            object.__setattr__(self, name, value)

    def __call__(
        self,
        source: NDArray[np.float32],
        margin: tuple[int, int],
        out: NDArray[Any],
        valid: NDArray[np.bool_] | None = None,
    ) -> tuple[int, int]:
        """Convolve the inner part of an array.

        Parameters
        ----------
        source : ndarray, shape (height + 2 rows, LEFT + width + 2 columns + RIGHT)
            Pixels with a margin; the columns LEFT and RIGHT of it are 0.
        margin : (columns, rows)
            At least what the kernel reaches.
        out : ndarray, shape (height, width)
            Gets the result; whole numbers are rounded to the nearest and clipped.
        valid : ndarray of bool, shape (height, width)
            Pixels that are counted; None: all.

        Returns
        -------
        below, above : int
            Pixels that were clipped, see `photoplan.kernels.convolve.round_clipped`.
        """
        rows, columns = (side // 2 for side in self.kernel.values.shape)
        if margin[0] < columns or margin[1] < rows:
            raise UsageError(f"a margin of {margin} pixels; the kernel reaches {(columns, rows)}")
        start = margin[1] - rows, LEFT + margin[0] - columns - self._zeros
        usable = _ALL if valid is None else valid
        return self._code()(source, start, self._weights, self._tag, usable, limits_of(out.dtype), out)

    def is_compiled(self, out: np.dtype[Any]) -> bool:
        """Whether the code for results of a type is compiled already, here or on the disk."""
        source, result = np.zeros((1, 1), np.float32), np.zeros((1, 1), out)
        arguments = (source, (0, 0), self._weights, self._tag, _ALL, limits_of(out), result)
        return bool(is_ready(self._code(), arguments))

    def _code(self) -> Any:
        return convolve_even if self.even else convolve_general


def limits_of(dtype: np.dtype[Any]) -> tuple[float, float]:
    """Least and largest whole number of a type; low > high: it is floating point."""
    if dtype.kind == "f":
        return 1.0, 0.0
    limits = np.iinfo(dtype)
    return float(limits.min), float(limits.max)
