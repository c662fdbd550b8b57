"""Images with rational polynomials: what a project states of them becomes a camera."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

from photoplan.cameras.rpc import RationalFunctions, RpcCamera
from photoplan.errors import InputError
from photoplan.geometry.geodetic import GeodeticGround
from photoplan.io.camera.rpc.file import read_rpc
from photoplan.io.project.model import Project
from photoplan.io.project.rpc import RpcImage
from photoplan.project.ground import Ground, stamp_of
from photoplan.project.image_size import check_size


def rpc_camera(project: Project, image: RpcImage, ground: Ground, size: tuple[int, int]) -> RpcCamera:
    """Camera of an image with rational polynomials, over the ground as it is worked in."""
    check_size(image.file, size, image.size, "the project states", "polynomials fit an image of full size only")
    file = project.resolve(image.geometry_file or image.file)
    _refuse_tile(image, file)
    functions = _read(file, stamp_of(file))
    if image.scale is not None:
        functions = functions.scaled(image.scale)
    fault = size_fault(functions, size, image.shift or (0.0, 0.0), file, stated=image.scale is not None)
    if fault is not None:
        raise InputError(f"{image.file}: {fault}")
    return RpcCamera(functions, GeodeticGround(project.crs, ground.working_system), size, image.correction)


def size_fault(
    functions: RationalFunctions, size: tuple[int, int], shift: tuple[float, float], file: Path, *, stated: bool
) -> str | None:
    """What is wrong if an image has another size than its polynomials, and what would fit; None: nothing is.

    An image with the shape of the one that they are made for, but not its size, was scaled; `stated`: the project
    states a scale. An image that lies mostly outside of that one is another image.
    """
    fit = functions.fit(size, shift)
    whole = f"{fit.whole[0]} × {fit.whole[1]}"
    has = f"{size[0]} × {size[1]} pixels, but the polynomials of {file.name} hold for {whole}"
    if fit.kind == "scaled" and not stated:
        change = "reduced" if fit.scale < 1 else "enlarged"
        return (
            f"{has}: give the image in full size. If it was {change}, set scale = {fit.scale:.4g} in its [[images]] "
            "entry; if it is the upper left part of the image, or the polynomials are those of this size, set scale = 1"
        )
    if fit.kind == "outside":
        return (
            f"{has}: much of the image lies outside. Give the polynomials of this image; if it was enlarged, set scale "
            "= FACTOR in its [[images]] entry; if it was cut out, set shift = [-COLUMN, -ROW]"
        )
    return None


def _refuse_tile(image: RpcImage, file: Path) -> None:
    """Refuse a tile of a delivery with the polynomials of the whole: they count from the first tile's corner."""
    tile = re.search(r"_R\d+C\d+(?![0-9A-Za-z])", Path(image.file).stem, re.IGNORECASE)
    if tile is None or tile[0].upper() == "_R1C1" or image.geometry_file is None or image.shift is not None:
        return
    if tile[0].upper() not in file.stem.upper():
        raise InputError(
            f"{image.file}: a tile of a product, and {file.name} counts from the corner of its first tile; join the "
            "tiles into one image, or state where this one begins: shift = [-COLUMN, -ROW]"
        )


@lru_cache(maxsize=256)
def _read(file: Path, stamp: tuple[int, int]) -> RationalFunctions:
    """Read again only when the file changes."""
    return read_rpc(file).functions
