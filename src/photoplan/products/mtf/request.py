"""What requests for edges and for test patterns have in common: names of images, and files that may be written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from photoplan.errors import UsageError
from photoplan.io.product import check_output

#: Said where nobody states how 8 bits are encoded.
ENCODED = (
    "linearisation: linear (by default: grey values are taken as light). Images of 8 bits are usually encoded by a "
    "curve such as sRGB, and that alone moves MTF50 by about 12 %; say `linearisation` srgb, a table, or linear"
)


def check_files(images: Sequence[Path], tables: Sequence[Path | str | None], csv: Path | None, overwrite: bool) -> None:
    """Refuse images, inputs and outputs that cannot be meant together."""
    if not images:
        raise UsageError("no image is given; give one or more images")
    files = [str(path) for path in images]
    twice = sorted({f for f in files if files.count(f) > 1})
    if twice:
        raise UsageError(f"image {twice[0]} is given twice")
    inputs = [*images, *(Path(table) for table in tables if table not in (None, "linear", "srgb"))]
    if csv is not None:
        check_output(csv, inputs, overwrite=overwrite)


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Names of files; whole paths where two files have one name."""
    names = [path.name for path in paths]
    return [str(path) if names.count(path.name) > 1 else path.name for path in paths]
