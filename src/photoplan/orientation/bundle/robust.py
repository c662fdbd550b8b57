"""Weights and gross errors of a bundle adjustment: variance groups, data snooping, control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np
from scipy import special

from photoplan.adjustment.least_squares import MEDIAN_1D, MEDIAN_2D, geman_mcclure, huber, spread
from photoplan.adjustment.statistics import chance_chi_square
from photoplan.arrays import Floats, Ints, Mask
from photoplan.errors import GeometryError
from photoplan.orientation.bundle.equations import (
    PARALLEL,
    Rows,
    inverse_depth_step,
    linearise,
    points_at_infinity,
    reduce_normals,
    residuals_of,
    residuals_of_all,
    whitened,
)
from photoplan.orientation.bundle.model import Active, Block, Model, State

#: Angle between rays below which a point waits until orientations are better, radians; points that every image keeps.
_NARROW, _ENOUGH = 0.02, 8
#: Control that is so many times farther from where its rays meet than the median of all control was given wrongly.
_ASTRAY = 10.0


@dataclass(frozen=True, eq=False)
class Selection:
    """Images, measurements and points that can take part."""

    images: list[int]
    """Indices into `block.images`, and beyond these into `block.projections`."""
    measured: Ints
    """Indices into `block.observations`."""
    points: list[str]
    left_out: tuple[tuple[str, str], ...]
    """Name and reason of what cannot."""


def select(block: Block, active: Active, undetermined: frozenset[str] = frozenset()) -> Selection:
    """Choose images and points with enough measurements."""
    seen = block.observations
    names = [*(b.name for b in block.images), *(p.name for p in block.projections)]
    index = {name: k for k, name in enumerate(names)}
    # A projection needs no more than a point: what is known of its corrections beforehand does the rest.
    least = np.repeat([3, 1], [len(block.images), len(block.projections)])
    image_of = np.array([index.get(n, -1) for n in seen.images], np.int64)[seen.image]
    known = _known(block, active.ground)
    keep = active.image & (image_of >= 0)
    keep &= ~np.array([n in undetermined for n in seen.points], bool)[seen.point]
    direct = _direct(block, active.position)
    images_out: dict[str, str] = {}
    while True:
        rays = np.bincount(seen.point[keep], minlength=len(seen.points))
        # One ray and a height determine a point too, but check nothing.
        enough = (rays >= 2) | ((rays == 1) & (known == 3))
        keep_points = keep & enough[seen.point]
        per_image = np.bincount(image_of[keep_points], minlength=len(names))
        poor = [k for k in range(len(names)) if per_image[k] < least[k] and k not in direct]
        poor = [k for k in poor if names[k] not in images_out]
        if not poor:
            break
        for k in poor:
            images_out[names[k]] = f"image with {per_image[k]} points that can be used; {least[k]} are needed"
        keep = keep_points & ~np.isin(image_of, poor)
    used = np.flatnonzero(enough)
    left = list(images_out.items())
    parallel = "point whose rays are parallel within their accuracy, or put it into a projection centre: not determined"
    left += [(n, parallel) for n in seen.points if n in undetermined]
    few = np.flatnonzero(~enough)
    left += [(seen.points[k], _reason(int(rays[k]))) for k in few if seen.points[k] not in undetermined]
    images = [k for k in range(len(names)) if names[k] not in images_out]
    return Selection(images, np.flatnonzero(keep_points), [seen.points[k] for k in used], tuple(left))


def _reason(rays: int) -> str:
    return "point seen in one image only" if rays == 1 else "point without measurements that can be used"


def _known(block: Block, active: Mask) -> Ints:
    """Control coordinates that take part, of each point of the observations."""
    coordinates = {
        name: int((np.isfinite(block.ground.XYZ[k]) & active[k]).sum())
        for k, name in enumerate(block.ground.names)
        if not block.ground.check[k]
    }
    return np.array([coordinates.get(n, 0) for n in block.observations.points], np.int64)


def _direct(block: Block, active: Mask) -> set[int]:
    """Images whose orientation is observed directly."""
    if block.positions is None or block.attitudes is None:
        return set()
    both = {n for n, used in zip(block.positions.images, active) if used} & set(block.attitudes.images)
    return {k for k, b in enumerate(block.images) if b.name in both}


def start_points(block: Block, selection: Selection, wait: bool = False) -> tuple[Floats, frozenset[str]]:
    """Start values of the selected points (m, 3), and the points whose rays are parallel.

    With `wait`, points of narrow rays count as such, unless an image has too few others: while orientations are only
    about right, they would fly off and take the adjustment with them.
    """
    seen = block.observations
    point_index = {n: k for k, n in enumerate(selection.points)}
    point = np.array([point_index.get(n, -1) for n in seen.points], np.int64)[seen.point[selection.measured]]
    image, centers, directions, sigma = _rays(block, selection)
    XYZ, angle = intersect(centers, directions, point, len(point_index))
    count = np.maximum(np.bincount(point, minlength=len(point_index)), 1)
    usual = np.bincount(point, sigma, len(point_index)) / count
    # An angle between rays that is found with this accuracy tells the distance to the same part; errors of many rays
    # alone make an angle too. Rays that come from a point behind their cameras are parallel as well.
    behind = ((XYZ[point] - centers) * directions).sum(axis=1) < 0
    turned = (np.bincount(point, behind, len(point_index)) > 0.5 * count) & (angle < _NARROW)
    least = usual * np.sqrt(1.0 + 0.5 * PARALLEL**2 * count) / PARALLEL
    determined = np.isfinite(XYZ).all(axis=1) & (angle > np.maximum(least, 1e-7)) & ~turned
    if wait:
        wide = determined & (angle > _NARROW)
        kept = np.bincount(image[wide[point]], minlength=len(selection.images))
        if (kept >= np.minimum(_ENOUGH, np.bincount(image, minlength=len(selection.images)))).all():
            determined = wide
    control = [
        (point_index[name], block.ground.XYZ[k])
        for k, name in enumerate(block.ground.names)
        if name in point_index and not block.ground.check[k]
    ]
    off = np.array([np.linalg.norm(XYZ[at] - given) if determined[at] else np.nan for at, given in control])
    far = _ASTRAY * np.nanmedian(off) if np.isfinite(off).any() else np.inf
    for (at, given), distance in zip(control, off):
        if np.isfinite(given).all():
            # A point that was exchanged with another one begins where its rays meet: from where it is not, the first
            # step would tear the block apart.
            if not distance > far:
                XYZ[at], determined[at] = given, True
        elif not determined[at]:
            XYZ[at] = _on_ray(centers[point == at][0], directions[point == at][0], given)
            determined[at] = np.isfinite(XYZ[at]).all()
    for name, start in block.start_points.items():
        if name in point_index:
            XYZ[point_index[name]] = start
            determined[point_index[name]] = True
    return XYZ, frozenset(selection.points[k] for k in np.flatnonzero(~determined))


def _rays(block: Block, selection: Selection) -> tuple[Ints, Floats, Floats, Floats]:
    """Of all measurements that were selected: number of the image, origin and direction (k, 3) of its ray, and the
    standard deviation of that, radians."""
    seen = block.observations
    chosen = [block.images[k] for k in selection.images if k < len(block.images)]
    projections = [block.projections[k - len(block.images)] for k in selection.images if k >= len(block.images)]
    numbers = {n: k for k, n in enumerate([*(b.name for b in chosen), *(p.name for p in projections)])}
    image = np.array([numbers.get(n, -1) for n in seen.images], np.int64)[seen.image[selection.measured]]
    xy, spread = seen.xy[selection.measured], seen.sigma[selection.measured].mean(axis=1)
    directions, centers = np.empty((len(image), 3)), np.empty((len(image), 3))
    sigma = np.empty(len(image))
    order = np.argsort(image, kind="stable")
    ends = np.searchsorted(image[order], np.arange(len(numbers) + 1))
    for k, b in enumerate(chosen):
        mine = order[ends[k] : ends[k + 1]]
        camera = block.cameras[b.camera]
        t = camera.lens.undistort((b.plane_to_pixel.inverse(xy[mine]) - camera.principal_point) / camera.c)
        d = np.column_stack([t, -np.ones(len(t))]) @ b.pose.R_ground_camera.T
        directions[mine] = d / np.linalg.norm(d, axis=1, keepdims=True)
        pixel = np.sqrt(abs(np.linalg.det(b.plane_to_pixel.derivative(np.array(camera.principal_point)))))
        sigma[mine] = spread[mine] / (camera.c * pixel)
        centers[mine] = b.pose.center
    for k, p in enumerate(projections, len(chosen)):
        mine = order[ends[k] : ends[k + 1]]
        centers[mine], directions[mine] = p.sight(xy[mine])
        # An angle that is as large as the point's size seen from there.
        sigma[mine] = spread[mine] * p.metres / p.away
    return image, centers, directions, sigma


def _on_ray(center: Floats, direction: Floats, given: Floats) -> Floats:
    """Point of a ray at a known height; NaN without one."""
    if not (np.isfinite(given[2]) and abs(direction[2]) > 1e-6):
        return np.full(3, np.nan)
    return np.asarray(center + direction * ((given[2] - center[2]) / direction[2]))


def intersect(centers: Floats, directions: Floats, point: Ints, count: int, rounds: int = 6) -> tuple[Floats, Floats]:
    """Points nearest to their rays, in the robust mean, and the angle at which two such rays would meet, radians.

    Parameters
    ----------
    centers, directions : ndarray, shape (k, 3)
        Origins and unit directions of rays.
    point : ndarray, shape (k,)
        Point of each ray.
    count : int
        Number of points.
    """
    weight = np.ones(len(point))
    good_rays = np.asarray(np.isfinite(directions).all(axis=1))
    directions = np.where(good_rays[:, None], directions, 0.0)
    projector = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    XYZ = np.full((count, 3), np.nan)
    meeting = np.zeros(count)
    for turn in range(rounds):
        w = weight * good_rays
        N = np.empty((count, 3, 3))
        for i in range(3):
            for j in range(3):
                N[:, i, j] = np.bincount(point, w * projector[:, i, j], count)
        from_center = (projector @ centers[:, :, None])[:, :, 0]
        b = np.stack([np.bincount(point, w * from_center[:, i], count) for i in range(3)], axis=-1)
        values = np.linalg.eigvalsh(N)
        if turn == 0:
            # Two rays at the angle a have the eigenvalues 1 − cos a and 2.
            meeting = np.sqrt(np.maximum(2.0 * values[:, 0], 0.0))
        solvable = values[:, 0] > 1e-14 * np.maximum(values[:, 2], 1e-300)
        N[~solvable] = np.eye(3)
        XYZ = np.where(solvable[:, None], np.linalg.solve(N, b[:, :, None])[:, :, 0], np.nan)
        to = XYZ[point] - centers
        distance = np.linalg.norm(to, axis=1)
        across = np.linalg.norm((projector @ to[:, :, None])[:, :, 0], axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            angle = np.where(distance > 0, across / distance, 0.0)
        scale = max(float(np.nanmedian(angle[good_rays])) if good_rays.any() else 0.0, 1e-12)
        # Far rays count less, as their error across is larger; gross errors hardly count.
        weight = np.nan_to_num(geman_mcclure(angle, 3.0 * scale) / np.maximum(distance, 1e-9) ** 2)
    return XYZ, meeting


#: Sets that are begun with at most, and of these those that grow to the end.
_BEGINNINGS, _GROWN = 150, 8
#: Chance of a set that fits as badly as it does, below which its accuracy counts as stated too well.
_UNLIKELY = 0.02
#: Chance of a part of a point (its place, or its height) below which it goes out with the rest of the point.
_PART = 0.01
#: Factor for the variances of what nothing but control places.
_LOOSER = 1e4
#: How far a point may be from its given place, in distances between camera and ground.
_FAR = 10.0
#: By how much standard deviations are widened while less than half of the points agree, and how often at most.
_WIDER, _OFTEN = 1.5, 6
#: Chance below which a set is not believed though each of its points fits the others: wrong points hide each other.
_MASKED = 1e-6


@dataclass(frozen=True, eq=False)
class Misclosures:
    """Where the block puts its control points without them, minus their coordinates; n points, X Y Z by turns."""

    points: Ints
    """Ground points, indices into `block.ground`, (n,)."""
    known: Mask
    """Coordinates that are known, (n, 3)."""
    w: Floats
    """(n, 3), metres; 0 where a coordinate is not known."""
    Q: Floats
    """Covariance of block and coordinates, (3n, 3n); one and nothing else where a coordinate is not known."""
    defect: int
    """Directions in which nothing but control places the block."""


def misclosures(model: Model, state: State, weight: Floats, loose: float) -> Misclosures | None:
    """Misclosures of all control at a state; None where there is none, or the block is not determined."""
    names, of = np.unique(model.ground, return_inverse=True)
    if not len(names):
        return None
    soft = weight.copy()
    soft[model.parts.ground] = 1.0 / (np.linalg.norm(model.ground_white, axis=1) * loose) ** 2
    point = np.empty(len(names), np.int64)
    point[of] = model.ground_point
    # A point whose rays were all wrong may be anywhere: it is looked at from where it should be.
    extent = np.linalg.norm(model.origins(state.images.centers) - state.XYZ[model.point], axis=1)
    far = np.linalg.norm(state.XYZ[point] - model.block.ground.XYZ[names], axis=1) > _FAR * np.median(extent)
    XYZ = state.XYZ.copy()
    XYZ[point[far]] = model.block.ground.XYZ[names[far]]
    state = replace(state, XYZ=XYZ)
    soft = np.where(np.isfinite(whitened(model, residuals_of(model, state))), soft, 0.0)
    rows, _ = linearise(model, state, np.sqrt(soft))
    reduced = reduce_normals(rows, len(model.point_names))
    coordinate = (3 * point[:, None] + np.arange(3)).ravel()
    V = np.zeros((len(coordinate), len(coordinate)))
    for k, inverse in enumerate(reduced.V_inverse[point]):
        V[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = inverse
    M = reduced.N_pg[coordinate].toarray() * reduced.scale
    try:
        moved = (state.XYZ + reduced.solve()[1])[point]
        Q = V + V @ (M @ reduced.factor.solve(M.T)) @ V
    except GeometryError:
        return None
    if not np.isfinite(Q).all():
        return None
    # More would be lost by rounding in the equations; so what only that control holds is made loose here.
    values, vectors = np.linalg.eigh(Q)
    free = values > (0.1 * loose) ** 2
    values[free] *= _LOOSER
    Q, defect = (vectors * values) @ vectors.T, int(free.sum())
    known = np.zeros((len(names), 3), bool)
    known[of, model.ground_axis] = True
    for k in range(len(names)):
        mine = np.flatnonzero(of == k)
        at = 3 * k + model.ground_axis[mine]
        W = model.ground_white[mine][:, model.ground_axis[mine]]
        Q[np.ix_(at, at)] += np.linalg.inv(W.T @ W)
    lost = np.flatnonzero(~known.ravel())
    Q[lost] = Q[:, lost] = 0.0
    Q[lost, lost] = 1.0
    return Misclosures(
        points=names, known=known, w=np.where(known, moved - model.block.ground.XYZ[names], 0.0), Q=Q, defect=defect
    )


@dataclass(frozen=True, eq=False)
class Agreeing:
    """Result of `agreeing`."""

    kept: Mask
    """Coordinates of all ground points that stay, (g, 3)."""
    alternative: tuple[int, ...] = ()
    """Ground points of the largest other set that agrees; empty where nothing contradicts."""


def agreeing(found: Misclosures, ground: Mask, critical: float) -> Agreeing:
    """The largest set of control points that agree, with what of the others agrees with it too.

    Where less than half of the points agree, or the set fits worse than its standard deviations allow, these are taken
    as stated too well, not the points as wrong. Where another set is as large, nothing tells which holds the wrong
    point, and all stay.
    """
    kept = ground.copy()
    wide, sets = 1.0, []
    for _ in range(_OFTEN):
        sets.append(_largest(found, critical, wide))
        best = sets[-1][0]
        least = np.sqrt(max(_fit(found, best), 0.0) / max(_freedom(found, best), 1))
        if 2 * best.sum() <= len(best):
            wide *= _WIDER
        elif _chance(found, best, wide) < _UNLIKELY and least > 1.05 * wide:
            wide = least
        else:
            break
    best, other = sets[-1] if 2 * sets[-1][0].sum() > len(kept[found.points]) else sets[0]
    if other.sum() >= best.sum() and not best.all():
        kept[found.points] = True
        return Agreeing(kept, tuple(found.points[other].tolist()))
    kept[found.points] = best[:, None]
    # A wrong height does not make the place of a point wrong, nor the other way round.
    for k in np.flatnonzero(~best):
        for part in ([0, 1], [2]):
            if found.known[k][part].any() and found.known[k].sum() > found.known[k][part].sum():
                square, freedom = _against(found, best, 3 * int(k) + np.array(part))
                kept[found.points[k], part] = chance_chi_square(square, freedom) > _PART
    return Agreeing(kept, () if best.all() else tuple(found.points[other].tolist()))


def _largest(found: Misclosures, critical: float, wide: float) -> tuple[Mask, Mask]:
    """The largest set that agrees, and the largest of those that hold a point which it does not, masks (n,)."""
    n = len(found.points)
    limit = wide**2 * special.chdtri(np.maximum(found.known.sum(axis=1), 1), 2.0 * special.ndtr(-critical))
    every = _grown(found, np.ones(n, bool), limit, wide)
    if every.all():
        return every, ~every
    few = min(3, n - 1)
    beginnings = list(combinations(range(n), few)) if comb(n, few) <= _BEGINNINGS else []
    if not beginnings:
        rng = np.random.default_rng(n)
        beginnings = [tuple(rng.choice(n, few, replace=False)) for _ in range(_BEGINNINGS)]
    near = []
    for beginning in beginnings:
        mask = np.zeros(n, bool)
        mask[list(beginning)] = True
        size = _sizes(found, mask) / limit
        near.append((-int((size <= 1.0).sum()), float(np.minimum(size, 1.0).sum()), (size <= 1.0) | mask))
    near.sort(key=lambda item: item[:2])
    masks = list({mask.tobytes(): mask for _, _, mask in near}.values())
    best = _ranked(found, [every, *(_grown(found, mask, limit, wide) for mask in masks[:_GROWN])])[0]
    others = sorted((mask for mask in masks if (mask & ~best).any()), key=lambda mask: -int((mask & ~best).sum()))
    second = [_grown(found, mask, limit, wide) for mask in others[:_GROWN]]
    second = [grown for grown in second if (grown & ~best).any()]
    return best, (_ranked(found, second) or [np.zeros(n, bool)])[0]


def _ranked(found: Misclosures, sets: list[Mask]) -> list[Mask]:
    """The largest first, of equal ones that with the least misclosures."""
    return sorted(sets, key=lambda mask: (-int(mask.sum()), _fit(found, mask)))


def _grown(found: Misclosures, mask: Mask, limit: Floats, wide: float) -> Mask:
    """A set from which the worst points have gone until it agrees, and to which those that fit have come."""
    mask = mask.copy()
    for _ in range(3 * len(mask)):
        size = _sizes(found, mask) / limit
        worst = int(np.argmax(np.where(mask, size, -1.0)))
        if size[worst] > 1.0 or (mask.sum() > 3 and _chance(found, mask, wide) < _MASKED):
            mask[worst] = False
            continue
        best = int(np.argmin(np.where(mask, np.inf, size)))
        if mask.all() or size[best] > 1.0:
            break
        mask[best] = True
    return mask


def _sizes(found: Misclosures, mask: Mask) -> Floats:
    """Squared misclosure of each point (n,) in standard deviations, against the points of a set without itself."""
    n, inside = len(mask), np.flatnonzero(mask)
    a = (3 * inside[:, None] + np.arange(3)).ravel()
    P = np.linalg.inv(found.Q[np.ix_(a, a)])
    w, v = found.w.ravel(), P @ found.w[inside].ravel()
    out = np.empty(n)
    own = P.reshape(len(inside), 3, len(inside), 3)[range(len(inside)), :, range(len(inside))]
    v3 = v.reshape(-1, 3)
    out[inside] = np.einsum("ni,ni->n", v3, np.linalg.solve(own, v3[:, :, None])[:, :, 0])
    others = np.flatnonzero(~mask)
    b = (3 * others[:, None] + np.arange(3)).ravel()
    across = found.Q[np.ix_(b, a)]
    G = across @ P
    off = (w[b] - G @ w[a]).reshape(-1, 3)
    rows = 3 * others[:, None] + np.arange(3)
    R = found.Q[rows[:, :, None], rows[:, None, :]] - np.einsum(
        "nik,njk->nij", G.reshape(len(others), 3, len(a)), across.reshape(len(others), 3, len(a))
    )
    out[others] = np.einsum("ni,ni->n", off, np.linalg.solve(R, off[:, :, None])[:, :, 0])
    return out


def _against(found: Misclosures, mask: Mask, rows: Ints) -> tuple[float, int]:
    """Squared misclosure of coordinates outside a set, in standard deviations, and how many of them are known."""
    a = (3 * np.flatnonzero(mask)[:, None] + np.arange(3)).ravel()
    G = np.linalg.solve(found.Q[np.ix_(a, a)], found.Q[np.ix_(a, rows)]).T
    off = found.w.ravel()[rows] - G @ found.w.ravel()[a]
    square = float(off @ np.linalg.solve(found.Q[np.ix_(rows, rows)] - G @ found.Q[np.ix_(a, rows)], off))
    return square, int(found.known.ravel()[rows].sum())


def _fit(found: Misclosures, mask: Mask) -> float:
    """Sum of squared misclosures of a set, in standard deviations."""
    a = (3 * np.flatnonzero(mask)[:, None] + np.arange(3)).ravel()
    return float(found.w.ravel()[a] @ np.linalg.solve(found.Q[np.ix_(a, a)], found.w.ravel()[a]))


def _freedom(found: Misclosures, mask: Mask) -> int:
    return int(found.known[mask].sum()) - found.defect


def _chance(found: Misclosures, mask: Mask, wide: float) -> float:
    """Chance that a set of right points fits as badly."""
    freedom = _freedom(found, mask)
    return chance_chi_square(_fit(found, mask) / wide**2, freedom) if freedom > 0 else 1.0


#: Kinds of rows: what a group of observations is called, and the unit of its residuals.
Kinds = tuple[tuple[str, str], ...]

#: Approximate orientations that place the block, as messages call them.
DATUM = "datum from orientations"
#: Standard deviation of softened control in units of an image point's on the ground.
_SOFT = 3.0
#: Iterations with Huber's weights before gross errors may lose all influence.
_HUBER = 5
#: Where the weights begin to fall, in standard deviations.
_HUBER_LIMIT, _FALL = 2.0, 3.0
#: Standard deviation of control in the same units while it is asked which of it agrees.
_LOOSE = 100.0
#: Image points are not judged by less than this part of their stated standard deviation, however small residuals are.
_BEST = 0.05
#: An observation that was taken out comes back when its residual is below this part of the critical value.
_BACK = 0.75


@dataclass(frozen=True, eq=False)
class Judged:
    """What data snooping looks at, of all rows."""

    e: Floats
    """Residuals divided by the standard deviations that were stated."""
    normalised: Floats
    """Residuals divided by their own standard deviations."""
    weight: Floats
    scales: Floats
    """Of each group (`kinds_of`): standard deviation of its residuals in units of the stated ones."""


def kinds_of(model: Model) -> tuple[Kinds, Ints]:
    """Groups of observations, and the group of each row; rows of what is known beforehand are not listed.

    Control and check points are measured otherwise than tie points (by hand, say), so they are groups of their own.
    """
    kinds: list[tuple[str, str]] = [(f"image points, {name}", "px") for name in model.groups]
    kinds += [(f"control and check points in images, {name}", "px") for name in model.groups]
    of = [np.repeat(kinds_of_measurements(model)[model.observation], 2)]
    at = len(kinds)
    kinds += [("control, horizontal", "m"), ("control, height", "m")]
    of.append(at + (model.ground_axis == 2))
    block = model.block
    if block.positions is not None:
        at = len(kinds)
        what = DATUM if block.datum else "observed positions"
        kinds += [(f"{what}, horizontal", "m"), (f"{what}, height", "m")]
        of.append(np.tile([at, at, at + 1], len(model.position)))
    if block.attitudes is not None:
        kinds.append((f"{DATUM}, angles" if block.datum else "observed attitudes", "rad"))
        of.append(np.full(3 * len(model.attitude), len(kinds) - 1))
    return tuple(kinds), np.concatenate(of).astype(np.int64)


def kinds_of_measurements(model: Model) -> Ints:
    """Group of every measurement of the block, also of those that take no part; −1: its image takes none."""
    seen = model.block.observations
    groups = {name: k for k, name in enumerate(model.groups)}
    of_image = {b.name: groups.get(f"camera {b.camera}", -1) for b in model.block.images}
    of_image |= {p.name: groups.get(p.group, -1) for p in model.block.projections}
    camera = np.array([of_image.get(n, -1) for n in seen.images], np.int64)[seen.image]
    names = set(model.block.ground.names)
    surveyed = np.array([n in names for n in seen.points], bool)[seen.point]
    return np.where(camera < 0, -1, camera + len(groups) * surveyed)


def weights_of(model: Model, active: Active, factors: Floats | None = None) -> Floats:
    """Weights of all rows: 0 for what is taken out, 1 / factor² for its group's variance factor."""
    weight = np.ones(model.rows)
    if factors is not None:
        weight[: model.observed] = 1.0 / factors[kinds_of(model)[1]] ** 2
    weight[model.parts.ground] *= active.ground[model.ground, model.ground_axis]
    weight[model.parts.position] *= np.repeat(active.position[model.position_row], 3)
    return weight


