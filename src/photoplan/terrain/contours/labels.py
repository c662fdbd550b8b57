"""Where the heights of contours are written: on straight parts, apart from each other, readable uphill."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.terrain.contours.run import ContourLine

#: Width of a digit as a part of the text's height, and what is kept free on either side of the text.
DIGIT, FREE = 0.62, 0.5
#: Steps along a text in which the line is looked at.
STEPS = 8
#: The line may depart from the text's axis by this part of the text's height.
STRAIGHT = 0.35


@dataclass(frozen=True)
class ContourLabel:
    """Text on a contour."""

    X: float
    """Middle of the text, metres."""
    Y: float
    height: float
    """Height of its contour, metres."""
    angle: float
    """Direction of the text, degrees counter-clockwise from east, above -180 to 180; its top is uphill."""
    text: str


def decimals_of(interval: float, base: float = 0.0) -> int:
    """Decimals that tell contours apart: those of the interval and the base, at most six."""
    for digits in range(6):
        if all(abs(round(value, digits) - value) < 1e-9 * max(1.0, abs(value)) for value in (interval, base)):
            return digits
    return 6


@dataclass(eq=False)
class Labeller:
    """Finds places for labels, line by line, and keeps those already taken free."""

    size: float
    """Height of the text, metres on the ground."""
    spacing: float
    """Distance of labels along a line, metres; a shorter line has one, if there is a straight part."""
    decimals: int = 0
    _taken: dict[tuple[int, int], list[tuple[float, float, float]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.size) and self.size > 0 and self.spacing > 0):
            raise UsageError(f"labels {self.size} m high every {self.spacing} m; positive numbers are needed")

    def place(self, line: ContourLine) -> list[ContourLabel]:
        """Labels of one line; empty if it is short, crooked, or there is no room."""
        text = f"{line.height:.{self.decimals}f}"
        text = text.lstrip("-") if float(text) == 0 else text
        width = self.size * (DIGIT * len(text) + FREE)
        points = _evenly(line.xy, width / STEPS)
        if len(points) <= STEPS:
            return []
        bent, chord = _straightness(points)
        good = (bent <= STRAIGHT * self.size) & (np.hypot(*chord.T) >= 0.9 * width)
        radius = 0.5 * math.hypot(width, self.size)
        count = max(1, int((len(points) - 1) * width / STEPS / self.spacing))
        found = []
        for part in np.array_split(np.arange(len(bent)), count):
            for at in self._candidates(part, good, bent):
                X, Y = (points[at] + points[at + STEPS]) / 2
                if self._take(float(X), float(Y), radius):
                    # Higher ground is right of the line: read backwards, it is above the text.
                    angle = math.degrees(math.atan2(-chord[at, 1], -chord[at, 0]))
                    found.append(
                        ContourLabel(
                            X=float(X),
                            Y=float(Y),
                            height=line.height,
                            angle=180.0 if angle == -180 else angle,
                            text=text,
                        )
                    )
                    break
        return found

    @staticmethod
    def _candidates(part: NDArray[np.int64], good: NDArray[np.bool_], bent: NDArray[np.float64]) -> Sequence[int]:
        """Places of one stretch worth trying: the straightest ones, those in its middle first."""
        part = part[good[part]]
        if not len(part):
            return []
        rank = np.rint(4 * bent[part] / max(float(bent[part].max()), 1e-12))
        order = np.lexsort((np.abs(part - part.mean()), rank))
        return [int(i) for i in part[order[:: max(1, len(order) // 12)]]]

    def _take(self, X: float, Y: float, radius: float) -> bool:
        """Whether a disc is free; if so it is taken."""
        # Texts are at most two dozen digits long; in cells of that size only neighbours can touch.
        cell = 16 * self.size
        column, row = math.floor(X / cell), math.floor(Y / cell)
        for j in (row - 1, row, row + 1):
            for i in (column - 1, column, column + 1):
                for x, y, r in self._taken.get((i, j), ()):
                    if math.hypot(x - X, y - Y) < r + radius:
                        return False
        self._taken.setdefault((column, row), []).append((X, Y, radius))
        return True


def _evenly(xy: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Points along a line at equal distances, shape (n, 2)."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    at = np.arange(0.0, along[-1], step)
    return np.column_stack([np.interp(at, along, xy[:, k]) for k in range(2)])


def _straightness(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Largest distance of points from the chord over `STEPS` steps, shape (n,), and the chords, shape (n, 2)."""
    chord = points[STEPS:] - points[:-STEPS]
    size = np.maximum(np.hypot(*chord.T), 1e-12)
    bent = np.zeros(len(chord))
    for k in range(1, STEPS):
        off = points[k : k + len(chord)] - points[:-STEPS]
        bent = np.maximum(bent, np.abs(chord[:, 0] * off[:, 1] - chord[:, 1] * off[:, 0]) / size)
    return bent, chord
