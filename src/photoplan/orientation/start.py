"""Initial values of a block: relative orientation, similarity, growth of the model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise
from math import comb
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from photoplan.adjustment.least_squares import huber, solve
from photoplan.arrays import Floats, Ints, Mask
from photoplan.cameras.fiducials import Affine2D, Bilinear2D
from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedPositions
from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose, small_rotations
from photoplan.orientation.bundle.model import BlockCamera
from photoplan.orientation.intersection import MeasuredRays, intersect
from photoplan.orientation.resection import polished_pose, reprojected, resect_direct

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
    inliers: Mask
    """Points that agree, (n,)."""
    points: Floats
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


def _candidates(a: Floats, b: Floats, judges: Ints, limit: float, rng: np.random.Generator) -> Floats:
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


def _misses(E: Floats, a: Floats, b: Floats) -> Floats:
    """Sampson's distances (k, n) of points from the epipolar lines of essential matrices (k, 3, 3)."""
    in_second = np.einsum("kij,nj->kni", E, a)
    in_first = np.einsum("kji,nj->kni", E, b)
    square = (in_second[..., :2] ** 2).sum(-1) + (in_first[..., :2] ** 2).sum(-1)
    return np.abs((b * in_second).sum(-1)) / np.sqrt(square + 1e-300)


def _poses(E: Floats) -> list[Pose]:
    """The four poses of an essential matrix E = Rᵀ [base]×."""
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return [Pose(side * Vt[2], (U @ turn @ Vt).T) for turn in (W, W.T) for side in (1.0, -1.0)]


def _essential(pose: Pose) -> Floats:
    x, y, z = pose.center
    return np.asarray(pose.R_ground_camera.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), float)


def _in_front(pose: Pose, a: Floats, b: Floats) -> Mask:
    """Whether the rays of points (n, 3) approach each other in front of both images."""
    other = b @ pose.R_ground_camera.T
    aa, bb, ab = (a * a).sum(1), (other * other).sum(1), (a * other).sum(1)
    at, bt = a @ pose.center, other @ pose.center
    det = aa * bb - ab * ab
    return np.asarray(((bb * at - ab * bt) * np.sign(det) > 0) & ((ab * at - aa * bt) * np.sign(det) > 0))


def _finalist(candidates: Floats, a: Floats, b: Floats, limit: float) -> Pose:
    """The pose with the least cost where points behind an image count as wrong; of equal ones the least tilted."""

    def cost(pose: Pose) -> tuple[float, Mask]:
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


def _refined(pose: Pose, a: Floats, b: Floats, limit: float) -> Pose:
    """Least squares of the distances from epipolar lines, the base of length one: five unknowns."""

    def signed(p: Pose) -> Floats:
        E = _essential(p)
        in_second, in_first = a @ E.T, b @ E
        square = (in_second[:, :2] ** 2).sum(1) + (in_first[:, :2] ** 2).sum(1)
        return np.asarray((b * in_second).sum(1) / np.sqrt(square), float)

    def stepped(p: Pose, step: Floats) -> Pose:
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


def _completed(pose: Pose, a: Floats, b: Floats, inliers: Mask, sigma: float) -> RelativeOrientation:
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


def five_point_essentials(first: ArrayLike, second: ArrayLike) -> Floats:
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


def _constraints(E: Floats) -> Floats:
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


def _sum(terms: list[Floats]) -> Floats:
    return np.asarray(np.sum(terms, axis=0), float)


def _eliminated(equations: Floats) -> Floats:
    """Cubic monomials by the basis: rows of G in cubic + G · basis = 0, (n, 10, 10); NaN where that fails."""
    left, right = equations[:, :, :10], equations[:, :, 10:]
    sound = np.abs(np.linalg.det(left / np.abs(left).max(axis=(1, 2), keepdims=True))) > 1e-40
    G = np.linalg.solve(np.where(sound[:, None, None], left, np.eye(10)), right)
    return np.where(sound[:, None, None], G, np.nan)


def _product(a: Floats, b: Floats, degree: int) -> Floats:
    """Product of a polynomial of the given degree and a linear one, coefficients in the last axis."""
    table = _table(degree)
    return np.einsum("...i,...j,ijk->...k", a, b, table, optimize=True)