def downweighted_control(model: Model, state: State) -> Floats:
    """Weights that make control no better than what image points say of the ground, while gross errors are sought.

    A wrong control point of high weight would otherwise draw its image points along, and these would look wrong.
    """
    out = np.ones(model.rows)
    blur = _SOFT * image_on_ground(model, state)
    sigma = 1.0 / np.linalg.norm(model.ground_white, axis=1)
    out[model.parts.ground] = sigma**2 / (sigma**2 + blur**2)
    return out


def image_on_ground(model: Model, state: State) -> float:
    """Standard deviation of an image point on the ground, metres; the median."""
    size = [model.sigma[mine].mean(axis=1) * p.metres for p, _, mine in model.of_projections]
    model = model.posed
    distance = np.linalg.norm(state.XYZ[model.point] - state.images.centers[model.image], axis=1)
    pixel = np.sqrt(np.abs(model.plane[:, 0] * model.plane[:, 5] - model.plane[:, 1] * model.plane[:, 4]))
    c = np.array([state.camera(name).c for name in model.camera_names])[model.camera_of[: len(pixel)]] * pixel
    return float(np.median(np.concatenate([model.sigma.mean(axis=1) * distance / c[model.image], *size])))


def robust_scale(e: Floats, kind: tuple[str, str]) -> float:
    """Standard deviation of a group's whitened residuals, that one in five gross errors hardly moves.

    Image points may be better than stated. Control, positions and attitudes may not: many of them are checked so little
    that their residuals are small for that reason alone. Fewer than 20 residuals count as stated: 1.
    """
    e = e[np.isfinite(e)]
    if len(e) < 20:
        return 1.0
    return max(spread(e), _BEST if kind[1] == "px" else 1.0)


