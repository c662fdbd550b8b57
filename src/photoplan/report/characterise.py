"""Report of a camera's characterisation: figures, plots and tables of every analysis, and what could not be known."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.products.characterise.result import MOST_PIXELS, Chart, Figure, Findings, Plate, Trace, block_means
from photoplan.products.characterise.run import CharacteriseReport
from photoplan.report.drawing import BLUE, GREEN, ORANGE, PURPLE, RED, SKY, SOFT, axes_of, mpl, png, round_down, styled
from photoplan.report.page import Cell, figure, headline, page, section, table, text

Array = NDArray[np.float64]

COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)
_SIZE = (6.6, 3.6)
#: Letters that fit side by side in a legend, and those that the sign of a curve takes.
_LEGEND, _HANDLE = 84, 7


def _columns(labels: list[str]) -> int:
    """How many columns of a legend fit across a chart."""
    wide = [len(label) + _HANDLE for label in labels]
    return len(labels) if sum(wide) <= _LEGEND else max(1, min(4, len(labels), _LEGEND // max(wide)))


@styled
def draw_plot(plot: Chart | Plate) -> bytes:
    """A plot as PNG."""
    return _chart(plot) if isinstance(plot, Chart) else _picture(plot)


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


def _picture(picture: Plate) -> bytes:
    values = np.asarray(picture.values, np.float64)
    factor = max(1, -(-max(values.shape) // MOST_PIXELS))
    known = values[np.isfinite(values)]
    low, high = picture.limits or _limits(known)
    small = block_means(values, factor)
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
    """What a scale shows: nearly all values; where nearly all are equal, all."""
    if not known.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(known, [0.5, 99.5]))
    if high - low < 1e-9 * max(abs(high), 1.0):
        low, high = float(known.min()), float(known.max())
    return low, high if high > low else low + 1.0


#: Rows of a table that are shown; all of them are in CSV.
_ROWS = 25


def characterise_page(made: CharacteriseReport) -> str:
    """The report as one HTML document."""
    series = made.series
    done = [(run.analysis.title, run.outcome) for run in made.runs if run.outcome is not None]
    kinds = dict.fromkeys(frame.kind for frame in series.frames)
    frames = ", ".join(f"{len(series.of(kind))} {kind}" for kind in kinds) or f"{len(series.reduced)} reduced figures"
    size = [] if series.size is None else [f"{series.size[0]} × {series.size[1]} px, {series.dtype}"]
    refused = sum(len(outcome.refused) for _, outcome in done)
    head = headline(
        [
            (
                str(len(done)),
                "analysis" if len(done) == 1 else "analyses",
                ", ".join(title.lower() for title, _ in done),
            ),
            (str(sum(len(outcome.figures) for _, outcome in done)), "figures", f"{refused} refused, with the reason"),
            (
                ", ".join(dict.fromkeys(f"{level:.4g}" for level in made.levels)),
                "saturation DN",
                " · ".join([frames, *size]),
            ),
        ]
    )
    remarks = [f"<p>{text(note)}</p>" for note in made.notes]
    sections = [_section(title, outcome) for title, outcome in done]
    others = [[run.analysis.title, run.state, run.missing or run.failed or ""] for run in made.runs if not run.outcome]
    if others:
        sections.append(section("Not done", [table(("analysis", "state", "why"), others)]))
    title = f"Camera characterisation: {series.camera.name or series.path.stem}"
    return page(title, f"From the image series {series.path.name}", [head, *remarks, *sections])


def _section(title: str, outcome: Findings) -> str:
    found: list[str] = []
    if outcome.figures:
        found.append(
            table(
                ("figure", "of", "value", "standard deviation", "unit", "remark"),
                [_figure_row(f) for f in outcome.figures],
            )
        )
    found += [f"<p><b>Not known.</b> {text(f'{what}: {why}')}</p>" for what, why in outcome.refused.items()]
    found += [f"<p>{text(note)}</p>" for note in outcome.notes]
    found += [figure(draw_plot(plot), plot.title, plot.caption) for plot in outcome.plots]
    for name, each in outcome.tables.items():
        shown = [k for k in range(len(each.head)) if any(row[k] != "" for row in each.rows)]
        rows = [[_cell(row[k]) for k in shown] for row in each.rows[:_ROWS]]
        cut = f". The first {_ROWS} of {len(each.rows)} lines; all are in the CSV tables."
        more = cut if len(each.rows) > _ROWS else ""
        if rows:
            found += [f"<p>{text((each.caption or name) + more)}</p>", table([each.head[k] for k in shown], rows)]
    return section(title, found)


def _figure_row(found: Figure) -> list[Cell]:
    value, sigma, unit = found.texts
    where = " ".join(filter(None, [found.plane, found.at]))
    of_sigma = Cell(sigma and f"± {sigma}", True)
    return [Cell(found.label), Cell(where), Cell(value, True), of_sigma, Cell(unit), Cell(found.remark)]


def _cell(value: str | float | int) -> Cell:
    if isinstance(value, str):
        return Cell(value)
    return Cell(f"{value:.5g}" if value == value else "–", True)
