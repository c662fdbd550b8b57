"""Ray casting: where rays first meet the terrain, under a pyramid of height ranges, and in vertical planes."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel, maker
from photoplan.kernels.terrain import Frame, barycentric

# Pyramid of the lowest and highest posts of blocks of a height grid: it lets rays skip terrain.


Pyramid = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]
"""Lowest and highest posts of all levels, and start, rows, columns of each level: see `pyramid_of`."""


@inner
def _ranges(
    posts: NDArray[np.float32],
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
) -> None:
    """Lowest and highest post of each mesh, or of its triangles; NaN does not count; inf and −inf: there is none."""
    for j in range(low.shape[0]):
        for i in range(low.shape[1]):
            bottom, top = np.float32(np.inf), np.float32(-np.inf)
            m = j * low.shape[1] + i
            if start.shape[0] > 0 and start[m + 1] > start[m]:
                for f in range(start[m], start[m + 1]):
                    for k in range(3):
                        z = vertices[corners[f, k], 2]
                        # Rounded to float32, a bound must still be one.
                        bottom = min(bottom, np.float32(z - abs(z) * 1e-6))
                        top = max(top, np.float32(z + abs(z) * 1e-6))
            else:
                for k in range(4):
                    h = posts[j + (k >> 1), i + (k & 1)]
                    bottom = h if h < bottom else bottom
                    top = h if h > top else top
            low[j, i], high[j, i] = bottom, top


@inner
def _halve(fine: NDArray[np.float32], coarse: NDArray[np.float32], sign: float) -> None:
    """Of four blocks each the highest for sign 1, the lowest for −1."""
    for j in range(coarse.shape[0]):
        for i in range(coarse.shape[1]):
            best = np.float32(-np.inf)
            for row in range(2 * j, min(2 * j + 2, fine.shape[0])):
                for col in range(2 * i, min(2 * i + 2, fine.shape[1])):
                    value = np.float32(sign) * fine[row, col]
                    best = value if value > best else best
            coarse[j, i] = np.float32(sign) * best


@kernel
def _fill_levels(
    posts: NDArray[np.float32],
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    levels: NDArray[np.int64],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
) -> None:
    """Ranges of the meshes, then of each level from the one below."""
    for n in range(levels.shape[0]):
        first, rows, columns = levels[n]
        here = slice(first, first + rows * columns)
        bottom, top = low[here].reshape(rows, columns), high[here].reshape(rows, columns)
        if n == 0:
            _ranges(posts, vertices, corners, start, bottom, top)
            continue
        first, rows, columns = levels[n - 1]
        below = slice(first, first + rows * columns)
        _halve(low[below].reshape(rows, columns), bottom, -1.0)
        _halve(high[below].reshape(rows, columns), top, 1.0)


def pyramid_of(
    posts: NDArray[np.float32],
    vertices: NDArray[np.float64] | None = None,
    corners: NDArray[np.int32] | None = None,
    start: NDArray[np.int64] | None = None,
) -> Pyramid:
    """Ranges of blocks of 1, 2, 4 … meshes.

    Parameters
    ----------
    posts : ndarray, shape (rows, cols), float32
        At least two posts each way; NaN = no height.
    vertices, corners, start : ndarray, optional
        Triangles of `MeshFaces`; meshes that have some count by these.

    Returns
    -------
    low, high : ndarray, float32
        All levels, one after the other, row by row; inf and −inf where a block has no height.
    levels : ndarray, shape (n, 3), int64
        Start in `low` and `high`, rows and columns of each level.
    """
    if vertices is None or corners is None or start is None:
        vertices, corners, start = np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.int64)
    levels = _level_sizes(posts.shape[0] - 1, posts.shape[1] - 1)
    low, high = np.empty((2, int(levels[-1].sum()) - 1), np.float32)
    _fill_levels(posts, vertices, corners, start, levels, low, high)
    return low, high, levels


@lru_cache(maxsize=64)
def _level_sizes(rows: int, columns: int) -> NDArray[np.int64]:
    """Start, rows and columns of each level; the last one has one block."""
    levels = [(0, rows, columns)]
    while max(rows, columns) > 1:
        start = levels[-1][0] + rows * columns
        rows, columns = (rows + 1) // 2, (columns + 1) // 2
        levels.append((start, rows, columns))
    return np.array(levels, np.int64)


@inner
def leave_block(block: int, level: int, start: float, step: float) -> float:
    """Parameter at which a line leaves a block in one direction of the grid; infinite if it runs along it."""
    if step > 0.0:
        return (((block + 1) << level) - start) / step
    if step < 0.0:
        return ((block << level) - start) / step
    return np.inf


# One ray over one unit: meshes, bilinear or made of triangles, under a pyramid of ranges.
#
# Positions are in meshes: x to the right, y downwards, from the first post. A ray has the parameter t; its position is
# linear in it, its height may have a quadratic term (a level ray over a round earth). Over a bilinear mesh the height
# of the ray above ground is then a quadratic function of t, over a triangle too: its roots are exact.
#
# A ray hits where it has been above ground and then is not: on the surface, or, where the heights on both sides of a
# place differ, on the wall between. It goes through places without ground; below the ground it goes on until it comes
# out.


#: What a ray has met last: no ground, ground below it, ground above it, or a block that lies below it as a whole.
NONE, ABOVE, BELOW, OVER = 0, 1, 2, 3
#: Results. ASK: the ray came from over a block and is below ground now; whether there was ground before is not known.
MISS, SURFACE, WALL, ASK = 0, 1, 2, 3

_BORDER = 1e-9
"""A ray this near to the border of a mesh, in meshes, has come to the next one."""
_STEP = 1e-6
"""Steps of the ground lower than this, metres, are no walls."""
_ON_LINE = 1e-6
"""A ray this near to a grid line, in meshes, needs the posts of that line only."""

Faces = tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64], Frame]
"""Vertices, corners and start of `MeshFaces` with the frame of `kernels.terrain`; an empty start: no triangles."""


@inner
def _next_mesh(x: float, step: float, count: int) -> Any:
    """The mesh, of so many, that a ray is in when it is at x and moves by step: at a border the next one."""
    if step > 0.0:
        cell = np.int64(np.floor(x + _BORDER))
    elif step < 0.0:
        cell = np.int64(np.ceil(x - _BORDER)) - 1
    else:
        cell = np.int64(np.floor(x))
    return min(max(cell, 0), count - 1)


@inner
def _height(ray: NDArray[np.float64], t: float) -> float:
    return ray[2] + t * (ray[5] + t * ray[6])


@inner
def _height_span(ray: NDArray[np.float64], a: float, b: float) -> tuple[float, float]:
    """Lowest and highest height of a ray between two parameters."""
    za, zb = _height(ray, a), _height(ray, b)
    low, high = min(za, zb), max(za, zb)
    if ray[6] != 0.0:
        turn = -ray[5] / (2.0 * ray[6])
        if a < turn < b:
            z = _height(ray, turn)
            low, high = min(low, z), max(high, z)
    return low, high


@inner
def _roots(a: float, b: float, c: float) -> tuple[float, float]:
    """Where a s² + b s + c goes down through zero, and where up; infinite if it does not."""
    down, up = np.inf, np.inf
    d = b * b - 4.0 * a * c
    if d > 0.0:
        root = np.sqrt(d)
        if b < 0.0:
            down = 2.0 * c / (root - b)
            if a != 0.0:
                up = (root - b) / (2.0 * a)
        else:
            if b + root > 0.0:
                up = -2.0 * c / (b + root)
            if a != 0.0:
                down = -(b + root) / (2.0 * a)
    return down, up


@inner
def _crossing(g0: float, gm: float, g1: float, state: int) -> tuple[float, Any, Any]:
    """A stretch of ground, from the heights of the ray above it at its begin, middle and end: where it is hit (part of
    the stretch), the new state, and the result."""
    if state == OVER:
        if g0 < -_STEP:
            return 0.0, OVER, ASK
        state = ABOVE
    elif state == ABOVE:
        if g0 < 0.0:
            return 0.0, ABOVE, WALL if g0 < -_STEP else SURFACE
    else:
        state = ABOVE if g0 >= 0.0 else BELOW
    a, b = 2.0 * (g0 + g1 - 2.0 * gm), 4.0 * gm - 3.0 * g0 - g1
    down, up = _roots(a, b, g0)
    first = 0.0
    if state == BELOW:
        if not (0.0 <= up <= 1.0):
            return 1.0, BELOW, MISS
        first, state = up, ABOVE
    if first <= down <= 1.0:
        return down, ABOVE, SURFACE
    return 1.0, state, MISS


@inner
def _on_mesh(posts: NDArray[np.float32], col: int, row: int, x: float, y: float) -> float:
    """Bilinear height in a mesh; NaN where a post that is needed is missing."""
    h00, h01 = np.float64(posts[row, col]), np.float64(posts[row, col + 1])
    h10, h11 = np.float64(posts[row + 1, col]), np.float64(posts[row + 1, col + 1])
    fx, fy = x - col, y - row
    upper, lower = h00 + fx * (h01 - h00), h10 + fx * (h11 - h10)
    value = upper + fy * (lower - upper)
    if value == value:
        return value
    if abs(fx) <= _ON_LINE:
        upper, lower = h00, h10
    elif abs(fx - 1.0) <= _ON_LINE:
        upper, lower = h01, h11
    if abs(fy) <= _ON_LINE:
        return upper
    if abs(fy - 1.0) <= _ON_LINE:
        return lower
    return upper + fy * (lower - upper)


@inner
def _on_plane(vertices: NDArray[np.float64], corners: NDArray[np.int32], f: int, x: float, y: float) -> float:
    """Height of triangle f, continued, at X, Y."""
    a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    px, py = x - vertices[a, 0], y - vertices[a, 1]
    area = ux * vy - uy * vx
    return vertices[a, 2] + ((px * vy - py * vx) * uz + (ux * py - uy * px) * vz) / area


@maker
def _cut_points(
    faces: Faces, first: int, last: int, ray: NDArray[np.float64], span: tuple[float, float]
) -> NDArray[np.float64]:
    """Parameters inside a span where a ray crosses edges of triangles, sorted, with both ends."""
    vertices, corners, _, frame = faces
    found = np.empty(3 * (last - first) + 2)
    found[0], found[1] = span
    count = 2
    for f in range(first, last):
        for k in range(3):
            a, b = corners[f, k], corners[f, (k + 1) % 3]
            ax, ay = (vertices[a, 0] - frame[0]) * frame[2] - ray[0], (frame[1] - vertices[a, 1]) * frame[2] - ray[1]
            ex, ey = (vertices[b, 0] - vertices[a, 0]) * frame[2], (vertices[a, 1] - vertices[b, 1]) * frame[2]
            across = ray[3] * ey - ray[4] * ex
            if across != 0.0:
                t = (ax * ey - ay * ex) / across
                if span[0] < t < span[1]:
                    found[count] = t
                    count += 1
    for i in range(2, count):
        # Sorted into those before; the ends are the first and the last.
        t, j = found[i], i - 1
        while j > 0 and found[j] > t:
            found[j + 1] = found[j]
            j -= 1
        found[j + 1] = t
    return found[:count]


@maker
def _through_faces(
    faces: Faces, m: int, ray: NDArray[np.float64], span: tuple[float, float], state: int
) -> tuple[float, Any, Any]:
    """A ray over a mesh of triangles: parameter, state and result, as `_crossing` has them."""
    vertices, corners, start, frame = faces
    cuts = _cut_points(faces, start[m], start[m + 1], ray, span)
    size = max(abs(ray[3]), abs(ray[4]))
    for i in range(cuts.shape[0] - 1):
        a, b = cuts[i], cuts[i + 1]
        if (b - a) * size <= 1e-9 and cuts.shape[0] > 2:
            continue
        t = 0.5 * (a + b)
        best, face = -2, -1
        for f in range(start[m], start[m + 1]):
            _, _, _, key = barycentric(vertices, corners, f, frame, ray[0] + t * ray[3], ray[1] + t * ray[4])
            if key == -2 or (best >= 0 and key >= best):
                continue
            best, face = key, f
            if key == -1:
                break
        if face < 0:
            state = NONE
            continue
        g = np.empty(3)
        for k in range(3):
            at = a + 0.5 * k * (b - a)
            x, y = frame[0] + (ray[0] + at * ray[3]) / frame[2], frame[1] - (ray[1] + at * ray[4]) / frame[2]
            g[k] = _height(ray, at) - _on_plane(vertices, corners, face, x, y)
        part, state, result = _crossing(g[0], g[1], g[2], state)
        if result != MISS:
            return a + part * (b - a), state, result
    return span[1], state, MISS


@inner
def _through_mesh(
    posts: NDArray[np.float32],
    faces: Faces,
    mesh: tuple[Any, Any],
    ray: NDArray[np.float64],
    span: tuple[float, float],
    state: int,
) -> tuple[float, Any, Any]:
    """A ray over one mesh, column and row: parameter, state and result, as `_crossing` has them."""
    col, row = mesh
    start = faces[2]
    m = row * (posts.shape[1] - 1) + col
    if start.shape[0] > 0 and start[m + 1] > start[m]:
        return _through_faces(faces, m, ray, span, state)
    a, b = span
    t = 0.5 * (a + b)
    g0 = _height(ray, a) - _on_mesh(posts, col, row, ray[0] + a * ray[3], ray[1] + a * ray[4])
    gm = _height(ray, t) - _on_mesh(posts, col, row, ray[0] + t * ray[3], ray[1] + t * ray[4])
    g1 = _height(ray, b) - _on_mesh(posts, col, row, ray[0] + b * ray[3], ray[1] + b * ray[4])
    if not (g0 == g0 and gm == gm and g1 == g1):
        return b, NONE, MISS
    part, state, result = _crossing(g0, gm, g1, state)
    return a + part * (b - a), state, result


@inner
def _block_at(
    posts: NDArray[np.float32], levels: NDArray[np.int64], level: int, ray: NDArray[np.float64], u: float, end: float
) -> tuple[tuple[Any, Any], Any, float]:
    """The mesh, column and row, in which a ray is at u; the block of a level around it; where the ray leaves that."""
    col = _next_mesh(ray[0] + u * ray[3], ray[3], posts.shape[1] - 1)
    row = _next_mesh(ray[1] + u * ray[4], ray[4], posts.shape[0] - 1)
    bx, by = col >> level, row >> level
    out = min(leave_block(bx, level, ray[0], ray[3]), leave_block(by, level, ray[1], ray[4]))
    if not out > u:
        # Beyond the outer edge, by rounding.
        out = end
    return (col, row), levels[level, 0] + by * levels[level, 2] + bx, out


@inner
def _follow_ray(
    posts: NDArray[np.float32], pyramid: Pyramid, faces: Faces, ray: NDArray[np.float64], state: int
) -> tuple[float, Any, Any]:
    """One ray over one part of the terrain: parameter, state and result.

    `ray` is x, y, z at t = 0; their change by t; change of z by t²; first and last t inside the part. `state` is what
    the ray has met before (NONE, ABOVE, BELOW or OVER), then what it met last; the result is MISS, SURFACE, WALL, ASK.
    """
    low, high, levels = pyramid
    u, end = ray[7], ray[8]
    last = levels.shape[0] - 1
    level = last
    while True:
        mesh, block, out = _block_at(posts, levels, level, ray, u, end)
        stop = min(out, end)
        lowest, highest = _height_span(ray, u, stop)
        if not low[block] <= high[block]:
            state = NONE
        elif lowest > high[block]:
            state = OVER
        elif highest < low[block] and state in (NONE, BELOW):
            state = BELOW
        elif level > 0:
            level -= 1
            continue
        else:
            t, state, result = _through_mesh(posts, faces, mesh, ray, (u, stop), state)
            if result != MISS:
                return t, state, result
        if out >= end:
            return end, state, MISS
        u, level = out, min(level + 1, last)


# Normals of the ground where rays have met it.


@inner
def _bilinear_normal(posts: NDArray[np.float32], x: float, y: float, out: NDArray[np.float64]) -> None:
    """Normal of the mesh at a position; along a line whose other side is missing that of the line."""
    col = min(max(np.int64(np.floor(x)), 0), posts.shape[1] - 2)
    row = min(max(np.int64(np.floor(y)), 0), posts.shape[0] - 2)
    h00, h01 = np.float64(posts[row, col]), np.float64(posts[row, col + 1])
    h10, h11 = np.float64(posts[row + 1, col]), np.float64(posts[row + 1, col + 1])
    fx, fy = x - col, y - row
    by_x = (h01 - h00) + fy * ((h11 - h10) - (h01 - h00))
    by_y = (h10 - h00) + fx * ((h11 - h01) - (h10 - h00))
    out[0], out[1], out[2] = -by_x, -by_y, 1.0


@inner
def _face_normal(
    faces: Faces, m: int, ray: NDArray[np.float64], t: float, wall: bool, out: NDArray[np.float64]
) -> bool:
    """Normal of the triangle that a ray is on just before t, or of the wall on an edge that it crosses there."""
    vertices, corners, start, frame = faces
    size = max(abs(ray[3]), abs(ray[4]), 1e-300)
    best, nearest = -2, np.inf
    for f in range(start[m], start[m + 1]):
        if wall:
            for k in range(3):
                a, b = corners[f, k], corners[f, (k + 1) % 3]
                ax = (vertices[a, 0] - frame[0]) * frame[2] - ray[0]
                ay = (frame[1] - vertices[a, 1]) * frame[2] - ray[1]
                ex = (vertices[b, 0] - vertices[a, 0]) * frame[2]
                ey = (vertices[a, 1] - vertices[b, 1]) * frame[2]
                across = ray[3] * ey - ray[4] * ex
                if across != 0.0:
                    off = abs((ax * ey - ay * ex) / across - t)
                    s = (ax * ray[4] - ay * ray[3]) / across
                    if off < nearest and -1e-6 <= s <= 1.0 + 1e-6:
                        nearest = off
                        out[0], out[1], out[2] = ey, -ex, 0.0
            continue
        at = t - 1e-7 / size
        _, _, _, key = barycentric(vertices, corners, f, frame, ray[0] + at * ray[3], ray[1] + at * ray[4])
        if key == -2 or (best >= 0 and key >= best):
            continue
        best = key
        a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        # In meshes, y downwards.
        area = (ux * vy - uy * vx) * frame[2]
        out[0], out[1], out[2] = (uy * vz - uz * vy) / area, -(uz * vx - ux * vz) / area, 1.0
        if key == -1:
            break
    return best != -2 or nearest < np.inf


@inner
def _hit_normal(
    posts: NDArray[np.float32], faces: Faces, ray: NDArray[np.float64], wall: bool, out: NDArray[np.float64]
) -> None:
    """Normal of the ground where a ray has hit it at ray[7], of no length in particular, with x and y in meshes and y
    downwards: (−∂h/∂x, −∂h/∂y, 1) on the surface, level on a wall."""
    t = ray[7]
    x, y = ray[0] + t * ray[3], ray[1] + t * ray[4]
    if faces[2].shape[0] > 0:
        m = _next_mesh(y, ray[4], posts.shape[0] - 1) * (posts.shape[1] - 1) + _next_mesh(x, ray[3], posts.shape[1] - 1)
        if faces[2][m + 1] > faces[2][m] and _face_normal(faces, m, ray, t, wall, out):
            return
    if wall:
        # A border of meshes.
        along_x = abs(x - np.rint(x)) < abs(y - np.rint(y))
        out[0], out[1], out[2] = (1.0, 0.0, 0.0) if along_x else (0.0, 1.0, 0.0)
    else:
        _bilinear_normal(posts, x, y, out)


# Rays over terrain that is kept in units: their lines, the next unit, and the first hit over it.
#
# A piece of a ray is a *line*: X, Y, Z, their change by t, and that of Z by t², cut to where there may be ground. Its
# *ray* holds the same with x to the right and y downwards in parts from the upper-left corner of all of them, the t
# that it has come to, its last t, and that at which it leaves the part it is in.


Box = tuple[float, float, float, float]
Parts = tuple[float, float, float, float]
"""X, Y of the upper-left corner of all parts, width and height of a part, metres."""


@inner
def _piece_line(path: NDArray[np.float64], piece: int, bend: float, away: float, line: NDArray[np.float64]) -> float:
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
def _clip_to_map(line: NDArray[np.float64], inside: Box, span: NDArray[np.float64]) -> None:
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
        _piece_line(paths[i], piece, bend, away[i], line)
        total = 0.0
        for k in range(7):
            total += line[k]
        if not np.isfinite(total):
            continue
        _clip_to_map(line, inside, span)
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
def next_unit(
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
        All rays: see the module, and `kernels.rays`. The t of a ray becomes that at which it enters the part.
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
            col = _next_mesh(ray[0] + u * ray[3] - first[0], ray[3], low.shape[1])
            row = _next_mesh(ray[1] + u * ray[4] - first[1], ray[4], low.shape[0])
            out = min(leave_block(col + first[0], 0, ray[0], ray[3]), leave_block(row + first[1], 0, ray[1], ray[4]))
            if not out > u:
                out = end
            lowest, highest = _height_span(ray, u, min(out, end))
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
def follow_unit(
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
        t, states[i], result = _follow_ray(posts, pyramid, faces, local, states[i])
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
        length = _piece_line(paths[i], piece, bend, away[i], line)
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


# Columns of a view that are vertical planes: one terrain profile gives the ground of all of their pixels.
#
# What a ray has flown over, the next one above it flies over, too: a column is one ray that is raised by a row each
# time it meets ground, and goes on from the mesh where it has met it (the running horizon of Ecker 1991, §5.4). Each
# pixel is where its own ray meets its mesh, as `kernels.rays` has it. A ray that is below the ground where it comes to
# a mesh, at its start or through a place without height, is told and left out: what it meets later says nothing of the
# ray above.


#: Of pixels that are left out: rays have to tell what they show.
LEFT = -2

VerticalPlanes = tuple[float, float, NDArray[np.float64], NDArray[np.float64], int, NDArray[np.float64]]
"""Z of the point of view, `bend`, rise per metre of the rows in the first column, what the rise is times in each
column, the uppermost row, and where the columns' lines begin and how long they are, metres (n, 2)."""
ShownGround = tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]
]
"""Filled for pixels that show ground: X, Y, Z, normal and direction to the point of view (rows, n, 3), distance on the
map (rows, n), and which (rows, n): 0 ground, −1 nothing, `LEFT`."""
Columns = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]
"""Lines and rays of all columns as `kernels.rays` has them, and the row (n,) that each of them looks for now; above
the uppermost one when there is none left."""


