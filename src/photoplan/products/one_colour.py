"""Images of one grey value, black ones among them: what is said of them wherever images are joined."""

from __future__ import annotations

from itertools import chain

from photoplan.engine.base import Reader
from photoplan.geometry.grid import Window

#: Sides of the window that is looked at first, which tells of nearly every image that it has more than one grey value,
#: and of those that follow, pixels.
_FIRST, _NEXT = 64, 1024


def one_colour_told(name: str, grey: float) -> str:
    """That an image has one grey value, and what to do."""
    return f"{name!r} has the grey value {grey:.0f} everywhere; look at its file, or take the image out of the project"


def one_colour(reader: Reader) -> float | None:
    """The grey value that all valid pixels of an image have in all bands; None: they differ, or none is valid."""
    width, height = reader.size
    whole, found = Window(0, 0, width, height), None
    # At the upper border: large pictures that are decoded from there on are not decoded as a whole for it.
    first = Window(max(0, (width - _FIRST) // 2), 0, _FIRST, _FIRST) & whole
    for window in chain([first], whole.tiles(_NEXT)):
        pixels, valid = reader.read(window)
        values = pixels if valid is None else pixels[:, valid]
        if not values.size:
            continue
        low, high = float(values.min()), float(values.max())
        if low != high or found not in (None, low):
            return None
        found = low
    return found
