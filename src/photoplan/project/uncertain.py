"""What a project knows of its own errors: orientations, cameras, terrain."""

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
from photoplan.io.camera.model import CameraEntry
from photoplan.io.fingerprint import fingerprint
from photoplan.io.project.file import parse_project
from photoplan.io.project.image import ImageEntry
from photoplan.io.project.model import Project
from photoplan.io.project.posed import Image
from photoplan.plan.accuracy import DepthErrors, IndependentError, SourceErrors
from photoplan.project.cameras import camera_of
from photoplan.project.ground import Ground
from photoplan.project.open_terrain import open_terrain
from photoplan.project.posed import posed_camera
from photoplan.project.scene import SceneAddress
from photoplan.project.scenes import ScenesAddress, surface_of
from photoplan.surfaces.height_errors import HeightErrors, RasterHeightErrors, StatedHeightErrors
from photoplan.surfaces.objects import ObjectSurface
from photoplan.targets.base import Target

#: Cameras are moved by so many standard deviations: far above rounding, and small where an angle is badly known.
_STEP = 1 / 16
#: Metres (or units of an angle or a camera's parameter) beyond which a standard deviation says nothing.
_MOST_DEVIATION = 1e6
_ANGLES = {"o": "omega", "p": "phi", "k": "kappa"}


def source_errors(
    project: Project, image: ImageEntry, ground: Ground, projection: Projection, in_image: float
) -> SourceErrors:
    """Errors of an image as the project states them.

    Parameters
    ----------
    ground : Ground
        The project's.
    projection : Projection
        The image's camera.
    in_image : float
        Standard deviation of image coordinates, pixels.

    Raises
    ------
    InputError
        The project states no standard deviations of the image's orientation, or such of the camera that do not fit.
    """
    if not isinstance(image, Image):

        def by_entry(change: NDArray[np.float64]) -> Projection:
            return camera_of(project, image.moved(change), ground, projection.size)

        found = (
            IndependentError(name, by_entry(_STEP * d), by_entry(-_STEP * d), _STEP) for name, d in image.deviations
        )
        return SourceErrors(projection, tuple(found), in_image)
    camera = project.cameras[image.camera]

    def at(change: NDArray[np.float64]) -> Projection:
        moved, entry = _moved(image, camera, change)
        changed = project.model_copy(update={"cameras": {**project.cameras, image.camera: entry}})
        return posed_camera(changed, moved, ground, projection.size)

    causes = (
        IndependentError(name, at(_STEP * d), at(-_STEP * d), _STEP) for name, d in _deviations(project, image, camera)
    )
    return SourceErrors(projection, tuple(causes), in_image)


