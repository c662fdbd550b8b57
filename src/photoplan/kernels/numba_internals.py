"""Numba's internals: the cache of compiled code on the disk, and SIMD vectors written in LLVM."""

from __future__ import annotations

import hashlib
import os
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba import types
from numba.extending import intrinsic

from photoplan.events import COMPILATIONS

# Internals of numba: its cache, and vectors.
#
# Numba promises none of it to stay. With a version that was not tried (`TRIED`), or where a part is missing, `USABLE`
# is False: kernels are then compiled from the plain loops in `resample` by documented ways alone, to the same values
# within rounding, slower. `PHOTOPLAN_PLAIN_KERNELS=1` chooses that too, so that tests run both ways.
#
# A pixel is gathered as vectors: a row of taps is one load of 4 × 4 bytes or so; the rows are weighted and added first,
# then the columns. The same few lines emit the code for every pixel type, number of taps and one or four interleaved
# bands; LLVM lowers the vectors to whatever the processor has.


try:
    from llvmlite import ir
    from numba.core import cgutils
    from numba.core.caching import FunctionCache, IndexDataCacheFile
    from numba.core.runtime import rtsys
except ImportError:
    _FOUND = False
else:
    _FOUND = True

try:
    from numba.core import event
except ImportError:  # a version without it: compilations are not counted
    pass
else:

    class _Compiling(event.Listener):
        """Pass on what numba broadcasts of its compilations."""

        def on_start(self, event: Any) -> None:
            COMPILATIONS.change(True)

        def on_end(self, event: Any) -> None:
            COMPILATIONS.change(False)

    event.register("numba:compile", _Compiling())

TRIED = ((0, 60), (0, 68))
"""First and last version of numba that these parts were tried with."""


def _is_usable(version: str, plain: str | None) -> bool:
    """Whether the parts below may be leaned on with this version, unless plain loops are asked for."""
    number = tuple(int(each) for each in version.split(".")[:2] if each.isdigit())
    return _FOUND and not plain and not numba.config.DISABLE_JIT and TRIED[0] <= number <= TRIED[1]


USABLE = _is_usable(numba.__version__, os.environ.get("PHOTOPLAN_PLAIN_KERNELS"))

UNTRIED = (
    f"numba {numba.__version__} was not tried with these kernels: they run from plain loops, up to 18 times slower, "
    f"with the same values within a grey level. Install 'numba>=0.{TRIED[0][1]},<0.{TRIED[1][1] + 1}'"
    if not (USABLE or numba.config.DISABLE_JIT or os.environ.get("PHOTOPLAN_PLAIN_KERNELS"))
    else ""
)
"""Why plain loops are compiled although nobody has asked for them; empty if they are not."""

# A call from Python or from C code needs wrappers, which are never used here; a call between parts is inlined, since
# arrays are many machine words each. Parts neither make nor return arrays, so that those who call them hold all that
# they touch: without counting references (two atomic operations for each array that is taken out of a tuple) a pixel is
# averaged in 51 instead of 166 ns. Numba refuses to compile a part that makes or returns one.
KERNEL_OPTIONS = {"no_cfunc_wrapper": True} if USABLE else {}
MAKER_OPTIONS = (
    {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "forceinline": True, "_nrt": True} if USABLE else {}
)
INNER_OPTIONS = MAKER_OPTIONS | {"_nrt": False} if USABLE else {}


_FOLDER = os.path.dirname(__file__)  # noqa: PTH120, every start waits for this: paths as text take a quarter of the time


@cache
def source(path: str, folder: str) -> tuple[bytes, tuple[str, ...]]:
    """Digest of a file of kernels, and the files of a folder that it imports as modules of this package."""
    text = Path(path).read_bytes()
    lines = [each.split(b"\n", 1)[0].decode() for each in text.split(b"\nfrom photoplan.kernels")[1:]]
    names = {name for each in lines for name in (each[1:].split()[0] if each[0] == "." else each[8:]).split(", ")}
    return hashlib.sha256(text).digest(), tuple(f"{folder}/{name}.py" for name in sorted(names))


@cache
def stamp(path: str, folder: str = _FOLDER) -> tuple[str, int]:
    """Digest of a file of kernels and of all that it imports, directly or not: kernels inline each other.

    Numba looks at the date of one file only.
    """
    digest, seen, waiting = hashlib.sha256(), {path}, [path]
    while waiting:
        own, files = source(waiting.pop(), folder)
        digest.update(own)
        fresh = [each for each in files if each not in seen]
        seen.update(fresh)
        waiting += fresh
    return digest.hexdigest(), 0


