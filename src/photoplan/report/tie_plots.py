"""The picture of tie points: which images hang together, and where the points lie in some of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, RED, SKY, SOFT, STYLE, load_matplotlib, png

#: Colours of points in two, three, four, and five or more images.
RAY_COLOURS = {2: ORANGE, 3: SKY, 4: BLUE, 5: GREEN}
_NAMES = 60


@dataclass(frozen=True, eq=False)
class TieView:
    """An image with its points."""

    name: str
    grey: NDArray[np.uint8]
    """A small copy, (rows, columns)."""
    xy: NDArray[np.float64]
    """Points in pixels of the small copy, (n, 2)."""
    rays: NDArray[np.int64]
    """Images that share each point, (n,)."""


@dataclass(frozen=True, eq=False)
class TieFacts:
    """What the picture shows."""

    names: tuple[str, ...]
    place: NDArray[np.float64]
    """Where each image is drawn, (n, 2)."""
    on_map: bool
    """The places are map coordinates; otherwise images with much in common lie close together."""
    joined: NDArray[np.int64]
    """Pairs of images with common points, (k, 2)."""
    common: NDArray[np.int64]
    """Their number, (k,)."""
    points: NDArray[np.int64]
    """Points of each image, (n,)."""
    views: tuple[TieView, ...]


class TiePlots:
    """Draws; made before any work, so that a missing library is known at once.

    Raises
    ------
    UsageError
        When made: matplotlib is not installed.
    """

    def __init__(self) -> None:
        self._mpl = load_matplotlib("a picture of tie points")

    def ties(self, facts: TieFacts) -> bytes:
        """Network and views, as PNG."""
        rows = -(-len(facts.views) // 2)
        with self._mpl.rc_context(STYLE):
            fig = self._mpl.figure.Figure(figsize=(9.0, 6.2 + 2.8 * rows), layout="constrained")
            grid = fig.add_gridspec(rows + 1, 2, height_ratios=[6.0, *([2.8] * rows)])
            self._network(fig, fig.add_subplot(grid[0, :]), facts)
            for k, view in enumerate(facts.views):
                _view(fig.add_subplot(grid[1 + k // 2, k % 2]), view)
            return png(fig)

    def _network(self, fig: Any, axes: Any, facts: TieFacts) -> None:
        most = max(1, int(facts.common.max(initial=1)))
        for k in np.argsort(facts.common, kind="stable"):
            part = facts.common[k] / most
            ends = facts.place[facts.joined[k]]
            axes.plot(*ends.T, color=BLUE, linewidth=0.3 + 4.0 * part, alpha=0.25 + 0.6 * part, zorder=1)
        alone = facts.points == 0
        axes.scatter(*facts.place[~alone].T, s=26, color=INK, zorder=2)
        if alone.any():
            axes.scatter(*facts.place[alone].T, s=60, color=RED, marker="x", zorder=3, label="without connection")
            axes.legend(loc="upper right")
        if len(facts.names) <= _NAMES:
            for name, at in zip(facts.names, facts.place):
                axes.annotate(name, at, (4, 4), textcoords="offset points", fontsize=7, color=INK)
        where = "by position on the map, metres" if facts.on_map else "by what they have in common"
        axes.set_title(f"Images, {where}; lines: common points, the widest {most}")
        axes.set_aspect("equal", adjustable="datalim")
        axes.ticklabel_format(useOffset=False, style="plain")
        if not facts.on_map:
            axes.set(xticks=[], yticks=[])


def _view(axes: Any, view: TieView) -> None:
    axes.imshow(view.grey, cmap="gray", vmin=-40, vmax=295, interpolation="nearest")
    for rays, colour in RAY_COLOURS.items():
        here = view.rays == rays if rays < 5 else view.rays >= 5
        label = f"{rays} images" if rays < 5 else "5 or more"
        if here.any():
            axes.scatter(*view.xy[here].T, s=7, color=colour, label=label, linewidths=0)
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.set_title(f"{view.name}: {len(view.xy)} points", color=SOFT)
    if len(view.xy):
        axes.legend(loc="lower left", fontsize=6, markerscale=1.8, frameon=True)


def spread_views(count: int, points: Sequence[int], most: int = 4) -> list[int]:
    """Images to show: spread over those that have points."""
    some = [k for k in range(count) if points[k] > 0]
    return sorted({some[int(i)] for i in np.linspace(0, len(some) - 1, min(most, len(some)))}) if some else []
