"""Space resection by three points in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Steps of Newton's method that take the rounding of the closed form out of the distances.
_POLISH = 3
#: Angles by which a pencil of conics is turned, of which the best one is used, so that no root is at infinity.
_TURNS = (0.0, 0.7, 1.9)


def bearings(tangents: ArrayLike) -> Array:
    """Unit directions in camera axes, shape (..., 3), of tangent coordinates (..., 2), x right, y up."""
    t = np.asarray(tangents, float)
    d = np.concatenate([t, np.full((*t.shape[:-1], 1), -1.0)], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def three_point_poses(tangents: ArrayLike, XYZ: ArrayLike) -> tuple[Array, Array]:
    """All poses from which three points are seen as they are.

    The three law-of-cosines equations for the distances (Grunert 1841) are two conics in the ratios of the distances.
    A cubic equation gives the degenerate conic of their pencil, a pair of lines, and each line meets the other conics
    in two points: the formulation of Persson & Nordberg 2018 ("Lambda Twist: an accurate fast robust perspective three
    point (P3P) solver", ECCV), here for many triples at once.
    """
    j = bearings(tangents)
    X = np.asarray(XYZ, float)
    X = X.reshape(-1, 3, 3)
    j = j.reshape(-1, 3, 3)
    with np.errstate(all="ignore"):
        distances = _distances(j, X)
        seen = distances[..., None] * j[:, None]
        R = _triad(X)[:, None] @ np.swapaxes(_triad(seen), -1, -2)
        center = X.mean(axis=1)[:, None] - np.einsum("nkij,nkj->nki", R, seen.mean(axis=2))
    good = np.asarray(np.isfinite(R).all(axis=(-1, -2)) & np.isfinite(center).all(axis=-1))
    R[~good] = np.nan
    center[~good] = np.nan
    return R, center


def _triad(points: Array) -> Array:
    """Orthonormal axes (…, 3, 3), as columns, that three points (…, 3, 3) span; NaN for points on a line."""
    a, b = points[..., 1, :] - points[..., 0, :], points[..., 2, :] - points[..., 0, :]
    normal = np.cross(a, b)
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    long = np.linalg.norm(a, axis=-1, keepdims=True)
    flat = size <= 1e-9 * long * np.linalg.norm(b, axis=-1, keepdims=True)
    first, third = a / long, np.where(flat, np.nan, normal) / size
    return np.stack([first, np.cross(third, first), third], axis=-1)


def _distances(j: Array, X: Array) -> Array:
    """Distances to the three points, (n, 4, 3); NaN where there is no solution."""
    pairs = ((0, 1), (0, 2), (1, 2))
    cos = np.stack([(j[:, a] * j[:, b]).sum(-1) for a, b in pairs], axis=-1)
    square = np.stack([((X[:, a] - X[:, b]) ** 2).sum(-1) for a, b in pairs], axis=-1)
    # In units of the triangle's size all numbers are near one.
    unit = np.sqrt(square.sum(axis=-1, keepdims=True))
    square = square / unit**2
    M = np.zeros((3, len(j), 3, 3))
    for k, (a, b) in enumerate(pairs):
        M[k, :, a, a] = M[k, :, b, b] = 1.0
        M[k, :, a, b] = M[k, :, b, a] = -cos[:, k]
    D1 = M[0] * square[:, 2, None, None] - M[2] * square[:, 0, None, None]
    D2 = M[1] * square[:, 2, None, None] - M[2] * square[:, 1, None, None]
    line, other = _degenerate(D1, D2)
    ratios = _meet(line, other)
    scale = np.einsum("nki,nij,nkj->nk", ratios, M.sum(axis=0), ratios)
    distances = ratios * np.sqrt(square.sum(axis=-1)[:, None] / scale)[..., None]
    distances *= np.where(distances.sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
    distances = _polished(distances, cos, square)
    good = np.asarray((distances > 0).all(axis=-1))
    # The two solutions of a line that touches a conic are one.
    return np.where(good[..., None], distances, np.nan) * unit[..., None]


def _degenerate(D1: Array, D2: Array) -> tuple[Array, Array]:
    """Pairs of lines of the pencil as two vectors each (n, 2, 3), and a conic (n, 3, 3) that is not degenerate."""
    D1 = D1 / np.linalg.norm(D1, axis=(1, 2), keepdims=True)
    D2 = D2 / np.linalg.norm(D2, axis=(1, 2), keepdims=True)
    n = len(D1)
    turned = [(np.cos(t) * D1 + np.sin(t) * D2, np.cos(t) * D2 - np.sin(t) * D1) for t in _TURNS]
    lead = np.stack([np.abs(np.linalg.det(b)) for _, b in turned])
    best = np.where(np.isfinite(lead), lead, -1.0).argmax(axis=0)
    A = np.stack([a for a, _ in turned])[best, np.arange(n)]
    B = np.stack([b for _, b in turned])[best, np.arange(n)]
    cofactor = _adjugate
    coefficients = np.stack(
        [np.linalg.det(A), _trace(cofactor(A) @ B), _trace(cofactor(B) @ A), np.linalg.det(B)], axis=-1
    )
    companion = np.zeros((n, 3, 3))
    companion[:, 1, 0] = companion[:, 2, 1] = 1.0
    companion[:, :, 2] = -coefficients[:, :3] / coefficients[:, 3:]
    sound = np.asarray(np.isfinite(companion).all(axis=(1, 2)))
    companion[~sound] = np.eye(3)
    roots = np.linalg.eigvals(companion)
    g = np.asarray(roots.real, float)
    C = A[:, None] + g[..., None, None] * B[:, None]
    C /= np.linalg.norm(C, axis=(2, 3), keepdims=True)
    C[~np.isfinite(C).all(axis=(1, 2, 3))] = np.eye(3)
    value, vector = np.linalg.eigh(C)
    # Real lines: one eigenvalue on each side of zero, the middle one zero.
    real = np.minimum(-value[..., 0], value[..., 2]) - 10.0 * np.abs(value[..., 1])
    k = np.where(np.abs(roots.imag) < 1e-3 * (1.0 + np.abs(g)), real, -np.inf).argmax(axis=1)
    at = (np.arange(n), k)
    value, vector, C = value[at], vector[at], C[at]
    low = np.sqrt(np.where(value[:, 0] < 0, -value[:, 0], np.nan))[:, None] * vector[:, :, 0]
    high = np.sqrt(np.where(value[:, 2] > 0, value[:, 2], np.nan))[:, None] * vector[:, :, 2]
    lines = np.stack([high + low, high - low], axis=1)
    lines[~sound] = np.nan
    # The conic of the pencil that is least like the degenerate one.
    other = B - (B * C).sum(axis=(1, 2), keepdims=True) * C
    return lines, other / np.linalg.norm(other, axis=(1, 2), keepdims=True)


def _adjugate(A: Array) -> Array:
    """adj(A) of matrices (n, 3, 3): A adj(A) = det(A) I."""
    a, b, c = A[:, 0], A[:, 1], A[:, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)


def _trace(A: Array) -> Array:
    return np.asarray(np.trace(A, axis1=1, axis2=2), float)


def _meet(lines: Array, conic: Array) -> Array:
    """Points (n, 4, 3), up to their length, in which two lines (n, 2, 3) meet a conic (n, 3, 3); NaN if they do not."""
    axis = np.eye(3)[np.abs(np.where(np.isfinite(lines), lines, 0.0)).argmin(axis=-1)]
    p = np.cross(lines, axis)
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    q = np.cross(lines, p)
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    a = np.einsum("nki,nij,nkj->nk", p, conic, p)
    b = np.einsum("nki,nij,nkj->nk", p, conic, q)
    c = np.einsum("nki,nij,nkj->nk", q, conic, q)
    # Slightly negative by rounding where the line touches the conic.
    square = b * b - a * c
    root = np.sqrt(np.where(square > -1e-9, np.maximum(square, 0.0), np.nan))
    far = -(b + np.copysign(root, b))
    first = far[..., None] * p + a[..., None] * q
    second = c[..., None] * p + far[..., None] * q
    points = np.concatenate([first, second], axis=1)
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def _polished(distances: Array, cos: Array, square: Array) -> Array:
    """Distances after Newton's method on the three law-of-cosines equations; NaN where it does not converge."""
    c12, c13, c23 = (cos[:, None, k] for k in range(3))
    s = distances
    for step in range(_POLISH + 1):
        a, b, c = s[..., 0], s[..., 1], s[..., 2]
        miss = np.stack(
            [a * a + b * b - 2 * a * b * c12, a * a + c * c - 2 * a * c * c13, b * b + c * c - 2 * b * c * c23], axis=-1
        )
        miss -= square[:, None]
        if step == _POLISH:
            break
        J = np.zeros((*s.shape, 3))
        J[..., 0, 0], J[..., 0, 1] = 2 * (a - b * c12), 2 * (b - a * c12)
        J[..., 1, 0], J[..., 1, 2] = 2 * (a - c * c13), 2 * (c - a * c13)
        J[..., 2, 1], J[..., 2, 2] = 2 * (b - c * c23), 2 * (c - b * c23)
        det = np.linalg.det(np.where(np.isfinite(J), J, 0.0))
        able = np.abs(det) > 1e-12
        J = np.where(able[..., None, None], J, np.eye(3))
        s = np.where(able[..., None], s - np.linalg.solve(J, miss[..., None])[..., 0], s)
    return np.where((np.abs(miss).max(axis=-1) < 1e-6)[..., None], s, np.nan)
