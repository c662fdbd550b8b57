"""Exterior orientation from text tables: comma, semicolon, tab or space, with declared columns.

Columns are known by their header (see `HEADERS`) or declared (`TableFormat.columns`). A file of the same name with
the suffix ``.prj`` beside the table states its CRS (EPSG code, WKT or PROJ string), possibly with a vertical part.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.orientation.block import OrientationBlock, OrientationFormat, common_losses, require_map
from photoplan.io.orientation.table import OrientationTable, OrientedImage, TableFormat
from photoplan.io.plain_files import read_text
from photoplan.io.prj_file import crs_beside
from photoplan.io.project.model import ANGLE_UNITS
from photoplan.io.text_columns import NUMBER, decimal, find_delimiter, has_decimal_comma, split_line

#: Header names (in small letters) of every role.
HEADERS = {
    "name": ("name", "nom", "filename", "file", "image", "imagename", "image_name", "photo", "label", "id"),
    "x": ("x", "x0", "east", "easting", "e"),
    "y": ("y", "y0", "north", "northing", "n"),
    "z": ("z", "z0", "height", "altitude", "h", "alt"),
    "omega": ("omega", "ω", "o"),
    "phi": ("phi", "φ", "p"),
    "kappa": ("kappa", "κ", "k"),
    "camera": ("camera", "camera_id", "cam"),
}
NEEDED = ("name", "x", "y", "z", "omega", "phi", "kappa")
MAX_BYTES = 100_000_000

_ANGLE_OF = {"o": "omega", "p": "phi", "k": "kappa"}


@dataclass(frozen=True)
class _Row:
    line: int
    fields: tuple[str, ...]


def read(path: Path, form: TableFormat) -> OrientationTable:
    """Orientation table of a text file.

    Raises
    ------
    InputError
        A line cannot be read as declared; the message names the line and the column.
    """
    lines = [(n, text) for n, text in enumerate(read_text(path, MAX_BYTES).split("\n"), 1) if text.strip()]
    data = [(n, text) for n, text in lines if not text.lstrip().startswith("#")]
    if form.columns is None and lines and lines[0][1].lstrip().startswith("#"):
        # Some programs write the header as a comment.
        head = (lines[0][0], lines[0][1].lstrip()[1:].strip())
        if data and _roles_of_header(_split(head, _delimiter([head], form, path), path), None) is not None:
            data.insert(0, head)
    if not data:
        raise InputError(f"{path}: holds no line with data")
    delimiter = _delimiter(data, form, path)
    rows = [_split(item, delimiter, path) for item in data]
    roles, rows, notes = _columns(rows, form, path)
    if not rows:
        raise InputError(f"{path}: holds a header and no image")
    width = len(rows[0].fields) if form.columns is not None else len(_split(data[0], delimiter, path).fields)
    images = tuple(_image(row, roles, width, form, path) for row in rows)
    beside = crs_beside(path)
    crs, side, heights = (None,) * 3 if beside is None else (beside.crs, beside.file, beside.height_system)
    return OrientationTable(
        path, images, form.angle_unit, form.rotation, form.direction, crs, side, heights, notes=tuple(notes)
    )


def _split(item: tuple[int, str], delimiter: str, path: Path) -> _Row:
    return _Row(item[0], split_line(path, item, delimiter))


def _delimiter(data: list[tuple[int, str]], form: TableFormat, path: Path) -> str:
    return find_delimiter(path, data, NEEDED) if form.delimiter is None else form.delimiter


def _columns(rows: list[_Row], form: TableFormat, path: Path) -> tuple[dict[str, int], list[_Row], list[str]]:
    """Column of every role, the rows with data, and notes."""
    if form.columns is None or "=" in form.columns:
        renamed = None if form.columns is None else _declared_names(form.columns)
        roles = _roles_of_header(rows[0], renamed)
        if roles is None:
            raise InputError(_why_no_header(rows[0], renamed, path))
        return roles, rows[1:], []
    declared = [c for c in re.split(r"[,\s]+", form.columns.strip()) if c]
    roles = {role: at for at, role in enumerate(declared) if role != "-"}
    _check_roles(list(roles), [d for d in declared if d != "-"])
    if len(declared) != len(rows[0].fields):
        raise InputError(
            f"{path}:{rows[0].line}: {len(rows[0].fields)} columns, {len(declared)} are declared "
            f"({', '.join(declared)}); write `-` for columns that are not used"
        )
    numeric = [rows[0].fields[roles[r]] for r in NEEDED[1:]]
    if not any(re.match(r"[-+.]?\d", text) for text in numeric):
        return roles, rows[1:], [f"{path.name}: line {rows[0].line} was taken as a header"]
    return roles, rows, []


def _declared_names(text: str) -> dict[str, str]:
    pairs = [item.partition("=") for item in text.split(",")]
    names = {role.strip(): name.strip() for role, _, name in pairs}
    _check_roles(list(names), [role.strip() for role, _, _ in pairs])
    return names


def _check_roles(roles: list[str], given: list[str]) -> None:
    unknown = [r for r in roles if r not in HEADERS]
    missing = [r for r in NEEDED if r not in roles]
    if unknown or missing or len(given) != len(roles):
        what = (
            f"unknown {', '.join(unknown)}" if unknown else f"missing {', '.join(missing)}" if missing else "repeated"
        )
        raise InputError(f"declared columns: {what}; needed are {', '.join(NEEDED)}, and camera where there is one")


def _roles_of_header(row: _Row, renamed: dict[str, str] | None) -> dict[str, int] | None:
    """Column of every role; None if a needed one is missing or two columns claim one."""
    header = [f.casefold() for f in row.fields]
    roles: dict[str, int] = {}
    for role, synonyms in HEADERS.items():
        wanted = synonyms if renamed is None else (renamed[role].casefold(),) if role in renamed else ()
        at = [i for i, name in enumerate(header) if name in wanted]
        if len(at) > 1:
            return None
        if at:
            roles[role] = at[0]
    return roles if all(r in roles for r in NEEDED) else None


def _why_no_header(row: _Row, renamed: dict[str, str] | None, path: Path) -> str:
    where = f"{path}:{row.line}"
    header = [f.casefold() for f in row.fields]
    if sum(bool(NUMBER.fullmatch(f)) for f in row.fields) >= 3:
        return (
            f"{where}: no header; declare the columns, for example `columns` name,x,y,z,omega,phi,kappa, or the format "
            "with `format`"
        )
    if "latitude" in header or "longitude" in header:
        return f"{where}: positions are geographic; transform them into a projected CRS in metres beforehand"
    if "roll" in header or "pitch" in header:
        return f"{where}: roll, pitch and yaw are angles of the aircraft; convert them to omega, phi, kappa beforehand"
    missing = []
    for role in NEEDED:
        names = HEADERS[role] if renamed is None else (renamed[role],)
        count = sum(h in [n.casefold() for n in names] for h in header)
        if count != 1:
            missing.append(f"{role} ({'no' if count == 0 else count} column called {' or '.join(names)})")
    return (
        f"{where}: header {', '.join(row.fields)}: {'; '.join(missing)}; declare them with `columns` {NEEDED[0]}=…,x=…"
    )


def _image(row: _Row, roles: dict[str, int], width: int, form: TableFormat, path: Path) -> OrientedImage:
    if len(row.fields) != width:
        hint = "; is the decimal sign a comma? then declare it" if len(row.fields) > width else ""
        raise InputError(f"{path}:{row.line}: {len(row.fields)} columns, the lines before have {width}{hint}")
    name = row.fields[roles["name"]]
    if not name:
        raise InputError(f"{path}:{row.line}: the image has no name")
    value = {role: _number(row, role, roles, form, path) for role in NEEDED[1:]}
    for role in ("omega", "phi", "kappa"):
        if abs(value[role]) > ANGLE_UNITS[form.angle_unit] * (1 + 1e-9):
            raise InputError(
                f"{path}:{row.line}: {role} = {value[role]:g} is more than a full circle in {form.angle_unit}; "
                "declare the angle unit that the table is in (deg, gon or rad)"
            )
    a, b, c = (value[_ANGLE_OF[letter]] for letter in form.rotation)
    camera = row.fields[roles["camera"]] if "camera" in roles else None
    return OrientedImage(name, (value["x"], value["y"], value["z"]), (a, b, c), camera or None, row.line)


def _number(row: _Row, role: str, roles: dict[str, int], form: TableFormat, path: Path) -> float:
    text = row.fields[roles[role]]
    number = decimal(text, form.decimal_comma)
    if number is not None:
        return number
    hint = ""
    if not form.decimal_comma and has_decimal_comma(text):
        hint = "; if the table uses decimal commas, declare it (`decimal_comma`)"
    elif not text or text.casefold().lstrip("+-") in ("nan", "inf", "null", "none", "na", "n/a"):
        hint = "; give the orientation or delete the line"
    raise InputError(f"{path}:{row.line}: {role} = {text!r} is not a number{hint}")


def _delimiter_safe(name: str) -> str:
    """A field of comma-separated text, quoted where it must be."""
    return '"' + name.replace('"', '""') + '"' if any(c in name for c in ',"') or name != name.strip() else name


def render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """Comma-separated table with ω, φ, κ in degrees, camera to ground, and its ``.prj`` where a CRS is known."""
    require_map(block, path)
    table = block.table
    named = any(image.camera for image in table.images)
    lines = ["name,x,y,z,omega,phi,kappa" + (",camera" if named else "")]
    for image, angles in zip(table.images, block.angles("opk", "deg")):
        numbers = [repr(float(v)) for v in (*image.center, *angles)]
        camera = [_delimiter_safe(image.camera or "")] if named else []
        lines.append(",".join([_delimiter_safe(image.name), *numbers, *camera]))
    texts = {path: "\n".join(lines) + "\n"}
    if table.crs is not None:
        texts[path.with_suffix(".prj")] = table.crs + "\n"
    return texts


FORMAT = OrientationFormat(
    name="csv",
    title="table of text",
    # Whatever no other format claims is read as a table.
    sniff=lambda path, head: False,
    read=lambda path, form: OrientationBlock(read(path, form)),
    render=render,
    losses=lambda block: common_losses(block, cameras=False, crs=True),
    suffix=".csv",
    angles=True,
)
