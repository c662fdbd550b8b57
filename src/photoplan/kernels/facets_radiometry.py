"""Radiometric transfer from a grey surface to images: an offset and a factor that change slowly over the surface."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.facets_rows import add_share
from photoplan.kernels.jit import inner, kernel


@inner
def _cell(places, r, c, lattice, rows, columns, share, index):
    """Shares and numbers of the four nodes of the lattice around a pixel's place."""
    x = min(max((places[r, c, 0] - lattice[0]) / lattice[2], 0.0), columns - 1.0)
    y = min(max((places[r, c, 1] - lattice[1]) / lattice[2], 0.0), rows - 1.0)
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
    n = rows * columns
    share, index = np.empty(4), np.empty(4, np.int64)
    for r in range(raw.shape[0]):
        for c in range(raw.shape[1]):
            p = weights[r, c]
            if not p > 0.0:
                continue
            _cell(places, r, c, lattice, rows, columns, share, index)
            g = surface[r, c]
            for k in range(4):
                right[index[k]] += p * share[k] * raw[r, c]
                right[n + index[k]] += p * share[k] * g * raw[r, c]
                for q in range(4):
                    both = p * share[k] * share[q]
                    system[index[k], index[q]] += both
                    system[index[k], n + index[q]] += both * g
                    system[n + index[k], index[q]] += both * g
                    system[n + index[k], n + index[q]] += both * g * g


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
