"""Tiles handed to workers: threads, processes or a Dask cluster, all as `concurrent.futures.Executor`.

As many at once as this process may use: the processors of the machine, less what affinity and a container leave.

A worker that dies is not the end of a run: its tiles are tried again, alone, so that one tile that kills its worker
is found and listed without harming the others.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

from photoplan.engine.cluster import Cluster, Question
from photoplan.errors import PhotoplanError, ResourceError, UsageError
from photoplan.events import Events

#: How often a tile is tried again after its worker died or an unforeseen error.
RETRIES = 2
#: Seconds after which a wait is interrupted for a sign of life.
PULSE = 1.0
#: Threads or processes of one computer.
_MOST_WORKERS = 4096


@dataclass(frozen=True)
class Outcome:
    """What became of one task."""

    task: Any
    """The task as it was given."""
    result: Any
    """What the work returned; None if it failed."""
    error: str | None
    """Why it failed at last; None if it did not."""


def executor_factory(kind: str, workers: int) -> Callable[[], Executor]:
    """How to make (and make again) the executor a user asked for."""
    if not 1 <= workers <= _MOST_WORKERS:
        raise UsageError(f"{workers} workers; 1 to {_MOST_WORKERS} are accepted")
    if kind == "threads":
        # One worker is a thread as well: whoever waits for it can say so.
        return lambda: ThreadPoolExecutor(workers, "photoplan")
    if kind == "processes":
        return lambda: _ProcessExecutor(workers)
    if "://" in kind:
        return lambda: Cluster(kind, RETRIES)
    raise UsageError(f"executor {kind!r}; allowed are threads, processes or a Dask scheduler's address tcp://host:port")


class _ProcessExecutor(Executor):
    """Worker processes that leave Ctrl-C to their parent, and end with it however it ends."""

    def __init__(self, workers: int) -> None:
        # Forking a process that runs threads can lock up; a fresh interpreter cannot.
        self._pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin_worker)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit to a worker; this may start one."""
        with _signals_held():
            return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers after the tiles they are at."""
        self._pool.shutdown(wait, cancel_futures=cancel_futures)


@contextmanager
def _signals_held() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM: a worker is started whole, and begins its life with both held back too."""
    if os.name != "posix":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if os.name == "posix":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def threads(workers: int) -> Workers:
    """So many threads of this process."""
    return Workers(executor_factory("threads", workers), workers)


def open_workers(kind: str, workers: int, question: Question, events: Events) -> Workers:
    """The workers that a user asked for; those of a cluster are asked who they are."""
    make = executor_factory(kind, workers)
    if "://" not in kind:
        return Workers(make, workers)
    cluster = Cluster(kind, RETRIES)
    try:
        cluster.ask(question, events)
    except BaseException:
        cluster.shutdown(cancel_futures=True)
        raise
    return Workers(make, cluster.threads, cluster)


class Workers:
    """The executor of a whole run, a context manager: made when first needed, and anew when its workers died."""

    def __init__(self, make: Callable[[], Executor], threads: int = 1, cluster: Cluster | None = None) -> None:
        self._make = make
        self._executor: Executor | None = cluster
        self._cluster = cluster
        self.threads = threads

    @property
    def in_flight(self) -> int:
        """Tasks that keep all workers busy without one that waits for the next."""
        return self.threads if self.threads == 1 else 2 * self.threads

    @property
    def versions(self) -> list[dict[str, str]] | None:
        """Versions on a cluster's workers; None: they are those of this process."""
        return None if self._cluster is None else self._cluster.versions

    @property
    def shares_folder(self) -> bool:
        """Whether a cluster sees the folder of the products."""
        return self._cluster is not None and self._cluster.shares_folder

    def prepared(self, job: Callable[[Any], Any], folder: Path | None) -> Callable[[Any], Any]:
        """A job as the workers get it; a cluster may leave results in the folder."""
        return job if self._cluster is None else self._cluster.prepared(job, folder)

    def check(self) -> None:
        """Make sure that somebody works."""
        if self._cluster is not None:
            self._cluster.check()

    def lost(self) -> PhotoplanError:
        """What to say of tasks that were taken back."""
        return ResourceError("tasks were cancelled") if self._cluster is None else self._cluster.lost()

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end(wait=kind is None)

    @property
    def executor(self) -> Executor:
        """Takes tasks, till it says that it is broken: `end` it then and ask again."""
        if self._executor is None:
            self._executor = self._make()
        return self._executor

    def end(self, wait: bool = True) -> None:
        """Let the workers go, at once or after the tasks they are at."""
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.shutdown(wait=wait, cancel_futures=True)


