"""Terrain heights: bilinear and triangulated meshes, height ranges, gradients, shading, and the flow of water."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

# Bilinear heights from a regular grid of posts.
#
# One rule for both functions: positions are (x, y) = (column, row) of posts. A position on a post (to 1e-6 of a cell)
# needs that post alone, one on a grid line two, any other four. NaN in a post that is needed gives NaN. In the outer
# half cell the edge value is continued; farther outside the result is NaN.


_ON_POST = 1e-6
# Lattices coarser than this many posts skip most of a row; there is then nothing to gain from whole rows.
_SPARSE = 2.0


@inner
def post_weights(x: float, count: int) -> tuple[Any, Any]:
    """Lower post and weight of the upper one, −1 if outside; the upper post is used only if its weight is not 0."""
    if not (x >= -0.5 - _ON_POST and x <= count - 0.5 + _ON_POST):
        return -1, 0.0
    x = min(max(x, 0.0), count - 1.0)
    nearest = np.floor(x + 0.5)
    if abs(x - nearest) <= _ON_POST:
        return np.int64(nearest), 0.0
    lower = np.floor(x)
    return np.int64(lower), x - lower


@inner
def bilinear(grid: NDArray[np.float32], col: int, row: int, fx: float, fy: float) -> float:
    """Return the bilinear height at fractions of a mesh; posts without weight are not read."""
    right, below = (1 if fx > 0.0 else 0), (1 if fy > 0.0 else 0)
    upper, lower = grid[row, col], grid[row + below, col]
    a = upper + fx * (grid[row, col + right] - upper) if right else upper
    b = lower + fx * (grid[row + below, col + right] - lower) if right else lower
    return a + fy * (b - a) if below else a


@inner
def _blend_row(grid: NDArray[np.float32], row: int, fy: float, first: int, line: NDArray[np.float32]) -> None:
    """line[k] = grid at column first + k, fractional row row + fy."""
    upper = grid[row, first : first + line.shape[0]]
    if fy > 0.0:
        weight = np.float32(fy)
        lower = grid[row + 1, first : first + line.shape[0]]
        for k in range(line.shape[0]):
            line[k] = upper[k] + weight * (lower[k] - upper[k])
    else:
        for k in range(line.shape[0]):
            line[k] = upper[k]


@inner
def _dense_row(
    line: NDArray[np.float32], picks: NDArray[np.int32], weights: NDArray[np.float32], target: NDArray[Any]
) -> None:
    """Linear interpolation along one row; a post without weight is not touched by NaN beside it."""
    none = np.float32(0.0)
    for i in range(target.shape[0]):
        k, weight = picks[i], weights[i]
        a, b = line[k], line[k + 1]
        between = a + weight * (b - a)
        target[i] = a if weight == none else between


@kernel
def _lattice(
    grid: NDArray[np.float32], columns: tuple[float, float], rows: tuple[float, float], result: NDArray[Any]
) -> None:
    """See `sample_lattice`; columns = (x0, dx), rows = (y0, dy)."""
    ny, nx = result.shape
    picks, weights = np.empty(nx, np.int32), np.empty(nx, np.float32)
    first, last, start, stop = grid.shape[1], 0, nx, 0
    for i in range(nx):
        post, fraction = post_weights(columns[0] + i * columns[1], grid.shape[1])
        picks[i], weights[i] = post, np.float32(fraction)
        if post >= 0:
            first, last = min(first, post), max(last, post)
            start, stop = min(start, i), i + 1
    if start >= stop:
        return
    for i in range(start, stop):
        picks[i] -= first
    sparse = abs(columns[1]) > _SPARSE
    # One more element than the last post: its right neighbour is read, though with no weight at the grid's edge.
    line = np.zeros(last - first + 2, np.float32)
    inside = min(last - first + 2, grid.shape[1] - first)
    for j in range(ny):
        row, fy = post_weights(rows[0] + j * rows[1], grid.shape[0])
        if row < 0:
            continue
        if sparse:
            for i in range(start, stop):
                result[j, i] = bilinear(grid, first + picks[i], row, weights[i], fy)
        else:
            _blend_row(grid, row, fy, first, line[:inside])
            _dense_row(line, picks[start:stop], weights[start:stop], result[j, start:stop])


def sample_lattice(
    grid: NDArray[np.float32], x0: float, dx: float, nx: int, y0: float, dy: float, ny: int
) -> NDArray[np.float32]:
    """Heights of a lattice parallel to the grid.

    Parameters
    ----------
    grid : ndarray, shape (rows, cols), float32
        Posts; NaN = no height.
    x0, dx, nx : float, float, int
        Column of the first point in posts, step, number of columns; the step may be negative.
    y0, dy, ny : float, float, int
        The same for rows.

    Returns
    -------
    ndarray, shape (ny, nx), float32
        NaN where a post with weight is NaN, or more than half a cell outside.
    """
    result = np.full((ny, nx), np.nan, np.float32)
    if grid.size and result.size:
        grid = np.ascontiguousarray(grid, np.float32)
        _lattice(grid, (float(x0), float(dx)), (float(y0), float(dy)), result)
    return result


@kernel
def _points(grid: NDArray[np.float32], xy: NDArray[np.float64], result: NDArray[Any]) -> None:
    for i in range(xy.shape[0]):
        col, fx = post_weights(xy[i, 0], grid.shape[1])
        row, fy = post_weights(xy[i, 1], grid.shape[0])
        if col >= 0 and row >= 0:
            result[i] = bilinear(grid, col, row, fx, fy)


def sample_points(grid: NDArray[np.float32], xy: NDArray[np.float64]) -> NDArray[np.float32]:
    """Heights at scattered points.

    Parameters
    ----------
    grid : ndarray, shape (rows, cols), float32
        Posts; NaN = no height.
    xy : ndarray, shape (n, 2), float64
        Column and row in posts; NaN gives NaN.

    Returns
    -------
    ndarray, shape (n,), float32
        NaN as in `sample_lattice`.
    """
    result = np.full(len(xy), np.nan, np.float32)
    if grid.size and result.size:
        _points(np.ascontiguousarray(grid, np.float32), np.ascontiguousarray(xy, np.float64), result)
    return result


# Hybrid meshes of a computing unit, bilinear or made of triangles.
#
# Positions are in meshes: x to the right from the unit's left edge, y downwards from its upper edge. `frame` = (X of
# the left edge, Y of the upper edge, meshes per metre, meshes along a side) takes vertices there. Vertices are X, Y and
# a value (k, 3); `corners` and `start` are those of `MeshFaces`. A point on an edge (to 1e-7 of a mesh) belongs to a
# triangle on either side, so that no point is lost between two; where the triangles differ (two-sided breaklines) the
# one whose vertices have the lower numbers counts, which is the left one of the line.


_ON_FACE = 1e-7
_ON_LINE = 1e-6
Frame = tuple[float, float, float, int]
Lattice = tuple[float, float, float, float]

# Heights of two triangles at one pixel that differ by more than this, metres, are those of a wall.
_WALL = 1e-3


@inner
def barycentric(
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
        wa, wb, wc, key = barycentric(vertices, corners, f, frame, x, y)
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
            col, fx = post_weights(x, n + 1)
            row, fy = post_weights(y, n + 1)
            result[i] = bilinear(posts, col, row, fx, fy)


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
def _clear_triangulated(result: NDArray[np.float32], start: NDArray[np.int64], n: int, lattice: Lattice) -> None:
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
def _span_at_row(
    xa: float, ya: float, xb: float, yb: float, y: float, span: tuple[float, float]
) -> tuple[float, float]:
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
def _scan_triangle(
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
        span = _span_at_row(xb, yb, xc, yc, y, _span_at_row(xa, ya, xb, yb, y, (np.inf, -np.inf)))
        low, high = _span_at_row(xc, yc, xa, ya, y, span)
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
    _clear_triangulated(result, start, n, lattice)
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
                    ties |= _scan_triangle(result, (i0, i1, j0, j1), scale, frame, vertices, corners, f)
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
def _error_term(terms: NDArray[np.float32], k: int, col: int, row: int, fx: float, fy: float) -> float:
    upper = terms[k, row, col] + fx * (terms[k, row, col + 1] - terms[k, row, col])
    lower = terms[k, row + 1, col] + fx * (terms[k, row + 1, col + 1] - terms[k, row + 1, col])
    return upper + fy * (lower - upper)


@inner
def _with_representation_error(
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
        _error_term(terms, 0, col, row, fx, fy),
        _error_term(terms, 1, col, row, fx, fy),
        _error_term(terms, 2, col, row, fx, fy),
    )
    error = 0.0
    mesh = row * n + col
    if start[mesh + 1] > start[mesh]:
        for f in range(start[mesh], start[mesh + 1]):
            wa, wb, wc, key = barycentric(vertices, corners, f, frame, x, y)
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
def add_representation_error(
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
            sigmas[i] = _with_representation_error(terms, power, vertices, corners, start, frame, x, y, sigmas[i])


@kernel
def add_representation_error_on_lattice(
    terms: NDArray[np.float32],
    power: float,
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    frame: Frame,
    lattice: Lattice,
    sigmas: NDArray[Any],
) -> None:
    """As `add_representation_error`, for the pixels of a lattice (ny, nx); see `scan_faces`."""
    x0, dx, y0, dy = lattice
    for j in range(sigmas.shape[0]):
        for i in range(sigmas.shape[1]):
            if sigmas[j, i] == sigmas[j, i]:
                x, y = x0 + i * dx, y0 + j * dy
                sigmas[j, i] = _with_representation_error(
                    terms, power, vertices, corners, start, frame, x, y, sigmas[j, i]
                )


# Height ranges of many rectangles of one relief.


@kernel
def height_ranges(relief: NDArray[np.float32], rects: NDArray[np.int32]) -> NDArray[np.float64]:
    """Lowest and highest finite relief of each rectangle.

    Parameters
    ----------
    relief : ndarray, shape (rows, cols), float32
        NaN where there is no surface.
    rects : ndarray, shape (n, 4), int32
        First column, first row, end column, end row; half-open.

    Returns
    -------
    ndarray, shape (n, 2), float64
        Lowest and highest; +inf, −inf where the rectangle holds no finite value.
    """
    n = rects.shape[0]
    ranges = np.empty((n, 2), np.float64)
    for i in range(n):
        low, high = np.float32(np.inf), np.float32(-np.inf)
        for row in range(rects[i, 1], rects[i, 3]):
            for col in range(rects[i, 0], rects[i, 2]):
                h = relief[row, col]
                # Both comparisons are false for NaN, and selecting (not branching) lets the loop use vectors.
                low = h if h < low else low
                high = h if h > high else high
        ranges[i, 0] = low
        ranges[i, 1] = high
    return ranges


# Gradients of a surface from its heights half a pixel away, and shading.


@inner
def _difference(before: float, middle: float, after: float, step: float) -> float:
    """Difference over a step; over half of it where one side has no height."""
    if np.isnan(before):
        return 2.0 * (after - middle) / step
    if np.isnan(after):
        return 2.0 * (middle - before) / step
    return (after - before) / step


@kernel
def gradients(
    across: NDArray[np.float32],
    along: NDArray[np.float32],
    middle: NDArray[np.float32],
    resolution: float,
    result: NDArray[np.float32],
) -> None:
    """Slopes to the east and to the north at pixel centres.

    Parameters
    ----------
    across
        Heights in the middles of the pixels' left and right edges, shape (h, w + 1), metres; NaN = none.
    along
        Heights in the middles of their upper and lower edges, shape (h + 1, w).
    middle
        Heights at the centres, shape (h, w).
    resolution
        Side of a pixel, metres.
    result
        Filled, shape (2, h, w): dz/dX and dz/dY; NaN where the centre has no height, or nothing beside it in X or Y.
    """
    for i in range(middle.shape[0]):
        for j in range(middle.shape[1]):
            z = np.float64(middle[i, j])
            gx, gy = np.nan, np.nan
            if not np.isnan(z):
                gx = _difference(np.float64(across[i, j]), z, np.float64(across[i, j + 1]), resolution)
                gy = _difference(np.float64(along[i + 1, j]), z, np.float64(along[i, j]), resolution)
            none = np.isnan(gx) or np.isnan(gy)
            result[0, i, j] = np.nan if none else gx
            result[1, i, j] = np.nan if none else gy


@kernel
def illumination(
    slopes: NDArray[np.float32],
    exaggeration: float,
    suns: NDArray[np.float64],
    weighted: bool,
    result: NDArray[np.float32],
) -> None:
    """Light of one or several suns on a matt surface (Lambert): the cosine of the angle of incidence, never below 0.

    Parameters
    ----------
    slopes
        dz/dX and dz/dY, shape (2, h, w).
    exaggeration
        Factor of all heights.
    suns
        Unit vectors towards the suns (east, north, up), shape (n, 3).
    weighted
        Each sun counts with the squared cosine of the angle between its azimuth and the slope's, so that every slope
        has the contrast of the sun that it faces or turns its back to. Else all count alike.
    result
        Filled, shape (h, w), 0 to 1; NaN where a slope is NaN.
    """
    n = suns.shape[0]
    for i in range(result.shape[0]):
        for j in range(result.shape[1]):
            gx, gy = exaggeration * slopes[0, i, j], exaggeration * slopes[1, i, j]
            steep = gx * gx + gy * gy
            norm = 1.0 / np.sqrt(1.0 + steep)
            total, weights = 0.0, 0.0
            for k in range(n):
                light = max(suns[k, 2] - gx * suns[k, 0] - gy * suns[k, 1], 0.0) * norm
                weight = 1.0
                if weighted and steep > 0.0:
                    flat = suns[k, 0] * suns[k, 0] + suns[k, 1] * suns[k, 1]
                    facing = gx * suns[k, 0] + gy * suns[k, 1]
                    weight = facing * facing / (steep * max(flat, 1e-30))
                total += weight * light
                weights += weight
            result[i, j] = np.nan if np.isnan(steep) else total / max(weights, 1e-30)


# Flow of water over a grid of heights: filled pits, receivers, and accumulation.
#
# Cells are numbered row · columns + column. The flood rises from the edge of the terrain inwards (priority flood:
# Barnes, Lehman, Mulla 2014, *Computers & Geosciences* 62), so that every cell is reached from a cell that is not
# higher. The order in which cells are reached never falls; whatever flows downhill flows to a cell that was reached
# before, and one pass along the order, or against it, sums along all ways.


#: Neighbours from east, counter-clockwise; direction d of a cell is its position here.
COLUMN = np.array([1, 1, 0, -1, -1, -1, 0, 1], np.int64)
ROW = np.array([0, -1, -1, -1, 0, 1, 1, 1], np.int64)
_DIAGONAL = np.sqrt(2.0)


@inner
def _push(keys: NDArray[np.float32], cells: NDArray[np.int32], size: int, key: float, cell: int) -> None:
    """Add to a heap of `size` elements; the lowest key is at 0."""
    i = size
    while i > 0:
        parent = (i - 1) >> 1
        if keys[parent] <= key:
            break
        keys[i], cells[i] = keys[parent], cells[parent]
        i = parent
    keys[i], cells[i] = key, cell


@inner
def _pop(keys: NDArray[np.float32], cells: NDArray[np.int32], size: int) -> None:
    """Take the lowest away; `size` is what is left."""
    key, cell = keys[size], cells[size]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i], cells[i] = keys[child], cells[child]
        i = child
    keys[i], cells[i] = key, cell


@inner
def _edge(heights: NDArray[np.float32], row: int, col: int) -> bool:
    """Whether water can leave the terrain from a cell."""
    rows, columns = heights.shape
    if row == 0 or col == 0 or row == rows - 1 or col == columns - 1:
        return True
    found = False
    for d in range(8):
        found |= np.isnan(heights[row + ROW[d], col + COLUMN[d]])
    return found


@kernel
def flood(
    heights: NDArray[np.float32], filled: NDArray[np.float32], order: NDArray[np.int32], origin: NDArray[np.int32]
) -> int:
    """Fill all pits up to where they spill.

    Parameters
    ----------
    heights : ndarray, shape (rows, cols), float32
        NaN = no terrain: water leaves there, and over the edge of the grid.
    filled : ndarray, shape (rows, cols), float32
        Result: heights, at least those of the way out.
    order : ndarray, shape (rows · cols,), int32
        Result: cells in the order in which the flood reaches them; their filled heights never fall.
    origin : ndarray, shape (rows · cols,), int32
        Result: the cell from which the flood came, −1 on the edge.

    Returns
    -------
    int
        Number of cells with terrain: that many elements of `order` are set.
    """
    rows, columns = heights.shape
    count = rows * columns
    keys, cells = np.empty(count, np.float32), np.empty(count, np.int32)
    level = np.empty(count, np.int32)
    reached = np.zeros((rows, columns), np.uint8)
    heap = first = last = done = 0
    for row in range(rows):
        for col in range(columns):
            filled[row, col] = heights[row, col]
            if not np.isnan(heights[row, col]) and _edge(heights, row, col):
                _push(keys, cells, heap, heights[row, col], row * columns + col)
                heap += 1
                reached[row, col] = 1
                origin[row * columns + col] = -1
    while heap > 0 or first < last:
        # Cells as high as the water's level wait in a queue, so that plains are crossed on the shortest ways to any
        # of their rims.
        if first == last:
            here = keys[0]
            while heap > 0 and keys[0] == here:
                level[last] = cells[0]
                last += 1
                heap -= 1
                _pop(keys, cells, heap)
        cell = level[first]
        first += 1
        order[done] = cell
        done += 1
        row, col = cell // columns, cell % columns
        here = filled[row, col]
        for d in range(8):
            j, i = row + ROW[d], col + COLUMN[d]
            if j < 0 or i < 0 or j >= rows or i >= columns or reached[j, i] or np.isnan(heights[j, i]):
                continue
            reached[j, i] = 1
            origin[j * columns + i] = cell
            if heights[j, i] <= here:
                filled[j, i] = here
                level[last] = j * columns + i
                last += 1
            else:
                _push(keys, cells, heap, heights[j, i], j * columns + i)
                heap += 1
    return done


@kernel
def steepest(filled: NDArray[np.float32], origin: NDArray[np.int32], receiver: NDArray[np.int32]) -> None:
    """Cell into which each cell flows (D8: O'Callaghan, Mark 1984): the neighbour with the steepest way down.

    On plains and filled pits it is where the flood came from; `receiver` is −1 where water leaves the terrain, and −2
    where there is none.
    """
    rows, columns = filled.shape
    for row in range(rows):
        for col in range(columns):
            cell = row * columns + col
            here = filled[row, col]
            if np.isnan(here):
                receiver[cell] = -2
                continue
            best, to = 0.0, np.int64(origin[cell])
            for d in range(8):
                j, i = row + ROW[d], col + COLUMN[d]
                if j < 0 or i < 0 or j >= rows or i >= columns:
                    continue
                fall = np.float64(here) - np.float64(filled[j, i])
                if d & 1:
                    fall /= _DIAGONAL
                if fall > best:
                    best, to = fall, j * columns + i
            receiver[cell] = to


@kernel
def directions(receiver: NDArray[np.int32], out: NDArray[np.int8]) -> None:
    """Direction of every cell's flow by its receiver: position in `COLUMN` and `ROW`, or the receiver's −1 or −2."""
    rows, columns = out.shape
    for row in range(rows):
        for col in range(columns):
            to = np.int64(receiver[row * columns + col])
            out[row, col] = -2 if to == -2 else -1
            if to >= 0:
                for d in range(8):
                    if row + ROW[d] == to // columns and col + COLUMN[d] == to % columns:
                        out[row, col] = d


@kernel
def accumulate(order: NDArray[np.int32], receiver: NDArray[np.int32], sums: NDArray[np.float64]) -> None:
    """Add to every cell what flows into it; `sums` holds each cell's own amount before."""
    for k in range(order.shape[0] - 1, -1, -1):
        cell = order[k]
        to = receiver[cell]
        if to >= 0:
            sums[to] += sums[cell]


@inner
def _facet(here: float, side: float, corner: float) -> tuple[float, float]:
    """Slope of a triangle of three cells, and the part of the flow that goes to the corner."""
    if np.isnan(side) or np.isnan(corner):
        return -1.0, 0.0
    s1, s2 = here - side, side - corner
    if s2 <= 0.0:
        return s1, 0.0
    if s2 >= s1:
        return (here - corner) / _DIAGONAL, 1.0
    return np.sqrt(s1 * s1 + s2 * s2), np.arctan2(s2, s1) / (np.pi / 4.0)


@kernel
def accumulate_split(
    filled: NDArray[np.float32], order: NDArray[np.int32], receiver: NDArray[np.int32], sums: NDArray[np.float64]
) -> None:
    """As `accumulate`, but flow is split between the two neighbours beside the steepest direction.

    The direction is that of the steepest of eight triangles (D∞: Tarboton 1997, *Water Resources Research* 33), the
    split by its angle to the two neighbours. Where no triangle falls, flow goes to the receiver.
    """
    rows, columns = filled.shape
    for k in range(order.shape[0] - 1, -1, -1):
        cell = order[k]
        row, col = cell // columns, cell % columns
        here = np.float64(filled[row, col])
        best, part, to_side, to_corner = 0.0, 0.0, -1, -1
        for f in range(8):
            # Triangles lie on both sides of the four neighbours that share an edge with the cell.
            d = f & 6
            e = (d + 1) & 7 if f & 1 else (d + 7) & 7
            j, i, q, p = row + ROW[d], col + COLUMN[d], row + ROW[e], col + COLUMN[e]
            if min(j, q) < 0 or min(i, p) < 0 or max(j, q) >= rows or max(i, p) >= columns:
                continue
            slope, share = _facet(here, np.float64(filled[j, i]), np.float64(filled[q, p]))
            if slope > best:
                best, part, to_side, to_corner = slope, share, j * columns + i, q * columns + p
        if best > 0.0:
            if part < 1.0:
                sums[to_side] += (1.0 - part) * sums[cell]
            if part > 0.0:
                sums[to_corner] += part * sums[cell]
        elif receiver[cell] >= 0:
            sums[receiver[cell]] += sums[cell]


@inner
def _step(cell: int, to: int, columns: int) -> float:
    """Distance between the middles of two neighbours, in cells."""
    return _DIAGONAL if cell // columns != to // columns and cell % columns != to % columns else 1.0


@kernel
def downstream(
    order: NDArray[np.int32], receiver: NDArray[np.int32], columns: int, stops: NDArray[np.bool_], length: NDArray[Any]
) -> None:
    """Length of the way down to where water leaves, or to the next of the cells in `stops`, in cells."""
    for k in range(order.shape[0]):
        cell = order[k]
        to = receiver[cell]
        length[cell] = 0.0 if to < 0 or stops[cell] else length[to] + _step(cell, to, columns)


@kernel
def upstream_length(order: NDArray[np.int32], receiver: NDArray[np.int32], columns: int, length: NDArray[Any]) -> None:
    """Length of the longest way that leads to each cell, in cells; `length` is zero before."""
    for k in range(order.shape[0] - 1, -1, -1):
        cell = order[k]
        to = receiver[cell]
        if to >= 0:
            length[to] = max(length[to], length[cell] + _step(cell, to, columns))


@kernel
def label_upstream(order: NDArray[np.int32], receiver: NDArray[np.int32], labels: NDArray[np.int32]) -> None:
    """Give every cell the label of the next labelled cell on its way down; labels of others are 0 before."""
    for k in range(order.shape[0]):
        cell = order[k]
        to = receiver[cell]
        if labels[cell] == 0 and to >= 0:
            labels[cell] = labels[to]
