"""Objects: meshes, CityJSON and polygons."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.arrays import Floats, Ints
from photoplan.errors import InputError
from photoplan.geometry.crs import split_compound
from photoplan.io.files import check_plain_file, elements, finite, members, number_rows, read_head, read_json_lines
from photoplan.io.vector_layer import is_drawing, read_chosen, states_crs
from photoplan.surfaces.polygon_faces import Rings, filled


@dataclass(frozen=True, eq=False)
class ObjectFile:
    """Triangles of a file's objects, in its own coordinates."""

    corners: Floats
    """X, Y, Z, shape (n, 3, 3), finite."""
    owner: NDArray[np.int32]
    """Object of each triangle, its place in `names`, shape (n,)."""
    names: tuple[str, ...]
    roles: tuple[str | None, ...]
    """``paint``, ``occluder``, or None where the file does not say, of each object."""
    crs: str | None
    """Horizontal CRS as stated; None: it is not."""
    height_system: str | None
    unit: float | None = None
    """Metres in the unit that a drawing states for all its coordinates; None: none is stated."""
    mesh: bool = False
    """Whether it is a mesh, which by itself only hides."""
    faults: Mapping[str, str] = field(default_factory=dict)
    """What is wrong with polygons that have no triangles for it, by name of the object."""


def from_polygons(
    where: str,
    polygons: list[Rings],
    objects: list[int],
    names: list[str],
    crs: str | None = None,
    roles: list[str | None] | None = None,
    unit: float | None = None,
) -> ObjectFile:
    """Objects of polygons."""
    corners, polygon, faults = filled(polygons, [names[k] for k in objects])
    if not len(corners) and not faults:
        raise InputError(f"{where}: holds no face of an object; give a file or a layer that does")
    horizontal, heights = (None, None) if crs is None else split_compound(crs, f"{where}: CRS")
    owner = np.array(objects, np.int32)[polygon]
    said = tuple(roles or [None] * len(names))
    return ObjectFile(
        corners=corners,
        owner=owner,
        names=tuple(names),
        roles=said,
        crs=horizontal,
        height_system=heights,
        unit=unit,
        faults=faults,
    )


#: Types that are read if nobody says which: what stands on the ground, not what is the ground.
STANDING = ("Building", "Bridge")
#: How deep lists of surfaces are in lists, by the type of a geometry.
_DEPTH = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
#: Surfaces of an object that the ground is, or that are none.
_NO_FACES = ("GroundSurface", "ClosureSurface")
_MOST_BYTES = 1 << 29
#: No coordinate of a map is as large as this, metres or feet.
_FARTHEST = 1e12


def read(path: Path, layer: str | None) -> ObjectFile:
    """Faces of the objects of a CityJSON file; `layer`: of one type, with its parts (``Bridge``, ``BridgePart`` …).

    Where surfaces have a meaning, ground and closure surfaces are left out. A file may be a sequence (CityJSONSeq): the
    first line states what all have in common, each other one is a feature with vertices of its own.
    """
    data, *features = read_json_lines(path, _MOST_BYTES)
    version = str(data.get("version", "")) if isinstance(data, dict) else ""
    if not version or data.get("type") != "CityJSON" or not re.fullmatch(r"(1\.[01]|2\.0)(\.\d+)?", version):
        raise InputError(f"{path}: not CityJSON 1.0 to 2.0 (version {version[:20]!r}); convert it with cjio")
    templates = _templates(path, data)
    transform = members(data.get("transform"), f"{path}: transform")
    types = STANDING if layer is None else (layer,)
    polygons: list[list[Floats]] = []
    objects: list[int] = []
    names: list[str] = []
    there: set[str] = set()
    for holder in (data, *features):
        if holder is not data and (not isinstance(holder, dict) or holder.get("type") != "CityJSONFeature"):
            raise InputError(f"{path}: a line of the sequence is no CityJSONFeature; get a fresh copy")
        vertices = _vertices(path, holder.get("vertices"), transform)
        if "CityObjects" not in holder:
            raise InputError(f"{path}: no CityObjects; get a fresh copy")
        city = members(holder["CityObjects"], f"{path}: CityObjects")
        for name, item in city.items():
            kind = str(item.get("type", "")).lstrip("+") if isinstance(item, dict) else ""
            there.add(kind)
            if not kind.startswith(types):
                continue
            try:
                found = list(_faces(item.get("geometry") or [], vertices, templates))
            except (
                TypeError,
                KeyError,
                IndexError,
                ValueError,
                AttributeError,
                OverflowError,
                RecursionError,
            ) as error:
                raise InputError(
                    f"{path}: object {name[:100]!r}: damaged geometry ({error}); get a fresh copy"
                ) from None
            if found:
                polygons += found
                objects += [len(names)] * len(found)
                names.append(name)
    if not polygons:
        told = ", ".join(sorted(there - {""}))[:300] or "none"
        raise InputError(
            f"{path}: no {' or '.join(types)} with faces; its types are {told}; layer = … in [[objects]] chooses one"
        )
    return from_polygons(str(path), polygons, objects, names, _crs(path, data))  # type: ignore[arg-type]


