"""The one loop: tiles to workers, pixels and figures to sinks, what is finished kept, products completed meanwhile.

A product says what a tile is (`Work.job`), where its outputs go (`Work.sinks`) and what is done when all tiles are
there (`Work.complete`). Order, retries, resuming and the bound on memory are here. While one product is completed (its
file assembled, compared and named), the tiles of the next one are computed. A product that comes about in steps, each
of which needs all of the one before (a terrain model, tie points), runs them through `photoplan.engine.steps`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, ExitStack, nullcontext
from contextvars import copy_context
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from photoplan.codec import storable
from photoplan.engine.cluster import opened
from photoplan.engine.executors import PULSE, Workers, run_tiles
from photoplan.engine.shares import Shared
from photoplan.errors import PhotoplanError, TilesFailed, UsageError
from photoplan.events import Events

Output = tuple[NDArray[Any], NDArray[np.bool_] | None]
"""Values of a tile, shape (bands, height, width), and their validity, (height, width); None: all are valid."""
Scratch = Callable[[], AbstractContextManager[Path]]
"""Gives a new folder that is removed after its use, such as `photoplan.io.naming.scratch` of a folder."""
T = TypeVar("T")


class Task(Protocol):
    """What one call of a job makes: a tile, or an item of a step."""

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
    """What became of one tile."""

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
    """Tiles that may be under way at once."""
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
