"""Grey facets: a surface of cubic B-splines through the pixels of all images, by conjugate gradients.

Coefficients count from `PAD` before the first height post; with `ratio` grey facets along a side of a height facet, the
place (u, v) of the posts is (u · ratio, v · ratio) of the grey facets. The system is kept by rows, then by offsets:
entry 7 · dj + di of row j couples column i with (j + dj, i + di); of dj = 0 only di >= 0 is used.
"""

from __future__ import annotations

import numpy as np

from photoplan.kernels.facets_rows import add_both, add_product, add_share, dot
from photoplan.kernels.facets_signs import sign_at
from photoplan.kernels.facets_sums import OFFSETS, PAD, spline
from photoplan.kernels.jit import inner, kernel

#: The inverse of (1 4 1)/6 at 0 to 3 nodes: √3 · (√3 − 2)^k.
_INVERSE = np.array([3**0.5 * (3**0.5 - 2) ** k for k in range(4)], np.float32)


@inner
def slope(f, w):
    """Their derivatives."""
    e = 1.0 - f
    w[0] = -0.5 * e * e
    w[1] = 0.5 * f * (3.0 * f - 4.0)
    w[2] = 0.5 * e * (4.0 - 3.0 * e)
    w[3] = 0.5 * f * f


@inner
def splines_at(s, t, x, y):
    """The splines along columns and rows at a place, in x and y; row and column of the first of their coefficients."""
    i, j = int(s), int(t)
    spline(s - i, x)
    spline(t - j, y)
    return j + PAD - 1, i + PAD - 1


@kernel
def add_errors(places, first, weights, ratio, right):
    """Add to a right-hand side what independent errors of an image's pixels are in it, one standard deviation each.

    `first` is column and row of the first pixel in its image: errors are the same whatever window is looked at. See
    `add_grey`.
    """
    x, y = np.empty(4), np.empty(4)
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            if not weights[r, c] > 0.0:
                continue
            j, i = splines_at(places[r, c, 0] * ratio, places[r, c, 1] * ratio, x, y)
            error = np.sqrt(weights[r, c]) * sign_at(first[0] + c, first[1] + r)
            for b in range(4):
                for a in range(4):
                    right[j + b, i + a] += np.float32(error * y[b] * x[a])


@inner
def _times(system, x, y):
    """y = system · x."""
    rows, columns = x.shape
    y[:] = np.float32(0.0)
    for j in range(rows):
        add_product(system[j, 0], x[j], y[j])
        for k in range(1, OFFSETS):
            dj = (k + 3) // 7
            di = k - 7 * dj
            if j + dj < rows:
                # Slices, since an index that might be negative would be looked at.
                i0, i1 = max(0, -di), columns - max(0, di)
                part, there = system[j, k, i0:i1], slice(i0 + di, i1 + di)
                if dj > 0:
                    add_both(part, x[j + dj, there], x[j, i0:i1], y[j, i0:i1], y[j + dj, there])
                else:
                    add_product(part, x[j, there], y[j, i0:i1])
                    add_product(part, x[j, i0:i1], y[j, there])


@inner
def _unfiltered(x, scratch):
    """Divide by the sampled B-spline (1 4 1)/6 along columns and rows, in place, but for what is cut off."""
    rows, columns = x.shape
    for j in range(rows):
        out = scratch[j]
        out[:] = np.float32(0.0)
        for k in range(max(0, j - 3), min(rows, j + 4)):
            add_share(_INVERSE[abs(k - j)], x[k], out)
    for j in range(rows):
        here, out = scratch[j], x[j]
        out[:] = np.float32(0.0)
        add_share(_INVERSE[0], here, out)
        for k in range(1, 4):
            add_share(_INVERSE[k], here[k:], out[: columns - k])
            add_share(_INVERSE[k], here[: columns - k], out[k:])


@kernel
def solve_grey(system, right, diagonal, values, rounds, enough):
    """Improve coefficients by conjugate gradients, preconditioned in the grey values at the nodes.

    Parameters
    ----------
    system : ndarray, shape (m, OFFSETS, n), float32
    right : ndarray, shape (m, n), float32
    diagonal : ndarray, shape (m, n), float32
        About the weight of the grey value at each node, positive.
    values : ndarray, shape (m, n), float32
        Coefficients: start and result.
    rounds, enough
        Iterations at most; they end when the errors of the grey values are about this part of their own standard
        deviations, in the mean.

    Returns
    -------
    int
        Iterations.
    """
    rows, columns = values.shape
    residual, product = np.empty((rows, columns), np.float32), np.empty((rows, columns), np.float32)
    improved, way = np.empty((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    part = np.empty(8, np.float32)
    _times(system, values, product)
    for j in range(rows):
        for i in range(columns):
            residual[j, i] = right[j, i] - product[j, i]
    before = 1.0
    for k in range(rounds):
        for j in range(rows):
            for i in range(columns):
                improved[j, i] = residual[j, i]
        _unfiltered(improved, product)
        for j in range(rows):
            for i in range(columns):
                improved[j, i] /= diagonal[j, i]
        _unfiltered(improved, product)
        size = dot(residual, improved, part)
        if not size > enough * enough * rows * columns:
            return k
        share = np.float32(0.0 if k == 0 else size / before)
        for j in range(rows):
            for i in range(columns):
                way[j, i] = improved[j, i] + share * way[j, i]
        _times(system, way, product)
        curve = dot(way, product, part)
        if not curve > 0.0:
            return k
        along = np.float32(size / curve)
        for j in range(rows):
            for i in range(columns):
                values[j, i] += along * way[j, i]
                residual[j, i] -= along * product[j, i]
        before = size
    return rounds


@inner
def grey_at(values, s, t, x, y, dx, dy, out):
    """Grey value and its derivatives along columns and rows of the grey facets; four scratch arrays of 4."""
    j, i = splines_at(s, t, x, y)
    slope(s - int(s), dx)
    slope(t - int(t), dy)
    g, gs, gt = 0.0, 0.0, 0.0
    for b in range(4):
        row, along = 0.0, 0.0
        for a in range(4):
            c = values[j + b, i + a]
            row += x[a] * c
            along += dx[a] * c
        g += y[b] * row
        gs += y[b] * along
        gt += dy[b] * row
    out[0], out[1], out[2] = g, gs, gt


@kernel
def sample_pixels(values, ratio, places, weights, out):
    """Grey values at the places of an image's pixels, all of shape (h, w); 0 where a weight is.

    See `add_grey`.
    """
    x, y = np.empty(4), np.empty(4)
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            out[r, c] = 0.0
            if not weights[r, c] > 0.0:
                continue
            j, i = splines_at(places[r, c, 0] * ratio, places[r, c, 1] * ratio, x, y)
            g = 0.0
            for b in range(4):
                row = values[j + b]
                g += y[b] * (x[0] * row[i] + x[1] * row[i + 1] + x[2] * row[i + 2] + x[3] * row[i + 3])
            out[r, c] = g


@kernel
def sample_grey(values, ratio, at, out):
    """Grey values at places (n, 2) of the posts inside them; out has shape (n,)."""
    x, y, dx, dy, found = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(3)
    for k in range(len(at)):
        grey_at(values, at[k, 0] * ratio, at[k, 1] * ratio, x, y, dx, dy, found)
        out[k] = found[0]
