"""Compilation of a command's kernels before its work, in one process per core, to shorten the first run.

`signatures.txt` lists kernels with the types that commands call them with, and the seconds that each takes to compile.
What is missing there, or fails here, is compiled when it is first called.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from numba import types

from photoplan.kernels import numba_internals
from photoplan.kernels.jit import COMPILED
from photoplan.kernels.weights import KERNELS

#: Processes at most, and seconds of compilation that are worth another one: it imports numba first.
_MOST_PROCESSES, _WORTH = 8, 3.0


class PixelSignatures(NamedTuple):
    """Pixels of the images: what decides which variants of the resampling kernels are needed."""

    dtype: str = "uint8"
    bands: int = 3
    kernel: str = "bicubic"


class Signature(NamedTuple):
    """A line of the list."""

    seconds: float
    commands: tuple[str, ...]
    kernel: str
    """Module and name."""
    types: str
    """An expression of numba's types; PIXEL, LANES and TAPS stand for those of the images."""


@cache
def signatures() -> tuple[Signature, ...]:
    """Return the list."""
    lines = Path(__file__).with_name("signatures.txt").read_text("utf-8").splitlines()
    rows = [[part.strip() for part in line.split("|")] for line in lines if line and not line.startswith("#")]
    return tuple(
        Signature(float(seconds), tuple(commands.split(", ")), kernel, text) for seconds, commands, kernel, text in rows
    )


def compile_for(
    commands: Sequence[str],
    pixels: Sequence[PixelSignatures],
    begin: Callable[[int], None],
    done: Callable[[], None],
    processes: int | None = None,
) -> int:
    """Compile what commands need and the cache lacks; return the number of kernels that were compiled.

    `begin` receives the number of kernels to be compiled, if there are any; `done` is called after each of them.
    """
    if not (COMPILED and numba_internals.USABLE):
        return 0
    wanted = _wanted(commands, pixels)
    mark = _mark(wanted)
    if not wanted or mark.exists():
        return 0
    jobs = [job for job in _jobs(wanted) if _is_missing(job)]
    if jobs:
        begin(len(jobs))
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        worth = int(sum(seconds for seconds, _, _ in jobs) / _WORTH)
        _share(jobs, max(1, min(processes or cores if sys.executable else 1, _MOST_PROCESSES, len(jobs), worth)), done)
    if not any(_is_missing(job) for job in jobs):
        with suppress(OSError):
            mark.touch()
    return len(jobs)


def _wanted(commands: Sequence[str], pixels: Sequence[PixelSignatures]) -> dict[tuple[str, str], float]:
    """Return kernels and types, each once, with seconds."""
    wanted: dict[tuple[str, str], float] = {}
    for row in signatures():
        if set(row.commands).intersection(commands):
            for each in pixels:
                values = {"PIXEL": each.dtype, "LANES": "1" if each.bands == 1 else "4"}
                values["TAPS"] = str(KERNELS[each.kernel].taps)
                text = row.types
                for name, value in values.items():
                    text = text.replace(name, value)
                wanted[row.kernel, text] = row.seconds
    return wanted


def _mark(wanted: dict[tuple[str, str], float]) -> Path:
    """Return the file in the cache that states that all these kernels are there, as their sources are now."""
    import llvmlite.binding as llvm  # noqa: PLC0415

    digest = hashlib.sha256(repr(sorted(wanted)).encode())
    folder = Path(__file__).parent
    for module in sorted({kernel.partition(".")[0] for kernel, _ in wanted}):
        digest.update(numba_internals.stamp(os.fspath(folder / f"{module}.py"))[0].encode())
    digest.update(f"{sys.version} {numba_internals.numba.__version__} {llvm.get_host_cpu_name()}".encode())
    digest.update(llvm.get_host_cpu_features().flatten().encode())
    kernel = next(iter(wanted), ("terrain._lattice", ""))[0]
    return Path(_dispatcher(kernel)._cache._cache_path) / f"complete-{digest.hexdigest()[:24]}"


Job = tuple[float, str, tuple[str, ...]]
"""Seconds, a kernel and its signatures: those of one kernel share a file of the cache, which one process writes."""


def _jobs(wanted: dict[tuple[str, str], float]) -> list[Job]:
    """Return the jobs, the dearest first."""
    of: dict[str, list[str]] = {}
    for kernel, text in wanted:
        of.setdefault(kernel, []).append(text)
    jobs = [(sum(wanted[kernel, each] for each in texts), kernel, tuple(texts)) for kernel, texts in of.items()]
    return sorted(jobs, reverse=True)


def _dispatcher(kernel: str) -> Any:
    module, _, name = kernel.partition(".")
    return getattr(importlib.import_module(f"photoplan.kernels.{module}"), name)


