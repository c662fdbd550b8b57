"""Layers of a terrain model's file that any GIS shows: units, lines, gross errors, border, heights."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import fields
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.windows import Window as GdalWindow

from photoplan.geometry.grid import Window
from photoplan.io.gdal import gdal_settings
from photoplan.io.geopackage import write_vector
from photoplan.io.terrain.model_tables import GrossError
from photoplan.kernels.sample_grid import sample_lattice
from photoplan.surfaces.units import LineElement, Unit, UnitFigures, UnitLayout

HEIGHTS_NODATA = -9999.0
HEIGHTS_STEP = 1 / 1024
"""Heights of the raster are multiples of this, metres: they are for looking at, and compress by a third."""
_TILE = 256
_STRIP = 16 * _TILE
_CHUNK = 50_000

T = TypeVar("T")


def write_units(path: Path, layout: UnitLayout, figures: Iterable[UnitFigures], crs: str) -> None:
    """Layer `units`: a square for each computing unit with its figures; makes the file."""
    names = [f.name for f in fields(UnitFigures)]
    whole = {"column", "row", "meshes", "points", "lines", "gross"}
    for part in _chunks(figures, _CHUNK):
        columns = {
            name: np.array([getattr(f, name) for f in part], np.int64 if name in whole else np.float64)
            for name in names
        }
        with np.errstate(divide="ignore"):
            columns["width"] = np.where(columns["meshes"] > 0, layout.side / columns["meshes"], np.nan)
        left = layout.left + columns["column"] * layout.side
        top = layout.top - columns["row"] * layout.side
        squares = shapely.box(left, top - layout.side, left + layout.side, top)
        _write(path, "units", squares, columns, crs, "Polygon")


def write_lines(path: Path, lines: Sequence[LineElement], crs: str) -> None:
    """Layer `lines`, and where a breakline has two heights the right-hand ones as layer `walls_right`."""
    kinds: dict[str, Callable[[LineElement], Any]] = {
        "name": lambda line: line.name,
        "kind": lambda line: line.kind,
        "code": lambda line: line.code,
        "two_sided": lambda line: line.right is not None,
        "vertices": lambda line: len(line.xyz),
        "on_grid": lambda line: int(line.on_grid.sum()),
        "sigma_mean": lambda line: _of(np.nanmean, line.sigmas),
        "sigma_max": lambda line: _of(np.nanmax, line.sigmas),
    }
    _write_lines(path, "lines", lines, [line.xyz for line in lines], kinds, crs)
    walls = [line for line in lines if line.right is not None]
    if walls:
        right = [np.column_stack([line.xyz[:, :2], line.right]) for line in walls if line.right is not None]
        _write_lines(path, "walls_right", walls, right, {name: kinds[name] for name in ("name", "code")}, crs)


def _write_lines(
    path: Path,
    layer: str,
    lines: Sequence[LineElement],
    vertices: Sequence[NDArray[np.float64]],
    kinds: dict[str, Callable[[LineElement], Any]],
    crs: str,
) -> None:
    columns = {name: np.array([read(line) for line in lines]) for name, read in kinds.items()}
    for name in ("name", "kind", "code"):
        if name in columns:
            columns[name] = columns[name].astype(object)
    counts = np.repeat(np.arange(len(lines)), [len(xyz) for xyz in vertices])
    shapes = shapely.linestrings(np.concatenate(vertices), indices=counts) if lines else np.empty(0, object)
    _write(path, layer, shapes, columns, crs, "LineString Z")


def _of(function: Callable[[Any], Any], values: NDArray[np.float64]) -> float:
    return float(function(values)) if np.isfinite(values).any() else np.nan


def write_gross(path: Path, layer: str, gross: Sequence[GrossError], crs: str) -> None:
    """Layer `gross_errors` or `suspects`: a point for each measurement."""
    xyz = np.array([g.xyz for g in gross], float).reshape(-1, 3)
    columns: dict[str, NDArray[Any]] = {
        name: np.array([getattr(g, name) for g in gross], object if name in ("name", "kind") else float)
        for name in ("name", "kind", "residual", "redundancy", "normalised")
    }
    columns |= {axis: xyz[:, i] for i, axis in enumerate("xyz")}
    _write(path, layer, shapely.points(xyz), columns, crs, "Point Z")


def write_border(path: Path, domain: Any, crs: str) -> None:
    """Layer `border`: where the model has a surface."""
    parts = shapely.get_parts(domain)
    _write(path, "border", parts, {"area": shapely.area(parts)}, crs, "Polygon")


def _write(path: Path, layer: str, shapes: NDArray[Any], columns: dict[str, NDArray[Any]], crs: str, kind: str) -> None:
    write_vector(
        path,
        geometry=shapely.to_wkb(shapes, output_dimension=3 if kind.endswith("Z") else 2),
        field_data=list(columns.values()),
        fields=list(columns),
        layer=layer,
        driver="GPKG",
        geometry_type=kind,
        crs=crs,
        append=path.exists(),
        # Older GDAL and QGIS warn of newer numbers, and nothing newer is used.
        dataset_options={} if path.exists() else {"VERSION": "1.2"},
    )


def write_heights(
    path: Path, layout: UnitLayout, meshes: int, unit: Callable[[int, int], Unit | None], crs: str
) -> None:
    """Layer `heights`: the posts as a raster of one grid width, in the extension for gridded coverages."""
    width, height = layout.columns * meshes + 1, layout.rows * meshes + 1
    step = layout.side / meshes
    profile = {
        "driver": "GPKG",
        "width": width,
        "height": height,
        "count": 1,
        "dtype": "float32",
        "crs": crs,
        # Posts are the pixels' centres.
        "transform": rasterio.transform.from_origin(layout.left - step / 2, layout.top + step / 2, step, step),
        "APPEND_SUBDATASET": "YES",
        "RASTER_TABLE": "heights",
        "RASTER_DESCRIPTION": "heights of the posts, metres",
        "TILE_FORMAT": "TIFF",
    }
    try:
        with gdal_settings(), rasterio.open(path, "w", **profile) as file:
            for area in _strips(width, height):
                posts = base_posts(layout, meshes, unit, area)
                if posts is not None:
                    rounded = np.round(posts / np.float32(HEIGHTS_STEP)) * np.float32(HEIGHTS_STEP)
                    stored = np.where(np.isnan(rounded), np.float32(HEIGHTS_NODATA), rounded)
                    file.write(stored, 1, window=GdalWindow(area.col, area.row, area.width, area.height))
    except TypeError:
        # rasterio stumbles over its own message where GDAL cannot write the place of a raster.
        raise RasterioError("GDAL could not place the raster of heights") from None
    _finish_heights(path)


def _strips(width: int, height: int) -> Iterator[Window]:
    """The raster in parts of one row of tiles, so that none is written twice."""
    for strip in Window(0, 0, -(-width // _STRIP), -(-height // _TILE)).tiles(1):
        yield Window(strip.col * _STRIP, strip.row * _TILE, _STRIP, _TILE) & Window(0, 0, width, height)


def _finish_heights(path: Path) -> None:
    """Declare nodata, which GDAL does not do while it writes, and drop statistics that count padding as heights."""
    db = sqlite3.connect(path)
    try:
        with db:
            db.execute(
                "UPDATE gpkg_2d_gridded_coverage_ancillary SET data_null = ?, uom = 'm' "
                "WHERE tile_matrix_set_name = 'heights'",
                (HEIGHTS_NODATA,),
            )
            db.execute("UPDATE gpkg_2d_gridded_tile_ancillary SET min = NULL, max = NULL, mean = NULL, std_dev = NULL")
    finally:
        db.close()


def base_posts(
    layout: UnitLayout, meshes: int, unit: Callable[[int, int], Unit | None], area: Window
) -> NDArray[np.float32] | None:
    """Heights of a window of the raster, NaN where there is none; None: all are."""
    out = np.full((area.height, area.width), np.nan, np.float32)
    right, bottom = area.stop
    found = False
    for row in range(max(0, (area.row - 1) // meshes), min(layout.rows, (bottom - 1) // meshes + 1)):
        for column in range(max(0, (area.col - 1) // meshes), min(layout.columns, (right - 1) // meshes + 1)):
            one = unit(column, row)
            if one is None:
                continue
            found = True
            place = Window(column * meshes, row * meshes, meshes + 1, meshes + 1)
            part = place & area
            values = _resampled(one, meshes)[part.row - place.row :, part.col - place.col :]
            target = out[part.row - area.row :, part.col - area.col :][: part.height, : part.width]
            values = values[: part.height, : part.width]
            # Posts on the edge of two units are in both; where one has none the other's is taken.
            np.copyto(target, values, where=~np.isnan(values))
    return out if found else None


def _resampled(unit: Unit, meshes: int) -> NDArray[np.float32]:
    values = unit.heights
    if unit.meshes != meshes:
        step = unit.meshes / meshes
        values = sample_lattice(np.ascontiguousarray(values), 0, step, meshes + 1, 0, step, meshes + 1)
    return (values.astype(np.float64) + unit.datum).astype(np.float32)


def _chunks(items: Iterable[T], count: int) -> Iterator[list[T]]:
    iterator = iter(items)
    while part := list(islice(iterator, count)):
        yield part
