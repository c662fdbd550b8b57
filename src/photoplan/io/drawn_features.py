"""Points and lines with their attributes, as they are drawn: GeoPackage, GeoJSON, Shapefile and DXF."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import split_compound
from photoplan.io.checks import check_plain_file
from photoplan.io.vector_layer import is_drawing, read_chosen, states_crs

_POINT, _POLYGON = 0, 3


@dataclass(frozen=True, eq=False)
class DrawnFeatures:
    """Features of one layer, taken apart into points and lines; of polygons the outlines."""

    path: Path
    XYZ: NDArray[np.float64]
    """Vertices of all in the units of the file, shape (n, 3); NaN height: none is stated."""
    part: NDArray[np.int64]
    """Number of the point or line of each vertex, ascending, shape (n,)."""
    is_point: NDArray[np.bool_]
    """Of each part."""
    row: NDArray[np.int64]
    """Feature of each part, from 0."""
    fields: dict[str, NDArray[Any]]
    """Attributes by name in small letters, one value for each feature."""
    crs: str | None
    """Of the map; None: the file does not state it."""
    height_system: str | None
    unit: float | None = None
    """Metres in the unit of a drawing; None: none is stated."""


def read_drawn_features(path: Path, layer: str | None) -> DrawnFeatures:
    """Features of a layer; `layer`: of several layers one, of a drawing a layer of the drawing."""
    path = check_plain_file(path, "vector file")
    drawing = is_drawing(path)
    name, found = read_chosen(path, layer)
    shapes, fields = found.shapes, {field.casefold(): values for field, values in found.fields.items()}
    use = ~(shapely.is_missing(shapes) | shapely.is_empty(shapes))
    if drawing and layer is not None:
        use &= fields["layer"].astype(str) == layer
        if not use.any():
            known = ", ".join(sorted(set(fields["layer"].astype(str))))[:300]
            raise InputError(f"{path}: nothing on layer {layer!r}; it has {known}")
    row = np.flatnonzero(use)
    parts = shapes[row]
    while (shapely.get_type_id(parts) > _POLYGON).any():
        parts, whose = shapely.get_parts(parts, return_index=True)
        row = row[whose]
    rings, whose = shapely.get_rings(parts, return_index=True)
    polygons = shapely.get_type_id(parts) == _POLYGON
    row = np.concatenate([row[~polygons], row[whose]])
    parts = np.concatenate([parts[~polygons], rings])
    XYZ, part = shapely.get_coordinates(parts, include_z=True, return_index=True)
    if not len(XYZ) or not np.isfinite(XYZ[:, :2]).all():
        raise InputError(f"{path}: layer {name}: holds nothing that can be drawn, or a coordinate that is no number")
    stated = found.crs if drawing or states_crs(path) else None
    crs, heights = (None, None) if stated is None else split_compound(stated, f"{path}: CRS")
    is_point = shapely.get_type_id(parts) == _POINT
    return DrawnFeatures(
        path=path,
        XYZ=XYZ,
        part=part.astype(np.int64),
        is_point=is_point,
        row=row,
        fields=fields,
        crs=crs,
        height_system=heights,
        unit=found.unit,
    )
