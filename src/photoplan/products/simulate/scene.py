"""Terrain, objects and colours of a project as scenes for its cameras, and rasters that say what there is to see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import CentralCamera
from photoplan.errors import GeometryError, UsageError
from photoplan.geometry.grid import MapGrid, Placement, Window
from photoplan.io.image_form import ImageForm
from photoplan.io.project.model import Project
from photoplan.plan.footprint import FAR
from photoplan.products.dtm.raster import GridOptions, GridTile, write_grid
from photoplan.products.orthophoto.look import two_figures
from photoplan.products.simulate.drape import DrapedTexture
from photoplan.project.cameras import central_without_pixels
from photoplan.project.ground import Ground, ground_of
from photoplan.quality.formation.rendered import FromAbove, RenderedScene, SolidTexture, Texture
from photoplan.surfaces.objects import painted_surface

#: Shortest wavelength of the pattern, ground pixels.
_GRAIN = 8.0
#: Points along a side of an image at which ground pixels are measured.
_POINTS = 7
#: Origins of stored coordinates are multiples of this, metres.
_ORIGIN = 1000.0


@dataclass(frozen=True, eq=False)
class ProjectScene:
    """What the cameras of a project look at."""

    project: Project
    texture: Texture
    ground: Ground
    oversampling: int

    @classmethod
    def of(cls, project: Project, raster: Path | None, grain: float, seed: int, oversampling: int) -> ProjectScene:
        """The scene of a project; arguments as those of `SceneRequest`.

        Raises
        ------
        InputError
            Terrain, objects or texture cannot be used.
        """
        other = SolidTexture(grain, seed)
        texture = other if raster is None else DrapedTexture.of(raster, project.crs, other)
        return cls(project, texture, ground_of(project), oversampling)

    def seen_by(self, name: str) -> RenderedScene:
        """What an image shows.

        Raises
        ------
        InputError
            The image is not oriented, or its size is not stated.
        GeometryError
            There is nothing within 30 km.
        """
        camera = central_without_pixels(self.project, name)
        x, y, z = camera.center.tolist()
        low, high = self._heights((x - FAR, y - FAR, x + FAR, y + FAR), f"image {name!r}")
        orientation = self.project.orientation
        if orientation.earth_curvature != "none" or orientation.refraction:
            # Curved rays are known from heights alone; what lies higher than the camera they cannot meet.
            high = max(low, min(high, z - 1.0))
        return RenderedScene(
            camera=camera,
            surface=self.ground.surface,
            texture=self.texture,
            heights=(low, high),
            oversampling=self.oversampling,
        )

    def from_above(self, grid: MapGrid) -> RenderedScene:
        """What a true orthophoto shows: objects that only hide are left out.

        Raises
        ------
        GeometryError
            There is nothing inside the grid.
        """
        low, high = self._heights(grid.bounds, "the true orthophoto")
        above = FromAbove(grid, high + 1.0)
        return RenderedScene(
            camera=above,
            surface=painted_surface(self.ground.surface),
            texture=self.texture,
            heights=(low, high),
            oversampling=self.oversampling,
        )

    def _heights(self, bounds: tuple[float, float, float, float], who: str) -> tuple[float, float]:
        low, high = (float(h) for h in self.ground.surface.height_range(bounds))
        if not low <= high:
            raise GeometryError(f"{who}: no terrain and no object in {' '.join(f'{b:.0f}' for b in bounds)}")
        return low, high


def usual_grain(project: Project) -> float:
    """Shortest wavelength of the pattern if nobody states it: eight ground pixels of the project's first image.

    Raises
    ------
    GeometryError
        It sees nothing.
    """
    name = project.images[0].name
    scene = ProjectScene(project, SolidTexture(1.0), ground_of(project), 1).seen_by(name)
    part = (np.arange(_POINTS) + 0.5) / _POINTS
    xy = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) * scene.size - 0.5
    beside = xy + np.array([1.0, 0.0])
    pixels = np.linalg.norm(scene.hits(beside).XYZ - scene.hits(xy).XYZ, axis=1)
    if np.isnan(pixels).all():
        raise GeometryError(f"image {name!r} sees neither terrain nor objects; check its orientation")
    return two_figures(_GRAIN * float(np.nanmedian(pixels)))


@dataclass(frozen=True, eq=False)
class TruthRaster:
    """A raster of what rays meet, to be written."""

    path: Path
    placement: Placement
    dtype: type
    tile: Callable[[Window], GridTile]
    options: GridOptions
    bands: int = 4

    def write(self) -> None:
        """Compute and write it, see `write_grid`."""
        write_grid(self.path, self.placement, self.dtype, self.bands, "auto", self.tile, self.options)


def image_truth(scene: RenderedScene, camera: CentralCamera, path: Path, options: GridOptions) -> TruthRaster:
    """X, Y, Z and object of what the middles of an image's pixels show; NaN: nothing.

    Values of X and Y are stored from an origin, the bands' offset, which GDAL's readers add.
    """
    origin = np.round(camera.center / _ORIGIN) * _ORIGIN * (1.0, 1.0, 0.0)
    form = ImageForm(
        descriptions=("X", "Y", "Z", "object"), units=("metre", "metre", "metre", ""), offsets=(*origin.tolist(), 0.0)
    )
    tile = partial(_truth_tile, scene, origin)
    return TruthRaster(
        path=path,
        placement=Placement(scene.size),
        dtype=np.float32,
        tile=tile,
        options=replace(options, form=form, overviews=False),
    )


def _truth_tile(scene: RenderedScene, origin: NDArray[np.float64], window: Window) -> GridTile:
    y, x = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
    hits = scene.hits(np.stack([x, y], axis=-1).reshape(-1, 2))
    there = np.isfinite(hits.along)
    values = np.concatenate([hits.XYZ - origin, np.where(there, hits.owner, np.nan)[:, None]], axis=1)
    return values.T.reshape(4, *x.shape).astype(np.float32)


def true_orthophoto(
    scene: ProjectScene,
    resolution: float,
    bounds: tuple[float, float, float, float] | None,
    path: Path,
    options: GridOptions,
) -> TruthRaster:
    """The scene's own colours on the map: means over the pixels of what lies uppermost.

    Raises
    ------
    UsageError
        No bounds are given, and the terrain has none.
    """
    bounds = bounds or scene.ground.bounds
    if bounds is None:
        raise UsageError("the terrain has no bounds; give `bounds` of the true orthophoto")
    grid = MapGrid.covering(bounds, resolution, scene.project.crs)
    seen = scene.from_above(grid)
    tile, bands = partial(_mean_tile, seen), seen.bands
    return TruthRaster(path=path, placement=grid.placement, dtype=np.uint8, tile=tile, options=options, bands=bands)


def _mean_tile(scene: RenderedScene, window: Window) -> GridTile:
    k = scene.oversampling
    cells = scene.cells(window).reshape(scene.bands, window.height, k, window.width, k)
    valid = np.asarray((cells > 0).all(axis=(0, 2, 4)))
    return np.rint(cells.mean(axis=(2, 4)) * valid).astype(np.uint8), valid
