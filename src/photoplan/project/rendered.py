"""Terrain, objects and colours of a project as scenes for its cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import floor, log2
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import GeometryError, InputError
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.grid import MapGrid, Window, level_size
from photoplan.io.project.model import Project
from photoplan.io.raster import RasterReader, stated_classes
from photoplan.io.raster_info import placement_of
from photoplan.kernels.terrain import sample_points
from photoplan.plan.footprint import FAR
from photoplan.project.cameras import camera_without_pixels
from photoplan.project.ground import Ground, ground_of
from photoplan.quality.formation.scenes import FromAbove, RenderedScene, SolidTexture, Texture
from photoplan.surfaces.base import Hits
from photoplan.surfaces.objects import painted_surface

#: Points along a side of an image at which ground pixels are measured.
_POINTS = 7
#: Neighbouring rays that read the raster together, at a level of their own.
_TOGETHER = 4096
#: Side of what is read for them at most, pixels: where they lie further apart, a coarser level is read.
_SIDE = 2048


@dataclass(frozen=True, eq=False)
class DrapedTexture:
    """Colours of a raster over the map, interpolated bilinearly between pixels about as large as rays are apart.

    Classes are taken by the nearest pixel.
    """

    reader: RasterReader
    other: SolidTexture
    """Texture where the raster has no value, and on objects."""
    classes: bool = False
    """True if its values are numbers of classes, which are never mixed."""

    @classmethod
    def of(cls, path: Path, crs: str, other: SolidTexture) -> DrapedTexture:
        """The texture of a file over a map in a CRS; `other` gets as many bands."""
        reader = RasterReader(path)
        if reader.info.to_map is None or reader.info.crs is None:
            raise InputError(f"{path}: a texture needs a place on the map; georeference it (`gdal_edit.py -a_srs`)")
        if reader.info.contradiction is not None:
            raise InputError(f"{path}: {reader.info.contradiction}")
        if not same_crs(reader.info.crs, crs):
            raise InputError(
                f"{path}: is in {crs_label(reader.info.crs)}, the project in {crs_label(crs)}; warp one of them"
            )
        if reader.dtype != np.uint8:
            raise InputError(f"{path}: pixels of type {reader.dtype}; the texture of a scene has uint8")
        return cls(reader, replace(other, bands=reader.bands), stated_classes(reader.info) is not None)

    @property
    def bands(self) -> int:
        """Return the number of bands of the raster."""
        return self.reader.bands

    def __call__(self, hits: Hits) -> NDArray[np.float64]:
        """Grey values, see `Texture`."""
        out = self.other(hits)
        ground = np.flatnonzero(hits.owner == 0)
        for first in range(0, len(ground), _TOGETHER):
            part = ground[first : first + _TOGETHER]
            values = self._sampled(hits.XYZ[part, :2])
            there = np.isfinite(values[0])
            out[:, part[there]] = values[:, there]
        return out

    def _sampled(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values at map points (n, 2), shape (bands, n); NaN where there are none."""
        place = placement_of(self.reader.info)
        xy = (XY - place.coefficients[2::3]) @ np.linalg.inv(place.linear).T
        if self.classes:
            return self._nearest(np.floor(xy).astype(np.int64))
        apart = float(np.median(np.hypot(*np.diff(xy, axis=0).T))) if len(xy) > 1 else 1.0
        level = max(0, floor(log2(max(apart, 1.0))), int(np.ceil(np.log2(max(1.0, np.ptp(xy, axis=0).max() / _SIDE)))))
        # Edges of pixels are whole numbers until here.
        xy = xy / 2**level - 0.5
        whole = Window(0, 0, *level_size(self.reader.size, level))
        low, high = np.floor(xy.min(axis=0)).astype(int), np.floor(xy.max(axis=0)).astype(int) + 2
        window = Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])) & whole
        if not window.size:
            return np.full((self.bands, len(xy)), np.nan)
        pixels, valid = self.reader.read(window, level)
        values = pixels.astype(np.float32)
        if valid is not None:
            values[:, ~valid] = np.nan
        return np.stack([sample_points(band, xy - (window.col, window.row)) for band in values]).astype(np.float64)

    def _nearest(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return values of pixels (column, row), shape (bands, n); NaN outside the raster and where it has none."""
        out = np.full((self.bands, len(cells)), np.nan)
        # Cells of one square of the raster together.
        squares = np.unique(cells // _SIDE, axis=0)
        for column, row in squares.tolist():
            window = Window(column * _SIDE, row * _SIDE, _SIDE, _SIDE) & Window(0, 0, *self.reader.size)
            here = np.flatnonzero(((cells >= (window.col, window.row)) & (cells < window.stop)).all(axis=1))
            if not len(here):
                continue
            low, high = cells[here].min(axis=0), cells[here].max(axis=0) + 1
            pixels, valid = self.reader.read(Window(*low.tolist(), *(high - low).tolist()))
            at = tuple((cells[here] - low).T[::-1])
            there = np.ones(len(here), bool) if valid is None else valid[at]
            out[:, here[there]] = pixels[(slice(None), *(axis[there] for axis in at))]
        return out


@dataclass(frozen=True, eq=False)
class ProjectScene:
    """Scene that the cameras of a project look at."""

    project: Project
    texture: Texture
    ground: Ground
    oversampling: int

    @classmethod
    def of(cls, project: Project, raster: Path | None, grain: float, seed: int, oversampling: int) -> ProjectScene:
        """The scene of a project; arguments as those of `SimulateRequest`."""
        other = SolidTexture(grain, seed)
        texture = other if raster is None else DrapedTexture.of(raster, project.crs, other)
        return cls(project, texture, ground_of(project), oversampling)

    def seen_by(self, name: str) -> RenderedScene:
        """Return the scene that an image shows."""
        camera = camera_without_pixels(self.project, name)
        x, y, z = camera.vantage.point.tolist()
        low, high = self._heights((x - FAR, y - FAR, x + FAR, y + FAR), f"image {name!r}")
        orientation = self.project.orientation
        if orientation.earth_curvature != "none" or orientation.refraction or not camera.vantage.central:
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
        """Return the scene that a true orthophoto shows: objects that only hide are left out."""
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


def ground_pixel(project: Project) -> float:
    """Ground pixel of the project's first image, the median over it, metres."""
    name = project.images[0].name
    scene = ProjectScene(project, SolidTexture(1.0), ground_of(project), 1).seen_by(name)
    part = (np.arange(_POINTS) + 0.5) / _POINTS
    xy = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) * scene.size - 0.5
    beside = xy + np.array([1.0, 0.0])
    pixels = np.linalg.norm(scene.hits(beside).XYZ - scene.hits(xy).XYZ, axis=1)
    if np.isnan(pixels).all():
        raise GeometryError(f"image {name!r} sees neither terrain nor objects; check its orientation")
    return float(np.nanmedian(pixels))
