"""Whether two orthophotos show the same thing in the same place: speed must not be bought with geometry."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window, from_bounds

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from tools.matching import match
from tools.pictures import gray

_PIECE = 700  # pixels; side of the pieces that are matched
_PIECES = 4  # per axis


@dataclass(frozen=True)
class Agreement:
    """Differences of two products on their common pixels."""

    common: float
    """Pixels that both have, among those that either has."""
    median: float
    """Median of the absolute differences, grey values."""
    within: float
    """Share of the values that differ by at most 2 grey values."""
    dx: float
    """Median offset to the east, pixels of the product."""
    dy: float
    """Median offset to the north, pixels of the product."""
    patches: int
    """Patches behind these offsets."""


def compare(one: Path, other: Path) -> Agreement:
    """`one` against `other`; grids must fit together to whole pixels."""
    with rasterio.open(one) as a, rasterio.open(other) as b:
        edges = (
            max(a.bounds.left, b.bounds.left),
            max(a.bounds.bottom, b.bounds.bottom),
            min(a.bounds.right, b.bounds.right),
            min(a.bounds.top, b.bounds.top),
        )
        windows = [from_bounds(*edges, transform=data.transform) for data in (a, b)]
        starts = np.array([[w.col_off, w.row_off] for w in windows])
        if np.abs(starts - starts.round()).max() > 1e-6:
            raise ValueError(f"{one.name} and {other.name}: their grids are shifted by a part of a pixel")
        (ax, ay), (bx, by) = starts.round().astype(int)
        width, height = round(windows[0].width), round(windows[0].height)
        counts, either = _differences(a, b, (ax, ay), (bx, by), (width, height))
    dx, dy = _offsets(one, other, (ax, ay), (bx, by), (width, height))
    total = counts.sum()
    median = int(np.searchsorted(counts.cumsum(), total / 2))
    return Agreement(
        total / 3 / max(either, 1), median, counts[:3].sum() / total, np.median(dx), np.median(dy), len(dx)
    )


def _differences(a, b, at_a, at_b, size) -> tuple[np.ndarray, int]:
    """Histogram of absolute differences where both have a value, and the pixels that either has, a strip at a time."""
    counts, either = np.zeros(256, np.int64), 0
    for row in range(0, size[1], 512):
        rows = min(512, size[1] - row)
        one = a.read(window=Window(at_a[0], at_a[1] + row, size[0], rows)).astype(np.int16)
        other = b.read(window=Window(at_b[0], at_b[1] + row, size[0], rows)).astype(np.int16)
        known = one.any(axis=0), other.any(axis=0)
        counts += np.bincount(np.abs(one - other)[:, known[0] & known[1]].ravel(), minlength=256)
        either += int((known[0] | known[1]).sum())
    return counts, either


def _offsets(one: Path, other: Path, at_one, at_other, size) -> tuple[np.ndarray, np.ndarray]:
    """Offsets of patches of 200 pixels in a regular set of pieces, pixels."""
    dx, dy = [], []
    for i in range(_PIECES):
        for j in range(_PIECES):
            col = round((j + 0.5) / _PIECES * size[0] - _PIECE / 2)
            row = round((i + 0.5) / _PIECES * size[1] - _PIECE / 2)
            a = gray(one, Window(at_one[0] + col, at_one[1] + row, _PIECE, _PIECE))
            b = gray(other, Window(at_other[0] + col, at_other[1] + row, _PIECE, _PIECE))
            found = match(a, b, patch=200 * b.cell, stride=400 * b.cell, search=3 * b.cell, filled=0.95)
            good = found.keep(found.quality > 0.9)
            dx.append(good.dx / b.cell)
            dy.append(good.dy / b.cell)
    return np.concatenate(dx), np.concatenate(dy)
