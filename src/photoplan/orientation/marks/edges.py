"""Where a mark's edges are in a scan: straight lines and arcs through many edge points, as a careful operator does it.

Correlation judges all grey values alike. A silhouette of the camera's frame has a mark's shape but image beside it
that differs from photo to photo; its edges still say where it is. At many points of every edge that the description
states, the grey values across the edge are followed to where they pass the middle between both sides. Shift, rotation
and scale that bring the description's edges through these points are adjusted; points far from their edge (image
content, dust, worn corners) lose their weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from photoplan.adjustment.linear import solve
from photoplan.adjustment.robust import bisquare, spread
from photoplan.cameras.mark_pattern import MarkPattern

_STEP = 1.0
"""Pixels between edge points."""
_SIDE = 4.0
"""Pixels beside an edge where the levels of both sides are taken."""
_GRAIN = 0.8
"""Standard deviation in pixels by which profiles are smoothed."""
_CLUSTER = 12.0
"""Pixels of an edge whose points err together: a frame's edge is ragged, not noisy."""
_LEAST_CONTRAST = 0.25
"""Share of the usual contrast of a mark's edge below which a point is none."""
_ROUNDS = 12
_TUKEY = 3.5
"""Robust standard deviations at which a point loses its weight."""
_FLOOR = 0.3
"""Least robust standard deviation, pixels: no edge is straighter."""


@dataclass(frozen=True, eq=False)
class PatternEdges:
    """Points on the edges of a mark's description."""

    points: NDArray[np.float64]
    """Shape (n, 2), millimetres."""
    normals: NDArray[np.float64]
    """Unit vectors from dark to bright, shape (n, 2)."""
    edge: NDArray[np.int64]
    """Number of the straight piece on which each lies, shape (n,)."""


@dataclass(frozen=True, eq=False)
class MarkEdge:
    """A mark placed by its edges."""

    x: float
    y: float
    """Column and row of the reference point."""
    covariance: NDArray[np.float64]
    """Of x and y, shape (2, 2), pixels²; points of one edge that lie close together count as one."""
    rotation: float
    """Anticlockwise as seen in the scan, beside what was given, radians."""
    scale: float
    """Beside what was given."""
    rms: float
    """Root mean square distance of the points used from their edges, pixels."""
    used: float
    """Share of all edge points in the scan that were used."""
    count: int
    """Edge points used."""

    @property
    def sigma_x(self) -> float:
        """Standard deviation of x, pixels."""
        return math.sqrt(self.covariance[0, 0])

    @property
    def sigma_y(self) -> float:
        """Standard deviation of y, pixels."""
        return math.sqrt(self.covariance[1, 1])


def pattern_edges(pattern: MarkPattern, spacing: float) -> PatternEdges:
    """Points about every `spacing` millimetres where a description changes from dark to bright.

    Pieces of outlines that later parts cover, that leave the window, or beside which a side is not compared are left
    out.
    """
    x0, y0, x1, y1 = pattern.window
    points, normals, lengths = [np.empty((0, 2))], [np.empty((0, 2))], []
    for part in pattern.parts:
        for start, end in zip(part.outline, np.roll(part.outline, -1, axis=0), strict=True):
            a, b = _clipped(start, end, (x0, y0, x1, y1))
            length = float(np.hypot(*(b - a)))
            count = round(length / spacing)
            if count < 1:
                continue
            points.append(a + (np.arange(count) + 0.5)[:, None] / count * (b - a))
            normals.append(np.repeat([[-(b - a)[1] / length, (b - a)[0] / length]], count, axis=0))
            lengths.append(count)
    at, normal = np.concatenate(points), np.concatenate(normals)
    number = np.repeat(np.arange(len(lengths)), lengths)
    left, right = (_tone(pattern, at + side * spacing / 20 * normal) for side in (1, -1))
    differ = np.abs(left - right) > 0.1  # NaN: no
    normal = np.where(left > right, 1.0, -1.0)[:, None] * normal
    at, normal, number = at[differ], normal[differ], number[differ]
    # Two parts that touch have one edge in common.
    twice = {max(pair) for pair in cKDTree(at).query_pairs(0.45 * spacing)} if len(at) else set()
    once = np.array([i not in twice for i in range(len(at))], bool)
    return PatternEdges(at[once], normal[once], number[once])


