"""Cameras calibrated with OpenCV: the YAML and JSON of its `FileStorage`, and ROS's ``camera_info`` YAML.

``camera_matrix`` is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with (0, 0) as the *centre* of the upper-left pixel, and
``distortion_coefficients`` are k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tx, ty]]]], y down, as distortion
(docs.opencv.org: Camera Calibration and 3D Reconstruction); the thin-prism and tilt terms must be zero. The fisheye
module has four coefficients: the file then says ``fisheye_model: 1`` or ``distortion_model: equidistant``.
``image_width``, ``image_height`` are the size. Names are compared without regard to capitals.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from photoplan.errors import InputError
from photoplan.io.camera.model import CameraEntry
from photoplan.io.files import finite, parse_yaml, read_head, read_json, read_text, unique_stems
from photoplan.io.lens_forms import OpenCVForm, frame_camera, opencv_form, opencv_losses
from photoplan.io.orientation.block import Loss, OrientationBlock, OrientationFormat
from photoplan.io.orientation.form import TableFormat

MAX_BYTES = 1_000_000
_COUNTS = (0, 4, 5, 8, 12, 14)
_MATRIX = ("camera_matrix", "cameramatrix", "k", "intrinsic_matrix", "m")
_DISTORTION = ("distortion_coefficients", "dist_coeffs", "distcoeffs", "dist_coeff", "distortion", "d")
_WIDTH, _HEIGHT = ("image_width", "width", "imagewidth"), ("image_height", "height", "imageheight")


def is_opencv(path: Path) -> bool:
    """Whether a YAML or JSON file is a calibration of this kind."""
    return re.search(r"camera_?matrix", read_head(path), re.I) is not None


def read(path: Path) -> dict[str, CameraEntry]:
    """The camera of a calibration file; it has the name that the file states, or the file's own."""
    contents = _contents(path)
    if not isinstance(contents, dict):
        raise InputError(f"{path}: no calibration of OpenCV; needed are camera_matrix and distortion_coefficients")
    values = {str(k).lower(): v for k, v in contents.items()}
    name = str(values.get("camera_name") or path.stem)
    where = f"{path}: camera {name!r}"
    K = _numbers(_first(values, _MATRIX), f"{where}: camera_matrix")
    if len(K) != 9 or K[8] == 0:
        raise InputError(f"{where}: camera_matrix holds {len(K)} numbers; 3 × 3 are needed")
    if abs(K[1]) > 1e-9 * abs(K[0]) or any(K[i] != 0 for i in (3, 6, 7)):
        raise InputError(f"{where}: camera_matrix has a shear or other entries that OpenCV does not set: {list(K)}")
    size = [finite(_first(values, keys), f"{where}: {keys[0]}") for keys in (_WIDTH, _HEIGHT)]
    if any(s != int(s) for s in size):
        raise InputError(f"{where}: size {size}; whole numbers of pixels are needed")
    given = _first(values, _DISTORTION)
    d = () if given is None else _numbers(given, f"{where}: distortion_coefficients")
    fisheye = _is_fisheye(values, where)
    k, p = _coefficients(d, fisheye, where)
    focal, point = (K[0] / K[8], K[4] / K[8]), (K[2] / K[8], K[5] / K[8])
    return {
        name: frame_camera(
            OpenCVForm(size=(int(size[0]), int(size[1])), focal=focal, point=point, fisheye=fisheye, k=k, p=p), where
        )
    }


def _contents(path: Path) -> Any:
    if path.suffix.lower() == ".json":
        return read_json(path, MAX_BYTES)
    text = read_text(path, MAX_BYTES)
    # OpenCV's own first line is not YAML's, and its matrices have a tag of their own; lines keep their numbers.
    text = re.sub(r"\A%YAML:1\.0[^\n]*\n(---[^\n]*)?", "\n", text)
    return parse_yaml(re.sub(r"!!opencv-(nd-)?matrix", "", text), path)


def _first(values: dict[str, Any], keys: tuple[str, ...]) -> Any:
    return next((values[k] for k in keys if k in values), None)


def _numbers(matrix: Any, where: str) -> tuple[float, ...]:
    """All numbers of a matrix: {rows, cols, data}, a list, or a list of rows."""
    if isinstance(matrix, dict):
        data = matrix.get("data")
        rows, cols = matrix.get("rows"), matrix.get("cols")
        if isinstance(data, list) and isinstance(rows, int) and isinstance(cols, int) and rows * cols != len(data):
            raise InputError(f"{where}: {len(data)} numbers for {rows} rows and {cols} columns")
        matrix = data
    if not isinstance(matrix, list):
        raise InputError(f"{where}: {str(matrix)[:80]!r} given; a matrix is needed")
    flat = [v for row in matrix for v in (row if isinstance(row, list) else [row])]
    checked: tuple[float, ...] = finite(flat, where, len(flat))
    return checked


