"""Raster filters: interleaving, block means, convolution, mirrored borders, shifts, tone, lines, polygons, edges."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

# Interleaving: the bands of a pixel side by side, as the kernels read them and as blocks of a file hold them.


def interleave(source: NDArray[Any], valid: NDArray[Any] | None = None) -> NDArray[Any]:
    """Planar pixels as groups of bands.

    Parameters
    ----------
    source : ndarray, shape (bands, height, width)
        uint8, uint16, int16 or float32.
    valid : ndarray, shape (height, width), or None
        Bool or uint8; pixels where it is 0 become 0, so that what they hold (nodata, NaN) cannot reach a product.

    Returns
    -------
    ndarray, shape (groups, height, width, lanes)
        One band: one group of one lane. More: groups of four bands side by side, the last filled up with 0.
    """
    bands, height, width = source.shape
    if bands == 1 and valid is None:
        return np.ascontiguousarray(source).reshape(1, height, width, 1)
    lanes = 1 if bands == 1 else 4
    packed = np.empty((-(-bands // lanes), height, width, lanes), source.dtype)
    if valid is None:
        _interleave_bands(np.ascontiguousarray(source), packed)
    else:
        _interleave_valid(np.ascontiguousarray(source), mask_bytes(valid), packed)
    return packed


def mask_bytes(mask: NDArray[Any]) -> NDArray[np.uint8]:
    """A mask as contiguous bytes, without a copy where it is one already."""
    return np.ascontiguousarray(mask).view(np.uint8)


@kernel
def _interleave_bands(source: NDArray[Any], packed: NDArray[Any]) -> None:
    """Two bands or more. Four named lanes, not a loop over them: the compiler then writes whole pixels."""
    bands, height, width = source.shape
    groups = packed.shape[0]
    nothing = np.zeros(width, source.dtype)
    for group in range(groups):
        first = 4 * group
        for row in range(height):
            a = source[first, row]
            b = source[first + 1, row] if first + 1 < bands else nothing
            c = source[first + 2, row] if first + 2 < bands else nothing
            d = source[first + 3, row] if first + 3 < bands else nothing
            target = packed[group, row]
            for i in range(width):
                target[i, 0] = a[i]
                target[i, 1] = b[i]
                target[i, 2] = c[i]
                target[i, 3] = d[i]


@kernel
def _interleave_valid(source: NDArray[Any], valid: NDArray[np.uint8], packed: NDArray[Any]) -> None:
    bands, height, width = source.shape
    groups, lanes = packed.shape[0], packed.shape[3]
    zero = source.dtype.type(0)
    for group in range(groups):
        for row in range(height):
            target = packed[group, row]
            usable = valid[row]
            for lane in range(lanes):
                band = group * lanes + lane
                if band < bands:
                    line = source[band, row]
                    for i in range(width):
                        target[i, lane] = line[i] if usable[i] != 0 else zero
                else:
                    for i in range(width):
                        target[i, lane] = zero


@kernel
def valid_patches(valid: NDArray[np.uint8], taps: int) -> NDArray[np.uint8]:
    """1 where the taps × taps pixels from (row, column) on to the lower right are all inside and valid; uint8."""
    height, width = valid.shape
    solid = np.zeros((height, width), np.uint8)
    along = np.zeros((height, width), np.uint8)
    for row in range(height):
        for col in range(width - taps + 1):
            every = valid[row, col]
            for k in range(1, taps):
                every = min(every, valid[row, col + k])
            along[row, col] = 1 if every != 0 else 0
    for row in range(height - taps + 1):
        for k in range(taps):
            for col in range(width):
                solid[row, col] = along[row, col] if k == 0 else solid[row, col] & along[row + k, col]
    return solid


@kernel
def fill_block(
    pixels: NDArray[Any], valid: NDArray[np.bool_], nodata: Any, neighbour: Any, fill: NDArray[Any], block: NDArray[Any]
) -> int:
    """Write a tile into the upper left of a block.

    Parameters
    ----------
    pixels : ndarray, shape (bands, height, width)
    valid : ndarray of bool, shape (height, width), or (0, 0): all are
    nodata, neighbour : scalars of the pixels' type
        Valid values that equal `nodata` become `neighbour`; with two equal scalars, or NaN, none is changed.
    fill : ndarray, shape (bands,), type of the pixels
        What invalid pixels hold.
    block : ndarray, shape (side, side, bands), type of the pixels
        The rest of it is left as it is.

    Returns
    -------
    int
        Number of valid values that became `neighbour`.
    """
    bands, height, width = pixels.shape
    everywhere = valid.shape[0] == 0
    apart = nodata != neighbour
    moved = 0
    for row in range(height):
        for band in range(bands):
            blank = fill[band]
            if everywhere:
                for col in range(width):
                    value = pixels[band, row, col]
                    hit = apart and value == nodata
                    moved += hit
                    block[row, col, band] = neighbour if hit else value
            else:
                for col in range(width):
                    value = pixels[band, row, col]
                    hit = apart and value == nodata and valid[row, col]
                    moved += hit
                    kept = neighbour if hit else value
                    block[row, col, band] = kept if valid[row, col] else blank
    return moved


# Reduction by means of square blocks.


@kernel
def reduce_means(
    source: NDArray[Any],
    valid: NDArray[np.bool_],
    side: int,
    whole: bool,
    out: NDArray[Any],
    out_valid: NDArray[np.bool_],
) -> None:
    """Mean of the valid pixels of each block of side × side pixels; blocks at the right and lower edge may be smaller.

    Parameters
    ----------
    source : (bands, height, width)
    valid : (height, width) bool, or (0, 0): all are valid
    whole : bool
        Whether means are rounded, half up, as integers want it.
    out : (bands, ceil(height / side), ceil(width / side)), type of `source`
        Filled; 0 where invalid.
    out_valid : (ceil(height / side), ceil(width / side)) bool
        Filled: whether at least half of the block's pixels are valid.
    """
    height, width = source.shape[1:]
    for row in range(out.shape[1]):
        top, bottom = row * side, min((row + 1) * side, height)
        for col in range(out.shape[2]):
            left, right = col * side, min((col + 1) * side, width)
            count = 0
            if valid.size > 0:
                for y in range(top, bottom):
                    for x in range(left, right):
                        count += valid[y, x]
            else:
                count = (bottom - top) * (right - left)
            good = 2 * count >= (bottom - top) * (right - left)
            out_valid[row, col] = good
            for band in range(source.shape[0]):
                total = 0.0
                if good:
                    for y in range(top, bottom):
                        for x in range(left, right):
                            if valid.size == 0 or valid[y, x]:
                                total += np.float64(source[band, y, x])
                    total /= count
                out[band, row, col] = np.floor(total + 0.5) if whole else total


# Convolution of one band in two dimensions, line by line, and rounding with a count of what is clipped.
#
# A pixel's result depends on its neighbours alone, to the last bit: the order of the sums is that of the kernel's rows
# and columns wherever a tile begins, and all columns go through the same vectorised code, because lines are padded to
# multiples of `CHUNK`.


#: Columns are computed in multiples of this number: sixteen lanes, four at once.
CHUNK = 64
#: Columns of weights that are unrolled together; a tag of that length selects the compiled code.
GENERAL_TAPS = (5, 11)
#: The same for one half of an even kernel, without its middle.
EVEN_TAPS = (5,)


@inner
def _store_line(
    total: NDArray[np.float32], valid: NDArray[np.bool_], limits: tuple[Any, ...], y: int, out: NDArray[Any]
) -> tuple[int, int]:
    """Round a line of sums, clip it, and write it to row y of `out`; see `round_clipped` for what is counted."""
    low, high = np.float32(limits[0]), np.float32(limits[1])
    below, above = 0, 0
    if low > high:
        for x in range(out.shape[1]):
            out[y, x] = total[x]
        return below, above
    everywhere = valid.shape[0] == 0
    for x in range(out.shape[1]):
        size = abs(total[x])
        whole = np.floor(size)
        # The difference is exact, whereas size + 0.5 may be rounded up to the next whole number.
        whole += np.float32(1.0) if size - whole >= np.float32(0.5) else np.float32(0.0)
        value = -whole if total[x] < 0 else whole
        counts = everywhere or valid[y, x]
        below += value < low and counts
        above += value > high and counts
        out[y, x] = np.int32(min(max(value, low), high))
    return below, above


@kernel
def convolve_general(
    source: NDArray[np.float32],
    start: tuple[int, int],
    weights: NDArray[np.float32],
    taps_tag: tuple[Any, ...],
    valid: NDArray[np.bool_],
    limits: tuple[float, float],
    out: NDArray[Any],
) -> tuple[int, int]:
    """Sum of weights times pixels: out[y, x] = Σ weights[i, k] · source[row + y + i, column + x + k].

    Parameters
    ----------
    source : (height, width) float32, contiguous
        Finite values; reaches `CHUNK` columns beyond the last one that is needed.
    start : (row, column)
        Pixel of `source` under the first weight of the first result.
    weights : (rows, columns) float32
        The columns are a multiple of the tag's length, filled up with zeros.
    taps_tag : tuple
        Its length is how many columns of weights are summed in one pass.
    valid, limits
        As in `round_clipped`; limits with low > high: sums are written as they are, and `out` is float32.
    out : (height, width)

    Returns
    -------
    below, above : int
        Clipped pixels, see `round_clipped`.
    """
    height, width = out.shape
    taps = len(taps_tag)
    rows, columns = weights.shape
    span = (width + CHUNK - 1) // CHUNK * CHUNK
    total = np.empty(span, np.float32)
    below, above = 0, 0
    for y in range(height):
        for x in range(span):
            total[x] = np.float32(0.0)
        for i in range(rows):
            line = source[start[0] + y + i]
            for first in range(0, columns, taps):
                part = line[start[1] + first :]
                for x in range(span):
                    value = total[x]
                    for k in range(taps):
                        # Unsigned: a negative index would count from the end, and that test would forbid vectors.
                        value += weights[i, first + k] * part[np.uintp(x) + np.uintp(k)]
                    total[x] = value
        counted = _store_line(total, valid, limits, y, out)
        below += counted[0]
        above += counted[1]
    return below, above


@kernel
def convolve_even(
    source: NDArray[np.float32],
    start: tuple[int, int],
    weights: NDArray[np.float32],
    taps_tag: tuple[Any, ...],
    valid: NDArray[np.bool_],
    limits: tuple[float, float],
    out: NDArray[Any],
) -> tuple[int, int]:
    """The same for kernels that are even in both directions: equal rows are added first, then equal columns.

    Parameters
    ----------
    source, taps_tag, valid, limits, out
        As in `convolve_general`, which also says what is returned.
    start : (row, column)
        Pixel of `source` under the upper left corner of the whole kernel, zeros included, for the first result.
    weights : (m + 1, n + 1) float32
        Middle row and column first; n is a multiple of the tag's length, and not 0.
    """
    height, width = out.shape
    taps = len(taps_tag)
    m, n = weights.shape[0] - 1, weights.shape[1] - 1
    span = (width + CHUNK - 1) // CHUNK * CHUNK
    total = np.empty(span, np.float32)
    below, above = 0, 0
    folded = np.empty(span + 2 * n, np.float32)
    middle = folded[n:]
    for y in range(height):
        for x in range(span):
            total[x] = np.float32(0.0)
        for i in range(m + 1):
            first_line, second_line = source[start[0] + y + m - i, start[1] :], source[start[0] + y + m + i, start[1] :]
            if i == 0:
                for x in range(span + 2 * n):
                    folded[x] = first_line[x]
            else:
                for x in range(span + 2 * n):
                    folded[x] = first_line[x] + second_line[x]
            for first in range(1, n + 1, taps):
                left, right = folded[n - first - taps + 1 :], folded[n + first :]
                if first == 1:
                    for x in range(span):
                        value = total[x] + weights[i, 0] * middle[x]
                        for k in range(taps):
                            both = left[np.uintp(x) + np.uintp(taps - 1 - k)] + right[np.uintp(x) + np.uintp(k)]
                            value += weights[i, 1 + k] * both
                        total[x] = value
                else:
                    for x in range(span):
                        value = total[x]
                        for k in range(taps):
                            both = left[np.uintp(x) + np.uintp(taps - 1 - k)] + right[np.uintp(x) + np.uintp(k)]
                            value += weights[i, first + k] * both
                        total[x] = value
        counted = _store_line(total, valid, limits, y, out)
        below += counted[0]
        above += counted[1]
    return below, above


@kernel
def round_clipped(
    values: NDArray[np.float32], valid: NDArray[np.bool_], limits: tuple[float, float], out: NDArray[Any]
) -> tuple[int, int]:
    """Round to whole numbers, halves away from zero, and clip to what the type holds.

    Parameters
    ----------
    values : (height, width) float32
    valid : (height, width) bool, or (0, 0): all are
        Only valid pixels are counted.
    limits : (low, high)
        Least and largest value of the type of `out`.
    out : (height, width), a type of whole numbers

    Returns
    -------
    below, above : int
        Pixels whose rounded value was below `low` and above `high`.
    """
    below, above = 0, 0
    for y in range(values.shape[0]):
        counted = _store_line(values[y], valid, limits, y, out)
        below += counted[0]
        above += counted[1]
    return below, above


# Mirrored borders: pixels beyond the edge of an image or of its valid part.


@kernel
def mirror_border(
    source: NDArray[np.float32],
    valid: NDArray[np.bool_],
    wanted: NDArray[np.bool_],
    offsets: NDArray[np.int32],
    place: tuple[Any, ...],
    out: NDArray[np.float32],
) -> None:
    """Fill invalid pixels so that constants and linear ramps go on.

    An invalid pixel q gets ``2 v(p) - v(2 p - q)`` from the nearest valid pixel p: the image reflected in p, grey value
    included. Where the pixel beyond p is invalid it gets v(p); where the pixel opposite of p is valid too, both are
    averaged; so are all valid pixels at the same distance.

    Parameters
    ----------
    source : (bands, height, width) float32
    valid : (height, width) bool
    wanted : (rows, columns) bool
        Pixels of `out` to be filled: invalid, with a valid one within the offsets.
    offsets : (n, 3) int32
        Squared distance, rows, columns: neighbours in the order of their distance, without (0, 0).
    place : (row, column, column in out)
        Pixel of `source` that is the first of `wanted`, and its column in `out`.
    out : (bands, rows, at least columns) float32
    """
    height, width = valid.shape
    for row in range(wanted.shape[0]):
        for col in range(wanted.shape[1]):
            if not wanted[row, col]:
                continue
            y, x = place[0] + row, place[1] + col
            nearest, count = -1, 0
            for k in range(offsets.shape[0]):
                if nearest >= 0 and offsets[k, 0] > nearest:
                    break
                dy, dx = offsets[k, 1], offsets[k, 2]
                py, px = y + dy, x + dx
                if not (0 <= py < height and 0 <= px < width and valid[py, px]):
                    continue
                nearest = offsets[k, 0]
                count += 1
                oy, ox = y - dy, x - dx
                between = 0 <= oy < height and 0 <= ox < width and valid[oy, ox]
                my, mx = py + dy, px + dx
                mirrored = not between and 0 <= my < height and 0 <= mx < width and valid[my, mx]
                for band in range(source.shape[0]):
                    value = source[band, py, px]
                    if mirrored:
                        value = np.float32(2.0) * value - source[band, my, mx]
                    before = out[band, row, place[2] + col] if count > 1 else np.float32(0.0)
                    out[band, row, place[2] + col] = before + value
            for band in range(source.shape[0]):
                if count > 0:
                    out[band, row, place[2] + col] /= np.float32(count)


# Band shifts: one band resampled at positions that are displaced a little from its own pixels.


@kernel
def shift_band(source, valid, offset, moved, rule, out, out_valid):
    """Values of a band at (column + dx, row + dy), by a separable kernel whose weights are polynomials.

    Beyond the border of the image the pixels at the border stand in; a value is valid where every pixel that carries
    weight is valid, and where its place lies at most half a pixel outside the source.

    Parameters
    ----------
    source : (H, W)
        Pixels of the band around the window.
    valid : (H, W) bool, or (0, 0) where all are valid
    offset : (int, int)
        Column and row of the window's first pixel in `source`.
    moved : (2, h, w) float64
        dx and dy of every pixel of the window.
    rule : (coefficients, limits)
        Coefficients (degree + 1, taps) float64 as `photoplan.kernels.weights.Kernel` holds them; smallest and largest
        value of whole-number types, the first above the second for floats: no rounding.
    out : (h, w), same type as the source
    out_valid : (h, w) bool
        Only ever set to False.
    """
    coefficients, limits = rule
    height, width = source.shape
    taps = coefficients.shape[1]
    degree = coefficients.shape[0] - 1
    first = taps // 2 - 1
    wx, wy = np.empty(taps), np.empty(taps)
    masked = valid.shape[0] > 0
    rounds = limits[0] < limits[1]
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            x = offset[0] + c + moved[0, r, c]
            y = offset[1] + r + moved[1, r, c]
            if not (x >= -0.5 and y >= -0.5 and x <= width - 0.5 and y <= height - 0.5):
                out_valid[r, c] = False
                out[r, c] = 0
                continue
            x0, y0 = int(np.floor(x)), int(np.floor(y))
            gx, gy = x - x0 - 0.5, y - y0 - 0.5
            for t in range(taps):
                a, b = coefficients[degree, t], coefficients[degree, t]
                for k in range(degree - 1, -1, -1):
                    a = a * gx + coefficients[k, t]
                    b = b * gy + coefficients[k, t]
                wx[t], wy[t] = a, b
            total = 0.0
            good = True
            for j in range(taps):
                row = min(max(y0 + j - first, 0), height - 1)
                part = 0.0
                for i in range(taps):
                    column = min(max(x0 + i - first, 0), width - 1)
                    part += wx[i] * source[row, column]
                    if masked and not valid[row, column] and abs(wx[i] * wy[j]) > 1e-6:
                        good = False
                total += wy[j] * part
            if not good:
                out_valid[r, c] = False
                out[r, c] = 0
                continue
            if rounds:
                total = min(max(np.floor(total + 0.5), limits[0]), limits[1])
            out[r, c] = total


def pixel_range(dtype: np.dtype[Any]) -> tuple[float, float]:
    """The limits in the `rule` of `shift_band` for a type of pixels."""
    if dtype.kind not in "iu":
        return 1.0, 0.0
    info = np.iinfo(dtype)
    return float(info.min), float(info.max)


def empty_mask() -> NDArray[np.bool_]:
    """The `valid` of `shift_band` where every pixel is valid."""
    return np.empty((0, 0), np.bool_)


# Tone: grey values divided by the trend over an image, through a table.


_Floats = NDArray[np.float64]


@kernel
def tone_pixels(
    values: _Floats,
    corner: tuple[int, int],
    size: tuple[int, int],
    trend: _Floats,
    least: float,
    grey: _Floats,
    becomes: _Floats,
) -> None:
    """Divide pixels by the trend and look them up, between entries linearly; NaN stays NaN.

    Parameters
    ----------
    values : ndarray, shape (height, width)
        Changed.
    corner, size : (int, int)
        Column and row of their upper-left pixel in the image, and its width and height.
    trend : ndarray, shape (n, m)
        Factors of uⁱ vʲ, columns and rows from the image's middle in half diagonals; and what the trend is at `least`.
    grey, becomes : ndarray
        The table; beyond it the first or last interval goes on.
    """
    half = np.hypot(size[0], size[1]) / 2
    powers, last = np.empty(trend.shape[0]), len(grey) - 2
    slopes, steps = np.empty(last + 1), (last + 1) / (grey[-1] - grey[0])
    for k in range(last + 1):
        slopes[k] = (becomes[k + 1] - becomes[k]) / (grey[k + 1] - grey[k])
    for row in range(values.shape[0]):
        v = (corner[1] + row - (size[1] - 1) / 2) / half
        for i in range(trend.shape[0]):
            total = 0.0
            for j in range(trend.shape[1] - 1, -1, -1):
                total = total * v + trend[i, j]
            powers[i] = total
        for col in range(values.shape[1]):
            u = (corner[0] + col - (size[0] - 1) / 2) / half
            total = 0.0
            for i in range(trend.shape[0] - 1, -1, -1):
                total = total * u + powers[i]
            x = values[row, col] / max(total, least)
            if np.isnan(x):
                continue
            # Most tables have equal steps: there the first guess is the entry.
            k = int(min(max((x - grey[0]) * steps, 0.0), last))
            while k < last and x >= grey[k + 1]:
                k += 1
            while k > 0 and x < grey[k]:
                k -= 1
            values[row, col] = becomes[k] + slopes[k] * (x - grey[k])


# Polygons: the part of each pixel's area that a polygon covers.


@kernel
def polygon_coverage(outline: NDArray[Any], total: NDArray[Any]) -> None:
    """Area to the right of every edge, summed with the sign of its direction: 0 outside a polygon, ±1 inside.

    An edge is cut at the borders of pixels; a piece in a pixel covers a trapezoid of it and all pixels to its right.

    Parameters
    ----------
    outline : ndarray, shape (n, 2)
        Column and row of the vertices, the first pixel from 0 to 1; finite.
    total : ndarray, shape (rows, columns + 1)
        Filled; its last column is without meaning.
    """
    rows, columns = total.shape[0], total.shape[1] - 1
    total[:] = 0.0
    for i in range(outline.shape[0]):
        j = i + 1 if i + 1 < outline.shape[0] else 0
        sign = 1.0 if outline[i, 1] < outline[j, 1] else -1.0
        upper, lower = (i, j) if sign > 0.0 else (j, i)
        ax, ay = outline[upper, 0], outline[upper, 1]
        dx, dy = outline[lower, 0] - ax, outline[lower, 1] - ay
        if dy == 0.0:
            continue
        for row in range(int(np.floor(min(max(ay, 0.0), rows))), int(np.ceil(max(min(ay + dy, rows), 0.0)))):
            top, bottom = max((row - ay) / dy, 0.0), min((row + 1 - ay) / dy, 1.0)
            if top >= bottom:
                continue
            left, right = ax + top * dx, ax + bottom * dx
            if left > right:
                left, right = right, left
            height = sign * (bottom - top) * dy
            at, more = left, True
            while more:
                stop = right
                if at < 0.0:
                    stop = min(right, 0.0)
                elif at < columns:
                    stop = min(right, np.floor(at) + 1.0)
                area = height * (stop - at) / (right - left) if right > left else height
                x = min(max((at + stop) / 2.0, 0.0), float(columns))
                column = min(int(x), columns - 1)
                total[row, column] += area * (column + 1 - x)
                total[row, column + 1] += area * (x - column)
                at, more = stop, stop < right
    for row in range(rows):
        for column in range(1, columns):
            total[row, column] += total[row, column - 1]


# Drawn lines of a width in pixels: how much of each pixel they cover.


@inner
def _half_plane_coverage(d: float, a: float, b: float) -> float:
    """Part of a pixel, a square, on one side of a line at a distance d from its centre; a ≥ b ≥ 0 are the parts of the
    line's normal along the sides of the pixel."""
    far = abs(d)
    if far >= 0.5 * (a + b):
        tail = 0.0
    elif far <= 0.5 * (a - b):
        tail = 0.5 - far / a
    else:
        tail = (0.5 * (a + b) - far) ** 2 / (2.0 * a * b)
    return 1.0 - tail if d > 0.0 else tail