def _joined(e: Floats, kind: tuple[str, str]) -> Floats:
    """Whitened residuals of a group, each coordinate of an image point replaced by what its length makes of it.

    Points of two rays have no residuals along the base, so that half of all coordinates would be small.
    """
    if kind[1] != "px":
        return e
    length: Floats = np.linalg.norm(e.reshape(-1, 2), axis=1)
    return np.repeat(length * (MEDIAN_1D / MEDIAN_2D), 2)


def robust_weights(model: Model, e: Floats, turn: int) -> Floats:
    """Weights that fall with the residual: Huber's at first, then Geman and McClure's.

    Both coordinates of an image point, and all of an observed position, have one weight.
    """
    size = _sizes_robust(model, e)
    weight = np.ones(len(e))
    kinds, of = kinds_of(model)
    stretch = _stretch(model)
    for k in range(len(kinds)):
        mine = np.flatnonzero(of == k)
        # Sizes of two or three coordinates are longer than single ones; the scale is that of the single ones.
        s = size[mine] / (robust_scale(_joined(e[mine], kinds[k]), kinds[k]) * stretch)
        weight[mine] = huber(s, _HUBER_LIMIT) if turn < _HUBER else geman_mcclure(s, _FALL)
    return np.nan_to_num(weight)


def scales_of(model: Model, e: Floats) -> Floats:
    """Standard deviation of the errors of each group (`kinds_of`), of whitened residuals, in a robust way."""
    kinds, of = kinds_of(model)
    own = e[: len(of)]
    return np.array([robust_scale(_joined(own[of == k], kind), kind) for k, kind in enumerate(kinds)]) * _stretch(model)


