"""Drawing with matplotlib: style, sizes, letters."""

from __future__ import annotations

import importlib
import importlib.util
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
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
def draw_normalised(values: NDArray[np.float64], limit: float, what: str) -> bytes:
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
