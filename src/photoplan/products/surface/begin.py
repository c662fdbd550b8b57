"""Where a surface over the map begins, beside its images and the project's terrain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photoplan.errors import UsageError
from photoplan.products.surface.settings import Bounds, number
from photoplan.products.surface.target import SeenTarget
from photoplan.project.ground import Ground
from photoplan.project.open_terrain import open_terrain

#: Places along a side of the bounds at which a start is compared with the project's terrain.
_PLACES = 33


@dataclass(frozen=True)
class StartGap:
    """Heights of a start less those of the project's terrain inside the bounds of a surface."""

    median: float = 0.0
    """Of all places where both have a height, metres; 0 if there is none, or the start is the terrain."""
    share: float = 0.0
    """Part of these places at which they differ by more than the reach, 0 to 1."""


def start_gap(
    start: str, reach: float, bounds: Bounds, crs: str, looked: Sequence[SeenTarget], ground: Ground
) -> StartGap:
    """Compare a start with the project's terrain, place by place inside the bounds."""
    if start == "terrain":
        return StartGap()
    x0, y0, x1, y1 = bounds
    part = (np.arange(_PLACES) + 0.5) / _PLACES
    XY = np.stack(np.meshgrid(x0 + part * (x1 - x0), y0 + part * (y1 - y0)), axis=-1)
    height, stated = number(start), None
    if height is None:
        opened = open_terrain(Path(start)).in_crs(crs)[0]
        stated, begun = opened.height_system, np.asarray(opened.surface.heights(XY), float)
    else:
        begun = np.full(XY.shape[:-1], height)
    if not np.isfinite(begun).any():
        return StartGap()  # the run reports that the start has no height there
    lifted = ground.into_working(crs, stated).where_defined(np.concatenate([XY, begun[..., None]], axis=-1))
    shift = float(np.nanmedian(lifted - begun))
    ceilings = sorted(((float(one.camera.vantage.point[2]) - shift, one.name) for one in looked), reverse=True)
    low = float(np.nanmin(begun))
    if sum(ceiling > low for ceiling, _ in ceilings) < 2:
        (first, name), (last, other) = ceilings[0], ceilings[-1]
        raise UsageError(
            f"start {start}: {low:.6g} m is above the images, which look down from {last:.6g} m ({other}) to "
            f"{first:.6g} m ({name})"
        )
    gaps = lifted - np.asarray(ground.bare.heights(XY), float)
    gaps = gaps[np.isfinite(gaps)]
    if not gaps.size:
        return StartGap()
    return StartGap(float(np.median(gaps)), float((np.abs(gaps) > reach).mean()))
