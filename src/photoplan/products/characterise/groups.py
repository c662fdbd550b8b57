"""Frames of a series by entry and time, for analyses that follow something from frame to frame."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.series import SeriesFrame, SeriesGroup, frame_pixels, plane_mask, split
from photoplan.products.characterise.data import SeriesData
from photoplan.quality.curves import clipped_levels

#: Share of a window that may be saturated, and samples of it that are looked at for the value where frames are cut off.
_MOST, _SAMPLE = 0.01, 4096


@dataclass(frozen=True)
class FrameGroup:
    """The frames of one ``[[frames]]`` entry, in the order of their names (numbers in them by value).

    Whether a point in a name is that of a decimal, the times decide.
    """

    group: SeriesGroup
    frames: tuple[SeriesFrame, ...]

    @property
    def label(self) -> str:
        """Its name, else its number among the entries."""
        return self.group.entry.name or f"entry {self.group.index + 1}"

    def times(self) -> NDArray[np.float64]:
        """Time of each frame, seconds since the first."""
        for frame in self.frames:
            if frame.time_s is None:
                raise InputError(
                    f"{self.group.label}: {frame.file.name} has no time; give a field {{time_s}} in the name, a table "
                    'with a column time_s, or time_from = "exif"'
                )
        t = np.array([frame.time_s for frame in self.frames], float)
        back = np.flatnonzero(np.diff(t) <= 0.0)
        if back.size:
            k = int(back[0])
            raise InputError(
                f"{self.group.label}: {self.frames[k + 1].file.name} has the time {t[k + 1]:.10g} s, which does not "
                f"come after {t[k]:.10g} s of {self.frames[k].file.name} before it; correct the times"
            )
        return np.asarray(t - t[0])

    def pixels(self, data: SeriesData, window: Window | None = None) -> Iterator[dict[str, NDArray[Any]]]:
        """Pixels of a window (the roi) of every frame, by plane; in a row those that a mask leaves."""
        window = self.group.window if window is None else window
        inside = replace(self.group, window=window)
        masks = {plane.name: plane_mask(inside, plane) for plane in data.planes}
        for frame in self.frames:
            image = frame_pixels(frame, window)
            parts = {plane.name: split(image, plane, window) for plane in data.planes}
            yield {name: part if (mask := masks[name]) is None else part[mask] for name, part in parts.items()}

    def number(self, key: str, default: float, low: float, high: float) -> float:
        """A number among the entry's values."""
        value = self.group.entry.values.get(key, default)
        if isinstance(value, str) or not low <= value <= high:
            raise InputError(
                f"{self.group.label}: values.{key} is {value!r}; a number from {low:g} to {high:g} is needed"
            )
        return float(value)

    def word(self, key: str, allowed: tuple[str, ...]) -> str:
        """A word among the entry's values; the first allowed one where it has none."""
        value = self.group.entry.values.get(key, allowed[0])
        if value not in allowed:
            raise InputError(f"{self.group.label}: values.{key} is {value!r}; allowed are {', '.join(allowed)}")
        return str(value)

    def has(self, key: str) -> bool:
        """Whether the entry states a value."""
        return key in self.group.entry.values


@dataclass(frozen=True, eq=False)
class WindowMeans:
    """A window followed from frame to frame."""

    mean: NDArray[np.float64]
    """Grey value in each frame, shape (n,)."""
    variance: NDArray[np.float64]
    """Of a pixel, from the difference of two successive frames, without what the whole window changes; NaN of a single
    pixel; shape (n − 1,)."""
    pixels: int


def window_means(data: SeriesData, group: FrameGroup, window: Window, advice: str) -> dict[str, WindowMeans]:
    """Means of a window in every frame of an entry, by plane."""
    means: dict[str, list[float]] = {p.name: [] for p in data.planes}
    variances: dict[str, list[float]] = {p.name: [] for p in data.planes}
    last: dict[str, NDArray[np.float64]] = {}
    samples: dict[str, list[NDArray[np.float64]]] = {p.name: [] for p in data.planes}
    for frame, planes in zip(group.frames, group.pixels(data, window)):
        for name, pixels in planes.items():
            values = pixels.astype(float)
            if float((values >= data.saturation_dn(name)).mean()) > _MOST:
                raise InputError(f"{group.group.label}: {frame.file.name} is saturated in the window; {advice}")
            means[name].append(float(values.mean()))
            if name in last:
                variances[name].append(float((values - last[name]).var(ddof=1)) / 2.0 if values.size > 1 else nan)
            last[name] = values
            samples[name].append(values.ravel()[:: max(1, values.size // _SAMPLE)])
    for parts in samples.values():
        top = clipped_levels(np.concatenate(parts))[1]
        for frame, part in zip(group.frames, parts):
            if float((part >= top).mean()) > _MOST:
                raise InputError(
                    f"{group.group.label}: {frame.file.name} is saturated in the window: the frames are cut off at "
                    f"{top:g} DN; {advice}"
                )
    return {n: WindowMeans(np.array(m), np.array(variances[n]), last[n].size) for n, m in means.items()}


def frame_groups(data: SeriesData, kind: str) -> tuple[FrameGroup, ...]:
    """Entries with frames of a kind, in the order of the file."""
    found: dict[int, list[SeriesFrame]] = {}
    for frame in data.series.of(kind):
        found.setdefault(frame.group.index, []).append(frame)
    return tuple(FrameGroup(frames[0].group, _ordered(frames)) for frames in found.values())


def _ordered(frames: list[SeriesFrame]) -> tuple[SeriesFrame, ...]:
    whole, decimal = (tuple(sorted(frames, key=lambda f: _natural(f, n))) for n in (r"([0-9]+)", r"([0-9]*\.?[0-9]+)"))
    return decimal if _grows(decimal) and not _grows(whole) else whole


def _grows(frames: tuple[SeriesFrame, ...]) -> bool:
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    return len(times) == len(frames) and all(a < b for a, b in pairwise(times))


def _natural(frame: SeriesFrame, number: str) -> tuple[tuple[int, str | float], ...]:
    parts = re.split(number, frame.file.name)
    return tuple((1, float(p[:15])) if re.fullmatch(number, p) else (0, p) for p in parts)


def central_window(window: Window, side: int, where: str) -> Window:
    """A square in the middle of a window."""
    if side > min(window.width, window.height):
        raise InputError(
            f"{where}: a window of {side} × {side} pixels in an area of {window.width} × {window.height}; state "
            "a smaller values.window"
        )
    return Window(window.col + (window.width - side) // 2, window.row + (window.height - side) // 2, side, side)
