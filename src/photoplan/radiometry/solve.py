"""Normal equations of many images: sparse, since an image shares ground with its neighbours only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_array, diags
from scipy.sparse.linalg import SuperLU, splu

_Floats = NDArray[np.float64]

#: What is added to the diagonal, a part of it: conditions determine what equations leave open.
_RIDGE = 1e-9
#: Most turns of an iteration, and the part of a solution that its last one changes.
_TURNS, _LEFT = 60, 0.001


@dataclass(frozen=True, eq=False)
class Solved:
    """Equations N x = g, factored, under conditions H x = held."""

    factor: SuperLU
    H: _Floats
    back: _Floats
    """What fulfils the conditions if they lack one, N⁻¹ Hᵀ (H N⁻¹ Hᵀ)⁻¹."""

    @classmethod
    def of(cls, N: csr_array, H: _Floats) -> Solved:
        """Factor equations with a positive definite matrix."""
        whole = csc_matrix(N + diags(_RIDGE * N.diagonal()))
        # SciPy 1.11 factors matrices with places of 32 bits alone.
        whole.indices, whole.indptr = (each.astype(np.intc, copy=False) for each in (whole.indices, whole.indptr))
        # An order that fills little: a band would be as wide as the block, and its cost an image grow with that.
        factor = splu(whole, permc_spec="COLAMD", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        if not len(H):
            return cls(factor, H, H.T)
        W = factor.solve(np.ascontiguousarray(H.T))
        return cls(factor, H, np.linalg.solve(H @ W, W.T).T)

    def step(self, g: _Floats, missing: _Floats | float) -> _Floats:
        """Solutions for right sides (unknowns,) or (unknowns, k) that fulfil the conditions."""
        free = self.factor.solve(np.ascontiguousarray(g))
        return np.asarray(free + self.back @ (missing - self.H @ free)) if len(self.H) else np.asarray(free)

    def without(self, part: csr_array, whole: csr_array, g: _Floats) -> _Floats:
        """Solution of (whole − part) x = g under H x = 0, where `whole` are the equations that were factored.

        Conjugate gradients with the factored equations as preconditioner (Gould, Hribar & Nocedal 2001): the more the
        part had to say, the more turns.
        """
        x, left = np.zeros_like(g), g
        z = self.step(left, 0.0)
        way, size = z, float(left @ z)
        for _ in range(_TURNS):
            pushed = whole @ way - part @ way
            curve = float(way @ pushed)
            if not (curve > 0 and size > 0):
                break
            x, left = x + size / curve * way, left - size / curve * pushed
            if size / curve * np.linalg.norm(way) < _LEFT * np.linalg.norm(x):
                break
            z = self.step(left, 0.0)
            before, size = size, float(left @ z)
            way = z + size / before * way
        return x
