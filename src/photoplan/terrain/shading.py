"""Shaded relief, slope and tint: options and kernels.

Slopes come from the surface itself: differences of its heights half a pixel to the left and right and above and below
each pixel's centre. Inside a face they are the face's own; a breakline shows in the pixels that it passes and in no
others. Where the surface ends inside a pixel, the half that is left is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.terrain import gradients, illumination
from photoplan.request import Request, opt
from photoplan.surfaces.base import Surface, Terrain
from photoplan.surfaces.raster import RasterSurface
from photoplan.targets.map import MapTarget


class ContourOptions(Request):
    """Which contours are traced, and how."""

    interval: float = opt("Height difference of neighbouring contours, metres.", gt=0, metavar="M")
    base: float = opt("Height that contours are counted from, metres.", 0.0)
    index: int = opt("Number of contours from one index contour to the next; 0 for none.", 5, ge=0)
    smooth: bool = opt("Smooth lines inside their band; they never cross.", False)
    simplify: bool = opt("Leave out vertices inside the band; lines never cross.", False)
    band: float = opt("Half width of the band, as a part of the interval.", 0.25, gt=0, lt=0.5)
    shortest: float = opt("Leave out lines shorter than this, metres.", 0.0, ge=0)


class Lighting(Request):
    """Direction of the light, and exaggeration of the terrain."""

    azimuth: float = opt("Direction of the sun, degrees clockwise from north.", 315.0)
    altitude: float = opt("Height of the sun above the horizon, degrees.", 45.0, gt=0, le=90)
    exaggeration: float = opt("Factor of all heights.", 1.0, ge=0.01, le=1000)
    # At the azimuth, 45 degrees to its right, and 45 and 90 to its left, weighted by the squared cosine of the angle
    # between their azimuth and the slope's, as `gdaldem hillshade -multidirectional` has it.
    multidirectional: bool = opt("Four suns instead of one.", False)

    @property
    def level(self) -> float:
        """Light on flat ground, 0 to 1."""
        return math.sin(math.radians(self.altitude))


#: Half the distance of two posts at most over which slopes are means, pixels.
_WIDEST = 64
#: Aspect of a flat place.
FLAT = -1.0
#: Suns of a multidirectional hillshade, from the azimuth that was given.
FAN = (-90.0, -45.0, 0.0, 45.0)


def directions(light: Lighting) -> NDArray[np.float64]:
    """Return unit vectors towards the suns (east, north, up), shape (n, 3)."""
    azimuths = np.radians([light.azimuth + turn for turn in (FAN if light.multidirectional else (0.0,))])
    altitude = math.radians(light.altitude)
    level = math.cos(altitude)
    up = np.full(len(azimuths), math.sin(altitude))
    return np.column_stack([level * np.sin(azimuths), level * np.cos(azimuths), up])


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
    """Heights and slopes of a surface at the pixel centres of a window.

    In the outer half cell of a raster, where its heights go on level, the slope is that between the outer two posts.
    """
    half = grid.resolution / 2
    columns = MapGrid(
        left=grid.left - half,
        top=grid.top,
        resolution=grid.resolution,
        width=grid.width + 1,
        height=grid.height,
        crs=grid.crs,
    )
    rows = MapGrid(
        left=grid.left,
        top=grid.top + half,
        resolution=grid.resolution,
        width=grid.width,
        height=grid.height + 1,
        crs=grid.crs,
    )
    middle = surface.relief(MapTarget(grid), window)
    gradient = np.full((2, *middle.shape), np.nan, np.float32)
    if np.isfinite(middle).any():
        centre = middle
        if isinstance(surface, RasterSurface):
            surface = surface.continued()
            centre = np.where(np.isnan(middle), np.float32(np.nan), surface.relief(MapTarget(grid), window))
        across = surface.relief(MapTarget(columns), Window(window.col, window.row, window.width + 1, window.height))
        along = surface.relief(MapTarget(rows), Window(window.col, window.row, window.width, window.height + 1))
        gradients(across, along, centre, grid.resolution, gradient)
    return Slopes(middle, gradient, grid.resolution)


def even_slopes(surface: Terrain, grid: MapGrid, window: Window) -> Slopes:
    """Compute slopes as `surface_slopes`, without steps at posts further apart than pixels: means over two of them."""
    reach = int(min(0.5 / surface.lattice(grid, window).per_pixel, _WIDEST))
    wide = Window(window.col - reach, window.row - reach, window.width + 2 * reach, window.height + 2 * reach)
    slopes, at = surface_slopes(surface, grid, wide), window.slices(wide)
    gradient = np.stack([_mean(each, 2 * reach + 1, axis)[at] for each, axis in zip(slopes.gradient, (1, 0))])
    return Slopes(np.ascontiguousarray(slopes.heights[at]), gradient, slopes.resolution)


def _mean(values: NDArray[np.floating], length: int, axis: int) -> NDArray[np.floating]:
    """Means over a length of those that are known, along an axis; NaN stays."""
    known = np.isfinite(values)
    if length == 1:
        return values
    total, count = (
        uniform_filter1d(each, length, axis, mode="constant")
        for each in (np.where(known, values, 0.0).astype(float), known.astype(float))
    )
    return np.asarray(np.where(known, total / np.maximum(count, 1e-9), np.nan), np.float32)


def hillshade(slopes: Slopes, light: Lighting) -> NDArray[np.float32]:
    """Light on a matt surface (Lambert), shape (h, w), 0 to 1; NaN = no surface."""
    result = np.empty(slopes.heights.shape, np.float32)
    illumination(slopes.gradient, light.exaggeration, directions(light), light.multidirectional, result)
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
    """Number of each value's class: 1 below the first limit, 2 from there to the second …; 0 for NaN."""
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