def fit_edges(
    image: NDArray[np.floating],
    pattern: MarkPattern,
    mm_to_pixel: NDArray[np.float64],
    at: tuple[float, float],
    *,
    negative: bool = False,
    search_px: float = 6.0,
    sigmas: tuple[float, float] = (0.035, 0.02),
) -> MarkEdge | None:
    """Place of a mark from its edges."""
    matrix = np.array(mm_to_pixel, np.float64)
    spacing = _STEP / math.sqrt(abs(np.linalg.det(matrix)))
    edges = pattern_edges(pattern, spacing)
    if len(edges.points) < 20:
        return None
    smooth = _smoothed(image)
    sign = -1.0 if negative else 1.0
    place, reach = np.array(at, np.float64), float(search_px)
    solution = None
    known = np.zeros(2)
    for _ in range(_ROUNDS):
        xy = edges.points @ matrix.T + place
        # A normal turns with the inverse transpose, so that it stays normal under shear too.
        normal = edges.normals @ np.linalg.inv(matrix)
        normal /= np.hypot(normal[:, 0], normal[:, 1])[:, None]
        offset = _edge_offsets(smooth, xy, sign * normal, reach) * sign
        solution = _adjust(xy - place, normal, offset, edges.edge, (known, np.array(sigmas)))
        if solution is None:
            return None
        step, turn = solution.shift, solution.turn
        place = place + np.clip(step, -reach, reach)
        matrix = np.array([[1 + turn[1], -turn[0]], [turn[0], 1 + turn[1]]]) @ matrix
        known = known - turn
        reach = max(2.5, 0.7 * reach)
        if np.abs(step).max() < 0.003 and reach == 2.5:
            break
    assert solution is not None
    total = matrix @ np.linalg.inv(np.array(mm_to_pixel, np.float64))
    scale = math.sqrt(abs(np.linalg.det(total)))
    rotation = -math.atan2(total[1, 0], total[0, 0])
    return MarkEdge(
        x=float(place[0]),
        y=float(place[1]),
        covariance=solution.covariance,
        rotation=rotation,
        scale=scale,
        rms=solution.rms,
        used=solution.used,
        count=solution.count,
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    shift: NDArray[np.float64]
    turn: NDArray[np.float64]
    """Rotation from columns towards rows, radians, and change of scale."""
    covariance: NDArray[np.float64]
    rms: float
    used: float
    count: int


def _clipped(
    a: NDArray[np.float64], b: NDArray[np.float64], box: tuple[float, float, float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The part of a line inside a box; of no length outside."""
    low, high = 0.0, 1.0
    for axis, (least, most) in enumerate(((box[0], box[2]), (box[1], box[3]))):
        d = b[axis] - a[axis]
        if d == 0:
            if not least <= a[axis] <= most:
                return a, a
            continue
        t = sorted(((least - a[axis]) / d, (most - a[axis]) / d))
        low, high = max(low, t[0]), min(high, t[1])
    if high <= low:
        return a, a
    return a + low * (b - a), a + high * (b - a)


def _tone(pattern: MarkPattern, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Tone of the description at points; NaN where it is not compared."""
    tone = np.full(len(points), pattern.background)
    for part in pattern.parts:
        tone[_inside(part.outline, points)] = part.tone
    return tone


def _inside(outline: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether points lie in a polygon: an odd number of its edges lies to their right."""
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        if crosses.any():
            inside ^= crosses & (x < ax + (y - ay) / (by - ay if by != ay else 1.0) * (bx - ax))
    return inside


def _smoothed(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Grey values without grain; NaN stays and does not spread."""
    grey = np.asarray(image, np.float64)
    known = np.isfinite(grey)
    if known.all():
        return np.asarray(ndimage.gaussian_filter(grey, _GRAIN, mode="nearest"))
    weight = ndimage.gaussian_filter(known.astype(float), _GRAIN, mode="nearest")
    value = ndimage.gaussian_filter(np.where(known, grey, 0.0), _GRAIN, mode="nearest")
    return np.where(known, value / np.maximum(weight, 1e-9), np.nan)


def _edge_offsets(
    smooth: NDArray[np.float64], xy: NDArray[np.float64], normal: NDArray[np.float64], reach: float
) -> NDArray[np.float64]:
    """Distance along each normal to the steepest rise, carried to the middle of both sides' levels; NaN: none."""
    fine = 0.25
    half = math.ceil((reach + _SIDE) / fine)
    t = np.arange(-half, half + 1) * fine
    column = xy[:, :1] + normal[:, :1] * t
    row = xy[:, 1:] + normal[:, 1:] * t
    height, width = smooth.shape
    inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    profile = ndimage.map_coordinates(smooth, [row, column], order=1, mode="nearest")
    profile[~inside] = np.nan
    side = round(_SIDE / fine)
    span = 4
    rise = np.full_like(profile, np.nan)
    rise[:, span:-span] = profile[:, 2 * span :] - profile[:, : -2 * span]
    rise[:, np.abs(t) > reach] = np.nan
    seen = np.isfinite(rise).any(axis=1)
    steepest = np.where(seen, np.nanargmax(np.where(np.isfinite(rise), rise, -np.inf), axis=1), half)
    offset = np.full(len(xy), np.nan)
    contrast = np.full(len(xy), np.nan)
    for i in np.nonzero(seen)[0]:
        k = int(steepest[i])
        line = profile[i, max(k - side, 0) : k + side + 1]
        line = line[np.isfinite(line)]
        low, high = float(line.min()), float(line.max())
        middle = (low + high) / 2
        # From the steepest point to the nearest passage through the middle.
        around = profile[i, max(k - side, 0) : k + side + 1] - middle
        passes = np.nonzero((around[:-1] <= 0) & (around[1:] > 0))[0]
        if not len(passes):
            continue
        p = passes[np.argmin(np.abs(passes - min(k, side)))]
        offset[i] = t[max(k - side, 0) + p] + fine * around[p] / (around[p] - around[p + 1])
        contrast[i] = high - low
    if np.isfinite(contrast).any():
        offset[~(contrast > _LEAST_CONTRAST * np.nanpercentile(contrast, 75))] = np.nan
    return offset


def _adjust(
    about: NDArray[np.float64],
    normal: NDArray[np.float64],
    offset: NDArray[np.float64],
    edge: NDArray[np.int64],
    prior: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> _Solution | None:
    """Shift, rotation and scale from distances along normals, robust; covariance from clusters of points.

    `prior`: rotation and change of scale that are expected, and their standard deviations.
    """
    seen = np.isfinite(offset)
    total = len(offset)
    if seen.sum() < max(20, 0.3 * total):
        return None
    n, d, at, piece = normal[seen], offset[seen], about[seen], edge[seen]
    # n · (shift + rotation r⊥ + scale r) = d, with r⊥ = (−y, x) in columns and rows.
    A = np.column_stack([n, n[:, 1] * at[:, 0] - n[:, 0] * at[:, 1], (n * at).sum(axis=1)])
    equations, observed = np.vstack([A, np.eye(4)[2:]]), np.append(d, prior[0])
    weight = np.ones(len(d))
    size = max(spread(d, None), _FLOOR)
    for _ in range(20):
        # Points of a cluster err together: the prior weighs against clusters, not points.
        known = (size / prior[1]) ** 2 * _CLUSTER
        fit = solve(equations, observed, np.append(weight, known))
        plane = A[:, :2].T @ (weight[:, None] * A[:, :2])
        if np.linalg.eigvalsh(plane)[0] < 1e-3 * weight.sum() or fit.rank < 4:
            return None
        residual = -fit.residuals[:-2]
        size = max(spread(residual), _FLOOR)
        weight = bisquare(residual / size, _TUKEY)
    along = at[:, 0] * n[:, 1] - at[:, 1] * n[:, 0]
    cluster = piece * 100003 + np.floor(along / _CLUSTER).astype(np.int64)
    _, group = np.unique(cluster, return_inverse=True)
    scores = np.zeros((int(group.max()) + 1, A.shape[1]))
    np.add.at(scores, group, (weight * residual)[:, None] * A)
    groups = len(scores)
    meat = scores.T @ scores * groups / max(groups - A.shape[1], 1) + size**2 * _CLUSTER * np.diag([0.0, 0.0, *known])
    covariance = (fit.cofactors @ meat @ fit.cofactors)[:2, :2]
    good = weight > 0
    rms = math.sqrt(float((weight * residual**2).sum() / weight.sum()))
    return _Solution(
        shift=fit.unknowns[:2],
        turn=fit.unknowns[2:],
        covariance=covariance,
        rms=rms,
        used=float(good.sum()) / total,
        count=int(good.sum()),
    )
