"""Figure of docs/reference/marks.md: every kind of fiducial mark, drawn as the program draws it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from pydantic import TypeAdapter

from photoplan.cameras.fiducials import MarkPattern
from photoplan.cameras.marks import Mark
from photoplan.orientation.marks.locate import render
from photoplan.project.camera_marks import mark_pattern

MARKS = {
    "cross": {"type": "cross", "arm": 1.0, "width": 0.12, "free": 0.2},
    "dot": {"type": "dot", "diameter": 0.5},
    "ring": {"type": "ring", "diameter": 1.2, "width": 0.12},
    "ring_cross": {"type": "ring_cross", "diameter": 1.6, "width": 0.12, "arm": 0.6, "rotation": 45.0},
    "dot_cross": {"type": "dot_cross", "diameter": 0.3, "arm": 1.0, "width": 0.1, "free": 0.35},
    "polygon": {
        "type": "polygon",
        "background": 0.0,
        "parts": [
            {"outline": [(-0.8, -0.8), (0.8, -0.8), (0.8, 0.8), (-0.8, 0.8)], "tone": 1.0},
            {"outline": [(0.0, 0.0), (0.8, 0.8), (-0.8, 0.8)], "tone": 0.0},
            {"outline": [(0.0, 0.0), (0.8, -0.8), (-0.8, -0.8)], "tone": 0.0},
        ],
    },
    "block": {"type": "block", "ledge": 3.0, "depth": 1.6, "tip": 1.8, "height": 3.2, "slit": 0.1, "inside": 0.5},
    "curve": {"type": "curve", "ledge": 3.0, "depth": 2.0, "rise": 3.2, "run": 4.0, "corner": 0.3},
    "notch": {"type": "notch", "reach": 2.5, "tip": 1.9, "shoulder": 2.2, "angle": 46.0},
    "triangle": {"type": "triangle", "flanks": (225.0, 315.0), "near": 0.3, "far": 2.5},
    "arc": {"type": "arc", "arm": 1.0, "width": 0.1, "tip": 4.0, "depth": 2.4, "rise": 4.5, "run": 8.0},
    "block, left side": {
        "type": "block",
        "ledge": 3.0,
        "depth": 1.6,
        "tip": 1.8,
        "height": 3.2,
        "slit": 0.1,
        "inside": 0.5,
        "rotation": 90.0,
    },
}
"""Entry `marks` of a camera, one for each panel."""


def draw_marks(columns: int = 4) -> Figure:
    """One panel for each kind: grey as compared, hatched blue where nothing is compared, a plus at the reference."""
    fig = Figure(figsize=(8.6, 6.6), dpi=130, layout="constrained")
    panels = fig.subplots(-(-len(MARKS) // columns), columns).ravel()
    for axes, (name, entry) in zip(panels, MARKS.items(), strict=False):
        pattern = mark_pattern(TypeAdapter(Mark).validate_python(entry), Path())
        assert isinstance(pattern, MarkPattern)
        drawn = render(pattern, 40 * np.diag([1.0, -1.0]))
        grey = np.clip(drawn.values, 0, 1)[..., None] * np.ones(3)
        unknown = np.array([0.62, 0.74, 0.87])
        rgb = drawn.weights[..., None] * grey + (1 - drawn.weights[..., None]) * unknown
        x, y = drawn.reference
        rows, cols = drawn.values.shape
        box = ((-0.5 - x) / 40, (cols - 0.5 - x) / 40, (y - rows + 0.5) / 40, (y + 0.5) / 40)
        axes.imshow(np.clip(rgb, 0, 1), extent=box, interpolation="nearest")
        axes.plot(0, 0, "+", color="#cc3311", ms=9, mew=1.4)
        axes.set(xlim=box[:2], ylim=box[2:])
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=7)
    for axes in panels[len(MARKS) :]:
        axes.set_axis_off()
    panels[0].set_ylabel("mm", fontsize=8)
    return fig
