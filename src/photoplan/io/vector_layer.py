"""Vector layers: GeoPackage, GeoJSON, Shapefile and DXF, read and written; contours, regions, plans."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sqlite3
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyogrio.raw
import rasterio
import rasterio.features
import rasterio.windows
import shapely
from numpy.typing import NDArray
from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError

from photoplan.arrays import Floats, Ints, Mask
from photoplan.cameras.observed import ImagePoints
from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import crs_label, same_crs, split_compound
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.units import MetricSystem, metric_system
from photoplan.io.disk import FIXED_DATE, FileLock, disk_error, library_error, lock_of, make_parents
from photoplan.io.drawing import drawing_metres, read_drawing
from photoplan.io.files import check_plain_file, json_object, open_database, plain_tables
from photoplan.io.product import check_output
from photoplan.io.store import give_name, scratch, together
from photoplan.io.tables import write_table

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


_POINT, _POLYGON = 0, 3


@dataclass(frozen=True, eq=False)
class DrawnFeatures:
    """Features of one layer, taken apart into points and lines; of polygons the outlines."""

    path: Path
    XYZ: Floats
    """Vertices of all in the units of the file, shape (n, 3); NaN height: none is stated."""
    part: Ints
    """Number of the point or line of each vertex, ascending, shape (n,)."""
    is_point: Mask
    """Of each part."""
    row: Ints
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


@dataclass(frozen=True, eq=False)
class VectorLayer:
    """A layer of one geometry type."""

    name: str
    kind: str
    """Geometry type: `Polygon`, `MultiPolygon`, `LineString Z`, `Point Z` …"""
    shapes: Sequence[Any]
    """Shapely geometries, (n,), metres."""
    columns: Mapping[str, NDArray[Any]]
    """Values of each field, (n,)."""


def write_vector(path: Path, **layer: Any) -> None:
    """Write a layer as `pyogrio.raw.write`, without the time of writing."""
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": FIXED_DATE})
    with warnings.catch_warnings():
        # The plane of a wall has no CRS.
        warnings.filterwarnings("ignore", message="'crs' was not provided")
        pyogrio.raw.write(os.fspath(path), **layer)


def write_geopackage(path: Path, layers: Sequence[VectorLayer], crs: str | None) -> None:
    """Write layers as one GeoPackage, which appears complete or not at all and replaces an older one.

    Without a `crs` they lie in a plane of their own, such as that of an image.
    """
    try:
        make_parents(path.parent)
        with scratch(path.parent) as folder:
            partial = folder / path.name
            warnings.filterwarnings("ignore", "'crs' was not provided")
            for layer in layers:
                write_vector(
                    partial,
                    geometry=shapely.to_wkb(np.array([*layer.shapes], object)),
                    field_data=list(layer.columns.values()),
                    fields=list(layer.columns),
                    layer=layer.name,
                    driver="GPKG",
                    geometry_type=layer.kind,
                    crs=crs,
                    append=partial.exists(),
                )
            give_name(partial, path)
    except OSError as error:
        raise disk_error(path, error) from error
    except RuntimeError as error:
        raise library_error(path, error) from error


@dataclass(frozen=True, eq=False)
class PointLayer:
    """A layer of points in space."""

    name: str
    XYZ: Floats
    """(n, 3), metres."""
    columns: Mapping[str, NDArray[Any]]
    """Values of each field, (n,)."""


def write_point_layers(path: Path, layers: Sequence[PointLayer], crs: str) -> None:
    """Write layers of points as one GeoPackage, which appears complete or not at all and replaces an older one.

    Layers without points are left out.
    """
    vectors = [
        VectorLayer(item.name, "Point Z", shapely.points(item.XYZ), item.columns) for item in layers if len(item.XYZ)
    ]
    write_geopackage(path, vectors, crs)


def write_residuals(
    path: Path, points: ImagePoints, residuals: Floats, normalised: Floats, redundancies: Floats, rejected: Mask
) -> None:
    """Write measurements with their residuals as a table that `photoplan adjust` reads again as image points."""
    pairs = ("residual", "normalised", "redundancy")
    names = [f"{name}_{axis}" for name in pairs for axis in "xy"]
    rows = []
    used: Mask = np.asarray(np.isfinite(residuals).all(axis=1))
    for k in range(len(points)):
        numbers = [*(f"{v:.10g}" for v in points.xy[k]), *(f"{v:.6g}" for v in points.sigma[k])]
        for values in (residuals[k], normalised[k], redundancies[k]):
            numbers += ["" if not np.isfinite(v) else f"{v:.4f}" for v in values]
        state = "rejected" if rejected[k] else "yes" if used[k] else "no"
        rows.append([points.points[points.point[k]], points.images[points.image[k]], *numbers, state])
    write_table(path, ["point", "image", "x", "y", "sigma_x", "sigma_y", *names, "used"], rows)


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


#: Side of the parts in which a raster is read, pixels.
_PART = 2048


@dataclass(frozen=True, eq=False)
class Regions:
    """Polygons that somebody has given to images of a mosaic."""

    grid: MapGrid
    shapes: tuple[tuple[Any, int], ...]
    """Polygon, and row of its image in the table of sources, plus one; the last of those over each other counts."""

    @property
    def meet(self) -> bool:
        """Whether a polygon lies in the grid, at least in part."""
        return any(polygon.intersects(shapely.box(*self.grid.bounds)) for polygon, _ in self.shapes)

    def digest(self, margin: float) -> str:
        """Of what lies in the grid, and `margin` metres around it: the same for regions that are the same there."""
        left, bottom, right, top = self.grid.bounds
        box = shapely.box(left - margin, bottom - margin, right + margin, top + margin)
        found = hashlib.sha256()
        for polygon, row in self.shapes:
            part = shapely.normalize(shapely.set_precision(polygon.intersection(box), 1e-6))
            if part.area > 0:
                found.update(row.to_bytes(4, "little") + shapely.to_wkb(part, output_dimension=2))
        return found.hexdigest()

    def rows(self, window: Window) -> NDArray[np.uint16]:
        """Row plus one for each pixel of a window whose centre lies in a polygon; 0 elsewhere."""
        grid, shape = self.grid, (window.height, window.width)
        left, top = grid.left + window.col * grid.resolution, grid.top - window.row * grid.resolution
        box = shapely.box(left, top - shape[0] * grid.resolution, left + shape[1] * grid.resolution, top)
        near = [(polygon, row) for polygon, row in self.shapes if polygon.intersects(box)]
        if not near:
            return np.zeros(shape, np.uint16)
        to_map = rasterio.Affine(grid.resolution, 0.0, left, 0.0, -grid.resolution, top)
        return np.asarray(rasterio.features.rasterize(near, shape, transform=to_map, dtype="uint16"))


def source_regions(path: Path, grid: MapGrid, images: int) -> dict[int, Any]:
    """Outline of what each image paints, along the edges of pixels: multipolygons by row plus one."""
    found: dict[int, list[Any]] = {}
    with rasterio.open(path) as file:
        for part in grid.window.tiles(_PART):
            at = rasterio.windows.Window(part.col, part.row, part.width, part.height)
            left, top = grid.left + part.col * grid.resolution, grid.top - part.row * grid.resolution
            labels = file.read(1, window=at).astype(np.int32)
            labels[labels > images] = 0
            here = MapGrid(
                left=left, top=top, resolution=grid.resolution, width=part.width, height=part.height, crs=grid.crs
            )
            for row, shape in label_polygons(labels, here).items():
                found.setdefault(row, []).append(shape)
    whole = ((row, shapely.union_all(parts)) for row, parts in sorted(found.items()))
    return {row: shape if shape.geom_type == "MultiPolygon" else shapely.MultiPolygon([shape]) for row, shape in whole}


def write_regions(path: Path, images: Sequence[str], shapes: Mapping[int, Any], crs: str | None) -> None:
    """Write regions as a GeoPackage with the layer `regions`: columns image, source and area_m2."""
    rows = list(shapes)
    columns = {
        "image": np.array([images[row - 1] for row in rows], object),
        "source": np.array(rows, np.int64),
        "area_m2": np.array([shapes[row].area for row in rows], float),
    }
    write_features(path, "MultiPolygon", [shapes[row] for row in rows], columns, crs, "regions")


def read_regions(path: Path, images: Sequence[str], grid: MapGrid, known: Sequence[str] = ()) -> Regions:
    """Regions of a GeoPackage, as `write_regions` writes them or somebody has drawn them; those of images that are
    `known`, but none of the table of sources `images`, are left out.
    """
    read = read_features(path, "Polygon", crs=grid.crs)
    features = read.items
    if "image" not in read.fields:
        raise InputError(f"{path}: no column `image`, which says whose each region is")
    names = [each.name for each in features]
    unknown = [name for name in names if name not in images and name not in known]
    if unknown:
        raise InputError(
            f"{path}: regions of {', '.join(map(repr, dict.fromkeys(unknown)))}, which "
            f"{'is' if len(set(unknown)) == 1 else 'are'} not in the mosaic; choose these images too, or take the "
            "regions out"
        )
    rows = {name: row for row, name in enumerate(images, 1)}
    taken = ((each.geometry, rows[name]) for each, name in zip(features, names) if name in rows)
    return Regions(grid, tuple(taken))


#: Ending of the name and the driver that writes it.
FORMATS = {".gpkg": "GPKG", ".shp": "ESRI Shapefile", ".geojson": "GeoJSON", ".json": "GeoJSON", ".dxf": "DXF"}
#: Vertices of the lines that are handed over at once.
BATCH = 500_000


@dataclass(frozen=True, eq=False)
class ContourRow:
    """One contour."""

    xy: Floats
    """Vertices, shape (n, 2), metres; of a closed line the last is the first."""
    height: float
    index: bool
    """It is an index contour."""
    depression: bool
    """It runs round lower ground."""


@dataclass(frozen=True)
class LabelRow:
    """Text on a contour."""

    X: float
    Y: float
    height: float
    angle: float
    """Degrees counter-clockwise from east."""
    text: str
    size: float
    """Height of the text, metres."""


def contour_files(path: Path, labels: bool) -> list[Path]:
    """What `write_contours` writes: the file, and for formats of one layer another one with the labels."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise UsageError(f"{path}: contours are written as {', '.join(FORMATS)}; give a name with such an ending")
    if labels and suffix not in (".gpkg", ".dxf"):
        return [path, path.with_name(f"{path.stem}_labels{path.suffix}")]
    return [path]


