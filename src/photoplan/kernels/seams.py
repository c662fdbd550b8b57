"""What seams cost: images in a window of a map, the graph of an expansion, sums over labels.

Labels are rows of `boxes` plus one, 0 where no image sees anything. `boxes` (n, 4): row, column, height and width of
what each image shows of the window; `layers` (pixels, features + 1): of one image after the other, from `first` on,
features by which images are compared, and what the pixel costs by its place, NaN where the image does not see it.
`costs`: of a difference at most, of a pixel of seam anyway.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

_Ints = NDArray[np.int64]
_Labels = NDArray[np.int32]
_Floats = NDArray[np.float32]


@inner
def _at(image: int, i: int, j: int, boxes: _Ints, first: _Ints, layers: _Floats) -> int:
    """Row of `layers` of a pixel in an image; −1: it does not see it."""
    y, x = i - boxes[image, 0], j - boxes[image, 1]
    if y < 0 or x < 0 or y >= boxes[image, 2] or x >= boxes[image, 3]:
        return -1
    found = first[image] + y * boxes[image, 3] + x
    return found if layers[found, layers.shape[1] - 1] >= 0.0 else -1


@inner
def _apart(a: int, b: int, i: int, j: int, boxes: _Ints, first: _Ints, layers: _Floats) -> float:
    """How much two images differ at a pixel; −1: one does not see it."""
    one, other = _at(a, i, j, boxes, first, layers), _at(b, i, j, boxes, first, layers)
    if one < 0 or other < 0:
        return -1.0
    total = 0.0
    for k in range(layers.shape[1] - 1):
        total += abs(layers[one, k] - layers[other, k])
    return total


@inner
def _seam(
    a: int, b: int, i: int, j: int, down: int, right: int, weight: _Floats, boxes: _Ints, first: _Ints,
    layers: _Floats, costs: tuple[float, float],
) -> float:  # fmt: skip
    """Cost of images a and b at a pixel and at its neighbour (Kwatra et al. 2003, eq. 1)."""
    if a == b:
        return 0.0
    total = 0.0
    for side in range(2):
        y, x = i + side * down, j + side * right
        apart = _apart(a, b, y, x, boxes, first, layers)
        most = costs[0]
        total += ((most if apart < 0.0 or apart > most else apart) + costs[1]) * weight[y, x]
    return total


@inner
def _takes(
    labels: _Labels, free: NDArray[np.bool_], image: int, i: int, j: int, boxes: _Ints, first: _Ints, layers: _Floats
) -> bool:
    """Whether an image may take a pixel."""
    return (
        free[i, j]
        and labels[i, j] > 0
        and labels[i, j] != image + 1
        and _at(image, i, j, boxes, first, layers) >= 0
    )  # fmt: skip


@kernel
def expansion(
    labels: _Labels, free: NDArray[np.bool_], weight: _Floats, image: int, boxes: _Ints, first: _Ints,
    layers: _Floats, costs: tuple[float, float], step: float, room: NDArray[np.int32], ends: NDArray[np.int32],
) -> int:  # fmt: skip
    """The graph in which the least cut says what an image takes (Boykov, Veksler & Zabih 2001, section 5).

    Parameters
    ----------
    free : ndarray of bool, shape of the window
        Pixels that may change.
    step : float
        Costs are counted in whole steps of it.
    room : ndarray of int32, shape (4, n)
    ends : ndarray of int32, shape (n,)
        As `least_cut` takes them, of the image's box with a rim of one pixel; zeros when given.

    Returns
    -------
    int
        Pixels that may change.
    """
    top, left, height, width = boxes[image]
    own = layers.shape[1] - 1
    take = np.zeros((height, width))
    count = 0
    for i in range(top, top + height):
        for j in range(left, left + width):
            if not _takes(labels, free, image, i, j, boxes, first, layers):
                continue
            count += 1
            a = labels[i, j] - 1
            cost = np.float64(layers[_at(image, i, j, boxes, first, layers), own])
            old = _at(a, i, j, boxes, first, layers)
            cost -= layers[old, own] if old >= 0 else 0.0
            for way in range(4):
                right, down = (1, 0) if way == 0 else (-1, 0) if way == 1 else (0, 1) if way == 2 else (0, -1)
                y, x = i + down, j + right
                if y < 0 or x < 0 or y >= labels.shape[0] or x >= labels.shape[1] or labels[y, x] == 0:
                    continue
                b = labels[y, x] - 1
                inside = top <= y < top + height and left <= x < left + width
                if not (inside and _takes(labels, free, image, y, x, boxes, first, layers)):
                    cost += _seam(image, b, i, j, down, right, weight, boxes, first, layers, costs)
                    cost -= _seam(a, b, i, j, down, right, weight, boxes, first, layers, costs)
                elif right + down > 0:
                    keep = _seam(a, b, i, j, down, right, weight, boxes, first, layers, costs)
                    one = _seam(a, image, i, j, down, right, weight, boxes, first, layers, costs)
                    other = _seam(image, b, i, j, down, right, weight, boxes, first, layers, costs)
                    cost += other - keep
                    take[y - top, x - left] -= other
                    both = max(one + other - keep, 0.0) / step
                    room[way, (i - top + 1) * (width + 2) + j - left + 1] = np.int32(min(both + 0.5, 1e8))
            take[i - top, j - left] += cost
    for i in range(height):
        for j in range(width):
            ends[(i + 1) * (width + 2) + j + 1] = np.int32(np.rint(min(max(take[i, j] / step, -1e8), 1e8)))
    return count


@kernel
def sum_of(
    labels: _Labels, weight: _Floats, box: tuple[int, int, int, int], boxes: _Ints, first: _Ints, layers: _Floats,
    costs: tuple[float, float],
) -> float:  # fmt: skip
    """What is made least: pixels of a box (row, column, height, width) and all neighbours of which one lies in it."""
    total = 0.0
    top, left, height, width = box
    for i in range(top, top + height):
        for j in range(left, left + width):
            if labels[i, j] == 0:
                continue
            a = labels[i, j] - 1
            mine = _at(a, i, j, boxes, first, layers)
            if mine >= 0:
                total += layers[mine, layers.shape[1] - 1]
            for way in range(4):
                right, down = (1, 0) if way == 0 else (0, 1) if way == 1 else (-1, 0) if way == 2 else (0, -1)
                y, x = i + down, j + right
                if y < 0 or x < 0 or y >= labels.shape[0] or x >= labels.shape[1] or labels[y, x] == 0:
                    continue
                # Backwards only out of the box: others are counted by the neighbour.
                if way < 2 or y < top or x < left:
                    total += _seam(a, labels[y, x] - 1, i, j, down, right, weight, boxes, first, layers, costs)
    return total


@kernel
def differences(
    labels: _Labels, box: tuple[int, int, int, int], boxes: _Ints, first: _Ints, layers: _Floats
) -> tuple[float, int]:
    """Sum and number of the differences on both sides of seams, of neighbours to the right of and below pixels of a
    box."""
    total, count = 0.0, 0
    top, left, height, width = box
    for i in range(top, top + height):
        for j in range(left, left + width):
            for way in range(2):
                y, x = i + way, j + 1 - way
                if y >= labels.shape[0] or x >= labels.shape[1] or labels[i, j] == labels[y, x]:
                    continue
                if labels[i, j] == 0 or labels[y, x] == 0:
                    continue
                a, b = labels[i, j] - 1, labels[y, x] - 1
                for side in range(2):
                    at = (i, j) if side == 0 else (y, x)
                    apart = _apart(a, b, at[0], at[1], boxes, first, layers)
                    if apart >= 0.0:
                        total, count = total + apart, count + 1
    return total, count
