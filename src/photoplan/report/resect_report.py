"""Report of resections: orientation, residuals and a picture of them for every image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.report.drawing import BLUE, INK, RED, SOFT, STYLE, axes_of, load_matplotlib, png, round_down
from photoplan.report.page import Cell, figure, headline, page, section, table, text

Array = NDArray[np.float64]

_WIDTH = 6.2
#: Names that are written into a picture.
_NAMED = 60
#: Images that get a picture.
_PICTURES = 60


@dataclass(frozen=True, eq=False)
class ResectFacts:
    """What the report shows of an image."""

    name: str
    size: tuple[int, int]
    points: tuple[str, ...]
    xy: Array
    """(n, 2), pixels."""
    residuals: Array
    """Computed minus measured, (n, 2), pixels."""
    normalised: Array
    redundancies: Array
    rejected: NDArray[np.bool_]
    sigma0: float
    redundancy: int
    rms: float
    orientation: tuple[tuple[str, str, str], ...]
    """Name, value and standard deviation of each parameter."""
    notes: tuple[str, ...]


class ResectPlots:
    """Draws; made before any work, so that a missing library is known at once.

    Raises
    ------
    UsageError
        When made: matplotlib is not installed.
    """

    def __init__(self) -> None:
        self._mpl = load_matplotlib("a report", "leave --report out")

    def residuals(self, facts: ResectFacts) -> tuple[bytes, float]:
        """Residual vectors at the measured points, and the factor by which they are enlarged."""
        width, height = facts.size
        used = ~facts.rejected & np.isfinite(facts.residuals).all(axis=1)
        typical = float(np.linalg.norm(facts.residuals[used], axis=1).max(initial=0.0)) or 1e-3
        scale = round_down(0.09 * max(width, height) / typical)
        with self._mpl.rc_context(STYLE):
            tall = float(np.clip(_WIDTH * height / width, 2.5, 8.0))
            fig, axes = axes_of(self._mpl, _WIDTH, tall + 0.5)
            for keep, colour, label in ((used, BLUE, "points"), (facts.rejected, RED, "gross errors")):
                if not keep.any():
                    continue
                axes.scatter(*facts.xy[keep].T, s=14, color=colour, zorder=3, label=label)
            ends = facts.xy + scale * facts.residuals
            for k in (int(i) for i in np.flatnonzero(used)):
                arrow = {"arrowstyle": "-|>", "color": BLUE, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
                axes.annotate("", ends[k], facts.xy[k], arrowprops=arrow, annotation_clip=False)
            for k in range(min(len(facts.points), _NAMED)):
                aside = (-4, 5) if facts.residuals[k, 0] > 0 else (4, 5)
                name = facts.points[k] if len(facts.points[k]) <= 14 else facts.points[k][:13] + "…"
                side = "right" if aside[0] < 0 else "left"
                colour = RED if facts.rejected[k] else INK
                axes.annotate(name, facts.xy[k], aside, textcoords="offset points", fontsize=8, color=colour, ha=side)
            self._key(axes, facts.size, scale, typical)
            axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="column px", ylabel="row px")
            axes.set_aspect("equal")
            if facts.rejected.any():
                fig.legend(loc="outside upper right", ncols=2)
            return png(fig), scale

    def _key(self, axes: Any, size: tuple[int, int], scale: float, typical: float) -> None:
        """A bar with the length of a residual."""
        length = round_down(typical)
        x, y = 0.03 * size[0], 0.96 * size[1]
        axes.plot([x, x + scale * length], [y, y], color=INK, linewidth=2.2, solid_capstyle="butt", zorder=4)
        label = f"residual of {length:g} px"
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
        axes.annotate(label, (x, y), (0, 4), textcoords="offset points", fontsize=8, color=SOFT, bbox=box)


def resect_report(project: str, images: Sequence[ResectFacts], plots: ResectPlots) -> str:
    """The report as one HTML document."""
    wrong = sum(int(i.rejected.sum()) for i in images)
    used = sum(int((~i.rejected).sum()) for i in images)
    rms = float(np.sqrt(np.mean([i.rms**2 for i in images])))
    parts = [
        headline(
            [
                (str(len(images)), "images oriented", "each by itself"),
                (str(used), "measurements used", f"{wrong} gross errors" if wrong else "no gross errors"),
                (f"{rms:.2f} px", "rms of residuals", "one coordinate"),
            ]
        )
    ]
    parts += [_image(facts, plots if k < _PICTURES else None) for k, facts in enumerate(images)]
    return page(f"Space resection: {project}", "Exterior orientation of single images by control points", parts)


def _image(facts: ResectFacts, plots: ResectPlots | None) -> str:
    rows = [[Cell(name), Cell(value, True), Cell(f"± {sigma}", True)] for name, value, sigma in facts.orientation]
    points = [
        [
            Cell(name + (" (gross error)" if facts.rejected[k] else "")),
            *(Cell(_number(v, 2), True) for v in (*facts.xy[k], *facts.residuals[k], *facts.normalised[k])),
            Cell(_number(float(np.mean(facts.redundancies[k])), 2), True),
        ]
        for k, name in enumerate(facts.points)
    ]
    parts = [
        f"<p>{int((~facts.rejected).sum())} points, redundancy {facts.redundancy}, sigma0 {facts.sigma0:.3g}, "
        f"rms {facts.rms:.3g} px. Standard deviations hold sigma0.</p>"
    ]
    parts += [f"<p>{text(note)}</p>" for note in facts.notes]
    if plots is not None:
        picture, scale = plots.residuals(facts)
        caption = f"Residuals (computed minus measured) enlarged {scale:g} times at the measured positions."
        parts.append(figure(picture, f"Residuals of {facts.name}", caption))
    head = ("point", "column", "row", "v column px", "v row px", "norm. column", "norm. row", "controlled")
    return section(facts.name, [*parts, table(("parameter", "value", "standard deviation"), rows), table(head, points)])


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"
