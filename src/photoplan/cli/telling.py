"""Progress and messages on stderr: one line that is updated on a terminal, occasional lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import click

from photoplan.cli.output import is_doubt, say
from photoplan.events import COMPILATIONS, COMPILING, Compilations

#: Seconds between two lines where there is no terminal, and between two changes of the line on one.
SELDOM, OFTEN = 30.0, 0.1
_BAR = 24
#: Pixels a second below which they are told one by one, as of heights of a surface.
_SLOW = 1e4
#: Seconds of compilation after which a line is due at once where there is no terminal.
_PATIENCE = 2.0
#: Units that tell nothing of the pace yet.
_FEW = 0.01


class Telling:
    """The events of a command; a context manager that leaves no unfinished line behind."""

    def __init__(
        self,
        quiet: bool,
        result: Callable[[object], None] = lambda value: None,
        terminal: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
        compilations: Compilations = COMPILATIONS,
    ) -> None:
        self._quiet, self._print, self._clock = quiet, result, clock
        self._compilations, self._thread = compilations, threading.get_ident()
        self._compiled_before = compilations.kernels, compilations.seconds
        self._compiling_said = False
        self._terminal = sys.stderr.isatty() if terminal is None else terminal
        self._drawn = False
        self.results: list[object] = []
        """All results so far."""
        self._last = self._clock()
        self.begin("")

    def __enter__(self) -> Telling:
        self._compilations.watchers.append(self._compiling)
        return self

    def __exit__(self, *error: object) -> None:
        self._compilations.watchers.remove(self._compiling)
        self._clear()

    def begin(self, phase: str, units: int = 0, unit: str = "tiles") -> None:
        """A phase begins."""
        self._phase, self._units, self._unit = phase, units, unit
        self._finished = self._pixels = self._kept = 0
        self._began, self._compiled = self._clock(), self._compilations.seconds
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
        self._show()

    def _compiling(self) -> None:
        """Show that kernels are compiled, if the thread that would show it is busy with that."""
        if threading.get_ident() == self._thread:
            with suppress(OSError):
                self._show()

    def _show(self) -> None:
        """Show the line if that is due."""
        now, compiling = self._clock(), self._compilations.running
        if self._quiet or not (self._phase or compiling):
            return
        due = now - self._last >= (OFTEN if self._terminal else SELDOM)
        if compiling and not self._compiling_said and self._compilations.seconds - self._compiled_before[1] > _PATIENCE:
            due = self._compiling_said = True
        if not due:
            return
        self._last = now
        if self._terminal:
            self._clear()
            click.echo(self.line(now), err=True, nl=False)
            self._drawn = True
        else:
            say(self.line(now))

    def line(self, now: float) -> str:
        """Return what there is to say at a time: phase, units done, rate, time left; or the kernels being compiled."""
        if self._compilations.running and self._phase != COMPILING:
            kernels, seconds = self._compiled_before
            count, compiled = self._compilations.kernels - kernels, self._compilations.seconds - seconds
            return f"compiling kernels: {count} so far, for {_time(compiled)}"
        compiled = 0.0 if self._phase == COMPILING else self._compilations.seconds - self._compiled
        took = max(now - self._began - compiled, 1e-6)
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
        if self._kept + _FEW < finished < self._units and self._phase != COMPILING:  # the dearest kernels come first
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
