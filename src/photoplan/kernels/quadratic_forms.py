"""Variances of linear functions of the unknowns of a bundle adjustment, from selected entries of the inverse."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.jit import kernel
from photoplan.kernels.selected_inverse import lookup

__all__ = ["gathered", "point_variances", "row_variances"]


@kernel
def gathered(pointer, rows, diagonal, lower, index):
    """Dense part of the selected inverse at `index` (m,) (numbers in the order of elimination), shape (m, m)."""
    m = len(index)
    out = np.empty((m, m))
    for a in range(m):
        for b in range(a + 1):
            out[a, b] = out[b, a] = lookup(pointer, rows, diagonal, lower, index[a], index[b])
    return out


@kernel
def row_variances(pointer, rows, diagonal, lower, order, A_pointer, A_columns, A_values, chosen):
    """a Q aᵀ of rows `chosen` of a sparse matrix (CSR), shape (len(chosen),); `order` numbers its columns."""
    out = np.zeros(len(chosen))
    for r in range(len(chosen)):
        begin, end = A_pointer[chosen[r]], A_pointer[chosen[r] + 1]
        for a in range(begin, end):
            i = order[A_columns[a]]
            out[r] += A_values[a] ** 2 * diagonal[i]
            for b in range(begin, a):
                z = lookup(pointer, rows, diagonal, lower, i, order[A_columns[b]])
                out[r] += 2.0 * A_values[a] * A_values[b] * z
    return out


@kernel
def point_variances(
    pointer, rows, diagonal, lower, order, row_pointer, row_index, A_pointer, A_columns, A_values, P, V_inverse
):
    """Covariance of every point and the variance that the unknowns give to each of its rows.

    With the unknowns of a point eliminated, its change is −V⁻¹ (N_pg dx_g − …), so that
    Q_pp = V⁻¹ + C Q C ᵀ with C = V⁻¹ N_pg, and a row a = (a_g, a_p) has
    a Q aᵀ = (a_g − a_p C) Q (a_g − a_p C)ᵀ + a_p V⁻¹ a_pᵀ.

    Parameters
    ----------
    pointer, rows, diagonal, lower, order
        Selected inverse Q of the reduced normal equations, and the place of each unknown in it.
    row_pointer, row_index : int64 arrays
        Rows of each point.
    A_pointer, A_columns, A_values
        The rows' part on unknowns that are not points (CSR).
    P : float64 array, shape (rows, 3)
        The rows' part on their point.
    V_inverse : float64 array, shape (points, 3, 3)

    Returns
    -------
    covariance : float64 array, shape (points, 3, 3)
    variance : float64 array, shape (rows,)
    """
    m = len(row_pointer) - 1
    covariance = np.empty((m, 3, 3))
    variance = np.zeros(len(P))
    mark = np.full(len(order), -1, np.int64)
    union = np.empty(len(order), np.int64)
    for p in range(m):
        count = 0
        for q in range(row_pointer[p], row_pointer[p + 1]):
            for a in range(A_pointer[row_index[q]], A_pointer[row_index[q] + 1]):
                if mark[A_columns[a]] < 0:
                    mark[A_columns[a]] = count
                    union[count] = A_columns[a]
                    count += 1
        index = np.empty(count, np.int64)
        for a in range(count):
            index[a] = order[union[a]]
        Q = gathered(pointer, rows, diagonal, lower, index)
        N = np.zeros((3, count))
        for q in range(row_pointer[p], row_pointer[p + 1]):
            r = row_index[q]
            for a in range(A_pointer[r], A_pointer[r + 1]):
                column = mark[A_columns[a]]
                for k in range(3):
                    N[k, column] += P[r, k] * A_values[a]
        C = V_inverse[p] @ N
        QC = Q @ np.ascontiguousarray(C.T)
        covariance[p] = V_inverse[p] + C @ QC
        for q in range(row_pointer[p], row_pointer[p + 1]):
            r = row_index[q]
            # (a_g − a_p C) Q (a_g − a_p C)ᵀ in parts: the first is sparse, the others are small.
            value = 0.0
            begin, end = A_pointer[r], A_pointer[r + 1]
            for a in range(begin, end):
                i = mark[A_columns[a]]
                for b in range(begin, end):
                    value += A_values[a] * A_values[b] * Q[i, mark[A_columns[b]]]
                for k in range(3):
                    value -= 2.0 * A_values[a] * QC[i, k] * P[r, k]
            for k in range(3):
                for n in range(3):
                    value += P[r, k] * P[r, n] * covariance[p, k, n]
            variance[r] = value
        for a in range(count):
            mark[union[a]] = -1
    return covariance, variance
