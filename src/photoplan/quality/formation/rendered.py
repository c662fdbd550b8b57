"""Images of a surface whose place and colours are known: one ray for each cell of the scene, to what it meets first.

What a camera is needed for is its rays: frame and line cameras, fisheyes and maps seen from above alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Rays
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import Hits, Terrain
from photoplan.surfaces.shifted import ray_paths

_Array = NDArray[np.float64]
#: Rays that are followed at once.
_BATCH = 200_000
#: Rows of the table of objects' colours.
_TINTS = 4096
#: Where light comes from: from the north-west, halfway up.
_LIGHT = np.array([-0.5, 0.5, np.sqrt(0.5)])
#: Mean grey values of objects, before shading; of the ground; and the standard deviation of the pattern on all of them.
_OBJECTS, _GROUND, _CONTRAST = (110.0, 215.0), (105.0, 125.0, 90.0), 15.0
#: Waves of the pattern, and the longest wavelength in those of the shortest.
_WAVES, _LONGEST = 32, 12.0


@dataclass(frozen=True)
class FromAbove:
    """A map grid as a camera: what lies uppermost at its pixels, by vertical rays."""

    grid: MapGrid
    top: float
    """A height that nothing exceeds, metres."""

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.grid.width, self.grid.height

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[_Array, _Array]:
        """Points above the pixels, and the way down."""
        XY = self.grid.to_map(xy)
        origin = np.concatenate([XY, np.full((*XY.shape[:-1], 1), self.top)], axis=-1)
        return origin, np.broadcast_to(np.array([0.0, 0.0, -1.0]), origin.shape)


class Texture(Protocol):
    """Colours of a scene."""

    @property
    def bands(self) -> int:
        """Number of bands."""
        ...

    def __call__(self, hits: Hits) -> _Array:
        """Grey values, 0 to 255, of what neighbouring rays meet, shape (bands, n); 0 where they meet nothing."""
        ...


@dataclass(frozen=True)
class SolidTexture:
    """A pattern that fills space, and a colour of its own for each object: known at every place without a raster.

    The pattern is a sum of waves of random direction (a solid texture: Perlin 1985; Peachey 1985). No face shows a
    shorter wavelength than space has, and nothing breaks where faces meet; so what is finer than a pixel never appears,
    and positions can be found by matching anywhere. Faces are shaded by their slope, so that roofs show their ridges.
    """

    finest: float
    """Shortest wavelength, metres."""
    seed: int = 0
    bands: int = 3

    @cached_property
    def _waves(self) -> tuple[_Array, _Array]:
        """Wave vectors (3, m), radians per metre, and phases (m,)."""
        rng = np.random.default_rng([self.seed, 0])
        way = rng.normal(size=(3, _WAVES))
        length = self.finest * _LONGEST ** np.linspace(0.0, 1.0, _WAVES)
        return way / np.linalg.norm(way, axis=0) * (2 * np.pi / length), rng.uniform(0, 2 * np.pi, _WAVES)

    @cached_property
    def _tints(self) -> _Array:
        """Mean grey values of objects, shape (_TINTS, bands)."""
        return np.random.default_rng([self.seed, 1]).uniform(*_OBJECTS, (_TINTS, self.bands))

    def __call__(self, hits: Hits) -> _Array:
        """Grey values, see `Texture`."""
        waves, phases = self._waves
        pattern = np.cos(hits.XYZ @ waves + phases).sum(axis=1) * (_CONTRAST * np.sqrt(2.0 / _WAVES))
        ground = np.resize(_GROUND, self.bands)
        shade = 0.6 + 0.4 * np.abs(hits.normal @ _LIGHT)
        mean = np.where(hits.owner[:, None] <= 0, ground, self._tints[hits.owner % _TINTS] * shade[:, None])
        return np.nan_to_num(np.clip(mean.T + pattern, 1.0, 255.0))


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """What a camera sees of a surface, as a scene for the image formation model.

    Cells are values at their middles; a pixel's light is the mean of oversampling² of them or, with a spread function,
    as many as that reaches.
    """

    camera: Rays
    surface: Terrain
    texture: Texture
    heights: tuple[float, float]
    """Between which the surface lies, metres; see `ray_paths` for curved rays."""
    oversampling: int = 2

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        return self.camera.size

    @property
    def bands(self) -> int:
        """Those of the texture."""
        return self.texture.bands

    @property
    def continuous(self) -> bool:
        """The scene is no mosaic of squares."""
        return True

    def cells(self, window: Window) -> _Array:
        """Cells of a window of pixels, shape (bands, height · k, width · k); where rays meet nothing they are 0."""
        k = self.oversampling
        x = (np.arange(window.width * k) + 0.5) / k - 0.5 + window.col
        y = (np.arange(window.height * k) + 0.5) / k - 0.5 + window.row
        out = np.empty((self.bands, len(y), len(x)))
        rows = max(1, _BATCH // len(x))
        for first in range(0, len(y), rows):
            part = slice(first, first + rows)
            xy = np.stack(np.meshgrid(x, y[part]), axis=-1).reshape(-1, 2)
            out[:, part] = self.texture(self.hits(xy)).reshape(self.bands, -1, len(x))
        return out

    def means(self, window: Window) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Means of the cells of pixels, shape (bands, height, width), and those that show something everywhere."""
        k = self.oversampling
        cells = self.cells(window).reshape(self.bands, window.height, k, window.width, k)
        valid = np.asarray((cells > 0).all(axis=(0, 2, 4)))
        return np.rint(cells.mean(axis=(2, 4)) * valid).astype(np.uint8), valid

    def places(self, window: Window, origin: _Array) -> NDArray[np.float32]:
        """X, Y, Z from an origin (3,) and object at the middles of pixels, shape (4, height, width); NaN: nothing."""
        y, x = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        hits = self.hits(np.stack([x, y], axis=-1).reshape(-1, 2))
        owner = np.where(np.isfinite(hits.along), hits.owner, np.nan)
        return np.column_stack([hits.XYZ - origin, owner]).T.reshape(4, *x.shape).astype(np.float32)

    def hits(self, xy: ArrayLike) -> Hits:
        """What the rays of image points (n, 2) meet first."""
        return self.surface.first_hit(ray_paths(self.camera, xy, self.heights))
