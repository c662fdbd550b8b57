"""Options that several verbs share, and how values are spelled."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import click

_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


class _Bytes(click.ParamType):
    """A number of bytes such as 2GB, 512MiB or 1.5G (1 K = 1024)."""

    name = "size"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)(?:i?B)?\s*", str(value), re.IGNORECASE)
        if not match:
            self.fail(f"{value!r} is no size; write for example 2GB or 800MB", param, ctx)
        return int(float(match[1]) * _UNITS[match[2].upper()])


BYTES = _Bytes()

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")


def executing(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options of every verb that executes a plan."""
    options = [
        click.option("--workers", type=click.IntRange(1), default=None, help="Tiles computed at once [all cores]."),
        click.option(
            "--executor",
            default="threads",
            show_default=True,
            metavar="KIND",
            help="threads, processes, or a Dask scheduler's address tcp://host:port.",
        ),
        click.option("--memory", type=BYTES, default=None, metavar="SIZE", help="Stay under this, e.g. 2GB."),
        click.option("--overwrite", is_flag=True, help="Replace products that exist."),
        click.option("--no-quicklook", is_flag=True, help="Do not write overview.png."),
        json_option,
        click.option("-q", "--quiet", is_flag=True, help="No talk on stderr."),
    ]
    for option in reversed(options):
        command = option(command)
    return command
