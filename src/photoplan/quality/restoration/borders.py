"""A tile with a margin: what lies beyond the image, or is invalid, continues the valid pixels beside it."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.convolve import CHUNK, EVEN_TAPS, GENERAL_TAPS, convolve_even, convolve_general
from photoplan.kernels.extend import extend_oddly
from photoplan.kernels.jit import is_ready
from photoplan.kernels.shift_bands import limits_of
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
        """Convolve the inner part of an array."""
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


#: Values that are kept for the next tile; larger arrays are made and given back (64 MiB).
MOST_KEPT = 1 << 24


class Scratch(threading.local):
    """Float32 arrays by name, of this thread alone; what they hold is what was left in them."""

    def __init__(self) -> None:
        self._kept: dict[str, NDArray[np.float32]] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """An array to be filled; it is the same memory as the last one of this name."""
        count = int(np.prod(shape))
        if count > MOST_KEPT:
            return np.empty(shape, np.float32)
        kept = self._kept.get(name)
        if kept is None or kept.size < count:
            kept = self._kept[name] = np.empty(count, np.float32)
        return kept[:count].reshape(shape)


@dataclass(frozen=True)
class Margin:
    """How far filters reach beyond a pixel, and what they find there.

    Pixels beyond the image and invalid ones are one case: q gets ``2 v(p) - v(2 p - q)`` from the nearest valid pixel p
    (`photoplan.kernels.extend`). Constants and linear ramps go on, so there is nothing for a filter to sharpen: across
    a straight edge an even filter leaves the outermost pixel as it is (times its sum), noise included. Only pixels that
    a filter of this reach can need are looked at, hence the result is that of any other tile.
    """

    columns: int
    rows: int

    def around(self, window: Window, size: tuple[int, int], gaps: bool = True) -> Window:
        """Pixels of an image of `size` that the filtered pixels of a window depend on."""
        times = 3 if gaps else 1
        columns, rows = times * self.columns, times * self.rows
        wide = (window.col - columns, window.row - rows, window.stop[0] + columns, window.stop[1] + rows)
        left, top = max(wide[0], 0), max(wide[1], 0)
        return Window(left, top, min(wide[2], size[0]) - left, min(wide[3], size[1]) - top)

    def fits(self, window: Window, size: tuple[int, int]) -> bool:
        """Whether a window lies so far inside the image that nothing has to be continued at its edge."""
        return self.around(window, size, gaps=False).size == (window.width + 2 * self.columns) * (
            window.height + 2 * self.rows
        )

    def source(
        self,
        window: Window,
        pixels: NDArray[Any],
        at: Window,
        valid: NDArray[np.bool_] | None,
        scratch: Scratch | None = None,
    ) -> NDArray[np.float32]:
        """Pixels of a window with its margin, all of them finite, as `Convolution` wants them."""
        wide = Window(
            window.col - self.columns,
            window.row - self.rows,
            window.width + 2 * self.columns,
            window.height + 2 * self.rows,
        )
        shape = (pixels.shape[0], wide.height, LEFT + wide.width + RIGHT)
        out = np.empty(shape, np.float32) if scratch is None else scratch.array("source", shape)
        out[..., :LEFT] = 0
        out[..., LEFT + wide.width :] = 0
        common = wide & at
        of, to = _part(common, at), _part(common, wide)
        body = out[..., LEFT : LEFT + wide.width]
        body[:, *to] = pixels[:, *of]
        gaps = valid is not None and not valid[of].all()
        if gaps or (valid is not None and common.size < wide.size):
            assert valid is not None
            known = np.zeros((wide.height, wide.width), bool)
            known[to] = valid[of]
            body[:, ~known] = 0
            wanted = self._near(valid, at, wide) & ~known
            place = (wide.row - at.row, wide.col - at.col, LEFT)
            light = np.ascontiguousarray(pixels, np.float32)
            extend_oddly(light, np.ascontiguousarray(valid), wanted, _offsets(self.columns, self.rows), place, out)
        elif common.size < wide.size:
            _beyond_edges(pixels, at, wide, to, body)
        return out

    def _near(self, valid: NDArray[np.bool_], at: Window, wide: Window) -> NDArray[np.bool_]:
        """Pixels of `wide` that have a valid one within reach."""
        sums = np.zeros((at.height + 1, at.width + 1), np.int64)
        sums[1:, 1:] = valid.cumsum(0, np.int64).cumsum(1)
        rows, cols = np.arange(wide.row, wide.stop[1]) - at.row, np.arange(wide.col, wide.stop[0]) - at.col
        top, bottom = np.clip(rows - self.rows, 0, at.height), np.clip(rows + self.rows + 1, 0, at.height)
        left, right = np.clip(cols - self.columns, 0, at.width), np.clip(cols + self.columns + 1, 0, at.width)
        found = sums[np.ix_(bottom, right)] - sums[np.ix_(top, right)]
        return np.asarray(found - sums[np.ix_(bottom, left)] + sums[np.ix_(top, left)] > 0)


def _part(common: Window, of: Window) -> tuple[slice, slice]:
    """Rows and columns of a common part in the arrays of a window."""
    return (slice(common.row - of.row, common.stop[1] - of.row), slice(common.col - of.col, common.stop[0] - of.col))


def _beyond_edges(
    pixels: NDArray[Any], at: Window, wide: Window, to: tuple[slice, slice], body: NDArray[np.float32]
) -> None:
    """What `extend_oddly` does where the image has no gaps: its nearest pixel is found without search."""
    rows, cols = np.arange(wide.row, wide.stop[1]) - at.row, np.arange(wide.col, wide.stop[0]) - at.col
    above, below, left, right = (
        slice(0, to[0].start),
        slice(to[0].stop, None),
        slice(0, to[1].start),
        slice(to[1].stop, None),
    )
    for part in ((above, slice(None)), (below, slice(None)), (to[0], left), (to[0], right)):
        y, x = rows[part[0]], cols[part[1]]
        if not y.size or not x.size:
            continue
        py, px = np.clip(y, 0, at.height - 1), np.clip(x, 0, at.width - 1)
        my, mx = 2 * py - y, 2 * px - x
        inside = np.logical_and.outer((my >= 0) & (my < at.height), (mx >= 0) & (mx < at.width))
        nearest = pixels[:, py[:, None], px].astype(np.float32)
        mirror = pixels[:, np.clip(my, 0, at.height - 1)[:, None], np.clip(mx, 0, at.width - 1)].astype(np.float32)
        body[:, *part] = np.where(inside, np.float32(2.0) * nearest - mirror, nearest)


@lru_cache(maxsize=16)
def _offsets(columns: int, rows: int) -> NDArray[np.int32]:
    """Squared distance, rows and columns of all neighbours within reach, the nearest first."""
    dy, dx = np.mgrid[-rows : rows + 1, -columns : columns + 1]
    squared = dy**2 + dx**2
    order = np.lexsort((dx.ravel(), dy.ravel(), squared.ravel()))[1:]
    table = np.stack([squared.ravel(), dy.ravel(), dx.ravel()], axis=1)[order].astype(np.int32)
    table.setflags(write=False)
    return table
