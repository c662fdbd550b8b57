"""Jitter of a platform in plans of line cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from photoplan.cameras.base import TremorPart
from photoplan.geometry.pose import cubic_convolution

_Floats = NDArray[np.float64]
#: Spacing of nodes along a line, pixels; finer where that misses more than a part of the tolerance.
_SPACINGS = (512.0, 256.0, 128.0, 64.0, 32.0)
#: Places along a line at which shifts are computed, and columns beyond its ends over which they are known.
_PLACES, _BEYOND = 5, 64.0
#: Lines that are measured strictly, and places along each.
_MEASURED, _MEASURED_ALONG = 16, 12
#: Heights are counted by steps of this or of a quarter of their range, metres: tiles of alike ground have one table.
_HEIGHTS = 64.0
#: Where points pass through the line at less than this part of its speed, a position has no accuracy: not reported.
_SLOW = 0.2
#: What is missed beside the places that are measured.
_BESIDE = 1.3
#: Rows around those that a tile needs: between the rows shifts are cubic.
_AROUND = 3


@dataclass(frozen=True, eq=False)
class TremorNodes:
    """The nodes that one tile needs."""

    first: tuple[float, float]
    """Ideal x and real y of the first node."""
    nodes: NDArray[np.float32]
    """(rows, columns, 5): real minus ideal position, its change per metre of height, and how far rows come, see
    `Anchors.field`."""
    low: _Floats
    """Lowest shift (x, y)."""
    high: _Floats
    """Highest shift (x, y)."""
    stretch: float
    """See `TremorTable.stretch`: of these rows."""


@dataclass(frozen=True, eq=False)
class TremorTable:
    """The shifts of some lines: strict at a few places along each, polynomials between them."""

    part: TremorPart
    rows: _Floats
    places: _Floats
    length: float
    """Of the line, pixels from the first to the last."""
    strict: _Floats
    """(rows, places, 4): shifts and their changes per metre of height."""
    spacing: float
    """Of the nodes along x, pixels; along y they lie on the lines."""
    heights: tuple[float, float]
    """Of the values, and half the range over which they hold, metres."""
    residual: float
    """Worst difference to the strict position, pixels, but for points that pass through the line very slowly."""
    stretch: _Floats
    """Pixels in the image of a pixel of the ideal position at most, but for such points: between rows, at columns
    spread evenly along the line, (n − 3, k)."""
    low: _Floats
    """Lowest shift (x, y)."""
    high: _Floats
    """Highest shift (x, y)."""

    def bounds(self, size: tuple[int, int]) -> tuple[float, float, float, float]:
        """Ideal positions x_min, y_min, x_max, y_max of all that lies in an image."""
        left, top = (-0.5 - self.high).tolist()
        right, bottom = (np.array(size) - 0.5 - self.low).tolist()
        return left, top, right, bottom

    def nodes(self, low: _Floats, high: _Floats) -> TremorNodes:
        """Nodes for ideal positions (x, y) from `low` to `high`."""
        columns = _columns(low[0] - 2.0, high[0] + 2.0, self.spacing)
        nodes = _along(self.strict, self.places, columns)
        around = self.heights[1] * np.abs(nodes[..., 3])
        seen = (self.rows[:, None] - nodes[..., 1]).T
        with np.errstate(invalid="ignore"):
            needed = ((seen + around.T >= low[1] - 1.0) & (seen - around.T <= high[1] + 1.0)).any(axis=0)
        some = np.flatnonzero(needed)
        begin, end = (some[0], some[-1] + 1) if len(some) else (0, 1)
        begin, end = max(begin - _AROUND, 0), min(end + _AROUND, len(self.rows))
        nodes, around = nodes[begin:end], around[begin:end]
        come = np.arange(len(nodes))[:, None] - nodes[..., 1] + around
        come[:, :-1] = np.maximum(come[:, :-1], come[:, 1:])
        # Rows without orientation see nothing.
        come = np.fmax.accumulate(np.nan_to_num(come, nan=-np.inf), axis=0) + 1e-3
        kept = np.concatenate([nodes, come[..., None]], axis=-1).astype(np.float32)
        lowest, highest = _range(nodes, self.heights[1])
        last = self.stretch.shape[1] - 1
        left, right = np.clip(np.array([low[0], high[0]]) / self.length * last, 0, last)
        stretch = self.stretch[begin : max(end - 3, begin), int(left) : int(np.ceil(right)) + 1].max(initial=1.0)
        first = (float(columns[0]), float(self.rows[begin]))
        return TremorNodes(first=first, nodes=kept, low=lowest, high=highest, stretch=float(stretch))


def tremor_table(part: TremorPart, width: int, heights: tuple[float, float], tolerance: float) -> TremorTable:
    """The table of some lines of an image of a width, over a range of heights at least; kept for the next tile."""
    step = max(_HEIGHTS, 2.0 ** math.ceil(math.log2(max(heights[1] - heights[0], 1.0) / 4)))
    low, high = step * math.floor(heights[0] / step), step * math.ceil(heights[1] / step)
    return _table(part, width, (low, max(high, low + step)), tolerance)


@lru_cache(maxsize=48)
def _table(part: TremorPart, width: int, heights: tuple[float, float], tolerance: float) -> TremorTable:
    rows = np.arange(part.rows[0] - 2.0, part.rows[1] + 3.0)
    left, right = -_BEYOND, width - 1 + _BEYOND
    middle, half = (heights[0] + heights[1]) / 2, (heights[1] - heights[0]) / 2
    # Along a line shifts are smooth: a few places tell what all others are.
    places = (left + right) / 2 + (right - left) / 2 * chebyshev.chebpts1(_PLACES)
    low, high = part.shifts(places, rows, (middle - half, middle + half))
    strict = np.concatenate([(low + high) / 2, (high - low) / (2 * half)], axis=-1)
    # What is measured is measured at some places spread along the line.
    some = np.linspace(0.0, width - 1.0, _MEASURED_ALONG)
    for spacing in _SPACINGS:
        ends = np.stack([some - spacing / 2, some + spacing / 2])
        nodes = _along(strict, places, ends.ravel()).reshape(len(rows), 2, len(some), 4)
        bent = nodes[..., :2].mean(axis=1) - _along(strict, places, some)[..., :2]
        if not np.nanmax(np.hypot(bent[..., 0], bent[..., 1]), initial=0.0) > tolerance / 4:
            break
    nodes = nodes.mean(axis=1)
    stretch = _stretch(nodes, half)
    worst = stretch.max(axis=1)
    k = np.unique(np.r_[np.argsort(worst)[-_MEASURED:], np.linspace(0, len(worst) - 1, _MEASURED)].astype(np.int64))
    missed = float(np.nanmax(_missed(part, some, rows, nodes, (middle, half), k + 1) * worst[k], initial=0.0))
    furthest = np.nanmax(np.abs(nodes), axis=(0, 1), initial=0.0)
    last_digits = [float(np.spacing(np.float32(each.max()))) for each in (furthest[:2], furthest[2:])]
    lowest, highest = _range(nodes, half)
    return TremorTable(
        part=part,
        rows=rows,
        places=places,
        length=width - 1.0,
        strict=strict,
        spacing=spacing,
        heights=(middle, half),
        residual=_BESIDE * missed + last_digits[0] + half * last_digits[1],
        stretch=stretch,
        low=lowest,
        high=highest,
    )


def _columns(left: float, right: float, spacing: float) -> _Floats:
    """Nodes at whole multiples of the spacing, from before `left` to behind `right`."""
    first = np.floor(left / spacing)
    return spacing * np.arange(first, np.floor(right / spacing) + 2.0)


def _range(nodes: _Floats, half: float) -> tuple[_Floats, _Floats]:
    """Lowest and highest shifts (x, y)."""
    around = half * np.nanmax(np.abs(nodes[..., 2:]), axis=(0, 1), initial=0.0)
    low, high = (find(nodes[..., :2], axis=(0, 1), initial=0.0) for find in (np.nanmin, np.nanmax))
    return low - around - 1.0, high + around + 1.0


def _along(values: _Floats, places: _Floats, columns: _Floats) -> _Floats:
    """Values (n, k, 4) at places (k,) along the lines as polynomials, at columns (m,)."""
    weights = np.ones((len(columns), len(places)))
    for j in range(len(places)):
        for other in np.delete(places, j):
            weights[:, j] *= (columns - other) / (places[j] - other)
    return np.asarray(weights @ values)


def _stretch(nodes: _Floats, half: float) -> _Floats:
    """Pixels in the image of a pixel of the ideal position at most, between rows (n − 3, columns), not where too slow.

    A point that passes the line slowly is found at another row, and all that the line does meanwhile comes with it.
    """
    n = len(nodes)
    worst = np.ones((n - 3, nodes.shape[1]))
    for u in (0.0, 0.25, 0.5, 0.75):
        w = ((4 - 3 * u) * u - 1) / 2, (9 * u - 10) * u / 2, ((8 - 9 * u) * u + 1) / 2, (3 * u - 2) * u / 2
        slope = np.asarray(sum(w[k] * nodes[k : n - 3 + k] for k in range(4)))
        along = np.abs(slope[..., 0]) + half * np.abs(slope[..., 2])
        pace = 1.0 - slope[..., 1] - half * np.abs(slope[..., 3])
        longer = np.where(pace > _SLOW, np.hypot(1.0, along) / np.where(pace > _SLOW, pace, 1.0), 1.0)
        worst = np.fmax(worst, longer)
    return np.asarray(np.hypot(1.0, worst))


def _missed(
    part: TremorPart,
    columns: _Floats,
    rows: _Floats,
    nodes: _Floats,
    heights: tuple[float, float],
    k: NDArray[np.int64],
) -> _Floats:
    """What nodes interpolated to columns miss, between heights and between rows k (m,) and the next; (m,), pixels."""
    w = cubic_convolution(np.full(len(k), 0.5))
    between = np.asarray(sum(w[:, j, None, None] * nodes[k - 1 + j] for j in range(4)))
    worst, away = np.zeros(len(k)), (0.0, 0.5 * heights[1])
    strict = part.shifts(columns, rows[k] + 0.5, [heights[0] + each for each in away])
    for each, found in zip(away, strict):
        miss = between[..., :2] + each * between[..., 2:] - found
        worst = np.maximum(worst, np.hypot(miss[..., 0], miss[..., 1]).max(axis=1))
    return worst
