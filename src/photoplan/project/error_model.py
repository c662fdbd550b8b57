"""Stated standard deviations of a project's inputs: orientation, cameras, terrain, objects."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Projection
from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.files import fingerprint
from photoplan.io.project.file import parse_project
from photoplan.io.project.model import Deviation, ImageEntry, Project
from photoplan.plan.accuracy import DepthErrors, IndependentError, SourceErrors
from photoplan.project.cameras import camera_of
from photoplan.project.ground import Ground, ground_of, open_relief, open_terrain
from photoplan.project.scene import SceneAddress, ScenesAddress, on_target, surface_of
from photoplan.surfaces.hybrid import HeightErrors, RasterHeightErrors, StatedHeightErrors
from photoplan.surfaces.objects import ObjectSurface
from photoplan.targets.map import Target

#: Cameras are moved by so many standard deviations: far above rounding, and small where an angle is badly known.
_STEP = 1 / 16
#: Metres beyond which a standard deviation of heights says nothing.
_MOST_DEVIATION = 1e6


def source_errors(
    project: Project, image: ImageEntry, ground: Ground, projection: Projection, in_image: float
) -> SourceErrors:
    """Errors of an image as the project states them; `ground` is the terrain, also if products lie on a target."""

    def at(change: NDArray[np.float64]) -> Projection:
        moved, cameras = image.moved(change, project.cameras)
        there = project.model_copy(update={"cameras": cameras})
        return on_target(project, camera_of(there, moved, ground, projection.size))

    known = _deviations(project, image)
    causes = (IndependentError(name, at(_STEP * d), at(-_STEP * d), _STEP) for name, d in known)
    # What is moved by nothing is what the others are compared with: tremor that they leave out is in none of them.
    return SourceErrors(at(0.0 * known[0][1]) if known else projection, tuple(causes), in_image)


def _deviations(project: Project, image: ImageEntry) -> tuple[Deviation, ...]:
    return image.deviations(project.cameras, project.orientation.rotation)


@dataclass(frozen=True)
class ScenesErrors(Mapping[int, SourceErrors]):
    """What is known of the errors of some images over one ground; made from it where it is opened."""

    address: ScenesAddress
    """Of the images, in the order of the table of sources."""
    in_image: tuple[float, ...]
    """Standard deviation of image coordinates of each, pixels."""

    @property
    def facts(self) -> list[object]:
        """What decides accuracies, beside what decides pixels."""
        _heights_of(self.address)
        out: list[object] = []
        for scene in self.address.scenes:
            project = _project_of(scene)
            image = project.any_image(project.images[0].name)
            camera = image.described_by
            known = [(name, d.tolist()) for name, d in _deviations(project, image)]
            of_camera = None if camera is None else project.cameras[camera].sigma
            objects = [part.sigma for part in project.objects]
            sigma = project.ground.sigma if project.target is None else project.target.sigma
            ground = fingerprint(project.resolve(sigma)).digest if isinstance(sigma, str) else sigma
            out.append([known, of_camera, ground, *objects])
        return [out, list(self.in_image)]

    @property
    def sources(self) -> Mapping[int, SourceErrors]:
        """By row of the table of sources."""
        return self

    @property
    def depth(self) -> DepthErrors:
        """Of the ground and its objects."""
        return _heights_of(self.address)

    def open(self) -> ScenesErrors:
        """Itself: what it opens is kept."""
        return self

    def __getitem__(self, row: int) -> SourceErrors:
        if not 0 <= row < len(self):
            raise KeyError(row)
        return _errors_of(self.address.scenes[row], self.in_image[row])

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self)))

    def __len__(self) -> int:
        return len(self.address.scenes)


def _project_of(address: SceneAddress) -> Project:
    return parse_project(json.loads(address.text), Path(address.folder), "project")


@lru_cache(maxsize=64)
def _errors_of(address: SceneAddress, in_image: float) -> SourceErrors:
    scene, project = address.open(), _project_of(address)
    image = project.any_image(project.images[0].name)
    return source_errors(project, image, ground_of(project), scene.camera, in_image)


@lru_cache(maxsize=8)
def _heights_of(address: ScenesAddress) -> DepthErrors:
    project, surface = _project_of(address.scenes[0]), surface_of(address)
    if not isinstance(surface, ObjectSurface):
        return height_errors(project)
    ground = height_errors(project) if surface.shows_ground else StatedHeightErrors(np.nan)
    return ground if surface.shown is None else object_errors(project, surface, ground)


@dataclass(frozen=True, eq=False)
class ObjectHeightErrors:
    """Standard deviations of objects where they are shown, and of the ground elsewhere.

    What a face truly looks like at a place is moved as a whole: by its height, and down its slope by its position.
    """

    surface: ObjectSurface
    of_face: NDArray[np.float64]
    """Standard deviation of the height at a place of each face that is shown, shape (n,), metres."""
    ground: DepthErrors

    def __call__(self, target: Target, window: Window) -> NDArray[np.floating]:
        """See `photoplan.plan.accuracy.DepthErrors`."""
        face = self.surface.top(target, window)[1]
        return np.where(face < 0, self.ground(target, window), self.of_face[face])


def object_errors(project: Project, surface: ObjectSurface, ground: DepthErrors) -> ObjectHeightErrors:
    """Errors of the objects that a surface shows, as [[objects]] state them."""
    faces = surface.shown
    assert faces is not None
    entry = np.array(surface.entries)[faces.owner]
    for place in np.unique(entry):
        if project.objects[place].sigma is None:
            raise InputError(
                f"nothing is known of the accuracy of the objects in {project.objects[place].file}: state sigma = "
                "[HORIZONTAL, HEIGHT], metres, in [[objects]]"
            )
    position, height = np.array([part.sigma or (np.nan, np.nan) for part in project.objects])[entry].T
    a, b, c = np.moveaxis(faces.corners, 1, 0)
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.hypot(normal[:, 0], normal[:, 1]) / np.abs(normal[:, 2])
        of_face = np.hypot(height, np.where(position > 0, position * slope, 0.0))
    return ObjectHeightErrors(surface, of_face, ground)


def height_errors(project: Project) -> HeightErrors:
    """Standard deviations of a project's terrain; see `known_height_errors`."""
    found = known_height_errors(project)
    if found is None and project.target is not None:
        raise InputError(
            "nothing is known of the accuracy of the target's surface: set `relief_sigma` to metres or to a raster of "
            "standard deviations (`photoplan surface` writes NAME_sigma.tif), or sigma in [targets.NAME]"
        )
    if found is None:
        raise InputError(
            "nothing is known of the accuracy of the terrain's heights: state sigma = METRES in [terrain], or a raster "
            "of standard deviations, or take a terrain model of `photoplan dtm build`, which holds them"
        )
    if isinstance(project.ground.sigma, float) and project.ground.sigma > _MOST_DEVIATION:
        raise InputError(f"[terrain]: sigma of {project.ground.sigma:.3g} m is no accuracy of heights")
    return found


def known_height_errors(project: Project) -> HeightErrors | None:
    """Standard deviations of a project's terrain, in its CRS: what [terrain] states, a number or a raster of them, or
    else what the terrain model holds; None: nothing is known."""
    if project.target is not None:
        sigma = project.target.sigma
        if isinstance(sigma, str):
            return RasterHeightErrors(open_relief(project.resolve(sigma))[0].surface)
        return None if sigma is None else StatedHeightErrors(sigma)
    terrain = project.ground
    if isinstance(terrain.sigma, str):
        beside, _ = open_terrain(project.resolve(terrain.sigma), default_crs=terrain.crs).in_crs(project.crs)
        return RasterHeightErrors(beside.surface)
    if terrain.sigma is not None:
        return StatedHeightErrors(terrain.sigma)
    if terrain.file is None:
        return None
    return (
        open_terrain(project.resolve(terrain.file), terrain.crs, height_system=terrain.height_system)
        .in_crs(project.crs)[0]
        .errors
    )
