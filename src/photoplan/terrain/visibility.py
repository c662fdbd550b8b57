"""Visibility from a point over a grid of heights, with earth curvature and refraction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.events import Map
from photoplan.geometry.local import MEAN_RADIUS
from photoplan.kernels.rays import pyramid_of
from photoplan.kernels.visibility import least_visible_heights

#: Rows that one task of a thread computes.
ROWS = 32


@dataclass(frozen=True)
class Observer:
    """Observer of a visibility map."""

    column: float
    """Column of the grid (0 = middle of the first pixel); need not be whole."""
    row: float
    eye: float
    """Height of the eye in the height system of the grid, metres."""
    name: str = ""


@dataclass(frozen=True)
class SightSettings:
    """Options of lines of sight."""

    target_height: float = 0.0
    """Height of the targets above ground, metres."""
    radius: float = math.inf
    """Distance beyond which nothing is looked at, metres."""
    curvature: bool = True
    """Whether the earth is round."""
    refraction: float = 0.13
    """Coefficient of refraction k = earth radius / radius of the line of sight (Ecker 1991, §5.7.6)."""
    earth_radius: float = MEAN_RADIUS
    """Metres."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.target_height) and self.target_height >= 0):
            raise UsageError(f"target height {self.target_height} m; zero or a positive number of metres is needed")
        if not self.radius > 0:
            raise UsageError(f"radius {self.radius} m; a positive number of metres is needed")
        if not -1 <= self.refraction < 1:
            raise UsageError(f"refraction coefficient {self.refraction}; from -1 to below 1, usual is 0.13")
        if not self.earth_radius > 0:
            raise UsageError(f"earth radius {self.earth_radius} m; a positive number of metres is needed")

    @property
    def bend(self) -> float:
        """Drop of the ground below the tangent line of sight per squared distance, 1/m: (1 − k) / 2R.

        Earth curvature lowers it by s² / 2R (Ecker 1991, eq. 5.6), refraction raises it by k s² / 2R (eq. 5.7).
        """
        return (1.0 - self.refraction) / (2.0 * self.earth_radius) if self.curvature else 0.0


def horizon(eye_height: float, settings: SightSettings) -> float:
    """Distance of the horizon over a smooth earth, metres; infinite without curvature."""
    return math.sqrt(eye_height / settings.bend) if settings.bend > 0 else math.inf


def needed_heights(
    heights: NDArray[np.float32],
    mesh: float,
    observer: Observer,
    settings: SightSettings,
    *,
    only_whether: bool,
    run: Map = map,
) -> NDArray[np.float32]:
    """Height above ground from which every post of a grid can be seen.

    Every line of sight is followed from the post to the eye and compared with bilinear terrain at all grid lines that
    it crosses; blocks of meshes that lie below it are skipped by a pyramid of their maxima, which changes no result.
    See `kernels.visibility` for what remains as error.
    """
    rows, columns = heights.shape
    if rows < 2 or columns < 2:
        raise InputError(f"a grid of {columns} × {rows} posts; lines of sight need at least two each way")
    if not (-0.5 <= observer.column <= columns - 0.5 and -0.5 <= observer.row <= rows - 0.5):
        raise InputError(f"observer {observer.name or ''} stands outside the terrain")
    relative = np.empty(heights.shape, np.float32)
    across = np.square(np.arange(columns) - observer.column)
    for row in range(rows):
        distance2 = (across + (row - observer.row) ** 2) * mesh**2
        relative[row] = heights[row].astype(float) - observer.eye - distance2 * settings.bend
    pyramid = pyramid_of(relative)
    out = np.empty(heights.shape, np.float32)
    eye = (float(observer.column), float(observer.row), settings.radius / mesh)

    def part(first: int) -> NDArray[np.float32]:
        rows_here = (first, min(first + ROWS, rows))
        least_visible_heights(relative, pyramid, eye, rows_here, float(settings.target_height), only_whether, out)
        return out[slice(*rows_here)]

    for number, found in enumerate(run(part, range(0, rows, ROWS))):
        out[number * ROWS : (number + 1) * ROWS] = found
    return out


def parts(heights: NDArray[np.float32]) -> int:
    """Items that `needed_heights` gives to `run`."""
    return -(-len(heights) // ROWS)
