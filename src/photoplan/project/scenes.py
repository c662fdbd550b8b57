"""Many images over one ground: the table of sources of a product, opened as tiles need it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, overload

from photoplan.engine.base import Source
from photoplan.io.project.model import Project
from photoplan.project.scene import Scene, SceneAddress, scene_address
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.objects import ObjectSurface, SingleObject


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
