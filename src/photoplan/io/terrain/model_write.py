"""Terrain models written: GeoPackages of photoplan, and meshes, LandXML and DXF for other programs."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import astuple, dataclass, fields, replace
from itertools import islice
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import pyogrio.errors
import rasterio
import shapely
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.windows import Window as GdalWindow
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from photoplan import __version__
from photoplan.arrays import Floats, Floats32, Ints, Mask
from photoplan.errors import PhotoplanError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.crs import parse_crs
from photoplan.geometry.grid import Window
from photoplan.geometry.heights import height_label
from photoplan.io.disk import FIXED_DATE, GDAL_ERRORS, FileLock, disk_error, gdal_settings, lock_of
from photoplan.io.product import check_output
from photoplan.io.store import StagedOutput, give_name, scratch, standing, when_named
from photoplan.io.tables import csv_line
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
from photoplan.plain import xml_quoted
from photoplan.surfaces.units import LineElement, Unit, UnitFigures, UnitLayout, UnitSource

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
    vertices: Sequence[Floats],
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


def _of(function: Callable[[Any], Any], values: Floats) -> float:
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
) -> Floats32 | None:
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


def _resampled(unit: Unit, meshes: int) -> Floats32:
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
        self._file = StagedOutput(
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


_SAME = 2e-5
"""Vertices closer than this in the plane, metres, and …"""
_SAME_HEIGHT = 5e-4
"""… closer than this in height are one: posts are stored to a fraction of it, places are known far better."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """What one unit adds to the triangulation."""

    vertices: Floats
    """New vertices, X, Y, Z, shape (k, 3), metres; their numbers follow those of the parts before."""
    faces: Ints
    """Vertex numbers, from 0 over all parts, of each triangle of the surface, counter-clockwise, shape (f, 3)."""
    walls: Ints
    """The same of vertical triangles at two-sided breaklines, shape (w, 3)."""


def mesh_parts(source: UnitSource) -> Iterator[MeshPart]:
    """The triangulation of a model, a part for each unit that has a surface, row by row."""
    numbers = _SharedNumbers()
    layout = source.layout
    for row in range(layout.rows):
        for column in range(layout.columns):
            unit = source.unit(column, row)
            if unit is None:
                continue
            vertices, faces, walls = unit_mesh(unit)
            if not len(faces):
                continue
            number, new = numbers.take(vertices, _on_edge(vertices, unit))
            yield MeshPart(vertices[new], number[faces], number[walls])
        numbers.next_row()


def unit_mesh(unit: Unit) -> tuple[Floats, Ints, Ints]:
    """Vertices (k, 3), triangles (f, 3) and vertical triangles of walls (w, 3) of a unit; vertex numbers from 0."""
    n = unit.meshes
    post = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    along = np.arange(n + 1) * unit.width
    X, Y = np.meshgrid(unit.left + along, unit.top - along)
    vertices = np.stack([X, Y, unit.heights.astype(float) + unit.datum], axis=-1).reshape(-1, 3)
    plain = np.ones((n, n), bool)
    corners = np.empty((0, 3), np.int64)
    if unit.faces is not None:
        plain = (np.diff(unit.faces.start) == 0).reshape(n, n)
        own = unit.faces.corners.astype(np.int64)
        # Three equal corners mark a mesh without a surface.
        corners = own[(own[:, 0] != own[:, 1]) & (own[:, 1] != own[:, 2]) & (own[:, 0] != own[:, 2])] + len(vertices)
        vertices = np.concatenate([vertices, unit.faces.vertices])
    there = np.isfinite(unit.heights)
    plain &= there[:-1, :-1] & there[:-1, 1:] & there[1:, :-1] & there[1:, 1:]
    a, b, c, d = (part[plain] for part in (post[:-1, :-1], post[:-1, 1:], post[1:, :-1], post[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1), corners])
    if unit.faces is not None:
        faces = _joined(vertices)[faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    return vertices, faces, _walls(vertices, faces) if unit.faces is not None else np.empty((0, 3), np.int64)


def _joined(vertices: Floats) -> Ints:
    """For each vertex the first that lies at its place."""
    there = np.flatnonzero(np.isfinite(vertices[:, 2]))
    scaled = vertices[there] / [_SAME, _SAME, _SAME_HEIGHT]
    pairs = there[cKDTree(scaled - scaled.min(axis=0)).query_pairs(1.0, output_type="ndarray")].reshape(-1, 2)
    first = np.arange(len(vertices))
    if len(pairs):
        graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(vertices),) * 2)
        group = connected_components(graph, directed=False)[1]
        _, lowest = np.unique(group, return_index=True)
        first = lowest[group]
    return first


def _walls(vertices: Floats, faces: Ints) -> Ints:
    """Vertical triangles between edges that lie above each other and belong to one triangle each."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    open_edges = edges[first[count == 1]]
    if not len(open_edges):
        return np.empty((0, 3), np.int64)
    # Ends at one place in the plane have one number.
    ends = np.unique(open_edges)
    place = np.zeros(len(vertices), np.int64)
    flat = vertices[ends] * [1, 1, 0]
    place[ends] = _joined(flat)
    by_place: dict[tuple[int, int], tuple[int, int]] = {(place[a], place[b]): (a, b) for a, b in open_edges.tolist()}
    walls: list[tuple[int, int, int]] = []
    for (p, q), (a, b) in by_place.items():
        other = by_place.get((q, p))
        if other is None or p > q:
            continue
        c, d = other  # c lies at b's place, d at a's
        walls += [t for t in ((b, a, d), (b, d, c)) if len(set(t)) == 3]
    return np.array(walls, np.int64).reshape(-1, 3)