@kernel
def draw_lines(segments: NDArray[Any], width: float, cover: NDArray[Any]) -> None:
    """Cover pixels with segments that have round ends.

    A pixel has the part of its area that a stripe of this width takes, so that a line's sum over the pixels is its
    width by its length, in every direction and wherever it lies between the pixels; where segments meet the larger
    counts. Ends are round nearly.

    Parameters
    ----------
    segments : ndarray, shape (n, 4)
        Column and row of both ends; (0, 0) is the centre of the first pixel.
    width : float
        Pixels.
    cover : ndarray, shape (rows, columns), float32
        Raised to the part of each pixel that is covered, 0 to 1.
    """
    rows, columns = cover.shape
    half, reach = width / 2.0, width / 2.0 + 0.75
    for i in range(segments.shape[0]):
        x, y, u, v = segments[i, 0], segments[i, 1], segments[i, 2], segments[i, 3]
        dx, dy = u - x, v - y
        squared = dx * dx + dy * dy
        first, last = max(0.0, np.ceil(min(y, v) - reach)), min(rows - 1.0, np.floor(max(y, v) + reach))
        for row in range(int(first), int(last) + 1):
            begin, end = 0.0, 1.0
            if abs(dy) > 1e-9:
                # The part of the segment that comes near this row.
                begin, end = (row - reach - y) / dy, (row + reach - y) / dy
                begin, end = max(min(begin, end), 0.0), min(max(begin, end), 1.0)
            left = min(x + begin * dx, x + end * dx) - reach
            right = max(x + begin * dx, x + end * dx) + reach
            for column in range(int(max(0.0, np.ceil(left))), int(min(columns - 1.0, np.floor(right))) + 1):
                px, py, t = column - x, row - y, 0.0
                if squared > 0.0:
                    t = min(max((px * dx + py * dy) / squared, 0.0), 1.0)
                px, py = px - t * dx, py - t * dy
                away = np.sqrt(px * px + py * py)
                if away > reach:
                    continue
                # The normal of the line; on its axis that of the segment.
                if away > 1e-9:
                    nx, ny = abs(px) / away, abs(py) / away
                elif squared > 0.0:
                    nx, ny = abs(dy) / np.sqrt(squared), abs(dx) / np.sqrt(squared)
                else:
                    nx, ny = 1.0, 0.0
                a, b = max(nx, ny), min(nx, ny)
                value = _half_plane_coverage(away + half, a, b) - _half_plane_coverage(away - half, a, b)
                if value > cover[row, column]:
                    cover[row, column] = value


