"""Patches of an orthophoto found again in photos: the steps from grey values to control that fits together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from photoplan.adjustment.robust import MEDIAN_2D, cauchy
from photoplan.cameras.base import CentralCamera, project
from photoplan.geometry.rotation import skew, small_rotations
from photoplan.kernels.patch_match import CONVERGED, CORRELATION, RESULTS, match_patches, spline_coefficients

Array = NDArray[np.float64]

#: Part of a patch that must have values.
FILLED = 0.5
#: A second peak of the correlation must stay below this part of the first one, so many cells away from it.
_SECOND, _APART = 0.95, 4
#: Least correlation of a peak before refinement.
_LIKE = 0.4
#: Points that an image's consistency is judged from, at least.
LEAST = 6
#: Prior standard deviation of the rotations of a correction, radians.
_TURN = 0.03
_MEDIAN = MEDIAN_2D**2
#: Fits are at least so much too sure of themselves: what loops of tie points show (see `photoplan.matching.loops`).
_FACTOR = 2.0


@dataclass(frozen=True, eq=False)
class FoundPatch:
    """Where the middle of a patch lies in another picture of its ground."""

    at: tuple[float, float]
    """Column and row."""
    covariance: Array
    """Of column and row as the fit has it, (2, 2)."""
    correlation: float


@dataclass(frozen=True, eq=False)
class AgreeingPoints:
    """Which points of an image agree with one correction of its orientation."""

    keep: NDArray[np.bool_]
    """(n,)."""
    residuals: Array
    """Measured minus computed after the correction, (n, 2), pixels."""
    shift: tuple[float, float]
    """Median of measured minus computed position before, pixels."""
    factor: float
    """By which standard deviations of the fit are to be multiplied, 2 or more."""


def best_place(values: NDArray[np.float32], radius: int, border: int) -> tuple[int, int] | None:
    """Column and row where a patch has most texture in all directions; None if none has enough values.

    The measure is the smaller eigenvalue of the mean products of slopes over the patch (Förstner and Gülch 1987).
    """
    known = np.isfinite(values)
    if not known.any():
        return None
    filled = np.where(known, values, values[known].mean())
    smooth = ndimage.gaussian_filter(filled, 1.0)
    gx, gy = ndimage.sobel(smooth, 1), ndimage.sobel(smooth, 0)
    inside = ndimage.binary_erosion(known, iterations=2)
    gx, gy = np.where(inside, gx, 0.0), np.where(inside, gy, 0.0)
    side = 2 * radius + 1
    xx, xy, yy = (ndimage.uniform_filter(v, side, mode="constant") for v in (gx * gx, gx * gy, gy * gy))
    least = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    share = ndimage.uniform_filter(known.astype(np.float32), side, mode="constant")
    fits = (share >= FILLED) & known
    inner = np.zeros_like(known)
    edge = max(border, 1)
    inner[edge:-edge, edge:-edge] = True
    score = np.where(fits & inner, least, -1.0)
    row, col = np.unravel_index(int(score.argmax()), score.shape)
    return (int(col), int(row)) if score[row, col] > 0 else None


def correlate(patch: Array, picture: Array) -> Array:
    """Correlation coefficient of a patch with every part of a larger picture, over the cells that both have.

    Normalised with means and norms of the common cells (Padfield 2012, eq. 27 and 28).
    """
    mask_t, mask_f = np.isfinite(patch), np.isfinite(picture)
    t = np.where(mask_t, patch - patch[mask_t].mean(), 0.0)
    f = np.where(mask_f, picture - picture[mask_f].mean(), 0.0)
    shape = [fft.next_fast_len(s) for s in picture.shape]

    def forward(a: Array) -> NDArray[np.complex128]:
        return np.asarray(fft.rfft2(a, shape))

    out = tuple(slice(0, n - m + 1) for n, m in zip(picture.shape, patch.shape))

    def against(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> Array:
        return np.asarray(fft.irfft2(np.conj(a) * b, shape))[out]

    T, T2, Mt = forward(t), forward(t * t), forward(mask_t.astype(float))
    F, F2, Mf = forward(f), forward(f * f), forward(mask_f.astype(float))
    n = np.maximum(np.rint(against(Mt, Mf)), 1.0)
    sum_t, sum_f = against(T, Mf), against(Mt, F)
    above = against(T, F) - sum_t * sum_f / n
    var_t, var_f = against(T2, Mf) - sum_t**2 / n, against(Mt, F2) - sum_f**2 / n
    floor = 1e-6 * max(float((t * t).sum()), 1e-12)
    enough = (n >= FILLED * mask_t.sum()) & (var_t > floor) & (var_f > 1e-6 * max(float((f * f).sum()), 1e-12))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(enough, np.clip(above / np.sqrt(np.maximum(var_t * var_f, 1e-30)), -1, 1), -1.0)


def find_patch(patch: Array, picture: Array, least: float = 0.7) -> FoundPatch | str:
    """Find a patch in a picture of the same scale and direction that is larger on all sides.

    The best whole cell by correlation, then least-squares matching.

    Parameters
    ----------
    patch : ndarray, shape (m, m), m odd
        NaN: no value.
    picture : ndarray, shape (n, n)
    least : float
        Least correlation after refinement.

    Returns
    -------
    FoundPatch or str
        Or why it was not found.
    """
    m, radius = len(patch), len(patch) // 2
    score = correlate(patch, picture)
    row, col = np.unravel_index(int(score.argmax()), score.shape)
    best = float(score[row, col])
    if best < _LIKE:
        return "unlike"
    if min(row, col) == 0 or row == score.shape[0] - 1 or col == score.shape[1] - 1:
        return "at the edge of the search"
    away = score.copy()
    away[max(0, row - _APART) : row + _APART + 1, max(0, col - _APART) : col + _APART + 1] = -1
    if away.max() > _SECOND * best:
        return "ambiguous"
    known = np.isfinite(patch)
    there = np.isfinite(picture[row : row + m, col : col + m])
    weights = (known & there).astype(float)
    coefficients = np.where(np.isfinite(picture), picture, np.nanmean(picture))[None].copy()
    spline_coefficients(coefficients)
    result = np.zeros((1, RESULTS))
    result[0, :6] = col + radius, row + radius, 1.0, 0.0, 0.0, 1.0
    limits = np.array([40, 2e-3, 3.0])
    match_patches(np.where(known, patch, 0.0)[None], weights[None], coefficients, limits, result)
    r = result[0]
    if r[-1] != CONVERGED:
        return "not settled"
    if r[CORRELATION] < least:
        return "unlike"
    return FoundPatch((float(r[0]), float(r[1])), r[[9, 10, 10, 11]].reshape(2, 2), float(r[CORRELATION]))


def agree(
    camera: CentralCamera, XYZ: Array, xy: Array, covariances: tuple[Array, Array], reach: float
) -> AgreeingPoints:
    """Which points obey one small change of the camera's position and direction.

    A change of the orientation moves the points of an image smoothly; what a wrong match does is its own. Six unknowns
    are adjusted with weights that fall with the residuals (Cauchy); points that then lie farther than four robust
    standard deviations, and a pixel at least, do not agree.
    """
    n = len(XYZ)
    gap = xy - project(camera, XYZ)
    if n < LEAST:
        return AgreeingPoints(np.zeros(n, bool), gap, (float("nan"), float("nan")), _FACTOR)
    middle = np.median(gap, axis=0)
    delta = np.zeros(6)
    residual, scale = gap - middle, 0.0
    for step in range(30):
        length = np.linalg.norm(residual, axis=1)
        scale = max(float(np.median(length)) / MEDIAN_2D, 0.05)
        weight = cauchy(length, 2.5 * scale)
        moved, J = _moved(camera, XYZ, delta)
        actual = xy - project(camera, moved)
        W = np.diag(1.0 / np.array([reach, reach, reach, _TURN, _TURN, _TURN]) ** 2) * scale**2
        N = np.einsum("nki,n,nkj->ij", J, weight, J) + W
        b = np.einsum("nki,n,nk->i", J, weight, actual) - W @ delta
        change = np.linalg.solve(N, b)
        delta = delta + change
        residual = xy - project(camera, _moved(camera, XYZ, delta)[0])
        if step > 3 and np.abs(change[:3]).max() < 1e-4 * reach and np.abs(change[3:]).max() < 1e-6:
            break
    keep = np.linalg.norm(residual, axis=1) <= max(4.0 * scale, 1.0)
    factor = _factor(camera, XYZ, residual, covariances, keep) if keep.sum() >= LEAST else _FACTOR
    if keep.sum() < LEAST:
        keep = np.zeros(n, bool)
    return AgreeingPoints(keep, residual, (float(middle[0]), float(middle[1])), factor)


def _moved(camera: CentralCamera, XYZ: Array, delta: Array) -> tuple[Array, Array]:
    """Points as a camera sees them that is moved by delta[:3] and turned by delta[3:], and ∂(x, y)/∂delta (n, 2, 6)."""
    v = (XYZ - camera.center - delta[:3]) @ small_rotations(delta[3:])
    moved = camera.center + v
    J = camera.derivatives(moved)
    # −ω × v = v × ω.
    return moved, np.concatenate([-J, J @ skew(v)], axis=-1)


def _factor(
    camera: CentralCamera, XYZ: Array, residual: Array, covariances: tuple[Array, Array], keep: NDArray[np.bool_]
) -> float:
    """Factor of the fits' standard deviations with which the residuals, as a whole, are as large as expected."""
    J = camera.derivatives(XYZ[keep])
    ground = J @ covariances[1][keep] @ J.transpose(0, 2, 1)
    fit, e = covariances[0][keep], residual[keep]
    # Six unknowns take their part of the residuals.
    expected = _MEDIAN * max(0.2, 1.0 - 3.0 / int(keep.sum()))

    def median(f: float) -> float:
        inverse = np.linalg.inv(f * f * fit + ground)
        return float(np.median(np.einsum("ni,nij,nj->n", e, inverse, e)))

    low, high = _FACTOR, 50.0
    if median(low) <= expected:
        return low
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if median(middle) > expected else (low, middle)
    return high
