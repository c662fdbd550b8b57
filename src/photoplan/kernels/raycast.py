"""Where rays first come down onto terrain: meshes, bilinear or made of triangles, under a pyramid of ranges.

Positions are in meshes: x to the right, y downwards, from the first post. A ray has the parameter t; its position is
linear in it, its height may have a quadratic term (a level ray over a round earth). Over a bilinear mesh the height of
the ray above ground is then a quadratic function of t, over a triangle too: its roots are exact.

A ray hits where it has been above ground and then is not: on the surface, or, where the heights on both sides of a
place differ, on the wall between. It goes through places without ground; below the ground it goes on until it comes
out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.hybrid import Frame, _weights
from photoplan.kernels.jit import inner, maker
from photoplan.kernels.pyramid import Pyramid, leave

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
"""Vertices, corners and start of `MeshFaces` with the frame of `kernels.hybrid`; an empty start: no triangles."""


@inner
def _cell(x: float, step: float, count: int) -> Any:
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
def _span(ray: NDArray[np.float64], a: float, b: float) -> tuple[float, float]:
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
            _, _, _, key = _weights(vertices, corners, f, frame, ray[0] + t * ray[3], ray[1] + t * ray[4])
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
def _block(
    posts: NDArray[np.float32], levels: NDArray[np.int64], level: int, ray: NDArray[np.float64], u: float, end: float
) -> tuple[tuple[Any, Any], Any, float]:
    """The mesh, column and row, in which a ray is at u; the block of a level around it; where the ray leaves that."""
    col = _cell(ray[0] + u * ray[3], ray[3], posts.shape[1] - 1)
    row = _cell(ray[1] + u * ray[4], ray[4], posts.shape[0] - 1)
    bx, by = col >> level, row >> level
    out = min(leave(bx, level, ray[0], ray[3]), leave(by, level, ray[1], ray[4]))
    if not out > u:
        # Beyond the outer edge, by rounding.
        out = end
    return (col, row), levels[level, 0] + by * levels[level, 2] + bx, out


@inner
def _follow(
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
        mesh, block, out = _block(posts, levels, level, ray, u, end)
        stop = min(out, end)
        lowest, highest = _span(ray, u, stop)
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
