"""Findings in reports: estimates, what is not known, plots and tables."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.findings import Bars, Chart, Findings, Picture, Table, Trace, number, shrunk, spaced
from photoplan.report.drawing import BLUE, COLOURS, INK, RED, SOFT, axes_of, mpl, png, round_down, styled
from photoplan.report.page import Cell, figure, section, table, text

Array = NDArray[np.float64]

_SIZE = (6.6, 3.6)
#: Letters that fit side by side in a legend, and those that the sign of a curve takes.
_LEGEND, _HANDLE = 84, 7


def _columns(labels: list[str]) -> int:
    """Return the number of columns of a legend that fit across a chart."""
    wide = [len(label) + _HANDLE for label in labels]
    return len(labels) if sum(wide) <= _LEGEND else max(1, min(4, len(labels), _LEGEND // max(wide)))


@styled
def draw_plot(plot: Chart | Bars | Picture) -> bytes:
    """Draw a plot as PNG."""
    return _chart(plot) if isinstance(plot, Chart) else _bars(plot) if isinstance(plot, Bars) else _picture(plot)


def _bars(bars: Bars) -> bytes:
    values = list(bars.values.values())
    fig, axes = axes_of(_SIZE[0], 0.75 + 0.36 * len(values))
    axes.barh(list(bars.values), values, color=[BLUE] * (len(values) - 1) + [INK], height=0.62)
    for k, value in enumerate(values):
        label = f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"
        axes.annotate(label, (value, k), (4, 0), textcoords="offset points", va="center", fontsize=8.5)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set(xlim=(0, 1.14 * max(values)), xlabel=bars.label)
    return png(fig)


def _chart(chart: Chart) -> bytes:
    fig, axes = axes_of(*_SIZE)
    for k, curve in enumerate(chart.curves):
        _draw_curve(axes, curve, COLOURS[(k if curve.colour is None else curve.colour) % len(COLOURS)])
    for name, wanted in (("x", chart.log_x), ("y", chart.log_y)):
        if wanted:
            _logarithmic(axes, name)
    for where, what in chart.marks:
        axes.axvline(where, color=SOFT, linewidth=0.9, linestyle=":")
        axes.annotate(what, (where, 0.98), (3, 0), xycoords=("data", "axes fraction"), textcoords="offset points",
                      fontsize=7.5, color=SOFT, va="top", rotation=90)  # fmt: skip
    axes.set(xlabel=chart.x_label, ylabel=chart.y_label)
    labelled = sum(bool(curve.label) for curve in chart.curves)
    if labelled > 1 or (labelled and len(chart.curves) > 1):
        fig.legend(
            loc="outside upper left", ncols=_columns([curve.label for curve in chart.curves if curve.label]), fontsize=8
        )
    return png(fig)


def _logarithmic(axes: Any, name: str) -> None:
    """A logarithmic axis with plain numbers; 2 and 5 are named too where it covers few decades."""
    getattr(axes, f"set_{name}scale")("log")
    low, high = getattr(axes, f"get_{name}lim")()
    axis = getattr(axes, f"{name}axis")
    steps = (1.0, 2.0, 5.0) if high < 400 * low else (1.0,)
    ticker = mpl.ticker
    axis.set_major_locator(ticker.LogLocator(base=10.0, subs=steps))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())


def _picture(picture: Picture) -> bytes:
    values = np.asarray(picture.values, np.float64)
    known = values[np.isfinite(values)]
    low, high = picture.limits or _limits(known)
    small, _ = shrunk(values)
    height, width = values.shape[0] * picture.factor, values.shape[1] * picture.factor
    left, right, bottom, top = picture.extent or (-0.5, width - 0.5, height - 0.5, -0.5)
    tall = float(np.clip((_SIZE[0] - 1.6) * height / width, 1.2, 7.0)) if picture.extent is None else 3.6
    fig, axes = axes_of(_SIZE[0], tall + 0.6)
    aspect = "equal" if picture.extent is None else "auto"
    options = {"cmap": "gray", "vmin": low, "vmax": high, "interpolation": "nearest"}
    shown = axes.imshow(small, extent=(left, right, bottom, top), aspect=aspect, **options)
    axes.grid(False)
    if picture.points:
        axes.scatter(*np.array(picture.points).T, s=40, facecolors="none", edgecolors=RED, linewidths=1.1)
    fig.colorbar(shown, ax=axes, label=picture.label, shrink=0.8)
    axes.set(xlabel="column px", ylabel="row px")
    return png(fig)


def _draw_curve(axes: Any, curve: Trace, colour: str) -> None:
    x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
    options: dict[str, Any] = {"color": colour, "label": curve.label or None}
    if curve.vectors is not None:
        _draw_vectors(axes, x, y, curve, options)
    elif curve.style == "steps":
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


def _draw_vectors(axes: Any, x: Array, y: Array, curve: Trace, options: dict[str, Any]) -> None:
    """Lines from the points, by a round factor longer than they are, so that the longest is a tenth of the extent."""
    vectors = np.asarray(curve.vectors, float)
    largest = float(np.linalg.norm(vectors, axis=1).max()) or 1.0
    factor = round_down(0.1 * float(np.ptp(np.stack([x, y]))) / largest)
    gap = np.full(len(x), np.nan)
    ends = [np.column_stack([at, at + factor * v, gap]).ravel() for at, v in zip((x, y), vectors.T)]
    axes.plot(*ends, linewidth=1.4, **{**options, "label": f"{curve.label} × {factor:g}"})


def _limits(known: NDArray[np.float64]) -> tuple[float, float]:
    """Return the limits of a scale: of nearly all values, or of all if nearly all are equal."""
    if not known.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(known, [0.5, 99.5]))
    if high - low < 1e-9 * max(abs(high), 1.0):
        low, high = float(known.min()), float(known.max())
    return low, high if high > low else low + 1.0


#: Rows of a table that are shown; all of them are in CSV.
_ROWS = 25


def findings_section(found: Findings, most: int = _ROWS) -> str:
    """Return a section with all that was found, and so many lines of each table."""
    heads = ("figure", "of", "value", "standard deviation", "unit", "stated elsewhere", "remark")
    rows = [
        (f.label, spaced(f.plane, f.at), *f.texts, f.unit,
         "" if f.stated is None else number(f.stated), f.remark)
        for f in found.figures
    ]  # fmt: skip
    parts = [findings_table(Table(heads, tuple(rows)))]
    parts += [f"<p><b>Not known.</b> {text(f'{what}: {why}')}</p>" for what, why in found.refused.items()]
    parts += [f"<p>{text(note)}</p>" for note in found.notes]
    parts += [figure(draw_plot(plot), plot.title, plot.caption) for plot in found.plots]
    for name, each in found.tables.items():
        cut = f". The first {most} of {len(each.rows)} lines; all are in the CSV tables."
        more = cut if len(each.rows) > most else ""
        parts += [f"<p>{text((each.caption or name) + more)}</p>", findings_table(each, most)] if each.rows else []
    return section(found.title, parts)


def findings_table(found: Table, most: int | None = None) -> str:
    """Return a table; cells that begin as numbers stand at the right."""
    head, *rows = found.texts()
    return table(head, [[Cell(cell, cell[:1] in tuple("0123456789+-−–±")) for cell in row] for row in rows[:most]])
