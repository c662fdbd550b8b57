"""Terrain models as GeoPackages: units and reading."""

from __future__ import annotations

import json
import math
import os
import sqlite3
import struct
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from photoplan.arrays import Floats
from photoplan.errors import InputError
from photoplan.io.files import fingerprint, open_database, plain_tables
from photoplan.plain import json_text
from photoplan.surfaces.units import LINE_KINDS, LineElement, MeshFaces, Unit, UnitFigures, UnitLayout

MOST_BYTES = 256 << 20
"""Bytes of one unit or line at most, before compression."""
MOST_MESHES = 4096
"""Meshes along a unit's side at most."""

_UNIT = struct.Struct("<4sIIIQd")
_LINE = struct.Struct("<4sIII")
_UNIT_MAGIC, _LINE_MAGIC = b"PPU1", b"PPL1"
_LEVEL = 6
Sections = tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class _Shape:
    """Counts in the head of a unit."""

    meshes: int
    vertices: int
    triangles: int
    faces: bool
    datum: float

    @property
    def sections(self) -> Sections:
        """Type and count of the numbers of each section: the wide ones first, so that all stay aligned."""
        posts = (self.meshes + 1) ** 2
        start = self.meshes**2 + 1 if self.faces else 0
        k, f = self.vertices, self.triangles
        return ("<f8", 3 * k), ("<i8", start), ("<f4", posts), ("<f4", posts), ("<f4", k), ("<i4", 3 * f)


def pack_unit(unit: Unit) -> tuple[bytes, int]:
    """Compressed bytes of a unit, and their number before compression."""
    faces = unit.faces
    k, f = (0, 0) if faces is None else (len(faces.vertices), len(faces.corners))
    head = _UNIT.pack(_UNIT_MAGIC, unit.meshes, k, f, int(faces is not None), unit.datum)
    empty = np.empty(0)
    parts: list[tuple[str, NDArray[Any]]] = [
        ("<f8", empty if faces is None else faces.vertices),
        ("<i8", empty if faces is None else faces.start),
        ("<f4", unit.heights),
        ("<f4", unit.sigmas),
        ("<f4", empty if faces is None else faces.sigmas),
        ("<i4", empty if faces is None else faces.corners),
    ]
    raw = head + b"".join(_shuffled(np.ascontiguousarray(part, kind)) for kind, part in parts)
    return zlib.compress(raw, _LEVEL), len(raw)


def unit_of(buffer: NDArray[np.uint8], layout: UnitLayout, column: int, row: int) -> Unit:
    """A unit as views of the bytes that `inflate` gave."""
    shape = _shape(buffer.tobytes() if len(buffer) < _UNIT.size else buffer[: _UNIT.size].tobytes(), "unit")
    vertices, start, heights, sigmas, face_sigmas, corners = _views(buffer, _UNIT.size, shape.sections)
    n = shape.meshes
    faces = None
    if shape.faces:
        faces = MeshFaces(vertices.reshape(-1, 3), face_sigmas, corners.reshape(-1, 3), start)
    left, top = layout.corner(column, row)
    side = (n + 1, n + 1)
    return Unit(
        left=left,
        top=top,
        side=layout.side,
        heights=heights.reshape(side),
        sigmas=sigmas.reshape(side),
        datum=shape.datum,
        faces=faces,
    )


def inflate(packed: bytes, promised: int, where: str) -> NDArray[np.uint8]:
    """Bytes of a unit or line with every section in its plain order; nothing is expanded beyond what was promised."""
    stream = zlib.decompressobj()
    try:
        head = stream.decompress(packed, _UNIT.size)
        sections, size = _sections(head, where)
        total = size + sum(np.dtype(kind).itemsize * count for kind, count in sections)
        if total != promised or total > MOST_BYTES:
            raise InputError(
                f"{where}: promises {promised} bytes, its head {total} (at most {MOST_BYTES} are read); "
                "the file is damaged, get a fresh copy"
            )
        raw = head + stream.decompress(stream.unconsumed_tail, total - len(head) + 1)
    except zlib.error as error:
        raise InputError(f"{where}: damaged ({error}); get a fresh copy of the file") from None
    if len(raw) != total or stream.unconsumed_tail or not stream.eof:
        raise InputError(f"{where}: does not hold the {total} bytes that it promises; get a fresh copy of the file")
    buffer = np.frombuffer(raw, np.uint8).copy()
    at = size
    for kind, count in sections:
        width = np.dtype(kind).itemsize
        part = buffer[at : at + width * count]
        part[:] = part.reshape(width, count).T.ravel()
        at += width * count
    return buffer