def types_of(kernel: str, text: str) -> tuple[Any, ...]:
    """Return the types of a line; named tuples are those of the kernel's module."""
    module = importlib.import_module(f"photoplan.kernels.{kernel.partition('.')[0]}")
    names = {**vars(module), **vars(types)}
    return tuple(_type_of(part, names) for part in ast.parse(f"({text},)", mode="eval").body.elts)  # type: ignore[attr-defined]


def _type_of(node: Any, names: dict[str, Any]) -> Any:
    """Return what an expression of numba's types means: names, calls, tuples and layouts such as `float64[:, ::1]`."""
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Name):
        return names[node.id]
    if isinstance(node, ast.Tuple | ast.List):
        return tuple(_type_of(part, names) for part in node.elts)
    if isinstance(node, ast.Slice):
        return slice(None, None, None if node.step is None else _type_of(node.step, names))
    if isinstance(node, ast.Subscript):
        return _type_of(node.value, names)[_type_of(node.slice, names)]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        given = {key.arg: _type_of(key.value, names) for key in node.keywords if key.arg}
        return names[node.func.id](*(_type_of(part, names) for part in node.args), **given)
    raise ValueError(f"{type(node).__name__} is no part of a numba type")


def text_of(kind: Any) -> str:
    """Return the expression of a type."""
    if isinstance(kind, types.Array):
        if kind.mutable and kind.aligned:
            axes = {"C": [":"] * (kind.ndim - 1) + ["::1"], "F": ["::1"] + [":"] * (kind.ndim - 1)}
            return f"{kind.dtype}[{', '.join(axes.get(kind.layout, [':'] * kind.ndim))}]"
        more = ["readonly=True"] * (not kind.mutable) + ["aligned=False"] * (not kind.aligned)
        return f"Array({', '.join([str(kind.dtype), str(kind.ndim), repr(kind.layout), *more])})"
    if isinstance(kind, types.BaseNamedTuple):
        inner = ", ".join(text_of(each) for each in kind)
        return f"NamedTuple(({inner},), {kind.instance_class.__name__})"
    if isinstance(kind, types.UniTuple):
        return f"UniTuple({text_of(kind.dtype)}, {kind.count})"
    if isinstance(kind, types.Tuple):
        return f"Tuple(({''.join(text_of(each) + ', ' for each in kind)}))"
    return str(kind)


def _is_missing(job: Job) -> bool:
    _, kernel, texts = job
    try:
        return not all(numba_internals.is_cached(_dispatcher(kernel), types_of(kernel, text)) for text in texts)
    except Exception:  # a list of another version
        return False


def compile_kernel(kernel: str, texts: Sequence[str]) -> None:
    """Compile a kernel for some types, or load it; what cannot be compiled is left to the call."""
    for text in texts:
        with suppress(Exception):
            _dispatcher(kernel).compile(types_of(kernel, text))


def _share(jobs: Sequence[Job], processes: int, done: Callable[[], None]) -> None:
    """Compile in this process and some others, each taking the next job as soon as it is free."""
    lock, waiting = threading.Lock(), iter(jobs)
    finished = threading.Semaphore(0)

    def take() -> Iterator[Job]:
        while True:
            with lock:
                job = next(waiting, None)
            if job is None:
                return
            yield job

    def feed(child: subprocess.Popen[str]) -> None:
        assert child.stdin is not None and child.stdout is not None
        for job in take():
            try:
                child.stdin.write("|".join((job[1], *job[2])) + "\n")
                child.stdin.flush()
                answered = bool(child.stdout.readline())
            except (OSError, ValueError):
                answered = False
            if not answered:  # it has ended, or never begun
                left.append(job)
                return
            finished.release()

    left: list[Job] = []
    children: list[subprocess.Popen[str]] = []
    feeders: list[threading.Thread] = []
    try:
        for _ in range(processes - 1):
            with suppress(OSError):
                children.append(_child())
                feeders.append(threading.Thread(target=feed, args=(children[-1],), daemon=True))
                feeders[-1].start()
        for _, kernel, texts in take():
            compile_kernel(kernel, texts)
            done()
            while finished.acquire(blocking=False):
                done()
        for feeder in feeders:
            while feeder.is_alive():
                feeder.join(0.1)
                while finished.acquire(blocking=False):
                    done()
        while finished.acquire(blocking=False):
            done()
        for _, kernel, texts in left:
            compile_kernel(kernel, texts)
            done()
    finally:
        for child in children:
            child.kill()
            with suppress(OSError), child:
                pass


def _child() -> subprocess.Popen[str]:
    """Start a process of `main`: a fresh interpreter, which no thread of this one can lock up."""
    return subprocess.Popen(
        [sys.executable, "-c", "from photoplan.kernels.precompile import main; main()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )


def main() -> None:
    """Compile what the lines of stdin name; a line of stdout follows each. Ends with its parent."""
    for line in sys.stdin:
        kernel, *texts = line.rstrip("\n").split("|")
        compile_kernel(kernel, texts)
        print("done", flush=True)
    os._exit(0)
