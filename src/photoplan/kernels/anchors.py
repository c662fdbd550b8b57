"""Interpolation between anchors and nodes of a tile: its errors, costs of source images, accuracy on the ground."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

# Boxes of anchors: interpolation errors, their part in the image, and where sources paint.


@inner
def _in_image(xy: NDArray[np.float64], bounds: tuple[float, float, float, float], around: float) -> bool:
    """Whether eight positions, widened, span a part of the image; not if one of them is NaN."""
    left, top, right, bottom = xy[0, 0], xy[0, 1], xy[0, 0], xy[0, 1]
    known = True
    for i in range(8):
        x, y = xy[i, 0], xy[i, 1]
        known = known and x == x and y == y
        left, top, right, bottom = min(left, x), min(top, y), max(right, x), max(bottom, y)
    return (
        known
        and right >= bounds[0] - around
        and bottom >= bounds[1] - around
        and left <= bounds[2] + around
        and top <= bounds[3] + around
    )


@inner
def _interpolation_error(lattice: NDArray[np.float64], h: int, v: int, u: int) -> float:
    """Distance of a place of a box's lattice to what its corners give there; infinite if that is undefined."""
    x, y, w = 0.0, 0.0, 0.0
    for i in range(2):
        for j in range(2):
            for k in range(2):
                corner = 9 * _neighbour_corner(h, i) + 3 * _neighbour_corner(v, j) + _neighbour_corner(u, k)
                x += lattice[corner, 0]
                y += lattice[corner, 1]
                w += lattice[corner, 2]
    strict = 9 * h + 3 * v + u
    dx = x / w - lattice[strict, 0] / lattice[strict, 2]
    dy = y / w - lattice[strict, 1] / lattice[strict, 2]
    miss = np.sqrt(dx * dx + dy * dy)
    return miss if miss == miss else np.inf


@inner
def _neighbour_corner(place: int, which: int) -> int:
    """Lower and upper corner (0, 1) that a place 0, 1, 2 along an edge is between."""
    return 2 * which if place == 1 else place


@kernel
def interpolation_errors(
    lattice: NDArray[np.float64],
    rect: NDArray[np.int64],
    bounds: tuple[float, float, float, float],
    radius: float,
    errors: NDArray[np.float64],
    keep: NDArray[np.bool_],
    behind: NDArray[np.bool_],
) -> None:
    """What boxes miss between their corners, and whether they can show a part of the image.

    Parameters
    ----------
    lattice : ndarray, shape (n, 27, 3)
        Strict homogeneous positions of 3 × 3 × 3 places of each box: 9·ih + 3·iv + iu.
    rect : ndarray, shape (n,)
        The rectangle that a box belongs to.
    bounds : (x_min, y_min, x_max, y_max)
        Of the image, pixels.
    radius : float
        Pixels around the image that count as well.
    errors : ndarray, shape (m, 4)
        Residuals of each rectangle along h, v, u, and worst of all, pixels: raised to what is found at the middles.
    keep, behind : ndarrays of bool, shape (m,), False
        Filled: whether anything of it is in the image, or may be, since a part is behind the camera; and the latter.
    """
    for n in range(len(lattice)):
        box, worst = lattice[n], errors[rect[n]]
        front = 0
        for i in range(27):
            x, y, w = box[i, 0], box[i, 1], box[i, 2]
            front += int(w > 0.0 and np.isfinite(x) and np.isfinite(y) and np.isfinite(w))
        keep[rect[n]] |= front > 0
        behind[rect[n]] |= front < 27
        for h in range(3):
            for v in range(3):
                for u in range(3):
                    halves = int(h == 1) + int(v == 1) + int(u == 1)
                    if halves == 0:
                        continue
                    miss = _interpolation_error(box, h, v, u)
                    worst[3] = max(worst[3], miss)
                    if halves == 1:
                        axis = 0 if h == 1 else (1 if v == 1 else 2)
                        worst[axis] = max(worst[axis], miss)
    inside, xy = np.zeros(len(errors), np.bool_), np.empty((8, 2))
    for n in range(len(lattice)):
        for i in range(8):
            corner = lattice[n, 18 * (i >> 2) + 6 * ((i >> 1) & 1) + 2 * (i & 1)]
            xy[i, 0], xy[i, 1] = corner[0] / corner[2], corner[1] / corner[2]
        # With w > 0 the corners bound the interpolation; the strict positions lie beside it by the residual.
        inside[rect[n]] |= _in_image(xy, bounds, radius + 2 * errors[rect[n], 3])
    for m in range(len(errors)):
        behind[m] &= keep[m]
        keep[m] &= inside[m] or behind[m]