def _vertices(path: Path, stated: Any, transform: dict[str, Any]) -> Floats:
    vertices = number_rows(stated, f"{path}: vertices", 3)
    if transform:
        scale, translate = (finite(transform.get(k), f"{path}: transform {k}", 3) for k in ("scale", "translate"))
        with np.errstate(over="ignore", invalid="ignore"):
            vertices = vertices * scale + translate
    if not (np.abs(vertices) < _FARTHEST).all():
        raise InputError(f"{path}: vertices that lie nowhere on a map; check `transform`, or get a fresh copy")
    return vertices


_Templates = tuple[list[Any], Floats]
"""Geometries that objects share, and their vertices."""


def _templates(path: Path, data: dict[str, Any]) -> _Templates:
    stated = data.get("geometry-templates")
    if stated is None:
        return [], np.empty((0, 3))
    where = f"{path}: geometry-templates"
    held = members(stated, where)
    templates = elements(held.get("templates"), f"{where}: templates")
    return templates, _vertices(path, held.get("vertices-templates"), {})


def _faces(geometries: list[Any], vertices: Floats, templates: _Templates) -> Iterator[list[Floats]]:
    """Surfaces, each a list of rings, of the finest geometry that has some."""
    placed = [_placed(g, vertices, templates) for g in geometries]
    usable = [each for each in placed if each[0]["type"] in _DEPTH]
    if not usable:
        return
    finest, own = max(usable, key=lambda each: float(each[0].get("lod", 0)))
    semantics = finest.get("semantics") or {}
    none = {k for k, s in enumerate(semantics.get("surfaces", ())) if s["type"] in _NO_FACES}
    for face in _of_depth(finest["boundaries"], semantics.get("values"), _DEPTH[finest["type"]], none):
        yield [_ring(ring, own) for ring in face]


def _placed(geometry: dict[str, Any], vertices: Floats, templates: _Templates) -> tuple[dict[str, Any], Floats]:
    """A geometry and the vertices that it counts; an instance is its template, moved to its place."""
    if geometry["type"] != "GeometryInstance":
        return geometry, vertices
    number, (anchor,) = geometry["template"], geometry["boundaries"]
    if not 0 <= number < len(templates[0]):
        raise ValueError(f"template {number} of {len(templates[0])}")
    M = np.array(geometry["transformationMatrix"], float).reshape(4, 4)
    if not (np.isfinite(M).all() and (M[3] == (0, 0, 0, 1)).all()):
        raise ValueError("a transformationMatrix that moves and turns nothing in space")
    return templates[0][number], templates[1] @ M[:3, :3].T + M[:3, 3] + _ring([anchor], vertices)[0]


