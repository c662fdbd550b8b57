"""Catchments and flow lengths on a grid of heights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from photoplan.codec import storable
from photoplan.errors import InputError, UsageError
from photoplan.kernels import terrain as kernels

FlowMethod = Literal["d8", "dinf"]
#: Bytes of one cell while it is computed.
CELL_BYTES = 80


@storable
@dataclass(frozen=True, eq=False)
class Flow:
    """Flow over a grid; all arrays have its shape."""

    filled: NDArray[np.float32]
    """Heights with pits filled up to where they spill, metres."""
    direction: NDArray[np.int8]
    """Direction of the flow, 0 = east, 1 = north-east … 7 = south-east; −1: it leaves the terrain, −2: no terrain."""
    area: NDArray[np.float64]
    """Area whose water comes through the cell, its own included, m²; NaN without terrain."""
    length: NDArray[np.float32]
    """Horizontal length of the way to the next outlet below, or to the edge of the terrain, metres."""
    longest: NDArray[np.float32]
    """Horizontal length of the longest way that leads to the cell, metres."""
    catchment: NDArray[np.int32]
    """Number of the next outlet below (from 1, in the order given); 0: the water leaves elsewhere; −1: no terrain."""
    leaves: NDArray[np.bool_]
    """Cells where water leaves the terrain."""


def flow_of(
    heights: NDArray[np.float32], cell: float, outlets: Sequence[tuple[int, int]] = (), method: FlowMethod = "d8"
) -> Flow:
    """Flow over a grid of heights.

    Pits are filled; every cell flows to the neighbour with the steepest way down, on plains towards where the plain
    spills. Water leaves over the edge of the grid and where terrain is missing.

    Parameters
    ----------
    heights : ndarray, shape (rows, cols), float32
        NaN = no terrain.
    cell : float
        Side of a cell, metres.
    outlets : sequence of (row, column)
        Cells whose catchments are wanted; without any, those are numbered where water leaves the terrain.
    method : str
        How upstream areas are summed: ``"d8"`` to one neighbour, ``"dinf"`` split between two, which is smoother on
        slopes. Lengths and catchments follow ``"d8"`` in any case.

    Raises
    ------
    UsageError
        The method is unknown.
    InputError
        There is no terrain, or an outlet lies where there is none.
    """
    if method not in get_args(FlowMethod):
        raise UsageError(f"method {method!r}; allowed are {', '.join(get_args(FlowMethod))}")
    heights = np.ascontiguousarray(heights, np.float32)
    shape, columns = heights.shape, heights.shape[1]
    missing = np.isnan(heights)
    if missing.all():
        raise InputError("no terrain: the grid holds no height")
    filled = np.empty(shape, np.float32)
    order, origin = np.empty(heights.size, np.int32), np.full(heights.size, -1, np.int32)
    count = kernels.flood(heights, filled, order, origin)
    order = order[:count]
    receiver = np.empty(heights.size, np.int32)
    kernels.steepest(filled, origin, receiver)
    area = np.where(missing, np.nan, cell**2).ravel()
    if method == "dinf":
        kernels.accumulate_split(filled, order, receiver, area)
    else:
        kernels.accumulate(order, receiver, area)
    leaves = receiver == -1
    labels = _outlets(heights, outlets) if outlets else _numbered(order, leaves)
    stops = (labels > 0) & bool(outlets)
    length, longest = np.full(heights.size, np.nan, np.float32), np.where(missing, np.nan, 0).astype(np.float32).ravel()
    kernels.downstream(order, receiver, columns, stops, length)
    kernels.upstream_length(order, receiver, columns, longest)
    kernels.label_upstream(order, receiver, labels)
    labels[missing.ravel()] = -1
    direction = np.empty(shape, np.int8)
    kernels.directions(receiver, direction)
    return Flow(
        filled=filled,
        direction=direction,
        area=area.reshape(shape),
        length=length.reshape(shape) * np.float32(cell),
        longest=longest.reshape(shape) * np.float32(cell),
        catchment=labels.reshape(shape),
        leaves=leaves.reshape(shape),
    )


def _outlets(heights: NDArray[np.float32], outlets: Sequence[tuple[int, int]]) -> NDArray[np.int32]:
    rows, columns = heights.shape
    labels = np.zeros(heights.size, np.int32)
    for number, (row, column) in enumerate(outlets, 1):
        if not (0 <= row < rows and 0 <= column < columns) or np.isnan(heights[row, column]):
            raise InputError(f"outlet {number} lies where there is no terrain; move it, or snap it to the flow")
        at = row * columns + column
        if labels[at]:
            raise InputError(f"outlets {labels[at]} and {number} lie in one cell; leave one out, or take smaller cells")
        labels[at] = number
    return labels


def _numbered(order: NDArray[np.int32], leaves: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Numbers from 1 for the cells where water leaves, from low to high."""
    labels = np.zeros(len(leaves), np.int32)
    out = order[leaves[order]]
    labels[out] = np.arange(1, len(out) + 1)
    return labels


def snapped(area: NDArray[np.float64], row: float, column: float, reach: float) -> tuple[int, int]:
    """The cell with the largest upstream area within `reach` cells of a place; the cell itself for reach 0."""
    rows, columns = area.shape
    j, i = np.mgrid[
        max(0, round(row - reach)) : min(rows, round(row + reach) + 1),
        max(0, round(column - reach)) : min(columns, round(column + reach) + 1),
    ]
    near = np.hypot(j - row, i - column) <= max(reach, 0.75)
    if reach < 0.5:
        near &= (j == round(row)) & (i == round(column))
    found = np.where(near, area[j, i], np.nan) if j.size else np.empty(0)
    if not np.isfinite(found).any():
        raise InputError("no terrain there")
    best = np.unravel_index(np.nanargmax(found), found.shape)
    return int(j[best]), int(i[best])
