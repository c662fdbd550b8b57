"""Pixels of a series' frames: planes of a Bayer pattern or bands, and the pixels that count."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.io.series.file import Series, SeriesFrame, SeriesGroup

#: Pixels of a frame that are held in memory at once.
MAX_PIXELS = 400_000_000


@dataclass(frozen=True)
class Plane:
    """Pixels of one colour: every second row and column of a Bayer pattern, or a band."""

    name: str
    """``R``, ``G1`` (green in the rows of red), ``G2``, ``B``; ``band 2``; empty where there is one plane only."""
    band: int
    """From 0."""
    row: int = 0
    """First row and column that belong to it, counted from the image's corner."""
    col: int = 0
    step: int = 1

    def first(self, window: Window) -> tuple[int, int]:
        """Row and column of its first pixel inside a window, counted from the window's corner."""
        return (self.row - window.row) % self.step, (self.col - window.col) % self.step

    def to_image(self, window: Window, col: float, row: float) -> tuple[float, float]:
        """(x, y) in the image of a position in the plane's array of that window."""
        first_row, first_col = self.first(window)
        return window.col + first_col + col * self.step, window.row + first_row + row * self.step


def series_planes(series: Series) -> tuple[Plane, ...]:
    """The planes of a series."""
    pattern = series.camera.bayer
    if pattern is None:
        if series.bands == 1:
            return (Plane("", 0),)
        return tuple(Plane(f"band {k + 1}", k) for k in range(series.bands))
    if series.bands != 1:
        raise InputError(
            f"{series.path}: camera.bayer is {pattern}, but the frames have {series.bands} bands; a Bayer pattern "
            "belongs to raw frames of one band: leave it out"
        )
    planes = []
    for k, colour in enumerate(pattern):
        row, col = divmod(k, 2)
        name = colour if colour != "G" else "G1" if "R" in pattern[2 * row : 2 * row + 2] else "G2"
        planes.append(Plane(name=name, band=0, row=row, col=col, step=2))
    return tuple(sorted(planes, key=lambda plane: ("R", "G1", "G2", "B").index(plane.name)))


def frame_pixels(frame: SeriesFrame, window: Window | None = None) -> NDArray[Any]:
    """Pixels of a frame's window, all bands, shape (bands, h, w), in the type of the file."""
    window = frame.group.window if window is None else window
    if window.size > MAX_PIXELS:
        raise InputError(
            f"{frame.group.label}: {window.width} × {window.height} pixels; at most {MAX_PIXELS:.2g} are held at once: "
            "give a roi"
        )
    pixels, valid = RasterReader(frame.file).read(window)
    if valid is not None:
        raise InputError(
            f"{frame.group.label}: {frame.file.name} has {int((~valid).sum())} pixels without a value (nodata, alpha "
            "or NaN); raw frames have a value in every pixel"
        )
    largest = float(pixels.max())
    if largest > frame.group.most_dn:
        raise InputError(
            f"{frame.group.label}: {frame.file.name} has the grey value {largest:.10g}, but camera.bits allow "
            f"{frame.group.most_dn:.10g}; correct the bits (where they are the upper ones of the files' type, leave "
            "them out)"
        )
    return pixels


def plane_pixels(frame: SeriesFrame, plane: Plane, window: Window | None = None) -> NDArray[Any]:
    """Pixels of one plane inside the frame's window, shape (h, w), in the type of the file."""
    window = frame.group.window if window is None else window
    return split(frame_pixels(frame, window), plane, window)


def split(pixels: NDArray[Any], plane: Plane, window: Window) -> NDArray[Any]:
    """The pixels of a plane out of all bands of a window."""
    row, col = plane.first(window)
    return pixels[plane.band, row :: plane.step, col :: plane.step]


def plane_mask(group: SeriesGroup, plane: Plane) -> NDArray[np.bool_] | None:
    """Which pixels of a plane count by the group's mask, shape as `plane_pixels`; None: all of them."""
    if group.mask is None:
        return None
    pixels, valid = RasterReader(group.mask).read(group.window)
    counts = (pixels != 0).any(axis=0)
    if valid is not None:
        counts &= valid
    row, col = plane.first(group.window)
    found = counts[row :: plane.step, col :: plane.step]
    if not found.any():
        raise InputError(f"{group.label}: mask {group.mask.name} leaves no pixel")
    return np.asarray(found)


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


def _middle(frame: SeriesFrame) -> Window:
    window = frame.group.window
    width, height = min(_SIDE, window.width), min(_SIDE, window.height)
    return Window(window.col + (window.width - width) // 2, window.row + (window.height - height) // 2, width, height)


def _step(frame: SeriesFrame) -> float | None:
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
