"""Normal equations of height facets, grey values eliminated, and of their curvatures.

The grey value of the surface is determined by all images that see a place, so that what is left of an image's equation
g = G + a·dZ is the difference of its sensitivity a to the mean of all images: S = Σ p (a − ā)² φ φᵀ (Schlüter 2001,
eq. 1). A system is kept by offsets of rows and columns: see `OFFSETS`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from photoplan.kernels.facets_grey import grey_at
from photoplan.kernels.facets_signs import sign_at
from photoplan.kernels.jit import inner, kernel

#: Rows and columns between the two posts of an entry.
OFFSETS = ((0, 0), (0, 1), (0, 2), (1, -1), (1, 0), (1, 1), (2, 0))
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
    """Shape (h, w, 4): see `facets_transfer.transfer`."""
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
            error = a * np.sqrt(p) * sign_at(pixels.first[0] + c, pixels.first[1] + r)
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
def made_heights(moments, system, right, noise):
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
            _add_shares(own[9:13], j, i, -1.0, right)
            _add_shares(own[13:17], j, i, 1.0, noise)


@inner
def _add_shares(own, j, i, sign, out):
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
