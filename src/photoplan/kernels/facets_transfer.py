"""Pixels of an image carried along their rays to a surface of height facets (direct transfer).

Rays are followed to bilinear facets, then over to the curved ones: along each axis a facet bends by what the second
differences around it have in common. So slopes and hills are curved, while an edge is none the rounder.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from photoplan.kernels.jit import inner, kernel

#: A ray goes on by no more than this part of a facet where the surface may be near.
_STRIDE = 0.25
#: Halvings of the piece of a ray in which it meets the surface.
_HALVINGS = 20
#: Least that a surface's height counts on a ray that grazes it.
_GRAZING = 0.1
#: Facets along a side of a cell whose steepness is known.
CELL = 8
#: What a surface may rise around a ray, part of what the ray comes down, that it is met but once without a look; steps
#: to where it is, and the part of a facet to which they find it.
_GENTLE, _STEPS, _EXACT = 0.5, 12, 1e-5


class Ray(NamedTuple):
    """A pixel's way down: column and row of the posts at the height 0, and their coefficients of z, z² and z³."""

    u: float
    v: float
    ku: float
    kv: float
    qu: float
    qv: float
    cu: float
    cv: float


@inner
def _place(ray, z):
    """Column and row of the posts at a height."""
    return ray.u + z * (ray.ku + z * (ray.qu + z * ray.cu)), ray.v + z * (ray.kv + z * (ray.qv + z * ray.cv))


@inner
def _change(ray, z):
    """What these change per metre of height there."""
    return ray.ku + z * (2.0 * ray.qu + 3.0 * z * ray.cu), ray.kv + z * (2.0 * ray.qv + 3.0 * z * ray.cv)


@inner
def height_at(posts, u, v):
    """Height of the facets at a place, in columns and rows of the posts; beyond the border that of the border."""
    rows, columns = posts.shape
    u, v = min(max(u, 0.0), columns - 1.0), min(max(v, 0.0), rows - 1.0)
    i, j = min(int(u), columns - 2), min(int(v), rows - 2)
    a, b = u - i, v - j
    upper = posts[j, i] * (1.0 - a) + posts[j, i + 1] * a
    lower = posts[j + 1, i] * (1.0 - a) + posts[j + 1, i + 1] * a
    return upper * (1.0 - b) + lower * b


@inner
def _above(posts, ray, z):
    """How far a ray is above the surface at a height."""
    u, v = _place(ray, z)
    return z - height_at(posts, u, v)


@inner
def _first_hit(posts, ray, top, bottom, slope, reach):
    """Height at which a ray first comes down to the surface; NaN: it does not. `reach`: facets that it goes per metre
    at most."""
    stride = _STRIDE / max(reach, 1e-12)
    z = top
    while z > bottom:
        above = _above(posts, ray, z)
        if above <= 0.0:
            return z
        # The surface cannot rise faster than its steepest facet.
        after = z - max(above / (1.0 + slope * reach), stride)
        if _above(posts, ray, after) > 0.0:
            z = after
            continue
        for _ in range(_HALVINGS):
            middle = 0.5 * (z + after)
            if _above(posts, ray, middle) > 0.0:
                z = middle
            else:
                after = middle
        return 0.5 * (z + after)
    return np.nan


@inner
def _rise(posts, u, v, ku, kv):
    """What the facet at a place rises per metre that a ray comes down."""
    i, j = min(int(u), posts.shape[1] - 2), min(int(v), posts.shape[0] - 2)
    a, b = u - i, v - j
    along = (posts[j, i + 1] - posts[j, i]) * (1.0 - b) + (posts[j + 1, i + 1] - posts[j + 1, i]) * b
    down = (posts[j + 1, i] - posts[j, i]) * (1.0 - a) + (posts[j + 1, i + 1] - posts[j, i + 1]) * a
    return along * ku + down * kv


