"""Grey values of images on a map, which seams compare: at several pixel sizes, kept in a store."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.codec import storable

_Floats = NDArray[np.float32]
_Mask = NDArray[np.bool_]
#: Pixels over which brightness is what images differ in, and not detail.
_SMOOTH = 6.0
#: What colours and the strength of detail count beside detail itself.
_COLOUR, _STRENGTH = 0.15, 0.5


class ArrayStore(Protocol):
    """Store of arrays, used by several threads."""

    def keep(self, values: _Floats, /) -> int:
        """Keep an array of shape (rows, columns, n); where it is."""
        ...

    def rows(self, at: int, shape: tuple[int, int, int], first: int, last: int, /) -> _Floats:
        """Rows from `first` to before `last` of an array of a shape."""
        ...


@dataclass(frozen=True, eq=False)
class Shown:
    """Part of a map that an image shows."""

    row: int
    col: int
    """Place of its upper-left pixel in the map."""
    values: _Floats
    """Shape (bands, height, width)."""
    valid: _Mask
    """Pixels that the image sees, shape (height, width)."""

    def halved(self) -> Shown:
        """The same on pixels twice as large; a pixel is valid if at least half of it was."""
        top, left = self.row % 2, self.col % 2
        height, width = (-(-(n + odd) // 2) * 2 for n, odd in zip(self.valid.shape, (top, left)))
        values = np.zeros((len(self.values), height, width), np.float32)
        weight = np.zeros((height, width), np.float32)
        here = slice(top, top + self.valid.shape[0]), slice(left, left + self.valid.shape[1])
        values[(slice(None), *here)], weight[here] = self.values * self.valid, self.valid
        sums, count = quads(values), quads(weight[None])[0]
        return Shown(self.row // 2, self.col // 2, sums / np.maximum(count, 1.0), count >= 2.0)


@storable
@dataclass(frozen=True)
class SeamLayer:
    """An image on pixels of one size, in a store: features, and (1 − distance from the border)² or NaN."""

    at: int
    box: tuple[int, int, int, int]
    """Row, column, height, width in the map of such pixels."""
    depth: int
    """Features and one."""

    def window(self, store: ArrayStore, box: tuple[int, int, int, int]) -> tuple[tuple[int, int, int, int], _Floats]:
        """Return what of it lies in a box of the map: its own box, and its pixels."""
        (row, col, height, width), (top, left, rows, cols) = self.box, box
        i, j = max(row, top), max(col, left)
        m, n = max(min(row + height, top + rows) - i, 0), max(min(col + width, left + cols) - j, 0)
        if not m * n:
            return (i, j, 0, 0), np.zeros((0, 0, self.depth), np.float32)
        values = store.rows(self.at, (height, width, self.depth), i - row, i - row + m)
        return (i, j, m, n), values[:, j - col : j - col + n]


@storable
@dataclass(frozen=True, eq=False)
class SeamFeatures:
    """An image on pixels of one size, see `SeamLayer`."""

    row: int
    col: int
    values: _Floats
    """(height, width, depth)."""

    def kept(self, store: ArrayStore) -> SeamLayer:
        """The same in a store."""
        height, width, depth = self.values.shape
        return SeamLayer(store.keep(self.values), (self.row, self.col, height, width), depth)


def features_of(image: Shown) -> tuple[SeamFeatures, ...]:
    """An image on its own pixels, on those twice as large and so on till it has one."""
    found = []
    while True:
        height, width = image.valid.shape
        place = np.where(image.valid, _from_middle(image.valid), np.nan)
        values = np.concatenate([_detail(image), place[..., None]], axis=-1).astype(np.float32)
        found.append(SeamFeatures(image.row, image.col, values))
        if max(height, width) < 3:
            return tuple(found)
        image = image.halved()


def quads(values: _Floats) -> _Floats:
    """Sums of 2 × 2 pixels of (bands, height, width), both even."""
    return values[:, ::2, ::2] + values[:, 1::2, ::2] + values[:, ::2, 1::2] + values[:, 1::2, 1::2]


def _detail(image: Shown) -> _Floats:
    """By what images are compared, shape (height, width, features): detail of each band, its strength, colour."""
    weight = image.valid.astype(np.float32)
    known = np.maximum(ndimage.gaussian_filter(weight, _SMOOTH), 1e-3)
    smooth = np.stack([ndimage.gaussian_filter(band * weight, _SMOOTH) / known for band in image.values])
    fine = (image.values - smooth) * weight
    grey = fine.mean(axis=0)
    strength = np.hypot(*np.gradient(grey)) if min(grey.shape) > 1 else np.zeros_like(grey)
    bands = len(fine)
    features = [*(fine / bands), _STRENGTH * strength, _COLOUR * image.values.mean(axis=0) * weight]
    return np.stack(features, axis=-1).astype(np.float32)


def _from_middle(valid: _Mask) -> _Floats:
    """0 in the middle of what an image shows, growing with the square to 1 at its border."""
    inside = ndimage.distance_transform_edt(np.pad(valid, 1))[1:-1, 1:-1]
    return np.asarray((1.0 - inside / max(float(inside.max()), 1.0)) ** 2, np.float32)
