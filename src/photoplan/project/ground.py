"""The ground of a project: terrain and objects, in the system that its cameras work in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import CrsStep
from photoplan.geometry.heights import HeightStep, declared_pair, height_step
from photoplan.geometry.units import metric_heights
from photoplan.io.names import resolve_input
from photoplan.io.project.model import Objects, Project, StatedTerrain
from photoplan.project.open_terrain import open_terrain
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.level import LevelSurface
from photoplan.surfaces.objects import ObjectSurface, without_objects
from photoplan.surfaces.shifted import ShiftedSurface


@dataclass(frozen=True, eq=False)
class Ground:
    """The terrain of a project with its objects, in the project's CRS and the orientation's height system."""

    surface: Terrain
    """With objects: an `ObjectSurface` if there are some."""
    bounds: tuple[float, float, float, float] | None
    """Outer edges xmin, ymin, xmax, ymax; None: everywhere."""
    file: Path | None
    """The height raster or terrain model."""
    operations: tuple[CrsStep | HeightStep, ...]
    """Coordinate operations on the way from the file, for the run record."""
    height_systems: tuple[str, str]
    """Those of the terrain file and of the orientation, as declared or read."""
    working_system: str
    """The one that surface and cameras are in."""

    @property
    def bare(self) -> Terrain:
        """The surface without objects."""
        return without_objects(self.surface)

    def into_working(self, crs: str, stated: str | None = None) -> HeightStep:
        """From heights in a stated system, else the orientation's, to those of surface and cameras, at points of the
        project's CRS."""
        return height_step(stated or self.height_systems[1], self.working_system, crs, self.bounds)

    def out_of_working(self, crs: str) -> HeightStep:
        """Back again, as whoever states heights in a project, or reads them, expects them."""
        return height_step(self.working_system, self.height_systems[1], crs, self.bounds)

    def is_open(self, XY: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether no object stands at map points (..., 2) or hangs over them, shape (...)."""
        if not isinstance(self.surface, ObjectSurface):
            return np.ones(XY.shape[:-1], bool)
        return np.isneginf(self.surface.faces.heights(XY))


@dataclass(frozen=True)
class _GroundAddress:
    """What decides the ground of a project; hashable."""

    terrain: StatedTerrain
    orientation_system: str | None
    to_ellipsoid: bool
    crs: str
    folder: str
    stamps: tuple[tuple[int, int], ...]
    """Size and time of each file: files that change are opened again."""
    objects: tuple[Objects, ...] = ()


def ground_of(project: Project) -> Ground:
    """The terrain of a project with its objects, in the project's CRS and the height system that the cameras
    work in.
    """
    orientation = project.orientation
    strict = orientation.earth_curvature == "strict"
    files = [*([] if project.ground.file is None else [project.ground.file]), *(o.file for o in project.objects)]
    stamps = tuple(stamp_of(project.resolve(file)) for file in files)
    folder = str(project.folder)
    return _ground(
        _GroundAddress(
            terrain=project.ground,
            orientation_system=project.height_system,
            to_ellipsoid=strict,
            crs=project.crs,
            folder=folder,
            stamps=stamps,
            objects=project.objects,
        )
    )


@lru_cache(maxsize=8)
def _ground(address: _GroundAddress) -> Ground:
    if address.objects:
        # A project without objects does not need the libraries of vector data.
        from photoplan.project.objects import Place, with_objects  # noqa: PLC0415

        bare = _ground(replace(address, objects=(), stamps=address.stamps[: -len(address.objects)]))
        place = Place(address.crs, bare.working_system, bare.height_systems[0], bare.bounds)
        files = [(resolve_input(Path(address.folder), stated.file), stated) for stated in address.objects]
        surface, steps = with_objects(bare.surface, files, place)
        return replace(bare, surface=surface, operations=(*bare.operations, *steps))
    terrain = address.terrain
    if terrain.height is not None:
        systems = declared_pair(terrain.height_system, address.orientation_system)
        return _in_system(
            Ground(
                surface=LevelSurface(terrain.height * metric_heights(terrain.height_system or "same")[1]),
                bounds=None,
                file=None,
                operations=(),
                height_systems=systems,
                working_system=systems[1],
            ),
            address,
        )
    assert terrain.file is not None
    path = resolve_input(Path(address.folder), terrain.file)
    own = open_terrain(path, terrain.crs, 'as crs = "EPSG:nnnn" in [terrain]', terrain.height_system)
    systems = declared_pair(terrain.height_system or own.height_system, address.orientation_system)
    placed, steps = own.in_crs(address.crs)
    return _in_system(
        Ground(
            surface=placed.surface,
            bounds=placed.bounds,
            file=placed.path,
            operations=steps,
            height_systems=systems,
            working_system=systems[1],
        ),
        address,
    )


def _in_system(ground: Ground, address: _GroundAddress) -> Ground:
    """The ground with heights in the system that the cameras work in."""
    terrain, orientation = ground.height_systems
    wanted = "ellipsoidal" if address.to_ellipsoid and orientation != "same" else orientation
    step = height_step(terrain, wanted, address.crs, ground.bounds)
    if step.definition is None:
        return replace(ground, working_system=wanted)
    surface = ShiftedSurface(ground.surface, _Undulation(step, ground.bounds))
    return replace(ground, surface=surface, operations=(*ground.operations, step), working_system=wanted)


@dataclass(frozen=True)
class _Undulation:
    """What a height step adds at map points.

    Rays and tiles reach beyond the terrain, where the grid of the step may have ended: the next place of the terrain
    counts there. A place inside that the grid does not cover is an error.
    """

    step: HeightStep
    bounds: tuple[float, float, float, float] | None
    """Of the terrain; None: it is everywhere."""

    def __call__(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        XYZ = np.concatenate([XY, np.zeros((*XY.shape[:-1], 1))], axis=-1)
        if self.bounds is None:
            return self.step(XYZ)
        out = self.step.where_defined(XYZ)
        lost = np.isnan(out)
        XYZ[lost, :2] = np.clip(XYZ[lost, :2], self.bounds[:2], self.bounds[2:])
        out[lost] = self.step(XYZ[lost])
        return out


def stamp_of(path: Path) -> tuple[int, int]:
    """Size and time of a file."""
    try:
        state = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check that it is there and readable") from error
    return state.st_size, state.st_mtime_ns
