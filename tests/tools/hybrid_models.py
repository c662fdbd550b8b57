"""Hybrid models made up for tests: units of different grid widths, random lines that meet in common points only."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.mesh import build_faces, on_grid
from photoplan.surfaces.units import LineElement, MemoryUnits, Unit, UnitLayout

Height = Callable[[Any, Any], Any]


def rough(X: Any, Y: Any) -> Any:
    """Heights without any smoothness, but the same for the same place to a tenth of a millimetre."""
    X, Y = np.round(np.asarray(X) * 1e4) / 1e4, np.round(np.asarray(Y) * 1e4) / 1e4
    return 250.0 + np.mod(np.sin(X * 12.9898 + Y * 78.233) * 43.758, 1.0)


def line(xyz: Any, right: Any = None, kind: Any = "breakline", name: str = "line", sigma: float = 0.05) -> LineElement:
    xyz = np.asarray(xyz, float)
    right = None if right is None else np.asarray(right, float)
    return LineElement(name, kind, "", xyz, right, np.full(len(xyz), sigma), np.zeros(len(xyz), bool))


def plain_unit(layout: UnitLayout, column: int, row: int, meshes: int, height: Height, sigma: float = 0.2) -> Unit:
    left, top = layout.corner(column, row)
    along = np.arange(meshes + 1) * (layout.side / meshes)
    Z = height(*np.meshgrid(left + along, top - along)) - 250.0
    sigmas = np.where(np.isfinite(Z), sigma, np.nan).astype(np.float32)
    return Unit(left, top, layout.side, Z.astype(np.float32), sigmas, 250.0)


def with_faces(
    layout: UnitLayout, units: dict[tuple[int, int], Unit], lines: Sequence[LineElement], domain: Any = None
) -> tuple[MemoryUnits, list[LineElement]]:
    """Units with the triangles that lines and neighbours ask for, and the lines with their intersections."""
    meshes = np.zeros((layout.rows, layout.columns), np.int64)
    for (c, r), unit in units.items():
        meshes[r, c] = unit.meshes
    cut = [on_grid(each, layout, meshes) for each in lines]
    built = {}
    beside = {"north": (0, -1), "south": (0, 1), "west": (-1, 0), "east": (1, 0)}
    for (c, r), unit in units.items():
        near = {s: units[c + dc, r + dr] for s, (dc, dr) in beside.items() if (c + dc, r + dr) in units}
        built[c, r] = dataclasses.replace(unit, faces=build_faces(unit, cut, near, domain))
    return MemoryUnits(layout, built), cut


def model(
    layout: UnitLayout, meshes: Any, lines: Sequence[LineElement], height: Height = rough, domain: Any = None
) -> tuple[HybridSurface, list[LineElement]]:
    """A model in which every unit has posts of one height function; meshes is a number or one for each unit."""
    count = np.broadcast_to(meshes, (layout.rows, layout.columns))
    units = {
        (c, r): plain_unit(layout, c, r, int(count[r, c]), height)
        for r in range(layout.rows)
        for c in range(layout.columns)
    }
    source, cut = with_faces(layout, units, lines, domain)
    return HybridSurface(source), cut


def random_lines(
    rng: np.random.Generator, layout: UnitLayout, count: int, walls: bool, on_posts: NDArray[np.float64] | None = None
) -> list[LineElement]:
    """Random lines that meet in common vertices only; some touch posts, some leave the model."""
    xmin, ymin, xmax, ymax = layout.bounds
    taken: list[Any] = []
    lines: list[LineElement] = []
    ends: list[NDArray[np.float64]] = []
    while len(lines) < count:
        size = int(rng.integers(2, 5))
        margin = 0.2 * layout.side
        XY = rng.uniform([xmin - margin, ymin - margin], [xmax + margin, ymax + margin], (size, 2))
        XY[1:] = XY[0] + np.cumsum(rng.normal(0, 0.35 * layout.side, (size - 1, 2)), axis=0)
        if on_posts is not None and rng.random() < 0.3:
            XY[int(rng.integers(size))] = on_posts[int(rng.integers(len(on_posts)))]
        joined = None
        if ends and rng.random() < 0.3:
            joined = ends[int(rng.integers(len(ends)))]
            XY[0] = joined
        path = shapely.LineString(XY)
        if not path.is_simple or path.length == 0:
            continue
        clash = False
        for other in taken:
            if joined is not None and shapely.Point(joined).distance(other) == 0:
                clash |= not shapely.LineString(XY[1:]).disjoint(other) if size > 2 else False
                common = path.intersection(other)
                clash |= common.geom_type != "Point"
            else:
                clash |= path.distance(other) < 0.01 * layout.side
        if clash:
            continue
        Z = rng.uniform(250, 252, size)
        wall = walls and rng.random() < 0.6
        lines.append(line(np.column_stack([XY, Z]), Z - rng.uniform(0.5, 3, size) if wall else None))
        if joined is not None and not wall:
            at = next(e for e in lines if (e.xyz[:, :2] == joined).all(axis=1).any())
            Z[0] = at.xyz[(at.xyz[:, :2] == joined).all(axis=1), 2][0]
            lines[-1].xyz[0, 2] = Z[0]
        taken.append(path)
        ends.extend(XY[1:] if size == 2 else XY[1:-1])
    return lines
