"""One pixel gathered from a packed source: the innermost step, written as LLVM vectors.

A row of taps is one load of 4 × 4 bytes or so; the rows are weighted and added first, then the columns. The same
few lines emit the code for every pixel type, number of taps and one or four interleaved bands; LLVM lowers the
vectors to whatever the processor has. `gather` in plain Python beside it says what is computed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from photoplan.kernels.jit import COMPILED, inner

_F32 = ir.FloatType()
_I32 = ir.IntType(32)
_FUSE = ("contract", "nsz")


def _gather_python(
    source: NDArray[Any],
    first: Any,
    stride: Any,
    gx: float,
    gy: float,
    coefficients: NDArray[Any],
    taps_tag: tuple[Any, ...],
    lanes_tag: tuple[Any, ...],
    out: NDArray[Any],
    at: int,
) -> None:
    """Weighted sum of taps × taps pixels of `lanes` interleaved bands, rounded into out[at·lanes : …].

    Parameters
    ----------
    source : array of any shape, C order
        Packed pixels (see `pack`); indices below count its elements.
    first, stride : int
        Element of the first tap, and elements from one row of taps to the next.
    gx, gy : float
        x − floor(x) − 1/2 and y − floor(y) − 1/2.
    coefficients : (degree + 1, 2·W) float32
        Powers of g down, taps of x then taps of y across, W = taps rounded up to a power of two.
    taps_tag, lanes_tag : tuple of int
        Only their lengths count: number of taps, number of bands side by side. They are part of the types, so each
        combination is compiled on its own.
    out : one-dimensional, same type as the source
    at : int
        Pixel of `out` to be written.
    """
    taps, lanes = len(taps_tag), len(lanes_tag)
    width = coefficients.shape[1] // 2
    g = np.repeat(np.array([gx, gy], np.float32), width)
    weights = np.zeros(2 * width, np.float32)
    for row in coefficients[::-1]:
        weights = weights * g + row
    flat = source.ravel()
    patch = np.stack([flat[first + r * stride : first + r * stride + taps * lanes] for r in range(taps)])
    patch = patch.reshape(taps, taps, lanes).astype(np.float32)
    middle = max(taps // 2 - 1, 0)
    base = patch[middle, middle].copy() if source.dtype.kind == "f" else np.zeros(lanes, np.float32)
    columns = np.tensordot(weights[width : width + taps], patch - base, 1)
    value = np.tensordot(weights[:taps], columns, 1) + base
    if source.dtype.kind != "f":
        limits = np.iinfo(source.dtype)
        value = np.clip(np.trunc(value + np.copysign(np.float32(0.5), value)), limits.min, limits.max)
    out[at * lanes : (at + 1) * lanes] = value.astype(source.dtype)


def _vector(count: int, element: Any) -> Any:
    return ir.VectorType(element, count)


def _splat(builder: Any, value: Any, count: int) -> Any:
    """A scalar in all elements of a vector."""
    one = builder.insert_element(ir.Constant(_vector(count, value.type), ir.Undefined), value, _I32(0))
    return _shuffle(builder, one, [0] * count)


def _shuffle(builder: Any, vector: Any, picks: list[int]) -> Any:
    mask = ir.Constant(_vector(len(picks), _I32), picks)
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), mask)


def _fused(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """a · b + c; one rounding where the processor can."""
    return builder.fadd(builder.fmul(a, b, flags=_FUSE), c, flags=_FUSE)


def _load(builder: Any, data: Any, index: Any, count: int) -> Any:
    """`count` elements from data[index] on, at any alignment."""
    place = builder.gep(data, [index])
    element = data.type.pointee
    return builder.load(builder.bitcast(place, _vector(count, element).as_pointer()), align=1)


def _widen(builder: Any, vector: Any, dtype: Any) -> Any:
    """Pixels as float32."""
    if isinstance(dtype, types.Float):
        return vector
    wide = _vector(vector.type.count, _F32)
    return builder.sitofp(vector, wide) if dtype.signed else builder.uitofp(vector, wide)


def _weights(builder: Any, coefficients: Any, degree: int, width: int, g: tuple[Any, Any]) -> Any:
    """Weights of x in the lower half, of y in the upper half of one vector (Horner's rule)."""
    lower, upper = (_splat(builder, each, width) for each in g)
    mask = ir.Constant(_vector(2 * width, _I32), list(range(2 * width)))
    both = builder.shuffle_vector(lower, upper, mask)
    result = _load(builder, coefficients, ir.IntType(64)(degree * 2 * width), 2 * width)
    for power in range(degree - 1, -1, -1):
        row = _load(builder, coefficients, ir.IntType(64)(power * 2 * width), 2 * width)
        result = _fused(builder, result, both, row)
    return result


def _total(builder: Any, vector: Any, lanes: int) -> Any:
    """Sum of the taps of a vector of taps × lanes."""
    count = vector.type.count
    while count > lanes:
        half = count // 2
        lower = _shuffle(builder, vector, list(range(half)))
        upper = _shuffle(builder, vector, list(range(half, count)))
        vector = builder.fadd(lower, upper, flags=_FUSE)
        count = half
    return vector


def _narrow(builder: Any, value: Any, dtype: Any) -> Any:
    """Round half away from zero, clip, convert to the pixels' type."""
    if isinstance(dtype, types.Float):
        return value
    kind = value.type

    def number(x: float) -> Any:
        return ir.Constant(kind, [x] * kind.count)

    half = number(0.5)
    if dtype.signed:
        half = builder.select(builder.fcmp_ordered("<", value, number(0.0)), number(-0.5), half)
    value = builder.fadd(value, half)
    low, high = float(dtype.minval), float(dtype.maxval)
    value = builder.select(builder.fcmp_ordered(">", value, number(low)), value, number(low))
    value = builder.select(builder.fcmp_ordered("<", value, number(high)), value, number(high))
    whole = builder.fptosi(value, _vector(kind.count, _I32))
    return builder.trunc(whole, _vector(kind.count, ir.IntType(dtype.bitwidth)))


def _chunks(taps: int) -> list[tuple[int, int]]:
    """(first tap, number of taps) of each load of a row."""
    return {1: [(0, 1)], 2: [(0, 2)], 4: [(0, 4)], 6: [(0, 4), (4, 2)]}[taps]


DEGREE = {1: 0, 2: 1, 4: 3, 6: 12}


def _emit(builder: Any, dtype: Any, taps: int, lanes: int, data: tuple[Any, Any, Any], place: tuple[Any, ...]) -> None:
    """The code of one gather; `data` = source, coefficients, out; `place` = first, stride, gx, gy, at."""
    source, coefficients, out = data
    first, stride, gx, gy, at = place
    width = {1: 1, 2: 2, 4: 4, 6: 8}[taps]
    weights = _weights(builder, coefficients, DEGREE[taps], width, (gx, gy))
    is_float = isinstance(dtype, types.Float)
    middle = max(taps // 2 - 1, 0)
    rows = [first]
    for _ in range(taps - 1):
        rows.append(builder.add(rows[-1], stride))
    if is_float:
        centre = builder.add(rows[middle], ir.IntType(64)(middle * lanes))
        base = _load(builder, source, centre, lanes)
    total = None
    for start, count in _chunks(taps):
        columns = None
        for r in range(taps):
            index = builder.add(rows[r], ir.IntType(64)(start * lanes))
            pixels = _widen(builder, _load(builder, source, index, count * lanes), dtype)
            if is_float:
                pixels = builder.fsub(pixels, _shuffle(builder, base, list(range(lanes)) * count))
            weight = _shuffle(builder, weights, [width + r] * (count * lanes))
            columns = (
                builder.fmul(weight, pixels, flags=_FUSE)
                if columns is None
                else _fused(builder, weight, pixels, columns)
            )
        weight = _shuffle(builder, weights, [start + j for j in range(count) for _ in range(lanes)])
        part = _total(builder, builder.fmul(weight, columns, flags=_FUSE), lanes)
        total = part if total is None else builder.fadd(total, part, flags=_FUSE)
    if is_float:
        total = builder.fadd(total, base)
    result = _narrow(builder, total, dtype)
    target = builder.gep(out, [builder.mul(at, ir.IntType(64)(lanes))])
    builder.store(result, builder.bitcast(target, result.type.as_pointer()), align=1)


@intrinsic
def _gather_llvm(
    typingctx: Any,
    source: Any,
    first: Any,
    stride: Any,
    gx: Any,
    gy: Any,
    coefficients: Any,
    taps_tag: Any,
    lanes_tag: Any,
    out: Any,
    at: Any,
) -> Any:
    """See `_gather_python`."""
    taps, lanes, dtype = len(taps_tag), len(lanes_tag), source.dtype
    signature = types.void(
        source,
        types.int64,
        types.int64,
        types.float32,
        types.float32,
        coefficients,
        taps_tag,
        lanes_tag,
        out,
        types.int64,
    )

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(position: Any) -> Any:
            return context.make_array(signature.args[position])(context, builder, value=args[position]).data

        _emit(builder, dtype, taps, lanes, (data(0), data(5), data(8)), (args[1], args[2], args[3], args[4], args[9]))
        return context.get_dummy_value()

    return signature, codegen


gather = _gather_llvm if COMPILED else _gather_python

_BLOCK = {1: 8, 4: 4}


def _add_block_python(
    source: NDArray[Any],
    place: tuple[Any, ...],
    wx: NDArray[np.float32],
    wy: NDArray[np.float32],
    base: NDArray[np.float32],
    lanes_tag: tuple[Any, ...],
    sums: NDArray[np.float32],
) -> None:
    """Add the weighted sum of a block of pixels, some columns wide and any number of rows high.

    sums[lane] += Σ wx[at_x + i] · wy[at_y + r] · (source[first + r · stride + i · lanes + lane] − base[lane]) over the
    `block_pixels` columns i and the rows r; integers are summed without base.

    Parameters
    ----------
    source : array of any shape, C order
    place : (first, stride, rows, at_x, at_y)
        Element of the first pixel, elements from row to row, number of rows, first weight of x and of y.
    wx, wy, base, sums : one-dimensional float32
    lanes_tag : tuple of int
        Its length counts: bands side by side.
    """
    first, stride, rows, at_x, at_y = place
    lanes = len(lanes_tag)
    many = _BLOCK[lanes]
    flat = source.ravel()
    block = np.stack([flat[first + r * stride : first + r * stride + many * lanes] for r in range(rows)])
    block = block.reshape(rows, many, lanes).astype(np.float32)
    if source.dtype.kind == "f":
        block = block - base[:lanes]
    columns = np.tensordot(wy[at_y : at_y + rows], block, 1)
    sums[:lanes] += np.tensordot(wx[at_x : at_x + many], columns, 1)


def _emit_block(builder: Any, dtype: Any, lanes: int, data: tuple[Any, ...], place: tuple[Any, ...]) -> None:
    """The code of `add_block`; `data` = source, wx, wy, base, sums."""
    source, wx, wy, base, sums = data
    first, stride, rows, at_x, at_y = place
    many = _BLOCK[lanes]
    count = many * lanes
    zero = ir.Constant(_vector(count, _F32), [0.0] * count)
    total = cgutils.alloca_once_value(builder, zero)
    is_float = isinstance(dtype, types.Float)
    if is_float:
        level = _shuffle(builder, _load(builder, base, ir.IntType(64)(0), lanes), list(range(lanes)) * many)
    with cgutils.for_range(builder, rows) as loop:
        index = builder.add(first, builder.mul(loop.index, stride))
        pixels = _widen(builder, _load(builder, source, index, count), dtype)
        if is_float:
            pixels = builder.fsub(pixels, level)
        weight = _splat(builder, builder.load(builder.gep(wy, [builder.add(at_y, loop.index)])), count)
        builder.store(_fused(builder, weight, pixels, builder.load(total)), total)
    weight = _shuffle(builder, _load(builder, wx, at_x, many), [i for i in range(many) for _ in range(lanes)])
    result = _total(builder, builder.fmul(weight, builder.load(total), flags=_FUSE), lanes)
    result = builder.fadd(_load(builder, sums, ir.IntType(64)(0), lanes), result)
    builder.store(result, builder.bitcast(sums, result.type.as_pointer()), align=1)


@intrinsic
def _add_block_llvm(
    typingctx: Any, source: Any, place: Any, wx: Any, wy: Any, base: Any, lanes_tag: Any, sums: Any
) -> Any:
    """See `_add_block_python`."""
    lanes, dtype = len(lanes_tag), source.dtype
    signature = types.void(source, types.UniTuple(types.int64, 5), wx, wy, base, lanes_tag, sums)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(position: Any) -> Any:
            return context.make_array(signature.args[position])(context, builder, value=args[position]).data

        place = cgutils.unpack_tuple(builder, args[1], 5)
        _emit_block(builder, dtype, lanes, (data(0), data(2), data(3), data(4), data(6)), place)
        return context.get_dummy_value()

    return signature, codegen


add_block = _add_block_llvm if COMPILED else _add_block_python


@inner
def block_pixels(lanes_tag: tuple[Any, ...]) -> int:
    """Columns of a block of `add_block`."""
    return 8 if len(lanes_tag) == 1 else 4
