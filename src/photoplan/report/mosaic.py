"""Which image painted what: the regions of a mosaic as a picture."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from photoplan.io.naming import write_atomically
from photoplan.report.drawing import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    axes_of,
    load_matplotlib,
    png,
    shortened,
)

#: Images of smaller regions get no name in the picture, part of the whole.
_NAMED = 0.005


def draw_regions(path: Path, shapes: Mapping[str, Any], title: str) -> Path:
    """Draw the regions of images, the larger ones with their names, as a PNG; replaces an older one.

    Parameters
    ----------
    shapes : mapping
        Multipolygon of each image, in map coordinates.

    Raises
    ------
    UsageError
        matplotlib is not installed, or the folder cannot be written.
    """
    mpl = load_matplotlib("a picture of the regions", "leave `sources` out")
    left, bottom, right, top = shapely.total_bounds(list(shapes.values())).tolist()
    fig, ax = axes_of(9.0, float(np.clip(9.0 * (top - bottom) / (right - left), 3.0, 14.0)))
    area = sum(shape.area for shape in shapes.values())
    for (name, shape), colour in zip(shapes.items(), cycle((BLUE, ORANGE, GREEN, RED, SKY, PURPLE))):
        rings = [np.array(ring.coords) for part in shape.geoms for ring in (part.exterior, *part.interiors)]
        outline = mpl.path.Path.make_compound_path(*(mpl.path.Path(ring, closed=True) for ring in rings))
        ax.add_patch(mpl.patches.PathPatch(outline, facecolor=colour, alpha=0.55, edgecolor=INK, linewidth=0.6))
        if shape.area > _NAMED * area:
            at = max(shape.geoms, key=lambda part: part.area).representative_point()
            ax.annotate(shortened(name), (at.x, at.y), ha="center", va="center", fontsize=8, color=INK)
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", title=title, xlabel="X [m]", ylabel="Y [m]")
    ax.ticklabel_format(useOffset=False, style="plain")
    ax.tick_params(axis="x", labelrotation=30)
    write_atomically(path, png(fig))
    return path
