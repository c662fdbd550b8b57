"""Layers of vector files, for all readers of features: GeoPackage, Shapefile and GeoJSON by GDAL, DXF by `drawing`.

This is the one place that reads layers through pyogrio: whatever a file holds, a layer has geometries and columns of
the stated types, or the file is refused by name.
"""

from __future__ import annotations

import json
import sqlite3
import warnings
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyogrio.raw
import shapely
from numpy.typing import NDArray
from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError

from photoplan.errors import InputError
from photoplan.geometry.crs import split_compound
from photoplan.io.drawing import drawing_metres, read_drawing

VECTOR_ERRORS = (
    DataLayerError,
    DataSourceError,
    FeatureError,
    FieldError,
    GeometryError,
    shapely.errors.ShapelyError,
    ValueError,
    RuntimeError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
)
"""What pyogrio and shapely raise for files that they cannot read."""
ENTITIES = "entities"
"""The one layer of a drawing."""
MAGIC = {b"SQLite format 3\0": "GeoPackage", b"\x00\x00\x27\x0a": "Shapefile", b"fgb": "FlatGeobuf"}
"""How binary vector files begin."""


@dataclass(frozen=True, eq=False)
class FeatureLayer:
    """One layer, feature by feature."""

    shapes: NDArray[Any]
    """Geometries, shape (n,); None where a feature has none."""
    fields: dict[str, NDArray[Any]]
    """Attributes by name, as the file spells it."""
    crs: str | None
    """As GDAL reports it: geographic for a GeoJSON that says nothing, see `states_crs`."""
    unit: float | None = None
    """Metres in the unit that a drawing states for all its coordinates; None: none is stated."""
    notes: tuple[str, ...] = ()
    """What was left out or repaired."""


def read_layer(path: Path, name: str | None = None) -> FeatureLayer:
    """All features of a layer, the first one with geometry if none is named."""
    if name == ENTITIES:
        drawn = read_drawing(path)
        own = {"Layer": drawn.layers, "EntityHandle": drawn.handles, "Text": drawn.texts}
        fields = {**drawn.attributes, **own}
        return FeatureLayer(
            shapes=drawn.shapes, fields=fields, crs=None, unit=drawing_metres(path, drawn.unit), notes=drawn.notes
        )
    if name is None:
        names = layers_of(path)
        if not names:
            raise InputError(f"{path}: holds no layer with geometry; give a file with points, lines or polygons")
        name = names[0]
    _refuse_view(path, name)
    meta, wkb, values = _read(path, name, read_geometry=True)
    if wkb is None:
        raise InputError(f"{path}: layer {name} has no geometry; its layers with geometry are "
                         f"{', '.join(layers_of(path))[:300] or 'none'}")  # fmt: skip
    try:
        shapes = np.atleast_1d(shapely.from_wkb(wkb))
        finite = np.isfinite(shapely.get_coordinates(shapes)).all()
    except VECTOR_ERRORS as error:
        raise InputError(f"{path}: layer {name}: damaged geometry ({_one_line(error)})") from None
    if not finite:
        raise InputError(f"{path}: layer {name}: a coordinate is not a finite number; repair or remove the feature")
    crs = meta["crs"]
    if crs is not None and split_compound(crs, f"{path}: CRS")[0] is None:
        crs = None
    return FeatureLayer(shapes, dict(zip((str(field) for field in meta["fields"]), values)), crs)


def read_columns(
    path: Path, name: str, kinds: dict[str, Literal["text", "integer", "number"]]
) -> dict[str, NDArray[Any]]:
    """Columns of a layer, each with a value of its kind in every row."""
    meta, _, values = _read(path, name, read_geometry=False)
    found = dict(zip((str(field) for field in meta["fields"]), values))
    columns: dict[str, NDArray[Any]] = {}
    for column, kind in kinds.items():
        if column not in found:
            raise InputError(f"{path}: layer {name}: no column {column}; its columns are {', '.join(found)[:200]}")
        column_values = found[column]
        if kind == "text":
            bad = np.array([not isinstance(value, str) for value in column_values], bool)
        elif column_values.dtype.kind in "iuf":
            bad = ~np.isfinite(column_values)
            if kind == "integer" and not bad.any():
                bad = (column_values != np.round(column_values)) | (np.abs(column_values) > 2**62)
                column_values = column_values.astype(np.int64)
        else:
            bad = np.ones(len(column_values), bool)
        if bad.any():
            at = int(np.flatnonzero(bad)[0])
            raise InputError(
                f"{path}: layer {name}, row {at + 1}: {column} is {str(found[column][at])[:40]!r}; it must be "
                f"{'an' if kind == 'integer' else 'a'} {kind}"
            )
        columns[column] = column_values
    return columns


def _read(path: Path, name: str, read_geometry: bool) -> tuple[dict[str, Any], Any, list[NDArray[Any]]]:
    """Description, geometries and columns of a layer."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            meta, _, wkb, values = pyogrio.raw.read(
                str(path.resolve()), layer=name, force_2d=False, read_geometry=read_geometry
            )
    except VECTOR_ERRORS as error:
        raise InputError(f"{path}: layer {name}: cannot be read ({_one_line(error)}); get a fresh copy") from None
    return meta, wkb, list(values)


def read_chosen(path: Path, layer: str | None) -> tuple[str, FeatureLayer]:
    """The layer that is named or the only one, and its name; all entities of a drawing."""
    name = ENTITIES if is_drawing(path) else only_layer(path, layer)
    return name, read_layer(path, name)


def layers_of(path: Path) -> list[str]:
    """Names of the layers with geometry."""
    try:
        return [str(name) for name, kind in pyogrio.list_layers(str(path)) if kind is not None]
    except VECTOR_ERRORS as error:
        raise InputError(f"{path}: cannot be read ({_one_line(error)}); get a fresh copy") from None


def only_layer(path: Path, layer: str | None) -> str:
    """The layer that is named, or the only one."""
    names = layers_of(path)
    if layer is None and len(names) == 1:
        layer = names[0]
    if layer not in names:
        told = "state one as layer" if layer is None else f"there is no {layer!r}"
        raise InputError(f"{path}: its layers are {', '.join(names)[:300] or 'none'}; {told}")
    _refuse_view(path, layer)
    return layer


def _refuse_view(path: Path, layer: str) -> None:
    if layer.casefold() in views_of(path):
        raise InputError(f"{path}: layer {layer!r} is a view (a query, which may have no end); store it as a table")


def views_of(path: Path) -> set[str]:
    """Names of the views of a GeoPackage in small letters; nothing for other formats."""
    with path.open("rb") as file:
        if file.read(6) != b"SQLite":
            return set()
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db:
            rows = db.execute("SELECT name FROM sqlite_master WHERE type = 'view'")
            return {str(name).casefold() for (name,) in rows}
    except sqlite3.Error as error:
        raise InputError(f"{path}: cannot be read ({error}); get a fresh copy") from None


def states_crs(path: Path) -> bool:
    """Whether a file states its CRS; GDAL takes geographic coordinates for a GeoJSON that says nothing."""
    with path.open("rb") as file:
        head = file.read(22)
    if head.startswith(tuple(MAGIC)):
        return True
    try:
        return "crs" in json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, OSError, RecursionError):
        return False


def is_drawing(path: Path) -> bool:
    """Whether it is a DXF."""
    with path.open("rb") as file:
        head = file.read(22)
    return head.startswith(b"AutoCAD Binary DXF") or not head.startswith((*MAGIC, b"{", b"\xef"))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