def check_unit(unit: Unit, where: str) -> None:
    """Refuse a unit that no computation could use safely."""
    n = unit.meshes
    if not 1 <= n <= MOST_MESHES or unit.heights.shape != (n + 1, n + 1) or unit.sigmas.shape != (n + 1, n + 1):
        raise InputError(f"{where}: posts {unit.heights.shape} and their deviations {unit.sigmas.shape}; not a unit")
    if not np.isfinite(unit.datum) or np.isinf(unit.heights).any() or np.isinf(unit.sigmas).any():
        raise InputError(f"{where}: an infinite height")
    faces = unit.faces
    if faces is None:
        return
    k, f = len(faces.vertices), len(faces.corners)
    shapes = faces.vertices.shape, faces.sigmas.shape, faces.corners.shape, faces.start.shape
    if shapes != ((k, 3), (k,), (f, 3), (n * n + 1,)):
        raise InputError(f"{where}: arrays of triangles with shapes {shapes}; not those of a unit")
    if faces.start[0] != 0 or faces.start[-1] != f or (np.diff(faces.start) < 0).any():
        raise InputError(f"{where}: the triangles are not in the order of the meshes")
    if f and (faces.corners.min() < 0 or faces.corners.max() >= k):
        raise InputError(f"{where}: a triangle names a vertex that does not exist")
    if k:
        slack = unit.width
        low, high = faces.vertices.min(axis=0), faces.vertices.max(axis=0)
        inside = (
            low[0] >= unit.left - slack
            and high[0] <= unit.left + unit.side + slack
            and low[1] >= unit.top - unit.side - slack
            and high[1] <= unit.top + slack
        )
        # A vertex without height belongs to no triangle that has a surface.
        if not inside or np.isinf(faces.vertices[:, 2]).any():
            raise InputError(f"{where}: a vertex outside of the unit, or not finite")


def pack_line(line: LineElement) -> tuple[bytes, int]:
    """Compressed bytes of a line's vertices, and their number before compression."""
    head = _LINE.pack(_LINE_MAGIC, len(line.xyz), int(line.right is not None), LINE_KINDS.index(line.kind))
    parts = [line.xyz, line.sigmas] if line.right is None else [line.xyz, line.right, line.sigmas]
    raw = head + b"\0" * (_UNIT.size - _LINE.size)
    raw += b"".join(_shuffled(np.ascontiguousarray(part, "<f8")) for part in parts)
    raw += np.ascontiguousarray(line.on_grid, np.uint8).tobytes()
    return zlib.compress(raw, _LEVEL), len(raw)


def unpack_line(buffer: NDArray[np.uint8], name: str, code: str, where: str) -> LineElement:
    """A line of the bytes that `inflate` gave."""
    _, count, two_sided, kind = _LINE.unpack_from(buffer[: _LINE.size].tobytes())
    sections, size = _sections(buffer[: _UNIT.size].tobytes(), where)
    parts = _views(buffer, size, sections)
    xyz = parts[0].reshape(count, 3)
    if kind >= len(LINE_KINDS) or not np.isfinite(xyz[:, :2]).all():
        raise InputError(f"{where}: kind {kind}, or a coordinate that is not finite")
    right = parts[1] if two_sided else None
    return LineElement(
        name=name,
        kind=LINE_KINDS[kind],
        code=code,
        xyz=xyz,
        right=right,
        sigmas=parts[-2],
        on_grid=parts[-1].astype(bool),
    )


def _sections(head: bytes, where: str) -> tuple[Sections, int]:
    if len(head) == _UNIT.size and head[:4] == _LINE_MAGIC:
        _, count, two_sided, _ = _LINE.unpack_from(head)
        right: Sections = (("<f8", count),) if two_sided else ()
        return (("<f8", 3 * count), *right, ("<f8", count), ("u1", count)), _UNIT.size
    return _shape(head, where).sections, _UNIT.size


def _shape(head: bytes, where: str) -> _Shape:
    if len(head) != _UNIT.size or head[:4] != _UNIT_MAGIC:
        raise InputError(f"{where}: is not stored as this version reads it; the file is damaged, get a fresh copy")
    _, meshes, vertices, triangles, faces, datum = _UNIT.unpack(head)
    if not 1 <= meshes <= MOST_MESHES:
        raise InputError(f"{where}: {meshes} meshes along a side; 1 to {MOST_MESHES} are allowed")
    return _Shape(meshes=meshes, vertices=vertices, triangles=triangles, faces=bool(faces), datum=datum)


