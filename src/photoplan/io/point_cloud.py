"""Points of a surface as LAS, LAZ or PLY: place, standard deviation of the height, grey value."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.windows
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.errors import UsageError
from photoplan.geometry.crs import parse_crs
from photoplan.geometry.frames import Frame
from photoplan.io.disk import disk_error
from photoplan.io.gdal import open_raster
from photoplan.io.store import give_name, scratch, standing

CLOUD_SUFFIXES = (".las", ".laz", ".ply")
#: What a point has: metres, standard deviation of z in metres, grey value.
_POINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("sigma", "<f4"), ("grey", "<f4")])
#: Rows of posts that are read at once; the unit of coordinates in LAS, part of the distance of the posts.
_ROWS, _UNIT = 256, 1e-3
#: Where day and year of making are in the header of LAS, two bytes each.
_LAS_DATE = 90


def check_cloud(path: Path) -> None:
    """Refuse a name that says no format, or a format whose library is missing."""
    kind = path.suffix.lower()
    if kind not in CLOUD_SUFFIXES:
        raise UsageError(f"{path}: {kind or 'no suffix'}; points are written by suffix: {', '.join(CLOUD_SUFFIXES)}")
    if kind != ".ply" and importlib.util.find_spec("laspy") is None:
        raise UsageError(
            f"{path}: LAS and LAZ need laspy; install it with `pip install 'photoplan[points]'`, or say .ply"
        )


def write_cloud(path: Path, heights: Path, sigmas: Path, grey: Path, crs: str, frame: Frame | None = None) -> int:
    """Write the posts of a surface that have a height."""
    write = _write_ply if path.suffix.lower() == ".ply" else _write_las
    try:
        with ExitStack() as opened:
            part = opened.enter_context(scratch(path.parent)) / path.name
            files = [opened.enter_context(open_raster(standing(file), "GTiff")) for file in (heights, sigmas, grey)]
            count = write(part, path, files, crs, frame)
            give_name(part, path)
    except OSError as error:
        raise disk_error(path, error) from error
    return count


def _points(files: Sequence[Any], frame: Frame | None) -> Iterator[NDArray[Any]]:
    """Points by rows of posts."""
    heights, sigmas, grey = files
    finer = grey.width // heights.width
    for row in range(0, heights.height, _ROWS):
        count = min(_ROWS, heights.height - row)
        window = rasterio.windows.Window(0, row, heights.width, count)
        z = heights.read(1, window=window)
        fine = rasterio.windows.Window(0, finer * row, grey.width, finer * count)
        means = grey.read(1, window=fine).reshape(count, finer, heights.width, finer).mean(axis=(1, 3))
        j, i = np.nonzero(np.isfinite(z))
        out = np.empty(len(i), _POINT)
        out["x"], out["y"] = heights.transform @ (i + 0.5, row + j + 0.5)
        out["z"], out["sigma"], out["grey"] = z[j, i], sigmas.read(1, window=window)[j, i], means[j, i]
        yield out if frame is None else _on_ground(out, frame)


def _on_ground(points: NDArray[Any], frame: Frame) -> NDArray[Any]:
    """Points of a frame on the ground, and standard deviations there; without those that it does not have."""
    uvh = np.stack([points[axis] for axis in "xyz"], axis=-1)
    out = points.copy()
    out["x"], out["y"], out["z"] = frame(uvh).T
    out["sigma"] *= np.linalg.norm(frame.jacobian(uvh)[..., 2], axis=-1)
    return np.asarray(out[np.isfinite(out["z"])])


def _write_ply(part: Path, path: Path, files: Sequence[Any], crs: str, frame: Frame | None) -> int:
    count = 0
    with part.open("wb") as file:
        # The count is known at the end: room is left for it.
        file.write(_ply_header(0, frame))
        for points in _points(files, frame):
            file.write(points.tobytes())
            count += len(points)
        file.seek(0)
        file.write(_ply_header(count, frame))
    return count


def _ply_header(count: int, frame: Frame | None) -> bytes:
    kinds = {"<f8": "double", "<f4": "float"}
    along = "Z" if frame is None else "the height over the target"
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment photoplan {__version__}; X east, Y north, Z up, sigma of {along}, metres; grey value",
        f"element vertex {count:012d}",
        *(f"property {kinds[_POINT[name].str]} {name}" for name in _POINT.names or ()),
        "end_header",
    ]
    return "\n".join([*lines, ""]).encode()


def _write_las(part: Path, path: Path, files: Sequence[Any], crs: str, frame: Frame | None) -> int:
    import laspy  # type: ignore[import-untyped]  # noqa: PLC0415  # an optional package

    left, bottom, *_ = files[0].bounds
    if frame is not None:
        left, bottom, _ = frame((left, bottom, 0.0)).tolist()
    unit = 10.0 ** np.floor(np.log10(_UNIT * files[0].res[0]) + 1e-9)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, unit), np.array([np.floor(left), np.floor(bottom), 0.0])
    header.generating_software = f"photoplan {__version__}"[:32]
    header.add_extra_dim(laspy.ExtraBytesParams("sigma", np.float32, "of the height, metres"))
    header.add_crs(parse_crs(crs))
    count = 0
    with laspy.open(part, mode="w", header=header, do_compress=path.suffix.lower() == ".laz") as file:
        for points in _points(files, frame):
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points["x"], points["y"], points["z"]
            record.intensity = np.clip(np.rint(points["grey"]), 0, 65535).astype(np.uint16)
            record["sigma"] = points["sigma"]
            record.return_number[:] = record.number_of_returns[:] = 1
            file.write_points(record)
            count += len(points)
    # Equal runs give equal files: laspy states the day of making, zeros that none is stated.
    with part.open("r+b") as written:
        written.seek(_LAS_DATE)
        written.write(bytes(4))
    return count
