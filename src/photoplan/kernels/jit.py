"""Compilation of the numba kernels: options, and the cache of compiled code on the disk."""

from __future__ import annotations

import os
import stat
import tempfile
import warnings
from collections.abc import Callable
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

from numba import config, njit, typeof

from photoplan.errors import PhotoplanWarning
from photoplan.kernels import numba_internals
from photoplan.kernels.numba_internals import INNER_OPTIONS, KERNEL_OPTIONS, MAKER_OPTIONS, enable_cache, is_cached

COMPILED: bool = not config.DISABLE_JIT
"""False when `NUMBA_DISABLE_JIT=1`: everything then runs as plain Python, slowly, with the same results."""

# `contract` allows fused multiply-add, `arcp` one reciprocal for two divisions, `nsz` ignores the sign of zero.
# NaN and infinity keep their meaning: relief uses NaN for "no surface".
_FAST = {"contract", "arcp", "nsz"}
_OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": _FAST}


if numba_internals.UNTRIED and parent_process() is None:  # workers would all repeat it
    warnings.warn(numba_internals.UNTRIED, PhotoplanWarning, stacklevel=1)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` on its first call for each set of types; later processes load it from the disk.

    It copies arrays element by element: for `a[:n] = b` numba compiles messages about shapes, 3 s for each kernel.
    """
    if not COMPILED:
        return function
    dispatcher = njit(**_OPTIONS, **KERNEL_OPTIONS)(function)
    try:
        enable_cache(dispatcher)
    except RuntimeError:  # neither the package's folder nor the user's can be written
        folder = _temporary_folder()
        if folder is None:
            warnings.warn(_NOWHERE, PhotoplanWarning, stacklevel=2)
            return dispatcher
        # For the kernels after this one, and for processes that this one starts.
        config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = folder
        warnings.warn(_ELSEWHERE.format(folder), PhotoplanWarning, stacklevel=2)
        enable_cache(dispatcher)
    return dispatcher


_NOWHERE = (
    "no folder can be written to keep compiled kernels: every run compiles them anew, for a minute or so. "
    "Set NUMBA_CACHE_DIR to a folder that can be written"
)
_ELSEWHERE = (
    "neither the package's folder nor the user's can be written: compiled kernels are kept in {}. "
    "Set NUMBA_CACHE_DIR to a folder that lasts"
)


def _temporary_folder() -> str | None:
    """A temporary folder of this user; None if there is none. What others could have written there is not run."""
    try:
        above = Path(tempfile.gettempdir())
        owner = os.getuid() if os.name == "posix" else 0
        folder = above / f"photoplan-kernels-{owner}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if os.name == "posix" and (not stat.S_ISDIR(found.st_mode) or found.st_uid != owner or found.st_mode & 0o022):
            return tempfile.mkdtemp(prefix="photoplan-kernels-")
        return str(folder)
    except OSError:
        return None


def inner(function: Callable[..., Any]) -> Any:
    """Compile a part of a kernel: called by kernels only, and always inlined there where numba can be told to.

    Arrays are many machine words each; a real call would spend more time on passing them than some parts need. It makes
    no arrays and returns none, not even those that it is given: it does not count who holds them.
    """
    return njit(**_OPTIONS, **INNER_OPTIONS)(function)


def maker(function: Callable[..., Any]) -> Any:
    """As `inner`, for a part of a kernel that makes arrays."""
    return njit(**_OPTIONS, **MAKER_OPTIONS)(function)


def is_ready(dispatcher: Any, arguments: tuple[Any, ...]) -> bool:
    """Whether a kernel is compiled for arguments of these types, in this process or in its cache on the disk."""
    if not COMPILED:
        return True
    signature = tuple(typeof(each) for each in arguments)
    return signature in dispatcher.overloads or is_cached(dispatcher, signature)