def _views(buffer: NDArray[np.uint8], at: int, sections: Sections) -> list[NDArray[Any]]:
    views = []
    for kind, count in sections:
        end = at + np.dtype(kind).itemsize * count
        views.append(buffer[at:end].view(kind))
        at = end
    return views


def _shuffled(values: NDArray[Any]) -> bytes:
    """Bytes of numbers, the first byte of all, the second of all …"""
    return values.reshape(-1).view(np.uint8).reshape(-1, values.itemsize).T.tobytes()


FORMAT = 1
"""Number of the layout; a file with another one is refused."""
MOST_UNITS = 4_000_000
"""Computing units of a model at most."""

HEADER = "photoplan_terrain"
UNITS = "photoplan_terrain_units"
LINES = "photoplan_terrain_lines"


@dataclass(frozen=True)
class GrossError:
    """A measurement that was flagged: it contradicts its neighbours more than its accuracy allows."""

    name: str
    """How users find it: file, record, own name."""
    kind: str
    """Mass point, spot height, or the kind of its line."""
    xyz: tuple[float, float, float]
    """X, Y, Z as measured, metres."""
    residual: float
    """Measured height less that of the surface without this measurement, metres."""
    redundancy: float
    """Share of an error that shows in the residual, 0 to 1."""
    normalised: float
    """Residual in units of its own standard deviation."""


@dataclass(frozen=True)
class ModelHeader:
    """What identifies a terrain model."""

    crs: str
    """Projected CRS in metres, as pyproj reads it."""
    height_system: str | None
    """Vertical CRS or `ellipsoidal`; None: not stated."""
    layout: UnitLayout
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What the model was computed with; JSON values."""
    inputs: tuple[Mapping[str, Any], ...] = ()
    """Files that it was computed from, see `input_facts`."""
    family: str = ""
    """Family of the covariance functions, such as `gaussian`; empty: not predicted."""
    totals: Mapping[str, Any] = field(default_factory=dict)
    """Figures of the whole model; JSON values."""
    made_by: str = ""
    """Program and version; set when the file is written."""
    identity: str = ""
    """Digest of all units; set when the file is written."""


def input_facts(path: Path) -> dict[str, Any]:
    """Name, size and digest of an input, for the header."""
    found = fingerprint(path)
    return {"file": Path(path).name, "bytes": found.size, "sha256_sampled": found.digest}


def empty_figures(column: int, row: int) -> UnitFigures:
    """Figures of a unit without a surface."""
    nan = math.nan
    return UnitFigures(
        column=column,
        row=row,
        meshes=0,
        low=nan,
        high=nan,
        points=0,
        lines=0,
        variance=nan,
        length=nan,
        noise=nan,
        sigma=nan,
        spread=nan,
        gross=0,
    )


def check_layout(layout: UnitLayout, where: str) -> None:
    """Refuse more units than can be handled."""
    if layout.columns * layout.rows > MOST_UNITS:
        raise InputError(
            f"{where}: {layout.columns} × {layout.rows} units; at most {MOST_UNITS} are allowed: take larger units"
        )


def header_to_json(header: ModelHeader) -> str:
    """The header as text."""
    return json_text(header, "header", indent=None)


def header_from_json(text: str, path: Path) -> ModelHeader:
    """The header of a file's text."""
    try:
        content = json.loads(text)
        place = content["layout"]
        left, top, side = (float(place[name]) for name in ("left", "top", "side"))
        layout = UnitLayout(left=left, top=top, side=side, columns=int(place["columns"]), rows=int(place["rows"]))
        check_layout(layout, str(path))
        header = ModelHeader(
            crs=content["crs"],
            height_system=content["height_system"],
            layout=layout,
            settings=dict(content["settings"]),
            inputs=tuple(dict(item) for item in content["inputs"]),
            family=content["family"],
            totals=dict(content["totals"]),
            made_by=content["made_by"],
            identity=content["identity"],
        )
    except InputError as error:
        raise InputError(f"{path}: header of the terrain model: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(f"{path}: header of the terrain model is damaged ({error!r}); get a fresh copy") from None
    texts = (header.crs, header.height_system or "", header.family, header.made_by, header.identity)
    if not all(isinstance(text, str) for text in texts) or not header.crs:
        raise InputError(f"{path}: header of the terrain model: no CRS, or no text where one is needed")
    return header


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
    ranges: Floats = field(init=False, repr=False)
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

    def _read_ranges(self, layout: UnitLayout) -> tuple[Floats, int]:
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
