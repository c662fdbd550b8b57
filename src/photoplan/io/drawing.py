"""Drawings (DXF) as points, lines and faces in space, read by ezdxf.

Read are the entities of the model space: points, lines, polylines of all kinds with their elevation and extrusion,
arcs, circles, ellipses and splines as chains of chords, faces (3DFACE, SOLID, MESH, polyface and polygon meshes), texts
as points, and block references. A block that holds heights of its own is unfolded; one that lies in height 0 is a
symbol, and its insertion point is a point. An entity that cannot be read is skipped and counted.
"""

from __future__ import annotations

import io
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.units import DRAWING_UNITS

MAX_BYTES = 2 << 30
#: Entities that unfolded blocks may have in all, and levels of blocks in blocks.
MOST_ENTITIES, MOST_LEVELS = 2_000_000, 32
#: Attributes of blocks that are kept.
MOST_TAGS = 100
#: Vertices that one curve may have, and how far its chords may lie from it, as a part of its extent.
MOST_VERTICES, _FLATNESS = 100_000, 1e-4
#: Key of the entities of all block references together; no block is called so.
_TOTAL = "\0"
_TEXTS = frozenset({"TEXT", "MTEXT", "ATTRIB", "ATTDEF"})
_CURVES = frozenset({"ARC", "CIRCLE", "ELLIPSE", "SPLINE", "HELIX", "LWPOLYLINE", "POLYLINE"})
_FACES = frozenset({"3DFACE", "SOLID", "TRACE"})
#: What holds no measured geometry.
_LEFT_OUT = frozenset({"HATCH", "MPOLYGON", "DIMENSION", "LEADER", "MULTILEADER", "MLEADER", "VIEWPORT", "IMAGE",
                       "WIPEOUT", "OLE2FRAME", "ACAD_TABLE", "TOLERANCE", "RAY", "XLINE", "LIGHT", "SUN",
                       "UNDERLAY"})  # fmt: skip


