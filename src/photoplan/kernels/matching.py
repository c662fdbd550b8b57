"""Image matching: correlation, least-squares matching, and semi-global matching over planes of one height."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

# Means over squares of neighbouring values, from running sums.


#: Rows that slide at once: the sum of each waits for that of the column before.
_TOGETHER = 4


@kernel
def box_means(values, before, after, out):
    """Means of values (rows, columns) over the rows and columns k − before … k + after − 1 that there are.

    `out` has the same shape, float64. None is below the least value: sums that slide past large ones may end beside 0.
    """
    rows, columns = values.shape
    least = np.inf
    for j in range(rows):
        for i in range(columns):
            least = min(least, values[j, i])
    down = np.zeros((_TOGETHER, columns))
    sums, along = np.zeros(columns), np.zeros(_TOGETHER)
    for j in range(-after + 1, 0):
        # What the window of the first row has but the last of its rows.
        if j + after - 1 < rows:
            for i in range(columns):
                sums[i] += values[j + after - 1, i]
    for first in range(0, rows, _TOGETHER):
        several = min(_TOGETHER, rows - first)
        for n in range(several):
            j = first + n
            if j + after - 1 < rows:
                for i in range(columns):
                    sums[i] += values[j + after - 1, i]
            if j - before - 1 >= 0:
                for i in range(columns):
                    sums[i] -= values[j - before - 1, i]
            count = min(j + after, rows) - max(j - before, 0)
            for i in range(columns):
                down[n, i] = sums[i] / count
        along[:] = 0.0
        for i in range(min(after - 1, columns)):
            for n in range(_TOGETHER):
                along[n] += down[n, i]
        for i in range(columns):
            count = min(i + after, columns) - max(i - before, 0)
            for n in range(several):
                if i + after - 1 < columns:
                    along[n] += down[n, i + after - 1]
                if i - before - 1 >= 0:
                    along[n] -= down[n, i - before - 1]
                out[first + n, i] = max(along[n] / count, least)


# Correlation of a template over a window (Behr 1989, eq. 4.1), weighted and with missing pixels.
#
# For least-squares matching, a template is sampled at the pixels of an image, with its derivatives.


_FLAT = 1e-10


@inner
def _correlation_coefficient(n, sg, sgg, st, stt, sgt):
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
        first, last = _longest_valid_run(there, r, height, width, columns)
        # A literal 0 would be a kind of its own to numba, compiled beside the last part's.
        _correlate_row(grey, there, template, weights, r, (np.int64(0), first, False), least * total, sums, out)
        _correlate_row(grey, there, template, weights, r, (first, last, True), least * total, sums, out)
        _correlate_row(grey, there, template, weights, r, (last, columns, False), least * total, sums, out)


@kernel
def _longest_valid_run(there, r, height, width, columns):
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
            out[r, c] = _correlation_coefficient(n[k], sg[c], sgg[c], st[k], stt[k], sgt[c])


@inner
def _cubic_weights(t, w, d):
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
            _cubic_weights(x - j, wx, dx)
            _cubic_weights(y - i, wy, dy)
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


# Least-squares matching: a patch of one image found in another to a small part of a pixel.
#
# The grey values of the template T are explained by those of the other image S under an affine mapping and a linear
# radiometry (Förstner 1982; Ackermann 1984; Gruen 1985):
#
#     T(u, v) = r0 + r1 · S(x + a11 u + a12 v, y + a21 u + a22 v) + e
#
# Eight unknowns, solved by Gauss-Newton. S is a cubic spline: its interpolation hardly smooths, so noise keeps its
# variance and positions have no bias towards whole pixels (Unser 1999, table 1).


#: What became of a patch: settled; not enough of it lies in the window; the normal matrix is singular (no texture,
#: or texture along one direction); the iteration has not settled or went farther than allowed.
CONVERGED, LEFT, SINGULAR, UNSETTLED = 0, 1, 2, 3
#: Numbers per result: x, y, a11, a12, a21, a22, r0, r1, correlation, var x, cov xy, var y, sigma0, status.
RESULTS = 14
#: Where the correlation stands among them.
CORRELATION = 8

_POLE = np.sqrt(3.0) - 2.0
_BORDER = 24
"""Terms of the start value: the pole to this power is below 1e-13."""
_UNKNOWNS = 8


@inner
def _filter_line(line: NDArray[Any]) -> None:
    """Values to coefficients of a cubic spline with mirrored ends (Unser 1999, box 2)."""
    n = line.shape[0]
    if n < 2:
        return
    total, power = 0.0, 1.0
    for k in range(_BORDER):
        period = 2 * (n - 1)
        j = k % period
        total += power * line[j if j < n else period - j]
        power *= _POLE
    line[0] = 6.0 * total
    for k in range(1, n):
        line[k] = 6.0 * line[k] + _POLE * line[k - 1]
    line[n - 1] = _POLE / (_POLE * _POLE - 1.0) * (line[n - 1] + _POLE * line[n - 2])
    for k in range(n - 2, -1, -1):
        line[k] = _POLE * (line[k + 1] - line[k])


@inner
def _filter_window(window: NDArray[Any]) -> None:
    for row in range(window.shape[0]):
        _filter_line(window[row])
    for col in range(window.shape[1]):
        _filter_line(window[:, col])


@kernel
def spline_coefficients(windows: NDArray[Any]) -> None:
    """Replace values (n, height, width), float64, by the coefficients of cubic splines through them."""
    for i in range(windows.shape[0]):
        _filter_window(windows[i])


@inner
def _basis_splines(t: float, w: NDArray[Any], d: NDArray[Any]) -> None:
    """Values and slopes of the four cubic basis splines at a fraction t of a mesh."""
    s = 1.0 - t
    w[0], w[3] = s * s * s / 6.0, t * t * t / 6.0
    w[1] = 2.0 / 3.0 - 0.5 * t * t * (2.0 - t)
    w[2] = 2.0 / 3.0 - 0.5 * s * s * (2.0 - s)
    d[0], d[3] = -0.5 * s * s, 0.5 * t * t
    d[1] = t * (1.5 * t - 2.0)
    d[2] = -s * (1.5 * s - 2.0)


@inner
def _spline(c: NDArray[Any], x: float, y: float, work: NDArray[Any], out: NDArray[Any]) -> bool:
    """Value and slopes along x and y into `out`; False within a pixel of the border and outside."""
    if not (x >= 1.0 and y >= 1.0 and x < c.shape[1] - 2.0 and y < c.shape[0] - 2.0):
        return False
    i, j = int(x), int(y)
    _basis_splines(x - i, work[0], work[1])
    _basis_splines(y - j, work[2], work[3])
    value, along_x, along_y = 0.0, 0.0, 0.0
    for k in range(4):
        row, slope = 0.0, 0.0
        for m in range(4):
            v = c[j - 1 + k, i - 1 + m]
            row += work[0, m] * v
            slope += work[1, m] * v
        value += work[2, k] * row
        along_x += work[2, k] * slope
        along_y += work[3, k] * row
    out[0], out[1], out[2] = value, along_x, along_y
    return True


@kernel
def sample_spline(coefficients: NDArray[Any], xy: NDArray[Any], values: NDArray[Any]) -> None:
    """Values (n,) of the spline of one window at xy (n, 2); NaN within a pixel of the border and outside."""
    work, out = np.empty((4, 4)), np.empty(3)
    for i in range(xy.shape[0]):
        inside = _spline(coefficients, xy[i, 0], xy[i, 1], work, out)
        values[i] = out[0] if inside else np.nan


@inner
def _factorise(N: NDArray[Any]) -> bool:
    """Cholesky factor into the lower triangle; False if N is singular in proportion to its diagonal."""
    for j in range(_UNKNOWNS):
        whole = N[j, j]
        for k in range(j):
            N[j, j] -= N[j, k] * N[j, k]
        if not N[j, j] > 1e-7 * whole:
            return False
        N[j, j] = np.sqrt(N[j, j])
        for i in range(j + 1, _UNKNOWNS):
            for k in range(j):
                N[i, j] -= N[i, k] * N[j, k]
            N[i, j] /= N[j, j]
    return True


@inner
def _solve(N: NDArray[Any], b: NDArray[Any]) -> None:
    """L Lᵀ x = b in place."""
    for i in range(_UNKNOWNS):
        for k in range(i):
            b[i] -= N[i, k] * b[k]
        b[i] /= N[i, i]
    for i in range(_UNKNOWNS - 1, -1, -1):
        for k in range(i + 1, _UNKNOWNS):
            b[i] -= N[k, i] * b[k]
        b[i] /= N[i, i]


@inner
def _accumulate(
    template: NDArray[Any], weight: NDArray[Any], c: NDArray[Any], p: NDArray[Any], work: tuple[Any, ...]
) -> tuple[Any, Any, Any]:
    """Normal equations of one step: `work` = N, b, spline work, spline result, row. Returns used, eᵀe, Σ(T−T̄)²."""
    N, b, inside, out, row = work
    N[:], b[:] = 0.0, 0.0
    r = template.shape[0] // 2
    used, squares, total, total2 = 0.0, 0.0, 0.0, 0.0
    for v in range(-r, r + 1):
        for u in range(-r, r + 1):
            w = weight[v + r, u + r]
            if w <= 0.0:
                continue
            x = p[0] + p[2] * u + p[3] * v
            y = p[1] + p[4] * u + p[5] * v
            if not _spline(c, x, y, inside, out):
                return -1.0, 0.0, 0.0
            t = template[v + r, u + r]
            e = t - p[6] - p[7] * out[0]
            gx, gy = p[7] * out[1], p[7] * out[2]
            # The affine elements are scaled to displacements at the patch's edge: all unknowns are of one size.
            row[0], row[1], row[2], row[3] = gx, gy, gx * u / r, gx * v / r
            row[4], row[5], row[6], row[7] = gy * u / r, gy * v / r, 1.0, out[0]
            for i in range(_UNKNOWNS):
                b[i] += w * row[i] * e
                for k in range(i + 1):
                    N[i, k] += w * row[i] * row[k]
            used += w
            squares += w * e * e
            total += w * t
            total2 += w * t * t
    return used, squares, total2 - total * total / max(used, 1.0)


@inner
def _radiometry(
    template: NDArray[Any], weight: NDArray[Any], c: NDArray[Any], p: NDArray[Any], work: tuple[Any, ...]
) -> bool:
    """Start values of r0 and r1: equal means and standard deviations; False outside the window or without texture."""
    _, _, inside, out, _ = work
    r = template.shape[0] // 2
    n, t1, t2, s1, s2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for v in range(-r, r + 1):
        for u in range(-r, r + 1):
            w = weight[v + r, u + r]
            if w <= 0.0:
                continue
            if not _spline(c, p[0] + p[2] * u + p[3] * v, p[1] + p[4] * u + p[5] * v, inside, out):
                return False
            t = template[v + r, u + r]
            n, t1, t2, s1, s2 = n + w, t1 + w * t, t2 + w * t * t, s1 + w * out[0], s2 + w * out[0] * out[0]
    vt, vs = t2 - t1 * t1 / max(n, 1.0), s2 - s1 * s1 / max(n, 1.0)
    if not (n > _UNKNOWNS and vt > 0.0 and vs > 0.0):
        return False
    p[7] = np.sqrt(vt / vs)
    p[6] = (t1 - p[7] * s1) / n
    return True


@inner
def _match(
    template: NDArray[Any],
    weight: NDArray[Any],
    c: NDArray[Any],
    limits: NDArray[Any],
    result: NDArray[Any],
    work: tuple[Any, ...],
) -> int:
    """One patch; `result` holds the start in its first six numbers. Returns the status."""
    N, b, _, _, _ = work
    r = template.shape[0] // 2
    x0, y0 = result[0], result[1]
    if not _radiometry(template, weight, c, result, work):
        return LEFT
    settled = False
    for _ in range(int(limits[0])):
        used, squares, variance = _accumulate(template, weight, c, result, work)
        if used < 0.0:
            return LEFT
        if not _factorise(N):
            return SINGULAR
        if settled:
            freedom = max(used - _UNKNOWNS, 1.0)
            result[8] = np.sqrt(max(0.0, 1.0 - squares / variance)) if variance > 0.0 else 0.0
            result[12] = np.sqrt(squares / freedom)
            for k in range(2):
                b[:] = 0.0
                b[k] = squares / freedom
                _solve(N, b)
                result[9 + 2 * k], result[10] = b[k], b[1 - k]
            return CONVERGED
        _solve(N, b)
        # A step is at most a pixel, at the patch's edge too: far from the solution the slopes are not to be trusted.
        largest = max(abs(b[0]), abs(b[1]))
        for k in range(2, 6):
            largest = max(largest, abs(b[k]))
        damp = 1.0 / largest if largest > 1.0 else 1.0
        for k in range(_UNKNOWNS):
            result[k] += damp * (b[k] / r if 2 <= k < 6 else b[k])
        if np.hypot(result[0] - x0, result[1] - y0) > limits[2]:
            return UNSETTLED
        settled = largest < limits[1]
    return UNSETTLED


@kernel
def match_patches(
    templates: NDArray[Any], weights: NDArray[Any], windows: NDArray[Any], limits: NDArray[Any], results: NDArray[Any]
) -> None:
    """Match n patches, each in a window of its own.

    Parameters
    ----------
    templates : ndarray, shape (n, m, m), float64
        Grey values on whole pixels, m odd; u and v are zero in the middle.
    weights : ndarray, shape (n, m, m), float64
        1: the pixel takes part, 0: not.
    windows : ndarray, shape (n, height, width), float64
        Coefficients of the other image, see `spline_coefficients`.
    limits : ndarray, shape (3,), float64
        Most iterations; displacement below which the iteration has settled, pixels; largest distance from the start.
    results : ndarray, shape (n, RESULTS), float64
        In: x, y, a11, a12, a21, a22 of the start, x and y in pixels of the window. Out: see `RESULTS`. The covariance
        is σ0² N⁻¹ with σ0² = eᵀe / (used pixels − 8), square pixels. NaN beyond the status where it is not CONVERGED.
    """
    work = (np.empty((_UNKNOWNS, _UNKNOWNS)), np.empty(_UNKNOWNS), np.empty((4, 4)), np.empty(3), np.empty(_UNKNOWNS))
    for i in range(templates.shape[0]):
        results[i, _UNKNOWNS:] = np.nan
        status = _match(templates[i], weights[i], windows[i], limits, results[i], work)
        if status != CONVERGED:
            results[i, :] = np.nan
        results[i, RESULTS - 1] = status


# Plane sweep: images on planes of one height, compared cell by cell by the census transform.


#: Cells up and down, and left and right, with which the middle one is compared (9 × 7).
HALF_ROWS, HALF_COLUMNS = 3, 4
#: Pairs of images that a post compares at most.
MOST_PAIRS = 8


@inner
def _count_bits(bits):
    """How many bits are set."""
    x = bits - ((bits >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@kernel
def sample_plane(raw, at, step, wanted, out):
    """Grey values of an image in cells of a plane, bilinear.

    Parameters
    ----------
    raw : ndarray, shape (h, w), float32
        NaN where there are none.
    at : ndarray, shape (m, n, 2)
        Column and row of every `step`-th cell in it; NaN: behind the camera.
    step : int
    wanted : ndarray of bool, shape (rows, columns)
        Cells that are filled.
    out : ndarray, shape (rows, columns), float32
        NaN where the image has no value.
    """
    rows, columns = out.shape
    height, width = raw.shape
    for r in range(rows):
        j = min(r // step, at.shape[0] - 2)
        b = r / step - j
        for c in range(columns):
            out[r, c] = np.nan
            if not wanted[r, c]:
                continue
            i = min(c // step, at.shape[1] - 2)
            a = c / step - i
            x = (at[j, i, 0] * (1.0 - a) + at[j, i + 1, 0] * a) * (1.0 - b)
            x += (at[j + 1, i, 0] * (1.0 - a) + at[j + 1, i + 1, 0] * a) * b
            y = (at[j, i, 1] * (1.0 - a) + at[j, i + 1, 1] * a) * (1.0 - b)
            y += (at[j + 1, i, 1] * (1.0 - a) + at[j + 1, i + 1, 1] * a) * b
            if not (x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0):
                continue
            u, v = min(int(x), width - 2), min(int(y), height - 2)
            s, t = np.float32(x - u), np.float32(y - v)
            upper = raw[v, u] + s * (raw[v, u + 1] - raw[v, u])
            lower = raw[v + 1, u] + s * (raw[v + 1, u + 1] - raw[v + 1, u])
            out[r, c] = upper + t * (lower - upper)


@kernel
def census_transform(grey, wanted, out, known):
    """Which cells around each one are brighter than it (census transform, Zabih and Woodfill 1994).

    Parameters
    ----------
    grey : ndarray, shape (rows, columns), float32
        NaN where there is no value; such neighbours count as not brighter.
    wanted : ndarray of bool, the same shape
    out : ndarray of uint64, the same shape
        62 bits, in cells that are wanted.
    known : ndarray of bool, the same shape
        Filled: cells that have a value and whose neighbours are inside.
    """
    rows, columns = grey.shape
    for r in range(rows):
        for c in range(columns):
            known[r, c] = False
            if not wanted[r, c] or r < HALF_ROWS or r >= rows - HALF_ROWS:
                continue
            if c < HALF_COLUMNS or c >= columns - HALF_COLUMNS:
                continue
            middle = grey[r, c]
            if np.isnan(middle):
                continue
            bits = np.uint64(0)
            for j in range(r - HALF_ROWS, r + HALF_ROWS + 1):
                for i in range(c - HALF_COLUMNS, c + HALF_COLUMNS + 1):
                    bits = (bits << np.uint64(1)) | np.uint64(grey[j, i] > middle)
            out[r, c], known[r, c] = bits, True


@kernel
def add_plane_costs(census, known, pairs, step, low, high, ratio, half, neutral, first, cost):
    """The cost of a plane at every post that may lie on it.

    Of each pair of images the mean share of bits that differ, over the cells around a post; the mean of the better half
    of the first `MOST_PAIRS` pairs that both see the post, since what hides a place from one image spoils the pairs
    that it is in.

    Parameters
    ----------
    census : ndarray, shape (images, rows · cells, columns · cells), uint64
    known : ndarray of bool, the same shape
    pairs : ndarray, shape (n, 2), int64
        Images that may be compared, the best to compare first.
    step : int
        Number of the plane.
    low, high : ndarray, shape (rows, columns), int64
        First step of each post, and the one after its last.
    ratio, half : int
        Cells along a facet, and around a post that are compared.
    neutral : float
        Cost where no two images are known.
    first : ndarray
        See `sum_paths`.
    cost : ndarray, shape (n,), float32
        Filled where posts may lie on the plane.
    """
    rows, columns = low.shape
    means = np.empty(MOST_PAIRS)
    for j in range(rows):
        for i in range(columns):
            if step < low[j, i] or step >= high[j, i]:
                continue
            top, bottom = max(j * ratio - half, 0), min(j * ratio + half + 1, census.shape[1])
            left, right = max(i * ratio - half, 0), min(i * ratio + half + 1, census.shape[2])
            number = 0
            for p in range(len(pairs)):
                if number == MOST_PAIRS:
                    break
                one, other = pairs[p, 0], pairs[p, 1]
                total, count = 0, 0
                for r in range(top, bottom):
                    for c in range(left, right):
                        if known[one, r, c] and known[other, r, c]:
                            total += _count_bits(census[one, r, c] ^ census[other, r, c])
                            count += 1
                if 2 * count <= (bottom - top) * (right - left):
                    continue
                mean = total / (62.0 * count)
                n = number
                while n > 0 and means[n - 1] > mean:
                    means[n] = means[n - 1]
                    n -= 1
                means[n] = mean
                number += 1
            value = neutral
            if number > 0:
                better = (number + 1) // 2
                value = 0.0
                for n in range(better):
                    value += means[n] / better
            cost[first[j * columns + i] + step - low[j, i]] = value


# Semi-global matching: costs of heights summed along eight paths (Hirschmüller 2008, eq. 13 and 14).
#
# Every post has its own run of steps, from `low[j, i]` on: their costs are those from `first[j, i]` to
# `first[j, i + 1]` of one long row, so that the memory is that of the steps that are searched.


@inner
def _path_costs(cost, at, count, low, path, before, steps, low_before, small, large, total):
    """The path's costs at a post from those at the post before it, written and added to `total`."""
    least = path[before]
    for k in range(1, steps):
        least = min(least, path[before + k])
    shift = low - low_before
    for k in range(count):
        n = k + shift
        best = least + large
        if n >= 0 and n < steps:
            best = min(best, path[before + n])
        if n >= 1 and n <= steps:
            best = min(best, path[before + n - 1] + small)
        if n >= -1 and n < steps - 1:
            best = min(best, path[before + n + 1] + small)
        path[at + k] = cost[at + k] + best - least
        total[at + k] += path[at + k]


