"""Equations of grey facets from the pixels of all images.

Pixels are sorted by facets first, so that the 116 sums of a facet stay where the processor has them at once: of the ten
pairs of its rows of coefficients with the ten of its columns, and of the right-hand sides.
"""

from __future__ import annotations

import numpy as np

from photoplan.kernels import numba_facets, numba_parts
from photoplan.kernels.facets_rows import add_row
from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.numba_facets import PAIRS

PAD = 2
"""Coefficients before the first and behind the last post."""
OFFSETS = 25
"""Entries of the system."""
#: Sums of a facet: see `_sum_of`; and facets side by side whose sums are held before they are added to the system, in
#: rows that are this much longer, as rows a multiple of 4 KiB apart are in each other's way.
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
def _sum_of(k, q):
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
            sums[_sum_of(k, q)] += np.float32(part * x[PAIRS[q][0]] * x[PAIRS[q][1]])
    for b in range(4):
        for a in range(4):
            sums[100 + 4 * b + a] += np.float32(p * value * y[b] * x[a])


add_pixel = numba_facets.add_pixel if numba_parts.USABLE else add_pixel_loops


@kernel
def count_pixels(places, weights, ratio, counts):
    """Count the pixels of an image in each grey facet.

    Parameters
    ----------
    places : ndarray, shape (h, w, 4)
        See `facets_transfer.transfer`.
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
            a, di, own = PAIRS[q][0], PAIRS[q][1] - PAIRS[q][0], sums[_sum_of(k, q), :count]
            add_row(own, system[row + b, 7 * dj + di, column + a : column + a + count])
            if dj > 0 and di > 0:
                add_row(own, system[row + b, 7 * dj - di, column + a + di : column + a + di + count])
    for b in range(4):
        for a in range(4):
            add_row(sums[100 + 4 * b + a, :count], right[row + b, column + a : column + a + count])
