"""How every kernel is compiled: without the GIL, serial, kept on disk."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import config, njit, typeof

COMPILED: bool = not config.DISABLE_JIT
"""False when `NUMBA_DISABLE_JIT=1`: everything then runs as plain Python, slowly, with the same results."""

# `contract` allows fused multiply-add, `arcp` one reciprocal for two divisions, `nsz` ignores the sign of zero.
# NaN and infinity keep their meaning: relief uses NaN for "no surface".
_FAST = {"contract", "arcp", "nsz"}


def _fingerprint() -> tuple[str, int]:
    """Digest of all kernel sources: numba looks at one file's date only, but kernels inline each other."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest(), 0


_STAMP = _fingerprint() if COMPILED else ("", 0)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` on its first call for each set of types; later processes load it from the disk."""
    dispatcher = njit(nogil=True, cache=True, error_model="numpy", fastmath=_FAST, no_cfunc_wrapper=True)(function)
    # In plain Python there is no cache; a numba that keeps its stamp elsewhere follows its own rule.
    with contextlib.suppress(AttributeError):
        dispatcher._cache._cache_file._source_stamp = _STAMP
    return dispatcher


def inner(function: Callable[..., Any]) -> Any:
    """Compile a part of a kernel: called by kernels only, and always inlined there.

    Arrays are many machine words each; a real call would spend more time on passing them than some parts need.
    """
    return njit(
        nogil=True,
        error_model="numpy",
        fastmath=_FAST,
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        forceinline=True,
    )(function)


def is_ready(dispatcher: Any, arguments: tuple[Any, ...]) -> bool:
    """Whether a kernel is compiled for arguments of these types, in this process or in its cache on the disk."""
    if not COMPILED:
        return True
    signature = tuple(typeof(each) for each in arguments)
    if signature in dispatcher.overloads:
        return True
    try:
        cache = dispatcher._cache
        return cache._index_key(signature, dispatcher.targetctx.codegen()) in cache._cache_file._load_index()
    except (AttributeError, TypeError, OSError):  # a numba with another cache inside, or none that can be read
        return False
