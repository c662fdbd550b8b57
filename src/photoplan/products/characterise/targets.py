"""Round targets located in the frames of a series."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.series import SeriesFrame, TargetEntry, frame_pixels
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.groups import FrameGroup

#: Largest part of the frames in which a target may be lost.
_MOST_LOST = 0.2
_LARGEST = 25_000_000


@dataclass(frozen=True)
class Located:
    """A target in a frame."""

    target: str
    frame: SeriesFrame
    x: float
    y: float
    """Column and row in the image; NaN where it was not found."""
    sigma: float
    why: str
    """Why it was not found; empty: it was."""


def targets_of(group: FrameGroup) -> tuple[TargetEntry, ...]:
    """The targets of an entry: those named, else one in the roi."""
    return group.group.entry.targets or (TargetEntry(name="target"),)


def locate_targets(data: SeriesData, group: FrameGroup) -> dict[str, list[Located]]:
    """Every target in every frame, by correlation, paraboloid and matching (Behr 1989, eq. 4.1 to 4.4)."""
    found: dict[str, list[Located]] = {t.name: [] for t in targets_of(group)}
    for frame in group.frames:
        for target in targets_of(group):
            found[target.name].append(_locate(data, group, frame, target))
    for name, places in found.items():
        lost = [p for p in places if p.why]
        if len(lost) > _MOST_LOST * len(places):
            raise InputError(
                f"{group.group.label}: target {name} is not found in {len(lost)} of {len(places)} frames; first in "
                f"{lost[0].frame.file.name}: {lost[0].why}. Give it a roi in which it alone lies"
            )
    return found


def _locate(data: SeriesData, group: FrameGroup, frame: SeriesFrame, target: TargetEntry) -> Located:
    from photoplan.orientation.marks.locate import locate_target  # noqa: PLC0415 - slow to import, rarely needed

    window = _window(data, group, target)
    # The first band; of a colour pattern the mean of each cell would move the target by less than its sigma.
    grey = frame_pixels(frame, window)[0].astype(np.float32)
    where = f"target {target.name}"
    peak = float(grey.max() if target.bright else grey.min())
    if target.bright and peak >= data.saturation_dn(data.planes[0].name) and (grey >= peak).mean() > 0.5:
        return Located(
            target=target.name,
            frame=frame,
            x=math.nan,
            y=math.nan,
            sigma=math.nan,
            why=f"{where}: the window is saturated",
        )
    try:
        at = locate_target(grey, bright=target.bright).location
    except InputError as error:
        return Located(target=target.name, frame=frame, x=math.nan, y=math.nan, sigma=math.nan, why=str(error))
    sigma = max(at.sigma_x, at.sigma_y)
    return Located(target=target.name, frame=frame, x=window.col + at.x, y=window.row + at.y, sigma=sigma, why="")


def _window(data: SeriesData, group: FrameGroup, target: TargetEntry) -> Window:
    window = group.group.window if target.roi is None else Window(*target.roi)
    assert data.series.size is not None
    if window.stop[0] > data.series.size[0] or window.stop[1] > data.series.size[1]:
        raise InputError(
            f"{group.group.label}: target {target.name}: roi {[window.col, window.row, window.width, window.height]} "
            f"leaves the image of {data.series.size[0]} × {data.series.size[1]} pixels"
        )
    if window.size > _LARGEST:
        raise InputError(
            f"{group.group.label}: target {target.name}: a window of {window.size} pixels is searched; give it a roi"
        )
    return window