def _on_edge(vertices: Floats, unit: Unit) -> Mask:
    """Whether vertices lie on the border of their unit."""
    x, y = vertices[:, 0] - unit.left, unit.top - vertices[:, 1]
    inside = (x > _SAME) & (x < unit.side - _SAME) & (y > _SAME) & (y < unit.side - _SAME)
    return np.asarray(~inside)


class _SharedNumbers:
    """Numbers of vertices over all units."""

    def __init__(self) -> None:
        self.count = 0
        self._here: dict[tuple[int, int], list[tuple[float, float, float, int]]] = {}
        self._above: dict[tuple[int, int], list[tuple[float, float, float, int]]] = {}

    def next_row(self) -> None:
        """Forget vertices that no later unit can share."""
        self._above, self._here = self._here, {}

    def take(self, vertices: Floats, shared: Mask) -> tuple[Ints, Mask]:
        """Number of each vertex, and which are new."""
        known = np.full(len(vertices), -1, np.int64)
        cells = np.floor(vertices[:, :2] / (4 * _SAME) + 0.5)
        # A vertex near the edge of its cell may lie in the next one as another unit has it.
        rest = vertices[:, :2] / (4 * _SAME) + 0.5 - cells
        near = np.where(rest < 0.25, -1, np.where(rest > 0.75, 1, 0)).astype(int)
        for i in np.flatnonzero(shared).tolist():
            known[i] = self._find(cells[i], near[i], vertices[i].tolist())
        new = known < 0
        known[new] = self.count + np.arange(np.count_nonzero(new))
        self.count += int(np.count_nonzero(new))
        for i in np.flatnonzero(shared).tolist():
            place = (int(cells[i, 0]), int(cells[i, 1]))
            x, y, z = vertices[i].tolist()
            self._here.setdefault(place, []).append((x, y, z, int(known[i])))
        return known, new

    def _find(self, cell: Floats, near: Ints, xyz: list[float]) -> int:
        column, row = int(cell[0]), int(cell[1])
        for c in {column, column + int(near[0])}:
            for r in {row, row + int(near[1])}:
                for kept in (self._here, self._above):
                    for x, y, z, number in kept.get((c, r), ()):
                        same = abs(x - xyz[0]) < _SAME and abs(y - xyz[1]) < _SAME
                        if same and abs(z - xyz[2]) < _SAME_HEIGHT:
                            return number
        return -1


TIN_SUFFIXES = (".obj", ".ply", ".xml")


@dataclass(frozen=True)
class ExportFigures:
    """What was written."""

    vertices: int
    faces: int = 0
    walls: int = 0
    """Vertical triangles at two-sided breaklines."""
    line_points: int = 0


