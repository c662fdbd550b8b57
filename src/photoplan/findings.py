"""Results of operations: what a command prints, writes as JSON and shows in a report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from photoplan.errors import InputError, TilesFailed


class Result:
    """What an operation returns, a data class; its JSON holds its fields, see `photoplan.plain`."""

    def written(self) -> Sequence[Path]:
        """Return the files that were written; the first is the product. By default all fields that are paths."""
        values: dict[str, Any] = vars(self)
        return [value for value in values.values() if isinstance(value, Path)]

    def summary(self) -> Sequence[str]:
        """Return the figures for people, printed on stdout after the files."""
        return ()

    def raise_failures(self) -> None:
        """Raise if a part of the inputs failed, after the rest is written."""

    def remarks(self) -> Sequence[str]:
        """Return what to mind in any case, printed on stderr as it is."""
        return ()

    def messages(self) -> Sequence[str]:
        """Return remarks, printed on stderr; ``note:`` and ``warning:`` also with `quiet`."""
        return ()


def noted(notes: Iterable[str]) -> list[str]:
    """Return notes that begin with ``note:``, but for warnings, once each."""
    return [note if note.startswith(("note:", "warning:")) else f"note: {note}" for note in dict.fromkeys(notes)]


def raise_failed(failed: Mapping[str, str], done: int, what: str = "images failed") -> None:
    """Name the images that failed, with the reasons, if any did."""
    if failed and not done:
        raise InputError("\n".join(failed.values()))
    if failed:
        listed = "\n".join(f"  {reason}" for reason in failed.values())
        raise TilesFailed(f"{len(failed)} of {len(failed) + done} {what}:\n{listed}")
