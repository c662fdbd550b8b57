"""Steps of one product, each of which needs all of the one before: items to workers by the one loop, results kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from photoplan.engine.executors import Workers, threads
from photoplan.engine.run import Made, Runner, Tally, Work
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
        """Keep a result; called by workers."""
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


class Steps:
    """A `map` by workers, for the steps of one product; the same calls in a later run find the results in the store.

    Parameters
    ----------
    workers : Workers
        Threads: functions and items are handed over as they are.
    store : Store, optional
        Keeps results; None: they end with the process.
    root : str
        What results depend on beside the store's key.
    """

    def __init__(
        self, name: str, workers: Workers, events: Events = SILENT, store: Store | None = None, root: str = ""
    ) -> None:
        self._name, self._workers, self._events, self._store, self._root = name, workers, events, store, root
        self._calls = 0

    def under(self, root: str) -> Steps:
        """The same for calls whose results depend on more: on what `root` is a digest of."""
        return Steps(self._name, self._workers, self._events, self._store, root)

    def __call__(
        self,
        function: Callable[[Any], Any],
        items: Iterable[Any],
        names: Sequence[object] | None = None,
        pixels: Callable[[Any], int] = lambda item: 0,
    ) -> Iterator[Any]:
        """Results of a function of all items, in their order.

        Parameters
        ----------
        names : sequence, optional
            What the result of each item depends on beside the store's key; None: the root and the numbers of the call
            and of the item.
        pixels : callable
            Those of an item, for the rate that is told.

        Raises
        ------
        TilesFailed
            An item failed again and again.
        """
        values, self._calls = list(items), self._calls + 1
        store = Memory() if self._store is None else self._store
        # Numbers, where they suffice: two of them are never the same, other than two digests.
        first = (store.index(self._root) if self._root else 0) ^ self._calls << 32
        at = [first ^ k for k in range(len(values))] if names is None else [store.index(name) for name in names]
        finished = store.finished
        tasks = [Item(k, value, pixels(value)) for k, value in zip(at, values, strict=True) if k not in finished]
        self._events.done(len(values) - len(tasks))

        def job(task: Item) -> Made:
            store.append(task.index, function(task.value))
            return Made(())

        # Whoever computes a result keeps it: there is no sink, and what was kept before is no task.
        work: Work[None] = Work(name=self._name, job=job, tiles=tasks, count=0, sinks=(), complete=self._check)
        Runner[None](self._workers, None, self._events).run([work])
        return (store[index] for index in at)

    def _check(self, tally: Tally) -> None:
        if tally.failed:
            reason = tally.reasons[0].partition(": ")[2]
            raise TilesFailed(
                f"{self._name}: {len(tally.failed)} parts could not be computed ({reason}); nothing is written"
            )


@contextmanager
def steps(name: str, workers: int, events: Events = SILENT, store: Store | None = None) -> Iterator[Steps]:
    """Steps by threads of this process, which end with the context."""
    if store is not None and store.finished:
        events.talk(f"{name}: {len(store.finished)} results of an earlier run are kept")
    with threads(workers) as pool:
        yield Steps(name, pool, events, store)
