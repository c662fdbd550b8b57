"""`photoplan info`: what a file holds."""

from __future__ import annotations

from pathlib import Path

import click

from photoplan.cli.options import PATH, ending
from photoplan.cli.output import show, show_json


@click.command("info")
@click.argument("file", type=PATH)
@click.option("--plot", type=PATH, metavar="PICTURE", help="Draw a restoration filter as PNG.")
@ending()
def command(file: Path, plot: Path | None, overwrite: bool, as_json: bool, quiet: bool) -> None:
    """Show what FILE holds: any file that a command takes or makes, or a folder of images."""
    from photoplan.products.describe import describe, readable

    if plot is not None:
        from photoplan.report.restore import draw_filter

        draw_filter(file, plot, overwrite=overwrite)
    facts = describe(file)
    if plot is not None:
        facts["picture"] = str(plot)
    if as_json:
        show_json(facts)
        return
    width = max(len(key) for key in facts)
    for key, value in facts.items():
        value = readable(value)
        lines = value if isinstance(value, list) else [value]
        for i, line in enumerate(lines):
            show(f"{key if i == 0 else '':<{width}}  {line}")
