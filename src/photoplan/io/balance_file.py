"""Balance files: what becomes of an image's grey values, as TOML that can be read, plotted and edited."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, Strict, model_validator

from photoplan.io.camera.model import Entry, NotNegative, Number
from photoplan.io.naming import write_atomically
from photoplan.io.plain_files import read_entries
from photoplan.io.project.write import toml_value

_MAX_BYTES = 10_000_000
_Side = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
_Power = Annotated[int, Strict(), Field(ge=0, le=8)]
_Numbers = Annotated[tuple[Number, ...], Field(min_length=2, max_length=65_536)]


class BalanceBand(Entry):
    """``[[bands]]``: one band, in the image's order."""

    grey: _Numbers
    """Grey values of the table, rising."""
    becomes: _Numbers
    """What they become, never falling; between them it is linear."""
    sigma: tuple[NotNegative, ...] = ()
    """Standard deviations; only information."""
    trend: Annotated[tuple[tuple[_Power, _Power, Number], ...], Field(max_length=60)] = ()
    """Terms i, j, c of 1 + Σ c (uⁱ vʲ − mean), by which grey values, or their light, are divided before the table."""
    curve_grey: _Numbers | tuple[()] = ()
    """Grey values of the image's characteristic curve, rising; none: grey values are light."""
    curve_light: _Numbers | tuple[()] = ()
    """The light that gives them, never falling; it is divided by the trend, and `grey` are values of it."""

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        if len(self.grey) != len(self.becomes):
            raise ValueError(
                f"{len(self.grey)} entries of grey, but {len(self.becomes)} of becomes; give as many of both"
            )
        if len(self.curve_grey) != len(self.curve_light):
            raise ValueError(
                f"{len(self.curve_grey)} entries of curve_grey, but {len(self.curve_light)} of curve_light; give as "
                "many of both, or none"
            )
        return self


class BalanceFile(Entry):
    """A whole file."""

    format: Literal["photoplan balance 1"]
    size: tuple[_Side, _Side]
    """Width and height of the image, pixels."""
    description: Annotated[str, Field(max_length=10_000)] = ""
    bands: Annotated[tuple[BalanceBand, ...], Field(min_length=1, max_length=1000)]


def read_balance_file(path: Path) -> BalanceFile:
    """Contents of a balance file."""
    return read_entries(path, BalanceFile, _MAX_BYTES)


def write_balance_file(path: Path, size: tuple[int, int], description: str, bands: Sequence[BalanceBand]) -> None:
    """Write a balance file; the name holds the old or the whole new file."""
    lines = [
        "# What becomes of grey values: table(light / trend), light by curve_grey and curve_light; without these light",
        "# is grey. Between entries tables are linear, they may not fall.",
        "# A term [i, j, c] adds c (u^i v^j - its mean) to a trend of 1; u, v are columns and rows from the image's",
        "# middle, in half diagonals.",
        'format = "photoplan balance 1"',
        f"size = {toml_value(list(size))}",
        f"description = {toml_value(description)}",
    ]
    for band in bands:
        lines += ["", "[[bands]]"]
        span = max(abs(value) for value in (*band.grey, *band.becomes))
        places = max(2, 5 - math.ceil(math.log10(max(span, 1e-9))))
        for name in ("curve_grey", "curve_light", "grey", "becomes", "sigma"):
            if values := getattr(band, name):
                lines.append(f"{name} = [{', '.join(f'{value:.{places}f}' for value in values)}]")
        if band.trend:
            lines.append(f"trend = [{', '.join(f'[{i}, {j}, {c:.6f}]' for i, j, c in band.trend)}]")
    write_atomically(path, ("\n".join(lines) + "\n").encode())
