"""Accuracy of an adjusted block: standard deviations of its grey values, and how the pixels fit it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.geometry.grid import Window
from photoplan.kernels.facets import add_residuals, sample_grey, sample_slopes
from photoplan.matching.facets.block import FacetBlock
from photoplan.matching.facets.means import means_around, smoothed

_Floats = NDArray[np.float32]
_Doubles = NDArray[np.float64]

#: Grey values along a patch over which the errors that were drawn are averaged.
_PATCH = 17
#: Least part of the pixels around a post that are redundant.
_LEAST = 0.1
#: Root mean square of residuals up to which pixels fit: four standard deviations of it, of two images. Posts along the
#: surroundings in which heights are that a wrong one may have.
_FITS, _AROUND = 1.3, 9


def grey_places(block: FacetBlock, window: Window, margin: int) -> _Doubles:
    """Places of the grey values of a window, which begins `margin` posts inside a block, in columns and rows of its
    posts; shape (m · rows, m · columns, 2)."""
    m = block.facets.ratio
    part = (np.arange(m) + 0.5) / m - 0.5
    u, v = ((margin + np.arange(n)[:, None] + part).reshape(-1) for n in (window.width, window.height))
    return np.stack(np.meshgrid(u, v), axis=-1)


def grey_sigmas(block: FacetBlock, at: _Doubles, height_variances: _Doubles) -> _Floats:
    """Standard deviations of grey values at places (n, m, 2) of a grid.

    Errors of the pixels are drawn and carried through the normal equations: what comes out has the covariance of the
    grey facets. Its squares, in units of what the pixels around a place weigh, change slowly, so that one draw and
    means over patches are enough. An error dZ of the height shows a place that lies beside by k·dZ, with k the mean of
    the images.
    """
    assert block.texture is not None
    ratio, places = block.facets.ratio, at.reshape(-1, 2)
    drawn, known, before = (np.empty(len(places), np.float32) for _ in range(3))
    fields = block.texture.errors, smoothed(block.density), smoothed(block.texture.density)
    for out, values in zip((drawn, known, before), fields):
        sample_grey(values, ratio, places, out)
    least = np.float32(1e-3 * max(float(block.density.mean()), 1e-30))
    single = 1 / np.maximum(known.reshape(at.shape[:2]), least)
    times = means_around((drawn**2 * np.maximum(before, least)).reshape(at.shape[:2]), _PATCH)
    slopes = np.empty((len(places), 2), np.float32)
    sample_slopes(block.values, ratio, places, slopes)
    j, i = (
        np.clip(at[..., k].astype(int), 0, n - 2) for k, n in ((1, block.facets.shape[0]), (0, block.facets.shape[1]))
    )
    beside = (slopes.reshape(at.shape) * block.ways[j, i]).sum(axis=-1)
    return np.sqrt(times * single + beside**2 * height_variances).astype(np.float32)


def fit(block: FacetBlock) -> _Doubles:
    """Root mean square of the standardised residuals around each post, shape (rows, columns); NaN without pixels.

    1 is what is expected: squares are divided by the redundancy, what grey values and height take of the pixels.
    """
    sums = np.zeros((*block.facets.shape, 3))
    for sight, residuals in zip(block.sights, standardised(block)):
        add_residuals(sight.places, residuals, 1, sums)
    count, squares = means_around(sums[..., 0], 3), means_around(sums[..., 2], 3)
    free = np.maximum(count - block.facets.ratio**2 - 1, _LEAST * count)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sums[..., 0] > 0, np.sqrt(squares / free), np.nan)


def pixel_noise(raw: _Floats) -> float:
    """Standard deviation of the noise of pixels by themselves, from differences that slopes of grey values do not have
    (Immerkær 1996), robustly; 0 without pixels."""
    a = np.array([1.0, -2.0, 1.0])
    found = ndimage.convolve1d(ndimage.convolve1d(raw.astype(float), a, axis=0), a, axis=1)[1:-1, 1:-1]
    found = np.abs(found[np.isfinite(found)])
    return float(np.median(found)) / (0.6745 * 6.0) if found.size else 0.0


def edge_variances(block: FacetBlock) -> _Doubles:
    """Variances of heights beside edges, shape (rows, columns), m²; 0 elsewhere.

    Where neighbours part by more parallax than lies between them, not all images see the facet that joins them (a
    gradient of disparity above 1: Burt and Julesz 1980), so that nothing tells where on it the edge is: any of its
    heights may be that of either post.
    """
    out = np.zeros(block.facets.shape)
    for axis in (0, 1):
        jump = np.abs(np.diff(block.heights, axis=axis))
        jump = np.where(jump * block.scale > block.facets.ratio, jump, 0.0) ** 2 / 12
        before, after = [slice(None)] * 2, [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        for side in (tuple(before), tuple(after)):
            out[side] = np.maximum(out[side], jump)
    return out


def misfit_variances(block: FacetBlock, misfit: _Doubles) -> _Doubles:
    """Variances of heights around which pixels do not fit, shape (rows, columns), m²; 0 where they do.

    A height that is not where it should be may be any of those around it. How probable that is: the square of the part
    of the squared residuals that noise does not explain, as a little more of it tells little (noise differs from place
    to place). So a rounded edge says so, and a region that went wrong as far as there is relief in it.
    """
    wrong = (1.0 - (_FITS / np.maximum(np.nan_to_num(misfit), _FITS)) ** 2) ** 2
    around = ndimage.maximum_filter(block.heights, _AROUND) - ndimage.minimum_filter(block.heights, _AROUND)
    return np.asarray(wrong * around**2 / 12)


def residual_pictures(block: FacetBlock) -> list[_Floats]:
    """Mean standardised residual of each view's pixels in every grey value's cell, shape (m · rows, m · columns); NaN
    without pixels. The first cell is that of the first post less half a facet."""
    m, pictures = block.facets.ratio, []
    for sight, residuals in zip(block.sights, standardised(block)):
        sums = np.zeros((m * block.facets.shape[0], m * block.facets.shape[1], 3))
        add_residuals(sight.places, residuals, m, sums)
        with np.errstate(divide="ignore", invalid="ignore"):
            pictures.append((sums[..., 1] / sums[..., 0]).astype(np.float32))
    return pictures


def standardised(block: FacetBlock) -> list[_Floats]:
    """Residuals of every view's pixels, the surface's grey value less theirs, in their standard deviations; NaN: not
    used."""
    return [residuals / np.float32(sigma) for residuals, sigma in zip(block.residuals, block.sigmas)]
