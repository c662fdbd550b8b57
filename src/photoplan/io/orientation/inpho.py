"""Project files of Trimble Inpho, Match-AT and OrthoMaster (``.prj``): images, orientations and digital frame cameras.

Sections ``$CAMERA`` (or ``$CAMERA_DEFINITION``) and ``$PHOTO`` hold entries ``$KEY : value`` and lines of numbers:

``$EXT_ORI``
    camera constant in millimetres, X0, Y0, Z0, then a rotation matrix row by row;
``$CCD_INTERIOR_ORIENTATION``
    two rows of an affine transformation from image coordinates (millimetres, x right, y up) to pixels (column, row);
``$PIXEL_REFERENCE``
    ``CenterTopLeft``: pixel (0, 0) is the centre of the upper-left one, as here;
``$PRINCIPAL_POINT_PPA``
    principal point in the image coordinates, millimetres;
``$INS`` in ``$NAVIGATION``
    ω, φ, κ of an image, in ``$ANGULAR_UNITS``.

The matrix takes the ground's axes (X east, Y north, Z up) to the camera's (x right, y up, z towards the viewer), its
rows are the camera's axes: so projects of MATCH-AT are read and published by others (cismet CARMA, importer and data
contract of its oblique viewer), and only so do the cameras of a published project look along and across their
flight line. There are programs that take it the other way. So ``$INS`` is heard first: the matrix or its transpose is
the rotation of these angles, and if neither is, the user declares it. An affine transformation that turns
the image is carried over to the rotation. ``$RADIAL_COEFFS`` and ``$DECENTRE_COEFFS`` are not read, since it is not
public whether they correct or distort: a camera that has them is left to a camera file.

In files that are written, each image also gets its ω, φ, κ as ``$INS``, so that the file itself settles the direction
of its rotation matrices; they are written ground to camera unless the other is asked for.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import parse_crs, split_compound
from photoplan.geometry.pose import rotation_opk
from photoplan.io.camera.model import CameraEntry, FrameEntry, InPixels
from photoplan.io.files import build, read_text
from photoplan.io.orientation.block import (
    Loss,
    OrientationBlock,
    OrientationFormat,
    OrientationTable,
    common_losses,
    posed,
    require_map,
)
from photoplan.io.orientation.form import Direction, TableFormat
from photoplan.io.orientation.text import DIRECTIONS, checked_rotation, numbers
from photoplan.io.tables import number

MAX_BYTES = 200_000_000
#: Largest median difference of matrices and angles that settles what the matrices do: boresight angles and errors of
#: observed attitudes stay below, degrees.
AGREE = 3.0
#: What matrices of MATCH-AT do.
OWN: Direction = "ground-to-camera"
#: Row products of an affine transformation without shear, and of a rotation that is none.
SQUARE = 1e-6

_ANGLE_UNITS = {"deg": np.pi / 180, "degree": np.pi / 180, "gon": np.pi / 200, "grad": np.pi / 200, "rad": 1.0}


@dataclass
class _Entry:
    """``$KEY : value`` and the lines below it that begin no other entry."""

    key: str
    value: str
    line: int
    rows: list[str] = field(default_factory=list)


class _Section(dict[str, _Entry]):
    """Entries of a section by key, the first of each; `repeated` are keys that came again."""

    def __init__(self, line: int) -> None:
        super().__init__()
        self.line = line
        self.repeated: set[str] = set()

    def take(self, entry: _Entry) -> None:
        if entry.key in self:
            self.repeated.add(entry.key)
        else:
            self[entry.key] = entry

    def text(self, *keys: str) -> str | None:
        """Value of the first of `keys` that is stated."""
        return next((self[k].value.replace("\\ ", " ").strip() for k in keys if k in self and self[k].value), None)


@dataclass
class _InphoFile:
    """The parts of a file that are read."""

    cameras: list[_Section] = field(default_factory=list)
    photos: list[_Section] = field(default_factory=list)
    navigation: list[_Section] = field(default_factory=list)
    other: _Section = field(default_factory=lambda: _Section(0))


def _parse(path: Path) -> _InphoFile:
    file, section, nested, navigating = _InphoFile(), None, 0, False
    for entry in _entries(read_text(path, MAX_BYTES)):
        key = entry.key
        if key in ("$CAMERA", "$CAMERA_DEFINITION") and not entry.value:
            section, nested, navigating = _Section(entry.line), 0, False
            file.cameras.append(section)
        elif key == "$PHOTO":
            section, nested, navigating = _Section(entry.line), 0, False
            file.photos.append(section)
        elif key == "$NAVIGATION":
            section, navigating = None, True
        elif key == "$CALIBRATION_SET":
            nested += 1
        elif key in ("$END", "$ENDNAV"):
            if nested:
                nested -= 1
            else:
                section, navigating = None, False
        else:
            if navigating and key == "$PHOTO_NUM":
                section = _Section(entry.line)
                file.navigation.append(section)
            (file.other if section is None else section).take(entry)
    return file


def _entries(text: str) -> list[_Entry]:
    found: list[_Entry] = []
    for line, raw in enumerate(text.split("\n"), 1):
        row = raw.strip()
        if row.startswith("$"):
            key, _, value = row.partition(":")
            words = key.split(None, 1)
            found.append(_Entry(words[0].upper(), value.strip() or " ".join(words[1:]), line))
        elif row and found:
            found[-1].rows.append(row)
    return found


def _read(path: Path, form: TableFormat) -> OrientationBlock:
    """Block of a file."""
    file = _parse(path)
    photos = [p for p in file.photos if "$EXT_ORI" in p]
    if not photos:
        raise InputError(f"{path}: holds no $PHOTO with $EXT_ORI; this is no Inpho project with orientations")
    notes = []
    if len(photos) < len(file.photos):
        notes.append(f"{path.name}: {len(file.photos) - len(photos)} images have no $EXT_ORI and are left out")
    poses = [_Pose(photo, path) for photo in photos]
    direction, reason = _direction(poses, file, form, path)
    notes.append(f"{path.name}: rotation matrices read as {DIRECTIONS[direction]}{reason}")
    cameras: dict[str, CameraEntry] = {}
    turns: dict[str, NDArray[np.float64]] = {}
    for section in file.cameras:
        name, camera, turn, why = _camera(section, path)
        turns[name] = turn
        if camera is not None:
            cameras[name] = camera
        if why is not None:
            notes.append(f"{path.name}: camera {name!r} is not taken over: {why}; give it as a camera file")
    images, turned = [], False
    for pose in poses:
        turn = turns.get(pose.camera or "", np.eye(3))
        turned |= not np.array_equal(turn, np.eye(3))
        R = (pose.M if direction == "camera-to-ground" else pose.M.T) @ turn.T
        images.append(posed(pose.name, pose.center, R, pose.camera, pose.line))
    if turned:
        notes.append(f"{path.name}: image axes of $CCD_INTERIOR_ORIENTATION are turned; the rotations are adapted")
    if any(image.camera not in cameras for image in images):
        # Some cameras alone would be no description of the block.
        cameras = {}
    crs, heights = _crs(file, path, notes)
    files = {pose.name: pose.file for pose in poses if pose.file is not None}
    table = OrientationTable(path, tuple(images), crs=crs, height_system=heights, notes=tuple(notes))
    return OrientationBlock(table, cameras, files)


class _Pose:
    """A photo as the file states it."""

    def __init__(self, photo: _Section, path: Path) -> None:
        entry = photo["$EXT_ORI"]
        name = photo.text("$PHOTO_NUM")
        self.line = photo.line
        where = f"{path}:{entry.line}"
        if name is None:
            raise InputError(f"{path}:{photo.line}: a $PHOTO without $PHOTO_NUM; every image needs its name")
        self.name, self.camera, self.file = name, photo.text("$CAMERA_ID"), photo.text("$PHOTO_FILE")
        if len(entry.rows) < 4:
            raise InputError(
                f"{where}: $EXT_ORI of image {name!r} has {len(entry.rows)} lines of numbers; 4 are needed"
            )
        first = numbers(entry.rows[0].split(), where, f"image {name!r}: c, X, Y, Z", 4)
        self.center = first[1:]
        rows = [v for row in entry.rows[1:4] for v in numbers(row.split(), where, f"image {name!r}: rotation", 3)]
        self.M = checked_rotation(rows, f"{where}: image {name!r}")


def _direction(poses: list[_Pose], file: _InphoFile, form: TableFormat, path: Path) -> tuple[Direction, str]:
    """Return the direction of the matrices, as declared, as the angles of `$INS` show, or as MATCH-AT writes them; and
    the reason."""
    if form.declares("direction"):
        return form.direction, ""
    unit = _ANGLE_UNITS.get((file.other.text("$ANGULAR_UNITS") or "deg").lower(), np.nan)
    angles = {}
    for section in file.navigation if np.isfinite(unit) else ():
        name, ins = section.text("$PHOTO_NUM"), section.get("$INS")
        if name is not None and ins is not None:
            words = ins.value.split()[:3]
            angles[name] = [number(w, f"{path}:{ins.line}: $INS of image {name!r}") * unit for w in words]
    known = [(pose.M, rotation_opk(*angles[pose.name])) for pose in poses if len(angles.get(pose.name, [])) == 3]
    usual = ", as MATCH-AT writes them (another program's project: `rotation_direction` camera-to-ground)"
    if not known:
        return OWN, usual
    off: dict[Direction, float] = {
        "camera-to-ground": float(np.median([_between(M, R) for M, R in known])),
        "ground-to-camera": float(np.median([_between(M.T, R) for M, R in known])),
    }
    fitting = [d for d in off if off[d] < AGREE]
    if not fitting:
        raise InputError(
            f"{path}: the rotation matrices differ from the angles of $INS by {min(off.values()):.0f}° or more, "
            "whatever they do; declare `rotation_direction` ground-to-camera (as MATCH-AT writes them) or "
            "camera-to-ground (with measured points, `list_readings` tells which)"
        )
    if len(fitting) == 1:
        return fitting[0], ", as the angles of $INS tell"
    if max(off.values()) > 3 * min(off.values()) and max(off.values()) > 1e-6:
        return min(fitting, key=lambda d: off[d]), ", as the angles of $INS tell"
    return OWN, usual


def _between(A: NDArray[np.float64], B: NDArray[np.float64]) -> float:
    """Angle between two rotations, degrees."""
    S = A.T @ B
    sine = np.linalg.norm([S[2, 1] - S[1, 2], S[0, 2] - S[2, 0], S[1, 0] - S[0, 1]])
    return float(np.degrees(np.arctan2(sine, np.trace(S) - 1)))


def _camera(section: _Section, path: Path) -> tuple[str, CameraEntry | None, NDArray[np.float64], str | None]:
    """Name, camera, rotation from the file's image axes to those of the pixels, and why there is no camera."""
    name = section.text("$CAMERA_ID", "$ID", "$TYPE")
    if name is None:
        raise InputError(f"{path}:{section.line}: a camera without $ID or $TYPE; photos refer to it")
    still = np.eye(3)
    if "$FOCAL_LENGTH" in section.repeated:
        return name, None, still, "it has several calibrations"
    if "$CCD_INTERIOR_ORIENTATION" not in section or "$FOCAL_LENGTH" not in section:
        return name, None, still, "it has no $CCD_INTERIOR_ORIENTATION or no $FOCAL_LENGTH"
    A, t = _affine(section, path)
    pixel = 1 / np.linalg.norm(A, axis=1)
    Q = A * pixel[:, None] * [[1.0], [-1.0]]
    if np.linalg.det(Q) < 0 or abs(Q[0] @ Q[1]) > SQUARE:
        return name, None, still, "its pixels are mirrored or not rectangular in $CCD_INTERIOR_ORIENTATION"
    if np.allclose(Q, np.eye(2), atol=SQUARE):
        turn = still
    else:
        turn = np.eye(3)
        turn[:2, :2] = Q
    if (section.text("$PIXEL_REFERENCE") or "CenterTopLeft").lower() != "centertopleft":
        return name, None, turn, f"$PIXEL_REFERENCE is {section.text('$PIXEL_REFERENCE')}, not CenterTopLeft"
    stated = [section[key] for key in ("$RADIAL_COEFFS", "$DECENTRE_COEFFS") if key in section]
    words = [(f"{path}:{e.line}: {e.key}", word) for e in stated for row in (e.value, *e.rows) for word in row.split()]
    coefficients = [number(word, where) for where, word in words]
    if any(coefficients):
        return name, None, turn, "it is not public whether its $RADIAL_COEFFS correct or distort"
    return name, _frame(section, name, A, t, pixel, path), turn, None


