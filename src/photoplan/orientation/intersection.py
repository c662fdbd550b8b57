"""Intersection of rays, check points, and skylines matched with the terrain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.least_squares import Equations, bisquare, by_differences, levenberg, spread
from photoplan.arrays import Floats, Ints, Mask
from photoplan.errors import GeometryError, UsageError
from photoplan.geometry.pose import Pose
from photoplan.orientation.resection import bearings

#: Why a point has no coordinates, by its code in `Intersected.reason`.
REASONS = ("", "fewer than two rays", "rays nearly parallel", "behind a camera", "rays do not meet")
#: Points that are computed at once.
_CHUNK = 200_000
_ITERATIONS = 8
#: Points with more rays are cleaned by their largest normalised residual, others by leaving out each ray in turn.
_MANY = 12


@dataclass(frozen=True, eq=False)
class MeasuredRays:
    """Measurements of points in oriented images."""

    image: Ints
    """Image of each ray, (m,), an index into the poses."""
    point: Ints
    """Point of each ray, (m,), from 0."""
    tangents: Floats
    """Ideal tangent coordinates (x, y) / c, (m, 2), x right, y up; NaN: the ray is not used."""
    sigma: Floats
    """Standard deviations of these, (m, 2)."""

    def __post_init__(self) -> None:
        m = len(self.image)
        object.__setattr__(self, "image", np.asarray(self.image, np.int64))
        object.__setattr__(self, "point", np.asarray(self.point, np.int64))
        object.__setattr__(self, "tangents", np.asarray(self.tangents, float).reshape(m, 2))
        object.__setattr__(self, "sigma", np.broadcast_to(np.asarray(self.sigma, float), (m, 2)))
        if len(self.point) != m or not (self.sigma > 0).all():
            raise UsageError("rays need one point each and positive standard deviations")

    def at(self, index: ArrayLike) -> MeasuredRays:
        """The rays at `index` (mask or numbers)."""
        k = np.asarray(index)
        return MeasuredRays(self.image[k], self.point[k], self.tangents[k], self.sigma[k])


@dataclass(frozen=True, eq=False)
class Intersected:
    """Result of `intersect`."""

    XYZ: Floats
    """(n, 3), metres; NaN where a point is not determined."""
    covariance: Floats
    """(n, 3, 3), m², from the rays' stated standard deviations, poses taken as free of error; NaN as XYZ."""
    rays: Ints
    """Rays that take part, (n,)."""
    used: Mask
    """Which rays take part, (m,)."""
    reason: NDArray[np.int8]
    """Index into `REASONS`, (n,); 0: the point is determined."""

    def counts(self) -> dict[str, int]:
        """How many points have no coordinates, by reason."""
        return {REASONS[k]: int((self.reason == k).sum()) for k in range(1, len(REASONS)) if (self.reason == k).any()}


@dataclass(frozen=True, eq=False)
class _Cameras:
    """Poses as arrays, with coordinates about their middle."""

    R: Floats
    centers: Floats


