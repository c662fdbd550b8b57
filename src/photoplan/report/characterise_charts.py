"""Plots of a camera's characterisation as plain values, and how they are drawn.

An analysis describes its plots with these values; only drawing needs matplotlib.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.report.drawing import BLUE, GREEN, ORANGE, PURPLE, RED, SKY, SOFT, STYLE, load_matplotlib, png

COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)
_SIZE = (6.6, 3.6)
#: Letters that fit side by side in a legend, and those that the sign of a curve takes.
_LEGEND, _HANDLE = 84, 7
#: Side of a picture, pixels, to which larger ones are reduced.
_SIDE = 900


@dataclass(frozen=True, eq=False)
class Curve:
    """One series of a chart."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    label: str = ""
    style: Literal["points", "line", "line and points", "dashed", "steps"] = "points"
    sigma: NDArray[np.float64] | None = None
    """Standard deviation of y, drawn as bars."""
    colour: int | None = None
    """Number of a colour; None: the next."""


@dataclass(frozen=True, eq=False)
class Chart:
    """Curves over one axis."""

    title: str
    caption: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    log_x: bool = False
    log_y: bool = False
    marks: tuple[tuple[float, str], ...] = ()
    """Vertical lines: where, and what they mean."""


@dataclass(frozen=True, eq=False)
class Picture:
    """An image with a scale, and positions in it."""

    title: str
    caption: str
    values: NDArray[Any]
    """Shape (h, w)."""
    label: str
    """Of the scale."""
    points: tuple[tuple[float, float], ...] = ()
    """(x, y) in pixels of `values`; drawn as circles."""
    limits: tuple[float, float] | None = None
    """Of the scale; None: 0.5 % and 99.5 % of the values."""
    factor: int = 1
    """Side of the block of pixels of which each value is the mean, see `shrunk`; positions count whole pixels."""
    extent: tuple[float, float, float, float] | None = field(default=None)
    """Left, right, bottom, top of the axes where they are no pixels of `values`."""


