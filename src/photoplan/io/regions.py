"""Regions of a mosaic by the image that paints them: from the raster of sources, to a GeoPackage, and back."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.features
import rasterio.windows
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.polygons import label_polygons, read_features, write_features

#: Side of the parts in which a raster is read, pixels.
_PART = 2048


@dataclass(frozen=True, eq=False)
class Regions:
    """Polygons that somebody has given to images of a mosaic."""

    grid: MapGrid
    shapes: tuple[tuple[Any, int], ...]
    """Polygon, and row of its image in the table of sources, plus one; the last of those over each other counts."""

    @property
    def meet(self) -> bool:
        """Whether a polygon lies in the grid, at least in part."""
        return any(polygon.intersects(shapely.box(*self.grid.bounds)) for polygon, _ in self.shapes)

    def digest(self, margin: float) -> str:
        """Of what lies in the grid, and `margin` metres around it: the same for regions that are the same there."""
        left, bottom, right, top = self.grid.bounds
        box = shapely.box(left - margin, bottom - margin, right + margin, top + margin)
        found = hashlib.sha256()
        for polygon, row in self.shapes:
            part = shapely.normalize(shapely.set_precision(polygon.intersection(box), 1e-6))
            if part.area > 0:
                found.update(row.to_bytes(4, "little") + shapely.to_wkb(part, output_dimension=2))
        return found.hexdigest()

    def rows(self, window: Window) -> NDArray[np.uint16]:
        """Row plus one for each pixel of a window whose centre lies in a polygon; 0 elsewhere."""
        grid, shape = self.grid, (window.height, window.width)
        left, top = grid.left + window.col * grid.resolution, grid.top - window.row * grid.resolution
        box = shapely.box(left, top - shape[0] * grid.resolution, left + shape[1] * grid.resolution, top)
        near = [(polygon, row) for polygon, row in self.shapes if polygon.intersects(box)]
        if not near:
            return np.zeros(shape, np.uint16)
        to_map = rasterio.Affine(grid.resolution, 0.0, left, 0.0, -grid.resolution, top)
        return np.asarray(rasterio.features.rasterize(near, shape, transform=to_map, dtype="uint16"))


def source_regions(path: Path, grid: MapGrid, images: int) -> dict[int, Any]:
    """Outline of what each image paints, along the edges of pixels: multipolygons by row plus one."""
    found: dict[int, list[Any]] = {}
    with rasterio.open(path) as file:
        for part in grid.window.tiles(_PART):
            at = rasterio.windows.Window(part.col, part.row, part.width, part.height)
            left, top = grid.left + part.col * grid.resolution, grid.top - part.row * grid.resolution
            labels = file.read(1, window=at).astype(np.int32)
            labels[labels > images] = 0
            here = MapGrid(
                left=left, top=top, resolution=grid.resolution, width=part.width, height=part.height, crs=grid.crs
            )
            for row, shape in label_polygons(labels, here).items():
                found.setdefault(row, []).append(shape)
    whole = ((row, shapely.union_all(parts)) for row, parts in sorted(found.items()))
    return {row: shape if shape.geom_type == "MultiPolygon" else shapely.MultiPolygon([shape]) for row, shape in whole}


def write_regions(path: Path, images: Sequence[str], shapes: Mapping[int, Any], crs: str | None) -> None:
    """Write regions as a GeoPackage with the layer `regions`: columns image, source and area_m2."""
    rows = list(shapes)
    columns = {
        "image": np.array([images[row - 1] for row in rows], object),
        "source": np.array(rows, np.int64),
        "area_m2": np.array([shapes[row].area for row in rows], float),
    }
    write_features(path, "MultiPolygon", [shapes[row] for row in rows], columns, crs, "regions")


def read_regions(path: Path, images: Sequence[str], grid: MapGrid, known: Sequence[str] = ()) -> Regions:
    """Regions of a GeoPackage, as `write_regions` writes them or somebody has drawn them; those of images that are
    `known`, but none of the table of sources `images`, are left out.
    """
    read = read_features(path, "Polygon", crs=grid.crs)
    features = read.items
    if "image" not in read.fields:
        raise InputError(f"{path}: no column `image`, which says whose each region is")
    names = [each.name for each in features]
    unknown = [name for name in names if name not in images and name not in known]
    if unknown:
        raise InputError(
            f"{path}: regions of {', '.join(map(repr, dict.fromkeys(unknown)))}, which "
            f"{'is' if len(set(unknown)) == 1 else 'are'} not in the mosaic; choose these images too, or take the "
            "regions out"
        )
    rows = {name: row for row, name in enumerate(images, 1)}
    taken = ((each.geometry, rows[name]) for each, name in zip(features, names) if name in rows)
    return Regions(grid, tuple(taken))
