"""Measured terrain from vector files (GeoPackage, Shapefile, GeoJSON, DXF) and LandXML.

Measured terrain from LandXML 1.0 to 1.2 (and Inframodel, which is LandXML): points, lines and the triangulation.

Coordinates stand in the order north, east, height (LandXML-1.2 schema, PntList3D). Data points are mass points,
breaklines breaklines, contours form lines, and boundaries border lines (`outer`, and `island` inside a void) or holes
(`void`). A breakline of the type `wall` has one height for each vertex and is an ordinary breakline; a retaining wall
(`RetWall`) has the height of its other side, and becomes a two-sided breakline.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np
import shapely
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import iterparse
from numpy.typing import NDArray

from photoplan.arrays import Floats, Ints, Mask
from photoplan.errors import InputError
from photoplan.geometry.crs import canonical_crs, parse_crs, split_compound
from photoplan.geometry.units import FOOT, metres_in, unit_label
from photoplan.io.files import whole_number
from photoplan.io.tables import NUMBER
from photoplan.io.terrain.options import OTHER, CodeClass, ReadOptions
from photoplan.io.vector_layer import ENTITIES, is_drawing, layers_of, read_layer, views_of
from photoplan.surfaces.units import LINE_KINDS, POINT_KINDS, LineKind, MeasuredLine, MeasuredTerrain, PointGroup, Tin

MAX_CODES = 1000
"""More codes than this in one file are names rather than classes: their points become one group for each class."""
MAX_SIGMAS = 100
"""More standard deviations than this are rounded up to two figures."""


class CodeIndex:
    """Numbers for texts in the order in which they first appear; number 0 is the empty text."""

    def __init__(self) -> None:
        self._number: defaultdict[str, int] = defaultdict()
        self._number.default_factory = self._number.__len__
        self._number[""]

    def numbers(self, texts: Iterable[str], count: int) -> NDArray[np.int32]:
        """Number of each of `count` texts; unknown ones get the next."""
        return np.fromiter((self._number[t] for t in texts), np.int32, count)

    @property
    def texts(self) -> list[str]:
        """All texts by their numbers."""
        return list(self._number)


@dataclass(frozen=True, eq=False)
class PointColumns:
    """Points of one file as columns."""

    xyz: Floats
    records: Ints
    codes: NDArray[np.int32] | None = None
    """Number of each point's code."""
    sigma: Floats | None = None
    """Standard deviation of each point; NaN: that of its code or class."""
    names: NDArray[Any] | None = None

    def take(self, which: NDArray[Any]) -> PointColumns:
        """The chosen points."""
        return PointColumns(
            xyz=self.xyz[which],
            records=self.records[which],
            codes=None if self.codes is None else self.codes[which],
            sigma=None if self.sigma is None else self.sigma[which],
            names=None if self.names is None else self.names[which],
        )


def class_of(code: str, options: ReadOptions, default: str, where: str) -> CodeClass:
    """Class of a code; `default` where there is no code, or no table to look it up in."""
    found = options.codes.find(code)
    if found is not None:
        return found
    if code and options.codes.classes:
        raise InputError(
            f"{where}: code {code!r} is not in the table of codes"
            + (f" ({options.codes.file})" if options.codes.file else "")
            + '; add it (`ignore` leaves it out), or give a class for all other codes with the code "*"'
        )
    return CodeClass(default)


def check_matched(measured: MeasuredTerrain, options: ReadOptions) -> None:
    """Refuse a table of codes of which the files hold none: what it says would be lost without a word."""
    named = [code for code in options.codes.classes if code != OTHER]
    if not named or any(code in measured.codes for code in named):
        return
    held = sorted(code for code in measured.codes if code)
    raise InputError(
        f"{options.codes.file or 'table of codes'}: none of its codes ({_some(named)}) is in the files; they hold "
        f"{f'the codes {_some(held)}' if held else 'no codes'} ({'; '.join(measured.fields)}); say which column holds "
        "them (`columns` x=…,y=…,z=…,code=… of text, `attribute` of vector files), or leave `codes` out"
    )


