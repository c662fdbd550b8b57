"""Graph cuts: maximum flow through a grid of pixels, and the seam energies that it minimises."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

# Largest flow through a grid, by two trees that grow towards each other (Boykov and Kolmogorov 2004).
#
# Nodes are pixels of a grid with a rim of one pixel that nothing flows through; they are counted row by row.
# Directions: 0 to the right, 1 to the left, 2 down, 3 up; `d ^ 1` is the way back. What goes from the source to a node
# or from a node to the sink is one number: positive or negative.


#: Of `tree`: whose tree a node is in.
FREE, SOURCE, SINK = 0, 1, 2
#: Of `parent`, beside the four directions.
_NONE, _ROOT, _ORPHAN = -1, 4, 5
#: Places in `state`: both ends of the queues of active nodes and of orphans, and the time.
_HEAD, _TAIL, _FIRST, _LAST, _TIME = 0, 1, 2, 3, 4
_UNREACHED = 1 << 30


@inner
def _push(queue: NDArray[np.int32], waits: NDArray[np.bool_], state: NDArray[np.int64], node: int) -> None:
    """Enter an active node, once."""
    if not waits[node]:
        waits[node] = True
        queue[state[_TAIL] % len(queue)] = node
        state[_TAIL] += 1


@inner
def _orphaned(
    orphans: NDArray[np.int32], parent: NDArray[np.int8], state: NDArray[np.int64], node: int, way: int
) -> None:
    """A node has lost its parent: `way` is `_ORPHAN`."""
    parent[node] = way
    orphans[state[_LAST] % len(orphans)] = node
    state[_LAST] += 1


@inner
def _origin(
    node: int, parent: NDArray[np.int8], stamp: NDArray[np.int64], away: NDArray[np.int32],
    step: NDArray[np.int64], now: int,
) -> int:  # fmt: skip
    """Nodes between this one and its terminal; `_UNREACHED`: it hangs on an orphan. Those on the way are stamped."""
    count, at = 0, node
    while True:
        if stamp[at] == now:
            count += away[at]
            break
        way = parent[at]
        count += 1
        if way == _ROOT:
            stamp[at], away[at] = now, 1
            break
        if way in (_ORPHAN, _NONE):
            count = _UNREACHED
            break
        at += step[way]
    if count < _UNREACHED:
        at, left = node, count
        while stamp[at] != now:
            stamp[at], away[at] = now, left
            left -= 1
            at += step[parent[at]]
    return count


@kernel
def _grow(
    node: int, edges: NDArray[np.int32], tree: NDArray[np.int8], parent: NDArray[np.int8], stamp: NDArray[np.int64],
    away: NDArray[np.int32], step: NDArray[np.int64], queue: NDArray[np.int32], waits: NDArray[np.bool_],
    state: NDArray[np.int64],
) -> tuple[int, int]:  # fmt: skip
    """Take neighbours into the tree of a node: where it meets the other tree, the node on the source's side and the way
    to the other; (-1, 0): nowhere."""
    mine = tree[node]
    for way in range(4):
        other = node + step[way]
        room = edges[way, node] if mine == SOURCE else edges[way ^ 1, other]
        if room <= 0:
            continue
        if tree[other] == FREE:
            tree[other], parent[other] = mine, way ^ 1
            stamp[other], away[other] = stamp[node], away[node] + 1
            _push(queue, waits, state, other)
        elif tree[other] != mine:
            return (node, way) if mine == SOURCE else (other, way ^ 1)
        elif stamp[other] <= stamp[node] and away[other] > away[node] + 1 and parent[other] != _ROOT:
            parent[other] = way ^ 1
            stamp[other], away[other] = stamp[node], away[node] + 1
    return -1, 0


@kernel
def _augment(
    node: int, way: int, edges: NDArray[np.int32], ends: NDArray[np.int32], parent: NDArray[np.int8],
    step: NDArray[np.int64], orphans: NDArray[np.int32], state: NDArray[np.int64],
) -> None:  # fmt: skip
    """Send what fits from source to sink over the edge at which the trees meet."""
    room, at = edges[way, node], node
    while parent[at] != _ROOT:
        up = parent[at]
        at += step[up]
        room = min(room, edges[up ^ 1, at])
    room, at = min(room, ends[at]), node + step[way]
    while parent[at] != _ROOT:
        room = min(room, edges[parent[at], at])
        at += step[parent[at]]
    room = min(room, -ends[at])
    edges[way, node] -= room
    edges[way ^ 1, node + step[way]] += room
    for side in range(2):
        at = node if side == 0 else node + step[way]
        while parent[at] != _ROOT:
            up = parent[at]
            above = at + step[up]
            edges[up, at] += room if side == 0 else -room
            edges[up ^ 1, above] -= room if side == 0 else -room
            if (edges[up ^ 1, above] if side == 0 else edges[up, at]) == 0:
                _orphaned(orphans, parent, state, at, _ORPHAN)
            at = above
        ends[at] -= room if side == 0 else -room
        if ends[at] == 0:
            _orphaned(orphans, parent, state, at, _ORPHAN)


@kernel
def _adopt(
    edges: NDArray[np.int32], tree: NDArray[np.int8], parent: NDArray[np.int8], stamp: NDArray[np.int64],
    away: NDArray[np.int32], step: NDArray[np.int64], queue: NDArray[np.int32], waits: NDArray[np.bool_],
    orphans: NDArray[np.int32], state: NDArray[np.int64],
) -> None:  # fmt: skip
    """Find orphans other parents, or let them go."""
    while state[_FIRST] < state[_LAST]:
        node = orphans[state[_FIRST] % len(orphans)]
        state[_FIRST] += 1
        mine, best, least = tree[node], -1, _UNREACHED
        for way in range(4):
            other = node + step[way]
            room = edges[way ^ 1, other] if mine == SOURCE else edges[way, node]
            if tree[other] == mine and room > 0:
                count = _origin(other, parent, stamp, away, step, state[_TIME])
                if count < least:
                    best, least = way, count
        if best >= 0:
            parent[node] = best
            stamp[node], away[node] = state[_TIME], least + 1
            continue
        for way in range(4):
            other = node + step[way]
            if tree[other] != mine:
                continue
            if (edges[way ^ 1, other] if mine == SOURCE else edges[way, node]) > 0:
                _push(queue, waits, state, other)
            if parent[other] == way ^ 1:
                _orphaned(orphans, parent, state, other, _ORPHAN)
        tree[node], parent[node] = FREE, _NONE


@kernel
def minimum_cut(edges: NDArray[np.int32], ends: NDArray[np.int32], width: int, tree: NDArray[np.int8]) -> None:
    """Cut a grid between source and sink at the least cost (Boykov and Kolmogorov 2004, section 3).

    Parameters
    ----------
    edges : ndarray, shape (4, n), int32
        What may flow from each node in each direction, not negative; 0 into and out of the rim. Changed.
    ends : ndarray, shape (n,), int32
        What may flow from the source to a node, or, negative, from it to the sink. Changed.
    width : int
        Columns of the grid with its rim.
    tree : ndarray, shape (n,), int8
        Receives `SINK` for nodes from which the sink can still be reached, the smallest set that a least cut can leave
        there: cutting nothing is preferred among equals.
    """
    n = len(ends)
    step = np.array([1, -1, width, -width])
    parent, stamp = np.full(n, _NONE, np.int8), np.zeros(n, np.int64)
    away, waits = np.zeros(n, np.int32), np.zeros(n, np.bool_)
    queue, orphans, state = np.empty(n, np.int32), np.empty(n, np.int32), np.zeros(5, np.int64)
    for node in range(n):
        tree[node] = FREE if ends[node] == 0 else SOURCE if ends[node] > 0 else SINK
        if ends[node] != 0:
            parent[node], away[node] = _ROOT, 1
            _push(queue, waits, state, node)
    while state[_HEAD] < state[_TAIL]:
        node = queue[state[_HEAD] % n]
        state[_HEAD] += 1
        waits[node] = False
        while tree[node] != FREE:
            state[_TIME] += 1
            met, way = _grow(node, edges, tree, parent, stamp, away, step, queue, waits, state)
            if met < 0:
                break
            _augment(met, way, edges, ends, parent, step, orphans, state)
            _adopt(edges, tree, parent, stamp, away, step, queue, waits, orphans, state)


# What seams cost: images in a window of a map, the graph of an expansion, sums over labels.
#
# Labels are rows of `boxes` plus one, 0 where no image sees anything. `boxes` (n, 4): row, column, height and width of
# what each image shows of the window; `layers` (pixels, features + 1): of one image after the other, from `first` on,
# features by which images are compared, and what the pixel costs by its place, NaN where the image does not see it.
# `costs`: of a difference at most, of a pixel of seam anyway.


_Ints = NDArray[np.int64]
_Labels = NDArray[np.int32]
_Floats = NDArray[np.float32]


@inner
def _layer_row(image: int, i: int, j: int, boxes: _Ints, first: _Ints, layers: _Floats) -> int:
    """Row of `layers` of a pixel in an image; −1: it does not see it."""
    y, x = i - boxes[image, 0], j - boxes[image, 1]
    if y < 0 or x < 0 or y >= boxes[image, 2] or x >= boxes[image, 3]:
        return -1
    found = first[image] + y * boxes[image, 3] + x
    return found if layers[found, layers.shape[1] - 1] >= 0.0 else -1


@inner
def _image_difference(a: int, b: int, i: int, j: int, boxes: _Ints, first: _Ints, layers: _Floats) -> float:
    """How much two images differ at a pixel; −1: one does not see it."""
    one, other = _layer_row(a, i, j, boxes, first, layers), _layer_row(b, i, j, boxes, first, layers)
    if one < 0 or other < 0:
        return -1.0
    total = 0.0
    for k in range(layers.shape[1] - 1):
        total += abs(layers[one, k] - layers[other, k])
    return total


@inner
def _seam_cost(
    a: int, b: int, i: int, j: int, down: int, right: int, weight: _Floats, boxes: _Ints, first: _Ints,
    layers: _Floats, costs: tuple[float, float],
) -> float:  # fmt: skip
    """Cost of images a and b at a pixel and at its neighbour (Kwatra et al. 2003, eq. 1)."""
    if a == b:
        return 0.0
    total = 0.0
    for side in range(2):
        y, x = i + side * down, j + side * right
        apart = _image_difference(a, b, y, x, boxes, first, layers)
        most = costs[0]
        total += ((most if apart < 0.0 or apart > most else apart) + costs[1]) * weight[y, x]
    return total


@inner
def _may_take(
    labels: _Labels, free: NDArray[np.bool_], image: int, i: int, j: int, boxes: _Ints, first: _Ints, layers: _Floats
) -> bool:
    """Whether an image may take a pixel."""
    return (
        free[i, j]
        and labels[i, j] > 0
        and labels[i, j] != image + 1
        and _layer_row(image, i, j, boxes, first, layers) >= 0
    )  # fmt: skip


@kernel
def expansion_graph(
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
            if not _may_take(labels, free, image, i, j, boxes, first, layers):
                continue
            count += 1
            a = labels[i, j] - 1
            cost = np.float64(layers[_layer_row(image, i, j, boxes, first, layers), own])
            old = _layer_row(a, i, j, boxes, first, layers)
            cost -= layers[old, own] if old >= 0 else 0.0
            for way in range(4):
                right, down = (1, 0) if way == 0 else (-1, 0) if way == 1 else (0, 1) if way == 2 else (0, -1)
                y, x = i + down, j + right
                if y < 0 or x < 0 or y >= labels.shape[0] or x >= labels.shape[1] or labels[y, x] == 0:
                    continue
                b = labels[y, x] - 1
                inside = top <= y < top + height and left <= x < left + width
                if not (inside and _may_take(labels, free, image, y, x, boxes, first, layers)):
                    cost += _seam_cost(image, b, i, j, down, right, weight, boxes, first, layers, costs)
                    cost -= _seam_cost(a, b, i, j, down, right, weight, boxes, first, layers, costs)
                elif right + down > 0:
                    keep = _seam_cost(a, b, i, j, down, right, weight, boxes, first, layers, costs)
                    one = _seam_cost(a, image, i, j, down, right, weight, boxes, first, layers, costs)
                    other = _seam_cost(image, b, i, j, down, right, weight, boxes, first, layers, costs)
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
def seam_energy(
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
            mine = _layer_row(a, i, j, boxes, first, layers)
            if mine >= 0:
                total += layers[mine, layers.shape[1] - 1]
            for way in range(4):
                right, down = (1, 0) if way == 0 else (0, 1) if way == 1 else (-1, 0) if way == 2 else (0, -1)
                y, x = i + down, j + right
                if y < 0 or x < 0 or y >= labels.shape[0] or x >= labels.shape[1] or labels[y, x] == 0:
                    continue
                # Backwards only out of the box: others are counted by the neighbour.
                if way < 2 or y < top or x < left:
                    total += _seam_cost(a, labels[y, x] - 1, i, j, down, right, weight, boxes, first, layers, costs)
    return total


@kernel
def seam_differences(
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
                    apart = _image_difference(a, b, at[0], at[1], boxes, first, layers)
                    if apart >= 0.0:
                        total, count = total + apart, count + 1
    return total, count
