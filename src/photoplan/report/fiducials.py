"""A picture of the located marks: each enlarged, with a cross where it was measured, and its template beside it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from photoplan.orientation.marks.fiducials import FiducialResult, LocatedMark, MissingMark
from photoplan.orientation.marks.layout import MarkLayout
from photoplan.orientation.marks.measure import mark_window
from photoplan.orientation.marks.search import Scan
from photoplan.orientation.marks.template import draw
from photoplan.products.fiducials.run import ImageFiducials
from photoplan.project.camera_marks import ScanImage
from photoplan.report.drawing import png

_ACROSS = 2
"""Marks in a row."""
_MOST = 200
"""Pixels of a mark's picture along a side; larger ones are thinned."""
_CROSS, _LOST = "#d81b60", "#b03000"


def marks_picture(image: ImageFiducials, mpl: Any) -> bytes:
    """The marks of an image as PNG; the scan is opened again."""
    found, scan = image.found, ScanImage(image.file, image.band)
    marks: list[LocatedMark | MissingMark] = [*found.marks, *found.missing]
    across = min(_ACROSS, len(marks))
    down = math.ceil(len(marks) / across)
    figure = mpl.figure.Figure(figsize=(4.6 * across, 0.6 + 3.0 * down), layout="constrained")
    figure.suptitle(image.name, fontsize=11)
    panels = figure.subplots(down, 2 * across, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    for k, mark in enumerate(marks):
        _panels(panels[2 * k : 2 * k + 2], scan, image.layout, found, mark)
    return png(figure, dpi=110)


def _panels(
    panels: Any, scan: Scan, layout: MarkLayout, found: FiducialResult, mark: LocatedMark | MissingMark
) -> None:
    """One mark: the scan, and what was sought there."""
    pattern = layout.patterns[layout.names.index(mark.name)]
    matrix = found.fit.transformation.derivative(np.zeros(2))
    template = draw(pattern, matrix, negative=found.negative, blur_px=found.blur_px)
    a, b = template.values.shape
    rx, ry = template.reference
    half = tuple(math.ceil(1.15 * max(r, s - 1 - r)) + 3 for r, s in ((rx, b), (ry, a)))
    grey, col, row = mark_window(scan, (mark.x, mark.y), half)
    thin = max(1, max(grey.shape) // _MOST)
    box = (col - 0.5, col + grey.shape[1] - 0.5, row + grey.shape[0] - 0.5, row - 0.5)
    image, side = panels
    image.imshow(grey[::thin, ::thin], cmap="gray", extent=box, interpolation="nearest")
    side.imshow(
        np.where(template.weights > 0, template.values, np.nan),
        cmap="gray",
        vmin=0,
        vmax=1,
        extent=(mark.x - rx - 0.5, mark.x - rx + b - 0.5, mark.y - ry + a - 0.5, mark.y - ry - 0.5),
        interpolation="nearest",
    )
    side.set_xlim(box[0], box[1])
    side.set_ylim(box[2], box[3])
    side.set_aspect("equal")
    for panel in panels:
        panel.axhline(mark.y, color=_CROSS, linewidth=0.6)
        panel.axvline(mark.x, color=_CROSS, linewidth=0.6)
    if isinstance(mark, LocatedMark):
        image.set_title(
            f"{mark.name}   {mark.x:.2f}  {mark.y:.2f}\ncorrelation {mark.correlation:.3f}", loc="left", fontsize=8
        )
        side.set_title(f"σ {mark.sigma_x:.3f}  {mark.sigma_y:.3f} px\n{mark.method}", loc="left", fontsize=8)
    else:
        best = "" if math.isnan(mark.correlation) else f"best {mark.correlation:.2f}"
        image.set_title(f"{mark.name}   not found\n{best}", loc="left", fontsize=8, color=_LOST)
