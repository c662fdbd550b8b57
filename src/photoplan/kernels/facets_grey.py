"""Grey facets: a surface of cubic B-splines through the pixels of all images, by conjugate gradients.

Coefficients count from `PAD` before the first height post; with `ratio` grey facets along a side of a height facet, the
place (u, v) of the posts is (u · ratio, v · ratio) of the grey facets. A system is kept by offsets: entry
7 · dj + di + 3 at (j, i) couples it with (j + dj, i + di); of dj = 0 only di >= 0 is used.
"""

from __future__ import annotations

import numpy as np

from photoplan.kernels.jit import inner, kernel

PAD = 2
"""Coefficients before the first and behind the last post."""
OFFSETS = 28
"""Entries of a row of the system, some of them unused."""


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
def add_grey(places, grey, weights, ratio, system, right, density):
    """Add the observation equations g = G(u, v) of an image to the normal equations of the grey facets.

    Parameters
    ----------
    places : ndarray, shape (h, w, 4)
        See `facets_transfer.transfer`.
    grey, weights : ndarray, shape (h, w)
        Grey values in the system of the surface, and their weights; 0: not to be used.
    ratio : int
        Grey facets along a side of a height facet.
    system : ndarray, shape (m, n, OFFSETS), float32
    right, density : ndarray, shape (m, n), float32
        Right-hand side, and sums of weights by the nearest coefficient.
    """
    x, y = np.empty(4), np.empty(4)
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
            i, j = i + PAD - 1, j + PAD - 1
            for b in range(4):
                for a in range(4):
                    first = p * y[b] * x[a]
                    right[j + b, i + a] += first * grey[r, c]
                    for e in range(b, 4):
                        for d in range(a if e == b else 0, 4):
                            system[j + b, i + a, 7 * (e - b) + d - a + 3] += first * y[e] * x[d]


@inner
def _times(system, x, y):
    """y = system · x, system by offsets first: shape (OFFSETS, m, n)."""
    rows, columns = x.shape
    for j in range(rows):
        for i in range(columns):
            y[j, i] = 0.0
    for k in range(3, OFFSETS):
        dj, di = k // 7, k % 7 - 3
        first, last = max(0, -di), columns - max(0, di)
        for j in range(rows - dj):
            for i in range(first, last):
                y[j, i] += system[k, j, i] * x[j + dj, i + di]
            if k > 3:
                for i in range(first, last):
                    y[j + dj, i + di] += system[k, j, i] * x[j, i]


@inner
def _unfiltered(x, gain):
    """Divide by the sampled B-spline (1 4 1)/6 along rows and columns, in place; `gain` is scratch."""
    rows, columns = x.shape
    for n in range(max(rows, columns)):
        gain[n] = 1.0 / (4.0 - (gain[n - 1] if n else 0.0))
    for j in range(rows):
        x[j, 0] *= 6.0 * gain[0]
        for i in range(1, columns):
            x[j, i] = (6.0 * x[j, i] - x[j, i - 1]) * gain[i]
        for i in range(columns - 2, -1, -1):
            x[j, i] -= gain[i] * x[j, i + 1]
    for i in range(columns):
        x[0, i] *= 6.0 * gain[0]
    for j in range(1, rows):
        for i in range(columns):
            x[j, i] = (6.0 * x[j, i] - x[j - 1, i]) * gain[j]
    for j in range(rows - 2, -1, -1):
        for i in range(columns):
            x[j, i] -= gain[j] * x[j + 1, i]


@kernel
def solve_grey(system, right, diagonal, values, rounds, tolerance):
    """Improve coefficients by conjugate gradients, preconditioned in the grey values at the nodes.

    Parameters
    ----------
    system : ndarray, shape (OFFSETS, m, n), float32
    right : ndarray, shape (m, n), float32
    diagonal : ndarray, shape (m, n), float32
        About the weight of the grey value at each node, positive.
    values : ndarray, shape (m, n), float32
        Coefficients: start and result.
    rounds, tolerance
        Iterations at most; they end when the error, measured by the preconditioner, has fallen by this factor.

    Returns
    -------
    int
        Iterations.
    """
    rows, columns = values.shape
    residual, product = np.empty((rows, columns), np.float32), np.empty((rows, columns), np.float32)
    improved, gain = np.empty((rows, columns), np.float32), np.empty(max(rows, columns))
    _times(system, values, product)
    residual[:] = right - product
    way = np.zeros((rows, columns), np.float32)
    before, first = 1.0, 0.0
    for k in range(rounds):
        improved[:] = residual
        _unfiltered(improved, gain)
        for j in range(rows):
            for i in range(columns):
                improved[j, i] /= diagonal[j, i]
        _unfiltered(improved, gain)
        size = 0.0
        for j in range(rows):
            for i in range(columns):
                size += residual[j, i] * improved[j, i]
        if k == 0:
            first = size
        if not size > tolerance * tolerance * first:
            return k
        share = 0.0 if k == 0 else size / before
        way[:] = improved + np.float32(share) * way
        _times(system, way, product)
        curve = 0.0
        for j in range(rows):
            for i in range(columns):
                curve += way[j, i] * product[j, i]
        if not curve > 0.0:
            return k
        along = np.float32(size / curve)
        values += along * way
        residual -= along * product
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
def sample_grey(values, ratio, at, out):
    """Grey values at places (n, 2) of the posts inside them; out has shape (n,)."""
    x, y, dx, dy, found = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(3)
    for k in range(len(at)):
        grey_at(values, at[k, 0] * ratio, at[k, 1] * ratio, x, y, dx, dy, found)
        out[k] = found[0]