def write_contours(
    path: Path,
    lines: Iterable[ContourRow],
    labels: Callable[[], Sequence[LabelRow]] | None,
    crs: str,
    *,
    inputs: Sequence[Path] = (),
    overwrite: bool = False,
) -> list[Path]:
    """Write contours as 3-D lines as they come; files appear under their names only when complete.

    A GeoPackage has the layers `contours` and `labels`; Shapefile and GeoJSON have a second file `NAME_labels`; a DXF
    the CAD layers CONTOUR, CONTOUR_INDEX and CONTOUR_LABEL. Columns are `height`, `is_index`, `depression`; of labels
    `text`, `height`, `angle` (degrees counter-clockwise from east) and `size` (metres).
    """
    files = contour_files(path, labels is not None)
    for file in files:
        check_output(file, inputs, overwrite=overwrite)
    try:
        with FileLock(lock_of(path)), scratch(path.parent) as made:
            # Versions before left a folder of this name when they were killed.
            old = path.with_name(f".{path.name}.partial")
            if old.is_dir() and not old.is_symlink():
                shutil.rmtree(old, ignore_errors=True)
            folder = made / "files"
            folder.mkdir()
            if path.suffix.lower() == ".dxf":
                _write_dxf(folder / path.name, lines, labels)
            else:
                _write_layers([folder / file.name for file in files], lines, labels, crs)
            # The main file comes last: where it is, its companions are.
            with together():
                for part in sorted(folder.iterdir(), key=lambda p: (p.name == path.name, p.name)):
                    give_name(part, path.with_name(part.name))
    except RuntimeError as error:
        raise library_error(path, error) from error
    except OSError as error:
        raise disk_error(path, error) from error
    return files