def _affine(section: _Section, path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    entry = section["$CCD_INTERIOR_ORIENTATION"]
    where = f"{path}:{entry.line}"
    rows = [numbers(row.split(), where, entry.key, 3) for row in entry.rows[:2]]
    both = np.array(rows, float)
    if both.shape != (2, 3) or abs(np.linalg.det(both[:, :2])) < 1e-12:
        raise InputError(f"{where}: {entry.key} needs two lines of three numbers that are an affine transformation")
    return both[:, :2], both[:, 2]


def _frame(
    section: _Section, name: str, A: NDArray[np.float64], t: NDArray[np.float64], pixel: NDArray[np.float64], path: Path
) -> CameraEntry:
    where = f"{path}:{section.line}: camera {name!r}"
    ppa = numbers((section.text("$PRINCIPAL_POINT_PPA") or "0 0").split(), where, "$PRINCIPAL_POINT_PPA", 2)
    col, row = (A @ ppa + t).tolist()
    size = [_count(section, key, where) for key in ("$CCD_COLUMNS", "$CCD_ROWS")]
    width, height = (float(v) for v in pixel * 1000)
    values = {
        "size": tuple(size),
        "camera_constant_mm": number(section["$FOCAL_LENGTH"].value, f"{where}: $FOCAL_LENGTH"),
        "pixel_size_um": width if abs(width - height) < 1e-9 * width else (width, height),
        "principal_point_px": (col, row),
    }
    return build(FrameEntry, values, where)


def _count(section: _Section, key: str, where: str) -> int:
    text = section.text(key) or ""
    if not re.fullmatch(r"\d{1,8}", text, re.ASCII):
        raise InputError(f"{where}: {key} = {text!r}; a whole number of pixels is needed")
    return int(text)


def _crs(file: _InphoFile, path: Path, notes: list[str]) -> tuple[str | None, str | None]:
    entry = file.other.get("$COORDINATE_SYSTEM")
    text = " ".join([entry.value, *entry.rows]).strip() if entry is not None else ""
    if not text:
        return None, None
    try:
        parse_crs(text, str(path))
    except InputError:
        notes.append(f"{path.name}: $COORDINATE_SYSTEM {text[:60]!r} is not known; declare the CRS")
        return None, None
    return split_compound(text)


#: Side of a pixel that is taken for a camera that is described in pixels, millimetres.
ASSUMED_PIXEL = 0.005


def _losses(block: OrientationBlock) -> list[Loss]:
    """Return the properties of a block that an Inpho project does not hold."""
    lost = common_losses(block, cameras=True, film=False, crs=True)
    direction = DIRECTIONS[block.matrix or OWN]
    lost.append(
        Loss("other", f"no word on what the rotation matrix does; it is written {direction}, the angles as $INS")
    )
    for name, camera in block.cameras.items():
        if camera.camera_constant_mm is None:
            lost.append(
                Loss("other", f"no camera in pixels: {name!r} is written with pixels of {ASSUMED_PIXEL * 1000:g} µm")
            )
    return lost


def _render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """Return the text of a project; the format states a camera constant with every image."""
    require_map(block, path)
    if not block.cameras:
        raise InputError(f"{path}: an Inpho project states a camera constant with every image; give `camera` FILE")
    lines = ["$PROJECT 5.0.0", f"  $PROJECT_NAME : {_word(path.stem)}", "  $ANGULAR_UNITS : deg", "$END"]
    if block.table.crs is not None:
        crs = " ".join(block.table.crs.split())
        lines += ["$COORDINATE_SYSTEM_SET", f"  $COORDINATE_SYSTEM : {crs}", "$END_COORDINATE_SYSTEM"]
    for image, R in zip(block.table.images, block.table.rotations):
        M = np.round(R.T if (block.matrix or OWN) == "ground-to-camera" else R, 14)
        file = block.files.get(image.name)
        lines += ["$PHOTO", f"  $PHOTO_NUM : {_word(image.name)}"]
        lines += [] if file is None else [f"  $PHOTO_FILE : {_word(file)}"]
        lines += [f"  $CAMERA_ID : {_word(block.camera_name(image))}", "  $ORI_STAT : adjusted", "  $EXT_ORI :"]
        lines.append("    " + _row((_constant(block.camera(image)), *image.center), 16, 6))
        lines += [*("    " + _row(row, 18, 14) for row in M), "$END"]
    for name, camera in block.cameras.items():
        if camera.pixels is not None:
            lines += _camera_lines(name, camera.pixels, _constant(camera))
    lines.append("$NAVIGATION")
    for image, angles in zip(block.table.images, block.angles("opk", "deg")):
        lines.append(f"  $PHOTO_NUM : {_word(image.name)}")
        lines.append(f"  $GPS : {_row(image.center, 15, 4)}")
        lines.append(f"  $INS : {_row(angles, 14, 8)}")
    lines.append("$ENDNAV")
    return {path: "\n".join(lines) + "\n"}


def _word(name: str) -> str:
    return name.replace(" ", "\\ ")


def _row(values: object, width: int, digits: int) -> str:
    return " ".join(f"{float(v) + 0.0:{width}.{digits}f}" for v in values)  # type: ignore[attr-defined]


def _constant(camera: CameraEntry) -> float:
    if camera.camera_constant_mm is not None or camera.pixels is None:
        return camera.constant_mm
    return camera.pixels.focal[0] * ASSUMED_PIXEL


def _camera_lines(name: str, camera: InPixels, c: float) -> list[str]:
    (fx, fy), (col, row), (width, height) = camera.focal, camera.point, camera.size
    # The image coordinates have their origin in the principal point: then PPA is zero.
    return [
        "$CAMERA",
        f"  $TYPE : {_word(name)}",
        "  $BRAND : Custom",
        "  $KIND : CCDFrame",
        "  $CCD_INTERIOR_ORIENTATION :",
        f"    {_row((fx / c, 0.0, col), 24, 14)}",
        f"    {_row((0.0, -fy / c, row), 24, 14)}",
        f"  $CCD_COLUMNS : {width}",
        f"  $CCD_ROWS : {height}",
        "  $PIXEL_REFERENCE : CenterTopLeft",
        f"  $FOCAL_LENGTH : {c:.9f}",
        "  $PRINCIPAL_POINT_PPA : 0.000000 0.000000",
        "$END",
    ]


def _sniff(path: Path, head: str) -> bool:
    return re.search(r"^\s*\$(PROJECT|PHOTO|EXT_ORI)\b", head, re.M) is not None


FORMAT = OrientationFormat("inpho", "project of Trimble Inpho", _sniff, _read, _render, _losses, suffix=".prj")
