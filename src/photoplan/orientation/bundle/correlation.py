"""Errors of neighbouring image points are alike: how far, and how many of them count as one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from photoplan.orientation.bundle.block import Correlation
from photoplan.orientation.bundle.model import Model

_Floats = NDArray[np.float64]

#: Classes of distance: their number, and the largest distance as a part of the extent of an image's points.
_CLASSES, _REACH = 14, 0.5
#: The first class ends where the last does, divided by this.
_RANGE = 64.0
#: Measurements of an image that are compared with each other at most.
_SAMPLE = 500
#: Pairs that a class needs to say anything, and how many of its standard deviations a correlation must exceed zero by.
_PAIRS, _CLEAR = 50, 3.0
#: Fewer measurements that count as one than this are none: formal accuracies stay as they are.
_LEAST = 1.2


def correlation_of(model: Model, normalised: _Floats, used: NDArray[np.bool_]) -> tuple[Correlation, ...]:
    """Correlation of the residuals within the images of each camera, as a function of their distance.

    Orientations are smooth functions of the image's points, so errors that are alike over some distance d do not
    average out: of n measurements, n / effect count, with effect = 1 + Σ ρ(d) over the neighbours of each.
    """
    v = np.nan_to_num(normalised)
    found = []
    for index, name in enumerate(model.groups):
        mine = np.flatnonzero(used & (model.camera_of[model.image] == index))
        made = _of_camera(name, model.image[mine], model.xy[mine], v[mine]) if len(mine) > _PAIRS else None
        if made is not None:
            found.append(made)
    return tuple(found)


def effects_of_rows(model: Model, correlations: tuple[Correlation, ...], rows: int) -> _Floats:
    """How many measurements count as one, of each row; 1 for everything but correlated tie points, (rows,).

    Control and check points are few and far from each other, so what they say is hardly alike. And if the image points
    of control lost weight, it would lie where its ground coordinates are, and nothing would check these.
    """
    of_camera = np.ones(len(model.groups))
    for correlation in correlations:
        of_camera[model.groups.index(correlation.group)] = correlation.effect
    out = np.ones(rows)
    ground = set(model.block.ground.names)
    surveyed = np.array([name in ground for name in model.point_names], bool)
    effects = np.where(surveyed[model.point], 1.0, of_camera[model.camera_of[model.image]])
    out[model.parts.image] = np.repeat(effects, 2)
    return out


def _of_camera(name: str, image: NDArray[np.int64], xy: _Floats, v: _Floats) -> Correlation | None:
    extent = float(np.hypot(*np.ptp(xy, axis=0)))
    if extent == 0.0:
        return None
    edges = np.concatenate([[0.0], np.geomspace(extent * _REACH / _RANGE, extent * _REACH, _CLASSES)])
    sums, pairs, weights = (np.zeros(_CLASSES) for _ in range(3))
    rng = np.random.default_rng(0)
    order = np.argsort(image, kind="stable")
    images = [0, *(np.flatnonzero(np.diff(image[order])) + 1).tolist(), len(order)]
    for begin, end in pairwise(images):
        members = order[begin:end]
        chosen = members if len(members) <= _SAMPLE else members[rng.permutation(len(members))[:_SAMPLE]]
        i, j = np.triu_indices(len(chosen), 1)
        distance = np.linalg.norm(xy[chosen[i]] - xy[chosen[j]], axis=1)
        product = (v[chosen[i]] * v[chosen[j]]).mean(axis=1)
        # The last class takes what is too far away.
        of = np.searchsorted(edges, distance, side="right") - 1
        sums += np.bincount(of, product, _CLASSES + 1)[:_CLASSES]
        count = np.bincount(of, minlength=_CLASSES + 1)[:_CLASSES]
        pairs += count
        # Of a sample of the points, each pair stands for many.
        weights += count * (len(members) / len(chosen)) ** 2
    variance = float((v**2).mean())
    enough = pairs >= _PAIRS
    rho = np.where(enough, sums / np.maximum(pairs, 1.0) / max(variance, 1e-300), 0.0)
    clear = rho > _CLEAR / np.sqrt(np.maximum(pairs, 1.0))
    ends = np.flatnonzero(enough & ~clear)
    last = int(ends[0]) if len(ends) else _CLASSES
    effect = 1.0 + 2.0 * float((rho[:last] * weights[:last]).sum()) / len(image)
    if effect < _LEAST:
        return None
    return Correlation(
        group=name, effect=effect, reach=float(edges[last]), distance=edges[1:], rho=np.where(enough, rho, np.nan)
    )