def intersect(
    poses: Sequence[Pose],
    rays: MeasuredRays,
    count: int | None = None,
    *,
    critical: float = 4.0,
    min_angle: float = 0.0035,
) -> Intersected:
    """Points where rays meet, by least squares of the image coordinates.

    The start is the point nearest to all rays. A ray that does not fit is taken out where the others tell which one it
    is: every ray is left out in turn, and only one of these points may fit (three rays or more).

    Parameters
    ----------
    poses : sequence of Pose
        In a Cartesian system.
    count : int, optional
        Number of points [the largest index + 1].
    critical : float
        Normalised residual from which a ray does not fit.
    min_angle : float
        Radians; rays that all lie within it are taken as parallel.
    """
    n = int(rays.point.max(initial=-1)) + 1 if count is None else count
    middle = np.mean([p.center for p in poses], axis=0) if poses else np.zeros(3)
    cameras = _Cameras(
        np.array([p.R_ground_camera for p in poses]).reshape(-1, 3, 3),
        np.array([p.center - middle for p in poses]).reshape(-1, 3),
    )
    used = np.asarray(np.isfinite(rays.tangents).all(axis=1))
    found = Intersected(
        XYZ=np.full((n, 3), np.nan),
        covariance=np.full((n, 3, 3), np.nan),
        rays=np.zeros(n, np.int64),
        used=used,
        reason=np.ones(n, np.int8),
    )
    order = np.flatnonzero(used)
    order = order[np.argsort(rays.point[order], kind="stable")]
    starts = np.searchsorted(rays.point[order], np.arange(0, n, _CHUNK))
    for first, (a, b) in zip(range(0, n, _CHUNK), zip(starts, [*starts[1:], len(order)])):
        part = order[a:b]
        size = min(_CHUNK, n - first)
        mine = rays.at(part)
        mine = replace(mine, point=mine.point - first)
        done = _cleaned(cameras, mine, size, critical, min_angle)
        where = slice(first, first + size)
        found.XYZ[where], found.covariance[where] = done.XYZ + middle, done.covariance
        found.rays[where], found.reason[where] = done.rays, done.reason
        used[part] = done.used
    return found


def _cleaned(cameras: _Cameras, rays: MeasuredRays, n: int, critical: float, min_angle: float) -> Intersected:
    """Points of all rays; then rays that do not fit leave, one of a point at a time."""
    used = np.ones(len(rays.point), bool)
    found, worst, size = _solved(cameras, rays, n, min_angle)
    while True:
        suspect = (found.reason == 0) & (size > critical)
        suspect |= (found.reason == 3) & (found.rays > 2)
        if not suspect.any():
            break
        found.reason[suspect] = 4
        mine = np.flatnonzero(used & suspect[rays.point])
        leaving = _leaving(cameras, rays.at(mine), worst[mine], critical, min_angle)
        if not leaving.any():
            break
        used[mine[leaving]] = False
        again = np.zeros(n, bool)
        again[rays.point[mine[leaving]]] = True
        keep = np.flatnonzero(used & again[rays.point])
        numbers, local = np.unique(rays.point[keep], return_inverse=True)
        better, w, s = _solved(cameras, replace(rays.at(keep), point=local.reshape(-1)), len(numbers), min_angle)
        found.XYZ[numbers], found.covariance[numbers] = better.XYZ, better.covariance
        found.rays[numbers], found.reason[numbers] = better.rays, better.reason
        worst[keep], size[numbers] = w, s
    lost = found.reason > 0
    found.XYZ[lost] = np.nan
    found.covariance[lost] = np.nan
    return replace(found, used=used)


def _leaving(cameras: _Cameras, rays: MeasuredRays, worst: Floats, critical: float, min_angle: float) -> Mask:
    """Which rays of points that do not fit have to leave: none or one of each point."""
    leaving = np.zeros(len(rays.point), bool)
    _, first, count = np.unique(rays.point, return_index=True, return_counts=True)
    for k in np.flatnonzero(count > _MANY):
        part = slice(first[k], first[k] + count[k])
        leaving[first[k] + int(np.nan_to_num(worst[part], nan=np.inf).argmax())] = True
    few = np.flatnonzero((count > 2) & (count <= _MANY))
    if not len(few):
        return leaving
    # Every ray that is left out makes a point of its own.
    left = np.concatenate([first[k] + np.arange(count[k]) for k in few])
    groups = np.concatenate([np.repeat(first[k], count[k]) for k in few])
    sizes = np.concatenate([np.repeat(count[k], count[k]) for k in few])
    ray = np.repeat(groups, sizes) + (np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes))
    trial = np.repeat(np.arange(len(left)), sizes)
    keep = ray != np.repeat(left, sizes)
    found, _, size = _solved(cameras, replace(rays.at(ray[keep]), point=trial[keep]), len(left), min_angle)
    size = np.where(found.reason == 0, size, np.inf)
    at = 0
    for k in few:
        sizes_here = size[at : at + count[k]]
        fits = sizes_here <= critical
        best = int(sizes_here.argmin())
        if fits.sum() == 1 or (not fits.any() and count[k] > 4 and np.isfinite(sizes_here[best])):
            leaving[first[k] + best] = True
        at += int(count[k])
    return leaving


