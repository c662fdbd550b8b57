"""Rows of numbers, written such that a processor takes several at once: no index might be negative."""

from __future__ import annotations

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
def add_share(share, a, out):
    """out += share · a."""
    for i in range(len(out)):
        out[i] += share * a[i]


@inner
def add_row(a, out):
    """out += a."""
    for i in range(len(out)):
        out[i] += a[i]


@inner
def add_four(shares, a, b, c, d, out):
    """out += four shares, each of its own row: `out` is read and written once for all of them."""
    p, q, r, s = shares[0], shares[1], shares[2], shares[3]
    for i in range(len(out)):
        out[i] = out[i] + p * a[i] + q * b[i] + r * c[i] + s * d[i]


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
