"""Execution of one tile: compile, read source windows, resample, fill holes, return the outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Part, Projection
from photoplan.engine.run import Made, Output
from photoplan.errors import UsageError
from photoplan.geometry.grid import FullSize, Pixels, Window, reduced
from photoplan.kernels.positions import ALL_MINE
from photoplan.kernels.rectify import rectify_tile
from photoplan.plan.accuracy import DepthErrors, SourceErrors, radial_counts, tile_accuracy
from photoplan.plan.footprint import Tile
from photoplan.plan.product import CompiledTile, Layer, ProductPlan, compile_next, compile_tile
from photoplan.surfaces.base import Surface
from photoplan.surfaces.objects import RaisedSurface
from photoplan.targets.map import MapTarget


@runtime_checkable
class Reader(FullSize, Protocol):
    """A source image of uint8, uint16, int16 or float32, alpha not counted; safe to call from several threads."""

    def read(self, window: Window, level: int = 0) -> Pixels:
        """Pixels of a window inside the image, shape (bands, height, width), and their validity."""
        ...


class Step(Protocol):
    """Pixels into pixels, on their way from a file to whoever reads it: the grid of the image stays.

    What becomes of a pixel does not depend on the window in which it is asked for.
    """

    def check(self, size: tuple[int, int], bands: int) -> None:
        """Refuse images that the step is not for."""
        ...

    def result(self, stored: np.dtype[Any]) -> np.dtype[Any]:
        """Type of the pixels that come of pixels of a type."""
        ...

    def around(self, window: Window, size: tuple[int, int], gaps: bool) -> Window:
        """Pixels of an image of `size` that those of a window depend on; `gaps`: if some of them are invalid."""
        ...

    def apply(self, window: Window, at: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> Pixels:
        """Pixels of a window and their validity, from those of the window `at` around it."""
        ...


@dataclass(frozen=True, eq=False)
class Source:
    """A row of the table of sources as the engine needs it."""

    camera: Projection
    reader: Reader


_TYPES = ("uint8", "uint16", "int16", "float32")


@dataclass(frozen=True, eq=False)
class ArrayReader:
    """A source image in memory, behind the engine's `Reader`."""

    image: NDArray[Any]
    """(bands, height, width): uint8, uint16, int16 or float32."""
    valid: NDArray[np.bool_] | None = None
    """(height, width), True = valid; None: all are."""

    def __post_init__(self) -> None:
        if self.image.ndim != 3 or self.image.dtype.name not in _TYPES or not self.image.size:
            advice = "" if self.image.dtype.name in _TYPES else "; convert it, for instance with astype('float32')"
            raise UsageError(
                f"image of shape {self.image.shape} and type {self.image.dtype}; needed are (bands, height, width) of "
                f"{', '.join(_TYPES)}{advice}"
            )
        if self.valid is not None and (self.valid.shape != self.image.shape[1:] or self.valid.dtype != bool):
            raise UsageError(f"validity of shape {self.valid.shape}; needed is bool of {self.image.shape[1:]}")

    @classmethod
    def of(cls, values: NDArray[Any]) -> ArrayReader:
        """From (height, width) or (bands, height, width); what is masked in any band, or NaN, is invalid."""
        image = values[None] if values.ndim == 2 else values
        bad = np.asarray(np.ma.getmaskarray(image).any(axis=0), bool)
        plain = np.ma.getdata(image)
        plain = plain.astype(plain.dtype.newbyteorder("="), copy=False)  # files of other machines
        if plain.dtype.kind == "f":
            bad |= ~np.isfinite(plain).all(axis=0)
        return cls(plain, ~bad if bad.any() else None)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.image.shape[2], self.image.shape[1]

    @property
    def bands(self) -> int:
        """Number of bands."""
        return int(self.image.shape[0])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""
        return self.image.dtype

    def read(self, window: Window, level: int = 0) -> Pixels:
        """Pixels of a window and their validity, see `engine.base.Reader`."""
        if level:
            return reduced(self, window, level)
        if window & Window(0, 0, *self.size) != window:
            raise UsageError(f"{window} is not inside the image of {self.size[0]} × {self.size[1]} pixels")
        rows, cols = window.slices(Window(0, 0, *self.size))
        return self.image[:, rows, cols], None if self.valid is None else self.valid[rows, cols]


