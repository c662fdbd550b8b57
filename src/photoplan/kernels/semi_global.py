"""Costs of heights summed along eight paths, so that neighbours have like heights (Hirschmüller 2008, eq. 13 and 14).

Every post has its own run of steps, from `low[j, i]` on: their costs are those from `first[j, i]` to
`first[j, i + 1]` of one long row, so that the memory is that of the steps that are searched.
"""

from __future__ import annotations

import numpy as np

from photoplan.kernels.jit import inner, kernel


@inner
def _follow(cost, at, count, low, path, before, steps, low_before, small, large, total):
    """The path's costs at a post from those at the post before it, written and added to `total`."""
    least = path[before]
    for k in range(1, steps):
        least = min(least, path[before + k])
    shift = low - low_before
    for k in range(count):
        n = k + shift
        best = least + large
        if n >= 0 and n < steps:
            best = min(best, path[before + n])
        if n >= 1 and n <= steps:
            best = min(best, path[before + n - 1] + small)
        if n >= -1 and n < steps - 1:
            best = min(best, path[before + n + 1] + small)
        path[at + k] = cost[at + k] + best - least
        total[at + k] += path[at + k]


@kernel
def sum_paths(cost, first, low, small, large, path, total):
    """Add the costs along eight paths to every post.

    Parameters
    ----------
    cost : ndarray, shape (n,), float32
    first : ndarray, shape (rows · columns + 1,), int64
        Where the costs of each post begin, row by row.
    low : ndarray, shape (rows, columns), int64
        First step of each post.
    small, large : float
        What going on to the next step costs, and to any other one.
    path : ndarray, shape (n,), float32
        Scratch.
    total : ndarray, shape (n,), float32
        Added.
    """
    rows, columns = low.shape
    for way in range(8):
        dj, di = 0, 1
        if way == 1:
            dj, di = 0, -1
        elif way > 1:
            dj, di = (1 if way < 5 else -1), (way - 2) % 3 - 1
        for a in range(rows):
            j = a if dj >= 0 else rows - 1 - a
            for b in range(columns):
                i = b if di >= 0 else columns - 1 - b
                here = j * columns + i
                at = first[here]
                count = first[here + 1] - at
                m, n = j - dj, i - di
                if m < 0 or n < 0 or m >= rows or n >= columns:
                    for k in range(count):
                        path[at + k] = cost[at + k]
                        total[at + k] += cost[at + k]
                    continue
                other = m * columns + n
                _follow(
                    cost, at, count, low[j, i], path, first[other], first[other + 1] - first[other], low[m, n],
                    small, large, total,
                )  # fmt: skip


@kernel
def choose(total, first, low, apart, steps, margin):
    """The step of least cost at every post, and by how much the next one costs more.

    Parameters
    ----------
    total, first, low
        See `sum_paths`.
    apart : int
        Steps next to the best one that are not another choice.
    steps : ndarray, shape (rows, columns)
        Filled: the step, with the vertex of the parabola through the costs around it.
    margin : ndarray, shape (rows, columns)
        Filled: least cost of another choice less that of the best one; 0 where there is no choice, or where the best
        step is the first or last one of several.
    """
    rows, columns = low.shape
    for j in range(rows):
        for i in range(columns):
            at = first[j * columns + i]
            count = first[j * columns + i + 1] - at
            best = 0
            for k in range(1, count):
                if total[at + k] < total[at + best]:
                    best = k
            steps[j, i], margin[j, i] = low[j, i] + best, 0.0
            if best == 0 or best == count - 1:
                continue
            below, least, above = total[at + best - 1], total[at + best], total[at + best + 1]
            bend = below + above - 2.0 * least
            if bend > 0.0:
                steps[j, i] += 0.5 * (below - above) / bend
            other = np.inf
            for k in range(count):
                if abs(k - best) > apart:
                    other = min(other, total[at + k])
            margin[j, i] = other - least if other < np.inf else bend


@kernel
def scatter(total, first, low, steps, scale, faint, kept_low, kept_high, out):
    """How far other choices lie from the best ones, by their costs: Σ p (k − best)² over Σ p, p = exp(−ΔS / scale).

    Parameters
    ----------
    total, first, low
        See `sum_paths`.
    steps : ndarray, shape (rows, columns)
        See `choose`.
    scale : float
        Difference of costs that counts as one unit of the exponent.
    faint : float
        p from which on choices count.
    kept_low, kept_high : ndarray, shape (rows, columns)
        Steps from the first to the second one do not count: they are one choice, or still to be chosen from.
    out : ndarray, shape (rows, columns)
        Filled, steps².
    """
    rows, columns = low.shape
    for j in range(rows):
        for i in range(columns):
            at = first[j * columns + i]
            count = first[j * columns + i + 1] - at
            least = total[at]
            for k in range(1, count):
                least = min(least, total[at + k])
            whole, sums = 0.0, 0.0
            for k in range(count):
                step = low[j, i] + k
                p = np.exp((least - total[at + k]) / scale)
                whole += p
                if p >= faint and (step < kept_low[j, i] or step > kept_high[j, i]):
                    sums += p * (step - steps[j, i]) ** 2
            out[j, i] = sums / max(whole, 1.0)
