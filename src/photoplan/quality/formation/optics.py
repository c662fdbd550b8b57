"""From a scene to the light on every pixel: spread, sampling by the aperture, displaced lines and bands, fall-off."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from photoplan.geometry.grid import Window
from photoplan.quality.formation.kernels import pixel_kernel
from photoplan.quality.formation.optics_parts import Aperture, Falloff, Lateral, LineJitter, Spread
from photoplan.quality.formation.scenes import Scene

__all__ = ["Optics", "falloff_factors", "line_displacements", "sample_scene"]

_Array = NDArray[np.float64]
#: Cells of a tile, without the margin of the spread function.
_TILE_CELLS = 1400
#: The same where the spread function varies: a small tile needs few of its scales.
_SMALL_TILE_CELLS = 350
#: Ratio of neighbouring scales of a spread function that grows over the field; between them is interpolated.
_SCALE_STEP = 1.03
#: Cells around a tile that interpolation between cells may use.
_SPLINE_MARGIN = 12


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


def line_displacements(jitter: LineJitter, lines: int, rng: np.random.Generator) -> _Array:
    """By how many pixels each line of a frame is moved to the right, shape (lines,)."""
    line = np.arange(lines)
    moved = jitter.amplitude * np.sin(2.0 * np.pi * line / jitter.period + np.radians(jitter.phase_deg))
    moved += np.where(line % 2 == 1, 0.5, -0.5) * jitter.field
    if jitter.sigma:
        moved += rng.normal(0.0, jitter.sigma, lines)
    return np.asarray(moved)


def sample_scene(scene: Scene, optics: Optics, moved: _Array | None = None) -> _Array:
    """Mean light on every pixel's aperture, in the units of the scene.

    Parameters
    ----------
    scene : Scene
    optics : Optics
    moved : (height,), optional
        By how many pixels each line shows the scene further right.

    Returns
    -------
    array of shape (bands, height, width)
    """
    width, height = scene.size
    out = np.empty((scene.bands, height, width))
    side = max(16, (_SMALL_TILE_CELLS if optics.spread.varies else _TILE_CELLS) // scene.oversampling)
    for tile in Window(0, 0, width, height).tiles(side):
        rows, columns = slice(tile.row, tile.stop[1]), slice(tile.col, tile.stop[0])
        out[:, rows, columns] = _tile(scene, optics, tile, None if moved is None else moved[rows])
    return out


def _displacement(
    lateral: tuple[Lateral, ...], band: int, size: tuple[int, int], tile: Window, moved: _Array | None
) -> tuple[_Array, _Array] | None:
    """Where a band's pixels take their light: distances (dx, dy) of that place from the pixel; None: none at all."""
    mine = [each for each in lateral if each.band == band + 1]
    if not mine and moved is None:
        return None
    width, height = size
    u = (np.arange(tile.col, tile.stop[0]) - (width - 1) / 2.0)[None, :]
    v = (np.arange(tile.row, tile.stop[1]) - (height - 1) / 2.0)[:, None]
    dx, dy = np.zeros((tile.height, tile.width)), np.zeros((tile.height, tile.width))
    if moved is not None:
        dx -= moved[:, None]
    corner = (np.hypot(width, height) / 2.0) ** 2
    for each in mine:
        # The place that the optics brings to a pixel, by iterating the displacement (it contracts by its scale).
        px, py = u + dx, v + dy
        for _ in range(4):
            factor = each.scale + each.cubic * ((u + dx) ** 2 + (v + dy) ** 2) / corner
            dx = px - u - (u + dx) * factor - each.shift[0]
            dy = py - v - (v + dy) * factor - each.shift[1]
    return dx, dy


