"""Resection of single images: direct solutions and adjustment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import combinations, islice, product
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from photoplan.adjustment.least_squares import levenberg, spread
from photoplan.adjustment.statistics import reach_t
from photoplan.arrays import Floats, Ints, Mask
from photoplan.cameras.base import Camera, project
from photoplan.cameras.framed import oriented_camera
from photoplan.cameras.lenses import Brown, Interior, Lens, NoLens, field_limited
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.geometry.pose import UNKNOWNS, Pose, skew, small_rotations
from photoplan.orientation.bundle.equations import by_coefficient
from photoplan.orientation.bundle.model import PARAMETERS, CameraState

#: Parameters of the camera that can be unknowns.
FREE = PARAMETERS


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """Points of one image with their ground coordinates."""

    names: tuple[str, ...]
    xy: Floats
    """Measured column and row, (n, 2), pixels."""
    sigma: Floats
    """Their standard deviations, (n, 2), pixels."""
    XYZ: Floats
    """Ground coordinates, (n, 3), metres."""
    covariance: Floats
    """Of those, (n, 3, 3), m²; zero: free of error."""

    def __post_init__(self) -> None:
        n = len(self.names)
        for name, shape in (("xy", (n, 2)), ("sigma", (n, 2)), ("XYZ", (n, 3)), ("covariance", (n, 3, 3))):
            value = np.array(np.broadcast_to(np.asarray(getattr(self, name), float), shape))
            bad = ~np.isfinite(value).all(axis=tuple(range(1, value.ndim)))
            if bad.any():
                raise InputError(f"point {self.names[int(bad.argmax())]!r}: its {name} is not finite")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if not (self.sigma > 0).all():
            raise InputError("standard deviations of image points must be positive")

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class ResectSettings:
    """How a resection is done."""

    free: tuple[str, ...] = ()
    """Parameters of the camera that are unknowns: c, x0, y0, and coefficients of the lens by their names with y up."""
    camera_constant_known: bool = True
    """False: c is an unknown, and the stated one is not even a start value."""
    critical: float = 4.0
    """Normalised residual, in units of sigma0, from which a point is taken out as a gross error."""

    def __post_init__(self) -> None:
        unknown = [name for name in self.free if name not in FREE]
        if unknown:
            raise UsageError(f"free parameter {unknown[0]!r}; resection of one image allows {', '.join(FREE)}")
        chosen = set(self.free) | (set() if self.camera_constant_known else {"c"})
        object.__setattr__(self, "free", tuple(p for p in FREE if p in chosen))


@dataclass(frozen=True, eq=False)
class Resected:
    """Result of a resection. Covariances hold sigma0 already."""

    pose: Pose
    interior: Interior
    """As given, or with the parameters that were free."""
    lens: Lens
    covariance: Floats
    """(6 + k, 6 + k): projection centre in metres, small rotations about the camera's x, y, z axes in radians
    (R ← R · exp[δ]×), then the free parameters in the unit of the image plane."""
    free: tuple[str, ...]
    residuals: Floats
    """Computed minus measured position of every point, (n, 2), pixels (column, row); of rejected points too."""
    redundancies: Floats
    """Redundancy numbers of the measurements, (n, 2); NaN for rejected points."""
    normalised: Floats
    """Residuals divided by their standard deviations (those before the adjustment, without sigma0), (n, 2); NaN where
    no other point controls the measurement."""
    rejected: Mask
    """Points taken out as gross errors, (n,)."""
    sigma0: float
    """Standard deviation of unit weight; 1 without redundancy."""
    redundancy: int
    notes: tuple[str, ...] = ()
    """What a user should know: errors that cannot be located …"""

    @property
    def rms(self) -> float:
        """Root mean square of the residuals of one coordinate over the points that take part, pixels."""
        return float(np.sqrt((self.residuals[~self.rejected] ** 2).mean()))

    @property
    def reach_95(self) -> float:
        """Standard deviations within which 95 % of the errors lie: more than 1.96, since few points tell sigma0 badly.

        NaN without redundancy.
        """
        return reach_t(0.95, self.redundancy)


#: The camera in ground coordinates that a pose makes: with earth curvature and refraction.
CameraOf = Callable[[Interior, Lens, Pose], Camera]


#: Largest standard deviation of an unknown, in units of its natural size (distance of the points, radian, camera
#: constant): with more the linear adjustment says nothing any more.
UNDETERMINED = 0.1
#: Smaller singular values than this part of the largest are rounding.
_ROUNDING = 1e-10


@dataclass(frozen=True, eq=False)
class ResectionUnknowns:
    """How the unknowns of a resection are called."""

    where: str
    """Begin of messages: "image 'a': its 5 control points"."""
    units: Floats
    """Natural size of each unknown, (u,)."""
    free: tuple[str, ...]
    """Names of those after the pose."""
    sigma: float
    """Standard deviation of a measurement, pixels."""


def refuse_undetermined(A: Floats, sigma0: float, unknowns: ResectionUnknowns) -> Floats:
    """Inverse normal equations of whitened equations (m, u) in natural units."""
    s, Vt = np.linalg.svd(A, full_matrices=False)[1:]
    worst = Vt[-1]
    if len(A) >= A.shape[1] and s[-1] > _ROUNDING * s[0] and max(1.0, sigma0) / s[-1] <= UNDETERMINED:
        return np.asarray((Vt.T / s**2) @ Vt, float)
    raise GeometryError(f"{unknowns.where} do not determine {_spelled(worst, float(s[-1]), unknowns)}")


def _spelled(direction: Floats, singular: float, unknowns: ResectionUnknowns) -> str:
    """A combination of unknowns that leaves the image as it is, in numbers."""
    share = np.abs(direction)
    parts = [int(k) for k in np.argsort(-share) if share[k] > 0.1 * share.max()]
    names = [*UNKNOWNS, *unknowns.free]
    # One percent of the natural size of what changes most.
    step = direction * (0.01 / direction[parts[0]])
    said = [_change(names[k], float(step[k] * unknowns.units[k]), k) for k in parts]
    moved = float(np.linalg.norm(step)) * singular * unknowns.sigma
    together = f"{' and '.join(names[k] for k in parts)}" + (" apart" if len(parts) > 1 else "")
    way = "hold a parameter fixed or " if unknowns.free else ""
    return (
        f"{together}: {', '.join(said)} alter{'s' * (len(said) == 1)} all image points together by {moved:.2g} px; "
        f"{way}use control points that are spread over the image and differ in height"
    )


def _change(name: str, value: float, k: int) -> str:
    if k < 3:
        return f"{name} {value:+.4g} m"
    if k < 6:
        return f"{name} {np.degrees(value):+.3g}°"
    return f"{name} {value:+.4g}"


#: Steps of Newton's method that take the rounding of the closed form out of the distances.
_POLISH = 3
#: Angles by which a pencil of conics is turned, of which the best one is used, so that no root is at infinity.
_TURNS = (0.0, 0.7, 1.9)


def bearings(tangents: ArrayLike) -> Floats:
    """Unit directions in camera axes, shape (..., 3), of tangent coordinates (..., 2), x right, y up."""
    t = np.asarray(tangents, float)
    d = np.concatenate([t, np.full((*t.shape[:-1], 1), -1.0)], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def three_point_poses(tangents: ArrayLike, XYZ: ArrayLike) -> tuple[Floats, Floats]:
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


def _triad(points: Floats) -> Floats:
    """Orthonormal axes (…, 3, 3), as columns, that three points (…, 3, 3) span; NaN for points on a line."""
    a, b = points[..., 1, :] - points[..., 0, :], points[..., 2, :] - points[..., 0, :]
    normal = np.cross(a, b)
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    long = np.linalg.norm(a, axis=-1, keepdims=True)
    flat = size <= 1e-9 * long * np.linalg.norm(b, axis=-1, keepdims=True)
    first, third = a / long, np.where(flat, np.nan, normal) / size
    return np.stack([first, np.cross(third, first), third], axis=-1)


def _distances(j: Floats, X: Floats) -> Floats:
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


def _degenerate(D1: Floats, D2: Floats) -> tuple[Floats, Floats]:
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


def _adjugate(A: Floats) -> Floats:
    """adj(A) of matrices (n, 3, 3): A adj(A) = det(A) I."""
    a, b, c = A[:, 0], A[:, 1], A[:, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)


def _trace(A: Floats) -> Floats:
    return np.asarray(np.trace(A, axis1=1, axis2=2), float)


def _meet(lines: Floats, conic: Floats) -> Floats:
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


def _polished(distances: Floats, cos: Floats, square: Floats) -> Floats:
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
    inliers: Mask
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
    r = _distances_direct(R, centers, t[judges], X[judges])
    fitting = int((r < 4.0 * sigma).sum(axis=1).max())
    # Where most points agree as well as they are said to, nothing need be learnt of the noise.
    scale = sigma if fitting >= max(4, int(np.ceil(0.6 * r.shape[1]))) else max(sigma, _median_scale(r))
    cost = np.minimum((r / (3.0 * scale)) ** 2, 1.0).sum(axis=1)
    order = np.argsort(cost, kind="stable")
    around = None if near is None else Pose(near.center - origin, near.R_ground_camera)
    pose = _best(R[order], centers[order], (t, X), scale, around, scale <= sigma)
    return _finished(pose, t, X, sigma, origin)


def _refuse_line(X: Floats) -> None:
    extent = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    if extent[1] <= _COLLINEAR * extent[0]:
        raise GeometryError(
            f"all {len(X)} points lie on one line (within {extent[1] / np.sqrt(len(X)):.3g} m): the camera can turn "
            "about it; a point beside the line is needed"
        )


def _candidates(t: Floats, X: Floats, judges: Ints, sigma: float, seed: int) -> tuple[Floats, Floats]:
    """Poses of triples, until enough of them have been tried."""
    Rs, Cs, tried, needed = [], [], 0, _TRIPLES
    for triples in _triples(len(t), seed):
        R, C = three_point_poses(t[triples], X[triples])
        good = np.isfinite(C[..., 0])
        Rs.append(R[good])
        Cs.append(C[good])
        tried += len(triples)
        if len(t) > _FEW and len(Rs[-1]):
            r = _distances_direct(Rs[-1], Cs[-1], t[judges], X[judges])
            share = (r < 3.0 * sigma).mean(axis=1).max()
            # One triple free of gross errors with a certainty of 1 − 1e-6; several, as noise spoils some.
            chance = max(1e-9, min(share**3, 1.0 - 1e-9))
            needed = min(needed, int(8 * np.ceil(-13.8 / np.log1p(-chance))))
        if tried >= max(_BATCH, needed):
            break
    return np.concatenate(Rs), np.concatenate(Cs)


def _triples(n: int, seed: int) -> list[Ints]:
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


def reprojected(R: Floats, centers: Floats, X: Floats) -> Floats:
    """Tangent coordinates (k, n, 2) of points (n, 3) by poses (k, 3, 3), (k, 3); NaN behind the camera."""
    p = np.einsum("knj,kji->kni", X[None] - centers[:, None], R)
    with np.errstate(all="ignore"):
        return p[..., :2] / np.where(p[..., 2:] < 0, -p[..., 2:], np.nan)


def _distances_direct(R: Floats, centers: Floats, t: Floats, X: Floats) -> Floats:
    """Distances (k, n) of reprojected from measured points; infinite behind the camera."""
    r = np.linalg.norm(reprojected(R, centers, X) - t, axis=-1)
    return np.where(np.isfinite(r), r, np.inf)


def _median_scale(r: Floats) -> float:
    """Standard deviation of a coordinate by the best pose's median distance; a little more than half of the points."""
    n = r.shape[1]
    h = min(n, max(4, n // 2 + 1))
    least = float(np.partition(r, h - 1, axis=1)[:, h - 1].min())
    # The distance below which the share (h − 3/2) / (n − 3/2) of normally distributed points lies, for σ = 1. Half of
    # the three points that were fitted counts as an estimate of a coordinate each.
    share = min((h - 1.5) / (n - 1.5), 0.95)
    return least / float(np.sqrt(-2.0 * np.log1p(-share))) if np.isfinite(least) else 0.0


def _best(
    R: Floats, centers: Floats, points: tuple[Floats, Floats], scale: float, near: Pose | None, sure: bool
) -> Pose:
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
        inside = _distances_direct(R[k : k + 1], centers[k : k + 1], t, X)[0] < limit * scale
        pose = polished_pose(pose, t, X, inside) if inside.sum() >= 3 else pose
        r = _distances_direct(pose.R_ground_camera[None], pose.center[None], t, X)[0] / (3.0 * scale)
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
        if (_distances_direct(there.R_ground_camera[None], there.center[None], t, X)[0] / (3.0 * scale) < _FITS).all():
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


def _finished(pose: Pose, t: Floats, X: Floats, sigma: float, origin: Floats) -> DirectPose:
    """The pose by all points that agree with it, back in ground coordinates."""
    inside = np.zeros(len(t), bool)
    scale = sigma
    for _ in range(5):
        r = _distances_direct(pose.R_ground_camera[None], pose.center[None], t, X)[0]
        scale = max(sigma, _median_scale(r[None]))
        agree = r < 4.0 * scale
        if agree.sum() < 3 or (agree == inside).all():
            break
        inside = agree
        pose = polished_pose(pose, t, X, inside)
    return DirectPose(Pose(pose.center + origin, pose.R_ground_camera), inside, float(scale))


def tangent_derivatives(pose: Pose, X: Floats) -> tuple[Floats, Floats, Floats, Floats]:
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


def polished_pose(pose: Pose, t: Floats, X: Floats, use: Mask, iterations: int = 8) -> Pose:
    """Least squares over some points, all of one weight; the pose itself where that gets worse."""
    t, X = t[use], X[use]

    def equations(pose: Pose) -> tuple[Floats, Floats] | None:
        computed, A, _, depth = tangent_derivatives(pose, X)
        return (A.reshape(-1, 6), (computed - t).ravel()) if (depth > 0).all() else None

    return levenberg(pose, equations, moved, iterations).state if equations(pose) is not None else pose


def moved(pose: Pose, step: Floats) -> Pose:
    """Pose after a step (6,): centre, then small rotations about the camera's axes."""
    return Pose(pose.center + step[:3], pose.R_ground_camera @ small_rotations(step[3:6]))


#: Camera constants that are tried where it is not known, in units of the image's longer side.
_SCAN = np.geomspace(0.3, 10.0, 48)
_ITERATIONS = 60
#: Part of a point's variance that residuals must keep, or it is not controlled by the others.
_UNCONTROLLED = 1e-6


def tangents_of(interior: Interior, lens: Lens, xy: Floats) -> Floats:
    """Ideal tangent coordinates (n, 2) of measured positions in pixels; NaN where the lens has no solution."""
    return field_limited(lens, interior).undistort(interior.tangent_to_pixel.inverse(xy))


@dataclass(frozen=True, eq=False)
class _Task:
    """What stays the same while adjusting."""

    points: MeasuredPoints
    lens: Lens
    settings: ResectSettings
    camera_of: CameraOf | None
    name: str


@dataclass(frozen=True, eq=False)
class _State:
    """What changes."""

    pose: Pose
    interior: Interior
    lens: Lens


@dataclass(frozen=True, eq=False)
class _Equations:
    """Whitened observation equations at a state: v = A·step + misclosure."""

    A: Floats
    """(n, 2, u)."""
    v: Floats
    """Whitened residuals (n, 2)."""
    root: Floats
    """Cholesky factors of the covariances of the measurements, control included, (n, 2, 2)."""
    residuals: Floats
    """In pixels, (n, 2)."""
    units: Floats
    """Natural size of each unknown, (u,): distance, radian, camera constant."""
    sound: bool = field(default=True)
    """Whether all points lie in front of the camera."""


def resect(
    points: MeasuredPoints,
    interior: Interior,
    lens: Lens,
    settings: ResectSettings | None = None,
    *,
    camera_of: CameraOf | None = None,
    near: Pose | None = None,
    name: str = "image",
) -> Resected:
    """Orient one image.

    Control points are observations too: with the covariances of image and ground points, every point gives two
    equations with the covariance Σ = Σ_image + (∂x/∂X) Σ_ground (∂x/∂X)ᵀ, the same
    adjustment (Ecker 1991, §4.5).

    Parameters
    ----------
    interior, lens
        Interior orientation, approximate for free parameters.
    camera_of : callable, optional
        The camera that a pose makes where central projection in the given coordinates is not all: earth curvature,
        refraction. What it adds to central projection is taken off the measurements, again at every step. The
        result is the pose with which this camera reproduces the points.
    near : Pose, optional
        Approximate pose, which decides only where points leave several poses possible.
    name : str
        How the image is called in messages.

    Raises
    ------
    GeometryError
        The points do not determine the unknowns; the message names these.
    """
    settings = settings or ResectSettings()
    if isinstance(lens, NoLens) and set(settings.free) - {"c", "x0", "y0"}:
        lens = Brown()
    task = _Task(points=points, lens=lens, settings=settings, camera_of=camera_of, name=name)
    unknowns = 6 + len(settings.free)
    if 2 * len(points) < unknowns or len(points) < 3:
        raise GeometryError(
            f"image {name!r}: {len(points)} control point{'s' * (len(points) != 1)} for {unknowns} unknowns (pose"
            f"{', ' + ', '.join(settings.free) if settings.free else ''}); at least {max(3, -(-unknowns // 2))} are "
            "needed, one more to check them"
        )
    try:
        state, inliers = _start(task, interior, near)
    except GeometryError as error:
        raise GeometryError(f"image {name!r}: {error}") from None
    if inliers.sum() < max(3, -(-unknowns // 2)):
        inliers[:] = True
    return _cleaned(task, state, inliers)


def _start(task: _Task, interior: Interior, near: Pose | None) -> tuple[_State, Mask]:
    """State and inliers of the direct solution."""
    if task.settings.camera_constant_known:
        found = _direct(task, interior, near)
        return _State(found.pose, interior, task.lens), found.inliers.copy()
    width = max(interior.size) / _pixels_per_unit(interior)
    best: tuple[float, Interior, DirectPose] | None = None
    reason = ""
    for factor in _SCAN:
        tried = replace(interior, c=float(factor * width))
        try:
            found = _direct(task, tried, near)
        except InputError as error:  # a lens may fold back within the wide field of a short camera constant
            reason = str(error)
            continue
        r = _pixels(task, _State(found.pose, tried, task.lens))
        size = np.sort(np.where(np.isfinite(r).all(axis=1), np.linalg.norm(r, axis=1), np.inf))
        cost = float(size[: len(size) // 2 + 2].sum())
        if best is None or cost < best[0]:
            best = cost, tried, found
    if best is None:
        raise GeometryError(f"no camera constant from 0.3 to 10 image widths fits; {reason}")
    return _State(best[2].pose, best[1], task.lens), best[2].inliers.copy()


def _direct(task: _Task, interior: Interior, near: Pose | None) -> DirectPose:
    t = tangents_of(interior, task.lens, task.points.xy)
    lost = ~np.isfinite(t).all(axis=1)
    if lost.any():
        raise GeometryError(
            f"point {task.points.names[int(lost.argmax())]!r} lies where the lens has no ray; is it measured in this "
            "image?"
        )
    f = interior.c * _pixels_per_unit(interior)
    X = task.points.XYZ
    # What control adds to the noise, at a distance that is not known yet but of the order of the points' extent.
    extent = max(float(np.linalg.norm(X - X.mean(axis=0), axis=1).max()), 1e-9)
    control = np.sqrt(np.trace(task.points.covariance, axis1=1, axis2=2) / 3.0) / extent
    sigma = float(np.median(np.hypot(task.points.sigma.mean(axis=1) / f, control)))
    return resect_direct(t, X, sigma, near)


def _pixels_per_unit(interior: Interior) -> float:
    """Pixels in one unit of the image plane."""
    J = interior.plane_to_pixel.derivative(np.array(interior.principal_point))
    return float(np.sqrt(abs(np.linalg.det(J))))


def _pixels(task: _Task, state: _State) -> Floats:
    """Residuals without covariances: computed minus measured, (n, 2)."""
    frame = oriented_camera(state.interior, state.lens, state.pose)
    camera = frame if task.camera_of is None else task.camera_of(state.interior, state.lens, state.pose)
    return project(camera, task.points.XYZ) - task.points.xy


def _equations(task: _Task, state: _State) -> _Equations:
    """Observation equations at a state; derivatives are those of central projection."""
    points, interior = task.points, state.interior
    free = task.settings.free
    lens = field_limited(state.lens, interior)
    camera = _camera_state(task, state)
    t, by_pose, by_X, depth = tangent_derivatives(state.pose, points.XYZ)
    real = lens.distort(t)
    plane = interior.c * real + interior.principal_point
    to_pixel = interior.plane_to_pixel.derivative(plane)
    by_t = interior.c * to_pixel @ lens.jacobian(t)
    columns = [by_t @ by_pose]
    for name in free:
        if name in ("x0", "y0"):
            columns.append(to_pixel[..., :, [("x0", "y0").index(name)]])
        else:
            moves = real if name == "c" else interior.c * by_coefficient(camera, name, t, real)
            columns.append(to_pixel @ moves[..., None])
    A = np.concatenate(columns, axis=2)
    to_ground = by_t @ by_X
    S = to_ground @ points.covariance @ np.swapaxes(to_ground, 1, 2)
    S[:, 0, 0] += points.sigma[:, 0] ** 2
    S[:, 1, 1] += points.sigma[:, 1] ** 2
    residuals = _pixels(task, state)
    sound = bool((depth > 0).all() and np.isfinite(residuals).all())
    if not np.isfinite(S).all() or not np.isfinite(A).all():
        S, A, sound = np.broadcast_to(np.eye(2), S.shape), np.zeros_like(A), False
    root = np.asarray(np.linalg.cholesky(S), float)
    v = np.linalg.solve(root, residuals[..., None])[..., 0]
    distance = float(np.linalg.norm(points.XYZ - state.pose.center, axis=1).mean())
    # A coefficient's natural size moves the outermost point by its distance from the principal point.
    radius = max(float(np.nanmax(np.linalg.norm(t, axis=1), initial=0.0)), 1e-9)
    power = {"k1": 2, "k2": 4, "k3": 6, "p1": 1, "p2": 1, "b1": 0, "b2": 0}
    own = [interior.c if name in ("c", "x0", "y0") else radius ** -power[name] for name in free]
    units = np.array([distance] * 3 + [1.0] * 3 + own)
    return _Equations(
        A=np.asarray(np.linalg.solve(root, A), float), v=v, root=root, residuals=residuals, units=units, sound=sound
    )


def _adjusted(task: _Task, state: _State, use: Mask) -> tuple[_State, _Equations]:
    """Least squares over the points `use`."""

    def equations(state: _State) -> tuple[Floats, Floats]:
        found = _equations(task, state)
        return found.A[use].reshape(-1, found.A.shape[2]), found.v[use].ravel()

    state = levenberg(state, equations, lambda state, step: _stepped(task, state, step), _ITERATIONS).state
    return state, _equations(task, state)


def _stepped(task: _Task, state: _State, step: Floats) -> _State | None:
    """The state after a step; None if it makes no camera."""
    interior, lens = state.interior, state.lens
    if task.settings.free:
        try:
            camera = _camera_state(task, state).moved(step[None, 6:])
        except InputError:
            return None
        if not 0.05 < camera.c / interior.c < 20.0:
            return None
        interior, lens = replace(interior, c=camera.c, principal_point=(camera.x0, camera.y0)), camera.lens
    return _State(moved(state.pose, step), interior, lens)


def _camera_state(task: _Task, state: _State) -> CameraState:
    """The camera of a state as a block knows it."""
    interior = state.interior
    return CameraState(interior.c, *interior.principal_point, state.lens, task.settings.free)


def _cleaned(task: _Task, state: _State, use: Mask) -> Resected:
    """Adjustment with data snooping: points leave one by one, and come back when they fit."""
    u = 6 + len(task.settings.free)
    seen: set[bytes] = set()
    while True:
        state, equations = _adjusted(task, state, use)
        if not np.isfinite(equations.v[use]).all():
            raise GeometryError(f"image {task.name!r}: {_why_not(task, state, use)}")
        tests = _tested(task, equations, use)
        largest = np.nan_to_num(np.abs(tests.normalised), nan=0.0).max(axis=1)
        limit = task.settings.critical * tests.scale
        worst = int(np.where(use, largest, 0.0).argmax())
        back = np.where(use, np.inf, largest)
        seen.add(use.tobytes())
        changed = use.copy()
        if largest[worst] > limit and 2 * (use.sum() - 1) > u:
            changed[worst] = False
        elif back.min() < limit:
            changed[int(back.argmin())] = True
        if changed.tobytes() in seen:
            break
        use = changed
    return _result(task, state, equations, use, tests)


def _why_not(task: _Task, state: _State, use: Mask) -> str:
    """Why an adjustment ended with points that have no image."""
    lost = use & ~np.isfinite(_pixels(task, state)).all(axis=1)
    central = project(oriented_camera(state.interior, task.lens, state.pose), task.points.XYZ)
    if task.camera_of is not None and np.isfinite(central[lost]).all():
        names = ", ".join(task.points.names[k] for k in np.flatnonzero(lost)[:5])
        return (
            f"{int(lost.sum())} points ({names}) have no image with the earth curvature that is asked for: as a "
            "correction it is not defined for points above the camera; ask for strict"
        )
    return (
        f"the adjustment of its {len(use)} control points does not converge with all points in front of the camera; "
        "check point names and the camera constant"
    )


@dataclass(frozen=True, eq=False)
class _Tests:
    """What residuals say about the observations."""

    cofactor: Floats
    """Inverse normal equations (u, u)."""
    normalised: Floats
    redundancies: Floats
    scale: float
    """Robust standard deviation of unit weight, at least 1."""
    sigma0: float


def _tested(task: _Task, equations: _Equations, use: Mask) -> _Tests:
    """Normalised residuals of all points; those that are not used are compared with their prediction."""
    A = equations.A * equations.units
    u = A.shape[2]
    used = A[use].reshape(-1, u)
    redundancy = len(used) - u
    sigma0 = float(np.sqrt((equations.v[use] ** 2).sum() / redundancy)) if redundancy > 0 else 1.0
    cofactor = refuse_undetermined(used, sigma0 if redundancy > 3 else 1.0, _unknowns(task, equations))
    fitted = A @ cofactor @ np.swapaxes(A, 1, 2)
    sign = np.where(use, -1.0, 1.0)[:, None, None]
    of_v = equations.root @ (np.eye(2) + sign * fitted) @ np.swapaxes(equations.root, 1, 2)
    before = equations.root @ np.swapaxes(equations.root, 1, 2)
    variance = np.diagonal(of_v, axis1=1, axis2=2)
    part = variance / np.diagonal(before, axis1=1, axis2=2)
    with np.errstate(all="ignore"):
        normalised = np.where(part > _UNCONTROLLED, equations.residuals / np.sqrt(variance), np.nan)
    # A point that cannot be predicted (behind the camera) does not fit.
    normalised[~use & ~np.isfinite(equations.residuals).all(axis=1)] = np.inf
    numbers = np.where(use[:, None], np.diagonal(np.eye(2) - fitted, axis1=1, axis2=2), np.nan)
    scale = spread(normalised[use]) if redundancy > 2 else sigma0
    units = equations.units
    return _Tests(
        cofactor=cofactor * units[:, None] * units,
        normalised=normalised,
        redundancies=numbers,
        scale=float(np.nanmax([1.0, scale])),
        sigma0=sigma0,
    )


def _unknowns(task: _Task, equations: _Equations) -> ResectionUnknowns:
    where = f"image {task.name!r}: its {len(task.points)} control points"
    return ResectionUnknowns(where, equations.units, task.settings.free, float(np.median(task.points.sigma)))


def _result(task: _Task, state: _State, equations: _Equations, use: Mask, tests: _Tests) -> Resected:
    redundancy = 2 * int(use.sum()) - len(equations.units)
    notes = []
    largest = np.nan_to_num(np.abs(tests.normalised[use]), nan=0.0).max(initial=0.0)
    if redundancy <= 0:
        notes.append("no redundancy: nothing checks these points, and gross errors stay unseen")
    elif redundancy <= 3 and largest > task.settings.critical:
        notes.append(
            f"sigma0 {tests.sigma0:.3g} shows a gross error or too small standard deviations, but {int(use.sum())} "
            "points do not tell which; measure another one"
        )
    return Resected(
        pose=state.pose,
        interior=state.interior,
        lens=state.lens,
        covariance=tests.cofactor * tests.sigma0**2,
        free=task.settings.free,
        residuals=equations.residuals,
        redundancies=tests.redundancies,
        normalised=tests.normalised,
        rejected=~use,
        sigma0=tests.sigma0,
        redundancy=redundancy,
        notes=tuple(notes),
    )
