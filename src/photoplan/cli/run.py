"""`photoplan run`: execute a plan that was looked at."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import NEW_FOLDER, PATH, executing
from photoplan.errors import UsageError


@click.command("run")
@click.argument("plan", type=PATH)
@click.option("-o", "--output", type=NEW_FOLDER, help="Folder of the products [as planned].")
@executing
def command(plan: Path, output: Path | None, **options: Any) -> None:
    """Execute PLAN, a GeoPackage written by `photoplan ortho PROJECT --plan PLAN`.

    Inputs that have changed since it was written are refused.
    """
    from photoplan.cli import running
    from photoplan.products.orthophoto.plan_file import read_plan

    how = running.How.from_options(options)
    with running.telling(how) as events:
        loaded, folder = read_plan(plan)
        folder = output or folder
        if folder is None:
            raise UsageError(f"{plan}: states a folder of products outside its own folder; give `output`")
        running.execute_and_report(loaded, folder, how, events)