@inner
def _only_hit(posts, ray, z):
    """Height at which a ray meets a surface that it meets once, by Newton's way from z; NaN: not found."""
    rows, columns = posts.shape
    enough = _EXACT / (abs(ray.ku) + abs(ray.kv) + 1e-12)
    for _ in range(_STEPS):
        x, y = _place(ray, z)
        x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
        i, j = min(int(x), columns - 2), min(int(y), rows - 2)
        a, b = x - i, y - j
        p00, p01, p10, p11 = posts[j, i], posts[j, i + 1], posts[j + 1, i], posts[j + 1, i + 1]
        upper, lower = p00 + a * (p01 - p00), p10 + a * (p11 - p10)
        along, down = _change(ray, z)
        rise = ((1.0 - b) * (p01 - p00) + b * (p11 - p10)) * along + (lower - upper) * down
        step = (upper + b * (lower - upper) - z) / (1.0 - rise)
        z += step
        if abs(step) <= enough:
            return z
    return np.nan


@kernel
def steepness(posts, out):
    """Largest difference of neighbouring posts in cells of `CELL` × `CELL` facets and in those around each.

    `out` has shape (⌈(rows − 1)/CELL⌉, ⌈(columns − 1)/CELL⌉).
    """
    rows, columns = posts.shape
    out[:] = 0.0
    for j in range(rows):
        for i in range(columns):
            most = 0.0
            if i + 1 < columns:
                most = abs(posts[j, i + 1] - posts[j, i])
            if j + 1 < rows:
                most = max(most, abs(posts[j + 1, i] - posts[j, i]))
            # A post on the border of cells belongs to both, and cells around have it, too.
            for n in range(max(0, (j - 1) // CELL - 1), min(out.shape[0], j // CELL + 2)):
                for m in range(max(0, (i - 1) // CELL - 1), min(out.shape[1], i // CELL + 2)):
                    out[n, m] = max(out[n, m], most)


@inner
def _bend(a, b, c, d, e, f):
    """What the second differences of six posts have in common: the least of them; 0 if they bend both ways."""
    least, most = np.inf, -np.inf
    for second in (a - 2.0 * b + c, b - 2.0 * c + d, c - 2.0 * d + e, d - 2.0 * e + f):
        least, most = min(least, second), max(most, second)
    return max(least, 0.0) + min(most, 0.0)


@kernel
def bends(posts, out):
    """By how much facets bend: what second differences at the ends of a side, and at the next posts, have in common.

    `out` has shape (2, rows, columns): of the side from a post to the next along columns, and along rows; 0 near the
    border.
    """
    rows, columns = posts.shape
    out[:] = 0.0
    for j in range(rows):
        for i in range(2, columns - 3):
            out[0, j, i] = _bend(
                posts[j, i - 2], posts[j, i - 1], posts[j, i], posts[j, i + 1], posts[j, i + 2], posts[j, i + 3]
            )
    for j in range(2, rows - 3):
        for i in range(columns):
            out[1, j, i] = _bend(
                posts[j - 2, i], posts[j - 1, i], posts[j, i], posts[j + 1, i], posts[j + 2, i], posts[j + 3, i]
            )


@inner
def _bulge(bent, u, v):
    """How much higher a curved facet is than a bilinear one."""
    i, j = min(int(u), bent.shape[2] - 2), min(int(v), bent.shape[1] - 2)
    a, b = u - i, v - j
    along = (1.0 - b) * bent[0, j, i] + b * bent[0, j + 1, i]
    down = (1.0 - a) * bent[1, j, i] + a * bent[1, j, i + 1]
    return -0.5 * (a * (1.0 - a) * along + b * (1.0 - b) * down)


@inner
def _hit(posts, steep, ray, top, bottom, slope, z):
    """Where a ray first meets the surface: at once where all below the ray from above is gentle, else by a search from
    above; z: about there."""
    far = max(abs(top), abs(bottom))
    bent = 2.0 * (abs(ray.qu) + abs(ray.qv)) + 3.0 * far * (abs(ray.cu) + abs(ray.cv))
    reach = abs(ray.ku) + abs(ray.kv) + far * bent
    found = _only_hit(posts, ray, z)
    at, clear = found, not np.isnan(found)
    if clear and slope * reach < _GENTLE:
        return found
    while clear:
        u, v = _place(ray, at)
        i, j = min(max(int(u) // CELL, 0), steep.shape[1] - 1), min(max(int(v) // CELL, 0), steep.shape[0] - 1)
        clear = steep[j, i] * reach < _GENTLE
        # What is around a cell goes as far as that.
        at += CELL / max(reach, 1e-12)
        if at > top:
            break
    return found if clear else _first_hit(posts, ray, top, bottom, slope, reach)


@kernel
def transfer(ways, right, down, posts, bent, steep, wall, out):
    """Where the rays of all pixels of a window first meet the surface: what hides behind it is met by none.

    Parameters
    ----------
    ways : ndarray, shape (rows, columns, 8)
        Rays of a lattice of pixels: column and row of the posts at the height 0, and the coefficients of the height z,
        of z² and of z³; NaN: there is no ray.
    right, down : int
        Pixels between neighbours of the lattice, whose first one is the window's first pixel.
    posts : ndarray, shape (m, n)
        Heights, metres, none of them NaN.
    bent, steep : ndarray
        See `bends` and `steepness`.
    wall : float
        Times by which pixels lie closer on a facet than on level ground beyond which they are left out; infinite: none.
    out : ndarray, shape (height, width, 4), float32
        Column and row of the posts where the ray of a pixel ends, and by how much these change if the surface there
        rises, 1/m: (X − X0)/(Z − Z0) of Schlüter 2001, eq. 1, over 1 less the surface's own rise along the ray.
        NaN where a ray meets nothing inside the posts, or a wall.
    """
    rows, columns = posts.shape
    top, bottom, slope = posts[0, 0], posts[0, 0], 0.0
    for j in range(rows):
        for i in range(columns):
            top, bottom = max(top, posts[j, i]), min(bottom, posts[j, i])
    for j in range(steep.shape[0]):
        for i in range(steep.shape[1]):
            slope = max(slope, steep[j, i])
    top, bottom = top + 1e-3, bottom - 1e-3
    first, way = np.zeros(8), np.zeros(8)
    z = 0.5 * (top + bottom)
    for r in range(out.shape[0]):
        j = min(r // down, ways.shape[0] - 2)
        b = r / down - j
        for i in range(ways.shape[1] - 1):
            # Along a row rays change linearly from node to node.
            for k in range(8):
                first[k] = (1.0 - b) * ways[j, i, k] + b * ways[j + 1, i, k]
                way[k] = ((1.0 - b) * ways[j, i + 1, k] + b * ways[j + 1, i + 1, k] - first[k]) / right
            last = out.shape[1] if i == ways.shape[1] - 2 else min(out.shape[1], (i + 1) * right)
            for c in range(i * right, last):
                a = c - i * right
                u, v = first[0] + a * way[0], first[1] + a * way[1]
                ku, kv = first[2] + a * way[2], first[3] + a * way[3]
                qu, qv = first[4] + a * way[4], first[5] + a * way[5]
                cu, cv = first[6] + a * way[6], first[7] + a * way[7]
                for k in range(4):
                    out[r, c, k] = np.nan
                if np.isnan(u + v + ku + kv + qu + qv + cu + cv):
                    continue
                ray = Ray(u=u, v=v, ku=ku, kv=kv, qu=qu, qv=qv, cu=cu, cv=cv)
                z = _hit(posts, steep, ray, top, bottom, slope, z)
                u, v = _place(ray, z)
                if u >= 0.0 and v >= 0.0 and u <= columns - 1.0 and v <= rows - 1.0:
                    ku, kv = _change(ray, z)
                    towards = max(1.0 - _rise(posts, u, v, ku, kv), _GRAZING)
                    if towards > wall:
                        continue
                    higher = _bulge(bent, u, v) / towards
                    out[r, c, 0] = min(max(u + higher * ku, 0.0), columns - 1.0)
                    out[r, c, 1] = min(max(v + higher * kv, 0.0), rows - 1.0)
                    out[r, c, 2], out[r, c, 3] = ku / towards, kv / towards
                if np.isnan(z):
                    z = 0.5 * (top + bottom)
