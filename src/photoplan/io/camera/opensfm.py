"""Cameras from OpenSfM's ``reconstruction.json`` and OpenDroneMap's ``cameras.json``.

The models are those of OpenSfM's documentation (opensfm.org/docs/geometry.html): image coordinates are divided by
the larger side of the image, origin in its middle, x right and y down; the middle is ((w − 1)/2, (h − 1)/2) with the
centre of the upper-left pixel at (0, 0). Camera axes are x right, y down, z forwards, so distortion has OpenCV's
meaning: ``perspective`` has one focal length and k1, k2; ``simple_radial``, ``radial`` and ``brown`` add focal_x,
focal_y, c_x, c_y, (k3, p1, p2); ``fisheye`` is OpenCV's with k1, k2, ``fisheye_opencv`` with k1–k4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from photoplan.errors import InputError
from photoplan.io.camera.frame import frame_in_pixels
from photoplan.io.camera.model import CameraEntry, InPixels, UnusableCamera
from photoplan.io.files import finite, looks_like, read_json

_COEFFICIENTS = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2"),
    "fisheye_opencv": ("k1", "k2", "k3", "k4"),
}


def read(path: Path) -> dict[str, CameraEntry]:
    """Cameras of a JSON file by name; sizes are those that the file states."""
    contents = read_json(path)
    if isinstance(contents, dict) and contents and all(_is_camera(c) for c in contents.values()):
        return cameras_of([{"cameras": contents}], path)
    return cameras_of(contents, path)


def cameras_of(
    reconstructions: Any, path: Path, faults: dict[str, UnusableCamera] | None = None
) -> dict[str, CameraEntry]:
    """Cameras of the parsed contents of a ``reconstruction.json``.

    Those of a projection that has no form here are entered into `faults`; None: they are errors.
    """
    if not isinstance(reconstructions, list) or not all(
        isinstance(r, dict) and isinstance(r.get("cameras"), dict) for r in reconstructions
    ):
        raise InputError(
            f"{path}: neither a reconstruction.json of OpenSfM nor a cameras.json of OpenDroneMap{looks_like(path)}"
        )
    cameras: dict[str, CameraEntry] = {}
    for reconstruction in reconstructions:
        for name, values in reconstruction["cameras"].items():
            try:
                camera = _camera(values, f"{path}: camera {name!r}")
            except UnusableCamera as error:
                if faults is None:
                    raise
                faults[name] = error
                continue
            if cameras.setdefault(name, camera) != camera:
                raise InputError(f"{path}: camera {name!r} differs between the reconstructions; keep one of them")
    return cameras


def _is_camera(values: Any) -> bool:
    return isinstance(values, dict) and "projection_type" in values


def _camera(values: Any, where: str) -> CameraEntry:
    if not _is_camera(values):
        raise InputError(f"{where}: projection_type is missing")
    kind = values["projection_type"]
    if not isinstance(kind, str) or kind not in _COEFFICIENTS:
        raise UnusableCamera(
            f"{where}: projection_type {kind!r} is not supported; must be one of {', '.join(_COEFFICIENTS)}"
        )
    size = finite([values.get("width"), values.get("height")], f"{where}: width and height", 2)
    w, h = int(size[0]), int(size[1])
    side = max(w, h)
    focal_x = finite(values.get("focal_x", values.get("focal")), f"{where}: focal")
    focal_y = finite(values.get("focal_y", focal_x * _number(values, "aspect_ratio", where, 1.0)), f"{where}: focal_y")
    for key in ("p1", "p2", "k3", "k4", "k5", "k6", "s0", "s1", "s2", "s3"):
        if key not in _COEFFICIENTS[kind] and _number(values, key, where) != 0:
            raise InputError(f"{where}: {key} = {values[key]} is not supported for projection_type {kind!r}")
    lens: dict[str, Any] = {k: _number(values, k, where) for k in _COEFFICIENTS[kind]}
    point = (w - 1) / 2 + _number(values, "c_x", where) * side, (h - 1) / 2 + _number(values, "c_y", where) * side
    lens = {"type": "opencv_fisheye" if kind.startswith("fisheye") else "opencv", **lens}
    return frame_in_pixels(InPixels((w, h), (focal_x * side, focal_y * side), point), lens, where)


def _number(values: dict[str, Any], key: str, where: str, default: float = 0.0) -> float:
    number: float = finite(values.get(key, default), f"{where}: {key}")
    return number


def resized(camera: CameraEntry, size: tuple[int, int], where: str) -> CameraEntry:
    """The camera for images of another resolution, as normalised coordinates define it."""
    if size == camera.size or camera.pixels is None:
        return camera
    given = camera.pixels
    factor = max(size) / max(given.size)
    expected = tuple(s * factor for s in given.size)
    if max(abs(a - b) for a, b in zip(expected, size)) > max(1.0, factor):
        raise InputError(
            f"{where}: image of {size[0]} × {size[1]} px, camera of {given.size[0]} × {given.size[1]} px; "
            "another aspect ratio means another camera or crop"
        )
    (fx, fy), middle = given.focal, [(s - 1) / 2 for s in given.size]
    point = tuple((s - 1) / 2 + (p - m) * factor for s, p, m in zip(size, given.point, middle))
    focal = fx * factor if fx == fy else (fx * factor, fy * factor)
    return camera.model_copy(update={"size": size, "focal_px": focal, "principal_point_px": point})
