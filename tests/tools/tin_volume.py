"""Exact volume between two triangulated surfaces: the triangles are intersected, linear functions integrated."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from photoplan.surfaces.units import Tin

__all__ = ["exact_volume", "faces_near", "read_landxml_tin", "tin_heights", "tin_outline", "tin_posts"]


def read_landxml_tin(path: Path) -> Tin:
    """Visible triangles of the first surface of a LandXML file; its coordinates are in the order N, E, Z."""
    number: dict[str, int] = {}
    points, faces = [], []
    for _, element in ET.iterparse(path):
        tag = element.tag.rsplit("}", 1)[-1]
        if tag == "P" and element.get("id") is not None and element.text:
            north, east, height = (float(v) for v in element.text.split()[:3])
            number[element.get("id")] = len(points)
            points.append((east, north, height))
        elif tag == "F" and element.get("i") != "1" and element.text:
            faces.append([number[name] for name in element.text.split()[:3]])
        elif tag == "Surface":
            break
    return Tin(np.array(points), np.array(faces, np.int64))


def exact_volume(tin_a: Tin, tin_b: Tin, within: shapely.Geometry | None = None) -> tuple[float, float, float]:
    """Cut (a above b), fill (b above a) in m³ and the common area in m², exact but for rounding.

    Parameters
    ----------
    tin_a, tin_b : Tin
        Surfaces; each one's triangles do not overlap in plan.
    within : shapely polygon, optional
        Only this part.
    """
    origin = tin_a.xyz[:, :2].mean(axis=0)
    a, b = _triangles(tin_a, origin), _triangles(tin_b, origin)
    plans_a, plans_b = shapely.polygons(a[..., :2]), shapely.polygons(b[..., :2])
    pairs_a, pairs_b = shapely.STRtree(plans_b).query(plans_a, predicate="intersects")
    common = shapely.intersection(plans_a[pairs_a], plans_b[pairs_b])
    if within is not None:
        common = shapely.intersection(common, shapely.transform(within, lambda xy: xy - origin))
    slope = _planes(b)[pairs_b] - _planes(a)[pairs_a]
    keep = shapely.area(common) > 0
    common, slope = common[keep], slope[keep]
    if not hasattr(shapely, "constrained_delaunay_triangles"):
        pytest.skip("the exact reference needs shapely 2.1")
    parts, of = shapely.get_parts(common, return_index=True)
    pieces, of_part = shapely.get_parts(shapely.constrained_delaunay_triangles(parts), return_index=True)
    corners = shapely.get_coordinates(shapely.get_exterior_ring(pieces)).reshape(-1, 4, 2)[:, :3]
    plane = slope[of[of_part]]
    d = np.einsum("nij,nj->ni", np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=2), plane)
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    fill = positive_part(d, area)
    return float((fill - area * d.mean(axis=1)).sum()), float(fill.sum()), float(area.sum())


def positive_part(d: NDArray[np.float64], area: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integral of max(d, 0) over triangles with d linear, from its values (n, 3) at the corners."""
    low, mid, high = np.sort(d, axis=1).T
    with np.errstate(divide="ignore", invalid="ignore"):
        one_above = area * high**3 / (3 * (high - mid) * (high - low))
        one_below = area * (-low) ** 3 / (3 * (mid - low) * (high - low))
    full = area * d.mean(axis=1)
    some = np.where(mid > 0, full + one_below, one_above)
    return np.where(low >= 0, full, np.where(high <= 0, 0.0, some))


def tin_heights(tin: Tin, XY: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights of points (n, 2), linear in the triangle that holds them; NaN outside."""
    origin = tin.xyz[:, :2].mean(axis=0)
    corners = _triangles(tin, origin)
    local = np.asarray(XY, float) - origin
    point, face = shapely.STRtree(shapely.polygons(corners[..., :2])).query(
        shapely.points(local), predicate="intersects"
    )
    plane = _planes(corners)[face]
    out = np.full(len(local), np.nan)
    out[point] = (plane[:, :2] * local[point]).sum(axis=1) + plane[:, 2]
    return out


def tin_outline(tin: Tin) -> shapely.Geometry:
    """Area that the triangles cover, as a polygon or several."""
    origin = tin.xyz[:, :2].mean(axis=0)
    whole = shapely.union_all(shapely.polygons(_triangles(tin, origin)[..., :2]))
    return shapely.transform(whole, lambda xy: xy + origin)


def faces_near(tin: Tin, place: shapely.Geometry, distance: float) -> Tin:
    """The triangles within a distance of a place."""
    plans = shapely.polygons(tin.xyz[tin.faces][..., :2])
    shapely.prepare(wide := place.buffer(distance))
    return Tin(tin.xyz, tin.faces[shapely.intersects(wide, plans)])


def tin_posts(tin: Tin, left: float, top: float, mesh: float, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Heights at the posts of a grid (rows, columns), the upper-left one at left, top; NaN outside the triangles."""
    out = np.full(shape, np.nan)
    corners = _triangles(tin, np.array([left, top])) / (mesh, -mesh, 1.0)
    planes = _planes(corners)
    low = np.maximum(np.ceil(corners[..., :2].min(axis=1) - 1e-9), 0).astype(int)
    high = np.minimum(np.floor(corners[..., :2].max(axis=1) + 1e-9) + 1, shape[::-1]).astype(int)
    for i in np.flatnonzero((high > low).all(axis=1)):
        x, y = np.meshgrid(np.arange(low[i, 0], high[i, 0]), np.arange(low[i, 1], high[i, 1]))
        p = corners[i, :, :2]
        side = [(b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) for a, b in zip(p, np.roll(p, -1, axis=0))]
        inside = (np.min(side, axis=0) >= -1e-9) | (np.max(side, axis=0) <= 1e-9)
        part = out[low[i, 1] : high[i, 1], low[i, 0] : high[i, 0]]
        part[inside] = (planes[i, 0] * x + planes[i, 1] * y + planes[i, 2])[inside]
    return out


def _triangles(tin: Tin, origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners (m, 3, 3) near the origin; triangles without an area are left out."""
    corners = tin.xyz[tin.faces] - np.append(origin, 0.0)
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return corners[np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) > 1e-9]


def _planes(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """a, b, c of h = a x + b y + c, shape (m, 3)."""
    matrix = np.concatenate([corners[..., :2], np.ones((*corners.shape[:2], 1))], axis=2)
    return np.linalg.solve(matrix, corners[..., 2:])[..., 0]
