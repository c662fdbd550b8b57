"""Fill empty pixels of a product: gaps of the direct method and small hidden holes, from pixels around them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window

#: In a raster of sources: added to the number of the image that fills a pixel; the number of pixels that are filled
#: from their surroundings; and how many images a product can have so that these differ.
FROM_IMAGE, FROM_SURROUNDINGS, MOST_IMAGES = 32768, 65535, 32766
#: Holes are looked at from the level around them if that is no more than this above their ground: pixels.
_RAISED = 8.0
#: Surroundings of holes are pixels no further away than this and half the largest side: pixels.
_AROUND = 3


def halo(largest: int) -> int:
    """Pixels around a pixel that decide whether and with what it is filled, for holes of a largest side."""
    return largest + _AROUND


def small_holes(hidden: NDArray[np.bool_], largest: int) -> NDArray[np.bool_]:
    """Pixels of those holes (pixels that touch at sides or corners) whose width and height are at most `largest`."""
    # Products that fill nothing do without it.
    from scipy.ndimage import find_objects, label  # noqa: PLC0415

    labels, _ = label(hidden, np.ones((3, 3), int))
    small = [max(part.stop - part.start for part in box) <= largest for box in find_objects(labels)]
    return np.asarray(np.array([False, *small])[labels])


class Mask:
    """Pixels of a window that a product shows, as `ProductPlan.clip` has them."""

    def __init__(self, window: Window, shown: NDArray[np.bool_]) -> None:
        self.window, self.shown = window, shown

    def rows(self, window: Window) -> NDArray[np.uint16]:
        """1 for pixels of a window that are shown, else 0."""
        found, common = np.zeros((window.height, window.width), np.uint16), self.window & window
        if common.size:
            found[common.slices(window)] = self.shown[common.slices(self.window)]
        return found

    def digest(self, margin: float) -> str:
        """Return nothing: it decides no key."""
        return ""


def rise_of_holes(
    level: NDArray[np.floating], valid: NDArray[np.bool_], holes: NDArray[np.bool_], largest: int
) -> NDArray[np.float64]:
    """How far the valid pixels around each pixel of holes lie above it, pixels; 0 if they lie below it or far above.

    Roughness of a surface hides its lower places; the level around them is nearer to the truth.
    """
    around = np.array(level[None], float)
    fill_by_distance(around, valid, holes, largest // 2 + _AROUND)
    rise = np.where(holes, around[0] - level, 0.0)
    return np.where((rise > 0) & (rise <= _RAISED), rise, 0.0)


def fill_from_surroundings(
    values: NDArray[Any], valid: NDArray[np.bool_], holes: NDArray[np.bool_], largest: int, level: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Fill holes from valid pixels around them, those of similar height (`level`, in pixels) before others; returns the
    pixels that are filled."""
    return fill_by_distance(values, valid, holes, largest // 2 + _AROUND, level)


def fill_by_distance(
    values: NDArray[Any],
    valid: NDArray[np.bool_],
    holes: NDArray[np.bool_],
    reach: int,
    level: NDArray[np.floating] | None = None,
) -> NDArray[np.bool_]:
    """Fill holes with the mean of valid pixels within reach, weighted by one over the square of the distance, or with
    heights by one over the fourth power of the distance in space; returns the pixels that are filled.

    `values` are changed, `valid` is not.
    """
    row, col = np.nonzero(holes)
    height, width = valid.shape
    sums, weights = np.zeros((len(values), len(row))), np.zeros(len(row))
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            square = du * du + dv * dv
            if not 0 < square <= reach * reach:
                continue
            r, c = row + dv, col + du
            inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
            r, c = np.where(inside, r, 0), np.where(inside, c, 0)
            usable = inside & valid[r, c]
            weight = usable / square
            if level is not None:
                weight = usable / (square + (level[r, c] - level[row, col]) ** 2) ** 2
            sums += values[:, r, c] * weight
            weights += weight
    found = weights > 0
    mean = sums[:, found] / weights[found]
    values[:, row[found], col[found]] = mean if values.dtype.kind == "f" else np.rint(mean)
    filled = np.zeros(valid.shape, bool)
    filled[row[found], col[found]] = True
    return filled
