"""Correction files of light fall-off: the model of one camera as TOML, which can be read and edited."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, Strict

from photoplan.io.camera.model import Entry, NotNegative, Number, Positive
from photoplan.io.plain_files import read_entries
from photoplan.io.project.write import toml_value

_MAX_BYTES = 1_000_000
_Side = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
_Degree = Annotated[int, Strict(), Field(ge=-20, le=20)]


class TermEntry(Entry):
    """A term of the artificial part."""

    n: _Degree
    """Power of the radius, in half diagonals of the image."""
    m: _Degree
    """Multiple of the angle: cosine, where negative the sine of its amount; 0: the same all around."""
    coefficient: Number
    sigma: NotNegative | None = None
    """Standard deviation; only information."""


class FallOffEntry(Entry):
    """The whole file."""

    format: Literal["photoplan light fall-off 1"]
    size: tuple[_Side, _Side]
    """Width and height of the images that it corrects, pixels (of a Bayer pattern: of one colour)."""
    plane: Annotated[str, Field(max_length=100)] = ""
    """Which colour it corrects; empty: images of one band."""
    principal_point_px: tuple[Number, Number]
    camera_constant_px: Positive | None = None
    """Of the natural part cos⁴ω; left out: the terms hold everything."""
    dark_dn: Number = 0.0
    """Grey value of no light."""
    gain_image: Annotated[str, Field(max_length=1000)] | None = None
    """Image of the gains beside this file; only information, the gains follow from the terms."""
    gain_reduction: Annotated[int, Strict(), Field(ge=1)] | None = None
    """Pixels of the camera per pixel of the gain image, along each side."""
    terms: Annotated[tuple[TermEntry, ...], Field(max_length=200)] = ()


def read_fall_off_entry(path: Path) -> FallOffEntry:
    """Contents of a correction file."""
    return read_entries(path, FallOffEntry, _MAX_BYTES)


def fall_off_text(entry: FallOffEntry) -> str:
    """A correction file's text."""
    lines = [
        "# Light fall-off: grey values are multiplied by 1 / (cos⁴ω · (1 + sum of terms)) after dark_dn is taken off.",
        "# A term is coefficient · r^n · cos(m θ), for negative m r^n · sin(|m| θ); r in half diagonals from the",
        "# principal point, θ from columns to rows.",
        *_stated((name, value) for name, value in entry if name != "terms"),
    ]
    for term in entry.terms:
        lines += ["", "[[terms]]", *_stated(term)]
    return "\n".join(lines) + "\n"


def _stated(entries: Iterable[tuple[str, Any]]) -> list[str]:
    return [f"{name} = {toml_value(value)}" for name, value in entries if value not in (None, "")]
