"""Pages of reports: HTML in one document, drawings by matplotlib, findings as tables and plots."""

from __future__ import annotations

import base64
import html
import importlib
import importlib.util
import io
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import wraps
from math import isfinite
from typing import Any, ParamSpec, TypeVar

import numpy as np

from photoplan.arrays import Floats
from photoplan.errors import UsageError
from photoplan.findings import Bars, Chart, Findings, Picture, Table, Trace, shrunk, spaced
from photoplan.findings import number as figures
from photoplan.products.view.content import Lettering, Letters

P = ParamSpec("P")
T = TypeVar("T")
#: Colours of Okabe and Ito.
BLUE, RED, ORANGE, GREEN, PURPLE, SKY = "#0072B2", "#D55E00", "#E69F00", "#009E73", "#CC79A7", "#56B4E9"
COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)
"""Colours of curves, in their order."""
INK, SOFT = "#1c2730", "#5c6b77"
STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.edgecolor": SOFT,
    "axes.labelcolor": INK,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e8eb",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "axes.unicode_minus": True,
    "text.parse_math": False,
}
_DPI = 150
#: Width of a plot over the whole page, inches.
_WIDE = 7.2
_PARTS = ("artist", "cm", "collections", "colors", "figure", "image", "lines", "patches", "path", "text", "ticker")


def has_matplotlib() -> bool:
    """Return whether it is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def load_matplotlib(what: str, otherwise: str = "") -> Any:
    """Import matplotlib with the parts that plots use; it is optional, and takes a second to import."""
    try:
        for part in _PARTS:
            importlib.import_module(f"matplotlib.{part}")
        return importlib.import_module("matplotlib")
    except ImportError:
        way_out = f", or {otherwise}" if otherwise else ""
        raise UsageError(
            f"{what} needs matplotlib; install it with: pip install 'photoplan[report]'{way_out}"
        ) from None


class _Matplotlib:
    """``matplotlib``, which is imported when the first thing of it is used."""

    def __getattr__(self, name: str) -> Any:
        return getattr(load_matplotlib("a picture"), name)


mpl: Any = _Matplotlib()


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """Return a drawing function that draws in the style of all plots."""

    @wraps(draw)
    def drawing(*args: P.args, **options: P.kwargs) -> T:
        with mpl.rc_context(STYLE):
            return draw(*args, **options)

    return drawing


def figure_of(width: float, height: float) -> Any:
    """A new figure of a size in inches."""
    return mpl.figure.Figure(figsize=(width, height), layout="constrained")


def axes_of(width: float, height: float) -> tuple[Any, Any]:
    """A new figure of a size in inches, and its only axes."""
    fig = figure_of(width, height)
    return fig, fig.subplots()


_KEPT: ContextVar[dict[bytes, Any] | None] = ContextVar("kept", default=None)


@contextmanager
def keeping() -> Iterator[dict[bytes, Any]]:
    """Keep figures as they are, for a PDF: `png` returns what stands for each."""
    kept: dict[bytes, Any] = {}
    token = _KEPT.set(kept)
    try:
        yield kept
    finally:
        _KEPT.reset(token)


def png(fig: Any, dpi: int = _DPI, **options: Any) -> bytes:
    """A figure as PNG, without the name of the program that drew it; options are those of matplotlib's ``savefig``."""
    if (kept := _KEPT.get()) is not None and not options:
        kept[key := b"figure %d" % len(kept)] = fig
        return key
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None}, **options)
    return buffer.getvalue()


def round_down(value: float, steps: Sequence[float] = (1.0, 2.0, 5.0)) -> float:
    """The largest of 1, 2, 5 (or other steps) times a power of ten that is not larger; 1e-12 at least."""
    value = max(value, 1e-12)
    power = 10.0 ** np.floor(np.log10(value))
    return float(round(max(f for f in steps if f <= value / power * (1 + 1e-9)) * power, 12))


def shortened(name: str, most: int = 14) -> str:
    """A name that fits into a picture: its end, since names of a block often begin alike."""
    return name if len(name) <= most else "…" + name[1 - most :]


