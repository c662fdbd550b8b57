"""CityJSON 1.0 to 2.0: of each object its finest level of detail that has faces (cityjson.org/specs)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.objects.model import ObjectFile, from_polygons
from photoplan.io.plain_files import elements, finite, members, number_rows, read_json_lines

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
    polygons: list[list[NDArray[np.float64]]] = []
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


def _vertices(path: Path, stated: Any, transform: dict[str, Any]) -> NDArray[np.float64]:
    vertices = number_rows(stated, f"{path}: vertices", 3)
    if transform:
        scale, translate = (finite(transform.get(k), f"{path}: transform {k}", 3) for k in ("scale", "translate"))
        with np.errstate(over="ignore", invalid="ignore"):
            vertices = vertices * scale + translate
    if not (np.abs(vertices) < _FARTHEST).all():
        raise InputError(f"{path}: vertices that lie nowhere on a map; check `transform`, or get a fresh copy")
    return vertices


_Templates = tuple[list[Any], NDArray[np.float64]]
"""Geometries that objects share, and their vertices."""


def _templates(path: Path, data: dict[str, Any]) -> _Templates:
    stated = data.get("geometry-templates")
    if stated is None:
        return [], np.empty((0, 3))
    where = f"{path}: geometry-templates"
    held = members(stated, where)
    templates = elements(held.get("templates"), f"{where}: templates")
    return templates, _vertices(path, held.get("vertices-templates"), {})


def _faces(
    geometries: list[Any], vertices: NDArray[np.float64], templates: _Templates
) -> Iterator[list[NDArray[np.float64]]]:
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


def _placed(
    geometry: dict[str, Any], vertices: NDArray[np.float64], templates: _Templates
) -> tuple[dict[str, Any], NDArray[np.float64]]:
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


def _ring(places: list[int], vertices: NDArray[np.float64]) -> NDArray[np.float64]:
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
