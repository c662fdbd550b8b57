"""Objects of a plan as squares: a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.io.naming import write_atomically
from photoplan.report.drawing import BLUE, INK, axes_of, load_matplotlib, png


def draw_squares(path: Path, bounds: NDArray[np.float64], title: str) -> Path:
    """Draw squares by their outer edges xmin, ymin, xmax, ymax, shape (n, 4), as a PNG; replaces an older one.

    Raises
    ------
    UsageError
        matplotlib is not installed, or the folder cannot be written.
    """
    mpl = load_matplotlib("a picture of the squares", "leave `show_quadtree` out")
    (left, bottom), (right, top) = bounds[:, :2].min(axis=0).tolist(), bounds[:, 2:].max(axis=0).tolist()
    shape = (9.0, float(np.clip(9.0 * (top - bottom) / (right - left), 2.0, 14.0)))
    fig, ax = axes_of(*shape)
    x0, y0, x1, y1 = bounds.T
    corners = np.stack([np.stack([x0, x1, x1, x0], axis=1), np.stack([y0, y0, y1, y1], axis=1)], axis=-1)
    ax.add_collection(
        mpl.collections.PolyCollection(corners, facecolor=BLUE, alpha=0.35, edgecolor=INK, linewidth=0.15)
    )
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", title=title, xlabel="X [m]", ylabel="Y [m]")
    ax.ticklabel_format(useOffset=False, style="plain")
    ax.tick_params(axis="x", labelrotation=30)
    write_atomically(path, png(fig))
    return path
