"""Pixels of an image carried along their rays to a surface of bilinear height facets (direct transfer)."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.jit import inner, kernel

#: A ray goes on by no more than this part of a facet where the surface may be near.
_STRIDE = 0.25
#: Halvings of the piece of a ray in which it meets the surface.
_HALVINGS = 20
#: Least that a surface's height counts on a ray that grazes it.
_GRAZING = 0.1


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
def _first_hit(posts, u, v, ku, kv, top, bottom, slope):
    """Height at which the line (u + z·ku, v + z·kv, z) first comes down to the surface; NaN: it does not."""
    reach = abs(ku) + abs(kv)
    stride = _STRIDE / max(reach, 1e-12)
    z = top
    while z > bottom:
        above = z - height_at(posts, u + z * ku, v + z * kv)
        if above <= 0.0:
            return z
        # The surface cannot rise faster than its steepest facet.
        after = z - max(above / (1.0 + slope * reach), stride)
        if after - height_at(posts, u + after * ku, v + after * kv) > 0.0:
            z = after
            continue
        for _ in range(_HALVINGS):
            middle = 0.5 * (z + after)
            if middle - height_at(posts, u + middle * ku, v + middle * kv) > 0.0:
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


@kernel
def transfer(low, high, step, levels, posts, out):
    """Where the rays of all pixels of a window first meet the surface: what hides behind it is met by none.

    Parameters
    ----------
    low, high : ndarray, shape (rows, columns, 2)
        Where rays of a lattice of pixels cross two levels, in columns and rows of the posts; NaN: there is no ray.
    step : int
        Pixels between neighbours of the lattice, whose first one is the window's first pixel.
    levels : (float, float)
        The two levels, metres; the rays are straight in between and beyond.
    posts : ndarray, shape (m, n)
        Heights, metres, none of them NaN.
    out : ndarray, shape (height, width, 4), float32
        Column and row of the posts where the ray of a pixel ends, and by how much these change if the surface there
        rises, 1/m: (X − X0)/(Z − Z0) of Schlüter 2001, eq. 1, over 1 less the surface's own rise along the ray.
        NaN where a ray meets nothing inside the posts.
    """
    rows, columns = posts.shape
    top, bottom, slope = posts[0, 0], posts[0, 0], 0.0
    for j in range(rows):
        for i in range(columns):
            top, bottom = max(top, posts[j, i]), min(bottom, posts[j, i])
            if i > 0:
                slope = max(slope, abs(posts[j, i] - posts[j, i - 1]))
            if j > 0:
                slope = max(slope, abs(posts[j, i] - posts[j - 1, i]))
    top, bottom = top + 1e-3, bottom - 1e-3
    rise = levels[1] - levels[0]
    at = np.zeros(4)
    for r in range(out.shape[0]):
        j = min(r // step, low.shape[0] - 2)
        b = r / step - j
        for c in range(out.shape[1]):
            i = min(c // step, low.shape[1] - 2)
            a = c / step - i
            w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
            out[r, c] = np.nan
            for k in range(2):
                at[k] = w00 * low[j, i, k] + w01 * low[j, i + 1, k]
                at[k] += w10 * low[j + 1, i, k] + w11 * low[j + 1, i + 1, k]
                end = w00 * high[j, i, k] + w01 * high[j, i + 1, k]
                end += w10 * high[j + 1, i, k] + w11 * high[j + 1, i + 1, k]
                at[2 + k] = (end - at[k]) / rise
                at[k] -= levels[0] * at[2 + k]
            if np.isnan(at[0] + at[1]):
                continue
            z = _first_hit(posts, at[0], at[1], at[2], at[3], top, bottom, slope)
            u, v = at[0] + z * at[2], at[1] + z * at[3]
            if u >= 0.0 and v >= 0.0 and u <= columns - 1.0 and v <= rows - 1.0:
                towards = max(1.0 - _rise(posts, u, v, at[2], at[3]), _GRAZING)
                out[r, c, 0], out[r, c, 1] = u, v
                out[r, c, 2], out[r, c, 3] = at[2] / towards, at[3] / towards
