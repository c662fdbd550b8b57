"""Gross errors sought before anything is estimated: by robust planes, and by heights that break off all round.

Neither asks for a covariance function or a noise, which gross errors would spoil. See `design/007`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photoplan.adjustment.robust import MEDIAN_1D, geman_mcclure, huber
from photoplan.kernels.local_breaks import borders, differences, hang_together
from photoplan.kernels.local_planes import fit_planes, local_scales, part_across
from photoplan.terrain.observations import Observations
from photoplan.terrain.paraboloids import paraboloids

#: Neighbours of a plane, those of lines beside them, and those whose misfits tell what is usual here.
_NEAR, _LINES, _WIDE = 14, 6, 32
#: Points are asked for again at most so often; each time the worst of every neighbourhood is set aside.
_ROUNDS = 40
#: Misfit beyond which a point is suspected, as a part of the limit for gross errors: the model has the last word.
PART = 0.9
#: Misfits below this part of the spacing are nothing to look at.
_FINEST = 1e-3
#: So many neighbours whose planes meet a point say that it lies at an edge: to this part of its misfit to its
#: own plane, which bends with the ground, or of its difference from the prediction of the model.
_SUPPORT, _MEETS, MEETS_MODEL = 3, 0.4, 0.2
#: Points of a cluster at most.
MOST = 20
#: Neighbours whose heights differ by more standard deviations than this do not hang together.
_HOLD = 2.0
#: Mean break around a cluster, in those standard deviations: of a gross error, of a suspect.
_CLEAR, _SUSPECT = 4.0, 3.0
#: Part of the border that breaks to the same side: of a gross error, of a suspect. And the least number of its edges.
_ROUND, _PARTLY, _EDGES = 0.95, 0.6, 6
#: A gross error is surrounded: neighbours outside leave no wider angle than this.
_OPEN = np.radians(110.0)
#: Every so-manieth point, and so many of these: the neighbourhood in which a cluster is small.
_THIN, _AROUND = 4, 25
#: Iterations of a paraboloid there, those of Huber's weights before; neighbourhoods at once.
_BENT_ROUNDS, _BENT_HUBER, _CHUNK = 6, 2, 20_000


@dataclass(frozen=True, eq=False)
class Neighbourhoods:
    """Neighbours of each point on its own side of breaklines; −1: none."""

    near: NDArray[np.int32]
    """The nearest points, shape (p, 14) or fewer, then of the points of lines, shape (p, 6) or fewer: data numbers."""
    wide: NDArray[np.int32]
    """The nearest points, more of them, the nearest first."""

    @property
    def points(self) -> NDArray[np.int32]:
        """The nearest points without those of lines."""
        return np.ascontiguousarray(self.wide[:, :_NEAR])

    @classmethod
    def of(cls, seen: Observations) -> Neighbourhoods:
        """Look them up."""
        p, xy = seen.points, np.ascontiguousarray(seen.xyz[:, :2])
        wide = cKDTree(xy[:p]).query(xy[:p], k=np.arange(2, min(_WIDE + 1, p) + 1))[1].astype(np.int32)
        beside = np.empty((p, 0), np.int32)
        if len(xy) > p:
            beside = cKDTree(xy[p:]).query(xy[:p], k=np.arange(1, min(_LINES, len(xy) - p) + 1))[1].astype(np.int32) + p
        both = np.column_stack([wide, beside])
        _part(seen, both)
        wide, beside = both[:, : wide.shape[1]], both[:, wide.shape[1] :]
        wide[wide == np.arange(p)[:, None]] = -1  # where two points coincide, the first of them is not always itself
        wide = np.take_along_axis(wide, np.argsort(wide < 0, axis=1, kind="stable"), axis=1)
        return cls(np.ascontiguousarray(np.column_stack([wide[:, :_NEAR], beside])), np.ascontiguousarray(wide))


def _part(seen: Observations, near: NDArray[np.int32], chunk: int = 50_000) -> None:
    """Take neighbours beyond breaklines away."""
    vertices, start = seen.barriers
    if len(start) < 2:
        return
    last = np.zeros(len(vertices), bool)
    last[start[1:] - 1] = True
    a, b = vertices[:-1][~last[:-1]], vertices[1:][~last[:-1]]
    count = np.maximum(1, np.ceil(np.linalg.norm(b - a, axis=1) / seen.spacing).astype(int))
    part = np.repeat(np.arange(len(a)), count)
    t = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    step = ((b - a) / count[:, None])[part]
    ends = a[part] + step * t[:, None]
    ends = np.column_stack([ends, ends + step])
    tree, xy = cKDTree((ends[:, :2] + ends[:, 2:]) / 2), seen.xyz[:, :2]
    longest = float(np.linalg.norm(step, axis=1).max(initial=0.0)) / 2
    for begin in range(0, seen.points, chunk):
        some = np.arange(begin, min(begin + chunk, seen.points))
        reach = np.linalg.norm(xy[near[some]] - xy[some, None], axis=2).max(axis=1) + longest
        some, reach = (each[tree.query(xy[some])[0] <= reach] for each in (some, reach))
        found = tree.query_ball_point(xy[some], reach)
        sizes = np.array([len(f) for f in found], np.int64)
        of = np.concatenate([np.empty(0, np.int64), *(np.asarray(f, np.int64) for f in found)])
        part_across(seen.xyz, near, some, ends, of, np.concatenate([[0], np.cumsum(sizes)]))


@dataclass(frozen=True, eq=False)
class Screened:
    """What looks like gross errors; the model has the last word."""

    single: NDArray[np.int64]
    """Points that contradict all their neighbours."""
    clusters: tuple[NDArray[np.int64], ...]
    """Groups of points whose border breaks off all round."""
    suspects: tuple[NDArray[np.int64], ...]
    """Groups whose border breaks off in part, or that lie at the edge of the data."""
    size: NDArray[np.float64]
    """By how much each of these is wrong, about, shape (points,), metres; zero: all others."""
    slopes: NDArray[np.float64]
    """Of the robust plane through the neighbours of each point, towards x and y, shape (points, 2); NaN: not known."""

    @property
    def all(self) -> NDArray[np.int64]:
        """All of these points."""
        return np.flatnonzero(self.size > 0)


def screen(seen: Observations, around: Neighbourhoods, limit: float) -> Screened:
    """Look for gross errors by robust planes and broken borders."""
    planes = np.full((seen.points, 3), np.nan)
    used = np.ones(len(seen.xyz), bool)
    fit_planes(seen.xyz, around.near, used, np.arange(seen.points), planes)
    slopes = planes[:, 1:].copy()
    clusters, suspects, size = _clusters(seen, around.points, np.nan_to_num(slopes))
    single = _singles(seen, around, planes, slopes, used, limit)
    size[single] = np.maximum(size[single], np.abs(planes[single, 0]))
    return Screened(single=single, clusters=clusters, suspects=suspects, size=size, slopes=slopes)


def finest(seen: Observations) -> NDArray[np.float64]:
    """Least misfit to be expected of each point, shape (points,), metres: its known noise, or next to nothing."""
    known = seen.noise(np.full(len(seen.xyz), seen.known_noise or 0.0))[: seen.points]
    return np.maximum(np.sqrt(known), _FINEST * seen.spacing)


def _singles(
    seen: Observations,
    around: Neighbourhoods,
    planes: NDArray[np.float64],
    slopes: NDArray[np.float64],
    used: NDArray[np.bool_],
    limit: float,
) -> NDArray[np.int64]:
    """Points far from their neighbours' planes, the worst of each neighbourhood first; the others are asked again."""
    p = seen.points
    floor, scale = finest(seen), np.full(p, np.nan)
    asked, changed = np.arange(p), np.arange(p)
    for _ in range(_ROUNDS):
        local_scales(planes[:, 0], around.wide, used, changed, scale)
        ratio = np.abs(planes[:, 0]) / np.maximum(scale, floor)
        found = asked[used[asked] & (ratio[asked] > PART * limit)]
        within = _MEETS * np.abs(planes[found, 0])
        found = found[~supported(seen, around.points[found], slopes, found, within)]
        worst = np.zeros(p)
        worst[found] = ratio[found]
        near = around.points[found]
        best = found[ratio[found] >= np.where(near >= 0, worst[near], 0.0).max(axis=1, initial=0.0)]
        if not len(best):
            break
        used[best] = False
        near = around.wide[best]
        touched = np.unique(near[near >= 0]).astype(np.int64)
        fit_planes(seen.xyz, around.near, used, touched, planes)
        near = around.wide[touched]
        changed = np.unique(near[near >= 0]).astype(np.int64)
        asked = np.union1d(changed, found)
    return np.flatnonzero(~used[:p])


