"""Entries of the inverse of a sparse symmetric matrix where its triangular factor has entries (Takahashi 1973)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from photoplan.kernels.jit import inner, kernel


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
def aligned(pointer, rows, L_pointer, L_rows, L_values):
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
