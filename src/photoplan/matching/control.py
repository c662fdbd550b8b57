"""Control points from orthophotos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from photoplan.adjustment.least_squares import MEDIAN_2D, cauchy, huber, solve
from photoplan.cameras.base import CentralCamera, project
from photoplan.geometry.grid import Window
from photoplan.geometry.pose import skew, small_rotations
from photoplan.kernels.matching import (
    CONVERGED,
    CORRELATION,
    RESULTS,
    match_patches,
    sample_spline,
    spline_coefficients,
)
from photoplan.matching.features import GreyImage

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
#: Fits are at least so much too sure of themselves: what loops of tie points show (see `photoplan.matching.refine`).
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


#: A patch whose ground is rougher than displaces it by this is not used, pixels of the photo (reduced).
_ROUGH = 1.0


#: No position in a photo is believed to be better than this, pixels: two pictures of one place differ.
_SIGMA = 0.1


@dataclass(frozen=True, eq=False)
class Photo:
    """An image whose orientation is known approximately."""

    camera: CentralCamera
    grey: GreyImage


@dataclass(frozen=True, eq=False)
class OrthoPatch:
    """A patch of an orthophoto and its ground."""

    values: NDArray[np.float64]
    """(m, m), rows from north to south; NaN: no value."""
    XYZ: tuple[float, float, float]
    """Its middle, on the plane through its ground, metres: what is matched is the patch as a whole."""
    slope: tuple[float, float]
    """Of the plane through its ground, to the east and to the north."""
    rough: float
    """Root mean square of the ground's heights against the plane, metres."""


def patch_on(
    values: NDArray[np.float64], at: tuple[float, float], Z: NDArray[np.float64], side: float
) -> OrthoPatch | None:
    """A patch with the plane through its ground; None where its middle has no height."""
    radius = len(values) // 2
    if not np.isfinite(Z[radius, radius]):
        return None
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1] * side
    known = np.isfinite(Z)
    A = np.stack([np.ones(known.sum()), u[known], -v[known]], axis=1)
    off = Z[known] - np.median(Z[known])
    for _ in range(5):
        # Least absolute values: walls and trees tilt no plane.
        fit = solve(A, Z[known], huber(off, 0.05 * side))
        off = fit.residuals
    level, *slope = fit.unknowns.tolist()
    return OrthoPatch(values, (at[0], at[1], level), (slope[0], slope[1]), float(np.sqrt(np.mean(off**2))))


def ground_covariances(patches: Sequence[OrthoPatch], plane: float, height: float) -> NDArray[np.float64]:
    """(n, 3, 3): an error of the place changes the height that is read there, by the slope of the ground.

    plane, height: standard deviations of X and Y in the orthophoto, and of the heights; metres.
    """
    A = np.zeros((len(patches), 3, 2))
    A[:, 0, 0] = A[:, 1, 1] = 1.0
    A[:, 2] = [p.slope for p in patches]
    covariance = plane**2 * (A @ A.transpose(0, 2, 1))
    covariance[:, 2, 2] += height**2
    return np.asarray(covariance)


@dataclass(frozen=True)
class Settings:
    """How patches are matched."""

    resolution: float
    """Side of a cell, metres."""
    radius: int
    """Of a patch, cells."""
    cells: int
    """Search, cells."""
    search: float
    """Search, metres."""
    correlation: float
    """Least correlation."""


@dataclass(frozen=True, eq=False)
class ImageControl:
    """What was found in an image."""

    name: str
    tried: int
    """Patches that it may show."""
    matched: int
    points: NDArray[np.int64]
    """Numbers of the patches that agree."""
    xy: NDArray[np.float64]
    """Where they are, (n, 2), pixels."""
    sigma: NDArray[np.float64]
    """(n, 2), pixels."""
    shift: tuple[float, float]
    """Median of measured minus computed position by the approximate orientation, pixels; NaN: too few points."""
    rms: float
    """Of the residuals of a coordinate after the correction of the orientation, pixels."""
    factor: float
    """Of the fit's standard deviations."""
    reasons: dict[str, int]
    """Why patches were not taken."""


