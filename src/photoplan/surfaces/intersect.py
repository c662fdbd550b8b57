"""Image points onto a surface."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import CentralCamera
from photoplan.surfaces.base import Surface
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.profile import profile
from photoplan.surfaces.raster import RasterSurface


def intersect(
    camera: CentralCamera,
    xy: ArrayLike,
    surface: Surface,
    height_range: tuple[float, float],
    steps: int = 64,
    precision: float = 1e-4,
) -> NDArray[np.float64]:
    """First point of the surface that each image ray meets, coming from the camera.

    Parameters
    ----------
    camera : CentralCamera
    xy : array_like, shape (n, 2)
        Image points in pixels.
    surface : Surface
    height_range : (float, float)
        Heights between which the surface is looked for, metres.
    steps : int
        Levels at which the ray is compared with the surface. An obstacle thinner than a level apart can be missed.
    precision : float
        Height to which the point is refined, metres.

    Returns
    -------
    ndarray, shape (n, 3)
        X, Y, Z; NaN where the ray does not meet the surface between the two heights (it looks up, passes beyond the
        terrain or crosses a hole).
    """
    xy = np.asarray(xy, float)
    low, high = height_range
    high = min(high, float(camera.center[2]))
    found = np.full((len(xy), 3), np.nan)
    if not (np.isfinite([low, high]).all() and low <= high):
        return found
    levels = np.linspace(high + precision, low - precision, max(2, steps))
    upper = np.full(len(xy), np.nan)
    lower = np.full(len(xy), np.nan)
    open_ = np.ones(len(xy), bool)
    for above, level in itertools.pairwise(levels):
        point = _at_height(camera, xy, np.full(len(xy), level))
        hit = open_ & (surface.heights(point[:, :2]) >= level)
        upper[hit], lower[hit] = above, level
        open_ &= ~hit
        if not open_.any():
            break
    there = np.isfinite(upper)
    while there.any() and (upper[there] - lower[there]).max() > precision:
        middle = (upper + lower) / 2
        point = _at_height(camera, xy[there], middle[there])
        under = surface.heights(point[:, :2]) >= middle[there]
        index = np.flatnonzero(there)
        lower[index[under]] = middle[index[under]]
        upper[index[~under]] = middle[index[~under]]
    if there.any():
        found[there] = _at_height(camera, xy[there], (upper[there] + lower[there]) / 2)
    return found


def intersect_strict(
    camera: CentralCamera,
    xy: ArrayLike,
    surface: HybridSurface | RasterSurface,
    height_range: tuple[float, float],
    tolerance: float = 0.001,
) -> NDArray[np.float64]:
    """First point of the surface that each image ray meets, from the profile of the surface below the ray.

    No ridge and no wall is missed, however thin: where the ray meets the face of a wall, the point lies on it. Slower
    than `intersect`: for single points, such as those that a person measures.

    Parameters
    ----------
    camera : CentralCamera
    xy : array_like, shape (n, 2)
        Image points in pixels.
    surface : HybridSurface or RasterSurface
        In the CRS of the camera.
    height_range : (float, float)
        Heights between which the surface is looked for, metres. In between, rays are taken as straight.
    tolerance : float
        Of the profile, metres.

    Returns
    -------
    ndarray, shape (n, 3)
        X, Y, Z; NaN where the ray does not meet the surface from above: it looks up, passes beyond the terrain, or
        goes below the terrain through a gap or the model's border.
    """
    xy = np.asarray(xy, float)
    low, high = height_range
    high = min(high, float(camera.center[2]))
    found = np.full((len(xy), 3), np.nan)
    if not (np.isfinite([low, high]).all() and low <= high):
        return found
    # A little more on both sides, so that a level surface lies between.
    upper = _at_height(camera, xy, np.full(len(xy), high + tolerance))
    lower = _at_height(camera, xy, np.full(len(xy), low - tolerance))
    for i in np.flatnonzero(np.isfinite(upper).all(axis=1) & np.isfinite(lower).all(axis=1)):
        found[i] = _first_hit(surface, upper[i], lower[i], tolerance)
    return found


def _first_hit(
    surface: HybridSurface | RasterSurface, upper: NDArray[np.float64], lower: NDArray[np.float64], tolerance: float
) -> NDArray[np.float64]:
    """Where the straight line from an upper to a lower point first comes down to the surface."""
    nowhere = np.full(3, np.nan)
    length = float(np.hypot(*(lower - upper)[:2]))
    if length < tolerance * 1e-3:
        height = float(surface.heights(upper[:2]))
        return np.array([*upper[:2], height]) if lower[2] <= height <= upper[2] else nowhere
    distance, _, _, Z = profile(surface, [upper[:2], lower[:2]], tolerance)
    above = upper[2] + distance / length * (lower[2] - upper[2]) - Z
    with np.errstate(invalid="ignore"):
        hit = np.flatnonzero((above[:-1] >= 0) & (above[1:] <= 0))
    if not hit.size:
        return nowhere
    k = hit[0]
    drop = above[k] - above[k + 1]
    t = (distance[k] + (distance[k + 1] - distance[k]) * (above[k] / drop if drop > 0 else 0.0)) / length
    return np.asarray(upper + t * (lower - upper))


def _at_height(camera: CentralCamera, xy: NDArray[np.float64], height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of the rays at given heights; NaN for rays that do not go down."""
    origin, direction = camera.rays(xy, float(np.mean(height)))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (height - origin[..., 2]) / direction[..., 2]
        point = origin + t[..., None] * direction
    return np.where(direction[..., 2:] < 0, point, np.nan)
