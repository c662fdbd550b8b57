"""Errors, and the exit code of each.

::

    PhotoplanError            exit 1   a run failed
    ├── UsageError            exit 2   wrong use: options, an output that exists or is an input
    ├── InputError            exit 3   an input cannot be used: file, table, orientation, heights
    │   ├── HeightSystemError          a height system is unknown, or the grid that joins two is missing
    │   └── GeometryError              rank, visibility or overlap do not allow the computation
    │       └── DatumDefect            nothing determines where a block lies
    ├── TilesFailed           exit 4   finished, but some tiles failed; they are listed
    │   └── ImagesLeftOut              finished, but without some of the images
    ├── ResourceError         exit 5   disk or memory is exhausted
    └── RunLocked             exit 2   another run is writing the same product

A message says what was given, what is allowed, which file, point or image, and what to do next.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class PhotoplanError(Exception):
    """Base of every error that photoplan raises on purpose; `exit_code` is what the command line returns."""

    exit_code = 1


class UsageError(PhotoplanError):
    """The command or function was called in a way that cannot be meant."""

    exit_code = 2


class RunLocked(UsageError):
    """Another run holds the lock of the same product."""


class InputError(PhotoplanError):
    """A file, table or value that was given cannot be used."""

    exit_code = 3


class HeightSystemError(InputError):
    """A height system is not declared, or two of them cannot be joined exactly."""


class GeometryError(InputError):
    """The geometry of the inputs does not determine what was asked."""


class DatumDefect(GeometryError):
    """The observations of a block do not determine where it lies, how it is turned, or its scale."""


@contextmanager
def named_by(path: Path) -> Iterator[None]:
    """Put a file's name before the message of an error that is raised inside."""
    try:
        yield
    except InputError as error:
        if str(path) in str(error):
            raise
        raise type(error)(f"{path}: {error}") from None


class TilesFailed(PhotoplanError):
    """The run finished, but the tiles listed in the message could not be computed."""

    exit_code = 4


class ImagesLeftOut(TilesFailed):
    """The run finished, but without the images listed in the message: not oriented, or their files cannot be used."""


class ResourceError(PhotoplanError):
    """Disk or memory ran out; nothing half-written was left under a product's name."""

    exit_code = 5


class PhotoplanWarning(UserWarning):
    """Something that a user should know and that stops nothing."""
