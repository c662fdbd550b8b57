"""Terrain with breaklines: units, refined posts, errors of heights."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError, UsageError
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
from photoplan.surfaces.mesh import build_faces, on_grid
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.units import LineElement, MeshFaces, Unit, UnitLayout, UnitSource
from photoplan.targets.map import MapTarget, Target

#: Meshes along a unit's side at most.
MESHES = 64
#: Posts are square if their distances along X and Y differ by no more than this part.
_SQUARE = 1e-9


@dataclass(frozen=True, eq=False)
class RasterUnits:
    """A source of computing units (`UnitSource`) whose posts are the posts of a raster; their sigmas are unknown."""

    surface: RasterSurface
    """In the raster's own CRS."""

    def __post_init__(self) -> None:
        dx, dy = self.surface.mesh
        if abs(dx - dy) > _SQUARE * max(dx, dy):
            raise InputError(
                f"raster with posts {dx:.10g} m × {dy:.10g} m apart; make its cells square with gdalwarp -tr"
            )
        if min(self.surface.grid.size) < 2:
            raise InputError(f"raster of {self.surface.grid.size} posts; at least 2 × 2 are needed")

    @property
    def meshes(self) -> int:
        """Meshes along a unit's side."""
        return min(MESHES, max(self.surface.grid.size) - 1)

    @property
    def layout(self) -> UnitLayout:
        """Return where the units lie: the first post is the corner of the first unit."""
        columns, rows = (-(-(count - 1) // self.meshes) for count in self.surface.grid.size)
        return UnitLayout(*self.surface.origin, side=self.meshes * self.finest, columns=columns, rows=rows)

    @property
    def finest(self) -> float:
        """Distance of posts, metres."""
        return self.surface.mesh[0]

    @cached_property
    def ranges(self) -> NDArray[np.float64]:
        """Bounds of the heights of every unit, shape (rows, columns, 2); NaN for empty units."""
        layout = self.layout
        column, row = np.meshgrid(np.arange(layout.columns), np.arange(layout.rows))
        left, top = layout.left + column * layout.side, layout.top - row * layout.side
        return self.surface.height_range(np.stack([left, top - layout.side, left + layout.side, top], axis=-1))

    def unit(self, column: int, row: int) -> Unit | None:
        """The unit, or None if it is empty."""
        layout = self.layout
        left, top = layout.corner(column, row)
        k = np.arange(self.meshes + 1)
        x, y = np.meshgrid(left + k * self.finest, top - k * self.finest)
        Z = self.surface.heights(np.stack([x, y], axis=-1))
        if not np.isfinite(Z).any():
            return None
        datum = float(np.rint(np.nanmean(Z)))
        heights = (Z - datum).astype(np.float32)
        return Unit(
            left=left,
            top=top,
            side=layout.side,
            heights=heights,
            sigmas=np.full(heights.shape, np.nan, np.float32),
            datum=datum,
        )


#: Vertices of clipped lines nearer than this, metres, are one.
SAME = 1e-6
#: A unit with more meshes along its side than this is meant otherwise.
MOST_MESHES = 4096

Index = tuple[int, int]
_BESIDE = {"north": (0, -1), "south": (0, 1), "west": (-1, 0), "east": (1, 0)}
_OPPOSITE = {"north": "south", "south": "north", "west": "east", "east": "west"}
_EDGES: dict[str, Any] = {"north": (0, ...), "south": (-1, ...), "west": (..., 0), "east": (..., -1)}
#: Posts this close to the straight edge of a neighbour, metres, lie on it: heights are held in single precision.
_ON_EDGE = 1e-4


@dataclass(frozen=True, eq=False)
class LinedUnits:
    """A hybrid model with its lines: what its triangles are built from."""

    units: UnitSource
    lines: Sequence[LineElement] = ()
    domain: Any = None
    """Shapely polygon or multipolygon outside which there are no triangles; None: everywhere."""


def refine_units(
    coarse: LinedUnits, fine: LinedUnits, polygons: Any, transition: float, width: float
) -> tuple[dict[Index, Unit], tuple[LineElement, ...]]:
    """The units of a coarse model that a finer one changes.

    Units that the polygons touch get posts of the `RefinedSurface` on a finer grid: their meshes are divided by the
    smallest whole number that makes them no wider than `width`. Posts of meshes that lie partly outside keep the
    coarse heights, so that nothing changes outside. Inside the polygons the lines of the fine model count, their
    heights blended like the surface; outside those of the coarse one. Units around get new triangles only where the
    finer posts that adjoin do not lie on their edge.
    """
    layout = coarse.units.layout
    if not (width > 0 and layout.side / width <= MOST_MESHES):
        raise InputError(
            f"grid width {width} m in units of {layout.side} m; between {layout.side / MOST_MESHES} m and the side "
            "of a unit is needed"
        )
    blend = _Blend(HybridSurface(coarse.units), HybridSurface(fine.units), polygons, transition)
    inner = _touched(layout, polygons)
    around = _around(layout, inner)
    old = {at: unit for at in sorted(around) if (unit := coarse.units.unit(*at)) is not None}
    plain = {at: dataclasses.replace(unit, faces=None) for at, unit in old.items()}
    for at in inner:
        unit = blend.unit(layout, at, plain.get(at), width)
        if unit is not None:
            plain[at] = unit
    changed = {at for at in _around(layout, inner, 1) if at in inner or (at in plain and _bent(at, plain))}
    lines = _lines(coarse, fine, blend, plain, changed)
    domain = _domain(coarse.domain, fine.domain, polygons)
    return {at: _with_faces(at, plain, layout, lines, domain) for at in sorted(changed & plain.keys())}, lines


def clip_line(line: LineElement, polygons: Any, inside: bool) -> list[LineElement]:
    """The parts of a line inside polygons, or outside; where it is cut, everything is linear between its vertices."""
    path = shapely.LineString(line.xyz[:, :2])
    cuts = shapely.get_coordinates(path.intersection(polygons.boundary))
    steps = np.hypot(*np.diff(line.xyz[:, :2], axis=0).T)
    along = np.append(0.0, np.cumsum(steps))
    new = np.unique(shapely.line_locate_point(path, shapely.points(cuts))) if len(cuts) else np.empty(0)
    if len(new):
        after = np.clip(np.searchsorted(along, new), 1, len(along) - 1)
        far = (np.abs(new - along[after]) > SAME) & (np.abs(new - along[after - 1]) > SAME)
        new = new[far & (np.diff(new, prepend=-np.inf) > SAME)]
    columns = [line.xyz, line.sigmas[:, None], line.on_grid[:, None]]
    columns += [] if line.right is None else [line.right[:, None]]
    table = np.concatenate(columns, axis=1)
    inserted = np.stack([np.interp(new, along, column) for column in table.T], axis=1)
    inserted[:, 4] = 0
    order = np.argsort(np.concatenate([along, new]), kind="stable")
    table = np.concatenate([table, inserted])[order]
    middle = (table[1:, :2] + table[:-1, :2]) / 2
    keep = shapely.intersects_xy(polygons, middle) == inside
    ends = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(int)))
    return [_element(line, table[a : b + 1]) for a, b in zip(ends[::2], ends[1::2])]


