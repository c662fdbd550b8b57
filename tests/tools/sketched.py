"""Figures of matplotlib as sketches: to lay out and draw one takes a third of a second, and few tests look at it.

A figure is composed as always; only its pixels are those of `BLANK`. Tests marked `drawn` have the real ones: at least
one for each function that draws.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


#: A grey pixel.
BLANK = (
    b"\x89PNG\r\n\x1a\n"
    + _chunk(b"IHDR", struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0))
    + _chunk(b"IDAT", zlib.compress(b"\0\x80"))
    + _chunk(b"IEND", b"")
)
_wanted = False


@contextmanager
def drawn() -> Iterator[None]:
    """For fixtures that several tests share: figures are drawn whoever asks first."""
    global _wanted
    before, _wanted = _wanted, False
    yield
    _wanted = before


def begin(item: pytest.Item) -> None:
    """What this test gets, its fixtures included."""
    global _wanted
    from photoplan.report import page

    _wanted = item.get_closest_marker("drawn") is None
    if page.load_matplotlib is not _load:
        _load.real = page.load_matplotlib  # type: ignore[attr-defined]
        page.load_matplotlib = _load


def _load(what: str, otherwise: str = "") -> Any:
    """Matplotlib, whose figures ask before they draw."""
    matplotlib = _load.real(what, otherwise)  # type: ignore[attr-defined]
    figure = matplotlib.figure.Figure
    real = figure.savefig
    if not hasattr(real, "asks"):

        def savefig(self: Any, to: Any, **options: Any) -> None:
            if _wanted and hasattr(to, "write"):
                to.write(BLANK)
            else:
                real(self, to, **options)

        savefig.asks = True  # type: ignore[attr-defined]
        figure.savefig = savefig
    return matplotlib
