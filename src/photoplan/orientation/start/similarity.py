"""Similarity transformation in space: seven parameters from points in two systems."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose

Array = NDArray[np.float64]

_TRIPLES = 500
#: Points on a line: their extent across it is smaller than this part of the extent along it.
_COLLINEAR = 0.01


@dataclass(frozen=True, eq=False)
class Similarity:
    """X' = scale · R X + shift."""

    scale: float
    R: Array
    shift: Array

    def __call__(self, XYZ: ArrayLike) -> Array:
        """Points (..., 3) in the target system."""
        return self.scale * (np.asarray(XYZ, float) @ self.R.T) + self.shift

    def pose(self, pose: Pose) -> Pose:
        """A pose in the target system."""
        return Pose(self(pose.center), self.R @ pose.R_ground_camera)


def fit_similarity(source: ArrayLike, target: ArrayLike) -> Similarity:
    """Least-squares similarity in closed form (Horn 1987; by singular values: Umeyama 1991, IEEE PAMI 13).

    Parameters
    ----------
    source, target : array_like, shape (n, 3)

    Raises
    ------
    GeometryError
        Fewer than three points, or points on a line.
    """
    a, b = np.asarray(source, float), np.asarray(target, float)
    if len(a) < 3:
        raise GeometryError(f"{len(a)} points known in both systems; a similarity transformation needs 3")
    w = np.full(len(a), 1.0 / len(a))
    ma, mb = w @ a, w @ b
    a, b = a - ma, b - mb
    for extent in (np.linalg.svd(points, compute_uv=False) for points in (a, b)):
        if not extent[1] > _COLLINEAR * extent[0]:
            raise GeometryError(
                f"the {len(a)} points known in both systems lie on one line: the rotation about it is not determined"
            )
    U, s, Vt = np.linalg.svd((b * w[:, None]).T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * sign) @ Vt
    scale = float((s * sign).sum() / (w @ (a * a).sum(axis=1)))
    return Similarity(scale, R, mb - scale * R @ ma)


def robust_similarity(source: ArrayLike, target: ArrayLike, tolerance: float) -> tuple[Similarity, NDArray[np.bool_]]:
    """Similarity that less than half of the points being wrong does not disturb, and the points that agree (n,).

    Three points each make a transformation; the one with the least median of distances decides which points agree.
    """
    a, b = np.asarray(source, float), np.asarray(target, float)
    if len(a) < 4:
        return fit_similarity(a, b), np.ones(len(a), bool)
    triples = list(combinations(range(len(a)), 3)) if comb(len(a), 3) <= _TRIPLES else None
    if triples is None:
        rng = np.random.default_rng(1)
        triples = [tuple(rng.choice(len(a), 3, replace=False)) for _ in range(_TRIPLES)]
    best = fit_similarity(a, b)
    h = min(len(a), max(4, len(a) // 2 + 1)) - 1
    least = np.sort(np.linalg.norm(best(a) - b, axis=1))[h]
    for triple in triples:
        k = list(triple)
        try:
            tried = fit_similarity(a[k], b[k])
        except GeometryError:
            continue
        r = np.sort(np.linalg.norm(tried(a) - b, axis=1))[h]
        if r < least:
            best, least = tried, r
    agree = np.linalg.norm(best(a) - b, axis=1) <= max(tolerance, 3.0 * least)
    try:
        return fit_similarity(a[agree], b[agree]), agree
    except GeometryError:
        return best, agree
