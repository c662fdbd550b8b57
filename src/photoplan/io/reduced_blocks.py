"""Reduced images block by block, each made once: tiles of a coarse product overlap in the source, turned ones twice."""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np

from photoplan.geometry.grid import Window
from photoplan.geometry.levels import FullSize, Pixels, level_size, reduced
from photoplan.io.block_cache import BlockCache

SIDE = 256
"""Of a block, pixels of the reduced image."""
_blocks = BlockCache(48 << 20)


def reduced_by_blocks(key: Hashable, reader: FullSize, window: Window, level: int) -> Pixels:
    """A window of an image that is reduced by 2^level, see `geometry.levels.reduced`.

    Parameters
    ----------
    key : hashable
        What tells the file and its state from all others.
    reader : FullSize
    window : Window
        Of the reduced image.
    level : int
        0: nothing is reduced, nor kept.
    """
    if level == 0:
        return reader.read(window)
    whole = Window(0, 0, *level_size(reader.size, level))
    values = np.empty((reader.bands, window.height, window.width), reader.dtype)
    valid = np.ones((window.height, window.width), bool)
    for row in range(window.row // SIDE, -(-window.stop[1] // SIDE)):
        for col in range(window.col // SIDE, -(-window.stop[0] // SIDE)):
            block = Window(col * SIDE, row * SIDE, SIDE, SIDE) & whole

            def load(block: Window = block) -> np.ndarray:
                pixels, good = reduced(reader, block, level)
                # The validity travels as one band more.
                return pixels if good is None else np.concatenate([pixels, good[None].astype(pixels.dtype)])

            kept = _blocks.get((key, level, block), load)
            part = block & window
            to, of = part.slices(window), part.slices(block)
            values[:, to[0], to[1]] = kept[: reader.bands, of[0], of[1]]
            if len(kept) > reader.bands:
                valid[to] = kept[-1][of] > 0
    return values, None if valid.all() else valid
