"""Relative orientation of two images from points that both show, begun by fives of them in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.linear import solve
from photoplan.adjustment.robust import huber
from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose
from photoplan.geometry.rotation import small_rotations
from photoplan.orientation.intersection import MeasuredRays, intersect

Array = NDArray[np.float64]

_BATCH = 100
_SAMPLES = 2000
#: Points that take part in the choice between candidates, at most.
_JUDGES = 600
#: Candidates that are looked at with the depths of their points.
_FINALISTS = 30
#: Poses that are adjusted before they are compared.
_REFINED = 8
#: Least number of points that must agree.
_LEAST = 8
#: Smaller median angles between rays leave the base undetermined, radians.
_PARALLEL = 0.005
#: Monomials x^a y^b z^c: the ten of third degree, which are eliminated, then the basis of the quotient ring.
_CUBIC = ((3, 0, 0), (2, 1, 0), (2, 0, 1), (1, 2, 0), (1, 1, 1), (1, 0, 2), (0, 3, 0), (0, 2, 1), (0, 1, 2), (0, 0, 3))
_BASIS = ((2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0), (0, 1, 1), (0, 0, 2), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))
_QUADRATIC = _BASIS
_LINEAR = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))


@dataclass(frozen=True, eq=False)
class RelativeOrientation:
    """The second image in the camera axes of the first, base = 1."""

    pose: Pose
    """Projection centre (a unit vector) and rotation of the second image."""
    inliers: NDArray[np.bool_]
    """Points that agree, (n,)."""
    points: Array
    """Model coordinates of these, (n, 3); NaN for the others."""
    angle: float
    """Median angle under which the two rays of a point meet, radians."""
    rms: float
    """Root mean square of the points' distances from their epipolar lines, in tangent coordinates."""


def relate(first: ArrayLike, second: ArrayLike, sigma: float = 1e-4) -> RelativeOrientation:
    """Relative orientation without start values; half of the points may be wrong, and the scene flat.

    Essential matrices of five points (`five_point_essentials`) are judged by the points' distances from their epipolar
    lines (Sampson 1982) in the manner of Fischler & Bolles 1981 with truncated squares. Of the poses that an essential
    matrix stands for, and of the two that a plane allows, the one counts that has the points in front of both images.

    Parameters
    ----------
    first, second : array_like, shape (n, 2)
        Ideal tangent coordinates (x, y) / c of each point in both images, x right, y up.
    sigma : float
        Standard deviation of a tangent coordinate.

    Raises
    ------
    GeometryError
        Fewer than eight points agree, or the images were taken from (nearly) one place.
    """
    a, b = (np.concatenate([np.asarray(t, float), np.full((len(np.asarray(t)), 1), -1.0)], 1) for t in (first, second))
    if len(a) < _LEAST:
        raise GeometryError(f"{len(a)} common points; relative orientation needs {_LEAST} or more")
    limit = 4.0 * sigma
    rng = np.random.default_rng(1)
    judges = rng.permutation(len(a))[:_JUDGES]
    candidates = _candidates(a, b, judges, limit, rng)
    pose = _finalist(candidates, a[judges], b[judges], limit)
    inliers = np.zeros(len(a), bool)
    for _ in range(4):
        agree = _misses(_essential(pose)[None], a, b)[0] < limit
        if agree.sum() < _LEAST or (agree == inliers).all():
            break
        inliers = agree
        pose = _refined(pose, a[inliers], b[inliers], limit)
    return _completed(pose, a, b, inliers, sigma)


def _candidates(a: Array, b: Array, judges: NDArray[np.int64], limit: float, rng: np.random.Generator) -> Array:
    """Essential matrices (k, 3, 3), the best first."""
    kept, costs, needed, tried = [], [], _SAMPLES, 0
    while tried < max(_BATCH, needed):
        sample = np.argsort(rng.random((_BATCH, len(judges))), axis=1)[:, :5]
        E = five_point_essentials(a[judges][sample], b[judges][sample]).reshape(-1, 3, 3)
        E = E[np.isfinite(E[:, 0, 0])]
        r = _misses(E, a[judges], b[judges])
        kept.append(E)
        costs.append(np.minimum((r / limit) ** 2, 1.0).sum(axis=1))
        tried += _BATCH
        if len(E):
            share = float((r < limit).mean(axis=1).max())
            chance = max(1e-9, min(share**5, 1.0 - 1e-9))
            needed = min(needed, int(5 * np.ceil(-9.2 / np.log1p(-chance))))
    order = np.argsort(np.concatenate(costs), kind="stable")
    return np.concatenate(kept)[order[:_FINALISTS]]


def _misses(E: Array, a: Array, b: Array) -> Array:
    """Sampson's distances (k, n) of points from the epipolar lines of essential matrices (k, 3, 3)."""
    in_second = np.einsum("kij,nj->kni", E, a)
    in_first = np.einsum("kji,nj->kni", E, b)
    square = (in_second[..., :2] ** 2).sum(-1) + (in_first[..., :2] ** 2).sum(-1)
    return np.abs((b * in_second).sum(-1)) / np.sqrt(square + 1e-300)


