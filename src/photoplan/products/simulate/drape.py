"""A raster as the colours of the ground; what it does not cover, and objects, have the pattern of a solid texture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import floor, log2
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import level_size
from photoplan.io.image_form import placement_of
from photoplan.io.raster import RasterReader
from photoplan.kernels.sample_grid import sample_points
from photoplan.quality.formation.rendered import SolidTexture
from photoplan.surfaces.rays import Hits

#: Neighbouring rays that read the raster together, at a level of their own.
_TOGETHER = 4096
#: Side of what is read for them at most, pixels: where they lie further apart, a coarser level is read.
_SIDE = 2048


@dataclass(frozen=True, eq=False)
class DrapedTexture:
    """Colours of a raster over the map, interpolated bilinearly between pixels about as large as rays are apart."""

    reader: RasterReader
    other: SolidTexture
    """Where the raster has no value, and on objects."""

    @classmethod
    def of(cls, path: Path, crs: str, other: SolidTexture) -> DrapedTexture:
        """The texture of a file over a map in a CRS; `other` gets as many bands.

        Raises
        ------
        InputError
            The file cannot be used, has no place in that CRS, or other pixels than bytes.
        """
        reader = RasterReader(path)
        if reader.info.to_map is None or reader.info.crs is None:
            raise InputError(f"{path}: a texture needs a place on the map; georeference it (`gdal_edit.py -a_srs`)")
        if not same_crs(reader.info.crs, crs):
            raise InputError(
                f"{path}: is in {crs_label(reader.info.crs)}, the project in {crs_label(crs)}; warp one of them"
            )
        if reader.dtype != np.uint8:
            raise InputError(f"{path}: pixels of type {reader.dtype}; the texture of a scene has uint8")
        return cls(reader, replace(other, bands=reader.bands))

    @property
    def bands(self) -> int:
        """Those of the raster."""
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
        a, b, c, d, e, f = placement_of(self.reader.info).coefficients
        inverse = np.linalg.inv(np.array([[a, b], [d, e]]))
        xy = (XY - (c, f)) @ inverse.T
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
