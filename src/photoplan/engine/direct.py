"""The direct method: image pixels are carried to the ground, and painted where they fall (Ecker 1991, §4.6, fig. 4.5).

Gaps remain between them. A pixel whose ray is blocked does not reach the hidden ground behind the obstacle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import CentralCamera, project
from photoplan.engine.execute import Painted, Source, fill_by_distance
from photoplan.geometry.grid import Window
from photoplan.plan.footprint import Tile
from photoplan.plan.product import CompiledTile, ProductPlan, compile_tile
from photoplan.surfaces.base import Surface, Terrain
from photoplan.surfaces.shifted import intersect
from photoplan.targets.map import MapTarget

#: Pixels of the image that are carried at once.
_AT_ONCE = 250_000
#: What is met further than this above or below what the product shows is not of it (walls, what only hides), pixels of
#: the product.
_OFF = 0.1


@dataclass(frozen=True)
class Direct:
    """Places of the pixels of an image in a product, by the direct method."""

    levels: tuple[float, float]
    """Heights between which rays are followed: those of all that the image sees, metres."""
    fill: int = 0
    """Gaps are filled from pixels that are no further away than this, pixels of the product; 0: they are left."""

    def render(self, product: ProductPlan, tile: Tile, sources: Sequence[Source], surface: Surface) -> Painted:
        """A tile, as `photoplan.engine.execute.render` gives it; of its source as much is read as can reach it.

        A pixel is the mean of all pixels of the image whose middles come down in it. A gap is a pixel that the image
        sees and in which none comes down; it is filled by means weighted by one over the square of the distance.
        """
        (row,) = tile.sources
        source, at, pad = sources[row], tile.window, self.fill + 1
        wide = Window(at.col - pad, at.row - pad, at.width + 2 * pad, at.height + 2 * pad)
        compiled = compile_tile(product, replace(tile, window=wide), {row: source.camera}, surface)
        sums, count = np.zeros((source.reader.bands, wide.size)), np.zeros(wide.size)
        for read in _strips(compiled, source):
            self._carry(product, compiled, read, source, cast(Terrain, surface), (sums, count))
        shape = (wide.height, wide.width)
        values = (sums / np.maximum(count, 1)).reshape(-1, *shape)
        valid = count.reshape(shape) > 0
        gaps = _gaps(product, compiled, source, valid)
        if self.fill and gaps.any():
            valid = valid | fill_by_distance(values, valid, gaps, self.fill)
        own = at.slices(wide)
        valid, hidden = valid[own], None if compiled.hidden is None else compiled.hidden[own]
        left = int(np.count_nonzero(gaps[own] & ~valid))
        bare = 0 if hidden is None else int(np.count_nonzero(np.isfinite(compiled.relief[own]) & ~valid & ~hidden))
        if not valid.any():
            return Painted(
                values=None, valid=None, owner=None, hidden=hidden, bare=bare - left, residual=0.0, cells=0, gaps=left
            )
        kind = source.reader.dtype
        cut = values[(slice(None), *own)] * valid
        typed = cut.astype(kind) if kind.kind == "f" else np.rint(cut).astype(kind)
        return Painted(
            values=typed, valid=valid, owner=None, hidden=hidden, bare=bare - left, residual=0.0, cells=0, gaps=left
        )

    def _carry(
        self,
        product: ProductPlan,
        tile: CompiledTile,
        read: Window,
        source: Source,
        surface: Terrain,
        into: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> None:
        """Add pixels of the image to those of the tile in which they come down."""
        target, window = product.target, tile.window
        assert isinstance(target, MapTarget)
        pixels, usable = source.reader.read(read)
        row, col = np.mgrid[read.row : read.stop[1], read.col : read.stop[0]]
        xy = np.stack([col.ravel(), row.ravel()], axis=-1).astype(float)
        XYZ = intersect(cast(CentralCamera, source.camera), xy, surface, self.levels)
        uv = target.grid.to_pixel(XYZ[:, :2]) - (window.col, window.row)
        place = np.rint(np.nan_to_num(uv, nan=-1.0)).astype(np.int64)
        inside = (place >= 0) & (place < (window.width, window.height))
        there = np.asarray(inside.all(axis=1) & (True if usable is None else usable.ravel()))
        off = np.abs(XYZ[there, 2] - surface.heights(XYZ[there, :2]))
        there[there] = off <= _OFF * target.grid.resolution
        index = place[there, 1] * window.width + place[there, 0]
        sums, count = into
        count += np.bincount(index, minlength=len(count))
        for band, values in zip(sums, pixels.reshape(len(pixels), -1)):
            band += np.bincount(index, values[there].astype(float), minlength=len(count))


def _strips(tile: CompiledTile, source: Source) -> Iterator[Window]:
    """Return what of an image can reach a tile, in strips of some rows."""
    for layer in tile.layers:
        whole = layer.window(source.camera.size)
        rows = max(1, _AT_ONCE // max(1, whole.width))
        for row in range(whole.row, whole.stop[1], rows):
            yield Window(whole.col, row, whole.width, rows) & whole


def _gaps(product: ProductPlan, tile: CompiledTile, source: Source, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels of a tile that the image sees, but that have got nothing."""
    gaps = np.isfinite(tile.relief) & ~valid
    if tile.hidden is not None:
        gaps &= ~tile.hidden
    row, col = np.nonzero(gaps)
    uvh = np.stack([col + tile.window.col, row + tile.window.row, tile.relief[row, col].astype(float)], axis=-1)
    xy = project(source.camera, product.target.to_ground(uvh))
    gaps[row, col] = ((xy >= -0.5) & (xy <= np.array(source.camera.size) - 0.5)).all(axis=-1)
    return gaps
