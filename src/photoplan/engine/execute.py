"""Execute tiles: the one place where pixels are resampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera
from photoplan.engine.base import Reader
from photoplan.geometry.grid import Window
from photoplan.kernels.rectify import rectify_tile
from photoplan.plan.product import CompiledTile, ProductPlan, compile_tile
from photoplan.surfaces.base import Surface

#: A window of the source larger than this (bytes as read) is not read at once; its tile is executed in parts.
MOST_SOURCE_BYTES = 48 * 2**20
#: A tile of this side is not cut further, however much of the source it needs.
SMALLEST_PART = 16


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of a window of a product."""

    values: NDArray[Any] | None
    """(bands, height, width) in the source's dtype, 0 where invalid; None if no pixel is valid."""
    valid: NDArray[np.bool_] | None
    """(height, width); None if no pixel is valid."""
    residual: float
    """Worst residual of the anchors, pixels of the source image."""
    cells: int
    """Boxes that the anchors have."""
    source_window: Window
    """Part of the source that was needed."""

    @property
    def valid_count(self) -> int:
        """Number of valid pixels."""
        return 0 if self.valid is None else int(np.count_nonzero(self.valid))


def execute_tile(tile: CompiledTile, reader: Reader, kernel: str) -> Pixels:
    """Resample one compiled tile.

    Parameters
    ----------
    tile : CompiledTile
    reader : Reader
        The image that the tile's anchors refer to.
    kernel : str
        Name of a resampling kernel.
    """
    anchors = tile.anchors
    if anchors is None or anchors.source_window.size == 0:
        return Pixels(None, None, 0.0, 0, Window(0, 0, 0, 0))
    source, usable = reader.read(anchors.source_window)
    values = np.zeros((source.shape[0], *tile.relief.shape), source.dtype)
    valid = np.zeros(tile.relief.shape, bool)
    if usable is None or usable.any():
        arrays = (anchors.rects, anchors.box_start, anchors.box_heights, anchors.corners)
        border = _border(anchors.source_window, reader.size)
        rectify_tile(arrays, tile.relief, source, usable, border, kernel, values, valid)
    if not valid.any():
        return Pixels(None, None, anchors.residual, len(anchors.corners), anchors.source_window)
    return Pixels(values, valid, anchors.residual, len(anchors.corners), anchors.source_window)


def render(
    product: ProductPlan, window: Window, camera: Camera, surface: Surface, reader: Reader, kernel: str
) -> Pixels:
    """Compile and execute a window of a product, in parts if it needs too much of the source at once.

    Whether and how it is cut depends on the window and the source alone, so that the result does not depend on
    memory, workers or order.
    """
    tile = compile_tile(product, window, camera, surface)
    if tile.anchors is None:
        return Pixels(None, None, 0.0, 0, Window(0, 0, 0, 0))
    needed = tile.anchors.source_window.size * reader.bands * reader.dtype.itemsize
    if needed <= MOST_SOURCE_BYTES or max(window.width, window.height) <= SMALLEST_PART:
        return execute_tile(tile, reader, kernel)
    side = max(SMALLEST_PART, -(-max(window.width, window.height) // 2))
    parts = [(part, render(product, part, camera, surface, reader, kernel)) for part in window.tiles(side)]
    return _joined(window, parts, reader)


def _joined(window: Window, parts: list[tuple[Window, Pixels]], reader: Reader) -> Pixels:
    values = np.zeros((reader.bands, window.height, window.width), reader.dtype)
    valid = np.zeros((window.height, window.width), bool)
    for part, pixels in parts:
        if pixels.values is None or pixels.valid is None:
            continue
        rows = slice(part.row - window.row, part.stop[1] - window.row)
        cols = slice(part.col - window.col, part.stop[0] - window.col)
        values[:, rows, cols] = pixels.values
        valid[rows, cols] = pixels.valid
    used = [p.source_window for _, p in parts if p.source_window.size]
    return Pixels(
        values if valid.any() else None,
        valid if valid.any() else None,
        max(p.residual for _, p in parts),
        sum(p.cells for _, p in parts),
        _hull(used),
    )


def _hull(windows: list[Window]) -> Window:
    if not windows:
        return Window(0, 0, 0, 0)
    col, row = min(w.col for w in windows), min(w.row for w in windows)
    right, bottom = max(w.stop[0] for w in windows), max(w.stop[1] for w in windows)
    return Window(col, row, right - col, bottom - row)


def _border(window: Window, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Outer edges of the image x_min, y_min, x_max, y_max in the window's pixel coordinates."""
    return (-0.5 - window.col, -0.5 - window.row, size[0] - 0.5 - window.col, size[1] - 0.5 - window.row)
