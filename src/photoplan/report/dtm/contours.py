"""A small picture of contours to look at."""

from __future__ import annotations

from typing import Any

from photoplan.products.dtm.contours import ContourFacts
from photoplan.report.drawing import png


def contours_picture(facts: ContourFacts, mpl: Any) -> bytes:
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
