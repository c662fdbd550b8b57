"""Lines of sight over a grid of posts, each followed exactly but for what a pyramid of maxima rules out.

Heights are relative to the eye and already lowered by earth curvature. Positions are (column, row) of posts. Each line
runs from a target post to the eye; u is 0 at the target and 1 at the eye, so that a straight line of sight whose height
at the target is S has the height S (1 − u). The terrain is compared with it wherever the line crosses a grid line,
where bilinear terrain is linear between two posts. Inside a mesh a bilinear patch can rise above its chord by a quarter
of the mesh's twist (sum of opposite corners minus sum of the others) at most; that is the error of the method.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.pyramid import Pyramid, leave

_NUDGE = 1e-7
"""Part of a mesh by which a position on a grid line is moved on to find the mesh that comes next."""


@inner
def _crossing(heights: NDArray[np.float32], x: float, y: float) -> float:
    """Height at a point of a grid line; NaN where a post that is needed is missing."""
    rows, columns = heights.shape
    col, row = np.floor(x + 0.5), np.floor(y + 0.5)
    # The coordinate nearer to a whole number is the one that is on a grid line.
    if abs(x - col) <= abs(y - row):
        i = min(max(np.int64(col), 0), columns - 1)
        low = min(max(np.int64(np.floor(y)), 0), rows - 1)
        f = y - low
        if f <= _NUDGE:
            return np.float64(heights[low, i])
        high = min(low + 1, rows - 1)
        return np.float64(heights[low, i]) + f * (np.float64(heights[high, i]) - np.float64(heights[low, i]))
    j = min(max(np.int64(row), 0), rows - 1)
    left = min(max(np.int64(np.floor(x)), 0), columns - 1)
    f = x - left
    if f <= _NUDGE:
        return np.float64(heights[j, left])
    right = min(left + 1, columns - 1)
    return np.float64(heights[j, left]) + f * (np.float64(heights[j, right]) - np.float64(heights[j, left]))


@inner
def _follow(
    heights: NDArray[np.float32],
    pyramid: Pyramid,
    target: tuple[float, float],
    way: tuple[float, float],
    top: float,
    stop: bool,
) -> float:
    """Smallest height at the target, not below `top`, whose line of sight to the eye is free; with `stop` infinity as
    soon as `top` is not enough."""
    _, values, levels = pyramid
    x, y = target
    dx, dy = way
    nudge = _NUDGE / max(abs(dx), abs(dy))
    u, level, last = 0.0, 0, levels.shape[0] - 1
    while u < 1.0:
        ahead = u + nudge
        col = min(max(np.int64(np.floor(x + ahead * dx)), 0), heights.shape[1] - 2)
        row = min(max(np.int64(np.floor(y + ahead * dy)), 0), heights.shape[0] - 2)
        bx, by = col >> level, row >> level
        away = max(min(leave(bx, level, x, dx), leave(by, level, y, dy)), ahead)
        end = min(away, 1.0)
        lowest = top * (1.0 - (end if top >= 0.0 else u))
        if values[levels[level, 0] + by * levels[level, 2] + bx] <= lowest:
            level = min(level + 1, last)
        elif level > 0:
            level -= 1
            continue
        elif away < 1.0:
            ground = _crossing(heights, x + away * dx, y + away * dy)
            if ground > top * (1.0 - away):
                if stop:
                    return np.inf
                top = ground / (1.0 - away)
        u = away
    return top


@kernel
def sight_rows(
    heights: NDArray[np.float32],
    pyramid: Pyramid,
    eye: tuple[float, float, float],
    rows: tuple[int, int],
    target_height: float,
    stop: bool,
    out: NDArray[np.float32],
) -> None:
    """Height above ground from which a line of sight to the eye is free, for the posts of some rows.

    Parameters
    ----------
    heights : ndarray, shape (rows, cols), float32
        Relative to the eye, metres; NaN = no height, which blocks nothing.
    pyramid : tuple
        `kernels.raycast.pyramid_of(heights)`.
    eye : (float, float, float)
        Column and row of the eye, and the radius in posts beyond which nothing is looked at.
    rows : (int, int)
        First row and the one after the last.
    target_height : float
        Height of the targets above ground, metres; the least that is found.
    stop : bool
        True: only whether `target_height` is enough is asked, which is faster; where it is not, the result is infinite.
    out : ndarray, shape (rows, cols), float32
        Result, metres; NaN where there is no height and beyond the radius.
    """
    for row in range(rows[0], rows[1]):
        for col in range(heights.shape[1]):
            dx, dy = eye[0] - col, eye[1] - row
            h = np.float64(heights[row, col])
            if np.isnan(h) or dx * dx + dy * dy > eye[2] * eye[2]:
                out[row, col] = np.nan
                continue
            top = h + target_height
            if dx != 0.0 or dy != 0.0:
                top = _follow(heights, pyramid, (float(col), float(row)), (dx, dy), top, stop)
            out[row, col] = top - h