@kernel
def sum_paths(cost, first, low, small, large, path, total):
    """Add the costs along eight paths to every post.

    Parameters
    ----------
    cost : ndarray, shape (n,), float32
    first : ndarray, shape (rows · columns + 1,), int64
        Where the costs of each post begin, row by row.
    low : ndarray, shape (rows, columns), int64
        First step of each post.
    small, large : float
        What going on to the next step costs, and to any other one.
    path : ndarray, shape (n,), float32
        Scratch.
    total : ndarray, shape (n,), float32
        Added.
    """
    rows, columns = low.shape
    for way in range(8):
        dj, di = 0, 1
        if way == 1:
            dj, di = 0, -1
        elif way > 1:
            dj, di = (1 if way < 5 else -1), (way - 2) % 3 - 1
        for a in range(rows):
            j = a if dj >= 0 else rows - 1 - a
            for b in range(columns):
                i = b if di >= 0 else columns - 1 - b
                here = j * columns + i
                at = first[here]
                count = first[here + 1] - at
                m, n = j - dj, i - di
                if m < 0 or n < 0 or m >= rows or n >= columns:
                    for k in range(count):
                        path[at + k] = cost[at + k]
                        total[at + k] += cost[at + k]
                    continue
                other = m * columns + n
                _path_costs(
                    cost, at, count, low[j, i], path, first[other], first[other + 1] - first[other], low[m, n],
                    small, large, total,
                )  # fmt: skip


