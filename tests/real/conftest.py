"""Orthophotos of real images, made once for all tests, through the Python API."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from tools.kept import kept
from tools.real_projects import dmc_project, drone_project

from photoplan.io.project.file import load_project
from photoplan.products.orthophoto.execution import Run, execute
from photoplan.products.orthophoto.plan import plan_orthophotos


def make_orthos(project_folder: Path, images: Sequence[str] | None, resolution: float) -> list[Path]:
    """Orthophotos of a project's images (all if None), GeoTIFFs in the order of the images."""
    project = load_project(project_folder / "project.toml")
    plan = plan_orthophotos(project, images, resolution=resolution, overviews=False)
    results = execute(plan, project_folder / "products", Run(workers=2, quicklook=False))
    assert not any(result.failed for result in results)
    return [result.path for result in results]


def kept_orthos(name: str, make: Callable[[Path], list[Path]], data: Path) -> list[Path]:
    """What `make` makes in a folder, kept from run to run."""

    def listed(folder: Path) -> None:
        paths = make(folder)
        (folder / "order.txt").write_text("\n".join(str(path.relative_to(folder)) for path in paths))

    folder = kept(name, listed, ["photoplan.products.orthophoto.execution", "photoplan.kernels.rectify"], [data])
    return [folder / line for line in (folder / "order.txt").read_text().split("\n")]


@pytest.fixture(scope="session")
def brighton(block: Path) -> list[Path]:
    """The drone block at 0.1 m, all 18 images."""

    def make(folder: Path) -> list[Path]:
        drone_project(block, folder)
        return make_orthos(folder, None, 0.1)

    return kept_orthos("brighton-orthos", make, block)


@pytest.fixture(scope="session")
def thirds(block: Path) -> list[Path]:
    """Every third image of it."""

    def make(folder: Path) -> list[Path]:
        project = drone_project(block, folder)
        names = [image.name for image in load_project(project).images]
        return make_orthos(folder, names[1::3], 0.1)

    return kept_orthos("brighton-thirds", make, block)


@pytest.fixture(scope="session")
def ngi(shared: Path) -> list[Path]:
    """The four DMC frames at 5 m."""

    def make(folder: Path) -> list[Path]:
        dmc_project(shared, folder)
        return make_orthos(folder, None, 5.0)

    return kept_orthos("ngi-orthos", make, shared / "data" / "ngi_dmc")
