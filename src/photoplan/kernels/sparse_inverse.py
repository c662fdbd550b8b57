"""Selected entries of the inverse of a sparse normal matrix, and variances of linear functions of its unknowns."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from photoplan.kernels.jit import inner, kernel

# Entries of the inverse of a sparse symmetric matrix where its triangular factor has entries (Takahashi 1973).


@kernel
def fill_pattern(pointer, rows):
    """Pattern of the factor L of a symmetric matrix without pivoting, column by column.

    Parameters
    ----------
    pointer, rows : int64 arrays
        Columns of the strictly lower triangle (CSC), in the order of elimination.

    Returns
    -------
    pointer, rows : int64 arrays
        Columns of the strictly lower triangle of L, rows increasing.
    """
    n = len(pointer) - 1
    out_pointer = np.zeros(n + 1, np.int64)
    out = np.empty(max(16, 4 * len(rows)), np.int64)
    mark = np.full(n, -1, np.int64)
    first_child = np.full(n, -1, np.int64)
    next_child = np.full(n, -1, np.int64)
    at = 0
    for j in range(n):
        begin = at
        if at + n - j > len(out):
            grown = np.empty(2 * len(out) + n, np.int64)
            for q in range(at):
                grown[q] = out[q]
            out = grown
        mark[j] = j
        for q in range(pointer[j], pointer[j + 1]):
            i = rows[q]
            if mark[i] != j:
                mark[i] = j
                out[at] = i
                at += 1
        child = first_child[j]
        while child >= 0:
            for q in range(out_pointer[child], out_pointer[child + 1]):
                i = out[q]
                if mark[i] != j:
                    mark[i] = j
                    out[at] = i
                    at += 1
            child = next_child[child]
        out[begin:at].sort()
        out_pointer[j + 1] = at
        if at > begin:
            parent = out[begin]
            next_child[j] = first_child[parent]
            first_child[parent] = j
    return out_pointer, out[:at].copy()


@kernel
def align_factor(pointer, rows, L_pointer, L_rows, L_values):
    """Values of L (CSC, diagonal allowed and skipped) at the entries of a pattern that contains its own."""
    n = len(pointer) - 1
    out = np.zeros(len(rows))
    place = np.full(n, -1, np.int64)
    for j in range(n):
        for q in range(pointer[j], pointer[j + 1]):
            place[rows[q]] = q
        for q in range(L_pointer[j], L_pointer[j + 1]):
            if L_rows[q] > j:
                out[place[L_rows[q]]] = L_values[q]
    return out


@kernel
def selected_inverse(pointer, rows, L, D):
    """Entries of (L D Lᵀ)⁻¹ at the pattern of L: recursion from the last column to the first.

    Parameters
    ----------
    pointer, rows : int64 arrays
        Pattern of the strictly lower triangle, closed under elimination (`fill_pattern`).
    L : float64 array
        Values there.
    D : float64 array, shape (n,)

    Returns
    -------
    diagonal : float64 array, shape (n,)
    lower : float64 array
        Values at the pattern.
    """
    n = len(D)
    diagonal = np.empty(n)
    lower = np.zeros(len(rows))
    place = np.full(n, -1, np.int64)
    for j in range(n - 1, -1, -1):
        begin, end = pointer[j], pointer[j + 1]
        for q in range(begin, end):
            place[rows[q]] = q
        for a in range(begin, end):
            k = rows[a]
            l_a = L[a]
            total = diagonal[k] * l_a
            for q in range(pointer[k], pointer[k + 1]):
                b = place[rows[q]]
                if b >= 0:
                    lower[b] -= lower[q] * l_a
                    total += lower[q] * L[b]
            lower[a] -= total
        value = 1.0 / D[j]
        for a in range(begin, end):
            value -= lower[a] * L[a]
            place[rows[a]] = -1
        diagonal[j] = value
    return diagonal, lower


class SelectedInverse(NamedTuple):
    """Entries of the inverse at the pattern of the factor, with the numbers under which unknowns are eliminated."""

    pointer: Any
    """Columns of the strictly lower triangle (CSC)."""
    rows: Any
    diagonal: Any
    lower: Any
    order: Any
    """Number of each unknown in the order of elimination."""


@inner
def lookup(Q, a, b):
    """Entry of unknowns a and b; 0 where it was not computed."""
    i, j = Q.order[a], Q.order[b]
    if i == j:
        return Q.diagonal[i]
    if i < j:
        i, j = j, i
    low, high = Q.pointer[j], Q.pointer[j + 1]
    while low < high:
        middle = (low + high) // 2
        if Q.rows[middle] < i:
            low = middle + 1
        else:
            high = middle
    if low < Q.pointer[j + 1] and Q.rows[low] == i:
        return Q.lower[low]
    return 0.0


# Variances of linear functions of the unknowns of a bundle adjustment, from selected entries of the inverse.


class SparseRows(NamedTuple):
    """Rows of a sparse matrix (CSR)."""

    pointer: Any
    columns: Any
    values: Any


@kernel
def dense_inverse(Q, unknowns):
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
        dense = dense_inverse(Q, union[:count])
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
