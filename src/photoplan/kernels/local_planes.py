"""Local planes: robust fits to the neighbours of points, and the discontinuities between them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

# Robust planes through the neighbours of points, without a covariance function or a stated noise.


# Fewer neighbours determine no plane that could do without one of them.
_FEWEST = 6
# Steps towards the smallest sum of absolute values, from which the biweight (Tukey's bisquare) begins.
_ABSOLUTE, _STEPS = 7, 14
_MEDIAN = 0.6744897501960817
_BISQUARE = 4.0
# A prior for slopes that only matters where all neighbours lie on one line.
_RIDGE = 1e-3
# The third largest misfit of so many neighbours counts with this factor: an edge of the terrain, at which the plane
# fits some of them badly, is no error of one.
_EDGE_OF, _EDGE = 14, 0.67


@kernel
def fit_planes(
    xyz: NDArray[Any], near: NDArray[Any], used: NDArray[Any], some: NDArray[Any], result: NDArray[Any]
) -> None:
    """Fit a plane to the neighbours of some points, robustly and without the points themselves.

    Parameters
    ----------
    xyz : ndarray, shape (n, 3)
        Data.
    near : ndarray, shape (p, k), int
        Neighbours of each point; −1: none.
    used : ndarray, shape (n,), bool
        Data that may be used.
    some : ndarray, int
        Points that are asked for.
    result : ndarray, shape (p, 3)
        Receives for each: height less that of the plane, divided by √(1 + h), h being the plane's own variance there
        in units of that of a neighbour; and the plane's slopes towards x and y. NaN: fewer than six neighbours.
    """
    k = near.shape[1]
    v, r = np.empty((k, 4)), np.empty(k)
    for i in some:
        m, size = 0, 0.0
        for c in range(k):
            j = near[i, c]
            if j >= 0 and used[j]:
                v[m, 0], v[m, 1], v[m, 2] = xyz[j, 0] - xyz[i, 0], xyz[j, 1] - xyz[i, 1], xyz[j, 2] - xyz[i, 2]
                v[m, 3] = 1.0
                size += v[m, 0] ** 2 + v[m, 1] ** 2
                m += 1
        result[i] = np.nan
        if m < _FEWEST or not size > 0.0:
            continue
        size = np.sqrt(size / m)
        for c in range(m):
            v[c, 0] /= size
            v[c, 1] /= size
        for step in range(_STEPS):
            height, a, b, h = _plane(v, m)
            for c in range(m):
                r[c] = abs(v[c, 2] - height - a * v[c, 0] - b * v[c, 1])
            middle = np.median(r[:m])
            if not middle > 0.0:
                break
            for c in range(m):
                if step < _ABSOLUTE:
                    v[c, 3] = 1.0 / max(r[c] / middle, 0.1)
                else:
                    q = r[c] / middle * (_MEDIAN / _BISQUARE)
                    v[c, 3] = (1.0 - q * q) ** 2 if q < 1.0 else 0.0
        result[i, 0] = -height / np.sqrt(1.0 + h)
        result[i, 1], result[i, 2] = a / size, b / size


@inner
def _plane(v: NDArray[Any], m: int) -> tuple[float, float, float, float]:
    """Weighted plane through rows (x, y, z, weight): height and slopes at the origin, and the height's variance."""
    s = sx = sy = sz = 0.0
    for c in range(m):
        w = v[c, 3]
        s += w
        sx += w * v[c, 0]
        sy += w * v[c, 1]
        sz += w * v[c, 2]
    sx, sy, sz = sx / s, sy / s, sz / s
    xx = yy = _RIDGE * s
    xy = xz = yz = 0.0
    for c in range(m):
        w, dx, dy, dz = v[c, 3], v[c, 0] - sx, v[c, 1] - sy, v[c, 2] - sz
        xx += w * dx * dx
        xy += w * dx * dy
        yy += w * dy * dy
        xz += w * dx * dz
        yz += w * dy * dz
    det = xx * yy - xy * xy
    a, b = (yy * xz - xy * yz) / det, (xx * yz - xy * xz) / det
    h = 1.0 / s + (yy * sx * sx - 2.0 * xy * sx * sy + xx * sy * sy) / det
    return sz - a * sx - b * sy, a, b, h


@kernel
def local_scales(
    misfit: NDArray[Any], near: NDArray[Any], used: NDArray[Any], some: NDArray[Any], result: NDArray[Any]
) -> None:
    """How large the misfits of the neighbours of some points are: a standard deviation, robust against a few.

    Parameters
    ----------
    misfit : ndarray, shape (p,)
        Of all points; NaN: not known.
    near : ndarray, shape (p, k), int
        Neighbours of each point, the nearest first; −1: none.
    used : ndarray, shape (≥ p,), bool
        Points whose misfits count.
    some : ndarray, int
        Points that are asked for.
    result : ndarray, shape (p,)
        Receives the median of the absolute values, as a standard deviation, or what the third largest of the nearest
        14 lets expect if that is more. NaN: fewer than six neighbours.
    """
    r = np.empty(near.shape[1])
    for i in some:
        m = 0
        first = second = third = 0.0
        for j in near[i]:
            if j >= 0 and used[j] and np.isfinite(misfit[j]):
                size = abs(misfit[j])
                r[m] = size
                m += 1
                if m > _EDGE_OF:
                    continue
                if size > first:
                    first, second, third = size, first, second
                elif size > second:
                    second, third = size, second
                elif size > third:
                    third = size
        result[i] = max(np.median(r[:m]) / _MEDIAN, _EDGE * third) if m >= _FEWEST else np.nan


