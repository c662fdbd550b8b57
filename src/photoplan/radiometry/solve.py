"""Normal equations of many images: banded, since an image shares ground with its neighbours only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array, csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

_Floats = NDArray[np.float64]

#: What is added to the diagonal, a part of it: conditions determine what equations leave open.
_RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Solved:
    """Equations N x = g, factored, under conditions H x = held."""

    order: NDArray[np.int64]
    """Unknowns in the order in which N is banded."""
    factor: _Floats
    """Cholesky factor as bands."""
    H: _Floats
    W: _Floats
    """N⁻¹ Hᵀ."""

    @classmethod
    def of(cls, N: csr_array, H: _Floats, width: int) -> Solved:
        """Factor equations whose unknowns come in groups of `width`, one for each image."""
        entries = N.tocoo()
        images = N.shape[0] // width
        at = entries.row // width, entries.col // width
        joined = csr_matrix((np.ones(entries.nnz), at), shape=(images, images))
        near = reverse_cuthill_mckee(joined, symmetric_mode=True).astype(np.int64)
        order = (near[:, None] * width + np.arange(width)).ravel()
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        row, col = place[entries.row], place[entries.col]
        lower = row >= col
        bands = np.zeros((int((row - col).max()) + 1, len(order)))
        bands[(row - col)[lower], col[lower]] = entries.data[lower]
        bands[0] *= 1 + _RIDGE
        factor = cholesky_banded(bands, lower=True, overwrite_ab=True, check_finite=False)
        found = cls(order, factor, H, np.empty((len(order), 0)))
        return cls(order, factor, H, found._free(np.ascontiguousarray(H.T))) if len(H) else found

    def step(self, g: _Floats, missing: _Floats | float) -> _Floats:
        """Solutions for right sides (unknowns,) or (unknowns, k) that fulfil the conditions."""
        free = self._free(g)
        if not len(self.H):
            return free
        return np.asarray(free + self.W @ np.linalg.solve(self.H @ self.W, missing - self.H @ free))

    def _free(self, g: _Floats) -> _Floats:
        x = np.empty_like(g)
        x[self.order] = cho_solve_banded((self.factor, True), g[self.order], check_finite=False)
        return x
