"""`photoplan demo`: the whole job on the real block that the package brings along."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import click

from photoplan.cli.options import FOLDER, quiet_option


@click.command("demo")
@click.argument("folder", type=FOLDER, default=Path("photoplan-demo"))
@click.option("--resolution", type=float, default=0.1, show_default=True, help="Ground pixel in metres.")
@quiet_option
def command(folder: Path, resolution: float, quiet: bool) -> None:
    """Copy the included drone block (18 reduced images of Brighton Beach) to FOLDER and make its orthophotos.

    Every step is the command that you would call yourself; it is printed before it runs.
    """
    import shutil

    from photoplan.cli import running
    from photoplan.engine.executors import available_cpus
    from photoplan.io.project.file import load_project
    from photoplan.products.check import check_project
    from photoplan.products.init.run import InitRequest, init_project
    from photoplan.products.orthophoto.plan import plan_orthophotos

    how = running.How(
        workers=available_cpus(),
        executor="threads",
        memory=None,
        overwrite=True,
        quicklook=True,
        as_json=False,
        quiet=quiet,
    )
    data = folder / "data"
    with as_file(files("photoplan") / "demo_block") as block:
        shutil.copytree(block, data, dirs_exist_ok=True)
    with running.telling(how) as events:
        events.talk(
            f"$ photoplan init {folder} --images '{data}/images/*.jpg' --camera {data}/int.yaml "
            f"--orientation {data}/ext.csv --terrain {data}/dsm.tif --height-system same"
        )
        request = InitRequest(
            folder=folder,
            images=(str(data / "images" / "*.jpg"),),
            camera=data / "int.yaml",
            orientation=data / "ext.csv",
            terrain=str(data / "dsm.tif"),
            height_system="same",
            overwrite=True,
        )
        project = init_project(request, lambda line: events.talk(f"  {line}")).path
        events.talk(f"$ photoplan check {project}")
        loaded = load_project(project)
        events.talk(str(check_project(loaded)))
        events.talk(f"$ photoplan ortho {project} --resolution {resolution:g}")
        plan = plan_orthophotos(loaded, resolution=resolution, events=events)
        running.execute_and_report(plan, folder / "products", how, events)
