"""Rows of numbers, written such that a processor takes several at once: no index might be negative."""

from __future__ import annotations

import numpy as np

from photoplan.kernels import numba_parts
from photoplan.kernels.jit import inner


@inner
def add_product(a, b, out):
    """out += a · b, element by element."""
    for i in range(len(out)):
        out[i] += a[i] * b[i]


@inner
def add_both(a, b, d, out, other):
    """out += a · b and other += a · d, element by element; `out` and `other` share nothing."""
    for i in range(len(out)):
        out[i] += a[i] * b[i]
        other[i] += a[i] * d[i]


@inner
def add_few_loops(share, a, count_tag, out, at):
    """out[at : at + n] += share · a of one-dimensional float32, with n the length of `count_tag`, part of its type."""
    for k in range(len(count_tag)):
        out[at + k] += np.float32(share) * a[k]


add_few = numba_parts.add_few if numba_parts.USABLE else add_few_loops


@inner
def add_share(share, a, out):
    """out += share · a."""
    for i in range(len(out)):
        out[i] += share * a[i]


@inner
def dot(a, b, part):
    """Sum of products of two arrays of rows, in eight `part`s at once."""
    total = 0.0
    rows, columns = a.shape
    whole = columns // 8 * 8
    for j in range(rows):
        first, second = a[j], b[j]
        for k in range(8):
            part[k] = 0.0
        for i in range(0, whole, 8):
            for k in range(8):
                part[k] += first[i + k] * second[i + k]
        for k in range(8):
            total += part[k]
        for i in range(whole, columns):
            total += first[i] * second[i]
    return total
