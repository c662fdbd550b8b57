"""Cameras in the conventions of OpenCV and Agisoft (Brown, y down), and files of OpenCV and orthority.

Both forms describe the same pixels as photoplan's camera, or there is no such form and None comes back.

OpenCV writes the YAML and JSON of its `FileStorage`, ROS its ``camera_info`` YAML. ``camera_matrix`` is [[fx, 0, cx],
[0, fy, cy], [0, 0, 1]] with (0, 0) as the *centre* of the upper-left pixel, and ``distortion_coefficients`` are k1, k2,
p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tx, ty]]]], y down, as distortion (docs.opencv.org: Camera Calibration and
3D Reconstruction); the thin-prism and tilt terms must be zero. The fisheye module has four coefficients: the file then
says ``fisheye_model: 1`` or ``distortion_model: equidistant``. ``image_width``, ``image_height`` are the size. Names
are compared without regard to capitals.

The YAML of orthority's interior parameters, as its documentation (orthority.readthedocs.io, "Orthority interior
parameters") defines it:

- one entry per camera, its key is the camera's name;
- ``im_size`` = [width, height] in pixels;
- ``focal_len``, one number or [x, y], in the unit of ``sensor_size`` = [width, height]; without a ``sensor_size`` it is
  divided by the larger side of the sensor, and pixels are square;
- ``cx``, ``cy``: offset of the principal point from the image's middle, x right and **y down**, in OpenSfM's normalised
  coordinates: in units of the larger side of the image in pixels. The middle is ((w − 1)/2, (h − 1)/2), the centre of
  the upper-left pixel being (0, 0). So column = (w − 1)/2 + cx·max(w, h), row = (h − 1)/2 + cy·max(w, h);
- ``type``: ``pinhole``; ``brown`` (k1, k2, p1, p2, k3, **OpenCV's** meaning); ``opencv`` (up to 14 coefficients, the
  thin-prism and tilt terms are not supported here); ``fisheye`` (k1–k4, OpenCV's meaning).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.cameras.lenses import Brown, Fisheye, NoLens, OpenCV
from photoplan.errors import InputError
from photoplan.io.camera.model import CameraEntry, InPixels, frame_in_pixels
from photoplan.io.files import finite, parse_yaml, read_head, read_json, read_text, read_yaml, unique_stems
from photoplan.io.orientation.block import Loss, OrientationBlock, OrientationFormat, TableFormat
from photoplan.io.project.model import lens_of


@dataclass(frozen=True)
class OpenCVForm:
    """A camera as OpenCV knows it, y down."""

    size: tuple[int, int]
    focal: tuple[float, float]
    """fx, fy, pixels."""
    point: tuple[float, float]
    """Column and row of the principal point, (0, 0) the centre of the upper-left pixel."""
    fisheye: bool
    k: tuple[float, ...]
    """k1–k6 of the rational lens, or k1–k4 of the fisheye."""
    p: tuple[float, float] = (0.0, 0.0)

    @property
    def rational(self) -> bool:
        """Return whether the denominator k4–k6 is used."""
        return not self.fisheye and any(self.k[3:])


def opencv_form(camera: CameraEntry) -> OpenCVForm | None:
    """OpenCV's form of a camera; None for film, and for lenses that OpenCV does not have."""
    if camera.pixels is None:
        return None
    (fx, fy), lens = camera.pixels.focal, lens_of(camera)
    k: tuple[float, ...] = (0.0,) * 6
    p, fisheye = (0.0, 0.0), False
    if isinstance(lens, OpenCV):
        k, p = (lens.k1, lens.k2, lens.k3, lens.k4, lens.k5, lens.k6), (lens.p1, lens.p2)
    elif isinstance(lens, Fisheye):
        k, fisheye = (lens.k1, lens.k2, lens.k3, lens.k4), True
    elif isinstance(lens, Brown) and lens.b2 == 0 and lens.k4 == 0:
        # Brown's y points up. The affinity is a second focal length.
        k, p = (lens.k1, lens.k2, lens.k3, 0.0, 0.0, 0.0), (0.0 - lens.p2, lens.p1)
        fx *= 1.0 + lens.b1
    elif not isinstance(lens, NoLens):
        return None
    return OpenCVForm(size=camera.pixels.size, focal=(fx, fy), point=camera.pixels.point, fisheye=fisheye, k=k, p=p)


def opencv_losses(block: OrientationBlock, *, rational: bool = True, fisheye: bool = True) -> list[Loss]:
    """Return the properties of a block's cameras that a format with OpenCV's lenses cannot hold."""
    lost = []
    for name, camera in block.cameras.items():
        if camera.pixels is None:
            lost.append(Loss("camera", f"no camera {name!r}: film has no pixels of its own"))
            continue
        form = opencv_form(camera)
        if form is None:
            lost.append(Loss("lens", f"no lens of type {camera.lens.type} as camera {name!r} has it"))
        elif form.rational and not rational:
            lost.append(Loss("lens", f"no k4 to k6 (camera {name!r})"))
        elif form.fisheye and not fisheye:
            lost.append(Loss("lens", f"no fisheye lens (camera {name!r})"))
    return lost


