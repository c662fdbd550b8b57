"""Where heights break off: differences between neighbours, points that hang together, and what lies around them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel


@kernel
def differences(
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
def hang_together(
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
def borders(
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