def _element(line: LineElement, table: NDArray[np.float64]) -> LineElement:
    right = None if line.right is None else np.ascontiguousarray(table[:, 5])
    return dataclasses.replace(
        line, xyz=table[:, :3].copy(), right=right, sigmas=table[:, 3].copy(), on_grid=table[:, 4] > 0
    )


@dataclass(frozen=True, eq=False)
class _Blend:
    """Both surfaces and how they are joined."""

    coarse: HybridSurface
    fine: HybridSurface
    polygons: Any
    transition: float

    @property
    def surface(self) -> RefinedSurface:
        return RefinedSurface(self.coarse, self.fine, self.polygons, self.transition)

    def unit(self, layout: UnitLayout, at: Index, old: Unit | None, width: float) -> Unit | None:
        """A unit with posts of the joined surface; None if there are none."""
        left, top = layout.corner(*at)
        meshes = old.meshes if old is not None else 1
        meshes *= int(np.ceil(layout.side / meshes / width * (1 - 1e-9)))
        step = np.arange(meshes + 1) * (layout.side / meshes)
        XY = np.stack(np.meshgrid(left + step, top - step), axis=-1)
        kept = ~self._amid(left, top, layout.side, meshes)
        heights = np.where(kept, self.coarse.heights(XY), self.surface.heights(XY))
        if not np.isfinite(heights).any():
            return None
        datum = old.datum if old is not None else float(np.rint(np.nanmean(heights)))
        sigmas = np.where(kept, self.coarse.sigmas(XY), self.sigmas(XY))
        sigmas = np.where(np.isfinite(heights), sigmas, np.nan)
        return Unit(
            left=left,
            top=top,
            side=layout.side,
            heights=(heights - datum).astype(np.float32),
            sigmas=sigmas.astype(np.float32),
            datum=datum,
            faces=None,
        )

    def _amid(self, left: float, top: float, side: float, meshes: int) -> NDArray[np.bool_]:
        """Posts of a unit, shape (meshes + 1, meshes + 1), around which all meshes lie inside the polygons."""
        width = side / meshes
        k = np.arange(-1, meshes + 1)
        x, y = np.meshgrid(left + k * width, top - k * width)
        inset = 1e-9 * side
        inside = shapely.covers(self.polygons, shapely.box(x + inset, y - width + inset, x + width - inset, y - inset))
        return np.asarray(inside[1:, 1:] & inside[1:, :-1] & inside[:-1, 1:] & inside[:-1, :-1])

    def sigmas(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of the joined surface: the two models err independently of each other.

        It is unknown where one is that counts.
        """
        weights = np.nan_to_num(self.surface.weights(XY), nan=0.0)
        lost = np.isnan(self.fine.heights(XY)), np.isnan(self.coarse.heights(XY))
        weights = np.where(lost[0], 0.0, np.where(lost[1], weights > 0, weights))
        parts = [
            np.where(share > 0, share * surface.sigmas(XY), 0.0)
            for share, surface in ((1 - weights, self.coarse), (weights, self.fine))
        ]
        return np.asarray(np.hypot(*parts))

    def line(self, line: LineElement) -> LineElement:
        """A line of the fine model with blended heights."""
        XY = line.xyz[:, :2]
        weights = np.nan_to_num(self.surface.weights(XY), nan=0.0)
        coarse, sigma = self.coarse.heights(XY), self.coarse.sigmas(XY)
        weights = np.where(np.isnan(coarse), 1.0, weights)
        coarse, sigma = np.nan_to_num(coarse), np.nan_to_num(sigma)

        def blended(Z: NDArray[np.float64]) -> NDArray[np.float64]:
            return coarse + weights * (Z - coarse)

        return dataclasses.replace(
            line,
            xyz=np.column_stack([XY, blended(line.xyz[:, 2])]),
            right=None if line.right is None else blended(line.right),
            sigmas=np.hypot((1 - weights) * sigma, weights * line.sigmas),
        )


def _bent(at: Index, units: dict[Index, Unit]) -> bool:
    """Return whether finer posts of a neighbour do not lie on the edge of a unit, which then needs triangles there."""
    unit = units[at]
    for side, (dc, dr) in _BESIDE.items():
        other = units.get((at[0] + dc, at[1] + dr))
        if other is None or unit.meshes % other.meshes == 0:
            continue
        own, theirs = _EDGES[side], _EDGES[_OPPOSITE[side]]
        Z = unit.heights[own] + np.float64(unit.datum)
        beside = other.heights[theirs] + np.float64(other.datum)
        between = np.interp(np.linspace(0, 1, len(beside)), np.linspace(0, 1, len(Z)), Z)
        known = np.isfinite(between) & np.isfinite(beside)
        if (np.isfinite(between) != np.isfinite(beside)).any() or (np.abs(between - beside)[known] > _ON_EDGE).any():
            return True
    return False


def _touched(layout: UnitLayout, polygons: Any) -> set[Index]:
    """Units that share an area with the polygons."""
    xmin, ymin, xmax, ymax = polygons.bounds
    columns = _span(xmin - layout.left, xmax - layout.left, layout.side, layout.columns)
    rows = _span(layout.top - ymax, layout.top - ymin, layout.side, layout.rows)
    shapely.prepare(polygons)
    found = set()
    for column in columns:
        for row in rows:
            left, top = layout.corner(column, row)
            inset = layout.side * 1e-9
            box = shapely.box(left + inset, top - layout.side + inset, left + layout.side - inset, top - inset)
            if polygons.intersects(box):
                found.add((column, row))
    return found


def _span(first: float, last: float, side: float, count: int) -> range:
    return range(max(0, int(np.floor(first / side))), min(count - 1, int(np.floor(last / side))) + 1)


def _around(layout: UnitLayout, units: Iterable[Index], reach: int = 2) -> set[Index]:
    """Units, and those around them up to `reach` away."""
    steps = range(-reach, reach + 1)
    return {
        (c + dc, r + dr)
        for c, r in units
        for dc in steps
        for dr in steps
        if 0 <= c + dc < layout.columns and 0 <= r + dr < layout.rows
    }


def _lines(
    coarse: LinedUnits, fine: LinedUnits, blend: _Blend, plain: dict[Index, Unit], changed: set[Index]
) -> tuple[LineElement, ...]:
    """All lines of the refined model, with the intersections of the new grids."""
    layout = coarse.units.layout
    meshes = np.zeros((layout.rows, layout.columns), np.int64)
    for (column, row), unit in plain.items():
        meshes[row, column] = unit.meshes
    corners = [layout.corner(*at) for at in changed]
    zone = shapely.union_all([shapely.box(x, y - layout.side, x + layout.side, y) for x, y in corners])
    lines: list[LineElement] = []
    for line in coarse.lines:
        path = shapely.LineString(line.xyz[:, :2])
        if not path.intersects(zone):
            lines.append(line)
            continue
        lines += [on_grid(part, layout, meshes) for part in clip_line(line, blend.polygons, inside=False)]
    for line in fine.lines:
        parts = clip_line(line, blend.polygons, inside=True)
        lines += [blend.line(on_grid(part, layout, meshes)) for part in parts]
    return tuple(lines)


def _domain(coarse: Any, fine: Any, polygons: Any) -> Any:
    """Inside the polygons the fine model's domain, outside the coarse one's; None: everywhere."""
    if coarse is None and fine is None:
        return None
    everywhere = shapely.box(*(np.array(polygons.buffer(1e7).bounds)))
    outer = (everywhere if coarse is None else coarse).difference(polygons)
    inner = polygons if fine is None else polygons.intersection(fine)
    return outer.union(inner)


def _with_faces(
    at: Index, plain: dict[Index, Unit], layout: UnitLayout, lines: Sequence[LineElement], domain: Any
) -> Unit:
    unit = plain[at]
    near = layout.side * 1e-6
    low = np.array([unit.left - near, unit.top - unit.side - near])
    high = np.array([unit.left + unit.side + near, unit.top + near])
    here = [
        line
        for line in lines
        if (line.xyz[:, :2].max(axis=0) >= low).all() and (line.xyz[:, :2].min(axis=0) <= high).all()
    ]
    beside = {
        side: plain[at[0] + dc, at[1] + dr] for side, (dc, dr) in _BESIDE.items() if (at[0] + dc, at[1] + dr) in plain
    }
    return dataclasses.replace(unit, faces=build_faces(unit, here, beside, domain))


@dataclass(frozen=True, eq=False)
class RefinedSurface:
    """The coarse surface, and inside the polygons the fine one.

    In a band inside the border the difference of the two is blended in: Z = coarse + s(d / transition) · (fine −
    coarse) with the distance d to the border and the smooth step s(t) = t² (3 − 2 t). Heights therefore lie between
    those of the two surfaces, without the waves that arise where a fine grid is fitted to a coarse one across an
    undefined border; on the border the coarse surface is met, and its slope where both agree on theirs.

    Where only one of the surfaces exists inside the polygons, that one counts.
    """

    coarse: Terrain
    fine: Terrain
    polygons: Any
    """Shapely polygon or multipolygon, X and Y of the surfaces."""
    transition: float
    """Width of the band inside the border, metres; 0: the fine surface begins at the border with a step."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.transition) and self.transition >= 0):
            raise InputError(f"transition of {self.transition}; a width in metres, zero or more, is needed")
        if self.polygons.geom_type not in ("Polygon", "MultiPolygon") or self.polygons.is_empty:
            raise InputError(f"refinement inside a {self.polygons.geom_type}; polygons with an area are needed")
        if not self.polygons.is_valid:
            raise InputError(f"polygons of the refinement: {shapely.is_valid_reason(self.polygons)}; repair them")

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Heights of the pixel centres of a window of a map target, shape (height, width), metres; NaN: no surface."""
        if not isinstance(target, MapTarget):
            raise UsageError(f"a refined surface gives relief for map targets, not for {type(target).__name__}")
        box = shapely.box(*target.grid.bounds_of(window))
        if not self.polygons.intersects(box):
            return self.coarse.relief(target, window)
        coarse, fine = self.coarse.relief(target, window), self.fine.relief(target, window)
        v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        weights = self.weights(target.grid.to_map(np.stack([u, v], axis=-1)))
        return _blended(coarse, fine, weights).astype(np.float32)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Height at map points (..., 2), shape (...), metres; NaN where there is no surface."""
        XY = np.asarray(XY, float)
        return _blended(self.coarse.heights(XY), self.fine.heights(XY), self.weights(XY))

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Bounds of both surfaces inside map bounds (..., 4), shape (..., 2), metres; NaN, NaN where there is none."""
        a, b = self.coarse.height_range(bounds), self.fine.height_range(bounds)
        return np.stack([np.fmin(a[..., 0], b[..., 0]), np.fmax(a[..., 1], b[..., 1])], axis=-1)

    def weights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Weight of the fine surface at map points (..., 2), shape (...): 0 outside, 1 inside the band.

        NaN outside the polygons, where the fine surface does not count at all.
        """
        XY = np.asarray(XY, float)
        flat = XY.reshape(-1, 2)
        weights = np.full(len(flat), np.nan)
        there = np.isfinite(flat).all(axis=1)
        if there.any():
            weights[there] = self._weights(flat[there])
        return weights.reshape(XY.shape[:-1])

    def _weights(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = XY.min(axis=0), XY.max(axis=0)
        margin = self.transition + 1e-3 + 1e-9 * float(np.abs(XY).max())
        near = shapely.clip_by_rect(self.polygons, *(low - margin), *(high + margin))
        border = shapely.clip_by_rect(self.polygons.boundary, *(low - margin), *(high + margin))
        shapely.prepare(near)
        inside = shapely.intersects_xy(near, XY)
        weights = np.where(inside, 1.0, np.nan)
        if self.transition > 0 and not border.is_empty:
            t = np.minimum(shapely.distance(border, shapely.points(XY[inside])) / self.transition, 1.0)
            weights[inside] = t * t * (3 - 2 * t)
        return weights


def _blended(coarse: NDArray[Any], fine: NDArray[Any], weights: NDArray[np.float64]) -> NDArray[Any]:
    """The sum of both with the weights; one where the other is missing, and coarse where the weight is NaN."""
    both = coarse + weights * (fine - coarse)
    inside = np.isfinite(weights)
    inner = np.where(np.isnan(fine), coarse, np.where(np.isnan(coarse), fine, both))
    return np.asarray(np.where(inside, inner, coarse))


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
