"""The figure of the pyramid experiment: the strip's turbulence, the level, and by how much the two ways differ."""

from __future__ import annotations

import numpy as np
import pyramid_strip as strips
from matplotlib.figure import Figure

from photoplan.matching.register import FOUND


def draw_strip(lines: int = 1600, columns: int = 600, rate: float = 0.7) -> Figure:
    """Angular rates over the lines, a level of the strip, both components of the vectors."""
    strip = strips.Strip(columns, lines, rate)
    outcome = strips.run(strip)
    fig = Figure(figsize=(9.6, 8.2), dpi=130, layout="constrained")
    rates, picture, *fields = fig.subplots(4, 1, height_ratios=[1.0, 1.25, 1.25, 1.25])
    at = np.arange(lines - 1) * strips.LINE
    for name, angle, colour in zip(("ω (roll)", "φ (pitch)"), strip.angles(), ("#0072B2", "#D55E00")):
        rates.plot(at, np.degrees(np.diff(angle)) / strips.LINE, color=colour, linewidth=1.0, label=name)
    rates.set(title="angular rates, degrees a second", xlabel="seconds of flight", xlim=(0, at[-1]))
    rates.legend(loc="upper right", ncols=2)
    level = outcome.after.shape
    picture.imshow(outcome.after.T, cmap="gray", interpolation="nearest")
    picture.set(title=f"the strip rectified, level {strips.LEVEL}, {level[0]} × {level[1]} pixels; flight to the right")
    found = outcome.found
    field = np.where((found.state == FOUND)[:, None], found.moved, np.nan).reshape(*outcome.shape, 2)
    low, high = found.at.min(axis=0)[::-1], found.at.max(axis=0)[::-1]
    for axes, k, name in zip(fields, (1, 0), ("along", "across")):
        rms = float(np.sqrt(np.nanmean(field[..., k] ** 2)))
        shown = axes.imshow(
            field[..., k].T, cmap="RdBu_r", vmin=-0.1, vmax=0.1, extent=(low[0], high[0], high[1], low[1])
        )
        axes.set(title=f"difference {name} the flight, root mean square {rms:.3f} px")
    fig.colorbar(shown, ax=[picture, *fields], label="px", extend="both", shrink=0.6)
    for axes in (picture, *fields):
        axes.grid(visible=False)
        axes.set(xlim=(0, level[0]), ylim=(level[1], 0))
    return fig