def _stretch(model: Model) -> float:
    """How much longer errors are than residuals, in the mean: unknowns take a part of the errors."""
    rows = model.observed
    unknowns = model.columns.count + 3 * len(model.point_names)
    return float(np.sqrt(rows / max(rows - unknowns, 0.05 * rows)))


def _sizes_robust(model: Model, e: Floats) -> Floats:
    """Length of the whitened residual that each row is part of, in units of one coordinate's."""
    size = np.abs(e)
    for part, n in ((model.parts.image, 2), (model.parts.position, 3)):
        size[part] = np.repeat(np.sqrt((e[part].reshape(-1, n) ** 2).mean(axis=1)), n)
    return size


def first_taken_out(model: Model, state: State, active: Active, critical: float) -> Active:
    """Take out what does not fit the robust estimate at `state`."""
    e = whitened(model, residuals_of(model, state)) * np.sqrt(downweighted_control(model, state))
    size, of = np.abs(e), kinds_of(model)[1]
    size[: len(of)] /= scales_of(model, e)[of]
    size[~np.isfinite(size)] = np.inf
    # Where residuals are small beside the errors this is too strict, so it takes twice as much here; data snooping does
    # the rest.
    bad = size[: len(of)] > 2.0 * critical
    # Gross errors are few. Where most positions look wrong the robust estimate has lost them, and snooping will tell.
    wrong = bad[model.parts.position].reshape(-1, 3).any(axis=1)
    if 2 * np.count_nonzero(wrong) > wrong.size:
        bad[model.parts.position] = False
    # Control is judged afterwards, as a set (`judged_control`).
    return _without(model, active, bad)