@dataclass(frozen=True, eq=False)
class DrawingFile:
    """Entities of a drawing in its own coordinates and unit."""

    shapes: NDArray[Any]
    """Points, lines and polygons (faces), shape (n,)."""
    layers: NDArray[Any]
    """Name of each entity's layer, shape (n,)."""
    handles: NDArray[Any]
    """Handle of each entity, that of the block reference if it was unfolded, shape (n,)."""
    texts: NDArray[Any]
    """Text of each entity, shape (n,); None if it is no text."""
    unit: int
    """$INSUNITS; 0: not stated."""
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Texts of the attributes of block references that are points, by tag, shape (n,); None: it has none."""
    notes: tuple[str, ...] = ()


@dataclass
class _Found:
    """What was read so far."""

    shapes: list[Any] = field(default_factory=list)
    layers: list[str] = field(default_factory=list)
    handles: list[str] = field(default_factory=list)
    texts: list[str | None] = field(default_factory=list)
    attributes: dict[str, dict[int, str]] = field(default_factory=dict)
    """By tag, the texts of shapes by their number."""
    left_out: Counter[str] = field(default_factory=Counter)
    unreadable: Counter[str] = field(default_factory=Counter)
    first: str = ""
    unfolded: int = 0
    symbols: int = 0
    endless: int = 0
    """Block references whose blocks in blocks hold too many entities."""


def drawing_metres(path: Path, number: int) -> float | None:
    """Metres in the unit of a drawing by its $INSUNITS; None: it states none."""
    if number == 0:
        return None
    name, metres = DRAWING_UNITS.get(number, (f"number {number}", 0.0))
    if not 1e-6 <= metres <= 1e4:
        raise InputError(
            f"{path}: the drawing states its unit as {name} ($INSUNITS); set $INSUNITS to the unit of its coordinates: "
            "6 is metres, 2 feet, 21 US survey feet, 4 millimetres"
        )
    return metres


def read_drawing(path: Path) -> DrawingFile:
    """All entities of a drawing's model space that have geometry."""
    # Only drawings need it, and it takes a third of a second.
    import ezdxf  # noqa: PLC0415

    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path}: more than {MAX_BYTES >> 30} GiB; export the part that is needed")
    notes: list[str] = []
    try:
        try:
            document = _repaired(path, None, notes) if _has_old_elevations(path) else ezdxf.readfile(path)
        except (ezdxf.DXFError, ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
            document = _repaired(path, error, notes)
        entities = list(document.modelspace())
        unit = document.header.get("$INSUNITS", 0)
    except (InputError, MemoryError):
        raise
    except Exception as error:  # ezdxf raises many kinds of errors for damaged files
        cause = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path}: not a drawing that can be read ({cause}); write it as DXF again") from None
    found = _Found()
    sizes: dict[str, float] = {}
    for entity in entities:
        _take(entity, found, sizes)
    if found.unfolded:
        notes.append(f"{path.name}: {found.unfolded} entities of blocks with heights of their own were unfolded")
    if found.symbols > found.endless:
        count = found.symbols - found.endless
        notes.append(f"{path.name}: {count} blocks lie in height 0: their insertion points are points")
    if found.endless:
        notes.append(
            f"{path.name}: {found.endless} blocks hold more than {MOST_ENTITIES:,} entities with the blocks in them, "
            "and are not unfolded: their insertion points are points"
        )
    if found.left_out:
        told = ", ".join(f"{count} {kind}" for kind, count in sorted(found.left_out.items()))
        notes.append(f"{path.name}: left out: {told[:300]}")
    if found.unreadable:
        told = ", ".join(f"{count} {kind}" for kind, count in sorted(found.unreadable.items()))
        notes.append(f"{path.name}: {found.unreadable.total()} entities cannot be read and are skipped: {told[:200]} "
                     f"(first {found.first})")  # fmt: skip
    shapes = np.empty(len(found.shapes), object)
    shapes[:] = found.shapes
    attributes = {tag: np.full(len(shapes), None, object) for tag in found.attributes}
    for tag, values in found.attributes.items():
        attributes[tag][list(values)] = list(values.values())
    if attributes:
        notes.append(
            f"{path.name}: blocks have attributes: {', '.join(attributes)[:200]}; `height_field` takes heights of one"
        )
    return DrawingFile(
        shapes=shapes,
        layers=np.array(found.layers, object),
        handles=np.array(found.handles, object),
        texts=np.array(found.texts, object),
        unit=unit if isinstance(unit, int) else -1,
        attributes=attributes,
        notes=tuple(notes),
    )


#: Entities in which each coordinate has a group code of its own.
_POINTS_ONCE = ("POINT", "LINE", "3DFACE", "SOLID", "TRACE", "TEXT", "INSERT", "CIRCLE", "ARC", "VERTEX", "POLYLINE")
#: Subclass that holds the geometry of an entity, where programs leave the mark of it out.
_SUBCLASSES = {"LWPOLYLINE": "AcDbPolyline", "SPLINE": "AcDbSpline", "ELLIPSE": "AcDbEllipse", "MTEXT": "AcDbMText",
               "MESH": "AcDbSubDMesh", "HATCH": "AcDbHatch", "HELIX": "AcDbSpline"}  # fmt: skip


#: Versions of drawings in which group 38 may state the elevation of any entity (before release 11; 12 keeps some).
_OLD = (b"AC1.", b"AC2.", b"AC1001", b"AC1002", b"AC1003", b"AC1004", b"AC1006", b"AC1009")


def _has_old_elevations(path: Path) -> bool:
    """Whether a drawing is of an old version, or states none, and has groups 38."""
    with path.open("rb") as file:
        head = file.read(10_000)
    version = re.search(rb"\$ACADVER\s+1\s+(\S+)", head)
    old = version is None or version[1].startswith(_OLD)
    if not old or head.startswith(b"AutoCAD Binary DXF"):
        return False
    return re.search(rb"[\r\n] *38\r?\n", path.read_bytes()) is not None