def _solved(cameras: _Cameras, rays: MeasuredRays, n: int, min_angle: float) -> tuple[Intersected, Floats, Floats]:
    """Points (n,), largest normalised residual of each ray (m,) and of each point (n,)."""
    R, C = cameras.R[rays.image], cameras.centers[rays.image]
    at = rays.point
    with np.errstate(all="ignore"):
        number = np.bincount(at, minlength=n)
        X, spread = _nearest(R, C, rays, n, number)
        for _ in range(_ITERATIONS):
            v, J, _ = _residuals(R, C, rays, X)
            N = _sums(np.einsum("mki,mkj->mij", J, J), at, n)
            rhs = _sums(np.einsum("mki,mk->mi", J, v), at, n)
            step, _ = _inverse_times(N, rhs)
            step = np.where(np.isfinite(step), step, 0.0)
            X = X - step
            far = np.abs(X).max(initial=1.0)
            if np.abs(step).max(initial=0.0) < 1e-9 + 1e-13 * far:
                break
        v, J, depth = _residuals(R, C, rays, X)
        N = _sums(np.einsum("mki,mkj->mij", J, J), at, n)
        _, covariance = _inverse_times(N, np.zeros((n, 3)))
        q = 1.0 - np.einsum("mki,mij,mkj->mk", J, covariance[at], J)
        normalised = np.where(q > 1e-6, np.abs(v) / np.sqrt(np.maximum(q, 1e-12)), 0.0)
    worst = np.where(np.isfinite(normalised).all(axis=1), normalised.max(axis=1), np.inf)
    size = np.zeros(n)
    np.maximum.at(size, at, worst)
    behind = np.zeros(n, bool)
    np.logical_or.at(behind, at, ~(depth > 0))
    reason = np.zeros(n, np.int8)
    reason[behind] = 3
    reason[~(spread > min_angle**2 / 4.0) | ~np.isfinite(covariance).all(axis=(1, 2))] = 2
    reason[number < 2] = 1
    return (
        Intersected(XYZ=X, covariance=covariance, rays=number, used=np.ones(len(at), bool), reason=reason),
        worst,
        size,
    )


def _nearest(R: Floats, C: Floats, rays: MeasuredRays, n: int, number: Ints) -> tuple[Floats, Floats]:
    """Points nearest to all their rays (n, 3), and the smallest eigenvalue of the rays' spread (n,)."""
    d = np.einsum("mij,mj->mi", R, bearings(rays.tangents))
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    N = _sums(across, rays.point, n)
    X, _ = _inverse_times(N, _sums(np.einsum("mij,mj->mi", across, C), rays.point, n))
    # Two of the eigenvalues of the mean are near one where the third, (angle / 2)² for two rays, is small.
    spread = np.linalg.det(N / np.maximum(number, 1)[:, None, None])
    return X, np.asarray(spread, float)


def _residuals(R: Floats, C: Floats, rays: MeasuredRays, X: Floats) -> tuple[Floats, Floats, Floats]:
    """Computed minus measured tangents (m, 2) and derivatives (m, 2, 3) in units of σ, and depths (m,)."""
    p = np.einsum("mji,mj->mi", R, X[rays.point] - C)
    depth = -p[:, 2]
    t = p[:, :2] / depth[:, None]
    J = (np.swapaxes(R, 1, 2)[:, :2] + t[:, :, None] * R[:, None, :, 2]) / depth[:, None, None]
    return (t - rays.tangents) / rays.sigma, J / rays.sigma[:, :, None], depth


def _sums(values: Floats, at: Ints, n: int) -> Floats:
    """Sums (n, …) of values (m, …) by index."""
    flat = values.reshape(len(values), -1)
    columns = [np.asarray(np.bincount(at, flat[:, k], minlength=n), float) for k in range(flat.shape[1])]
    return np.stack(columns, axis=-1).reshape(n, *values.shape[1:])


