"""Fiducial marks as templates: patterns and examples drawn at the scale of a scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from photoplan.arrays import Floats, Floats32
from photoplan.cameras.fiducials import MarkExample, MarkPattern
from photoplan.errors import InputError
from photoplan.kernels.raster import polygon_coverage

_LARGEST = 4096
"""Side of a template in pixels beyond which the scale must be wrong."""
_SHARP = 0.5
"""Standard deviation in pixels of the area of a pixel, about what a scanner's pixel blurs."""
_GRAIN = 0.8
"""Standard deviation in pixels by which an example is smoothed: interpolation lowers its grain between pixels, and
matching would be drawn there by a quarter of a pixel."""


@dataclass(frozen=True, eq=False)
class Template:
    """A mark in pixels."""

    values: Floats32
    """Grey values, shape (rows, columns); without meaning where the weight is 0."""
    weights: Floats32
    """How much each pixel counts, at least 0; 0: not compared. Same shape."""
    reference: tuple[float, float]
    """Column and row of the mark's reference point in `values`; (0, 0) is the centre of the first pixel."""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape != self.weights.shape:
            raise InputError(f"template of shape {self.values.shape} with weights of shape {self.weights.shape}")


def coverage(outline: Floats, shape: tuple[int, int]) -> Floats:
    """Share of each pixel's area that a polygon covers, exact."""
    total = np.empty((shape[0], shape[1] + 1))
    polygon_coverage(np.asarray(outline, np.float64) + 0.5, total)
    return np.clip(np.abs(total[:, :-1]), 0.0, 1.0)


def render(
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: Floats | Sequence[Sequence[float]],
    *,
    negative: bool = False,
    blur_px: float = 0.7,
    offset: tuple[float, float] = (0.0, 0.0),
) -> Template:
    """A mark as it appears in a scan.

    Parameters
    ----------
    pattern : MarkPattern or MarkExample
        What it looks like.
    mm_to_pixel : (2, 2)
        From millimetres (x right, y up) to columns and rows of the scan: scale, rotation, reflection, shear.
    negative : bool
        Exchange dark and bright.
    blur_px : float
        Standard deviation of the scan's blur in pixels, for drawn patterns; an example has its own.
    offset : (float, float)
        Columns and rows by which the reference point lies beside the centre of a pixel.

    Returns
    -------
    Template
        Values from 0 dark to 1 bright. Where the description states no tone, or more than half of what blurs into a
        pixel has none, the weight is 0.

    Raises
    ------
    InputError
        The matrix has no inverse, the blur is not sensible, or the mark is smaller than 3 pixels or larger than 4096.
    """
    matrix = np.array(mm_to_pixel, np.float64)
    if matrix.shape != (2, 2) or not np.isfinite(matrix).all() or np.linalg.det(matrix) == 0:
        raise InputError(f"mark {pattern.name!r}: scale {matrix.tolist()}; a 2x2 matrix with an inverse is needed")
    if not 0 <= blur_px <= 100:
        raise InputError(f"mark {pattern.name!r}: blur of {blur_px} px; 0 to 100 are allowed")
    shape, at = _frame(pattern, matrix, offset)
    if isinstance(pattern, MarkExample):
        values, weights = _resample(pattern, matrix, shape, at)
    else:
        values, weights = _draw(pattern, matrix, shape, at, blur_px)
    if negative:
        values = np.float32(1.0) - values
    return Template(values, weights, at)


def _corners(pattern: MarkPattern | MarkExample) -> Floats:
    """Corners of what is compared about the reference point, shape (4, 2), millimetres."""
    if isinstance(pattern, MarkPattern):
        x0, y0, x1, y1 = pattern.window
    else:
        rows, columns = pattern.values.shape
        x, y = pattern.reference
        x0, x1 = (-0.5 - x) * pattern.pixel_mm, (columns - 0.5 - x) * pattern.pixel_mm
        y0, y1 = (y - rows + 0.5) * pattern.pixel_mm, (y + 0.5) * pattern.pixel_mm
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _frame(
    pattern: MarkPattern | MarkExample, matrix: Floats, offset: tuple[float, float]
) -> tuple[tuple[int, int], tuple[float, float]]:
    """Rows and columns of the template, and where the reference point is in it."""
    corners = _corners(pattern) @ matrix.T + offset
    # The window's outline may fall on a pixel's border by rounding: a thousandth of a pixel is no pixel more.
    first = np.floor(corners.min(axis=0) + 0.501).astype(np.int64)
    last = np.ceil(corners.max(axis=0) - 0.501).astype(np.int64)
    columns, rows = (last - first + 1).tolist()
    if min(rows, columns) < 3 or max(rows, columns) > _LARGEST:
        raise InputError(
            f"mark {pattern.name!r}: {columns} x {rows} px at this scale; 3 to {_LARGEST} are allowed. "
            "Check the size of the mark and of the scan's pixels"
        )
    return (rows, columns), (float(offset[0] - first[0]), float(offset[1] - first[1]))


