"""Events on stderr: a line that moves on a terminal, a line now and then without one."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import click

from photoplan.cli.output import is_doubt, say

#: Seconds between two lines where there is no terminal, and between two changes of the line on one.
SELDOM, OFTEN = 30.0, 0.1
_BAR = 24
#: Pixels a second below which they are told one by one, as of heights of a surface.
_SLOW = 1e4
#: Units that tell nothing of the pace yet.
_FEW = 0.01


class Telling:
    """The events of a command; a context manager that leaves no unfinished line behind.

    Parameters
    ----------
    result : callable
        Prints a result; it goes to stdout.
    terminal : bool or None
        Whether stderr is one; None: as it is.
    clock : callable
        Seconds from anywhere.
    """

    def __init__(
        self,
        quiet: bool,
        result: Callable[[object], None] = lambda value: None,
        terminal: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._quiet, self._print, self._clock = quiet, result, clock
        self._terminal = sys.stderr.isatty() if terminal is None else terminal
        self._drawn = False
        self.results: list[object] = []
        """All results so far."""
        self._last = self._clock()
        self.begin("")

    def __enter__(self) -> Telling:
        return self

    def __exit__(self, *error: object) -> None:
        self._clear()

    def begin(self, phase: str, units: int = 0, unit: str = "tiles") -> None:
        """A phase begins."""
        self._phase, self._units, self._unit = phase, units, unit
        self._finished = self._pixels = self._kept = 0
        self._began = self._clock()
        self.done(0)

    def kept(self, units: int) -> None:
        """Count what an earlier run has done; it tells nothing of the pace of this one."""
        self._kept += units
        self.done(units)

    def more(self, units: int) -> None:
        """Add parts to the total of the phase."""
        self._units += units

    def done(self, units: int = 1, pixels: int = 0, begun: float = 0.0, what: str = "") -> None:
        """Count what is done; tell it if that is due."""
        self._finished += units
        if self._units:  # a total that was too small is no total: the counter never passes it
            self._units = max(self._units, self._finished)
        self._pixels += pixels
        self._begun, self._what = begun, what
        now = self._clock()
        if self._quiet or not self._phase or now - self._last < (OFTEN if self._terminal else SELDOM):
            return
        self._last = now
        if self._terminal:
            self._clear()
            click.echo(self.line(now), err=True, nl=False)
            self._drawn = True
        else:
            say(self.line(now))

    def line(self, now: float) -> str:
        """What there is to say at a time: phase, units done, rate, time left."""
        took = max(now - self._began, 1e-6)
        words, finished = [f"{self._phase}:"], self._finished + self._begun
        if self._units:
            share = min(1.0, finished / self._units)
            if self._terminal:
                words.append("▇" * round(_BAR * share) + "·" * (_BAR - round(_BAR * share)))
            words.append(f"{self._finished}/{self._units} {self._unit}")
            if self._begun:
                words.append(f"({', '.join([f'{share:.0%}', *filter(None, [self._what])])})")
        elif self._finished:
            words.append(f"{self._finished} {self._unit}")
        if self._pixels:
            rate = self._pixels / took
            words.append(f"{rate / 1e6:.3g} Mpx/s" if rate >= _SLOW else f"{rate:.0f} px/s")
        if self._kept + _FEW < finished < self._units:
            words.append(f"{_time(took / (finished - self._kept) * (self._units - finished))} left")
        else:
            words.append(f"for {_time(took)}")
        return " ".join(words)

    def talk(self, text: str) -> None:
        """Print a message on stderr; doubts also if `quiet`."""
        if not self._quiet or is_doubt(text):
            self._clear()
            say(text)

    def result(self, value: object) -> None:
        """Keep a result and print it."""
        self.results.append(value)
        self._clear()
        self._print(value)

    def _clear(self) -> None:
        if self._drawn:
            click.echo("\r\x1b[K", err=True, nl=False, color=True)
            self._drawn = False


def _time(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