def _columns(labels: list[str]) -> int:
    """How many columns of a legend fit across a chart."""
    wide = [len(label) + _HANDLE for label in labels]
    return len(labels) if sum(wide) <= _LEGEND else max(1, min(4, len(labels), _LEGEND // max(wide)))


class ChartDrawer:
    """Draws; made before any work, so that a missing library is known at once.

    Raises
    ------
    UsageError
        When made: matplotlib is not installed.
    """

    def __init__(self) -> None:
        self._mpl = load_matplotlib("a report", "leave `report` out")

    def draw(self, plot: Chart | Picture) -> bytes:
        """A plot as PNG."""
        with self._mpl.rc_context(STYLE):
            return self._chart(plot) if isinstance(plot, Chart) else self._picture(plot)

    def _chart(self, chart: Chart) -> bytes:
        fig = self._mpl.figure.Figure(figsize=_SIZE, layout="constrained")
        axes = fig.subplots()
        for k, curve in enumerate(chart.curves):
            _draw_curve(axes, curve, COLOURS[(k if curve.colour is None else curve.colour) % len(COLOURS)])
        for name, wanted in (("x", chart.log_x), ("y", chart.log_y)):
            if wanted:
                self._logarithmic(axes, name)
        for where, what in chart.marks:
            axes.axvline(where, color=SOFT, linewidth=0.9, linestyle=":")
            axes.annotate(what, (where, 0.98), (3, 0), xycoords=("data", "axes fraction"), textcoords="offset points",
                          fontsize=7.5, color=SOFT, va="top", rotation=90)  # fmt: skip
        axes.set(xlabel=chart.x_label, ylabel=chart.y_label)
        labelled = sum(bool(curve.label) for curve in chart.curves)
        if labelled > 1 or (labelled and len(chart.curves) > 1):
            fig.legend(
                loc="outside upper left",
                ncols=_columns([curve.label for curve in chart.curves if curve.label]),
                fontsize=8,
            )
        return png(fig)

    def _logarithmic(self, axes: Any, name: str) -> None:
        """A logarithmic axis with plain numbers; 2 and 5 are named too where it covers few decades."""
        getattr(axes, f"set_{name}scale")("log")
        low, high = getattr(axes, f"get_{name}lim")()
        axis = getattr(axes, f"{name}axis")
        steps = (1.0, 2.0, 5.0) if high < 400 * low else (1.0,)
        ticker = self._mpl.ticker
        axis.set_major_locator(ticker.LogLocator(base=10.0, subs=steps))
        axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(ticker.NullFormatter())

    def _picture(self, picture: Picture) -> bytes:
        values = np.asarray(picture.values, np.float64)
        factor = max(1, -(-max(values.shape) // _SIDE))
        known = values[np.isfinite(values)]
        low, high = picture.limits or _limits(known)
        small = _reduced(values, factor)
        height, width = values.shape[0] * picture.factor, values.shape[1] * picture.factor
        left, right, bottom, top = picture.extent or (-0.5, width - 0.5, height - 0.5, -0.5)
        tall = float(np.clip((_SIZE[0] - 1.6) * height / width, 1.2, 7.0)) if picture.extent is None else 3.6
        fig = self._mpl.figure.Figure(figsize=(_SIZE[0], tall + 0.6), layout="constrained")
        axes = fig.subplots()
        aspect = "equal" if picture.extent is None else "auto"
        options = {"cmap": "gray", "vmin": low, "vmax": high, "interpolation": "nearest"}
        shown = axes.imshow(small, extent=(left, right, bottom, top), aspect=aspect, **options)
        axes.grid(False)
        if picture.points:
            axes.scatter(*np.array(picture.points).T, s=40, facecolors="none", edgecolors=RED, linewidths=1.1)
        fig.colorbar(shown, ax=axes, label=picture.label, shrink=0.8)
        axes.set(xlabel="column px", ylabel="row px")
        return png(fig)


def shrunk(values: NDArray[Any]) -> tuple[NDArray[np.float64], int]:
    """An image as small as a picture of the report shows it anyway, and the side of the blocks it was averaged over."""
    image = np.asarray(values, np.float64)
    factor = max(1, -(-max(image.shape) // _SIDE))
    return np.array(_reduced(image, factor)), factor


def _draw_curve(axes: Any, curve: Curve, colour: str) -> None:
    x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
    options: dict[str, Any] = {"color": colour, "label": curve.label or None}
    if curve.style == "steps":
        axes.step(x, y, where="mid", linewidth=1.2, **options)
    elif curve.style == "dashed":
        axes.plot(x, y, linestyle="--", linewidth=1.1, **options)
    elif curve.style == "line":
        axes.plot(x, y, linewidth=1.4, **options)
    else:
        line = 1.2 if curve.style == "line and points" else 0
        axes.plot(x, y, linewidth=line, marker="o", markersize=3.6, **options)
    if curve.sigma is not None:
        axes.errorbar(x, y, yerr=curve.sigma, fmt="none", ecolor=colour, elinewidth=0.9, capsize=2)


def _limits(known: NDArray[np.float64]) -> tuple[float, float]:
    """What a scale shows: nearly all values; where nearly all are equal, all."""
    if not known.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(known, [0.5, 99.5]))
    if high - low < 1e-9 * max(abs(high), 1.0):
        low, high = float(known.min()), float(known.max())
    return low, high if high > low else low + 1.0


def _reduced(values: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    """Means of blocks, which a picture of the report's size would show anyway."""
    if factor == 1:
        return values
    height, width = values.shape[0] // factor * factor, values.shape[1] // factor * factor
    blocks = values[:height, :width].reshape(height // factor, factor, width // factor, factor)
    return np.asarray(blocks.mean(axis=(1, 3)))
