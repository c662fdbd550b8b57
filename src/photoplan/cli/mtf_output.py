"""What `photoplan mtf` prints, of edges as of test patterns."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import click


class _Image(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def notes(self) -> tuple[str, ...]: ...


class _Report(Protocol):
    @property
    def images(self) -> Sequence[_Image]: ...
    @property
    def report(self) -> Path | None: ...
    @property
    def csv(self) -> Path | None: ...
    def to_dict(self) -> dict[str, Any]: ...


def talking(quiet: bool) -> Callable[[str], None]:
    """What says a line on stderr, or nothing."""
    return lambda text: None if quiet else click.echo(text, err=True)


def say_images(report: _Report, as_json: bool, talk: Callable[[str], None]) -> None:
    """The figures of every image on stdout, or all as JSON; notes are talk."""
    if as_json:
        click.echo(json.dumps(report.to_dict(), indent=2, ensure_ascii=False))
    for image in report.images:
        if not as_json:
            click.echo(str(image))
        for note in image.notes:
            talk(f"{image.name}: {note}")


def say_files(report: _Report) -> None:
    """The files that were written."""
    for path in (report.csv, report.report):
        if path is not None:
            click.echo(str(path))