@dataclass(frozen=True)
class AgisoftForm:
    """A camera as Agisoft's programs know it, y down; everything in pixels."""

    size: tuple[int, int]
    f: float
    offset: tuple[float, float]
    """cx, cy: principal point minus the middle of the image."""
    k: tuple[float, float, float, float]
    p: tuple[float, float]
    b: tuple[float, float]
    """b1, b2, pixels."""
    fisheye: bool = False


def agisoft_form(camera: CameraEntry) -> AgisoftForm | None:
    """Agisoft's form of a camera; None for film, and for lenses that it does not have."""
    if camera.pixels is None:
        return None
    (fx, fy), lens = camera.pixels.focal, lens_of(camera)
    k, p, b, fisheye = (0.0, 0.0, 0.0, 0.0), (0.0, 0.0), (0.0, 0.0), False
    if isinstance(lens, OpenCV) and not (lens.k4 or lens.k5 or lens.k6):
        k, p = (lens.k1, lens.k2, lens.k3, 0.0), (lens.p2, lens.p1)
    elif isinstance(lens, Fisheye):
        k, fisheye = (lens.k1, lens.k2, lens.k3, lens.k4), True
    elif isinstance(lens, Brown):
        k, p, b = (lens.k1, lens.k2, lens.k3, lens.k4), (lens.p1, 0.0 - lens.p2), (lens.b1, 0.0 - lens.b2)
    elif not isinstance(lens, NoLens):
        return None
    # x fx (1 + b1) = x (f + B1) with f = fy: square pixels of the height, and their affinity.
    in_pixels = fx * (1.0 + b[0]) - fy if b[0] or fx != fy else 0.0, fx * b[1]
    (col, row), size = camera.pixels.point, camera.pixels.size
    offset = col - (size[0] - 1) / 2, row - (size[1] - 1) / 2
    return AgisoftForm(size=size, f=fy, offset=offset, k=k, p=p, b=in_pixels, fisheye=fisheye)


def frame_camera(form: OpenCVForm | AgisoftForm, where: str) -> CameraEntry:
    """The description of a camera in one of the two forms; `where` begins messages."""
    if isinstance(form, OpenCVForm):
        (fx, fy), point = form.focal, form.point
        names = ("k1", "k2", "k3", "k4", "k5", "k6")
        lens: dict[str, Any] = {"type": "opencv_fisheye" if form.fisheye else "opencv", **dict(zip(names, form.k))}
        if not form.fisheye:
            lens |= {"p1": form.p[0], "p2": form.p[1]}
    else:
        point = (form.size[0] - 1) / 2 + form.offset[0], (form.size[1] - 1) / 2 + form.offset[1]
        lens, (fx, fy) = _agisoft_lens(form, where)
    if lens["type"] != "opencv_fisheye" and not any(v for key, v in lens.items() if key[0] in "kpb"):
        lens = {"type": "none"}
    return frame_in_pixels(InPixels(form.size, (fx, fy), point), lens, where)


def _agisoft_lens(form: AgisoftForm, where: str) -> tuple[dict[str, Any], tuple[float, float]]:
    k = {f"k{i + 1}": v for i, v in enumerate(form.k)}
    b1, b2 = form.b
    if form.fisheye:
        if form.p != (0.0, 0.0) or b2 != 0:
            raise InputError(
                f"{where}: a fisheye with p1, p2 or b2 is not supported; fix them to 0, align and export again"
            )
        return {"type": "opencv_fisheye", **k}, (form.f + b1, form.f)
    if form.f <= 0:
        raise InputError(f"{where}: f = {form.f}; a positive number of pixels is needed")
    p1, p2 = form.p
    lens = {"type": "brown", "y_axis": "down", **k, "p1": p1, "p2": p2, "b1": b1 / form.f, "b2": b2 / form.f}
    return lens, (form.f, form.f)


_MAX_BYTES = 1_000_000
_COUNTS = (0, 4, 5, 8, 12, 14)
_MATRIX = ("camera_matrix", "cameramatrix", "k", "intrinsic_matrix", "m")
_DISTORTION = ("distortion_coefficients", "dist_coeffs", "distcoeffs", "dist_coeff", "distortion", "d")
_WIDTH, _HEIGHT = ("image_width", "width", "imagewidth"), ("image_height", "height", "imageheight")