def _draw(
    pattern: MarkPattern, matrix: Floats, shape: tuple[int, int], at: tuple[float, float], blur_px: float
) -> tuple[Floats32, Floats32]:
    """Values and weights of a drawn pattern; each part covers those before it in proportion to its share of a pixel."""
    margin = int(np.ceil(4 * blur_px)) + 1
    wide = (shape[0] + 2 * margin, shape[1] + 2 * margin)
    origin = np.add(at, margin)
    known = np.full(wide, 0.0 if np.isnan(pattern.background) else 1.0)
    tones = known * np.nan_to_num(pattern.background)
    for part in pattern.parts:
        outline = part.outline @ matrix.T + origin
        first = np.clip(np.floor(outline.min(axis=0)), 0, (wide[1], wide[0])).astype(np.int64)
        last = np.clip(np.ceil(outline.max(axis=0)) + 1, first, (wide[1], wide[0])).astype(np.int64)
        box = (slice(first[1], last[1]), slice(first[0], last[0]))
        if known[box].size == 0:
            continue
        share = coverage(outline - first, known[box].shape)
        known[box] *= 1 - share
        tones[box] *= 1 - share
        if not np.isnan(part.tone):
            known[box] += share
            tones[box] += share * part.tone
    if blur_px > 0:
        known = ndimage.gaussian_filter(known, blur_px, mode="nearest")
        tones = ndimage.gaussian_filter(tones, blur_px, mode="nearest")
    inner = (slice(margin, -margin), slice(margin, -margin))
    known, tones = known[inner], tones[inner]
    window = coverage(_corners(pattern) @ matrix.T + at, shape)
    weights = np.clip(2 * known - 1, 0.0, 1.0) * window
    values = np.divide(tones, known, out=np.zeros(shape), where=known > 0.5)
    return values.astype(np.float32), weights.astype(np.float32)


def _resample(
    example: MarkExample, matrix: Floats, shape: tuple[int, int], at: tuple[float, float]
) -> tuple[Floats32, Floats32]:
    """Values and weights of an example, cubic; smoothed first, more where the scan's pixels are larger than its own."""
    given = np.asarray(example.values, np.float64)
    valid = np.isfinite(given)
    if not valid.any() or np.ptp(given[valid]) == 0:
        raise InputError(f"example of mark {example.name!r} has no contrast; cut another one")
    low, high = given[valid].min(), given[valid].max()
    known = valid.astype(np.float64)
    tones = np.where(valid, (given - low) / (high - low), 0.0)
    larger = 1 / (example.pixel_mm * np.sqrt(abs(np.linalg.det(matrix))))
    sigma = max(_GRAIN, _SHARP * np.sqrt(max(larger**2 - 1, 0.0)))
    known = ndimage.gaussian_filter(known, sigma, mode="nearest")
    tones = ndimage.gaussian_filter(tones, sigma, mode="nearest")
    rows, columns = np.indices(shape, dtype=np.float64)
    millimetres = np.stack([columns - at[0], rows - at[1]], axis=-1) @ np.linalg.inv(matrix).T
    column = example.reference[0] + millimetres[..., 0] / example.pixel_mm
    row = example.reference[1] - millimetres[..., 1] / example.pixel_mm
    sampled = [ndimage.map_coordinates(each, [row, column], order=3, mode="mirror") for each in (known, tones)]
    height, width = given.shape
    least, right, bottom = -1e-6, width - 1 + 1e-6, height - 1 + 1e-6
    inside = (column >= least) & (column <= right) & (row >= least) & (row <= bottom)
    weights = np.where(inside, np.clip(2 * sampled[0] - 1, 0.0, 1.0), 0.0)
    values = np.divide(sampled[1], sampled[0], out=np.zeros(shape), where=sampled[0] > 0.5)
    return values.astype(np.float32), weights.astype(np.float32)


def draw(
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: Floats | Sequence[Sequence[float]],
    *,
    negative: bool = False,
    blur_px: float = 0.7,
) -> Template:
    """What `render` draws, or drew for the same pattern, matrix, tone and blur; see there."""
    matrix = np.asarray(mm_to_pixel, float)
    return _drawn(pattern, matrix.shape, tuple(matrix.ravel().tolist()), negative, float(blur_px))


@lru_cache(maxsize=48)
def _drawn(
    pattern: MarkPattern | MarkExample, shape: tuple[int, int], matrix: tuple[float, ...], negative: bool, blur: float
) -> Template:
    return render(pattern, np.array(matrix).reshape(shape), negative=negative, blur_px=blur)
