"""`photoplan demo`: the whole job on the real block that the package brings along."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import click

from photoplan.cli.options import FOLDER, overwrite_option, quiet_option


@click.command("demo")
@click.argument("folder", type=FOLDER, default=Path("photoplan-demo"))
@click.option("--resolution", type=float, default=0.1, show_default=True, help="Ground pixel in metres.")
@overwrite_option
@quiet_option
def command(folder: Path, resolution: float, overwrite: bool, quiet: bool) -> None:
    """Copy the included drone block (18 reduced images of Brighton Beach) to FOLDER and make its orthophotos.

    Every step is the command that you would call yourself; it is printed before it runs. A project, images or products
    in FOLDER that differ from those of the demo stay as they are, unless --overwrite is given.
    """
    from photoplan.cli import running
    from photoplan.engine.executors import available_cpus
    from photoplan.errors import UsageError
    from photoplan.io.disk import make_folder, received
    from photoplan.io.project.file import load_project, project_text
    from photoplan.io.store import write_atomically
    from photoplan.products.check import check_project
    from photoplan.products.init import InitRequest, make_project
    from photoplan.products.orthophoto.plan import plan_orthophotos

    how = running.How(
        workers=available_cpus(),
        executor="threads",
        memory=None,
        overwrite=overwrite,
        quicklook=True,
        as_json=False,
        quiet=quiet,
    )
    data = folder / "data"
    received(folder)

    def put(path: Path, content: bytes) -> bool:
        """Write a file; False if another one is there that must stay."""
        there = path.exists() or path.is_symlink()
        if there and path.is_file() and path.read_bytes() == content:
            return True
        if there and not overwrite:
            return False
        make_folder(path.parent)
        write_atomically(path, content)
        return True

    with as_file(files("photoplan") / "demo_block") as block:
        for source in sorted(path for path in block.rglob("*") if path.is_file() and path.suffix != ".pyc"):
            target = data / source.relative_to(block)
            if not put(target, source.read_bytes()):
                raise UsageError(f"{target}: exists already and differs; choose another folder or give `overwrite`")
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
        )
        made = make_project(request, events)
        # What a demo that was interrupted has written is the same; anything else is somebody's work.
        if not put(made.path, project_text(made.project).encode()):
            raise UsageError(f"{made.path}: exists already and differs; choose another folder or give `overwrite`")
        events.talk(f"$ photoplan check {made.path}")
        loaded = load_project(made.path)
        events.talk(str(check_project(loaded)))
        events.talk(f"$ photoplan ortho {made.path} --resolution {resolution:g}")
        plan = plan_orthophotos(loaded, resolution=resolution, events=events)
        running.execute_and_report(plan, folder / "products", how, events)
