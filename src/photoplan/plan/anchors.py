"""Where the pixels of a tile lie in the source image: a projective or smooth factor, and a field in the image.

What the boxes of the smooth factor miss of a mapping that is bent is measured where it declares its breaks.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.breaks import Breaks
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import level_size


@dataclass(frozen=True, eq=False)
class Anchors:
    """A tile cut into rectangles, each a pile of boxes in (u, v, h) with eight homogeneous corners.

    A pixel looks up the box of its rectangle that holds its height, interpolates (x·w, y·w, w) trilinearly and
    divides once. For a frame camera over a map this is exact for a box of any size. What the field of the projection
    adds to the position (a lens) is interpolated between nodes.
    """

    rects: NDArray[np.int32]
    """(m, 4): first column, first row, end column, end row of each rectangle, relative to the tile; half-open."""
    box_start: NDArray[np.int32]
    """(m + 1,): boxes of rectangle i are `box_start[i]` to `box_start[i + 1]`, from low to high, without gaps."""
    box_heights: NDArray[np.float64]
    """(n, 2): lowest and highest h of each box, metres."""
    corners: NDArray[np.float64]
    """(n, 8, 3): (x·w, y·w, w) at corner 4·ih + 2·iv + iu. The corners of a rectangle lie on its pixels' outer edges
    (first column − 1/2, end column − 1/2); x and y are relative to the first pixel of `source_window`, without the
    field; w > 0 and is scaled to be about 1 inside a tile."""
    field_frame: NDArray[np.float64]
    """(5,): x and y of the field's first node, in the coordinates of `corners`; nodes per pixel along x and y; largest
    factor by which the field makes a distance longer. With a field that belongs to rows (6,): also the
    height of its values, metres."""
    field: NDArray[np.float32]
    """(rows, columns, 2): what is added to x and y at the nodes; (0, 0, 2): the projection has no field. Positions
    beyond the nodes are not in the image. (rows, columns, 5): a field that belongs to rows (a turbulent flight):
    nodes lie at ideal x and *real* y; then follow the changes per metre of height, and the furthest ideal row, pixels
    from the first node, that any row up to this one sees between this column and the next, whatever the height."""
    residual: float
    """Worst difference to the strict position, pixels: of the boxes, measured at their centre, face and edge middles,
    plus of the field, measured in and beside its cells' middles, and at declared breaks."""
    source_window: Window
    """Part of the source image that holds every position, with the kernel's margin, cut at the image's border."""
    scales: tuple[float, float]
    """Smallest and largest number of source pixels per target pixel along x or y."""

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """What the kernels take."""
        return self.rects, self.box_start, self.box_heights, self.corners, self.field_frame, self.field

    def at_level(self, level: int, size: tuple[int, int]) -> Anchors:
        """The same for an image of `size` that is reduced by 2 to the power of `level`; the residual stays as it is."""
        if level == 0:
            return self
        f, old = 2.0**level, self.source_window
        limit = level_size(size, level)
        # A pixel more all round: the margin was made for pixels of full size.
        col, row = max((old.col >> level) - 1, 0), max((old.row >> level) - 1, 0)
        right, bottom = (min(-(-stop >> level) + 1, most) for stop, most in zip(old.stop, limit))
        window = Window(col, row, max(0, right - col), max(0, bottom - row))
        corners = self.corners.copy()
        for axis, (before, after) in enumerate(((old.col, col), (old.row, row))):
            corners[..., axis] /= f
            corners[..., axis] += ((before + 0.5) / f - 0.5 - after) * corners[..., 2]
        frame = self.field_frame.copy()
        for axis, (before, after) in enumerate(((old.col, col), (old.row, row))):
            frame[axis] = (frame[axis] + before + 0.5) / f - 0.5 - after
            frame[axis + 2] *= f
        return replace(
            self,
            corners=corners,
            field_frame=frame,
            field=self.field / np.float32(f),
            source_window=window,
            scales=(self.scales[0] / f, self.scales[1] / f),
        )


Positions = Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]]
"""Gives the strict homogeneous positions (k, 3) of places (k, 3) in (h, v, u), 0 to 1, in the boxes numbered (k,)."""

#: A bend that crosses a box askew is missed most between the lines along which it is looked for.
_BESIDE = 1.25
#: Crossings that are looked for together.
_MOST = 2_000_000

# 27 lines through a box in (h, v, u): nine along each axis, at its lower, middle and upper places.
_LINES = [
    (axis, np.insert(np.array(place), axis, 0.0))
    for axis in range(3)
    for place in itertools.product((0.0, 0.5, 1.0), repeat=2)
]
_AXIS = np.array([axis for axis, _ in _LINES])
_START = np.array([start for _, start in _LINES])
_ALONG = np.eye(3)[_AXIS]
_CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))


def _weights(fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trilinear weights of the corners (4·ih + 2·iv + iu) at places (k, 3) in (h, v, u)."""
    return np.where(_CORNERS[None] == 1.0, fractions[:, None], 1.0 - fractions[:, None]).prod(axis=2)


_FROM, _TO = _weights(_START), _weights(_START + _ALONG)


def bend_errors(breaks: Breaks, corners: NDArray[np.float64], strict: Positions) -> NDArray[np.float64]:
    """Residual of boxes at the breaks that cross them, pixels."""
    errors = np.zeros((len(corners), 4))
    for component, places in enumerate((np.asarray(breaks.columns), np.asarray(breaks.rows))):
        many = max(1, _MOST // (27 * max(1, len(places))))
        for first in range(0, len(corners) if len(places) else 0, many):
            some = slice(first, first + many)
            begin, end = (np.einsum("lc,ncj->nlj", w, corners[some]) for w in (_FROM, _TO))
            step = end - begin
            at = begin[..., component, None] - places * begin[..., 2, None]
            with np.errstate(all="ignore"):
                t = at / (places * step[..., 2, None] - step[..., component, None])
            box, line, place = np.nonzero((t > 0) & (t < 1))
            t = t[box, line, place]
            between = begin[box, line] + t[:, None] * step[box, line]
            found = strict(box + first, _START[line] + t[:, None] * _ALONG[line])
            with np.errstate(all="ignore"):
                miss = np.hypot(*(between[:, :2] / between[:, 2:] - found[:, :2] / found[:, 2:]).T)
            miss = _BESIDE * np.nan_to_num(miss, nan=np.inf)
            np.maximum.at(errors, (box + first, _AXIS[line]), miss)
            np.maximum.at(errors[:, 3], box + first, miss)
    return errors
