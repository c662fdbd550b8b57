"""One plumb line in one frame, measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.series.file import Frame
from photoplan.io.series.model import EdgeEntry
from photoplan.io.series.pixels import frame_pixels
from photoplan.products.characterise.data import SeriesData
from photoplan.quality.camera.line_jitter import LineJitter, line_jitter
from photoplan.quality.camera.plumb_edge import EdgeLines, correlate_edge, fit_edge


@dataclass(frozen=True, eq=False)
class Edge:
    """An edge in a frame."""

    entry: EdgeEntry
    frame: Frame
    window: Window
    fitted: EdgeLines
    jitter: LineJitter
    """Of the least-squares positions."""
    correlated: LineJitter
    """Of the positions by correlation and parabola."""

    @property
    def first_line(self) -> int:
        """Row (column, of a horizontal edge) of the image in which line 0 lies."""
        return self.window.row if self.entry.direction == "vertical" else self.window.col

    @property
    def field_offset(self) -> float:
        """Odd rows minus even rows of the image."""
        return -self.jitter.field_offset if self.first_line % 2 else self.jitter.field_offset


def measured_edge(data: SeriesData, frame: Frame, entry: EdgeEntry, degree: int | None) -> Edge:
    """An edge of a frame by least squares and by correlation, and the jitter of both.

    Raises
    ------
    InputError
        The edge's window leaves the image, or holds no clean edge.
    """
    window = Window(*entry.roi)
    assert data.series.size is not None
    if window.stop[0] > data.series.size[0] or window.stop[1] > data.series.size[1]:
        raise InputError(
            f"{frame.group.label}: edge {entry.name}: roi {list(entry.roi)} leaves the image of "
            f"{data.series.size[0]} × {data.series.size[1]} pixels"
        )
    grey = frame_pixels(frame, window)[0].astype(float)
    lines = grey if entry.direction == "vertical" else grey.T
    name = f"{frame.file.name}, edge {entry.name}"
    saturation = data.saturation_dn(data.planes[0].name)
    fitted = fit_edge(lines, name=name, saturation=saturation if math.isfinite(saturation) else None)
    by_correlation = correlate_edge(lines, fitted, name=name)
    return Edge(
        entry,
        frame,
        window,
        fitted,
        line_jitter(fitted.position, name, degree),
        line_jitter(by_correlation.position, name, degree),
    )