def _of_depth(items: list[Any], values: Any, depth: int, none: set[int]) -> Iterator[list[list[int]]]:
    for k, item in enumerate(items):
        value = None if values is None else values[k]
        if depth:
            yield from _of_depth(item, value, depth - 1, none)
        elif value is None or value not in none:
            yield item


def _ring(places: list[int], vertices: Floats) -> Floats:
    at = np.array(places)
    if at.ndim != 1 or (len(at) and at.dtype.kind != "i"):
        raise ValueError(f"a ring {str(places)[:60]} that is no list of vertices")
    if len(at) and not 0 <= at.min() <= at.max() < len(vertices):
        raise ValueError(f"vertex {at.max() if at.min() >= 0 else at.min()} of {len(vertices)}")
    return np.asarray(vertices[at.astype(int)])


def _crs(path: Path, data: dict[str, Any]) -> str | None:
    stated = members(data.get("metadata"), f"{path}: metadata").get("referenceSystem")
    # Two codes are those of a compound CRS.
    found = re.findall(r"EPSG(?:::|/\d{1,8}/|/[\d.]{1,12}/|:)(\d{1,8})(?!\d)", str(stated))
    return f"EPSG:{'+'.join(found)}" if len(found) in (1, 2) else None


_MOST_BYTES_MESH = 4 << 30
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


def _obj_lines(lines: list[bytes], before: int) -> tuple[Floats, Ints]:
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


def _text(path: Path, body: int, elements: list[Any]) -> tuple[Floats, Ints]:
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


def _vertex_rows(values: Floats, counts: Ints, properties: list[_Property]) -> Floats:
    columns = [[p[0] for p in properties].index(axis) for axis in "xyz"]
    if (counts != len(properties)).any():
        raise ValueError(f"a vertex of {counts[counts != len(properties)][0]} instead of {len(properties)} numbers")
    return values.reshape(-1, len(properties))[:, columns]


def _face_rows(values: Floats, counts: Ints, properties: list[_Property]) -> Ints:
    before = _before_list(properties)
    start = np.cumsum(counts) - counts
    corners = values[np.minimum(start + before, start + counts - 1)].astype(np.int64)
    if (before + 1 + corners > counts).any() or (corners < 0).any():
        raise ValueError("a face of fewer corners than it says")
    at = np.repeat(start + before + 1, corners) + _within(corners)
    return _fans(values[at].astype(np.int64), corners)


def _binary(path: Path, body: int, order: str, elements: list[Any]) -> tuple[Floats, Ints]:
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


def _rows(raw: Any, at: int, count: int, order: str, properties: list[_Property]) -> tuple[Ints, Ints, int]:
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


def _numbers(lines: list[bytes], idle: bytes = b"") -> tuple[Floats, Ints]:
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


def _within(counts: Ints) -> Ints:
    """0, 1, 2 … for each of the counts."""
    return np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)


def _fans(corners: Ints, counts: Ints) -> Ints:
    """Triangles of faces from their first corners, given all corners and how many each has; less than three: none."""
    triangles = np.maximum(counts - 2, 0)
    first = np.repeat(np.cumsum(counts) - counts, triangles)
    second = first + 1 + _within(triangles)
    return corners[np.stack([first, second, second + 1], axis=1)]


def _size(path: Path) -> int:
    size = path.stat().st_size
    if size > _MOST_BYTES_MESH:
        raise InputError(f"{path}: {size} bytes; at most {_MOST_BYTES_MESH} are read of a mesh: cut out what is needed")
    return size


def _refuse_many(path: Path, faces: int, vertices: int) -> None:
    if max(faces, vertices) > _MOST:
        raise InputError(
            f"{path}: more than {_MOST:,} faces or vertices; cut out what is needed, or make the mesh coarser"
        )


def _mesh(path: Path, vertices: Floats, faces: Ints) -> ObjectFile:
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


_NAMES = ("name", "id", "nr", "label")
_ROLES = ("paint", "occluder")
_LINE, _POLYGON = 1, 3


