"""Lines on the chessboard of units: vertices wherever a line crosses the grid (Ecker 1991, §2.1.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.surfaces.units import LineElement, UnitLayout

#: A vertex nearer than this to a grid line or post, in meshes, is moved onto it.
SNAP = 1e-6


def on_grid(line: LineElement, layout: UnitLayout, meshes: NDArray[np.int64]) -> LineElement:
    """A line with a vertex wherever it crosses a grid line of the unit that it is in.

    The new vertices are computed once, so that the meshes on both sides of a grid line hold the very same numbers;
    where a line runs along the border of two units it gets the posts of both. Vertices within 1e-6 of a mesh of a grid
    line are moved onto it. Lines that share vertices share them still.
    """
    if meshes.shape != (layout.rows, layout.columns):
        raise InputError(
            f"meshes of units given as {meshes.shape}; the layout has {layout.rows} rows, {layout.columns} columns"
        )
    chain = _Chain.of(line, layout).snapped(meshes)
    # First the borders of units; then every piece lies in one unit, or between two whose grids both count.
    segments = len(chain.xy) - 1
    chain = chain.cut(np.zeros((segments, 2)), np.ones(segments)).snapped(meshes)
    for shift in (SNAP / 10, -SNAP / 10):
        middle = (chain.xy[:-1] + chain.xy[1:]) / 2
        unit = np.floor(middle + shift)
        chain = chain.cut(unit, _count(unit, meshes))
    return chain.element(line)


@dataclass(frozen=True, eq=False)
class _Chain:
    """Vertices in sides of units from the layout's corner, y downwards, and what else is linear between them."""

    xy: NDArray[np.float64]
    ground: NDArray[np.float64]
    """X, Y, height, right height, standard deviation."""
    new: NDArray[np.bool_]
    layout: UnitLayout

    @classmethod
    def of(cls, line: LineElement, layout: UnitLayout) -> _Chain:
        X, Y, Z = line.xyz.T
        right = np.full(len(Z), np.nan) if line.right is None else line.right
        xy = np.stack([X - layout.left, layout.top - Y], axis=1) / layout.side
        return cls(xy, np.stack([X, Y, Z, right, line.sigmas], axis=1), line.on_grid, layout)

    def snapped(self, meshes: NDArray[np.int64]) -> _Chain:
        """Vertices near a grid line of any unit that they touch, moved onto it; repeated vertices left out."""
        xy, ground = self.xy.copy(), self.ground.copy()
        near = SNAP / max(1, int(meshes.max(initial=1)))
        todo = np.ones(xy.shape, bool)
        for dx in (near, -near):
            for dy in (near, -near):
                unit = np.floor(self.xy + np.array([dx, dy]))
                count = _count(unit, meshes)[:, None]
                fine = (self.xy - unit) * count
                line = np.rint(fine)
                hit = todo & (np.abs(fine - line) <= SNAP)
                xy[hit] = (unit + line / count)[hit]
                todo &= ~hit
        moved = ~todo
        ground[:, :2] = np.where(moved, self._to_ground(xy), ground[:, :2])
        keep = np.append(True, (np.diff(ground[:, :2], axis=0) != 0).any(axis=1))
        return _Chain(xy[keep], ground[keep], self.new[keep], self.layout)

    def cut(self, unit: NDArray[np.float64], count: NDArray[np.float64]) -> _Chain:
        """Vertices inserted at the grid lines of `count` meshes in a unit, for every segment."""
        if len(self.xy) < 2:
            return self
        segments = np.arange(len(self.xy) - 1)
        start, stop = self.xy[:-1], self.xy[1:]
        numbers, positions, places = [], [], []
        for axis in (0, 1):
            a = _exact((start[:, axis] - unit[:, axis]) * count)
            b = _exact((stop[:, axis] - unit[:, axis]) * count)
            first, last = np.floor(np.minimum(a, b)) + 1, np.ceil(np.maximum(a, b)) - 1
            crossings = np.maximum(last - first + 1, 0).astype(np.int64)
            which = np.repeat(segments, crossings)
            k = np.arange(len(which)) - np.repeat(np.cumsum(crossings) - crossings, crossings) + first[which]
            t = (k - a[which]) / (b[which] - a[which])
            place = start[which] + t[:, None] * (stop[which] - start[which])
            place[:, axis] = unit[which, axis] + k / count[which]
            other = 1 - axis
            fine = (place[:, other] - unit[which, other]) * count[which]
            near = np.abs(fine - np.rint(fine)) <= SNAP
            place[near, other] = (unit[which, other] + np.rint(fine) / count[which])[near]
            numbers.append(which)
            positions.append(t)
            places.append(place)
        return self._with(np.concatenate(numbers), np.concatenate(positions), np.concatenate(places))

    def _with(self, which: NDArray[np.int64], t: NDArray[np.float64], place: NDArray[np.float64]) -> _Chain:
        """New vertices at part t of segments `which`; two at one place are one."""
        if not len(which):
            return self
        ground = self.ground[which] + t[:, None] * (self.ground[which + 1] - self.ground[which])
        ground[:, :2] = self._to_ground(place)
        order = np.lexsort((t, which))
        count = len(self.xy)
        index = np.concatenate([np.arange(count), which[order]])
        again = np.argsort(index, kind="stable")
        xy = np.concatenate([self.xy, place[order]])[again]
        full = np.concatenate([self.ground, ground[order]])[again]
        new = np.concatenate([self.new, np.ones(len(which), bool)])[again]
        original = np.concatenate([np.ones(count, bool), np.zeros(len(which), bool)])[again]
        same = (xy[1:] == xy[:-1]).all(axis=1)
        keep = np.ones(len(xy), bool)
        keep[1:] &= ~same | original[1:]
        keep[:-1] &= ~(same & original[1:] & ~original[:-1])
        return _Chain(xy[keep], full[keep], new[keep], self.layout)

    def _to_ground(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack(
            [self.layout.left + xy[:, 0] * self.layout.side, self.layout.top - xy[:, 1] * self.layout.side], axis=1
        )

    def element(self, line: LineElement) -> LineElement:
        X, Y, Z, right, sigmas = self.ground.T
        return LineElement(
            name=line.name,
            kind=line.kind,
            code=line.code,
            xyz=np.stack([X, Y, Z], axis=1),
            right=None if line.right is None else right.copy(),
            sigmas=sigmas.copy(),
            on_grid=self.new,
        )


def _count(unit: NDArray[np.float64], meshes: NDArray[np.int64]) -> NDArray[np.float64]:
    """Meshes along the side of units (column, row), at least 1; 1 outside the layout."""
    rows, columns = meshes.shape
    inside = ((unit >= 0) & (unit < [columns, rows])).all(axis=1)
    count = np.ones(len(unit))
    col, row = unit[inside].astype(np.int64).T
    count[inside] = np.maximum(meshes[row, col], 1)
    return count


def _exact(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Whole numbers where only rounding keeps a position from being one."""
    nearest = np.rint(x)
    return np.where(np.abs(x - nearest) <= SNAP / 2, nearest, x)
