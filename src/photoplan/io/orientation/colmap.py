"""COLMAP's text model: ``cameras.txt``, ``images.txt`` and ``points3D.txt`` of one folder.

As its documentation defines it (colmap.github.io: Output Format, Camera Models, Database Format): an image's pose is a
unit quaternion (w, x, y, z; Hamilton) and a translation that take world coordinates to camera coordinates, the axes
being x right, y down, z forwards, so the projection centre is −Rᵀ t. Lenses are OpenCV's. The corner of the upper-left
pixel is (0, 0), its centre (0.5, 0.5). The world has no CRS.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from photoplan.errors import InputError
from photoplan.io.camera.model import CameraEntry
from photoplan.io.lens_forms import OpenCVForm, frame_camera, opencv_form, opencv_losses
from photoplan.io.orientation.block import Loss, OrientationBlock, OrientationFormat, require_cameras
from photoplan.io.orientation.table import FLIP, OrientationTable, OrientedImage, TableFormat, posed
from photoplan.io.orientation.text import numbers
from photoplan.io.plain_files import read_text

MAX_BYTES = 2 << 30
#: Parameters of every model: one or two focal lengths f, principal point c, coefficients of the lens.
_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images and cameras of a model; `form` is not used.

    Parameters
    ----------
    path : Path
        The folder, or one of its files.

    Raises
    ------
    InputError
        A file is missing or a line is not of the format; the message names it.
    """
    folder = _folder(path)
    cameras = read_cameras(folder / "cameras.txt")
    images = tuple(_images(folder / "images.txt"))
    note = "a COLMAP model states no CRS; unless it was georeferenced, position, scale and axes are its own"
    table = OrientationTable(folder / "images.txt", images, notes=(note,))
    used = {i.camera for i in images}
    return OrientationBlock(table, {name: c for name, c in cameras.items() if name in used})


def _folder(path: Path) -> Path:
    folder = path if path.is_dir() else path.parent
    missing = [n for n in ("cameras.txt", "images.txt") if not (folder / n).is_file()]
    if missing:
        binary = (folder / "images.bin").is_file()
        hint = "; convert the model to text: colmap model_converter --output_type TXT" if binary else ""
        raise InputError(f"{folder}: holds no {' and no '.join(missing)}, so it is no COLMAP model as text{hint}")
    return folder


def read_cameras(path: Path) -> dict[str, CameraEntry]:
    """Cameras of a ``cameras.txt`` by their number, as text.

    Raises
    ------
    InputError
        A line is not of the format, or the model is not supported.
    """
    cameras: dict[str, CameraEntry] = {}
    for number, line in _lines(path):
        words = line.split()
        where = f"{path}:{number}"
        if len(words) < 5 or words[1] not in _MODELS:
            given = words[1] if len(words) > 1 else line[:50]
            raise InputError(f"{where}: camera model {given!r} is not supported; allowed are {', '.join(_MODELS)}")
        if words[0] in cameras:
            raise InputError(f"{where}: camera {words[0]} is given twice")
        cameras[words[0]] = _camera(words[1], words[2:], where)
    return cameras


def _camera(model: str, words: list[str], where: str) -> CameraEntry:
    width, height, *values = numbers(words, where, f"camera model {model}", 2 + len(_MODELS[model]))
    v = dict(zip(_MODELS[model], values))
    focal = (v.get("fx", v.get("f", 0.0)), v.get("fy", v.get("f", 0.0)))
    fisheye = model.endswith("FISHEYE")
    k = tuple(v.get(f"k{i + 1}", 0.0) for i in range(4 if fisheye else 6))
    p = (v.get("p1", 0.0), v.get("p2", 0.0))
    form = OpenCVForm(
        size=(int(width), int(height)), focal=focal, point=(v["cx"] - 0.5, v["cy"] - 0.5), fisheye=fisheye, k=k, p=p
    )
    return frame_camera(form, where)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(read_text(path, MAX_BYTES).split("\n"), 1):
        if line.strip() and not line.startswith("#"):
            yield number, line


