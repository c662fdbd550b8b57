"""Whether the matches of a pair of images obey the geometry of two central projections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import solve
from photoplan.adjustment.robust import cauchy
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.codec import storable
from photoplan.geometry.rotation import skew
from photoplan.matching.features import opencv


@dataclass(frozen=True)
class Calibration:
    """What is known of the rays of an image."""

    interior: Interior
    lens: Lens

    def tangents(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image points (n, 2) as ideal tangent coordinates (n, 2); NaN where the lens has none."""
        return self.lens.undistort(self.interior.tangent_to_pixel.inverse(xy))

    @property
    def focal(self) -> float:
        """Pixels per unit of tangent in the middle of the image."""
        return float(np.sqrt(abs(np.linalg.det(self.interior.tangent_to_pixel.derivative(np.zeros(2))))))


@dataclass(frozen=True)
class VerifySettings:
    """When a pair counts as verified."""

    threshold: float = 2.0
    """Distance from the epipolar line up to which a match fits, pixels."""
    least: int = 16
    """Matches that must fit."""
    share: float = 0.25
    """Part of all matches of the pair that must fit."""


@storable
@dataclass(frozen=True, eq=False)
class PairMatches:
    """Verified matches of two images."""

    first: int
    second: int
    """Indices of the images."""
    features: NDArray[np.int64]
    """Indices of features in first and second image, shape (n, 2)."""
    tried: int
    """Matches before verification."""

    def __len__(self) -> int:
        return len(self.features)


def verify_pair(
    xy: tuple[NDArray[np.float64], NDArray[np.float64]],
    calibrations: tuple[Calibration | None, Calibration | None],
    settings: VerifySettings,
) -> NDArray[np.bool_]:
    """Which matches fit one geometry of the pair; none of them if it is not verified.

    With both cameras known the geometry is the essential matrix of the tangents (Nistér 2004), else the fundamental
    matrix. Flat ground is no obstacle: it leaves the essential matrix two solutions which contain the same points, and
    where it leaves the fundamental matrix undetermined, the points of a homography are taken instead.

    Parameters
    ----------
    xy : pair of ndarrays, shape (n, 2)
        Matched image points of the first and the second image, pixels.
    calibrations : pair
        Interior orientation and lens of each, None where they are not known.

    Returns
    -------
    ndarray, shape (n,)
    """
    count = len(xy[0])
    none = np.zeros(count, bool)
    if count < settings.least:
        return none
    a, b = calibrations
    if a is not None and b is not None:
        fits = _essential((a.tangents(xy[0]), b.tangents(xy[1])), settings.threshold / ((a.focal + b.focal) / 2))
    else:
        fits = _fundamental(xy, settings.threshold)
    enough = fits.sum() >= max(settings.least, settings.share * count)
    return fits if enough else none


def _essential(t: tuple[NDArray[np.float64], NDArray[np.float64]], threshold: float) -> NDArray[np.bool_]:
    cv2 = opencv()
    known: NDArray[np.bool_] = np.asarray(np.isfinite(np.concatenate(t, axis=1)).all(axis=1), np.bool_)
    fits: NDArray[np.bool_] = np.zeros(len(known), np.bool_)
    p, q = t[0][known], t[1][known]
    if len(p) < 6:
        return fits
    E, inliers = cv2.findEssentialMat(
        p, q, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=threshold, maxIters=5000
    )
    if E is None or inliers is None or E.shape != (3, 3):
        return fits
    fits[known] = _sampson(_adjusted(cv2, E, p, q, threshold), p, q) <= threshold
    return fits


def _adjusted(
    cv2: Any, E: NDArray[np.float64], p: NDArray[np.float64], q: NDArray[np.float64], threshold: float
) -> NDArray[np.float64]:
    """Essential matrix of all matches that fit: five unknowns, weights that fall with the distance (Cauchy).

    A sample of five matches gives a solution through their noise, which loses part of the right ones.
    """
    R, _, base = cv2.decomposeEssentialMat(E)
    base = base.ravel()

    def distances(E: NDArray[np.float64]) -> NDArray[np.float64]:
        return _signed(E, p, q)

    step = 1e-6
    for _ in range(10):
        across = np.linalg.svd(base[None])[2][1:]
        now = distances(skew(base) @ R)
        turned = [skew(base) @ cv2.Rodrigues(step * axis)[0] @ R for axis in np.eye(3)]
        moved = [skew(base + step * side) @ R for side in across]
        J = np.stack([(distances(m) - now) / step for m in (*turned, *moved)], axis=1)
        change = -solve(J, now, cauchy(now, 0.5 * threshold)).unknowns
        R = cv2.Rodrigues(change[:3])[0] @ R
        base = base + change[3:] @ across
        base /= np.linalg.norm(base)
        if np.abs(change).max() < 1e-7:
            break
    better = skew(base) @ R
    fit = [int((np.abs(distances(m)) <= threshold).sum()) for m in (E, better)]
    return better if fit[1] >= fit[0] else E


def _fundamental(xy: tuple[NDArray[np.float64], NDArray[np.float64]], threshold: float) -> NDArray[np.bool_]:
    cv2 = opencv()
    p, q = (np.ascontiguousarray(v) for v in xy)
    fits: NDArray[np.bool_] = np.zeros(len(p), np.bool_)
    F, _ = cv2.findFundamentalMat(p, q, cv2.USAC_MAGSAC, threshold, 0.9999, 10000)
    if F is not None and F.shape == (3, 3):
        fits = _sampson(F, p, q) <= threshold
    H, _ = cv2.findHomography(p, q, cv2.USAC_MAGSAC, 2 * threshold, maxIters=5000, confidence=0.9999)
    if H is not None and H.shape == (3, 3):
        moved = np.concatenate([p, np.ones((len(p), 1))], axis=1) @ H.T
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.linalg.norm(moved[:, :2] / moved[:, 2:] - q, axis=1) <= 2 * threshold
        if flat.sum() >= 0.8 * fits.sum():
            return flat
    return fits


def _sampson(F: NDArray[np.float64], p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of matches from their epipolar lines, to first order (Hartley and Zisserman 2004, eq. 11.9)."""
    return np.abs(_signed(F, p, q))


def _signed(F: NDArray[np.float64], p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same with a sign."""
    one = np.ones((len(p), 1))
    a, b = np.concatenate([p, one], axis=1), np.concatenate([q, one], axis=1)
    line_b, line_a = a @ F.T, b @ F
    gap = (b * line_b).sum(axis=1)
    scale = np.sqrt((line_a[:, :2] ** 2).sum(axis=1) + (line_b[:, :2] ** 2).sum(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(scale > 0, np.sqrt(2) * gap / scale, np.inf)
