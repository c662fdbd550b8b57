"""`photoplan demo`: the whole job on the real block that the package brings along."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import click

__all__ = ["command"]


@click.command("demo")
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False), default=Path("photoplan-demo"))
@click.option("--resolution", type=float, default=0.1, show_default=True, help="Ground pixel in metres.")
@click.option("-q", "--quiet", is_flag=True, help="No talk on stderr.")
def command(folder: Path, resolution: float, quiet: bool) -> None:
    """Copy the included drone block (18 images of Brighton Beach) to FOLDER and make its orthophotos.

    Every step is the command that you would call yourself; it is printed before it runs.
    """
    import shutil

    from photoplan.cli import running
    from photoplan.io.project import load_project
    from photoplan.products.check import check_project
    from photoplan.products.init import init_project
    from photoplan.products.orthophoto import plan_orthophotos

    how = running.How.plain(quiet)
    data = folder / "data"
    with as_file(files("photoplan") / "demo_block") as block:
        shutil.copytree(block, data, dirs_exist_ok=True)
    project = folder / "project.toml"
    how.talk(
        f"$ photoplan init {folder} --images '{data}/images/*.jpg' --camera {data}/int.yaml "
        f"--orientation {data}/ext.csv --terrain {data}/dsm.tif --height-system same"
    )
    raise NotImplementedError
