"""From a scene to the light on every pixel: spread, sampling by the aperture, displaced lines and bands, fall-off."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import ceil
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from photoplan.geometry.grid import Window
from photoplan.quality.formation.kernels import PixelKernel, pixel_kernel
from photoplan.quality.formation.parts import Aperture, Falloff, Lateral, LineJitterPart, Spread
from photoplan.quality.formation.scenes import LightScene

_Array = NDArray[np.float64]
_Spectrum = NDArray[np.complex128]
#: Cells of a tile's side, without the margin of the spread function.
_TILE_CELLS = 1400
#: The least where the spread function varies: a small tile needs few of its scales, but is mostly margin.
_SMALL_TILE_CELLS = 350
#: Bytes of the transforms of kernels that are kept; one is kept in any case.
_KEPT_BYTES = 256 << 20
#: Ratio of neighbouring scales of a spread function that grows over the field; between them is interpolated.
_SCALE_STEP = 1.03
#: Cells around a tile that interpolation between cells may use.
_SPLINE_MARGIN = 20


@dataclass(frozen=True)
class Optics:
    """The parts of the model that decide how a scene is sampled."""

    spread: Spread
    aperture: Aperture
    lateral: tuple[Lateral, ...] = ()


def falloff_factors(falloff: Falloff, size: tuple[int, int], rows: slice | None = None) -> _Array:
    """Light of every pixel relative to the axis, shape (height, width); at least 0."""
    width, height = size
    cx, cy = falloff.centre if falloff.centre is not None else ((width - 1) / 2.0, (height - 1) / 2.0)
    half = np.hypot(width, height) / 2.0
    u = ((np.arange(width) - cx) / half)[None, :]
    v = ((np.arange(height) - cy) / half)[rows or slice(None), None]
    square = u**2 + v**2
    factors = np.ones(np.broadcast_shapes(u.shape, v.shape))
    if falloff.focal is not None:
        # cos α = f / √(f² + r²)
        factors *= (1.0 + square * (half / falloff.focal) ** 2) ** -2.0
    if falloff.artificial:
        factors *= 1.0 - falloff.artificial * square ** (falloff.power / 2.0)
    if falloff.polynomial:
        factors *= sum(a * u**i * v**j for i, j, a in falloff.polynomial)
    return np.maximum(factors, 0.0)


def line_displacements(jitter: LineJitterPart, lines: int, rng: np.random.Generator) -> _Array:
    """By how many pixels each line of a frame is moved to the right, shape (lines,)."""
    line = np.arange(lines)
    moved = jitter.amplitude * np.sin(2.0 * np.pi * line / jitter.period + np.radians(jitter.phase_deg))
    moved += np.where(line % 2 == 1, 0.5, -0.5) * jitter.field
    if jitter.sigma:
        moved += rng.normal(0.0, jitter.sigma, lines)
    return np.asarray(moved)


@dataclass(frozen=True, eq=False)
class Light:
    """Mean light on every pixel's aperture, in the units of the scene: computed tile by tile, in any order."""

    scene: LightScene
    optics: Optics
    falloff: Falloff = field(default_factory=Falloff)
    moved: _Array | None = None
    """By how many pixels each line shows the scene further right, shape (height,); None: not at all."""
    _transforms: _Transforms = field(default_factory=lambda: _Transforms(), repr=False)

    @property
    def tiles(self) -> list[Window]:
        """The tiles, from the middle outwards: those with the same scales of the spread function follow each other."""
        width, height = self.scene.size
        tiles = Window(0, 0, width, height).tiles(_tile_side(self.scene, self.optics))
        return sorted(tiles, key=lambda t: np.hypot(2 * t.col + t.width - width, 2 * t.row + t.height - height))

    def __call__(self, tile: Window) -> _Array:
        """Light on a tile, shape (bands, height, width); may be called from several threads."""
        rows = slice(tile.row, tile.stop[1])
        moved = None if self.moved is None else self.moved[rows]
        found = _tile(self.scene, self.optics, tile, moved, self._transforms)
        if self.falloff != Falloff():
            found *= falloff_factors(self.falloff, self.scene.size, rows)[:, tile.col : tile.stop[0]]
        return found

    def whole(self, known: Iterable[_Array] | None = None) -> _Array:
        """All tiles in their places, shape (bands, height, width); those of `tiles` that are known, or computed now."""
        width, height = self.scene.size
        out = np.empty((self.scene.bands, height, width))
        for tile, values in zip(self.tiles, map(self, self.tiles) if known is None else known):
            out[:, tile.row : tile.stop[1], tile.col : tile.stop[0]] = values
        return out


