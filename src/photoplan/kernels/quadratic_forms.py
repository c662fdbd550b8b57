"""Variances of linear functions of the unknowns of a bundle adjustment, from selected entries of the inverse."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from photoplan.kernels.jit import kernel
from photoplan.kernels.selected_inverse import lookup


class SparseRows(NamedTuple):
    """Rows of a sparse matrix (CSR)."""

    pointer: Any
    columns: Any
    values: Any


@kernel
def gathered(Q, unknowns):
    """Dense part of a `SelectedInverse` at `unknowns` (m,), shape (m, m)."""
    m = len(unknowns)
    out = np.empty((m, m))
    for a in range(m):
        for b in range(a + 1):
            out[a, b] = out[b, a] = lookup(Q, unknowns[a], unknowns[b])
    return out


@kernel
def row_variances(Q, A, chosen):
    """a Q aᵀ of the rows `chosen` of `SparseRows` A, shape (len(chosen),)."""
    out = np.zeros(len(chosen))
    for r in range(len(chosen)):
        begin, end = A.pointer[chosen[r]], A.pointer[chosen[r] + 1]
        for a in range(begin, end):
            for b in range(begin, end):
                out[r] += A.values[a] * A.values[b] * lookup(Q, A.columns[a], A.columns[b])
    return out


@kernel
def point_variances(Q, A, P, row_pointer, row_index, V_inverse):
    """Covariance of every point and the variance that the unknowns give to each of its rows.

    With the unknowns of a point eliminated, its change is −V⁻¹ (N_pg dx_g − …), so that
    Q_pp = V⁻¹ + C Q C ᵀ with C = V⁻¹ N_pg, and a row a = (a_g, a_p) has
    a Q aᵀ = (a_g − a_p C) Q (a_g − a_p C)ᵀ + a_p V⁻¹ a_pᵀ.

    Parameters
    ----------
    Q : SelectedInverse
        Of the reduced normal equations.
    A : SparseRows
        The rows' part on unknowns that are not points.
    P : float64 array, shape (rows, 3)
        The rows' part on their point.
    row_pointer, row_index : int64 arrays
        Rows of each point.
    V_inverse : float64 array, shape (points, 3, 3)

    Returns
    -------
    covariance : float64 array, shape (points, 3, 3)
    variance : float64 array, shape (rows,)
    """
    m = len(row_pointer) - 1
    covariance = np.empty((m, 3, 3))
    variance = np.zeros(len(P))
    mark = np.full(len(Q.order), -1, np.int64)
    union = np.empty(len(Q.order), np.int64)
    for p in range(m):
        count = 0
        for q in range(row_pointer[p], row_pointer[p + 1]):
            for a in range(A.pointer[row_index[q]], A.pointer[row_index[q] + 1]):
                if mark[A.columns[a]] < 0:
                    mark[A.columns[a]] = count
                    union[count] = A.columns[a]
                    count += 1
        dense = gathered(Q, union[:count])
        N = np.zeros((3, count))
        for q in range(row_pointer[p], row_pointer[p + 1]):
            r = row_index[q]
            for a in range(A.pointer[r], A.pointer[r + 1]):
                column = mark[A.columns[a]]
                for k in range(3):
                    N[k, column] += P[r, k] * A.values[a]
        C = V_inverse[p] @ N
        QC = dense @ np.ascontiguousarray(C.T)
        own = C @ QC
        for i in range(3):
            for k in range(3):
                covariance[p, i, k] = V_inverse[p, i, k] + own[i, k]
        for q in range(row_pointer[p], row_pointer[p + 1]):
            r = row_index[q]
            # (a_g − a_p C) Q (a_g − a_p C)ᵀ in parts: the first is sparse, the others are small.
            value = 0.0
            begin, end = A.pointer[r], A.pointer[r + 1]
            for a in range(begin, end):
                i = mark[A.columns[a]]
                for b in range(begin, end):
                    value += A.values[a] * A.values[b] * dense[i, mark[A.columns[b]]]
                for k in range(3):
                    value -= 2.0 * A.values[a] * QC[i, k] * P[r, k]
            for k in range(3):
                for n in range(3):
                    value += P[r, k] * P[r, n] * covariance[p, k, n]
            variance[r] = value
        for a in range(count):
            mark[union[a]] = -1
    return covariance, variance