def _batches(rows: Iterable[ContourRow], most: float) -> Iterator[list[ContourRow]]:
    """Lines in batches of about so many vertices."""
    batch: list[ContourRow] = []
    vertices = 0
    for row in rows:
        batch.append(row)
        vertices += len(row.xy)
        if vertices >= most:
            yield batch
            batch, vertices = [], 0
    if batch:
        yield batch


def _write_layers(
    files: list[Path], lines: Iterable[ContourRow], labels: Callable[[], Sequence[LabelRow]] | None, crs: str
) -> None:
    driver = FORMATS[files[0].suffix.lower()]
    written = False
    # GDAL cannot add to a GeoJSON without reading it again.
    for batch in _batches(lines, np.inf if driver == "GeoJSON" else BATCH):
        _write_lines(files[0], driver, batch, crs, written)
        written = True
    if not written:
        _write_lines(files[0], driver, [], crs, False)
    if labels is None:
        return
    found = labels()
    points = np.array([(row.X, row.Y, row.height) for row in found]).reshape(-1, 3)
    columns = {
        "text": np.array([row.text for row in found], object),
        "height": points[:, 2],
        "angle": np.array([row.angle for row in found], float),
        "size": np.array([row.size for row in found], float),
    }
    one_file = len(files) == 1
    _write_layer(files[-1], driver, "labels", "Point Z", shapely.points(points), columns, crs, one_file)


