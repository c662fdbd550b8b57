"""Image points onto a surface."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera
from photoplan.surfaces.base import Surface

__all__ = ["intersect"]


def intersect(
    camera: Camera,
    xy: ArrayLike,
    surface: Surface,
    height_range: tuple[float, float],
    steps: int = 64,
    precision: float = 1e-4,
) -> NDArray[np.float64]:
    """First point of the surface that each image ray meets, coming from the camera.

    Parameters
    ----------
    camera : Camera
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


def _at_height(camera: Camera, xy: NDArray[np.float64], height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of the rays at given heights; NaN for rays that do not go down."""
    origin, direction = camera.rays(xy, float(np.mean(height)))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (height - origin[..., 2]) / direction[..., 2]
        point = origin + t[..., None] * direction
    return np.where(direction[..., 2:] < 0, point, np.nan)
