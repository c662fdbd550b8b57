"""`photoplan info`: what a file holds."""

from __future__ import annotations

import json
from pathlib import Path

import click

from photoplan.cli.options import json_option

__all__ = ["command"]


@click.command("info")
@click.argument("file", type=click.Path(path_type=Path))
@json_option
def command(file: Path, as_json: bool) -> None:
    """Show what FILE holds: a raster, a terrain model, a project, a plan or a run record."""
    from photoplan.products.describe import describe

    facts = describe(file)
    if as_json:
        click.echo(json.dumps(facts, indent=2))
        return
    width = max(len(key) for key in facts)
    for key, value in facts.items():
        lines = value if isinstance(value, list) else [value]
        for i, line in enumerate(lines):
            click.echo(f"{key if i == 0 else '':<{width}}  {line}")
