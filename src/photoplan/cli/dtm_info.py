"""`photoplan dtm info`: what a terrain model holds."""

from __future__ import annotations

from pathlib import Path

import click

from photoplan.cli.options import PATH, ending
from photoplan.cli.output import show, show_json


@click.command("info")
@click.argument("model", type=PATH)
@click.option("--gross", is_flag=True, help="List the measurements that were flagged as gross errors, and suspects.")
@ending(overwrite=False)
def command(model: Path, gross: bool, as_json: bool, quiet: bool) -> None:
    """Show the figures of MODEL: units, lines, accuracy, gross errors. A raster is shown as by `photoplan info`."""
    from photoplan.products.describe import dtm_info

    found = dtm_info(model)
    if as_json:
        show_json(found.figures | ({"gross_errors": found.gross, "suspect_points": found.suspects} if gross else {}))
        return
    width = max(len(key) for key in found.facts)
    for key, value in found.facts.items():
        lines = value if isinstance(value, list) else [value]
        for i, line in enumerate(lines):
            show(f"{key if i == 0 else '':<{width}}  {line}")
    flagged = [("", g) for g in found.gross] + [("suspect: ", g) for g in found.suspects]
    for what, g in flagged if gross else ():
        show(
            f"{what}{g['name']}  {g['kind']}  X {g['x']:.3f} Y {g['y']:.3f} Z {g['z']:.3f}  "
            f"residual {g['residual']:+.3f} m ({g['normalised']:+.1f} σ, redundancy {g['redundancy']:.2f})"
        )
