"""A pixel added to the sums of its facet, written as LLVM vectors: see `numba_parts`, on which it leans."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic

from photoplan.kernels import numba_parts

#: Cubic B-splines over a facet by powers of the part of it, from the highest on (`facets_grey.spline`).
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
    """The vectors of `facets_sums.add_pixel_loops`."""
    signature = types.void(pixels, types.int64, sums)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, out = (context.make_array(signature.args[k])(context, builder, value=args[k]).data for k in (0, 2))

        def add(at: int, a: Any, b: Any) -> None:
            found = numba_parts._fused(
                builder, a, b, numba_parts._load(builder, out, numba_parts.ir.IntType(64)(at), a.type.count)
            )
            builder.store(
                found,
                builder.bitcast(builder.gep(out, [numba_parts.ir.IntType(64)(at)]), found.type.as_pointer()),
                align=1,
            )

        def product(a: Any, b: Any) -> Any:
            return builder.fmul(a, b, flags=numba_parts._FUSE)

        pixel = numba_parts._load(builder, source, builder.mul(args[1], numba_parts.ir.IntType(64)(4)), 4)
        places = numba_parts._shuffle(builder, pixel, [0] * 4 + [1] * 4)
        splines = numba_parts.ir.Constant(places.type, _SPLINES[0] * 2)
        for row in _SPLINES[1:]:
            splines = numba_parts._fused(builder, splines, places, numba_parts.ir.Constant(places.type, row * 2))
        of_columns, of_rows = (
            [numba_parts._shuffle(builder, splines, [first + pair[k] for pair in PAIRS]) for k in (0, 1)]
            for first in (0, 4)
        )
        columns, rows = product(*of_columns), product(product(*of_rows), numba_parts._shuffle(builder, pixel, [2] * 10))
        eight = numba_parts._shuffle(builder, columns, list(range(8)))
        for k in range(10):
            add(8 * k, numba_parts._shuffle(builder, rows, [k] * 8), eight)
        for k in (8, 9):
            add(
                16 + 8 * k,
                numba_parts._shuffle(builder, columns, [k] * 8),
                numba_parts._shuffle(builder, rows, list(range(8))),
            )
        add(96, numba_parts._shuffle(builder, columns, [8, 8, 9, 9]), numba_parts._shuffle(builder, rows, [8, 9, 8, 9]))
        right = product(numba_parts._shuffle(builder, pixel, [2] * 4), numba_parts._shuffle(builder, pixel, [3] * 4))
        right = product(right, numba_parts._shuffle(builder, splines, [4, 5, 6, 7]))
        for b in (0, 2):
            add(
                100 + 4 * b,
                numba_parts._shuffle(builder, right, [b] * 4 + [b + 1] * 4),
                numba_parts._shuffle(builder, splines, [0, 1, 2, 3] * 2),
            )
        return context.get_dummy_value()

    return signature, codegen
