"""Steps of one product, each of which needs all of the one before: items to workers by the one loop, results kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from photoplan.engine.cluster import Question
from photoplan.engine.executors import Workers, open_workers
from photoplan.engine.run import Made, Runner, Scratch, Tally, Work
from photoplan.errors import TilesFailed
from photoplan.events import SILENT, Events


class Store(Protocol):
    """Where results of steps are kept by their names, such as `photoplan.io.result_log.ResultLog`; open when given."""

    @property
    def finished(self) -> frozenset[int]:
        """Indices of the results that are there."""
        ...

    def index(self, name: object, /) -> int:
        """Where the result of a name is kept."""
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
