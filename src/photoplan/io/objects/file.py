"""A file of objects, whatever its format."""

from __future__ import annotations

import re
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.checks import check_plain_file
from photoplan.io.objects import cityjson, mesh, vector
from photoplan.io.objects.model import ObjectFile
from photoplan.io.plain_files import read_head


def read_objects(path: Path, layer: str | None = None) -> ObjectFile:
    """Faces of the objects of a file, which its content names, not its suffix; some may have faults."""
    path = check_plain_file(path, "object file")
    head = read_head(path).lstrip("\x1e \t\n")
    if head.startswith("ply"):
        return mesh.read_ply(path)
    if (
        re.search(r'"type"\s*:\s*"CityJSON"', head)
        or ("CityObjects" in head)
        or path.name.endswith((".city.json", ".city.jsonl"))
    ):
        return cityjson.read(path, layer)
    if re.search(r"^(v|f|o|g|vn|vt|mtllib|usemtl) ", head, re.MULTILINE) and path.suffix.casefold() == ".obj":
        return mesh.read_obj(path)
    vectors = ("SQLite", "{", "AutoCAD Binary DXF")
    if head.startswith(vectors) or path.suffix.casefold() in (".dxf", ".shp", ".fgb"):
        return vector.read(path, layer)
    raise InputError(
        f"{path}: not a file of objects that is read here; allowed are CityJSON, GeoPackage, GeoJSON, Shapefile, DXF, "
        "OBJ and PLY"
    )