def _some(texts: Sequence[str]) -> str:
    return ", ".join(texts[:10]) + (f" and {len(texts) - 10} more" if len(texts) > 10 else "")


def make_groups(
    path: Path, columns: PointColumns, codes: Sequence[str], classes: Sequence[CodeClass]
) -> list[PointGroup]:
    """Point groups of one file: one for each code and standard deviation.

    `codes` and `classes` are by the numbers of `columns.codes`; points whose class is no point class are left out.
    """
    used = np.zeros(1, np.int32) if columns.codes is None else np.unique(columns.codes)
    by_code = len(used) <= MAX_CODES
    numbers = np.zeros(len(columns.xyz), np.int32) if columns.codes is None else columns.codes
    keys: dict[tuple[str, str, float | None], list[int]] = {}
    for number in used.tolist():
        cls = classes[number]
        if cls.kind in POINT_KINDS:
            keys.setdefault((codes[number] if by_code else "", cls.kind, cls.sigma), []).append(number)
    groups: list[PointGroup] = []
    for (code, kind, sigma), members in keys.items():
        part = columns if len(used) == 1 else columns.take(np.isin(numbers, members))
        name = f"{path.name} {code}".strip()
        groups += [
            PointGroup(name=name, kind=kind, xyz=p.xyz, records=p.records, sigma=s, names=p.names)  # type: ignore[arg-type]
            for s, p in _by_sigma(part, sigma)
            if len(p.xyz)
        ]
    return groups


def _by_sigma(part: PointColumns, default: float | None) -> list[tuple[float | None, PointColumns]]:
    """Points parted by their own standard deviation."""
    if part.sigma is None or np.isnan(part.sigma).all():
        return [(default, part)]
    sigma = part.sigma
    if len(np.unique(sigma[~np.isnan(sigma)])) > MAX_SIGMAS:
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = 10.0 ** (np.floor(np.log10(sigma)) - 1)
            sigma = np.where(sigma > 0, np.ceil(sigma / unit - 1e-9) * unit, sigma)
    out: list[tuple[float | None, PointColumns]] = []
    for value in np.unique(sigma):  # NaN comes last, once
        which = np.isnan(sigma) if np.isnan(value) else sigma == value
        out.append((default if np.isnan(value) else float(value), part.take(which)))
    return out


def is_line(cls: CodeClass) -> bool:
    """Whether a class is one of lines."""
    return cls.kind in LINE_KINDS


_CODES = ("kind", "class", "code")
_NAMES = ("name", "id", "nr", "label")
_POINT, _LINE, _POLYGON = 0, 1, 3


@dataclass(frozen=True, eq=False)
class _Layer:
    """Simple geometries of one layer and the attributes of each."""

    name: str
    geometry: NDArray[Any]
    feature: Ints
    """Number of the feature of each geometry, from 1."""
    codes: list[str]
    sigma: Floats | None
    names: NDArray[Any] | None
    fields: tuple[str, ...]
    """What the attributes are called."""
    right: NDArray[Any] | None
    numeric: tuple[str, ...] = ()
    """Attributes of numbers that may be heights."""


def read(path: Path, options: ReadOptions) -> MeasuredTerrain:
    """Points and lines of the layers of a vector file."""
    drawing = is_drawing(path)
    notes: list[str] = []
    points: list[PointGroup] = []
    lines: list[MeasuredLine] = []
    crs: str | None = None
    heights: str | None = None
    codes: set[str] = set()
    fields: list[str] = []
    unit: float | None = None
    for name in _layers(path, options, drawing):
        layer, text, unit = _layer(path, name, options, drawing, notes)
        if layer is None:
            continue
        stated = _reference(path, text, layer, notes)
        if crs is not None and stated[0] is not None and stated[0] != crs:
            raise InputError(f"{path}: layers in {crs} and {stated[0]}; choose layers of one CRS")
        crs, heights = (crs or stated[0]), (heights or stated[1])
        more = _features(path, layer, options, notes)
        points += more[0]
        lines += more[1]
        codes |= {layer.name, *layer.codes}
        fields.append(f"{path.name}: layer {layer.name} with {', '.join(layer.fields) or 'no attributes'}")
    return MeasuredTerrain(
        points=tuple(points),
        lines=tuple(lines),
        crs=crs,
        height_system=heights,
        tin=None,
        files=(path,),
        notes=tuple(notes),
        codes=frozenset(codes),
        fields=tuple(fields),
        unit=unit,
    )


