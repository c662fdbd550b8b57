"""The loop over tiles and steps: progress, resuming a killed run, memory limit, and where results go."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from contextvars import copy_context
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from photoplan.codec import storable
from photoplan.engine.executors import PULSE, Question, Workers, open_workers, opened, run_tiles
from photoplan.errors import PhotoplanError, TilesFailed, UsageError
from photoplan.events import SILENT, Events, listening


class Shared:
    """A job whose tiles can be asked how far they are; what pickles of it is the job alone."""

    def __init__(self, job: Callable[[Any], Any]) -> None:
        self._job = job
        self._begun: dict[int, tuple[float, str]] = {}
        self._left = False

    def __call__(self, task: Any) -> Any:
        """Return what the job makes of a task."""

        def told(share: float, what: str) -> None:
            if self._left:
                raise CancelledError
            self._begun[task.index] = share, what

        with listening(told):
            return self._job(task)

    def __reduce__(self) -> tuple[Any, ...]:
        return _itself, (self._job,)

    def __enter__(self) -> Shared:
        return self

    def __exit__(self, *error: object) -> None:
        # Nobody waits for what is still under way: it ends where it next tells how far it is.
        self._left = True

    def ended(self, task: Any) -> None:
        """A task is no longer under way."""
        self._begun.pop(task.index, None)

    def under_way(self) -> tuple[float, str]:
        """Return the sum of the shares done of tasks in progress, and the phase of the oldest."""
        now = list(self._begun.values())
        return sum(share for share, _ in now), next((what for _, what in now), "")


def _itself(job: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return job


Output = tuple[NDArray[Any], NDArray[np.bool_] | None]
"""Values of a tile, shape (bands, height, width), and their validity, (height, width); None: all are valid."""
Scratch = Callable[[], AbstractContextManager[Path]]
"""Gives a new folder that is removed after its use, such as `photoplan.io.store.scratch` of a folder."""
T = TypeVar("T")


class Task(Protocol):
    """Task of a job: a tile, or an item of a step."""

    @property
    def index(self) -> int:
        """Its place in the sinks."""
        ...

    @property
    def pixels(self) -> int:
        """Its pixels, for the rate that is told; 0: it has none."""
        ...


@storable
@dataclass(frozen=True, eq=False)
class Made:
    """Result of one tile."""

    layers: tuple[Any, ...]
    """An `Output` or the result of a step, one for each sink; None: not one valid pixel."""
    record: Mapping[str, Any] = field(default_factory=dict)
    """Figures that the product adds up, kept with the tile: numbers and lists of numbers. Names that begin with
    ``worst`` are maxima, all others sums."""


class Sink(Protocol):
    """One of the outputs of a product: it keeps finished tiles, whatever happens; open inside its context."""

    def __enter__(self) -> Any: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    @property
    def finished(self) -> frozenset[int]:
        """Indices of the tiles that it has, those of an earlier run among them."""
        ...

    def append(self, index: int, pixels: NDArray[Any], valid: NDArray[np.bool_] | None, record: Any, /) -> None:
        """Keep a tile and its record."""
        ...

    def append_empty(self, index: int, record: Any = ..., /) -> None:
        """Keep that a tile has no valid pixel."""
        ...

    def record(self, index: int) -> dict[str, Any]:
        """The record that was kept with a tile."""
        ...


@dataclass
class Tally:
    """Figures of all tiles of a product so far."""

    totals: dict[str, Any] = field(default_factory=dict)
    resumed: int = 0
    """Tiles taken over from an earlier run."""
    failed: list[int] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)

    def check(self, name: object) -> None:
        """Refuse to complete what lacks tiles."""
        if self.failed:
            failed = ", ".join(map(str, sorted(self.failed)))
            raise TilesFailed(f"{name}: tiles {failed} could not be computed ({self.reasons[0]}); nothing is written")

    def add(self, record: Mapping[str, Any]) -> None:
        """Add a tile's figures: maxima of those that begin with ``worst``, sums of the others."""
        for name, value in record.items():
            before = self.totals.get(name)
            if before is None:
                self.totals[name] = value
            elif name.startswith("worst"):
                self.totals[name] = max(before, value)
            else:
                self.totals[name] = (
                    [a + b for a, b in zip(before, value, strict=True)] if isinstance(value, list) else before + value
                )


@dataclass(frozen=True, eq=False)
class Work(Generic[T]):
    """One product to be made."""

    name: str
    job: Callable[[Any], Made]
    """Makes a task: what a worker is told once, small; it pickles for processes and clusters."""
    tiles: Sequence[Task]
    """Tiles that can hold something."""
    count: int
    """All tiles; those that `tiles` leaves out are empty. 0: there are none, `tiles` are items of a step."""
    sinks: Sequence[Sink]
    complete: Callable[[Tally], T]
    """Called when all tiles are there or have failed, with the sinks still open; in a thread of its own."""
    scratch: Scratch | None = None
    """Makes a folder beside the outputs for results on their way from a cluster."""


