"""Faces of polygons in space, and squares of a quadtree that show them on a map."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.surfaces.objects import Faces

Rings = Sequence[NDArray[np.float64]]


#: Polygons with less area than this, square metres, have no inside and are left out.
LEAST_AREA = 1e-6


#: A ring that comes back to itself within this is not yet one that crosses itself, metres: files round to millimetres.
ROUNDING = 2e-3


#: Coordinates on a map are smaller, metres.
_FARTHEST = 1e9


#: Polygons that are named in a message, each on a line of its own.
_NAMED = 100


def cannot_be_used(where: str, faults: Mapping[str, str]) -> InputError:
    """The error that names polygons one by one, each with what is wrong with it."""
    told = "".join(f"\n  {name!r} {fault}" for name, fault in list(faults.items())[:_NAMED])
    more = f"\n  and {len(faults) - _NAMED} more" if len(faults) > _NAMED else ""
    what = "1 polygon" if len(faults) == 1 else f"{len(faults)} polygons"
    return InputError(f"{where}: {what} cannot be used; repair or remove what is named:{told}{more}")


def filled(
    polygons: Sequence[Rings], names: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.int64], dict[str, str]]:
    """Triangles that fill polygons between their vertices, whose heights they have.

    Inside a plane polygon the height is that of the plane; inside another one that of a constrained Delaunay
    triangulation of its vertices, seen along its mean normal (Newell's), so that upright and overhanging polygons are
    as good as level ones.
    """
    flat: list[Any] = []
    bases: list[_Base | None] = []
    faults: dict[str, str] = {}
    for rings, name in zip(polygons, names, strict=True):
        base, plane, fault = _flattened(rings)
        if fault:
            faults[name] = fault
        flat.append(plane)
        bases.append(base)
    found = shapely.constrained_delaunay_triangles(np.array(flat, object))
    pieces, polygon = shapely.get_parts(found, return_index=True)
    uv = shapely.get_coordinates(pieces).reshape(-1, 4, 2)[:, :3]
    corners = np.empty((len(uv), 3, 3))
    starts = np.searchsorted(polygon, np.arange(len(flat) + 1))
    for base, first, last in zip(bases, starts[:-1], starts[1:]):
        if base is not None:
            corners[first:last] = base.in_space(uv[first:last])
    return corners, polygon.astype(np.int64), faults


@dataclass(frozen=True, eq=False)
class _Base:
    """Vertices of a polygon in space and in its mean plane."""

    xyz: NDArray[np.float64]
    uv: NDArray[np.float64]
    middle: NDArray[np.float64]
    axes: NDArray[np.float64]

    def in_space(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (..., 2) of the plane: those of vertices are where these are, all others stay in the plane."""
        place = {(u, v): k for k, (u, v) in enumerate(self.uv.tolist())}
        at = np.array([place.get((u, v), -1) for u, v in uv.reshape(-1, 2).tolist()], int).reshape(uv.shape[:-1])
        points = self.middle + uv @ self.axes
        return np.where(at[..., None] < 0, points, self.xyz[at])


def _flattened(rings: Rings) -> tuple[_Base | None, Any, str]:
    """Vertices of a polygon, the polygon in its mean plane, and what is wrong with it; none of them if it has no
    inside."""
    clean = [_opened(np.asarray(ring, float)) for ring in rings]
    if not all((np.abs(ring[:, :2]) < _FARTHEST).all() for ring in clean):
        return None, None, "has coordinates that lie nowhere on a map"
    if not all(np.isfinite(ring[:, 2]).all() for ring in clean):
        return None, None, "has vertices without a height"
    if not clean or len(clean[0]) < 3:
        return None, None, ""
    middle = clean[0].mean(axis=0)
    around = clean[0] - middle
    (x, y, z), (xn, yn, zn) = around.T, np.concatenate([around[1:], around[:1]]).T
    # Newell's normal: its length is twice the area.
    normal = float(y @ zn - z @ yn), float(z @ xn - x @ zn), float(x @ yn - y @ xn)
    size = math.hypot(*normal)
    if size < 2 * LEAST_AREA:
        spread = np.linalg.svd(around, compute_uv=False)
        return None, None, "crosses itself" if spread[0] * spread[1] > 1e-3 * len(around) else ""
    axes = _axes(normal[0] / size, normal[1] / size, normal[2] / size)
    clean = [clean[0], *(ring for ring in clean[1:] if len(ring) >= 3)]
    planes = [(ring - middle) @ axes.T for ring in clean]
    plane: Any = shapely.Polygon(planes[0], planes[1:])
    if not plane.is_valid:
        reason = shapely.is_valid_reason(plane).split("[")[0].strip()
        # What touches itself or goes back on its own way encloses what it seems to; what crosses itself does not.
        mended = shapely.make_valid(plane)
        if abs(mended.area - plane.area) > ROUNDING * plane.length:
            return None, None, f"crosses itself ({reason})"
        # A collection holds polygons of several parts beside lines.
        parts = shapely.get_parts(shapely.get_parts(mended))
        plane = shapely.MultiPolygon([part for part in parts if part.geom_type == "Polygon"])
    return _Base(np.concatenate(clean), np.concatenate(planes), middle, axes), plane, ""


def _opened(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """A ring without points that repeat the one before them."""
    same = (ring == np.roll(ring, 1, axis=0)).all(axis=1)
    return ring[~same] if same.any() else ring


def _axes(x: float, y: float, z: float) -> NDArray[np.float64]:
    """Two axes across a unit vector, (2, 3)."""
    if abs(z) > 0.5:
        length = math.hypot(x, z)
        u = z / length, 0.0, -x / length
    else:
        length = math.hypot(x, y)
        u = -y / length, x / length, 0.0
    return np.array([u, (y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0])])


#: More squares than this are not made of one polygon.
MOST_SQUARES = 4_000_000


#: Outlines are put together from triangles on a lattice of this width, metres.
_LATTICE = 1e-4


@dataclass(frozen=True, eq=False)
class Squares:
    """Squares of a polygon in the order of Behr's linear list: depth first; NW, NE, SW, SE."""

    corner: NDArray[np.float64]
    """Upper-left corners X, Y, shape (n, 2), metres."""
    side: NDArray[np.float64]
    """Shape (n,), metres."""
    level: NDArray[np.int64]
    """Number of divisions of a mesh, shape (n,)."""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Outer edges xmin, ymin, xmax, ymax, shape (n, 4)."""
        (x, y), side = self.corner.T, self.side
        return np.stack([x, y - side, x + side, y], axis=1)


def decompose(polygon: Any, corner: tuple[float, float], mesh: float, levels: int) -> Squares:
    """Squares that a polygon is made of.

    Meshes that lie inside stay as they are, those outside are dropped, all others are divided by four; the smallest
    belong to the polygon if their middles do.
    """
    xmin, ymin, xmax, ymax = polygon.bounds
    col = np.arange(np.floor((xmin - corner[0]) / mesh), np.ceil((xmax - corner[0]) / mesh))
    row = np.arange(np.floor((corner[1] - ymax) / mesh), np.ceil((corner[1] - ymin) / mesh))
    finest = mesh / 2**levels
    if polygon.length / finest + len(col) * len(row) > MOST_SQUARES / 4:
        raise UsageError(f"a polygon of {polygon.length:.6g} m in squares of {finest:g} m; choose larger ones")
    # Columns and rows are counted in squares of each level, from the first mesh.
    at = np.stack(np.meshgrid(col - col[0], row - row[0]), axis=-1).reshape(-1, 2).astype(np.int64)
    first = np.array([corner[0] + col[0] * mesh, corner[1] - row[0] * mesh])
    shapely.prepare(polygon)
    found = []
    for level in range(levels + 1):
        side = mesh / 2**level
        x, y = (first + at * (side, -side)).T
        boxes = shapely.box(x, y - side, x + side, y)
        inside = shapely.contains(polygon, boxes)
        divide = ~inside & shapely.intersects(polygon, boxes)
        if level == levels:
            inside |= divide & shapely.contains_xy(polygon, x + side / 2, y - side / 2)
        found.append((at[inside], np.full(int(inside.sum()), level)))
        at = (2 * at[divide][:, None] + np.array([[0, 0], [1, 0], [0, 1], [1, 1]])).reshape(-1, 2)
    places, level_of = (np.concatenate(part) for part in zip(*found))
    scale = 2 ** (levels - level_of)
    order = np.lexsort((_along(places * scale[:, None]),))
    places, level_of = places[order], level_of[order]
    side_of = mesh / 2.0**level_of
    return Squares(first + places * np.stack([side_of, -side_of], axis=1), side_of, level_of)


def _along(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Place of the finest squares along a depth-first way (the curve of Morton)."""
    code = np.zeros(len(places), np.int64)
    for bit in range(31):
        code |= ((places[:, 0] >> bit & 1) << (2 * bit)) | ((places[:, 1] >> bit & 1) << (2 * bit + 1))
    return code


def outlines(faces: Faces, bounds: tuple[float, float, float, float]) -> list[tuple[str, Faces, Any]]:
    """Objects inside bounds on the map: name, faces, and outline there."""
    flat = faces.corners[..., :2]
    (ax, ay), (bx, by) = (np.moveaxis(flat[:, k] - flat[:, 0], -1, 0) for k in (1, 2))
    level = np.abs(ax * by - ay * bx) > 2 * LEAST_AREA
    frame = shapely.box(*bounds)
    places: dict[str, list[int]] = {}
    for owner in np.unique(faces.owner).tolist():
        places.setdefault(faces.names[owner], []).append(owner)
    found = []
    for name, mine in places.items():
        use = np.isin(faces.owner, mine) & level
        own = faces.only(use)
        if own is not None:
            outline = shapely.union_all(shapely.polygons(flat[use]), grid_size=_LATTICE).intersection(frame)
            if outline.area > LEAST_AREA:
                found.append((name, own, outline))
    return found