def _layers(path: Path, options: ReadOptions, drawing: bool) -> list[str]:
    if drawing:
        return [ENTITIES]
    views = views_of(path)
    names = layers_of(path)
    if options.layers is not None and len(names) > 1:
        lost = [name for name in options.layers if name not in names]
        chosen = [name for name in names if name in options.layers]
        if not chosen:
            raise InputError(f"{path}: holds no layer called {', '.join(lost)}; it has {', '.join(names)}")
        names = chosen
    if not names:
        raise InputError(f"{path}: holds no layer with geometry")
    if views & {name.casefold() for name in names}:
        raise InputError(
            f"{path}: layer {', '.join(n for n in names if n.casefold() in views)} is a view (a query, which may have "
            "no end), not a table; store it as a table (ogr2ogr), or choose other layers"
        )
    return names


def _layer(
    path: Path, name: str, options: ReadOptions, drawing: bool, notes: list[str]
) -> tuple[_Layer | None, str | None, float | None]:
    """One layer with its geometries taken apart, its CRS, and the unit of a drawing."""
    found = read_layer(path, name)
    notes += found.notes
    unit = found.unit
    if drawing and options.unit is not None:
        unit = metres_in(options.unit, "unit of drawings")
        if found.unit is not None and found.unit != unit:
            notes.append(
                f"{path.name}: states {unit_label(found.unit)} ($INSUNITS); read in {unit_label(unit)} as declared"
            )
    geometry, fields = found.shapes, {name.casefold(): values for name, values in found.fields.items()}
    use = ~(shapely.is_missing(geometry) | shapely.is_empty(geometry))
    if drawing:
        use &= _drawn(path, geometry, fields, options, notes)
    if not use.all() and not drawing:
        notes.append(f"{path.name}: layer {name}: {int((~use).sum())} features have no geometry")
    at = np.flatnonzero(use)
    parts, whose = shapely.get_parts(geometry[at], return_index=True)
    while (shapely.get_type_id(parts) > _POLYGON).any():
        parts, again = shapely.get_parts(parts, return_index=True)
        whose = whose[again]
    if not len(parts):
        spots = sum(v is not None and bool(NUMBER.fullmatch(v.strip())) for v in fields["text"]) if drawing else 0
        if spots:
            raise InputError(
                f"{path}: no point and no line; {spots} of its texts are numbers; `height_field` Text takes them for "
                "heights"
            )
        return None, None, unit
    row = at[whose]
    if options.height_field is not None:
        parts = _raised(path, name, options.height_field, parts, row, fields, notes)
    attribute = "layer" if drawing and options.attribute is None else options.attribute
    key = attribute.casefold() if attribute else next((c for c in _CODES if c in fields), "")
    if attribute and key not in fields:
        raise InputError(f"{path}: layer {name}: no attribute {attribute!r}; it has {', '.join(fields) or 'none'}")
    codes = [_text(v) for v in fields[key][row]] if key else [""] * len(parts)
    names = next((fields[n] for n in _NAMES if n in fields), None)
    return (
        _Layer(
            name=name,
            geometry=parts,
            feature=row + 1,
            codes=codes,
            sigma=None if "sigma" not in fields else _sigma(path, fields["sigma"][row]),
            names=None if names is None else np.array([_text(v) for v in names[row]]),
            fields=tuple(found.fields),
            right=fields["z_right"][row] if "z_right" in fields else None,
            numeric=_height_fields(found.fields),
        ),
        found.crs,
        unit,
    )


