"""Polygons in space from GeoPackage, GeoJSON, Shapefile and DXF."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.objects.model import ObjectFile, from_polygons
from photoplan.io.polygons import _states_crs
from photoplan.io.terrain.options import ReadOptions
from photoplan.io.terrain.vector import _ERRORS, _check_drawing_units, _is_drawing, _views

_NAMES = ("name", "id", "nr", "label")
_ROLES = ("paint", "occluder")
_LINE, _POLYGON = 1, 3


def read(path: Path, layer: str | None) -> ObjectFile:
    """Polygons with heights, one object for each feature; `layer`: of one layer, in drawings of a drawing's layer.

    Closed lines of drawings are polygons. An attribute ``role`` says ``paint`` or ``occluder``, ``name`` what a feature
    is called.

    Raises
    ------
    InputError
        The file cannot be read, has several layers and none is stated, or its features are no polygons with heights;
        they are named.
    """
    drawing = _is_drawing(path)
    if drawing:
        _check_drawing_units(path, ReadOptions())
    name = "entities" if drawing else _layer(path, layer)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            more = {"INLINE_BLOCKS": "NO"} if drawing else {}
            meta, _, wkb, data = pyogrio.raw.read(str(path), layer=name, force_2d=False, **more)
            shapes = shapely.from_wkb(wkb)
    except _ERRORS as error:
        raise InputError(f"{path}: layer {name}: cannot be read ({' '.join(str(error).split())[:300]})") from None
    fields = {str(f).casefold(): values for f, values in zip(meta["fields"], data)}
    use = ~(shapely.is_missing(shapes) | shapely.is_empty(shapes))
    if drawing:
        use &= np.isin(shapely.get_type_id(shapes), (_LINE, _POLYGON, 6, 7))
        if layer is not None:
            on = fields["layer"].astype(str)
            use &= on == layer
            if not use.any():
                raise InputError(f"{path}: no faces on layer {layer!r}; it has {', '.join(sorted(set(on)))[:300]}")
    rows = np.flatnonzero(use)
    called = next((fields[key] for key in _NAMES if key in fields), None)
    names = [_name(name, called, row) for row in rows.tolist()]
    roles = [
        None if "role" not in fields else _role(path, n, fields["role"][row]) for n, row in zip(names, rows.tolist())
    ]
    polygons: list[list[NDArray[np.float64]]] = []
    objects: list[int] = []
    for k, row in enumerate(rows):
        for part in shapely.get_parts(shapely.get_parts(shapes[row])):
            rings = _rings(part, drawing)
            if rings is None:
                raise InputError(f"{path}: {names[k]!r} is a {part.geom_type}; polygons with heights are needed")
            polygons.append(rings)
            objects.append(k)
    crs = meta["crs"] if drawing or _states_crs(path, path.open("rb").read(16)) else None
    return from_polygons(str(path), polygons, objects, names, crs, roles)  # type: ignore[arg-type]


def _layer(path: Path, layer: str | None) -> str:
    try:
        names = [str(name) for name, kind in pyogrio.list_layers(str(path)) if kind is not None]
    except _ERRORS as error:
        raise InputError(f"{path}: cannot be opened ({' '.join(str(error).split())[:300]}); get a fresh copy") from None
    if layer is None and len(names) == 1:
        layer = names[0]
    if layer not in names:
        told = "state one as layer" if layer is None else f"there is no {layer!r}"
        raise InputError(f"{path}: its layers are {', '.join(names)[:300] or 'none'}; {told}")
    if layer.casefold() in _views(path):
        raise InputError(f"{path}: layer {layer!r} is a view (a query, which may have no end); store it as a table")
    return layer


def _name(layer: str, called: Any, row: int) -> str:
    text = "" if called is None or called[row] is None else str(called[row]).strip()
    return text or f"{layer} {row + 1}"


def _role(path: Path, name: str, value: Any) -> str | None:
    text = "" if value is None else str(value).strip().casefold()
    if text and text not in _ROLES:
        raise InputError(f"{path}: {name!r}: role {text[:40]!r}; allowed are {', '.join(_ROLES)}, or nothing")
    return text or None


def _rings(part: Any, drawing: bool) -> list[NDArray[np.float64]] | None:
    """Rings of a polygon or, in a drawing, of a closed line; None: it is neither."""
    if part.geom_type == "Polygon":
        lines = [part.exterior, *part.interiors]
    elif drawing and part.geom_type == "LineString" and part.is_closed:
        lines = [part]
    else:
        return None
    return [shapely.get_coordinates(line, include_z=True) for line in lines]
