"""Details and histograms of an image and of what became of it, for a report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader

#: Side of a detail, pixels; and places in each direction at which details are looked at.
SIDE = 160
_PLACES = 20
#: Grey values of a band that count for the histogram.
_VALUES = 1_000_000
_CLASSES = 16
_SHARE = 256
"""A class is this part of the range of grey values, at least one value."""


@dataclass(frozen=True, eq=False)
class HistogramEnds:
    """The dark and the bright end of a histogram."""

    edges: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Limits of the classes of grey values."""
    before: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Share of the pixels in each class, percent."""
    after: tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Compared:
    """A detail before and after, and the ends of the histograms."""

    window: Window
    before: NDArray[np.uint8]
    """(height, width) or (height, width, 3)."""
    after: NDArray[np.uint8]
    ends: HistogramEnds | None
    """None: no pixel is valid."""


def compare(before: RasterReader, after: RasterReader) -> Compared:
    """The detail of largest contrast and the ends of the histograms of an image and its restored copy.

    At most 20 × 20 windows of 160 × 160 pixels are read, spread over the image; all of it where it is small. Contrast
    is the root mean square difference of neighbouring pixels.

    Raises
    ------
    InputError
        Pixels are damaged.
    """
    windows = _windows(before.size)
    step = max(1, round((len(windows) * min(SIDE, *before.size) ** 2 / _VALUES) ** 0.5))
    best, most = windows[0], -1.0
    values: list[tuple[NDArray[Any], NDArray[Any]]] = []
    for window in windows:
        (was, valid), (now, still) = before.read(window), after.read(window)
        known = np.ones(was.shape[1:], bool)
        for mask in (valid, still):
            known &= True if mask is None else mask
        contrast = _contrast(was, known)
        if contrast > most:
            best, most = window, contrast
        some = np.zeros_like(known)
        some[::step, ::step] = known[::step, ::step]
        values.append((was[:, some], now[:, some]))
    pair = [np.concatenate([v[k] for v in values], axis=1).ravel() for k in (0, 1)]
    ends = _ends(pair[0], pair[1], before.dtype) if pair[0].size else None
    return Compared(best, *_detail(before, after, best), ends)


def _windows(size: tuple[int, int]) -> list[Window]:
    """Windows spread over an image, the last ones at its edge."""
    side = [min(SIDE, length) for length in size]
    counts = [min(_PLACES, -(-length // SIDE)) for length in size]
    at = [
        [round(k * (length - s) / max(count - 1, 1)) for k in range(count)]
        for length, s, count in zip(size, side, counts)
    ]
    return [Window(col, row, *side) for row in at[1] for col in at[0]]


def _contrast(pixels: NDArray[Any], valid: NDArray[np.bool_]) -> float:
    grey = np.where(valid, pixels[:3].mean(0, dtype=np.float64), np.nan)
    squares = np.concatenate([(np.diff(grey, axis=axis) ** 2).ravel() for axis in (0, 1)])
    known = squares[np.isfinite(squares)]
    # Gaps count as even ground: a detail that is mostly invalid shows little.
    return float(known.sum() / squares.size) if squares.size else 0.0


def _detail(before: RasterReader, after: RasterReader, window: Window) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both as pictures, stretched alike; invalid pixels black."""
    read = [reader.read(window) for reader in (before, after)]
    known = read[0][0][:, read[0][1]] if read[0][1] is not None else read[0][0].reshape(before.bands, -1)
    known = known[np.isfinite(known)]
    low, high = (float(v) for v in np.quantile(known, [0.005, 0.995])) if known.size else (0.0, 1.0)
    pad = 0.1 * (high - low) or 1.0
    bands = slice(0, 3 if before.bands >= 3 else 1)
    pictures = []
    for pixels, valid in read:
        part = (np.nan_to_num(pixels[bands].astype(np.float64), nan=low) - low + pad) / (high - low + 2.0 * pad)
        shown = (255.0 * np.clip(part, 0.0, 1.0)).astype(np.uint8)
        if valid is not None:
            shown[:, ~valid] = 0
        pictures.append(np.moveaxis(shown, 0, -1) if shown.shape[0] == 3 else shown[0])
    return pictures[0], pictures[1]


def _ends(before: NDArray[Any], after: NDArray[Any], dtype: np.dtype[Any]) -> HistogramEnds | None:
    """Shares of the pixels in 16 classes at each end of the range: that of 8 bits, else what occurs."""
    before, after = (v[np.isfinite(v)].astype(np.float64) for v in (before, after))
    if before.size == 0 or after.size == 0:
        return None
    low = min(float(before.min()), float(after.min()))
    high = max(float(before.max()), float(after.max()))
    if dtype == np.uint8:
        low, high = min(low, 0.0), max(high, 255.0)
    if dtype.kind in "ui":
        low, high = np.floor(low) - 0.5, np.ceil(high) + 0.5
    elif high <= low:
        low, high = low - 0.5, low + 0.5
    width = (high - low) / _SHARE
    if dtype.kind in "ui":
        width = float(max(1, round(width)))
    steps = np.asarray(width * np.arange(_CLASSES + 1), np.float64)
    edges = low + steps, high - steps[::-1]
    was, now = (tuple(100.0 * np.histogram(v, e)[0] / v.size for e in edges) for v in (before, after))
    return HistogramEnds(edges, (was[0], was[1]), (now[0], now[1]))