class _KernelCache(FunctionCache if USABLE else object):  # type: ignore[misc]
    """A kernel's compiled code on the disk, loaded without what only a compilation needs.

    Numba first imports all that it can compile, SciPy's linear algebra among it: 0.45 CPU s of each start.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


class _CacheIndex(IndexDataCacheFile if USABLE else object):  # type: ignore[misc]
    """What is kept of a kernel. What cannot be read is not there: a file that is damaged, or names a class of before.

    Numba reads all of an index before it asks whether the sources are the same, and ends with what goes wrong then.
    """

    def load(self, key: Any) -> Any:
        try:
            return super().load(key)
        except OSError:
            raise
        except Exception:
            return None

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except OSError:
            raise
        except Exception:
            return {}


def enable_cache(dispatcher: Any) -> None:
    """Keep a kernel on the disk as long as its sources are the same; another numba follows its own rules."""
    if not USABLE:
        dispatcher.enable_caching()
        return
    cache = dispatcher._cache = _KernelCache(dispatcher.py_func)
    own = stamp(dispatcher.py_func.__code__.co_filename)
    cache._cache_file = _CacheIndex(cache._cache_path, cache._impl.filename_base, own)


def is_cached(dispatcher: Any, signature: tuple[Any, ...]) -> bool:
    """Whether compiled code for these types is on the disk; False where that cannot be known."""
    if not USABLE or not isinstance(dispatcher._cache, FunctionCache):
        return False
    cache = dispatcher._cache
    try:
        return cache._index_key(signature, dispatcher.targetctx.codegen()) in cache._cache_file._load_index()
    except OSError:  # none that can be read
        return False


_FUSE = ("contract", "nsz")
BLOCK = {1: 8, 4: 4}
"""Columns of a block of `add_block`, by the number of bands side by side."""
DEGREE = {1: 0, 2: 1, 4: 3, 6: 12}
"""Of the polynomials that are the weights, by the number of taps."""


def _vector(count: int, element: Any) -> Any:
    return ir.VectorType(element, count)


def _splat(builder: Any, value: Any, count: int) -> Any:
    """A scalar in all elements of a vector."""
    one = builder.insert_element(ir.Constant(_vector(count, value.type), ir.Undefined), value, ir.IntType(32)(0))
    return _shuffle(builder, one, [0] * count)


def _shuffle(builder: Any, vector: Any, picks: list[int]) -> Any:
    mask = ir.Constant(_vector(len(picks), ir.IntType(32)), picks)
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
    wide = _vector(vector.type.count, ir.FloatType())
    return builder.sitofp(vector, wide) if dtype.signed else builder.uitofp(vector, wide)


def _weights(builder: Any, coefficients: Any, degree: int, width: int, g: tuple[Any, Any]) -> Any:
    """Weights of x in the lower half, of y in the upper half of one vector (Horner's rule)."""
    lower, upper = (_splat(builder, each, width) for each in g)
    mask = ir.Constant(_vector(2 * width, ir.IntType(32)), list(range(2 * width)))
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
    whole = builder.fptosi(value, _vector(kind.count, ir.IntType(32)))
    return builder.trunc(whole, _vector(kind.count, ir.IntType(dtype.bitwidth)))


def _chunks(taps: int) -> list[tuple[int, int]]:
    """(first tap, number of taps) of each load of a row."""
    return {1: [(0, 1)], 2: [(0, 2)], 4: [(0, 4)], 6: [(0, 4), (4, 2)]}[taps]


def _emit(builder: Any, dtype: Any, taps: int, lanes: int, data: tuple[Any, Any, Any], place: tuple[Any, ...]) -> None:
    """The code of one gather; `data` = source, coefficients, out; `place` = rows, gx, gy, at.

    rows: first element of each row of taps; gx: one for all rows, or one for each.
    """
    source, coefficients, out = data
    rows, gx, gy, at = place
    width = {1: 1, 2: 2, 4: 4, 6: 8}[taps]
    each = [_weights(builder, coefficients, DEGREE[taps], width, (x, gy)) for x in gx]
    is_float, apart, weights = isinstance(dtype, types.Float), len(gx) > 1, each[0]
    middle = max(taps // 2 - 1, 0)
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
            if apart:
                own = _shuffle(builder, each[r], [start + j for j in range(count) for _ in range(lanes)])
                weight = builder.fmul(weight, own, flags=_FUSE)
            columns = (
                builder.fmul(weight, pixels, flags=_FUSE)
                if columns is None
                else _fused(builder, weight, pixels, columns)
            )
        if not apart:
            weight = _shuffle(builder, weights, [start + j for j in range(count) for _ in range(lanes)])
            columns = builder.fmul(weight, columns, flags=_FUSE)
        part = _total(builder, columns, lanes)
        total = part if total is None else builder.fadd(total, part, flags=_FUSE)
    if is_float:
        total = builder.fadd(total, base)
    result = _narrow(builder, total, dtype)
    target = builder.gep(out, [builder.mul(at, ir.IntType(64)(lanes))])
    builder.store(result, builder.bitcast(target, result.type.as_pointer()), align=1)


@intrinsic
def gather(
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
    """The vectors of `resample.gather`."""
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

        rows = [args[1]]
        for _ in range(taps - 1):
            rows.append(builder.add(rows[-1], args[2]))
        _emit(builder, dtype, taps, lanes, (data(0), data(5), data(8)), (rows, [args[3]], args[4], args[9]))
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def gather_lines(
    typingctx: Any,
    source: Any,
    rows: Any,
    gx: Any,
    gy: Any,
    coefficients: Any,
    taps_tag: Any,
    lanes_tag: Any,
    out: Any,
    at: Any,
) -> Any:
    """The vectors of `resample.gather_lines`."""
    taps, lanes, dtype = len(taps_tag), len(lanes_tag), source.dtype
    signature = types.void(source, rows, gx, types.float32, coefficients, taps_tag, lanes_tag, out, types.int64)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(position: Any) -> Any:
            return context.make_array(signature.args[position])(context, builder, value=args[position]).data

        def each(position: Any) -> Any:
            return [builder.load(builder.gep(data(position), [ir.IntType(64)(r)])) for r in range(taps)]

        _emit(builder, dtype, taps, lanes, (data(0), data(4), data(7)), (each(1), each(2), args[3], args[8]))
        return context.get_dummy_value()

    return signature, codegen


def _emit_block(builder: Any, dtype: Any, lanes: int, data: tuple[Any, ...], place: tuple[Any, ...]) -> None:
    """The code of `add_block`; `data` = source, wx, wy, base, sums."""
    source, wx, wy, base, sums = data
    first, stride, rows, at_x, at_y = place
    many = BLOCK[lanes]
    count = many * lanes
    zero = ir.Constant(_vector(count, ir.FloatType()), [0.0] * count)
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
def add_block(typingctx: Any, source: Any, place: Any, wx: Any, wy: Any, base: Any, lanes_tag: Any, sums: Any) -> Any:
    """The vectors of `resample.add_block`."""
    lanes, dtype = len(lanes_tag), source.dtype
    signature = types.void(source, types.UniTuple(types.int64, 5), wx, wy, base, lanes_tag, sums)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(position: Any) -> Any:
            return context.make_array(signature.args[position])(context, builder, value=args[position]).data

        place = cgutils.unpack_tuple(builder, args[1], 5)
        _emit_block(builder, dtype, lanes, (data(0), data(2), data(3), data(4), data(6)), place)
        return context.get_dummy_value()

    return signature, codegen


# Sums of a facet, as LLVM vectors.


#: Cubic B-splines over a facet by powers of the part of it, from the highest on (`facets.spline`).
_SPLINES = [
    [-1 / 6, 3 / 6, -3 / 6, 1 / 6],
    [3 / 6, -6 / 6, 3 / 6, 0.0],
    [-3 / 6, 0.0, 3 / 6, 0.0],
    [1 / 6, 4 / 6, 1 / 6, 0.0],
]
PAIRS = ((0, 0), (1, 1), (2, 2), (3, 3), (0, 1), (1, 2), (2, 3), (0, 2), (1, 3), (0, 3))
"""Of four coefficients."""


@intrinsic
def add_pixel(typingctx: Any, pixels: Any, n: Any, sums: Any) -> Any:
    """The vectors of `facets.add_pixel_loops`."""
    signature = types.void(pixels, types.int64, sums)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, out = (context.make_array(signature.args[k])(context, builder, value=args[k]).data for k in (0, 2))

        def add(at: int, a: Any, b: Any) -> None:
            found = _fused(builder, a, b, _load(builder, out, ir.IntType(64)(at), a.type.count))
            builder.store(
                found,
                builder.bitcast(builder.gep(out, [ir.IntType(64)(at)]), found.type.as_pointer()),
                align=1,
            )

        def product(a: Any, b: Any) -> Any:
            return builder.fmul(a, b, flags=_FUSE)

        pixel = _load(builder, source, builder.mul(args[1], ir.IntType(64)(4)), 4)
        places = _shuffle(builder, pixel, [0] * 4 + [1] * 4)
        splines = ir.Constant(places.type, _SPLINES[0] * 2)
        for row in _SPLINES[1:]:
            splines = _fused(builder, splines, places, ir.Constant(places.type, row * 2))
        of_columns, of_rows = (
            [_shuffle(builder, splines, [first + pair[k] for pair in PAIRS]) for k in (0, 1)] for first in (0, 4)
        )
        columns, rows = product(*of_columns), product(product(*of_rows), _shuffle(builder, pixel, [2] * 10))
        eight = _shuffle(builder, columns, list(range(8)))
        for k in range(10):
            add(8 * k, _shuffle(builder, rows, [k] * 8), eight)
        for k in (8, 9):
            add(
                16 + 8 * k,
                _shuffle(builder, columns, [k] * 8),
                _shuffle(builder, rows, list(range(8))),
            )
        add(96, _shuffle(builder, columns, [8, 8, 9, 9]), _shuffle(builder, rows, [8, 9, 8, 9]))
        right = product(_shuffle(builder, pixel, [2] * 4), _shuffle(builder, pixel, [3] * 4))
        right = product(right, _shuffle(builder, splines, [4, 5, 6, 7]))
        for b in (0, 2):
            add(
                100 + 4 * b,
                _shuffle(builder, right, [b] * 4 + [b + 1] * 4),
                _shuffle(builder, splines, [0, 1, 2, 3] * 2),
            )
        return context.get_dummy_value()

    return signature, codegen
