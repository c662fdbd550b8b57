"""A small picture of contours to look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.io.disk import write_atomically
from photoplan.report.drawing import load_matplotlib, png
from photoplan.terrain.contours.run import ContourLine

#: Longer side, pixels; and vertices after which further lines are left out of the picture.
SIDE, MOST = 1400, 2_000_000


@dataclass(eq=False)
class ContourPicture:
    """Collects lines at the picture's own resolution.

    Raises
    ------
    UsageError
        When made: matplotlib is not installed.
    """

    bounds: tuple[float, float, float, float]
    _lines: dict[str, list[NDArray[np.float64]]] = field(default_factory=lambda: {"plain": [], "index": [], "low": []})
    _count: int = 0

    def __post_init__(self) -> None:
        self._mpl = load_matplotlib("a preview")
        xmin, ymin, xmax, ymax = self.bounds
        self._pixel = max(xmax - xmin, ymax - ymin) / SIDE

    def add(self, line: ContourLine) -> None:
        """Take a line."""
        if self._count > MOST:
            return
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line.xy, axis=0).T))])
        if along[-1] < self._pixel:
            return
        # One vertex in every stretch of a pixel, and the last one.
        keep = np.append(np.diff(np.floor(along / self._pixel), prepend=-1)[:-1] > 0, True)
        xy = line.xy[keep]
        self._count += len(xy)
        self._lines["index" if line.index else "low" if line.depression else "plain"].append(xy)

    def write(self, path: Path, labels: Sequence[tuple[float, float, float, str]], size: float) -> None:
        """Draw and write the PNG.

        Parameters
        ----------
        path
            The picture; replaced if it is there.
        labels
            X, Y, angle in degrees and text.
        size
            Height of the texts, metres.
        """
        xmin, ymin, xmax, ymax = self.bounds
        inches = (xmax - xmin) / self._pixel / 100, (ymax - ymin) / self._pixel / 100
        figure = self._mpl.figure.Figure(figsize=(max(inches[0], 1), max(inches[1], 1)), dpi=100)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        for kind, colour, width in (("plain", "#a8763e", 0.5), ("low", "#4a78a8", 0.5), ("index", "#7a4a14", 1.1)):
            lines = self._mpl.collections.LineCollection(self._lines[kind], colors=colour, linewidths=width)
            axes.add_collection(lines)
        axes.set(xlim=(xmin, xmax), ylim=(ymin, ymax), aspect="equal")
        points = max(5.0, 72 / 100 * size / self._pixel)
        for x, y, angle, text in labels:
            box = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
            axes.text(x, y, text, rotation=angle, ha="center", va="center", size=points, color="#5a3208", bbox=box)
        write_atomically(path, png(figure, dpi=100, facecolor="white"))
