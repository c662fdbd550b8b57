"""Polygons, points and lines of users' vector files, and small vector products as GeoPackage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.features
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.grid import MapGrid
from photoplan.geometry.units import MetricSystem, metric_system
from photoplan.io.checks import check_plain_file
from photoplan.io.geopackage import VectorLayer, write_geopackage
from photoplan.io.vector_layer import MAGIC, read_layer, states_crs

_KINDS = {
    "Polygon": ("Polygon", "MultiPolygon"),
    "Point": ("Point", "MultiPoint"),
    "LineString": ("LineString", "MultiLineString"),
}
_PLURAL = {"Polygon": "polygons", "Point": "points", "LineString": "lines"}


@dataclass(frozen=True, eq=False)
class Feature:
    """One object of a vector file."""

    name: str
    """Its column `image`, `name`, `NAME` or `id`, else its number from 1."""
    geometry: Any
    """Shapely geometry; Z is kept."""


@dataclass(frozen=True, eq=False)
class VectorFeatures:
    """Objects of one layer."""

    path: Path
    crs: str | None
    """As the file states it; None: it does not."""
    items: tuple[Feature, ...]
    fields: tuple[str, ...] = ()
    """Names of the columns."""


def read_features(path: Path, *kinds: str, crs: str | None = None) -> VectorFeatures:
    """Objects of the first layer of a GeoPackage, Shapefile, GeoJSON or FlatGeobuf."""
    path = check_plain_file(path, "vector file")
    with path.open("rb") as file:
        head = file.read(16)
    if not head.startswith(tuple(MAGIC)) and not head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        raise InputError(f"{path}: not a vector file that is read here; allowed are GeoPackage, Shapefile, GeoJSON")
    found = read_layer(path)
    shapes, columns = found.shapes, found.fields
    names = next((columns[key] for key in ("image", "name", "NAME", "Name", "id", "ID") if key in columns), None)
    allowed = [name for kind in kinds for name in _KINDS[kind]]
    items = []
    for i, shape in enumerate(shapes):
        if shape is None or shape.is_empty:
            continue
        if shape.geom_type not in allowed:
            raise InputError(
                f"{path}: feature {i + 1} is a {shape.geom_type}; allowed are {', '.join(allowed)}. Give another file"
            )
        name = None if names is None else names[i]
        items.append(Feature(str(name) if name is not None and str(name).strip() else str(i + 1), shape))
    if not items:
        raise InputError(f"{path}: holds no {' or '.join(kinds)}; give a file that does")
    _refuse_invalid(path, items)
    own = found.crs if states_crs(path) else None
    if own is not None and crs is not None:
        system = metric_system(own, f"{path}: CRS")
        if not system.is_plain:
            items = [Feature(item.name, _in_metres(item.geometry, system, str(path))) for item in items]
        own = system.crs
    if own is not None and crs is not None and not same_crs(own, crs):
        raise InputError(
            f"{path}: {_PLURAL[kinds[0]]} in {crs_label(own)}, the model is in {crs_label(crs)}; reproject them"
        )
    return VectorFeatures(path, own, tuple(items), tuple(found.fields))


def _in_metres(shape: Any, system: MetricSystem, where: str) -> Any:
    """A geometry with its coordinates in metres."""
    if not shapely.has_z(shape):
        return shapely.transform(shape, lambda XY: XY * system.scale)
    return shapely.transform(shape, lambda XYZ: system.to_metres(XYZ, f"{where}: heights"), include_z=True)


def _refuse_invalid(path: Path, items: Sequence[Feature]) -> None:
    shapes = np.array([item.geometry for item in items], object)
    wrong = [
        f"{item.name!r} ({reason})"
        for item, valid, reason in zip(items, shapely.is_valid(shapes), shapely.is_valid_reason(shapes))
        if not valid and item.geometry.geom_type in _KINDS["Polygon"]
    ]
    if wrong:
        raise InputError(f"{path}: {len(wrong)} polygons cross themselves or overlap: {', '.join(wrong)}; repair them")


def label_polygons(labels: NDArray[np.int32], grid: MapGrid) -> dict[int, Any]:
    """Outline of every positive label of a grid, along the edges of its pixels, as a multipolygon."""
    to_map = rasterio.Affine(grid.resolution, 0.0, grid.left, 0.0, -grid.resolution, grid.top)
    parts: dict[int, list[Any]] = {}
    shapes = rasterio.features.shapes(np.ascontiguousarray(labels, np.int32), mask=labels > 0, transform=to_map)
    for outline, value in shapes:
        shell, *holes = outline["coordinates"]
        parts.setdefault(int(value), []).append(shapely.Polygon(shell, holes))
    return {value: shapely.MultiPolygon(found) for value, found in sorted(parts.items())}


def check_vectors(path: Path) -> None:
    """Refuse a name that `write_features` would not write, before anything is computed for it."""
    if path.suffix.lower() != ".gpkg":
        raise UsageError(f"{path}: vectors are written as GeoPackage; give a name that ends with .gpkg")


def write_features(
    path: Path, kind: str, shapes: Sequence[Any], columns: Mapping[str, NDArray[Any]], crs: str | None, layer: str
) -> None:
    """Write one layer as a GeoPackage that appears under its name only when it is complete; replaces an older one."""
    check_vectors(path)
    write_geopackage(path, [VectorLayer(layer, kind, shapes, columns)], crs)
