"""Two-sided breaklines in a triangulation: which triangle sees which height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.surfaces.mesh.nodes import Nodes
from photoplan.surfaces.units import LineElement


@dataclass(frozen=True, eq=False)
class _WallRays:
    """Pieces of walls that leave a node, sorted by node and direction; sector k lies left of ray k."""

    node: NDArray[np.int64]
    angle: NDArray[np.float64]
    height: NDArray[np.float64]
    """Height of the sector that begins at the ray."""
    rank: NDArray[np.int64]
    """Number of the sector at its node: sectors on the left of walls first."""
    first: NDArray[np.int64]
    """First and one past the last ray of the node that each ray belongs to."""
    last: NDArray[np.int64]


def split_at_walls(
    nodes: Nodes, lines: Sequence[LineElement], corners: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices of triangles, doubled along two-sided breaklines.

    The pieces of walls that meet in a point part its surroundings into sectors; each has the mean of the heights that
    the walls on both of its sides give it. In the middle of a wall these are the heights left and right; where a wall
    ends there is one sector, and with it one height, the mean of both.

    Parameters
    ----------
    nodes : Nodes
    lines : sequence of LineElement
        Those that the nodes come from.
    corners : ndarray, shape (f, 3)
        Node numbers of the triangles, counter-clockwise on the map.

    Returns
    -------
    values : ndarray, shape (k, 4)
        X, Y, Z and standard deviation of every vertex that a triangle uses. At a wall the vertex on the left comes
        before that on the right.
    corners : ndarray, shape (f, 3)
        Vertex numbers.
    """
    rank = np.zeros(corners.shape, np.int64)
    height = nodes.values[corners, 2]
    rays = _rays(nodes, lines)
    if len(rays.node):
        _find_sectors(nodes, rays, corners, rank, height)
    most = int(rank.max(initial=0)) + 1
    key = corners.astype(np.int64) * most + rank
    used, first, number = np.unique(key, return_index=True, return_inverse=True)
    values = nodes.values[used // most].copy()
    values[:, 2] = height.reshape(-1)[first]
    return values, number.reshape(corners.shape).astype(np.int32)


def _rays(nodes: Nodes, lines: Sequence[LineElement]) -> _WallRays:
    node, angle, on_left, on_right, outward = [], [], [], [], []
    begin = 0
    for line in lines:
        count = len(line.xyz)
        at = nodes.line_nodes[begin : begin + count]
        xy = nodes.line_xy[begin : begin + count]
        begin += count
        if line.right is None:
            continue
        step = np.diff(xy, axis=0)
        for here, direction, out in ((np.arange(count - 1), step, True), (np.arange(1, count), -step, False)):
            there = (at[here] >= 0) & (direction != 0).any(axis=1)
            here, direction = here[there], direction[there]
            node.append(at[here])
            angle.append(np.arctan2(-direction[:, 1], direction[:, 0]))
            on_left.append(line.xyz[here, 2] if out else line.right[here])
            on_right.append(line.right[here] if out else line.xyz[here, 2])
            outward.append(np.full(len(here), out))
    if not node:
        empty = np.empty(0, np.int64)
        return _WallRays(empty, np.empty(0), np.empty(0), empty, empty, empty)
    at, turn = np.concatenate(node), np.concatenate(angle)
    order = np.lexsort((turn, at))
    left, right = np.concatenate(on_left)[order], np.concatenate(on_right)[order]
    return _sectors(at[order], turn[order], left, right, np.concatenate(outward)[order])


def _sectors(
    at: NDArray[np.int64],
    turn: NDArray[np.float64],
    left: NDArray[np.float64],
    right: NDArray[np.float64],
    out: NDArray[np.bool_],
) -> _WallRays:
    count = len(at)
    first = np.searchsorted(at, at, side="left")
    last = np.searchsorted(at, at, side="right")
    following = np.arange(1, count + 1)
    following = np.where(following == last, first, following)
    height = (left + right[following]) / 2
    # A sector is on the left of a wall that leaves on its right-hand side, and of one that arrives on its left.
    lefts = out.astype(np.int64) + ~out[following]
    order = np.lexsort((np.arange(count), -lefts, at))
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count) - first
    # No wall is left where all sectors have one height.
    low, high = height.copy(), height.copy()
    np.minimum.at(low, first, height)
    np.maximum.at(high, first, height)
    rank[low[first] == high[first]] = 0
    return _WallRays(at, turn, height, rank, first, last)


def _find_sectors(
    nodes: Nodes, rays: _WallRays, corners: NDArray[np.int32], rank: NDArray[np.int64], height: NDArray[np.float64]
) -> None:
    """Sector of every corner that is at a wall, from the direction of the triangle's middle."""
    at_wall = np.zeros(len(nodes.xy), bool)
    at_wall[rays.node] = True
    face, corner = np.nonzero(at_wall[corners])
    node = corners[face, corner].astype(np.int64)
    # Directions along both edges, made equally long: their sum points into the triangle however flat it is.
    direction = np.zeros((len(face), 2))
    for step in (1, 2):
        edge = nodes.xy[corners[face, (corner + step) % 3]] - nodes.xy[node]
        direction += edge / np.maximum(np.hypot(edge[:, 0], edge[:, 1]), np.finfo(float).tiny)[:, None]
    turn = np.arctan2(-direction[:, 1], direction[:, 0])
    ray = _last_before(rays, node, turn)
    rank[face, corner] = rays.rank[ray]
    height[face, corner] = rays.height[ray]


def _last_before(rays: _WallRays, node: NDArray[np.int64], turn: NDArray[np.float64]) -> NDArray[np.int64]:
    """The ray of a node from which a direction is reached counter-clockwise, without another between."""
    all_nodes = np.concatenate([rays.node, node])
    all_turns = np.concatenate([rays.angle, turn])
    is_ray = np.concatenate([np.ones(len(rays.node), bool), np.zeros(len(node), bool)])
    order = np.lexsort((~is_ray, all_turns, all_nodes))
    passed = np.cumsum(is_ray[order]) - 1
    before = np.empty(len(order), np.int64)
    before[order] = passed
    found = before[len(rays.node) :]
    first = np.searchsorted(rays.node, node, side="left")
    return np.where(found < first, np.searchsorted(rays.node, node, side="right") - 1, found)