def _poses(E: Array) -> list[Pose]:
    """The four poses of an essential matrix E = Rᵀ [base]×."""
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return [Pose(side * Vt[2], (U @ turn @ Vt).T) for turn in (W, W.T) for side in (1.0, -1.0)]


def _essential(pose: Pose) -> Array:
    x, y, z = pose.center
    return np.asarray(pose.R_ground_camera.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), float)


def _in_front(pose: Pose, a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether the rays of points (n, 3) approach each other in front of both images."""
    other = b @ pose.R_ground_camera.T
    aa, bb, ab = (a * a).sum(1), (other * other).sum(1), (a * other).sum(1)
    at, bt = a @ pose.center, other @ pose.center
    det = aa * bb - ab * ab
    return np.asarray(((bb * at - ab * bt) * np.sign(det) > 0) & ((ab * at - aa * bt) * np.sign(det) > 0))


def _finalist(candidates: Array, a: Array, b: Array, limit: float) -> Pose:
    """The pose with the least cost where points behind an image count as wrong; of equal ones the least tilted."""

    def cost(pose: Pose) -> tuple[float, NDArray[np.bool_]]:
        front = _in_front(pose, a, b)
        r = _misses(_essential(pose)[None], a, b)[0]
        return float(np.where(front, np.minimum((r / limit) ** 2, 1.0), 1.0).sum()), front & (r < limit)

    rough = sorted(((*cost(pose), pose) for E in candidates for pose in _poses(E)), key=lambda item: item[0])
    judged = []
    for _, inside, pose in rough[:_REFINED]:
        better = _refined(pose, a[inside], b[inside], limit) if inside.sum() >= _LEAST else pose
        judged.append((cost(better)[0], -float(better.R_ground_camera[2, 2]), better))
    if not judged:
        raise GeometryError("no relative orientation fits any five of the common points")
    least = min(item[0] for item in judged)
    return min((item for item in judged if item[0] <= 1.02 * least + 0.5), key=lambda item: item[1])[2]


def _refined(pose: Pose, a: Array, b: Array, limit: float) -> Pose:
    """Least squares of the distances from epipolar lines, the base of length one: five unknowns."""

    def signed(p: Pose) -> Array:
        E = _essential(p)
        in_second, in_first = a @ E.T, b @ E
        square = (in_second[:, :2] ** 2).sum(1) + (in_first[:, :2] ** 2).sum(1)
        return np.asarray((b * in_second).sum(1) / np.sqrt(square), float)

    def stepped(p: Pose, step: Array) -> Pose:
        side = np.linalg.svd(p.center[None])[2][1:]
        base = p.center + step[:2] @ side
        turn = small_rotations(step[2:])
        return Pose(base / np.linalg.norm(base), p.R_ground_camera @ turn)

    now = signed(pose)
    for _ in range(10):
        h = 1e-6
        J = np.stack(
            [(signed(stepped(pose, h * e)) - signed(stepped(pose, -h * e))) / (2 * h) for e in list(np.eye(5))], 1
        )
        step = -solve(J, now, huber(now, 0.5 * limit)).unknowns
        trial = stepped(pose, step)
        after = signed(trial)
        if not np.minimum(np.abs(after), limit).sum() < np.minimum(np.abs(now), limit).sum():
            break
        pose, now = trial, after
        if np.abs(step).max() < 1e-10:
            break
    return pose


def _completed(pose: Pose, a: Array, b: Array, inliers: NDArray[np.bool_], sigma: float) -> RelativeOrientation:
    """Result with the points of the model."""
    n = len(a)
    rays = MeasuredRays(
        np.repeat([0, 1], n), np.tile(np.arange(n), 2), np.concatenate([a[:, :2], b[:, :2]]), np.full((1, 2), sigma)
    )
    model = intersect([Pose(np.zeros(3), np.eye(3)), pose], rays, n, critical=6.0, min_angle=1e-4)
    inliers = inliers & (model.reason == 0)
    if inliers.sum() < _LEAST:
        raise GeometryError(f"{int(inliers.sum())} of {n} common points fit one relative orientation; 8 are needed")
    XYZ = np.where(inliers[:, None], model.XYZ, np.nan)
    away = XYZ[inliers]
    one, two = away, away - pose.center
    cos = (one * two).sum(1) / np.linalg.norm(one, axis=1) / np.linalg.norm(two, axis=1)
    angle = float(np.median(np.arccos(np.clip(cos, -1.0, 1.0))))
    if angle < _PARALLEL:
        raise GeometryError(
            f"rays of common points meet under {np.degrees(angle):.2g}° only: the images were taken from one place"
        )
    r = _misses(_essential(pose)[None], a[inliers], b[inliers])[0]
    return RelativeOrientation(pose=pose, inliers=inliers, points=XYZ, angle=angle, rms=float(np.sqrt((r * r).mean())))


def five_point_essentials(first: ArrayLike, second: ArrayLike) -> Array:
    """Essential matrices E with dᵀ₂ E d₁ = 0 for five pairs of directions.

    E lies in the four-dimensional null space of the five linear equations; det E = 0 and 2 E Eᵀ E − tr(E Eᵀ) E = 0 are
    ten cubic equations for its three coordinates (Nistér 2004, "An efficient solution to the five-point relative pose
    problem", IEEE PAMI 26). They are solved by the eigenvectors of the 10 × 10 action matrix of x on the quotient ring
    (Stewénius, Engels & Nistér 2006, "Recent developments on direct relative orientation", ISPRS Journal 60). Points
    on a plane are no special case.
    """
    a, b = np.asarray(first, float), np.asarray(second, float)
    a, b = a.reshape(-1, 5, 3), b.reshape(-1, 5, 3)
    Q = (b[:, :, :, None] * a[:, :, None, :]).reshape(-1, 5, 9)
    null = np.linalg.svd(Q)[2][:, 5:].reshape(-1, 4, 3, 3)
    # E = x N0 + y N1 + z N2 + N3: every entry is a linear polynomial, coefficients last.
    E = np.moveaxis(null, 1, -1)
    G = _eliminated(_constraints(E))
    action = np.zeros((len(a), 10, 10))
    for row, monomial in enumerate(_BASIS):
        raised = (monomial[0] + 1, monomial[1], monomial[2])
        if raised in _CUBIC:
            action[:, row] = -G[:, _CUBIC.index(raised)]
        else:
            action[:, row, _BASIS.index(raised)] = 1.0
    sound = np.asarray(np.isfinite(action).all(axis=(1, 2)))
    action[~sound] = np.eye(10)
    values, vectors = np.linalg.eig(action)
    with np.errstate(all="ignore"):
        xyz = np.swapaxes(vectors[:, 6:9] / vectors[:, 9:10], 1, 2)
        real = (np.abs(xyz.imag).max(axis=2) < 1e-8 * (1.0 + np.abs(xyz.real).max(axis=2))) & sound[:, None]
        real &= np.abs(values.imag) < 1e-8 * (1.0 + np.abs(values.real))
        weights = np.concatenate([xyz.real, np.ones((len(a), 10, 1))], axis=2)
        weights[~(real & np.isfinite(weights).all(axis=2))] = np.nan
        found = np.einsum("nkc,nijc->nkij", weights, E)
        return np.asarray(found / np.linalg.norm(found, axis=(2, 3), keepdims=True), float)


def _constraints(E: Array) -> Array:
    """Coefficients (n, 10, 20) of the ten cubic equations, of entries (n, 3, 3, 4)."""
    square = _sum([_product(E[:, :, None, k], E[:, None, :, k], 1) for k in range(3)])
    trace = square[:, 0, 0] + square[:, 1, 1] + square[:, 2, 2]
    cube = _sum([_product(square[:, :, None, k], E[:, None, k, :], 2) for k in range(3)])
    first = 2.0 * cube - _product(trace[:, None, None], E, 2)
    minors = [
        _product(E[:, 1, (k + 1) % 3], E[:, 2, (k + 2) % 3], 1)
        - _product(E[:, 1, (k + 2) % 3], E[:, 2, (k + 1) % 3], 1)
        for k in range(3)
    ]
    determinant = _sum([_product(minors[k], E[:, 0, k], 2) for k in range(3)])
    return np.concatenate([first.reshape(len(E), 9, 20), determinant[:, None]], axis=1)


def _sum(terms: list[Array]) -> Array:
    return np.asarray(np.sum(terms, axis=0), float)


def _eliminated(equations: Array) -> Array:
    """Cubic monomials by the basis: rows of G in cubic + G · basis = 0, (n, 10, 10); NaN where that fails."""
    left, right = equations[:, :, :10], equations[:, :, 10:]
    sound = np.abs(np.linalg.det(left / np.abs(left).max(axis=(1, 2), keepdims=True))) > 1e-40
    G = np.linalg.solve(np.where(sound[:, None, None], left, np.eye(10)), right)
    return np.where(sound[:, None, None], G, np.nan)


def _product(a: Array, b: Array, degree: int) -> Array:
    """Product of a polynomial of the given degree and a linear one, coefficients in the last axis."""
    table = _table(degree)
    return np.einsum("...i,...j,ijk->...k", a, b, table, optimize=True)


@cache
def _table(degree: int) -> Array:
    left = _LINEAR if degree == 1 else _QUADRATIC
    out = _QUADRATIC if degree == 1 else _CUBIC + _BASIS
    table = np.zeros((len(left), 4, len(out)))
    for i, a in enumerate(left):
        for j, b in enumerate(_LINEAR):
            table[i, j, out.index((a[0] + b[0], a[1] + b[1], a[2] + b[2]))] = 1.0
    return table
