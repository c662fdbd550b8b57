"""Orientations and cameras of Trimble Inpho (``.prj``) and of Pix4D.

Project files of Trimble Inpho, Match-AT and OrthoMaster (``.prj``): images, orientations and digital frame cameras.

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

Pix4D's exterior and interior orientations (folder ``1_initial/params`` of a project).

``PROJECT_pix4d_calibrated_internal_camera_parameters.cam``: as Pix4D's knowledge base ("How are the Internal and
External Camera Parameters defined?") and its open format (OPF specification: calibrated cameras, CC BY 4.0) define
them: focal length and principal point in one unit, the origin at the *corner* of the upper-left pixel, y down; R1–R3
and T1, T2 as in OpenCV (k1, k2, k3 and p1, p2). In this file the unit is the millimetre of a sensor whose size is
stated, but not its pixels: these are read from the file ``PROJECT_calibrated_internal_camera_parameters.cam`` beside
it. That second file holds the same camera in Inpho's manner, for undistorted images or with a table of corrections; it
is not read by itself.

``PROJECT_calibrated_external_camera_parameters.txt`` has one line per image, ``imageName X Y Z Omega Phi Kappa``:
degrees, R = R_ω R_φ R_κ takes the camera's axes (x right, y up, z backwards) to those of the map (Pix4D knowledge base,
"How are the Internal and External Camera Parameters defined?"; OPF specification, input cameras).
``PROJECT_calibrated_camera_parameters.txt`` has ten lines per image with camera and pose in the form of computer
vision, m = K [R | −R t] X with x right, y down, z forwards, positions relative to ``PROJECT_offset.xyz``.
``PROJECT_wkt.prj`` states the CRS. Each of the two may be given; files of the project beside it are used too.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from photoplan.arrays import Floats
from photoplan.errors import InputError
from photoplan.geometry.crs import parse_crs, split_compound
from photoplan.geometry.local import is_local_crs, legacy_wkt
from photoplan.geometry.pose import FLIP, rotation_opk
from photoplan.io.camera.model import CameraEntry, FrameEntry, InPixels
from photoplan.io.camera.opencv import OpenCVForm, frame_camera, opencv_form, opencv_losses
from photoplan.io.files import build, finite, read_text, whole_number
from photoplan.io.orientation.block import (
    Direction,
    Loss,
    OrientationBlock,
    OrientationFormat,
    OrientationTable,
    OrientedImage,
    TableFormat,
    common_losses,
    posed,
    require_map,
)
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


def _read_inpho(path: Path, form: TableFormat) -> OrientationBlock:
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
    turns: dict[str, Floats] = {}
    for section in file.cameras:
        name, camera, turn, why = _inpho_camera(section, path)
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


def _between(A: Floats, B: Floats) -> float:
    """Angle between two rotations, degrees."""
    S = A.T @ B
    sine = np.linalg.norm([S[2, 1] - S[1, 2], S[0, 2] - S[2, 0], S[1, 0] - S[0, 1]])
    return float(np.degrees(np.arctan2(sine, np.trace(S) - 1)))


def _inpho_camera(section: _Section, path: Path) -> tuple[str, CameraEntry | None, Floats, str | None]:
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


def _affine(section: _Section, path: Path) -> tuple[Floats, Floats]:
    entry = section["$CCD_INTERIOR_ORIENTATION"]
    where = f"{path}:{entry.line}"
    rows = [numbers(row.split(), where, entry.key, 3) for row in entry.rows[:2]]
    both = np.array(rows, float)
    if both.shape != (2, 3) or abs(np.linalg.det(both[:, :2])) < 1e-12:
        raise InputError(f"{where}: {entry.key} needs two lines of three numbers that are an affine transformation")
    return both[:, :2], both[:, 2]


def _frame(section: _Section, name: str, A: Floats, t: Floats, pixel: Floats, path: Path) -> CameraEntry:
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


def _losses_inpho(block: OrientationBlock) -> list[Loss]:
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


def _render_inpho(block: OrientationBlock, path: Path) -> dict[Path, str]:
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


def _sniff_inpho(path: Path, head: str) -> bool:
    return re.search(r"^\s*\$(PROJECT|PHOTO|EXT_ORI)\b", head, re.M) is not None


INPHO = OrientationFormat(
    "inpho", "project of Trimble Inpho", _sniff_inpho, _read_inpho, _render_inpho, _losses_inpho, suffix=".prj"
)


_CAMERA_BYTES = 1 << 20
_KEYS = ("F", "Px", "Py", "K1", "K2", "K3", "T1", "T2")
_SENSOR = re.compile(r"sensor width of\s*([\d.eE+-]+)\s*x\s*([\d.eE+-]+)\s*mm", re.I)
_SIZE = re.compile(r"#\s*Image size\s+(\d+)\s*x\s*(\d+)\s*pixel", re.I)
_FILE = re.compile(r"(Pix4D camera calibration file|camera_calibration_file)\s*(\d+)", re.I)
_SUFFIX = "pix4d_calibrated_internal_camera_parameters.cam"


def _camera_files(stem: Path) -> tuple[Path, Path]:
    """Pix4D's and Inpho's file of the cameras of a project; `stem` is a path up to the project's name."""
    return stem.with_name(f"{stem.name}_{_SUFFIX}"), stem.with_name(f"{stem.name}_{_SUFFIX.removeprefix('pix4d_')}")