def run_tiles(
    tasks: Iterable[Any],
    work: Callable[[Any], Any],
    workers: Workers,
    in_flight: int,
    pulse: Callable[[], None] = lambda: None,
) -> Iterator[Outcome]:
    """Run `work(task)` for every task and yield outcomes as they come, in any order."""
    more = iter(tasks)
    waiting: deque[Any] = deque()
    alone: deque[Any] = deque()
    failures: dict[Any, int] = {}
    pending: dict[Future[Any], Any] = {}
    solo = False
    try:
        while True:
            # Only what may begin soon is taken: a product of a million tasks holds a few of them at a time.
            waiting.extend(islice(more, in_flight - len(waiting)))
            if not (waiting or alone or pending):
                return
            try:
                while not solo and (queue := _next(waiting, alone, pending, in_flight)) is not None:
                    future = workers.executor.submit(work, queue[0])
                    solo = queue is alone
                    pending[future] = queue.popleft()
            except BrokenExecutor:
                # The pool broke after its last result came: what is pending is told so below.
                if not pending:
                    workers.end(wait=False)
                    continue
            done, _ = wait(pending, PULSE, FIRST_COMPLETED)
            if not done:
                workers.check()
                pulse()
                continue
            # Whoever runs alone is done before others begin.
            solo = False
            if any(f.cancelled() for f in done):
                raise workers.lost()
            broken = [f for f in done if isinstance(f.exception(), BrokenExecutor)]
            if broken:
                lost, pending = list(pending.values()), {}
                workers.end(wait=False)
                yield from _lost(lost, alone, failures)
                continue
            for future in done:
                task = pending.pop(future)
                error = future.exception()
                if error is None:
                    yield Outcome(task, future.result(), None)
                elif isinstance(error, (PhotoplanError, MemoryError)) or not isinstance(error, Exception):
                    raise error
                elif _again(task, failures):
                    alone.append(task)
                else:
                    yield Outcome(task, None, f"{type(error).__name__}: {error}")
    finally:
        for future in pending:
            future.cancel()


def _next(waiting: deque[Any], alone: deque[Any], pending: dict[Future[Any], Any], in_flight: int) -> deque[Any] | None:
    """Where the next task comes from: many at once, or one of those that must run alone; None: nothing may begin."""
    if alone:
        return None if pending else alone
    return waiting if waiting and len(pending) < in_flight else None


def _lost(lost: list[Any], alone: deque[Any], failures: dict[Any, int]) -> Iterator[Outcome]:
    """Queue what died with a worker; blame a task only if it ran alone."""
    for task in lost:
        if len(lost) > 1 or _again(task, failures):
            alone.append(task)
        else:
            yield Outcome(task, None, "its worker died, also when it ran alone")


def _again(task: Any, failures: dict[Any, int]) -> bool:
    failures[task] = failures.get(task, 0) + 1
    return failures[task] <= RETRIES


def available_cpus(root: Path = Path("/")) -> int:
    """Number of processors that work can be spread over, at least one.

    The least of the machine's processors, those that the process is bound to, and the quota of its control groups, also
    of those around them: ``cpu.max`` of version 2, ``cpu.cfs_quota_us`` and ``cpu.cfs_period_us`` of version 1. A quota
    of two and a half processors counts as three.
    """
    counts = [float(os.cpu_count() or 1)]
    if sys.platform == "linux":
        counts.append(len(os.sched_getaffinity(0)))
    groups = root / "sys/fs/cgroup"
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if controllers == "":
            counts += _quotas(groups, path, "cpu.max")
        elif "cpu" in controllers.split(","):
            # A container sees its own group at the top, under the name that it has outside.
            counts += _quotas(groups / controllers, path, "cpu.cfs_quota_us")
            counts += _quotas(groups / "cpu", path, "cpu.cfs_quota_us")
    return max(1, math.ceil(min(counts)))


def _quotas(top: Path, path: str, name: str) -> list[float]:
    """Processors that a group and those around it may use, where they are limited."""
    found = []
    parts = [part for part in path.split("/") if part not in ("", "..")]
    for depth in range(len(parts) + 1):
        folder = top.joinpath(*parts[:depth])
        words = _text(folder / name).split()
        if name != "cpu.max":
            words += _text(folder / "cpu.cfs_period_us").split()
        try:
            quota, period = map(float, words)
        except ValueError:
            # "max" of version 2: no limit; or there is no such file.
            continue
        if quota > 0 and period > 0:
            found.append(quota / period)
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
