"""Values of a computing unit whose meshes are bilinear or made of triangles.

Positions are in meshes: x to the right from the unit's left edge, y downwards from its upper edge. `frame` = (X of the
left edge, Y of the upper edge, meshes per metre, meshes along a side) takes vertices there. Vertices are X, Y and a
value (k, 3); `corners` and `start` are those of `MeshFaces`. A point on an edge (to 1e-7 of a mesh) belongs
to a triangle on either side, so that no point is lost between two; where the triangles differ (two-sided breaklines)
the one whose vertices have the lower numbers counts, which is the left one of the line.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.sample_grid import _bilinear, _post

_ON_FACE = 1e-7
_ON_LINE = 1e-6
Frame = tuple[float, float, float, int]
Lattice = tuple[float, float, float, float]

# Heights of two triangles at one pixel that differ by more than this, metres, are those of a wall.
_WALL = 1e-3


@inner
def _weights(
    vertices: NDArray[np.float64], corners: NDArray[np.int32], f: int, frame: Frame, x: float, y: float
) -> tuple[Any, Any, Any, Any]:
    """Barycentric weights of a point in triangle f, and a key: −2 outside, −1 inside, else a number of the edge."""
    a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
    ax, ay = (vertices[a, 0] - frame[0]) * frame[2] - x, (frame[1] - vertices[a, 1]) * frame[2] - y
    bx, by = (vertices[b, 0] - frame[0]) * frame[2] - x, (frame[1] - vertices[b, 1]) * frame[2] - y
    cx, cy = (vertices[c, 0] - frame[0]) * frame[2] - x, (frame[1] - vertices[c, 1]) * frame[2] - y
    # y runs downwards: the sign makes counter-clockwise triangles positive.
    wa, wb, wc = by * cx - bx * cy, cy * ax - cx * ay, ay * bx - ax * by
    if not (wa + wb + wc > 0.0):
        return 0.0, 0.0, 0.0, -2
    limit_a = _ON_FACE * np.sqrt((cx - bx) ** 2 + (cy - by) ** 2)
    limit_b = _ON_FACE * np.sqrt((ax - cx) ** 2 + (ay - cy) ** 2)
    limit_c = _ON_FACE * np.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
    if wa < -limit_a or wb < -limit_b or wc < -limit_c:
        return 0.0, 0.0, 0.0, -2
    numbers, count = 0, 0
    if wa > limit_a:
        numbers, count = numbers + a, count + 1
    if wb > limit_b:
        numbers, count = numbers + b, count + 1
    if wc > limit_c:
        numbers, count = numbers + c, count + 1
    wa, wb, wc = max(wa, 0.0), max(wb, 0.0), max(wc, 0.0)
    total = wa + wb + wc
    if not (total > 0.0):
        return 0.0, 0.0, 0.0, -2
    if count == 3:
        return wa / total, wb / total, wc / total, -1
    # Triangles at one edge share two vertices but for their copies at a wall, those at one vertex share one.
    return wa / total, wb / total, wc / total, (6 * numbers) // max(count, 1)


@inner
def _in_mesh(
    vertices: NDArray[np.float64], corners: NDArray[np.int32], first: int, last: int, frame: Frame, x: float, y: float
) -> tuple[Any, Any]:
    """Value at a point among triangles first … last − 1, and the key of its triangle; NaN, −2 if it is in none."""
    best, found = -2, np.nan
    for f in range(first, last):
        wa, wb, wc, key = _weights(vertices, corners, f, frame, x, y)
        if key == -2 or (best >= 0 and key >= best):
            continue
        found = wa * vertices[corners[f, 0], 2] + wb * vertices[corners[f, 1], 2] + wc * vertices[corners[f, 2], 2]
        best = key
        if key == -1:
            break
    return found, best


@inner
def _candidates(x: float, n: int) -> tuple[Any, Any]:
    """First and last mesh that touches x (of n meshes)."""
    first = min(max(np.int64(np.floor(x - _ON_LINE)), 0), n - 1)
    last = min(max(np.int64(np.floor(x + _ON_LINE)), 0), n - 1)
    return first, last


@inner
def _on_faces(
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    frame: Frame,
    x: float,
    y: float,
) -> tuple[Any, Any]:
    """Value on the triangles of all meshes that touch a point, and whether all of these meshes have triangles."""
    n = frame[3]
    c0, c1 = _candidates(x, n)
    r0, r1 = _candidates(y, n)
    found, best, every = np.nan, -2, True
    for r in range(r0, r1 + 1):
        for c in range(c0, c1 + 1):
            m = r * n + c
            if start[m + 1] == start[m]:
                every = False
                continue
            value, key = _in_mesh(vertices, corners, start[m], start[m + 1], frame, x, y)
            if key != -2 and (best == -2 or key < best):
                found, best = value, key
    return found, every


@kernel
def sample_hybrid(
    posts: NDArray[np.float32],
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    frame: Frame,
    xy: NDArray[np.float64],
    result: NDArray[np.float64],
) -> None:
    """Values at scattered points.

    posts (n + 1, n + 1) and the values of the vertices refer to one datum; xy (p, 2) are positions inside the unit in
    meshes; result (p,) is filled, NaN where there is no surface.
    """
    n = frame[3]
    for i in range(xy.shape[0]):
        x, y = xy[i, 0], xy[i, 1]
        result[i] = np.nan
        if not (x >= -_ON_LINE and y >= -_ON_LINE and x <= n + _ON_LINE and y <= n + _ON_LINE):
            continue
        found, every = _on_faces(vertices, corners, start, frame, x, y)
        if found == found or every:
            result[i] = found
        else:
            col, fx = _post(x, n + 1)
            row, fy = _post(y, n + 1)
            result[i] = _bilinear(posts, col, row, fx, fy)


@inner
def _pixels(first: float, last: float, origin: float, step: float, count: int) -> tuple[Any, Any]:
    """First and last pixel whose position lies in first … last, edges included; empty if the first is higher."""
    a = max(np.int64(np.ceil((first - origin) / step - _ON_LINE)), 0)
    b = min(np.int64(np.floor((last - origin) / step + _ON_LINE)), count - 1)
    return a, b


@inner
def _all_faces(start: NDArray[np.int64], n: int, x: float, y: float) -> bool:
    """Whether all meshes that touch a point have triangles."""
    c0, c1 = _candidates(x, n)
    r0, r1 = _candidates(y, n)
    for r in range(r0, r1 + 1):
        for c in range(c0, c1 + 1):
            if start[r * n + c + 1] == start[r * n + c]:
                return False
    return True


@inner
def _clear(result: NDArray[np.float32], start: NDArray[np.int64], n: int, lattice: Lattice) -> None:
    """NaN at all pixels that belong to meshes with triangles only."""
    x0, dx, y0, dy = lattice
    for r in range(n):
        j0, j1 = _pixels(r, r + 1, y0, dy, result.shape[0])
        if j0 > j1 or start[r * n + n] == start[r * n]:
            continue
        for c in range(n):
            if start[r * n + c + 1] == start[r * n + c]:
                continue
            i0, i1 = _pixels(c, c + 1, x0, dx, result.shape[1])
            for j in range(j0, j1 + 1):
                y = y0 + j * dy
                edge = y - r <= _ON_LINE or r + 1 - y <= _ON_LINE
                for i in range(i0, i1 + 1):
                    x = x0 + i * dx
                    if edge or x - c <= _ON_LINE or c + 1 - x <= _ON_LINE:
                        if _all_faces(start, n, x, y):
                            result[j, i] = np.nan
                    else:
                        result[j, i] = np.nan


@inner
def _cut(xa: float, ya: float, xb: float, yb: float, y: float, span: tuple[float, float]) -> tuple[float, float]:
    """The span of a row widened by where edge a–b meets it."""
    low, high = span
    if (ya <= y and y <= yb) or (yb <= y and y <= ya):
        if ya == yb:
            low, high = min(low, xa, xb), max(high, xa, xb)
        else:
            x = xa + (y - ya) / (yb - ya) * (xb - xa)
            low, high = min(low, x), max(high, x)
    return low, high


@inner
def _fill(
    result: NDArray[np.float32],
    box: tuple[Any, Any, Any, Any],
    scale: tuple[float, float, float, float, float, float],
    frame: Frame,
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    f: int,
) -> Any:
    """Triangle f scanned over the pixels of `box` (first and last column, first and last row) that it covers.

    scale: pixels per metre, of the first pixel, and of the tolerance, along x and along y. Infinite where another
    triangle has written another height; returns whether there is such a pixel.
    """
    sx, ox, tx, sy, oy, ty = scale
    a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
    ya = (frame[1] - vertices[a, 1]) * sy - oy
    yb = (frame[1] - vertices[b, 1]) * sy - oy
    yc = (frame[1] - vertices[c, 1]) * sy - oy
    upper, lower = min(ya, yb, yc), max(ya, yb, yc)
    v0, v1 = max(np.int64(np.ceil(upper - ty)), box[2]), min(np.int64(np.floor(lower + ty)), box[3])
    if v0 > v1:
        return False
    xa = (vertices[a, 0] - frame[0]) * sx - ox
    xb = (vertices[b, 0] - frame[0]) * sx - ox
    xc = (vertices[c, 0] - frame[0]) * sx - ox
    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    if area == 0.0 or np.ceil(min(xa, xb, xc) - tx) > np.floor(max(xa, xb, xc) + tx):
        return False
    za, zb, zc = vertices[a, 2], vertices[b, 2], vertices[c, 2]
    gx = ((zb - za) * (yc - ya) - (zc - za) * (yb - ya)) / area
    gy = ((zc - za) * (xb - xa) - (zb - za) * (xc - xa)) / area
    lowest, highest = min(za, zb, zc), max(za, zb, zc)
    tie = False
    for j in range(v0, v1 + 1):
        y = min(max(np.float64(j), upper), lower)
        span = _cut(xb, yb, xc, yc, y, _cut(xa, ya, xb, yb, y, (np.inf, -np.inf)))
        low, high = _cut(xc, yc, xa, ya, y, span)
        u0, u1 = max(np.int64(np.ceil(low - tx)), box[0]), min(np.int64(np.floor(high + tx)), box[1])
        for i in range(u0, u1 + 1):
            z = min(max(za + gx * (i - xa) + gy * (j - ya), lowest), highest)
            old = result[j, i]
            if old != old:
                result[j, i] = z
            elif abs(old - z) > _WALL:
                result[j, i] = np.inf
                tie = True
    return tie


@kernel
def scan_faces(
    result: NDArray[np.float32],
    lattice: Lattice,
    frame: Frame,
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
) -> None:
    """Values of the triangles at the pixels of a lattice.

    result (ny, nx) holds the bilinear values; lattice = (x0, dx, y0, dy), positive steps: pixel (i, j) lies at
    (x0 + i · dx, y0 + j · dy) in meshes. Pixels in meshes with triangles get their value, NaN where there is none.
    """
    x0, dx, y0, dy = lattice
    n = frame[3]
    _clear(result, start, n, lattice)
    scale = (frame[2] / dx, x0 / dx, _ON_FACE / dx, frame[2] / dy, y0 / dy, _ON_FACE / dy)
    ties = False
    for r in range(n):
        j0, j1 = _pixels(r, r + 1, y0, dy, result.shape[0])
        if j0 > j1:
            continue
        for c in range(n):
            m = r * n + c
            if start[m + 1] == start[m]:
                continue
            i0, i1 = _pixels(c, c + 1, x0, dx, result.shape[1])
            if i0 <= i1:
                for f in range(start[m], start[m + 1]):
                    ties |= _fill(result, (i0, i1, j0, j1), scale, frame, vertices, corners, f)
    if ties:
        for j in range(result.shape[0]):
            for i in range(result.shape[1]):
                if np.isinf(result[j, i]):
                    result[j, i], _ = _on_faces(vertices, corners, start, frame, x0 + i * dx, y0 + j * dy)


@inner
def _side_error(
    vertices: NDArray[np.float64], a: int, b: int, share: float, scale: float, terms: tuple[float, float, float, float]
) -> float:
    """Standard deviation by the side a–b of a triangle; share = 4 · product of the weights of a and b."""
    ex, ey = abs(vertices[a, 0] - vertices[b, 0]) * scale, abs(vertices[a, 1] - vertices[b, 1]) * scale
    ex, ey, share = ex ** terms[3], ey ** terms[3], max(share, 0.0) ** (0.5 * terms[3])
    return share * np.sqrt(max(ex * ex * terms[0] + ey * ey * terms[1] + 2.0 * ex * ey * terms[2], 0.0))


@inner
def _term(terms: NDArray[np.float32], k: int, col: int, row: int, fx: float, fy: float) -> float:
    upper = terms[k, row, col] + fx * (terms[k, row, col + 1] - terms[k, row, col])
    lower = terms[k, row + 1, col] + fx * (terms[k, row + 1, col + 1] - terms[k, row + 1, col])
    return upper + fy * (lower - upper)


@inner
def _with_between(
    terms: NDArray[np.float32],
    power: float,
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    frame: Frame,
    x: float,
    y: float,
    sigma: float,
) -> float:
    """Standard deviation with the representation error at a place in meshes."""
    n = frame[3]
    col, row = np.int64(min(max(np.floor(x), 0.0), n - 1.0)), np.int64(min(max(np.floor(y), 0.0), n - 1.0))
    fx, fy = min(max(x - col, 0.0), 1.0), min(max(y - row, 0.0), 1.0)
    xx, yy, xy = (
        _term(terms, 0, col, row, fx, fy),
        _term(terms, 1, col, row, fx, fy),
        _term(terms, 2, col, row, fx, fy),
    )
    error = 0.0
    mesh = row * n + col
    if start[mesh + 1] > start[mesh]:
        for f in range(start[mesh], start[mesh + 1]):
            wa, wb, wc, key = _weights(vertices, corners, f, frame, x, y)
            if key != -2:
                a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
                law = (xx, yy, xy, power)
                error = (
                    _side_error(vertices, a, b, 4.0 * wa * wb, frame[2], law)
                    + _side_error(vertices, b, c, 4.0 * wb * wc, frame[2], law)
                    + _side_error(vertices, c, a, 4.0 * wc * wa, frame[2], law)
                )
                break
    else:
        bx, by = (4.0 * fx * (1.0 - fx)) ** (0.5 * power), (4.0 * fy * (1.0 - fy)) ** (0.5 * power)
        error = np.sqrt(max(bx * bx * xx + by * by * yy + 2.0 * bx * by * xy, 0.0))
    return np.sqrt(sigma * sigma + error * error)


@kernel
def add_between(
    terms: NDArray[np.float32],
    power: float,
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    frame: Frame,
    xy: NDArray[np.float64],
    sigmas: NDArray[Any],
) -> None:
    """Add the representation error to standard deviations (p,) at places (p, 2) in meshes; see `Representation`."""
    for i in range(len(xy)):
        if sigmas[i] == sigmas[i]:
            x, y = xy[i, 0], xy[i, 1]
            sigmas[i] = _with_between(terms, power, vertices, corners, start, frame, x, y, sigmas[i])


@kernel
def add_between_on_lattice(
    terms: NDArray[np.float32],
    power: float,
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    frame: Frame,
    lattice: Lattice,
    sigmas: NDArray[Any],
) -> None:
    """As `add_between`, for the pixels of a lattice (ny, nx); see `scan_faces`."""
    x0, dx, y0, dy = lattice
    for j in range(sigmas.shape[0]):
        for i in range(sigmas.shape[1]):
            if sigmas[j, i] == sigmas[j, i]:
                x, y = x0 + i * dx, y0 + j * dy
                sigmas[j, i] = _with_between(terms, power, vertices, corners, start, frame, x, y, sigmas[j, i])
