"""Meshes that hide what is behind them: Wavefront OBJ and Stanford PLY, text and binary."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.objects.model import ObjectFile

_MOST_BYTES = 4 << 30
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_HEADER = 1 << 16


def read_obj(path: Path) -> ObjectFile:
    """Faces of an OBJ file; those of more than three corners are cut into triangles from their first.

    Raises
    ------
    InputError
        A line cannot be read, or a face names a vertex that is not there.
    """
    _size(path)
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            word, *rest = line.split() or [""]
            try:
                if word == "v":
                    x, y, z = (float(v) for v in rest[:3])
                    vertices.append([x, y, z])
                elif word == "f":
                    # Counted from 1, or backwards from the last vertex so far.
                    at = [int(part.split("/")[0]) for part in rest]
                    at = [k - 1 if k > 0 else len(vertices) + k for k in at]
                    if len(at) < 3 or min(at) < 0:
                        raise ValueError("a face needs three corners that are there")
                    faces += [(at[0], at[k], at[k + 1]) for k in range(1, len(at) - 1)]
            except ValueError as error:
                raise InputError(f"{path}:{number}: {line.strip()[:60]!r} is no {word} ({error}); repair it") from None
    return _mesh(path, np.array(vertices, float).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3))


def read_ply(path: Path) -> ObjectFile:
    """Faces of a PLY file, as `read_obj`.

    Raises
    ------
    InputError
        The header promises more than the file holds, or a face names a vertex that is not there.
    """
    size = _size(path)
    with path.open("rb") as file:
        head = file.read(_HEADER)
    end = head.find(b"end_header")
    body = head.find(b"\n", end) + 1
    if end < 0 or not body:
        raise InputError(f"{path}: no end of the PLY header in {_HEADER} bytes; get a fresh copy")
    form, elements = _header(path, head[:end].decode("ascii", "replace"))
    for name, count, _ in elements:
        if not 0 <= count <= size - body:
            raise InputError(f"{path}: promises {count} of {name!r} in {size} bytes; the file is damaged")
    try:
        found = _text(path, body, elements) if form == "ascii" else _binary(path, body, form, elements)
    except (ValueError, IndexError, KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged ({error}); get a fresh copy") from None
    return _mesh(path, *found)


_Property = tuple[str, str, str | None]
"""Name, type, and for a list the type of its length."""


def _header(path: Path, text: str) -> tuple[str, list[tuple[str, int, list[_Property]]]]:
    form, elements = "", list[tuple[str, int, list[_Property]]]()
    try:
        for line in text.splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                form = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1][2].append((words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1][2].append((words[2], _TYPES[words[1]], None))
    except (KeyError, IndexError, ValueError):
        raise InputError(f"{path}: PLY header line {line.strip()[:80]!r} is not understood") from None
    if not form or not {"vertex", "face"} <= {name for name, *_ in elements}:
        raise InputError(f"{path}: a PLY file with vertices and faces is needed")
    return form, elements


def _text(path: Path, body: int, elements: list[Any]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    vertices, faces = np.empty((0, 3)), np.empty((0, 3), np.int64)
    with path.open("rb") as file:
        file.seek(body)
        for name, count, properties in elements:
            rows = [file.readline().split() for _ in range(count)]
            if name == "vertex":
                columns = [[p[0] for p in properties].index(axis) for axis in "xyz"]
                vertices = np.array([[float(row[k]) for k in columns] for row in rows]).reshape(-1, 3)
            elif name == "face":
                before = _before_list(properties)
                lists = [[int(v) for v in row[before + 1 : before + 1 + int(row[before])]] for row in rows]
                faces = _fans(lists)
    return vertices, faces


def _binary(path: Path, body: int, order: str, elements: list[Any]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    raw = np.memmap(path, np.uint8, "r")
    vertices, faces, at = np.empty((0, 3)), np.empty((0, 3), np.int64), body
    for name, count, properties in elements:
        lists = [p for p in properties if p[2] is not None]
        if not lists:
            row = np.dtype([(p[0], order + p[1]) for p in properties])
            table = np.frombuffer(raw[at : at + count * row.itemsize], row, count)
            at += count * row.itemsize
            if name == "vertex":
                vertices = np.stack([table[axis].astype(float) for axis in "xyz"], axis=-1)
            continue
        if name != "face" or len(lists) > 1:
            raise ValueError(f"lists in {name!r}, or several in a face, are not read")
        # Nearly always all are triangles: rows of one length, which is then checked.
        fields = [(p[0], order + p[1], 3) if p[2] else (p[0], order + p[1]) for p in properties]
        place = properties.index(lists[0])
        fields.insert(place, ("count", order + lists[0][2]))
        row = np.dtype(fields)
        if len(raw) - at >= count * row.itemsize:
            table = np.frombuffer(raw[at : at + count * row.itemsize], row, count)
            if (table["count"] == 3).all():
                faces = table[lists[0][0]].astype(np.int64)
                at += count * row.itemsize
                continue
        corners, at = _rows(raw, at, count, order, properties)
        faces = _fans(corners)
    return vertices, faces


def _rows(raw: Any, at: int, count: int, order: str, properties: list[_Property]) -> tuple[list[list[int]], int]:
    """Lists of faces of several lengths, one by one, and where they end."""
    corners = []
    for _ in range(count):
        for _, kind, length in properties:
            many = 1
            if length is not None:
                counted = np.dtype(order + length)
                many = int(np.frombuffer(raw[at : at + counted.itemsize], counted, 1)[0])
                at += counted.itemsize
            item = np.dtype(order + kind)
            values = np.frombuffer(raw[at : at + many * item.itemsize], item, many)
            at += many * item.itemsize
            if length is not None:
                corners.append(values.astype(int).tolist())
    return corners, at


def _before_list(properties: list[_Property]) -> int:
    places = [k for k, p in enumerate(properties) if p[2] is not None]
    if len(places) != 1:
        raise ValueError("a face needs one list of vertices")
    return places[0]


def _fans(lists: list[list[int]]) -> NDArray[np.int64]:
    faces = [(at[0], at[k], at[k + 1]) for at in lists for k in range(1, len(at) - 1)]
    return np.array(faces, np.int64).reshape(-1, 3)


def _size(path: Path) -> int:
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise InputError(f"{path}: {size} bytes; at most {_MOST_BYTES} are read of a mesh: cut out what is needed")
    return size


def _mesh(path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> ObjectFile:
    if not len(faces):
        raise InputError(f"{path}: holds no faces; a mesh is needed, not a cloud of points")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: a face names vertex {faces.max()} of {len(vertices)}; get a fresh copy")
    corners = vertices[faces]
    if not np.isfinite(corners).all():
        raise InputError(f"{path}: vertices that are no numbers; get a fresh copy")
    return ObjectFile(corners, np.zeros(len(corners), np.int32), (path.stem,), (None,), None, None, mesh=True)
