"""Rays over terrain that is kept in parts: their lines, the part that comes next, and the first hit over it.

A piece of a ray is a *line*: X, Y, Z, their change by t, and that of Z by t², cut to where there may be ground. Its
*ray* holds the same with x to the right and y downwards in parts from the upper-left corner of all of them, the t that
it has come to, its last t, and that at which it leaves the part it is in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.normals import _hit_normal
from photoplan.kernels.pyramid import Pyramid, leave
from photoplan.kernels.raycast import ASK, BELOW, MISS, NONE, OVER, SURFACE, Faces, _cell, _follow, _span

Box = tuple[float, float, float, float]
Parts = tuple[float, float, float, float]
"""X, Y of the upper-left corner of all parts, width and height of a part, metres."""


@inner
def _line(path: NDArray[np.float64], piece: int, bend: float, away: float, line: NDArray[np.float64]) -> float:
    """A piece of a path, whose first point is so far from that of the path; returns its length on the map."""
    for k in range(3):
        line[k], line[3 + k] = path[piece, k], path[piece + 1, k] - path[piece, k]
    length = np.hypot(line[3], line[4])
    # The height is z + bend (away + length t)².
    line[2] += bend * away * away
    line[5] += 2.0 * bend * away * length
    line[6] = bend * length * length
    return length


@inner
def _clip(line: NDArray[np.float64], inside: Box, span: NDArray[np.float64]) -> None:
    """Begin and size of the part of a line inside map bounds; the size is −1 where it stays outside."""
    begin, end = 0.0, 1.0
    for axis in range(2):
        low, high, at, step = inside[axis], inside[axis + 2], line[axis], line[axis + 3]
        if step == 0.0:
            if at < low or at > high:
                begin = np.inf
        else:
            a, b = (low - at) / step, (high - at) / step
            begin, end = max(begin, min(a, b)), min(end, max(a, b))
    span[0], span[1] = (begin, end - begin) if begin <= end else (0.0, -1.0)


@kernel
def begin_lines(
    paths: NDArray[np.float64],
    piece: int,
    bend: float,
    inside: Box,
    parts: Parts,
    away: NDArray[np.float64],
    results: NDArray[np.int64],
    states: NDArray[np.int64],
    lines: NDArray[np.float64],
    rays: NDArray[np.float64],
    spans: NDArray[np.float64],
) -> tuple[float, float, float, float]:
    """Lines and rays of one piece of all paths that have met nothing yet.

    Parameters
    ----------
    paths : ndarray, shape (n, k, 3)
    piece : int
        The piece, from 0.
    bend : float
        See `Terrain.first_hit`.
    inside, parts : tuple
        Map bounds of ground, and where its parts are.
    away : ndarray, shape (n,)
        Lengths of the pieces before on the map.
    results, states : ndarray, shape (n,)
        Rays whose result is not MISS are left alone. The state of rays that come from outside becomes NONE.
    lines, rays : ndarray, shapes (n, 7), (n, 10)
        Filled for rays that have a part inside.
    spans : ndarray, shape (n, 2)
        Filled: begin and size of that part in the piece; size −1: there is none; NaN: nothing is looked for.

    Returns
    -------
    (float, float, float, float)
        Lowest x, y and highest x, y in parts; inf, inf, −inf, −inf: no ray has a part inside.
    """
    x0, y0, x1, y1 = np.inf, np.inf, -np.inf, -np.inf
    for i in range(paths.shape[0]):
        line, ray, span = lines[i], rays[i], spans[i]
        span[0] = span[1] = np.nan
        if results[i] != MISS:
            continue
        _line(paths[i], piece, bend, away[i], line)
        total = 0.0
        for k in range(7):
            total += line[k]
        if not np.isfinite(total):
            continue
        _clip(line, inside, span)
        begin, size = span[0], span[1]
        if begin > 0.0 or size < 0.0:
            # Outside there is no ground.
            states[i] = NONE
        if size < 0.0:
            continue
        for k in range(3):
            line[k] += begin * line[3 + k]
        line[2] += begin * begin * line[6]
        line[5] = (line[5] + 2.0 * begin * line[6]) * size
        line[3], line[4] = line[3] * size, line[4] * size
        line[6] *= size * size
        ray[0], ray[1] = (line[0] - parts[0]) / parts[2], (parts[1] - line[1]) / parts[3]
        ray[3], ray[4] = line[3] / parts[2], -line[4] / parts[3]
        ray[2], ray[5], ray[6] = line[2], line[5], line[6]
        ray[7], ray[8], ray[9] = 0.0, 1.0, 0.0
        ex, ey = ray[0] + ray[3], ray[1] + ray[4]
        x0, y0 = min(x0, ray[0], ex), min(y0, ray[1], ey)
        x1, y1 = max(x1, ray[0], ex), max(y1, ray[1], ey)
    return x0, y0, x1, y1


@kernel
def next_part(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    first: tuple[int, int],
    rays: NDArray[np.float64],
    states: NDArray[np.int64],
    which: NDArray[np.int64],
    places: NDArray[np.int64],
) -> None:
    """The part of the terrain that each of some rays has to be followed over next.

    Parameters
    ----------
    low, high : ndarray, shape (rows, cols), float64
        Bounds of the parts' heights, infinite where they are not known; inf and −inf where a part has no ground.
    first : (int, int)
        Column and row of the first of these parts.
    rays, states
        All rays: see the module, and `kernels.raycast`. The t of a ray becomes that at which it enters the part.
    which : ndarray, shape (m,), int64
        The rays that are asked.
    places : ndarray, shape (m,), int64
        Filled with the part, row by row of `low`; −1: the ray has come to its end.
    """
    for j in range(which.shape[0]):
        i = which[j]
        ray = rays[i]
        u, end = ray[7], ray[8]
        places[j] = -1
        while u < end:
            col = _cell(ray[0] + u * ray[3] - first[0], ray[3], low.shape[1])
            row = _cell(ray[1] + u * ray[4] - first[1], ray[4], low.shape[0])
            out = min(leave(col + first[0], 0, ray[0], ray[3]), leave(row + first[1], 0, ray[1], ray[4]))
            if not out > u:
                out = end
            lowest, highest = _span(ray, u, min(out, end))
            if not low[row, col] <= high[row, col]:
                states[i] = NONE
            elif lowest > high[row, col]:
                states[i] = OVER
            elif highest < low[row, col] and (states[i] == NONE or states[i] == BELOW):
                states[i] = BELOW
            else:
                places[j] = row * low.shape[1] + col
                ray[9] = min(out, end)
                break
            u = out
        ray[7] = min(u, end)


@kernel
def follow_part(
    posts: NDArray[np.float32],
    pyramid: Pyramid,
    faces: Faces,
    frame: tuple[float, float, float, float, float],
    lines: NDArray[np.float64],
    rays: NDArray[np.float64],
    states: NDArray[np.int64],
    results: NDArray[np.int64],
    normals: NDArray[np.float64],
    which: NDArray[np.int64],
) -> int:
    """Follow some rays over one part of the terrain, up to their first hit.

    Parameters
    ----------
    posts : ndarray, shape (rows, cols), float32
        Heights above the datum of the part, metres; NaN = no height.
    pyramid, faces : tuple
        See `Pyramid` and `Faces`; heights of vertices refer to the same datum.
    frame : tuple
        X, Y of the first post, distance of the posts in X and in Y, datum.
    lines, rays, states
        All rays. Their t becomes that of the hit, or of the end of the part.
    results, normals : ndarray, shapes (n,), (n, 3)
        Of the rays that are asked results are filled with MISS, SURFACE, WALL or ASK; of those that hit ground
        the normals, of no length in particular.
    which : ndarray, shape (m,), int64
        The rays that are asked.

    Returns
    -------
    int
        How many results are ASK.
    """
    asks = 0
    local = np.empty(9)
    for j in range(which.shape[0]):
        i = which[j]
        line = lines[i]
        local[0], local[1] = (line[0] - frame[0]) / frame[2], (frame[1] - line[1]) / frame[3]
        local[3], local[4] = line[3] / frame[2], -line[4] / frame[3]
        local[2], local[5], local[6] = line[2] - frame[4], line[5], line[6]
        local[7], local[8] = rays[i, 7], rays[i, 9]
        t, states[i], result = _follow(posts, pyramid, faces, local, states[i])
        results[i] = result
        rays[i, 7] = local[7] = t
        if result == ASK:
            asks += 1
        elif result != MISS:
            normal = normals[i]
            _hit_normal(posts, faces, local, result != SURFACE, normal)
            normal[0], normal[1] = normal[0] / frame[2], -normal[1] / frame[3]
    return asks


@kernel
def end_lines(
    paths: NDArray[np.float64],
    piece: int,
    bend: float,
    away: NDArray[np.float64],
    rays: NDArray[np.float64],
    spans: NDArray[np.float64],
    results: NDArray[np.int64],
    states: NDArray[np.int64],
    XYZ: NDArray[np.float64],
    along: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> None:
    """What the rays of one piece have met: see `begin_lines` and `surfaces.rays.Hits`; `away` grows by the piece."""
    line = np.empty(7)
    for i in range(paths.shape[0]):
        begin, size = spans[i, 0], spans[i, 1]
        if results[i] != MISS and not begin >= 0.0:
            # Met in a piece before.
            continue
        length = _line(paths[i], piece, bend, away[i], line)
        away[i] += length
        if not begin >= 0.0:
            continue
        if results[i] == MISS:
            if begin + size < 1.0:
                states[i] = NONE
            continue
        t = begin + size * rays[i, 7]
        along[i] = piece + t
        for k in range(3):
            XYZ[i, k] = line[k] + t * line[3 + k]
        XYZ[i, 2] += t * t * line[6]
        n = normals[i]
        way = n[0] * line[3] + n[1] * line[4]
        scale = 1.0 / np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        # Walls are looked at from where rays come from.
        if n[2] == 0.0 and way > 0.0:
            scale = -scale
        for k in range(3):
            n[k] *= scale