def judged_control(
    model: Model, state: State, active: Active, factors: Floats, critical: float
) -> tuple[Active, tuple[str, ...]]:
    """Control of which the largest set agrees, and the names of the largest other set.

    `factors` are the standard deviations of the groups' residuals (`kinds_of`) in units of the stated ones.
    """
    control = np.array([name.startswith("control, ") for name, _ in kinds_of(model)[0]], bool)
    weight = weights_of(model, active, np.where(control, 1.0, factors))
    used = active.image[model.observation]
    # A tie point of one ray says nothing, and its equations are singular.
    alone = np.bincount(model.point[used], minlength=len(model.point_names)) < 2
    alone[model.ground_point] = False
    weight[model.parts.image] *= np.repeat(used & ~alone[model.point], 2)
    found = misclosures(model, state, weight, _LOOSE * image_on_ground(model, state))
    if found is None:
        return active, ()
    result = agreeing(found, active.ground, critical)
    return replace(active, ground=result.kept), tuple(model.block.ground.names[k] for k in result.alternative)


def _without(model: Model, active: Active, bad: Mask) -> Active:
    """Take out the observations whose rows are bad."""
    image, position = active.image.copy(), active.position.copy()
    image[model.observation[bad[model.parts.image].reshape(-1, 2).any(axis=1)]] = False
    position[model.position_row[bad[model.parts.position].reshape(-1, 3).any(axis=1)]] = False
    return Active(image, active.ground, position)