@inner
def _set_row_slope(
    fan: VerticalPlanes, row: Any, column: Any, line: NDArray[np.float64], ray: NDArray[np.float64]
) -> None:
    """Let the line of a column, and its ray, rise as a row does."""
    rise, bend = fan[2][row] * fan[3][column], fan[1]
    begin, size = fan[5][column, 0], fan[5][column, 1]
    line[2] = fan[0] + begin * (rise + bend * begin)
    line[5] = size * (rise + 2.0 * bend * begin)
    line[6] = bend * size * size
    ray[2], ray[5], ray[6] = line[2], line[5], line[6]


@kernel
def set_column_slopes(fan: VerticalPlanes, columns: Columns, which: NDArray[np.int64]) -> None:
    """Let some columns rise as their lowest row does."""
    lines, rays, rows = columns
    for j in range(which.shape[0]):
        i = which[j]
        _set_row_slope(fan, rows[i], i, lines[i], rays[i])


@inner
def _store_ground(
    fan: VerticalPlanes,
    pixel: tuple[Any, Any],
    line: NDArray[np.float64],
    t: float,
    normal: NDArray[np.float64],
    shown: ShownGround,
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
    fan: VerticalPlanes,
    columns: Columns,
    shown: ShownGround,
    which: NDArray[np.int64],
) -> None:
    """Follow some columns over one part of the terrain, which has no triangles; see `kernels.rays.follow_unit`."""
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
            mesh, block, out = _block_at(posts, levels, level, local, u, end)
            stop = min(out, end)
            t, result = stop, MISS
            if low[block] <= high[block] and _height_span(local, u, stop)[0] <= high[block]:
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
                _store_ground(fan, (rows[i], i), line, t, normal, shown)
            # The ray above it comes here, too.
            rows[i] -= 1
            if rows[i] >= fan[4]:
                _set_row_slope(fan, rows[i], i, line, ray)
                local[2], local[5], local[6] = line[2] - frame[4], line[5], line[6]
        ray[7] = u