def _images(path: Path) -> Iterator[OrientedImage]:
    """Every image; the line of its points, which may be empty, is passed over."""
    lines = enumerate(read_text(path, MAX_BYTES).split("\n"), 1)
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        where = f"{path}:{number}"
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise InputError(
                f"{where}: {len(words)} columns; IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID and NAME are needed "
                "(a line with points follows every image, even if it is empty)"
            )
        values = numbers(words[1:8], where, f"image {words[9]!r}: pose", 7)
        q, t = np.array(values[:4]), np.array(values[4:])
        if not 0.99 < np.linalg.norm(q) < 1.01:
            raise InputError(
                f"{where}: image {words[9]!r}: the quaternion has the length {np.linalg.norm(q):.3g}, not 1"
            )
        R_camera_world = Rotation.from_quat(np.roll(q, -1)).as_matrix()
        yield posed(words[9].strip(), -R_camera_world.T @ t, R_camera_world.T @ FLIP, words[8], number)
        next(lines, None)


def _render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    require_cameras(block, path, "a COLMAP model")
    cameras = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    numbers = {name: str(k + 1) for k, name in enumerate(block.cameras)}
    for name, camera in block.cameras.items():
        cameras.append(f"{numbers[name]} {_camera_line(name, camera, path)}")
    images = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for k, (image, R) in enumerate(zip(block.table.images, block.table.rotations), 1):
        R_camera_world: NDArray[np.float64] = FLIP @ R.T
        q = np.roll(Rotation.from_matrix(R_camera_world).as_quat(), 1)
        t = -R_camera_world @ np.array(image.center)
        values = " ".join(repr(v) for v in (*q.tolist(), *t.tolist()))
        images += [f"{k} {values} {numbers[block.camera_name(image)]} {image.name}", ""]
    points = ["# 3D point list with one line of data per point:"]
    points.append("#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)")
    texts = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    return {path / name: "\n".join([*lines, ""]) for name, lines in texts.items()}


def _camera_line(name: str, camera: CameraEntry, path: Path) -> str:
    form = opencv_form(camera)
    if form is None:
        raise InputError(f"{path}: camera {name!r} has no form in COLMAP; write without its lens, or another format")
    model = "OPENCV_FISHEYE" if form.fisheye else "FULL_OPENCV" if any(form.k[2:]) else "OPENCV"
    if not (form.fisheye or any(form.k) or any(form.p)):
        model = "PINHOLE"
    v = dict(zip(("fx", "fy"), form.focal)) | dict(zip(("cx", "cy"), (c + 0.5 for c in form.point)))
    v |= {f"k{i + 1}": value for i, value in enumerate(form.k)} | {"p1": form.p[0], "p2": form.p[1]}
    values = " ".join(repr(v[n]) for n in _MODELS[model])
    return f"{model} {form.size[0]} {form.size[1]} {values}"


def _losses(block: OrientationBlock) -> Iterable[Loss]:
    yield from opencv_losses(block)
    if block.table.crs is not None or block.table.origin is not None:
        yield Loss("crs", "no coordinate system: state it to whoever reads the model")
    if block.table.height_system is not None:
        yield Loss("height_system", f"no height system ({block.table.height_system})")
    if block.cameras:
        yield Loss("other", "no names of cameras: they are numbered")


def _sniff(path: Path, head: str) -> bool:
    if path.is_dir():
        return (path / "images.txt").is_file() and (path / "cameras.txt").is_file()
    return "IMAGE_ID, QW, QX, QY, QZ" in head or "CAMERA_ID, MODEL, WIDTH, HEIGHT" in head


FORMAT = OrientationFormat(
    name="colmap", title="COLMAP model as text", sniff=_sniff, read=read, render=_render, losses=_losses, suffix=""
)
