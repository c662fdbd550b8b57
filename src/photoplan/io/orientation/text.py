"""Orientations in text files: lines of BINGO and BLUH, records of PATB, Metashape's Omega Phi Kappa, tables, and TOML.

BINGO (``itera.dat``): lines that begin with ``ORIA`` hold name, X0, Y0, Z0 in metres, φ, ω, κ in gon; φ about Y is the
primary rotation, then ω, then κ. So a program reads them whose author compared his adjustment with BINGO's (Š. Turek,
master's thesis, Czech Technical University in Prague, 2014). Other lines belong to other parts of an adjustment and are
passed over, as is what follows the angles.

BLUH, the bundle adjustment of the University of Hannover: the same without a keyword (rotation: Turek 2014, who names
it BLUH's). No public description of columns and unit was found: the unit has to be declared, and since files of other
make look the same, the format has to be stated.

PATB (``.ori``): three records for each image (PCI Geomatics, *Using Pat-B in OrthoEngine*: ``I16, 16X, 3F16.5 /
5F16.12 / 4F16.12``): its name, a field that may be empty or hold the camera constant, X0, Y0, Z0; then the nine
elements of the rotation matrix row by row, a11 a12 a13 a21 a22 and a23 a31 a32 a33. Published descriptions do not say
whether the matrix takes the camera's axes (x right, y up, z towards the viewer) to the ground's or the other way, and
programs differ. So the user declares it; files are written camera to ground unless the other is asked for.

OPK of Agisoft Metashape: one line per image, ``# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, …, r33``, separated by tabs
or commas; a line ``# CoordinateSystem: WKT`` above states the CRS (Metashape User Manual, Professional Edition,
"Exporting results", camera orientation). Angles are degrees, ω the primary rotation. The direction of the matrix has
changed between versions, so the angles are read, and the matrix must be theirs: as it is, transposed, or with axes y
down and z forwards.

Tables have comma, semicolon, tab or space between columns, which are known by their header (see `HEADERS`) or declared
(`TableFormat.columns`). A file of the same name with the suffix ``.prj`` beside the table states its CRS (EPSG code,
WKT or PROJ string), possibly with a vertical part.

The file has the entries of a project that concern orientation: ``crs``, ``[orientation]`` (height system, angle unit,
rotation), ``[cameras.NAME]`` and ``[[images]]`` with ``name``, ``center``, ``angles`` and, where needed, ``camera``,
``file``, ``size`` and ``fiducials``. A whole project file is read too.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from photoplan.arrays import Floats
from photoplan.errors import InputError
from photoplan.geometry.crs import parse_crs, split_compound
from photoplan.geometry.local import enu_poses, is_local_crs, is_wgs84_geographic, legacy_wkt
from photoplan.geometry.pose import FLIP, rotation_opk
from photoplan.geometry.units import metric_system
from photoplan.io.camera.model import Camera, Fiducials, Name, Pixels, Triple
from photoplan.io.files import crs_beside, explain, read_text, read_toml
from photoplan.io.orientation.block import (
    Loss,
    OrientationBlock,
    OrientationFormat,
    OrientationTable,
    OrientedImage,
    TableFormat,
    common_losses,
    name_losses,
    posed,
    require_map,
)
from photoplan.io.project.file import camera_lines, toml_value
from photoplan.io.project.model import Orientation
from photoplan.io.tables import NUMBER, Columns, Dialect, csv_line, number, read_table

MAX_BYTES = 200_000_000
#: Rotation matrices of files are rounded; what differs more from a rotation is none.
ORTHOGONAL = 2e-4
DIRECTIONS = {"camera-to-ground": "camera to ground", "ground-to-camera": "ground to camera"}


@dataclass(frozen=True)
class Words:
    """A line of a file, split at white space."""

    where: str
    """File and line, for messages."""
    line: int
    words: tuple[str, ...]


def word_lines(path: Path) -> list[Words]:
    """Return the lines of a text file that are not empty; raises InputError as `read_text`."""
    lines = read_text(path, MAX_BYTES).split("\n")
    return [Words(f"{path}:{n}", n, tuple(text.split())) for n, text in enumerate(lines, 1) if text.strip()]


def numbers(words: Sequence[str], where: str, what: str, count: int) -> tuple[float, ...]:
    """Return `count` numbers."""
    if len(words) != count:
        raise InputError(f"{where}: {what}: {len(words)} values; {count} numbers are needed")
    return tuple(number(word, f"{where}: {what}") for word in words)


def one_word(name: str, path: Path) -> str:
    """Return a name that a format without quotes can hold."""
    if not name or name.split() != [name]:
        raise InputError(f"{path}: image {name!r} has a blank in its name, which this format cannot hold; rename it")
    return name


def checked_rotation(values: ArrayLike, where: str, tolerance: float = ORTHOGONAL) -> Floats:
    """Return the rotation (3, 3) nearest to nine rounded numbers, row by row.

    `tolerance` is that of the matrix times itself.
    """
    M = np.array(values, float).reshape(3, 3)
    if not np.allclose(M @ M.T, np.eye(3), rtol=0, atol=tolerance) or np.linalg.det(M) < 0:
        raise InputError(
            f"{where}: the nine numbers are not a rotation matrix (rows of length 1, at right angles, right-handed)"
        )
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ Vt, np.float64)


@dataclass(frozen=True)
class AngleLines:
    """Lines of name, X, Y, Z and φ, ω, κ: what differs between the programs that write them."""

    program: str
    keyword: str
    """First word of the lines that are read; empty if all are."""
    width: int
    """Characters that names are filled up to; with a keyword, names have no more."""
    described: bool
    """True if the unit of angles is known (gon)."""

    def read(self, path: Path, form: TableFormat) -> OrientationBlock:
        """Read a block; `form` is used only where it declares other conventions."""
        skip = int(bool(self.keyword))
        lines = [line for line in word_lines(path) if not skip or line.words[0].upper() == self.keyword]
        if skip and not lines:
            raise InputError(
                f"{path}: no line begins with {self.keyword}; this is no orientation file of {self.program}"
            )
        if not self.described and not form.declares("angle_unit"):
            raise InputError(
                f"{path}: no public description tells the unit of angles in files of {self.program}; declare "
                "`angle_unit` gon, deg or rad (with measured points, `list_readings` tells which)"
            )
        unit, rotation, direction = form.conventions("gon", "pok", "camera-to-ground")
        images = []
        for line in lines:
            if not skip and len(line.words) < 7:
                raise InputError(
                    f"{line.where}: {len(line.words)} columns; a line of {self.program} holds name, X, Y, Z, phi, "
                    "omega, kappa"
                )
            # Standard deviations or the number of a camera may follow.
            name, words = "".join(line.words[skip : skip + 1]), line.words[skip + 1 : skip + 7]
            X, Y, Z, *pok = numbers(words, line.where, f"image {name!r}: X, Y, Z, phi, omega, kappa", 6)
            a, b, c = (pok["pok".index(letter)] for letter in rotation)
            images.append(OrientedImage(name, (X, Y, Z), (a, b, c), line=line.line))
        note = f"{path.name}: angles read as {unit}, rotation {rotation}, {DIRECTIONS[direction]}"
        return OrientationBlock(
            OrientationTable(
                file=path, images=tuple(images), angle_unit=unit, rotation=rotation, direction=direction, notes=(note,)
            )
        )

    def render(self, block: OrientationBlock, path: Path) -> dict[Path, str]:
        """Return the text of a file, angles in gon."""
        require_map(block, path)
        lines, begin = [], self.keyword and f"{self.keyword} "
        for image, (phi, omega, kappa) in zip(block.table.images, block.angles("pok", "gon")):
            X, Y, Z = image.center
            name = f"{one_word(image.name, path):<{self.width}}"
            lines.append(f"{begin}{name} {X:14.4f} {Y:14.4f} {Z:12.4f} {phi:14.8f} {omega:14.8f} {kappa:14.8f}\n")
        return {path: "".join(lines)}

    def sniff(self, path: Path, head: str) -> bool:
        """Return whether a line with the keyword is there."""
        line = rf"^\s*{self.keyword}\s+\S+(\s+[-+.\deEdD]+){{6}}"
        return bool(self.keyword) and re.search(line, head, re.M) is not None

    def losses(self, block: OrientationBlock) -> list[Loss]:
        """Return what of a block is lost."""
        return [*common_losses(block, cameras=False), *(name_losses(block, self.width) if self.keyword else ())]

    def format(self, title: str, suffix: str) -> OrientationFormat:
        """Return the entry in the registry."""
        name = self.program.lower()
        return OrientationFormat(
            name=name,
            title=title,
            sniff=self.sniff,
            read=self.read,
            render=self.render,
            losses=self.losses,
            suffix=suffix,
            angles=True,
        )


#: BINGO takes names of 15 characters at most (Catalyst's guide on export to BINGO).
BINGO = AngleLines("BINGO", "ORIA", 15, described=True).format("orientation lines of BINGO", ".dat")
BLUH = AngleLines("BLUH", "", 20, described=False).format("orientation file of BLUH", ".ori")

#: Characters of an image name that PATB takes at most (Catalyst's guide on export to PATB).
_PATB_NAME = 15


def _read_patb(path: Path, form: TableFormat) -> OrientationBlock:
    lines = word_lines(path)
    if not lines:
        raise InputError(f"{path}: holds no image")
    if not form.declares("direction"):
        raise InputError(
            f"{path}: PATB does not say what its rotation matrix does; declare `rotation_direction` camera-to-ground "
            "or ground-to-camera (with measured points, `list_readings` tells which)"
        )
    if len(lines) % 3:
        raise InputError(
            f"{lines[-1].where}: {len(lines)} lines; PATB has three for each image: name and X, Y, Z, then five and "
            "four elements of the rotation matrix"
        )
    images = []
    for first, second, third in zip(lines[::3], lines[1::3], lines[2::3]):
        if len(first.words) not in (4, 5):
            raise InputError(
                f"{first.where}: {len(first.words)} values; the first line of an image holds its name, X, Y, Z, and "
                "perhaps the camera constant before them"
            )
        name = first.words[0]
        for word in first.words[1:-3]:
            number(word, f"{first.where}: image {name!r}: camera constant")
        center = numbers(first.words[-3:], first.where, f"image {name!r}: X, Y, Z", 3)
        rows = (
            *numbers(second.words, second.where, f"image {name!r}: a11 a12 a13 a21 a22", 5),
            *numbers(third.words, third.where, f"image {name!r}: a23 a31 a32 a33", 4),
        )
        M = checked_rotation(rows, f"{second.where}: image {name!r}")
        images.append(posed(name, center, M if form.direction == "camera-to-ground" else M.T, line=first.line))
    note = f"{path.name}: rotation matrices read as {DIRECTIONS[form.direction]}"
    return OrientationBlock(OrientationTable(path, tuple(images), notes=(note,)))


def _render_patb(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """Return the text of a file; the camera constant in millimetres if it is known, else an empty field."""
    require_map(block, path)
    lines = []
    for image, R in zip(block.table.images, block.table.rotations):
        c = block.camera(image).camera_constant_mm if block.cameras else None
        constant = " " * 16 if c is None else f"{c:16.5f}"
        X, Y, Z = image.center
        lines.append(f"{one_word(image.name, path):>16}{constant} {X:15.5f} {Y:15.5f} {Z:15.5f}")
        M = R.T if block.matrix == "ground-to-camera" else R
        a = [f"{v + 0.0:16.12f}" for v in np.round(M, 12).ravel()]
        lines += ["".join(a[:5]), "".join(a[5:])]
    return {path: "\n".join(lines) + "\n"}


def _losses_patb(block: OrientationBlock) -> list[Loss]:
    direction = DIRECTIONS[block.matrix or "camera-to-ground"]
    word = Loss("other", f"no word on what the rotation matrix does; it is written {direction}")
    return [*common_losses(block, cameras=False), word, *name_losses(block, _PATB_NAME)]


def _sniff_patb(path: Path, head: str) -> bool:
    """Return whether there are three lines whose last nine numbers are a rotation."""
    lines = [line.split() for line in head.split("\n") if line.strip()][:3]
    if [len(words) for words in lines] not in ([4, 5, 4], [5, 5, 4]):
        return False
    try:
        checked_rotation([number(w, "") for w in lines[1] + lines[2]], "")
    except InputError:
        return False
    return True


PATB = OrientationFormat(
    "patb", "orientation file of PATB", _sniff_patb, _read_patb, _render_patb, _losses_patb, suffix=".ori"
)

_OPK_BYTES = 256 << 20
_OPK_HEADER = re.compile(r"#\s*PhotoID\W+X\W+Y\W+Z\W+Omega\W+Phi\W+Kappa", re.I)
_OPK_SYSTEM = re.compile(r"#\s*CoordinateSystem\s*:?\s*(\S.*)", re.I)
#: Largest difference of an angle's matrix and the printed one: angles are printed with six digits and more.
_OPK_TOLERANCE = 1e-5


def _read_opk(path: Path, form: TableFormat) -> OrientationBlock:
    images: list[OrientedImage] = []
    crs: str | None = None
    notes: list[str] = []
    for n, line in enumerate(read_text(path, _OPK_BYTES).split("\n"), 1):
        system = _OPK_SYSTEM.match(line)
        if system:
            local = is_local_crs(system[1], f"{path}:{n}")
            if not local:
                parse_crs(system[1], f"{path}:{n}")
            crs = None if local else system[1]
            notes += [f"{path.name}: coordinates are in a local system"] if local else []
        if line.strip() and not line.lstrip().startswith("#"):
            images.append(_opk_image(line, n, path))
    if crs is None:
        return OrientationBlock(OrientationTable(path, tuple(images), notes=tuple(notes)))
    metric = metric_system(crs, f"{path}: CoordinateSystem")
    crs, heights = split_compound(crs)
    if crs is None or not is_wgs84_geographic(crs, f"{path}: CoordinateSystem"):
        return OrientationBlock(
            OrientationTable(
                path, tuple(images), crs=crs, height_system=heights, true_metres=crs is not None, notes=tuple(notes)
            )
        )
    # Positions are longitude, latitude and height, angles refer to east, north and up at each of them.
    table = OrientationTable(path, tuple(images), notes=tuple(notes))
    lon, lat, height = table.centers.T
    if (np.abs(lat) > 90).any():
        raise InputError(f"{path}: latitude {lat[np.abs(lat) > 90][0]}; X is longitude and Y latitude, degrees")
    origin, enu, axes = enu_poses(np.column_stack([lat, lon, height * (metric.height_scale or 1.0)]))
    placed = (posed(i.name, at, R, line=i.line) for i, at, R in zip(images, enu, axes @ table.rotations))
    return OrientationBlock(replace(table, images=tuple(placed), origin=origin))


def _opk_image(line: str, n: int, path: Path) -> OrientedImage:
    where = f"{path}:{n}"
    split = line.split("\t" if "\t" in line else "," if "," in line else None)
    fields = [field.strip() for field in split if field.strip()]
    if len(fields) not in (7, 16):
        raise InputError(f"{where}: {len(fields)} columns; 7 (PhotoID, X, Y, Z, Omega, Phi, Kappa) or 16 are needed")
    name, *words = fields
    X, Y, Z, omega, phi, kappa, *matrix = numbers(words, where, f"image {name!r}: column", len(words))
    if matrix:
        given, R = np.array(matrix).reshape(3, 3), rotation_opk(*np.radians([omega, phi, kappa]))
        worst = min(float(np.abs(given - reading).max()) for reading in (R, R.T, R @ FLIP, (R @ FLIP).T))
        if worst > _OPK_TOLERANCE:
            raise InputError(
                f"{where}: image {name!r}: the matrix r11 … r33 is not that of ω, φ, κ in degrees (nearest reading "
                f"differs by {worst:.2g}); the file states other angles (yaw, pitch, roll?): export Omega Phi Kappa"
            )
    return OrientedImage(name, (X, Y, Z), (omega, phi, kappa), line=n)


def _render_opk(block: OrientationBlock, path: Path) -> dict[Path, str]:
    table = block.table
    lines = [] if table.crs is None else [f"# CoordinateSystem: {legacy_wkt(table.crs)}"]
    lines.append(f"# Cameras ({len(table.images)})")
    lines.append("# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, r12, r13, r21, r22, r23, r31, r32, r33")
    for image, angles, R in zip(table.images, block.angles("opk", "deg").tolist(), table.rotations):
        if "\t" in image.name or "\n" in image.name:
            raise InputError(f"{path}: image {image.name!r} holds a tab or a line end; rename it")
        lines.append("\t".join([image.name, *(repr(v) for v in (*image.center, *angles, *R.ravel().tolist()))]))
    return {path: "\n".join([*lines, ""])}


OPK = OrientationFormat(
    name="opk",
    title="Metashape Omega Phi Kappa text",
    sniff=lambda path, head: any(_OPK_HEADER.match(line.strip()) for line in head.split("\n")[:10]),
    read=_read_opk,
    render=_render_opk,
    losses=lambda block: common_losses(block, cameras=False, crs=True),
)

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
_TABLE_BYTES = 100_000_000


def _explain(first: tuple[str, ...], why: str) -> str | None:
    """Return what a first line is that is no header of orientations."""
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


def _read_csv(path: Path, form: TableFormat) -> OrientationBlock:
    dialect = Dialect(form.columns, form.delimiter, form.decimal_comma)
    table = read_table(path, _COLUMNS, dialect, _TABLE_BYTES)
    declared = form.columns is not None and "=" not in form.columns and table.layout.header
    values, roles, images = table.numbers(*NEEDED[1:]), table.roles, []
    for k, (X, Y, Z, *opk) in enumerate(values.tolist()):
        name = table.rows[k][roles["name"]]
        if not name:
            raise InputError(f"{table.where(k)}: the image has no name")
        a, b, c = (opk["opk".index(letter)] for letter in form.rotation)
        camera = table.rows[k][roles["camera"]] if "camera" in roles else None
        images.append(
            OrientedImage(name=name, center=(X, Y, Z), angles=(a, b, c), camera=camera or None, line=table.lines[k])
        )
    beside = crs_beside(path)
    crs, side, heights = (None,) * 3 if beside is None else (beside.crs, beside.file, beside.height_system)
    return OrientationBlock(
        OrientationTable(
            file=path,
            images=tuple(images),
            angle_unit=form.angle_unit,
            rotation=form.rotation,
            direction=form.direction,
            crs=crs,
            crs_file=side,
            height_system=heights,
            notes=(f"{path.name}: line {table.layout.header} was taken as a header",) if declared else (),
        )
    )


def _render_csv(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """Return a comma-separated table with ω, φ, κ in degrees, camera to ground, and its ``.prj`` if a CRS is known."""
    require_map(block, path)
    table = block.table
    named = any(image.camera for image in table.images)
    lines = ["name,x,y,z,omega,phi,kappa" + (",camera\n" if named else "\n")]
    for image, angles in zip(table.images, block.angles("opk", "deg")):
        words = [repr(float(v)) for v in (*image.center, *angles)]
        lines.append(csv_line([image.name, *words, *([image.camera or ""] if named else [])]))
    texts = {path: "".join(lines)}
    if table.crs is not None:
        texts[path.with_suffix(".prj")] = table.crs + "\n"
    return texts


CSV = OrientationFormat(
    name="csv",
    title="table of text",
    # Whatever no other format claims is read as a table.
    sniff=lambda path, head: False,
    read=_read_csv,
    render=_render_csv,
    losses=lambda block: common_losses(block, cameras=False, crs=True),
    suffix=".csv",
    angles=True,
)


class _TomlLine(BaseModel):
    # What else a project states of an image is not needed here.
    model_config = ConfigDict(frozen=True, extra="ignore")
    name: Name
    center: Triple | None = None
    angles: Triple | None = None
    camera: Name | None = None
    file: Name | None = None
    size: tuple[Pixels, Pixels] | None = None
    fiducials: Fiducials | None = None
    sigma_center: Triple | None = None
    sigma_angles: Triple | None = None


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")
    crs: Name | None = None
    orientation: Orientation = Orientation()
    cameras: dict[Name, Camera] = Field(default_factory=dict)
    images: Annotated[tuple[_TomlLine, ...], Field(min_length=1)]


def _read_toml(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images of a TOML file with their cameras; it states its own angle unit and rotation: `form`
    is not used.
    """
    contents, text = read_toml(path)
    try:
        file = _File.model_validate(contents)
    except ValidationError as error:
        raise InputError(explain(error, contents, str(path), text)) from None
    crs, heights = None, None
    if file.crs is not None:
        parse_crs(file.crs, f"{path}: crs")
        crs, heights = split_compound(file.crs)
    if file.orientation.height_system is not None:
        heights = file.orientation.height_system
    images: list[OrientedImage] = []
    notes: list[str] = []
    for i in file.images:
        if i.center is not None and i.angles is not None:
            images.append(
                OrientedImage(
                    name=i.name, center=i.center, angles=i.angles, camera=i.camera, line=None, fiducials=i.fiducials
                )
            )
        elif i.center is not None or i.angles is not None:
            raise InputError(f"{path}: image {i.name!r}: center and angles go together; give both or none")
    if not images:
        raise InputError(f"{path}: none of the {len(file.images)} images has center and angles")
    if len(images) < len(file.images):
        notes.append(f"{path.name}: {len(file.images) - len(images)} images are not oriented and left out")
    notes += _not_taken(file, path)
    table = OrientationTable(
        path,
        tuple(images),
        file.orientation.angle_unit,
        file.orientation.rotation,
        crs=crs,
        height_system=heights,
        notes=tuple(notes),
    )
    names = {image.name for image in images}
    files = {i.name: i.file for i in file.images if i.file is not None and i.name in names}
    sizes = {i.name: i.size for i in file.images if i.size is not None and i.name in names}
    return OrientationBlock(table, file.cameras, files, sizes)


