"""Layers of vector files (GeoPackage, Shapefile, GeoJSON, DXF) as GDAL reads them, for all that take features apart."""

from __future__ import annotations

import json
import re
import sqlite3
import warnings
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyogrio.raw
import shapely
from numpy.typing import NDArray
from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError

from photoplan.errors import InputError

VECTOR_ERRORS = (
    DataLayerError,
    DataSourceError,
    FeatureError,
    FieldError,
    GeometryError,
    shapely.errors.ShapelyError,
    ValueError,
    RuntimeError,
)
"""What pyogrio and shapely raise for files that they cannot read."""
ENTITIES = "entities"
"""The one layer that GDAL finds in a drawing."""
MAGIC = {b"SQLite format 3\0": "GeoPackage", b"\x00\x00\x27\x0a": "Shapefile", b"fgb": "FlatGeobuf"}
"""How binary vector files begin."""
_DRAWING_METRES = ("0", "6")
_UNITS = {"1": "inches", "2": "feet", "4": "millimetres", "5": "centimetres", "21": "US survey feet"}


@dataclass(frozen=True, eq=False)
class FeatureLayer:
    """One layer, feature by feature."""

    shapes: NDArray[Any]
    """Geometries, shape (n,); None where a feature has none."""
    fields: dict[str, NDArray[Any]]
    """Attributes by name, as the file spells it."""
    crs: str | None
    """As GDAL tells it: geographic for a GeoJSON that says nothing, see `states_crs`."""


def read_layer(path: Path, name: str | None = None) -> FeatureLayer:
    """All features of a layer, the first one if none is named.

    Blocks of drawings are not unfolded: nested ones grow without bound. Their insertion points are points.

    Raises
    ------
    InputError
        It cannot be read.
    """
    more = {"INLINE_BLOCKS": "NO"} if name == ENTITIES else {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            meta, _, wkb, values = pyogrio.raw.read(str(path.resolve()), layer=name, force_2d=False, **more)
            shapes = shapely.from_wkb(wkb)
    except VECTOR_ERRORS as error:
        where = "" if name is None else f" layer {name}:"
        raise InputError(f"{path}:{where} cannot be read ({_one_line(error)})") from None
    return FeatureLayer(shapes, dict(zip((str(field) for field in meta["fields"]), values)), meta["crs"])


def read_chosen(path: Path, layer: str | None) -> tuple[str, FeatureLayer]:
    """The layer that is named or the only one, and its name; of a drawing, which has to be in metres, all entities."""
    if is_drawing(path):
        check_drawing_units(path)
    name = ENTITIES if is_drawing(path) else only_layer(path, layer)
    return name, read_layer(path, name)


def layers_of(path: Path) -> list[str]:
    """Names of the layers with geometry.

    Raises
    ------
    InputError
        The file cannot be opened.
    """
    try:
        return [str(name) for name, kind in pyogrio.list_layers(str(path)) if kind is not None]
    except VECTOR_ERRORS as error:
        raise InputError(f"{path}: cannot be opened ({_one_line(error)}); get a fresh copy") from None


def only_layer(path: Path, layer: str | None) -> str:
    """The layer that is named, or the only one.

    Raises
    ------
    InputError
        There is none of this name, there are several and none is named, or it is a view.
    """
    names = layers_of(path)
    if layer is None and len(names) == 1:
        layer = names[0]
    if layer not in names:
        told = "state one as layer" if layer is None else f"there is no {layer!r}"
        raise InputError(f"{path}: its layers are {', '.join(names)[:300] or 'none'}; {told}")
    if layer.casefold() in views_of(path):
        raise InputError(f"{path}: layer {layer!r} is a view (a query, which may have no end); store it as a table")
    return layer


def views_of(path: Path) -> set[str]:
    """Names of the views of a GeoPackage in small letters; nothing for other formats.

    Raises
    ------
    InputError
        The database cannot be opened.
    """
    with path.open("rb") as file:
        if file.read(6) != b"SQLite":
            return set()
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db:
            rows = db.execute("SELECT name FROM sqlite_master WHERE type = 'view'")
            return {str(name).casefold() for (name,) in rows}
    except sqlite3.Error as error:
        raise InputError(f"{path}: cannot be opened ({error}); get a fresh copy") from None


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


def check_drawing_units(path: Path) -> None:
    """Refuse a drawing in units other than metres.

    Raises
    ------
    InputError
        The unit that it states is another one.
    """
    with path.open("rb") as file:
        head = file.read(1 << 16).decode("latin-1")
    found = re.search(r"\$INSUNITS\s+70\s+(\d+)", head)
    if found and found[1] not in _DRAWING_METRES:
        unit = _UNITS.get(found[1], f"number {found[1]}")
        raise InputError(
            f"{path}: the drawing says its unit is {unit} ($INSUNITS); metres are "
            "needed: convert it, or declare the CRS if the coordinates are its metres nevertheless"
        )


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