@dataclass(frozen=True)
class Kept(Generic[T]):
    """The result of a product that an earlier run has made."""

    result: T
    tiles: int


def tiles_in_flight(wanted: int, memory: int | None, base: int, each: int) -> int:
    """Return how many tiles may be in progress at once within the memory limit."""
    if memory is None:
        return wanted
    fits = (memory - base) // each
    if fits < 1:
        needed = math.ceil((base + each) / 2**20)
        raise UsageError(f"`memory` {memory / 2**20:.0f} MiB; at least {needed} MiB are needed for one tile")
    return int(min(wanted, fits))


class Runner(Generic[T]):
    """Makes products one after the other."""

    def __init__(
        self,
        workers: Workers,
        in_flight: int | None,
        events: Events,
        excuse: Callable[[Work[T], PhotoplanError], T | None] | None = None,
    ) -> None:
        self.results: list[T] = []
        """In the order of the products; complete when the context ends."""
        self.workers, self._in_flight, self._events = workers, in_flight or workers.in_flight, events
        self._excuse = excuse
        self._left = 0
        """Tiles of the product in work that are not counted yet."""
        self._completing: deque[tuple[Work[T] | Kept[T], Future[T]]] = deque()
        self._pool = ThreadPoolExecutor(1, "photoplan-complete")

    def __enter__(self) -> Runner[T]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None and not isinstance(error, Exception):
            self._pool.shutdown(wait=False, cancel_futures=True)
            return
        try:
            # Also after an error: what is complete but for its name is a result.
            self._settle(0)
        except Exception:
            if error is None:
                raise
        finally:
            self._pool.shutdown()

    def run(self, works: Iterable[Work[T] | Kept[T]]) -> list[T]:
        """Compute the tiles of all products, and have each completed while the next is computed."""
        with self:
            for work in works:
                if isinstance(work, Kept):
                    kept: Future[T] = Future()
                    kept.set_result(work.result)
                    self._completing.append((work, kept))
                    self._events.kept(work.tiles)
                    self._settle_done()
                    continue
                self._left = len(work.tiles)
                with ExitStack() as stack:
                    try:
                        for sink in work.sinks:
                            stack.enter_context(sink)
                        tally = self._compute(work)
                    except PhotoplanError as error:
                        self._settle(0)
                        self._tell(self._excused(work, error))
                        self._events.done(self._left)
                        continue
                    # Files of one product are assembled at a time; that of the next one is already computed.
                    self._settle(0)
                    self._completing.append(
                        (work, self._pool.submit(copy_context().run, _complete, work, tally, stack.pop_all()))
                    )
        return self.results

    def _compute(self, work: Work[T]) -> Tally:
        """Bring every tile of a product into its sinks: those of an earlier run are there, the others are computed."""
        tally = Tally()
        finished = frozenset.intersection(*(sink.finished for sink in work.sinks)) if work.sinks else frozenset()
        for tile in work.tiles:
            if tile.index in finished:
                tally.resumed += 1
                tally.add(work.sinks[0].record(tile.index))
        if tally.resumed:
            self._events.talk(f"{work.name}: {tally.resumed} of {len(work.tiles)} tiles are finished already")
            self._events.kept(tally.resumed)
            self._left -= tally.resumed
        if work.count:
            empty = np.ones(work.count, bool)
            for tile in work.tiles:
                empty[tile.index] = False
            for index in np.flatnonzero(empty).tolist():
                if index not in finished:
                    for sink in work.sinks:
                        sink.append_empty(index)
        waiting = (tile for tile in work.tiles if tile.index not in finished)
        with (
            nullcontext() if work.scratch is None or not self.workers.shares_folder else work.scratch() as folder,
            Shared(self.workers.prepared(work.job, folder)) as job,
        ):
            for outcome in run_tiles(waiting, job, self.workers, self._in_flight, lambda: self._pulse(job)):
                tile = outcome.task
                if outcome.error is None:
                    made: Made = opened(outcome.result)
                    _store(work.sinks, tile.index, made)
                    tally.add(made.record)
                else:
                    tally.failed.append(tile.index)
                    tally.reasons.append(f"tile {tile.index}: {outcome.error}")
                job.ended(tile)
                self._left -= 1
                self._events.done(1, tile.pixels, *job.under_way())
                self._settle_done()
        return tally

    def _pulse(self, job: Shared) -> None:
        self._events.done(0, 0, *job.under_way())
        self._settle_done()

    def _settle_done(self) -> None:
        while self._completing and self._completing[0][1].done():
            self._take()

    def _settle(self, left: int) -> None:
        """Wait until no more than `left` products are being completed."""
        while len(self._completing) > left:
            while not wait([self._completing[0][1]], PULSE).done:
                self._events.done(0)
            self._take()

    def _take(self) -> None:
        work, future = self._completing.popleft()
        result: T | None
        try:
            result = future.result()
        except PhotoplanError as error:
            assert isinstance(work, Work)
            result = self._excused(work, error)
        self._tell(result)

    def _excused(self, work: Work[T], error: PhotoplanError) -> T | None:
        if self._excuse is None:
            raise error
        return self._excuse(work, error)

    def _tell(self, result: T | None) -> None:
        if result is None:
            return
        self.results.append(result)
        self._events.result(result)


