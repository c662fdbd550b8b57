"""Radiometric transfer from a grey surface to images: an offset and a factor that change slowly over the surface."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.facets_rows import add_share
from photoplan.kernels.jit import inner, kernel

#: Shares of two nodes, 1 − a and a, by powers of a; and products of two of them, by how many are of the second.
_ONE = np.array([[1.0, -1.0], [0.0, 1.0]])
_TWO = np.array([[1.0, -2.0, 1.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]])


@inner
def _cell(places, r, c, lattice, rows, columns, share, index):
    """Shares and numbers of the four nodes of the lattice around a pixel's place."""
    x = min(max((places[r, c, 0] - lattice[0]) * (1.0 / lattice[2]), 0.0), columns - 1.0)
    y = min(max((places[r, c, 1] - lattice[1]) * (1.0 / lattice[2]), 0.0), rows - 1.0)
    i, j = min(int(x), columns - 2), min(int(y), rows - 2)
    a, b = x - i, y - j
    for k in range(4):
        index[k] = (j + k // 2) * columns + i + k % 2
        share[k] = (a if k % 2 else 1.0 - a) * (b if k // 2 else 1.0 - b)


@kernel
def transferred(places, raw, offsets, gains, lattice, out):
    """Grey values of an image in the system of the surface: (g − offset) / gain at each pixel's place; NaN stays.

    Parameters
    ----------
    places : ndarray, shape (h, w, 4)
        See `facets_transfer.transfer`.
    raw, out : ndarray, shape (h, w), float32
    offsets, gains : ndarray, shape (rows, columns)
        At the nodes of a lattice.
    lattice : (float, float, float)
        Column and row of the posts at its first node, and its pitch.
    """
    rows, columns = offsets.shape
    share, index = np.empty(4), np.empty(4, np.int64)
    first, second = offsets.reshape(-1), gains.reshape(-1)
    for r in range(raw.shape[0]):
        for c in range(raw.shape[1]):
            out[r, c] = np.nan
            if np.isnan(places[r, c, 0]) or np.isnan(raw[r, c]):
                continue
            _cell(places, r, c, lattice, rows, columns, share, index)
            offset, gain = 0.0, 0.0
            for k in range(4):
                offset += share[k] * first[index[k]]
                gain += share[k] * second[index[k]]
            out[r, c] = (raw[r, c] - offset) / gain


@kernel
def add_radiometry(places, raw, weights, surface, shape, lattice, system, right):
    """Add equations g = offset + gain · G of an image's pixels.

    Parameters
    ----------
    places, raw, lattice
        See `transferred`.
    weights, surface : ndarray, shape (h, w), float32
        Weights, and grey values of the surface at the pixels' places.
    shape : (int, int)
        Rows and columns of the lattice.
    system, right : ndarray, shape (2n, 2n) and (2n,)
        Unknowns: offsets of all n nodes, then gains.
    """
    rows, columns = shape
    share, index = np.empty(4), np.empty(4, np.int64)
    # Σ p · a^i · b^j · (1, G, G²), Σ p · g · a^i · b^j · (1, G) of pixels in a cell: all follows from them.
    both, single, before = np.zeros((3, 3, 3)), np.zeros((2, 2, 2)), -1
    for r in range(raw.shape[0]):
        for c in range(raw.shape[1]):
            p = weights[r, c]
            if not p > 0.0:
                continue
            _cell(places, r, c, lattice, rows, columns, share, index)
            if index[0] != before:
                if before >= 0:
                    _add_cell(before, rows, columns, both, single, system, right)
                before = index[0]
            a, b = share[1] + share[3], share[2] + share[3]
            G, g = surface[r, c], raw[r, c]
            for j in range(3):
                q = p
                for i in range(3):
                    both[j, i, 0] += q
                    both[j, i, 1] += q * G
                    both[j, i, 2] += q * G * G
                    q *= a
                if j < 2:
                    single[j, 0, 0] += p * g
                    single[j, 0, 1] += p * g * G
                    single[j, 1, 0] += p * a * g
                    single[j, 1, 1] += p * a * g * G
                p *= b
    if before >= 0:
        _add_cell(before, rows, columns, both, single, system, right)


@inner
def _add_cell(first, rows, columns, both, single, system, right):
    """Add the sums of a cell, whose upper left node is number `first`, to the equations, and empty them."""
    n = rows * columns
    for k in range(4):
        to = first + k // 2 * columns + k % 2
        for j in range(2):
            for i in range(2):
                part = _ONE[k // 2, j] * _ONE[k % 2, i]
                right[to] += part * single[j, i, 0]
                right[n + to] += part * single[j, i, 1]
        for q in range(4):
            other = first + q // 2 * columns + q % 2
            for j in range(3):
                for i in range(3):
                    part = _TWO[k // 2 + q // 2, j] * _TWO[k % 2 + q % 2, i]
                    system[to, other] += part * both[j, i, 0]
                    system[to, n + other] += part * both[j, i, 1]
                    system[n + to, other] += part * both[j, i, 1]
                    system[n + to, n + other] += part * both[j, i, 2]
    both[:] = 0.0
    single[:] = 0.0


@kernel
def solve_radiometry(system, right):
    """Solve with a full positive matrix, in place: its upper triangle becomes its Cholesky factor, `right`
    the solution.

    Libraries use threads of their own for this, which stand in each other's way in the workers of a run.
    """
    n = len(right)
    for k in range(n):
        system[k, k] = np.sqrt(system[k, k])
        scale = 1.0 / system[k, k]
        for j in range(k + 1, n):
            system[k, j] *= scale
        for j in range(k + 1, n):
            if system[k, j] != 0.0:
                add_share(-system[k, j], system[k, j:], system[j, j:])
    for k in range(n):
        right[k] /= system[k, k]
        add_share(-right[k], system[k, k + 1 :], right[k + 1 :])
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            right[k] -= system[k, j] * right[j]
        right[k] /= system[k, k]