@cache
def _table(degree: int) -> Floats:
    left = _LINEAR if degree == 1 else _QUADRATIC
    out = _QUADRATIC if degree == 1 else _CUBIC + _BASIS
    table = np.zeros((len(left), 4, len(out)))
    for i, a in enumerate(left):
        for j, b in enumerate(_LINEAR):
            table[i, j, out.index((a[0] + b[0], a[1] + b[1], a[2] + b[2]))] = 1.0
    return table


#: Known points that an image needs to be resected.
FEWEST = 6
#: Part of them that must agree.
_SHARE = 0.4
#: Images with at least this part of the best image's points are added together.
_TOGETHER = 0.7
#: Pairs that are tried for the begin of a model.
_PAIRS = 12
#: Standard deviations of measurements are multiplied by this, as models are not adjusted while they grow.
_SLACK = 4.0
_SWEEPS = 2


@dataclass(frozen=True, eq=False)
class StartModel:
    """Poses and points in one system; both are filled while the model grows."""

    poses: dict[int, Pose]
    XYZ: Floats
    """(p, 3); NaN: not known."""


def free_model(net: ImageGraph, images: Iterable[int]) -> StartModel | None:
    """A model of its own of as many of `images` as hang together; None where no pair does."""
    wanted = sorted(images)
    pair = _best_pair(net, wanted)
    if pair is None:
        return None
    first, second, found = pair
    model = StartModel({first: Pose(np.zeros(3), np.eye(3)), second: found.pose}, np.full((len(net.points), 3), np.nan))
    grown(net, model, wanted, 1.0, fixed=False)
    return model


def _best_pair(net: ImageGraph, images: list[int]) -> tuple[int, int, RelativeOrientation] | None:
    """The pair with the most common points that meet under a good angle."""
    shown = {k: set(net.point[net.of_image[k]].tolist()) for k in images}
    pairs = [
        (len(shown[a] & shown[b]), a, b) for i, a in enumerate(images) for b in images[i + 1 :] if shown[a] & shown[b]
    ]
    pairs.sort(key=lambda p: (-p[0], p[1], p[2]))
    best: tuple[float, int, int, RelativeOrientation] | None = None
    for count, a, b in pairs[:_PAIRS]:
        if best is not None and count < 0.5 * pairs[0][0]:
            break
        try:
            found = _related(net, a, b)
        except GeometryError:
            continue
        # More than 30° between rays gains nothing.
        worth = float(found.inliers.sum()) * min(found.angle, 0.52)
        if best is None or worth > best[0]:
            best = worth, a, b, found
    return None if best is None else best[1:]


def _related(net: ImageGraph, a: int, b: int) -> RelativeOrientation:
    one, two = net.of_image[a], net.of_image[b]
    _, i, j = np.intersect1d(net.point[one], net.point[two], return_indices=True)
    one, two = one[i], two[j]
    return relate(net.tangents[one], net.tangents[two], float(np.median(net.sigma[one])))


def grown(net: ImageGraph, model: StartModel, images: Iterable[int], loose: float, fixed: bool = True) -> list[int]:
    """Add images until none has enough known points; the numbers of those that were added."""
    waiting = [k for k in images if k not in model.poses]
    added: list[int] = []
    refused: dict[int, int] = {}
    while True:
        _intersected(net, model, loose, fixed)
        known = np.isfinite(model.XYZ[:, 0])
        counts = {k: int(known[net.point[net.of_image[k]]].sum()) for k in waiting}
        able = {k: n for k, n in counts.items() if n >= FEWEST and n > refused.get(k, 0)}
        if not able:
            return added
        enough = _TOGETHER * max(able.values())
        new = []
        for k in sorted(able, key=lambda k: (-able[k], k)):
            if able[k] < enough:
                break
            pose = _resected(net, model, k, loose)
            if pose is None:
                refused[k] = able[k]
                continue
            model.poses[k] = pose
            new.append(k)
        waiting = [k for k in waiting if k not in model.poses]
        added += new
        for _ in range(_SWEEPS if new else 0):
            _intersected(net, model, loose, fixed)
            for k in new:
                model.poses[k] = _polished(net, model, k, loose)


