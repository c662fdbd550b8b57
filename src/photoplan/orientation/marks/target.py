"""A round target of unknown size, such as a measuring mark or a hole in a mask (Behr 1989, §4.1.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.cameras.mark_pattern import MarkPart, MarkPattern
from photoplan.errors import InputError
from photoplan.orientation.marks.locate import BLURS as _BLURS
from photoplan.orientation.marks.locate import LEAST_CORRELATION, Location, best_blur, locate_mark

_SMALLEST, _MARGIN = 2.0, 3.0
"""Least diameter, and background that is compared around the target, pixels."""
_STEPS = 8
"""Steps of a pixel in which discs are drawn: a disc that is a little too large or small lies where it lies."""


@dataclass(frozen=True, eq=False)
class MarkTarget:
    """A round target."""

    location: Location
    """Its middle in the window."""
    diameter: float
    """Pixels, at half of its contrast."""
    bright: bool
    """Whether it is brighter than what surrounds it."""


def locate_target(image: NDArray[np.floating], *, bright: bool = True) -> MarkTarget:
    """Middle and diameter of the one round target in a window (Behr 1989, §4.1.1, eq. 4.1–4.4).

    Halfway between the extreme grey values lies the threshold; the largest extent of what exceeds it, in rows and
    columns, is the diameter. A disc of this size is then drawn, with the edge as wide as it fits best, and located by
    correlation, paraboloid and least-squares matching. Unlike the source, only the largest connected piece beyond the
    threshold is measured: a bright grain elsewhere would enlarge the target.
    """
    grey = np.asarray(image, float) if bright else -np.asarray(image, float)
    if grey.ndim != 2 or not np.isfinite(grey).any() or np.nanmax(grey) <= np.nanmin(grey):
        raise InputError("window without variation of grey values: no target in it")
    # Behind a median a single grain is no extreme.
    calm = ndimage.median_filter(np.where(np.isfinite(grey), grey, np.nanmin(grey)), 3)
    beyond = calm > (calm.min() + calm.max()) / 2
    pieces, count = ndimage.label(beyond)
    if not count:
        raise InputError("window without variation of grey values: no target in it")
    sizes = ndimage.sum_labels(beyond, pieces, np.arange(1, count + 1))
    piece = pieces == 1 + int(np.argmax(sizes))
    rows, columns = np.nonzero(piece)
    diameter = float(max(piece.sum(axis=0).max(), piece.sum(axis=1).max()))
    where = f"target of {diameter:.0f} px near column {columns.mean():.0f}, row {rows.mean():.0f}"
    if diameter < _SMALLEST:
        raise InputError(f"{where}: too small to be measured; scan it more finely")
    half = diameter / 2 + _MARGIN
    if (
        min(columns.mean(), rows.mean()) < half
        or (np.array(grey.shape)[::-1] - 1 - (columns.mean(), rows.mean()) < half).any()
    ):
        raise InputError(f"{where}: touches the border of the window; give a larger window, or another one")
    near = float(columns.mean()), float(rows.mean())
    one = np.array([[1.0, 0.0], [0.0, -1.0]])
    # The area at half contrast is that of the disc, whatever the blur.
    area = _area(grey, piece)
    diameter = 2 * math.sqrt(area / math.pi)
    disc = _disc(round(diameter * _STEPS) / _STEPS)
    tried = best_blur(grey, disc, one, near, False)
    blur = _BLURS[int(np.nanargmax(tried))] if np.isfinite(tried).any() else 0.7
    at = locate_mark(grey, disc, one, blur_px=blur, near=(*near, half))
    if not at.correlation >= LEAST_CORRELATION:
        raise InputError(
            f"{where}: correlates by {at.correlation:.2f} with a disc, less than {LEAST_CORRELATION:g}: no round target"
        )
    return MarkTarget(at, diameter, bright)


def _area(grey: NDArray[np.float64], piece: NDArray[np.bool_]) -> float:
    """Area of a target in pixels: its grey values above the background, divided by its contrast."""
    wide = ndimage.binary_dilation(piece, iterations=4)
    ring = ndimage.binary_dilation(wide, iterations=2) & ~wide & np.isfinite(grey)
    background = float(np.median(grey[ring])) if ring.any() else float(np.nanmin(grey))
    core = ndimage.binary_erosion(piece, iterations=2)
    top = float(np.median(grey[core])) if core.sum() >= 5 else float(np.nanmax(grey[piece]))
    inside = wide & np.isfinite(grey)
    return max(float((grey[inside] - background).sum()) / (top - background), 1.0)


@lru_cache(maxsize=16)
def _disc(diameter: float) -> MarkPattern:
    """The same object for the same diameter, so that templates of a target in many frames are drawn once."""
    angle = np.linspace(0, 2 * math.pi, 72, endpoint=False)
    circle = diameter / 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    half = diameter / 2 + _MARGIN - 0.5
    return MarkPattern("target", (MarkPart(circle, 1.0),), 0.0, (-half, -half, half, half))
