"""Rectification of one tile from one source window: the only entry to the resampling kernels.

Validity, one rule: a tap outside the image, or invalid in the source's mask, carries no weight, and the rest is
renormalised. A pixel is valid if its height is finite, it lies in a rectangle of the anchors, its position lies within
the outer edges of the image's border pixels, and its valid taps carry at least half of the kernel's weight (nearest:
the pixel itself is valid). What invalid source pixels hold never enters a sum.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.footprint import STRETCH_CHECK, average_along_runs, footprint_runs, largest_scales, stretch_runs
from photoplan.kernels.jit import is_ready
from photoplan.kernels.positions import ALL_MINE, CELL, RUN, Owned, find_taps, line_offset_cells, tap_block, tile_runs
from photoplan.kernels.raster import interleave, mask_bytes, valid_patches
from photoplan.kernels.resample import average_runs, border_runs, gather_runs, line_scan_runs
from photoplan.kernels.weights import KERNELS, weight_table

AnchorArrays = tuple[NDArray[Any], ...]
"""rects (m, 4), box_start (m + 1,), box_heights (n, 2), corners (n, 8, 3), field_frame (5,), field (rows, cols, 2);
or, of a flight that changes from line to line, (6,) and (rows, cols, 5)."""

Border = tuple[float, float, float, float]
"""Outer edges of the image x_min, y_min, x_max, y_max in pixels of the source window."""

BLOCK = 64
"""Runs that go through the steps together: small enough to stay in the processor's cache."""

_NO_TILT = np.empty((2, 0, 0), np.float32)

_ANCHOR_TYPES = (np.int32, np.int32, np.float64, np.float64, np.float64, np.float32)


@lru_cache(maxsize=64)
def _rule(name: str, dtype: np.dtype[Any], lanes: int) -> tuple[Any, ...]:
    """Coefficients, tags and limits as `gather_runs` wants them."""
    kernel = KERNELS[name]
    width = {1: 1, 2: 2, 4: 4, 6: 8}[kernel.taps]
    coefficients = np.zeros((len(kernel.coefficients), 2 * width), np.float32)
    coefficients[:, : kernel.taps] = kernel.coefficients
    coefficients[:, width : width + kernel.taps] = kernel.coefficients
    limits = (-np.inf, np.inf, 0.0)
    if dtype.kind != "f":
        limits = (float(np.iinfo(dtype).min), float(np.iinfo(dtype).max), 0.5)
    return coefficients, ((0,) * kernel.taps, (0,) * lanes), limits


def rectify_tile(
    anchors: AnchorArrays,
    relief: NDArray[np.float32],
    source: NDArray[Any],
    valid: NDArray[Any] | None,
    border: Border | None,
    kernel: str,
    out: NDArray[Any],
    out_valid: NDArray[np.bool_],
    offset: tuple[int, int] = (0, 0),
    owned: Owned = ALL_MINE,
    tilt: NDArray[np.float32] | None = None,
) -> None:
    """Resample one tile from a source window.

    Parameters
    ----------
    anchors : tuple of arrays
        rects (m, 4) int32, box_start (m + 1,) int32, box_heights (n, 2) float64, corners (n, 8, 3) float64,
        field_frame (5,) float64, field (rows, cols, 2) float32, or (6,) and (rows, cols, 5): the fields of
        `photoplan.plan.Anchors`.
    relief : ndarray, shape (rows, cols), float32
        Height of every pixel, metres; NaN where there is no surface.
    source : ndarray, shape (bands, height, width)
        uint8, uint16, int16 or float32; or interleaved for several tiles, (groups, height, width, lanes).
    valid : ndarray, shape (height, width), or None
        Bool or uint8, 0 = invalid. NaN pixels of float data must be marked here.
    border : (x_min, y_min, x_max, y_max) or None
        Outer edges of the image in pixels of the window; None: the window is the image.
    kernel : str
        A name of `KERNELS`.
    out : ndarray, shape (bands, rows, cols), type of `source`
        Written everywhere; 0 where the pixel is not valid. With `owned`, only there.
    out_valid : ndarray, shape (rows, cols), bool
        As `out`.
    offset : (column, row)
        First pixel of `relief` and `out` in the tile's pixels: part of a tile is the same, byte by byte, as the tile
        cut afterwards.
    owned : (raster of uint16, number, part)
        Pixels that the source paints, see `tile_runs`; all others are left as they are. Several sources compose a tile
        one after the other, at the cost of their own pixels.
    tilt : ndarray, shape (2, rows, cols), float32, optional
        Change of the relief per column and per row, see `depth_tilt`, where it decides what a pixel covers: in a view.
        None: on a map, where a step of the relief covers no ground.

    Notes
    -----
    Integers are rounded half away from zero and clipped. Where the target is coarser than the source the kernel is
    widened along image x and y (see `weights.stretch`), except for "nearest", which keeps grey values. With `tilt` it
    is widened by the width of what a pixel covers, and repeated along its length, see `photoplan.kernels.footprint`.
    """
    packed = source if source.ndim == 4 else interleave(source, valid)
    height, width = packed.shape[1:3]
    target, target_valid = _plain(out, out.dtype), _plain(out_valid, bool)
    if owned is ALL_MINE:
        target[...] = 0
        target_valid[...] = False
    arrays = tuple(_plain(np.asarray(array), dtype) for array, dtype in zip(anchors, _ANCHOR_TYPES))
    if arrays[5].shape[2] == 5:
        arrays = (*arrays[:5], line_offset_cells(arrays[5]))
    if packed.size and len(arrays[0]):
        mask = solid = np.empty((0, 0), np.uint8)
        if valid is not None:
            mask = _plain(mask_bytes(valid), np.uint8)
            solid = valid_patches(mask, KERNELS[kernel].taps)
        edges = (-0.5, -0.5, width - 0.5, height - 0.5) if border is None else tuple(float(edge) for edge in border)
        image = (_plain(packed, packed.dtype), mask, solid, edges)
        place = (int(offset[0]), int(offset[1]))
        wanted = (_plain(owned[0], np.uint16), int(owned[1]), tuple(int(edge) for edge in owned[2]))
        ground = (_plain(relief, np.float32), _NO_TILT if tilt is None else _plain(tilt, np.float32))
        _resample(arrays, ground, image, kernel, (place, wanted), (target, target_valid))
    if target is not out:
        out[...] = target
    if target_valid is not out_valid:
        out_valid[...] = target_valid


