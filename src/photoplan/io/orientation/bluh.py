"""Orientation files of BLUH, the bundle adjustment of the University of Hannover.

A line for each image: name, X0, Y0, Z0 in metres, φ, ω, κ; φ about Y is the primary rotation, then ω, then κ
(rotation: Š. Turek, master's thesis, Czech Technical University in Prague, 2014, who names it BLUH's). For columns and
unit no public description was found: the unit has to be declared, and since files of other make look the same, the
format has to be stated.
"""

from __future__ import annotations

from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.orientation.block import OrientationBlock, OrientationFormat, common_losses, require_map
from photoplan.io.orientation.form import TableFormat
from photoplan.io.orientation.text import angle_block, angle_lines, word_lines

COLUMNS = 7
#: Characters of a name.
NAME = 20


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Block of a file; `form` only where it declares other conventions."""
    rows = []
    lines = word_lines(path)
    if not form.declares("angle_unit"):
        raise InputError(
            f"{path}: no public description tells the unit of angles in files of BLUH; declare `angle_unit` gon, deg "
            "or rad (with measured points, `list_readings` tells which)"
        )
    for line in lines:
        if len(line.words) < COLUMNS:
            raise InputError(
                f"{line.where}: {len(line.words)} columns; a line of BLUH holds name, X, Y, Z, phi, omega, kappa"
            )
        # What follows are standard deviations or a camera's number.
        rows.append((line, line.words[0], line.words[1:COLUMNS]))
    return angle_block(path, form, rows)


def render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """The text of a file, angles in gon."""
    require_map(block, path)
    return {path: "".join(f"{line}\n" for line in angle_lines(block, path, NAME))}


FORMAT = OrientationFormat(
    name="bluh",
    title="orientation file of BLUH",
    sniff=lambda path, head: False,
    read=read,
    render=render,
    losses=lambda block: common_losses(block, cameras=False),
    suffix=".ori",
    angles=True,
)
