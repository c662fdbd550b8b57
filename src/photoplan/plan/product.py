"""The plan of a product: target, table of sources, tiles, who paints which pixel, how tiles are compiled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Part, Projection, parts_of
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.footprint import depth_tilt, footprint_levels
from photoplan.kernels.positions import tile_runs
from photoplan.plan.anchors import FINEST, AnchorRule, Anchors, compile_anchors
from photoplan.plan.footprint import Tile, Tiles
from photoplan.plan.ground import TileGround
from photoplan.plan.sources import Drawn, Feather, Ownership, Share
from photoplan.surfaces.base import Surface
from photoplan.targets.map import Target

#: Columns from the edge of a part of an image within which another part may leave something to it.
_NEAR = 8.0


@dataclass(frozen=True, eq=False)
class Layer:
    """What one source gives to a tile."""

    source: int
    """Row of the table of sources."""
    level: int
    """The source is read reduced by 2 to the power of this; the anchors refer to pixels of the reduced image."""
    anchors: Anchors
    """Where the tile's pixels lie in it."""
    part: NDArray[np.int64]
    """First column, first row, end column, end row in the tile between which are all pixels that it paints."""
    owner: NDArray[np.uint16] | None
    """It paints the pixels that are `source` + 1 here; None: all."""
    columns: Part | None = None
    """The columns of the source that it is made of, at full size; None: all. Layers of such parts follow each other:
    each paints what those before have left."""

    def window(self, size: tuple[int, int]) -> Window:
        """What is read of a source of this size, in its pixels at full size."""
        at = self.anchors.source_window
        level = self.level
        full = Window(at.col << level, at.row << level, at.width << level, at.height << level)
        return full & Window(0, 0, *size)


@dataclass(frozen=True, eq=False)
class Blend:
    """What an image gives where others paint, too."""

    weights: NDArray[np.float32]
    """By bands of detail from the finest, shape (bands, height, width) of the tile."""
    tile: CompiledTile
    """What it paints for that: of the tile, or with what is around it if there are several bands."""


@dataclass(frozen=True, eq=False)
class CompiledTile:
    """Relief, owner and anchors of a tile: all that the engine needs besides pixels."""

    window: Window
    """Its pixels in the product."""
    relief: NDArray[np.float32]
    """h of each pixel, shape (height, width); NaN where there is no surface."""
    tilt: NDArray[np.float32] | None
    """Change of h per column and row, shape (2, height, width), where it decides what a pixel covers: not on a map."""
    layers: tuple[Layer, ...]
    """Sources that paint a part of it, each once for every level; those that show none of it are left out."""
    owner: NDArray[np.uint16] | None
    """See `Share.owner`."""
    hidden: NDArray[np.bool_] | None
    """See `Share.hidden`."""
    blends: tuple[Blend, ...] = ()
    """Of images that pass into each other along seams."""
    reaches: tuple[int, ...] = ()
    """How far their detail spreads, band by band, see `Feather.reaches`."""

    @property
    def residual(self) -> float:
        """Worst residual of all layers, pixels of their sources at full size."""
        return max((layer.anchors.residual for layer in self.layers), default=0.0)

    @property
    def cells(self) -> int:
        """Boxes of all layers' anchors."""
        return sum(len(layer.anchors.corners) for layer in self.layers)


@dataclass(frozen=True)
class ProductPlan:
    """One product, of one source or of many."""

    name: str
    """Name of the product, and of its file without the extension."""
    sources: tuple[str, ...]
    """The table of sources: names of the images; tiles and owners count its rows."""
    target: Target
    """The product's own coordinates."""
    rule: AnchorRule
    """How finely tiles are cut."""
    tiles: Tiles
    """Tiles that can hold a part of an image."""
    owners: Ownership | None = None
    """Who paints which pixel; None: there is one source."""
    feather: Feather | None = None
    """How sources pass into each other along seams; None: they do not."""
    clip: Drawn | None = None
    """What of the target the product shows, where rows are not 0; None: all."""
    fill_hidden: int = 0
    """Holes that no source sees are filled up to this width and height, pixels; 0: they stay empty."""

    def __post_init__(self) -> None:
        if len(self.sources) != 1 and self.owners is None:
            raise UsageError(f"product {self.name!r} of {len(self.sources)} sources; say which of them paints a pixel")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.target.window.width, self.target.window.height


