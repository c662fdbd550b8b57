"""Location of a single mark by its edges and ellipses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from photoplan.adjustment.least_squares import bisquare, solve, spread
from photoplan.arrays import Floats, Floats32, Ints, Mask
from photoplan.cameras.fiducials import MarkExample, MarkPattern
from photoplan.errors import InputError
from photoplan.orientation.marks.locate import Location, Template, correlation_surface, locate_mark, render

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

    points: Floats
    """Shape (n, 2), millimetres."""
    normals: Floats
    """Unit vectors from dark to bright, shape (n, 2)."""
    edge: Ints
    """Number of the straight piece on which each lies, shape (n,)."""


@dataclass(frozen=True, eq=False)
class MarkEdge:
    """A mark placed by its edges."""

    x: float
    y: float
    """Column and row of the reference point."""
    covariance: Floats
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
    mm_to_pixel: Floats,
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
    shift: Floats
    turn: Floats
    """Rotation from columns towards rows, radians, and change of scale."""
    covariance: Floats
    rms: float
    used: float
    count: int


def _clipped(a: Floats, b: Floats, box: tuple[float, float, float, float]) -> tuple[Floats, Floats]:
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


def _tone(pattern: MarkPattern, points: Floats) -> Floats:
    """Tone of the description at points; NaN where it is not compared."""
    tone = np.full(len(points), pattern.background)
    for part in pattern.parts:
        tone[_inside(part.outline, points)] = part.tone
    return tone


def _inside(outline: Floats, points: Floats) -> Mask:
    """Whether points lie in a polygon: an odd number of its edges lies to their right."""
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        if crosses.any():
            inside ^= crosses & (x < ax + (y - ay) / (by - ay if by != ay else 1.0) * (bx - ax))
    return inside


def _smoothed(image: NDArray[np.floating]) -> Floats:
    """Grey values without grain; NaN stays and does not spread."""
    grey = np.asarray(image, np.float64)
    known = np.isfinite(grey)
    if known.all():
        return np.asarray(ndimage.gaussian_filter(grey, _GRAIN, mode="nearest"))
    weight = ndimage.gaussian_filter(known.astype(float), _GRAIN, mode="nearest")
    value = ndimage.gaussian_filter(np.where(known, grey, 0.0), _GRAIN, mode="nearest")
    return np.where(known, value / np.maximum(weight, 1e-9), np.nan)


def _edge_offsets(smooth: Floats, xy: Floats, normal: Floats, reach: float) -> Floats:
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
    about: Floats, normal: Floats, offset: Floats, edge: Ints, prior: tuple[Floats, Floats]
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


LEAST_ALONE = 0.7
"""Correlation below which a place is no mark: no other mark confirms it, so that more is asked than of one of many."""

_COARSE = 24
"""Pixels that the smaller side of a mark has in the coarse search, about."""
_SHARE = 0.6
"""Share of a template that must lie on the window."""
_AGREE = 1.5
"""Pixels by which the place by edges may differ from that by correlation, beside three standard deviations."""
_SECOND = 0.93
"""Correlation of another place, as a share of the best, from which on it is not clear which is the mark."""
_USED = 0.6
"""Least share of the edge points that must be seen where they are expected."""
_AROUND = 5
"""Pixels about the place by edges in which correlation is to confirm it."""
_BLUNT = 0.1
"""Coarse correlations so near to the best do not decide between rotations."""
_RMS = 1.5
"""Largest root mean square distance of the edge points from the description, pixels."""
_QUARTERS = 0.06
"""How much better a quarter of an example may correlate elsewhere; those of marks of another shape do by more."""
_NEAR = 8
"""Pixels about a place in which the quarters are sought."""
_SURE = 1.0
"""Largest standard deviation of an accepted place, pixels."""


@dataclass(frozen=True, eq=False)
class SingleMark:
    """Where a mark is, and whether to believe it."""

    x: float
    y: float
    """Column and row of the reference point; NaN: nothing was found."""
    sigma_x: float
    sigma_y: float
    """Standard deviations, pixels."""
    correlation: float
    """Highest correlation coefficient."""
    second: float
    """Highest correlation coefficient at another place, as a share of it."""
    method: str
    """`edges`, `matching`, `paraboloid` or `pixel`."""
    refused: str
    """Why the place is not to be used; empty: it is accepted."""
    edges: MarkEdge | None
    """Place by edges, of patterns."""

    @property
    def accepted(self) -> bool:
        """Whether the place is to be used."""
        return not self.refused


def find_mark(
    image: NDArray[np.floating],
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: Floats,
    *,
    negative: bool = False,
    blur_px: float = 0.7,
    rotations: tuple[float, ...] = (-1.5, 0.0, 1.5),
    least_correlation: float = LEAST_ALONE,
) -> SingleMark:
    """A mark in a window.

    The window is searched with coarse pixels and a few rotations, the best place with fine ones. Where image content
    lies beside the mark (its description leaves parts of the ground out), its edges place it, and correlation confirms
    that; else least-squares matching places it.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Grey values; NaN: not compared. The reference point may lie outside.
    pattern : MarkPattern or MarkExample
        What the mark looks like.
    mm_to_pixel : (2, 2)
        From millimetres (x right, y up) to columns and rows; scale to 3 %, rotation to 2°.
    negative : bool
        Whether dark and bright are exchanged.
    blur_px : float
        Standard deviation of the scan's blur, pixels.
    rotations : tuple of float
        Rotations beside that of the matrix that are tried, degrees.
    least_correlation : float
        Correlation below which the place is refused.

    Raises
    ------
    InputError
        The mark is larger than the window even in part.
    """
    grey = np.asarray(image, np.float32)
    matrix = np.array(mm_to_pixel, np.float64)
    turned = [_turn(angle) @ matrix for angle in rotations]
    tries = [_coarse(grey, render(pattern, each, negative=negative, blur_px=blur_px)) for each in turned]
    top = max((t.correlation for t in tries if math.isfinite(t.correlation)), default=math.nan)
    if math.isnan(top):
        return _nothing("too little of the mark lies in the window")
    likely = [(turn, t) for turn, t in zip(turned, tries, strict=True) if t.correlation > top - _BLUNT]
    found = [_by_edges(grey, pattern, turn, t, negative, blur_px) for turn, t in likely]
    _, at, edges, turn = max(found, key=_merit)
    if edges is not None:
        # Correlation once more, now with the rotation and scale that the edges have.
        turn, at = edges.scale * _turn(math.degrees(edges.rotation)) @ turn, (edges.x, edges.y)
    part, origin = _around(grey, render(pattern, turn, blur_px=0.0), at, _AROUND)
    fine = locate_mark(part, pattern, turn, negative=negative, blur_px=blur_px)
    second = max(t.second / t.correlation for _, t in likely if t.correlation == top)
    place = (fine.x + origin[0], fine.y + origin[1])
    judged = _judged(pattern, fine, place, edges, second, least_correlation)
    if isinstance(pattern, MarkExample) and judged.accepted:
        apart = min(_disagreement(grey, render(pattern, each, negative=negative), place) for each in turned)
        if apart > _QUARTERS:
            return replace(judged, refused=f"its quarters lie elsewhere: they correlate better there by {apart:.2f}")
    return judged


def _nothing(why: str) -> SingleMark:
    nan = math.nan
    return SingleMark(
        x=nan, y=nan, sigma_x=nan, sigma_y=nan, correlation=nan, second=nan, method="pixel", refused=why, edges=None
    )


_Found = tuple[float, tuple[float, float], MarkEdge | None, Floats]


def _by_edges(
    grey: Floats32, pattern: MarkPattern | MarkExample, matrix: Floats, coarse: _Place, negative: bool, blur_px: float
) -> _Found:
    """Correlation with finer pixels near a coarse place, where it is highest, the place by edges, and the matrix."""
    x, y, _, _, factor = coarse
    template = render(pattern, matrix, negative=negative, blur_px=blur_px)
    part, origin = _around(grey, template, (x, y), 2 * factor + 2)
    finer = max(1, factor // 3)
    small, (ox, oy) = _shrunk_template(template, finer)
    surface, _ = correlation_surface(_shrunk(part, finer), small, _SHARE)
    if not np.isfinite(surface).any():
        return -1.0, (x, y), None, matrix
    row, column = np.unravel_index(int(np.nanargmax(surface)), surface.shape)
    half = (finer - 1) / 2
    at = ((column + ox) * finer + half + origin[0], (row + oy) * finer + half + origin[1])
    edges = None
    if isinstance(pattern, MarkPattern):
        edges = fit_edges(grey, pattern, matrix, at, negative=negative, search_px=8.0)
    return float(surface[row, column]), at, edges, matrix


def _merit(found: _Found) -> float:
    """Correlation, less where the edges are not seen."""
    r, _, edges, _ = found
    return r - 1.0 if edges is None else r + edges.used - min(edges.rms, 3.0) / 3.0


def _judged(
    pattern: MarkPattern | MarkExample,
    fine: Location,
    at: tuple[float, float],
    edges: MarkEdge | None,
    second: float,
    least_correlation: float,
) -> SingleMark:
    """Which place stands, and whether it is to be used."""
    by_edges = isinstance(pattern, MarkPattern) and math.isnan(pattern.background)
    x, y, sx, sy, method = *at, fine.sigma_x, fine.sigma_y, fine.method
    if by_edges and edges is not None:
        x, y, sx, sy, method = edges.x, edges.y, edges.sigma_x, edges.sigma_y, "edges"
    refused = ""
    if not fine.correlation >= least_correlation:
        refused = f"correlation {fine.correlation:.2f}; {least_correlation} is needed"
    elif second > _SECOND:
        refused = f"another place correlates nearly as well ({second:.0%})"
    elif by_edges and edges is None:
        refused = "its edges are not seen"
    elif by_edges and edges is not None and edges.used < _USED:
        refused = f"{edges.used:.0%} of its edges are seen; {_USED:.0%} are needed"
    elif by_edges and edges is not None and edges.rms > _RMS:
        refused = f"points lie {edges.rms:.1f} px (rms) beside the edges of its description; {_RMS} px are allowed"
    elif by_edges and math.hypot(x - at[0], y - at[1]) > _AGREE + 3 * math.hypot(sx, sy):
        refused = f"edges and correlation differ by {math.hypot(x - at[0], y - at[1]):.1f} px"
    elif not max(sx, sy) <= _SURE:
        refused = f"standard deviation of {max(sx, sy):.1f} px; {_SURE} px are allowed"
    return SingleMark(
        x=float(x),
        y=float(y),
        sigma_x=float(sx),
        sigma_y=float(sy),
        correlation=fine.correlation,
        second=second,
        method=method,
        refused=refused,
        edges=edges,
    )


def _disagreement(grey: Floats32, template: Template, at: tuple[float, float]) -> float:
    """How much better the worst quarter of a template correlates somewhere near than at a place; 1: not seen there."""
    part, origin = _around(grey, template, at, _NEAR)
    column, row = (round(at[k] - origin[k] - template.reference[k]) for k in (0, 1))
    i, j = np.indices(template.values.shape)
    lower, right = i >= template.values.shape[0] // 2, j >= template.values.shape[1] // 2
    worst = 0.0
    for quarter in (lower & right, lower & ~right, ~lower & right, ~lower & ~right):
        piece = Template(template.values, template.weights * quarter, template.reference)
        surface, _ = correlation_surface(part, piece, _SHARE)
        here = surface[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        if np.isfinite(surface).any():  # a quarter without contrast, or outside, says nothing
            worst = max(worst, float(np.nanmax(surface) - np.nanmax(here)) if np.isfinite(here).any() else 1.0)
    return worst


def _turn(degrees: float) -> Floats:
    """Rotation anticlockwise as seen in the scan, in columns and rows."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, s], [-s, c]])


