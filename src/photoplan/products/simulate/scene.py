"""Rasters that say what there is to see in a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from photoplan.cameras.base import Camera
from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Placement, Window
from photoplan.io.image_form import ImageForm
from photoplan.products.dtm.raster import GridOptions, GridTile, write_grid
from photoplan.project.rendered import ProjectScene
from photoplan.quality.formation.rendered import RenderedScene

#: Origins of stored coordinates are multiples of this, metres.
_ORIGIN = 1000.0


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


def image_truth(scene: RenderedScene, camera: Camera, path: Path, options: GridOptions) -> TruthRaster:
    """X, Y, Z and object of what the middles of an image's pixels show; NaN: nothing.

    Values of X and Y are stored from an origin, the bands' offset, which GDAL's readers add.
    """
    origin = np.round(camera.vantage.point / _ORIGIN) * _ORIGIN * (1.0, 1.0, 0.0)
    form = ImageForm(
        descriptions=("X", "Y", "Z", "object"), units=("metre", "metre", "metre", ""), offsets=(*origin.tolist(), 0.0)
    )
    return TruthRaster(
        path=path,
        placement=Placement(scene.size),
        dtype=np.float32,
        tile=partial(scene.places, origin=origin),
        options=replace(options, form=form, overviews=False),
    )


def true_orthophoto(
    scene: ProjectScene,
    resolution: float,
    bounds: tuple[float, float, float, float] | None,
    path: Path,
    options: GridOptions,
) -> TruthRaster:
    """The scene's own colours on the map: means over the pixels of what lies uppermost."""
    bounds = bounds or scene.ground.bounds
    if bounds is None:
        raise UsageError("the terrain has no bounds; give `bounds` of the true orthophoto")
    grid = MapGrid.covering(bounds, resolution, scene.project.crs)
    seen = scene.from_above(grid)
    return TruthRaster(
        path=path, placement=grid.placement, dtype=np.uint8, tile=seen.means, options=options, bands=seen.bands
    )
