"""Types of values on the command line: paths, folders, sizes, lists, numbers of workers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

#: Endings of files: a folder of such a name would be made in silence.
_FILE = re.compile(r"\.(csv|gpkg|html|jp2|jpe?g|json|la[sz]|pdf|png|tiff?|toml|vrt)$", re.IGNORECASE)


class _Path(click.Path):
    """A path that is not empty, which would be the folder where the command runs; no new folder is named as a file."""

    def __init__(self, *, new_folder: bool = False) -> None:
        super().__init__(path_type=Path)
        self.new_folder = new_folder

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not str(value).strip():
            self.fail("the name is empty; give the name of a file or folder", param, ctx)
        if self.new_folder and _FILE.search(str(value)) and not Path(str(value)).exists():
            self.fail(f"{str(value)!r} is named as a file; give a folder: files in it have their own names", param, ctx)
        return super().convert(value, param, ctx)


PATH = _Path()
NEW_FOLDER = _Path(new_folder=True)
_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


class _Bytes(click.ParamType):
    """A number of bytes such as 2GB, 512MiB or 1.5G (1 K = 1024)."""

    name = "size"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        match = re.fullmatch(r"\s*(\d{1,12}(?:\.\d{1,12})?)\s*([KMGT]?)(?:i?B)?\s*", str(value), re.IGNORECASE)
        if not match:
            self.fail(f"{value!r} is no size; write for example 2GB or 800MB", param, ctx)
        return int(float(match[1]) * _UNITS[match[2].upper()])


BYTES = _Bytes()


def all_cores(context: click.Context, parameter: click.Parameter, given: int | None) -> int:
    """Return the number of workers; all cores if none is given."""
    from photoplan.engine.executors import available_cpus

    return given or available_cpus()


def listed(values: Sequence[str]) -> tuple[str, ...]:
    """Return values with commas between them, or of an option that is repeated; a file that is there is one value."""
    parts = [[value] if Path(value).exists() else value.split(",") for value in values]
    return tuple(part.strip() for split in parts for part in split if part.strip())