def read_pix4d_cameras(path: Path) -> dict[str, CameraEntry]:
    """Cameras of a ``.cam`` file: ``camera 0``, ``camera 1`` … as the file numbers them."""
    text = read_text(path, _CAMERA_BYTES)
    if not re.search(r"^\s*F\s", text, re.M):
        raise InputError(
            f"{path}: not Pix4D's own camera file (no line `F`); give PROJECT_{_SUFFIX}, or for all images at once "
            "PROJECT_calibrated_camera_parameters.txt"
        )
    sizes = _image_sizes(path)
    cameras: dict[str, CameraEntry] = {}
    for key, section in _sections(text):
        where = f"{path}: camera {key}"
        if key not in sizes:
            beside = path.name.replace("pix4d_", "")
            raise InputError(
                f"{where}: the file does not state the size of the images in pixels; it is read from {beside}, which "
                "is not there or does not state it"
            )
        cameras[f"camera {key}"] = _pix4d_camera(section, sizes[key], where)
    return cameras


def _sections(text: str) -> list[tuple[str, str]]:
    """Number and text of every camera of a file."""
    starts = list(_FILE.finditer(text))
    ends = [s.start() for s in starts[1:]] + [len(text)]
    if not starts:
        return [("0", text)]
    return [(start[2], text[start.start() : end]) for start, end in zip(starts, ends)]


def _image_sizes(path: Path) -> dict[str, tuple[int, int]]:
    sizes = {}
    for file in (path, path.with_name(path.name.replace("pix4d_", ""))):
        if file.is_file():
            for key, section in _sections(read_text(file, _CAMERA_BYTES)):
                found = _SIZE.search(section)
                if found:
                    sizes[key] = (int(found[1]), int(found[2]))
    return sizes


def _pix4d_camera(section: str, size: tuple[int, int], where: str) -> CameraEntry:
    v = dict.fromkeys(_KEYS, 0.0)
    for line in section.split("\n"):
        words = line.split()
        if len(words) == 2 and words[0] in v:
            try:
                v[words[0]] = finite(float(words[1]), f"{where}: {words[0]}")
            except ValueError:
                raise InputError(f"{where}: {words[0]}: {words[1]!r} given; a number is needed") from None
    sensor = _SENSOR.search(section)
    try:
        width, height = (float(sensor[1]), float(sensor[2])) if sensor else (0.0, 0.0)
    except ValueError:
        width = height = 0.0
    if not (width > 0 and height > 0):
        raise InputError(f"{where}: the size of the sensor in mm is not stated")
    per_mm = size[0] / width, size[1] / height
    focal = (v["F"] * per_mm[0], v["F"] * per_mm[1])
    if abs(focal[0] - focal[1]) < 1e-6 * abs(focal[0]):
        # The two sides of the sensor are rounded; pixels of these cameras are square.
        focal = (focal[0], focal[0])
    point = (v["Px"] * per_mm[0] - 0.5, v["Py"] * per_mm[1] - 0.5)
    k = (v["K1"], v["K2"], v["K3"], 0.0, 0.0, 0.0)
    return frame_camera(
        OpenCVForm(size=size, focal=focal, point=point, fisheye=False, k=k, p=(v["T1"], v["T2"])), where
    )


