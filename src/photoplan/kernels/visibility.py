"""Visibility: lines of sight over a height grid, and the ground that objects in space hide from them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.rays import Pyramid, leave_block

# Triangles in space, sorted into the cells of a map grid: the highest at a place, and the first that a line meets.
#
# A line passes few cells, since what it could meet has no great height; in a cell it is compared with all triangles
# there whose heights it shares. Triangles have two sides and belong to their borders, so that nothing passes between
# two that share an edge. Coordinates are metres from the first corner of the cells.


Cells = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]
"""Start of each cell's triangles, shape (rows · columns + 1,); the triangles; lowest and highest height of each cell's,
shape (rows · columns, 2), inf and −inf where there are none; and side, columns, rows, lowest and highest height of all,
shape (5,)."""

_EDGE = 1e-7
"""Map points this near to a triangle, metres, lie on it."""
_ON = 1e-9
"""A line that passes this near to a triangle, in sides of the triangle, meets it."""
_UPRIGHT = 1e-9
"""Triangles whose map area is smaller than this, in squares of their longest side, have nothing above a place."""


@inner
def _map_cell(x: float, side: float, count: float) -> Any:
    return np.int64(min(max(np.floor(x / side), 0.0), count - 1.0))


@kernel
def count_in_cells(boxes: NDArray[np.float64], frame: tuple[float, int, int], count: NDArray[np.int64]) -> None:
    """Number of boxes xmin, ymin, xmax, ymax (n, 4) in each cell; `frame` is side, columns and rows."""
    side, columns, rows = frame
    for i in range(boxes.shape[0]):
        for row in range(_map_cell(boxes[i, 1], side, rows), _map_cell(boxes[i, 3], side, rows) + 1):
            for col in range(_map_cell(boxes[i, 0], side, columns), _map_cell(boxes[i, 2], side, columns) + 1):
                count[row * columns + col] += 1


@kernel
def fill_cells(
    boxes: NDArray[np.float64],
    heights: NDArray[np.float64],
    frame: tuple[float, int, int],
    place: NDArray[np.int64],
    members: NDArray[np.int32],
    ranges: NDArray[np.float64],
) -> None:
    """Enter boxes and their heights (n, 2) into cells; `place`, where each cell begins, becomes where it ends."""
    side, columns, rows = frame
    for i in range(boxes.shape[0]):
        for row in range(_map_cell(boxes[i, 1], side, rows), _map_cell(boxes[i, 3], side, rows) + 1):
            for col in range(_map_cell(boxes[i, 0], side, columns), _map_cell(boxes[i, 2], side, columns) + 1):
                cell = row * columns + col
                members[place[cell]] = i
                place[cell] += 1
                ranges[cell, 0] = min(ranges[cell, 0], heights[i, 0])
                ranges[cell, 1] = max(ranges[cell, 1], heights[i, 1])


@inner
def _triangle_height(corners: NDArray[np.float64], f: int, x: float, y: float) -> float:
    """Height of triangle f at a map point; −inf beside it, and where it is upright."""
    ux, uy = corners[f, 1, 0] - corners[f, 0, 0], corners[f, 1, 1] - corners[f, 0, 1]
    vx, vy = corners[f, 2, 0] - corners[f, 0, 0], corners[f, 2, 1] - corners[f, 0, 1]
    wx, wy = vx - ux, vy - uy
    area = ux * vy - uy * vx
    uu, vv, ww = ux * ux + uy * uy, vx * vx + vy * vy, wx * wx + wy * wy
    if abs(area) <= _UPRIGHT * max(uu, vv, ww):
        return -np.inf
    px, py = x - corners[f, 0, 0], y - corners[f, 0, 1]
    sign = 1.0 if area > 0.0 else -1.0
    b, c = sign * (px * vy - py * vx), sign * (ux * py - uy * px)
    if b < -_EDGE * np.sqrt(vv) or c < -_EDGE * np.sqrt(uu) or sign * area - b - c < -_EDGE * np.sqrt(ww):
        return -np.inf
    rise = b * (corners[f, 1, 2] - corners[f, 0, 2]) + c * (corners[f, 2, 2] - corners[f, 0, 2])
    return corners[f, 0, 2] + rise / (sign * area)


@kernel
def highest_triangles(
    corners: NDArray[np.float64],
    cells: Cells,
    XY: NDArray[np.float64],
    out: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> None:
    """The highest triangle above or below map points, and its height.

    Parameters
    ----------
    corners : ndarray, shape (n, 3, 3), float64
    cells : tuple
        See `Cells`.
    XY : ndarray, shape (m, 2), float64
    out : ndarray, shape (m,), float64
        −inf where there is none.
    faces : ndarray, shape (m,), int64
        Which; −1: none.
    """
    start, members, _, frame = cells
    side, columns, rows = frame[0], np.int64(frame[1]), np.int64(frame[2])
    for i in range(XY.shape[0]):
        x, y = XY[i, 0], XY[i, 1]
        out[i], faces[i] = -np.inf, -1
        # Not so for NaN, too.
        if not (-_EDGE <= x <= side * columns + _EDGE and -_EDGE <= y <= side * rows + _EDGE):
            continue
        cell = _map_cell(y, side, rows) * columns + _map_cell(x, side, columns)
        for k in range(start[cell], start[cell + 1]):
            height = _triangle_height(corners, members[k], x, y)
            if height > out[i]:
                out[i], faces[i] = height, members[k]


@inner
def _intersect_triangle(corners: NDArray[np.float64], f: int, line: NDArray[np.float64]) -> float:
    """Parameter at which a line meets triangle f (Möller and Trumbore 1997); NaN if it does not, or lies in it."""
    ux, uy, uz = (
        corners[f, 1, 0] - corners[f, 0, 0],
        corners[f, 1, 1] - corners[f, 0, 1],
        corners[f, 1, 2] - corners[f, 0, 2],
    )
    vx, vy, vz = (
        corners[f, 2, 0] - corners[f, 0, 0],
        corners[f, 2, 1] - corners[f, 0, 1],
        corners[f, 2, 2] - corners[f, 0, 2],
    )
    dx, dy, dz = line[3], line[4], line[5]
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    volume = ux * px + uy * py + uz * pz
    uu, vv, dd = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, dx * dx + dy * dy + dz * dz
    if not volume * volume > 1e-24 * uu * vv * dd:
        return np.nan
    sx, sy, sz = line[0] - corners[f, 0, 0], line[1] - corners[f, 0, 1], line[2] - corners[f, 0, 2]
    b = (sx * px + sy * py + sz * pz) / volume
    if b < -_ON or b > 1.0 + _ON:
        return np.nan
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    c = (dx * qx + dy * qy + dz * qz) / volume
    if c < -_ON or b + c > 1.0 + _ON:
        return np.nan
    return (vx * qx + vy * qy + vz * qz) / volume


@inner
def first_hit(
    corners: NDArray[np.float64], cells: Cells, line: NDArray[np.float64], begin: float, end: float
) -> tuple[float, int]:
    """Least parameter between two at which a line (x, y, z and their changes) meets a triangle, and which; inf, −1 if
    there is none."""
    start, members, ranges, frame = cells
    side, columns, rows = frame[0], np.int64(frame[1]), np.int64(frame[2])
    best, face = np.inf, -1
    for axis in range(3):
        low, high = (frame[3], frame[4]) if axis == 2 else (0.0, side * frame[1 + axis])
        d = line[3 + axis]
        if d == 0.0:
            if not low <= line[axis] <= high:
                return best, face
        else:
            a, b = (low - line[axis]) / d, (high - line[axis]) / d
            begin, end = max(begin, min(a, b)), min(end, max(a, b))
    # Not so for NaN, too.
    if not begin <= end:
        return best, face
    col = _map_cell(line[0] + begin * line[3], side, columns)
    row = _map_cell(line[1] + begin * line[4], side, rows)
    t = begin
    while True:
        out_x, out_y = np.inf, np.inf
        if line[3] != 0.0:
            out_x = ((col + (1 if line[3] > 0.0 else 0)) * side - line[0]) / line[3]
        if line[4] != 0.0:
            out_y = ((row + (1 if line[4] > 0.0 else 0)) * side - line[1]) / line[4]
        away = min(out_x, out_y)
        last = min(away, end)
        cell = row * columns + col
        za, zb = line[2] + t * line[5], line[2] + last * line[5]
        if min(za, zb) <= ranges[cell, 1] and max(za, zb) >= ranges[cell, 0]:
            for k in range(start[cell], start[cell + 1]):
                at = _intersect_triangle(corners, members[k], line)
                if begin <= at <= end and at < best:
                    best, face = at, members[k]
        if best <= last or away >= end:
            return best, face
        t = max(t, last)
        if out_x <= out_y:
            col += 1 if line[3] > 0.0 else -1
        else:
            row += 1 if line[4] > 0.0 else -1
        if col < 0 or row < 0 or col >= columns or row >= rows:
            return best, face


@kernel
def first_hits(
    corners: NDArray[np.float64],
    cells: Cells,
    lines: NDArray[np.float64],
    along: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> None:
    """The triangle that each line meets first.

    Parameters
    ----------
    corners, cells
        As in `highest_triangles`.
    lines : ndarray, shape (m, 6), float64
        X, Y, Z of the beginning, and what leads from there to the end; NaN meets nothing.
    along : ndarray, shape (m,), float64
        Filled with the part of the line before the triangle, 0 to 1; inf: it meets none.
    faces : ndarray, shape (m,), int64
        Filled with the triangle; −1: none.
    """
    for i in range(lines.shape[0]):
        along[i], faces[i] = first_hit(corners, cells, lines[i], 0.0, 1.0)


# Lines of sight over a grid of posts, each followed exactly except where a pyramid of maxima excludes a hit.
#
# Heights are already lowered by earth curvature. Positions are (column, row) of posts. Each line runs from a target
# post to the eye; u is 0 at the target and 1 at the eye, so that a straight line of sight between the heights S and E
# has the height S (1 − u) + E u. The terrain is compared with it wherever the line crosses a grid line, where bilinear
# terrain is linear between two posts. Inside a mesh a bilinear patch can rise above its chord by a quarter of the
# mesh's twist (sum of opposite corners minus sum of the others) at most; that is the error of the method.


_NUDGE, _ALONG = 1e-7, 1e-5
"""Part of a mesh by which a position on a grid line is moved on to find the mesh that comes next; and by which a line
leaves a row or column in all, to count as leaving it."""


@inner
def _height_on_line(heights: NDArray[np.float32], x: float, y: float) -> float:
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
def _least_visible_height(
    heights: NDArray[np.float32],
    pyramid: Pyramid,
    target: tuple[float, float],
    way: tuple[float, float],
    top: float,
    eye: float,
    begin: float,
    stop: bool,
) -> float:
    """Smallest height at the target, not below `top`, whose line of sight to the height `eye`, `way` from it, is free
    from its part `begin` on; with `stop` infinity as soon as `top` is not enough."""
    _, values, levels = pyramid
    x, y = target
    # A line that is all but along a row or column is: else steps that round to nothing would not leave it.
    dx, dy = way[0] if abs(way[0]) > _ALONG else 0.0, way[1] if abs(way[1]) > _ALONG else 0.0
    nudge = _NUDGE / max(abs(dx), abs(dy))
    u, level, last = begin, 0, levels.shape[0] - 1
    while u < 1.0:
        ahead = u + nudge
        col = min(max(np.int64(np.floor(x + ahead * dx)), 0), heights.shape[1] - 2)
        row = min(max(np.int64(np.floor(y + ahead * dy)), 0), heights.shape[0] - 2)
        bx, by = col >> level, row >> level
        away = max(min(leave_block(bx, level, x, dx), leave_block(by, level, y, dy)), ahead)
        end = min(away, 1.0)
        lower = end if top >= eye else u
        lowest = top * (1.0 - lower) + eye * lower
        if values[levels[level, 0] + by * levels[level, 2] + bx] <= lowest:
            level = min(level + 1, last)
        elif level > 0:
            level -= 1
            continue
        elif away < 1.0:
            ground = _height_on_line(heights, x + away * dx, y + away * dy)
            if ground > top * (1.0 - away) + eye * away:
                if stop:
                    return np.inf
                top = (ground - eye * away) / (1.0 - away)
        u = away
    return top


@kernel
def least_visible_heights(
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
        `kernels.rays.pyramid_of(heights)`.
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
                top = _least_visible_height(heights, pyramid, (float(col), float(row)), (dx, dy), top, 0.0, 0.0, stop)
            out[row, col] = top - h


#: What `find_hidden` says of a pixel: it is seen; something is in the way; nothing is as far as the heights reach.
SEEN, HIDDEN, BEYOND = 0, 1, 2


#: Side of the blocks of posts that `free_blocks` tells apart.
BLOCK_MESHES = 8


@kernel
def free_blocks(heights: NDArray[np.float32], slope: float, top: float) -> NDArray[np.bool_]:
    """Blocks of `BLOCK_MESHES` × `BLOCK_MESHES` meshes from which every line that rises at least so much is free.

    Near by the terrain is nowhere as steep as the line; further away it is lower than the line has risen to by then.

    Parameters
    ----------
    heights : ndarray, shape (rows, cols), float32
        NaN = no height, which blocks nothing.
    slope : float
        Height per distance of two posts; from lines that do not rise no block is quiet.
    top : float
        No height exceeds it.
    """
    rows, columns = heights.shape
    down, across = -(-rows // BLOCK_MESHES), -(-columns // BLOCK_MESHES)
    quiet = np.ones((down, across), np.bool_)
    low = np.full((down, across), np.inf)
    # Steepest slope and highest post, each with those of the blocks around.
    steep, high = np.zeros((down, across)), np.full((down, across), -np.inf)
    for row in range(rows):
        for col in range(columns):
            j, i = row // BLOCK_MESHES, col // BLOCK_MESHES
            h = heights[row, col]
            low[j, i] = h if h < low[j, i] else low[j, i]
            high[j, i] = h if h > high[j, i] else high[j, i]
            x = h - heights[row, min(col + 1, columns - 1)]
            y = h - heights[min(row + 1, rows - 1), col]
            # Of a bilinear mesh the slopes along its four sides bound all others.
            steep[j, i] = abs(x) if abs(x) > steep[j, i] else steep[j, i]
            steep[j, i] = abs(y) if abs(y) > steep[j, i] else steep[j, i]
    _dilate(steep)
    least = low.min()
    for j in range(down):
        for i in range(across):
            quiet[j, i] = np.sqrt(2.0) * steep[j, i] < slope
    if not slope > 0.0:
        return quiet
    _dilate(high)
    for ring in range(1, max(down, across) + 1):
        # A line may begin below the lowest post of its block, but in a mesh that is less steep than the line.
        risen = slope * (BLOCK_MESHES * ring - 2.0)
        _dilate(high)
        for j in range(down):
            for i in range(across):
                quiet[j, i] &= high[j, i] <= low[j, i] + risen
        if least + risen >= top:
            break
    return quiet


@inner
def _dilate(values: NDArray[np.float64]) -> None:
    """The largest of each block and the eight around it, in place."""
    for j in range(values.shape[0]):
        before = values[j, 0]
        for i in range(values.shape[1]):
            here = values[j, i]
            values[j, i] = max(before, here, values[j, min(i + 1, values.shape[1] - 1)])
            before = here
    for i in range(values.shape[1]):
        before = values[0, i]
        for j in range(values.shape[0]):
            here = values[j, i]
            values[j, i] = max(before, here, values[min(j + 1, values.shape[0] - 1), i])
            before = here


@inner
def _direction_between(nodes: NDArray[np.float64], part: tuple[float, float, float], d: NDArray[np.float64]) -> None:
    """Direction to a source at a place between nodes: parts of rows, of columns, and of the way between the levels."""
    m, n = nodes.shape[1], nodes.shape[2]
    j, i = min(np.int64(part[0]), m - 2), min(np.int64(part[1]), n - 2)
    fv, fu = part[0] - j, part[1] - i
    for k in range(d.shape[0]):
        low = (1.0 - fv) * ((1.0 - fu) * nodes[0, j, i, k] + fu * nodes[0, j, i + 1, k]) + fv * (
            (1.0 - fu) * nodes[0, j + 1, i, k] + fu * nodes[0, j + 1, i + 1, k]
        )
        high = (1.0 - fv) * ((1.0 - fu) * nodes[1, j, i, k] + fu * nodes[1, j, i + 1, k]) + fv * (
            (1.0 - fu) * nodes[1, j + 1, i, k] + fu * nodes[1, j + 1, i + 1, k]
        )
        d[k] = low + part[2] * (high - low)


@kernel
def find_hidden(
    heights: NDArray[np.float32],
    pyramid: Pyramid,
    frame: tuple[float, float, float, float, float, float],
    relief: NDArray[np.float32],
    nodes: NDArray[np.float64],
    levels: tuple[float, float],
    top: float,
    limits: tuple[float, float, float],
    quiet: NDArray[np.bool_],
    out: NDArray[np.uint8],
) -> None:
    """Whether the lines of sight from the pixels of a tile to a source are free.

    Parameters
    ----------
    heights : ndarray, shape (rows, cols), float32
        Ground of the tile and of what is around it; NaN = no surface, which hides nothing.
    pyramid : tuple
        `pyramid_of(heights)`.
    frame : six floats
        x, y, a, b, c, d: the pixel in a column and row of the tile lies in `heights` at x + a · column + b · row and
        y + c · column + d · row.
    relief : ndarray, shape (height, width), float32
        Where lines begin: on the ground or above it; NaN = no surface.
    nodes : ndarray, shape (2, m, n, 5)
        Directions to the source at two levels, m rows and n columns of nodes spread over the tile from its first to its
        last pixel: steps in columns and rows of pixels, and in height, and what is left of the depth and by how much a
        step lessens it. Interpolated linearly; a source at a point is the case where that is exact.
    levels : (float, float)
        Their heights.
    top : float
        A height that nothing exceeds.
    limits : (float, float, float)
        By how much ground may rise above a line, in heights; how far a line is followed, and up to where the ground is
        that of the place itself, in columns or rows of `heights`.
    quiet : ndarray of bool
        `free_blocks` of the heights: lines from there are not followed.
    out : ndarray, shape (height, width), uint8
        `SEEN`, `HIDDEN` or `BEYOND`.
    """
    rows, columns = heights.shape
    step_v, step_u = (nodes.shape[1] - 1) / max(out.shape[0] - 1, 1), (nodes.shape[2] - 1) / max(out.shape[1] - 1, 1)
    d = np.empty(5)
    for row in range(out.shape[0]):
        for col in range(out.shape[1]):
            x = frame[0] + col * frame[2] + row * frame[3]
            y = frame[1] + col * frame[4] + row * frame[5]
            h = np.float64(relief[row, col])
            out[row, col] = SEEN
            if np.isnan(h) or quiet[np.int64(y) // BLOCK_MESHES, np.int64(x) // BLOCK_MESHES]:
                continue
            _direction_between(nodes, (row * step_v, col * step_u, (h - levels[0]) / (levels[1] - levels[0])), d)
            d[0], d[1] = d[0] * frame[2] + d[1] * frame[3], d[0] * frame[4] + d[1] * frame[5]
            t = (top - h) / d[2] if d[2] > 0.0 else np.inf
            if d[4] > 0.0:
                t = min(t, d[3] / d[4])
            if not d[3] > 0.0:
                continue
            # As far as there are heights, but whatever the tile no further than the limit.
            cut = min(t, limits[1] / max(abs(d[0]), abs(d[1]), 1e-300))
            for k in range(2):
                at, last = (x, columns - 1) if k == 0 else (y, rows - 1)
                if d[k] > 0.0:
                    cut = min(cut, (last - at) / d[k])
                elif d[k] < 0.0:
                    cut = min(cut, -at / d[k])
            dx, dy = d[0] * cut, d[1] * cut
            if max(abs(dx), abs(dy)) >= 1e-3:
                low = h + limits[0]
                near = limits[2] / max(abs(dx), abs(dy))
                if (
                    _least_visible_height(heights, pyramid, (x, y), (dx, dy), low, low + d[2] * cut, near, True)
                    == np.inf
                ):
                    out[row, col] = HIDDEN
                    continue
            if cut < t:
                out[row, col] = BEYOND


@kernel
def find_behind(
    corners: NDArray[np.float64],
    cells: Cells,
    frame: tuple[float, float, float],
    relief: NDArray[np.float32],
    nodes: NDArray[np.float64],
    levels: tuple[float, float],
    short: float,
    out: NDArray[np.uint8],
) -> None:
    """Enter the pixels of a tile whose lines of sight to a source meet a triangle; `HIDDEN` ones are not asked.

    Parameters
    ----------
    corners, cells
        As in `kernels.visibility.highest_triangles`.
    frame : (float, float, float)
        X, Y of the centre of the tile's first pixel, as corners have them, and side of a pixel.
    relief, nodes, levels
        As in `find_hidden`.
    short : float
        What is met no further than this from the pixel's place, metres, is the place itself.
    out : ndarray, shape (height, width), uint8
    """
    step_v, step_u = (nodes.shape[1] - 1) / max(out.shape[0] - 1, 1), (nodes.shape[2] - 1) / max(out.shape[1] - 1, 1)
    d, line = np.empty(5), np.empty(6)
    for row in range(out.shape[0]):
        for col in range(out.shape[1]):
            h = np.float64(relief[row, col])
            if np.isnan(h) or out[row, col] == HIDDEN:
                continue
            _direction_between(nodes, (row * step_v, col * step_u, (h - levels[0]) / (levels[1] - levels[0])), d)
            if not d[3] > 0.0:
                continue
            line[0], line[1], line[2] = frame[0] + col * frame[2], frame[1] - row * frame[2], h
            line[3], line[4], line[5] = d[0] * frame[2], -d[1] * frame[2], d[2]
            begin = short / np.sqrt(line[3] * line[3] + line[4] * line[4] + line[5] * line[5])
            end = d[3] / d[4] if d[4] > 0.0 else np.inf
            _, face = first_hit(corners, cells, line, begin, end)
            if face >= 0:
                out[row, col] = HIDDEN