def network_strain(net: ImageGraph, model: StartModel) -> float:
    """By how much the poses that the model has miss the measurements' standard deviation; at least 1."""
    numbers = sorted(model.poses)
    place = np.full(net.images, -1)
    place[numbers] = np.arange(len(numbers))
    rays = np.flatnonzero(place[net.image] >= 0)
    if len(numbers) < 2 or not len(rays):
        return 1.0
    image, point, sigma = place[net.image[rays]], net.point[rays], np.repeat(net.sigma[rays, None], 2, axis=1)
    poses = [model.poses[k] for k in numbers]
    XYZ = intersect(poses, MeasuredRays(image, point, net.tangents[rays], sigma), len(net.points), critical=np.inf).XYZ
    miss = np.full(len(rays), np.nan)
    for k, pose in enumerate(poses):
        mine = image == k
        t = reprojected(pose.R_ground_camera[None], pose.center[None], XYZ[point[mine]])[0]
        miss[mine] = np.linalg.norm(t - net.tangents[rays[mine]], axis=1) / net.sigma[rays[mine]]
    miss = miss[np.isfinite(miss)]
    # Residuals of two rays hold a quarter of the errors.
    return float(np.clip(2.0 * np.median(miss) / _SLACK, 1.0, 200.0)) if len(miss) else 1.0


def _intersected(net: ImageGraph, model: StartModel, loose: float, fixed: bool) -> None:
    """Points of all oriented images, anew."""
    numbers = sorted(model.poses)
    place = np.full(net.images, -1)
    place[numbers] = np.arange(len(numbers))
    rays = np.flatnonzero(place[net.image] >= 0)
    model.XYZ[:] = net.control if fixed else np.nan
    if len(numbers) < 2:
        return
    sigma = np.repeat(net.sigma[rays, None], 2, axis=1) * (_SLACK * loose)
    found = intersect(
        [model.poses[k] for k in numbers],
        MeasuredRays(place[net.image[rays]], net.point[rays], net.tangents[rays], sigma),
        len(net.points),
        min_angle=0.02,
    )
    free = ~np.isfinite(model.XYZ[:, 0])
    model.XYZ[free] = found.XYZ[free]


def _known(net: ImageGraph, model: StartModel, k: int) -> tuple[Floats, Floats, float]:
    mine = net.of_image[k]
    mine = mine[np.isfinite(model.XYZ[net.point[mine], 0])]
    return net.tangents[mine], model.XYZ[net.point[mine]], float(np.median(net.sigma[mine]))


def _resected(net: ImageGraph, model: StartModel, k: int, loose: float) -> Pose | None:
    """Pose of an image; None where too few of its known points agree."""
    t, X, sigma = _known(net, model, k)
    try:
        found = resect_direct(t, X, _SLACK * sigma)
    except GeometryError:
        return None
    good = found.inliers.sum() >= max(FEWEST, _SHARE * len(t)) and found.scale <= 5.0 * _SLACK * loose * sigma
    return found.pose if good else None


def _polished(net: ImageGraph, model: StartModel, k: int, loose: float) -> Pose:
    t, X, sigma = _known(net, model, k)
    pose = model.poses[k]
    r = np.linalg.norm(reprojected(pose.R_ground_camera[None], pose.center[None], X)[0] - t, axis=1)
    near = r < 4.0 * _SLACK * loose * sigma
    return polished_pose(pose, t, X, near) if near.sum() >= FEWEST else pose


