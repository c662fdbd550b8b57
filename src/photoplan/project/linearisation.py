"""How grey values become light, as a user names it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.tables import Columns, read_table
from photoplan.quality.linearise import Linearisation

#: A table of 65536 lines of four long numbers.
_MAX_BYTES = 8_000_000


def linearisation_of(words: str) -> Linearisation:
    """What ``linear``, ``srgb`` or the name of a table stand for."""
    if words in ("linear", "srgb"):
        return Linearisation("linear" if words == "linear" else "srgb")
    path = Path(words)
    if not path.is_file():
        raise InputError(f"linearisation {words}: is no file; give linear, srgb, or a table that exists")
    table = read_linearisation_table(path)
    try:
        return Linearisation.from_table(table)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_linearisation_table(path: Path) -> NDArray[np.float64]:
    """The numbers of a linearisation table.

    Columns are separated by spaces, tabs, semicolons or commas; empty lines, lines that begin with ``#`` and a first
    line of words are passed over. One column holds the light of the grey values 0, 1, 2 …, two hold grey value and
    light, three the light in three bands, four the grey value and the light in three bands.
    """
    order = tuple(f"column {n}" for n in range(1, 5))
    columns = Columns(
        roles={}, needed=order[:1], orders=(order,), numbers=frozenset(order), untitled=True, row="line with numbers"
    )
    table = read_table(path, columns, max_bytes=_MAX_BYTES)
    if table.layout.width > len(order):
        raise InputError(f"{table.where(0)}: {table.layout.width} columns, at most {len(order)} are read")
    return np.stack([table.numbers(role) for role in table.roles], axis=1)
