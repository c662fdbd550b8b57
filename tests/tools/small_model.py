"""Small terrain models, made in a moment: what tests of model files and of commands on them start from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.io.terrain.model import GrossError, ModelHeader, ModelReader, empty_figures
from photoplan.io.terrain.model_write import ModelParts, ModelWriter
from photoplan.surfaces.mesh import build_faces
from photoplan.surfaces.units import LineElement, Unit, UnitFigures, UnitLayout

CRS = "EPSG:32633"
LAYOUT = UnitLayout(500_000.0, 5_300_000.0, 40.0, 4, 3)
EMPTY = (3, 1)
"""The unit that has no surface."""
LINED = (1, 1)
"""The unit with a wall along its main diagonal."""
WALL = 2.0
"""What the wall's right side is lower, metres."""


def hills(X: NDArray[np.float64], Y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights of the models, metres; float32 above the datum keeps them to a micrometre."""
    return 150 + 6 * np.sin((X - 500_000) / 25) * np.cos((Y - 5_300_000) / 35)


def grid_unit(
    layout: UnitLayout, column: int, row: int, meshes: int, height: Callable[..., Any] = hills, datum: float = 150.0
) -> Unit:
    """A unit with posts alone."""
    left, top = layout.corner(column, row)
    along = np.arange(meshes + 1) * layout.side / meshes
    X, Y = np.meshgrid(left + along, top - along)
    heights = (height(X, Y) - datum).astype(np.float32)
    sigmas = np.full(heights.shape, 0.05, np.float32)
    return Unit(left, top, layout.side, heights, sigmas, datum)


def wall_unit(layout: UnitLayout, column: int, row: int, meshes: int) -> Unit:
    """A unit whose main diagonal is a wall: at it, the surface south-west is lower by `WALL`."""
    unit = grid_unit(layout, column, row, meshes)
    return replace(unit, faces=build_faces(unit, [diagonal(layout, column, row, meshes)]))


def diagonal(layout: UnitLayout, column: int, row: int, meshes: int) -> LineElement:
    """The wall along a unit's main diagonal: left of it, in its direction to the south-east, is high."""
    left, top = layout.corner(column, row)
    along = np.arange(meshes + 1) * layout.side / meshes
    z = hills(left + along, top - along)
    xyz, count = np.column_stack([left + along, top - along, z]), meshes + 1
    return LineElement("wall Ä 7", "breakline", "W1", xyz, z - WALL, np.full(count, 0.02), np.ones(count, bool))


def unit_at(column: int, row: int, layout: UnitLayout = LAYOUT) -> Unit | None:
    """Units of the small model: adapted widths, one empty, one with a wall."""
    if (column, row) == EMPTY:
        return None
    if (column, row) == LINED:
        return wall_unit(layout, column, row, 8)
    return grid_unit(layout, column, row, 16 if column == 0 else 8)


def figures_of(unit: Unit | None, column: int, row: int) -> UnitFigures:
    """Invented figures, each unit its own."""
    if unit is None or np.isnan(unit.heights).all():
        return empty_figures(column, row)
    heights = unit.heights + unit.datum
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    spread = math.nan if column == 2 else 1.01
    return UnitFigures(column, row, unit.meshes, low, high, 10 * column + row, 1, 4.0, 12.5, 0.07, 0.05, spread, row)


def wall_line(layout: UnitLayout = LAYOUT) -> LineElement:
    """The wall of the unit `LINED`."""
    return diagonal(layout, *LINED, 8)


def lines(layout: UnitLayout = LAYOUT) -> list[LineElement]:
    """The wall, a form line, and a border without heights."""
    xmin, ymin, xmax, ymax = layout.bounds
    form = np.array([[xmin + 3, ymin + 3, 149.0], [xmin + 20, ymin + 9, 150.5], [xmin + 37, ymin + 20, 151.0]])
    ring = np.array([[xmin, ymin], [xmax, ymin], [xmax, ymax], [xmin, ymax], [xmin, ymin]])
    border = np.column_stack([ring, np.full(5, np.nan)])
    nothing = np.full(5, np.nan)
    return [
        wall_line(layout),
        LineElement("ridge", "formline", "", form, None, np.array([0.1, 0.2, 0.1]), np.array([False, True, False])),
        LineElement("edge", "border", "", border, None, nothing, np.zeros(5, bool)),
    ]


GROSS = (GrossError("p 17", "mass", (500_010.0, 5_299_990.0, 171.5), 21.25, 0.83, 14.5),)
SUSPECTS = (GrossError("p 18", "mass", (500_012.0, 5_299_990.0, 160.5), 10.25, 0.81, 7.5),)
HEADER = ModelHeader(
    CRS,
    "EPSG:5773",
    LAYOUT,
    settings={"filter": 0.1, "reach": math.nan},
    inputs=({"file": "points.xyz", "bytes": 12, "sha256_sampled": "ab"},),
    family="gaussian",
    totals={"points": 12},
)


def parts(layout: UnitLayout = LAYOUT) -> ModelParts:
    """All but the units."""
    domain = shapely.box(*layout.bounds)
    return ModelParts(replace(HEADER, layout=layout), lines(layout), GROSS, domain, SUSPECTS)


def write_small(path: Path, stop_after: int | None = None, key: str = "k", **options: Any) -> ModelReader | None:
    """Write the small model; with `stop_after` only so many units, and no end."""
    with ModelWriter(path, LAYOUT, key, **options) as writer:
        places = [(c, r) for r in range(LAYOUT.rows) for c in range(LAYOUT.columns)]
        for column, row in [place for place in places if place not in writer.done()][:stop_after]:
            unit = unit_at(column, row)
            writer.add(unit, figures_of(unit, column, row))
        return writer.finish(parts()) if stop_after is None else None


def write_units_of(
    path: Path, layout: UnitLayout, unit: Callable[[int, int], Unit | None], crs: str = CRS, **header: Any
) -> ModelReader:
    """A model of any units, without lines."""
    with ModelWriter(path, layout, "k") as writer:
        for row in range(layout.rows):
            for column in range(layout.columns):
                one = unit(column, row)
                writer.add(one, figures_of(one, column, row))
        return writer.finish(ModelParts(ModelHeader(crs, header.pop("height_system", None), layout, **header)))


def same_unit(a: Unit | None, b: Unit | None) -> bool:
    """Whether two units hold the same numbers, bit by bit."""
    if a is None or b is None:
        return a is b
    pairs = [(a.heights, b.heights), (a.sigmas, b.sigmas)]
    if (a.faces is None) != (b.faces is None):
        return False
    if a.faces is not None and b.faces is not None:
        names = ("vertices", "sigmas", "corners", "start")
        pairs += [(getattr(a.faces, name), getattr(b.faces, name)) for name in names]
    place = (a.left, a.top, a.side, a.datum) == (b.left, b.top, b.side, b.datum)
    return place and all(x.dtype == y.dtype and np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs)
