"""Pictures of an error budget: what each cause contributes, and where in the image the error is large."""

from __future__ import annotations

import numpy as np

from photoplan.products.budget import PLACES, Budget, SourceTables
from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, PURPLE, RED, SKY, SOFT, figure_of, png, shortened, styled

#: Contributions that are nowhere larger than this part of the total are not drawn.
_LEAST = 0.05
_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, SOFT)


@styled
def draw_picture(found: Budget | SourceTables) -> bytes | None:
    """Draw bars for each place, and the map of the total over the typical image; nothing for tables."""
    if isinstance(found, SourceTables):
        return None
    budget = found.typical
    fig = figure_of(8.6, 3.6)
    bars, area = fig.subplots(1, 2, width_ratios=(1.25, 1))
    places = np.arange(len(PLACES))
    drawn = {n: v for n, v in budget.parts.items() if (v > _LEAST * budget.total).any()}
    wide = 0.8 / (len(drawn) + 1)
    for k, (name, values) in enumerate(drawn.items()):
        bars.bar(places - 0.4 + (k + 0.5) * wide, values, wide * 0.9, label=name,
                 color=_COLOURS[k % len(_COLOURS)], hatch="//" * (k // len(_COLOURS)))  # fmt: skip
    bars.bar(places + 0.4 - 0.5 * wide, budget.total, wide * 0.9, label="total", color=INK)
    bars.set(xticks=places, xticklabels=PLACES, ylabel="standard deviation of position, m")
    bars.set_title(f"{shortened(budget.image, 30)}: contributions")
    bars.grid(axis="x", visible=False)
    bars.legend(fontsize=8, loc="upper left")
    shown = area.imshow(budget.map, cmap="cividis", extent=(0, 1, 1, 0), interpolation="bilinear")
    lines = area.contour(np.linspace(0, 1, budget.map.shape[1]), np.linspace(0, 1, budget.map.shape[0]),
                         budget.map, 5, colors="white", linewidths=0.7)  # fmt: skip
    area.clabel(lines, fmt="%.3g", fontsize=7)
    area.set(xticks=[], yticks=[], xlabel="over the image")
    area.set_title("total, m")
    fig.colorbar(shown, ax=area, shrink=0.9)
    return png(fig)