@kernel
def least_cost_steps(total, first, low, apart, steps, margin):
    """The step of least cost at every post, and by how much the next one costs more.

    Parameters
    ----------
    total, first, low
        See `sum_paths`.
    apart : int
        Steps next to the best one that are not another choice.
    steps : ndarray, shape (rows, columns)
        Filled: the step, with the vertex of the parabola through the costs around it.
    margin : ndarray, shape (rows, columns)
        Filled: least cost of another choice less that of the best one; 0 where there is no choice, or where the best
        step is the first or last one of several.
    """
    rows, columns = low.shape
    for j in range(rows):
        for i in range(columns):
            at = first[j * columns + i]
            count = first[j * columns + i + 1] - at
            best = 0
            for k in range(1, count):
                if total[at + k] < total[at + best]:
                    best = k
            steps[j, i], margin[j, i] = low[j, i] + best, 0.0
            if best == 0 or best == count - 1:
                continue
            below, least, above = total[at + best - 1], total[at + best], total[at + best + 1]
            bend = below + above - 2.0 * least
            if bend > 0.0:
                steps[j, i] += 0.5 * (below - above) / bend
            other = np.inf
            for k in range(count):
                if abs(k - best) > apart:
                    other = min(other, total[at + k])
            margin[j, i] = other - least if other < np.inf else bend


