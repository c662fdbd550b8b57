"""Fixed pattern: what differs from pixel to pixel and stays from frame to frame.

Spatial variances as in EMVA 1288 release 4 linear: that of a mean image, without what is left of the temporal noise
(eq. 33–36), split into rows, columns and single pixels by the variances of the row and column means (eq. 41, 42); DSNU
from dark (eq. 66), PRNU from dark and bright frames (eq. 67); spectrograms along rows and columns with the excess over
white noise. Sums are divided by n − 1, those of the standard by n. The standard filters dark frames like bright ones;
whether a mean image is filtered is the caller's choice here.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import nan, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.errors import InputError

#: Side of an image from which rows and columns can be told from pixels.
_LEAST_SIDE = 16


@dataclass(frozen=True)
class PatternVariance:
    """Spatial variances of a mean image in squared grey values; a small negative one is the noise of zero."""

    total: float
    total_sigma: float
    row: float
    """Of rows against each other."""
    row_sigma: float
    column: float
    column_sigma: float
    pixel: float
    pixel_sigma: float
    mean: float
    """Grey value."""
    filtered: bool
    """Whether the slow variation was taken out."""


def pattern_variance(
    mean: NDArray[np.float64], temporal_variance: float, frames: int, *, filtered: bool = False
) -> PatternVariance:
    """Spatial variances of the mean image of several frames."""
    height, width = mean.shape
    if min(height, width) < _LEAST_SIDE:
        raise InputError(f"image of {width} × {height} pixels; the fixed pattern needs {_LEAST_SIDE} × {_LEAST_SIDE}")
    if not np.isfinite(temporal_variance) or frames < 2:
        raise InputError("a single frame; the fixed pattern needs two or more, to tell it from the temporal noise")
    values = high_pass(mean) if filtered else mean
    white, line = (WHITE_SHARE, LINE_SHARE) if filtered else (1.0, 1.0)
    rest = temporal_variance / frames
    measured = float(values.var(ddof=1))
    of_rows = float(values.mean(axis=1).var(ddof=1)) / line
    of_columns = float(values.mean(axis=0).var(ddof=1)) / line
    # With q = pixel + rest: E[of_rows] = row + q / width, E[of_columns] = column + q / height and
    # E[measured] = line (row + column) + white q; without the filter line = white = 1.
    inner = (measured - line * (of_rows + of_columns)) / (white - line / width - line / height)
    row, column, pixel = of_rows - inner / width, of_columns - inner / height, inner - rest
    total = row + column + pixel
    measured_sigma = inner * sqrt(2 / (mean.size - 1))
    row_sigma = of_rows * sqrt(2 / (height - 1))
    column_sigma = of_columns * sqrt(2 / (width - 1))
    # What is left of the temporal noise is itself estimated.
    rest_sigma = rest * sqrt(2 / ((frames - 1) * (mean.size - 1)))
    pixel_sigma = sqrt(measured_sigma**2 + rest_sigma**2)
    total_sigma = sqrt(row_sigma**2 + column_sigma**2 + pixel_sigma**2)
    return PatternVariance(
        total=total,
        total_sigma=total_sigma,
        row=row,
        row_sigma=row_sigma,
        column=column,
        column_sigma=column_sigma,
        pixel=pixel,
        pixel_sigma=pixel_sigma,
        mean=float(mean.mean()),
        filtered=filtered,
    )


def signed_root(variance: float, sigma: float) -> tuple[float, float]:
    """Standard deviation of a variance and its sigma; 0 where the variance is not above zero."""
    if variance <= 0:
        return 0.0, sqrt(sigma) if sigma > 0 else 0.0
    root = sqrt(variance)
    return root, min(sigma / (2 * root), sqrt(sigma))


def prnu_percent(bright: PatternVariance, dark: PatternVariance | float = 0.0) -> tuple[float, float]:
    """Photo response non-uniformity in percent of the signal, and its sigma."""
    below, of_dark, of_dark_sigma = (
        (dark.mean, dark.total, dark.total_sigma) if isinstance(dark, PatternVariance) else (dark, 0.0, 0.0)
    )
    signal = bright.mean - below
    if signal <= 0:
        raise InputError(f"flat frames of mean {bright.mean:.4g} DN are not brighter than the dark ones")
    root, sigma = signed_root(bright.total - of_dark, sqrt(bright.total_sigma**2 + of_dark_sigma**2))
    return 100 * root / signal, 100 * sigma / signal


@dataclass(frozen=True, eq=False)
class Spectrogram:
    """Spectrum along rows or columns, mean over them."""

    frequency: NDArray[np.float64]
    """Cycles per pixel of the plane, without 0."""
    amplitude: NDArray[np.float64]
    """Root of the power, grey values; white noise of standard deviation s has s everywhere."""
    white: float
    """Level of the white part: the median."""
    excess: float
    """Whole power over that of the white part; 1 for white noise."""
    peak_frequency: float
    """Frequency of the largest peak that stands out (5 times its neighbourhood); NaN: there is none."""


def spectrogram(mean: NDArray[np.float64], axis: int) -> Spectrogram:
    """Spectrogram of a mean image along an axis: 1 along rows (horizontal), 0 along columns."""
    values = mean - mean.mean()
    length = values.shape[axis]
    power = (np.abs(np.fft.rfft(values, axis=axis)) ** 2).mean(axis=1 - axis) / length
    power, frequency = power[1:], np.fft.rfftfreq(length)[1:]
    white = float(np.median(power))
    excess = float(power.mean() / white) if white > 0 else nan
    peak = int(np.argmax(power))
    around = np.delete(power[max(0, peak - 8) : peak + 9], min(peak, 8))
    standing = around.size and power[peak] > 5 * float(np.median(around)) and power[peak] > 5 * white
    return Spectrogram(
        frequency=np.asarray(frequency, np.float64),
        amplitude=np.sqrt(power),
        white=sqrt(max(white, 0.0)),
        excess=excess,
        peak_frequency=float(frequency[peak]) if standing else nan,
    )


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