class _NetImage(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> str: ...
    @property
    def plane_to_pixel(self) -> Affine2D | Bilinear2D: ...


@dataclass(frozen=True, eq=False)
class ImageGraph:
    """Measurements in tangent coordinates."""

    images: int
    """Number of images."""
    points: tuple[str, ...]
    """Names of the points, (p,)."""
    image: Ints
    """(m,), an index into the images."""
    point: Ints
    """(m,), an index into `points`."""
    tangents: Floats
    """(m, 2)."""
    sigma: Floats
    """Standard deviation of a tangent coordinate, (m,)."""
    control: Floats
    """(p, 3); NaN where a point is no control point with three coordinates."""
    of_image: tuple[Ints, ...]
    """Measurements of each image."""


def image_graph(
    cameras: Mapping[str, BlockCamera],
    images: Sequence[_NetImage],
    observations: ImagePoints,
    ground: GroundPoints,
    sigma: float,
) -> ImageGraph:
    """Measurements of the block's images; those for which a lens has no ray are dropped."""
    number = {image.name: k for k, image in enumerate(images)}
    of_block = np.array([number.get(name, -1) for name in observations.images], np.int64)
    image = of_block[observations.image] if len(observations) else np.empty(0, np.int64)
    tangents = np.full((len(image), 2), np.nan)
    scale = np.ones(len(image))
    for k, described in enumerate(images):
        mine = np.flatnonzero(image == k)
        camera = cameras[described.camera]
        plane = described.plane_to_pixel.inverse(observations.xy[mine])
        tangents[mine] = camera.lens.undistort((plane - camera.principal_point) / camera.c)
        J = described.plane_to_pixel.derivative(np.array(camera.principal_point))
        scale[mine] = camera.c * np.sqrt(abs(np.linalg.det(J)))
    stated = np.where(np.isfinite(observations.sigma), observations.sigma, sigma).mean(axis=1) if len(image) else scale
    keep = np.flatnonzero((image >= 0) & np.isfinite(tangents).all(axis=1))
    image, point = image[keep], observations.point[keep]
    control = np.full((len(observations.points), 3), np.nan)
    given = {name: k for k, name in enumerate(ground.names)}
    for p, name in enumerate(observations.points):
        g = given.get(name, -1)
        if g >= 0 and not ground.check[g] and np.isfinite(ground.XYZ[g]).all():
            control[p] = ground.XYZ[g]
    order = np.argsort(image, kind="stable")
    ends = np.searchsorted(image[order], np.arange(len(images) + 1))
    of_image = tuple(order[a:b] for a, b in pairwise(ends))
    return ImageGraph(
        images=len(images),
        points=observations.points,
        image=image,
        point=point,
        tangents=tangents[keep],
        sigma=(stated / scale)[keep],
        control=control,
        of_image=of_image,
    )


_TRIPLES = 500
#: Points on a line: their extent across it is smaller than this part of the extent along it.
_COLLINEAR = 0.01


@dataclass(frozen=True, eq=False)
class Similarity:
    """X' = scale · R X + shift."""

    scale: float
    R: Floats
    shift: Floats

    def __call__(self, XYZ: ArrayLike) -> Floats:
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


def robust_similarity(source: ArrayLike, target: ArrayLike, tolerance: float) -> tuple[Similarity, Mask]:
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


#: Control points from which an image is oriented by itself.
_CONTROL = 4


@dataclass(frozen=True, eq=False)
class StartImage:
    """An image of the block."""

    name: str
    camera: str
    plane_to_pixel: Affine2D | Bilinear2D
    """From the image plane (x right, y up) to pixels."""
    pose: Pose | None = None
    """Approximate exterior orientation, where it is known; it is kept."""


@dataclass(frozen=True, eq=False)
class Started:
    """Result of `start_block`."""

    poses: Mapping[str, Pose]
    """Of every image that could be oriented."""
    how: Mapping[str, str]
    """For each: "given", "control points" or "tie points"."""
    points: Mapping[str, tuple[float, float, float]]
    """Ground coordinates of the points whose rays meet."""
    left_out: tuple[tuple[str, str], ...]
    """Images that could not be oriented: name and reason; those of models that have no place first."""


def start_block(
    cameras: Mapping[str, BlockCamera],
    images: Sequence[StartImage],
    observations: ImagePoints,
    ground: GroundPoints,
    positions: ObservedPositions | None = None,
    sigma: float = 0.5,
) -> Started:
    """Orient as many images of a block as can be, in one Cartesian system.

    Given poses are kept. Images with four control points or more are resected. From these on, further images are
    resected from the points that two oriented images intersect. What is left forms models of its own: a pair by
    relative orientation, further images by resection, and a similarity transformation to control points, to observed
    positions or to points of the images oriented before. Gross errors are tolerated at every step; small ones are left
    to the adjustment, for which these are start values.

    Parameters
    ----------
    cameras : mapping of BlockCamera
        Interior orientation and lens of each camera.
    images : sequence of StartImage
    observations : ImagePoints
        Those of other images are not used.
    ground : GroundPoints
        Points with all three coordinates that are no check points serve as control.
    sigma : float
        Standard deviation of measurements that state none, pixels.
    """
    net = image_graph(cameras, images, observations, ground, sigma)
    block = StartModel({}, net.control.copy())
    how: dict[int, str] = {}
    for k, image in enumerate(images):
        if image.pose is not None:
            block.poses[k] = image.pose
            how[k] = "given"
    loose = network_strain(net, block)
    _resect_by_control(net, block, how)
    _grow(net, block, how, loose)
    reasons: dict[int, str] = {}
    tried: set[int] = set()
    while True:
        rest = [k for k in range(len(images)) if k not in block.poses and k not in tried]
        model = free_model(net, rest)
        if model is None:
            break
        tried.update(model.poses)
        try:
            placed = _placed(net, model, block, images, positions)
        except GeometryError as error:
            reasons |= dict.fromkeys(
                model.poses, f"one of {len(model.poses)} images that form a model of their own; {error}"
            )
            continue
        block.poses.update({k: placed.pose(p) for k, p in model.poses.items()})
        how |= dict.fromkeys(model.poses, "tie points")
        _grow(net, block, how, loose)
    return _result(net, images, block, how, reasons)


def _resect_by_control(net: ImageGraph, block: StartModel, how: dict[int, str]) -> None:
    known = np.isfinite(net.control[:, 0])
    for k in range(net.images):
        mine = net.of_image[k]
        mine = mine[known[net.point[mine]]]
        if k in block.poses or len(mine) < _CONTROL:
            continue
        try:
            found = resect_direct(net.tangents[mine], net.control[net.point[mine]], 2.0 * float(net.sigma[mine].mean()))
        except GeometryError:
            continue
        if found.inliers.sum() >= _CONTROL and found.scale < 20.0 * net.sigma[mine].mean():
            block.poses[k] = found.pose
            how[k] = "control points"


def _grow(net: ImageGraph, block: StartModel, how: dict[int, str], loose: float) -> None:
    new = grown(net, block, range(net.images), loose)
    how |= dict.fromkeys(new, "tie points")


def _placed(
    net: ImageGraph,
    model: StartModel,
    block: StartModel,
    images: Sequence[StartImage],
    positions: ObservedPositions | None,
) -> Similarity:
    """Transformation of a free model into the ground system."""
    of_model = np.isfinite(model.XYZ[:, 0])
    control = of_model & np.isfinite(net.control[:, 0])
    tied = of_model & np.isfinite(block.XYZ[:, 0])
    source = [model.XYZ[tied]]
    target = [block.XYZ[tied]]
    kind = f"{int(control.sum())} control points"
    # Observed positions take part where points alone are too few.
    seen: list[tuple[Floats, Floats]] = []
    if positions is not None:
        at = {name: k for k, name in enumerate(positions.images)}
        seen = [(p.center, positions.XYZ[at[images[k].name]]) for k, p in model.poses.items() if images[k].name in at]
        kind += f" and {len(seen)} observed positions"
    if tied.sum() < 3 and seen:
        source.append(np.array([s for s, _ in seen]))
        target.append(np.array([t for _, t in seen]))
    try:
        a, b = np.concatenate(source), np.concatenate(target)
        return robust_similarity(a, b, 0.01 * float(np.ptp(b, axis=0).max()) if len(b) else 0.0)[0]
    except GeometryError as error:
        raise GeometryError(f"it has {kind}: {error}") from None


def _result(
    net: ImageGraph, images: Sequence[StartImage], block: StartModel, how: dict[int, str], reasons: dict[int, str]
) -> Started:
    left = []
    for k, image in enumerate(images):
        if k in block.poses:
            continue
        count = len(net.of_image[k])
        why = reasons.get(k)
        if why is None:
            seen = int(np.isfinite(block.XYZ[net.point[net.of_image[k]], 0]).sum())
            why = "no point is measured in it" if count == 0 else _apart(count, seen)
        left.append((image.name, why))
    # What is said of models tells more than what is said of single images.
    told = {images[k].name for k in reasons}
    left.sort(key=lambda item: item[0] not in told)
    known = np.isfinite(block.XYZ[:, 0])
    points = {net.points[k]: tuple(float(v) for v in block.XYZ[k]) for k in np.flatnonzero(known)}
    return Started(
        {images[k].name: block.poses[k] for k in sorted(block.poses)},
        {images[k].name: how[k] for k in sorted(how)},
        points,  # type: ignore[arg-type]
        tuple(left),
    )


def _apart(count: int, known: int) -> str:
    """Why an image with points has no orientation."""
    if known < FEWEST:
        return f"its {count} points do not connect it to other images"
    return (
        f"{known} of its {count} points are known from other images, but no orientation makes enough of them fit: "
        "are camera constant, lens and the names of its points right?"
    )
