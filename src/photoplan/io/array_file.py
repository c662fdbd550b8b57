"""Arrays kept between runs under a key: what an interrupted run need not compute again."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.io.disk import write_atomically

_KEY = "key"


def array_key(*facts: Any) -> str:
    """Digest of what decides the content of arrays: plain values, or anything whose text says it all."""
    return sha256(json.dumps(facts, sort_keys=True, default=repr).encode()).hexdigest()


def load_arrays(path: Path, key: str) -> dict[str, NDArray[Any]] | None:
    """Arrays of a file; None if it is not there, damaged, or of another key."""
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error):
        return None
    stored = found.pop(_KEY, None)
    return found if stored is not None and str(stored) == key else None


def store_arrays(path: Path, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays; the name holds the old or the whole new file.

    Raises
    ------
    ResourceError, UsageError
        The disk is full, or the folder cannot be written to.
    """
    content = io.BytesIO()
    every: dict[str, Any] = {_KEY: np.array(key), **arrays}
    np.savez(content, **every)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content.getvalue())