def _inverse_times(N: Floats, rhs: Floats) -> tuple[Floats, Floats]:
    """N⁻¹ rhs (n, 3) and N⁻¹ (n, 3, 3) of symmetric matrices, by cofactors; NaN or infinite where singular."""
    a, b, c = N[:, 0], N[:, 1], N[:, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    inverse = cofactors / (a * cofactors[:, :, 0]).sum(axis=-1)[:, None, None]
    return np.einsum("nij,nj->ni", inverse, rhs), inverse


#: Check points that the standard asks for at least.
LEAST_CHECK_POINTS = 30
#: Mean error, as part of the RMSE, from which a systematic error should be looked for.
_MEAN = 0.25


@dataclass(frozen=True)
class CheckAccuracy:
    """Figures of all check points, metres; NaN where no point has the coordinate."""

    horizontal: int
    """Check points with X and Y."""
    vertical: int
    """Check points with a height."""
    mean: tuple[float, float, float]
    """Mean error in X, Y, Z: adjusted minus surveyed."""
    rmse: tuple[float, float, float]
    """RMSE in X, Y, Z: the fit to the check points."""
    fit_h: float
    """RMSE_H1."""
    fit_v: float
    """RMSE_V1."""
    survey_h: float
    """RMSE_H2, from the stated standard deviations of the survey; NaN: not stated for every point."""
    survey_v: float
    """RMSE_V2."""
    rmse_h: float
    """RMSE_H: with the survey's part, where it is known."""
    rmse_v: float
    """RMSE_V."""
    rmse_3d: float
    """RMSE_3D."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the standard would object to."""
        out = []
        fewest = min(self.horizontal, self.vertical) if self.vertical and self.horizontal else 0
        count = fewest or max(self.horizontal, self.vertical)
        if count < LEAST_CHECK_POINTS:
            out.append(
                f"{count} check points; the standard asks for at least {LEAST_CHECK_POINTS}, so these figures are no "
                "accuracy after the standard"
            )
        axes = [
            axis
            for axis, mean, rmse in zip("XYZ", self.mean, self.rmse)
            if np.isfinite(mean) and rmse > 0 and abs(mean) > _MEAN * rmse
        ]
        if axes and count > 2:
            out.append(f"the mean error in {', '.join(axes)} is more than a quarter of the RMSE: look for a bias")
        if not np.isfinite([self.survey_h, self.survey_v]).all():
            out.append("the accuracy of the survey is not stated for every check point, so its part is left out")
        return tuple(out)


def check_accuracy(residuals: Floats, sigma: Floats) -> CheckAccuracy:
    """Accuracy at check points."""
    known = np.isfinite(residuals)
    plane = known[:, :2].all(axis=1)
    columns = [residuals[plane, 0], residuals[plane, 1], residuals[known[:, 2], 2]]
    mean = tuple(float(c.mean()) if len(c) else np.nan for c in columns)
    rmse = tuple(float(np.sqrt((c**2).mean())) if len(c) else np.nan for c in columns)
    fit_h, fit_v = float(np.hypot(rmse[0], rmse[1])), rmse[2]
    survey_h = _rms(sigma[plane, :2]) * np.sqrt(2.0)
    survey_v = _rms(sigma[known[:, 2], 2:])
    h = float(np.hypot(fit_h, np.nan_to_num(survey_h)))
    v = float(np.hypot(fit_v, np.nan_to_num(survey_v)))
    return CheckAccuracy(
        horizontal=int(plane.sum()),
        vertical=int(known[:, 2].sum()),
        mean=(mean[0], mean[1], mean[2]),
        rmse=(rmse[0], rmse[1], rmse[2]),
        fit_h=fit_h,
        fit_v=fit_v,
        survey_h=float(survey_h),
        survey_v=float(survey_v),
        rmse_h=h,
        rmse_v=v,
        rmse_3d=float(np.hypot(h, v)),
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")


#: Unknowns: small turns about the camera's axes x (right), y (up) and z (backwards), radians, and the logarithm of a
#: factor of the camera constant.
UNKNOWNS = ("pitch", "azimuth", "roll", "focal")
#: Steps of the derivatives, and standard deviations beyond which a parameter is not determined, in their unit.
_STEP, _UNDETERMINED = 1e-5, 0.02
#: Rounds in which weights are found.
_ROUNDS = 8
#: Least spread of residuals that weights are based on, pixels.
_LEAST_SPREAD = 0.05
#: Points of a skyline farther apart than this, pixels, have no line between them.
_GAP = 3.0
#: Parts of the largest eigenvalue of normal equations with a diagonal of ones that are no more than rounding.
_ROUNDING = 1e-10
#: Rounds in which autocovariances are restored, and the most that a fit may have taken, part of the variance.
_RESTORED, _MOST_TAKEN = 6, 0.3


@dataclass(frozen=True, eq=False)
class SkylineFit:
    """What the skyline says of a camera."""

    step: Floats
    """Change of the unknowns, by `UNKNOWNS`, (3,) or (4,)."""
    covariance: Floats
    """Of them; neighbouring columns resemble each other, which counts."""
    used: int
    """Columns whose weight is above zero."""
    columns: int
    """Columns with an edge and a skyline."""
    correlated: float
    """Columns that say no more than one: 1 where neighbours err independently."""


def fit_skyline(pixels: Callable[[Floats], Floats], distance: Floats, edge: Floats, unknowns: int) -> SkylineFit:
    """Robust least squares of distances between a skyline and an edge, measured across the skyline.

    Neighbouring columns of terrain and photograph err together: the covariance has the autocorrelation of the
    residuals in it, as far as it is positive. Near terrain shows its errors of height more than far one: how much of
    the residuals' size falls with the distance is estimated from them.
    """
    start = np.zeros(unknowns)
    where = _columns(pixels(start), edge)
    if len(where) < 10 * unknowns:
        raise GeometryError(
            f"{len(where)} columns show skyline and edge; {10 * unknowns} are needed for {unknowns} angles"
        )

    def rows(step: Floats) -> Floats:
        xy = pixels(step)
        order = np.argsort(xy[:, 0], kind="stable")
        return np.asarray(np.interp(where, xy[order, 0], xy[order, 1]))

    across = 1.0 / np.hypot(1.0, np.gradient(rows(start), where))

    def distances(step: Floats) -> Floats:
        return np.asarray((rows(step) - edge[where]) * across)

    first = pixels(start)[:, 0]
    order = np.argsort(first, kind="stable")
    nearness = np.median(distance) / np.interp(where, first[order], distance[order])
    weight, size = np.ones(len(where)), np.ones(len(where))
    for _ in range(_ROUNDS):
        found = _round(distances, start, np.sqrt(weight) / size)
        start = found.state
        v = distances(start)
        size = _sizes(v, nearness)
        weight = bisquare(v / size / max(spread(v / size), _LEAST_SPREAD))
    A = by_differences(distances, start, _STEP)
    covariance, correlated = _covariance(A / size[:, None], v / size, weight, where)
    _refuse_undetermined(covariance)
    return SkylineFit(
        step=start, covariance=covariance, used=int(np.count_nonzero(weight)), columns=len(where), correlated=correlated
    )


def _columns(xy: Floats, edge: Floats) -> Ints:
    """Columns with an edge between points of the skyline that are neighbours."""
    x = np.sort(xy[np.isfinite(xy[:, 0]), 0])
    at = np.flatnonzero(np.isfinite(edge))
    right = np.searchsorted(x, at)
    inside = (right > 0) & (right < len(x))
    at, right = at[inside], right[inside]
    return np.asarray(at[x[right] - x[right - 1] <= _GAP])


def _sizes(v: Floats, nearness: Floats) -> Floats:
    """Sizes of errors up to a factor: of the edge, the same everywhere, and of heights, larger where they are near.

    The mixture that makes the residuals most likely (with Laplace's density, which gross errors hardly move).
    """
    best = None
    for part in np.linspace(0.0, 1.0, 11).tolist():
        size = np.hypot(1.0 - part, part * nearness)
        told = float(np.log(size).mean() + np.log(max(float((np.abs(v) / size).mean()), 1e-12)))
        if best is None or told < best[0]:
            best = told, size
    assert best is not None
    return best[1]


def _round(distances: Callable[[Floats], Floats], start: Floats, root: Floats) -> Equations[Floats]:
    def equations(step: Floats) -> tuple[Floats, Floats]:
        return by_differences(distances, step, _STEP) * root[:, None], distances(step) * root

    return levenberg(start, equations, lambda state, step: state + step)


def _covariance(A: Floats, v: Floats, weight: Floats, where: Ints) -> tuple[Floats, float]:
    """Covariance (u, u) with the autocorrelation of the residuals, and its length in columns."""
    span = int(where[-1] - where[0]) + 1
    B, e, w = np.zeros((span, A.shape[1])), np.zeros(span), np.zeros(span)
    at = where - where[0]
    B[at], e[at], w[at] = A * weight[:, None], v * weight, weight
    square = np.array(
        [float(e[k:] @ e[: span - k]) / max(float(w[k:] @ w[: span - k]), 1e-9) for k in range(span // 3)]
    )
    square, correlated = _restored(square, A.shape[1], float(weight.sum()))
    meat = square[0] * (B.T @ B)
    for k in range(1, len(square)):
        both = B[k:].T @ B[: span - k]
        meat += square[k] * (both + both.T)
    normal = (A.T * weight) @ A
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    free = values < _ROUNDING * values[-1]
    if free.any():
        way = np.abs(vectors[:, free] / scale[:, None])
        return np.diag(np.where((way > 0.1 * way.max(axis=0)).any(axis=1), np.inf, 0.0)), correlated
    inverse = np.linalg.inv(normal)
    plain = square[0] * (inverse @ ((B.T @ B) @ inverse))
    out = inverse @ meat @ inverse
    if (np.diag(out) < np.diag(plain)).any():
        out = plain * correlated
    # A small change of an observation moves the unknowns by the slope of weight times residual, not by the weight.
    slope = np.where(weight > 0, np.sqrt(weight) * (5.0 * np.sqrt(weight) - 4.0), 0.0)
    return np.asarray(out * (weight.sum() / max(float(slope.sum()), 0.3 * float(weight.sum()))) ** 2), correlated


def _restored(square: Floats, unknowns: int, count: float) -> tuple[Floats, float]:
    """Autocovariances of errors, as far as positive, and the columns that err together, from those of residuals.

    A fit takes out of them what unknowns can follow, which is slow: as much in each lag as unknowns times columns that
    err together have of all.
    """
    errors, correlated = square, 1.0
    for _ in range(_RESTORED):
        stop = int(np.argmax(errors <= 0)) if (errors <= 0).any() else len(errors)
        errors = errors[: max(stop, 1)]
        correlated = max(1.0 + 2.0 * float(errors[1:].sum() / max(errors[0], 1e-300)), 1.0)
        errors = square + min(unknowns * correlated / count, _MOST_TAKEN) * square[0]
    stop = int(np.argmax(errors <= 0)) if (errors <= 0).any() else len(errors)
    return errors[: max(stop, 1)], correlated


def _refuse_undetermined(covariance: Floats) -> None:
    sigma = np.sqrt(np.diag(covariance))
    weak = [name for name, value in zip(UNKNOWNS, sigma) if not value <= _UNDETERMINED]
    if weak:
        told = ", ".join(
            f"{name} ±{value:.2g}" + (" of itself" if name == "focal" else " rad")
            for name, value in zip(UNKNOWNS, sigma)
            if name in weak
        )
        raise GeometryError(
            f"the skyline does not determine {' and '.join(weak)} ({told}); a level or straight horizon tells no "
            "azimuth: leave `focal` as it is, or orient by control points (`photoplan resect`)"
        )
