"""Image pyramids without rectification: low-pass filtered, every second pixel of every second row kept."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.matching.features import Grey

_Floats = NDArray[np.float32]

#: Low-pass filters (Kaiser, Schmolla and Wrobel 1992, in Schlüter 2001, table 1), by how many pixels they span.
FILTERS = {
    3: np.array([1, 2, 1]) / 4,
    5: np.array([1, 4, 6, 4, 1]) / 16,
    # The printed coefficients add up to 0.999.
    11: np.array([51, 0, -87, 0, 298, 475, 298, 0, -87, 0, 51]) / 999,
}
#: Pixels of a block along a side.
_SIDE = 256


@dataclass(eq=False)
class Pyramid:
    """Levels of an image, read by windows; level 0 is the image. Safe to call from several threads.

    Pixel (i, j) of a level lies at (i, j)·2^level of the image: filters are symmetric about the pixels that are kept.
    """

    image: Grey
    span: int = 11
    """Pixels that the low-pass filter spans."""
    kept: int = 64 << 20
    """Bytes of blocks that are kept for the next window."""
    _blocks: OrderedDict[tuple[int, int, int], _Floats] = field(default_factory=OrderedDict, init=False, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def size(self, level: int) -> tuple[int, int]:
        """Width and height of a level."""
        width, height = self.image.size
        return ((width - 1) >> level) + 1, ((height - 1) >> level) + 1

    def read(self, level: int, window: Window) -> _Floats:
        """Grey values of any window of a level, shape (height, width); NaN where there are none."""
        if level == 0:
            return self.image.read(window)
        out = np.full((window.height, window.width), np.nan, np.float32)
        inside = window & Window(0, 0, *self.size(level))
        for row in range(inside.row // _SIDE, -(-inside.stop[1] // _SIDE)):
            for col in range(inside.col // _SIDE, -(-inside.stop[0] // _SIDE)):
                block = Window(col * _SIDE, row * _SIDE, _SIDE, _SIDE)
                part = block & inside
                out[part.slices(window)] = self._block(level, block)[part.slices(block)]
        return out

    def _block(self, level: int, block: Window) -> _Floats:
        key = level, block.col, block.row
        with self._lock:
            if key in self._blocks:
                self._blocks.move_to_end(key)
                return self._blocks[key]
        reach = self.span // 2
        finer = Window(
            2 * block.col - reach, 2 * block.row - reach, 2 * block.width + 2 * reach, 2 * block.height + 2 * reach
        )
        made = halved(self.read(level - 1, finer), FILTERS[self.span])
        with self._lock:
            self._blocks[key] = made
            while len(self._blocks) * _SIDE**2 * 4 > max(self.kept, 4 * _SIDE**2):
                # The oldest of the finest level: a block is made of four times as many pixels as one of a level finer.
                del self._blocks[min(self._blocks, key=lambda one: one[0])]
        return made


def halved(fine: _Floats, low_pass: NDArray[np.float64]) -> _Floats:
    """Filter along rows and columns and keep every second pixel, the first of them where the filter first fits.

    Pixels without a value count nothing; where they have most of the weight there is none.
    """
    valid = np.isfinite(fine)
    values, whole = np.where(valid, fine, np.float32(0)), bool(valid.all())
    total = _along(_along(values, low_pass, 0), low_pass, 1)
    if whole:
        return total
    weight = _along(_along(valid.astype(np.float32), low_pass, 0), low_pass, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(weight > 0.6, total / weight, np.float32(np.nan))


def _along(values: _Floats, low_pass: NDArray[np.float64], axis: int) -> _Floats:
    count = (values.shape[axis] - len(low_pass) + 1 + 1) // 2
    out: _Floats | None = None
    for k, share in enumerate(low_pass):
        if share:
            index = [slice(None), slice(None)]
            index[axis] = slice(k, k + 2 * count - 1, 2)
            part = values[tuple(index)] * np.float32(share)
            out = part if out is None else out + part
    assert out is not None
    return out