def supported(
    seen: Observations,
    near: NDArray[np.int32],
    slopes: NDArray[np.float64],
    some: NDArray[np.int64],
    within: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether the planes of several neighbours meet a point: it lies on one side of an edge that no line describes."""
    xyz = seen.xyz
    step = xyz[some, None] - xyz[near]
    off = step[..., 2] - (step[..., :2] * slopes[near]).sum(axis=2)
    meets = (near >= 0) & (np.abs(off) < within[:, None])
    return np.asarray(meets.sum(axis=1) >= _SUPPORT)


def _clusters(
    seen: Observations, near: NDArray[np.int32], slopes: NDArray[np.float64]
) -> tuple[tuple[NDArray[np.int64], ...], tuple[NDArray[np.int64], ...], NDArray[np.float64]]:
    """Small groups whose border breaks: all round; in part; and by how much, of each point.

    Heights break off from the slopes around, which are those of planes in the middle, or of a paraboloid. On curved
    ground the differences between neighbours are larger than a group's with the first, on rough ground groups draw the
    second along. What breaks off all round from one of them is wrong.
    """
    p = seen.points
    thin = np.arange(min(_THIN // 2, p - 1), p, _THIN)
    tree = cKDTree(seen.xyz[thin, :2])
    wide = thin[tree.query(seen.xyz[thin, :2], k=np.arange(1, min(_AROUND, len(thin)) + 1))[1]]
    at = tree.query(seen.xyz[:p, :2])[1]
    clear, partly, size = _broken(seen, near, np.median(slopes[wide], axis=1)[at], wide, at)
    bent, _, by_bent = _broken(seen, near, _bent_slopes(seen.xyz, thin, wide, at), wide, at)
    number = np.zeros(p, np.int64)
    for k, group in enumerate((*clear, *partly), 1):
        number[group] = k
    # What is known already is known as a whole: a part of it that breaks off from another slope is nothing new.
    counts = np.bincount(number, minlength=len(clear) + len(partly) + 1)
    for group in bent:
        touched = np.unique(number[group])
        touched = touched[touched > 0]
        if (touched > len(clear)).all() and counts[touched].sum() == (number[group] > 0).sum():
            clear = (*clear, group)
            number[group] = -1
            size[group] = by_bent[group]
    return clear, tuple(group for group in partly if number[group[0]] > 0), size


def _bent_slopes(
    xyz: NDArray[np.float64], thin: NDArray[np.int64], wide: NDArray[np.int64], at: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Slopes at all points, shape (p, 2), of the robust paraboloid through the heights around the nearest of `thin`."""
    found = np.empty((len(thin), 5))
    size = np.empty(len(thin))
    for begin in range(0, len(thin), _CHUNK):
        some = slice(begin, begin + _CHUNK)
        A, size[some] = paraboloids(xyz[wide[some], :2] - xyz[thin[some], None, :2])
        z = xyz[wide[some], 2] - np.median(xyz[wide[some], 2], axis=1)[:, None]
        weight = np.ones_like(z)
        for turn in range(_BENT_ROUNDS):
            transposed = np.swapaxes(A * weight[..., None], 1, 2)
            c = np.linalg.solve(transposed @ A + 1e-6 * np.eye(6), transposed @ z[..., None])
            e = np.abs(z - (A @ c)[..., 0])
            e /= np.median(e, axis=1)[:, None] / MEDIAN_1D + 1e-300
            weight = huber(e, 1.0) if turn < _BENT_HUBER else geman_mcclure(e, 2.0)
        found[some] = c[:, 1:, 0]
    d = (xyz[: len(at), :2] - xyz[thin[at], :2]) / size[at, None]
    sx, sy, xx, xy, yy = (found[at] / size[at, None]).T
    return np.column_stack([sx + xx * d[:, 0] + xy * d[:, 1], sy + xy * d[:, 0] + yy * d[:, 1]])


def _broken(
    seen: Observations,
    near: NDArray[np.int32],
    slopes: NDArray[np.float64],
    wide: NDArray[np.int64],
    at: NDArray[np.int64],
) -> tuple[tuple[NDArray[np.int64], ...], tuple[NDArray[np.int64], ...], NDArray[np.float64]]:
    """Groups that break off from the slopes (p, 2) around all points."""
    p = seen.points
    off, middle = np.empty(near.shape), np.empty(p)
    differences(seen.xyz, near, slopes, off, middle)
    scale = np.median(np.nan_to_num(middle)[wide], axis=1)[at] / MEDIAN_1D
    scale = np.maximum(scale, finest(seen))
    label, border = np.empty(p, np.int64), np.empty((p, 6))
    hang_together(near, off, scale, _HOLD, label)
    borders(near, off, scale, _HOLD, label, border)
    edges = np.maximum(border[:, 0], 1.0)
    upper = border[:, 1] >= border[:, 2]
    broken = np.where(upper, border[:, 1], border[:, 2])
    mean = np.where(upper, border[:, 3], border[:, 4]) / np.maximum(broken, 1.0)
    count = np.bincount(label, minlength=p)
    small = (count > 0) & (count <= MOST) & (border[:, 0] >= _EDGES)
    picked = small & (mean >= _SUSPECT) & (broken >= _PARTLY * edges)
    size = np.zeros(p)
    members = np.flatnonzero(picked[label])
    members = members[np.argsort(label[members], kind="stable")]
    size[members] = (border[:, 5] / edges)[label[members]]
    groups = np.split(members, np.flatnonzero(np.diff(label[members])) + 1) if len(members) else []
    clear: list[NDArray[np.int64]] = []
    partly: list[NDArray[np.int64]] = []
    for group in groups:
        k = label[group[0]]
        sure = mean[k] >= _CLEAR and broken[k] >= _ROUND * edges[k]
        (clear if sure and _surrounded(seen.xyz, group, near[group], label) else partly).append(group)
    return tuple(clear), tuple(partly), size


def _surrounded(
    xyz: NDArray[np.float64], group: NDArray[np.int64], near: NDArray[np.int32], label: NDArray[np.int64]
) -> bool:
    """Whether the neighbours outside a group lie on all its sides."""
    outside = np.unique(near[(near >= 0) & (label[near] != label[group[0]])])
    if not len(outside):
        return False
    step = xyz[outside, :2] - xyz[group, :2].mean(axis=0)
    angle = np.sort(np.arctan2(step[:, 1], step[:, 0]))
    return bool(np.diff(np.append(angle, angle[0] + 2 * np.pi)).max() < _OPEN)