def _not_taken(file: _File, path: Path) -> list[str]:
    """Notes on what a project states of its orientations and no orientation file does."""
    notes = []
    corrections = [f"earth curvature ({file.orientation.earth_curvature})"]
    corrections = corrections if file.orientation.earth_curvature != "none" else []
    corrections += ["refraction"] if file.orientation.refraction else []
    if corrections:
        notes.append(f"{path.name}: orientations hold with {' and '.join(corrections)}; whoever reads them must know")
    if any(i.sigma_center is not None or i.sigma_angles is not None for i in file.images):
        notes.append(f"{path.name}: standard deviations of orientations are not taken over")
    return notes


def render_toml(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """The text of a file; numbers that are camera to ground already stay as they are."""
    require_map(block, path)
    table = block.table
    unit, order = (table.angle_unit, table.rotation) if table.direction == "camera-to-ground" else ("deg", "opk")
    lines = ["# Orientations of photoplan; lengths are metres unless the name of an entry says otherwise."]
    if table.crs is not None:
        lines.append(f"crs = {toml_value(table.crs)}")
    lines += ["", "[orientation]"]
    if table.height_system is not None:
        lines.append(f"height_system = {toml_value(table.height_system)}")
    lines += [f"angle_unit = {toml_value(unit)}", f"rotation = {toml_value(order)}", ""]
    for name, camera in block.cameras.items():
        lines += camera_lines(name, camera)
    for image, angles in zip(table.images, block.angles(order, unit)):
        entries = {
            "name": image.name,
            "file": block.files.get(image.name),
            "camera": image.camera if image.camera is not None or not block.cameras else block.camera_name(image),
            "center": list(image.center),
            "angles": angles.tolist(),
            "fiducials": image.fiducials,
            "size": block.sizes.get(image.name),
        }
        lines += ["[[images]]", *(f"{k} = {toml_value(v)}" for k, v in entries.items() if v is not None), ""]
    return {path: "\n".join(lines)}


TOML = OrientationFormat(
    name="toml",
    title="photoplan's own TOML",
    sniff=lambda path, head: path.suffix.lower() == ".toml",
    read=_read_toml,
    render=render_toml,
    suffix=".toml",
    angles=True,
)
