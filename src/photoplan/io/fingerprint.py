"""Whether an input is still the file that it was: a cheap fingerprint of its content."""

from __future__ import annotations

import hashlib
import os
import stat
from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import InputError

_BLOCK = 64 << 10
_BLOCKS = 64


@dataclass(frozen=True)
class Fingerprint:
    """What identifies a file's content.

    The digest is sampled: SHA-256 over the size and up to 64 blocks of 64 KiB, spread evenly from the first byte to
    the last (files up to 4 MiB are covered whole). An edit that keeps size and time and falls between the blocks is not
    seen; it is no protection against malice.
    """

    size: int
    """Bytes of the file."""
    digest: str
    """SHA-256 as 64 hexadecimal digits."""


def fingerprint(path: str | os.PathLike[str]) -> Fingerprint:
    """Fingerprint of a file; reads at most 4 MiB, whatever its size."""
    path = Path(path)
    digest = hashlib.sha256()
    try:
        if stat.S_ISFIFO(path.stat().st_mode):
            raise InputError(f"{path}: is a pipe, which can be read once only; give a file")
        with path.open("rb", buffering=0) as file:
            state = os.fstat(file.fileno())
            digest.update(str(state.st_size).encode())
            last = max(0, state.st_size - _BLOCK)
            count = max(1, min(_BLOCKS, -(-state.st_size // _BLOCK)))
            for i in range(count):
                file.seek(last * i // max(1, count - 1))
                digest.update(file.read(_BLOCK))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check that it is there and readable") from error
    return Fingerprint(state.st_size, digest.hexdigest())
