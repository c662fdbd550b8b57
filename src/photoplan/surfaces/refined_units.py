"""Units from rasters and refined units."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.surfaces.base import (
    Terrain,
)
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.mesh import build_faces, on_grid
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.units import LineElement, Unit, UnitLayout, UnitSource
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
