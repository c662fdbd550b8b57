"""Working memory that a thread uses again for its next tile.

A fresh array of a megabyte costs more than the convolution that fills it: the system hands it out page by page.
"""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

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