def _tile(scene: Scene, optics: Optics, tile: Window, moved: _Array | None) -> _Array:
    """Light on the pixels of a tile, shape (bands, height, width)."""
    k = scene.oversampling
    moves = [_displacement(optics.lateral, b, scene.size, tile, moved) for b in range(scene.bands)]
    far = max((float(np.abs(d).max()) for m in moves if m is not None for d in m), default=0.0)
    extra = ceil(far) + -(-_SPLINE_MARGIN // k) if any(m is not None for m in moves) else 0
    levels = _levels(optics.spread, scene.size, tile)
    kernels = [pixel_kernel(optics.spread, optics.aperture, scale, k, scene.continuous) for scale in levels]
    reach = max(
        max(each.spread.shape) // 2 + max(each.weights.shape) + max(-each.row, -each.column, 0) for each in kernels
    )
    margin = extra + -(-reach // k)
    window = Window(tile.col - margin, tile.row - margin, tile.width + 2 * margin, tile.height + 2 * margin)
    cells = scene.cells(window)
    light = np.zeros((scene.bands, tile.height, tile.width))
    for index, kernel in enumerate(kernels):
        share = _level_share(optics.spread, levels, index, scene.size, tile)
        if not share.any():
            continue
        for band, move in enumerate(moves):
            means = _convolved(cells[band], kernel.spread, kernel.weights)
            start = (margin * k + kernel.row, margin * k + kernel.column)
            light[band] += share * _at_pixels(means, start, k, (tile.height, tile.width), move)
    return light


def _convolved(cells: _Array, kernel: _Array, weights: _Array) -> _Array:
    """Cells spread by a kernel; then ``[i, j]`` holds the weighted mean of the cells from i, j on."""
    if kernel.size > 1:
        cells = signal.fftconvolve(cells, kernel, mode="same") if kernel.size > 9 else ndimage.convolve(cells, kernel)
    if weights.size == 1:
        return cells
    # Correlation with the weights, its first cell the one where the weights begin; the end is padded and never used.
    padded = np.pad(cells, ((0, weights.shape[0] - 1), (0, weights.shape[1] - 1)), mode="edge")
    if np.ptp(weights) == 0.0 or np.linalg.matrix_rank(weights) == 1:
        down, across = weights.sum(1), weights.sum(0)
        padded = ndimage.correlate1d(padded, down, axis=0, origin=-(down.size // 2))[: cells.shape[0]]
        padded = ndimage.correlate1d(padded, across, axis=1, origin=-(across.size // 2))[:, : cells.shape[1]]
        return np.asarray(padded)
    return np.asarray(signal.fftconvolve(padded, weights[::-1, ::-1], mode="valid"))


def _at_pixels(
    means: _Array, start: tuple[int, int], k: int, shape: tuple[int, int], move: tuple[_Array, _Array] | None
) -> _Array:
    """Means of apertures at the pixels of a tile; between cells by cubic splines where pixels are displaced."""
    height, width = shape
    if move is None:
        return means[start[0] : start[0] + height * k : k, start[1] : start[1] + width * k : k]
    dx, dy = move
    rows = start[0] + (np.arange(height)[:, None] + dy) * k
    columns = start[1] + (np.arange(width)[None, :] + dx) * k
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
    width, height = size
    u = (np.arange(tile.col, tile.stop[0]) - (width - 1) / 2.0)[None, :]
    v = (np.arange(tile.row, tile.stop[1]) - (height - 1) / 2.0)[:, None]
    square = (u**2 + v**2) / (np.hypot(width, height) / 2.0) ** 2
    return np.asarray(1.0 + spread.field_square * square + spread.field_fourth * square**2)


def _level_share(spread: Spread, levels: list[float], index: int, size: tuple[int, int], tile: Window) -> _Array:
    """Share of one scale in each pixel: linear in the square of the scale between neighbouring levels."""
    if len(levels) == 1:
        return np.ones((tile.height, tile.width))
    squares = np.array(levels) ** 2
    unit = np.zeros(len(levels))
    unit[index] = 1.0
    return np.asarray(np.interp(_scales(spread, size, tile) ** 2, squares, unit))
