"""The figure of the road's edge in two orthophotos."""

from __future__ import annotations

import numpy as np
import road_edge as road
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, RED, INK = "#0072B2", "#D55E00", "#1c2730"
TITLES = {"hybrid": "hybrid model: grid and breaklines", "grid": "its grid alone"}


def draw_road(width: float = 5.0) -> Figure:
    """Both orthophotos with the true edge, and how far the edge lies from it all along the road."""
    outcome = road.run(width)
    fig = Figure(figsize=(9.6, 6.6), dpi=130, layout="constrained")
    rows = fig.subfigures(2, 1, height_ratios=[1.15, 1.0])
    for axes, name in zip(rows[0].subplots(1, 2, sharey=True), ("hybrid", "grid")):
        _picture(axes, outcome, name)
    panels = rows[1].subplots(1, 2, sharey=True)
    for axes, side, where in zip(panels, (0, 1), ("northern edge", "southern edge")):
        _offsets(axes, outcome, side, where)
    panels[0].set_ylabel("off the true edge, away from the axis, px")
    return fig


def _picture(axes: Axes, outcome: road.Outcome, name: str) -> None:
    left, bottom, right, top = road.ortho_grid().bounds
    axes.imshow(
        outcome.pictures[name],
        cmap="gray",
        vmin=0,
        vmax=230,
        extent=(left, right, bottom, top),
        interpolation="nearest",
    )
    angles = np.linspace(*road.ANGLES, 200)
    for side in (-1.0, 1.0):
        axes.plot(*road.on_circle(angles, side * road.HALF_WIDTH).T, color=RED, linewidth=1.1)
    axes.set(title=TITLES[name], xlim=(36, 76), ylim=(54, 73), xlabel="X, m")
    axes.grid(False)
    if name == "hybrid":
        axes.set_ylabel("Y, m")
        axes.annotate(
            "true edge", (50.0, 67.6), (40.0, 70.6), color=RED, arrowprops={"arrowstyle": "-", "color": RED, "lw": 0.8}
        )


def _offsets(axes: Axes, outcome: road.Outcome, side: int, where: str) -> None:
    axes.axhspan(-0.2, 0.2, color="#dddddd", linewidth=0)
    axes.plot(outcome.along, outcome.offsets["grid"][side], color=RED, label="grid alone")
    axes.plot(outcome.along, outcome.offsets["hybrid"][side], color=BLUE, label="hybrid model")
    axes.set(title=f"{where} (grey: ±0.2 px)", xlabel="along the edge, m", xlim=(0, outcome.along[-1]))
    if side == 0:
        axes.legend(loc="lower right", ncols=2)
