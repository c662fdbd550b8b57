"""Progress, messages and workers of long work: one protocol each for the whole package.

Whoever works calls it; a command shows it on a terminal or writes a line now and then, a test keeps it, most callers
want nothing of it (`SILENT`).

What takes minutes inside of one part of a work says how far it is by `tell`, wherever it is called from, and knows
neither whose part it is nor who listens.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol

Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]
"""`map`, or one by several workers: results in the order of the items."""


class Events(Protocol):
    """Who is told how far a work is. Called from the thread that began the work alone."""

    def begin(self, phase: str, units: int = 0, unit: str = "tiles") -> None:
        """A phase begins, and the one before has ended."""
        ...

    def done(self, units: int = 1, pixels: int = 0, begun: float = 0.0, what: str = "") -> None:
        """So many more parts of the phase are done, with so many more pixels; 0 is a sign of life."""
        ...

    def kept(self, units: int) -> None:
        """So many more parts of the phase are done, which took no time: an earlier run had made them."""
        ...

    def more(self, units: int) -> None:
        """Add parts to the total of the phase: they were not known when it began."""
        ...

    def talk(self, text: str) -> None:
        """Tell a sentence that a user may want to read while it goes on."""
        ...

    def result(self, value: object) -> None:
        """Tell one of the results as soon as it is known."""
        ...


class Silent:
    """Events that nobody is told of."""

    def begin(self, phase: str, units: int = 0, unit: str = "tiles") -> None:
        """Nothing."""

    def done(self, units: int = 1, pixels: int = 0, begun: float = 0.0, what: str = "") -> None:
        """Nothing."""

    def kept(self, units: int) -> None:
        """Nothing."""

    def more(self, units: int) -> None:
        """Nothing."""

    def talk(self, text: str) -> None:
        """Nothing."""

    def result(self, value: object) -> None:
        """Nothing."""


SILENT = Silent()


class Compilations:
    """Count the kernels that this process compiles and the seconds while it compiles any.

    Numba compiles one function at a time in a process. Functions that a kernel calls are compiled inside of its own
    compilation and count with it.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.kernels = 0
        """Kernels whose compilation has begun."""
        self.watchers: list[Callable[[], None]] = []
        """Called at each change, in the thread that compiles."""
        self._clock, self._depth = clock, 0
        self._spent: tuple[float, float | None] = 0.0, None  # finished seconds; when the current compilation began

    @property
    def running(self) -> bool:
        """Whether a kernel is being compiled."""
        return self._spent[1] is not None

    @property
    def seconds(self) -> float:
        """Seconds while any kernel was being compiled, until now."""
        finished, began = self._spent
        return finished if began is None else finished + self._clock() - began

    def change(self, begins: bool) -> None:
        """Take into account that the compilation of a function begins or ends."""
        self._depth += 1 if begins else -1
        if begins and self._depth == 1:
            self.kernels += 1
            self._spent = self._spent[0], self._clock()
        elif not self._depth:
            self._spent = self.seconds, None
        for watcher in tuple(self.watchers):
            watcher()


COMPILATIONS = Compilations()
"""The compilations of this process; `photoplan.kernels` reports them."""

COMPILING = "compiling"
"""The phase in which kernels are compiled before the work; its parts are kernels."""

_LISTENER: ContextVar[Callable[[float, str], None] | None] = ContextVar("listener", default=None)


@contextmanager
def listening(told: Callable[[float, str], None]) -> Iterator[None]:
    """Inside, whatever this thread tells is told to a function: how much is done, 0 to 1, and what is done now."""
    before = _LISTENER.set(told)
    try:
        yield
    finally:
        _LISTENER.reset(before)


def tell(share: float, what: str = "") -> None:
    """Say how much is done of the part of a work that this thread is at, 0 to 1, and perhaps what is done now.

    Whoever listens may end the part by an error.
    """
    listener = _LISTENER.get()
    if listener is not None:
        listener(share, what)


@contextmanager
def stretch(begin: float, end: float, what: str = "") -> Iterator[None]:
    """Inside, whatever is told is a part of the work around it, from one share of that to another."""
    tell(begin, what)
    outer = _LISTENER.get()
    if outer is None:
        yield
        return

    def told(share: float, inner: str) -> None:
        outer(begin + share * (end - begin), ", ".join(filter(None, (what, inner))))

    with listening(told):
        yield
    outer(end, what)