def data_snooping(model: Model, state: State, judged: Judged, active: Active, critical: float) -> Active:
    """Data snooping: the worst measurement of each point is taken out, and what fits again comes back.

    Only the largest normalised residual of a point is judged at a time, since a gross error spreads over the
    residuals of its point's other measurements.
    """
    _, of = kinds_of(model)
    size = np.nan_to_num(np.abs(judged.normalised[: len(of)]))
    size[judged.weight[: len(of)] == 0] = 0.0
    on = slice(0, model.parts.ground.stop)
    bad = size > critical
    bad[model.parts.ground] = False
    point = np.concatenate([np.repeat(model.point, 2), model.ground_point])
    worst = np.zeros(len(model.point_names))
    np.maximum.at(worst, point, size[on])
    bad[on] &= size[on] >= worst[point]
    out = _without(model, active, bad)
    return _brought_back(model, state, judged, active, out, critical * _BACK)


def _brought_back(model: Model, state: State, judged: Judged, before: Active, after: Active, limit: float) -> Active:
    """Observations that were out before and fit now."""
    block, scales = model.block, judged.scales
    _, of = kinds_of(model)
    residuals = residuals_of_all(model, state)
    image = after.image.copy()
    kind = kinds_of_measurements(model)
    with np.errstate(invalid="ignore"):
        size = np.abs(residuals / block.observations.sigma).max(axis=1) / scales[kind]
    image |= ~before.image & (kind >= 0) & (np.nan_to_num(size, nan=np.inf) < limit)
    position = after.position.copy()
    off = np.abs(judged.e[: len(of)]) / scales[of]
    fits = off[model.parts.position].reshape(-1, 3).max(axis=1) < limit
    position[model.position_row[fits & ~before.position[model.position_row]]] = True
    return Active(image, after.ground, position)


