"""Orientation files of PATB (``.ori``).

Three records for each image (PCI Geomatics, *Using Pat-B in OrthoEngine*: ``I16, 16X, 3F16.5 / 5F16.12 / 4F16.12``):
its name, a field that may be empty or hold the camera constant, X0, Y0, Z0; then the nine elements of the rotation
matrix row by row, a11 a12 a13 a21 a22 and a23 a31 a32 a33. Published descriptions do not say whether the matrix takes
the camera's axes (x right, y up, z towards the viewer) to the ground's or the other way, and programs differ. So the
user declares it; files are written camera to ground unless the other is asked for.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from photoplan.errors import InputError
from photoplan.io.orientation.block import (
    Loss,
    OrientationBlock,
    OrientationFormat,
    common_losses,
    name_losses,
    require_map,
)
from photoplan.io.orientation.form import TableFormat
from photoplan.io.orientation.table import OrientationTable, OrientedImage, posed
from photoplan.io.orientation.text import DIRECTIONS, Words, checked_rotation, numbers, one_word, word_lines
from photoplan.io.tables import number

#: Characters of an image name that PATB takes at most (Catalyst's guide on export to PATB).
NAME = 15


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Block of a file."""
    lines = word_lines(path)
    if not lines:
        raise InputError(f"{path}: holds no image")
    if not form.declares("direction"):
        raise InputError(
            f"{path}: PATB does not say what its rotation matrix does; declare `rotation_direction` camera-to-ground "
            "or ground-to-camera (with measured points, `list_readings` tells which)"
        )
    if len(lines) % 3:
        raise InputError(
            f"{lines[-1].where}: {len(lines)} lines; PATB has three for each image: name and X, Y, Z, then five and "
            "four elements of the rotation matrix"
        )
    images = [_image(lines[k], lines[k + 1], lines[k + 2], form) for k in range(0, len(lines), 3)]
    note = f"{path.name}: rotation matrices read as {DIRECTIONS[form.direction]}"
    return OrientationBlock(OrientationTable(path, tuple(images), notes=(note,)))


def _image(first: Words, second: Words, third: Words, form: TableFormat) -> OrientedImage:
    if len(first.words) not in (4, 5):
        raise InputError(
            f"{first.where}: {len(first.words)} values; the first line of an image holds its name, X, Y, Z, and "
            "perhaps the camera constant before them"
        )
    name = first.words[0]
    if len(first.words) == 5:
        number(first.words[1], f"{first.where}: image {name!r}: camera constant")
    center = numbers(first.words[-3:], first.where, f"image {name!r}: X, Y, Z", 3)
    rows = (
        *numbers(second.words, second.where, f"image {name!r}: a11 a12 a13 a21 a22", 5),
        *numbers(third.words, third.where, f"image {name!r}: a23 a31 a32 a33", 4),
    )
    M = checked_rotation(rows, f"{second.where}: image {name!r}")
    return posed(name, center, M if form.direction == "camera-to-ground" else M.T, line=first.line)


def render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """The text of a file; the camera constant in millimetres where it is known, an empty field else."""
    require_map(block, path)
    lines = []
    for image, R in zip(block.table.images, block.table.rotations):
        M = R.T if block.matrix == "ground-to-camera" else R
        c = block.camera(image).camera_constant_mm if block.cameras else None
        constant = " " * 16 if c is None else f"{c:16.5f}"
        X, Y, Z = image.center
        lines.append(f"{one_word(image.name, path):>16}{constant} {X:15.5f} {Y:15.5f} {Z:15.5f}")
        a = [f"{v + 0.0:16.12f}" for v in np.round(M, 12).ravel()]
        lines += ["".join(a[:5]), "".join(a[5:])]
    return {path: "\n".join(lines) + "\n"}


def _losses(block: OrientationBlock) -> list[Loss]:
    lost = common_losses(block, cameras=False)
    direction = DIRECTIONS[block.matrix or "camera-to-ground"]
    lost.append(Loss("other", f"no word on what the rotation matrix does; it is written {direction}"))
    return [*lost, *name_losses(block, NAME)]


def _sniff(path: Path, head: str) -> bool:
    """Three lines whose last nine numbers are a rotation."""
    lines = [line.split() for line in head.split("\n") if line.strip()][:3]
    if [len(words) for words in lines] not in ([4, 5, 4], [5, 5, 4]):
        return False
    try:
        checked_rotation([number(w, "") for w in lines[1] + lines[2]], "")
    except InputError:
        return False
    return True


FORMAT = OrientationFormat(
    name="patb", title="orientation file of PATB", sniff=_sniff, read=read, render=render, losses=_losses, suffix=".ori"
)