def _render_cameras(cameras: dict[str, CameraEntry], stem: Path, pixel_mm: float = 0.001) -> dict[Path, str]:
    """Text of the two camera files of a project; millimetres are made with pixels of `pixel_mm`.

    Raises
    ------
    InputError
        A camera has no form there.
    """
    own, sizes = [], []
    for k, (name, camera) in enumerate(cameras.items()):
        form = opencv_form(camera)
        if form is None or form.rational or form.fisheye or abs(form.focal[0] - form.focal[1]) > 1e-9 * form.focal[0]:
            raise InputError(
                f"{stem.parent}: camera {name!r} has no form in Pix4D; write without its lens, or another format"
            )
        side = [s * pixel_mm for s in form.size]
        x, y = ((p + 0.5) * pixel_mm for p in form.point)
        values = (form.focal[0] * pixel_mm, x, y, *form.k[:3], *form.p)
        v = dict(zip(_KEYS, map(repr, values)))
        own += [
            f"Pix4D camera calibration file {k}",
            f"#Focal Length mm assuming a sensor width of {side[0]!r}x{side[1]!r}mm",
            f"F {v['F']}",
            "#Principal Point mm",
            *(f"{n} {v[n]}" for n in ("Px", "Py")),
            "#Symmetrical Lens Distortion Coeffs",
            *(f"{n} {v[n]}" for n in ("K1", "K2", "K3")),
            "#Tangential Lens Distortion Coeffs",
            *(f"{n} {v[n]}" for n in ("T1", "T2")),
            "",
        ]
        sizes += [f"camera_calibration_file {k}", f"#Image size {form.size[0]}x{form.size[1]} pixel", ""]
    files = _camera_files(stem)
    return {files[0]: "\n".join(own), files[1]: "\n".join(sizes)}


_MAX_BYTES = 1 << 30
_EXTERNAL = re.compile(r"\s*#?\s*imageName\s+X\s+Y\s+Z\s+Omega\s+Phi\s+Kappa\b", re.I)
_FULL = re.compile(r"\s*fileName\s+imageWidth\s+imageHeight", re.I)
_NAMES = ("_calibrated_external_camera_parameters.txt", "_calibrated_camera_parameters.txt")


