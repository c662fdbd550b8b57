"""Hillshade, slope and aspect of any surface, at the pixels of a map grid.

Slopes come from the surface itself: differences of its heights half a pixel to the left and right and above and below
each pixel's centre. Inside a face they are the face's own; a breakline shows in the pixels that it passes and in no
others. Where the surface ends inside a pixel, the half that is left is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.gradient import gradients, illumination
from photoplan.surfaces.base import Surface
from photoplan.targets.map import MapTarget

#: Aspect of a flat place.
FLAT = -1.0
#: Suns of a multidirectional hillshade, from the azimuth that was given.
FAN = (-90.0, -45.0, 0.0, 45.0)


@dataclass(frozen=True)
class Light:
    """Where light comes from, and how much relief is made of the terrain."""

    azimuth: float = 315.0
    """Direction of the sun, degrees clockwise from north."""
    altitude: float = 45.0
    """Its height above the horizon, degrees."""
    exaggeration: float = 1.0
    """Factor of all heights."""
    multidirectional: bool = False
    """Four suns, at the azimuth, 45 degrees to its right, and 45 and 90 to its left, weighted by the squared cosine of
    the angle between their azimuth and the slope's, as `gdaldem hillshade -multidirectional` has it."""

    def __post_init__(self) -> None:
        if not math.isfinite(self.azimuth):
            raise UsageError(f"azimuth {self.azimuth}; degrees clockwise from north are needed")
        if not 0 < self.altitude <= 90:
            raise UsageError(f"altitude {self.altitude} of the sun; more than 0 and up to 90 degrees are needed")
        if not (math.isfinite(self.exaggeration) and self.exaggeration > 0):
            raise UsageError(f"exaggeration {self.exaggeration}; a positive factor is needed")

    @property
    def directions(self) -> NDArray[np.float64]:
        """Unit vectors towards the suns (east, north, up), shape (n, 3)."""
        azimuths = np.radians([self.azimuth + turn for turn in (FAN if self.multidirectional else (0.0,))])
        altitude = math.radians(self.altitude)
        level = math.cos(altitude)
        up = np.full(len(azimuths), math.sin(altitude))
        return np.column_stack([level * np.sin(azimuths), level * np.cos(azimuths), up])

    @property
    def level(self) -> float:
        """Light on flat ground, 0 to 1."""
        return math.sin(math.radians(self.altitude))


@dataclass(frozen=True, eq=False)
class Slopes:
    """Heights and slopes at the pixels of a window."""

    heights: NDArray[np.float32]
    """At the centres, shape (h, w), metres; NaN = no surface."""
    gradient: NDArray[np.float32]
    """dz/dX and dz/dY, shape (2, h, w); NaN where there is no surface on either side of the centre."""
    resolution: float
    """Side of a pixel, metres."""


def surface_slopes(surface: Surface, grid: MapGrid, window: Window) -> Slopes:
    """Heights and slopes of a surface at the pixel centres of a window."""
    half = grid.resolution / 2
    columns = MapGrid(grid.left - half, grid.top, grid.resolution, grid.width + 1, grid.height, grid.crs)
    rows = MapGrid(grid.left, grid.top + half, grid.resolution, grid.width, grid.height + 1, grid.crs)
    middle = surface.relief(MapTarget(grid), window)
    gradient = np.full((2, *middle.shape), np.nan, np.float32)
    if np.isfinite(middle).any():
        across = surface.relief(MapTarget(columns), Window(window.col, window.row, window.width + 1, window.height))
        along = surface.relief(MapTarget(rows), Window(window.col, window.row, window.width, window.height + 1))
        gradients(across, along, middle, grid.resolution, gradient)
    return Slopes(middle, gradient, grid.resolution)


def hillshade(slopes: Slopes, light: Light) -> NDArray[np.float32]:
    """Light on a matt surface (Lambert), shape (h, w), 0 to 1; NaN = no surface."""
    result = np.empty(slopes.heights.shape, np.float32)
    illumination(slopes.gradient, light.exaggeration, light.directions, light.multidirectional, result)
    return result


def grey(shade: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A hillshade as grey values 1 to 255; 0 where there is no surface."""
    empty = np.isnan(shade)
    return np.where(empty, 0, np.rint(1 + 254 * np.where(empty, 0, shade))).astype(np.uint8)


def slope_degrees(slopes: Slopes) -> NDArray[np.float32]:
    """Inclination, degrees, shape (h, w); NaN = no surface."""
    return np.degrees(np.arctan(_steepness(slopes)))


def slope_percent(slopes: Slopes) -> NDArray[np.float32]:
    """Rise over horizontal distance, percent, shape (h, w); NaN = no surface."""
    return 100 * _steepness(slopes)


def _steepness(slopes: Slopes) -> NDArray[np.float32]:
    return np.hypot(slopes.gradient[0], slopes.gradient[1])


def slope_classes(values: NDArray[np.float32], limits: tuple[float, ...]) -> NDArray[np.uint8]:
    """Number of each value's class: 1 below the first limit, 2 from there to the second …; 0 for NaN.

    Raises
    ------
    UsageError
        The limits do not rise, or there are more than 254.
    """
    if not limits or len(limits) > 254 or not (np.diff(limits) > 0).all() or not np.isfinite(limits).all():
        raise UsageError(f"class limits {limits}; one to 254 rising numbers are needed")
    classes = 1 + np.searchsorted(np.array(limits), values, side="right")
    return np.where(np.isnan(values), 0, classes).astype(np.uint8)


def aspect(slopes: Slopes) -> NDArray[np.float32]:
    """Direction in which the surface falls, degrees clockwise from north, 0 to below 360, shape (h, w).

    -1 where it is flat, which is where heights differ by no more than the rounding of the float32 numbers that they
    come in; NaN where there is no surface.
    """
    gx, gy = slopes.gradient
    direction = np.degrees(np.arctan2(-gx, -gy)) % 360
    direction = np.where(direction >= 360, 0, direction)
    with np.errstate(invalid="ignore"):
        rounding = 2 * np.spacing(np.abs(slopes.heights)) / slopes.resolution
        flat = np.hypot(gx, gy) <= rounding
    return np.where(flat, FLAT, direction).astype(np.float32)
