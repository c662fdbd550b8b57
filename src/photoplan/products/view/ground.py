"""What a view is of: the ground of a project, or a terrain model alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from photoplan.errors import InputError, UsageError
from photoplan.geometry.bounds import odd_place
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.project.ground import ground_of
from photoplan.project.open_terrain import open_terrain
from photoplan.project.scene import input_files
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.flooded import flooded
from photoplan.surfaces.objects import ObjectSurface, painted_surface


@dataclass(frozen=True, eq=False)
class ViewGround:
    """Terrain, and the project that it belongs to if there is one."""

    terrain: Terrain
    """With the objects that are painted."""
    bounds: tuple[float, float, float, float] | None
    """Outer edges of the terrain; None: it has no end."""
    crs: str
    height_system: str | None
    """That of all heights; None: not stated."""
    project: Project | None
    files: tuple[Path, ...]
    """That decide the ground."""
    water: float | None = None
    """Height of water that covers what is lower, metres; the terrain has it in it."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects, by their numbers from one."""
        return self.terrain.faces.names if isinstance(self.terrain, ObjectSurface) else ()

    @property
    def named(self) -> Project:
        """The project."""
        if self.project is None:
            raise UsageError("a terrain model has no images; give a project, or a standpoint `position`")
        return self.project


def open_view_ground(path: Path, crs: str | None = None, water: float | None = None) -> ViewGround:
    """The ground of a project file (``.toml``) or of a terrain model."""
    ground = _dry_ground(path, crs)
    if water is None:
        return ground
    odd = odd_place((math.nan, math.nan, water), camera=False)
    if odd or not math.isfinite(water):
        raise UsageError(f"`water`: {odd or f'{water}; a height in metres is needed'}")
    return replace(ground, terrain=flooded(ground.terrain, water, ground.bounds), water=water)


def _dry_ground(path: Path, crs: str | None) -> ViewGround:
    if path.suffix.lower() != ".toml":
        model = open_terrain(path, crs, "with `crs` EPSG:nnnn")
        return ViewGround(
            terrain=model.surface,
            bounds=model.bounds,
            crs=model.crs,
            height_system=model.height_system,
            project=None,
            files=(model.path,),
        )
    if not path.is_file():
        raise InputError(f"{path}: is no file; give a project.toml or a terrain model")
    project = load_project(path)
    ground = ground_of(project)
    images = {project.resolve(image.file) for image in project.images}
    files = [file for file in input_files(project) if file not in images and file.is_file()]
    return ViewGround(
        terrain=painted_surface(ground.surface),
        bounds=ground.bounds,
        crs=project.crs,
        height_system=ground.working_system,
        project=project,
        files=tuple(dict.fromkeys([path, *files])),
    )