def _repaired(path: Path, error: Exception | None, notes: list[str]) -> Any:
    """The drawing without entities that cannot be read, with the marks of subclasses that programs leave out, and with
    elevations of old entities as Z; without an error the text is that of a drawing that can be read."""
    import ezdxf.recover  # noqa: PLC0415

    raw = path.read_bytes()
    if error is not None and (raw.startswith(b"AutoCAD Binary DXF") or b"SECTION" not in raw[:100_000]):
        raise error
    lines = raw.decode("utf-8", errors="surrogateescape").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    out: list[str] = []
    lost = 0
    section, modern = "", False
    starts = [k for k in range(0, len(lines) - 1, 2) if lines[k].strip() == "0"]
    for start, stop in zip(starts, [*starts[1:], len(lines)]):
        kind, tags = lines[start + 1].strip(), lines[start:stop]
        if kind == "SECTION":
            section = tags[3].strip() if len(tags) > 3 else ""
        if section in ("ENTITIES", "BLOCKS") and kind not in ("SECTION", "ENDSEC", "BLOCK", "ENDBLK", "EOF"):
            if not all(_is_value(code, value) for code, value in zip(tags[::2], tags[1::2])):
                lost += 1
                continue
            codes = [code.strip() for code in tags[::2]]
            if kind in _POINTS_ONCE and "38" in codes and "30" not in codes:
                height = tags[2 * codes.index("38") + 1]
                if "10" not in codes:  # polylines whose vertices alone have places
                    tags, codes = [*tags, "10", "0", "20", "0"], [*codes, "10", "20"]
                tags += [line for code in codes if re.fullmatch("1[0-3]", code) for line in (f"3{code[1]}", height)]
                codes = [code.strip() for code in tags[::2]]
            if kind in _POINTS_ONCE:
                # X, Y and Z of a point follow each other.
                key = [(int(c) % 10, int(c)) if c.isdigit() and 10 <= int(c) <= 39 else (-1, 0) for c in codes]
                order = sorted(range(len(codes)), key=key.__getitem__)
                tags = [line for k in order for line in tags[2 * k : 2 * k + 2]]
            if kind in _SUBCLASSES and "100" not in codes:
                common = [k for k, code in enumerate(codes) if code in ("0", "5", "8", "6", "62", "330", "48", "60")]
                own = [k for k in range(len(codes)) if k not in common]
                first = [line for k in common for line in tags[2 * k : 2 * k + 2]]
                rest = [line for k in own for line in tags[2 * k : 2 * k + 2]]
                modern = True
                tags = [*first[:2], "100", "AcDbEntity", *first[2:], "100", _SUBCLASSES[kind], *rest]
        out += tags
    if lost:
        notes.append(f"{path.name}: {lost} damaged entities are left out")
    text = "\n".join(out)
    if modern:
        # Programs without these marks state no version either, or one that had no such entities.
        text = re.sub(r"(\n|^) *9\n\$ACADVER\n *1\n[^\n]*(?=\n)", "", text)
        version = "9\n$ACADVER\n1\nAC1015\n"
        head = re.sub(r"^( *0\nSECTION\n *2\nHEADER\n)", lambda found: found[1] + version, text, count=1)
        text = head if head != text else f"0\nSECTION\n2\nHEADER\n{version}0\nENDSEC\n{text}"
    document, auditor = ezdxf.recover.read(io.BytesIO(text.encode("utf-8", errors="surrogateescape")))
    if auditor.errors or auditor.fixes:
        notes.append(f"{path.name}: {len(auditor.errors) + len(auditor.fixes)} faults were repaired")
    return document


def _is_value(code: str, value: str) -> bool:
    """Whether the value of a group is of the type of its code (DXF reference, group code value types)."""
    try:
        number = int(code)
        if 10 <= number <= 59 or 110 <= number <= 149 or 210 <= number <= 239:
            return math.isfinite(float(value))
        if 60 <= number <= 79 or 90 <= number <= 99 or 170 <= number <= 179:
            return abs(int(value)) < 1 << 63
    except ValueError:
        return False
    return True


