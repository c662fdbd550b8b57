"""Profiles: the surface over a polyline, broken wherever the surface bends (Ecker 1991, §5.4.4, fig. 5.9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.mesh import SNAP, on_grid
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.units import LineElement, Unit, UnitLayout

#: Breaks of a profile nearer than this, metres, are one …
SAME_PLACE = 1e-6
#: … and so are heights on both sides of a break nearer than this, metres.
SAME_HEIGHT = 1e-4


def profile(
    surface: HybridSurface | RasterSurface, polyline: ArrayLike, tolerance: float = 0.001
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Heights over a polyline, such that straight lines between them are the surface.

    There is a point at every vertex of the polyline and wherever it crosses a grid line, a line element or the edge of
    a triangle. Over a bilinear mesh the surface is a parabola: points are added until it is met to the tolerance.
    """
    line = _polyline(polyline)
    if not tolerance > 0:
        raise UsageError(f"tolerance {tolerance}; a height in metres above zero is needed")
    if isinstance(surface, HybridSurface):
        if surface.to_model_crs is not None:
            raise UsageError("profile over a model in another CRS; give the polyline in the model's CRS instead")
        cut = _cut_hybrid(surface, line)
    else:
        if surface.to_grid_crs is not None:
            raise UsageError("profile over a grid in another CRS; give the polyline in the grid's CRS instead")
        cut = _cut_raster(surface, line)
    return _between_breaks(surface, cut, tolerance)


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Parts of the polyline over which the surface does not bend, from a to b."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]

    @classmethod
    def of(cls, XY: NDArray[np.float64]) -> _Pieces:
        return cls(XY[:-1], XY[1:])

    @property
    def length(self) -> NDArray[np.float64]:
        return np.asarray(np.hypot(*(self.b - self.a).T))

    def at(self, t: float) -> NDArray[np.float64]:
        return self.a + t * (self.b - self.a)

    def cut(self, which: NDArray[np.int64], t: NDArray[np.float64]) -> _Pieces:
        """Broken at parts t of pieces `which`, but not into pieces without length."""
        near = SAME_PLACE / np.maximum(self.length, SAME_PLACE)[which]
        inside = (t > near) & (t < 1 - near)
        which, t = which[inside], t[inside]
        count = len(self.a)
        number = np.concatenate([np.arange(count), which])
        part = np.concatenate([np.zeros(count), t])
        order = np.lexsort((part, number))
        number, part = number[order], part[order]
        gap = np.append(True, (np.diff(number) != 0) | (np.diff(part) * self.length[number[1:]] > SAME_PLACE))
        number, part = number[gap], part[gap]
        start = self.a[number] + part[:, None] * (self.b - self.a)[number]
        last = np.append(np.diff(number) != 0, True)
        stop = np.where(last[:, None], self.b[number], np.roll(start, -1, axis=0))
        return _Pieces(start, stop)


def _polyline(polyline: ArrayLike) -> NDArray[np.float64]:
    XY = np.asarray(polyline, float)
    if XY.ndim != 2 or XY.shape[1] != 2 or not np.isfinite(XY).all():
        raise UsageError(f"polyline of shape {XY.shape}; finite X, Y of at least two points are needed")
    XY = XY[np.append(True, (np.diff(XY, axis=0) != 0).any(axis=1))] if len(XY) else XY
    if len(XY) < 2:
        raise UsageError("polyline without length; at least two different points are needed")
    return XY


def _element(XY: NDArray[np.float64]) -> LineElement:
    zero = np.zeros(len(XY))
    return LineElement(
        name="profile",
        kind="formline",
        code="",
        xyz=np.column_stack([XY, zero]),
        right=None,
        sigmas=zero,
        on_grid=np.zeros(len(XY), bool),
    )


def _cut_hybrid(surface: HybridSurface, XY: NDArray[np.float64]) -> _Pieces:
    """Broken at grid lines and at the edges of triangles."""
    layout = surface.source.layout
    meshes = np.zeros((layout.rows, layout.columns), np.int64)
    rough = _Pieces.of(on_grid(_element(XY), layout, meshes).xyz[:, :2])
    units: dict[tuple[int, int], Unit] = {}
    for shift in (SNAP / 10, -SNAP / 10):
        for column, row in np.unique(_unit_numbers(rough, layout, shift), axis=0):
            inside = 0 <= column < layout.columns and 0 <= row < layout.rows
            unit = surface.source.unit(int(column), int(row)) if inside else None
            if unit is not None:
                units[int(column), int(row)] = unit
                meshes[row, column] = unit.meshes
    pieces = _Pieces.of(on_grid(_element(XY), layout, meshes).xyz[:, :2])
    which, parts = [np.empty(0, np.int64)], [np.empty(0)]
    for shift in (SNAP / 10, -SNAP / 10):
        at = _unit_numbers(pieces, layout, shift)
        for (column, row), unit in units.items():
            here = np.flatnonzero((at == [column, row]).all(axis=1))
            if unit.faces is not None and here.size:
                number, t = _edge_cuts(unit, pieces.a[here], pieces.b[here], shift)
                which.append(here[number])
                parts.append(t)
    return pieces.cut(np.concatenate(which), np.concatenate(parts))