@contextmanager
def replacing(path: Path, inputs: Sequence[Path | str] = (), overwrite: bool = False) -> Iterator[Path]:
    """A temporary name beside `path` to write to; it takes the name when the context ends well, else it is removed."""
    check_output(path, inputs, overwrite=overwrite)
    with FileLock(lock_of(path)):
        check_output(path, inputs, overwrite=overwrite)
        try:
            with scratch(path.parent) as folder:
                yield folder / path.name
                check_output(path, inputs, overwrite=overwrite)
                give_name(folder / path.name, path)
        except PhotoplanError:
            raise
        except OSError as error:
            raise disk_error(path, error) from error


def write_tin(
    part: Path,
    kind: str,
    source: UnitSource,
    name: str,
    events: Events = SILENT,
    *,
    crs: str | None = None,
    height_system: str | None = None,
) -> ExportFigures:
    """Write the triangulation of a model."""
    counts = [0, 0, 0]

    def parts() -> Iterator[MeshPart]:
        for item in mesh_parts(source):
            counts[0] += len(item.vertices)
            counts[1] += len(item.faces)
            counts[2] += len(item.walls)
            events.done()
            yield item

    if kind == ".xml":
        _write_landxml(part, parts(), name, _coordinate_system(crs, height_system))
    else:
        {".obj": _write_obj, ".ply": _write_ply}[kind](part, parts(), name)
    return ExportFigures(counts[0], counts[1], 0 if kind == ".xml" else counts[2])


def _write_obj(path: Path, parts: Iterator[MeshPart], name: str) -> None:
    with path.open("wb") as file:
        file.write(
            f"# photoplan {__version__}: terrain model, X east, Y north, Z up, metres\no {_word(name)}\n".encode()
        )
        for item in parts:
            file.write(_text("v %.5f %.5f %.4f\n", item.vertices))
            file.write(_text("f %d %d %d\n", np.concatenate([item.faces, item.walls]) + 1))


def _write_ply(path: Path, parts: Iterator[MeshPart], name: str) -> None:
    record = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
    with ExitStack() as open_files:
        file, faces = _two_files(open_files, path)
        # The counts are known at the end: room is left for them.
        file.write(_ply_header(0, 0, name))
        vertices = triangles = 0
        for item in parts:
            file.write(item.vertices.astype("<f8").tobytes())
            both = np.concatenate([item.faces, item.walls])
            rows = np.empty(len(both), record)
            rows["count"], rows["corners"] = 3, both
            faces.write(rows.tobytes())
            vertices, triangles = vertices + len(item.vertices), triangles + len(both)
        faces.seek(0)
        shutil.copyfileobj(faces, file, 1 << 20)
        file.seek(0)
        file.write(_ply_header(vertices, triangles, name))


def _ply_header(vertices: int, faces: int, name: str) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment photoplan {__version__}: {_word(name)}; X east, Y north, Z up, metres",
        f"element vertex {vertices:012d}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {faces:012d}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode()


def _coordinate_system(crs: str | None, height_system: str | None) -> str:
    """The CoordinateSystem of LandXML 1.2; empty if nothing is known."""
    facts: dict[str, str] = {}
    if crs is not None:
        code = crs.upper().removeprefix("EPSG:")
        facts |= {"name": parse_crs(crs).name} | ({"epsgCode": code} if code.isdigit() else {"ogcWktCode": crs})
    if height_system is not None:
        facts |= {"verticalDatum": height_label(height_system), "verticalCoordinateSystemName": height_system}
    return f"<CoordinateSystem{''.join(f' {k}={xml_quoted(v)}' for k, v in facts.items())}/>\n" if facts else ""


def _write_landxml(path: Path, parts: Iterator[MeshPart], name: str, system: str) -> None:
    with ExitStack() as open_files:
        file, faces = _two_files(open_files, path)
        file.write(
            (
                '<?xml version="1.0" encoding="UTF-8"?>\n<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" '
                'version="1.2">\n<Units><Metric linearUnit="meter" areaUnit="squareMeter" volumeUnit="cubicMeter" '
                f'temperatureUnit="celsius" pressureUnit="milliBars"/></Units>\n{system}'
                f'<Application name="photoplan" version="{__version__}"/>\n'
                f'<Surfaces><Surface name={xml_quoted(_word(name))}><Definition surfType="TIN">\n<Pnts>\n'
            ).encode()
        )
        count = 0
        for item in parts:
            # LandXML has north before east.
            numbered = np.column_stack([count + 1 + np.arange(len(item.vertices)), item.vertices[:, [1, 0, 2]]])
            file.write(_text('<P id="%d">%.5f %.5f %.4f</P>\n', numbered))
            faces.write(_text("<F>%d %d %d</F>\n", item.faces + 1))
            count += len(item.vertices)
        file.write(b"</Pnts>\n<Faces>\n")
        faces.seek(0)
        shutil.copyfileobj(faces, file, 1 << 20)
        file.write(b"</Faces>\n</Definition></Surface></Surfaces>\n</LandXML>\n")


