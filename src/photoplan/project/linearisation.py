"""How grey values become light, as a user names it."""

from __future__ import annotations

from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.linearisation_file import read_linearisation_table
from photoplan.quality.linearise import Linearisation


def linearisation_of(words: str) -> Linearisation:
    """What ``linear``, ``srgb`` or the name of a table stand for.

    Raises
    ------
    InputError
        It is neither a word nor a file, or the table cannot be read or used.
    """
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