def _unit_numbers(pieces: _Pieces, layout: UnitLayout, shift: float) -> NDArray[np.int64]:
    """Column and row of the unit of each piece; along a border, the shift decides."""
    x, y = pieces.at(0.5).T
    at = np.stack([x - layout.left, layout.top - y], axis=1) / layout.side
    return np.floor(at + shift).astype(np.int64)


def _edge_cuts(
    unit: Unit, a: NDArray[np.float64], b: NDArray[np.float64], shift: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Pieces a–b, each in one mesh, against the edges of its triangles: number of the piece, and part of it."""
    faces = unit.faces
    assert faces is not None
    x, y = ((a + b) / 2).T
    at = np.stack([x - unit.left, unit.top - y], axis=1) / unit.width
    col, row = np.clip(np.floor(at + shift * unit.meshes), 0, unit.meshes - 1).astype(np.int64).T
    mesh = row * unit.meshes + col
    count = faces.start[mesh + 1] - faces.start[mesh]
    piece = np.repeat(np.arange(len(a)), count)
    face = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count) + faces.start[mesh][piece]
    corners = faces.vertices[faces.corners[face]][:, :, :2]
    start, step = a[piece], (b - a)[piece]
    found_piece, found = [], []
    for k in range(3):
        p, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        across = step[:, 0] * edge[:, 1] - step[:, 1] * edge[:, 0]
        away = p - start
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (away[:, 0] * edge[:, 1] - away[:, 1] * edge[:, 0]) / across
            s = (away[:, 0] * step[:, 1] - away[:, 1] * step[:, 0]) / across
        hit = (s > -1e-9) & (s < 1 + 1e-9) & (t > 0) & (t < 1)
        found_piece.append(piece[hit])
        found.append(t[hit])
    return np.concatenate(found_piece), np.concatenate(found)


def _cut_raster(surface: RasterSurface, XY: NDArray[np.float64]) -> _Pieces:
    """Broken at the lines between posts, and where the continued edge ends."""
    pieces = _Pieces.of(XY)
    size = surface.grid.size
    which, parts = [], []
    for axis, sign in ((0, 1.0), (1, -1.0)):
        a, b = (sign * (end[:, axis] - surface.origin[axis]) / surface.mesh[axis] for end in (pieces.a, pieces.b))
        low, high = np.minimum(a, b), np.maximum(a, b)
        first = np.clip(np.ceil(low), 0, size[axis]).astype(np.int64)
        last = np.clip(np.floor(high), -1, size[axis] - 1).astype(np.int64)
        count = np.maximum(last - first + 1, 0)
        number = np.repeat(np.arange(len(a)), count)
        post = np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count) + first[number]
        number = np.concatenate([number, np.tile(np.arange(len(a)), 2)])
        at = np.concatenate([post, np.repeat([-0.5, size[axis] - 0.5], len(a))])
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (at - a[number]) / (b - a)[number]
        good = np.isfinite(t)
        which.append(number[good])
        parts.append(t[good])
    return pieces.cut(np.concatenate(which), np.concatenate(parts))


def _between_breaks(
    surface: HybridSurface | RasterSurface, pieces: _Pieces, tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Points of the profile: over each piece a parabola through three heights inside it, where there is no doubt."""
    quarter, half, three = (surface.heights(pieces.at(t)) for t in (0.25, 0.5, 0.75))
    bend = 8 * (quarter - 2 * half + three)
    slope = 2 * (three - quarter) - bend
    begin = half - slope / 2 - bend / 4
    with np.errstate(invalid="ignore"):
        parts = np.ceil(np.sqrt(np.abs(bend) / (4 * tolerance)))
    parts = np.where(np.isfinite(parts), np.maximum(parts, 1), 1).astype(np.int64)
    number = np.repeat(np.arange(len(parts)), parts + 1)
    step = np.arange(len(number)) - np.repeat(np.cumsum(parts + 1) - parts - 1, parts + 1)
    t = step / parts[number]
    Z = begin[number] + t * (slope[number] + t * bend[number])
    lengths = pieces.length
    from_start = np.cumsum(lengths) - lengths
    distance = np.maximum.accumulate(from_start[number] + t * lengths[number])
    XY = pieces.a[number] + t[:, None] * (pieces.b - pieces.a)[number]
    keep = _distinct(Z, step == 0)
    return distance[keep], XY[keep, 0], XY[keep, 1], Z[keep]


def _distinct(Z: NDArray[np.float64], first: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points that are needed: one where two pieces meet at one height, none inside gaps."""
    lost = np.isnan(Z)
    keep = np.ones(len(Z), bool)
    same = np.append(False, (np.abs(np.diff(Z)) <= SAME_HEIGHT) | (lost[1:] & lost[:-1])) & first
    keep &= ~same
    inner_gap = lost & np.append(False, lost[:-1]) & np.append(lost[1:], False)
    return keep & ~inner_gap
