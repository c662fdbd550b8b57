"""Writing terrain models as GeoPackages, with layers to look at."""

from __future__ import annotations

import hashlib
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, fields, replace
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyogrio.errors
import rasterio
import shapely
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.windows import Window as GdalWindow

from photoplan import __version__
from photoplan.errors import PhotoplanError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.gdal import FIXED_DATE, GDAL_ERRORS, gdal_settings
from photoplan.io.product import check_output
from photoplan.io.store import Unfinished, standing, when_named
from photoplan.io.terrain.model import (
    FORMAT,
    HEADER,
    LINES,
    UNITS,
    GrossError,
    ModelHeader,
    ModelReader,
    check_layout,
    check_unit,
    header_to_json,
    inflate,
    pack_line,
    pack_unit,
    unit_checksum,
    unit_of,
)
from photoplan.io.vector_layer import write_vector
from photoplan.kernels.terrain import sample_lattice
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


_FIGURES = struct.Struct("<3q2d2q5dq")
_STORED = struct.Struct("<Q2dQ")
_SAMPLES = 12
_GPKG_ERRORS = (
    *GDAL_ERRORS,
    pyogrio.errors.DataSourceError,
    pyogrio.errors.DataLayerError,
    pyogrio.errors.FeatureError,
    sqlite3.Error,
)


@dataclass(frozen=True, eq=False)
class ModelParts:
    """What a model holds beside its units."""

    header: ModelHeader
    """Its layout must be the writer's; `made_by` and `identity` are set by the writer."""
    lines: Sequence[LineElement] = ()
    """Line elements, with their intersections with the grid."""
    gross: Sequence[GrossError] = ()
    """Measurements flagged as gross errors."""
    domain: Any | None = None
    """Where there is a surface: a polygon or multipolygon of Shapely in the model's CRS; None: not bounded."""
    suspects: Sequence[GrossError] = ()
    """Measurements that are used, but look like parts of gross errors."""