#: Called after each iteration: its number, and the root mean square of the weighted residuals.
Progress = Callable[[int, float], None]


#: Largest step at the end, in units of each unknown's own standard deviation (the others fixed).
_CONVERGED = 1e-3
_ROUNDING = 1e-6
#: The same for the robust start, and its least number of iterations.
_ROUGHLY, _LEAST = 0.5, 8
#: Largest relative change of the sum of squares at the end. Below _CONVERGED ** 2 variances it means nothing either: an
#: unknown that is off by the largest step makes as much, and rounding of large coordinates may make more than 1e-9.
_SETTLED = 1e-9
#: Damped steps are short for that reason alone. But where so many of them one after the other lower the sum of squares
#: by less than this part of a variance each, what is left to go means nothing: an unknown that is off by its whole
#: standard deviation makes one.
_FLAT, _FLAT_STEPS = 1e-4, 4
#: Part of a variance that may be left to go where the number of iterations is used up, as the last steps shrink.
_NEARLY = 0.1
#: Iterations after which it is looked whether rays of points are parallel.
_LOOK = 5
#: Whole steps that may make things worse for once, and steps within which it has to be better than ever.
_PATIENCE, _AWAY = 4, 8
#: Damping (part of the diagonal) after a step that made things worse, and when to give up.
_FIRST_DAMPING, _MOST_DAMPING = 1e-12, 1e6


class Loop:
    """Iterations to the minimum; counts them over all rounds of an adjustment."""

    def __init__(self, most: int, progress: Progress) -> None:
        self.count = 0
        self._most, self._progress = most, progress

    def watched(self, model: Model, state: State, base: Floats) -> tuple[State, frozenset[str]]:
        """As `run`, but stopped where the rays of points turn out to be parallel: these points are handed back."""
        watch = _Watch()
        state = self.run(model, state, base, watch=watch)
        if watch.loose:
            return state, watch.loose
        e = whitened(model, residuals_of(model, state))
        behind = np.flatnonzero(~np.isfinite(e[model.parts.image][::2]) & (base[model.parts.image][::2] > 0))
        rows, _ = linearise(model, state, np.sqrt(np.where(np.isfinite(e), base, 0.0)))
        return state, frozenset(model.point_names[k] for k in model.point[behind]) | points_at_infinity(
            model, state, rows
        )

    def run(self, model: Model, state: State, base: Floats, robust: bool = False, watch: _Watch | None = None) -> State:
        """The state where the sum of squares with weights `base` (rows,) is least."""
        if robust:
            base = base * downweighted_control(model, state)
        descent, cost, gains = _Descent(model, state), np.inf, [np.inf] * _FLAT_STEPS
        for turn in range(self._most):
            e = whitened(model, residuals_of(model, state))
            weight = base * robust_weights(model, e * np.sqrt(base), turn) if robust else base
            weight = np.where(np.isfinite(e), weight, 0.0)
            before = _cost(e, weight)
            redundancy = max(1.0, float((weight > 0).sum()) - model.columns.count - 3 * len(model.point_names))
            if descent.leads_nowhere(state, before) and not robust:
                state = descent.taken_up()
                continue
            rows, _ = linearise(model, state, np.sqrt(weight))
            # Not in the middle of steps that made things worse: rays are parallel there that are not.
            if watch is not None and watch.stops(turn, model, state, rows, calm=state is descent.best):
                return state
            step = descent.step(state, rows, weight, before, redundancy)
            state, after = step.state, step.cost
            self.count += 1
            self._progress(self.count, float(np.sqrt(after / max(1.0, float((weight > 0).sum())))))
            variance = after / redundancy
            gains = [*gains[1:], abs(before - after) / max(variance, 1e-300)]
            if robust:
                if turn >= _LEAST and step.largest < _ROUGHLY:
                    return state
            elif step.ends(abs(cost - after) <= _SETTLED * after or after < 1e-18 * len(e), max(gains)):
                if descent.is_least(after, redundancy):
                    return state
                descent.go_back()
            cost = after
        if robust or _left(gains) < _NEARLY:
            return state
        raise GeometryError(
            f"the adjustment has not converged after {self._most} iterations (largest step {step.largest:.2g} standard "
            "deviations). Are the start orientations about right, and all free parameters determined? Images that have "
            "no start orientation are oriented from control and tie points"
        )


