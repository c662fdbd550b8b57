"""Tables of numbers beside a strip: the record of its flight, positions of detectors; CSV or NPY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.files import read_text


def read_numbers(path: Path, columns: str, max_bytes: int) -> NDArray[np.float64]:
    """The numbers (n, k) of a table: CSV that begins with the names of its columns, or NPY."""
    count = columns.count(",") + 1
    try:
        if path.suffix.lower() == ".npy":
            if path.stat().st_size > max_bytes:
                raise InputError(f"{path}: {path.stat().st_size} bytes; no table of a strip has more than {max_bytes}")
            table = _from_npy(path)
        else:
            header, _, body = read_text(path, max_bytes).partition("\n")
            if header.replace(" ", "").strip().lower() != columns:
                raise InputError(f"{path}: the first line is {header[:80]!r}; it has to be {columns}")
            if not body.strip():
                raise InputError(f"{path}: holds nothing but its first line")
            table = np.loadtxt(body.splitlines(), delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        # What NumPy advises behind the semicolon is for who programs.
        raise InputError(f"{path}: cannot be read ({str(error).partition(';')[0]})") from None
    if table.ndim != 2 or table.shape[1] != count:
        raise InputError(f"{path}: a table of shape {table.shape}; needed are {count} numbers in each row")
    wrong = ~np.isfinite(table).all(axis=1)
    if wrong.any():
        raise InputError(f"{path}: row {int(np.argmax(wrong)) + 1} holds a number that is not finite")
    return np.ascontiguousarray(table)


def _from_npy(path: Path) -> NDArray[np.float64]:
    try:
        table = np.load(path, allow_pickle=False, mmap_mode="r")
        kind = table.dtype
    except (OSError, ValueError):
        raise
    except Exception as error:
        # Its header is a line of Python: a damaged one ends in whatever the parser raises.
        raise ValueError(f"no array in NPY form: {error}") from None
    if kind.kind not in "fiu":
        raise ValueError(f"it holds {kind}: real numbers are needed")
    return np.asarray(table, float)
