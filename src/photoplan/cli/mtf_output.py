"""What `photoplan mtf` prints, of edges as of test patterns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from photoplan.cli.output import show, show_json


class _Image(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def notes(self) -> tuple[str, ...]: ...


class _Report(Protocol):
    @property
    def images(self) -> Sequence[_Image]: ...
    @property
    def csv(self) -> Path | None: ...


def say_images(report: _Report, page: Path | None, as_json: bool, talk: Callable[[str], None]) -> None:
    """The figures of every image on stdout, or all as JSON; notes are talk."""
    if as_json:
        show_json(report, report=page)
    for image in report.images:
        if not as_json:
            show(image)
        for note in image.notes:
            talk(f"{image.name}: {note}")


def say_files(report: _Report, page: Path | None) -> None:
    """The files that were written."""
    for path in (report.csv, page):
        if path is not None:
            show(path)
