"""Triangles in space, sorted into the cells of a map grid: what lies above a place, and what a line meets first.

A line passes few cells, since what it could meet has no great height; in a cell it is compared with all triangles there
whose heights it shares. Triangles have two sides and belong to their borders, so that nothing passes between two that
share an edge. Coordinates are metres from the first corner of the cells.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

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
def _cell(x: float, side: float, count: float) -> Any:
    return np.int64(min(max(np.floor(x / side), 0.0), count - 1.0))


@kernel
def count_in_cells(boxes: NDArray[np.float64], frame: tuple[float, int, int], count: NDArray[np.int64]) -> None:
    """Number of boxes xmin, ymin, xmax, ymax (n, 4) in each cell; `frame` is side, columns and rows."""
    side, columns, rows = frame
    for i in range(boxes.shape[0]):
        for row in range(_cell(boxes[i, 1], side, rows), _cell(boxes[i, 3], side, rows) + 1):
            for col in range(_cell(boxes[i, 0], side, columns), _cell(boxes[i, 2], side, columns) + 1):
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
        for row in range(_cell(boxes[i, 1], side, rows), _cell(boxes[i, 3], side, rows) + 1):
            for col in range(_cell(boxes[i, 0], side, columns), _cell(boxes[i, 2], side, columns) + 1):
                cell = row * columns + col
                members[place[cell]] = i
                place[cell] += 1
                ranges[cell, 0] = min(ranges[cell, 0], heights[i, 0])
                ranges[cell, 1] = max(ranges[cell, 1], heights[i, 1])


@inner
def _height(corners: NDArray[np.float64], f: int, x: float, y: float) -> float:
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
def highest(
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
        cell = _cell(y, side, rows) * columns + _cell(x, side, columns)
        for k in range(start[cell], start[cell + 1]):
            height = _height(corners, members[k], x, y)
            if height > out[i]:
                out[i], faces[i] = height, members[k]


@inner
def _meets(corners: NDArray[np.float64], f: int, line: NDArray[np.float64]) -> float:
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
def first_of(
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
    col = _cell(line[0] + begin * line[3], side, columns)
    row = _cell(line[1] + begin * line[4], side, rows)
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
                at = _meets(corners, members[k], line)
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
def first_faces(
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
        As in `highest`.
    lines : ndarray, shape (m, 6), float64
        X, Y, Z of the beginning, and what leads from there to the end; NaN meets nothing.
    along : ndarray, shape (m,), float64
        Filled with the part of the line before the triangle, 0 to 1; inf: it meets none.
    faces : ndarray, shape (m,), int64
        Filled with the triangle; −1: none.
    """
    for i in range(lines.shape[0]):
        along[i], faces[i] = first_of(corners, cells, lines[i], 0.0, 1.0)
