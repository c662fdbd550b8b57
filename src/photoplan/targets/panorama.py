"""Pictures of more than a camera sees: cylinders and spheres around a point."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError


@dataclass(frozen=True, eq=False)
class Panorama:
    """The rays of a panorama: columns are directions on the map, clockwise, at equal angles.

    On a cylinder (h = horizontal distance) verticals stay straight and rows are tangents of elevations; on a sphere (an
    equirectangular panorama, h = distance) rows are elevations at equal angles.
    """

    center: NDArray[np.float64]
    """The point of view, shape (3,)."""
    size: tuple[int, int]
    """Width and height, pixels."""
    azimuth: float
    """Direction of the middle, radians clockwise from north."""
    scale: float
    """Pixels per radian."""
    horizon: float
    """Row of the horizon."""
    spherical: bool = False
    upright: bool = field(default=True, init=False)
    """Columns are vertical planes."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0 and min(self.size) >= 1):
            raise UsageError(f"panorama of {self.size} pixels, {self.scale} per radian; positive numbers are needed")
        if self.size[0] > 2 * math.pi * self.scale * (1 + 1e-9):
            raise UsageError(f"panorama over {math.degrees(self.size[0] / self.scale):.6g}°; at most 360 are there")

    def directions(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Directions (..., 3): of horizontal length one on a cylinder, of length one on a sphere."""
        uv = np.asarray(uv, float)
        azimuth = self.azimuth + (uv[..., 0] - (self.size[0] - 1) / 2) / self.scale
        rise = (self.horizon - uv[..., 1]) / self.scale
        level, up = np.ones_like(rise), rise
        if self.spherical:
            level, up = np.where(np.abs(rise) <= math.pi / 2, np.cos(rise), np.nan), np.sin(rise)
        return np.stack([level * np.sin(azimuth), level * np.cos(azimuth), up], axis=-1)

    def pixels(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Pixel and depth (..., 3), columns within half a turn of the middle; NaN at the point of view itself."""
        away = np.asarray(XYZ, float) - self.center
        level = np.hypot(away[..., 0], away[..., 1])
        turn = np.arctan2(away[..., 0], away[..., 1]) - self.azimuth
        turn = (turn + math.pi) % (2 * math.pi) - math.pi
        with np.errstate(divide="ignore", invalid="ignore"):
            rise = np.arctan2(away[..., 2], level) if self.spherical else away[..., 2] / level
        h = np.linalg.norm(away, axis=-1) if self.spherical else level
        out = np.stack([(self.size[0] - 1) / 2 + self.scale * turn, self.horizon - self.scale * rise, h], axis=-1)
        out[~(h > 0)] = np.nan
        return out