@styled
def draw_normalised(values: Floats, limit: float, what: str) -> bytes:
    """Histogram of normalised residuals with the normal curve, on a linear and on a logarithmic scale.

    Beyond the limit, if it is not 0, they count as gross errors; what lies off the scale is in its last classes.
    """
    fig = figure_of(_WIDE, 2.9)
    panels = fig.subplots(1, 2)
    z = values[np.isfinite(values)]
    edge = max(5.0, limit + 0.5)
    bins = np.linspace(-edge, edge, 81 if len(z) > 2000 else 41)
    t = np.linspace(-edge, edge, 401)
    normal = np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi)
    for axes in panels:
        if len(z):
            weight = np.full(len(z), 1 / (len(z) * (bins[1] - bins[0])))
            axes.hist(np.clip(z, -edge, edge), bins=bins, weights=weight, color=SKY, label=what)
        axes.plot(t, normal, color=RED, linewidth=1.5, label="normal curve")
        for side in (-limit, limit) if limit else ():
            axes.axvline(side, color=SOFT, linestyle=":", linewidth=1.0)
        axes.set(xlim=(-edge, edge), xlabel="normalised residual")
    panels[0].set_ylabel("density")
    panels[0].legend(loc="upper right", fontsize=8)
    if len(z):
        said = f"mean {z.mean():+.2f}\nspread {z.std():.2f}"
        panels[0].text(0.02, 0.96, said, transform=panels[0].transAxes, va="top", fontsize=8)
    floor = 0.5 / max(1, len(z)) / (bins[1] - bins[0])
    panels[1].set_yscale("log")
    panels[1].yaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda v, _: f"{v:g}"))
    panels[1].yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    panels[1].set(ylim=(floor, 1.0), title="the same, logarithmic")
    return png(fig)


def lettering(size: float) -> Lettering:
    """Return what draws texts of a size in pixels, in the font of all plots."""
    load_matplotlib("a view with labels", "leave the labels out (label= of the lines)")
    fonts = importlib.import_module("matplotlib.ft2font")
    path = importlib.import_module("matplotlib.font_manager").findfont("DejaVu Sans")

    def draw(text: str) -> Letters:
        font = fonts.FT2Font(path)
        font.set_size(size, 72)
        font.set_text(text, 0.0)
        font.draw_glyphs_to_bitmap(antialiased=True)
        cover = np.asarray(font.get_image(), np.float32) / np.float32(255)
        return Letters(cover, cover.shape[0] - font.get_descent() / 64)

    return draw


_STYLE = """
:root { --ink: #1c2730; --soft: #5c6b77; --rule: #d7dee3; --accent: #0b5c8c; --ground: #f6f8f9; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 2.5rem 1.5rem 4rem; color: var(--ink); background: #fff;
  font: 15px/1.5 "Source Sans 3", "Segoe UI", "Helvetica Neue", Arial, sans-serif; }
header { border-bottom: 3px solid var(--accent); padding-bottom: .8rem; margin-bottom: 1.6rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.6rem 0 .8rem; padding-bottom: .25rem; border-bottom: 1px solid var(--rule); }
header p, figcaption, .more { color: var(--soft); }
header p { margin: 0; overflow-wrap: anywhere; }
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(17.5rem, 1fr)); gap: .8rem; margin: 0; }
.figures div { background: var(--ground); border-left: 3px solid var(--accent); padding: .7rem .9rem; }
.figures dd { margin: 0; font-size: 1.55rem; font-weight: 600; font-variant-numeric: tabular-nums; line-height: 1.2; }
.figures dt { font-weight: 600; font-size: .92rem; }
.figures div { display: flex; flex-direction: column; }
.figures dd:first-of-type { order: -1; }
.figures dd.more { font-size: .84rem; font-weight: 400; line-height: 1.35; margin: .1rem 0 0; }
figure { margin: 1.2rem 0 1.8rem; break-inside: avoid; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption { font-size: .88rem; max-width: 50rem; margin: .4rem auto 0; }
.scroll { overflow-x: auto; margin: .8rem 0 1.4rem; }
table { border-collapse: collapse; width: 100%; font-size: .88rem; }
th { text-align: left; color: var(--soft); font-weight: 600; border-bottom: 2px solid var(--rule); }
th, td { padding: .3rem .8rem .3rem 0; vertical-align: top; }
td { border-bottom: 1px solid var(--rule); overflow-wrap: anywhere; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  h2 { break-after: avoid; } tr { break-inside: avoid; } thead { display: table-header-group; }
  .scroll { overflow: visible; }
  .figures { grid-template-columns: repeat(3, 1fr); }
  .figures div, header { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
@page { size: A4; margin: 16mm 15mm; }
"""
#: No script, no address outside the document: pictures come with it.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str
    number: bool = False
    """Aligned to the right."""


