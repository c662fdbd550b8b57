"""Images that no frame camera took, as features and matching see them: laid on the map, piece by piece.

Lines of a strip, satellites and frames are turned, stretched and bent against each other by whatever flew them.
Rectified over the terrain at one resolution they are alike but for what the orientations are off by: patches correlate.
Nothing is kept on the disk: a piece is made when it is read, by the engine that makes orthophotos. What is found on the
map is carried back strictly, through the ground, by the image's own camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import project
from photoplan.cameras.map import MapProjection
from photoplan.cameras.observed import ImagePoints
from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.project.model import Project
from photoplan.matching.grey import GreyImage
from photoplan.matching.tracks import Tracks
from photoplan.plan.footprint import mean_gsd
from photoplan.products.rectify import rectify
from photoplan.products.tie.inputs import TieImage
from photoplan.project.scene import Scene, open_scene

_Floats = NDArray[np.float64]
#: Side of the pieces, pixels, and how many of an image are kept in memory.
_PIECE, _KEPT = 512, 32


@dataclass(frozen=True, eq=False)
class RectifiedPixels:
    """An image on the map."""

    scene: Scene
    grid: MapGrid
    _piece: Callable[[int, int], tuple[NDArray[Any], NDArray[np.bool_]]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_piece", lru_cache(maxsize=_KEPT)(self._made))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels of the map."""
        return self.grid.width, self.grid.height

    def read(self, window: Window) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Pixels of a window inside the image, shape (bands, height, width), and their validity."""
        bands, dtype = self.scene.reader.bands, self.scene.reader.dtype
        values = np.zeros((bands, window.height, window.width), dtype)
        valid = np.zeros((window.height, window.width), bool)
        for row in range(window.row // _PIECE, -(-window.stop[1] // _PIECE)):
            for col in range(window.col // _PIECE, -(-window.stop[0] // _PIECE)):
                place = Window(col * _PIECE, row * _PIECE, _PIECE, _PIECE) & self.grid.window
                common = place & window
                made, known = self._piece(col, row)
                there, here = common.slices(place), common.slices(window)
                values[:, here[0], here[1]] = made[:, there[0], there[1]]
                valid[here] = known[there]
        return values, valid

    def _made(self, col: int, row: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        place = Window(col * _PIECE, row * _PIECE, _PIECE, _PIECE) & self.grid.window
        g = self.grid
        part = MapGrid(
            left=g.left + place.col * g.resolution,
            top=g.top - place.row * g.resolution,
            resolution=g.resolution,
            width=place.width,
            height=place.height,
            crs=g.crs,
        )
        made = rectify(self.scene.reader, self.scene.camera, part, self.scene.ground.bare)
        return made.values, made.valid

    def carried(self, uv: _Floats) -> tuple[_Floats, _Floats]:
        """Image points (n, 2) of points on the map (n, 2), and the derivatives (n, 2, 2); NaN where there are none."""
        half = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        at = uv[:, None] + half
        g = self.grid
        XY = np.stack([g.left + (at[..., 0] + 0.5) * g.resolution, g.top - (at[..., 1] + 0.5) * g.resolution], axis=-1)
        # The slope of the ground has no part in what a piece shows around a point, its height has.
        heights = np.broadcast_to(np.asarray(self.scene.ground.bare.heights(XY[:, 0]))[:, None], XY.shape[:2])
        xy = project(self.scene.camera, np.concatenate([XY, heights[..., None]], axis=-1))
        return xy[:, 0], np.stack([xy[:, 1] - xy[:, 2], xy[:, 3] - xy[:, 4]], axis=-1)


@dataclass(frozen=True, eq=False)
class MapView:
    """A rectified image as a camera that looks straight down on the map."""

    grid: MapGrid

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels of the map."""
        return self.grid.width, self.grid.height

    field: ClassVar[None] = None
    """Maps are ideal."""
    breaks: ClassVar[None] = None
    """Maps are smooth."""

    @property
    def center(self) -> _Floats:
        """Above its middle, (3,)."""
        xmin, ymin, xmax, ymax = self.grid.bounds
        return np.array([(xmin + xmax) / 2, (ymin + ymax) / 2, 1.0])

    def project_homogeneous(self, XYZ: ArrayLike) -> _Floats:
        """Ground (..., 3) to (x, y, 1)."""
        return MapProjection(self.grid.placement).project_homogeneous(XYZ)

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[_Floats, _Floats]:
        """Straight down, from a metre above the zero of heights."""
        xy, g = np.asarray(xy, float), self.grid
        X, Y = g.left + (xy[..., 0] + 0.5) * g.resolution, g.top - (xy[..., 1] + 0.5) * g.resolution
        down = np.broadcast_to([0.0, 0.0, -1.0], (*X.shape, 3))
        return np.stack([X, Y, np.ones_like(X)], axis=-1), down


def open_rectified(project_: Project, names: Sequence[str], use_orientation: bool) -> tuple[list[TieImage], list[str]]:
    """The images of a project on the map, at the coarsest of their resolutions, and a note of that."""
    if not use_orientation:
        raise UsageError("satellites and strips are matched on the map, by the orientation that they come with; use it")
    scenes = [open_scene(project_, name) for name in names]
    for name, scene in zip(names, scenes):
        if scene.footprint.bounds is None:
            raise InputError(f"image {name!r} sees nothing of the terrain; tie points are looked for on the map")
    resolution = float(f"{max(mean_gsd(scene.camera, scene.footprint) for scene in scenes):.3g}")
    opened = []
    for name, scene in zip(names, scenes):
        assert scene.footprint.bounds is not None
        grid = MapGrid.covering(scene.footprint.bounds, resolution, project_.crs)
        opened.append(
            TieImage(
                name=name,
                path=scene.reader.path,
                grey=GreyImage(RectifiedPixels(scene, grid)),
                calibration=None,
                camera=MapView(grid),
                level=0.0,
                position=None,
                geometry=repr((scene.address.facts, grid)),
            )
        )
    return opened, [f"matched on the map over the terrain, at {resolution:g} m"]


def carried_back(tracks: Tracks, images: Sequence[TieImage], points: ImagePoints) -> ImagePoints:
    """Points that were found on the map, where they lie in the images; tracks that keep fewer than two places go."""
    xy, sigma = np.full_like(points.xy, np.nan), np.full_like(points.xy, np.nan)
    good = np.zeros(len(points), bool)
    for k in np.unique(tracks.image):
        mine, pixels = np.flatnonzero(tracks.image == k), images[k].grey.pixels
        assert isinstance(pixels, RectifiedPixels)
        xy[mine], J = pixels.carried(tracks.xy[mine])
        sigma[mine] = np.sqrt((J**2 @ tracks.sigma[mine][:, :, None] ** 2)[..., 0])
        size = np.array(pixels.scene.camera.size)
        with np.errstate(invalid="ignore"):
            good[mine] = ((xy[mine] > -0.5) & (xy[mine] < size - 0.5)).all(axis=1) & (sigma[mine] > 0).all(axis=1)
    good &= np.bincount(points.point[good], minlength=len(points.points))[points.point] >= 2
    whole = ImagePoints(
        images=points.images,
        points=points.points,
        image=points.image,
        point=points.point,
        xy=np.where(good[:, None], xy, 0.0),
        sigma=np.where(good[:, None], sigma, 1.0),
    )
    return whole.where(good)
