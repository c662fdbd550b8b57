"""Terrain models read by units: random access to a file that may be far larger than memory."""

from __future__ import annotations

import os
import sqlite3
import struct
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.checks import open_database, plain_tables
from photoplan.io.terrain.model_blob import MOST_BYTES, check_unit, inflate, unit_of, unpack_line
from photoplan.io.terrain.model_tables import FORMAT, HEADER, LINES, UNITS, GrossError, ModelHeader, header_from_json
from photoplan.surfaces.units import LineElement, Unit, UnitFigures, UnitLayout

T = TypeVar("T")
_CHECKED = struct.Struct("<QQdd")
_DAMAGED = (sqlite3.Error, UnicodeDecodeError)
"""What SQLite raises for a damaged file; its message may quote bytes that are no text."""
_HIGHEST = 1e6
"""No height of any body is beyond this, metres."""


class UnitCache(Generic[T]):
    """Values by key, at most `limit` bytes of them; safe to use from several threads.

    Other than in a `BlockCache`, arrays of the values stay writable: kernels are compiled anew for arrays that are not.
    A value that two threads want at once may be loaded twice; it is kept once.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._held: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """Bytes held now; never above the limit."""
        return self._bytes

    def get(self, key: Hashable, load: Callable[[], tuple[T, int]]) -> T:
        """The value of a key; `load` makes it, and says its bytes, when it is not held. It must not be changed."""
        with self._lock:
            held = self._held.get(key)
            if held is not None:
                self._held.move_to_end(key)
                return held[0]
        value, size = load()
        with self._lock:
            if key not in self._held and size <= self._limit:
                self._held[key] = value, size
                self._bytes += size
                while self._bytes > self._limit:
                    self._bytes -= self._held.popitem(last=False)[1][1]
        return value


def unit_checksum(number: int, size: int, low: float, high: float, packed: bytes) -> int:
    """Checksum of a row of the table of units: its numbers too, so that rows cannot be exchanged."""
    return zlib.crc32(packed, zlib.crc32(_CHECKED.pack(number, size, low, high)))


def is_terrain_model(path: Path) -> bool:
    """Whether a file is a GeoPackage with a terrain model; False as well if it cannot be read."""
    try:
        with path.open("rb") as file:
            if file.read(16) != b"SQLite format 3\0":
                return False
        with closing(_open(path)) as db:
            return HEADER in plain_tables(db)
    except (OSError, *_DAMAGED):
        return False


@dataclass(frozen=True, eq=False)
class ModelReader:
    """A terrain model's file; a `UnitSource` that is safe to call from several threads and to pickle.

    Decoded units are kept up to `cache_bytes`, least recently used ones are forgotten first (the cache stays behind
    when the reader is pickled).
    """

    path: Path
    """The file."""
    cache_bytes: int = 64 << 20
    """Bytes of units that are kept."""
    header: ModelHeader = field(init=False, repr=False)
    """What the model is."""
    ranges: NDArray[np.float64] = field(init=False, repr=False)
    """Lowest and highest height of every unit, shape (rows, columns, 2); NaN for empty units."""
    finest: float = field(init=False)
    """Smallest grid width, metres."""
    _cache: UnitCache[Unit] = field(init=False, repr=False)
    _own: _Connections = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))
        object.__setattr__(self, "_cache", UnitCache(self.cache_bytes))
        object.__setattr__(self, "_own", _Connections(self.path, []))
        if not self.path.is_file():
            raise InputError(f"{self.path}: no such terrain model")
        try:
            text = _header_text(self._own.get())
        except _DAMAGED as error:
            raise self._no_model(str(error)) from error
        header = header_from_json(text, self.path)
        object.__setattr__(self, "header", header)
        self._own.expect(header.identity)
        ranges, finest = self._read_ranges(header.layout)
        object.__setattr__(self, "ranges", ranges)
        object.__setattr__(self, "finest", header.layout.side / finest)

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen, (self.path, self.cache_bytes, self.header.identity)

    @property
    def layout(self) -> UnitLayout:
        """Where the units lie."""
        return self.header.layout

    def unit(self, column: int, row: int) -> Unit | None:
        """The unit, or None if it is empty (or not of the layout)."""
        layout = self.layout
        if not (0 <= column < layout.columns and 0 <= row < layout.rows) or np.isnan(self.ranges[row, column, 0]):
            return None
        return self._cache.get((column, row), partial(self._load, column, row))

    def units(self) -> Iterator[tuple[int, int]]:
        """Column and row of every unit that is not empty, row by row."""
        for row, column in zip(*np.nonzero(~np.isnan(self.ranges[..., 0]))):
            yield int(column), int(row)

    def lines(self, bounds: tuple[float, float, float, float] | None = None) -> list[LineElement]:
        """Line elements, in the order of the file; with `bounds` those whose box meets xmin, ymin, xmax, ymax."""
        xmin, ymin, xmax, ymax = bounds or (-np.inf, -np.inf, np.inf, np.inf)
        query = (
            f"SELECT id, name, code, size, checksum, CASE WHEN length(content) <= ? THEN content END FROM {LINES} "
            "WHERE xmin <= ? AND xmax >= ? AND ymin <= ? AND ymax >= ? ORDER BY id"
        )
        found = []
        for number, name, code, size, checksum, packed in self._rows(query, MOST_BYTES, xmax, xmin, ymax, ymin):
            where = f"{self.path}: line {number} {str(name)[:80]!r}"
            if not isinstance(packed, bytes) or not isinstance(size, int) or zlib.crc32(packed) != checksum:
                raise InputError(f"{where}: damaged (its checksum differs); get a fresh copy of the file")
            found.append(unpack_line(inflate(packed, size, where), str(name), str(code), where))
        return found

    def figures(self) -> list[UnitFigures]:
        """Figures of all units, row by row, empty ones included."""
        names = [f.name for f in fields(UnitFigures)]
        whole = {"column", "row", "meshes", "points", "lines", "gross"}
        columns = ", ".join(f'"{name}"' for name in names)
        found = []
        for values in self._rows(f'SELECT {columns} FROM units ORDER BY "row", "column"'):
            numbers = {n: _number(v, n in whole, f"{self.path}: units.{n}") for n, v in zip(names, values)}
            found.append(UnitFigures(**numbers))
        return found

    def gross(self) -> list[GrossError]:
        """Measurements that were flagged as gross errors."""
        return self._flagged("gross_errors")

    def suspects(self) -> list[GrossError]:
        """Measurements that are used, but look like parts of gross errors."""
        return self._flagged("suspects")

    def _flagged(self, layer: str) -> list[GrossError]:
        if layer not in self._tables():
            return []
        query = f"SELECT name, kind, x, y, z, residual, redundancy, normalised FROM {layer} ORDER BY fid"
        found = []
        for name, kind, *values in self._rows(query):
            x, y, z, residual, redundancy, normalised = (
                _number(value, False, f"{self.path}: {layer}") for value in values
            )
            found.append(
                GrossError(
                    name=str(name),
                    kind=str(kind),
                    xyz=(x, y, z),
                    residual=residual,
                    redundancy=redundancy,
                    normalised=normalised,
                )
            )
        return found

    def domain(self) -> Any | None:
        """Where the model has a surface, as a polygon of Shapely in the model's CRS; None: it is not bounded."""
        (content,) = next(iter(self._rows(f"SELECT domain FROM {HEADER}")), (None,))
        if content is None:
            return None
        import shapely  # noqa: PLC0415 - 10 ms of each start, and only here

        try:
            shape = shapely.from_wkb(content)
        except (shapely.errors.ShapelyError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: the border is damaged ({error}); get a fresh copy") from None
        if shape.geom_type not in ("Polygon", "MultiPolygon"):
            raise InputError(f"{self.path}: the border is a {shape.geom_type}; it must be a polygon")
        return shape

    def layers(self) -> list[str]:
        """Names of the layers that a GIS shows."""
        return [str(name) for (name,) in self._rows("SELECT table_name FROM gpkg_contents ORDER BY table_name")]

    def _load(self, column: int, row: int) -> tuple[Unit, int]:
        """A unit, checked, and its bytes."""
        where = f"{self.path}: unit column {column} row {row}"
        number = row * self.layout.columns + column
        query = f"SELECT size, low, high, checksum, CASE WHEN length(content) <= ? THEN content END FROM {UNITS} "
        rows = self._rows(query + "WHERE id = ?", MOST_BYTES, number)
        size, low, high, checksum, packed = rows[0] if rows else (None,) * 5
        if (
            not isinstance(packed, bytes)
            or not isinstance(size, int)
            or not 0 < size <= MOST_BYTES
            or unit_checksum(number, size, float(low), float(high), packed) != checksum
        ):
            raise InputError(f"{where}: damaged (its checksum differs); get a fresh copy of the file")
        buffer = inflate(packed, size, where)
        unit = unit_of(buffer, self.layout, column, row)
        check_unit(unit, where)
        return unit, buffer.nbytes

    def _read_ranges(self, layout: UnitLayout) -> tuple[NDArray[np.float64], int]:
        """Heights of the units, and meshes along a side of the finest."""
        missing = {HEADER, UNITS, LINES, "units"} - self._tables()
        if missing:
            raise self._no_model(f"the table {min(missing)} is missing")
        ranges = np.full((layout.rows, layout.columns, 2), np.nan)
        finest = 1
        flat = ranges.reshape(-1, 2)
        for number, low, high, count in self._each(f"SELECT id, low, high, meshes FROM {UNITS}"):
            good = isinstance(number, int) and isinstance(count, int) and 0 <= number < len(flat) and count > 0
            if not (good and isinstance(low, float) and isinstance(high, float) and -_HIGHEST < low <= high < _HIGHEST):
                raise InputError(f"{self.path}: unit {number}: heights {low} to {high}; get a fresh copy of the file")
            flat[number] = low, high
            finest = max(finest, count)
        ranges.setflags(write=False)
        return ranges, finest

    def _tables(self) -> set[str]:
        try:
            return plain_tables(self._own.get())
        except _DAMAGED as error:
            raise self._no_model(str(error)) from error

    def _rows(self, query: str, *values: Any) -> list[tuple[Any, ...]]:
        return list(self._each(query, *values))

    def _each(self, query: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """Rows of a query, one after the other."""
        try:
            yield from self._own.get().execute(query, values)
        except (*_DAMAGED, OverflowError) as error:
            raise InputError(f"{self.path}: damaged ({error}); get a fresh copy of the file") from error

    def _no_model(self, reason: str) -> InputError:
        return InputError(
            f"{self.path}: no terrain model of photoplan ({reason}); make one with `photoplan dtm build`, "
            "or give a GeoTIFF of heights"
        )


class _Connections(threading.local):
    """One connection per thread, and per process where a process was forked; a connection must not be shared.

    `identity` is one list for all threads: the identity of the model that was opened first, when it is known.
    """

    def __init__(self, path: Path, identity: list[str]) -> None:
        self.path = path
        self.identity = identity
        self.process = -1
        self.db: sqlite3.Connection | None = None

    def expect(self, identity: str) -> None:
        self.identity.append(identity)

    def get(self) -> sqlite3.Connection:
        if self.db is None or self.process != os.getpid():
            db = _open(self.path)
            if self.identity and header_from_json(_header_text(db), self.path).identity != self.identity[0]:
                raise InputError(f"{self.path}: has changed since it was opened; start again")
            self.db, self.process = db, os.getpid()
        return self.db


def _reopen(path: Path, cache_bytes: int, identity: str) -> ModelReader:
    """A reader that arrives in another process."""
    reader = ModelReader(path, cache_bytes)
    if reader.header.identity != identity:
        raise InputError(f"{path}: has changed since it was opened; start again")
    return reader


def _open(path: Path) -> sqlite3.Connection:
    db = open_database(path, MOST_BYTES)
    db.text_factory = lambda raw: raw.decode(errors="replace")
    return db


def _header_text(db: sqlite3.Connection) -> str:
    if HEADER not in plain_tables(db):
        raise sqlite3.DatabaseError(f"it has no table {HEADER}")
    row: Sequence[Any] | None = db.execute(f"SELECT format, content FROM {HEADER}").fetchone()
    if row is None or row[0] != FORMAT or not isinstance(row[1], str):
        raise sqlite3.DatabaseError(f"its layout is number {row and row[0]}, this version reads {FORMAT}")
    return row[1]


def _number(value: Any, whole: bool, where: str) -> Any:
    """A number of a table; NULL is NaN."""
    if value is None and not whole:
        return np.nan
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
        raise InputError(f"{where}: {str(value)[:40]!r} is no number; get a fresh copy of the file")
    return value if whole else float(value)
