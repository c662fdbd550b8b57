"""What the readers of classical orientation files share: words with line numbers, numbers with messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.io.files import read_text
from photoplan.io.orientation.block import OrientationBlock
from photoplan.io.orientation.form import TableFormat
from photoplan.io.orientation.table import OrientationTable, OrientedImage
from photoplan.io.tables import number

MAX_BYTES = 200_000_000
#: Rotation matrices of files are rounded; what differs more from a rotation is none.
ORTHOGONAL = 2e-4
DIRECTIONS = {"camera-to-ground": "camera to ground", "ground-to-camera": "ground to camera"}


@dataclass(frozen=True)
class Words:
    """A line of a file, split at white space."""

    where: str
    """File and line, for messages."""
    line: int
    words: tuple[str, ...]


def word_lines(path: Path) -> list[Words]:
    """Lines of a text file that are not empty; raises InputError as `read_text`."""
    lines = read_text(path, MAX_BYTES).split("\n")
    return [Words(f"{path}:{n}", n, tuple(text.split())) for n, text in enumerate(lines, 1) if text.strip()]


def numbers(words: Sequence[str], where: str, what: str, count: int) -> tuple[float, ...]:
    """`count` numbers."""
    if len(words) != count:
        raise InputError(f"{where}: {what}: {len(words)} values; {count} numbers are needed")
    return tuple(number(word, f"{where}: {what}") for word in words)


def one_word(name: str, path: Path) -> str:
    """A name as a format without quotes can hold it."""
    if not name or name.split() != [name]:
        raise InputError(f"{path}: image {name!r} has a blank in its name, which this format cannot hold; rename it")
    return name


def checked_rotation(values: ArrayLike, where: str, tolerance: float = ORTHOGONAL) -> NDArray[np.float64]:
    """The rotation (3, 3) nearest to nine rounded numbers, row by row; `tolerance` is that of the matrix
    times itself.
    """
    M = np.array(values, float).reshape(3, 3)
    if not np.allclose(M @ M.T, np.eye(3), rtol=0, atol=tolerance) or np.linalg.det(M) < 0:
        raise InputError(
            f"{where}: the nine numbers are not a rotation matrix (rows of length 1, at right angles, right-handed)"
        )
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ Vt, np.float64)


def angle_block(path: Path, form: TableFormat, rows: Sequence[tuple[Words, str, Sequence[str]]]) -> OrientationBlock:
    """Block of lines as `angle_lines` writes them: a name, X, Y, Z and φ, ω, κ in this order."""
    unit, rotation, direction = form.conventions("gon", "pok", "camera-to-ground")
    images = []
    for line, name, words in rows:
        X, Y, Z, phi, omega, kappa = numbers(words, line.where, f"image {name!r}: X, Y, Z, phi, omega, kappa", 6)
        named = {"p": phi, "o": omega, "k": kappa}
        a, b, c = (named[letter] for letter in rotation)
        images.append(OrientedImage(name=name, center=(X, Y, Z), angles=(a, b, c), camera=None, line=line.line))
    note = f"{path.name}: angles read as {unit}, rotation {rotation}, {DIRECTIONS[direction]}"
    return OrientationBlock(
        OrientationTable(
            file=path, images=tuple(images), angle_unit=unit, rotation=rotation, direction=direction, notes=(note,)
        )
    )


def angle_lines(block: OrientationBlock, path: Path, width: int) -> list[str]:
    """A line for each image: name, X, Y, Z in metres, and φ, ω, κ in gon, φ the primary rotation."""
    lines = []
    for image, (phi, omega, kappa) in zip(block.table.images, block.angles("pok", "gon")):
        X, Y, Z = image.center
        name = one_word(image.name, path)
        lines.append(f"{name:<{width}} {X:14.4f} {Y:14.4f} {Z:12.4f} {phi:14.8f} {omega:14.8f} {kappa:14.8f}")
    return lines