def _is_fisheye(values: dict[str, Any], where: str) -> bool:
    model = str(values.get("distortion_model", "plumb_bob")).lower()
    if model not in ("plumb_bob", "rational_polynomial", "equidistant", "fisheye", "opencv", ""):
        raise InputError(
            f"{where}: distortion_model {model!r}; allowed are plumb_bob, rational_polynomial, equidistant"
        )
    return model in ("equidistant", "fisheye") or bool(values.get("fisheye_model"))


def _coefficients(d: tuple[float, ...], fisheye: bool, where: str) -> tuple[tuple[float, ...], tuple[float, float]]:
    """Radial and tangential coefficients in the form's order."""
    if fisheye:
        if len(d) != 4:
            raise InputError(f"{where}: {len(d)} distortion coefficients; a fisheye has 4")
        return d, (0.0, 0.0)
    if len(d) not in _COUNTS:
        raise InputError(f"{where}: {len(d)} distortion coefficients; allowed are {', '.join(map(str, _COUNTS[1:]))}")
    if any(d[8:]):
        raise InputError(f"{where}: thin-prism (s1–s4) and tilt (tx, ty) terms are not supported: {list(d[8:])}")
    k1, k2, p1, p2, k3, k4, k5, k6 = (*d, *(0.0,) * 8)[:8]
    return (k1, k2, k3, k4, k5, k6), (p1, p2)


def render(camera: CameraEntry, path: Path, name: str) -> dict[Path, str]:
    """Text of a calibration file: JSON if the path says so, else YAML, both as OpenCV's `FileStorage` reads them.

    Raises
    ------
    InputError
        The camera has no form in OpenCV.
    """
    form = opencv_form(camera)
    if form is None:
        raise InputError(f"{path}: camera {name!r} has no form in OpenCV; write without its lens, or another format")
    k, p = form.k, form.p
    d = list(k) if form.fisheye else [k[0], k[1], *p, k[2], *(k[3:] if form.rational else ())]
    (fx, fy), (cx, cy) = form.focal, form.point
    K = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    head = {"camera_name": name, "image_width": form.size[0], "image_height": form.size[1]}
    head |= {"fisheye_model": 1} if form.fisheye else {}
    matrices = {"camera_matrix": (3, 3, K), "distortion_coefficients": (len(d), 1, d)}
    if path.suffix.lower() == ".json":
        typed = {
            n: {"type_id": "opencv-matrix", "rows": r, "cols": c, "dt": "d", "data": v}
            for n, (r, c, v) in matrices.items()
        }
        return {path: json.dumps(head | typed, indent=4) + "\n"}
    lines = ["%YAML:1.0", "---", f"camera_name: {json.dumps(name)}"]
    lines += [f"{key}: {value}" for key, value in head.items() if key != "camera_name"]
    for key, (rows, cols, data) in matrices.items():
        numbers = ", ".join(_yaml_number(v) for v in data)
        lines += [
            f"{key}: !!opencv-matrix",
            f"   rows: {rows}",
            f"   cols: {cols}",
            "   dt: d",
            f"   data: [ {numbers} ]",
        ]
    return {path: "\n".join([*lines, ""])}


def _yaml_number(value: float) -> str:
    # 1e-05 is text in YAML 1.1, 1.0e-05 is a number.
    text = repr(value)
    return text if "." in text or "e" not in text else text.replace("e", ".0e")


def _refuse(path: Path, form: TableFormat) -> OrientationBlock:
    raise InputError(f"{path}: a calibration of OpenCV describes a camera and no orientation; give it with `camera`")


def _render_block(block: OrientationBlock, path: Path) -> dict[Path, str]:
    if not block.cameras:
        raise InputError(f"{path}: no camera is given; name the file that describes it")
    stems = unique_stems(block.cameras)
    texts: dict[Path, str] = {}
    for name, camera in block.cameras.items():
        file = path if len(stems) == 1 else path.with_name(f"{path.stem}_{stems[name]}{path.suffix}")
        texts |= render(camera, file, name)
    return texts


def _losses(block: OrientationBlock) -> Iterable[Loss]:
    yield from opencv_losses(block)
    yield Loss("other", "no orientations: only the cameras")


def _sniff(path: Path, head: str) -> bool:
    known = path.suffix.lower() in (".yml", ".yaml", ".json")
    return known and re.search(r"camera_?matrix", head, re.I) is not None


FORMAT = OrientationFormat(
    name="opencv",
    title="OpenCV calibration",
    sniff=_sniff,
    read=_refuse,
    render=_render_block,
    losses=_losses,
    suffix=".yml",
)
