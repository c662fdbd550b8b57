"""Step between the grey values of a series: not 1 where they stand in the upper bits of their type, or were scaled.

Rounding has a variance of a twelfth of the squared step, so all that is compared with rounding needs it.
"""

from __future__ import annotations

import numpy as np

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.series.file import Frame, Series
from photoplan.io.series.pixels import frame_pixels

#: Frames that are looked at, and the side of the window in their middle.
_FRAMES, _SIDE = 48, 128
#: Different grey values from which on neighbouring ones occur among them.
_LEAST_VALUES = 8


def grey_step(series: Series) -> float:
    """Smallest distance of two grey values in a window of some frames; 1 where these have too few of them."""
    frames = series.frames
    chosen = frames if len(frames) <= _FRAMES else [frames[k * len(frames) // _FRAMES] for k in range(_FRAMES)]
    steps = [step for frame in chosen if (step := _step(frame)) is not None]
    return min(steps, default=1.0)


def _middle(frame: Frame) -> Window:
    window = frame.group.window
    width, height = min(_SIDE, window.width), min(_SIDE, window.height)
    return Window(window.col + (window.width - width) // 2, window.row + (window.height - height) // 2, width, height)


def _step(frame: Frame) -> float | None:
    """Smallest distance of two values; None: there are too few different ones, or the frame cannot be used."""
    try:
        pixels = frame_pixels(frame, _middle(frame))
    except InputError:  # said by the analysis that needs the frame
        return None
    values = np.unique(pixels).astype(np.float64)
    return float(np.diff(values).min()) if values.size >= _LEAST_VALUES else None


def largest_of_steps(largest: float, step: float) -> float:
    """The largest grey value that a number of whole steps makes."""
    return largest if step < 2 or not np.isfinite(largest) else float(largest // step * step)
