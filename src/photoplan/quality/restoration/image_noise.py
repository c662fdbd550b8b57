"""Noise of an image from the image itself, apart from what the scene shows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Side of the blocks, pixels.
BLOCK = 24
#: Share of the blocks, the most even ones, that are taken to show noise alone.
_EVEN = 0.1
#: What the most even tenth of blocks of pure noise shows less than its standard deviation, found by simulation.
_TOO_SMALL = 0.894


def block_noise(grey: NDArray[np.float64], valid: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
    """Standard deviation of the noise in each whole block of an image, if the scene is even there.

    Differences of differences in both directions, [1 -2 1] times [1 -2 1], leave nothing of planes and of edges along
    rows or columns; their root mean square, divided by 6, is the noise of a pixel.
    """
    rows, columns = (side // BLOCK * BLOCK for side in grey.shape)
    if rows == 0 or columns == 0:
        return np.empty(0)
    blocks = _blocks(np.asarray(grey, np.float64)[:rows, :columns])
    mixed = np.diff(np.diff(blocks, n=2, axis=1), n=2, axis=2)
    noise = np.sqrt((mixed**2).mean(axis=(1, 2))) / 6.0
    whole = np.isfinite(blocks).all(axis=(1, 2))
    if valid is not None:
        whole &= _blocks(valid[:rows, :columns]).all(axis=(1, 2))
    return np.asarray(noise[whole])


def image_noise(blocks: NDArray[np.float64]) -> float:
    """Noise of an image from that of its blocks: what the most even ones show; NaN if there is none."""
    seen = np.sort(blocks[blocks > 0.0])
    if seen.size == 0:
        return float("nan")
    count = max(1, round(_EVEN * seen.size))
    return float(seen[:count].mean() / _TOO_SMALL)


def _blocks(pixels: NDArray[Any]) -> NDArray[Any]:
    """Shape (blocks, BLOCK, BLOCK)."""
    rows, columns = pixels.shape
    parts = pixels.reshape(rows // BLOCK, BLOCK, columns // BLOCK, BLOCK)
    return parts.swapaxes(1, 2).reshape(-1, BLOCK, BLOCK)