def read_vector(path: Path, layer: str | None) -> ObjectFile:
    """Polygons with heights, one object for each feature; `layer`: of one layer, in drawings of a drawing's layer.

    Closed lines of drawings are polygons. An attribute ``role`` says ``paint`` or ``occluder``, ``name`` what a feature
    is called.
    """
    drawing = is_drawing(path)
    name, found = read_chosen(path, layer)
    shapes, fields = found.shapes, {field.casefold(): values for field, values in found.fields.items()}
    use = ~(shapely.is_missing(shapes) | shapely.is_empty(shapes))
    if drawing:
        use &= np.isin(shapely.get_type_id(shapes), (_LINE, _POLYGON, 6, 7))
        if layer is not None:
            on = fields["layer"].astype(str)
            use &= on == layer
            if not use.any():
                raise InputError(f"{path}: no faces on layer {layer!r}; it has {', '.join(sorted(set(on)))[:300]}")
    rows = np.flatnonzero(use)
    called = next((fields[key] for key in _NAMES if key in fields), None)
    names = [_name(name, called, row) for row in rows.tolist()]
    roles = [
        None if "role" not in fields else _role(path, n, fields["role"][row]) for n, row in zip(names, rows.tolist())
    ]
    polygons: list[list[Floats]] = []
    objects: list[int] = []
    for k, row in enumerate(rows):
        for part in shapely.get_parts(shapely.get_parts(shapes[row])):
            rings = _rings(part, drawing)
            if rings is None:
                raise InputError(f"{path}: {names[k]!r} is a {part.geom_type}; polygons with heights are needed")
            polygons.append(rings)
            objects.append(k)
    crs = found.crs if drawing or states_crs(path) else None
    return from_polygons(str(path), polygons, objects, names, crs, roles, found.unit)  # type: ignore[arg-type]


def _name(layer: str, called: Any, row: int) -> str:
    text = "" if called is None or called[row] is None else str(called[row]).strip()
    return text or f"{layer} {row + 1}"


def _role(path: Path, name: str, value: Any) -> str | None:
    text = "" if value is None else str(value).strip().casefold()
    if text and text not in _ROLES:
        raise InputError(f"{path}: {name!r}: role {text[:40]!r}; allowed are {', '.join(_ROLES)}, or nothing")
    return text or None


def _rings(part: Any, drawing: bool) -> list[Floats] | None:
    """Rings of a polygon or, in a drawing, of a closed line; None: it is neither."""
    if part.geom_type == "Polygon":
        lines = [part.exterior, *part.interiors]
    elif drawing and part.geom_type == "LineString" and part.is_closed:
        lines = [part]
    else:
        return None
    return [shapely.get_coordinates(line, include_z=True) for line in lines]


def read_objects(path: Path, layer: str | None = None) -> ObjectFile:
    """Faces of the objects of a file, which its content names, not its suffix; some may have faults."""
    path = check_plain_file(path, "object file")
    head = read_head(path).lstrip("\x1e \t\n")
    if head.startswith("ply"):
        return read_ply(path)
    if (
        re.search(r'"type"\s*:\s*"CityJSON"', head)
        or ("CityObjects" in head)
        or path.name.endswith((".city.json", ".city.jsonl"))
    ):
        return read(path, layer)
    if re.search(r"^(v|f|o|g|vn|vt|mtllib|usemtl) ", head, re.MULTILINE) and path.suffix.casefold() == ".obj":
        return read_obj(path)
    vectors = ("SQLite", "{", "AutoCAD Binary DXF")
    if head.startswith(vectors) or path.suffix.casefold() in (".dxf", ".shp", ".fgb"):
        return read_vector(path, layer)
    raise InputError(
        f"{path}: not a file of objects that is read here; allowed are CityJSON, GeoPackage, GeoJSON, Shapefile, DXF, "
        "OBJ and PLY"
    )