def _two_files(stack: ExitStack, path: Path) -> tuple[IO[bytes], IO[bytes]]:
    """The file, and one beside it for what comes last."""
    faces = path.with_name(path.name + ".faces")
    return stack.enter_context(path.open("w+b")), stack.enter_context(faces.open("w+b"))


def _text(form: str, rows: Floats | Ints) -> bytes:
    return (form * len(rows) % tuple(rows.ravel().tolist())).encode()


def _word(name: str) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in name).split()) or "terrain"


def write_points(
    part: Path, kind: str, source: UnitSource, lines: Sequence[LineElement], events: Events = SILENT
) -> ExportFigures:
    """Write the posts and the vertices of the lines as text."""
    posts = points = 0
    with part.open("wb") as file:
        if kind == ".csv":
            file.write(b"x,y,z,sigma,kind,name,code,side\n")
        for rows in _posts(source):
            form = "%.4f %.4f %.4f\n" if kind == ".xyz" else "%.4f,%.4f,%.4f,%.4f,post,,,\n"
            file.write(_text(form, rows[:, :3] if kind == ".xyz" else rows))
            posts += len(rows)
            events.done()
        for line in lines:
            for side, z in (("left", line.xyz[:, 2]), ("right", line.right)):
                if z is None or (side == "left" and not np.isfinite(z).any()):
                    continue
                there = np.isfinite(z)
                rows = np.column_stack([line.xyz[:, :2], z, line.sigmas])[there]
                points += len(rows)
                if kind == ".xyz":
                    file.write(_text("%.4f %.4f %.4f\n", rows[:, :3]))
                else:
                    ending = csv_line([line.kind, line.name, line.code, side if line.right is not None else ""])
                    file.write(_text("%.4f,%.4f,%.4f,%.4f," + ending.replace("%", "%%"), rows))
    return ExportFigures(posts, line_points=points)


def _posts(source: UnitSource) -> Iterator[Floats]:
    """X, Y, Z, sigma of the posts of each unit, shape (k, 4); a post that the unit before has is left out."""
    layout = source.layout
    above: dict[int, Unit] = {}
    for row in range(layout.rows):
        before: Unit | None = None
        here: dict[int, Unit] = {}
        for column in range(layout.columns):
            unit = source.unit(column, row)
            if unit is not None:
                here[column] = unit
                new = np.isfinite(unit.heights)
                upper, corner = above.get(column), above.get(column - 1)
                if before is not None:
                    new[:, 0] &= ~_shared(before.heights[:, -1], unit.meshes)
                if upper is not None:
                    new[0] &= ~_shared(upper.heights[-1], unit.meshes)
                if corner is not None and np.isfinite(corner.heights[-1, -1]):
                    new[0, 0] = False
                east = above.get(column + 1)
                if east is not None and np.isfinite(east.heights[-1, 0]):
                    new[0, -1] = False
                yield _rows(unit, new)
            before = unit
        above = here


def _shared(edge: Floats32, meshes: int) -> Mask:
    """Which of the posts along an edge the other unit has, whose posts along it are given."""
    at = np.arange(meshes + 1) * (len(edge) - 1) / meshes
    nearest = np.rint(at).astype(int)
    return np.asarray((np.abs(at - nearest) < 1e-9) & np.isfinite(edge[nearest]))


def _rows(unit: Unit, which: Mask) -> Floats:
    along = np.arange(unit.meshes + 1) * unit.width
    X, Y = np.meshgrid(unit.left + along, unit.top - along)
    heights = unit.heights.astype(float) + unit.datum
    return np.column_stack([X[which], Y[which], heights[which], unit.sigmas[which]])
