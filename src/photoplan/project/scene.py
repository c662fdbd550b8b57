"""Scenes: camera, ground and pixels of each image of a project, on the map or on a target."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Self, TypeVar, overload

import numpy as np

from photoplan.cameras.base import Camera, tremor_of
from photoplan.cameras.framed import FramedCamera
from photoplan.engine.execute import Source
from photoplan.errors import GeometryError, ImagesLeftOut, InputError
from photoplan.geometry.grid import Window
from photoplan.io.files import fingerprint
from photoplan.io.project.file import parse_project
from photoplan.io.project.model import Image, ImageEntry, Project
from photoplan.io.raster import RasterReader
from photoplan.plan.footprint import Footprint, footprint
from photoplan.project.cameras import camera_of
from photoplan.project.ground import Ground, ground_of, stamp_of, target_ground
from photoplan.project.steps import (
    BalanceStep,
    RestoreStep,
    SteppedReader,
    linearisation_of,
    load_balance,
    load_filter,
    restored,
)
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.objects import ObjectSurface, SingleObject, painted_surface

#: Scenes that are kept open, some 20 kB each: more than the images of a row of a mosaic's tiles.
_KEPT = 2048
#: Side of the windows in which images are read to find those that are damaged.
_READ = 2048
T = TypeVar("T")


@dataclass(frozen=True)
class SceneAddress:
    """All that a worker needs to open a scene: small, hashable, pickles."""

    text: str
    """JSON of a project that holds this image alone."""
    folder: str
    """Folder from which its relative paths start."""
    digests: tuple[tuple[str, str], ...]
    """Path and content digest of each input file."""

    @property
    def facts(self) -> dict[str, Any]:
        """What moves a pixel: numbers of the description and contents of the files; no names, no places, no accuracy.

        Two scenes of equal facts give the same pixels. What is not known to be idle counts.
        """
        project = json.loads(self.text)
        (image,) = project.pop("images")
        camera: dict[str, Any] = next(iter(project.pop("cameras").values()), {})
        restored = image.pop("restore", None) or camera.get("restore")
        camera.pop("restore", None)
        for name in ("name", "file", "balance", "camera", "rpc", "sigma_center", "sigma_angles", "correlation",
                     "covariance", "correction", "mount"):  # fmt: skip
            image.pop(name, None)
        ground = (project["terrain"], *project.get("objects", ()))
        target = project.get("target", {})
        for name in ("frame", "sigma", *(["relief"] if isinstance(target.get("relief"), str) else [])):
            target.pop(name, None)
        idle = [(part, name) for part in ground for name in ("file", "sigma")]
        for entries, name in (*idle, (camera, "sigma")):
            entries.pop(name, None)
        table = None
        if restored is not None:
            # Of a filter and a table the content counts, which is among the digests.
            table = restored["linearisation"] if restored["linearisation"] in ("linear", "srgb") else "table"
        digests = [digest for _, digest in self.digests]
        return {**project, "image": image, "camera": camera, "linearisation": table, "files": digests}

    def open(self) -> Scene:
        """The scene; kept for the next tile."""
        return _open(self)


@dataclass(frozen=True, eq=False)
class Scene:
    """One image with its camera and the ground below it."""

    camera: Camera
    surface: Terrain
    reader: SteppedReader
    ground: Ground
    address: SceneAddress

    @cached_property
    def footprint(self) -> Footprint:
        """What the image sees of the ground."""
        return footprint(self.camera, painted_surface(self.surface), self.ground.bounds)

    @property
    def sources(self) -> tuple[Source]:
        """The image as a table of sources."""
        return (Source(self.camera, self.reader),)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of the pixels, one sentence each."""
        found = self.reader.info.warnings
        found += tuple(f"{self.reader.path.name}: {note}" for note in getattr(self.camera, "notes", ()))
        step = self.reader.step(RestoreStep)
        if step is not None:
            found += (f"{self.reader.path.name}: {step.describe()}",)
        balanced = self.reader.step(BalanceStep)
        if balanced is not None:
            # The same for all images of a block: many of them make one note.
            found += (f"colours by the balance files in {balanced.path.parent.name}",)
        return found

    @property
    def files(self) -> tuple[Path, ...]:
        """Input files."""
        return tuple(Path(path) for path, _ in self.address.digests)


