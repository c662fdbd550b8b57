"""Units and lines of a terrain model as bytes: compressed, checked, decoded without trusting a length.

A unit's bytes are a head and sections of numbers, little-endian, compressed as one zlib stream. The bytes of each
section are ordered by their significance (all first bytes, all second bytes …), which compresses far better.
The layout is documented in `docs/reference/terrain-model-file.md`.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.surfaces.measured import LINE_KINDS
from photoplan.surfaces.units import LineElement, MeshFaces, Unit, UnitLayout

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
