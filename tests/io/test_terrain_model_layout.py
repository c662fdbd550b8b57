"""The layout as `docs/reference/terrain-model-file.md` describes it, read by a slow twin that knows only that page."""

from __future__ import annotations

import json
import sqlite3
import struct
import zlib
from pathlib import Path

import numpy as np
from tools.small_model import EMPTY, LAYOUT, lines, unit_at, write_small

from photoplan.surfaces.units import LINE_KINDS


def section(raw: bytes, at: int, kind: str, count: int) -> tuple[list[float], int]:
    """Numbers of a section, byte by byte."""
    width = struct.calcsize(kind)
    numbers = []
    for i in range(count):
        numbers.append(struct.unpack("<" + kind, bytes(raw[at + b * count + i] for b in range(width)))[0])
    return numbers, at + width * count


def test_units_by_the_documented_layout(tmp_path: Path) -> None:
    write_small(tmp_path / "m.gpkg")
    db = sqlite3.connect(tmp_path / "m.gpkg")
    number, content = db.execute("SELECT format, content FROM photoplan_terrain").fetchone()
    layout = json.loads(content)["layout"]
    assert number == 1 and layout == vars(LAYOUT)
    rows = db.execute("SELECT * FROM photoplan_terrain_units ORDER BY id").fetchall()
    assert len(rows) == LAYOUT.columns * LAYOUT.rows - 1
    for id_, column, row, meshes, low, high, size, checksum, packed in rows:
        assert (column, row) != EMPTY and id_ == row * layout["columns"] + column
        assert checksum == zlib.crc32(struct.pack("<QQdd", id_, size, low, high) + packed)
        raw = zlib.decompress(packed)
        magic, n, k, f, faces, datum = struct.unpack("<4sIIIQd", raw[:32])
        assert magic == b"PPU1" and n == meshes and len(raw) == size
        vertices, at = section(raw, 32, "d", 3 * k)
        start, at = section(raw, at, "q", n * n + 1 if faces else 0)
        heights, at = section(raw, at, "f", (n + 1) ** 2)
        sigmas, at = section(raw, at, "f", (n + 1) ** 2)
        vertex_sigmas, at = section(raw, at, "f", k)
        corners, at = section(raw, at, "i", 3 * f)
        assert at == size
        unit = unit_at(column, row)
        assert unit is not None and (unit.faces is not None) == bool(faces) and unit.datum == datum
        assert np.array_equal(np.float32(heights).reshape(n + 1, n + 1), unit.heights)
        assert np.array_equal(np.float32(sigmas).reshape(n + 1, n + 1), unit.sigmas)
        if unit.faces is not None:
            assert np.array_equal(np.reshape(vertices, (-1, 3)), unit.faces.vertices)
            assert np.array_equal(start, unit.faces.start)
            assert np.array_equal(np.float32(vertex_sigmas), unit.faces.sigmas)
            assert np.array_equal(np.reshape(corners, (-1, 3)), unit.faces.corners)
    db.close()


def test_lines_by_the_documented_layout(tmp_path: Path) -> None:
    write_small(tmp_path / "m.gpkg")
    db = sqlite3.connect(tmp_path / "m.gpkg")
    rows = db.execute("SELECT * FROM photoplan_terrain_lines ORDER BY id").fetchall()
    for (id_, name, code, xmin, ymin, xmax, ymax, size, checksum, packed), line in zip(rows, lines(), strict=True):
        assert (name, code, checksum) == (line.name, line.code, zlib.crc32(packed)) and id_ >= 1
        raw = zlib.decompress(packed)
        magic, n, two_sided, kind, rest = struct.unpack("<4sIII16s", raw[:32])
        assert magic == b"PPL1" and rest == bytes(16) and len(raw) == size and LINE_KINDS[kind] == line.kind
        assert LINE_KINDS == ("breakline", "formline", "border", "hole")
        xyz, at = section(raw, 32, "d", 3 * n)
        right, at = section(raw, at, "d", n if two_sided else 0)
        sigmas, at = section(raw, at, "d", n)
        on_grid, at = section(raw, at, "B", n)
        assert at == size
        assert np.array_equal(np.reshape(xyz, (-1, 3)), line.xyz, equal_nan=True)
        assert (right == line.right.tolist()) if line.right is not None else not right
        assert np.array_equal(sigmas, line.sigmas, equal_nan=True)
        assert on_grid == line.on_grid.tolist()
        assert [xmin, ymin, xmax, ymax] == [*line.xyz[:, :2].min(axis=0), *line.xyz[:, :2].max(axis=0)]
    db.close()