#: Colours from the lowest to the highest place, red, green, blue.
RAMPS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "hypsometric": (
        (86, 135, 92),
        (139, 169, 110),
        (200, 202, 142),
        (231, 219, 168),
        (214, 181, 128),
        (180, 139, 99),
        (146, 112, 96),
        (190, 182, 182),
        (250, 250, 250),
    ),
    "grey": ((40, 40, 40), (245, 245, 245)),
    "spectral": ((50, 60, 150), (60, 150, 190), (120, 200, 140), (240, 235, 140), (235, 150, 70), (170, 40, 50)),
}


@dataclass(frozen=True, eq=False)
class Ramp:
    """Colours at rising heights."""

    heights: NDArray[np.float64]
    """Metres, rising, shape (n,)."""
    colours: NDArray[np.float64]
    """Red, green, blue, 0 to 255, shape (n, 3)."""
    classed: bool = False
    """A height has the colour of the entry at or below it; else colours are interpolated. Beyond the ends the first
    and the last colour hold."""

    def __post_init__(self) -> None:
        if len(self.heights) < 1 or self.colours.shape != (len(self.heights), 3):
            raise InputError(f"colour ramp of {len(self.heights)} heights and colours of shape {self.colours.shape}")
        if not (np.diff(self.heights) > 0).all() or not np.isfinite(self.heights).all():
            raise InputError("colour ramp: heights must be finite and rise from entry to entry")
        if not ((self.colours >= 0) & (self.colours <= 255)).all():
            raise InputError("colour ramp: red, green and blue must be from 0 to 255")

    def __call__(self, heights: NDArray[np.float32]) -> NDArray[np.float32]:
        """Colours of heights (h, w), shape (3, h, w), 0 to 255; NaN where the height is NaN."""
        empty = np.isnan(heights)
        if self.classed:
            at = np.clip(np.searchsorted(self.heights, heights, side="right") - 1, 0, len(self.heights) - 1)
            bands = [self.colours[at, k] for k in range(3)]
        else:
            bands = [np.interp(heights, self.heights, self.colours[:, k]) for k in range(3)]
        return np.where(empty, np.nan, np.stack(bands)).astype(np.float32)


def built_in_ramp(name: str, low: float, high: float, steps: int | None = None) -> Ramp:
    """A ramp of `RAMPS` between two heights."""
    if name not in RAMPS:
        raise UsageError(f"colour ramp {name!r}; built in are {', '.join(RAMPS)}, anything else is the name of a file")
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise UsageError(f"heights of the ramp from {low} to {high}; two rising numbers are needed")
    colours = np.array(RAMPS[name], float)
    smooth = Ramp(np.linspace(low, high, len(colours)), colours)
    if steps is None:
        return smooth
    if not 1 <= steps <= 1000:
        raise UsageError(f"{steps} height classes; 1 to 1000 are allowed")
    lower = low + (high - low) * np.arange(steps) / steps
    middle = low + (high - low) * (np.arange(steps) / max(steps - 1, 1))
    picked = [np.interp(middle, smooth.heights, colours[:, k]) for k in range(3)]
    return Ramp(lower, np.column_stack(picked), classed=True)


def parse_ramp(text: str, name: str, classed: bool = False) -> Ramp:
    """A ramp of a text: lines `height red green blue`, separated by blanks, commas or tabs; `#` begins a remark."""
    rows: list[list[float]] = []
    for number, line in enumerate(text.lstrip("\ufeff").splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not words or words[0].lower() == "nv":
            continue
        try:
            row = [float(word) for word in words[:4]]
        except ValueError:
            row = []
        if len(row) < 4 or not all(map(math.isfinite, row)) or not all(0 <= c <= 255 for c in row[1:]):
            raise InputError(
                f"{name}, line {number}: {line.strip()!r}; needed are a height in metres and red, green and blue from "
                "0 to 255"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{name}: no line with a height and a colour; write for example `500 200 180 120`")
    table = np.array(sorted(rows))
    twice = table[:-1, 0][np.diff(table[:, 0]) == 0]
    if len(twice):
        raise InputError(f"{name}: height {twice[0]:g} has two colours; keep one of them")
    return Ramp(table[:, 0], table[:, 1:], classed)


def shaded(
    colours: NDArray[np.float32], shade: NDArray[np.float32], level: float, strength: float = 0.6
) -> NDArray[np.float32]:
    """Colours darkened and lightened by a hillshade; flat ground keeps its colour."""
    shade = np.where(np.isnan(shade), np.float32(level), shade)
    dark = np.minimum(shade / level, 1)
    bright = np.maximum(shade - level, 0) / max(1 - level, 1e-6)
    # Light slopes go half way to white at most: their colour must still be read.
    return (colours * (1 - strength * (1 - dark)) + (255 - colours) * (0.5 * strength * bright)).astype(np.float32)
