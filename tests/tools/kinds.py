"""Kinds of the resampling kernel: each pair of a kernel and a type of pixel takes two seconds to compile.

`make test` compiles `FEW`: every kernel with bytes, every type of pixel with some kernel; tests of one property take
theirs from these. As plain Python, and in `make test-slow`, there are all.
"""

from __future__ import annotations

from photoplan.kernels.jit import COMPILED
from photoplan.kernels.weights import KERNELS

TYPES = ("uint8", "uint16", "int16", "float32")
NAMES = tuple(KERNELS)
KINDS = tuple((name, dtype) for name in NAMES for dtype in TYPES)
_SOME = {("bicubic", "uint16"), ("bilinear", "int16"), ("nearest", "float32"), ("bicubic", "float32")}
FEW = tuple(kind for kind in KINDS if kind[1] == "uint8" or kind in _SOME or not COMPILED)
OTHERS = tuple(kind for kind in KINDS if kind not in FEW)


def few_of(dtype: str, names: tuple[str, ...] = NAMES) -> list[int]:
    """Places of the kernels that are compiled with a type of pixel; for `tools.thinned.some`."""
    return [place for place, name in enumerate(names) if (name, dtype) in FEW]