_Floats = NDArray[np.float64]


def detail_bands(
    values: NDArray[Any], usable: NDArray[np.bool_], reaches: Sequence[int], at: tuple[slice, slice]
) -> Iterator[_Floats]:
    """Bands of a picture whose sum it is (Burt and Adelson 1983), from the finest.

    Each is what one smoothing takes away that the finer one has left; the last is what the coarsest has left. Smoothed
    is over usable pixels alone, by weights that fall along rows and columns to nothing beyond a reach; a pixel's bands
    depend on what lies within the last but one of the reaches, in a sum of always the same order.
    """
    picture = np.where(usable, values, 0).astype(np.float64)
    before = picture[(slice(None), *at)]
    for reach in reaches[:-1]:
        known = np.maximum(_smooth(usable.astype(np.float64), reach, at), 1.0)
        after = np.stack([_smooth(band, reach, at) for band in picture]) / known
        yield before - after
        before = after
    yield before


def _smooth(values: _Floats, reach: int, at: tuple[slice, slice]) -> _Floats:
    """Sums by whole weights that fall from reach + 1 to 0 on both sides, along both axes, of a part."""
    # Products without bands do without it: a tenth of a second of their start.
    from scipy.ndimage import correlate1d  # noqa: PLC0415

    weights = reach + 1.0 - np.abs(np.arange(-reach, reach + 1))
    down = correlate1d(values, weights, axis=0, mode="constant")[at[0]]
    return np.asarray(correlate1d(down, weights, axis=1, mode="constant")[:, at[1]])


#: In a raster of sources: added to the number of the image that fills a pixel; the number of pixels that are filled
#: from their surroundings; and how many images a product can have so that these differ.
FROM_IMAGE, FROM_SURROUNDINGS, MOST_IMAGES = 32768, 65535, 32766
#: Holes are looked at from the level around them if that is no more than this above their ground: pixels.
_RAISED = 8.0
#: Surroundings of holes are pixels no further away than this and half the largest side: pixels.
_AROUND = 3


def halo(largest: int) -> int:
    """Pixels around a pixel that decide whether and with what it is filled, for holes of a largest side."""
    return largest + _AROUND


def small_holes(hidden: NDArray[np.bool_], largest: int) -> NDArray[np.bool_]:
    """Pixels of those holes (pixels that touch at sides or corners) whose width and height are at most `largest`."""
    # Products that fill nothing do without it.
    from scipy.ndimage import find_objects, label  # noqa: PLC0415

    labels, _ = label(hidden, np.ones((3, 3), int))
    small = [max(part.stop - part.start for part in box) <= largest for box in find_objects(labels)]
    return np.asarray(np.array([False, *small])[labels])


class Mask:
    """Pixels of a window that a product shows, as `ProductPlan.clip` has them."""

    def __init__(self, window: Window, shown: NDArray[np.bool_]) -> None:
        self.window, self.shown = window, shown

    def rows(self, window: Window) -> NDArray[np.uint16]:
        """1 for pixels of a window that are shown, else 0."""
        found, common = np.zeros((window.height, window.width), np.uint16), self.window & window
        if common.size:
            found[common.slices(window)] = self.shown[common.slices(self.window)]
        return found

    def digest(self, margin: float) -> str:
        """Return nothing: it decides no key."""
        return ""


