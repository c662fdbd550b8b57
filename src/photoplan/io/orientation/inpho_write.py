"""Project files of Trimble Inpho, written; conventions as in `photoplan.io.orientation.inpho`.

Each image also gets its ω, φ, κ as ``$INS``, so that the file tells by itself what its rotation matrices do. Without
other wish they are written ground to camera.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from photoplan.errors import InputError
from photoplan.io.camera.model import CameraEntry, InPixels
from photoplan.io.orientation.block import Loss, OrientationBlock, common_losses, require_map
from photoplan.io.orientation.form import Direction
from photoplan.io.orientation.table import OrientedImage
from photoplan.io.orientation.text import DIRECTIONS

DEFAULT: Direction = "ground-to-camera"
#: Side of a pixel that is taken for a camera that is described in pixels, millimetres.
ASSUMED_PIXEL = 0.005


def losses(block: OrientationBlock) -> list[Loss]:
    """What of a block an Inpho project does not hold."""
    lost = common_losses(block, cameras=True, film=False, crs=True)
    direction = DIRECTIONS[block.matrix or DEFAULT]
    lost.append(
        Loss("other", f"no word on what the rotation matrix does; it is written {direction}, the angles as $INS")
    )
    for name, camera in block.cameras.items():
        if camera.camera_constant_mm is None:
            lost.append(
                Loss("other", f"no camera in pixels: {name!r} is written with pixels of {ASSUMED_PIXEL * 1000:g} µm")
            )
    return lost


def render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """The text of a project.

    Raises
    ------
    InputError
        No camera is known: the format states a camera constant with every image.
    """
    require_map(block, path)
    if not block.cameras:
        raise InputError(f"{path}: an Inpho project states a camera constant with every image; give `camera` FILE")
    lines = ["$PROJECT 5.0.0", f"  $PROJECT_NAME : {_word(path.stem)}", "  $ANGULAR_UNITS : deg", "$END"]
    if block.table.crs is not None:
        crs = " ".join(block.table.crs.split())
        lines += ["$COORDINATE_SYSTEM_SET", f"  $COORDINATE_SYSTEM : {crs}", "$END_COORDINATE_SYSTEM"]
    matrices = block.table.rotations
    for image, R in zip(block.table.images, matrices):
        lines += _photo(block, image, R.T if (block.matrix or DEFAULT) == "ground-to-camera" else R)
    for name, camera in block.cameras.items():
        if camera.pixels is not None:
            lines += _camera(name, camera.pixels, _constant(camera))
    lines.append("$NAVIGATION")
    for image, angles in zip(block.table.images, block.angles("opk", "deg")):
        lines.append(f"  $PHOTO_NUM : {_word(image.name)}")
        lines.append(f"  $GPS : {_row(image.center, 15, 4)}")
        lines.append(f"  $INS : {_row(angles, 14, 8)}")
    lines.append("$ENDNAV")
    return {path: "\n".join(lines) + "\n"}


def _word(name: str) -> str:
    return name.replace(" ", "\\ ")


def _row(values: object, width: int, digits: int) -> str:
    return " ".join(f"{float(v) + 0.0:{width}.{digits}f}" for v in values)  # type: ignore[attr-defined]


def _photo(block: OrientationBlock, image: OrientedImage, M: np.ndarray) -> list[str]:
    camera = block.camera(image)
    lines = ["$PHOTO", f"  $PHOTO_NUM : {_word(image.name)}"]
    file = block.files.get(image.name)
    if file is not None:
        lines.append(f"  $PHOTO_FILE : {_word(file)}")
    lines.append(f"  $CAMERA_ID : {_word(block.camera_name(image))}")
    lines += ["  $ORI_STAT : adjusted", "  $EXT_ORI :"]
    lines.append("    " + _row((_constant(camera), *image.center), 16, 6))
    lines += ["    " + _row(row, 18, 14) for row in np.round(M, 14)]
    lines.append("$END")
    return lines


def _constant(camera: CameraEntry) -> float:
    if camera.camera_constant_mm is not None or camera.pixels is None:
        return camera.constant_mm
    return camera.pixels.focal[0] * ASSUMED_PIXEL


def _camera(name: str, camera: InPixels, c: float) -> list[str]:
    (fx, fy), (col, row), (width, height) = camera.focal, camera.point, camera.size
    # The image coordinates have their origin in the principal point: then PPA is zero.
    return [
        "$CAMERA",
        f"  $TYPE : {_word(name)}",
        "  $BRAND : Custom",
        "  $KIND : CCDFrame",
        "  $CCD_INTERIOR_ORIENTATION :",
        f"    {_row((fx / c, 0.0, col), 24, 14)}",
        f"    {_row((0.0, -fy / c, row), 24, 14)}",
        f"  $CCD_COLUMNS : {width}",
        f"  $CCD_ROWS : {height}",
        "  $PIXEL_REFERENCE : CenterTopLeft",
        f"  $FOCAL_LENGTH : {c:.9f}",
        "  $PRINCIPAL_POINT_PPA : 0.000000 0.000000",
        "$END",
    ]
