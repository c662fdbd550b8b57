"""Constrained Delaunay triangulation: a thin adapter, so that no other module knows the library."""

from __future__ import annotations

import numpy as np
import pythoncdt
from numpy.typing import NDArray

from photoplan.errors import GeometryError


def constrained_faces(xy: NDArray[np.float64], edges: NDArray[np.int64]) -> NDArray[np.int32]:
    """Triangles over all points (their convex hull is filled) that hold every edge.

    Parameters
    ----------
    xy : ndarray, shape (n, 2)
        Points; finite, no two equal.
    edges : ndarray, shape (m, 2)
        Point numbers of the edges that must be kept; they may meet in points, but not cross.

    Returns
    -------
    ndarray, shape (k, 3), int32
        Point numbers of each triangle, counter-clockwise; empty for fewer than three points or points on one line.

    Raises
    ------
    GeometryError
        A point is not finite, two are equal, an edge has one point twice, or two edges cross.
    """
    xy = np.ascontiguousarray(xy, np.float64)
    edges = np.ascontiguousarray(edges, np.int64).reshape(-1, 2)
    if not np.isfinite(xy).all():
        raise GeometryError("triangulation: a point is not finite")
    if len(np.unique(xy, axis=0)) != len(xy):
        raise GeometryError("triangulation: two points at one place; join them first")
    if len(edges) and (edges[:, 0] == edges[:, 1]).any():
        raise GeometryError("triangulation: an edge begins and ends in one point")
    if len(xy) < 3 or np.linalg.matrix_rank(xy[1:] - xy[0]) < 2:
        return np.empty((0, 3), np.int32)
    # Near the origin the numbers keep their digits: map coordinates would cost seven of sixteen.
    local = xy - xy.mean(axis=0)
    mesh = pythoncdt.Triangulation(
        pythoncdt.VertexInsertionOrder.AUTO, pythoncdt.IntersectingConstraintEdges.NOT_ALLOWED, 0.0
    )
    try:
        mesh.insert_vertices(local)
        if len(edges):
            mesh.insert_edges(edges.astype(np.uint32))  # type: ignore[call-overload]  # arrays are buffers
        mesh.erase_super_triangle()
    except (RuntimeError, ValueError) as error:
        raise GeometryError(f"triangulation: {error}; lines may meet in common points, but not cross") from error
    faces = mesh.triangles_array()
    return np.ascontiguousarray(faces["vertices"], np.int32)
