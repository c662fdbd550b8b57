"""Meshes that hide what is behind them: Wavefront OBJ and Stanford PLY, text and binary."""

from __future__ import annotations

import itertools
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.objects.model import ObjectFile

_MOST_BYTES = 4 << 30
#: Faces or vertices of a mesh at most: kept, a face takes some 300 bytes.
_MOST = 20_000_000
#: Lines of a text that are read together.
_BATCH = 100_000
_VERTEX, _FACE = (b"v ", b"v\t"), (b"f ", b"f\t")
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
    """Faces of an OBJ file; those of more than three corners are cut into triangles from their first."""
    _size(path)
    vertices, faces = [np.empty((0, 3))], [np.empty((0, 3), np.int64)]
    count = first = 0
    with path.open("rb") as file:
        while lines := [line.lstrip() for line in itertools.islice(file, _BATCH)]:
            lines[0] = lines[0].removeprefix(b"\xef\xbb\xbf")
            try:
                part = _obj_lines(lines, count)
            except ValueError:
                _name_line(path, lines, first + 1, count)
                raise
            vertices.append(part[0])
            faces.append(part[1])
            count, first = count + len(part[0]), first + len(lines)
            _refuse_many(path, sum(map(len, faces)), count)
    return _mesh(path, np.concatenate(vertices), np.concatenate(faces))


