"""Columns of a picture that are vertical planes: one profile of the terrain gives the ground of all of their pixels.

What a ray has flown over, the next one above it flies over, too: a column is one ray that is raised by a row each time
it meets ground, and goes on from the mesh where it has met it (the running horizon of Ecker 1991, §5.4). Each pixel is
where its own ray meets its mesh, as `kernels.raycast` has it. A ray that is below the ground where it comes to a mesh,
at its start or through a place without height, is told and left out: what it meets later says nothing of the ray above.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.normals import _hit_normal
from photoplan.kernels.pyramid import Pyramid
from photoplan.kernels.raycast import ASK, MISS, OVER, SURFACE, Faces, _block, _span, _through_mesh

#: Of pixels that are left out: rays have to tell what they show.
LEFT = -2

Fan = tuple[float, float, NDArray[np.float64], NDArray[np.float64], int, NDArray[np.float64]]
"""Z of the point of view, `bend`, rise per metre of the rows in the first column, what the rise is times in each
column, the uppermost row, and where the columns' lines begin and how long they are, metres (n, 2)."""
Shown = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]
"""Filled for pixels that show ground: X, Y, Z, normal and direction to the point of view (rows, n, 3), distance on the
map (rows, n), and which (rows, n): 0 ground, −1 nothing, `LEFT`."""
Columns = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]
"""Lines and rays of all columns as `kernels.raywalk` has them, and the row (n,) that each of them looks for now; above
the uppermost one when there is none left."""


@inner
def _raise(fan: Fan, row: Any, column: Any, line: NDArray[np.float64], ray: NDArray[np.float64]) -> None:
    """Let the line of a column, and its ray, rise as a row does."""
    rise, bend = fan[2][row] * fan[3][column], fan[1]
    begin, size = fan[5][column, 0], fan[5][column, 1]
    line[2] = fan[0] + begin * (rise + bend * begin)
    line[5] = size * (rise + 2.0 * bend * begin)
    line[6] = bend * size * size
    ray[2], ray[5], ray[6] = line[2], line[5], line[6]


@kernel
def begin_columns(fan: Fan, columns: Columns, which: NDArray[np.int64]) -> None:
    """Let some columns rise as their lowest row does."""
    lines, rays, rows = columns
    for j in range(which.shape[0]):
        i = which[j]
        _raise(fan, rows[i], i, lines[i], rays[i])


@inner
def _show(
    fan: Fan, pixel: tuple[Any, Any], line: NDArray[np.float64], t: float, normal: NDArray[np.float64], shown: Shown
) -> None:
    """Put down what a pixel, row and column, shows: the place at t of its line; the normal of its ground has no length
    in particular."""
    XYZ, n, towards, away, owner = shown
    row, column = pixel
    for k in range(3):
        XYZ[row, column, k] = line[k] + t * line[3 + k]
    XYZ[row, column, 2] += t * t * line[6]
    size, rise = fan[5][column, 1], fan[2][row] * fan[3][column]
    s = fan[5][column, 0] + size * t
    away[row, column], owner[row, column] = s, 0
    scale = 1.0 / np.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    # Walls are looked at from where rays come from.
    if normal[2] == 0.0 and normal[0] * line[3] + normal[1] * line[4] > 0.0:
        scale = -scale
    up = rise + 2.0 * fan[1] * s
    back = -1.0 / np.sqrt(1.0 + up * up)
    for k in range(3):
        n[row, column, k] = scale * normal[k]
        towards[row, column, k] = back * (line[3 + k] / size if k < 2 else up)


@kernel
def follow_columns(
    posts: NDArray[np.float32],
    pyramid: Pyramid,
    faces: Faces,
    frame: tuple[float, float, float, float, float],
    fan: Fan,
    columns: Columns,
    shown: Shown,
    which: NDArray[np.int64],
) -> None:
    """Follow some columns over one part of the terrain, which has no triangles; see `kernels.raywalk.follow_part`."""
    lines, rays, rows = columns
    low, high, levels = pyramid
    last = levels.shape[0] - 1
    local, normal = np.empty(9), np.empty(3)
    for j in range(which.shape[0]):
        i = which[j]
        line, ray = lines[i], rays[i]
        local[0], local[1] = (line[0] - frame[0]) / frame[2], (frame[1] - line[1]) / frame[3]
        local[3], local[4] = line[3] / frame[2], -line[4] / frame[3]
        local[2], local[5], local[6] = line[2] - frame[4], line[5], line[6]
        u, end, level = ray[7], ray[9], last
        while rows[i] >= fan[4]:
            mesh, block, out = _block(posts, levels, level, local, u, end)
            stop = min(out, end)
            t, result = stop, MISS
            if low[block] <= high[block] and _span(local, u, stop)[0] <= high[block]:
                if level > 0:
                    level -= 1
                    continue
                t, _, result = _through_mesh(posts, faces, mesh, local, (u, stop), OVER)
            if result == MISS:
                u, level = out, min(level + 1, last)
                if out >= end:
                    u = end
                    break
                continue
            if result == ASK:
                shown[4][rows[i], i] = LEFT
            else:
                local[7] = t
                _hit_normal(posts, faces, local, result != SURFACE, normal)
                normal[0], normal[1] = normal[0] / frame[2], -normal[1] / frame[3]
                _show(fan, (rows[i], i), line, t, normal, shown)
            # The ray above it comes here, too.
            rows[i] -= 1
            if rows[i] >= fan[4]:
                _raise(fan, rows[i], i, line, ray)
                local[2], local[5], local[6] = line[2] - frame[4], line[5], line[6]
        ray[7] = u