def _tile_side(scene: LightScene, optics: Optics) -> int:
    """Pixels of a tile's side."""
    k, cells = scene.oversampling, _TILE_CELLS
    if optics.spread.varies:
        ends = (Window(0, 0, 1, 1), Window(scene.size[0] // 2, scene.size[1] // 2, 1, 1))
        widest = max(_levels(optics.spread, scene.size, end)[-1] for end in ends)
        kernel = pixel_kernel(optics.spread, optics.aperture, widest, k, scene.continuous)
        cells = min(cells, max(_SMALL_TILE_CELLS, *kernel.spread.shape))
    return max(16, cells // k)


@dataclass(frozen=True)
class _Transforms:
    """Fourier transforms of kernels; those that fit into a bound of memory are kept."""

    kept: dict[tuple[PixelKernel, tuple[int, int]], _Spectrum] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)

    def of(self, kernel: PixelKernel, shape: tuple[int, int]) -> _Spectrum:
        """Transform of a kernel; the convolution holds a pixel's value at the first cell of the pixel."""
        with self.lock:
            known = self.kept.get((kernel, shape))
        return self._made(kernel, shape) if known is None else known

    def _made(self, kernel: PixelKernel, shape: tuple[int, int]) -> _Spectrum:
        cells = np.zeros(shape)
        rows, columns = kernel.spread.shape
        cells[:rows, :columns] = kernel.spread
        made = fft.rfft2(np.roll(cells, (-(rows // 2) - kernel.row, -(columns // 2) - kernel.column), (0, 1)))
        if kernel.weights.size > 1:
            made *= np.conj(fft.rfft2(kernel.weights, shape))
        with self.lock:
            while self.kept and sum(each.nbytes for each in self.kept.values()) + made.nbytes > _KEPT_BYTES:
                del self.kept[next(iter(self.kept))]
            self.kept[kernel, shape] = made
        return np.asarray(made)


def _displacement(
    lateral: tuple[Lateral, ...], band: int, size: tuple[int, int], tile: Window, moved: _Array | None
) -> tuple[_Array, _Array] | None:
    """Where a band's pixels take their light: distances (dx, dy) of that place from the pixel; None: none at all."""
    mine = [each for each in lateral if each.band == band + 1]
    if not mine and moved is None:
        return None
    u, v = _from_middle(size, tile)
    dx, dy = np.zeros((tile.height, tile.width)), np.zeros((tile.height, tile.width))
    if moved is not None:
        dx -= moved[:, None]
    corner = (np.hypot(*size) / 2.0) ** 2
    for each in mine:
        # The place that the optics brings to a pixel, by iterating the displacement (it contracts by its scale).
        px, py = u + dx, v + dy
        for _ in range(4):
            factor = each.scale + each.cubic * ((u + dx) ** 2 + (v + dy) ** 2) / corner
            dx = px - u - (u + dx) * factor - each.shift[0]
            dy = py - v - (v + dy) * factor - each.shift[1]
    return dx, dy


def _tile(scene: LightScene, optics: Optics, tile: Window, moved: _Array | None, transforms: _Transforms) -> _Array:
    """Light on the pixels of a tile, shape (bands, height, width)."""
    k = scene.oversampling
    moves = [_displacement(optics.lateral, b, scene.size, tile, moved) for b in range(scene.bands)]
    far = max((float(np.abs(d).max()) for m in moves if m is not None for d in m), default=0.0)
    extra = ceil(far) + -(-_SPLINE_MARGIN // k) if any(m is not None for m in moves) else 0
    levels = _levels(optics.spread, scene.size, tile)
    kernels = [pixel_kernel(optics.spread, optics.aperture, scale, k, scene.continuous) for scale in levels]
    shares = [_level_share(optics.spread, levels, index, scene.size, tile) for index in range(len(levels))]
    reach = max(
        max(each.spread.shape) // 2 + max(each.weights.shape) + max(-each.row, -each.column, 0) for each in kernels
    )
    margin = extra + -(-reach // k)
    window = Window(tile.col - margin, tile.row - margin, tile.width + 2 * margin, tile.height + 2 * margin)
    cells = scene.cells(window)
    light = np.zeros((scene.bands, tile.height, tile.width))
    for band, move in enumerate(moves):
        used = [(kernel, share) for kernel, share in zip(kernels, shares) if share.any()]
        means = _means(cells[band], [kernel for kernel, _ in used], transforms, k, k if move is None else 1)
        for (_, share), values in zip(used, means):
            light[band] += share * _at_pixels(values, margin, k, (tile.height, tile.width), move)
    return light


def _means(cells: _Array, kernels: list[PixelKernel], transforms: _Transforms, k: int, step: int) -> Iterator[_Array]:
    """For each kernel the values of pixels that begin at the cells, or at every `step`-th cell.

    The margin of the cells is wider than the kernels: what a periodic convolution brings from the other side stays
    there.
    """
    # Whole pixels, of a number whose transform is quick.
    rows, columns = (k * fft.next_fast_len(n // k, real=True) for n in cells.shape)
    shape = rows, columns
    spectrum: _Spectrum | None = None
    for kernel in kernels:
        if _is_direct(kernel):
            yield _convolved(cells, kernel)[::step, ::step]
            continue
        spectrum = fft.rfft2(cells, shape) if spectrum is None else spectrum
        # To take every step-th row is to add the parts of the spectrum that fall on each other.
        parts = (step, shape[0] // step, -1)
        folded = np.einsum("kij,kij->ij", spectrum.reshape(parts), transforms.of(kernel, shape).reshape(parts)) / step
        yield fft.irfft(fft.ifft(folded, axis=0), shape[1], axis=1)[:, ::step]


def _is_direct(kernel: PixelKernel) -> bool:
    """Whether a convolution without Fourier transforms is quick."""
    weights = kernel.weights
    separable = np.allclose(weights, np.multiply.outer(weights.sum(1), weights.sum(0)), rtol=0.0, atol=1e-15)
    return kernel.spread.size <= 9 and separable


def _convolved(cells: _Array, kernel: PixelKernel) -> _Array:
    """Values of pixels that begin at the cells, for a small kernel and weights that are a product."""
    if kernel.spread.size > 1:
        cells = ndimage.convolve(cells, kernel.spread)
    for axis, first in enumerate((kernel.row, kernel.column)):
        weights = kernel.weights.sum(1 - axis)
        if weights.size > 1:
            cells = ndimage.correlate1d(cells, weights, axis=axis, origin=-(weights.size // 2))
        cells = np.roll(cells, -first, axis)
    return cells


def _at_pixels(
    means: _Array, margin: int, k: int, shape: tuple[int, int], move: tuple[_Array, _Array] | None
) -> _Array:
    """Values at the pixels of a tile: chosen from one for each pixel, or from one for each cell by cubic splines."""
    height, width = shape
    if move is None:
        return means[margin : margin + height, margin : margin + width]
    dx, dy = move
    rows = (margin + np.arange(height)[:, None] + dy) * k
    columns = (margin + np.arange(width)[None, :] + dx) * k
    return np.asarray(ndimage.map_coordinates(means, [rows, columns], order=3, mode="nearest"))


def _levels(spread: Spread, size: tuple[int, int], tile: Window) -> list[float]:
    """Scales of the spread function that a tile needs: steps of a common ladder."""
    if not spread.varies:
        return [1.0]
    scales = _scales(spread, size, tile)
    first = int(np.floor(np.log(scales.min()) / np.log(_SCALE_STEP) + 1e-9))
    last = int(np.ceil(np.log(scales.max()) / np.log(_SCALE_STEP) - 1e-9))
    return [float(_SCALE_STEP**step) for step in range(first, max(last, first) + 1)]


def _scales(spread: Spread, size: tuple[int, int], tile: Window) -> _Array:
    """Scale of the spread function at the pixels of a tile."""
    u, v = _from_middle(size, tile)
    return np.asarray(spread.scale_at(np.hypot(u, v) / (np.hypot(*size) / 2.0)))


def _from_middle(size: tuple[int, int], tile: Window) -> tuple[_Array, _Array]:
    """Columns and rows of a tile's pixels from the image's middle; they broadcast."""
    y, x = np.ogrid[tile.row : tile.stop[1], tile.col : tile.stop[0]]
    return x - (size[0] - 1) / 2.0, y - (size[1] - 1) / 2.0


def _level_share(spread: Spread, levels: list[float], index: int, size: tuple[int, int], tile: Window) -> _Array:
    """Share of one scale in each pixel: linear in the square of the scale between neighbouring levels."""
    if len(levels) == 1:
        return np.ones((tile.height, tile.width))
    squares = np.array(levels) ** 2
    unit = np.zeros(len(levels))
    unit[index] = 1.0
    return np.asarray(np.interp(_scales(spread, size, tile) ** 2, squares, unit))
