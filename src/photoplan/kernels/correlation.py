"""Correlation of a template over a window (Behr 1989, eq. 4.1), weighted and with missing pixels.

For least-squares matching, a template is sampled at the pixels of an image, with its derivatives.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

_FLAT = 1e-10


@inner
def _coefficient(n, sg, sgg, st, stt, sgt):
    """r from weighted sums of grey values g and template t; NaN where one of them does not vary."""
    vg = sgg - sg * sg / n
    vt = stt - st * st / n
    if vg <= _FLAT * max(sgg, 1.0) or vt <= _FLAT * max(stt, 1.0):
        return np.nan
    return (sgt - sg * st / n) / np.sqrt(vg * vt)


@kernel
def correlate(image: NDArray[Any], template: NDArray[Any], weights: NDArray[Any], least: float, out: NDArray[Any]):
    """out[r, c] = correlation coefficient with the template's first pixel on image[r, c] (Behr 1989, eq. 4.1).

    The sums run over columns inside, template pixels outside: neighbouring positions are computed at once.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Grey values; NaN: not compared.
    template, weights : ndarrays, shape (a, b)
        The template and the weight of each of its pixels; 0: not compared.
    least : float
        Share of the weights that must lie on valid pixels; elsewhere the result is NaN.
    out : ndarray, shape (h − a + 1, w − b + 1)
        Receives the coefficients, −1 to 1; NaN where the grey values do not vary.
    """
    rows, columns = out.shape
    height, width = template.shape
    total, mean, count = 0.0, 0.0, 0
    for i in range(height):
        for j in range(width):
            total += weights[i, j]
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            if not np.isnan(image[r, c]):
                mean += image[r, c]
                count += 1
    # About the mean: the sums of squares then do not cancel.
    mean = mean / max(count, 1)
    grey = np.zeros(image.shape, np.float32)
    there = np.ones(image.shape, np.float32)
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            if np.isnan(image[r, c]):
                there[r, c] = 0.0
            else:
                grey[r, c] = image[r, c] - mean
    sums = np.zeros((6, columns))
    for r in range(rows):
        first, last = _whole(there, r, height, width, columns)
        # A literal 0 would be a kind of its own to numba, compiled beside the last part's.
        _correlate_row(grey, there, template, weights, r, (np.int64(0), first, False), least * total, sums, out)
        _correlate_row(grey, there, template, weights, r, (first, last, True), least * total, sums, out)
        _correlate_row(grey, there, template, weights, r, (last, columns, False), least * total, sums, out)


@kernel
def _whole(there, r, height, width, columns):
    """First and last + 1 of the longest run of places in row r whose pixels are all valid."""
    begin, end, start, known = 0, 0, 0, 0
    for c in range(columns + width - 1):
        whole = True
        for i in range(height):
            if there[r + i, c] == 0.0:
                whole = False
                break
        known = known + 1 if whole else 0
        if known >= width:
            start = c - known + 1
            if c - width + 2 - start > end - begin:
                begin, end = start, c - width + 2
    return begin, end


@kernel
def _correlate_row(grey, there, template, weights, r, part, least, sums, out):
    """Coefficients of places part[0] to part[1] of a row; part[2]: all their pixels are valid."""
    begin, end, whole = part
    if end <= begin:
        return
    sg, sgg, sgt, n, st, stt = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    sums[:] = 0.0
    for i in range(template.shape[0]):
        line, known = grey[r + i], there[r + i]
        for j in range(template.shape[1]):
            w = np.float64(weights[i, j])
            if w <= 0.0:
                continue
            t = np.float64(template[i, j])
            wt = w * t
            for c in range(begin, end):
                g = np.float64(line[c + j])
                sg[c] += w * g
                sgg[c] += w * g * g
                sgt[c] += wt * g
            if whole:
                n[begin] += w
                st[begin] += wt
                stt[begin] += wt * t
            else:
                for c in range(begin, end):
                    v = np.float64(known[c + j])
                    n[c] += w * v
                    st[c] += wt * v
                    stt[c] += wt * t * v
    for c in range(begin, end):
        k = begin if whole else c
        if n[k] <= 0.0 or n[k] < least:
            out[r, c] = np.nan
        else:
            out[r, c] = _coefficient(n[k], sg[c], sgg[c], st[k], stt[k], sgt[c])


@inner
def _cubic(t, w, d):
    """Weights of the four neighbours in cubic convolution (a = −1/2) at 0 ≤ t < 1, and their derivatives."""
    t2 = t * t
    t3 = t2 * t
    w[0] = -0.5 * t + t2 - 0.5 * t3
    w[1] = 1.0 - 2.5 * t2 + 1.5 * t3
    w[2] = 0.5 * t + 2.0 * t2 - 1.5 * t3
    w[3] = -0.5 * t2 + 0.5 * t3
    d[0] = -0.5 + 2.0 * t - 1.5 * t2
    d[1] = -5.0 * t + 4.5 * t2
    d[2] = 0.5 + 4.0 * t - 4.5 * t2
    d[3] = -t + 1.5 * t2


@kernel
def sample_template(values: NDArray[Any], weights: NDArray[Any], to_template: NDArray[Any], out: NDArray[Any]):
    """Template values, derivatives and weights at every pixel of a window.

    Parameters
    ----------
    values, weights : ndarrays, shape (a, b)
        The template; finite everywhere.
    to_template : ndarray, shape (2, 3)
        From (column, row) of the window to those of the template: A p + t.
    out : ndarray, shape (4, h, w)
        Receives value, derivatives by the window's column and row, and weight; the weight is 0 outside the template.
    """
    height, width = values.shape
    wx, wy, dx, dy = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for r in range(out.shape[1]):
        for c in range(out.shape[2]):
            x = to_template[0, 0] * c + to_template[0, 1] * r + to_template[0, 2]
            y = to_template[1, 0] * c + to_template[1, 1] * r + to_template[1, 2]
            i, j = int(np.floor(y)), int(np.floor(x))
            if i < 1 or j < 1 or i + 2 >= height or j + 2 >= width:
                out[0, r, c], out[1, r, c], out[2, r, c], out[3, r, c] = 0.0, 0.0, 0.0, 0.0
                continue
            _cubic(x - j, wx, dx)
            _cubic(y - i, wy, dy)
            value, along, down = 0.0, 0.0, 0.0
            for k in range(4):
                v, d = 0.0, 0.0
                for m in range(4):
                    t = values[i - 1 + k, j - 1 + m]
                    v += wx[m] * t
                    d += dx[m] * t
                value += wy[k] * v
                along += wy[k] * d
                down += dy[k] * v
            out[0, r, c] = value
            out[1, r, c] = along * to_template[0, 0] + down * to_template[1, 0]
            out[2, r, c] = along * to_template[0, 1] + down * to_template[1, 1]
            out[3, r, c] = weights[int(np.round(y)), int(np.round(x))]