def _obj_lines(lines: list[bytes], before: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and triangles of some lines, with so many vertices before them."""
    of_v, of_f = (
        np.fromiter((line.startswith(words) for line in lines), bool, len(lines)) for words in (_VERTEX, _FACE)
    )
    values, counts = _numbers([lines[k][1:] for k in np.flatnonzero(of_v)])
    if (counts < 3).any():
        raise ValueError("a vertex needs three numbers")
    start = np.cumsum(counts) - counts
    vertices = values[start[:, None] + np.arange(3)]
    values, counts = _numbers([lines[k][1:] for k in np.flatnonzero(of_f)], rb"/\S*")
    # Counted from 1, or backwards from the last vertex so far.
    so_far = np.repeat((before + np.cumsum(of_v))[of_f], counts)
    places = np.where(values > 0, values - 1, so_far + values)
    if (counts < 3).any() or (places < 0).any() or (places != np.rint(places)).any():
        raise ValueError("a face needs three corners that are there")
    return vertices, _fans(places.astype(np.int64), counts)


def _name_line(path: Path, lines: list[bytes], first: int, before: int) -> None:
    """Refuse the first of some lines that cannot be read by itself."""
    for number, line in enumerate(lines, first):
        try:
            before += len(_obj_lines([line], before)[0])
        except ValueError as error:
            said = line.decode("utf-8", "replace").strip()[:60]
            raise InputError(f"{path}:{number}: {said!r} is no {said[:1]} ({error}); repair it") from None


def read_ply(path: Path) -> ObjectFile:
    """Faces of a PLY file, as `read_obj`."""
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
        _refuse_many(path, count, 0)
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
    found: dict[str, list[Any]] = {"vertex": [np.empty((0, 3))], "face": [np.empty((0, 3), np.int64)]}
    with path.open("rb") as file:
        file.seek(body)
        for name, count, properties in elements:
            for start in range(0, count, _BATCH):
                rows = list(itertools.islice(file, min(_BATCH, count - start)))
                if name in found:
                    values, counts = _numbers(rows)
                    if len(rows) < min(_BATCH, count - start) or not counts.all():
                        raise ValueError(f"less than {count} rows of {name!r}")
                    read = _vertex_rows if name == "vertex" else _face_rows
                    found[name].append(read(values, counts, properties))
    return np.concatenate(found["vertex"]), np.concatenate(found["face"])


def _vertex_rows(
    values: NDArray[np.float64], counts: NDArray[np.int64], properties: list[_Property]
) -> NDArray[np.float64]:
    columns = [[p[0] for p in properties].index(axis) for axis in "xyz"]
    if (counts != len(properties)).any():
        raise ValueError(f"a vertex of {counts[counts != len(properties)][0]} instead of {len(properties)} numbers")
    return values.reshape(-1, len(properties))[:, columns]


def _face_rows(
    values: NDArray[np.float64], counts: NDArray[np.int64], properties: list[_Property]
) -> NDArray[np.int64]:
    before = _before_list(properties)
    start = np.cumsum(counts) - counts
    corners = values[np.minimum(start + before, start + counts - 1)].astype(np.int64)
    if (before + 1 + corners > counts).any() or (corners < 0).any():
        raise ValueError("a face of fewer corners than it says")
    at = np.repeat(start + before + 1, corners) + _within(corners)
    return _fans(values[at].astype(np.int64), corners)


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
        corners, counts, at = _rows(raw, at, count, order, properties)
        faces = _fans(corners, counts)
    return vertices, faces


def _rows(
    raw: Any, at: int, count: int, order: str, properties: list[_Property]
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Corners of faces of several lengths, how many each has, and where they end."""
    place = _before_list(properties)
    _, kind, length = properties[place]
    item, counted = np.dtype(order + kind), np.dtype(order + str(length))
    before, after = (
        sum(np.dtype(p[1]).itemsize for p in part) for part in (properties[:place], properties[place + 1 :])
    )
    body = raw[at:].tobytes()
    counts, starts, here = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for k in range(count):
        here += before + counted.itemsize
        if here > len(body):
            raise ValueError(f"less than {count} faces")
        many = int.from_bytes(body[here - counted.itemsize : here], "little" if order == "<" else "big")
        counts[k], starts[k] = many, here
        here += many * item.itemsize + after
    if here > len(body):
        raise ValueError(f"less than {count} faces")
    first = np.repeat(starts, counts) + _within(counts) * item.itemsize
    content = np.frombuffer(body, np.uint8)[first[:, None] + np.arange(item.itemsize)]
    return content.copy().view(item)[:, 0].astype(np.int64), counts, at + here


def _before_list(properties: list[_Property]) -> int:
    places = [k for k, p in enumerate(properties) if p[2] is not None]
    if len(places) != 1:
        raise ValueError("a face needs one list of vertices")
    return places[0]


def _numbers(lines: list[bytes], idle: bytes = b"") -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """All numbers of some lines, one after the other, and how many each line has; what fits `idle` is left out."""
    text = b"\n".join(line.rstrip() for line in lines)
    text = re.sub(idle, b"", text) if idle else text
    if not text:
        return np.empty(0), np.zeros(len(lines), np.int64)
    raw = np.frombuffer(text, np.uint8)
    begins = raw > 32
    begins[1:] &= raw[:-1] <= 32
    counts = np.bincount(np.cumsum(raw == 10)[begins], minlength=len(lines))
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values = np.fromstring(text, sep=" ")
        except (DeprecationWarning, ValueError):  # older and newer versions of NumPy
            raise ValueError("numbers, with a point, are needed") from None
    if len(values) != counts.sum():
        raise ValueError("numbers, with a point, are needed")
    return values, counts


def _within(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """0, 1, 2 … for each of the counts."""
    return np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)


def _fans(corners: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles of faces from their first corners, given all corners and how many each has; less than three: none."""
    triangles = np.maximum(counts - 2, 0)
    first = np.repeat(np.cumsum(counts) - counts, triangles)
    second = first + 1 + _within(triangles)
    return corners[np.stack([first, second, second + 1], axis=1)]


def _size(path: Path) -> int:
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise InputError(f"{path}: {size} bytes; at most {_MOST_BYTES} are read of a mesh: cut out what is needed")
    return size


def _refuse_many(path: Path, faces: int, vertices: int) -> None:
    if max(faces, vertices) > _MOST:
        raise InputError(
            f"{path}: more than {_MOST:,} faces or vertices; cut out what is needed, or make the mesh coarser"
        )


def _mesh(path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> ObjectFile:
    if not len(faces):
        raise InputError(f"{path}: holds no faces; a mesh is needed, not a cloud of points")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: a face names vertex {faces.max()} of {len(vertices)}; get a fresh copy")
    corners = vertices[faces]
    if not np.isfinite(corners).all():
        raise InputError(f"{path}: vertices that are no numbers; get a fresh copy")
    return ObjectFile(
        corners=corners,
        owner=np.zeros(len(corners), np.int32),
        names=(path.stem,),
        roles=(None,),
        crs=None,
        height_system=None,
        mesh=True,
    )