def rise_of_holes(
    level: NDArray[np.floating], valid: NDArray[np.bool_], holes: NDArray[np.bool_], largest: int
) -> NDArray[np.float64]:
    """Return the height of valid pixels around each pixel of holes above it, pixels; 0 if below or far above.

    Roughness of a surface hides its lower places; the level around them is nearer to the truth.
    """
    around = np.array(level[None], float)
    fill_by_distance(around, valid, holes, largest // 2 + _AROUND)
    rise = np.where(holes, around[0] - level, 0.0)
    return np.where((rise > 0) & (rise <= _RAISED), rise, 0.0)


def fill_from_surroundings(
    values: NDArray[Any], valid: NDArray[np.bool_], holes: NDArray[np.bool_], largest: int, level: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Fill holes from valid pixels around them, those of similar height (`level`, in pixels) before others; returns the
    pixels that are filled."""
    return fill_by_distance(values, valid, holes, largest // 2 + _AROUND, level)


def fill_by_distance(
    values: NDArray[Any],
    valid: NDArray[np.bool_],
    holes: NDArray[np.bool_],
    reach: int,
    level: NDArray[np.floating] | None = None,
) -> NDArray[np.bool_]:
    """Fill holes with the mean of valid pixels within reach, weighted by one over the square of the distance, or with
    heights by one over the fourth power of the distance in space; returns the pixels that are filled.

    `values` are changed, `valid` is not.
    """
    row, col = np.nonzero(holes)
    height, width = valid.shape
    sums, weights = np.zeros((len(values), len(row))), np.zeros(len(row))
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            square = du * du + dv * dv
            if not 0 < square <= reach * reach:
                continue
            r, c = row + dv, col + du
            inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
            r, c = np.where(inside, r, 0), np.where(inside, c, 0)
            usable = inside & valid[r, c]
            weight = usable / square
            if level is not None:
                weight = usable / (square + (level[r, c] - level[row, col]) ** 2) ** 2
            sums += values[:, r, c] * weight
            weights += weight
    found = weights > 0
    mean = sums[:, found] / weights[found]
    values[:, row[found], col[found]] = mean if values.dtype.kind == "f" else np.rint(mean)
    filled = np.zeros(valid.shape, bool)
    filled[row[found], col[found]] = True
    return filled


OutputName = Literal["picture", "hidden", "sources", "accuracy"]

#: A window of the source larger than this (bytes as read) is not read at once; its tile is executed in parts.
MOST_SOURCE_BYTES = 48 * 2**20
#: A tile of this side is not cut further, however much of the source it needs.
SMALLEST_PART = 16


@dataclass(frozen=True, eq=False)
class Painted:
    """Pixels of a window of a product."""

    values: NDArray[Any] | None
    """(bands, height, width) in the sources' dtype, 0 where invalid; None if no pixel is valid."""
    valid: NDArray[np.bool_] | None
    """(height, width); None if no pixel is valid."""
    owner: NDArray[np.uint16] | None
    """(height, width): row of the table of sources, plus one, that painted each pixel; 0 where invalid. Filled: with
    codes of `photoplan.engine.execute`. None if there is one source, or no pixel is valid."""
    hidden: NDArray[np.bool_] | None
    """(height, width): pixels that no source sees, see `photoplan.plan.sources.Share`; None if nobody has asked."""
    bare: int
    """Pixels with a surface that lie in no source; 0 if there is one source and nobody has asked."""
    residual: float
    """Worst residual of the anchors, pixels of the source image."""
    cells: int
    """Boxes that the anchors have."""
    gaps: int | None = None
    """Pixels that the source sees, but that none of its pixels has reached; None: all are reached."""


def execute_tile(
    tile: CompiledTile,
    sources: Sequence[Source],
    kernel: str,
    onto: tuple[NDArray[Any], NDArray[np.bool_]] | None = None,
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Compose one compiled tile: each source paints the pixels that it owns, and nothing else is computed."""
    values, valid = onto or (np.zeros((0, *tile.relief.shape)), np.zeros(tile.relief.shape, bool))
    for layer in tile.layers:
        window, reader = layer.anchors.source_window, sources[layer.source].reader
        if not window.size:
            continue
        pixels, usable = reader.read(window, layer.level)
        if not len(values):
            values = np.zeros((len(pixels), *tile.relief.shape), pixels.dtype)
        border = _border(layer, reader.size)
        owner = layer.owner
        if layer.columns is not None:
            pixels, usable, border = _columns_of(layer, layer.columns, (pixels, usable), border)
            # What parts before it have painted stays.
            owner = np.where(valid, 0, layer.source + 1 if owner is None else owner).astype(np.uint16)
        if usable is None or usable.any():
            owned = ALL_MINE if owner is None else (owner, layer.source + 1, layer.part.tolist())
            arrays, tilt = layer.anchors.arrays, tile.tilt
            rectify_tile(arrays, tile.relief, pixels, usable, border, kernel, values, valid, owned=owned, tilt=tilt)
    return values, valid


def _painted(tile: CompiledTile, values: NDArray[Any], valid: NDArray[np.bool_]) -> Painted:
    """Return what was painted, with its figures."""
    bare = 0
    if tile.hidden is not None:
        bare = int(np.count_nonzero(np.isfinite(tile.relief) & ~valid & ~tile.hidden))
    if not valid.any():
        return Painted(
            values=None, valid=None, owner=None, hidden=tile.hidden, bare=bare, residual=tile.residual, cells=tile.cells
        )
    owner = None if tile.owner is None else tile.owner * valid
    return Painted(
        values=values, valid=valid, owner=owner, hidden=tile.hidden, bare=bare, residual=tile.residual, cells=tile.cells
    )


def render(product: ProductPlan, tile: Tile, sources: Sequence[Source], surface: Surface, kernel: str) -> Painted:
    """Compile and execute a tile of a product, in parts if it needs too much of a source at once.

    Whether and how it is cut depends on the tile and the sources alone, so that the result does not depend on
    memory, workers or order.
    """
    window, cameras = tile.window, {row: sources[row].camera for row in tile.sources}
    compiled = compile_tile(product, tile, cameras, surface)
    every = [*compiled.layers, *(layer for blend in compiled.blends for layer in blend.tile.layers)]
    needed = max((_bytes(layer, sources[layer.source]) for layer in every), default=0)
    if needed <= MOST_SOURCE_BYTES or max(window.width, window.height) <= SMALLEST_PART:
        values, valid = execute_tile(compiled, sources, kernel)
        refused: dict[int, NDArray[np.bool_]] = {}
        while len(cameras) > 1 and _refuse(compiled, valid, refused):
            again = compile_next(product, tile, cameras, surface, compiled, refused)
            values, valid = execute_tile(again, sources, kernel, (values, valid))
            compiled = _with_others(compiled, again, np.any(list(refused.values()), axis=0))
        _blend(compiled, sources, kernel, values, valid)
        return _painted(compiled, values, valid)
    side = max(SMALLEST_PART, -(-max(window.width, window.height) // 2))
    cut = [replace(tile, window=part) for part in window.tiles(side)]
    parts = ((part.window, render(product, part, sources, surface, kernel)) for part in cut)
    whole = joined(window, parts, sources[tile.sources[0]].reader)
    return whole if np.any(whole.valid) else replace(whole, values=None, valid=None, owner=None)


def with_holes_filled(
    product: ProductPlan, tile: Tile, sources: Sequence[Source], surface: Surface, kernel: str, painted: Painted
) -> Painted:
    """A tile whose small hidden holes are filled: from images that see them once they are raised to the level around
    them, else from what is painted around them.

    All other pixels stay as they are. What a pixel gets does not depend on the tile: holes, and what is around them,
    are looked at across its borders and those of what the product shows.
    """
    if not product.fill_hidden or painted.hidden is None or not painted.hidden.any():
        return painted
    assert isinstance(product.target, MapTarget)
    at, reach, resolution = tile.window, halo(product.fill_hidden), product.target.grid.resolution
    whole = replace(product, clip=None, fill_hidden=0)
    mine = painted if product.clip is None else render(whole, tile, sources, surface, kernel)
    assert mine.hidden is not None
    wide = Window(at.col - reach, at.row - reach, at.width + 2 * reach, at.height + 2 * reach)
    (right, bottom), parts = at.stop, [(at, mine)]
    for near, beside in (
        (mine.hidden[:reach], Window(wide.col, wide.row, wide.width, reach)),
        (mine.hidden[-reach:], Window(wide.col, bottom, wide.width, reach)),
        (mine.hidden[:, :reach], Window(wide.col, at.row, reach, at.height)),
        (mine.hidden[:, -reach:], Window(right, at.row, reach, at.height)),
    ):
        if near.any():
            parts.append((beside, render(whole, replace(tile, window=beside), sources, surface, kernel)))
    around = joined(wide, parts, sources[tile.sources[0]].reader)
    assert around.values is not None and around.valid is not None and around.hidden is not None
    own = at.slices(wide)
    holes = small_holes(around.hidden & ~around.valid, product.fill_hidden)
    wanted = np.zeros(holes.shape, bool)
    wanted[own] = holes[own] & painted.hidden
    if not wanted.any():
        return painted
    values, owner = around.values, np.zeros(holes.shape, np.uint16)
    level = np.nan_to_num(surface.relief(product.target, wide) / resolution)
    rise = rise_of_holes(level, around.valid, holes, product.fill_hidden)
    shown = wanted & (rise > 0)
    if shown.any():
        rows, cols = (np.flatnonzero(shown.any(axis=axis)).tolist() for axis in (1, 0))
        box = Window(wide.col + cols[0], wide.row + rows[0], cols[-1] - cols[0] + 1, rows[-1] - rows[0] + 1)
        over, raised = (
            replace(whole, feather=None, clip=Mask(wide, shown)),
            RaisedSurface(surface, wide, rise * resolution),
        )
        seen = render(over, replace(tile, window=box), sources, raised, kernel)
        if seen.values is not None and seen.valid is not None and seen.owner is not None:
            part = box.slices(wide)
            values[:, *part] = np.where(seen.valid, seen.values, values[:, *part])
            owner[part] = np.where(seen.valid, seen.owner + np.uint16(FROM_IMAGE), np.uint16(0))
    near = fill_from_surroundings(values, around.valid, wanted & (owner == 0), product.fill_hidden, level)
    owner[near] = FROM_SURROUNDINGS
    filled = owner[own] > 0
    if not filled.any():
        return painted
    before = np.zeros(filled.shape, np.uint16) if painted.owner is None else painted.owner
    valid = filled if painted.valid is None else painted.valid | filled
    cut = values[:, *own] * valid if painted.values is None else np.where(filled, values[:, *own], painted.values)
    return replace(painted, values=cut, valid=valid, owner=np.where(filled, owner[own], before))


def _blend(
    tile: CompiledTile, sources: Sequence[Source], kernel: str, values: NDArray[Any], valid: NDArray[np.bool_]
) -> None:
    """Replace what is painted along seams by the weighted mean of the sources that pass into each other there."""
    if not tile.blends or not len(values):
        return
    # In float64: the least weights are those of sources that stand alone in the end.
    total = np.zeros((len(tile.reaches), *values.shape), np.float64)
    weights = np.zeros((len(tile.reaches), *valid.shape), np.float64)
    for blend in tile.blends:
        shown, usable = execute_tile(blend.tile, sources, kernel)
        if len(shown):
            inner = tile.window.slices(blend.tile.window)
            mine = blend.weights.astype(np.float64) * usable[inner]
            weights += mine
            for k, band in enumerate(detail_bands(shown, usable, tile.reaches, inner)):
                total[k] += mine[k] * band
    # Where whoever was to paint has nothing, some bands may have no weight.
    at = valid & (weights > 0).all(axis=0)
    mean = (total[:, :, at] / weights[:, None, at]).sum(axis=0)
    if values.dtype.kind in "iu":
        limits = np.iinfo(values.dtype)
        mean = np.clip(np.floor(mean + 0.5), limits.min, limits.max)
    values[:, at] = mean.astype(values.dtype)


def _refuse(tile: CompiledTile, valid: NDArray[np.bool_], refused: dict[int, NDArray[np.bool_]]) -> bool:
    """Enter the pixels in which their source was of no use; whether there are any that nobody has asked for before."""
    if tile.owner is None:
        return False
    bad = ~valid & (tile.owner > 0)
    for row in (np.unique(tile.owner[bad]).astype(int) - 1).tolist():
        refused[row] = refused.get(row, False) | (bad & (tile.owner == row + 1))
    return bool(bad.any())


def _with_others(tile: CompiledTile, again: CompiledTile, given: NDArray[np.bool_]) -> CompiledTile:
    """A tile with the owners of those pixels that were given away again."""
    hidden = tile.hidden
    if hidden is not None and again.hidden is not None:
        hidden = hidden | again.hidden
    assert tile.owner is not None and again.owner is not None
    owner = np.where(given, again.owner, tile.owner)
    return replace(tile, owner=owner, hidden=hidden, layers=tile.layers + again.layers)


def _bytes(layer: Layer, source: Source) -> int:
    """Return what a layer reads."""
    return layer.anchors.source_window.size * source.reader.bands * source.reader.dtype.itemsize


def joined(window: Window, parts: Iterable[tuple[Window, Painted]], reader: Reader) -> Painted:
    """A window of a product from painted parts of the product; what none of them holds is 0 and not valid.

    `reader` tells bands and type of the pixels.
    """
    shape = (window.height, window.width)
    values, valid = np.zeros((reader.bands, *shape), reader.dtype), np.zeros(shape, bool)
    owner: NDArray[np.uint16] | None = None
    hidden: NDArray[np.bool_] | None = None
    residual, bare, cells = 0.0, 0, 0
    for at, part in parts:
        residual, bare, cells = max(residual, part.residual), bare + part.bare, cells + part.cells
        common = at & window
        if not common.size:
            continue
        to, of = common.slices(window), common.slices(at)
        if part.hidden is not None:
            hidden = np.zeros(shape, bool) if hidden is None else hidden
            hidden[to] = part.hidden[of]
        if part.values is None or part.valid is None:
            continue
        values[:, to[0], to[1]], valid[to] = part.values[:, of[0], of[1]], part.valid[of]
        if part.owner is not None:
            owner = np.zeros(shape, np.uint16) if owner is None else owner
            owner[to] = part.owner[of]
    return Painted(values=values, valid=valid, owner=owner, hidden=hidden, bare=bare, residual=residual, cells=cells)


def _border(layer: Layer, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Outer edges of the image x_min, y_min, x_max, y_max in the pixel coordinates of the layer's window."""
    window, f = layer.anchors.source_window, 2.0**layer.level
    return (-0.5 - window.col, -0.5 - window.row, size[0] / f - 0.5 - window.col, size[1] / f - 0.5 - window.row)


def _columns_of(
    layer: Layer, part: Part, pixels: Pixels, border: tuple[float, float, float, float]
) -> tuple[NDArray[Any], NDArray[np.bool_], tuple[float, float, float, float]]:
    """Pixels of a layer's window without those of other parts of the image, and the outer edges of the part.

    Up to the next part, the border pixels are shown twice.
    """
    values, usable = pixels
    f, width = 2.0**layer.level, values.shape[2]
    # A reduced column that holds pixels of two parts belongs to neither.
    first = math.ceil((part.first + 0.5) / f) - layer.anchors.source_window.col
    end = math.floor((part.end + 0.5) / f) - layer.anchors.source_window.col
    mine = np.ones(values.shape[1:], bool) if usable is None else usable.copy()
    mine[:, : max(first, 0)], mine[:, max(end, 0) :] = False, False
    values = np.where(mine, values, 0).astype(values.dtype)
    for gap, at, of in ((part.before, first - 1, first), (part.after, end, end - 1)):
        if gap > 0 and min(at, of) >= 0 and max(at, of) < width:
            values[:, :, at], mine[:, at] = values[:, :, of], mine[:, of]
    shift = layer.anchors.source_window.col + 0.5
    left, right = (part.first - part.before + 0.5) / f - shift, (part.end + part.after + 0.5) / f - shift
    return values, mine, (max(left, border[0]), border[1], min(right, border[2]), border[3])


class Opened(Protocol):
    """Opened sources and surface of a product."""

    @property
    def sources(self) -> Sequence[Source]:
        """The table of sources."""
        ...

    @property
    def surface(self) -> Surface:
        """Return what a product's depth is taken from."""
        ...


class Address(Protocol):
    """Address by which a worker opens what a plan needs; small, and can be pickled."""

    def open(self) -> Opened:
        """Sources and surface; kept for the next tile."""
        ...


class KnownErrors(Protocol):
    """Errors of sources and surface, as far as they are known."""

    @property
    def depth(self) -> DepthErrors:
        """Return the depth of the surface."""
        ...

    @property
    def sources(self) -> Mapping[int, SourceErrors]:
        """By row of the table of sources."""
        ...


class ErrorsAddress(Protocol):
    """Address by which a worker opens the errors; small, and can be pickled."""

    def open(self) -> KnownErrors:
        """Errors of all sources; each is made when it is asked for, and kept for the next tile."""
        ...


class Paint(Protocol):
    """Another way to paint a tile than by resampling where its pixels lie in the sources; small, and pickles."""

    def render(self, product: ProductPlan, tile: Tile, sources: Sequence[Source], surface: Surface) -> Painted:
        """A tile of a product; what a pixel gets does not depend on the tile."""
        ...


@dataclass(frozen=True)
class RenderJob:
    """Job of a worker: one product that is resampled."""

    address: Address
    product: ProductPlan
    """Without its tiles."""
    kernel: str
    outputs: tuple[OutputName, ...] = ("picture",)
    """Outputs of a tile, in the order of the sinks: its ``picture``; what is ``hidden``, 1, or 0 for what is seen, not
    valid beyond the images; of the ``sources``, the row in their table, plus one, that painted a pixel, and codes of
    filled ones; of the ``accuracy``, the bands of `photoplan.plan.accuracy`."""
    errors: ErrorsAddress | None = None
    """Needed for the output ``accuracy``."""
    paint: Paint | None = None
    """Function that paints a tile; None for `render` with the kernel."""

    def __call__(self, tile: Tile) -> Made:
        """Outputs of a tile, and its figures: of its anchors, and how many pixels are hidden or in no image if somebody
        has asked."""
        opened = self.address.open()
        if self.paint is None:
            painted = render(self.product, tile, opened.sources, opened.surface, self.kernel)
            painted = with_holes_filled(self.product, tile, opened.sources, opened.surface, self.kernel, painted)
        else:
            painted = self.paint.render(self.product, tile, opened.sources, opened.surface)
        record: dict[str, Any] = {"worst_residual": painted.residual, "cells": painted.cells}
        record |= {} if painted.gaps is None else {"gaps": painted.gaps}
        if painted.hidden is not None:
            record |= {"hidden": int(np.count_nonzero(painted.hidden)), "bare": painted.bare}
        if self.product.fill_hidden:
            codes = np.zeros(0) if painted.owner is None else painted.owner[painted.owner > FROM_IMAGE]
            around = int(np.count_nonzero(codes == FROM_SURROUNDINGS))
            record |= {"filled_from_images": codes.size - around, "filled_from_surroundings": around}
        made = {name: find(painted) for name, find in _OUTPUTS.items()}
        if self.errors is not None:
            made["accuracy"] = accuracy = self._accuracy(tile, painted, opened.surface, self.errors.open())
            record |= {} if accuracy is None else radial_counts(accuracy[0])
        return Made(tuple(made[name] for name in self.outputs), record)

    def _accuracy(self, tile: Tile, painted: Painted, surface: Surface, errors: KnownErrors) -> Output | None:
        """Return how exactly lies what is painted."""
        if painted.valid is None:
            return None
        owner = painted.owner
        if owner is None:
            owner = painted.valid * np.uint16(tile.sources[0] + 1)
        if self.product.fill_hidden:
            # How exactly filled pixels lie is not known.
            owner = np.where(owner > FROM_IMAGE, np.uint16(0), owner)
        found = tile_accuracy(self.product.target, tile.window, surface, errors.depth, errors.sources, owner)
        known = np.isfinite(found[0])
        return (found, known) if known.any() else None


def _picture(painted: Painted) -> Output | None:
    return None if painted.values is None else (painted.values, painted.valid)


def _mark(painted: Painted) -> Output | None:
    """Return whether pixels are hidden, where the image has them."""
    hidden = painted.hidden
    if hidden is None or (painted.valid is None and not hidden.any()):
        return None
    return hidden.astype(np.uint8)[None], hidden if painted.valid is None else hidden | painted.valid


def _sources(painted: Painted) -> Output | None:
    """Who painted each pixel."""
    return None if painted.owner is None else (painted.owner[None], painted.owner > 0)


_OUTPUTS: dict[OutputName, Callable[[Painted], Output | None]] = {
    "picture": _picture,
    "hidden": _mark,
    "sources": _sources,
}