@kernel
def cost_scatter(total, first, low, steps, scale, faint, kept_low, kept_high, out):
    """How far other choices lie from the best ones, by their costs: Σ p (k − best)² over Σ p, p = exp(−ΔS / scale).

    Parameters
    ----------
    total, first, low
        See `sum_paths`.
    steps : ndarray, shape (rows, columns)
        See `least_cost_steps`.
    scale : float
        Difference of costs that counts as one unit of the exponent.
    faint : float
        p from which on choices count.
    kept_low, kept_high : ndarray, shape (rows, columns)
        Steps from the first to the second one do not count: they are one choice, or still to be chosen from.
    out : ndarray, shape (rows, columns)
        Filled, steps².
    """
    rows, columns = low.shape
    for j in range(rows):
        for i in range(columns):
            at = first[j * columns + i]
            count = first[j * columns + i + 1] - at
            least = total[at]
            for k in range(1, count):
                least = min(least, total[at + k])
            whole, sums = 0.0, 0.0
            for k in range(count):
                step = low[j, i] + k
                p = np.exp((least - total[at + k]) / scale)
                whole += p
                if p >= faint and (step < kept_low[j, i] or step > kept_high[j, i]):
                    sums += p * (step - steps[j, i]) ** 2
            out[j, i] = sums / max(whole, 1.0)
