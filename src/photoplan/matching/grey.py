"""Images as one band of grey values, read by windows: what features and matching work on.

Rule, if no bands are chosen: one band is taken as it is, three are weighed 0.299, 0.587, 0.114 (ITU-R BT.601), of any
other number the mean is taken. Grey values keep the scale of the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window

#: Pixels are read in squares of this side.
TILE = 2048
_LUMINANCE = (0.299, 0.587, 0.114)


class GreyPixels(Protocol):
    """An image that is read by windows; safe to call from several threads."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        ...

    def read(self, window: Window) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Pixels of a window inside the image, shape (bands, height, width), and their validity; None: all."""
        ...


class Grey(Protocol):
    """Grey values that are read by windows of any place."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        ...

    def read(self, window: Window) -> NDArray[np.float32]:
        """Grey values, shape (height, width); NaN where there are none."""
        ...


@dataclass(frozen=True, eq=False)
class GreyImage:
    """Grey values of an image and where they count."""

    pixels: GreyPixels
    area: tuple[float, float, float, float] | None = None
    """Columns and rows xmin, ymin, xmax, ymax of the picture on a scan, without its margin; None: everything."""
    bands: tuple[int, ...] = ()
    """Bands whose mean counts, from 1; empty: all, by the rule above."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.pixels.size

    def read(self, window: Window) -> NDArray[np.float32]:
        """Grey values of any window, shape (height, width); NaN outside the image and its area, and where not valid."""
        out = np.full((window.height, window.width), np.nan, np.float32)
        inside = window & Window(0, 0, *self.size)
        if not inside.size:
            return out
        pixels, valid = self.pixels.read(inside)
        grey = _grey(pixels) if not self.bands else pixels[[band - 1 for band in self.bands]].mean(0, np.float32)
        if valid is not None:
            grey[~valid] = np.nan
        if self.area is not None:
            x, y = np.arange(inside.col, inside.stop[0]), np.arange(inside.row, inside.stop[1])
            xmin, ymin, xmax, ymax = self.area
            grey[:, (x < xmin) | (x > xmax)] = np.nan
            grey[(y < ymin) | (y > ymax)] = np.nan
        col, row = inside.col - window.col, inside.row - window.row
        out[row : row + inside.height, col : col + inside.width] = grey
        return out

    def reduced(self, window: Window, factor: int) -> NDArray[np.float32]:
        """Means of `factor` × `factor` pixels; `window` counts in such means. NaN where one of them is."""
        if factor == 1:
            return self.read(window)
        full = self.read(
            Window(window.col * factor, window.row * factor, window.width * factor, window.height * factor)
        )
        return full.reshape(window.height, factor, window.width, factor).mean(axis=(1, 3))

    def stretch(self) -> tuple[float, float]:
        """Grey values at 0.5 and 99.5 percent of nine windows spread over the image."""
        (width, height), side = self.size, 128
        found = [np.zeros(1, np.float32)]
        for k in range(9):
            col = int((k % 3 + 0.5) / 3 * max(0, width - side))
            row = int((k // 3 + 0.5) / 3 * max(0, height - side))
            values = self.read(Window(col, row, min(side, width), min(side, height)))
            found.append(values[np.isfinite(values)])
        values = np.concatenate(found[1:]) if sum(map(len, found[1:])) else found[0]
        low, high = np.percentile(values, (0.5, 99.5))
        return float(low), float(max(high, low + 1e-6))


@dataclass(frozen=True, eq=False)
class ReducedImage:
    """Means of squares of pixels as an image of their own; what does not fill a square at the right and below is lost.

    A point x of the image lies at (x + 0.5) / factor − 0.5.
    """

    image: GreyImage
    factor: int
    """Pixels along each side of a square."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in squares."""
        width, height = self.image.size
        return width // self.factor, height // self.factor

    def read(self, window: Window) -> NDArray[np.float32]:
        """Grey values of any window, shape (height, width); NaN where a pixel has none."""
        return self.image.reduced(window, self.factor)


def _grey(pixels: NDArray[Any]) -> NDArray[np.float32]:
    if len(pixels) == 1:
        return pixels[0].astype(np.float32)
    weights = np.array(_LUMINANCE if len(pixels) == 3 else [1 / len(pixels)] * len(pixels), np.float32)
    return np.einsum("b,bij->ij", weights, pixels, dtype=np.float32, casting="unsafe")


def to_bytes(grey: NDArray[np.float32], low: float, high: float) -> NDArray[np.uint8]:
    """Grey values from `low` to `high` as 0 to 255; what has none becomes the mean of the rest."""
    scaled = np.clip((grey - low) * (255.0 / (high - low)), 0, 255)
    known = np.isfinite(scaled)
    if not known.all():
        scaled = np.where(known, scaled, scaled[known].mean() if known.any() else 0.0)
    return np.rint(scaled).astype(np.uint8)


def patches_at(image: Grey, corner: NDArray[np.int64], side: int) -> NDArray[np.float32]:
    """Square windows of grey values, shape (n, side, side); NaN where there are none.

    The image is read once, in tiles that hold the windows; what is in memory is a tile and the result.
    """
    out = np.empty((len(corner), side, side), np.float32)
    if not len(corner):
        return out
    cell = corner // TILE
    _, first, which = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    which = which.reshape(-1)
    for t in range(len(first)):
        members = np.flatnonzero(which == t)
        low, high = corner[members].min(axis=0), corner[members].max(axis=0) + side
        part = image.read(Window(int(low[0]), int(low[1]), *(int(v) for v in high - low)))
        for k in members:
            col, row = corner[k] - low
            out[k] = part[row : row + side, col : col + side]
    return out
