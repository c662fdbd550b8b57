"""The heights of a part of a grid of facets, by a band Cholesky factor, and the variances of heights and curvatures."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.jit import inner, kernel


@inner
def _fill(system, curve, first, shape, free, band):
    """The band of a part: row k holds the columns k − w … k of its lower triangle at the end of a row of w + 1."""
    rows, columns = shape
    w = band.shape[1] - 1
    j0, i0 = first
    band[:] = 0.0
    for j in range(rows):
        for i in range(columns):
            n = j * columns + i
            row, col = j0 + j, i0 + i
            band[n, w] += system[0, row, col]
            if i + 1 < columns:
                band[n + 1, w - 1] += system[1, row, col]
            if j + 1 < rows:
                band[n + columns, w - columns] += system[4, row, col]
                if i > 0:
                    band[n + columns - 1, w - columns + 1] += system[3, row, col]
                if i + 1 < columns:
                    band[n + columns + 1, w - columns - 1] += system[5, row, col]
    # Curvatures (1, −2, 1) along columns and rows, and (1, −1, −1, 1) across: with a free border only those inside.
    for j in range(-1, rows + 1):
        for i in range(-1, columns + 1):
            row, col = j0 + j, i0 + i
            for kind in range(3):
                _add_curvature(curve, row, col, j, i, kind, shape, free, band)


@inner
def _add_curvature(curve, row, col, j, i, kind, shape, free, band):
    rows, columns = shape
    w = band.shape[1] - 1
    if row < 0 or col < 0 or row >= curve.shape[1] or col >= curve.shape[2]:
        return
    p = curve[kind, row, col]
    if not p > 0.0:
        return
    count = 3 if kind < 2 else 4
    if free:
        for k in range(count):
            dj, di, _ = curvature(kind, k)
            if not (0 <= j + dj < rows and 0 <= i + di < columns):
                return
    for k in range(count):
        dj, di, a = curvature(kind, k)
        if not (0 <= j + dj < rows and 0 <= i + di < columns):
            continue
        n = (j + dj) * columns + i + di
        for q in range(count):
            ej, ei, b = curvature(kind, q)
            if 0 <= j + ej < rows and 0 <= i + ei < columns:
                o = (j + ej) * columns + i + ei
                if o <= n:
                    band[n, w - (n - o)] += p * a * b


@inner
def curvature(kind, k):
    """Row and column from the middle, and factor, of the k-th post of a second difference: along, down, across."""
    if kind == 0:
        return 0, k - 1, -2.0 if k == 1 else 1.0
    if kind == 1:
        return k - 1, 0, -2.0 if k == 1 else 1.0
    return k // 2, k % 2, 1.0 if k == 0 or k == 3 else -1.0


@inner
def _factor(band):
    """Cholesky factor in place: L is the lower triangle."""
    size, w = band.shape[0], band.shape[1] - 1
    for n in range(size):
        for m in range(max(0, n - w), n):
            total = band[n, w - n + m]
            start = max(0, n - w, m - w)
            a, b = w - n, w - m
            for k in range(start, m):
                total -= band[n, a + k] * band[m, b + k]
            band[n, w - n + m] = total / band[m, w]
        total = band[n, w]
        for k in range(max(0, n - w), n):
            total -= band[n, w - n + k] ** 2
        if not total > 0.0:
            return False
        band[n, w] = np.sqrt(total)
    return True


@inner
def _back(band, x):
    """Solve with the factor, in place."""
    size, w = band.shape[0], band.shape[1] - 1
    for n in range(size):
        total = x[n]
        for k in range(max(0, n - w), n):
            total -= band[n, w - n + k] * x[k]
        x[n] = total / band[n, w]
    for n in range(size - 1, -1, -1):
        x[n] /= band[n, w]
        for k in range(max(0, n - w), n):
            x[k] -= band[n, w - n + k] * x[n]


@kernel
def solve_heights(system, curve, right, side, margin, out):
    """Heights' corrections, part by part: each with `margin` posts around it, beyond which nothing changes.

    Parameters
    ----------
    system : ndarray, shape (7, rows, columns)
        Of the pixels, see `facets_height`.
    curve : ndarray, shape (3, rows, columns)
        Weights of the curvatures along columns, rows and across.
    right : ndarray, shape (rows, columns)
        Right-hand side, of pixels and curvatures.
    side, margin : int
    out : ndarray, shape (rows, columns)

    Returns
    -------
    int
        Parts without a solution; their heights stay.
    """
    rows, columns = right.shape
    failed = 0
    for row in range(0, rows, side):
        for col in range(0, columns, side):
            j0, i0 = max(0, row - margin), max(0, col - margin)
            j1, i1 = min(rows, row + side + margin), min(columns, col + side + margin)
            n, m = j1 - j0, i1 - i0
            band = np.empty((n * m, 2 * m + 1))
            _fill(system, curve, (j0, i0), (n, m), False, band)
            x = right[j0:j1, i0:i1].copy().reshape(-1)
            done = _factor(band)
            if done:
                _back(band, x)
            else:
                failed += 1
            for j in range(row, min(rows, row + side)):
                for i in range(col, min(columns, col + side)):
                    out[j, i] = x[(j - j0) * m + i - i0] if done else 0.0
    return failed


@inner
def _invert(band, inverse, column):
    """Entries of the inverse inside the band (Takahashi 1973), stored as the factor is."""
    size, w = band.shape[0], band.shape[1] - 1
    inverse[:] = 0.0
    for n in range(size - 1, -1, -1):
        below = min(w, size - 1 - n)
        for k in range(1, below + 1):
            column[k] = band[n + k, w - k] / band[n, w]
        for k in range(below, 0, -1):
            total = 0.0
            for q in range(1, k):
                total -= column[q] * inverse[n + k, w - k + q]
            for q in range(k, below + 1):
                total -= column[q] * inverse[n + q, w - q + k]
            inverse[n + k, w - k] = total
        total = 1.0 / band[n, w] ** 2
        for q in range(1, below + 1):
            total -= column[q] * inverse[n + q, w - q]
        inverse[n, w] = total


@kernel
def variances(system, curve, side, margin, heights, curvatures, spans, wide):
    """Variances of heights and curvatures, part by part with a free border.

    Parameters
    ----------
    system, curve, side, margin
        See `solve_heights`.
    heights : ndarray, shape (rows, columns)
        Out; NaN where a part is singular.
    curvatures : ndarray, shape (3, rows, columns)
        Out; 0 for curvatures without weight.
    spans : ndarray, shape (k,), int
        Distances m; below each the mean variance of z(i − m) − 2 z(i) + z(i + m) along rows goes into `wide`, (k,).
    """
    rows, columns = heights.shape
    number = np.zeros(len(spans))
    column = np.empty(2 * (side + 2 * margin) + 1)
    wide[:] = 0.0
    for row in range(0, rows, side):
        for col in range(0, columns, side):
            j0, i0 = max(0, row - margin), max(0, col - margin)
            j1, i1 = min(rows, row + side + margin), min(columns, col + side + margin)
            n, m = j1 - j0, i1 - i0
            band, inverse = np.empty((n * m, 2 * m + 1)), np.empty((n * m, 2 * m + 1))
            _fill(system, curve, (j0, i0), (n, m), True, band)
            done = _factor(band)
            if done:
                _invert(band, inverse, column)
                for k in range(len(spans)):
                    _add_wide(inverse, (n, m), spans[k], wide, number, k)
            for j in range(row, min(rows, row + side)):
                for i in range(col, min(columns, col + side)):
                    heights[j, i] = inverse[(j - j0) * m + i - i0, 2 * m] if done else np.nan
                    for kind in range(3):
                        curvatures[kind, j, i] = 0.0
                        if done and curve[kind, j, i] > 0.0:
                            curvatures[kind, j, i] = _variance(inverse, j - j0, i - i0, kind, (n, m))


@inner
def _add_wide(inverse, shape, span, wide, number, k):
    """Bring the variances of a part's second differences over 2 · `span` posts of a row into their mean."""
    rows, columns = shape
    w = inverse.shape[1] - 1
    for j in range(rows):
        for i in range(span, columns - span):
            n = j * columns + i
            total = inverse[n - span, w] + 4.0 * inverse[n, w] + inverse[n + span, w]
            total += 2.0 * inverse[n + span, w - 2 * span]
            total -= 4.0 * (inverse[n, w - span] + inverse[n + span, w - span])
            number[k] += 1.0
            wide[k] += (total - wide[k]) / number[k]


@inner
def _variance(inverse, j, i, kind, shape):
    """Variance of a curvature; 0 where it is not inside."""
    rows, columns = shape
    w = inverse.shape[1] - 1
    count = 3 if kind < 2 else 4
    total = 0.0
    for k in range(count):
        dj, di, a = curvature(kind, k)
        if not (0 <= j + dj < rows and 0 <= i + di < columns):
            return 0.0
        n = (j + dj) * columns + i + di
        for q in range(count):
            ej, ei, b = curvature(kind, q)
            if not (0 <= j + ej < rows and 0 <= i + ei < columns):
                return 0.0
            o = (j + ej) * columns + i + ei
            total += a * b * inverse[max(n, o), w - abs(n - o)]
    return total
