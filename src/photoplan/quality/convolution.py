"""A filter kernel made ready for use: the fastest way that gives its result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.kernels.convolve import CHUNK, EVEN_TAPS, GENERAL_TAPS, convolve_even, convolve_general
from photoplan.kernels.jit import is_ready
from photoplan.quality.filters import FilterKernel

__all__ = ["LEFT", "RIGHT", "Convolution"]

#: Columns of zeros that a source has before and behind its pixels, for vectors and unrolled loops.
LEFT, RIGHT = max(EVEN_TAPS), CHUNK + max(GENERAL_TAPS)
#: Part of a kernel's largest value by which mirrored values of a symmetric one may differ: the rounding of its making.
SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Convolution:
    """One kernel, convolved in float32.

    Kernels that are the same upside down and left to right, to `SAME` of their largest value, are folded to a quarter;
    all others are summed as they are.
    The result of a pixel differs from exact arithmetic by at most ``2e-7 · (rows + columns) · Σ|weights|`` times the
    largest pixel below the kernel (rounding of float32 sums).
    """

    kernel: FilterKernel

    @property
    def even(self) -> bool:
        """Whether the fast way for symmetric kernels is taken."""
        values = self.kernel.values
        differs = max(float(np.abs(values - turned).max()) for turned in (values[::-1], values[:, ::-1]))
        return differs <= SAME * float(np.abs(values).max())

    def __call__(self, source: NDArray[np.float32], margin: tuple[int, int]) -> NDArray[np.float32]:
        """Convolve the inner part of an array.

        Parameters
        ----------
        source : ndarray, shape (height + 2 rows, LEFT + width + 2 columns + RIGHT)
            Pixels with a margin; the columns LEFT and RIGHT of it are 0.
        margin : (columns, rows)
            At least what the kernel reaches.

        Returns
        -------
        ndarray, shape (height, width)
        """
        rows, columns = (side // 2 for side in self.kernel.values.shape)
        if margin[0] < columns or margin[1] < rows:
            raise UsageError(f"a margin of {margin} pixels; the kernel reaches {(columns, rows)}")
        shape = source.shape[0] - 2 * margin[1], source.shape[1] - 2 * margin[0] - LEFT - RIGHT
        out = np.empty(shape, np.float32)
        weights, tag, extra = self._weights()
        start = margin[1] - rows, LEFT + margin[0] - columns - extra
        (convolve_even if self.even else convolve_general)(source, start, weights, tag, out)
        return out

    @property
    def is_compiled(self) -> bool:
        """Whether the code for it is compiled already, here or on the disk."""
        empty = np.zeros((1, 1), np.float32)
        weights, tag, _ = self._weights()
        arguments = (empty, (0, 0), weights, tag, empty)
        return bool(is_ready(convolve_even if self.even else convolve_general, arguments))

    def _weights(self) -> tuple[NDArray[np.float32], tuple[int, ...], int]:
        """Weights as the compiled code wants them, its tag, and the columns of zeros before the kernel's first."""
        # A convolution turns the kernel round: its weights by the order of the pixels that they are for.
        values = self.kernel.values[::-1, ::-1].astype(np.float32)
        m, n = (side // 2 for side in values.shape)
        if not self.even:
            taps = min(GENERAL_TAPS, key=lambda t: -(-(2 * n + 1) // t) * t)
            zeros = -(2 * n + 1) % taps
            return np.ascontiguousarray(np.pad(values, ((0, 0), (0, zeros)))), (0,) * taps, 0
        taps = min(EVEN_TAPS, key=lambda t: -(-n // t) * t)
        zeros = -n % taps
        return np.ascontiguousarray(np.pad(values[m:, n:], ((0, 0), (0, zeros)))), (0,) * taps, zeros
