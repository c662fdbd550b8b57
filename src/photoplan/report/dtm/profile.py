"""Small pictures to look at: profiles, heights over the distance with their standard deviation; contours."""

from __future__ import annotations

from typing import Any

import numpy as np

from photoplan.errors import UsageError
from photoplan.products.dtm.contours import ContourFacts
from photoplan.products.dtm.profile import Profile, Profiles
from photoplan.report.drawing import mpl, png

MOST = 12
"""Profiles of one picture at most."""
_GROUND, _BAND = "#5b4a33", "#d9a441"


def profile_picture(profiles: Profiles) -> bytes:
    """A PNG: a panel for each profile, all in one scale."""
    if len(profiles) > MOST:
        raise UsageError(f"{len(profiles)} lines; a picture shows at most {MOST}: give fewer, or write a .csv alone")
    figure = mpl.figure.Figure(figsize=(10, 1.0 + 2.4 * len(profiles)), layout="constrained", dpi=110)
    axes = figure.subplots(len(profiles), 1, squeeze=False)[:, 0]
    span = max(high - low for low, high in map(_range, profiles))
    length = max(float(p.distance[-1]) for p in profiles)
    for panel, item in zip(axes, profiles):
        _panel(panel, item, span, length)
    axes[-1].set_xlabel("distance along the line [m]")
    # The layout decides how large the panels are, and so how much heights are exaggerated.
    figure.draw_without_rendering()
    for panel, item in zip(axes, profiles):
        box = panel.get_window_extent()
        factor = (box.height / (1.1 * span)) / (box.width / length)
        panel.set_title(f"{item.name}  (heights × {factor:.2g})", loc="left", fontsize=10)
    return png(figure, dpi=110)


def _panel(panel: Any, item: Profile, span: float, length: float) -> None:
    d, z, s = item.distance, item.heights, item.sigmas
    if np.isfinite(s).any():
        panel.fill_between(d, z - 2 * s, z + 2 * s, color=_BAND, alpha=0.5, linewidth=0, label="± 2 σ")
        panel.legend(loc="upper right", fontsize=8, frameon=False)
    panel.plot(d, z, color=_GROUND, linewidth=1.2)
    low, high = _range(item)
    middle = (low + high) / 2
    panel.set_ylim(middle - 0.55 * span, middle + 0.55 * span)
    panel.set_xlim(0, length)
    panel.set_ylabel("height [m]")
    panel.ticklabel_format(useOffset=False)
    panel.set_title(item.name, loc="left", fontsize=10)
    panel.grid(alpha=0.3)


def _range(item: Profile) -> tuple[float, float]:
    """Lowest and highest of all that is drawn, at least 0.1 m apart."""
    band = 2 * np.nan_to_num(item.sigmas)
    drawn = np.concatenate([item.heights - band, item.heights + band])
    drawn = drawn[np.isfinite(drawn)]
    if not drawn.size:
        return 0.0, 1.0
    low, high = float(drawn.min()), float(drawn.max())
    return (low, high) if high - low > 0.1 else (low - 0.05, high + 0.05)


def contours_picture(facts: ContourFacts) -> bytes:
    """Contours and their labels as PNG."""
    sketch = facts.sketch
    assert sketch is not None
    xmin, ymin, xmax, ymax = sketch.bounds
    inches = (xmax - xmin) / sketch.pixel / 100, (ymax - ymin) / sketch.pixel / 100
    figure = mpl.figure.Figure(figsize=(max(inches[0], 1), max(inches[1], 1)), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    for kind, colour, width in (("plain", "#a8763e", 0.5), ("low", "#4a78a8", 0.5), ("index", "#7a4a14", 1.1)):
        lines = mpl.collections.LineCollection(sketch.lines[kind], colors=colour, linewidths=width)
        axes.add_collection(lines)
    axes.set(xlim=(xmin, xmax), ylim=(ymin, ymax), aspect="equal")
    points = max(5.0, 72 / 100 * (facts.text_height or 1.0) / sketch.pixel)
    for label in facts.labels:
        box = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
        axes.text(
            label.X,
            label.Y,
            label.text,
            rotation=label.angle,
            ha="center",
            va="center",
            size=points,
            color="#5a3208",
            bbox=box,
        )
    return png(figure, dpi=100, facecolor="white")
