"""A picture of the located marks: each enlarged, with a cross where it was measured, and its template beside it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.geometry.grid import Window
from photoplan.orientation.marks.fiducials import Scan, mark_window
from photoplan.orientation.marks.layout import FiducialResult, LocatedMark, MarkLayout, MissingMark
from photoplan.orientation.marks.template import Template, draw
from photoplan.products.film import FiducialsReport, ImageFiducials, UnfoundFiducials
from photoplan.project.camera_marks import ScanImage
from photoplan.report.drawing import figure_of, png

_ACROSS = 2
"""Marks in a row."""
_MOST = 200
"""Pixels of a mark's picture along a side; larger ones are thinned."""
_OVERVIEW = 900
"""Pixels of a whole scan's picture along its longer side."""
_AROUND = 1.5
"""Half side of what is shown around a place, in sides of the mark."""
_CROSS, _LOST = "#d81b60", "#b03000"


def draw_marks(report: FiducialsReport) -> dict[Path, bytes]:
    """Draw the marks of all images by the places of their pictures, also where they were searched in vain."""
    found = {image.picture: marks_picture(image) for image in report.images if image.picture is not None}
    return found | {image.picture: unfound_picture(image) for image in report.unfound if image.picture is not None}


def marks_picture(image: ImageFiducials) -> bytes:
    """Draw the marks of an image; the scan is opened again."""
    found, scan = image.found, ScanImage(image.file, image.band)
    marks: list[LocatedMark | MissingMark] = [*found.marks, *found.missing]
    across = min(_ACROSS, len(marks))
    down = math.ceil(len(marks) / across)
    figure = figure_of(4.6 * across, 0.6 + 3.0 * down)
    figure.suptitle(image.name, fontsize=11)
    panels = figure.subplots(down, 2 * across, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    for k, mark in enumerate(marks):
        _panels(panels[2 * k : 2 * k + 2], scan, image.layout, found, mark)
    return png(figure, dpi=110)


def unfound_picture(image: UnfoundFiducials) -> bytes:
    """Draw a scan on which marks were not found: places that were searched, enlarged, next to what was searched."""
    scan, layout, sought = ScanImage(image.file, image.band), image.layout, image.sought
    px_per_mm = float(np.ptp([(m.x, m.y) for m in sought], axis=0).max()) / layout.extent
    rows = max(2, len(sought))
    figure = figure_of(9.5, 0.6 + 1.9 * rows)
    figure.suptitle(f"{image.name}: {sum(m.found for m in sought)} of {len(sought)} marks found, three are needed")
    left, right = figure.subfigures(1, 2, width_ratios=(1.3, 1))
    overview, panels = left.subplots(), right.subplots(rows, 2, squeeze=False)
    factor = max(1, max(scan.size) // _OVERVIEW)
    whole = Window(0, 0, *(side // factor * factor for side in scan.size))
    box = (-0.5, whole.width - 0.5, whole.height - 0.5, -0.5)
    overview.imshow(scan.grey(whole, factor), cmap="gray", extent=box, interpolation="nearest")
    overview.set_title("circles: found; squares: expected here, not found", loc="left", fontsize=8)
    for panel in panels.ravel():
        panel.set_axis_off()
    for (place, side), mark in zip(panels, sought):
        colour = _CROSS if mark.found else _LOST
        overview.plot(mark.x, mark.y, "o" if mark.found else "s", mfc="none", mec=colour, ms=14)
        overview.annotate(mark.name, (mark.x, mark.y), xytext=(9, 6), textcoords="offset points", color=colour)
        template = draw(layout.patterns[layout.names.index(mark.name)], np.diag([px_per_mm, -px_per_mm]))
        reach = math.ceil(_AROUND * max(template.values.shape))
        said = "" if math.isnan(mark.correlation) else f", best correlation {mark.correlation:.2f}"
        _show_place(place, scan, (mark.x, mark.y), (reach, reach))
        place.set_title(f"{mark.name}   {'found' if mark.found else 'not found'}{said}", loc="left", fontsize=8)
        _show_template(side, template, (reach - template.reference[0], reach - template.reference[1]))
        side.set_xlim(-0.5, 2 * reach + 0.5)
        side.set_ylim(2 * reach + 0.5, -0.5)
        side.set_title("what was sought", loc="left", fontsize=8)
    return png(figure, dpi=110)


def _show_place(
    panel: Any, scan: Scan, xy: tuple[float, float], half: tuple[int, int]
) -> tuple[float, float, float, float]:
    """Show the scan around a place; the box that is shown."""
    grey, col, row = mark_window(scan, xy, half)
    thin = max(1, max(grey.shape) // _MOST)
    box = (col - 0.5, col + grey.shape[1] - 0.5, row + grey.shape[0] - 0.5, row - 0.5)
    panel.imshow(grey[::thin, ::thin], cmap="gray", extent=box, interpolation="nearest")
    return box


def _show_template(panel: Any, template: Template, corner: tuple[float, float]) -> None:
    """Show what is compared, with the centre of its first pixel at `corner`."""
    (a, b), (x, y) = template.values.shape, corner
    shown = np.where(template.weights > 0, template.values, np.nan)
    box = (x - 0.5, x + b - 0.5, y + a - 0.5, y - 0.5)
    panel.imshow(shown, cmap="gray", vmin=0, vmax=1, extent=box, interpolation="nearest")
    panel.set_aspect("equal")


def _panels(
    panels: Any, scan: Scan, layout: MarkLayout, found: FiducialResult, mark: LocatedMark | MissingMark
) -> None:
    """Draw one mark: the scan, and what was searched there."""
    pattern = layout.patterns[layout.names.index(mark.name)]
    matrix = found.fit.transformation.derivative(np.zeros(2))
    template = draw(pattern, matrix, negative=found.negative, blur_px=found.blur_px)
    a, b = template.values.shape
    rx, ry = template.reference
    across, down = (math.ceil(1.15 * max(r, s - 1 - r)) + 3 for r, s in ((rx, b), (ry, a)))
    image, side = panels
    box = _show_place(image, scan, (mark.x, mark.y), (across, down))
    _show_template(side, template, (mark.x - rx, mark.y - ry))
    side.set_xlim(box[0], box[1])
    side.set_ylim(box[2], box[3])
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
