"""One factor for each image and band from ratios of means (Behr 1989, section 6.3.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, hstack
from scipy.sparse.linalg import lsqr

from photoplan.radiometry.cells import Cells, neighbours
from photoplan.radiometry.priors import GROUND

_Floats = NDArray[np.float64]

#: Initial standard deviations of exposures and of the factor of a pair, parts of the brightness; what they count as.
_FIRST, _COUNTS = (0.10, 0.01), 2.0
#: Least standard deviations.
_LEAST = (0.01, 0.0005)
_ROUNDS = 30


def factors(
    cells: Cells,
    images: int,
    parts: NDArray[np.int64],
    fixed: int | None = None,
    middles: _Floats | None = None,
) -> _Floats:
    """Factors by which images agree, (images, bands).

    For two images, the second of which is fixed, the factor of the first is f = 1/n Σ M₂ₖ / M₁ₖ, with the means M of
    both in n cells. For more images the logarithms of the factors of all pairs are adjusted, each with the weight n.
    A slope of brightness that all images have would accumulate from pair to pair. It is an unknown of its own, with a
    standard deviation a priori; so is the exposure of each image, whose standard deviation comes from the overlaps.
    """
    mean = np.maximum(cells.levels.mean(axis=2, dtype=float), 1e-6)
    first, second = neighbours(cells)
    ordered = np.stack([cells.image[first], cells.image[second]], axis=1)
    pair, of, count = np.unique(ordered, axis=0, return_inverse=True, return_counts=True)
    total = np.zeros((len(pair), mean.shape[1]))
    np.add.at(total, of.reshape(-1), mean[second] / mean[first])
    if fixed is not None:
        # The formula is that of the image that is changed: the other way round where the first is fixed.
        away = np.zeros_like(total)
        np.add.at(away, of.reshape(-1), mean[first] / mean[second])
        total = np.where((pair[:, 0] == fixed)[:, None], count[:, None] ** 2 / away, total)
    root = np.sqrt(count)
    rows = np.repeat(np.arange(len(pair)), 2)
    A = csr_array((np.outer(root, [1.0, -1.0]).ravel(), (rows, pair.ravel())), shape=(len(pair), images))
    y = np.log(total / count[:, None]) * root[:, None]
    if images == 2:
        found = np.stack([lsqr(A, band, atol=1e-12, btol=1e-12)[0] for band in y.T], axis=1)
    else:
        away = np.zeros((images, 2)) if middles is None else middles
        whole = csr_array(hstack([A, csr_array(A @ away)]))
        found = np.stack([_adjusted(whole, band, images) for band in y.T], axis=1)
    for part in np.unique(parts):
        members = np.flatnonzero(parts == part)
        found[members] -= found[fixed] if fixed in members else found[members].mean(axis=0)
    return np.asarray(np.exp(found))


def _adjusted(A: csr_array, y: _Floats, images: int) -> _Floats:
    """Logarithms of the factors (images,) with prior and variance components; rows of A have the pairs' weights."""
    # Both variance components by expectation and maximisation, with the whole inverse: its unknowns are few.
    exposure, pair = _FIRST
    scale = float(np.sqrt(A[:, :images].power(2).sum() / (2 * len(y))))
    N, g = (A.T @ A).toarray(), A.T @ y
    x = np.zeros(N.shape[0])
    for _ in range(_ROUNDS):
        known = np.r_[np.full(images, exposure**-2), np.full(2, GROUND**-2)]
        C = np.linalg.inv(N / (scale * pair) ** 2 + np.diag(known))
        x = C @ g / (scale * pair) ** 2
        left = float(np.square(y - A @ x).sum() + (N * C).sum()) / scale**2
        own = float(np.square(x[:images]).sum() + np.trace(C[:images, :images]))
        exposure = max(float(np.sqrt((_COUNTS * _FIRST[0] ** 2 + own) / (_COUNTS + images))), _LEAST[0])
        pair = max(float(np.sqrt((_COUNTS * _FIRST[1] ** 2 + left) / (_COUNTS + len(y)))), _LEAST[1])
    return x[:images]
