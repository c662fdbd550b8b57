"""Report of test patterns: transfer against frequency, by direction, and where a target was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, RED, SOFT, STYLE, axes_of, load_matplotlib, png
from photoplan.report.page import Cell, figure, page, section, table, text

Array = NDArray[np.float64]

_WIDTH = 6.2
_COLOURS = (BLUE, RED, GREEN, ORANGE)
#: Modulations whose frequencies are shown by direction.
_LEVELS = (0.8, 0.5, 0.2, 0.1)


@dataclass(frozen=True, eq=False)
class Curve:
    """Transfer against frequency."""

    name: str
    kind: str
    """``mtf`` or ``contrast``."""
    frequency: Array
    """Cycles per pixel."""
    value: Array
    sigma: Array
    """NaN where it is not known."""
    points: bool
    """Draw each value."""


@dataclass(frozen=True, eq=False)
class PolarCurve:
    """MTF of a direction."""

    angle_deg: float
    frequency: Array
    value: Array


class Mark(NamedTuple):
    """A place in the picture."""

    col: float
    row: float
    label: str
    resolved: bool


class Frame(NamedTuple):
    """A window in the picture."""

    col: float
    row: float
    width: float
    height: float
    label: str


@dataclass(frozen=True, eq=False)
class PatternFacts:
    """What the report shows of a pattern."""

    title: str
    summary: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    """The figures as a table; the first column names the row."""
    notes: tuple[str, ...]
    linearisation: str
    curves: tuple[Curve, ...]
    polar: tuple[PolarCurve, ...]
    picture: NDArray[np.float32] | None
    """Light, shape (rows, columns)."""
    marks: tuple[Mark, ...]
    frames: tuple[Frame, ...]
    pixel_um: float | None


class PatternPlots:
    """Draws; made before any work, so that a missing library is known at once.

    Raises
    ------
    UsageError
        When made: matplotlib is not installed.
    """

    def __init__(self) -> None:
        self._mpl = load_matplotlib("a report", "leave --report out")

    def curves(self, facts: PatternFacts) -> bytes:
        """Transfer against frequency, with two standard deviations."""
        with self._mpl.rc_context(STYLE):
            fig, axes = axes_of(self._mpl, _WIDTH, 3.5)
            for curve, colour in zip(facts.curves, _COLOURS):
                dashed = "--" if curve.kind == "contrast" and len({c.kind for c in facts.curves}) > 1 else "-"
                axes.plot(curve.frequency, curve.value, dashed, color=colour, linewidth=1.3, label=curve.name)
                known = np.isfinite(curve.sigma)
                if curve.points:
                    axes.errorbar(curve.frequency[known], curve.value[known], 2.0 * curve.sigma[known], fmt="o",
                                  color=colour, markersize=3.2, linewidth=0.9)  # fmt: skip
                else:
                    low, high = curve.value - 2.0 * curve.sigma, curve.value + 2.0 * curve.sigma
                    axes.fill_between(curve.frequency, low, high, color=colour, alpha=0.2, linewidth=0)
            longest = max([0.5, *(float(c.frequency.max()) for c in facts.curves if c.frequency.size)])
            lowest = min([0.0, *(float(np.nanmin(c.value)) for c in facts.curves if c.value.size)])
            axes.axvline(0.5, color=SOFT, linewidth=0.8, linestyle=":")
            mtf = any(curve.kind == "mtf" for curve in facts.curves)
            axes.set(xlim=(0, longest * 1.02), ylim=(max(lowest, -0.3) - 0.02, 1.12), xlabel="cycles per pixel",
                     ylabel="modulation transfer" if mtf else "contrast transfer of bars")  # fmt: skip
            if facts.pixel_um is not None and mtf:
                scale = 1000.0 / facts.pixel_um
                top = axes.secondary_xaxis("top", functions=(lambda f: f * scale, lambda f: f / scale))
                top.set_xlabel("line pairs per mm")
            axes.legend(loc="upper right")
            return png(fig)

    def polar(self, facts: PatternFacts) -> bytes:
        """Frequencies at which the modulation falls to some levels, by direction."""
        with self._mpl.rc_context(STYLE):
            fig = self._mpl.figure.Figure(figsize=(_WIDTH, 4.2), layout="constrained")
            axes = fig.add_subplot(projection="polar")
            angles = np.array([curve.angle_deg for curve in facts.polar])
            for level, colour in zip(_LEVELS, _COLOURS):
                reach = np.array([_falls_to(curve, level) for curve in facts.polar])
                if not np.isfinite(reach).any():
                    continue
                turn = np.deg2rad(np.concatenate([angles, angles + 180.0, angles[:1]]))
                around = np.concatenate([reach, reach, reach[:1]])
                axes.plot(turn, around, "o-", color=colour, markersize=3, linewidth=1.2, label=f"modulation {level:g}")
            # Rows increase downwards: angles grow clockwise, as in the picture.
            axes.set_theta_direction(-1)
            axes.set_ylim(bottom=0.0)
            axes.tick_params(labelsize=8)
            fig.legend(loc="outside right upper")
            return png(fig)

    def picture(self, facts: PatternFacts) -> bytes:
        """The pattern and what was found in it."""
        assert facts.picture is not None
        rows, columns = facts.picture.shape
        with self._mpl.rc_context({**STYLE, "axes.grid": False}):
            fig, axes = axes_of(self._mpl, _WIDTH, float(np.clip((_WIDTH - 0.5) * rows / columns + 0.5, 1.4, 8.5)))
            low, high = np.nanquantile(facts.picture, [0.005, 0.995])
            axes.imshow(facts.picture, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
            for resolved, colour in ((True, GREEN), (False, RED)):
                some = [mark for mark in facts.marks if mark.resolved == resolved]
                if some:
                    name = "resolved" if resolved else "not resolved"
                    axes.plot([m.col for m in some], [m.row for m in some], "+", color=colour, markersize=7, label=name)
                for x, y, label, _ in some:
                    axes.annotate(label, (x, y), (3, 3), textcoords="offset points", fontsize=6.5, color=colour)
            for frame in facts.frames:
                place = (frame.col - 0.5, frame.row - 0.5)
                axes.add_patch(self._mpl.patches.Rectangle(place, frame.width, frame.height, fill=False, edgecolor=RED))
                box = {"boxstyle": "square,pad=0.2", "facecolor": RED, "edgecolor": "none"}
                axes.annotate(frame.label, place, (3, -3), textcoords="offset points", va="top", fontsize=8,
                              color="white", bbox=box)  # fmt: skip
            axes.set(xlabel="column px", ylabel="row px")
            if len({mark.resolved for mark in facts.marks}) > 1:
                fig.legend(loc="outside upper right", ncols=2, labelcolor=INK)
            return png(fig)


def _falls_to(curve: PolarCurve, level: float) -> float:
    below = np.flatnonzero(curve.value <= level)
    if below.size == 0 or below[0] == 0:
        return float("nan")
    i = int(below[0])
    high, low = curve.value[i - 1], curve.value[i]
    return float(curve.frequency[i - 1] + (high - level) / (high - low) * (curve.frequency[i] - curve.frequency[i - 1]))


def pattern_page(patterns: Sequence[PatternFacts], plots: PatternPlots) -> str:
    """The report as one HTML document."""
    parts = []
    for facts in patterns:
        found = [f"<p>{text(facts.summary)}</p>"]
        found.append(table(facts.head, [[row[0], *(Cell(value, True) for value in row[1:])] for row in facts.rows]))
        found += [f"<p>{text(note)}</p>" for note in facts.notes]
        if any(curve.frequency.size for curve in facts.curves):
            caption = "With two standard deviations; the dotted line is the Nyquist frequency."
            found.append(figure(plots.curves(facts), "Transfer", caption))
        if facts.polar:
            caption = "Frequency in cycles per pixel at which the modulation falls to a level, by its direction."
            found.append(figure(plots.polar(facts), "Transfer by direction", caption))
        if facts.picture is not None:
            found.append(figure(plots.picture(facts), "Pattern", "What was found, marked at its place."))
        parts.append(section(facts.title, found))
    kind = patterns[0].linearisation if patterns else ""
    return page("Test patterns", f"Modulation and contrast transfer of images; linearisation: {kind}", parts)