def compile_tile(product: ProductPlan, tile: Tile, cameras: Mapping[int, Projection], surface: Surface) -> CompiledTile:
    """Relief, owner, anchors and field of a tile of a product. Pure: the same inputs give the same bytes."""
    relief, tilt = _depth(product, tile.window, surface)
    if product.clip is not None:
        relief = np.where(product.clip.rows(tile.window) > 0, relief, np.float32(np.nan))
    ground = TileGround.of(product.target, tile.window, relief)
    if product.feather is not None:
        return _feathered(product, tile, cameras, ground, tilt, surface)
    share = Share(None) if product.owners is None else product.owners.share(ground, cameras, surface)
    return _compiled(product, tile, cameras, ground, tilt, share)


def _feathered(
    product: ProductPlan,
    tile: Tile,
    cameras: Mapping[int, Projection],
    ground: TileGround,
    tilt: NDArray[np.float32] | None,
    surface: Surface,
) -> CompiledTile:
    """A tile whose sources pass into each other."""
    assert product.feather is not None and product.owners is not None
    wide = product.feather.around(tile.window)
    around = TileGround.of(product.target, wide, surface.relief(product.target, wide))
    share = product.owners.share(around, cameras, surface)
    assert share.owner is not None
    at = tile.window.slices(wide)
    owner = np.ascontiguousarray(share.owner[at])
    hidden = None if share.hidden is None else np.ascontiguousarray(share.hidden[at])
    made = _compiled(product, tile, cameras, ground, tilt, Share(owner, hidden))
    feather, blends = product.feather, []
    if len(feather.reaches) > 1:
        tile, ground, tilt, at = replace(tile, window=wide), around, None, np.s_[:, :]
    for row, (weights, seen) in feather.weights(share, wide, made.window).items():
        wanted = np.zeros(seen.shape, np.bool_)
        wanted[made.window.slices(wide)] = weights[-1] > 0
        if len(feather.reaches) > 1:
            wanted = _spread(wanted, feather.reaches[-2]) & seen
        mine = Share(np.where(wanted[at], np.uint16(row + 1), np.uint16(0)))
        blends.append(Blend(weights, _compiled(product, tile, cameras, ground, tilt, mine)))
    return replace(made, blends=tuple(blends), reaches=feather.reaches)


