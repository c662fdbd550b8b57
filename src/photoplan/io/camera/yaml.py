"""Cameras from YAML in the layout of orthority's interior parameter files.

The layout, as its documentation (orthority.readthedocs.io, "Orthority interior parameters") defines it:

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

from pathlib import Path
from typing import Any

from photoplan.errors import InputError
from photoplan.io.camera.frame import frame_in_pixels
from photoplan.io.camera.model import CameraEntry, InPixels
from photoplan.io.files import finite, read_yaml

_COEFFICIENTS = {
    "pinhole": (),
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty"),
}
_COMMON = ("type", "im_size", "focal_len", "sensor_size", "cx", "cy")
_UNSUPPORTED = ("s1", "s2", "s3", "s4", "tx", "ty")


def read(path: Path) -> dict[str, CameraEntry]:
    """Cameras of a YAML file by name."""
    contents = read_yaml(path)
    if not isinstance(contents, dict):
        raise InputError(f"{path}: no cameras; needed is `name:` with `type`, `im_size` and `focal_len` below it")
    if "type" in contents and "im_size" in contents:
        # A file with a single camera and no name level.
        contents = {path.stem: contents}
    return {str(name): _camera(values, f"{path}: camera {str(name)!r}") for name, values in contents.items()}


def _camera(values: Any, where: str) -> CameraEntry:
    if not isinstance(values, dict):
        raise InputError(f"{where}: {values!r} given; needed are `type`, `im_size` and `focal_len`")
    kind = values.get("type")
    if not isinstance(kind, str) or kind not in _COEFFICIENTS:
        raise InputError(f"{where}: type {kind!r}; allowed are {', '.join(_COEFFICIENTS)}")
    unknown = sorted(str(k) for k in values if k not in _COMMON and k not in _COEFFICIENTS[kind])
    if unknown:
        raise InputError(f"{where}: unknown {', '.join(unknown)}; type {kind} knows {', '.join(_COEFFICIENTS[kind])}")
    for key in ("im_size", "focal_len"):
        if values.get(key) is None:
            raise InputError(f"{where}: {key} is missing")
    size = finite(values["im_size"], f"{where}: im_size", 2)
    if any(s != int(s) for s in size):
        raise InputError(f"{where}: im_size {values['im_size']!r}; whole numbers of pixels are needed")
    w, h = int(size[0]), int(size[1])
    fx, fy = _focal(values, (w, h), where)
    cx, cy = (finite(values.get(k) or 0.0, f"{where}: {k}") for k in ("cx", "cy"))
    focal = (fx, fx) if abs(fx - fy) < 1e-9 * fx else (fx, fy)
    point = (w - 1) / 2 + cx * max(w, h), (h - 1) / 2 + cy * max(w, h)
    return frame_in_pixels(InPixels((w, h), focal, point), _lens(kind, values, where), where)


def _focal(values: dict[str, Any], size: tuple[int, int], where: str) -> tuple[float, float]:
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


def _lens(kind: str, values: dict[str, Any], where: str) -> dict[str, Any]:
    given = {k: finite(values[k], f"{where}: {k}") for k in _COEFFICIENTS[kind] if values.get(k) is not None}
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