#: Beginnings of names of attributes that hold heights, in small letters.
_HEIGHT_NAMES = ("elev", "height", "contour", "alt", "level", "z", "h_", "hoehe", "höhe", "kote", "cota", "quota")


def _height_fields(fields: Mapping[str, NDArray[Any]]) -> tuple[str, ...]:
    """Attributes of numbers that may be heights; those that are called so come first."""
    numeric = [name for name, values in fields.items() if values.dtype.kind in "iuf" and name.casefold() != "sigma"]
    called = [name for name in numeric if name.casefold().startswith(_HEIGHT_NAMES) or name.casefold() == "h"]
    return tuple(called or numeric)


def _raised(
    path: Path,
    layer: str,
    wanted: str,
    parts: NDArray[Any],
    row: Ints,
    fields: Mapping[str, NDArray[Any]],
    notes: list[str],
) -> NDArray[Any]:
    """Geometries with the heights that an attribute states; those of features without one stay as they are."""
    if wanted.casefold() not in fields:
        raise InputError(f"{path}: layer {layer}: no attribute {wanted!r}; it has {', '.join(fields) or 'none'}")
    values = fields[wanted.casefold()]
    used = np.unique(row)
    heights = np.full(len(values), np.nan)
    for k, value in zip(used.tolist(), values[used]):
        try:
            heights[k] = np.nan if value is None or value == "" else float(value)
        except (TypeError, ValueError):
            raise InputError(
                f"{path}: layer {layer}, feature {k + 1}: {str(value)[:40]!r} in {wanted} is not a number; heights are "
                "needed, with a decimal point"
            ) from None
    lost = int((~np.isfinite(heights[used])).sum())
    if lost:
        notes.append(f"{path.name}: layer {layer}: {lost} features state no height in {wanted}")
    out = parts.copy()
    known = np.isfinite(heights[row])
    XYZ, part = shapely.get_coordinates(parts[known], include_z=True, return_index=True)
    XYZ[:, 2] = heights[row[known]][part]
    out[known] = shapely.set_coordinates(shapely.force_3d(parts[known]), XYZ)
    return out


def _drawn(path: Path, geometry: NDArray[Any], fields: dict[str, Any], options: ReadOptions, notes: list[str]) -> Mask:
    """Which entities of a drawing are measured points and lines: no faces and hatches, and no texts but those of
    numbers that `height_field` takes for heights."""
    spot = (options.height_field or "").casefold() == "text"
    stated = fields.get("text", [None] * len(geometry))
    text = np.array([v is not None and not (spot and NUMBER.fullmatch(v.strip())) for v in stated], bool)
    faces = shapely.get_type_id(geometry) == _POLYGON
    use = np.ones(len(geometry), bool)
    if options.layers is not None:
        layers = fields["layer"]
        use &= np.isin(layers.astype(str), options.layers)
        if not use.any():
            known = ", ".join(sorted(set(layers.astype(str))))[:300]
            raise InputError(f"{path}: nothing on layers {', '.join(options.layers)}; it has {known}")
    if (use & text).any():
        notes.append(f"{path.name}: {int((use & text).sum())} texts left out")
    use &= ~text
    if (use & faces).any() and (options.tin_points or not (use & ~faces).any()):
        # Corners of faces are shared: each counts once.
        corners = np.unique(shapely.get_coordinates(geometry[use & faces], include_z=True), axis=0)
        first = int(np.flatnonzero(use & faces)[0])
        notes.append(f"{path.name}: {int((use & faces).sum())} faces: their {len(corners)} corners are mass points")
        geometry[first] = shapely.MultiPoint(corners)
        faces = faces & (np.arange(len(geometry)) != first)
    elif (use & faces).any():
        notes.append(
            f"{path.name}: {int((use & faces).sum())} faces left out; with `tin_points` their corners are mass points"
        )
    return use & ~faces


