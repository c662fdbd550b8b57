"""TIFF files that promise gigabytes and hold one block: every entry of the table of blocks points to it.

Reading such a file costs what a full one costs, writing and storing it nothing.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_SHORT, _LONG, _DOUBLE, _LONG8 = 3, 4, 12, 16
_CODES = {_SHORT: "H", _LONG: "I", _DOUBLE: "d", _LONG8: "Q"}


def write_huge_tiff(
    path: Path, block: NDArray[np.generic], size: tuple[int, int], place: tuple[int, float, float, float] | None = None
) -> Path:
    """A BigTIFF of `size` (width, height) that repeats `block` (rows, columns, bands), compressed by DEFLATE.

    Parameters
    ----------
    path
        The file.
    block
        Its sides must be multiples of 16.
    size
        Width and height of the picture, pixels.
    place
        EPSG code, left edge, top edge, pixel: a georeference.
    """
    rows, columns, bands = block.shape
    payload = zlib.compress(block.tobytes(), 1)
    count = -(-size[0] // columns) * -(-size[1] // rows)
    header = 16
    kind = {"u": 1, "i": 2, "f": 3}[block.dtype.kind]
    tags: list[tuple[int, int, list[float]]] = [
        (256, _LONG, [size[0]]),
        (257, _LONG, [size[1]]),
        (258, _SHORT, [8 * block.dtype.itemsize] * bands),
        (259, _SHORT, [8]),
        (262, _SHORT, [2 if bands == 3 else 1]),
        (277, _SHORT, [bands]),
        (284, _SHORT, [1]),
        (322, _LONG, [columns]),
        (323, _LONG, [rows]),
        (324, _LONG8, [header] * count),
        (325, _LONG8, [len(payload)] * count),
        (339, _SHORT, [kind] * bands),
    ]
    if place is not None:
        code, left, top, pixel = place
        tags += [
            (33550, _DOUBLE, [pixel, pixel, 0]),
            (33922, _DOUBLE, [0, 0, 0, left, top, 0]),
            # GeoTIFF keys: model type projected, pixels are areas, code of the CRS.
            (34735, _SHORT, [1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, code]),
        ]
    at = header + len(payload)
    with path.open("wb") as file:
        table, values = b"", b""
        values_at = at + 8 + 20 * len(tags) + 8
        for number, code_of, numbers in tags:
            data = struct.pack(f"<{len(numbers)}{_CODES[code_of]}", *numbers)
            if len(data) <= 8:
                inline = data.ljust(8, b"\0")
            else:
                inline = struct.pack("<Q", values_at + len(values))
                values += data
            table += struct.pack("<HHQ", number, code_of, len(numbers)) + inline
        file.write(struct.pack("<2sHHHQ", b"II", 43, 8, 0, at) + payload)
        file.write(struct.pack("<Q", len(tags)) + table + struct.pack("<Q", 0) + values)
    return path
