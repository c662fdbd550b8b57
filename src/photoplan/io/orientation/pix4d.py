"""Pix4D's exterior and interior orientations (folder ``1_initial/params`` of a project).

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
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import parse_crs, split_compound
from photoplan.geometry.local import is_local_crs, legacy_wkt
from photoplan.geometry.pose import FLIP
from photoplan.io.camera.model import CameraEntry
from photoplan.io.camera.opencv import OpenCVForm, frame_camera, opencv_form, opencv_losses
from photoplan.io.files import finite, read_text, whole_number
from photoplan.io.orientation.block import (
    Loss,
    OrientationBlock,
    OrientationFormat,
    OrientationTable,
    OrientedImage,
    posed,
)
from photoplan.io.orientation.form import TableFormat
from photoplan.io.orientation.text import checked_rotation, numbers

_CAMERA_BYTES = 1 << 20
_KEYS = ("F", "Px", "Py", "K1", "K2", "K3", "T1", "T2")
_SENSOR = re.compile(r"sensor width of\s*([\d.eE+-]+)\s*x\s*([\d.eE+-]+)\s*mm", re.I)
_SIZE = re.compile(r"#\s*Image size\s+(\d+)\s*x\s*(\d+)\s*pixel", re.I)
_FILE = re.compile(r"(Pix4D camera calibration file|camera_calibration_file)\s*(\d+)", re.I)
_SUFFIX = "pix4d_calibrated_internal_camera_parameters.cam"


def _camera_files(stem: Path) -> tuple[Path, Path]:
    """Pix4D's and Inpho's file of the cameras of a project; `stem` is a path up to the project's name."""
    return stem.with_name(f"{stem.name}_{_SUFFIX}"), stem.with_name(f"{stem.name}_{_SUFFIX.removeprefix('pix4d_')}")


def read_cameras(path: Path) -> dict[str, CameraEntry]:
    """Cameras of a ``.cam`` file: ``camera 0``, ``camera 1`` … as the file numbers them."""
    text = read_text(path, _CAMERA_BYTES)
    if not re.search(r"^\s*F\s", text, re.M):
        raise InputError(
            f"{path}: not Pix4D's own camera file (no line `F`); give PROJECT_{_SUFFIX}, or for all images at once "
            "PROJECT_calibrated_camera_parameters.txt"
        )
    sizes = _image_sizes(path)
    cameras: dict[str, CameraEntry] = {}
    for number, section in _sections(text):
        where = f"{path}: camera {number}"
        if number not in sizes:
            beside = path.name.replace("pix4d_", "")
            raise InputError(
                f"{where}: the file does not state the size of the images in pixels; it is read from {beside}, which "
                "is not there or does not state it"
            )
        cameras[f"camera {number}"] = _camera(section, sizes[number], where)
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
            for number, section in _sections(read_text(file, _CAMERA_BYTES)):
                found = _SIZE.search(section)
                if found:
                    sizes[number] = (int(found[1]), int(found[2]))
    return sizes


def _camera(section: str, size: tuple[int, int], where: str) -> CameraEntry:
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
    for number, (name, camera) in enumerate(cameras.items()):
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
            f"Pix4D camera calibration file {number}",
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
        sizes += [f"camera_calibration_file {number}", f"#Image size {form.size[0]}x{form.size[1]} pixel", ""]
    files = _camera_files(stem)
    return {files[0]: "\n".join(own), files[1]: "\n".join(sizes)}


_MAX_BYTES = 1 << 30
_EXTERNAL = re.compile(r"\s*#?\s*imageName\s+X\s+Y\s+Z\s+Omega\s+Phi\s+Kappa\b", re.I)
_FULL = re.compile(r"\s*fileName\s+imageWidth\s+imageHeight", re.I)
_NAMES = ("_calibrated_external_camera_parameters.txt", "_calibrated_camera_parameters.txt")


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images, with cameras and CRS where files of the project state them; `form` is not used."""
    lines = read_text(path, _MAX_BYTES).split("\n")
    if _FULL.match(lines[0]):
        return _read_full(lines, path)
    if not _EXTERNAL.match(lines[0]):
        raise InputError(
            f"{path}: begins neither with `imageName X Y Z Omega Phi Kappa` (calibrated_external_camera_parameters) "
            "nor with `fileName imageWidth imageHeight` (calibrated_camera_parameters)"
        )
    images = [_external(line, number, path) for number, line in enumerate(lines, 1) if number > 1 and line.strip()]
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


def _external(line: str, number: int, path: Path) -> OrientedImage:
    where = f"{path}:{number}"
    # A name may hold spaces: the numbers are counted from the end.
    words = line.rsplit(maxsplit=6)
    X, Y, Z, *angles = numbers(words[1:], where, f"image {words[0]!r}: X, Y, Z, omega, phi, kappa", 6)
    return OrientedImage(
        name=words[0].strip(), center=(X, Y, Z), angles=(angles[0], angles[1], angles[2]), camera=None, line=number
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
        cameras = read_cameras(own)
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


def _offset(path: Path) -> tuple[NDArray[np.float64], list[str]]:
    file = path.with_name(f"{_stem(path).name}_offset.xyz")
    if not file.is_file():
        return np.zeros(3), [f"{path.name}: positions are relative to {file.name}, which is not there"]
    return np.array(numbers(read_text(file, 10_000).split(), str(file), "offset", 3)), []


def _ten_lines(
    rows: list[tuple[int, str]], path: Path
) -> tuple[str, CameraEntry, NDArray[np.float64], NDArray[np.float64]]:
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


def _render(block: OrientationBlock, path: Path) -> dict[Path, str]:
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


def _losses(block: OrientationBlock) -> Iterable[Loss]:
    yield from opencv_losses(block, rational=False, fisheye=False)
    for name, camera in block.cameras.items():
        if not _square(camera):
            yield Loss("other", f"square pixels only, and those of camera {name!r} are not: no .cam file")
    if len(block.cameras) > 1:
        yield Loss("other", "no names of cameras: they are numbered by their first image")
    if block.table.height_system is not None:
        yield Loss("height_system", f"no height system ({block.table.height_system})")


def _sniff(path: Path, head: str) -> bool:
    first = head.split("\n", 1)[0]
    return bool(_EXTERNAL.match(first) or _FULL.match(first))


FORMAT = OrientationFormat(
    name="pix4d", title="Pix4D calibrated camera parameters", sniff=_sniff, read=read, render=_render, losses=_losses
)