# Edges: gradient ridges, to a fraction of a pixel, joined to chains.


@kernel
def gradient_ridge(gx: NDArray[np.float32], gy: NDArray[np.float32], least: float, offset: NDArray[np.float32]) -> int:
    """Find pixels whose gradient is the largest across the edge.

    Each is compared with its two neighbours in the column or row direction in which the gradient is steeper, and a
    parabola through the three gives the place of the ridge.

    Parameters
    ----------
    gx, gy
        Gradient, shape (h, w); NaN or 0 where it must not be used.
    least
        Smallest magnitude of an edge pixel.
    offset
        Filled, shape (h, w): by what the ridge lies right of (|gx| >= |gy|) or below the pixel, -0.5 to 0.5; NaN
        where there is none.

    Returns
    -------
    int
        Number of edge pixels.
    """
    h, w = gx.shape
    count = 0
    for i in range(h):
        for j in range(w):
            offset[i, j] = np.nan
            if i == 0 or j == 0 or i == h - 1 or j == w - 1:
                continue
            x, y = np.float64(gx[i, j]), np.float64(gy[i, j])
            middle = np.hypot(x, y)
            if not middle >= least:
                continue
            di, dj = (0, 1) if abs(x) >= abs(y) else (1, 0)
            # Only the part along this pixel's own gradient counts, so that another edge nearby does not hide it.
            before = (gx[i - di, j - dj] * x + gy[i - di, j - dj] * y) / middle
            after = (gx[i + di, j + dj] * x + gy[i + di, j + dj] * y) / middle
            if not (middle >= before and middle > after):
                continue
            bend = before - 2.0 * middle + after
            offset[i, j] = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
            count += 1
    return count