class _Watch:
    """Looks now and then whether the rays of points are parallel."""

    def __init__(self) -> None:
        self.loose: frozenset[str] = frozenset()
        self._due = False

    def stops(self, turn: int, model: Model, state: State, rows: Rows, calm: bool) -> bool:
        """Whether points have been found that rays do not determine; `calm`: it may be looked now."""
        self._due |= turn % _LOOK == _LOOK - 1
        if not (self._due and calm):
            return False
        self._due = False
        self.loose = points_at_infinity(model, state, rows)
        return bool(self.loose)


@dataclass(frozen=True, eq=False)
class _Step:
    """Where a step has led."""

    state: State
    cost: float
    largest: float
    """Largest component in units of each unknown's own standard deviation."""
    damped: bool

    def ends(self, settled: bool, gain: float) -> bool:
        """Whether it is the last one; `settled`: the sum of squares is, `gain`: the largest of the last steps."""
        # A damped step is short for that reason alone, unless rounding is all that is left.
        short = self.largest < _CONVERGED or settled
        return (not self.damped and short) or self.largest < _ROUNDING or gain < _FLAT


class _Descent:
    """Damping of steps, the best state so far, and for how long it may be left."""

    def __init__(self, model: Model, start: State) -> None:
        self._model, self._damping = model, 0.0
        self.best, self._least = start, np.inf
        self._patience, self._away = _PATIENCE, 0
        self._gone_back = False

    def leads_nowhere(self, state: State, cost: float) -> bool:
        """Keep a state if it is the best one; whether steps that made things worse have come to nothing."""
        self._away += 1
        if cost <= self._least:
            self.best, self._least, self._away = state, cost, 0
            return False
        return not self._gone_back and (self._patience == 0 or self._away > _AWAY)

    def taken_up(self) -> State:
        """The best state again, from which damped steps alone go on."""
        self._gone_back, self._damping, self._patience = True, _FIRST_DAMPING, 0
        return self.best

    def is_least(self, cost: float, redundancy: float) -> bool:
        """Whether an end with this sum of squares counts: it is the best one, or no other way is left."""
        return self._gone_back or _is_no_more(cost, self._least, redundancy)

    def go_back(self) -> None:
        """Take up the best state next, unless the state at hand is better."""
        self._away = _AWAY

    def step(self, state: State, rows: Rows, weight: Floats, before: float, redundancy: float) -> _Step:
        """A step that lowers the sum of squares, damped until it does; a whole one may raise it for once."""
        model = self._model
        while True:
            reduced = reduce_normals(rows, len(model.point_names), self._damping)
            moves, points = reduced.solved(model, state)
            moved = state.moved(model.columns, moves, inverse_depth_step(model, state, points))
            after = _cost(whitened(model, residuals_of(model, moved)), weight)
            if _is_no_more(after, before, redundancy):
                break
            if self._patience > 0 and self._damping == 0.0 and after < np.inf:
                self._patience -= 1
                break
            self._damping = max(10.0 * self._damping, _FIRST_DAMPING)
            if self._damping > _MOST_DAMPING:
                raise GeometryError(
                    "the adjustment does not converge: no step makes the residuals smaller. Are start "
                    "orientations, image points and control of the same block?"
                )
        self._damping = 0.0 if self._damping <= _FIRST_DAMPING else self._damping / 10.0
        largest = float(np.abs(moves / reduced.scale).max()) if len(moves) else 0.0
        return _Step(moved, after, largest, self._damping > 0.0)


def _is_no_more(after: float, before: float, redundancy: float) -> bool:
    """Whether a sum of squares is no larger than another, but for what means nothing."""
    return after <= before + max(_SETTLED, _CONVERGED**2 / redundancy) * before + 1e-12


def _left(gains: list[float]) -> float:
    """What steps to come may gain, if each is to the next as the last ones were; infinite where they do not shrink."""
    first, last = gains[0], gains[-1]
    ratio = (last / first) ** (1.0 / (len(gains) - 1)) if 0.0 < last < first < np.inf else 1.0 - (last == 0.0)
    return last * ratio / (1.0 - ratio) if ratio < 1.0 else np.inf


def _cost(e: Floats, weight: Floats) -> float:
    """Weighted sum of squares; infinite when a point that counts has come behind a camera."""
    counted = weight > 0
    if not np.isfinite(e[counted]).all():
        return np.inf
    return float((weight[counted] * e[counted] ** 2).sum())
