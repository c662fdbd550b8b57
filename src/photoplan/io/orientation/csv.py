"""Exterior orientation from text tables: comma, semicolon, tab or space, with declared columns.

Columns are known by their header (see `HEADERS`) or declared (`TableFormat.columns`). A file of the same name with
the suffix ``.prj`` beside the table states its CRS (EPSG code, WKT or PROJ string), possibly with a vertical part.
"""

from __future__ import annotations

from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.files import crs_beside
from photoplan.io.orientation.block import OrientationBlock, OrientationFormat, common_losses, require_map
from photoplan.io.orientation.form import TableFormat
from photoplan.io.orientation.table import ANGLE_NAMES, OrientationTable, OrientedImage
from photoplan.io.tables import NUMBER, Columns, Dialect, Table, csv_line, read_table

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


def _explain(first: tuple[str, ...], why: str) -> str | None:
    """What a first line is that is no header of orientations."""
    header = [f.casefold() for f in first]
    if sum(bool(NUMBER.fullmatch(f)) for f in first) >= 3:
        return (
            "no header; declare the columns, for example `columns` name,x,y,z,omega,phi,kappa, or the format with "
            "`format`"
        )
    if "latitude" in header or "longitude" in header:
        return "positions are geographic; transform them into a projected CRS in metres beforehand"
    if "roll" in header or "pitch" in header:
        return "roll, pitch and yaw are angles of the aircraft; convert them to omega, phi, kappa beforehand"
    return None


_COLUMNS = Columns(
    roles=HEADERS, needed=NEEDED, numbers=frozenset(NEEDED[1:]), one_each=True, row="image", explain=_explain
)


def read(path: Path, form: TableFormat) -> OrientationTable:
    """Orientation table of a text file."""
    dialect = Dialect(form.columns, form.delimiter, form.decimal_comma)
    table = read_table(path, _COLUMNS, dialect, MAX_BYTES)
    declared = form.columns is not None and "=" not in form.columns and table.layout.header
    notes = (f"{path.name}: line {table.layout.header} was taken as a header",) if declared else ()
    values = table.numbers(*NEEDED[1:])
    images = tuple(_image(table, k, row, form) for k, row in enumerate(values.tolist()))
    beside = crs_beside(path)
    crs, side, heights = (None,) * 3 if beside is None else (beside.crs, beside.file, beside.height_system)
    return OrientationTable(
        file=path,
        images=images,
        angle_unit=form.angle_unit,
        rotation=form.rotation,
        direction=form.direction,
        crs=crs,
        crs_file=side,
        height_system=heights,
        notes=notes,
    )


def _image(table: Table, k: int, values: list[float], form: TableFormat) -> OrientedImage:
    row, roles, where = table.rows[k], table.roles, table.where(k)
    name = row[roles["name"]]
    if not name:
        raise InputError(f"{where}: the image has no name")
    value = dict(zip(NEEDED[1:], values))
    a, b, c = (value[ANGLE_NAMES[letter]] for letter in form.rotation)
    camera = row[roles["camera"]] if "camera" in roles else None
    return OrientedImage(
        name=name,
        center=(value["x"], value["y"], value["z"]),
        angles=(a, b, c),
        camera=camera or None,
        line=table.lines[k],
    )


def render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """Comma-separated table with ω, φ, κ in degrees, camera to ground, and its ``.prj`` where a CRS is known."""
    require_map(block, path)
    table = block.table
    named = any(image.camera for image in table.images)
    lines = ["name,x,y,z,omega,phi,kappa" + (",camera\n" if named else "\n")]
    for image, angles in zip(table.images, block.angles("opk", "deg")):
        numbers = [repr(float(v)) for v in (*image.center, *angles)]
        camera = [image.camera or ""] if named else []
        lines.append(csv_line([image.name, *numbers, *camera]))
    texts = {path: "".join(lines)}
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