def _deviations(project: Project, image: Image, camera: CameraEntry) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Independent errors of centre, angles and camera, each one standard deviation large, with their names."""
    if image.sigma_center is None or image.sigma_angles is None:
        raise InputError(
            f"image {image.name!r}: nothing is known of the accuracy of its orientation; `photoplan adjust` and "
            "`resect` write sigma_center and sigma_angles, or state them in [[images]]"
        )
    of_camera = camera.sigma or {}
    sigma = np.array([*image.sigma_center, *image.sigma_angles, *of_camera.values()])
    if sigma.max() > _MOST_DEVIATION:
        raise InputError(
            f"image {image.name!r}: a standard deviation of {sigma.max():.3g} in orientation or camera is no accuracy"
        )
    angles = (_ANGLES[letter] for letter in project.orientation.rotation)
    names = ["X0", "Y0", "Z0", *angles, *(f"camera {name}" for name in of_camera)]
    given = np.array(image.correlation or (), float)
    joined = {0: 0, 15: 6, len(sigma) * (len(sigma) - 1) // 2: len(sigma)}.get(len(given))
    if joined is None:
        raise InputError(
            f"image {image.name!r}: correlation has {len(given)} numbers; 15 for centre and angles, or "
            f"{len(sigma) * (len(sigma) - 1) // 2} for them and the {len(of_camera)} parameters of its camera"
        )
    R = np.eye(len(sigma))
    R[:joined, :joined][np.tril_indices(joined, -1)] = given
    values, axes = np.linalg.eigh(np.tril(R) + np.tril(R, -1).T)
    if joined and values[0] < -1e-3:
        raise InputError(f"image {image.name!r}: correlation is that of no covariance; `photoplan adjust` writes it")
    together = "orientation" if joined <= 6 else "orientation and camera"
    for value, axis in zip(values, axes.T):
        k = int(np.argmax(np.abs(axis)))
        yield (together if k < joined else names[k]), axis * np.sqrt(max(value, 0.0)) * sigma


def _moved(image: Image, camera: CameraEntry, change: NDArray[np.float64]) -> tuple[Image, CameraEntry]:
    """An image and its camera with other centre, angles and camera parameters."""
    center, angles = (np.array(part) for part in image.pose_numbers)
    update = {"center": tuple(center + change[:3]), "angles": tuple(angles + change[3:6])}
    lens = {}
    entries: dict[str, object] = {}
    by_name = dict(zip(camera.sigma or {}, change[6:].tolist()))
    for name, d in by_name.items():
        if name == "c" and camera.camera_constant_mm is not None:
            entries["camera_constant_mm"] = camera.camera_constant_mm + d
        elif name == "c" and camera.pixels is not None:
            fx, fy = camera.pixels.focal
            entries["focal_px"] = (fx + d, fy * (fx + d) / fx)
        elif name in type(camera.lens).model_fields and isinstance(getattr(camera.lens, name), float):
            lens[name] = getattr(camera.lens, name) + d
        elif name not in ("x0", "y0"):
            raise InputError(
                f"camera {image.camera!r}: sigma of {name!r}; allowed are c, x0, y0 and what its lens states"
            )
    d_point = np.array([by_name.get("x0", 0.0), by_name.get("y0", 0.0)])
    if d_point.any() and camera.states_pixels and camera.pixels is not None:
        entries["principal_point_px"] = tuple(camera.pixels.point + d_point)
    elif d_point.any():
        entries["principal_point_mm"] = tuple((camera.principal_point_mm or (0.0, 0.0)) + d_point)
    if lens:
        entries["lens"] = camera.lens.model_copy(update=lens)
    return image.model_copy(update=update), camera.model_copy(update=entries)


@dataclass(frozen=True)
class ScenesErrors(Mapping[int, SourceErrors]):
    """What is known of the errors of some images over one ground; made from it where it is opened."""

    address: ScenesAddress
    """Of the images, in the order of the table of sources."""
    in_image: tuple[float, ...]
    """Standard deviation of image coordinates of each, pixels."""

    @property
    def facts(self) -> list[object]:
        """What decides accuracies, beside what decides pixels.

        Raises
        ------
        InputError
            Nothing is known of the terrain, of objects or of an image.
        """
        _heights_of(self.address)
        out: list[object] = []
        for scene in self.address.scenes:
            project = _project_of(scene)
            image = project.any_image(project.images[0].name)
            known: list[object] = []
            if isinstance(image, Image):
                camera = project.cameras[image.camera]
                known = [[(name, d.tolist()) for name, d in _deviations(project, image, camera)], camera.sigma]
            else:
                known = [[(name, d.tolist()) for name, d in image.deviations], None]
            objects = [part.sigma for part in project.objects]
            sigma = project.ground.sigma
            ground = fingerprint(project.resolve(sigma)).digest if isinstance(sigma, str) else sigma
            out.append([*known, ground, *objects])
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
    return source_errors(project, project.any_image(project.images[0].name), scene.ground, scene.camera, in_image)


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
    """Errors of the objects that a surface shows, as [[objects]] state them.

    Raises
    ------
    InputError
        An entry of objects that are shown states none.
    """
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
    """Standard deviations of a project's terrain; see `known_height_errors`.

    Raises
    ------
    InputError
        Nothing is known.
    """
    found = known_height_errors(project)
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
    terrain = project.ground
    if isinstance(terrain.sigma, str):
        beside, _ = open_terrain(project.resolve(terrain.sigma), terrain.crs).in_crs(project.crs)
        return RasterHeightErrors(beside.surface)
    if terrain.sigma is not None:
        return StatedHeightErrors(terrain.sigma)
    if terrain.file is None:
        return None
    return open_terrain(project.resolve(terrain.file), terrain.crs).in_crs(project.crs)[0].errors
