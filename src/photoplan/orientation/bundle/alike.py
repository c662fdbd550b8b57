"""Errors of image points that are alike, weighed against accuracies that were stated wrongly: by their likelihood.

Residuals of few points hide that errors are alike: orientations follow these errors, and classes of distance hold few
pairs. All that no unknown moves tells it nevertheless, the misfits of observed positions included: errors that are
alike displace images in a way that is known, errors of positions displace each by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from photoplan.adjustment.chances import chance_chi_square
from photoplan.adjustment.components import Components, variance_components
from photoplan.orientation.bundle.block import Active, Adjusted, Block
from photoplan.orientation.bundle.model import Model, build_model
from photoplan.orientation.bundle.robust import kinds_of
from photoplan.orientation.bundle.rows import linearise
from photoplan.orientation.bundle.select import select
from photoplan.orientation.bundle.unknowns import start_state

_Floats = NDArray[np.float64]

#: Images and contrasts that are looked at at most: a neighbourhood tells as much as needed.
_IMAGES, _CONTRASTS = 30, 400
#: Contrasts below which nothing is said.
_FEW = 40
#: Correlation lengths that are tried, as parts of the extent of an image's points, and on either side of the best.
_LENGTHS = 1.0 / np.array([48.0, 24.0, 12.0, 6.0, 3.0])
_BESIDE = 2.0 ** np.array([-0.5, 0.5])
#: Chance from which on a difference in likelihood means something.
_CHANCE = 1e-4
#: Times that an accuracy is worse than stated from which on it is named.
_WORSE = 1.4
#: Singular values below this part of the largest are none.
_RANK = 1e-10


@dataclass(frozen=True)
class Likeness:
    """What makes the misfits of a block likely, image errors of free size at any rate."""

    reach: float
    """Distance at which the correlation of image errors has fallen to 1/e, pixels."""
    share: float
    """Part of their variance that is alike, 0 to 1."""
    by_likeness: float
    """Part of what the best model makes more likely (in deviance) that image errors which are alike make, all other
    accuracies as stated, 0 to 1."""
    by_accuracy: float
    """The same of other accuracies than stated, image errors independent."""
    worse: tuple[tuple[str, float], ...]
    """Groups of observations that are less accurate than stated even so, and how many times; empty: none with any
    certainty."""
    alike: bool
    """Whether errors are alike, whatever the accuracies of the others are."""


def likeness_of(block: Block, base: Adjusted) -> Likeness | None:
    """Weigh image errors that are alike, with covariance exp(−(d/L)²) over distances d, against other accuracies."""
    model, K, w = _contrasts(_part(block, base), base)
    if len(w) < _FEW:
        return None
    kinds, of = kinds_of(model)
    kind = np.full(model.rows, -1)
    kind[: len(of)] = of
    there = [k for k in range(len(kinds)) if (of == k).any()]
    parts = {k: K[kind == k].T @ K[kind == k] for k in there}
    image = [parts[k] for k in there if kinds[k][1] == "px"]
    others = [k for k in there if kinds[k][1] != "px"]
    free = [parts[k] for k in others]
    rest = K[kind < 0].T @ K[kind < 0]
    stated = sum(free, rest)
    size = float(w @ w) / len(w)
    plain = variance_components(w, stated, image, np.full(len(image), size))
    accuracy = variance_components(w, rest, [*image, *free], np.full(len(there), max(size, 1.0)))
    length, near, likeness = _likeliest(model, K, lambda near: (w, stated, image, near), size)
    start = [*likeness.variances[:-1], *np.ones(len(free)), likeness.variances[-1]]
    both = variance_components(w, rest, [*image, *free, near], start)
    whole = plain.deviance - both.deviance
    alike = _means(accuracy.deviance - both.deviance, 2)
    variances = dict(zip(others, both.variances[len(image) :]))
    worse = []
    for k, variance in variances.items():
        if variance > _WORSE**2:
            # As stated, with all others free.
            rest_free = [parts[j] for j in others if j != k]
            start = [*both.variances[: len(image)], *(variances[j] for j in others if j != k), both.variances[-1]]
            without = variance_components(w, rest + parts[k], [*image, *rest_free, near], start)
            if _means(without.deviance - both.deviance, 1):
                worse.append((kinds[k][0], float(np.sqrt(variance))))
    if not (alike or worse):
        return None
    own = float(np.average(likeness.variances[:-1], weights=[np.trace(part) for part in image]))
    return Likeness(
        reach=length,
        share=float(likeness.variances[-1]) / (own + float(likeness.variances[-1])),
        by_likeness=min(1.0, (plain.deviance - likeness.deviance) / whole),
        by_accuracy=min(1.0, (plain.deviance - accuracy.deviance) / whole),
        worse=tuple(worse),
        alike=alike,
    )


def _means(gain: float, more: int) -> bool:
    return more > 0 and chance_chi_square(max(gain, 0.0), more) < _CHANCE


_Data = tuple[_Floats, _Floats, list[_Floats], _Floats]


def _likeliest(
    model: Model, K: _Floats, data: Callable[[_Floats], _Data], size: float
) -> tuple[float, _Floats, Components]:
    """Correlation length, its part of the covariance matrix, and variances: the last of errors that are alike."""
    found: list[tuple[float, _Floats, Components]] = []

    def tried(lengths: _Floats) -> tuple[float, _Floats, Components]:
        for length in lengths.tolist():
            w, fixed, image, near = data(_near(model, K, length))
            start = found[-1][2].variances if found else np.full(len(image) + 1, size / 2.0)
            start = np.maximum(start, 0.01 * size)
            found.append((length, near, variance_components(w, fixed, [*image, near], start)))
        return min(found, key=lambda each: each[2].deviance)

    best = tried(_LENGTHS * np.hypot(*np.ptp(model.xy, axis=0)))
    return tried(best[0] * _BESIDE)


def _near(model: Model, K: _Floats, length: float) -> _Floats:
    """Covariance of contrasts from errors that are alike within each image, in either coordinate."""
    out = np.zeros((K.shape[1], K.shape[1]))
    for image in range(len(model.image_names)):
        mine = np.flatnonzero(model.image == image)
        xy = model.xy[mine]
        distance = np.linalg.norm(xy[:, None] - xy[None], axis=2)
        covariance = np.exp(-((distance / length) ** 2))
        for axis in range(2):
            rows = K[2 * mine + axis]
            out += rows.T @ covariance @ rows
    return out


def _part(block: Block, base: Adjusted) -> Block:
    """A neighbourhood of images with so many of their points, at random, that all can be computed at once."""
    seen = block.observations
    centers = {name: pose.center for name, pose in zip(base.images, base.poses)}
    names = [image.name for image in block.images if image.name in centers]
    if len(names) > _IMAGES:
        XYZ = np.array([centers[name] for name in names])
        away = np.linalg.norm(XYZ - np.median(XYZ, axis=0), axis=1)
        names = [names[k] for k in np.argsort(away)[:_IMAGES]]
    names += [each.name for each in block.projections]
    inside = np.array([name in set(names) for name in seen.images], bool)[seen.image]
    inside &= np.array([name in set(base.points) for name in seen.points], bool)[seen.point]
    rays = np.bincount(seen.point[inside], minlength=len(seen.points))
    surveyed = np.array([name in set(block.ground.names) for name in seen.points], bool)
    usable = (rays >= 2) | surveyed
    order = np.random.default_rng(0).permutation(len(seen.points))
    order = order[np.argsort(~surveyed[order], kind="stable")]
    added = np.where(usable[order], np.maximum(2 * rays[order] - 3, 0), 0)
    chosen = np.zeros(len(seen.points), bool)
    chosen[order[usable[order] & (np.cumsum(added) <= _CONTRASTS + 6 * len(names))]] = True
    return replace(block, observations=seen.where(inside & chosen[seen.point]))


def _contrasts(block: Block, base: Adjusted) -> tuple[Model, _Floats, _Floats]:
    """The model, combinations of its rows that no unknown moves (rows, n), and what they are (n,)."""
    cameras = {
        each.name: replace(block.cameras[each.name], c=each.c, principal_point=each.principal_point, lens=each.lens)
        for each in base.cameras
    }
    block = replace(block, cameras={**block.cameras, **cameras})
    selection = select(block, Active.all_of(block))
    model = build_model(block, selection.images, selection.measured, selection.points)
    XYZ = dict(zip(base.points, base.XYZ))
    poses = dict(zip(base.images, base.poses))
    state = start_state(
        block,
        model.camera_names,
        model.strip_names,
        [poses[block.images[k].name] for k in model.image_rows],
        np.array([XYZ[name] for name in model.point_names]).reshape(-1, 3),
        model.sets,
    )
    rows, _ = linearise(model, state, np.ones(model.rows))
    A = np.hstack([rows.A_global.toarray(), rows.A_points.toarray()])
    lengths = np.linalg.norm(A, axis=0)
    Q, R, _ = linalg.qr(A / np.where(lengths > 0.0, lengths, 1.0), pivoting=True)
    diagonal = np.abs(np.diag(R))
    K = Q[:, int((diagonal > _RANK * diagonal.max(initial=0.0)).sum()) :]
    return model, K, K.T @ rows.e