def is_opencv(path: Path) -> bool:
    """Return whether a YAML or JSON file is a calibration of this kind."""
    return re.search(r"camera_?matrix", read_head(path), re.I) is not None


def read_opencv(path: Path) -> dict[str, CameraEntry]:
    """Read the camera of a calibration file; it has the name that the file states, or the file's own."""
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
        return read_json(path, _MAX_BYTES)
    text = read_text(path, _MAX_BYTES)
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


def _losses_opencv(block: OrientationBlock) -> Iterable[Loss]:
    yield from opencv_losses(block)
    yield Loss("other", "no orientations: only the cameras")


def _sniff_opencv(path: Path, head: str) -> bool:
    known = path.suffix.lower() in (".yml", ".yaml", ".json")
    return known and re.search(r"camera_?matrix", head, re.I) is not None


FORMAT = OrientationFormat(
    name="opencv",
    title="OpenCV calibration",
    sniff=_sniff_opencv,
    read=_refuse,
    render=_render_block,
    losses=_losses_opencv,
    suffix=".yml",
)


_ORTHORITY = {
    "pinhole": (),
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty"),
}
_COMMON = ("type", "im_size", "focal_len", "sensor_size", "cx", "cy")
_UNSUPPORTED = ("s1", "s2", "s3", "s4", "tx", "ty")


def read_orthority(path: Path) -> dict[str, CameraEntry]:
    """Cameras of a YAML file by name."""
    contents = read_yaml(path)
    if not isinstance(contents, dict):
        raise InputError(f"{path}: no cameras; needed is `name:` with `type`, `im_size` and `focal_len` below it")
    if "type" in contents and "im_size" in contents:
        # A file with a single camera and no name level.
        contents = {path.stem: contents}
    return {str(name): _orthority_camera(values, f"{path}: camera {str(name)!r}") for name, values in contents.items()}


def _orthority_camera(values: Any, where: str) -> CameraEntry:
    if not isinstance(values, dict):
        raise InputError(f"{where}: {values!r} given; needed are `type`, `im_size` and `focal_len`")
    kind = values.get("type")
    if not isinstance(kind, str) or kind not in _ORTHORITY:
        raise InputError(f"{where}: type {kind!r}; allowed are {', '.join(_ORTHORITY)}")
    unknown = sorted(str(k) for k in values if k not in _COMMON and k not in _ORTHORITY[kind])
    if unknown:
        raise InputError(f"{where}: unknown {', '.join(unknown)}; type {kind} knows {', '.join(_ORTHORITY[kind])}")
    for key in ("im_size", "focal_len"):
        if values.get(key) is None:
            raise InputError(f"{where}: {key} is missing")
    size = finite(values["im_size"], f"{where}: im_size", 2)
    if any(s != int(s) for s in size):
        raise InputError(f"{where}: im_size {values['im_size']!r}; whole numbers of pixels are needed")
    w, h = int(size[0]), int(size[1])
    fx, fy = _orthority_focal(values, (w, h), where)
    cx, cy = (finite(values.get(k) or 0.0, f"{where}: {k}") for k in ("cx", "cy"))
    focal = (fx, fx) if abs(fx - fy) < 1e-9 * fx else (fx, fy)
    point = (w - 1) / 2 + cx * max(w, h), (h - 1) / 2 + cy * max(w, h)
    return frame_in_pixels(InPixels((w, h), focal, point), _orthority_lens(kind, values, where), where)


def _orthority_focal(values: dict[str, Any], size: tuple[int, int], where: str) -> tuple[float, float]:
    """Camera constant in pixels, in x and y."""
    given = values["focal_len"]
    pair = (
        finite(given, f"{where}: focal_len", 2)
        if isinstance(given, list)
        else (finite(given, f"{where}: focal_len"),) * 2
    )
    if values.get("sensor_size") is None:
        return pair[0] * max(size), pair[1] * max(size)
    sensor = finite(values["sensor_size"], f"{where}: sensor_size", 2)
    if min(sensor) <= 0:
        raise InputError(f"{where}: sensor_size {sensor}; positive numbers are needed")
    return pair[0] * size[0] / sensor[0], pair[1] * size[1] / sensor[1]


def _orthority_lens(kind: str, values: dict[str, Any], where: str) -> dict[str, Any]:
    given = {k: finite(values[k], f"{where}: {k}") for k in _ORTHORITY[kind] if values.get(k) is not None}
    for key in _UNSUPPORTED:
        if given.pop(key, 0.0) != 0:
            raise InputError(
                f"{where}: {key} = {values[key]}; thin-prism (s1–s4) and tilt (tx, ty) terms are not supported"
            )
    if kind == "fisheye":
        return {"type": "opencv_fisheye", **given}
    if not any(given.values()):
        return {"type": "none"}
    return {"type": "opencv", **given}
