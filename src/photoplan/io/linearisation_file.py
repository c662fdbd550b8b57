"""Linearisation tables: text files that say how much light a grey value stands for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.tables import Columns, read_table

#: A table of 65536 lines of four long numbers.
MAX_BYTES = 8_000_000


def read_linearisation_table(path: Path) -> NDArray[np.float64]:
    """The numbers of a linearisation table.

    Columns are separated by spaces, tabs, semicolons or commas; empty lines, lines that begin with ``#`` and a first
    line of words are passed over. One column holds the light of the grey values 0, 1, 2 …, two hold grey value and
    light, three the light in three bands, four the grey value and the light in three bands.

    Parameters
    ----------
    path : Path

    Returns
    -------
    array
        Shape (lines, columns).

    Raises
    ------
    InputError
        The file cannot be read, holds no numbers, or a line has another number of columns than the first, or what is
        no finite number; the message names the line.
    """
    order = tuple(f"column {n}" for n in range(1, 5))
    columns = Columns(
        roles={}, needed=order[:1], orders=(order,), numbers=frozenset(order), untitled=True, row="line with numbers"
    )
    table = read_table(path, columns, max_bytes=MAX_BYTES)
    if table.layout.width > len(order):
        raise InputError(f"{table.where(0)}: {table.layout.width} columns, at most {len(order)} are read")
    return np.stack([table.numbers(role) for role in table.roles], axis=1)
