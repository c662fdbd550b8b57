"""Models of lateral chromatic aberration: TOML that can be read and edited."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, Strict

from photoplan.io.camera.model import Entry, Number, Pair, Pixels
from photoplan.io.naming import write_atomically
from photoplan.io.plain_files import read_entries
from photoplan.io.project.write import toml_value

_MAX_BYTES = 1_000_000
_Band = Annotated[int, Strict(), Field(ge=1, le=1000)]
_Power = Annotated[int, Strict(), Field(ge=0, le=5)]
_Count = Annotated[int, Strict(), Field(ge=0)]


class ChromaticBand(Entry):
    """``[[bands]]``: one band."""

    band: _Band
    terms: Annotated[tuple[tuple[_Power, _Power, Number, Number], ...], Field(max_length=60)] = ()
    sigmas: Annotated[tuple[Pair, ...], Field(max_length=60)] = ()
    kind: Annotated[str, Field(max_length=100)] = "polynomial"
    residual: Number | None = None
    count: _Count = 0
    rejected: _Count = 0


class ChromaticFile(Entry):
    """A whole file."""

    format: Literal["photoplan chromatic 1"]
    image_size: tuple[Pixels, Pixels]
    reference: _Band
    description: Annotated[str, Field(max_length=10_000)] = ""
    bands: Annotated[tuple[ChromaticBand, ...], Field(max_length=1000)] = ()


def read_chromatic(path: Path) -> ChromaticFile:
    """A model of lateral chromatic aberration."""
    return read_entries(path, ChromaticFile, _MAX_BYTES)


def write_chromatic(path: Path, contents: Mapping[str, Any], bands: Sequence[Mapping[str, Any]]) -> None:
    """Write a model; the name holds the old or the whole new file."""
    lines = ["# Lateral chromatic aberration: where a band lies against the reference, pixels.",
             "# A term [i, j, a, b] adds (a, b) u^i v^j; u, v from the image's middle in units of half its diagonal.",
             'format = "photoplan chromatic 1"']  # fmt: skip
    lines += [f"{name} = {_text(value)}" for name, value in contents.items()]
    for band in bands:
        lines += ["", "[[bands]]"]
        for name, value in band.items():
            if name in ("terms", "sigmas"):
                lines += [f"{name} = [", *(f"  {_text(each)}," for each in value), "]"]
            elif not (isinstance(value, float) and not math.isfinite(value)):
                lines.append(f"{name} = {_text(value)}")
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _text(value: Any) -> str:
    """A plain value as TOML; numbers with nine digits, which is far below what is measured."""
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_text(each) for each in value) + "]"
    return toml_value(float(f"{value:.9g}") if isinstance(value, float) else value)
