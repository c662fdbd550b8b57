"""Pose of an image from points without start values, in the presence of gross errors."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, islice, product
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.iterate import levenberg
from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose
from photoplan.geometry.rotation import skew, small_rotations
from photoplan.orientation.resection.p3p import three_point_poses

Array = NDArray[np.float64]

#: Triples that are tried at most; all of them where there are no more.
_TRIPLES = 600
_BATCH = 100
#: Points that take part in the choice between candidates, at most.
_JUDGES = 400
#: Points on a line: their extent across it is smaller than this part of the extent along it.
_COLLINEAR = 1e-4
#: With so few points another pose may fit as well; it is looked for.
_FEW = 6
#: Centres closer than this, in units of the points' extent, are one pose.
_SAME = 2e-3
#: A pose fits whose residuals are below this, in units of three standard deviations.
_FITS = 4.0 / 3.0


@dataclass(frozen=True, eq=False)
class DirectPose:
    """Result of `resect_direct`."""

    pose: Pose
    inliers: NDArray[np.bool_]
    """Points that agree with the pose, (n,)."""
    scale: float
    """Standard deviation of a tangent coordinate of these."""


def resect_direct(
    tangents: ArrayLike, XYZ: ArrayLike, sigma: float = 1e-4, near: Pose | None = None, seed: int = 1
) -> DirectPose:
    """Pose from three or more points, no approximate values needed, up to nearly half of the points being wrong.

    Poses of triples (`three_point_poses`) are judged by all points: the one with the least median of squares
    (Rousseeuw 1984) sets the scale of the noise, then the least sum of truncated squares decides.

    Parameters
    ----------
    tangents : array_like, shape (n, 2)
        Ideal tangent coordinates (x, y) / c, x right, y up.
    XYZ : array_like, shape (n, 3)
        Points in Cartesian ground coordinates, metres.
    sigma : float
        Standard deviation of a tangent coordinate, as stated.
    near : Pose, optional
        Decides where several poses fit equally well.
    seed : int
        Of the choice of triples, where not all are tried.

    Raises
    ------
    GeometryError
        Fewer than three points, points on a line, or points that leave several poses possible.
    """
    t, X = np.asarray(tangents, float), np.asarray(XYZ, float)
    if len(t) < 3:
        raise GeometryError(f"{len(t)} points; space resection needs 3, and a fourth to be checked")
    _refuse_line(X)
    origin = X.mean(axis=0)
    X = X - origin
    judges = np.arange(len(X))
    if len(X) > _JUDGES:
        judges = np.random.default_rng(seed).permutation(len(X))[:_JUDGES]
    R, centers = _candidates(t, X, judges, sigma, seed)
    if not len(R):
        raise GeometryError(f"no pose fits any three of the {len(t)} points; are they the points that were measured?")
    r = _distances(R, centers, t[judges], X[judges])
    fitting = int((r < 4.0 * sigma).sum(axis=1).max())
    # Where most points agree as well as they are said to, nothing need be learnt of the noise.
    scale = sigma if fitting >= max(4, int(np.ceil(0.6 * r.shape[1]))) else max(sigma, _median_scale(r))
    cost = np.minimum((r / (3.0 * scale)) ** 2, 1.0).sum(axis=1)
    order = np.argsort(cost, kind="stable")
    around = None if near is None else Pose(near.center - origin, near.R_ground_camera)
    pose = _best(R[order], centers[order], (t, X), scale, around, scale <= sigma)
    return _finished(pose, t, X, sigma, origin)


def _refuse_line(X: Array) -> None:
    extent = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    if extent[1] <= _COLLINEAR * extent[0]:
        raise GeometryError(
            f"all {len(X)} points lie on one line (within {extent[1] / np.sqrt(len(X)):.3g} m): the camera can turn "
            "about it; a point beside the line is needed"
        )


def _candidates(t: Array, X: Array, judges: NDArray[np.int64], sigma: float, seed: int) -> tuple[Array, Array]:
    """Poses of triples, until enough of them have been tried."""
    Rs, Cs, tried, needed = [], [], 0, _TRIPLES
    for triples in _triples(len(t), seed):
        R, C = three_point_poses(t[triples], X[triples])
        good = np.isfinite(C[..., 0])
        Rs.append(R[good])
        Cs.append(C[good])
        tried += len(triples)
        if len(t) > _FEW and len(Rs[-1]):
            r = _distances(Rs[-1], Cs[-1], t[judges], X[judges])
            share = (r < 3.0 * sigma).mean(axis=1).max()
            # One triple free of gross errors with a certainty of 1 − 1e-6; several, as noise spoils some.
            chance = max(1e-9, min(share**3, 1.0 - 1e-9))
            needed = min(needed, int(8 * np.ceil(-13.8 / np.log1p(-chance))))
        if tried >= max(_BATCH, needed):
            break
    return np.concatenate(Rs), np.concatenate(Cs)


def _triples(n: int, seed: int) -> list[NDArray[np.int64]]:
    """Batches of triples of point numbers."""
    if comb(n, 3) <= _TRIPLES:
        chosen = np.array(list(islice(combinations(range(n), 3), _TRIPLES)), np.int64)
    else:
        rng = np.random.default_rng(seed)
        chosen = np.argsort(rng.random((_TRIPLES, min(n, 4000))), axis=1)[:, :3]
        if n > 4000:
            chosen = rng.integers(0, n, (_TRIPLES, 3))
            chosen = chosen[(np.diff(np.sort(chosen, axis=1), axis=1) > 0).all(axis=1)]
    return [chosen[k : k + _BATCH] for k in range(0, len(chosen), _BATCH)]


def reprojected(R: Array, centers: Array, X: Array) -> Array:
    """Tangent coordinates (k, n, 2) of points (n, 3) by poses (k, 3, 3), (k, 3); NaN behind the camera."""
    p = np.einsum("knj,kji->kni", X[None] - centers[:, None], R)
    with np.errstate(all="ignore"):
        return p[..., :2] / np.where(p[..., 2:] < 0, -p[..., 2:], np.nan)


def _distances(R: Array, centers: Array, t: Array, X: Array) -> Array:
    """Distances (k, n) of reprojected from measured points; infinite behind the camera."""
    r = np.linalg.norm(reprojected(R, centers, X) - t, axis=-1)
    return np.where(np.isfinite(r), r, np.inf)


def _median_scale(r: Array) -> float:
    """Standard deviation of a coordinate by the best pose's median distance; a little more than half of the points."""
    n = r.shape[1]
    h = min(n, max(4, n // 2 + 1))
    least = float(np.partition(r, h - 1, axis=1)[:, h - 1].min())
    # The distance below which the share (h − 3/2) / (n − 3/2) of normally distributed points lies, for σ = 1. Half of
    # the three points that were fitted counts as an estimate of a coordinate each.
    share = min((h - 1.5) / (n - 1.5), 0.95)
    return least / float(np.sqrt(-2.0 * np.log1p(-share))) if np.isfinite(least) else 0.0


def _best(R: Array, centers: Array, points: tuple[Array, Array], scale: float, near: Pose | None, sure: bool) -> Pose:
    """The pose that fits best, of candidates in the order of their cost.

    Where the noise is known (`sure`) and the points are few, several poses may see all of them as they were measured:
    then the one nearest to `near` is it, and without that none.
    """
    t, X = points
    few = len(t) <= _FEW
    size = float(np.linalg.norm(X, axis=1).mean())
    kept: list[tuple[float, bool, Pose]] = []
    # Noise of three points may grow at the others, so that few points are also adjusted all together.
    limits = (4.0, np.inf) if few else (4.0,)
    for k, limit in product(range(min(len(R), 60 if few else 5)), limits):
        pose = Pose(centers[k], R[k])
        inside = _distances(R[k : k + 1], centers[k : k + 1], t, X)[0] < limit * scale
        pose = polished_pose(pose, t, X, inside) if inside.sum() >= 3 else pose
        r = _distances(pose.R_ground_camera[None], pose.center[None], t, X)[0] / (3.0 * scale)
        if (r < _FITS).all():
            # One minimum is one pose, whichever points led there.
            pose = polished_pose(pose, t, X, np.ones(len(t), bool), 20)
        found = (float(np.minimum(r * r, 1.0).sum()), bool((r < _FITS).all()), pose)
        same = [i for i, (_, _, other) in enumerate(kept) if np.linalg.norm(pose.center - other.center) < _SAME * size]
        if not same:
            kept.append(found)
        elif found[0] < kept[same[0]][0]:
            kept[same[0]] = found
    fitting = [pose for _, fits, pose in kept if fits] if few and sure else []
    if fitting and near is not None:
        # Where the camera lies on the cylinder about three points, noise may leave no closed solution there.
        # The minimum next to it, also where the points hardly determine it.
        there = polished_pose(near, t, X, np.ones(len(t), bool), 200)
        if (_distances(there.R_ground_camera[None], there.center[None], t, X)[0] / (3.0 * scale) < _FITS).all():
            fitting.append(there)
    if len(fitting) < 2:
        return min(kept, key=lambda item: item[0])[2]
    if near is None:
        raise GeometryError(
            f"{len(t)} points leave {len(fitting)} positions of the camera possible; a further point apart from these, "
            "or an approximate orientation, is needed"
        )
    return min(fitting, key=lambda pose: _apart(pose, near, size))


def _apart(a: Pose, b: Pose, size: float) -> float:
    """How different two poses are: distance in units of the points' extent, and sine of half the turn."""
    turn = np.linalg.norm(a.R_ground_camera - b.R_ground_camera) / np.sqrt(8.0)
    return float(np.linalg.norm(a.center - b.center) / size + turn)


def _finished(pose: Pose, t: Array, X: Array, sigma: float, origin: Array) -> DirectPose:
    """The pose by all points that agree with it, back in ground coordinates."""
    inside = np.zeros(len(t), bool)
    scale = sigma
    for _ in range(5):
        r = _distances(pose.R_ground_camera[None], pose.center[None], t, X)[0]
        scale = max(sigma, _median_scale(r[None]))
        agree = r < 4.0 * scale
        if agree.sum() < 3 or (agree == inside).all():
            break
        inside = agree
        pose = polished_pose(pose, t, X, inside)
    return DirectPose(Pose(pose.center + origin, pose.R_ground_camera), inside, float(scale))


def tangent_derivatives(pose: Pose, X: Array) -> tuple[Array, Array, Array, Array]:
    """Tangent coordinates (n, 2), their derivatives (n, 2, 6) by the pose and (n, 2, 3) by the points, depth (n,).

    The pose changes by its centre and by small rotations about the camera's axes, R ← R · exp[δ]×.
    """
    R = pose.R_ground_camera
    p = (X - pose.center) @ R
    depth = -p[:, 2]
    t = p[:, :2] / depth[:, None]
    by_p = np.zeros((len(X), 2, 3))
    by_p[:, 0, 0] = by_p[:, 1, 1] = 1.0
    by_p[:, :, 2] = t
    by_p /= depth[:, None, None]
    by_X = by_p @ R.T
    return t, np.concatenate([-by_X, by_p @ skew(p)], axis=2), by_X, depth


def polished_pose(pose: Pose, t: Array, X: Array, use: NDArray[np.bool_], iterations: int = 8) -> Pose:
    """Least squares over some points, all of one weight; the pose itself where that gets worse."""
    t, X = t[use], X[use]

    def equations(pose: Pose) -> tuple[Array, Array] | None:
        computed, A, _, depth = tangent_derivatives(pose, X)
        return (A.reshape(-1, 6), (computed - t).ravel()) if (depth > 0).all() else None

    return levenberg(pose, equations, moved, iterations).state if equations(pose) is not None else pose


def moved(pose: Pose, step: Array) -> Pose:
    """Pose after a step (6,): centre, then small rotations about the camera's axes."""
    return Pose(pose.center + step[:3], pose.R_ground_camera @ small_rotations(step[3:6]))
