"""Selected entries of the inverse, and variances from them, against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from photoplan.kernels.sparse_inverse import align_factor, fill_pattern, selected_inverse


def sparse_positive(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    A = sparse.random(n, n, 0.08, random_state=rng).toarray()
    return A @ A.T + np.diag(rng.uniform(1, 2, n))


def ldl(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    C = np.linalg.cholesky(S)
    d = np.diag(C)
    return C / d, d**2


@pytest.mark.parametrize("seed", range(4))
def test_selected_inverse_equals_the_dense_one_on_its_pattern(seed: int) -> None:
    S = sparse_positive(40, seed)
    L, D = ldl(S)
    lower = sparse.csc_matrix(np.tril(S, -1))
    pointer, rows = fill_pattern(lower.indptr.astype(np.int64), lower.indices.astype(np.int64))
    dense = np.zeros_like(S, bool)
    for j in range(len(S)):
        dense[rows[pointer[j] : pointer[j + 1]], j] = True
    assert dense[np.abs(np.tril(L, -1)) > 1e-12].all(), "the pattern holds all of L"
    assert dense.sum() < 40 * 39 / 2, "and is no full triangle"
    factor = sparse.csc_matrix(np.where(np.abs(L) > 1e-14, L, 0.0))
    values = align_factor(
        pointer, rows, factor.indptr.astype(np.int64), factor.indices.astype(np.int64), factor.data.astype(float)
    )
    diagonal, off = selected_inverse(pointer, rows, values, D)
    inverse = np.linalg.inv(S)
    np.testing.assert_allclose(diagonal, np.diag(inverse), rtol=1e-10)
    column = np.repeat(np.arange(len(S)), np.diff(pointer))
    np.testing.assert_allclose(off, inverse[rows, column], atol=1e-12)
