"""Facets: normal equations of grey values and heights of a surface of cubic B-splines, and their solution."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from photoplan.kernels import numba_internals
from photoplan.kernels.jit import inner, kernel, maker
from photoplan.kernels.numba_internals import PAIRS

# Sums and products of rows, vectorised: no index may be negative.


@inner
def add_product(a, b, out):
    """out += a · b, element by element."""
    for i in range(len(out)):
        out[i] += a[i] * b[i]


@inner
def add_products(a, b, d, out, other):
    """out += a · b and other += a · d, element by element; `out` and `other` share nothing."""
    for i in range(len(out)):
        out[i] += a[i] * b[i]
        other[i] += a[i] * d[i]


@inner
def axpy(share, a, out):
    """out += share · a."""
    for i in range(len(out)):
        out[i] += share * a[i]


@inner
def add_row(a, out):
    """out += a."""
    for i in range(len(out)):
        out[i] += a[i]


@inner
def axpy_four(shares, a, b, c, d, out):
    """out += four shares, each of its own row: `out` is read and written once for all of them."""
    p, q, r, s = shares[0], shares[1], shares[2], shares[3]
    for i in range(len(out)):
        out[i] = out[i] + p * a[i] + q * b[i] + r * c[i] + s * d[i]


@inner
def dot(a, b, part):
    """Sum of products of two arrays of rows, in eight `part`s at once."""
    total = 0.0
    rows, columns = a.shape
    whole = columns // 8 * 8
    for j in range(rows):
        first, second = a[j], b[j]
        for k in range(8):
            part[k] = 0.0
        for i in range(0, whole, 8):
            for k in range(8):
                part[k] += first[i + k] * second[i + k]
        for k in range(8):
            total += part[k]
        for i in range(whole, columns):
            total += first[i] * second[i]
    return total


# Rademacher signs: random, but always the same at a place, whichever block asks.


@inner
def rademacher_at(i, j):
    """1 or −1, by chance, but always the same at a place (MurmurHash3's mixing, Appleby 2011)."""
    mixed = np.uint64(i) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(j) * np.uint64(0xC2B2AE3D27D4EB4F)
    mixed = (mixed ^ (mixed >> np.uint64(33))) * np.uint64(0xFF51AFD7ED558CCD)
    mixed = (mixed ^ (mixed >> np.uint64(33))) * np.uint64(0xC4CEB9FE1A85EC53)
    return 1.0 if (mixed >> np.uint64(40)) & np.uint64(1) else -1.0


@kernel
def rademacher(col, row, out):
    """Signs of the places of a grid that begins at (col, row), for each of the layers of `out`, (k, m, n)."""
    for k in range(out.shape[0]):
        for j in range(out.shape[1]):
            for i in range(out.shape[2]):
                out[k, j, i] = rademacher_at((col + i) * 4 + k, row + j)


# Equations of grey facets from the pixels of all images.
#
# Pixels are sorted by facets first, so that the 116 sums of a facet stay where the processor has them at once: of the
# ten pairs of its rows of coefficients with the ten of its columns, and of the right-hand sides.


PAD = 2
"""Coefficients before the first and behind the last post."""
GREY_ENTRIES = 25
"""Entries of the system."""
#: Sums of a facet: see `_sum_index`; and facets side by side whose sums are held before they are added to the system,
#: in rows that are this much longer, as rows a multiple of 4 KiB apart are in each other's way.
_SUMS, _SIDE, _GAP = 116, 128, 16


@inner
def spline(f, w):
    """The four cubic B-splines at the part f of a facet."""
    e = 1.0 - f
    w[0] = e * e * e / 6.0
    w[1] = (4.0 - 3.0 * f * f * (1.0 + e)) / 6.0
    w[2] = (4.0 - 3.0 * e * e * (1.0 + f)) / 6.0
    w[3] = f * f * f / 6.0


@inner
def _sum_index(k, q):
    """Where the sum of a pair of rows and a pair of columns stands: eight columns of each row, then what is left."""
    if q < 8:
        return 8 * k + q
    return 16 + 8 * q + k if k < 8 else 80 + 2 * q + k - 8


@inner
def add_pixel_loops(pixels, n, sums):
    """Add a pixel, see `sort_pixels`, to the sums of its facet, float32."""
    f, g, p, value = pixels[n, 0], pixels[n, 1], pixels[n, 2], pixels[n, 3]
    e, h = 1.0 - f, 1.0 - g
    x = (e * e * e / 6, (4 - 3 * f * f * (1 + e)) / 6, (4 - 3 * e * e * (1 + f)) / 6, f * f * f / 6)
    y = (h * h * h / 6, (4 - 3 * g * g * (1 + h)) / 6, (4 - 3 * h * h * (1 + g)) / 6, g * g * g / 6)
    for k in range(10):
        part = p * y[PAIRS[k][0]] * y[PAIRS[k][1]]
        for q in range(10):
            sums[_sum_index(k, q)] += np.float32(part * x[PAIRS[q][0]] * x[PAIRS[q][1]])
    for b in range(4):
        for a in range(4):
            sums[100 + 4 * b + a] += np.float32(p * value * y[b] * x[a])


add_pixel = numba_internals.add_pixel if numba_internals.USABLE else add_pixel_loops


@kernel
def count_pixels(places, weights, ratio, counts):
    """Count the pixels of an image in each grey facet.

    Parameters
    ----------
    places : ndarray, shape (h, w, 4)
        See `facet_transfer.transfer`.
    weights : ndarray, shape (h, w)
        0: not to be used.
    ratio : int
        Grey facets along a side of a height facet.
    counts : ndarray of int, shape (m, n)
        Added; 2 · PAD fewer rows and columns than coefficients.
    """
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            if weights[r, c] > 0.0:
                counts[int(places[r, c, 1] * ratio), int(places[r, c, 0] * ratio)] += 1


@kernel
def sort_pixels(places, grey, weights, ratio, next_ones, pixels):
    """Put the pixels of an image where those of their facets are.

    Parameters
    ----------
    places, weights, ratio
        See `count_pixels`.
    grey : ndarray, shape (h, w)
        Grey values in the system of the surface.
    next_ones : ndarray of int, shape (m, n)
        Where in `pixels` the next pixel of each facet comes: counts of all images, summed up to the facet, without it.
        Changed: after all images, where those of a facet end.
    pixels : ndarray, shape (number, 4), float32
        Changed: place in the facet along columns and rows, 0 to 1, weight, grey value.
    """
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            p = weights[r, c]
            if p > 0.0:
                s, t = places[r, c, 0] * ratio, places[r, c, 1] * ratio
                i, j = int(s), int(t)
                at = next_ones[j, i]
                next_ones[j, i] = at + 1
                pixels[at, 0], pixels[at, 1], pixels[at, 2], pixels[at, 3] = s - i, t - j, p, grey[r, c]


@kernel
def add_grey(pixels, ends, system, right, density):
    """Add the observation equations g = G(u, v) of all pixels to the normal equations of the grey facets.

    Parameters
    ----------
    pixels, ends
        See `sort_pixels`.
    system : ndarray, shape (rows, OFFSETS, columns); right : ndarray, shape (rows, columns), float32
        Added.
    density : ndarray, shape (rows, columns), float32
        Added: sums of weights by the nearest coefficient.
    """
    own, sums = np.empty(_SUMS, np.float32), np.empty((_SUMS, _SIDE + _GAP), np.float32)
    before = 0
    for j in range(ends.shape[0]):
        for first in range(0, ends.shape[1], _SIDE):
            count = min(_SIDE, ends.shape[1] - first)
            for i in range(count):
                own[:] = np.float32(0.0)
                for n in range(before, ends[j, first + i]):
                    density[j + PAD + int(pixels[n, 1] >= 0.5), first + i + PAD + int(pixels[n, 0] >= 0.5)] += pixels[
                        n, 2
                    ]
                    add_pixel(pixels, n, own)
                before = ends[j, first + i]
                for k in range(_SUMS):
                    sums[k, i] = own[k]
            _add_facets(sums, j + PAD - 1, first + PAD - 1, count, system, right)


@inner
def _add_facets(sums, row, column, count, system, right):
    """Add the sums of facets side by side, the first of whose coefficients is at a row and column, to the system."""
    for k in range(10):
        b, dj = PAIRS[k][0], PAIRS[k][1] - PAIRS[k][0]
        for q in range(10):
            a, di, own = PAIRS[q][0], PAIRS[q][1] - PAIRS[q][0], sums[_sum_index(k, q), :count]
            add_row(own, system[row + b, 7 * dj + di, column + a : column + a + count])
            if dj > 0 and di > 0:
                add_row(own, system[row + b, 7 * dj - di, column + a + di : column + a + di + count])
    for b in range(4):
        for a in range(4):
            add_row(sums[100 + 4 * b + a, :count], right[row + b, column + a : column + a + count])


# Grey facets: a surface of cubic B-splines through the pixels of all images, by conjugate gradients.
#
# Coefficients count from `PAD` before the first height post; with `ratio` grey facets along a side of a height facet,
# the place (u, v) of the posts is (u · ratio, v · ratio) of the grey facets. The system is kept by rows, then by
# offsets: entry 7 · dj + di of row j couples column i with (j + dj, i + di); of dj = 0 only di >= 0 is used.


#: The inverse of (1 4 1)/6 at 0 to 3 nodes: √3 · (√3 − 2)^k.
_INVERSE = np.array([3**0.5 * (3**0.5 - 2) ** k for k in range(4)], np.float32)


@inner
def spline_slopes(f, w):
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
def add_random_errors(places, first, weights, ratio, right):
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
            error = np.sqrt(weights[r, c]) * rademacher_at(first[0] + c, first[1] + r)
            for b in range(4):
                for a in range(4):
                    right[j + b, i + a] += np.float32(error * y[b] * x[a])


@inner
def _multiply_grey(system, x, y):
    """y = system · x."""
    rows, columns = x.shape
    y[:] = np.float32(0.0)
    for j in range(rows):
        add_product(system[j, 0], x[j], y[j])
        for k in range(1, GREY_ENTRIES):
            dj = (k + 3) // 7
            di = k - 7 * dj
            if j + dj < rows:
                # Slices, since an index that might be negative would be looked at.
                i0, i1 = max(0, -di), columns - max(0, di)
                part, there = system[j, k, i0:i1], slice(i0 + di, i1 + di)
                if dj > 0:
                    add_products(part, x[j + dj, there], x[j, i0:i1], y[j, i0:i1], y[j + dj, there])
                else:
                    add_product(part, x[j, there], y[j, i0:i1])
                    add_product(part, x[j, i0:i1], y[j, there])


@inner
def _unfilter(x, scratch):
    """Divide by the sampled B-spline (1 4 1)/6 along columns and rows, in place, but for what is cut off."""
    rows, columns = x.shape
    for j in range(rows):
        out = scratch[j]
        out[:] = np.float32(0.0)
        for k in range(max(0, j - 3), min(rows, j + 4)):
            axpy(_INVERSE[abs(k - j)], x[k], out)
    for j in range(rows):
        here, out = scratch[j], x[j]
        out[:] = np.float32(0.0)
        axpy(_INVERSE[0], here, out)
        for k in range(1, 4):
            axpy(_INVERSE[k], here[k:], out[: columns - k])
            axpy(_INVERSE[k], here[: columns - k], out[k:])


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
    _multiply_grey(system, values, product)
    for j in range(rows):
        for i in range(columns):
            residual[j, i] = right[j, i] - product[j, i]
    before = 1.0
    for k in range(rounds):
        for j in range(rows):
            for i in range(columns):
                improved[j, i] = residual[j, i]
        _unfilter(improved, product)
        for j in range(rows):
            for i in range(columns):
                improved[j, i] /= diagonal[j, i]
        _unfilter(improved, product)
        size = dot(residual, improved, part)
        if not size > enough * enough * rows * columns:
            return k
        share = np.float32(0.0 if k == 0 else size / before)
        for j in range(rows):
            for i in range(columns):
                way[j, i] = improved[j, i] + share * way[j, i]
        _multiply_grey(system, way, product)
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
    spline_slopes(s - int(s), dx)
    spline_slopes(t - int(t), dy)
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


# Correction for the amplitude that cubic B-splines lose at wavelengths near the facet size.


@kernel
def add_spline_residual(values, ratio, places, weights, table, grey):
    """Add to the grey values of an image's pixels what the facets have there more than waves have that go on between
    their coefficients.

    Parameters
    ----------
    values, ratio
        Coefficients of the grey facets, and how many lie along a side of a height facet.
    places, weights
        See `add_grey`.
    table : ndarray, shape (n + 1, taps)
        Shares of `taps` coefficients, the middle two of which are those beside a place, for its parts k / n of a facet.
    grey : ndarray, shape (h, w), float32
        Added; nothing near the border, nor where a weight is 0.
    """
    parts, taps = table.shape[0] - 1, table.shape[1]
    x, y, right, down = np.empty(4), np.empty(4), np.empty(taps), np.empty(taps)
    before = taps // 2 - 1
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            if not weights[r, c] > 0.0:
                continue
            s, t = places[r, c, 0] * ratio, places[r, c, 1] * ratio
            i, j = int(s), int(t)
            left, top = i + PAD - before, j + PAD - before
            if left < 0 or top < 0 or left + taps > values.shape[1] or top + taps > values.shape[0]:
                continue
            spline(s - i, x)
            spline(t - j, y)
            k, m = min(int((s - i) * parts), parts - 1), min(int((t - j) * parts), parts - 1)
            f, g = (s - i) * parts - k, (t - j) * parts - m
            for a in range(taps):
                right[a] = (1.0 - f) * table[k, a] + f * table[k + 1, a]
                down[a] = (1.0 - g) * table[m, a] + g * table[m + 1, a]
            missed = 0.0
            for b in range(taps):
                row, cubic = 0.0, 0.0
                for a in range(taps):
                    row += right[a] * values[top + b, left + a]
                if before - 1 <= b < before + 3:
                    for a in range(4):
                        cubic += x[a] * values[top + b, left + before - 1 + a]
                    missed += y[b - before + 1] * cubic
                missed -= down[b] * row
            grey[r, c] += missed


# Residuals of grey values, standardised.


@kernel
def add_residuals(places, residuals, finer, sums):
    """Add an image's standardised residuals to the cells that its pixels lie in.

    Parameters
    ----------
    places : ndarray, shape (h, w, 4)
        See `facet_transfer.transfer`.
    residuals : ndarray, shape (h, w), float32
        Grey value of the surface less that of the pixel, standard deviations; NaN: not used.
    finer : int
        Cells along the side of a height facet; those of 1 lie around the posts.
    sums : ndarray, shape (rows · finer, columns · finer, 3)
        Added: pixels, sum, and sum of squares.
    """
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            v = residuals[r, c]
            if np.isnan(v):
                continue
            i = min(int((places[r, c, 0] + 0.5) * finer), sums.shape[1] - 1)
            j = min(int((places[r, c, 1] + 0.5) * finer), sums.shape[0] - 1)
            sums[j, i, 0] += 1.0
            sums[j, i, 1] += v
            sums[j, i, 2] += v * v


@kernel
def sample_slopes(values, ratio, at, out):
    """Change of the grey value per post along columns and rows, at places (n, 2) of the posts inside them; out has
    shape (n, 2)."""
    x, y, dx, dy, found = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(3)
    for k in range(len(at)):
        grey_at(values, at[k, 0] * ratio, at[k, 1] * ratio, x, y, dx, dy, found)
        out[k, 0], out[k, 1] = found[1] * ratio, found[2] * ratio


# Normal equations of height facets, grey values eliminated, and of their curvatures.
#
# The grey value of the surface is determined by all images that see a place, so that what is left of an image's
# equation g = G + a·dZ is the difference of its sensitivity a to the mean of all images: S = Σ p (a − ā)² φ φᵀ
# (Schlüter 2001, eq. 1). A system is kept by offsets of rows and columns: see `HEIGHT_OFFSETS`.


#: Rows and columns between the two posts of an entry.
HEIGHT_OFFSETS = ((0, 0), (0, 1), (0, 2), (1, -1), (1, 0), (1, 1), (2, 0))
MOMENTS = 17
"""Sums of a facet over its pixels at the parts f and g of it: Σ p·a² · fⁱ gʲ (i and j to 2), Σ p·a·misfit · fⁱ gʲ (to
1), the same of errors that are drawn; i runs fastest."""
#: Products of the shares of two posts, 1 − f and f, by powers of f; by how many are of the second.
_TWO = np.array([[1.0, -2.0, 1.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]])


class Pixels(NamedTuple):
    """What an image has of a block."""

    first: Any
    """Column and row of the first pixel in its image: errors are drawn the same way whatever window is looked at."""
    places: Any
    """Shape (h, w, 4): see `facet_transfer.transfer`."""
    grey: Any
    """Grey values in the system of the surface, shape (h, w), float32."""
    weights: Any
    """Of the pixels, shape (h, w), float32; 0: not to be used."""


class GreyFacets(NamedTuple):
    """A surface."""

    values: Any
    """Coefficients of the grey facets."""
    ratio: Any
    """How many lie along a side of a height facet."""
    means: Any
    """Mean change of place with height of the pixels of all images in a facet, shape (rows − 1, columns − 1, 2)."""
    trusted: Any
    """Posts around which pixels tell noise, bool, shape (rows, columns)."""


@kernel
def add_means(places, weights, sums):
    """Add weights and weighted changes of places with height of an image's pixels, by facet.

    `sums` has shape (rows − 1, columns − 1, 3): Σ p, Σ p·ku, Σ p·kv.
    """
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            p = weights[r, c]
            if p > 0.0:
                i = min(int(places[r, c, 0]), sums.shape[1] - 1)
                j = min(int(places[r, c, 1]), sums.shape[0] - 1)
                sums[j, i, 0] += p
                sums[j, i, 1] += p * places[r, c, 2]
                sums[j, i, 2] += p * places[r, c, 3]


@kernel
def add_heights(pixels, ground, sigma, limit, moments, residuals, factors, sums):
    """Add the equations of an image to the sums of the height facets; residuals and robust factors.

    Parameters
    ----------
    pixels : Pixels
    ground : GreyFacets
    sigma, limit : float
        Standard deviation of the grey values, and the multiple of it from which weights fall (Huber 1964).
    moments : ndarray, shape (rows − 1, columns − 1, MOMENTS)
        Added.
    residuals, factors : ndarray, shape (h, w), float32
        Grey value of the surface less that of the pixel (NaN: no pixel), and the robust factor of its weight.
    sums : ndarray, shape (3,)
        Added: Σ f, Σ f (v/σ)², pixels around posts that are trusted.
    """
    x, y, dx, dy, found = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(3)
    places, weights, ratio, means = pixels.places, pixels.weights, ground.ratio, ground.means
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            p = weights[r, c]
            residuals[r, c] = np.nan
            if not p > 0.0:
                continue
            u, v = places[r, c, 0], places[r, c, 1]
            grey_at(ground.values, u * ratio, v * ratio, x, y, dx, dy, found)
            misfit = found[0] - pixels.grey[r, c]
            size = abs(misfit) / sigma
            factor = 1.0 if size <= limit else limit / size
            residuals[r, c], factors[r, c] = misfit, factor
            if ground.trusted[int(v + 0.5), int(u + 0.5)]:
                sums[0] += factor
                sums[1] += factor * size * size
                sums[2] += 1.0
            i, j = min(int(u), means.shape[1] - 1), min(int(v), means.shape[0] - 1)
            a = ratio * (found[1] * (places[r, c, 2] - means[j, i, 0]) + found[2] * (places[r, c, 3] - means[j, i, 1]))
            f, g, own = np.float64(u) - i, np.float64(v) - j, moments[j, i]
            part, pull = p * a * a, p * a * misfit
            error = a * np.sqrt(p) * rademacher_at(pixels.first[0] + c, pixels.first[1] + r)
            for k in range(3):
                own[3 * k] += part
                own[3 * k + 1] += part * f
                own[3 * k + 2] += part * f * f
                part *= g
            own[9] += pull
            own[10] += pull * f
            own[11] += pull * g
            own[12] += pull * f * g
            own[13] += error
            own[14] += error * f
            own[15] += error * g
            own[16] += error * f * g


@kernel
def height_equations(moments, system, right, noise):
    """The normal equations from the sums of all images.

    Parameters
    ----------
    moments : ndarray, shape (rows − 1, columns − 1, MOMENTS)
    system : ndarray, shape (7, rows, columns); right, noise : ndarray, shape (rows, columns)
        Added: normal equations; and a right-hand side of independent errors of the pixels, one standard deviation each.
    """
    both, half = np.empty((3, 3)), np.empty((3, 3))
    for j in range(moments.shape[0]):
        for i in range(moments.shape[1]):
            own = moments[j, i]
            for k in range(3):
                for q in range(3):
                    half[k, q] = _TWO[q, 0] * own[3 * k] + _TWO[q, 1] * own[3 * k + 1] + _TWO[q, 2] * own[3 * k + 2]
            for k in range(3):
                for q in range(3):
                    both[k, q] = _TWO[k, 0] * half[0, q] + _TWO[k, 1] * half[1, q] + _TWO[k, 2] * half[2, q]
            system[0, j, i] += both[0, 0]
            system[0, j, i + 1] += both[0, 2]
            system[0, j + 1, i] += both[2, 0]
            system[0, j + 1, i + 1] += both[2, 2]
            system[1, j, i] += both[0, 1]
            system[1, j + 1, i] += both[2, 1]
            system[3, j, i + 1] += both[1, 1]
            system[4, j, i] += both[1, 0]
            system[4, j, i + 1] += both[1, 2]
            system[5, j, i] += both[1, 1]
            _add_to_posts(own[9:13], j, i, -1.0, right)
            _add_to_posts(own[13:17], j, i, 1.0, noise)


@inner
def _add_to_posts(own, j, i, sign, out):
    """Add to the posts of a facet their shares of sums by 1, f, g, f·g."""
    out[j, i] += sign * (own[0] - own[1] - own[2] + own[3])
    out[j, i + 1] += sign * (own[1] - own[3])
    out[j + 1, i] += sign * (own[2] - own[3])
    out[j + 1, i + 1] += sign * own[3]


@kernel
def add_sensitivities(places, weights, ground, errors, sums):
    """Add squared sensitivities of an image's pixels to height, Σ p (a − ā)², by facet: those with the grey values of a
    surface, and those with errors of their coefficients, (2, rows − 1, columns − 1).

    See `add_heights`.
    """
    x, y, dx, dy, found = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(3)
    means, ratio = ground.means, ground.ratio
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            p = weights[r, c]
            if not p > 0.0:
                continue
            u, v = places[r, c, 0], places[r, c, 1]
            i, j = min(int(u), means.shape[1] - 1), min(int(v), means.shape[0] - 1)
            ku, kv = ratio * (places[r, c, 2] - means[j, i, 0]), ratio * (places[r, c, 3] - means[j, i, 1])
            grey_at(ground.values, u * ratio, v * ratio, x, y, dx, dy, found)
            a = found[1] * ku + found[2] * kv
            sums[0, j, i] += p * a * a
            grey_at(errors, u * ratio, v * ratio, x, y, dx, dy, found)
            a = found[1] * ku + found[2] * kv
            sums[1, j, i] += p * a * a


# Gradient of the curvature term.


@kernel
def curvature_gradient(weights, heights, out):
    """Half the gradient of the weighted sum of squared curvatures.

    Parameters
    ----------
    weights : ndarray, shape (3, rows, columns)
        Of curvatures along columns, rows and across, see `curvature`; 0 where not inside.
    heights, out : ndarray, shape (rows, columns)
        `out` is changed.
    """
    rows, columns = heights.shape
    out[:] = 0.0
    for j in range(rows):
        for i in range(1, columns - 1):
            part = weights[0, j, i] * (heights[j, i - 1] - 2.0 * heights[j, i] + heights[j, i + 1])
            out[j, i - 1] += part
            out[j, i] -= 2.0 * part
            out[j, i + 1] += part
    for j in range(1, rows - 1):
        for i in range(columns):
            part = weights[1, j, i] * (heights[j - 1, i] - 2.0 * heights[j, i] + heights[j + 1, i])
            out[j - 1, i] += part
            out[j, i] -= 2.0 * part
            out[j + 1, i] += part
    for j in range(rows - 1):
        for i in range(columns - 1):
            part = heights[j, i] - heights[j, i + 1] - heights[j + 1, i] + heights[j + 1, i + 1]
            part *= weights[2, j, i]
            out[j, i] += part
            out[j, i + 1] -= part
            out[j + 1, i] -= part
            out[j + 1, i + 1] += part


# Heights of a grid of facets by conjugate gradients, and their variances by band Cholesky factors of its parts.


#: Rows and columns between the posts of an entry: see `HEIGHT_OFFSETS`.
_DOWN, _ALONG = (0, 0, 0, 1, 1, 1, 2), (0, 1, 2, -1, 0, 1, 0)
#: Times by which the parts whose variances are computed at once are longer than wide.
_LONG = 12


@kernel
def add_curvatures(curve, out):
    """Add the normal equations of curvatures to those of the pixels, (7, rows, columns).

    `curve` has the weights of curvatures along columns, rows and across, (3, rows, columns), 0 where not inside.
    """
    for kind in range(3):
        count = 3 if kind < 2 else 4
        for row in range(curve.shape[1]):
            for col in range(curve.shape[2]):
                p = curve[kind, row, col]
                if not p > 0.0:
                    continue
                for k in range(count):
                    dj, di, a = curvature(kind, k)
                    for q in range(k, count):
                        ej, ei, b = curvature(kind, q)
                        down, along = ej - dj, ei - di
                        # (0, 0) (0, 1) (0, 2), (1, −1) (1, 0) (1, 1), (2, 0)
                        entry = along if down == 0 else (4 + along if down == 1 else 6)
                        out[entry, row + dj, col + di] += p * a * b


@inner
def curvature(kind, k):
    """Row and column from the middle, and factor, of the k-th post of a second difference: along, down, across."""
    if kind == 0:
        return 0, k - 1, -2.0 if k == 1 else 1.0
    if kind == 1:
        return k - 1, 0, -2.0 if k == 1 else 1.0
    return k // 2, k % 2, 1.0 if k == 0 or k == 3 else -1.0


@inner
def _factor(band, shares):
    """Cholesky factor in place: L is the lower triangle, stored as the band is. Three columns of zeros follow the
    band's own, as four rows are eliminated at once; `shares` is scratch of 4."""
    size, width = band.shape[0], band.shape[1] - 3
    for first in range(0, size, 4):
        several = min(4, size - first)
        for p in range(several):
            row = band[first + p]
            if not row[0] > 0.0:
                return False
            row[0] = np.sqrt(row[0])
            scale = 1.0 / row[0]
            for k in range(1, width):
                row[k] *= scale
            for q in range(p + 1, several):
                axpy(-row[q - p], row[q - p : width], band[first + q, : width - q + p])
        if several < 4:
            break
        a, b, c, d = band[first], band[first + 1], band[first + 2], band[first + 3]
        for k in range(4, min(width + 3, size - first)):
            count = width + 3 - k
            shares[0], shares[1], shares[2], shares[3] = -a[k], -b[k - 1], -c[k - 2], -d[k - 3]
            axpy_four(
                shares, a[k : k + count], b[k - 1 : k - 1 + count], c[k - 2 : k - 2 + count], d[k - 3 : k - 3 + count],
                band[first + k, :count],
            )  # fmt: skip
    return True


@inner
def _multiply_heights(system, x, y):
    """y = system · x."""
    rows, columns = x.shape
    y[:] = 0.0
    for j in range(rows):
        add_product(system[0, j], x[j], y[j])
        for k in range(1, 7):
            dj, di = _DOWN[k], _ALONG[k]
            if j + dj < rows:
                i0, i1 = max(0, -di), columns - max(0, di)
                part = system[k, j, i0:i1]
                add_product(part, x[j + dj, i0 + di : i1 + di], y[j, i0:i1])
                add_product(part, x[j, i0:i1], y[j + dj, i0 + di : i1 + di])


@maker
def _scale_to_unit_diagonal(system, scale, kind):
    """The same system with unknowns such that its diagonal is 1, which is left out, by rows: (rows, 6, columns)."""
    rows, columns = scale.shape
    out = np.zeros((rows, 6, columns), kind.dtype)
    for j in range(rows):
        for k in range(1, 7):
            dj, di = _DOWN[k], _ALONG[k]
            if j + dj < rows:
                for i in range(max(0, -di), columns - max(0, di)):
                    out[j, k - 1, i] = system[k, j, i] * scale[j, i] * scale[j + dj, i + di]
    return out


@inner
def _next_direction(system, share, residual, way, product, part):
    """way = residual + share · way, product = system · way of a scaled system; way · product."""
    rows, columns = way.shape
    total = 0.0
    for row in range(min(2, rows)):
        _next_direction_row(share, residual[row], way[row], product[row])
    for j in range(rows):
        if j + 2 < rows:
            _next_direction_row(share, residual[j + 2], way[j + 2], product[j + 2])
        for k in range(1, 7):
            dj, di = _DOWN[k], _ALONG[k]
            if j + dj < rows:
                i0, i1 = max(0, -di), columns - max(0, di)
                own, there = way[j, i0:i1], way[j + dj, i0 + di : i1 + di]
                here, other = product[j, i0:i1], product[j + dj, i0 + di : i1 + di]
                if dj == 0:
                    add_product(system[j, k - 1, i0:i1], there, here)
                    add_product(system[j, k - 1, i0:i1], own, other)
                else:
                    add_products(system[j, k - 1, i0:i1], there, own, here, other)
        total += dot(way[j : j + 1], product[j : j + 1], part)
    return total


@inner
def _next_direction_row(share, residual, way, product):
    """A row of what `_next_direction` begins with: the diagonal is 1."""
    for i in range(len(way)):
        way[i] = residual[i] + share * way[i]
        product[i] = way[i]


@kernel
def solve_heights(system, right, rounds, enough, out):
    """Heights' corrections by conjugate gradients, preconditioned by the diagonal.

    Parameters
    ----------
    system : ndarray, shape (7, rows, columns)
        Of pixels and curvatures, see `add_curvatures`.
    right : ndarray, shape (rows, columns)
    rounds, enough
        Iterations at most; they end when what is left of the equations has fallen to this part.
    out : ndarray, shape (rows, columns), float32 or float64
        Start and result; what it lacks is found with numbers of its kind.

    Returns
    -------
    int
        Iterations.
    """
    rows, columns = right.shape
    scale, left = np.empty((rows, columns)), np.empty((rows, columns))
    _multiply_heights(system, out, left)
    work = np.zeros((4, rows, columns), out.dtype)
    residual, way, product, more = work[0], work[1], work[2], work[3]
    first, before = 0.0, 1.0
    for j in range(rows):
        for i in range(columns):
            # What no equation knows stays.
            scale[j, i] = 1.0 / np.sqrt(system[0, j, i]) if system[0, j, i] > 0.0 else 0.0
            residual[j, i] = (right[j, i] - left[j, i]) * scale[j, i]
            first += (right[j, i] * scale[j, i]) ** 2
    part, system = np.empty(8, out.dtype), _scale_to_unit_diagonal(system, scale, out)
    size, k = dot(residual, residual, part), 0
    while k < rounds and size > enough * enough * first:
        curve = _next_direction(
            system, residual.dtype.type(0.0 if k == 0 else size / before), residual, way, product, part
        )
        if not curve > 0.0:
            break
        along = residual.dtype.type(size / curve)
        before, size, k = size, 0.0, k + 1
        for j in range(rows):
            axpy(along, way[j], more[j])
            axpy(-along, product[j], residual[j])
            size += dot(residual[j : j + 1], residual[j : j + 1], part)
    for j in range(rows):
        for i in range(columns):
            out[j, i] += scale[j, i] * more[j, i]
    return k


@inner
def _band_inverse(band, inverse, column, shares):
    """Entries of the inverse inside the band (Takahashi 1973): row n holds columns n − w … n + w. See `_factor`."""
    size, w = band.shape[0], band.shape[1] - 4
    for n in range(size - 1, -1, -1):
        below = min(w, size - 1 - n)
        out, scale = column[1 : below + 1], -1.0 / band[n, 0]
        out[:] = 0.0
        for q in range(1, below - 2, 4):
            for k in range(4):
                shares[k] = scale * band[n, q + k]
            i = w - q + 1
            axpy_four(
                shares, inverse[n + q, i : i + below], inverse[n + q + 1, i - 1 : i - 1 + below],
                inverse[n + q + 2, i - 2 : i - 2 + below], inverse[n + q + 3, i - 3 : i - 3 + below], out,
            )  # fmt: skip
        for q in range(below // 4 * 4 + 1, below + 1):
            axpy(scale * band[n, q], inverse[n + q, w - q + 1 : w - q + 1 + below], out)
        total = 1.0 / band[n, 0] ** 2
        for k in range(1, below + 1):
            inverse[n, w + k] = inverse[n + k, w - k] = column[k]
            total -= band[n, k] / band[n, 0] * column[k]
        inverse[n, w] = total


@kernel
def variances(system, side, margin, out):
    """Variances of heights, part by part, with `margin` posts around each beyond which nothing changes; NaN where a
    part is singular. Parts are `side` columns wide and _LONG times as many rows long: narrow bands take least.

    See `solve_heights`; `out` has shape (rows, columns).
    """
    rows, columns = out.shape
    length = _LONG * side
    wide = min(columns, side + 2 * margin)
    most = min(rows, length + 2 * margin) * wide
    bands, inverses = np.empty(most * (2 * wide + 4)), np.empty(most * (4 * wide + 1))
    column, shares = np.empty(2 * wide + 1), np.empty(4)
    for row in range(0, rows, length):
        for col in range(0, columns, side):
            j0, i0 = max(0, row - margin), max(0, col - margin)
            j1, i1 = min(rows, row + length + margin), min(columns, col + side + margin)
            n, m = j1 - j0, i1 - i0
            band = bands[: n * m * (2 * m + 4)].reshape(n * m, 2 * m + 4)
            inverse = inverses[: n * m * (4 * m + 1)].reshape(n * m, 4 * m + 1)
            band[:] = 0.0
            for j in range(n):
                for i in range(m):
                    for k in range(7):
                        if j + _DOWN[k] < n and 0 <= i + _ALONG[k] < m:
                            band[j * m + i, _DOWN[k] * m + _ALONG[k]] = system[k, j0 + j, i0 + i]
            done = _factor(band, shares)
            if done:
                _band_inverse(band, inverse, column, shares)
            for j in range(row, min(rows, row + length)):
                for i in range(col, min(columns, col + side)):
                    out[j, i] = inverse[(j - j0) * m + i - i0, 2 * m] if done else np.nan
