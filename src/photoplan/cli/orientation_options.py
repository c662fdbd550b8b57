"""Options of the verbs that read orientation files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
DIRECTIONS = ["camera-to-ground", "ground-to-camera"]


def reading_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options that say what an orientation file does not say of itself."""
    options = [
        click.option("--format", "format", metavar="FORMAT", help="Format of the orientation file [by its content]."),
        click.option("--columns", help="Columns of a table: name,x,y,z,omega,phi,kappa[,camera] or name=LABEL,x=…"),
        click.option("--delimiter", type=click.Choice([*_DELIMITERS]), help="Of a table [found by itself]."),
        click.option("--decimal-comma", is_flag=True, help="Numbers of a table are written 1,5."),
        click.option("--angle-unit", type=click.Choice(["deg", "gon", "rad"]), help="[deg, or the format's own]"),
        click.option(
            "--rotation",
            type=click.Choice(["opk", "pok", "kpo", "kop", "okp", "pko"]),
            help="Order of omega, phi, kappa; the first is primary [opk, or the format's own].",
        ),
        click.option(
            "--rotation-direction",
            "direction",
            type=click.Choice(DIRECTIONS),
            help="What the file's rotation does [camera-to-ground; some formats have to be told].",
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def table_format(options: dict[str, Any]) -> Any:
    """TableFormat of `reading_options`, which are taken out of `options`."""
    from photoplan.io.orientation.table import TableFormat

    names = ("angle_unit", "rotation", "direction")
    given = {name: value for name in names if (value := options.pop(name)) is not None}
    sign: Any = _DELIMITERS.get(options.pop("delimiter") or "")
    return TableFormat(options.pop("columns"), sign, options.pop("decimal_comma"), **given, declared=frozenset(given))
