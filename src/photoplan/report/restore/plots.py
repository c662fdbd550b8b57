"""Plots of a restoration: spread functions, MTF before and after, the field, details of images, ends of histograms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.report.drawing import BLUE, INK, ORANGE, SOFT, STYLE, png
from photoplan.report.restore.details import HistogramEnds

Array = NDArray[np.float64]

_WIDTH = 9.0
_COLOURS = (BLUE, ORANGE)
_NAMES = ("Z", "A", "B")
#: Values of a spread function that are drawn to each side.
_SPREAD = 6
#: Side of a drawn detail, pixels of the picture, so many that a page that makes it smaller leaves squares; resolution.
_DETAIL, _DPI = 960, 300


@dataclass(frozen=True, eq=False)
class AxisPicture:
    """Sharpness in one direction, before and after."""

    label: str
    spread: Array
    """Centre Z and the values A, B, … on one side."""
    frequency: Array
    """Cycles per pixel, up to 0.5."""
    modulation: Array
    """NaN where it is not known."""
    expected: Array
    """Modulation times the response of the filter."""


@dataclass(frozen=True, eq=False)
class FieldMap:
    """One value in each part of the field."""

    title: str
    values: Array
    """(rows, columns), NaN where it is not known."""
    digits: int


@dataclass(frozen=True, eq=False)
class RestorePlots:
    """Draws sharpness, maps of the field, details and histograms."""

    mpl: Any

    def sharpness(self, axes: Sequence[AxisPicture]) -> bytes:
        """Discrete spread functions as bars, and MTF curves with what they become."""
        with self.mpl.rc_context(STYLE):
            fig = self.mpl.figure.Figure(figsize=(_WIDTH, 3.4), layout="constrained")
            left, right = fig.subplots(1, 2, gridspec_kw={"width_ratios": [1.0, 1.25]})
            self._spreads(left, axes)
            self._curves(right, axes)
            return png(fig)

    def _spreads(self, axes: Any, pictures: Sequence[AxisPicture]) -> None:
        width = 0.8 / len(pictures)
        top = max(float(picture.spread.max()) for picture in pictures)
        for number, (picture, colour) in enumerate(zip(pictures, _COLOURS)):
            side = picture.spread[: _SPREAD + 1]
            at = np.arange(1 - side.size, side.size) + (number - (len(pictures) - 1) / 2) * width
            axes.bar(at, np.concatenate([side[:0:-1], side]), width, color=colour, label=picture.label)
        for place, name in enumerate(_NAMES[: pictures[0].spread.size]):
            values = " / ".join(f"{picture.spread[place]:.3f}" for picture in pictures)
            height = max(float(picture.spread[place]) for picture in pictures)
            axes.annotate(
                f"{name} {values}",
                (place, max(height, 0.0)),
                (0 if place == 0 else -6, 3),
                textcoords="offset points",
                ha="center" if place == 0 else "left",
                fontsize=7.5,
                color=INK,
            )
        axes.axhline(0.0, color=SOFT, linewidth=0.8)
        axes.set(xlabel="pixels from the middle", title="spread function: share of the light", ylim=(None, 1.3 * top))
        axes.xaxis.set_major_locator(self.mpl.ticker.MaxNLocator(integer=True))
        axes.legend(loc="upper left", fontsize=7.5)

    @staticmethod
    def _curves(axes: Any, pictures: Sequence[AxisPicture]) -> None:
        for picture, colour in zip(pictures, _COLOURS):
            axes.plot(picture.frequency, picture.modulation, color=colour, linewidth=1.4, label=picture.label)
            label = f"{picture.label}, expected after"
            axes.plot(picture.frequency, picture.expected, "--", color=colour, linewidth=1.6, label=label)
        axes.axhline(0.5, color=SOFT, linewidth=0.6, linestyle=":")
        axes.axhline(1.0, color=SOFT, linewidth=0.6, linestyle=":")
        top = max(1.0, *(float(np.nanmax(p.expected)) for p in pictures))
        axes.set(xlim=(0.0, 0.5), ylim=(0.0, top + 0.08), xlabel="frequency, cycles per pixel")
        axes.set_title("modulation transfer")
        axes.legend(loc="lower left", fontsize=7.5)

    def field(self, maps: Sequence[FieldMap]) -> bytes:
        """Values over the field side by side, each with a scale of its own."""
        with self.mpl.rc_context(STYLE):
            fig = self.mpl.figure.Figure(figsize=(3.1 * max(len(maps), 2), 2.7), layout="constrained")
            for axes, each in zip(fig.subplots(1, len(maps), squeeze=False)[0], maps):
                known = each.values[np.isfinite(each.values)]
                low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
                pad = max(0.05 * abs(high), 0.1 * (high - low))
                shown = axes.imshow(each.values, cmap="viridis", vmin=low - pad, vmax=high + pad, aspect="auto")
                if max(each.values.shape) <= 8:
                    for (row, column), value in np.ndenumerate(each.values):
                        known_here = bool(np.isfinite(value))
                        words = f"{value:.{each.digits}f}" if known_here else "–"
                        colour = "white" if known_here and value <= (low + high) / 2 else INK
                        axes.annotate(words, (column, row), ha="center", va="center", fontsize=8, color=colour)
                axes.set(xticks=[], yticks=[], title=each.title)
                axes.grid(False)
                fig.colorbar(shown, ax=axes, shrink=0.85)
            return png(fig)

    def details(self, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> bytes:
        """A detail before and after, enlarged by a whole factor.

        Parameters
        ----------
        before, after : ndarray, shape (height, width) or (height, width, 3)
        """
        height, width = before.shape[:2]
        factor = max(1, _DETAIL // max(height, width))
        wide, tall, gap, head = factor * width, factor * height, 48, 68
        total = 2 * wide + gap, tall + head
        with self.mpl.rc_context(STYLE):
            fig = self.mpl.figure.Figure(figsize=(total[0] / _DPI, total[1] / _DPI))
            for number, (name, picture) in enumerate((("as it was", before), ("restored", after))):
                place = number * (wide + gap) / total[0], 0.0, wide / total[0], tall / total[1]
                axes = fig.add_axes(place)
                axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="nearest", aspect="auto")
                axes.set_axis_off()
                axes.set_title(f" {name}", fontsize=9, color=INK)
            return png(fig, _DPI)

    def ends(self, picture: HistogramEnds) -> bytes:
        """How many pixels have the darkest and the brightest grey values, before and after."""
        with self.mpl.rc_context(STYLE):
            fig = self.mpl.figure.Figure(figsize=(_WIDTH, 2.6), layout="constrained")
            shares = np.concatenate([*picture.before, *picture.after])
            low = float(shares[shares > 0].min()) / 2 if (shares > 0).any() else 1e-3
            panels = fig.subplots(1, 2, sharey=True)
            for axes, name, edges, was, now in zip(
                panels, ("dark end", "bright end"), picture.edges, picture.before, picture.after
            ):
                axes.stairs(was, edges, baseline=low, fill=True, color="#c4ced5", label="as it was")
                axes.stairs(now, edges, baseline=low, color=BLUE, linewidth=1.5, label="restored")
                axes.set(yscale="log", title=name, xlabel="grey value", xlim=(edges[0], edges[-1]))
                axes.set_ylim(low, max(2.0 * float(shares.max()), 4.0 * low))
                axes.yaxis.set_major_formatter(self.mpl.ticker.FuncFormatter(lambda value, at: f"{value:g}"))
            panels[0].set_ylabel("share of the pixels, %")
            panels[1].legend(fontsize=7.5, loc="upper left")
            return png(fig)