def _plain(array: NDArray[Any], dtype: Any) -> NDArray[Any]:
    """The array in the one form that kernels are compiled for: contiguous, aligned, not read-only."""
    flags = array.flags
    ready = array.dtype == dtype and flags.c_contiguous and flags.aligned and flags.writeable
    return array if ready else np.require(array, dtype, ("C", "A", "W"))


def _resample(
    anchors: tuple[Any, ...],
    ground: tuple[NDArray[np.float32], NDArray[np.float32]],
    image: tuple[Any, ...],
    name: str,
    part: tuple[tuple[int, int], Owned],
    result: tuple[Any, ...],
) -> None:
    """Rectangles at about the source's scale, and those that are coarser, block by block."""
    rects, box_start, _, corners, frame, field = anchors
    offset, owned = part
    coarse = np.zeros(len(rects), bool)
    if name != "nearest":
        stretch = frame[4] if field.size else 1.0
        coarse = ~(stretch * largest_scales(rects, box_start, corners) <= STRETCH_CHECK) | (ground[1].size > 0)
    for averaging in (False, True):
        chosen = np.flatnonzero(coarse == averaging)
        if not len(chosen):
            continue
        runs = tile_runs(rects, chosen, offset, ground[0].shape, owned)
        block = tap_block(min(BLOCK, len(runs)))
        for start in range(0, len(runs), BLOCK):
            _block(anchors, runs[start : start + BLOCK], ground, image, name, offset, (block, averaging), result)


def _block(
    anchors: tuple[Any, ...],
    runs: NDArray[np.int32],
    ground: tuple[NDArray[np.float32], NDArray[np.float32]],
    image: tuple[Any, ...],
    name: str,
    offset: tuple[int, int],
    work: tuple[Any, bool],
    result: tuple[Any, ...],
) -> None:
    """The steps of one block of runs; those that no pixel needs are skipped (and not compiled)."""
    packed, mask, solid, edges = image
    block, averaging = work
    _, height, width, lanes = packed.shape
    coefficients, tags, limits = _rule(name, packed.dtype, lanes)
    taps = KERNELS[name].taps
    relief, tilt = ground
    by_rows = anchors[5].shape[2] == CELL
    doubtful = find_taps(anchors, runs, relief, offset, (taps, width, height, solid, edges), block, result[1])
    averaged = 0
    scales = np.empty((0, 2, RUN), np.float32)
    if averaging:
        scales = np.empty((len(runs), 4 if tilt.size else 2, RUN), np.float32)
        if tilt.size:
            averaged = footprint_runs(anchors, runs, ground, offset, block, scales)
        else:
            averaged = stretch_runs(anchors, runs, relief, offset, block, scales)
    if by_rows:
        rule = (coefficients, taps, weight_table(name), limits)
        line_scan_runs((packed, mask, solid), anchors, runs, (relief, offset), block, scales, rule, tags, result)
        return
    gather_runs(packed, runs, offset, block, coefficients, tags, result[0])
    if doubtful:
        border_runs(packed, mask, runs, offset, block, (coefficients, taps, limits), result)
    if averaged:
        average = average_along_runs if tilt.size else average_runs
        average(packed, mask, runs, offset, block, scales, (weight_table(name), tags[1], limits), result)


def is_compiled(dtype: Any, bands: int, kernel: str) -> bool:
    """Whether the code for such pixels exists, in this process or on the disk; if not, the first tile waits for it.

    Costs a few milliseconds. Kernels are compiled once for each type of pixel, for one band or several, and for one,
    two, four or six taps; callers announce it ("compiling kernels, once") when this is False. The code for averaging
    is compiled apart, when a tile is first coarser than its source. Plain Python (`NUMBA_DISABLE_JIT=1`) is True.
    """
    lanes = 1 if bands == 1 else 4
    coefficients, tags, _ = _rule(kernel, np.dtype(dtype), lanes)
    source, out = np.empty((1, 1, 1, lanes), dtype), np.empty((bands, 1, 1), dtype)
    return is_ready(gather_runs, (source, np.empty((0, 5), np.int32), (0, 0), tap_block(0), coefficients, tags, out))
