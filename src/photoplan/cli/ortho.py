"""`photoplan ortho`: orthophotos of a project."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import bounds_option, dry_run_option, executing, images_option


@click.command("ortho")
@click.argument("project", type=click.Path(path_type=Path))
@images_option()
@click.option("--resolution", type=float, metavar="R", help="Ground pixel in metres [the images' mean GSD].")
@bounds_option
@click.option("--kernel", help="nearest, bilinear, bicubic, bicubic-1 or lanczos3 [bicubic].")
@click.option("--tolerance", type=float, metavar="PX", help="Largest residual of the anchors [0.02].")
@click.option("--hidden", help="Ground that the image cannot see: show, nodata, or mark (second raster) [show].")
@click.option("--compress", help="deflate, zstd, lzw, jpeg or none [deflate].")
@click.option("--nodata", help="A number, mask, or auto: 0 for integers, NaN for floats [auto].")
@click.option("--overviews/--no-overviews", default=None, help="Whether the file holds overviews [yes].")
@click.option("--tile", type=int, metavar="PX", help="Side of a tile [512].")
@click.option("--output", type=click.Path(path_type=Path), help="Folder of the products [PROJECT's folder/products].")
@click.option("--force", is_flag=True, help="Also of orientations with a FAULT, and finer than a quarter of the GSD.")
@click.option("--plan", "plan_file", type=click.Path(path_type=Path), help="Write the plan (GeoPackage) and stop.")
@dry_run_option("Compile the plan, print it, and stop.")
@executing
def command(
    project: Path,
    images: tuple[str, ...],
    output: Path | None,
    plan_file: Path | None,
    dry_run: bool,
    **options: Any,
) -> None:
    """Make an orthophoto of each image: NAME_ortho.tif (a cloud-optimised GeoTIFF) and its run record.

    The same command continues a run that was interrupted.
    """
    from photoplan.cli import running
    from photoplan.io.project.file import load_project
    from photoplan.products.orthophoto.plan import plan_orthophotos

    how = running.How.from_options(options)
    with running.telling(how) as events:
        loaded = load_project(project)
        changes = {k: v for k, v in options.items() if v is not None and v != ()}
        plan = plan_orthophotos(loaded, images or None, events=events, **changes)
        folder = output or loaded.folder / "products"
        if dry_run or plan_file is not None:
            # Here, since plans as files need a library for vector data that a product does not: 30 MB of memory.
            from photoplan.cli.show_plan import show_plan

            show_plan(plan, folder, plan_file, how, events)
        else:
            running.execute_and_report(plan, folder, how, events)
