"""Orientations of BINGO (``itera.dat``).

Lines that begin with ``ORIA``: name, X0, Y0, Z0 in metres, φ, ω, κ in gon; φ about Y is the primary rotation, then ω,
then κ. So a program reads them whose author compared his adjustment with BINGO's (Š. Turek, master's thesis, Czech
Technical University in Prague, 2014). Other lines belong to other parts of an adjustment and are passed over, as is
what follows the angles.
"""

from __future__ import annotations

import re
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.orientation.block import OrientationBlock, OrientationFormat, common_losses, name_losses, require_map
from photoplan.io.orientation.form import TableFormat
from photoplan.io.orientation.text import angle_block, angle_lines, word_lines

KEYWORD = "ORIA"
#: Characters of an image name that BINGO takes at most (Catalyst's guide on export to BINGO).
NAME = 15


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Block of a file; `form` only where it declares other conventions."""
    rows = [
        (line, line.words[1] if len(line.words) > 1 else "", line.words[2:8])
        for line in word_lines(path)
        if line.words[0].upper() == KEYWORD
    ]
    if not rows:
        raise InputError(f"{path}: no line begins with {KEYWORD}; this is no orientation file of BINGO")
    return angle_block(path, form, rows)


def render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """The text of a file."""
    require_map(block, path)
    return {path: "".join(f"{KEYWORD} {line}\n" for line in angle_lines(block, path, NAME))}


FORMAT = OrientationFormat(
    name="bingo",
    title="orientation lines of BINGO",
    sniff=lambda path, head: re.search(rf"^\s*{KEYWORD}\s+\S+(\s+[-+.\deEdD]+){{6}}", head, re.M) is not None,
    read=read,
    render=render,
    losses=lambda block: [*common_losses(block, cameras=False), *name_losses(block, NAME)],
    suffix=".dat",
    angles=True,
)
