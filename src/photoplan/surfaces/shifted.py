"""Shifted and flooded surfaces, and intersections of rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera, Rays
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import Hits, Lattice, LevelSurface, Terrain, chords
from photoplan.surfaces.objects import ObjectSurface
from photoplan.targets.map import Target

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


@dataclass(frozen=True)
class ShiftedSurface:
    """A surface plus a smooth shift of heights, such as the geoid's height above the ellipsoid."""

    surface: Terrain
    shift: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    """Shift of the heights at map points (..., 2), metres, shape (...). It is evaluated at nine points of a
    tile and bilinear between them: a geoid bends by less than a millimetre over a tile."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Relief of the surface with the shift added; NaN where there is no surface."""
        nodes = self.shift(target.to_ground(_nodes(window))[..., :2])
        return _raised(self.surface.relief(target, window), nodes, window)

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """Return that of the surface, with the shift added."""
        own = self.surface.lattice(grid, window)

        def read(part: Window) -> NDArray[np.float32]:
            nodes = self.shift(grid.to_map(own.to_pixels(_nodes(part)[..., :2])))
            return _raised(own.read(part), nodes, part)

        return replace(own, read=read)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Heights at map points (..., 2) with the shift added."""
        XY = np.asarray(XY, float)
        return self.surface.heights(XY) + self.shift(XY)

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Range of the surface in map bounds (..., 4), widened by the range of the shift at corners and middle."""
        bounds = np.asarray(bounds, float)
        part = np.array([0.0, 0.5, 1.0])
        x = bounds[..., None, 0:1] + part * (bounds[..., None, 2:3] - bounds[..., None, 0:1])
        y = bounds[..., 1:2, None] + part[:, None] * (bounds[..., 3:4, None] - bounds[..., 1:2, None])
        shift = self.shift(np.stack(np.broadcast_arrays(x, y), axis=-1)).reshape(*bounds.shape[:-1], 9)
        return self.surface.height_range(bounds) + np.stack([shift.min(axis=-1), shift.max(axis=-1)], axis=-1)

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Return where rays first come down onto the surface; see `Terrain.first_hit`."""
        given = np.asarray(paths, float)
        fine, carried = chords(given, bend, self._lowered)
        hits = self.surface.first_hit(carried)
        there = np.isfinite(hits.along)
        hits.XYZ[there, 2] += self.shift(hits.XYZ[there, :2])
        hits.along[there] *= (given.shape[1] - 1) / (fine.shape[1] - 1)
        return hits

    def _lowered(self, XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points as the surface that was shifted has them."""
        return np.concatenate([XYZ[..., :2], XYZ[..., 2:] - self.shift(XYZ[..., :2])[..., None]], axis=-1)


def _nodes(window: Window) -> NDArray[np.float64]:
    """(u, v, 0) of nine places over a window, from its first to its last pixel, shape (3, 3, 3)."""
    u = np.linspace(window.col, window.stop[0] - 1, 3)
    v = np.linspace(window.row, window.stop[1] - 1, 3)
    return np.stack([*np.meshgrid(u, v), np.zeros((3, 3))], axis=-1)


def _raised(heights: NDArray[np.float32], shift: NDArray[np.float64], window: Window) -> NDArray[np.float32]:
    """Heights of a window with a shift added that is bilinear between its nodes."""
    u, v, _ = _nodes(window).T
    along_v = np.arange(window.row, window.stop[1])
    along_u = np.arange(window.col, window.stop[0])
    columns = np.stack([np.interp(along_v, v[0], shift[:, i]) for i in range(3)], axis=1)
    full = np.stack([np.interp(along_u, u[:, 0], row) for row in columns])
    return (heights + full).astype(np.float32)


@dataclass(frozen=True, eq=False)
class FloodedSurface:
    """The terrain where it is higher than the water, else the water."""

    ground: Terrain
    level: float
    """Height of the water, metres."""
    bounds: tuple[float, float, float, float] | None
    """Map bounds xmin, ymin, xmax, ymax beyond which there is no water; None: it has no end."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Heights of the pixels of a window of a map target; NaN where there is neither ground nor water."""
        v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        XYZ = target.to_ground(np.stack([u, v, np.zeros_like(u)], axis=-1))
        return self._raised(self.ground.relief(target, window), XYZ).astype(np.float32)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Return heights at map points (..., 2), shape (...), as `relief` does at pixels."""
        XY = np.asarray(XY, float)
        return self._raised(self.ground.heights(XY), XY)

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Bounds of ground and water inside map bounds (..., 4), shape (..., 2)."""
        return np.asarray(np.fmax(self.ground.height_range(bounds), self.level))

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """The pixels of the map."""
        return Lattice.of_relief(self, grid)

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Return what rays meet first: the ground, as `Terrain.first_hit` has it, or the water, whose Z is `level`."""
        ground, water = self.ground.first_hit(paths, bend), LevelSurface(self.level).first_hit(paths, bend)
        first = ~(ground.along <= water.along) & np.isfinite(water.along) & self._inside(water.XYZ)
        water.XYZ[:, 2] = self.level
        for name, values in vars(ground).items():
            values[first] = getattr(water, name)[first]
        return ground

    def _inside(self, XY: NDArray[np.float64]) -> NDArray[np.bool_]:
        if self.bounds is None:
            return np.ones(XY.shape[:-1], bool)
        xmin, ymin, xmax, ymax = self.bounds
        X, Y = XY[..., 0], XY[..., 1]
        return (xmin <= X) & (xmax >= X) & (ymin <= Y) & (ymax >= Y)

    def _raised(self, heights: NDArray[np.floating], XY: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(self._inside(XY), np.fmax(heights, self.level), heights)


def flooded(terrain: Terrain, level: float, bounds: tuple[float, float, float, float] | None) -> Terrain:
    """Terrain under water of a level, metres; objects stand in it."""
    if isinstance(terrain, ObjectSurface):
        return replace(terrain, ground=FloodedSurface(terrain.ground, level, bounds))
    return FloodedSurface(terrain, level, bounds)
