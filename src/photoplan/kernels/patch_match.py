"""Least-squares matching: a patch of one image found in another to a small part of a pixel.

The grey values of the template T are explained by those of the other image S under an affine mapping and a linear
radiometry (Förstner 1982; Ackermann 1984; Gruen 1985):

    T(u, v) = r0 + r1 · S(x + a11 u + a12 v, y + a21 u + a22 v) + e

Eight unknowns, solved by Gauss-Newton. S is a cubic spline: its interpolation hardly smooths, so noise keeps its
variance and positions have no bias towards whole pixels (Unser 1999, table 1).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

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
def _weights(t: float, w: NDArray[Any], d: NDArray[Any]) -> None:
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
    _weights(x - i, work[0], work[1])
    _weights(y - j, work[2], work[3])
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