def _spread(some: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Pixels with one of some in the square around them."""
    # Products without seams do without it, as of distances.
    from scipy.ndimage import maximum_filter  # noqa: PLC0415

    return np.asarray(maximum_filter(some, 2 * reach + 1, mode="constant"))


def compile_next(
    product: ProductPlan,
    tile: Tile,
    cameras: Mapping[int, Projection],
    surface: Surface,
    first: CompiledTile,
    refused: Mapping[int, NDArray[np.bool_]],
) -> CompiledTile:
    """A tile once more, for pixels whose source has nothing there that can be used: a mask, nodata."""
    owner, hidden = np.zeros(first.relief.shape, np.uint16), np.zeros(first.relief.shape, bool)
    ground = TileGround.of(product.target, tile.window, first.relief)
    rows = np.array(list(refused))
    tables = np.stack([refused[row] for row in rows])
    asked = tables.any(axis=0)
    for alike in np.unique(tables[:, asked], axis=1).T:
        left = {row: camera for row, camera in cameras.items() if row not in rows[alike]}
        if left and product.owners is not None:
            share = product.owners.share(ground, left, surface)
            at = asked & (tables == alike[:, None, None]).all(axis=0)
            if share.owner is not None:
                # A rule that knows no others, as a drawn raster, gives the same again: then nobody paints.
                owner[at] = np.where(np.isin(share.owner[at], rows[alike] + 1), 0, share.owner[at])
            if share.hidden is not None:
                hidden[at] = share.hidden[at]
    return _compiled(product, tile, cameras, ground, first.tilt, Share(owner, hidden))


def _compiled(
    product: ProductPlan,
    tile: Tile,
    cameras: Mapping[int, Projection],
    ground: TileGround,
    tilt: NDArray[np.float32] | None,
    share: Share,
) -> CompiledTile:
    """Anchors of those that paint a tile."""
    wanted, parts = ground.ranges[None], np.array([[0, 0, tile.window.width, tile.window.height]])
    if share.owner is not None:
        wanted, parts = ground.owned(share.owner, tile.sources, len(product.sources))
    layers: list[Layer] = []
    for source, mine, part in zip(tile.sources, wanted, parts):
        for columns in parts_of(cameras[source]):
            camera = cameras[source] if columns is None else columns.projection
            anchors = compile_anchors(camera, ground, product.rule, mine)
            if anchors is None or not _shows(anchors, columns):
                continue
            if tilt is None:
                level = product.rule.level(anchors)
                reduced = anchors.at_level(level, camera.size)
                found = [Layer(source=source, level=level, anchors=reduced, part=part, owner=share.owner)]
            else:
                found = _layers_by_level(product.rule, ground, tilt, source, camera, anchors, share.owner)
            layers += found if columns is None else [replace(each, columns=columns) for each in found]
    return CompiledTile(
        window=tile.window,
        relief=ground.relief,
        tilt=tilt,
        layers=tuple(layers),
        owner=share.owner,
        hidden=share.hidden,
    )


def _shows(anchors: Anchors, columns: Part | None) -> bool:
    """Whether a tile needs anything of some columns of a source."""
    if columns is None:
        return True
    window = anchors.source_window
    if columns.rest:
        edges = np.array([columns.first, columns.end])
        return bool(((window.col < edges + _NEAR) & (window.stop[0] > edges - _NEAR)).any())
    return window.col < columns.end and window.stop[0] > columns.first


def _depth(
    product: ProductPlan, window: Window, surface: Surface
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Relief of a tile, and its tilt if the product needs it: from a pixel more all round, so that tiles join."""
    if not product.rule.tilted:
        return surface.relief(product.target, window), None
    around = Window(window.col - 1, window.row - 1, window.width + 2, window.height + 2) & product.target.window
    depth = surface.relief(product.target, around)
    rows, cols = window.slices(around)
    right, bottom = around.width - cols.stop, around.height - rows.stop
    tilt = depth_tilt(np.ascontiguousarray(depth), (cols.start, rows.start, right, bottom))
    return np.ascontiguousarray(depth[rows, cols]), tilt


def _layers_by_level(
    rule: AnchorRule,
    ground: TileGround,
    tilt: NDArray[np.float32],
    row: int,
    camera: Projection,
    anchors: Anchors,
    owner: NDArray[np.uint16] | None,
) -> list[Layer]:
    """What a source gives where neighbouring pixels need it at very different levels: near and far ground of a view."""
    runs = tile_runs(anchors.rects, np.arange(len(anchors.rects)), (0, 0), ground.relief.shape)
    levels, longest = np.zeros(ground.relief.shape, np.uint8), np.zeros(256)
    footprint_levels(anchors.arrays, runs, (ground.relief, tilt), FINEST, levels, longest)
    there = np.isfinite(ground.relief) if owner is None else np.isfinite(ground.relief) & (owner == row + 1)
    layers = []
    for level in np.unique(levels[there]).tolist():
        mine = there & (levels == level)
        wanted, part = ground.where(mine)
        found = compile_anchors(camera, ground, rule, wanted, float(longest[level]))
        if found is not None:
            raster = mine.astype(np.uint16) * np.uint16(row + 1)
            layers.append(
                Layer(source=row, level=level, anchors=found.at_level(level, camera.size), part=part, owner=raster)
            )
    return layers