@kernel
def join_chains(
    index: NDArray[np.int32],
    place: NDArray[np.int32],
    direction: NDArray[np.float64],
    cosine: float,
    label: NDArray[np.int32],
) -> int:
    """Join edge pixels, neighbours or with one pixel between them, whose gradient agrees with that of the chain so far.

    Parameters
    ----------
    index
        Number of the edge pixel at each place, shape (h, w); -1: none.
    place
        Row and column of the edge pixels, shape (n, 2), those with the steepest gradient first: they begin chains.
    direction
        Their unit gradients (x, y), shape (n, 2).
    cosine
        Smallest cosine of the angle between a pixel's gradient and the mean of its chain.
    label
        Filled, shape (n,): number of the chain.

    Returns
    -------
    int
        Number of chains.
    """
    h, w = index.shape
    n = place.shape[0]
    stack = np.empty(n, np.int32)
    for k in range(n):
        label[k] = -1
    chains = 0
    for seed in range(n):
        if label[seed] >= 0:
            continue
        label[seed] = chains
        stack[0] = seed
        top = 1
        sx, sy = direction[seed, 0], direction[seed, 1]
        while top > 0:
            top -= 1
            k = stack[top]
            # Near 45 degrees noise decides between rows and columns, and single pixels are missing.
            for i in range(max(place[k, 0] - 2, 0), min(place[k, 0] + 3, h)):
                for j in range(max(place[k, 1] - 2, 0), min(place[k, 1] + 3, w)):
                    m = index[i, j]
                    if m < 0 or label[m] >= 0:
                        continue
                    ux, uy = direction[m, 0], direction[m, 1]
                    if ux * sx + uy * sy < cosine * np.sqrt(sx * sx + sy * sy):
                        continue
                    label[m] = chains
                    sx += ux
                    sy += uy
                    stack[top] = m
                    top += 1
        chains += 1
    return chains
