"""Accuracy of least-squares matching where noise of neighbouring pixels is alike.

A fit takes its residuals e for white noise and gives σ² N⁻¹. With the autocovariance C of the noise, the variance of a
coordinate whose slopes, freed of what the other unknowns explain, are g, is larger by

    f² = Σ C(d) R(d) / (C(0) R(0)),   R(d) = Σ g(p) g(p + d)

summed over distances d (the middle part of the "sandwich" N⁻¹ JᵀCJ N⁻¹). C comes from the residuals of many patches,
each divided by its standard deviation. They lack what the unknowns have taken away: with the columns q of an
orthonormal basis of J and B(d) = Σ q(p) q(p + d), f² times Σ B R / n is added again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]

#: Distances at which noise may be alike, pixels.
REACH = 4
#: The noise that is expected counts as so many patches.
_EXPECTED = 10.0


def noise_factors(columns: _Floats, observed: _Floats, mask: NDArray[np.bool_], expected: _Floats) -> _Floats:
    """Factors f of the standard deviations of the first two unknowns of every patch, (n, 2)."""
    n, side, _, unknowns = columns.shape
    flat = (columns * mask[..., None]).reshape(n, -1, unknowns)
    q = np.linalg.qr(flat)[0]
    e = (observed * mask).reshape(n, -1)
    e = e - np.einsum("npk,nk->np", q, np.einsum("npk,np->nk", q, e))
    free = mask.sum() - unknowns
    e /= np.maximum(np.sqrt((e**2).sum(axis=1, keepdims=True) / free), 1e-12)
    pixels = _products(mask[None].astype(float))[0]
    along = np.correlate(expected, expected, "full") / (expected**2).sum()
    one = np.zeros(2 * REACH + 1)
    half = len(along) // 2
    one[REACH - half : REACH + half + 1] = along
    prior = _EXPECTED * pixels * np.outer(one, one).reshape(-1)
    C = (_products(e.reshape(n, side, side)).sum(axis=0) + prior) / ((n + _EXPECTED) * pixels)
    B = sum(_products(q[..., k].reshape(n, side, side)).sum(axis=0) for k in range(unknowns))
    B = B / ((n + _EXPECTED) * pixels)
    out = np.empty((n, 2))
    for axis in range(2):
        others = np.linalg.qr(np.delete(flat, axis, axis=2))[0]
        g = flat[..., axis] - np.einsum("npk,nk->np", others, np.einsum("npk,np->nk", others, flat[..., axis]))
        R = _products(g.reshape(n, side, side))
        R = R / np.maximum(R[:, [R.shape[1] // 2]], 1e-300)
        out[:, axis] = np.sqrt(np.maximum(R @ C, 0.0) / np.maximum(1.0 - R @ B, 0.2))
    return np.maximum(out, 1.0)


def _products(values: _Floats) -> _Floats:
    """Sums of products of pixels at distances up to `REACH`, row by row of distances, (n, (2 REACH + 1)²)."""
    size = values.shape[1] + REACH
    power = np.abs(np.fft.rfft2(values, (size, size))) ** 2
    near = np.arange(-REACH, REACH + 1)
    return np.asarray(np.fft.irfft2(power, (size, size))[:, near[:, None], near].reshape(len(values), -1))