def text(value: str) -> str:
    """A value as it may stand in HTML: escaped, and without characters that turn or hide the text around them."""
    kept = "".join(c if unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Co", "Cn") else "\ufffd" for c in value)
    return html.escape(kept, quote=True)


def page(title: str, subtitle: str, parts: Iterable[str]) -> str:
    """A whole document."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<header>\n<h1>{text(title)}</h1>\n<p>{text(subtitle)}</p>\n</header>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def section(title: str, parts: Iterable[str]) -> str:
    """A headed part of the document."""
    return f"<section>\n<h2>{text(title)}</h2>\n" + "\n".join(parts) + "\n</section>"


def headline(figures: Sequence[tuple[str, str, str]]) -> str:
    """Large figures: each its value, what it is, and a remark."""
    boxes = [
        f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd>"
        + (f'<dd class="more">{text(more)}</dd>' if more else "")
        + "</div>"
        for value, name, more in figures
    ]
    return '<dl class="figures">\n' + "\n".join(boxes) + "\n</dl>"


def figure(png: bytes, title: str, caption: str) -> str:
    """A picture with its caption."""
    data = base64.b64encode(png).decode("ascii")
    return (
        f'<figure><img alt="{text(title)}" src="data:image/png;base64,{data}">'
        f"<figcaption><b>{text(title)}.</b> {text(caption)}</figcaption></figure>"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str | Cell]]) -> str:
    """A table; a column is headed as its first cell is aligned."""
    if not rows:
        return ""
    first = [isinstance(cell, Cell) and cell.number for cell in rows[0]]
    heads = "".join(_cell("th", Cell(name, number)) for name, number in zip(head, first))
    body = "\n".join("<tr>" + "".join(_cell("td", cell) for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table>\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'


def cells(row: Sequence[str], words: int = 0) -> list[Cell]:
    """A row whose first columns are words and the others numbers."""
    return [Cell(value, number >= words) for number, value in enumerate(row)]


def number(value: float, digits: int) -> str:
    """A number with so many digits after the point; a dash for NaN and infinity."""
    return f"{value:.{digits}f}" if isfinite(value) else "–"


def _cell(tag: str, cell: str | Cell) -> str:
    value = cell if isinstance(cell, Cell) else Cell(cell)
    return f"<{tag}" + (' class="number">' if value.number else ">") + f"{text(value.text)}</{tag}>"


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


def _draw_vectors(axes: Any, x: Floats, y: Floats, curve: Trace, options: dict[str, Any]) -> None:
    """Lines from the points, by a round factor longer than they are, so that the longest is a tenth of the extent."""
    vectors = np.asarray(curve.vectors, float)
    largest = float(np.linalg.norm(vectors, axis=1).max()) or 1.0
    factor = round_down(0.1 * float(np.ptp(np.stack([x, y]))) / largest)
    gap = np.full(len(x), np.nan)
    ends = [np.column_stack([at, at + factor * v, gap]).ravel() for at, v in zip((x, y), vectors.T)]
    axes.plot(*ends, linewidth=1.4, **{**options, "label": f"{curve.label} × {factor:g}"})


def _limits(known: Floats) -> tuple[float, float]:
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
         "" if f.stated is None else figures(f.stated), f.remark)
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