def _store(sinks: Sequence[Sink], index: int, made: Made) -> None:
    for sink, layer in zip(sinks, made.layers, strict=True):
        if layer is None:
            sink.append_empty(index, made.record)
        else:
            pixels, valid = layer
            sink.append(index, pixels, valid, made.record)


def _complete(work: Work[T], tally: Tally, stack: ExitStack) -> T:
    with stack:
        return work.complete(tally)


class Store(Protocol):
    """Store of results of steps by their names, such as `photoplan.io.store.ResultLog`; open when given."""

    @property
    def finished(self) -> frozenset[int]:
        """Indices of the results that are there."""
        ...

    def index(self, name: object, /) -> int:
        """Return where the result of a name is kept."""
        ...

    def append(self, index: int, result: Any, /) -> None:
        """Keep a result."""
        ...

    def __getitem__(self, index: int, /) -> Any:
        """A result."""
        ...


class Memory(dict[int, Any]):
    """Results that are kept as long as the process lives."""

    finished: frozenset[int] = frozenset()
    index = staticmethod(hash)
    append = dict.__setitem__


@dataclass(frozen=True, eq=False)
class Item:
    """One item of a step as a task."""

    index: int
    value: Any
    pixels: int = 0


@dataclass(frozen=True)
class _Job:
    """A function of the values of items, as workers get it."""

    function: Callable[[Any], Any]

    def __call__(self, item: Item) -> Made:
        """Its result as the only layer of what is made."""
        return Made(((self.function(item.value), None),))


@dataclass(frozen=True, eq=False)
class _Keeping:
    """The sink of a step: a store, into which whatever is made of results goes."""

    store: Store
    kept: Callable[[Any], Any]
    finished: frozenset[int] = frozenset()

    def __enter__(self) -> _Keeping:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def append(self, index: int, pixels: Any, valid: Any, record: Any, /) -> None:
        """Keep a result."""
        self.store.append(index, self.kept(pixels))

    def append_empty(self, index: int, record: Any = None, /) -> None:
        """Steps have no empty items."""
        raise NotImplementedError

    def record(self, index: int) -> dict[str, Any]:
        """Results have no figures."""
        return {}


class Steps:
    """A `map` by workers, for the steps of one product; the same calls in a later run find the results in the store."""

    def __init__(
        self,
        name: str,
        workers: Workers,
        events: Events = SILENT,
        store: Store | None = None,
        root: str = "",
        scratch: Scratch | None = None,
    ) -> None:
        self._name, self._workers, self._events, self._store, self._root = name, workers, events, store, root
        self._scratch, self._calls = scratch, 0

    def under(self, root: str) -> Steps:
        """The same for calls whose results depend on more: on what `root` is a digest of."""
        return Steps(self._name, self._workers, self._events, self._store, root, self._scratch)

    def __call__(
        self,
        function: Callable[[Any], Any],
        items: Iterable[Any],
        names: Sequence[object] | None = None,
        pixels: Callable[[Any], int] = lambda item: 0,
        kept: Callable[[Any], Any] = lambda result: result,
    ) -> Iterator[Any]:
        """Results of a function of all items, in their order."""
        values, self._calls = list(items), self._calls + 1
        store = Memory() if self._store is None else self._store
        # Numbers, where they suffice: two of them are never the same, other than two digests.
        first = (store.index(self._root) if self._root else 0) ^ self._calls << 32
        at = [first ^ k for k in range(len(values))] if names is None else [store.index(name) for name in names]
        finished = store.finished
        tasks = [Item(k, value, pixels(value)) for k, value in zip(at, values, strict=True) if k not in finished]
        self._events.kept(len(values) - len(tasks))
        # What was kept before is no task.
        work: Work[None] = Work(
            name=self._name,
            job=_Job(function),
            tiles=tasks,
            count=0,
            sinks=(_Keeping(store, kept),),
            complete=self._check,
            scratch=self._scratch,
        )
        Runner[None](self._workers, None, self._events).run([work])
        return (store[index] for index in at)

    def _check(self, tally: Tally) -> None:
        if tally.failed:
            reason = tally.reasons[0].partition(": ")[2]
            raise TilesFailed(
                f"{self._name}: {len(tally.failed)} parts could not be computed ({reason}); nothing is written"
            )


@contextmanager
def steps(
    name: str,
    workers: int,
    events: Events = SILENT,
    store: Store | None = None,
    *,
    executor: str = "threads",
    question: Question | None = None,
    scratch: Scratch | None = None,
) -> Iterator[Steps]:
    """Steps by workers that end with the context: threads of this process, or what `executor_factory` knows."""
    if store is not None and store.finished:
        events.talk(f"{name}: {len(store.finished)} results of an earlier run are kept")
    with open_workers(executor, workers, question or Question(dict), events) as pool:
        yield Steps(name, pool, events, store, scratch=scratch)
