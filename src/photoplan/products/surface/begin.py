"""Where a surface over the map begins, beside its images and the project's terrain."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photoplan.errors import UsageError
from photoplan.products.surface.settings import Bounds, number
from photoplan.products.surface.target import SeenTarget
from photoplan.project.ground import Ground
from photoplan.project.open_terrain import open_terrain


def start_apart(start: str, bounds: Bounds, crs: str, looked: Sequence[SeenTarget], ground: Ground) -> float:
    """By how much a start lies above (below: negative) the terrain that the images were looked up on.

    Parameters
    ----------
    start : str
        See `SurfaceSettings.start`.
    bounds : tuple
        Of the surface.
    crs : str
        Of the project.
    looked : sequence of SeenTarget
    ground : Ground
        Of the project: what height system the images are in.

    Returns
    -------
    float
        Metres between the ranges of their heights; 0 where these meet, and of the project's terrain itself.

    Raises
    ------
    UsageError
        Fewer than two images can see its lowest height from above.
    InputError
        Its file cannot be used.
    """
    if start == "terrain":
        return 0.0
    height, stated = number(start), None
    if height is None:
        opened = open_terrain(Path(start)).in_crs(crs)[0]
        stated = opened.height_system
        low, high = (float(h) for h in opened.surface.height_range(np.array(bounds)))
        if not np.isfinite([low, high]).all():
            return 0.0  # no heights there: told of the surface, which has none either
    else:
        low = high = height
    x0, y0, x1, y1 = bounds
    inward = ground.into_working(crs, stated)
    shift = float(inward([(x0 + x1) / 2, (y0 + y1) / 2, 0.0]))
    ceilings = sorted(((float(one.camera.vantage.point[2]) - shift, one.name) for one in looked), reverse=True)
    if sum(ceiling > low for ceiling, _ in ceilings) < 2:
        (first, name), (last, other) = ceilings[0], ceilings[-1]
        raise UsageError(
            f"start {start}: {low:.6g} m is above the images, which look down from {last:.6g} m ({other}) to "
            f"{first:.6g} m ({name})"
        )
    lowest = min(one.heights[0] for one in looked) - shift
    highest = max(one.heights[1] for one in looked) - shift
    return max(0.0, low - highest) - max(0.0, lowest - high)
