"""Grey facets: a surface of cubic B-splines through the pixels of all images, by conjugate gradients.

Coefficients count from `PAD` before the first height post; with `ratio` grey facets along a side of a height facet, the
place (u, v) of the posts is (u · ratio, v · ratio) of the grey facets. Pixels are added facet by facet: what has one
address for one facet is there when the next pixel wants it; from this the system is made. It is kept by rows, then by
offsets: entry 7 · dj + di of row j couples column i with (j + dj, i + di); of dj = 0 only di >= 0 is used.
"""

from __future__ import annotations

import numpy as np

from photoplan.kernels.facets_rows import add_both, add_few, add_product, add_share, dot
from photoplan.kernels.facets_signs import sign_at
from photoplan.kernels.jit import inner, kernel

PAD = 2
"""Coefficients before the first and behind the last post."""
OFFSETS = 25
"""Entries of the system."""
SUMS = 44
"""Sums of a facet, by the row of its four coefficients: the ten pairs of its columns (0 0, 1 1, 2 2, 3 3, 0 1, 1 2,
2 3, 0 2, 1 3, 0 3) with each of four rows from there on, and the right-hand side of its columns."""
#: As many as `add_few` takes at once.
_TEN, _FOUR = (0,) * 10, (0,) * 4
#: The inverse of (1 4 1)/6 at 0 to 3 nodes: √3 · (√3 − 2)^k.
_INVERSE = np.array([3**0.5 * (3**0.5 - 2) ** k for k in range(4)], np.float32)


@inner
def spline(f, w):
    """The four cubic B-splines at the part f of a facet."""
    e = 1.0 - f
    w[0] = e * e * e / 6.0
    w[1] = (4.0 - 3.0 * f * f * (1.0 + e)) / 6.0
    w[2] = (4.0 - 3.0 * e * e * (1.0 + f)) / 6.0
    w[3] = f * f * f / 6.0


@inner
def slope(f, w):
    """Their derivatives."""
    e = 1.0 - f
    w[0] = -0.5 * e * e
    w[1] = 0.5 * f * (3.0 * f - 4.0)
    w[2] = 0.5 * e * (4.0 - 3.0 * e)
    w[3] = 0.5 * f * f


@kernel
def add_grey(places, grey, weights, ratio, sums, density):
    """Add the observation equations g = G(u, v) of an image to sums of the grey facets.

    Parameters
    ----------
    places : ndarray, shape (h, w, 4)
        See `facets_transfer.transfer`.
    grey, weights : ndarray, shape (h, w)
        Grey values in the system of the surface, and their weights; 0: not to be used.
    ratio : int
        Grey facets along a side of a height facet.
    sums : ndarray, shape (m, n + 3, SUMS), float32
        Added; see `made_grey`. A facet whose first coefficient is in column i is at i + 3.
    density : ndarray, shape (m, n), float32
        Sums of weights by the nearest coefficient.
    """
    x, y, columns = np.empty(4), np.empty(4), np.empty(4, np.float32)
    pairs, flat, width = np.empty(10, np.float32), sums.reshape(-1), sums.shape[1] * SUMS
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            p = weights[r, c]
            if not p > 0.0:
                continue
            s, t = places[r, c, 0] * ratio, places[r, c, 1] * ratio
            i, j = int(s), int(t)
            spline(s - i, x)
            spline(t - j, y)
            density[int(t + 0.5) + PAD, int(s + 0.5) + PAD] += p
            for a in range(4):
                columns[a] = x[a]
            x0, x1, x2, x3 = columns[0], columns[1], columns[2], columns[3]
            pairs[0], pairs[1], pairs[2], pairs[3], pairs[4] = x0 * x0, x1 * x1, x2 * x2, x3 * x3, x0 * x1
            pairs[5], pairs[6], pairs[7], pairs[8], pairs[9] = x1 * x2, x2 * x3, x0 * x2, x1 * x3, x0 * x3
            at = (j + PAD - 1) * width + (i + PAD + 2) * SUMS
            for b in range(4):
                part = p * y[b]
                for e in range(b, 4):
                    add_few(part * y[e], pairs, _TEN, flat, at + 10 * (e - b))
                add_few(part * grey[r, c], columns, _FOUR, flat, at + 40)
                at += width


@kernel
def made_grey(sums, system, right):
    """The normal equations from the sums of all images: system of shape (m, OFFSETS, n), right-hand side (m, n)."""
    system[:] = np.float32(0.0)
    for j in range(right.shape[0]):
        for i in range(right.shape[1]):
            # The facets of which a coefficient is the first, second, third, fourth column.
            for dj in range(4):
                k = 10 * dj
                a, b = sums[j, i + 3, k : k + 10], sums[j, i + 2, k : k + 10]
                c, d = sums[j, i + 1, k : k + 10], sums[j, i, k : k + 10]
                to = system[j, 7 * dj : 7 * dj + 4]
                to[0, i] = a[0] + b[1] + c[2] + d[3]
                to[1, i] = a[4] + b[5] + c[6]
                to[2, i] = a[7] + b[8]
                to[3, i] = a[9]
                if dj > 0:
                    to = system[j, 7 * dj - 3 : 7 * dj]
                    to[2, i] = b[4] + c[5] + d[6]
                    to[1, i] = c[7] + d[8]
                    to[0, i] = d[9]
            right[j, i] = sums[j, i + 3, 40] + sums[j, i + 2, 41] + sums[j, i + 1, 42] + sums[j, i, 43]


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
            s, t = places[r, c, 0] * ratio, places[r, c, 1] * ratio
            i, j = int(s), int(t)
            spline(s - i, x)
            spline(t - j, y)
            i, j = i + PAD - 1, j + PAD - 1
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
    i, j = int(s), int(t)
    spline(s - i, x)
    spline(t - j, y)
    slope(s - i, dx)
    slope(t - j, dy)
    i, j = i + PAD - 1, j + PAD - 1
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
            s, t = places[r, c, 0] * ratio, places[r, c, 1] * ratio
            i, j = int(s), int(t)
            spline(s - i, x)
            spline(t - j, y)
            i, j = i + PAD - 1, j + PAD - 1
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
