"""Normal equations of height facets, grey values eliminated, and of their curvatures.

The grey value of the surface is determined by all images that see a place, so that what is left of an image's equation
g = G + a·dZ is the difference of its sensitivity a to the mean of all images: S = Σ p (a − ā)² φ φᵀ (Schlüter 2001,
eq. 1). A system is kept by offsets of rows and columns: see `OFFSETS`.
"""

from __future__ import annotations

import numpy as np

from photoplan.kernels.facets_grey import grey_at
from photoplan.kernels.facets_signs import sign_at
from photoplan.kernels.jit import kernel

#: Rows and columns between the two posts of an entry.
OFFSETS = ((0, 0), (0, 1), (0, 2), (1, -1), (1, 0), (1, 1), (2, 0))


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
def add_heights(
    first, places, grey, weights, values, ratio, means, sigma, limit, trusted, system, right, noise, residuals,
    factors, sums,
):  # fmt: skip
    """Add the equations of an image to the normal equations of the heights; residuals and robust factors.

    Parameters
    ----------
    first : (int, int)
        Column and row of the first pixel in its image: errors are drawn the same way whatever window is looked at.
    places, grey, weights
        See `facets_grey.add_grey`.
    values, ratio
        Coefficients of the grey facets, and how many lie along a side of a height facet.
    means : ndarray, shape (rows − 1, columns − 1, 2)
        Mean change of place with height of the pixels of all images in a facet.
    sigma, limit : float
        Standard deviation of the grey values, and the multiple of it from which weights fall (Huber 1964).
    trusted : ndarray of bool, shape (rows, columns)
        Posts around which pixels count in `sums`.
    system : ndarray, shape (7, rows, columns); right, noise : ndarray, shape (rows, columns)
        Normal equations; and a right-hand side of independent errors of the pixels, one standard deviation each.
    residuals, factors : ndarray, shape (h, w), float32
        Grey value of the surface less that of the pixel (NaN: no pixel), and the robust factor of its weight.
    sums : ndarray, shape (3,)
        Added: Σ f, Σ f (v/σ)², pixels.
    """
    x, y, dx, dy, found = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(3)
    phi = np.empty(4)
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            p = weights[r, c]
            residuals[r, c] = np.nan
            if not p > 0.0:
                continue
            u, v = places[r, c, 0], places[r, c, 1]
            grey_at(values, u * ratio, v * ratio, x, y, dx, dy, found)
            misfit = found[0] - grey[r, c]
            size = abs(misfit) / sigma
            factor = 1.0 if size <= limit else limit / size
            residuals[r, c], factors[r, c] = misfit, factor
            if trusted[int(v + 0.5), int(u + 0.5)]:
                sums[0] += factor
                sums[1] += factor * size * size
                sums[2] += 1.0
            i, j = min(int(u), means.shape[1] - 1), min(int(v), means.shape[0] - 1)
            a = ratio * (found[1] * (places[r, c, 2] - means[j, i, 0]) + found[2] * (places[r, c, 3] - means[j, i, 1]))
            f, g = u - i, v - j
            phi[0], phi[1], phi[2], phi[3] = (1 - f) * (1 - g), f * (1 - g), (1 - f) * g, f * g
            pa = p * a
            error = a * np.sqrt(p) * sign_at(first[0] + c, first[1] + r)
            for k in range(4):
                right[j + k // 2, i + k % 2] -= pa * phi[k] * misfit
                noise[j + k // 2, i + k % 2] += phi[k] * error
            paa = pa * a
            system[0, j, i] += paa * phi[0] * phi[0]
            system[0, j, i + 1] += paa * phi[1] * phi[1]
            system[0, j + 1, i] += paa * phi[2] * phi[2]
            system[0, j + 1, i + 1] += paa * phi[3] * phi[3]
            system[1, j, i] += paa * phi[0] * phi[1]
            system[1, j + 1, i] += paa * phi[2] * phi[3]
            system[3, j, i + 1] += paa * phi[1] * phi[2]
            system[4, j, i] += paa * phi[0] * phi[2]
            system[4, j, i + 1] += paa * phi[1] * phi[3]
            system[5, j, i] += paa * phi[0] * phi[3]


@kernel
def add_sensitivities(places, weights, values, ratio, means, sums):
    """Add squared sensitivities of an image's pixels to height, Σ p (a − ā)², by facet: (rows − 1, columns − 1).

    See `add_heights`.
    """
    x, y, dx, dy, found = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(3)
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            p = weights[r, c]
            if not p > 0.0:
                continue
            u, v = places[r, c, 0], places[r, c, 1]
            grey_at(values, u * ratio, v * ratio, x, y, dx, dy, found)
            i, j = min(int(u), sums.shape[1] - 1), min(int(v), sums.shape[0] - 1)
            a = ratio * (found[1] * (places[r, c, 2] - means[j, i, 0]) + found[2] * (places[r, c, 3] - means[j, i, 1]))
            sums[j, i] += p * a * a
