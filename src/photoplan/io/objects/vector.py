"""Polygons in space from GeoPackage, GeoJSON, Shapefile and DXF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.objects.model import ObjectFile, from_polygons
from photoplan.io.vector_layer import is_drawing, read_chosen, states_crs

_NAMES = ("name", "id", "nr", "label")
_ROLES = ("paint", "occluder")
_LINE, _POLYGON = 1, 3


def read(path: Path, layer: str | None) -> ObjectFile:
    """Polygons with heights, one object for each feature; `layer`: of one layer, in drawings of a drawing's layer.

    Closed lines of drawings are polygons. An attribute ``role`` says ``paint`` or ``occluder``, ``name`` what a feature
    is called.
    """
    drawing = is_drawing(path)
    name, found = read_chosen(path, layer)
    shapes, fields = found.shapes, {field.casefold(): values for field, values in found.fields.items()}
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
    crs = found.crs if drawing or states_crs(path) else None
    return from_polygons(str(path), polygons, objects, names, crs, roles, found.unit)  # type: ignore[arg-type]


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