class _Place(NamedTuple):
    """Place, its correlation, that of the best other place, and the factor of the pixels used; NaN: none."""

    x: float
    y: float
    correlation: float
    second: float
    factor: int


def _coarse(grey: Floats32, template: Template) -> _Place:
    """Where a template suits best, with coarse pixels."""
    factor = max(1, round(min(template.values.shape) / _COARSE))
    small, at = _shrunk_template(template, factor)
    image = _shrunk(grey, factor)
    rows, columns = small.values.shape
    padded = np.pad(image, ((rows // 2, rows // 2), (columns // 2, columns // 2)), constant_values=np.nan)
    if padded.shape[0] < rows or padded.shape[1] < columns:
        return _Place(math.nan, math.nan, math.nan, math.nan, factor=factor)
    surface, _ = correlation_surface(padded, small, _SHARE)
    if not np.isfinite(surface).any():
        return _Place(math.nan, math.nan, math.nan, math.nan, factor=factor)
    row, column = np.unravel_index(int(np.nanargmax(surface)), surface.shape)
    i, j = np.indices(surface.shape)
    far = np.maximum(np.abs(i - row) / rows, np.abs(j - column) / columns) > 0.25
    other = surface[far & np.isfinite(surface)]
    second = float(other.max()) if other.size else -1.0
    half = (factor - 1) / 2
    x = (column - columns // 2 + at[0]) * factor + half
    y = (row - rows // 2 + at[1]) * factor + half
    return _Place(x=x, y=y, correlation=float(surface[row, column]), second=second, factor=factor)


def _shrunk(grey: Floats32, factor: int) -> Floats32:
    """Means of blocks; NaN where less than half of a block is valid."""
    rows, columns = (n // factor * factor for n in grey.shape)
    blocks = grey[:rows, :columns].reshape(rows // factor, factor, columns // factor, factor)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.where(2 * count >= factor * factor, total / np.maximum(count, 1), np.nan).astype(np.float32)


def _shrunk_template(template: Template, factor: int) -> tuple[Template, tuple[float, float]]:
    """Weighted means of blocks, and where the reference point is in them."""
    more = [-n % factor for n in template.values.shape]
    values, weights = (np.pad(a, ((0, more[0]), (0, more[1]))) for a in (template.values, template.weights))
    shape = (values.shape[0] // factor, factor, values.shape[1] // factor, factor)
    total = weights.reshape(shape).sum(axis=(1, 3))
    mean = (values * weights).reshape(shape).sum(axis=(1, 3)) / np.maximum(total, 1e-9)
    half = (factor - 1) / 2
    at = ((template.reference[0] - half) / factor, (template.reference[1] - half) / factor)
    weight = np.where(total >= 0.25 * factor * factor, total / factor**2, 0.0)
    return Template(mean.astype(np.float32), weight.astype(np.float32), at), at


def _around(
    grey: Floats32, template: Template, at: tuple[float, float], margin: int
) -> tuple[Floats32, tuple[int, int]]:
    """The part of a window that a template may cover, NaN outside the window; column and row of its first pixel."""
    rows, columns = template.values.shape
    col, row = (math.floor(at[k] - template.reference[k]) - margin for k in (0, 1))
    part = np.full((rows + 2 * margin, columns + 2 * margin), np.nan, np.float32)
    r0, c0 = max(row, 0), max(col, 0)
    r1, c1 = min(row + part.shape[0], grey.shape[0]), min(col + part.shape[1], grey.shape[1])
    if r1 <= r0 or c1 <= c0:
        raise InputError("the mark lies outside the window")
    part[r0 - row : r1 - row, c0 - col : c1 - col] = grey[r0:r1, c0:c1]
    return part, (col, row)