def input_files(project: Project) -> list[Path]:
    """All files that a project names; nothing that is written may replace one of them."""
    files = [file for image in project.images for file in (image.file, image.balance) if file is not None]
    restored = [project.restoration(image) for image in project.images]
    files += [file for each in restored if each is not None for file in each.files]
    files += [] if project.terrain is None else project.terrain.files
    files += [objects.file for objects in project.objects]
    files += [] if project.target is None else project.target.files
    observed = project.observations
    files += [*observed.image_points, *observed.control, *([observed.positions] if observed.positions else [])]
    geometry = [file for image in project.images for file in image.geometry_files(project.resolve)]
    return [*(project.resolve(file) for file in files), *geometry]


def open_scene(project: Project, name: str) -> Scene:
    """Camera, surface and pixels of one image of a project."""
    return _open(scene_address(project, name))


class Attempts:
    """Attempts to make something of a project's images, each without those whose files the one before could not read.

    Each is a context that gives the project. If it ends with an error, the images that cannot be opened are left out,
    see `Project.leaving_out`; if all can be opened and the error names the file of one, those whose pixels cannot be
    read. Balance files and filters do not count: they can be corrected.
    """

    def __init__(self, project: Project, images: Sequence[str] | None) -> None:
        self.left_out: dict[str, str] = {}
        self._project, self._images, self._again = project, images, True

    def __iter__(self) -> Iterator[Self]:
        while self._again:
            self._again = False
            yield self

    def __enter__(self) -> Project:
        return self._project.leaving_out(self.left_out)

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        if not isinstance(error, InputError):
            return False
        usable = self._project.leaving_out(self.left_out)
        names = usable.oriented(self._project.select(self._images), approximate=True)[0]
        found = unusable_images(usable, names, str(error))
        self._again = 0 < len(found) < len(names)
        if self._again:
            self.left_out |= found
        return self._again


def unusable_images(project: Project, names: Sequence[str], error: str) -> dict[str, str]:
    """Return why images cannot be used, by name: by their own files, and pixels if `error` names the file of one."""
    found, readers = {}, {}
    cameras = {name: camera.model_copy(update={"restore": None}) for name, camera in project.cameras.items()}
    images = tuple(image.model_copy(update={"balance": None, "restore": None}) for image in project.images)
    project = project.model_copy(update={"cameras": cameras, "images": images})
    for name in names:
        try:
            readers[name] = open_scene(project, name).reader
        except InputError as reason:
            found[name] = f"cannot be used: {reason}"
    if found or not any(str(reader.path) in error for reader in readers.values()):
        return found
    for name, reader in readers.items():
        width, height = reader.size
        try:
            for part in Window(0, 0, width, height).tiles(_READ):
                reader.image.read(part)
        except InputError as reason:
            found[name] = f"cannot be used: {reason}"
    return found


def refuse_unusable(left_out: Mapping[str, str], of: int) -> None:
    """Raise ImagesLeftOut if something was made without some of a number of images."""
    if left_out:
        lines = "\n  ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise ImagesLeftOut(f"finished, but {len(left_out)} of {of} images cannot be used and are left out:\n  {lines}")


def map_order(project: Project, names: Sequence[str]) -> list[int]:
    """Places in `names` such that images that are near on the map come soon after each other (a curve of Morton).

    What was read of the terrain for one is then at hand for the next; along strips each strip would read its own.
    """
    XY = np.array([_place(project.any_image(name)) for name in names])
    cell = (1023 * (XY - XY.min(axis=0)) / max(1e-9, float(np.ptp(XY, axis=0).max()))).astype(int)
    code = sum((cell[:, axis] >> bit & 1) << (2 * bit + axis) for bit in range(10) for axis in (0, 1))
    return [int(place) for place in np.argsort(code, kind="stable")]


def _place(image: ImageEntry) -> tuple[float, ...]:
    """Where an image is on the map, as far as that is known without opening it."""
    return image.center[:2] if isinstance(image, Image) and image.center is not None else (0.0, 0.0)


def scene_address(project: Project, name: str) -> SceneAddress:
    """What the scene of an image is opened by; its files are looked at, but not opened."""
    image = project.any_image(name)
    alone = project.alone([name])
    files = [project.resolve(file) for file in (image.file, image.balance) if file is not None]
    files += image.geometry_files(project.resolve)
    if project.ground.file is not None:
        files.append(project.resolve(project.ground.file))
    files += [project.resolve(objects.file) for objects in project.objects]
    if project.target is not None and isinstance(project.target.relief, str):
        files.append(project.resolve(project.target.relief))
    restoration = project.restoration(image)
    if restoration is not None:
        files += [project.resolve(file) for file in restoration.files]
    digests = tuple((str(path), _digest(str(path), stamp_of(path))) for path in files)
    text = alone.model_dump_json(exclude={"ortho", "observations", "adjustment", "targets"}, exclude_none=True)
    return SceneAddress(text, str(project.folder), digests)


