"""Terrain models written unit by unit: crash-safe, continued after an interruption, complete under their name."""

from __future__ import annotations

import hashlib
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.errors
import shapely

from photoplan import __version__
from photoplan.errors import PhotoplanError, UsageError
from photoplan.io.gdal import FIXED_DATE, GDAL_ERRORS
from photoplan.io.naming import standing, when_named
from photoplan.io.product import check_output
from photoplan.io.terrain.model_blob import check_unit, inflate, pack_line, pack_unit, unit_of
from photoplan.io.terrain.model_layers import write_border, write_gross, write_heights, write_lines, write_units
from photoplan.io.terrain.model_read import ModelReader, unit_checksum
from photoplan.io.terrain.model_tables import (
    FORMAT,
    HEADER,
    LINES,
    UNITS,
    GrossError,
    ModelHeader,
    check_layout,
    header_to_json,
)
from photoplan.io.unfinished import Unfinished
from photoplan.surfaces.units import LineElement, Unit, UnitFigures, UnitLayout

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