def _write_lines(path: Path, driver: str, rows: list[ContourRow], crs: str, append: bool) -> None:
    counts = [len(row.xy) for row in rows]
    heights = np.array([row.height for row in rows], float)
    xyz = np.column_stack([np.concatenate([row.xy for row in rows]), np.repeat(heights, counts)]) if rows else None
    shapes = shapely.linestrings(xyz, indices=np.repeat(np.arange(len(rows)), counts)) if rows else np.array([], object)
    columns = {
        "height": heights,
        "is_index": np.array([row.index for row in rows], np.int16),
        "depression": np.array([row.depression for row in rows], np.int16),
    }
    _write_layer(path, driver, "contours", "LineString Z", shapes, columns, crs, append)


def _write_layer(
    path: Path,
    driver: str,
    layer: str,
    kind: str,
    shapes: Any,
    columns: dict[str, NDArray[Any]],
    crs: str,
    append: bool,
) -> None:
    write_vector(
        path,
        geometry=shapely.to_wkb(np.asarray(shapes, object), output_dimension=3),
        field_data=list(columns.values()),
        fields=list(columns),
        layer=layer if driver == "GPKG" else path.stem,
        driver=driver,
        geometry_type=kind,
        crs=crs,
        append=append,
    )


def _write_dxf(path: Path, lines: Iterable[ContourRow], labels: Callable[[], Sequence[LabelRow]] | None) -> None:
    """A DXF of release 12, which every CAD program reads: 3-D polylines, and texts turned along them."""
    with path.open("w", encoding="ascii", newline="\r\n") as file:
        file.write(
            "0\nSECTION\n2\nHEADER\n9\n$ACADVER\n1\nAC1009\n0\nENDSEC\n0\nSECTION\n2\nTABLES\n0\nTABLE\n2\nLAYER\n"
        )
        file.write("70\n3\n")
        for name, colour in (("CONTOUR", 34), ("CONTOUR_INDEX", 32), ("CONTOUR_LABEL", 7)):
            file.write(f"0\nLAYER\n2\n{name}\n70\n0\n62\n{colour}\n6\nCONTINUOUS\n")
        file.write("0\nENDTAB\n0\nENDSEC\n0\nSECTION\n2\nENTITIES\n")
        for row in lines:
            closed = len(row.xy) > 3 and bool((row.xy[0] == row.xy[-1]).all())
            layer = "CONTOUR_INDEX" if row.index else "CONTOUR"
            # Flag 8: a polyline in space; 1: closed.
            file.write(f"0\nPOLYLINE\n8\n{layer}\n66\n1\n10\n0.0\n20\n0.0\n30\n0.0\n70\n{8 + closed}\n")
            tail = f"30\n{row.height:.6f}\n70\n32\n"
            for x, y in (row.xy[:-1] if closed else row.xy).tolist():
                file.write(f"0\nVERTEX\n8\n{layer}\n10\n{x:.7f}\n20\n{y:.7f}\n{tail}")
            file.write(f"0\nSEQEND\n8\n{layer}\n")
        for label in labels() if labels is not None else ():
            at = f"{{0}}\n{label.X:.4f}\n{{1}}\n{label.Y:.4f}\n{{2}}\n{label.height:.6f}\n"
            # Justified to the middle (72, 73) of its second alignment point.
            file.write(f"0\nTEXT\n8\nCONTOUR_LABEL\n{at.format(10, 20, 30)}40\n{label.size:.4f}\n1\n{label.text}\n")
            file.write(f"50\n{label.angle:.4f}\n72\n1\n{at.format(11, 21, 31)}73\n2\n")
        file.write("0\nENDSEC\n0\nEOF\n")


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
    tile_bounds: Floats
    """Outer edges of each tile, shape (n, 4), in the product's CRS."""
    footprints: dict[str, NDArray[Any]]
    """Columns of the layer `footprints`: image, product, columns, rows, resolution."""
    outlines: list[Floats]
    """Footprint of each image, shape (k, 2), in the product's CRS."""
    crs: str | None
    """CRS of all layers."""
    squares: tuple[Floats, dict[str, NDArray[Any]]] | None = None
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
                _write_polygons(partial, layer, boxes, columns, plan.crs, "Polygon", append=partial.exists())
        outlines = np.array([shapely.Polygon(o) for o in plan.outlines], object)
        _write_polygons(partial, "footprints", outlines, plan.footprints, plan.crs, "Polygon", append=True)
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


def _write_polygons(
    path: Path,
    layer: str,
    geometry: NDArray[Any],
    columns: dict[str, NDArray[Any]],
    crs: str | None,
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
