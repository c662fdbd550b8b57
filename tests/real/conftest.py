"""Orthophotos of real images, made once per session through the Python API."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
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


@pytest.fixture(scope="session")
def brighton(block: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The drone block at 0.1 m, all 18 images."""
    folder = tmp_path_factory.mktemp("brighton")
    drone_project(block, folder)
    return make_orthos(folder, None, 0.1)


@pytest.fixture(scope="session")
def ngi(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The four DMC frames at 5 m."""
    folder = tmp_path_factory.mktemp("ngi")
    dmc_project(shared, folder)
    return make_orthos(folder, None, 5.0)
