"""How long work tells what it is at, and is spread over workers: one protocol each for the whole package.

Whoever works calls it; a command shows it on a terminal or writes a line now and then, a test keeps it, most callers
want nothing of it (`SILENT`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol

Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]
"""`map`, or one by several workers: results in the order of the items."""


class Events(Protocol):
    """Who is told how far a work is. Called from the thread that began the work alone."""

    def begin(self, phase: str, units: int = 0, unit: str = "tiles") -> None:
        """A phase begins, and the one before has ended.

        Parameters
        ----------
        phase : str
            What is done, such as "planning".
        units : int
            Its parts; 0: not known.
        unit : str
            What a part is.
        """
        ...

    def done(self, units: int = 1, pixels: int = 0) -> None:
        """So many more parts of the phase are done, with so many more pixels; 0 is a sign of life."""
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

    def done(self, units: int = 1, pixels: int = 0) -> None:
        """Nothing."""

    def talk(self, text: str) -> None:
        """Nothing."""

    def result(self, value: object) -> None:
        """Nothing."""


SILENT = Silent()
