"""Pix4D's cameras: ``PROJECT_pix4d_calibrated_internal_camera_parameters.cam``.

As Pix4D's knowledge base ("How are the Internal and External Camera Parameters defined?") and its open format (OPF
specification: calibrated cameras, CC BY 4.0) define them: focal length and principal point in one unit, the origin at
the *corner* of the upper-left pixel, y down; R1–R3 and T1, T2 as in OpenCV (k1, k2, k3 and p1, p2). In this file the
unit is the millimetre of a sensor whose size is stated, but not its pixels: these are read from the file
``PROJECT_calibrated_internal_camera_parameters.cam`` beside it.

That second file holds the same camera in Inpho's manner, for undistorted images or with a table of corrections; it is
not read by itself.
"""

from __future__ import annotations

import re
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.camera.model import CameraEntry
from photoplan.io.files import finite, read_text
from photoplan.io.lens_forms import OpenCVForm, frame_camera, opencv_form

MAX_BYTES = 1 << 20
_KEYS = ("F", "Px", "Py", "K1", "K2", "K3", "T1", "T2")
_SENSOR = re.compile(r"sensor width of\s*([\d.eE+-]+)\s*x\s*([\d.eE+-]+)\s*mm", re.I)
_SIZE = re.compile(r"#\s*Image size\s+(\d+)\s*x\s*(\d+)\s*pixel", re.I)
_FILE = re.compile(r"(Pix4D camera calibration file|camera_calibration_file)\s*(\d+)", re.I)
_SUFFIX = "pix4d_calibrated_internal_camera_parameters.cam"


def camera_files(stem: Path) -> tuple[Path, Path]:
    """Pix4D's and Inpho's file of the cameras of a project; `stem` is a path up to the project's name."""
    return stem.with_name(f"{stem.name}_{_SUFFIX}"), stem.with_name(f"{stem.name}_{_SUFFIX.removeprefix('pix4d_')}")


def read(path: Path) -> dict[str, CameraEntry]:
    """Cameras of a ``.cam`` file: ``camera 0``, ``camera 1`` … as the file numbers them."""
    text = read_text(path, MAX_BYTES)
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
            for number, section in _sections(read_text(file, MAX_BYTES)):
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


def render(cameras: dict[str, CameraEntry], stem: Path, pixel_mm: float = 0.001) -> dict[Path, str]:
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
    files = camera_files(stem)
    return {files[0]: "\n".join(own), files[1]: "\n".join(sizes)}
