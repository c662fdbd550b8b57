"""Largest flow through a grid, by two trees that grow towards each other (Boykov and Kolmogorov 2004).

Nodes are pixels of a grid with a rim of one pixel that nothing flows through; they are counted row by row. Directions:
0 to the right, 1 to the left, 2 down, 3 up; `d ^ 1` is the way back. What goes from the source to a node or from a node
to the sink is one number: positive or negative.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

#: Of `tree`: whose tree a node is in.
FREE, SOURCE, SINK = 0, 1, 2
#: Of `parent`, beside the four directions.
_NONE, _ROOT, _ORPHAN = -1, 4, 5
#: Places in `state`: both ends of the queues of active nodes and of orphans, and the time.
_HEAD, _TAIL, _FIRST, _LAST, _TIME = 0, 1, 2, 3, 4
_FAR = 1 << 30


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
    """Nodes between this one and its terminal; `_FAR`: it hangs on an orphan. Those on the way are stamped."""
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
            count = _FAR
            break
        at += step[way]
    if count < _FAR:
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
        mine, best, least = tree[node], -1, _FAR
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
def least_cut(edges: NDArray[np.int32], ends: NDArray[np.int32], width: int, tree: NDArray[np.int8]) -> None:
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
