"""Patches of an orthophoto: where they lie, and how they are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.cameras.base import on_level
from photoplan.errors import GeometryError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.matching.control import best_place
from photoplan.matching.grey import GreyImage
from photoplan.matching.ortho import OrthoPatch, patch_on
from photoplan.plan.footprint import image_border
from photoplan.project.ground import Ground
from photoplan.project.scene import Scene

#: Cells of the search at most, along each side.
_LARGEST = 600


@dataclass(frozen=True, eq=False)
class Ortho:
    """Orthophotos of one CRS."""

    readers: tuple[RasterReader, ...]

    @property
    def resolution(self) -> float:
        """Side of a pixel of the first one, metres."""
        to_map = self.readers[0].info.to_map
        assert to_map is not None
        return to_map[1]

    def read(
        self, bounds: tuple[float, float, float, float], factor: int
    ) -> tuple[NDArray[np.float32], tuple[float, float], float] | None:
        """Grey values of means of pixels inside map bounds, the map place of the first one's middle, and their side.

        From the first orthophoto that has values there; None if none has.
        """
        xmin, ymin, xmax, ymax = bounds
        for reader in self.readers:
            to_map = reader.info.to_map
            assert to_map is not None
            x0, step, _, y0, _, _ = to_map
            side = factor * step
            left, top = x0 - step / 2, y0 + step / 2
            first = np.array([np.ceil((xmin - left) / side), np.ceil((top - ymax) / side)]).astype(int)
            last = np.array([np.floor((xmax - left) / side), np.floor((top - ymin) / side)]).astype(int)
            low, high = np.maximum(first, 0), np.minimum(last, np.array(reader.size) // factor)
            if (high <= low).any():
                continue
            window = Window(int(low[0]), int(low[1]), *(int(v) for v in high - low))
            values = GreyImage(reader).reduced(window, factor)
            if np.isfinite(values).any():
                return values, (left + (low[0] + 0.5) * side, top - (low[1] + 0.5) * side), side
        return None


def choose_patches(
    ortho: Ortho, scenes: Sequence[Scene], grid: int, radius: int, search: float
) -> tuple[tuple[float, int, int, float], list[OrthoPatch]]:
    """Patches spread over what the images see: one in every square of the map, where its texture is best.

    Places where objects stand are not taken: whether the orthophoto shows them there or beside is not known.
    Squares are the `grid`-th part of a footprint. Patches are of the coarser resolution of orthophoto and photos.
    """
    seen = [_seen(scene) for scene in scenes]
    areas = [s for s in seen if s is not None]
    if not areas:
        raise GeometryError("none of the images looks at the ground; look at heights and orientation")
    gsd = float(np.median([np.sqrt(area.area / np.prod(size)) for area, size in areas]))
    factor = max(1, round(gsd / ortho.resolution))
    resolution = factor * ortho.resolution
    cells = int(np.ceil(search / resolution))
    if cells > _LARGEST:
        raise UsageError(
            f"`search` {search:g} m are {cells} pixels of {resolution:g} m; at most {_LARGEST} are searched; give "
            f"{_LARGEST * resolution:g} m or less, or a coarser orthophoto"
        )
    step = max(float(np.median([np.sqrt(area.area) for area, _ in areas])) / grid, resolution)
    union = shapely.unary_union([area for area, _ in areas])
    settings = (resolution, radius, cells, search)
    return settings, _in_squares(ortho, union, scenes[0].ground, step, resolution, radius, factor)


def _seen(scene: Scene) -> tuple[shapely.Geometry, tuple[int, int]] | None:
    """Footprint on the level of the ground below."""
    camera = scene.camera
    level = float(scene.ground.bare.heights(camera.vantage.point[:2]))
    if not np.isfinite(level):
        level = sum(scene.footprint.height_range) / 2
    if not np.isfinite(level):
        return None
    foot = on_level(camera, image_border(camera.size), level)[:, :2]
    area = shapely.convex_hull(shapely.MultiPoint(foot[np.isfinite(foot).all(axis=1)]))
    if scene.ground.bounds is not None:
        area = area.intersection(shapely.box(*scene.ground.bounds))
    return (area, camera.size) if area.area > 0 else None


def _in_squares(
    ortho: Ortho, union: shapely.Geometry, ground: Ground, step: float, resolution: float, radius: int, factor: int
) -> list[OrthoPatch]:
    xmin, ymin, xmax, ymax = union.bounds
    margin = (radius + 1) * resolution
    found = []
    for y in np.arange(ymin, ymax, step):
        for x in np.arange(xmin, xmax, step):
            if not union.intersects(shapely.box(x, y, x + step, y + step)):
                continue
            part = ortho.read((x - margin, y - margin, x + step + margin, y + step + margin), factor)
            if part is None or min(part[0].shape) <= 2 * radius + 2:
                continue
            values, (left, top), side = part
            v, u = np.indices(values.shape) * side
            values = np.where(ground.is_open(np.stack([left + u, top - v], axis=-1)), values, np.float32(np.nan))
            place = best_place(values, radius, radius)
            if place is None:
                continue
            col, row = place
            patch = values[row - radius : row + radius + 1, col - radius : col + radius + 1].astype(float)
            at = left + col * side, top - row * side
            v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1] * side
            made = patch_on(patch, at, ground.bare.heights(np.stack([at[0] + u, at[1] - v], axis=-1)), side)
            if made is not None:
                found.append(made)
    return found
