"""Executors: threads, processes and Dask clusters; order of tasks, and tiles in progress at once."""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import secrets
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
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
from functools import cache
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

from photoplan.codec import NotData, decode, encode
from photoplan.errors import InputError, PhotoplanError, ResourceError, UsageError
from photoplan.events import Events

#: Seconds within which a cluster that cannot work is told so.
PATIENCE = 10.0
#: Packages whose other version is told, since it may move a grey value.
_NAMED = ("GDAL", "numba", "numpy", "rasterio")


@dataclass(frozen=True)
class Question:
    """Check of the workers before any tile."""

    versions: Callable[[], Mapping[str, str]]
    """Versions of packages by their names."""
    inputs: tuple[str, ...] = ()
    """Files that they must see."""
    folder: str = ""
    """Folder of the results, if the workers see it as well."""


@dataclass(frozen=True)
class Answer:
    """Answer of one worker to the check."""

    fingerprint: str
    """Fingerprint of photoplan's sources."""
    versions: Mapping[str, str]
    unseen: tuple[str, ...]
    """Inputs that it does not see."""
    token: str
    """Content of the file in the common folder; empty: it does not see it."""


@cache
def source_fingerprint() -> str:
    """Digest of photoplan's own sources: two of the same version number may differ."""
    top = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(top.rglob("*.py")):
        digest.update(path.relative_to(top).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def answer(question: Question, token: str) -> Answer:
    """Return what this process says; runs on the workers."""
    unseen = tuple(path for path in question.inputs if not Path(path).is_file())
    try:
        found = Path(token).read_text() if token else ""
    except OSError:
        found = ""
    return Answer(source_fingerprint(), dict(question.versions()), unseen, found)


def judge(address: str, own: Answer, answers: Mapping[str, Answer | BaseException]) -> list[str]:
    """Notes on workers that differ without harm."""
    notes: dict[str, None] = {}
    for worker, said in answers.items():
        if isinstance(said, BaseException) or said.fingerprint != own.fingerprint:
            which = f"cannot be asked: {said}" if isinstance(said, BaseException) else said.versions.get("photoplan")
            raise UsageError(
                f"executor {address}: worker {worker} has another photoplan ({which}, here is "
                f"{own.versions.get('photoplan')}); install the same one everywhere, its pixels would differ"
            )
        if said.unseen:
            raise InputError(
                f"executor {address}: worker {worker} does not see {said.unseen[0]}"
                f"{f' and {len(said.unseen) - 1} more inputs' if len(said.unseen) > 1 else ''}; put the inputs in a "
                "folder that all machines have under the same name"
            )
        for name in _NAMED:
            here, there = own.versions.get(name), said.versions.get(name)
            if here != there:
                notes[f"note: workers have {name} {there}, here is {here}; grey values may differ by one"] = None
    return list(notes)


@dataclass(frozen=True)
class Parcel:
    """A result that lies in a file."""

    path: str
    digest: bytes

    def open(self) -> Any:
        """The result; its file is gone then."""
        path = Path(self.path)
        try:
            content = path.read_bytes()
            path.unlink()
        except OSError as error:
            raise ResourceError(f"{path}: a worker's tile cannot be read ({error.strerror}); run again") from error
        if hashlib.blake2b(content).digest() != self.digest:
            raise ResourceError(f"{path}: a worker's tile came damaged; run the same command again")
        try:
            return decode(content)
        except NotData as error:
            raise ResourceError(f"{path}: a worker's tile cannot be read ({error}); run again") from error


@dataclass(frozen=True)
class RemoteJob:
    """A job on a worker of a cluster."""

    job: Callable[[Any], Any]
    fingerprint: str
    folder: str | None
    """Folder of the results; None if they go to the client."""

    def __call__(self, task: Any) -> Any:
        """The job's result, or where it lies."""
        if source_fingerprint() != self.fingerprint:
            raise UsageError("a worker that came later has another photoplan; install the same one everywhere")
        made = self.job(task)
        if self.folder is None:
            return made
        content = encode(made)
        path = Path(self.folder) / secrets.token_hex(8)
        path.write_bytes(content)
        return Parcel(str(path), hashlib.blake2b(content).digest())


class Cluster(Executor):
    """A cluster that was asked and found good; it is the cluster that tries a tile again when its worker dies."""

    def __init__(self, address: str, retries: int) -> None:
        try:
            from distributed import Client  # noqa: PLC0415  (an optional package)
        except ImportError as error:
            raise UsageError(
                f"executor {address}: Dask is not installed; install it with: pip install 'photoplan[cluster]'"
            ) from error
        self.address = address
        try:
            self._client = Client(
                address, timeout=f"{PATIENCE:.0f}s", set_as_default=False, direct_to_workers=True, name="photoplan"
            )
        except (OSError, TimeoutError, ValueError) as error:
            raise UsageError(f"executor {address}: no usable Dask scheduler ({error})") from error
        try:
            self._client.wait_for_workers(1, timeout=PATIENCE)
            self._client.get_versions(check=True)
        except TimeoutError as error:
            self._client.close()
            raise ResourceError(
                f"executor {address}: the scheduler has no workers; start some with `dask worker {address}`"
            ) from error
        except ValueError as error:
            self._client.close()
            raise UsageError(f"executor {address}: versions do not fit ({error})") from error
        self._inner = self._client.get_executor(retries=retries, pure=False)
        self._seen = time.monotonic()
        self.shares_folder = False
        self.versions: list[dict[str, str]] = []
        """Versions of the workers, each combination once."""

    @property
    def threads(self) -> int:
        """Threads of all workers."""
        return sum(self._client.nthreads().values())

    def ask(self, question: Question, events: Events) -> None:
        """Ask all workers who they are and what they see."""
        token = ""
        folder = Path(question.folder) if question.folder else None
        if folder is not None and folder.is_dir():
            place = folder / f".{secrets.token_hex(8)}.seen"
            token = str(place.resolve())
        try:
            if token:
                Path(token).write_text(token)
            own = answer(question, token)
            answers = self._client.run(answer, question, token, on_error="return")
        finally:
            if token:
                Path(token).unlink(missing_ok=True)
        for note in judge(self.address, own, answers):
            events.talk(note)
        self.shares_folder = bool(token) and all(each.token == token for each in answers.values())
        self.versions = [dict(each) for each in {tuple(sorted(a.versions.items())) for a in answers.values()}]

    def prepared(self, job: Callable[[Any], Any], folder: Path | None) -> RemoteJob:
        """A job as workers get it; they leave results in the folder if they see it."""
        shared = folder if self.shares_folder else None
        if shared is not None:
            shared.mkdir(exist_ok=True)
        return RemoteJob(job, source_fingerprint(), None if shared is None else os.fspath(shared.resolve()))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit to the cluster."""
        try:
            return self._inner.submit(fn, *args, **kwargs)
        except (OSError, RuntimeError) as error:
            raise self.lost() from error

    def check(self) -> None:
        """Make sure that somebody works."""
        if self._client.status != "running":
            raise self.lost()
        try:
            workers = self._client.nthreads()
        except (OSError, TimeoutError, RuntimeError) as error:
            raise self.lost() from error
        if workers:
            self._seen = time.monotonic()
        elif time.monotonic() - self._seen > PATIENCE / 2:
            raise ResourceError(
                f"executor {self.address}: no workers are left; start some and run the same command again: finished "
                "tiles are kept"
            )

    def lost(self) -> ResourceError:
        """Return what to say when the scheduler is gone."""
        return ResourceError(
            f"executor {self.address}: the scheduler is gone; start it again, or choose another executor, and run the "
            "same command again: finished tiles are kept"
        )

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster; the cluster itself goes on."""
        if self._client.status == "running":
            self._inner.shutdown(wait=wait and not cancel_futures)
        self._client.close(timeout=2)


def opened(result: Any) -> Any:
    """A result as the job made it, wherever it lies."""
    return result.open() if isinstance(result, Parcel) else result


#: How often a tile is tried again after its worker died or an unforeseen error.
RETRIES = 2
#: Seconds after which a wait is interrupted for a sign of life.
PULSE = 1.0
#: Threads or processes of one computer.
_MOST_WORKERS = 4096


@dataclass(frozen=True)
class Outcome:
    """Outcome of one task."""

    task: Any
    """The task as it was given."""
    result: Any
    """Value that the work returned; None if it failed."""
    error: str | None
    """Why it failed at last; None if it did not."""


def executor_factory(kind: str, workers: int) -> Callable[[], Executor]:
    """Return how to make (and make again) the executor a user asked for."""
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
        """Return whether a cluster sees the folder of the products."""
        return self._cluster is not None and self._cluster.shares_folder

    def prepared(self, job: Callable[[Any], Any], folder: Path | None) -> Callable[[Any], Any]:
        """A job as the workers get it; a cluster may leave results in the folder."""
        return job if self._cluster is None else self._cluster.prepared(job, folder)

    def check(self) -> None:
        """Make sure that somebody works."""
        if self._cluster is not None:
            self._cluster.check()

    def lost(self) -> PhotoplanError:
        """Return what to say of tasks that were taken back."""
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
    """Return the source of the next task: many at once, or one that must run alone; None if nothing may begin."""
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