def control_of_image(
    name: str, photo: Photo, patches: Sequence[OrthoPatch], covariances: NDArray[np.float64], settings: Settings
) -> ImageControl:
    """Find the patches in a photo and keep those that agree on a correction of its orientation.

    The photo is resampled into the map, on the plane through each patch's ground, by the approximate camera. A place
    found there is carried back into the photo by the same camera and plane: no error of the orientation enters.
    """
    XYZ = np.array([p.XYZ for p in patches])
    expected = project(photo.camera, XYZ)
    size = np.array(photo.camera.size)
    tried = np.flatnonzero(((expected > 0) & (expected < size - 1)).all(axis=1))
    number, xy, fits, reasons = [], [], [], Counter[str]()
    for k in tried.tolist():
        found = _find(photo, patches[k], settings)
        if isinstance(found, str):
            reasons[found] += 1
            continue
        at, covariance = found
        number.append(k)
        xy.append(at)
        fits.append(covariance)
    index = np.array(number, np.int64)
    if not number:
        none = np.empty((0, 2))
        return ImageControl(
            name=name,
            tried=len(tried),
            matched=0,
            points=index,
            xy=none,
            sigma=none,
            shift=(np.nan, np.nan),
            rms=np.nan,
            factor=1.0,
            reasons=dict(reasons),
        )
    places, fit = np.array(xy), np.array(fits)
    fit = fit + 1e-6 * np.eye(2)
    agreed = agree(photo.camera, XYZ[index], places, (fit, covariances[index]), max(settings.search, 1.0))
    keep = agreed.keep
    if (~keep).any():
        reasons["not in agreement"] += int((~keep).sum())
    sigma = np.maximum(agreed.factor * np.sqrt(np.diagonal(fit, axis1=1, axis2=2)), _SIGMA)
    rms = float(np.sqrt((agreed.residuals[keep] ** 2).mean())) if keep.any() else float("nan")
    return ImageControl(
        name=name,
        tried=len(tried),
        matched=len(number),
        points=index[keep],
        xy=places[keep],
        sigma=sigma[keep],
        shift=agreed.shift,
        rms=rms,
        factor=agreed.factor,
        reasons=dict(reasons),
    )


def _find(photo: Photo, patch: OrthoPatch, settings: Settings) -> tuple[NDArray[np.float64], NDArray[np.float64]] | str:
    """Position in the photo and its covariance by the fit, or why there is none."""
    J = photo.camera.derivatives(np.array(patch.XYZ))
    gsd = float(1 / np.sqrt(abs(np.linalg.det(J[:, :2]))))
    factor = max(1, round(settings.resolution / gsd))
    if patch.rough * float(np.linalg.norm(J[:, 2])) > _ROUGH * factor:
        return "rough ground"
    half = settings.radius + settings.cells + 2
    row, col = np.mgrid[-half : half + 1, -half : half + 1]
    at = project(photo.camera, _on_plane(patch, col, row, settings.resolution))
    picture = _resampled(photo, at, factor)
    if picture is None:
        return "outside the photo"
    found = find_patch(patch.values, picture, settings.correlation)
    if isinstance(found, str):
        return found
    return _in_photo(photo, patch, found, half, settings)


def _on_plane(
    patch: OrthoPatch, col: NDArray[np.float64], row: NDArray[np.float64], side: float
) -> NDArray[np.float64]:
    """Ground points of cells counted from the patch's middle."""
    east, north = np.asarray(col) * side, -np.asarray(row) * side
    X, Y, level = patch.XYZ
    Z = level + patch.slope[0] * east + patch.slope[1] * north
    return np.stack([X + east, Y + north, Z], axis=-1)


def _resampled(photo: Photo, at: NDArray[np.float64], factor: int) -> NDArray[np.float64] | None:
    """Grey values of the photo (means of factor × factor pixels) at image points; NaN outside."""
    small = (at + 0.5) / factor - 0.5
    size = np.array(photo.camera.size) // factor
    known: NDArray[np.bool_] = np.asarray(np.isfinite(small).all(axis=-1), np.bool_)
    if not known.any():
        return None
    low = np.maximum(np.floor(small[known].min(axis=0)).astype(int) - 3, 0)
    high = np.minimum(np.ceil(small[known].max(axis=0)).astype(int) + 4, size)
    if (high - low < 8).any():
        return None
    window = Window(int(low[0]), int(low[1]), *(int(v) for v in high - low))
    pixels = photo.grey.reduced(window, factor).astype(float)
    valid = np.isfinite(pixels)
    if not valid.any():
        return None
    coefficients = np.where(valid, pixels, pixels[valid].mean())[None].copy()
    spline_coefficients(coefficients)
    local = np.where(known[..., None], small - low, -9.0).reshape(-1, 2)
    values = np.empty(len(local))
    sample_spline(coefficients[0], np.ascontiguousarray(local), values)
    if not valid.all():
        nearest = np.clip(np.rint(local).astype(int), 0, high - low - 1)
        values[~valid[nearest[:, 1], nearest[:, 0]]] = np.nan
    return values.reshape(at.shape[:2])


def _in_photo(
    photo: Photo, patch: OrthoPatch, found: FoundPatch, half: int, settings: Settings
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    col, row = (v - half for v in found.at)
    step = 0.5
    around = np.array([[0.0, 0.0], [step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]])
    at = project(photo.camera, _on_plane(patch, col + around[:, 0], row + around[:, 1], settings.resolution))
    J = np.stack([at[1] - at[2], at[3] - at[4]], axis=1) / (2 * step)
    return at[0], J @ found.covariance @ J.T
