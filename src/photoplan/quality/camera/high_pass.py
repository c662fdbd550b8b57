"""Background of a sensor's image taken away, so that only what differs from pixel to pixel is left.

`high_pass` is the filter of EMVA 1288 release 4 linear, section 8.1 (as in release 3.1, appendix C.5): the image minus
itself smoothed by a 7 × 7 box, an 11 × 11 box and a 3 × 3 binomial filter. `background` follows the image by medians of
blocks: single pixels, however bright, leave no trace in it.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

#: Sides of the boxes, pixels, and one row of the binomial filter, by the standard.
_BOXES = (7, 11)
_BINOMIAL = (0.25, 0.5, 0.25)
#: Side of a block of `background`, pixels.
BLOCK = 16


def _smooth(image: NDArray[np.float64]) -> NDArray[np.float64]:
    for side in _BOXES:
        image = ndimage.uniform_filter(image, side, mode="reflect")
    for axis in (0, 1):
        image = ndimage.correlate1d(image, _BINOMIAL, axis=axis, mode="reflect")
    return np.asarray(image)


def _share(image: NDArray[np.float64]) -> float:
    return float(np.sum((image - _smooth(image))[:, 20] ** 2))


def _impulse() -> NDArray[np.float64]:
    impulse = np.zeros((41, 41))
    impulse[20, 20] = 1.0
    return impulse


WHITE_SHARE = float(np.sum((_impulse() - _smooth(_impulse())) ** 2))
"""Part of the variance of white noise that `high_pass` leaves."""
LINE_SHARE = _share(np.repeat(_impulse()[:, 20:21], 41, axis=1))
"""Part of the variance of independent offsets of rows, or of columns, that it leaves."""


def high_pass(image: NDArray[Any]) -> NDArray[np.float64]:
    """An image without its slow variation, shape (h, w); white noise keeps `WHITE_SHARE` of its variance."""
    values = np.asarray(image, np.float64)
    return values - _smooth(values)


def _median(block: NDArray[np.float64]) -> float:
    known = block[~np.isnan(block)]
    return float(np.median(known)) if known.size else float("nan")


def background(image: NDArray[Any]) -> NDArray[np.float64]:
    """Slow variation of an image by medians of blocks of 16 × 16 pixels, linear between their middles.

    NaN does not count; a block without a value takes that of the nearest block with one.
    """
    values = np.asarray(image, np.float64)
    height, width = values.shape
    rows, cols = max(1, height // BLOCK), max(1, width // BLOCK)
    y = np.linspace(0, height, rows + 1).astype(int)
    x = np.linspace(0, width, cols + 1).astype(int)
    medians = np.array([[_median(values[a:b, c:d]) for c, d in pairwise(x)] for a, b in pairwise(y)])
    if np.isnan(medians).any():
        medians = medians[
            tuple(ndimage.distance_transform_edt(np.isnan(medians), return_distances=False, return_indices=True))
        ]
    middle_y, middle_x = (y[:-1] + y[1:] - 1) / 2, (x[:-1] + x[1:] - 1) / 2
    along = np.array([np.interp(np.arange(width), middle_x, row) for row in medians])
    at = np.interp(np.arange(height), middle_y, np.arange(rows))
    low = np.minimum(at.astype(int), max(rows - 2, 0))
    part = (at - low)[:, None]
    return np.asarray(along[low] * (1 - part) + along[np.minimum(low + 1, rows - 1)] * part)
