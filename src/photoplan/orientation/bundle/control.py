"""Which control points agree with each other: judged point by point, as a set.

What the block says of its control points without any control is one adjustment; from its misclosures and their
covariances every set of points is judged by small dense equations. Sets grow from few points, whatever else is wrong
(consensus: Fischler and Bolles 1981); within a set each point is tested against all others (Baarda 1968, for whole
points instead of single coordinates). The largest set is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy import special

from photoplan.adjustment.chances import chance_chi_square
from photoplan.errors import GeometryError
from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.normal import reduce_normals
from photoplan.orientation.bundle.rows import linearise, residuals_of, whitened
from photoplan.orientation.bundle.unknowns import State

_Floats = NDArray[np.float64]
_Mask = NDArray[np.bool_]

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

    points: NDArray[np.int64]
    """Ground points, indices into `block.ground`, (n,)."""
    known: _Mask
    """Coordinates that are known, (n, 3)."""
    w: _Floats
    """(n, 3), metres; 0 where a coordinate is not known."""
    Q: _Floats
    """Covariance of block and coordinates, (3n, 3n); one and nothing else where a coordinate is not known."""
    defect: int
    """Directions in which nothing but control places the block."""


def misclosures(model: Model, state: State, weight: _Floats, loose: float) -> Misclosures | None:
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

    kept: _Mask
    """Coordinates of all ground points that stay, (g, 3)."""
    alternative: tuple[int, ...] = ()
    """Ground points of the largest other set that agrees; empty where nothing contradicts."""


def agreeing(found: Misclosures, ground: _Mask, critical: float) -> Agreeing:
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


def _largest(found: Misclosures, critical: float, wide: float) -> tuple[_Mask, _Mask]:
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


def _ranked(found: Misclosures, sets: list[_Mask]) -> list[_Mask]:
    """The largest first, of equal ones that with the least misclosures."""
    return sorted(sets, key=lambda mask: (-int(mask.sum()), _fit(found, mask)))


def _grown(found: Misclosures, mask: _Mask, limit: _Floats, wide: float) -> _Mask:
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


def _sizes(found: Misclosures, mask: _Mask) -> _Floats:
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


def _against(found: Misclosures, mask: _Mask, rows: NDArray[np.int64]) -> tuple[float, int]:
    """Squared misclosure of coordinates outside a set, in standard deviations, and how many of them are known."""
    a = (3 * np.flatnonzero(mask)[:, None] + np.arange(3)).ravel()
    G = np.linalg.solve(found.Q[np.ix_(a, a)], found.Q[np.ix_(a, rows)]).T
    off = found.w.ravel()[rows] - G @ found.w.ravel()[a]
    square = float(off @ np.linalg.solve(found.Q[np.ix_(rows, rows)] - G @ found.Q[np.ix_(a, rows)], off))
    return square, int(found.known.ravel()[rows].sum())


def _fit(found: Misclosures, mask: _Mask) -> float:
    """Sum of squared misclosures of a set, in standard deviations."""
    a = (3 * np.flatnonzero(mask)[:, None] + np.arange(3)).ravel()
    return float(found.w.ravel()[a] @ np.linalg.solve(found.Q[np.ix_(a, a)], found.w.ravel()[a]))


def _freedom(found: Misclosures, mask: _Mask) -> int:
    return int(found.known[mask].sum()) - found.defect


def _chance(found: Misclosures, mask: _Mask, wide: float) -> float:
    """Chance that a set of right points fits as badly."""
    freedom = _freedom(found, mask)
    return chance_chi_square(_fit(found, mask) / wide**2, freedom) if freedom > 0 else 1.0