@kernel
def separate_across_lines(
    xyz: NDArray[Any], near: NDArray[Any], some: NDArray[Any], ends: NDArray[Any], of: NDArray[Any], start: NDArray[Any]
) -> None:
    """Replace neighbours of some points that lie beyond a line by −1.

    Parameters
    ----------
    near : ndarray, shape (p, k), int
        Neighbours of each point, changed in place.
    some : ndarray, int
        Points near lines.
    ends : ndarray, shape (s, 4)
        x, y of both ends of pieces of lines.
    of, start : ndarrays, int
        Pieces near some[t] are of[start[t]:start[t + 1]].
    """
    for t in range(len(some)):
        i = some[t]
        for c in range(near.shape[1]):
            j = near[i, c]
            if j < 0:
                continue
            for s in of[start[t] : start[t + 1]]:
                if _segments_cross(xyz[i], xyz[j], ends[s]):
                    near[i, c] = -1
                    break


@inner
def _segments_cross(p: NDArray[Any], q: NDArray[Any], e: NDArray[Any]) -> bool:
    """Whether the way from p to q crosses the piece from e[0], e[1] to e[2], e[3]."""
    dx, dy, ex, ey = q[0] - p[0], q[1] - p[1], e[2] - e[0], e[3] - e[1]
    a = dx * (e[1] - p[1]) - dy * (e[0] - p[0])
    b = dx * (e[3] - p[1]) - dy * (e[2] - p[0])
    f = ex * (p[1] - e[1]) - ey * (p[0] - e[0])
    g = ex * (q[1] - e[1]) - ey * (q[0] - e[0])
    return a * b <= 0.0 and f * g < 0.0


# Discontinuities: height differences between neighbours, connected components, and their borders.


@kernel
def neighbour_differences(
    xyz: NDArray[Any], near: NDArray[Any], slopes: NDArray[Any], result: NDArray[Any], middle: NDArray[Any]
) -> None:
    """Heights of points less those of their neighbours, the slope of the ground taken away.

    Parameters
    ----------
    xyz : ndarray, shape (≥ p, 3)
    near : ndarray, shape (p, k), int
        Neighbours; −1: none.
    slopes : ndarray, shape (p, 2)
        Of the ground around each point, towards x and y.
    result, middle : ndarrays, shapes (p, k), (p,)
        Receive the differences, NaN where there is no neighbour, and the median of their absolute values.
    """
    r = np.empty(near.shape[1])
    for i in range(len(near)):
        m = 0
        for c in range(near.shape[1]):
            j = near[i, c]
            result[i, c] = np.nan
            if j >= 0:
                dx, dy = xyz[i, 0] - xyz[j, 0], xyz[i, 1] - xyz[j, 1]
                fall = 0.5 * ((slopes[i, 0] + slopes[j, 0]) * dx + (slopes[i, 1] + slopes[j, 1]) * dy)
                result[i, c] = xyz[i, 2] - xyz[j, 2] - fall
                r[m] = abs(result[i, c])
                m += 1
        middle[i] = np.median(r[:m]) if m > 0 else np.nan


@inner
def _root(label: NDArray[Any], i: int) -> int:
    while label[i] != i:
        label[i] = label[label[i]]
        i = label[i]
    return i


@kernel
def connected_components(
    near: NDArray[Any], difference: NDArray[Any], scale: NDArray[Any], hold: float, label: NDArray[Any]
) -> None:
    """Number every point by the group that it hangs together with: label[i], shape (p,), names one of its points.

    Neighbours do whose difference is below `hold` times the larger of their scales.
    """
    for i in range(len(label)):
        label[i] = i
    for i in range(len(label)):
        for c in range(near.shape[1]):
            j = near[i, c]
            if j >= 0 and abs(difference[i, c]) < hold * max(scale[i], scale[j]):
                a, b = _root(label, i), _root(label, j)
                if a != b:
                    label[max(a, b)] = min(a, b)
    for i in range(len(label)):
        label[i] = _root(label, i)


@kernel
def component_borders(
    near: NDArray[Any],
    difference: NDArray[Any],
    scale: NDArray[Any],
    hold: float,
    label: NDArray[Any],
    result: NDArray[Any],
) -> None:
    """What lies between each group and the points around it.

    result, shape (p, 6), receives at the number of each group: edges across its border, those along which it lies
    higher and lower than `hold` scales, the sums of these differences in scales, and of all, absolute.
    """
    result[:] = 0.0
    for i in range(len(label)):
        for c in range(near.shape[1]):
            j = near[i, c]
            if j < 0 or label[i] == label[j]:
                continue
            size = difference[i, c] / max(scale[i], scale[j])
            for group, value in ((label[i], size), (label[j], -size)):
                result[group, 0] += 1.0
                result[group, 5] += abs(difference[i, c])
                if value > hold:
                    result[group, 1] += 1.0
                    result[group, 3] += value
                elif value < -hold:
                    result[group, 2] += 1.0
                    result[group, 4] -= value
