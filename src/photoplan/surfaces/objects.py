"""Terrain with objects on it: houses, bridges, walls, trees (Behr 1989, §6.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.raycast import SURFACE
from photoplan.surfaces.base import Surface, Terrain
from photoplan.surfaces.faces import Faces
from photoplan.surfaces.lattice import Lattice
from photoplan.surfaces.rays import Hits
from photoplan.targets.base import Target
from photoplan.targets.map import MapTarget

#: Metres; and between which heights above the ground an object stands there, metres.
_FOOT, _STANDS = 0.3048, (-3.0, 25.0)


@dataclass(frozen=True)
class SingleObject:
    """What a product shows where it is the product of a single object."""

    objects: tuple[int, ...]
    """The object, by its places in `Faces.names`: some are made of several features."""
    below: bool = False
    """Whether what lies below it is shown, as if it only hid, and not itself."""


@dataclass(frozen=True, eq=False)
class ObjectSurface:
    """Terrain that is raised by the objects which a product shows, and from which rays are kept by all of them.

    What overhangs has ground below it: a bridge that is painted gives its deck, one that only hides leaves the road.
    """

    ground: Terrain
    """Without objects."""
    faces: Faces
    part: SingleObject | None = None
    """What is shown of it; None: the ground, and all that is painted. All of it hides what is behind it."""
    entries: tuple[int, ...] = ()
    """Entry of the project that each object is of, by place in `Faces.names`."""

    @property
    def painted(self) -> Terrain:
        """The surface without objects that only hide: what a product is an image of."""
        faces = self.faces.painted
        return self.ground if faces is None else replace(self, faces=faces, part=None)

    @cached_property
    def shown(self) -> Faces | None:
        """Faces that a product shows."""
        if self.part is None:
            return self.faces.painted
        own = np.isin(self.faces.owner, self.part.objects)
        return self.faces.only(self.faces.paints & ~own if self.part.below else own)

    @property
    def shows_ground(self) -> bool:
        """Whether a product shows the ground beside them."""
        return self.part is None or self.part.below

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Height of the ground or of the highest shown face above it at the pixel centres of a window of a map
        target, shape (height, width), metres; NaN where there is neither. Of a single object that of its own faces,
        also where they are below the ground."""
        return self.top(target, window)[0]

    def top(self, target: Target, window: Window) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Relief of a window, and which of the faces `shown` is there, shape (height, width); −1: none."""
        faces, none = self.shown, np.full((window.height, window.width), -1)
        relief = self.ground.relief(target, window) if self.shows_ground else np.full(none.shape, np.nan, np.float32)
        if faces is None:
            return relief, none
        if not isinstance(target, MapTarget):
            raise UsageError(f"objects give relief for map targets, not for {type(target).__name__}")
        v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        raised, face = faces.highest(target.grid.to_map(np.stack([u, v], axis=-1)))
        face[raised < relief] = -1
        return np.where(face < 0, relief, raised).astype(np.float32), face

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """As `relief`, at map points (..., 2), shape (...)."""
        faces = self.shown
        heights = self.ground.heights(XY) if self.shows_ground else np.full(np.shape(XY)[:-1], np.nan)
        if faces is None:
            return heights
        raised = faces.heights(XY)
        return np.where(np.isneginf(raised), heights, np.fmax(heights, raised))

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Bounds of ground and faces, painted or not, inside map bounds (..., 4), shape (..., 2)."""
        ground, faces = self.ground.height_range(bounds), self.faces.height_range(bounds)
        return np.stack([np.fmin(ground[..., 0], faces[..., 0]), np.fmax(ground[..., 1], faces[..., 1])], axis=-1)

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """That of the ground: faces are no raster."""
        return self.ground.lattice(grid, window)

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """What rays meet first: the ground, as `Terrain.first_hit` has it, or a face, from either side."""
        ground = self.ground.first_hit(paths, bend)
        along, XYZ, face = self.faces.first_hit(paths, bend)
        nearer = np.isfinite(along) & ~(ground.along < along)
        return Hits(
            XYZ=np.where(nearer[:, None], XYZ, ground.XYZ),
            along=np.where(nearer, along, ground.along),
            result=np.where(nearer, SURFACE, ground.result),
            below=ground.below & ~nearer,
            normal=np.where(
                nearer[:, None], self.faces.normals(face, XYZ - np.asarray(paths, float)[:, 0]), ground.normal
            ),
            owner=np.where(nearer, self.faces.owner[face] + 1, ground.owner),
        )


@dataclass(frozen=True, eq=False)
class RaisedSurface:
    """A surface that is shown higher than it stands: it hides what it hides, but is looked at above itself."""

    surface: Surface
    window: Window
    """Where it is raised, pixels of a target."""
    by: NDArray[np.floating]
    """Metres for each pixel there."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Relief of the surface, raised."""
        relief, common = np.array(self.surface.relief(target, window), np.float32), self.window & window
        if common.size:
            relief[common.slices(window)] += self.by[common.slices(self.window)].astype(np.float32)
        return relief


def without_objects(surface: Terrain) -> Terrain:
    """The ground alone."""
    return surface.ground if isinstance(surface, ObjectSurface) else surface


def as_if_in_feet(surface: Terrain, height: float) -> dict[str, float]:
    """Objects that rise above a height, metres, and would stand on the ground if their own were in feet: how high they
    rise; of a surface without objects none."""
    if not isinstance(surface, ObjectSurface):
        return {}
    faces = surface.faces
    owner = np.repeat(faces.owner, 3)
    top, lowest = np.full(len(faces.names), -np.inf), np.full(len(faces.names), np.inf)
    np.maximum.at(top, owner, faces.corners[..., 2].ravel())
    corners = faces.corners.reshape(-1, 3)
    np.fmin.at(lowest, owner, _FOOT * corners[:, 2] - surface.ground.heights(corners[:, :2]))
    stands = (lowest > _STANDS[0]) & (lowest < _STANDS[1])
    return {faces.names[k]: float(top[k]) for k in np.flatnonzero((top > height) & stands)}


def painted_surface(surface: Terrain) -> Terrain:
    """What a product shows, without what only hides."""
    return surface.painted if isinstance(surface, ObjectSurface) else surface
