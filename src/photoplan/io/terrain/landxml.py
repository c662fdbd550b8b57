"""Measured terrain from LandXML 1.0 to 1.2 (and Inframodel, which is LandXML): points, lines and the triangulation.

Coordinates stand in the order north, east, height (LandXML-1.2 schema, PntList3D). Data points are mass points,
breaklines breaklines, contours form lines, and boundaries border lines (`outer`, and `island` inside a void) or holes
(`void`). A breakline of the type `wall` has one height for each vertex and is an ordinary breakline; a retaining wall
(`RetWall`) has the height of its other side, and becomes a two-sided breakline.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import iterparse
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import canonical_crs, parse_crs, split_compound
from photoplan.geometry.units import FOOT, metres_in
from photoplan.io.files import whole_number
from photoplan.io.terrain.options import OTHER, CodeClass, ReadOptions
from photoplan.surfaces.units import LINE_KINDS, LineKind, MeasuredLine, MeasuredTerrain, PointGroup, Tin

MAX_BYTES = 4 << 30
MAX_DEPTH = 64
"""Levels of nesting; LandXML surfaces need ten."""
_CODE_LABELS = ("terrainCoding", "code", "Code", "surveyCode")
_BOUNDARIES: dict[str, LineKind] = {"outer": "border", "island": "border", "void": "hole"}


@dataclass
class _LandXmlSurface:
    """What was read of one surface."""

    name: str
    points: list[tuple[str, NDArray[np.float64]]] = field(default_factory=list)
    lines: list[MeasuredLine] = field(default_factory=list)
    numbers: dict[int, int] = field(default_factory=dict)
    vertices: list[NDArray[np.float64]] = field(default_factory=list)
    faces: list[tuple[int, ...]] = field(default_factory=list)
    ignored: int = 0


def read(path: Path, options: ReadOptions) -> MeasuredTerrain:
    """Surfaces of a LandXML file."""
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path}: more than {MAX_BYTES >> 30} GiB of XML; export the part that is needed")
    reader = _Reader(path, options)
    try:
        for event, element in iterparse(str(path), events=("start", "end"), forbid_dtd=True):
            if event == "start":
                reader.start(element)
            else:
                reader.end(element)
    except DefusedXmlException as error:
        raise InputError(
            f"{path}: holds a document type or entities ({type(error).__name__}), which are not followed; "
            "export the file again without them"
        ) from None
    except ParseError as error:
        raise InputError(f"{path}:{error.position[0]}: not valid XML ({error}); get a fresh copy") from None
    except (ValueError, LookupError, OSError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    return reader.terrain()


class _Reader:
    """Takes the elements of a file as they come; keeps no element that it has used."""

    def __init__(self, path: Path, options: ReadOptions) -> None:
        self.path, self.options = path, options
        self.open: list[Element] = []
        self.surfaces: list[_LandXmlSurface] = []
        self.system: dict[str, str] = {}
        self.notes: list[str] = []
        self.unit: float | None = None
        self.height_unit: float | None = None
        self.walls = 0
        self.codes: set[str] = set()

    def start(self, element: Element) -> None:
        tag = _tag(element)
        if not self.open and tag != "LandXML":
            raise InputError(f"{self.path}: an XML document of <{tag[:50]}>; LandXML is read")
        self.open.append(element)
        if len(self.open) > MAX_DEPTH:
            raise InputError(f"{self.path}: nested deeper than {MAX_DEPTH} levels; this is no LandXML surface")
        if tag == "Surface":
            self.surfaces.append(_LandXmlSurface(element.get("name") or f"surface {len(self.surfaces) + 1}"))

    def end(self, element: Element) -> None:
        self.open.pop()
        tag = _tag(element)
        if tag in ("Metric", "Imperial"):
            self._units(element, tag)
        elif tag == "CoordinateSystem":
            self.system = dict(element.attrib)
        handler = _HANDLERS.get(tag)
        if handler is not None and self.surfaces and any(_tag(e) == "Surface" for e in self.open):
            handler(self, element, self.surfaces[-1])
        # Parts of lines are needed until the line ends; everything else is dropped at once, so memory stays small.
        if self.open and (tag in _HANDLERS or _tag(self.open[-1]) not in _KEPT):
            self.open[-1].remove(element)

    def _units(self, element: Element, tag: str) -> None:
        linear = element.get("linearUnit") or ("meter" if tag == "Metric" else "foot")
        if self.unit is not None:
            raise InputError(f"{self.path}: states its units twice; keep one of Metric and Imperial")
        self.unit = metres_in(linear, f"{self.path}: linearUnit")
        heights = element.get("elevationUnit")
        foot = abs(self.unit - FOOT) < 1e-5
        if heights is None and not foot and self.unit != 1.0:
            raise InputError(
                f"{self.path}: lengths in {linear}, and elevationUnit is not stated; set it to the unit of heights"
            )
        # An elevationUnit of feet beside lengths in US survey feet stands for the same feet.
        same = heights is None or (heights.casefold() in ("feet", "foot") and foot)
        self.height_unit = self.unit if same else metres_in(heights or "", f"{self.path}: elevationUnit")

    def data_points(self, element: Element, surface: _LandXmlSurface) -> None:
        code = _code(element)
        where = f"{self.path}: {surface.name}: data points"
        for part in element:
            if _tag(part) == "PntList3D":
                surface.points.append((code, _numbers(part, 3, where)[:, [1, 0, 2]]))
            elif _tag(part) == "PntList2D":
                raise InputError(f"{where}: a PntList2D has no heights; export points with heights")

    def breakline(self, element: Element, surface: _LandXmlSurface) -> None:
        where = self._where(element, surface, "breakline")
        self.walls += element.get("brkType") == "wall"
        flat = next((p for p in element if _tag(p) == "PntList2D"), None)
        if flat is not None:
            raise InputError(f"{where}: a PntList2D has no heights; export breaklines with heights")
        self._line(element, surface, where, "breakline")

    def boundary(self, element: Element, surface: _LandXmlSurface) -> None:
        where = self._where(element, surface, "boundary")
        kind = _BOUNDARIES.get(element.get("bndType", "outer"))
        if kind is None:
            raise InputError(f"{where}: bndType {element.get('bndType')!r}; LandXML knows outer, void and island")
        self._line(element, surface, where, kind)

    def contour(self, element: Element, surface: _LandXmlSurface) -> None:
        where = self._where(element, surface, "contour")
        height = _floats(element.get("elev", ""), where)
        if len(height) != 1:
            raise InputError(f"{where}: elev = {element.get('elev')!r}; the height of a contour is needed")
        self._line(element, surface, where, "formline", float(height[0]))

    def wall(self, element: Element, surface: _LandXmlSurface) -> None:
        where = self._where(element, surface, "retaining wall")
        points = [p for p in element if _tag(p) == "RetWallPnt"]
        if len(points) < 2:
            raise InputError(f"{where}: {len(points)} points; at least two are needed")
        xyz = np.concatenate([_numbers(p, 3, where) for p in points])[:, [1, 0, 2]]
        rise, offset = (np.array([_attribute(p, a, where) for p in points]) for a in ("height", "offset"))
        if (offset > 0).any() and (offset < 0).any():
            raise InputError(f"{where}: its other side lies to the left and to the right; split it where it changes")
        # The height is positive where the point is at the wall's bottom: the other side is higher by it. A negative
        # offset says that the other side is the left one (LandXML-1.2 schema, RetWallPnt).
        other = xyz[:, 2] + rise
        left = bool((offset < 0).any())
        if left:
            xyz, other = np.column_stack([xyz[:, :2], other]), xyz[:, 2].copy()
        largest = float(np.abs(offset).max())
        if largest > 0.1:
            self.notes.append(
                f"{self.path.name}: {surface.name}: a retaining wall is {largest:.2f} m wide; taken as upright"
            )
        name, code = self._name(element, surface), _code(element)
        surface.lines.append(MeasuredLine(name=name, kind="breakline", xyz=xyz, right=other, sigma=None, code=code))

    def vertex(self, element: Element, surface: _LandXmlSurface) -> None:
        where = f"{self.path}: {surface.name}: point {element.get('id')!r} of the triangulation"
        text = element.get("id", "")
        number = whole_number(text.strip())
        if number is None:
            raise InputError(f"{where}: its id is not a number")
        xyz = _numbers(element, 3, where)
        if len(xyz) != 1 or number in surface.numbers:
            raise InputError(f"{where}: {'given twice' if len(xyz) == 1 else 'three numbers are needed'}")
        surface.numbers[number] = len(surface.vertices)
        surface.vertices.append(xyz[0, [1, 0, 2]])

    def face(self, element: Element, surface: _LandXmlSurface) -> None:
        if element.get("i", "0").strip() == "1":
            return
        ids = (element.text or "").split()
        try:
            corners = tuple(surface.numbers[int(i)] for i in ids)
        except (KeyError, ValueError):
            corners = ()
        if len(corners) != 3:
            raise InputError(
                f"{self.path}: {surface.name}: face {len(surface.faces) + 1} of the triangulation, "
                f"{' '.join(ids)[:60]!r}, does not name three of its points"
            )
        surface.faces.append(corners)

    def _where(self, element: Element, surface: _LandXmlSurface, what: str) -> str:
        return f"{self.path}: {surface.name}: {what} {element.get('name') or len(surface.lines) + 1!s}"

    def _name(self, element: Element, surface: _LandXmlSurface) -> str:
        own = element.get("name") or str(len(surface.lines) + 1)
        return " ".join(t for t in (f"{self.path.name}: {_tag(element).lower()} {own}", _code(element)) if t)

    def _line(
        self, element: Element, surface: _LandXmlSurface, where: str, kind: str, height: float = float("nan")
    ) -> None:
        flat = next((p for p in element if _tag(p) == "PntList2D"), None)
        full = next((p for p in element if _tag(p) == "PntList3D"), None)
        if full is not None:
            xyz = _numbers(full, 3, where)[:, [1, 0, 2]]
            if kind == "formline":
                xyz[:, 2] = height
        elif flat is not None:
            plain = _numbers(flat, 2, where)[:, [1, 0]]
            xyz = np.column_stack([plain, np.full(len(plain), height)])
        else:
            raise InputError(f"{where}: holds no list of points")
        if len(xyz) < 2:
            raise InputError(f"{where}: has {len(xyz)} point; at least two are needed")
        code = _code(element)
        cls = self._class(code, kind)
        if cls.kind == "ignore":
            surface.ignored += 1
        elif cls.kind in LINE_KINDS:
            name = self._name(element, surface)
            line_kind: Any = cls.kind
            surface.lines.append(
                MeasuredLine(name=name, kind=line_kind, xyz=xyz, right=None, sigma=cls.sigma, code=code)
            )
        else:
            surface.points.append((code, xyz))

    def _class(self, code: str, kind: str) -> CodeClass:
        """Class of a line's or a point's code; what the element is says it where the table does not."""
        self.codes.add(code)
        classes = self.options.codes.classes
        other = classes.get(OTHER) if kind in ("mass", "breakline") else None
        return classes.get(code) or other or CodeClass(kind)

    def terrain(self) -> MeasuredTerrain:
        """All that was read."""
        surfaces = self._chosen()
        groups: list[PointGroup] = []
        for surface in surfaces:
            if surface.ignored:
                self.notes.append(f"{self.path.name}: {surface.name}: {surface.ignored} lines left out by their codes")
            if not surface.points and not surface.lines and surface.vertices:
                self.notes.append(f"{self.path.name}: {surface.name}: nothing measured, only a triangulation")
                if self.options.tin_points:
                    surface.points.append(("", np.array(surface.vertices)))
                    self.notes[-1] += "; its vertices are taken as mass points"
            groups += self._groups(surface)
        if self.walls:
            self.notes.append(
                f"{self.path.name}: {self.walls} breaklines of type `wall` state one height: not two-sided"
            )
        crs, heights = _reference(self.path, self.system)
        lines = tuple(line for s in surfaces for line in s.lines)
        held = sorted(code for code in self.codes if code)
        unknown = [code for code in held if code not in self.options.codes.classes]
        if unknown and self.options.codes.classes and OTHER not in self.options.codes.classes:
            some = ", ".join(unknown[:5]) + (f" and {len(unknown) - 5} more" if len(unknown) > 5 else "")
            self.notes.append(
                f"{self.path.name}: codes that the table does not have, read as their elements say: {some}"
            )
        fields = (f"{self.path.name}: surface {', '.join(s.name for s in surfaces)}",)
        tin, notes = _tin(surfaces), tuple(self.notes)
        return MeasuredTerrain(
            points=tuple(groups),
            lines=lines,
            crs=crs,
            height_system=heights,
            tin=tin,
            files=(self.path,),
            notes=notes,
            codes=frozenset(held),
            fields=fields,
            unit=self.unit,
            height_unit=self.height_unit,
        )

    def _chosen(self) -> list[_LandXmlSurface]:
        names = [s.name for s in self.surfaces]
        wanted = self.options.layers
        chosen = [s for s in self.surfaces if wanted is None or s.name in wanted]
        if not chosen:
            raise InputError(f"{self.path}: holds no surface" + (f" called {wanted}; it has {names}" if names else ""))
        if wanted is None and len(chosen) > 1:
            raise InputError(f"{self.path}: holds {len(chosen)} surfaces: {names}; choose with `layers`")
        return chosen

    def _groups(self, surface: _LandXmlSurface) -> list[PointGroup]:
        groups, count = [], 0
        by_code: dict[str, list[NDArray[np.float64]]] = {}
        for code, xyz in surface.points:
            by_code.setdefault(code, []).append(xyz)
        for code, parts in by_code.items():
            cls = self._class(code, "mass")
            xyz = np.concatenate(parts)
            records = np.arange(count + 1, count + len(xyz) + 1)
            count += len(xyz)
            if cls.kind != "ignore":
                kind: Any = cls.kind if cls.kind == "spot" else "mass"
                name = f"{self.path.name} {code}".strip()
                groups.append(PointGroup(name=name, kind=kind, xyz=xyz, records=records, sigma=cls.sigma))
        return groups


_HANDLERS = {
    "DataPoints": _Reader.data_points,
    "Breakline": _Reader.breakline,
    "RetWall": _Reader.wall,
    "Boundary": _Reader.boundary,
    "Contour": _Reader.contour,
    "P": _Reader.vertex,
    "F": _Reader.face,
}
_KEPT = ("DataPoints", "Breakline", "RetWall", "Boundary", "Contour", "Feature")
"""Elements whose parts are looked at when they end."""


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _floats(text: str, where: str) -> NDArray[np.float64]:
    words = text.split()
    try:
        values = np.array(words, np.float64)
    except ValueError:
        bad = next((w for w in words if not _is_float(w)), "")
        raise InputError(f"{where}: {bad[:40]!r} is not a number") from None
    if not (np.abs(values) < 1e300).all():
        raise InputError(f"{where}: a coordinate is not finite")
    return values


def _is_float(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _numbers(element: Element, width: int, where: str) -> NDArray[np.float64]:
    values = _floats(element.text or "", where)
    if not len(values) or len(values) % width:
        raise InputError(f"{where}: {len(values)} numbers; {width} for each point are needed")
    return values.reshape(-1, width)


def _attribute(element: Element, name: str, where: str) -> float:
    values = _floats(element.get(name, ""), where)
    if len(values) != 1:
        raise InputError(f"{where}: {name} = {element.get(name)!r}; one number is needed")
    return float(values[0])


def _code(element: Element) -> str:
    """Code of an element: its own, or that of its features."""
    for feature in element:
        if _tag(feature) == "Feature":
            values = {p.get("label"): p.get("value") for p in feature if _tag(p) == "Property"}
            for label in _CODE_LABELS:
                if values.get(label):
                    return str(values[label]).strip()
    return (element.get("code") or "").strip()


def _tin(surfaces: list[_LandXmlSurface]) -> Tin | None:
    chosen = [s for s in surfaces if s.vertices and s.faces]
    if not chosen:
        return None
    start = np.cumsum([0] + [len(s.vertices) for s in chosen])
    faces = [np.array(s.faces, np.int64).reshape(-1, 3) + a for s, a in zip(chosen, start)]
    return Tin(np.concatenate([np.array(s.vertices) for s in chosen]), np.concatenate(faces))


def _reference(path: Path, system: dict[str, str]) -> tuple[str | None, str | None]:
    """CRS and height system of the attributes of a CoordinateSystem."""
    code = system.get("epsgCode", "").strip().upper().removeprefix("EPSG:").strip()
    wkt = system.get("ogcWktCode", "").strip()
    crs, heights = None, None
    if code or wkt:
        text = f"EPSG:{code}" if code else wkt
        parse_crs(text, f"{path}: CRS")
        crs, heights = split_compound(text)
    name = (system.get("verticalCoordinateSystemName") or system.get("verticalDatum") or "").strip()
    if not name:
        return crs, heights
    try:
        # PROJ knows vertical systems as "N2000 height" where files say N2000.
        vertical = parse_crs(name if name.upper().startswith("EPSG:") else f"{name} height")
    except InputError:
        return crs, name
    same = vertical.is_vertical and (
        name.upper().startswith("EPSG:") or vertical.name.casefold() == f"{name} height".casefold()
    )
    return crs, canonical_crs(vertical.to_wkt()) if same else name
