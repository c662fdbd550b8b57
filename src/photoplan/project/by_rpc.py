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
    """Camera of an image with rational polynomials, over the ground as it is worked in.

    Raises
    ------
    InputError
        The polynomials cannot be read, or the image has another size than is stated.
    HeightSystemError
        The grid that leads from the ground's heights to the ellipsoid is missing.
    """
    check_size(image.file, size, image.size, "the project states", "polynomials fit an image of full size only")
    file = project.resolve(image.geometry_file or image.file)
    _refuse_tile(image, file)
    functions = _read(file, stamp_of(file))
    return RpcCamera(functions, GeodeticGround(project.crs, ground.working_system), size, image.correction)


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