@dataclass(eq=False)
class ModelWriter:
    """Collects computing units and makes a terrain model's file of them; a context manager.

    Units go into a crash-safe log beside the file, so that the next run with the same `run_key` finds them in `done`.
    `finish` assembles the GeoPackage under a temporary name, opens it again, compares it with the log, and only then
    gives it its name. Leaving the context without `finish` keeps the log. `add` may be called from several threads.
    """

    path: Path
    """The file, a `.gpkg`."""
    layout: UnitLayout
    """Where the units lie."""
    run_key: str
    """A digest of inputs, settings and version: another key starts afresh."""
    overwrite: bool = False
    """Replace a file that exists."""
    inputs: Sequence[Path | str] = ()
    """Files that must not be overwritten."""

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if self.path.suffix.lower() != ".gpkg":
            raise UsageError(f"{self.path}: a terrain model is a GeoPackage; give it a name that ends with .gpkg")
        check_layout(self.layout, str(self.path))
        self._file = Unfinished(
            path=self.path,
            log_path=self.path.with_name(f".{self.path.name}.units"),
            what="units",
            check=lambda: check_output(self.path, self.inputs, overwrite=self.overwrite),
            faults=_GPKG_ERRORS,
        )

    def __enter__(self) -> ModelWriter:
        self._file.enter(f"{self.run_key} {self.layout} {FORMAT} {__version__}")
        return self

    def __exit__(self, *error: object) -> None:
        self._file.leave()

    def done(self) -> frozenset[tuple[int, int]]:
        """Column and row of the units that need not be computed any more."""
        columns = self.layout.columns
        return frozenset((number % columns, number // columns) for number in self._file.log.finished)

    def add(self, unit: Unit | None, figures: UnitFigures) -> None:
        """Add a finished unit, or None with the figures of an empty one; at once safe on the disk."""
        column, row = figures.column, figures.row
        where = f"{self.path}: unit column {column} row {row}"
        if not (0 <= column < self.layout.columns and 0 <= row < self.layout.rows):
            raise UsageError(f"{where}: the layout has {self.layout.columns} × {self.layout.rows} units")
        content = b""
        if unit is not None:
            left, top = self.layout.corner(column, row)
            if max(abs(unit.left - left), abs(unit.top - top), abs(unit.side - self.layout.side)) > 1e-6:
                raise UsageError(f"{where}: lies at {unit.left}, {unit.top}; its place in the layout is {left}, {top}")
            check_unit(unit, where)
            packed, size = pack_unit(unit)
            span = _range_of(unit)
            if span is not None:
                content = _STORED.pack(size, *span, unit.meshes) + packed
        payload = _FIGURES.pack(*astuple(figures)) + content
        self._file.log.append(row * self.layout.columns + column, payload)

    def figures(self) -> Iterator[UnitFigures]:
        """Figures of all finished units, row by row."""
        log = self._file.log
        for number in sorted(log.finished):
            yield UnitFigures(*_FIGURES.unpack_from(log.read(number)))

    def unit(self, column: int, row: int) -> Unit | None:
        """A finished unit, or None if it is empty."""
        number = row * self.layout.columns + column
        stored = self._stored(number)
        if stored is None:
            return None
        buffer = inflate(stored.packed, stored.size, f"{self.path}: unit column {column} row {row}")
        return unit_of(buffer, self.layout, column, row)

    def finish(self, parts: ModelParts) -> ModelReader:
        """Make the file of all units and these parts, give it its name, and open it."""
        log = self._file.log
        missing = self.layout.columns * self.layout.rows - len(log.finished)
        if missing:
            raise PhotoplanError(f"{self.path}: {missing} units were not delivered; empty ones are added as None")
        if parts.header.layout != self.layout:
            raise UsageError(f"{self.path}: the header's layout is {parts.header.layout}, the units' {self.layout}")
        self._file.give(lambda folder: self._assemble(parts, folder / "part.gpkg"))
        when_named(log.remove)
        return ModelReader(standing(self.path))

    def _assemble(self, parts: ModelParts, part: Path) -> Path:
        """Make the file under a temporary name, and compare it with the log."""
        crs = parts.header.crs
        write_units(part, self.layout, self.figures(), crs)
        write_lines(part, parts.lines, crs)
        write_gross(part, "gross_errors", parts.gross, crs)
        if parts.suspects:
            write_gross(part, "suspects", parts.suspects, crs)
        if parts.domain is not None:
            write_border(part, parts.domain, crs)
        meshes = self._base_meshes()
        if meshes:
            write_heights(part, self.layout, meshes, self.unit, crs)
        with closing(sqlite3.connect(part)) as db:
            # The file is nothing until it is complete: no journal is needed, and it is synchronised once at the end.
            db.execute("PRAGMA journal_mode = OFF")
            db.execute("PRAGMA synchronous = OFF")
            with db:
                _make_tables(db)
                digest = hashlib.sha256()
                db.executemany(f"INSERT INTO {UNITS} VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", self._unit_rows(digest))
                db.executemany(f"INSERT INTO {LINES} VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", _line_rows(parts.lines))
                header = replace(parts.header, made_by=f"photoplan {__version__}", identity="")
                digest.update(header_to_json(header).encode())
                text = header_to_json(replace(header, identity=digest.hexdigest()))
                domain = None if parts.domain is None else shapely.to_wkb(parts.domain)
                db.execute(f"INSERT INTO {HEADER} VALUES (1, ?, ?, ?)", (FORMAT, text, domain))
        self._check(part, digest.hexdigest())
        return part

    def _base_meshes(self) -> int:
        """Meshes along a side that most units have; 0: all are empty."""
        counts: Counter[int] = Counter()
        for number in self._file.log.finished:
            stored = self._stored(number)
            if stored is not None:
                counts[stored.meshes] += 1
        return max(counts, key=lambda meshes: (counts[meshes], -meshes)) if counts else 0

    def _unit_rows(self, digest: Any) -> Iterator[tuple[Any, ...]]:
        """Rows of the table of units, in order."""
        for number in sorted(self._file.log.finished):
            stored = self._stored(number)
            if stored is None:
                continue
            low, high, size = stored.low, stored.high, stored.size
            checksum = unit_checksum(number, size, low, high, stored.packed)
            digest.update(f"{number} {checksum} ".encode())
            row, column = divmod(number, self.layout.columns)
            yield number, column, row, stored.meshes, low, high, size, checksum, stored.packed

    def _stored(self, number: int) -> _Stored | None:
        content = self._file.log.read(number)[_FIGURES.size :]
        if not content:
            return None
        size, low, high, meshes = _STORED.unpack_from(content)
        return _Stored(size=size, low=low, high=high, meshes=meshes, packed=content[_STORED.size :])

    def _check(self, part: Path, identity: str) -> None:
        """Open the assembled file and compare it with the log at some units."""
        reader = ModelReader(part, cache_bytes=0)
        places = list(reader.units())
        good = reader.header.identity == identity
        for column, row in places[:: max(1, -(-len(places) // _SAMPLES))]:
            written, kept = reader.unit(column, row), self.unit(column, row)
            good = good and written is not None and kept is not None
            good = good and np.array_equal(written.heights, kept.heights, equal_nan=True)  # type: ignore[union-attr]
        if not good:
            raise PhotoplanError("it does not hold what was written")


@dataclass(frozen=True)
class _Stored:
    """A unit as it lies in the log."""

    size: int
    low: float
    high: float
    meshes: int
    packed: bytes


def _range_of(unit: Unit) -> tuple[float, float] | None:
    """Lowest and highest height of posts and triangles; None if the unit has no surface at all."""
    heights = unit.heights[np.isfinite(unit.heights)].astype(float) + unit.datum
    if unit.faces is not None and len(unit.faces.corners):
        Z = unit.faces.vertices[unit.faces.corners.ravel(), 2]
        heights = np.append(heights, Z[np.isfinite(Z)])
    return (float(heights.min()), float(heights.max())) if heights.size else None


def _make_tables(db: sqlite3.Connection) -> None:
    db.execute(
        f"CREATE TABLE {HEADER} (id INTEGER PRIMARY KEY, format INTEGER NOT NULL, content TEXT NOT NULL, domain BLOB)"
    )
    db.execute(
        f'CREATE TABLE {UNITS} (id INTEGER PRIMARY KEY, "column" INTEGER NOT NULL, "row" INTEGER NOT NULL, '
        "meshes INTEGER NOT NULL, low DOUBLE NOT NULL, high DOUBLE NOT NULL, size INTEGER NOT NULL, "
        "checksum INTEGER NOT NULL, content BLOB NOT NULL)"
    )
    db.execute(
        f"CREATE TABLE {LINES} (id INTEGER PRIMARY KEY, name TEXT NOT NULL, code TEXT NOT NULL, xmin DOUBLE NOT NULL, "
        "ymin DOUBLE NOT NULL, xmax DOUBLE NOT NULL, ymax DOUBLE NOT NULL, size INTEGER NOT NULL, "
        "checksum INTEGER NOT NULL, content BLOB NOT NULL)"
    )
    # A GeoPackage names its tables, so that programs which look for them know that these are meant to be there.
    for table, what in ((HEADER, "header"), (UNITS, "computing units"), (LINES, "line elements")):
        db.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change) "
            "VALUES (?, 'attributes', ?, ?, ?)",
            (table, table, f"{what} of the terrain model, for photoplan", FIXED_DATE),
        )


def _line_rows(lines: Sequence[LineElement]) -> Iterator[tuple[Any, ...]]:
    for number, line in enumerate(lines, 1):
        packed, size = pack_line(line)
        xmin, ymin = (float(value) for value in line.xyz[:, :2].min(axis=0))
        xmax, ymax = (float(value) for value in line.xyz[:, :2].max(axis=0))
        yield number, line.name, line.code, xmin, ymin, xmax, ymax, size, zlib.crc32(packed), packed