def _text(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return (
        str(int(value)) if isinstance(value, float | np.floating) and float(value).is_integer() else str(value).strip()
    )


def _sigma(path: Path, values: NDArray[Any]) -> Floats:
    try:
        sigma = np.array([np.nan if v is None or v == "" else v for v in values], np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{path}: attribute sigma: not all values are numbers; metres are needed") from None
    if (sigma < 0).any() or np.isinf(sigma).any():
        raise InputError(f"{path}: attribute sigma: {sigma[(sigma < 0) | np.isinf(sigma)][0]}; zero or more is needed")
    return sigma


def _features(
    path: Path, layer: _Layer, options: ReadOptions, notes: list[str]
) -> tuple[list[PointGroup], list[MeasuredLine]]:
    codes = CodeIndex()
    number = codes.numbers(layer.codes, len(layer.codes))
    # What an empty code means, the name of the layer says; the kind of geometry says it where that is no class either.
    of_layer = options.codes.find(layer.name)
    classes = [(_known(path, layer, code, options) if code else None) or of_layer for code in codes.texts]
    kind = shapely.get_type_id(layer.geometry)
    lines: list[MeasuredLine] = []
    stray: list[tuple[int, Floats]] = []
    left_out: Counter[str] = Counter()
    for at in np.flatnonzero(kind != _POINT).tolist():
        cls = classes[number[at]] or CodeClass("border" if kind[at] == _POLYGON else "breakline")
        if cls.kind == "ignore":
            left_out[layer.codes[at] or layer.name] += 1
        elif is_line(cls):
            lines += _lines(path, layer, at, cls)
        else:
            stray.append((at, _heights(path, layer, at, shapely.get_coordinates(layer.geometry[at], include_z=True))))
    is_point = np.flatnonzero(kind == _POINT)
    of_point = [c if c is not None and not is_line(c) else CodeClass("mass") for c in classes]
    xyz = shapely.get_coordinates(layer.geometry[is_point], include_z=True)
    rows = np.concatenate([is_point, *(np.full(len(c), at) for at, c in stray)]).astype(np.int64)
    xyz = np.concatenate([xyz, *(c for _, c in stray)])
    used = np.array([c.kind != "ignore" for c in of_point])[number[rows]]
    rows, xyz = rows[used], xyz[used]
    flat = np.flatnonzero(np.isnan(xyz[:, 2]))
    if len(flat):
        raise InputError(_no_height(path, layer, int(rows[flat[0]]), len(flat)))
    columns = PointColumns(
        xyz=xyz,
        records=layer.feature[rows],
        codes=number[rows],
        sigma=None if layer.sigma is None else layer.sigma[rows],
        names=None if layer.names is None else layer.names[rows],
    )
    if left_out or not used.all():
        notes.append(
            f"{path.name}: layer {layer.name}: {sum(left_out.values()) + int((~used).sum())} features left out"
        )
    return (make_groups(path, columns, codes.texts, of_point) if len(xyz) else []), lines


def _known(path: Path, layer: _Layer, code: str, options: ReadOptions) -> CodeClass | None:
    found = options.codes.find(code)
    if found is None and options.codes.classes:
        at = int(layer.feature[layer.codes.index(code)])
        class_of(code, options, "mass", f"{path}: layer {layer.name}, feature {at}")
    return found


def _no_height(path: Path, layer: _Layer, at: int, count: int) -> str:
    code = f" ({layer.codes[at]})" if layer.codes[at] else ""
    more = f"; so have {count - 1} others" if count > 1 else ""
    wanted = f"; its attribute {' or '.join(layer.numeric[:5])} may hold it" if layer.numeric else ""
    name = layer.numeric[0] if layer.numeric else "NAME"
    return (
        f"{path}: layer {layer.name}, feature {layer.feature[at]}{code}: has no height{more}{wanted}; name the "
        f"attribute with `height_field` {name}, give 3-D geometry, choose other layers, or leave its code out "
        "(`ignore` in the table of codes)"
    )


def _heights(path: Path, layer: _Layer, at: int, xyz: Floats) -> Floats:
    if np.isnan(xyz[:, 2]).any():
        raise InputError(_no_height(path, layer, at, 1))
    return xyz


def _lines(path: Path, layer: _Layer, at: int, cls: CodeClass) -> list[MeasuredLine]:
    """Lines of one geometry: itself, or the rings of a polygon."""
    shape, kind = layer.geometry[at], cls.kind
    rings = [(shape, kind)]
    if shapely.get_type_id(shape) == _POLYGON:
        inner = "hole" if kind == "border" else kind
        rings = [(shapely.get_exterior_ring(shape), kind), *((r, inner) for r in shape.interiors)]
    own = f" {layer.names[at]}" if layer.names is not None and layer.names[at] else ""
    code = layer.codes[at]
    name = f"{path.name}: {layer.name} {layer.feature[at]}{own}" + (f" ({code})" if code else "")
    sigma = cls.sigma if layer.sigma is None or np.isnan(layer.sigma[at]) else float(layer.sigma[at])
    lines = []
    for ring, own_kind in rings:
        xyz = shapely.get_coordinates(ring, include_z=True)
        if own_kind in ("breakline", "formline"):
            _heights(path, layer, at, xyz)
        right = _right(path, layer, at, len(xyz)) if own_kind == "breakline" else None
        line_kind: Any = own_kind
        lines.append(MeasuredLine(name=name, kind=line_kind, xyz=xyz, right=right, sigma=sigma, code=code))
    return lines


def _right(path: Path, layer: _Layer, at: int, count: int) -> Floats | None:
    """Heights right of a line from the attribute z_right."""
    value = None if layer.right is None else layer.right[at]
    if value is None or (isinstance(value, str) and not value.strip()):
        return None
    try:
        numbers = np.atleast_1d(
            np.array(re.split(r"[;\s]+|,\s+", value.strip()) if isinstance(value, str) else value, float)
        )
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if np.isnan(numbers).all() and len(numbers):
        return None
    if len(numbers) == 1:
        numbers = np.repeat(numbers, count)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(
            f"{path}: layer {layer.name}, feature {layer.feature[at]}: z_right = {str(value)[:60]!r}; "
            f"{count} heights, one for each vertex, or one for all are needed"
        )
    return numbers


def _reference(path: Path, text: str | None, layer: _Layer, notes: list[str]) -> tuple[str | None, str | None]:
    """CRS and height system that a layer states."""
    if text is None:
        return None, None
    crs = parse_crs(text, f"{path}: CRS")
    bounds = shapely.total_bounds(layer.geometry[:1000])
    if path.suffix.casefold() in (".geojson", ".json") and crs.is_geographic and np.abs(bounds).max() > 360:
        # GeoJSON without a CRS is WGS 84 by its standard; coordinates that are no degrees say otherwise.
        notes.append(f"{path.name}: states no CRS, and its coordinates are no degrees")
        return None, None
    return split_compound(text, f"{path}: CRS")


MAX_BYTES = 4 << 30
MAX_DEPTH = 64
"""Levels of nesting; LandXML surfaces need ten."""
_CODE_LABELS = ("terrainCoding", "code", "Code", "surveyCode")
_BOUNDARIES: dict[str, LineKind] = {"outer": "border", "island": "border", "void": "hole"}


@dataclass
class _LandXmlSurface:
    """What was read of one surface."""

    name: str
    points: list[tuple[str, Floats]] = field(default_factory=list)
    lines: list[MeasuredLine] = field(default_factory=list)
    numbers: dict[int, int] = field(default_factory=dict)
    vertices: list[Floats] = field(default_factory=list)
    faces: list[tuple[int, ...]] = field(default_factory=list)
    ignored: int = 0


def read_landxml(path: Path, options: ReadOptions) -> MeasuredTerrain:
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
        crs, heights = _stated_systems(self.path, self.system)
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
        by_code: dict[str, list[Floats]] = {}
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


def _floats(text: str, where: str) -> Floats:
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


def _numbers(element: Element, width: int, where: str) -> Floats:
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


def _stated_systems(path: Path, system: dict[str, str]) -> tuple[str | None, str | None]:
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