def read_pix4d(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images, with cameras and CRS where files of the project state them; `form` is not used."""
    lines = read_text(path, _MAX_BYTES).split("\n")
    if _FULL.match(lines[0]):
        return _read_full(lines, path)
    if not _EXTERNAL.match(lines[0]):
        raise InputError(
            f"{path}: begins neither with `imageName X Y Z Omega Phi Kappa` (calibrated_external_camera_parameters) "
            "nor with `fileName imageWidth imageHeight` (calibrated_camera_parameters)"
        )
    images = [_external(line, n, path) for n, line in enumerate(lines, 1) if n > 1 and line.strip()]
    cameras, of_image, notes = _cameras_beside(path, [i.name for i in images])
    images = [
        OrientedImage(name=i.name, center=i.center, angles=i.angles, camera=of_image.get(i.name), line=i.line)
        for i in images
    ]
    return _block(path, images, cameras, notes)


def _stem(path: Path) -> Path:
    """Path up to the project's name."""
    name = next((path.name.removesuffix(end) for end in _NAMES if path.name.endswith(end)), path.stem)
    return path.with_name(name)


def _block(
    path: Path, images: list[OrientedImage], cameras: dict[str, CameraEntry], notes: list[str]
) -> OrientationBlock:
    side = path.with_name(f"{_stem(path).name}_wkt.prj")
    side = side if side.is_file() else path.with_suffix(".prj")
    crs = heights = None
    if side.is_file():
        text = read_text(side, 100_000).strip()
        if is_local_crs(text, str(side)):
            notes.append(f"{side.name}: coordinates are in a local system")
        else:
            parse_crs(text, str(side))
            crs, heights = split_compound(text)
    table = OrientationTable(
        path,
        tuple(images),
        crs=crs,
        crs_file=side if crs is not None else None,
        height_system=heights,
        notes=tuple(notes),
    )
    return OrientationBlock(table, cameras)


def _external(line: str, n: int, path: Path) -> OrientedImage:
    where = f"{path}:{n}"
    # A name may hold spaces: the numbers are counted from the end.
    words = line.rsplit(maxsplit=6)
    X, Y, Z, *angles = numbers(words[1:], where, f"image {words[0]!r}: X, Y, Z, omega, phi, kappa", 6)
    return OrientedImage(
        name=words[0].strip(), center=(X, Y, Z), angles=(angles[0], angles[1], angles[2]), camera=None, line=n
    )


def _cameras_beside(path: Path, names: list[str]) -> tuple[dict[str, CameraEntry], dict[str, str | None], list[str]]:
    """Cameras by name, the camera of every image, and notes."""
    stem = _stem(path)
    full = stem.with_name(stem.name + _NAMES[1])
    if full.is_file():
        block = _read_full(read_text(full, _MAX_BYTES).split("\n"), full)
        of_image = {i.name: i.camera for i in block.table.images}
        if set(names) <= set(of_image):
            return dict(block.cameras), of_image, [f"{path.name}: cameras from {full.name}"]
    own = _camera_files(stem)[0]
    if own.is_file():
        cameras = read_pix4d_cameras(own)
        if len(cameras) == 1:
            return cameras, {}, [f"{path.name}: camera from {own.name}"]
    return {}, {}, []


def _read_full(lines: list[str], path: Path) -> OrientationBlock:
    """The blocks of ten lines of a ``calibrated_camera_parameters.txt``."""
    # Eight lines of description; blank lines are no part of the format.
    rows = [(n, line) for n, line in enumerate(lines, 1) if line.strip()]
    first = next((k for k, (_, line) in enumerate(rows) if line.strip().lower().startswith("camera model")), -1) + 1
    rows = rows[first:] if first else rows[7:]
    if not rows or len(rows) % 10:
        last = rows[-1][0] if rows else 1
        raise InputError(f"{path}:{last}: {len(rows)} lines follow the description; ten for each image are needed")
    offset, notes = _offset(path)
    cameras: dict[CameraEntry, str] = {}
    images = []
    for k in range(0, len(rows), 10):
        name, camera, t, R_camera_world = _ten_lines(rows[k : k + 10], path)
        label = cameras.setdefault(camera, f"camera {len(cameras)}")
        images.append(posed(name, t + offset, R_camera_world.T @ FLIP, label, rows[k][0]))
    return _block(path, images, {label: c for c, label in cameras.items()}, notes)


def _offset(path: Path) -> tuple[Floats, list[str]]:
    file = path.with_name(f"{_stem(path).name}_offset.xyz")
    if not file.is_file():
        return np.zeros(3), [f"{path.name}: positions are relative to {file.name}, which is not there"]
    return np.array(numbers(read_text(file, 10_000).split(), str(file), "offset", 3)), []


def _ten_lines(rows: list[tuple[int, str]], path: Path) -> tuple[str, CameraEntry, Floats, Floats]:
    """Name, camera, position and R_camera_world of an image."""
    where = f"{path}:{rows[0][0]}"
    words = rows[0][1].rsplit(maxsplit=2)
    width, height = (whole_number(word) for word in words[1:]) if len(words) == 3 else (None, None)
    if width is None or height is None:
        raise InputError(f"{where}: {rows[0][1][:80]!r}: file name, width and height are needed")
    lengths = (3, 3, 3, 3, 2, 3, 3, 3, 3)
    values = [numbers(row.split(), f"{path}:{n}", "line", count) for (n, row), count in zip(rows[1:], lengths)]
    K, radial, tangential, t = np.array(values[:3]), values[3], values[4], np.array(values[5])
    R = checked_rotation(values[6:], f"{path}:{rows[7][0]}: image {words[0]!r}", 1e-5)
    if K[0, 1] != 0 or K[1, 0] != 0:
        raise InputError(f"{path}:{rows[1][0]}: image {words[0]!r}: a sheared camera matrix is not supported")
    form = OpenCVForm(
        size=(width, height),
        focal=(float(K[0, 0]), float(K[1, 1])),
        point=(float(K[0, 2]) - 0.5, float(K[1, 2]) - 0.5),
        fisheye=False,
        k=(*radial, 0.0, 0.0, 0.0),
        p=(tangential[0], tangential[1]),
    )
    return words[0], frame_camera(form, f"{where}: image {words[0]!r}"), t, R


def _render_pix4d(block: OrientationBlock, path: Path) -> dict[Path, str]:
    stem = _stem(path)
    external = path if path.suffix else stem.with_name(stem.name + _NAMES[0])
    lines = ["imageName X Y Z Omega Phi Kappa"]
    for image, angles in zip(block.table.images, block.angles("opk", "deg").tolist()):
        lines.append(" ".join([image.name, *(repr(v) for v in (*image.center, *angles))]))
    texts = {external: "\n".join([*lines, ""])}
    if block.table.crs is not None:
        texts[stem.with_name(f"{stem.name}_wkt.prj")] = legacy_wkt(block.table.crs) + "\n"
    if block.cameras:
        texts |= _render_full(block, stem)
        if all(_square(camera) for camera in block.cameras.values()):
            texts |= _render_cameras(dict(block.cameras), stem)
    return texts


def _render_full(block: OrientationBlock, stem: Path) -> dict[Path, str]:
    offset = np.floor(block.table.centers.mean(axis=0))
    lines = ["fileName imageWidth imageHeight", "camera matrix K [3x3]", "radial distortion [3x1]"]
    lines += ["tangential distortion [2x1]", "camera position t [3x1]", "camera rotation R [3x3]"]
    lines += ["camera model m = K [R|-Rt] X", ""]
    for image, R in zip(block.table.images, block.table.rotations):
        form = opencv_form(block.camera(image))
        if form is None or form.rational or form.fisheye:
            name = block.camera_name(image)
            raise InputError(f"{stem}: camera {name!r} has no form in Pix4D; write without its lens, or another format")
        (fx, fy), (x, y) = form.focal, form.point
        matrix = (FLIP @ R.T).tolist()
        t = (np.array(image.center) - offset).tolist()
        numbers = [(fx, 0.0, x + 0.5), (0.0, fy, y + 0.5), (0.0, 0.0, 1.0), form.k[:3], form.p, t, *matrix]
        lines.append(f"{image.name} {form.size[0]} {form.size[1]}")
        lines += [" ".join(repr(float(v)) for v in row) for row in numbers]
    return {
        stem.with_name(stem.name + _NAMES[1]): "\n".join([*lines, ""]),
        stem.with_name(f"{stem.name}_offset.xyz"): " ".join(repr(v) for v in offset.tolist()) + "\n",
    }


def _square(camera: CameraEntry) -> bool:
    """Return whether pixels are square, as in Pix4D."""
    form = opencv_form(camera)
    return form is None or abs(form.focal[0] - form.focal[1]) <= 1e-9 * form.focal[0]


def _losses_pix4d(block: OrientationBlock) -> Iterable[Loss]:
    yield from opencv_losses(block, rational=False, fisheye=False)
    for name, camera in block.cameras.items():
        if not _square(camera):
            yield Loss("other", f"square pixels only, and those of camera {name!r} are not: no .cam file")
    if len(block.cameras) > 1:
        yield Loss("other", "no names of cameras: they are numbered by their first image")
    if block.table.height_system is not None:
        yield Loss("height_system", f"no height system ({block.table.height_system})")


def _sniff_pix4d(path: Path, head: str) -> bool:
    first = head.split("\n", 1)[0]
    return bool(_EXTERNAL.match(first) or _FULL.match(first))


PIX4D = OrientationFormat(
    name="pix4d",
    title="Pix4D calibrated camera parameters",
    sniff=_sniff_pix4d,
    read=read_pix4d,
    render=_render_pix4d,
    losses=_losses_pix4d,
)
