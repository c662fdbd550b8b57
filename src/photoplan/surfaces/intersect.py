"""Image points onto terrain."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera, Rays
from photoplan.surfaces.base import Terrain

#: A curved ray is followed along chords that it leaves by less than this, metres …
CURVED = 1e-4
#: … of which there are at most so many.
MOST_CHORDS = 64
#: What is looked through above and below the heights of the terrain, metres.
_MARGIN = 0.01
#: Rays that do not leave the heights of a scene are followed so far on the map, metres.
FAR = 30_000.0


def intersect(
    camera: Camera, xy: ArrayLike, terrain: Terrain, height_range: tuple[float, float]
) -> NDArray[np.float64]:
    """First point of the terrain that each image ray meets, coming from the camera.

    No ridge and no wall is missed, however thin: where the ray meets the face of a wall, the point lies on it.

    Parameters
    ----------
    xy : array_like, shape (n, 2)
        Image points in pixels.
    terrain : Terrain
        In the CRS of the camera.
    height_range : (float, float)
        Heights between which the terrain is looked for, metres.

    Returns
    -------
    ndarray, shape (n, 3)
        X, Y, Z; NaN where the ray does not meet the surface from above between the two heights: it looks up, passes
        beyond the terrain, or goes below it through a hole or the model's border.
    """
    xy = np.asarray(xy, float)
    vantage = camera.vantage
    low = max(height_range[0] - _MARGIN, vantage.floor)
    high = min(height_range[1] + _MARGIN, float(vantage.point[2]) - 1e-6)
    if not (np.isfinite([low, high]).all() and low <= high and len(xy)):
        return np.full((len(xy), 3), np.nan)
    return terrain.first_hit(_paths(camera, xy, high, low)).XYZ


def ray_paths(camera: Rays, xy: ArrayLike, height_range: tuple[float, float]) -> NDArray[np.float64]:
    """Rays of image points through the heights of a scene, whichever way they run: paths for `Terrain.first_hit`."""
    low, high = height_range[0] - _MARGIN, height_range[1] + _MARGIN
    xy = np.asarray(xy, float)
    origin, direction = camera.rays(xy, high)
    if not np.array_equal(origin, camera.rays(xy, low)[0], equal_nan=True):
        return _paths(camera, xy, high, low)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (np.array([[low], [high]]) - origin[:, 2]) / direction[:, 2]
        start = np.maximum(ends.min(axis=0), 0.0)
        end = np.minimum(ends.max(axis=0), start + FAR / np.hypot(direction[:, 0], direction[:, 1]))
        along = np.where(start < end, (start, end), np.nan)
        return np.moveaxis(origin + along[..., None] * direction, 0, 1)


def _paths(camera: Rays, xy: NDArray[np.float64], high: float, low: float) -> NDArray[np.float64]:
    """Rays between two heights as paths (n, k, 3), from above; NaN where they do not come down."""
    ends = _at_height(camera, xy, high), _at_height(camera, xy, low)
    paths = np.stack([end[0] for end in ends], axis=1)
    if np.array_equal(ends[0][1], ends[1][1], equal_nan=True):
        return paths
    while paths.shape[1] <= MOST_CHORDS:
        count = 2 * paths.shape[1] - 1
        levels = np.linspace(high, low, count)
        finer = np.empty((len(xy), count, 3))
        finer[:, ::2] = paths
        finer[:, 1::2] = np.stack([_at_height(camera, xy, level)[0] for level in levels[1::2]], axis=1)
        off = np.abs(finer[:, 1::2] - (paths[:, 1:] + paths[:, :-1]) / 2)
        paths = finer
        # Twice as many chords have a fourth of the error.
        if not (off > 4 * CURVED).any():
            break
    return paths


def _at_height(camera: Rays, xy: NDArray[np.float64], height: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of the rays at a height, NaN for rays that do not go down, and the points that rays start from."""
    origin, direction = camera.rays(xy, height)
    with np.errstate(divide="ignore", invalid="ignore"):
        point = origin + ((height - origin[..., 2]) / direction[..., 2])[..., None] * direction
    point[..., 2] = height
    return np.where(direction[..., 2:] < 0, point, np.nan), origin
