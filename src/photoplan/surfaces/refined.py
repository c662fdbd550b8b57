"""A finer terrain model inside polygons, joined to the coarse one without a step (Behr 1989, §6.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.surfaces.base import Terrain
from photoplan.targets.base import Target
from photoplan.targets.map import MapTarget


@dataclass(frozen=True, eq=False)
class RefinedSurface:
    """The coarse surface, and inside the polygons the fine one.

    In a band inside the border the difference of the two is blended in: Z = coarse + s(d / transition) · (fine −
    coarse) with the distance d to the border and the smooth step s(t) = t² (3 − 2 t). Heights therefore lie between
    those of the two surfaces, without the waves that arise where a fine grid is fitted to a coarse one across an
    undefined border; on the border the coarse surface is met, and its slope where both agree on theirs.

    Where only one of the surfaces exists inside the polygons, that one counts.
    """

    coarse: Terrain
    fine: Terrain
    polygons: Any
    """Shapely polygon or multipolygon, X and Y of the surfaces."""
    transition: float
    """Width of the band inside the border, metres; 0: the fine surface begins at the border with a step."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.transition) and self.transition >= 0):
            raise InputError(f"transition of {self.transition}; a width in metres, zero or more, is needed")
        if self.polygons.geom_type not in ("Polygon", "MultiPolygon") or self.polygons.is_empty:
            raise InputError(f"refinement inside a {self.polygons.geom_type}; polygons with an area are needed")
        if not self.polygons.is_valid:
            raise InputError(f"polygons of the refinement: {shapely.is_valid_reason(self.polygons)}; repair them")

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Heights of the pixel centres of a window of a map target, shape (height, width), metres; NaN: no surface."""
        if not isinstance(target, MapTarget):
            raise UsageError(f"a refined surface gives relief for map targets, not for {type(target).__name__}")
        box = shapely.box(*target.grid.bounds_of(window))
        if not self.polygons.intersects(box):
            return self.coarse.relief(target, window)
        coarse, fine = self.coarse.relief(target, window), self.fine.relief(target, window)
        v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        weights = self.weights(target.grid.to_map(np.stack([u, v], axis=-1)))
        return _blended(coarse, fine, weights).astype(np.float32)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Height at map points (..., 2), shape (...), metres; NaN where there is no surface."""
        XY = np.asarray(XY, float)
        return _blended(self.coarse.heights(XY), self.fine.heights(XY), self.weights(XY))

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Bounds of both surfaces inside map bounds (..., 4), shape (..., 2), metres; NaN, NaN where there is none."""
        a, b = self.coarse.height_range(bounds), self.fine.height_range(bounds)
        return np.stack([np.fmin(a[..., 0], b[..., 0]), np.fmax(a[..., 1], b[..., 1])], axis=-1)

    def weights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Weight of the fine surface at map points (..., 2), shape (...): 0 outside, 1 inside the band.

        NaN outside the polygons, where the fine surface does not count at all.
        """
        XY = np.asarray(XY, float)
        flat = XY.reshape(-1, 2)
        weights = np.full(len(flat), np.nan)
        there = np.isfinite(flat).all(axis=1)
        if there.any():
            weights[there] = self._weights(flat[there])
        return weights.reshape(XY.shape[:-1])

    def _weights(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = XY.min(axis=0), XY.max(axis=0)
        margin = self.transition + 1e-3 + 1e-9 * float(np.abs(XY).max())
        near = shapely.clip_by_rect(self.polygons, *(low - margin), *(high + margin))
        border = shapely.clip_by_rect(self.polygons.boundary, *(low - margin), *(high + margin))
        shapely.prepare(near)
        inside = shapely.intersects_xy(near, XY)
        weights = np.where(inside, 1.0, np.nan)
        if self.transition > 0 and not border.is_empty:
            t = np.minimum(shapely.distance(border, shapely.points(XY[inside])) / self.transition, 1.0)
            weights[inside] = t * t * (3 - 2 * t)
        return weights


def _blended(coarse: NDArray[Any], fine: NDArray[Any], weights: NDArray[np.float64]) -> NDArray[Any]:
    """The sum of both with the weights; one where the other is missing, and coarse where the weight is NaN."""
    both = coarse + weights * (fine - coarse)
    inside = np.isfinite(weights)
    inner = np.where(np.isnan(fine), coarse, np.where(np.isnan(coarse), fine, both))
    return np.asarray(np.where(inside, inner, coarse))
