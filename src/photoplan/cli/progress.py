"""Progress on stderr, only on a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Report(Protocol):
    """What a run calls when tiles are finished."""

    def __call__(self, tiles: int, pixels: int, /) -> None:
        """`tiles` more tiles with `pixels` more pixels are finished."""
        ...


@contextmanager
def progress(total: int, quiet: bool, parts: str = "tiles") -> Iterator[Report]:
    """A bar with parts, their rate if they have pixels, and time left; nothing without a terminal or if `quiet`."""
    if quiet or not sys.stderr.isatty():
        yield lambda tiles, pixels: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    started = time.perf_counter()
    done = 0
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=total, rate=parts)

        def report(tiles: int, pixels: int, /) -> None:
            nonlocal done
            done += pixels
            rate = done / 1e6 / max(time.perf_counter() - started, 1e-6)
            bar.update(task, advance=tiles, rate=f"{parts}  {rate:.0f} Mpx/s" if done else parts)

        yield report
