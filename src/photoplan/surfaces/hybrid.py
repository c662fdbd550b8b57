"""Terrain with breaklines: units, refined posts, errors of heights."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.terrain import (
    add_representation_error,
    add_representation_error_on_lattice,
    height_ranges,
    sample_hybrid,
    sample_lattice,
    scan_faces,
)
from photoplan.surfaces.base import (
    NO_FACES,
    Hits,
    Lattice,
    Terrain,
    TerrainPart,
    box_points,
    carried_hits,
    carried_positions,
)
from photoplan.surfaces.units import MeshFaces, Unit, UnitSource
from photoplan.targets.map import MapTarget, Target

#: A point this close to a border of units, in sides of a unit, lies on it.
ON_BORDER = 1e-9
#: Between CRSs, positions are interpolated where that is good to this part of a pixel; else each pixel is transformed.
POSITION_TOLERANCE = 0.01

Layer = Literal["heights", "sigmas"]


@dataclass(frozen=True)
class HybridSurface:
    """A hybrid terrain model as a surface.

    A mesh without triangles is bilinear (Behr 1989, eq. 5.10) and needs its four posts, on an edge the two of the edge,
    at a post that one; a mesh with triangles is there where a triangle is. There is no surface beyond the outer posts.
    A point on the border of two units belongs to the eastern or southern one, and to the other where that has no
    surface. At a point exactly on a two-sided breakline (to 1e-7 of a mesh) the height left of the line counts.
    """

    source: UnitSource
    to_model_crs: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Takes X, Y of the product's CRS (..., 2) to the model's CRS; None if they are the same."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Heights of the pixel centres of a window of a map target, shape (height, width), metres; NaN: no surface."""
        return self._relief(target, window, ("heights",))[0]

    def relief_with_sigma(self, target: Target, window: Window) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Heights and their standard deviations at the pixel centres of a window, metres; NaN: no surface."""
        heights, sigmas = self._relief(target, window, ("heights", "sigmas"))
        return heights, sigmas

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Height at map points (..., 2), shape (...), metres; NaN where there is no surface."""
        return self._values(XY, "heights")

    def sigmas(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Standard deviation of the height at map points (..., 2), shape (...), metres; NaN where there is no surface.

        Between posts and vertices the standard deviations are interpolated as the heights are, and the representation
        error of the meshes is added (`Unit.representation`).
        """
        return self._values(XY, "sigmas")

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Bounds of the units that map bounds (..., 4) touch, shape (..., 2); NaN, NaN where there is no surface."""
        boxes = np.asarray(bounds, float)
        XY = box_points(boxes.reshape(-1, 4), self.to_model_crs)
        layout = self.source.layout
        at = (XY - (layout.left, layout.top)) / (layout.side, -layout.side)
        low = np.floor(np.fmin.reduce(at, axis=1) - ON_BORDER)
        high = np.floor(np.fmax.reduce(at, axis=1) + ON_BORDER) + 1
        there = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
        units = np.where(there[:, None], np.concatenate([low, high], axis=1), 0)
        units = np.clip(units, 0, np.tile([layout.columns, layout.rows], 2)).astype(np.int32)
        ranges = self.source.ranges
        out = np.stack([height_ranges(np.ascontiguousarray(ranges[..., k]), units)[:, k] for k in (0, 1)], axis=-1)
        out[np.isinf(out)] = np.nan
        return out.reshape(*boxes.shape[:-1], 2)

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """The pixels of the map in parts of half a mesh of the finest unit: triangles bend between posts."""
        return Lattice.of_relief(self, grid, 2 * grid.resolution / self.source.finest)

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Return where rays first come down onto the surface; see `Terrain.first_hit`."""
        return carried_hits(HybridParts(self), np.asarray(paths, float), self.to_model_crs, bend)

    def _values(self, XY: ArrayLike, layer: Layer) -> NDArray[np.float64]:
        XY = np.asarray(XY, float)
        model = XY if self.to_model_crs is None else self.to_model_crs(XY)
        return self._at(model.reshape(-1, 2), layer).reshape(XY.shape[:-1])

    def _at(self, XY: NDArray[np.float64], layer: Layer) -> NDArray[np.float64]:
        """Values at points (n, 2) of the model's CRS."""
        layout = self.source.layout
        at = np.stack([XY[:, 0] - layout.left, layout.top - XY[:, 1]], axis=-1) / layout.side
        values = np.full(len(XY), np.nan)
        with np.errstate(invalid="ignore"):
            upper, lower = np.floor(at + ON_BORDER), np.floor(at - ON_BORDER)
        self._gather(XY, upper, np.arange(len(XY)), layer, values)
        # Points on a border, where the first unit has no surface.
        for along in ((0,), (1,), (0, 1)):
            other = upper.copy()
            other[:, along] = lower[:, along]
            again = np.flatnonzero(np.isnan(values) & (other[:, along] != upper[:, along]).all(axis=1))
            again = again[np.isfinite(at[again]).all(axis=1)]
            if again.size:
                self._gather(XY, other, again, layer, values)
        return values

    def _gather(
        self,
        XY: NDArray[np.float64],
        units: NDArray[np.float64],
        which: NDArray[np.int64],
        layer: Layer,
        values: NDArray[np.float64],
    ) -> None:
        """Fill in the values of points `which` from their units (column, row)."""
        layout = self.source.layout
        inside = ((units[which] >= 0) & (units[which] < [layout.columns, layout.rows])).all(axis=1)
        which = which[inside]
        if not which.size:
            return
        number = (units[which, 1] * layout.columns + units[which, 0]).astype(np.int64)
        if (number == number[0]).all():
            groups = [which]
        else:
            order = np.argsort(number, kind="stable")
            cuts = np.flatnonzero(np.diff(number[order])) + 1
            groups = np.split(which[order], cuts)
        for group in groups:
            unit = self.source.unit(int(units[group[0], 0]), int(units[group[0], 1]))
            if unit is not None:
                values[group] = _unit_values(unit, XY[group], layer)

    def _relief(self, target: Target, window: Window, layers: tuple[Layer, ...]) -> list[NDArray[np.float32]]:
        if not isinstance(target, MapTarget):
            raise UsageError(f"a hybrid surface gives relief for map targets, not for {type(target).__name__}")
        grid = target.grid
        results = [np.full((window.height, window.width), np.nan, np.float32) for _ in layers]
        if not window.size:
            return results
        if self.to_model_crs is not None:
            XY = carried_positions(grid, window, self.to_model_crs, POSITION_TOLERANCE * grid.resolution)
            if XY is None:
                v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
                XY = self.to_model_crs(grid.to_map(np.stack([u, v], axis=-1)))
            for layer, result in zip(layers, results):
                result[:] = self._at(XY.reshape(-1, 2), layer).reshape(result.shape)
            return results
        layout = self.source.layout
        X = grid.left + (np.arange(window.col, window.stop[0], dtype=np.float64) + 0.5) * grid.resolution
        Y = grid.top - (np.arange(window.row, window.stop[1], dtype=np.float64) + 0.5) * grid.resolution
        x, y = (X - layout.left) / layout.side, (layout.top - Y) / layout.side
        for row, rows in _runs(y, layout.rows):
            for column, columns in _runs(x, layout.columns):
                unit = self.source.unit(column, row)
                if unit is not None:
                    first = float(X[columns.start]), float(Y[rows.start])
                    for layer, result in zip(layers, results):
                        _unit_lattice(unit, first, grid.resolution, result[rows, columns], layer)
        self._fill_borders(np.flatnonzero(_on_border(x)), np.flatnonzero(_on_border(y)), X, Y, layers, results)
        return results

    def _fill_borders(
        self,
        columns: NDArray[np.int64],
        rows: NDArray[np.int64],
        X: NDArray[np.float64],
        Y: NDArray[np.float64],
        layers: tuple[Layer, ...],
        results: list[NDArray[np.float32]],
    ) -> None:
        """Pixels on borders of units that are still without a value may have one in the other unit."""
        for layer, result in zip(layers, results):
            lost = np.zeros(result.shape, bool)
            lost[:, columns] = np.isnan(result[:, columns])
            lost[rows] = np.isnan(result[rows])
            j, i = np.nonzero(lost)
            if len(j):
                result[j, i] = self._at(np.stack([X[i], Y[j]], axis=-1), layer)


def _on_border(x: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether positions in sides of units lie on a border."""
    return np.asarray(np.abs(x - np.rint(x)) <= ON_BORDER)


def _runs(x: NDArray[np.float64], count: int) -> Iterator[tuple[int, slice]]:
    """Units (of `count`) along a row or column of pixels at ascending positions x, and which pixels lie in each."""
    index = np.floor(x + ON_BORDER).astype(np.int64)
    for unit in range(max(0, int(index[0])), min(count - 1, int(index[-1])) + 1):
        first, last = np.searchsorted(index, (unit, unit + 1))
        if first < last:
            yield unit, slice(int(first), int(last))


def _frame(unit: Unit) -> tuple[float, float, float, int]:
    return float(unit.left), float(unit.top), float(unit.meshes / unit.side), unit.meshes


def _layer(unit: Unit, layer: Layer) -> tuple[NDArray[np.float32], float]:
    return (unit.heights, unit.datum) if layer == "heights" else (unit.sigmas, 0.0)


def _unit_values(unit: Unit, XY: NDArray[np.float64], layer: Layer) -> NDArray[np.float64]:
    """Values at points (n, 2) inside a unit."""
    posts, datum = _layer(unit, layer)
    frame = _frame(unit)
    xy = np.stack([XY[:, 0] - frame[0], frame[1] - XY[:, 1]], axis=-1) * frame[2]
    faces = unit.faces or _no_faces(unit.meshes)
    result = np.empty(len(xy))
    sample_hybrid(np.ascontiguousarray(posts), *_plain(faces, layer, datum), frame, xy, result)
    if layer == "sigmas":
        between = unit.representation
        add_representation_error(between.terms, between.power, *_plain(faces, layer, datum), frame, xy, result)
    result += datum
    return result


def _unit_lattice(
    unit: Unit, first: tuple[float, float], resolution: float, result: NDArray[np.float32], layer: Layer
) -> None:
    """Values at pixels inside a unit; `first` = X, Y of the first pixel."""
    posts, datum = _layer(unit, layer)
    frame = _frame(unit)
    x0, y0, step = (first[0] - frame[0]) * frame[2], (frame[1] - first[1]) * frame[2], resolution * frame[2]
    ny, nx = result.shape
    part = sample_lattice(posts, x0, step, nx, y0, step, ny)
    if unit.faces is not None:
        scan_faces(part, (x0, step, y0, step), frame, *_plain(unit.faces, layer, datum))
    if layer == "sigmas":
        between, faces = unit.representation, unit.faces or _no_faces(unit.meshes)
        plain = _plain(faces, layer, datum)
        add_representation_error_on_lattice(between.terms, between.power, *plain, frame, (x0, step, y0, step), part)
    np.add(part, datum, out=result, casting="unsafe")


def _plain(
    faces: MeshFaces, layer: Layer, datum: float
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64]]:
    """X, Y and value above the datum of the vertices, and the triangles, always with one layout in memory."""
    vertices = np.array(faces.vertices, np.float64, order="C")
    vertices[:, 2] = vertices[:, 2] - datum if layer == "heights" else faces.sigmas
    return vertices, np.ascontiguousarray(faces.corners, np.int32), np.ascontiguousarray(faces.start, np.int64)


def _no_faces(meshes: int) -> MeshFaces:
    return MeshFaces(
        np.empty((0, 3)), np.empty(0, np.float32), np.empty((0, 3), np.int32), np.zeros(meshes * meshes + 1, np.int64)
    )


@dataclass(frozen=True, eq=False)
class HybridParts:
    """A hybrid model in parts for rays: its units."""

    surface: HybridSurface

    @property
    def corner(self) -> tuple[float, float]:
        """X, Y of the upper-left corner of the first unit."""
        layout = self.surface.source.layout
        return layout.left, layout.top

    @property
    def step(self) -> tuple[float, float]:
        """Side of a unit, twice, metres."""
        return self.surface.source.layout.side, self.surface.source.layout.side

    @property
    def inside(self) -> tuple[float, float, float, float]:
        """Outer edges of the units."""
        return self.surface.source.layout.bounds

    def ranges(self, window: Window) -> NDArray[np.float64]:
        """Bounds of units, shape (height, width, 2)."""
        return self.surface.source.ranges[window.row : window.stop[1], window.col : window.stop[0]]

    def range(self, column: int, row: int) -> NDArray[np.float64]:
        """Bounds of a unit."""
        return np.asarray(self.surface.source.ranges[row, column])

    def part(self, column: int, row: int) -> TerrainPart | None:
        """A unit; None if it is empty."""
        unit = self.surface.source.unit(column, row)
        if unit is None:
            return None
        faces = NO_FACES if unit.faces is None else (*_plain(unit.faces, "heights", unit.datum), _frame(unit))
        return TerrainPart(
            corner=(unit.left, unit.top),
            mesh=(unit.width, unit.width),
            posts=unit.heights,
            datum=unit.datum,
            faces=faces,
        )

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Heights at points of the model's CRS."""
        return self.surface._at(np.asarray(XY, float), "heights")


class HeightErrors(Protocol):
    """Standard deviations of heights, metres; NaN where there is no surface or nothing is known of it."""

    def sigmas(self, XY: ArrayLike) -> NDArray[np.float64]:
        """At map points (..., 2), shape (...)."""
        ...

    def __call__(self, target: Target, window: Window) -> NDArray[np.floating]:
        """At the pixel centres of a window of a map target, shape (height, width)."""
        ...


@dataclass(frozen=True)
class StatedHeightErrors:
    """One standard deviation of the heights everywhere, metres."""

    sigma: float

    def sigmas(self, XY: ArrayLike) -> NDArray[np.float64]:
        """See `HeightErrors`."""
        return np.full(np.shape(XY)[:-1], self.sigma)

    def __call__(self, target: Target, window: Window) -> NDArray[np.floating]:
        """See `HeightErrors`."""
        return np.full((window.height, window.width), self.sigma)


@dataclass(frozen=True)
class ModelHeightErrors:
    """The standard deviations that a terrain model holds for its posts, interpolated as its heights are."""

    surface: HybridSurface

    def sigmas(self, XY: ArrayLike) -> NDArray[np.float64]:
        """See `HeightErrors`."""
        return self.surface.sigmas(XY)

    def __call__(self, target: Target, window: Window) -> NDArray[np.floating]:
        """See `HeightErrors`."""
        return self.surface.relief_with_sigma(target, window)[1]


@dataclass(frozen=True)
class RasterHeightErrors:
    """A raster of standard deviations beside one of heights, bilinear in between."""

    raster: Terrain
    """Its values are standard deviations; a value below zero tells nothing."""

    def sigmas(self, XY: ArrayLike) -> NDArray[np.float64]:
        """See `HeightErrors`."""
        return _known(self.raster.heights(XY)).astype(float)

    def __call__(self, target: Target, window: Window) -> NDArray[np.floating]:
        """See `HeightErrors`."""
        return _known(self.raster.relief(target, window))


def _known(values: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.where(values >= 0, values, np.nan)
