"""Plots of a restoration: spread functions, MTF before and after, the field, details of images, ends of histograms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.report.drawing import BLUE, INK, ORANGE, SOFT, figure_of, mpl, png, styled

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


@styled
def draw_sharpness(axes: Sequence[AxisPicture]) -> bytes:
    """Discrete spread functions as bars, and MTF curves with what they become."""
    fig = figure_of(_WIDTH, 3.4)
    left, right = fig.subplots(1, 2, gridspec_kw={"width_ratios": [1.0, 1.25]})
    _spreads(left, axes)
    _curves(right, axes)
    return png(fig)


def _spreads(axes: Any, pictures: Sequence[AxisPicture]) -> None:
    width = 0.8 / len(pictures)
    top = max(float(picture.spread.max()) for picture in pictures)
    for number, (picture, colour) in enumerate(zip(pictures, _COLOURS)):
        side = picture.spread[: _SPREAD + 1]
        at = np.arange(1 - side.size, side.size) + (number - (len(pictures) - 1) / 2) * width
        axes.bar(at, np.concatenate([side[:0:-1], side]), width, color=colour, label=picture.label)
    shares = [
        f"{name}  " + " / ".join(f"{picture.spread[place]:.3f}" for picture in pictures)
        for place, name in enumerate(_NAMES[: pictures[0].spread.size])
    ]
    # In a corner: beside the bars they would lie over each other.
    where = {"xycoords": "axes fraction", "ha": "right", "va": "top"}
    axes.annotate("\n".join(shares), (0.98, 0.97), fontsize=7.5, color=INK, **where)
    axes.axhline(0.0, color=SOFT, linewidth=0.8)
    axes.set(xlabel="pixels from the middle", title="spread function: share of the light", ylim=(None, 1.3 * top))
    axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(integer=True))
    axes.legend(loc="upper left", fontsize=7.5)


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


@styled
def draw_field(maps: Sequence[FieldMap]) -> bytes:
    """Values over the field side by side, each with a scale of its own."""
    fig = figure_of(3.1 * max(len(maps), 2), 2.7)
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


@styled
def draw_details(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> bytes:
    """A detail before and after, enlarged by a whole factor."""
    height, width = before.shape[:2]
    factor = max(1, _DETAIL // max(height, width))
    wide, tall, gap, head = factor * width, factor * height, 48, 68
    total = 2 * wide + gap, tall + head
    fig = mpl.figure.Figure(figsize=(total[0] / _DPI, total[1] / _DPI))
    for number, (name, picture) in enumerate((("as it was", before), ("restored", after))):
        place = number * (wide + gap) / total[0], 0.0, wide / total[0], tall / total[1]
        axes = fig.add_axes(place)
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="nearest", aspect="auto")
        axes.set_axis_off()
        axes.set_title(f" {name}", fontsize=9, color=INK)
    return png(fig, _DPI)


@styled
def draw_ends(picture: HistogramEnds) -> bytes:
    """How many pixels have the darkest and the brightest grey values, before and after."""
    fig = figure_of(_WIDTH, 2.6)
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
        axes.yaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, at: f"{value:g}"))
    panels[0].set_ylabel("share of the pixels, %")
    panels[1].legend(fontsize=7.5, loc="upper left")
    return png(fig)


#: Side of a detail, pixels; and places in each direction at which details are looked at.
SIDE = 160
_PLACES = 20
#: Grey values of a band that count for the histogram.
_VALUES = 1_000_000
_CLASSES = 16
_SHARE = 256
"""A class is this part of the range of grey values, at least one value."""


@dataclass(frozen=True, eq=False)
class HistogramEnds:
    """The dark and the bright end of a histogram."""

    edges: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Limits of the classes of grey values."""
    before: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Share of the pixels in each class, percent."""
    after: tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Compared:
    """A detail before and after, and the ends of the histograms."""

    window: Window
    before: NDArray[np.uint8]
    """(height, width) or (height, width, 3)."""
    after: NDArray[np.uint8]
    ends: HistogramEnds | None
    """None: no pixel is valid."""


def compare(before: RasterReader, after: RasterReader) -> Compared:
    """The detail of largest contrast and the ends of the histograms of an image and its restored copy.

    At most 20 × 20 windows of 160 × 160 pixels are read, spread over the image; all of it where it is small. Contrast
    is the root mean square difference of neighbouring pixels.
    """
    windows = _windows(before.size)
    step = max(1, round((len(windows) * min(SIDE, *before.size) ** 2 / _VALUES) ** 0.5))
    best, most = windows[0], -1.0
    values: list[tuple[NDArray[Any], NDArray[Any]]] = []
    for window in windows:
        (was, valid), (now, still) = before.read(window), after.read(window)
        known = np.ones(was.shape[1:], bool)
        for mask in (valid, still):
            known &= True if mask is None else mask
        contrast = _contrast(was, known)
        if contrast > most:
            best, most = window, contrast
        some = np.zeros_like(known)
        some[::step, ::step] = known[::step, ::step]
        values.append((was[:, some], now[:, some]))
    pair = [np.concatenate([v[k] for v in values], axis=1).ravel() for k in (0, 1)]
    ends = _ends(pair[0], pair[1], before.dtype) if pair[0].size else None
    return Compared(best, *_detail(before, after, best), ends)


def _windows(size: tuple[int, int]) -> list[Window]:
    """Windows spread over an image, the last ones at its edge."""
    side = [min(SIDE, length) for length in size]
    counts = [min(_PLACES, -(-length // SIDE)) for length in size]
    at = [
        [round(k * (length - s) / max(count - 1, 1)) for k in range(count)]
        for length, s, count in zip(size, side, counts)
    ]
    return [Window(col, row, *side) for row in at[1] for col in at[0]]


def _contrast(pixels: NDArray[Any], valid: NDArray[np.bool_]) -> float:
    grey = np.where(valid, pixels[:3].mean(0, dtype=np.float64), np.nan)
    squares = np.concatenate([(np.diff(grey, axis=axis) ** 2).ravel() for axis in (0, 1)])
    known = squares[np.isfinite(squares)]
    # Gaps count as even ground: a detail that is mostly invalid shows little.
    return float(known.sum() / squares.size) if squares.size else 0.0


def _detail(before: RasterReader, after: RasterReader, window: Window) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both as pictures, stretched alike; invalid pixels black."""
    read = [reader.read(window) for reader in (before, after)]
    known = read[0][0][:, read[0][1]] if read[0][1] is not None else read[0][0].reshape(before.bands, -1)
    known = known[np.isfinite(known)]
    low, high = (float(v) for v in np.quantile(known, [0.005, 0.995])) if known.size else (0.0, 1.0)
    pad = 0.1 * (high - low) or 1.0
    bands = slice(0, 3 if before.bands >= 3 else 1)
    pictures = []
    for pixels, valid in read:
        part = (np.nan_to_num(pixels[bands].astype(np.float64), nan=low) - low + pad) / (high - low + 2.0 * pad)
        shown = (255.0 * np.clip(part, 0.0, 1.0)).astype(np.uint8)
        if valid is not None:
            shown[:, ~valid] = 0
        pictures.append(np.moveaxis(shown, 0, -1) if shown.shape[0] == 3 else shown[0])
    return pictures[0], pictures[1]


def _ends(before: NDArray[Any], after: NDArray[Any], dtype: np.dtype[Any]) -> HistogramEnds | None:
    """Shares of the pixels in 16 classes at each end of the range: that of 8 bits, else what occurs."""
    before, after = (v[np.isfinite(v)].astype(np.float64) for v in (before, after))
    if before.size == 0 or after.size == 0:
        return None
    low = min(float(before.min()), float(after.min()))
    high = max(float(before.max()), float(after.max()))
    if dtype == np.uint8:
        low, high = min(low, 0.0), max(high, 255.0)
    if dtype.kind in "ui":
        low, high = np.floor(low) - 0.5, np.ceil(high) + 0.5
    elif high <= low:
        low, high = low - 0.5, low + 0.5
    width = (high - low) / _SHARE
    if dtype.kind in "ui":
        width = float(max(1, round(width)))
    steps = np.asarray(width * np.arange(_CLASSES + 1), np.float64)
    edges = low + steps, high - steps[::-1]
    was, now = (tuple(100.0 * np.histogram(v, e)[0] / v.size for e in edges) for v in (before, after))
    return HistogramEnds(edges, (was[0], was[1]), (now[0], now[1]))
