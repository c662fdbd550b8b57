"""Patches of an orthophoto in one photo."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import solve
from photoplan.adjustment.robust import huber
from photoplan.cameras.base import CentralCamera, project
from photoplan.geometry.grid import Window
from photoplan.kernels.patch_match import sample_spline, spline_coefficients
from photoplan.matching.control import FoundPatch, agree, find_patch
from photoplan.matching.grey import GreyImage

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
