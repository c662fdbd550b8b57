"""Options that several verbs share, and how values are spelled."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
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


class _ProjectPath(_Path):
    """A project file; a folder stands for the `project.toml` in it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = super().convert(value, param, ctx)
        inside = Path(path) / "project.toml"
        return inside if inside.is_file() else path


PATH = _Path()
PROJECT = _ProjectPath()
NEW_FOLDER = _Path(new_folder=True)
POSITIVE = click.FloatRange(0, min_open=True)


def several(*options: Callable[..., Any]) -> Callable[..., Any]:
    """Options (and arguments) as one decorator, in the order of the help."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


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


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="No progress on stderr; warnings stay.")
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace what exists.")
workers_option = click.option(
    "--workers", type=click.IntRange(1), callback=all_cores, help="Worked on at once [all cores]."
)
executor_option = click.option(
    "--executor",
    default="threads",
    show_default=True,
    metavar="KIND",
    help="threads, processes, or a Dask scheduler's address tcp://host:port.",
)
memory_option = click.option("--memory", type=BYTES, default=None, metavar="SIZE", help="Stay under this, e.g. 2GB.")


def dry_run_option(what: str) -> Callable[..., Any]:
    """`--dry-run`, with what happens instead."""
    return click.option("--dry-run", is_flag=True, help=what)


def ending(
    dry_run: str = "", *, workers: bool = False, executor: bool = False, memory: bool = False, overwrite: bool = True
) -> Callable[..., Any]:
    """What the options of nearly every verb end with; `dry_run` says what happens instead."""
    first = [workers_option] * workers + [executor_option] * executor + [memory_option] * memory
    first += [dry_run_option(dry_run)] * bool(dry_run) + [overwrite_option] * overwrite
    return several(*first, json_option, quiet_option)


def listed(values: Sequence[str]) -> tuple[str, ...]:
    """Values with commas between them, or of an option that is repeated; a file that is there is one value."""
    parts = [[value] if Path(value).exists() else value.split(",") for value in values]
    return tuple(part.strip() for split in parts for part in split if part.strip())
