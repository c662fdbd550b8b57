"""One factor for each image and band from ratios of means (Behr 1989, section 6.3.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import lsqr

from photoplan.radiometry.cells import Cells, neighbours

_Floats = NDArray[np.float64]


def factors(cells: Cells, images: int, parts: NDArray[np.int64], fixed: int | None = None) -> _Floats:
    """Factors by which images agree, (images, bands).

    For two images, the second of which is fixed, the factor of the first is f = 1/n Σ M₂ₖ / M₁ₖ, with the means M of
    both in n cells. For more images the logarithms of the factors of all pairs are adjusted, each with the weight n.

    Parameters
    ----------
    cells : Cells
        That more than one image shows.
    images : int
    parts : ndarray, shape (images,)
        Images of one number hang together; in each part the factors have the geometric mean 1.
    fixed : int, optional
        The image whose factor is 1 instead.
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
    found = np.stack([lsqr(A, band, atol=1e-12, btol=1e-12)[0] for band in y.T], axis=1)
    for part in np.unique(parts):
        members = np.flatnonzero(parts == part)
        found[members] -= found[fixed] if fixed in members else found[members].mean(axis=0)
    return np.asarray(np.exp(found))