@lru_cache(maxsize=4096)
def _digest(path: str, stamp: tuple[int, int]) -> str:
    """Digest of a file's content; read again only when size or time of the file change."""
    return fingerprint(path).digest


@lru_cache(maxsize=_KEPT)
def _open(address: SceneAddress) -> Scene:
    for path, digest in address.digests:
        if _digest(path, stamp_of(Path(path))) != digest:
            raise InputError(f"{path}: has changed since the run was planned; plan it again")
    project = parse_project(json.loads(address.text), Path(address.folder), "project")
    image = project.images[0]
    ground = ground_of(project)
    reader = _reader(project, image)
    camera = on_target(project, camera_of(project, image, ground, reader.size))
    if project.target is not None:
        ground = target_ground(project)
    return Scene(camera=camera, surface=ground.surface, reader=reader, ground=ground, address=address)


def on_target(project: Project, camera: Camera) -> Camera:
    """Return a camera in the coordinates that products of the project lie in."""
    target = project.target
    if target is None:
        return camera
    if tremor_of(camera) is not None:
        raise GeometryError(
            f"target {target.frame}: images of a turbulent flight lie on the map alone; leave them out by `images`"
        )
    return FramedCamera(camera, target.space, target.bounds)


def _reader(project: Project, image: ImageEntry) -> SteppedReader:
    """The image's pixels, restored and balanced if the project says so."""
    source = SteppedReader(RasterReader(project.resolve(image.file), alpha=image.alpha))
    restoration = project.restoration(image)
    if restoration is not None:
        table = restoration.linearisation
        light = linearisation_of(table if table in ("linear", "srgb") else str(project.resolve(table)))
        source = restored(source, load_filter(project.resolve(restoration.filter)), light)
    return source if image.balance is None else source.then(load_balance(project.resolve(image.balance)))


@dataclass(frozen=True)
class ScenesAddress:
    """All that a worker needs to open the images of a product: small, and pickles."""

    scenes: tuple[SceneAddress, ...]
    """One for each row of the table of sources; all over the same ground."""
    part: SingleObject | None = None
    """What is shown of the ground's objects, where it is a single one."""

    @classmethod
    def of(cls, project: Project, names: Sequence[str], part: SingleObject | None = None) -> ScenesAddress:
        """Addresses of images of a project."""
        return cls(tuple(scene_address(project, name) for name in names), part)

    @property
    def facts(self) -> list[dict[str, Any]]:
        """What moves a pixel, see `SceneAddress.facts`."""
        part = [] if self.part is None else [{"part": [list(self.part.objects), self.part.below]}]
        return [scene.facts for scene in self.scenes] + part

    @property
    def digests(self) -> tuple[tuple[str, str], ...]:
        """Path and content digest of each input file, each once."""
        return tuple(dict.fromkeys(entry for scene in self.scenes for entry in scene.digests))

    def open(self) -> Scenes:
        """The images; each is opened when it is asked for, and kept for the next tile."""
        return Scenes(self)


@dataclass(frozen=True)
class Scenes:
    """The images of a product and their ground."""

    address: ScenesAddress

    @property
    def sources(self) -> Sequence[Source]:
        """The table of sources."""
        return _Table(self.address)

    @property
    def surface(self) -> Terrain:
        """The ground that they have in common, or what is shown of it."""
        return surface_of(self.address)

    def __getitem__(self, row: int) -> Scene:
        return self.address.scenes[row].open()


@lru_cache(maxsize=16)
def surface_of(address: ScenesAddress) -> Terrain:
    """The ground that images have in common, or what is shown of it; kept, since it finds its faces once."""
    surface = address.scenes[0].open().surface
    if address.part is None:
        return surface
    assert isinstance(surface, ObjectSurface)
    return replace(surface, part=address.part)


@dataclass(frozen=True)
class _Table(Sequence[Source]):
    """Sources, opened one by one."""

    address: ScenesAddress

    def __len__(self) -> int:
        return len(self.address.scenes)

    @overload
    def __getitem__(self, row: int) -> Source: ...
    @overload
    def __getitem__(self, row: slice) -> Sequence[Source]: ...
    def __getitem__(self, row: int | slice) -> Source | Sequence[Source]:
        if isinstance(row, slice):
            return _Table(ScenesAddress(self.address.scenes[row]))
        (source,) = self.address.scenes[row].open().sources
        return source
