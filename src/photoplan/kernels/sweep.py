"""Images on planes of one height, compared cell by cell: the cost of a height at every post that may have it."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.jit import inner, kernel

#: Cells up and down, and left and right, with which the middle one is compared (9 × 7).
HALF_ROWS, HALF_COLUMNS = 3, 4
#: Pairs of images that a post compares at most.
MOST_PAIRS = 8


@inner
def _ones(bits):
    """How many bits are set."""
    x = bits - ((bits >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@kernel
def sample_plane(raw, at, step, wanted, out):
    """Grey values of an image in cells of a plane, bilinear.

    Parameters
    ----------
    raw : ndarray, shape (h, w), float32
        NaN where there are none.
    at : ndarray, shape (m, n, 2)
        Column and row of every `step`-th cell in it; NaN: behind the camera.
    step : int
    wanted : ndarray of bool, shape (rows, columns)
        Cells that are filled.
    out : ndarray, shape (rows, columns), float32
        NaN where the image has no value.
    """
    rows, columns = out.shape
    height, width = raw.shape
    for r in range(rows):
        j = min(r // step, at.shape[0] - 2)
        b = r / step - j
        for c in range(columns):
            out[r, c] = np.nan
            if not wanted[r, c]:
                continue
            i = min(c // step, at.shape[1] - 2)
            a = c / step - i
            x = (at[j, i, 0] * (1.0 - a) + at[j, i + 1, 0] * a) * (1.0 - b)
            x += (at[j + 1, i, 0] * (1.0 - a) + at[j + 1, i + 1, 0] * a) * b
            y = (at[j, i, 1] * (1.0 - a) + at[j, i + 1, 1] * a) * (1.0 - b)
            y += (at[j + 1, i, 1] * (1.0 - a) + at[j + 1, i + 1, 1] * a) * b
            if not (x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0):
                continue
            u, v = min(int(x), width - 2), min(int(y), height - 2)
            s, t = np.float32(x - u), np.float32(y - v)
            upper = raw[v, u] + s * (raw[v, u + 1] - raw[v, u])
            lower = raw[v + 1, u] + s * (raw[v + 1, u + 1] - raw[v + 1, u])
            out[r, c] = upper + t * (lower - upper)


@kernel
def describe(grey, wanted, out, known):
    """Which cells around each one are brighter than it (census transform, Zabih and Woodfill 1994).

    Parameters
    ----------
    grey : ndarray, shape (rows, columns), float32
        NaN where there is no value; such neighbours count as not brighter.
    wanted : ndarray of bool, the same shape
    out : ndarray of uint64, the same shape
        62 bits, in cells that are wanted.
    known : ndarray of bool, the same shape
        Filled: cells that have a value and whose neighbours are inside.
    """
    rows, columns = grey.shape
    for r in range(rows):
        for c in range(columns):
            known[r, c] = False
            if not wanted[r, c] or r < HALF_ROWS or r >= rows - HALF_ROWS:
                continue
            if c < HALF_COLUMNS or c >= columns - HALF_COLUMNS:
                continue
            middle = grey[r, c]
            if np.isnan(middle):
                continue
            bits = np.uint64(0)
            for j in range(r - HALF_ROWS, r + HALF_ROWS + 1):
                for i in range(c - HALF_COLUMNS, c + HALF_COLUMNS + 1):
                    bits = (bits << np.uint64(1)) | np.uint64(grey[j, i] > middle)
            out[r, c], known[r, c] = bits, True


@kernel
def add_costs(census, known, pairs, step, low, high, ratio, half, neutral, first, cost):
    """The cost of a plane at every post that may lie on it.

    Of each pair of images the mean share of bits that differ, over the cells around a post; the mean of the better half
    of the first `MOST_PAIRS` pairs that both see the post, since what hides a place from one image spoils the pairs
    that it is in.

    Parameters
    ----------
    census : ndarray, shape (images, rows · cells, columns · cells), uint64
    known : ndarray of bool, the same shape
    pairs : ndarray, shape (n, 2), int64
        Images that may be compared, the best to compare first.
    step : int
        Number of the plane.
    low, high : ndarray, shape (rows, columns), int64
        First step of each post, and the one after its last.
    ratio, half : int
        Cells along a facet, and around a post that are compared.
    neutral : float
        Cost where no two images are known.
    first : ndarray
        See `semi_global.sum_paths`.
    cost : ndarray, shape (n,), float32
        Filled where posts may lie on the plane.
    """
    rows, columns = low.shape
    means = np.empty(MOST_PAIRS)
    for j in range(rows):
        for i in range(columns):
            if step < low[j, i] or step >= high[j, i]:
                continue
            top, bottom = max(j * ratio - half, 0), min(j * ratio + half + 1, census.shape[1])
            left, right = max(i * ratio - half, 0), min(i * ratio + half + 1, census.shape[2])
            number = 0
            for p in range(len(pairs)):
                if number == MOST_PAIRS:
                    break
                one, other = pairs[p, 0], pairs[p, 1]
                total, count = 0, 0
                for r in range(top, bottom):
                    for c in range(left, right):
                        if known[one, r, c] and known[other, r, c]:
                            total += _ones(census[one, r, c] ^ census[other, r, c])
                            count += 1
                if 2 * count <= (bottom - top) * (right - left):
                    continue
                mean = total / (62.0 * count)
                n = number
                while n > 0 and means[n - 1] > mean:
                    means[n] = means[n - 1]
                    n -= 1
                means[n] = mean
                number += 1
            value = neutral
            if number > 0:
                better = (number + 1) // 2
                value = 0.0
                for n in range(better):
                    value += means[n] / better
            cost[first[j * columns + i] + step - low[j, i]] = value
