"""The chunk structure of a PNG: a file that was cut off is recognised without decoding it (PNG specification, 5.3)."""

from __future__ import annotations

import struct
from pathlib import Path

from photoplan.errors import InputError


def check_png_complete(path: Path) -> None:
    """Follow the chunks to the end chunk; the decoder itself would deliver a cut-off picture without a word.

    Raises
    ------
    InputError
        If the file ends before its end chunk.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        position = 8
        while position + 12 <= size:
            file.seek(position)
            length, kind = struct.unpack(">I4s", file.read(8))
            position += 12 + length
            if kind == b"IEND" and position <= size:
                return
    raise InputError(f"{path}: the PNG is cut off (its end chunk is missing, {size} bytes); get a fresh copy")