def _take(entity: Any, found: _Found, sizes: dict[str, float]) -> None:
    """Add the geometry of an entity of the model space; what cannot be read is counted."""
    kind = str(entity.dxftype())
    try:
        layer, handle = str(entity.dxf.get("layer", "0")), str(entity.dxf.handle)
        if kind in _LEFT_OUT:
            found.left_out[kind] += 1
            return
        if kind == "INSERT":
            parts, unfolded = _block(entity, sizes, found)
            found.unfolded += unfolded
            found.symbols += not unfolded
            for attribute in () if unfolded else entity.attribs:
                tag = str(attribute.dxf.tag)
                if tag in found.attributes or len(found.attributes) < MOST_TAGS:
                    found.attributes.setdefault(tag, {})[len(found.shapes)] = str(attribute.dxf.text).strip()
        else:
            parts = [(layer, *item) for item in _geometry(entity, kind)]
    except (MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:  # ezdxf raises many kinds of errors for damaged entities
        if not found.unreadable:
            cause = " ".join(str(error).split())[:80] or type(error).__name__
            found.first = f"{kind} {entity.dxf.get('handle', '?')}: {cause}"
        found.unreadable[kind] += 1
        return
    if not parts:
        found.left_out[kind] += 1
    for own_layer, shape, text in parts:
        found.shapes.append(shape)
        # Layer 0 of a block is that of its reference.
        found.layers.append(layer if own_layer == "0" else own_layer)
        found.handles.append(handle)
        found.texts.append(text)


def _block(insert: Any, sizes: dict[str, float], found: _Found) -> tuple[list[tuple[str, Any, str | None]], int]:
    """Geometry of a block reference, and how many entities it was unfolded to; 0: it is a symbol, a point."""
    name = str(insert.dxf.name)
    size = _size(insert.doc, name, sizes, ())
    copies = max(1, int(insert.dxf.get("row_count", 1))) * max(1, int(insert.dxf.get("column_count", 1)))
    sizes[_TOTAL] = sizes.get(_TOTAL, 0.0) + size * copies
    too_many = sizes[_TOTAL] > MOST_ENTITIES
    if too_many:
        sizes[_TOTAL] = 0.0
        found.endless += 1
    if size and not too_many and _has_heights(insert.doc, name, {}):
        parts: list[tuple[str, Any, str | None]] = []
        count = 0
        for entity in _unfolded(insert, 0):
            count += 1
            kind = str(entity.dxftype())
            if kind not in _LEFT_OUT and kind not in _TEXTS:
                parts += [(str(entity.dxf.get("layer", "0")), *item) for item in _geometry(entity, kind)]
        return parts, count
    at = insert.ocs().to_wcs(insert.dxf.insert)
    return [(str(insert.dxf.get("layer", "0")), shapely.Point(*_finite(at)), None)], 0


def _unfolded(insert: Any, level: int) -> Iterator[Any]:
    if level > MOST_LEVELS:
        return
    for one in insert.multi_insert() if insert.mcount > 1 else (insert,):
        for entity in one.virtual_entities():
            if entity.dxftype() == "INSERT":
                yield from _unfolded(entity, level + 1)
            else:
                yield entity


def _size(document: Any, name: str, sizes: dict[str, float], above: tuple[str, ...]) -> float:
    """Entities of a block when it is unfolded; endless if it holds itself."""
    key = name.casefold()
    if key in above or len(above) > MOST_LEVELS:
        return math.inf
    if key not in sizes:
        block = document.blocks.get(name)
        total = 0.0
        for entity in () if block is None else block:
            if entity.dxftype() == "INSERT":
                copies = max(1, int(entity.dxf.get("row_count", 1))) * max(1, int(entity.dxf.get("column_count", 1)))
                total += copies * _size(document, str(entity.dxf.name), sizes, (*above, key))
            else:
                total += 1
        sizes[key] = total
    return sizes[key]


def _has_heights(document: Any, name: str, seen: dict[str, bool]) -> bool:
    """Whether a block's entities have heights other than 0 in the block."""
    key = name.casefold()
    if key not in seen:
        seen[key] = False
        block = document.blocks.get(name)
        for entity in () if block is None else block:
            kind = str(entity.dxftype())
            if kind == "INSERT":
                high = entity.dxf.insert.z != 0 or _has_heights(document, str(entity.dxf.name), seen)
            elif kind in _LEFT_OUT or kind in _TEXTS:
                continue
            else:
                try:
                    high = any(
                        bool((shapely.get_coordinates(shape, include_z=True)[:, 2] != 0).any())
                        for shape, _ in _geometry(entity, kind)
                        if shapely.has_z(shape)
                    )
                except Exception:
                    continue
            if high:
                seen[key] = True
                break
    return seen[key]


def _geometry(entity: Any, kind: str) -> list[tuple[Any, str | None]]:
    """Shapes of an entity, each with its text; none: it is of a kind that holds no geometry."""
    dxf = entity.dxf
    if kind == "POINT":
        return [(shapely.Point(*_finite(dxf.location)), None)]
    if kind == "LINE":
        return [(shapely.LineString([_finite(dxf.start), _finite(dxf.end)]), None)]
    if kind in _TEXTS:
        text = entity.plain_text() if kind == "MTEXT" else dxf.get("text", "")
        at = dxf.insert if kind == "MTEXT" else entity.ocs().to_wcs(dxf.insert)
        return [(shapely.Point(*_finite(at)), str(text))]
    if kind in _FACES:
        corners = [_finite(v) for v in entity.wcs_vertices()]
        return _polygon(corners)
    if kind == "MESH":
        vertices = [_finite(v) for v in entity.vertices]
        return [item for face in entity.faces for item in _polygon([vertices[k] for k in face])]
    if kind == "POLYLINE" and (entity.is_poly_face_mesh or entity.is_polygon_mesh):
        return [
            item for face in entity.virtual_entities() for item in _geometry(face, str(face.dxftype()))
        ]  # fmt: skip
    if kind in _CURVES:
        return [(_line(entity, kind), None)]
    return []


def _polygon(corners: list[tuple[float, float, float]]) -> list[tuple[Any, str | None]]:
    """A face with three corners and more; four corners off one plane stay one polygon."""
    ring = [c for k, c in enumerate(corners) if c != corners[k - 1]]
    return [(shapely.Polygon(ring), None)] if len(ring) >= 3 else []


def _line(entity: Any, kind: str) -> Any:
    """A curve or a chain of straight lines in world coordinates."""
    from ezdxf.path import make_path  # noqa: PLC0415

    flat = kind == "LWPOLYLINE" and not entity.dxf.hasattr("elevation")
    if kind == "LWPOLYLINE" and not entity.has_arc:
        vertices = [tuple(v) for v in entity.vertices_in_wcs()]
        closed = entity.closed
    elif kind == "POLYLINE" and not entity.has_arc and not int(entity.dxf.get("smooth_type", 0)):
        vertices = [tuple(v) for v in entity.points_in_wcs()]
        closed = entity.is_closed
    else:
        path = make_path(entity)
        control = np.array([tuple(v) for v in path.control_vertices()], float)
        if not np.isfinite(control).all():
            raise ValueError("a coordinate is not finite")
        distance = max(float(np.ptp(control, axis=0).max()) * _FLATNESS, 1e-9)
        vertices, closed = [], False
        # Paths replace circles by cubic curves, which is 3 parts in 10,000 off.
        exact = kind in ("ARC", "CIRCLE", "ELLIPSE")
        for vertex in entity.flattening(distance) if exact else path.flattening(distance):
            vertices.append(tuple(vertex))
            if len(vertices) > MOST_VERTICES:
                raise ValueError(f"a curve of more than {MOST_VERTICES} vertices")
    points = np.array(vertices, float).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise ValueError("a coordinate is not finite")
    if closed and len(points) > 2 and not (points[0] == points[-1]).all():
        points = np.concatenate([points, points[:1]])
    # Without an elevation a polyline states no height; one that is turned in space does.
    flat = flat and float(entity.dxf.get("extrusion", (0, 0, 1))[2]) == 1.0
    return shapely.LineString(points[:, :2] if flat else points)


def _finite(vertex: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in vertex)
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        raise ValueError("a coordinate is not finite")
    return x, y, z
