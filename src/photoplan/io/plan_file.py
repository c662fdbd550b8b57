"""Plans as GeoPackages: tile footprints and image footprints to look at in any GIS, and what is needed to execute."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.io.disk import make_parents
from photoplan.io.files import json_object, open_database, plain_tables
from photoplan.io.gdal import FIXED_DATE
from photoplan.io.store import give_name, scratch
from photoplan.io.vector_layer import read_columns, write_vector

FORMAT = 2
_HEADER = "photoplan_plan"
#: What is read of the tiles again.
_READ: dict[str, Literal["text", "integer", "number"]] = {
    "product": "text",
    "tile": "integer",
    "sources": "text",
    "cells": "integer",
    "residual_px": "number",
}
#: Tiles that are written at once: as polygons they take much more memory than as numbers.
_PIECE = 100_000


@dataclass(frozen=True, eq=False)
class PlanTables:
    """A plan as plain tables."""

    header: dict[str, Any]
    """Settings, products, inputs with fingerprints: all that executing needs; JSON values only."""
    tiles: dict[str, NDArray[Any]]
    """Columns of the layer `tiles`: product, index, sources, cells, residual, col, row, width, height, source_*."""
    tile_bounds: NDArray[np.float64]
    """Outer edges of each tile, shape (n, 4), in the product's CRS."""
    footprints: dict[str, NDArray[Any]]
    """Columns of the layer `footprints`: image, product, columns, rows, resolution."""
    outlines: list[NDArray[np.float64]]
    """Footprint of each image, shape (k, 2), in the product's CRS."""
    crs: str
    """CRS of all layers."""
    squares: tuple[NDArray[np.float64], dict[str, NDArray[Any]]] | None = None
    """Outer edges (n, 4) and columns of the layer `quadtree`; None: there is none."""


def write_plan_tables(path: Path, plan: PlanTables, overwrite: bool = False) -> None:
    """Write a plan; it appears under its name only when complete."""
    if path.exists() and not overwrite:
        raise UsageError(f"{path} exists; give `overwrite` to replace it")
    make_parents(path.parent)
    with scratch(path.parent) as folder:
        partial = folder / path.name
        for layer, (bounds, table) in {
            "tiles": (plan.tile_bounds, plan.tiles),
            "quadtree": plan.squares or ((), {}),
        }.items():
            for start in range(0, len(bounds), _PIECE):
                some = slice(start, start + _PIECE)
                boxes, columns = shapely.box(*bounds[some].T), {k: v[some] for k, v in table.items()}
                _write_layer(partial, layer, boxes, columns, plan.crs, "Polygon", append=partial.exists())
        outlines = np.array([shapely.Polygon(o) for o in plan.outlines], object)
        _write_layer(partial, "footprints", outlines, plan.footprints, plan.crs, "Polygon", append=True)
        # A table of its own that GIS programs leave alone; GeoPackage is SQLite and allows it as an attribute table.
        with sqlite3.connect(partial) as db:
            db.execute(
                f"CREATE TABLE {_HEADER} (id INTEGER PRIMARY KEY, format INTEGER NOT NULL, content TEXT NOT NULL)"
            )
            db.execute(f"INSERT INTO {_HEADER} (format, content) VALUES (?, ?)", (FORMAT, json.dumps(plan.header)))
            db.execute(
                "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change) "
                "VALUES (?, 'attributes', ?, 'what photoplan needs to execute this plan', ?)",
                (_HEADER, _HEADER, FIXED_DATE),
            )
        db.close()
        give_name(partial, path)


def _write_layer(
    path: Path,
    layer: str,
    geometry: NDArray[Any],
    columns: dict[str, NDArray[Any]],
    crs: str,
    kind: str,
    append: bool = False,
) -> None:
    write_vector(
        path,
        geometry=shapely.to_wkb(geometry),
        field_data=list(columns.values()),
        fields=list(columns),
        layer=layer,
        driver="GPKG",
        geometry_type=kind,
        crs=crs,
        append=append,
    )


def read_plan_tables(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header of a plan, and some columns of its tiles: product, tile, sources, cells, residual_px."""
    if not path.is_file():
        raise InputError(f"{path}: no such plan")
    try:
        with closing(open_database(path)) as db:
            # A view under one of these names could compute without end.
            if not {_HEADER, "tiles"} <= plain_tables(db):
                raise sqlite3.DatabaseError(f"it has no tables {_HEADER} and tiles")
            row = db.execute(f"SELECT format, content FROM {_HEADER}").fetchone()
    except (sqlite3.Error, OverflowError, UnicodeError) as error:
        raise InputError(f"{path}: not a plan of photoplan ({error}); make one with `photoplan ortho`") from error
    if row is None or row[0] != FORMAT:
        raise InputError(
            f"{path}: plan format {row and row[0]!r:.40}; this version reads {FORMAT}: make the plan again"
        )
    try:
        return json_object(row[1], f"{path}: header"), read_columns(path, "tiles", _READ)
    except InputError as error:
        raise InputError(f"{error}; the plan is damaged, make it again with the command that wrote it") from None
