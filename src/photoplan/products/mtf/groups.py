"""Means of measured edges: by channel, direction and cell of the field."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan

import numpy as np
from numpy.typing import NDArray

from photoplan.products.mtf.result import EdgeGroup, LabComparison, MeasuredEdge
from photoplan.quality.edges.groups import (
    CombinedValue,
    combine,
    field_cell,
    fit_gaussian,
    mean_curve,
    quantiles,
    sigma_of_interval,
)
from photoplan.quality.edges.koelbl import EdgeSpread, spread_of_edge
from photoplan.quality.edges.response import EdgeMeasurement

#: Edges that show all phases of a pixel from which on others do not count in a mean.
ENOUGH = 3
#: Shares of light that means are given for: Z, A, B and the next.
SHARES = 4

Lab = tuple[NDArray[np.float64], NDArray[np.float64]]


def group_edges(
    edges: Sequence[MeasuredEdge], size: tuple[int, int] | None, grid: int, lab: Lab | None
) -> list[EdgeGroup]:
    """Means of every channel: all edges, each direction, and both for every cell of the field that has edges."""
    groups: list[EdgeGroup] = []
    for channel in sorted({edge.channel for edge in edges}):
        own = [edge for edge in edges if edge.channel == channel]
        groups.append(_group(own, None, None, lab))
        groups += [_group(part, way, None, lab) for way in ("x", "y") if (part := _in(own, way))]
        if grid < 2 or size is None:
            continue
        cells: dict[tuple[int, int], list[MeasuredEdge]] = {}
        for edge in own:
            cells.setdefault(field_cell(edge.col, edge.row, size, grid), []).append(edge)
        for cell, members in sorted(cells.items()):
            where = (cell, _bounds(cell, size, grid))
            groups.append(_group(members, None, where, None))
            groups += [_group(part, way, where, None) for way in ("x", "y") if (part := _in(members, way))]
    return groups


def _in(edges: Sequence[MeasuredEdge], direction: str) -> list[MeasuredEdge]:
    return [edge for edge in edges if edge.direction == direction]


def _group(
    edges: Sequence[MeasuredEdge],
    direction: str | None,
    where: tuple[tuple[int, int], tuple[float, float, float, float]] | None,
    lab: Lab | None,
) -> EdgeGroup:
    dense = [edge.measured for edge in edges if edge.measured.sampling == "super-sampled"]
    own = dense if len(dense) >= ENOUGH else [edge.measured for edge in edges]
    curve = mean_curve([m.mtf for m in own])
    beside = None
    if lab is not None:
        beside = LabComparison(lab[0], lab[1], np.array([curve.at(float(f)) for f in lab[0]]))
    spreads = [found for m in own if (found := spread_of_edge(m)) is not None]
    low, middle, high = quantiles([m.mtf50 for m in own], (0.1, 0.5, 0.9))
    return EdgeGroup(
        channel=edges[0].channel,
        band=edges[0].band,
        direction=direction,
        flight=edges[0].flight if direction is not None else None,
        cell=None if where is None else where[0],
        bounds=None if where is None else where[1],
        mtf50=_mean([(m.mtf50, m.mtf50_interval) for m in own], own),
        mtf10=_mean([(m.mtf10, m.mtf10_interval) for m in own], own),
        fwhm=_mean([(m.fwhm, m.fwhm_interval) for m in own], own),
        overshoot=combine([m.overshoot for m in own], [m.overshoot_sigma for m in own], least=0.0),
        undershoot=combine([m.undershoot for m in own], [m.undershoot_sigma for m in own], least=0.0),
        mtf50_range=(low, middle, high),
        curve=curve,
        gaussian=fit_gaussian(curve),
        spread=tuple(_coefficient(spreads, k) for k in range(SHARES)) if direction is not None and spreads else (),
        laboratory=beside,
    )


def _mean(figures: Sequence[tuple[float, tuple[float, float]]], edges: Sequence[EdgeMeasurement]) -> CombinedValue:
    """Mean of figures that are known by intervals."""
    sigmas = [sigma_of_interval(i, m.confidence, m.freedom) for (_, i), m in zip(figures, edges, strict=True)]
    freedom = float(np.mean([m.freedom for m in edges]))
    return combine([value for value, _ in figures], sigmas, freedom=freedom, least=0.0)


def _coefficient(spreads: Sequence[EdgeSpread], place: int) -> CombinedValue:
    """Mean share of light so many pixels away; edges that are not seen so far do not count."""
    values, sigmas = [], []
    for found in spreads:
        spread = found.spread
        seen = place <= spread.half
        values.append(float(spread.side()[place]) if seen else nan)
        both = spread.sigma
        sigmas.append(float(both[spread.half + place]) if seen and both is not None else nan)
    return combine(values, sigmas, least=0.0)


def _bounds(cell: tuple[int, int], size: tuple[int, int], cells: int) -> tuple[float, float, float, float]:
    width, height = size[0] / cells, size[1] / cells
    row, col = cell
    return (
        round(col * width - 0.5, 1),
        round(row * height - 0.5, 1),
        round((col + 1) * width - 0.5, 1),
        round((row + 1) * height - 0.5, 1),
    )
