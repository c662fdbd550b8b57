"""How a verb ends that goes on after images that fail."""

from __future__ import annotations

from collections.abc import Mapping

from photoplan.errors import InputError, TilesFailed


def end_with_failures(failed: Mapping[str, str], done: int, what: str = "images failed") -> None:
    """Name the images that failed, if any did.

    Parameters
    ----------
    failed : mapping
        Why, by name of the image.
    done : int
        Number of the others.
    what : str
        What the message says of them.

    Raises
    ------
    InputError
        All failed.
    TilesFailed
        Some did.
    """
    if failed and not done:
        raise InputError("\n".join(failed.values()))
    if failed:
        listed = "\n".join(f"  {reason}" for reason in failed.values())
        raise TilesFailed(f"{len(failed)} of {len(failed) + done} {what}:\n{listed}")