@kernel
def blocks_in_image(
    boxes: tuple[Any, ...],
    ranges: NDArray[np.float64],
    side: int,
    bounds: tuple[float, float, float, float],
    around: float,
    xy: NDArray[np.float64],
    found: NDArray[np.float64],
) -> int:
    """Cut boxes into blocks that have heights of their own, and find those that lie in the image.

    Parameters
    ----------
    boxes : tuple
        Rectangles (n, 4), heights (n, 2) and homogeneous corners (n, 8, 3).
    ranges : ndarray, shape (2, rows, cols)
        Lowest and highest h of squares of `side` pixels of the tile; inf, −inf: none.
    side : int
        Of the blocks, pixels.
    bounds, around
        Of the image, and what of its surroundings counts, pixels.
    xy : ndarray, shape (k, 8, 2)
        Filled: positions of the corners of the blocks that were found.
    found : ndarray, shape (3, 2), inf, −inf
        Lowest and highest x, y of these corners, and length of (∂x/∂u, ∂x/∂v) or (∂y/∂u, ∂y/∂v): widened to them.

    Returns
    -------
    int
        Number of blocks found.
    """
    rects, heights, corners = boxes
    own = np.empty((8, 3))
    count = 0
    for n in range(len(rects)):
        left, top, right, bottom = rects[n]
        for row in range(top, bottom, side):
            for col in range(left, right, side):
                end_row, end_col = min(row + side, bottom), min(col + side, right)
                low, high = np.inf, -np.inf
                for i in range(row // side, (end_row - 1) // side + 1):
                    for j in range(col // side, (end_col - 1) // side + 1):
                        low, high = min(low, ranges[0, i, j]), max(high, ranges[1, i, j])
                low, high = max(low, heights[n, 0]), min(high, heights[n, 1])
                if not low <= high:
                    continue
                rise = heights[n, 1] - heights[n, 0]
                _part_corners(corners[n], ((low - heights[n, 0]) / rise, (high - heights[n, 0]) / rise), 4, own)
                _part_corners(own, ((row - top) / (bottom - top), (end_row - top) / (bottom - top)), 2, own)
                _part_corners(own, ((col - left) / (right - left), (end_col - left) / (right - left)), 1, own)
                for i in range(8):
                    xy[count, i, 0], xy[count, i, 1] = own[i, 0] / own[i, 2], own[i, 1] / own[i, 2]
                if _in_image(xy[count], bounds, around):
                    _widen_ranges(own, xy[count], end_col - col, end_row - row, found)
                    count += 1
    return count


@inner
def _part_corners(corners: NDArray[np.float64], at: tuple[float, float], bit: int, out: NDArray[np.float64]) -> None:
    """Corners of a part of a box, between two places along h (bit 4), v (2) or u (1); `out` may be `corners`."""
    for i in range(8):
        if i & bit == 0:
            for c in range(3):
                a, step = corners[i, c], corners[i | bit, c] - corners[i, c]
                out[i, c], out[i | bit, c] = a + at[0] * step, a + at[1] * step


@inner
def _widen_ranges(
    corners: NDArray[np.float64], xy: NDArray[np.float64], width: int, height: int, found: NDArray[np.float64]
) -> None:
    """Widen ranges of positions and scales by those at the corners of a box."""
    for i in range(8):
        w = corners[i, 2]
        for c in range(2):
            # Signs do not matter: the derivatives are squared.
            along_u = ((corners[i ^ 1, c] - corners[i, c]) - xy[i, c] * (corners[i ^ 1, 2] - w)) / (width * w)
            along_v = ((corners[i ^ 2, c] - corners[i, c]) - xy[i, c] * (corners[i ^ 2, 2] - w)) / (height * w)
            scale = np.sqrt(along_u * along_u + along_v * along_v)
            found[2, 0], found[2, 1] = min(found[2, 0], scale), max(found[2, 1], scale)
            found[c, 0], found[c, 1] = min(found[c, 0], xy[i, c]), max(found[c, 1], xy[i, c])


@kernel
def owned_bounds(
    owner: NDArray[np.uint16], place: NDArray[np.int64], side: int, squares: NDArray[np.bool_], parts: NDArray[np.int64]
) -> None:
    """Where the pixels are that each source paints.

    Parameters
    ----------
    owner : ndarray, shape (height, width), uint16
    place : ndarray, shape (k,)
        Place in `squares` and `parts` of each owner; −1: it is not asked for.
    side : int
        Of the squares, pixels.
    squares : ndarray of bool, shape (n, rows, cols), False
        Filled: whether a square of the tile holds pixels of a source.
    parts : ndarray, shape (n, 4), width, height, 0, 0
        First column, first row, end column, end row of each source's pixels: narrowed to them.
    """
    for row in range(owner.shape[0]):
        for first in range(0, owner.shape[1], side):
            start, end = first, min(first + side, owner.shape[1])
            while start < end:
                number, stop, others = owner[row, start], end, 0
                for i in range(start, end):
                    others += int(owner[row, i] != number)
                if others > 0:
                    stop = start + 1
                    while owner[row, stop] == number:
                        stop += 1
                which = place[number]
                if which >= 0:
                    squares[which, row // side, first // side] = True
                    part = parts[which]
                    part[0], part[1] = min(part[0], start), min(part[1], row)
                    part[2], part[3] = max(part[2], stop), row + 1
                start = stop


# Costs of source images: positions of the pixels of a tile, and penalties.


@kernel
def interpolate_positions(
    relief: NDArray[np.float32],
    nodes: NDArray[np.float64],
    levels: tuple[float, float],
    corner: tuple[int, int],
    spacing: int,
    size: tuple[float, float],
    xy: NDArray[np.float64],
    near: NDArray[np.float64],
    values: NDArray[np.float32],
) -> None:
    """Positions and k values of each pixel, by linear interpolation in (u, v, h) between nodes.

    nodes (2, rows, columns, 3 + k): homogeneous position and values at two levels; the first node lies `corner`
    (columns, rows) before the first pixel. Writes xy (height, width, 2), near (height, width), the distance from the
    border of an image of a size (width, height), negative outside, and values (k, height, width); NaN without surface,
    and at and behind the camera's plane.
    """
    height, width = relief.shape
    low, thick = levels[0], levels[1] - levels[0]
    found = np.empty(nodes.shape[3])
    for i in range(height):
        v = (i + corner[1]) / spacing
        row = min(np.int64(v), nodes.shape[1] - 2)
        fv = v - row
        for j in range(width):
            u = (j + corner[0]) / spacing
            col = min(np.int64(u), nodes.shape[2] - 2)
            fu = u - col
            fh = (np.float64(relief[i, j]) - low) / thick
            for k in range(nodes.shape[3]):
                total = 0.0
                for level in range(2):
                    upper = nodes[level, row, col, k] * (1.0 - fu) + fu * nodes[level, row, col + 1, k]
                    lower = nodes[level, row + 1, col, k] * (1.0 - fu) + fu * nodes[level, row + 1, col + 1, k]
                    total += (fh if level == 1 else 1.0 - fh) * (upper + fv * (lower - upper))
                found[k] = total
            w = found[2] if found[2] > 0.0 else np.nan
            xy[i, j, 0] = found[0] / w
            xy[i, j, 1] = found[1] / w
            x, y = abs(xy[i, j, 0] - 0.5 * (size[0] - 1.0)), abs(xy[i, j, 1] - 0.5 * (size[1] - 1.0))
            near[i, j] = min(0.5 * size[0] - x, 0.5 * size[1] - y)
            for k in range(3, nodes.shape[3]):
                values[k - 3, i, j] = found[k] if w > 0.0 else np.nan


@kernel
def source_costs(
    near: NDArray[np.float64],
    values: NDArray[np.float32],
    slope: NDArray[np.float32],
    drawn: NDArray[np.uint16],
    border: tuple[float, float, float, float],
    sloped: tuple[float, float, float],
    ahead: tuple[float, int, float],
) -> None:
    """Make smooth penalties, the first of values (4, height, width), those of an image; see `plan.choice`.

    Parameters
    ----------
    near : ndarray, shape (height, width)
        Distance from the image's border, pixels; outside, and where it is not known, the penalty becomes infinite.
    values, slope : ndarray of float32, shapes (4, height, width) and (2, height, width)
        The last two values are how many columns and rows a line of sight moves per metre; slope of the ground.
    drawn : ndarray of uint16, shape (height, width)
        Numbers that somebody has given to pixels; empty: nobody has.
    border : four floats
        Its weight, how far it counts, and a margin and what that costs.
    sloped : three floats
        What a doubled area counts, and the least and largest area of a pixel on the slope beside that on the level.
    ahead : (float, int, float)
        A rank that is added, the image's number, and what it is worth that it was given the pixel.
    """
    given = drawn.shape[0] > 0
    for i in range(near.shape[0]):
        for j in range(near.shape[1]):
            total, n = np.float64(values[0, i, j]), near[i, j]
            if not n >= 0.0 or np.isnan(total):
                values[0, i, j] = np.inf
                continue
            if sloped[0] > 0.0:
                larger = abs(1.0 - values[2, i, j] * slope[0, i, j] - values[3, i, j] * slope[1, i, j])
                total -= sloped[0] * np.log2(min(max(larger, sloped[1]), sloped[2]))
            rim = max(1.0 - n / border[1], 0.0)
            total += border[0] * rim * rim + ahead[0]
            if given and drawn[i, j] == ahead[1]:
                total -= ahead[2]
            if n < border[2]:
                total += border[3]
            values[0, i, j] = total


# Standard deviations on the ground from errors in the image and of the depth.


#: Figures of a place that the spread is computed from: the ray's run (2), covariance in the tile (3), ground (9).
FIGURES = 14


@kernel
def interpolate_trilinear(
    nodes: NDArray[np.float64], low: float, high: float, relief: NDArray[np.float32], out: NDArray[np.float64]
) -> None:
    """Interpolate trilinearly from the first to the last pixel of a tile, and between two depths.

    Parameters
    ----------
    nodes : ndarray, shape (layers, rows, cols, k)
        Two or more along each axis, at equal distances.
    low, high : float
        Depth of the first and of the last layer.
    relief : ndarray, shape (height, width), float32
        Depth of each pixel.
    out : ndarray, shape (height, width, k)
        Is written; NaN where the depth or a node around is NaN.
    """
    layers, rows, cols, count = nodes.shape
    height, width = relief.shape
    for i in range(height):
        y = i * (rows - 1) / max(height - 1, 1)
        r = min(int(y), rows - 2)
        y -= r
        for j in range(width):
            h = np.float64(relief[i, j])
            if math.isnan(h):
                for k in range(count):
                    out[i, j, k] = np.nan
                continue
            x = j * (cols - 1) / max(width - 1, 1)
            c = min(int(x), cols - 2)
            x -= c
            z = (h - low) / (high - low) * (layers - 1)
            a = min(max(int(z), 0), layers - 2)
            z -= a
            for k in range(count):
                total = 0.0
                for b in range(2):
                    upper = nodes[a + b, r, c, k] * (1 - x) + nodes[a + b, r, c + 1, k] * x
                    lower = nodes[a + b, r + 1, c, k] * (1 - x) + nodes[a + b, r + 1, c + 1, k] * x
                    total += (upper * (1 - y) + lower * y) * (z if b else 1 - z)
                out[i, j, k] = total


@kernel
def ground_errors(
    figures: NDArray[np.float64], slope: NDArray[np.float64], sigma: NDArray[np.float64], out: NDArray[np.float32]
) -> None:
    """Standard deviations and error ellipse of what places show.

    With e the displacement on the level through a place, t the run of its ray (tile units per depth), s the slope and
    dh the error of the depth, what is shown lies off by (u, v) = e − t (dh + z) and z = s (u, v) + dh.

    Parameters
    ----------
    figures : ndarray, shape (n, 14)
        t_u, t_v; variances and covariance uu, uv, vv of e; derivatives of X, of Y, of Z by u, v and depth.
    slope : ndarray, shape (n, 2)
        Derivatives of the depth by u and v.
    sigma : ndarray, shape (n,)
        Standard deviation of the depth.
    out : ndarray, shape (6, n), float32
        Is written: standard deviations of X, Y, Z, semi-axes and azimuth (degrees from Y to X, 0 to 180) of the
        ellipse in X, Y; NaN where a figure is NaN or the surface is turned away from the ray.
    """
    B = np.empty((3, 3))
    G = np.empty((3, 3))
    for n in range(len(sigma)):
        tu, tv, uu, uv, vv = figures[n, :5]
        su, sv = slope[n, 0], slope[n, 1]
        facing = 1.0 + su * tu + sv * tv
        variance = sigma[n] * sigma[n]
        if not facing > 0.0 or math.isnan(uu + variance):
            for band in range(6):
                out[band, n] = np.nan
            continue
        B[0, 0], B[0, 1], B[0, 2] = 1.0 - tu * su / facing, -tu * sv / facing, -tu / facing
        B[1, 0], B[1, 1], B[1, 2] = -tv * su / facing, 1.0 - tv * sv / facing, -tv / facing
        B[2, 0], B[2, 1], B[2, 2] = su / facing, sv / facing, 1.0 / facing
        for a in range(3):
            for b in range(3):
                G[a, b] = 0.0
                for k in range(3):
                    G[a, b] += figures[n, 5 + 3 * a + k] * B[k, b]
        xx = G[0, 0] ** 2 * uu + 2 * G[0, 0] * G[0, 1] * uv + G[0, 1] ** 2 * vv + G[0, 2] ** 2 * variance
        yy = G[1, 0] ** 2 * uu + 2 * G[1, 0] * G[1, 1] * uv + G[1, 1] ** 2 * vv + G[1, 2] ** 2 * variance
        zz = G[2, 0] ** 2 * uu + 2 * G[2, 0] * G[2, 1] * uv + G[2, 1] ** 2 * vv + G[2, 2] ** 2 * variance
        xy = G[0, 0] * G[1, 0] * uu + (G[0, 0] * G[1, 1] + G[0, 1] * G[1, 0]) * uv + G[0, 1] * G[1, 1] * vv
        xy += G[0, 2] * G[1, 2] * variance
        middle, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        out[0, n], out[1, n], out[2, n] = math.sqrt(xx), math.sqrt(yy), math.sqrt(max(zz, 0.0))
        out[3, n], out[4, n] = math.sqrt(middle + half), math.sqrt(max(middle - half, 0.0))
        out[5, n] = (90.0 - math.degrees(0.5 * math.atan2(2.0 * xy, xx - yy))) % 180.0
