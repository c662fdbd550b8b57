"""Reports of radiometry: restoration, colour balance, illumination."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.arrays import Floats, Mask
from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.products.balance import BalanceReport
from photoplan.products.describe import FileFacts, place_of
from photoplan.products.illumination import IlluminationReport
from photoplan.products.measured_filter import DesignedPart, MeasuredFilter, model_figures
from photoplan.products.restore import FoundFilter, Job, RestoredImage, RestoreReport
from photoplan.project.align import AlignStep
from photoplan.project.steps import FallOffStep, fall_off_line, load_filter, restoration_of
from photoplan.quality.colour import ChromaticModel
from photoplan.quality.curves import MtfCurve
from photoplan.quality.restoration.design import Sharpness
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter
from photoplan.radiometry.balance import Balanced, Pairs
from photoplan.radiometry.equations import SIDE
from photoplan.report.page import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    RED,
    SOFT,
    Cell,
    cells,
    figure,
    figure_of,
    headline,
    mpl,
    page,
    png,
    section,
    styled,
    table,
    text,
)

#: Kernels that are drawn; of more, the first ones are.
MOST_DRAWN = 12
_DIRECTIONS = (("row", BLUE, "-"), ("column", ORANGE, "--"), ("diagonal", GREEN, ":"))


def frequency_response(values: Floats, frequency: Floats, direction: tuple[float, float]) -> Floats:
    """Factor by which a kernel changes the amplitude of waves."""
    m, n = (side // 2 for side in values.shape)
    rows, columns = np.mgrid[-m : m + 1, -n : n + 1]
    along = (direction[0] * columns + direction[1] * rows).ravel()
    return np.asarray(np.abs(np.exp(-2j * np.pi * np.multiply.outer(frequency, along)) @ values.ravel()))


@styled
def draw_kernels(title: str, kernels: Sequence[tuple[str, Floats]]) -> bytes:
    """PNG with a row of three panels for each kernel, given by name and values (2 m + 1, 2 n + 1)."""
    drawn = list(kernels[:MOST_DRAWN])
    height = 3.0 * len(drawn) + 0.7
    fig = figure_of(11.0, height)
    more = f" (the first {MOST_DRAWN} of {len(kernels)} kernels)" if len(kernels) > MOST_DRAWN else ""
    fig.suptitle(title + more, x=0.01, ha="left", fontsize=11, color=INK)
    rows = fig.subplots(len(drawn), 3, squeeze=False, gridspec_kw={"width_ratios": [1.0, 1.3, 1.3]})
    for panels, (name, values) in zip(rows, drawn):
        panels[0].set_title(name)
        _weights(panels[0], values)
        _sections(panels[1], values)
        _response(panels[2], values)
    return png(fig)


def _weights(axes: Any, values: Floats) -> None:
    """Heat map; the colour is that of the root, since the middle is far larger than all others."""
    m, n = (side // 2 for side in values.shape)
    rooted = np.sign(values) * np.sqrt(np.abs(values))
    most = float(np.abs(rooted).max()) or 1.0
    box = (-n - 0.5, n + 0.5, m + 0.5, -m - 0.5)
    axes.imshow(rooted, cmap="RdBu_r", vmin=-most, vmax=most, extent=box, interpolation="nearest")
    axes.grid(visible=False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(integer=True))
    axes.set_xlabel("columns (colour: root of the weight)")
    axes.set_ylabel("rows")
    if values.size <= 49:
        for (i, k), value in np.ndenumerate(values):
            strong = abs(rooted[i, k]) > 0.6 * most
            axes.text(
                k - n, i - m, f"{value:.2g}", ha="center", va="center", fontsize=6, color="white" if strong else INK
            )


def _sections(axes: Any, values: Floats) -> None:
    """Middle row, middle column, and sums."""
    m, n = (side // 2 for side in values.shape)
    axes.axhline(0.0, color=SOFT, linewidth=0.8)
    axes.plot(np.arange(-n, n + 1), values[m], "o-", color=BLUE, markersize=3.5, linewidth=1.2, label="middle row")
    axes.plot(
        np.arange(-m, m + 1), values[:, n], "s--", color=ORANGE, markersize=3, linewidth=1.2, label="middle column"
    )
    axes.plot(np.arange(-n, n + 1), values.sum(0), "^:", color=GREEN, markersize=3, linewidth=1.2, label="column sums")
    axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(integer=True))
    axes.set_title(f"sections; sum {values.sum():.4g}")
    axes.set_xlabel("pixels from the middle")
    axes.legend(fontsize=7.5)


def _response(axes: Any, values: Floats) -> None:
    """Up to the Nyquist frequency along rows and columns."""
    frequency = np.linspace(0.0, 0.5, 101)
    for (name, colour, line), direction in zip(_DIRECTIONS, ((1.0, 0.0), (0.0, 1.0), (0.5**0.5, 0.5**0.5))):
        response = frequency_response(values, frequency, direction)
        axes.plot(frequency, response, line, color=colour, linewidth=1.6, label=f"along a {name}")
    axes.set_xlim(0.0, 0.5)
    axes.set_ylim(bottom=0.0)
    gain = float(np.sqrt((values**2).sum()))
    axes.set_title(f"frequency response |R|; noise grows {gain:.3g} times")
    axes.set_xlabel("cycles per pixel")
    axes.legend(fontsize=7.5)


def draw_filter(facts: FileFacts) -> bytes:
    """Draw the kernels of a filter file."""
    used = load_filter(facts.file)
    kernels = [(place_of(kernel), kernel.values) for kernel in used.kernels]
    return draw_kernels(used.description or facts.file.name, kernels)


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
    spread: Floats
    """Centre Z and the values A, B, … on one side."""
    frequency: Floats
    """Cycles per pixel, up to 0.5."""
    modulation: Floats
    """NaN where it is not known."""
    expected: Floats
    """Modulation times the response of the filter."""


@dataclass(frozen=True, eq=False)
class FieldMap:
    """One value in each part of the field."""

    title: str
    values: Floats
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
    """Numbers of pixels with the darkest and the brightest grey values, before and after."""
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
WINDOW_SIDE = 160
_PLACES = 20
#: Grey values of a band that count for the histogram.
_VALUES = 1_000_000
_CLASSES = 16
_SHARE = 256
"""A class is this part of the range of grey values, at least one value."""


@dataclass(frozen=True, eq=False)
class HistogramEnds:
    """The dark and the bright end of a histogram."""

    edges: tuple[Floats, Floats]
    """Limits of the classes of grey values."""
    before: tuple[Floats, Floats]
    """Share of the pixels in each class, percent."""
    after: tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class Compared:
    """A detail before and after, and the ends of the histograms."""

    window: Window
    before: NDArray[np.uint8]
    """(height, width) or (height, width, 3)."""
    after: NDArray[np.uint8]
    ends: HistogramEnds | None
    """None if no pixel is valid."""


def compare(before: RasterReader, after: RasterReader) -> Compared:
    """The detail of largest contrast and the ends of the histograms of an image and its restored copy.

    At most 20 × 20 windows of 160 × 160 pixels are read, spread over the image; all of it where it is small. Contrast
    is the root mean square difference of neighbouring pixels.
    """
    windows = _windows(before.size)
    step = max(1, round((len(windows) * min(WINDOW_SIDE, *before.size) ** 2 / _VALUES) ** 0.5))
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
    side = [min(WINDOW_SIDE, length) for length in size]
    counts = [min(_PLACES, -(-length // WINDOW_SIDE)) for length in size]
    at = [
        [round(k * (length - s) / max(count - 1, 1)) for k in range(count)]
        for length, s, count in zip(size, side, counts)
    ]
    return [Window(col, row, *side) for row in at[1] for col in at[0]]


def _contrast(pixels: NDArray[Any], valid: Mask) -> float:
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


#: Images that get pictures, and parts of the field that are listed.
_PICTURED = 30
_LISTED = 300
_PART_HEAD = ("part", "edges", "method", "along", "Z", "A", "B", "A/Z", "singular values", "least transfer", "MTF50",
              "expected", "noise ×")  # fmt: skip
#: Marks a direction without edges enough.
_STANDS_FOR = " †"
_BAND_HEAD = ("band", "below", "above", "clipped")
_CHROMATIC_HEAD = ("band", "kind", "shift x px", "shift y px", "corners px", "residual px", "used", "left out")
_FREQUENCY = np.linspace(0.0, 0.5, 101)
_AXES = (("x", "rows", (1.0, 0.0)), ("y", "columns", (0.0, 1.0)))
#: Bands whose field is drawn.
_BANDS = 6


def restore_page(made: RestoreReport) -> str | None:
    """Return the report as one HTML document, if an image was restored; images are opened again for details."""
    if not made.images:
        return None
    by_path = {job.target: job for job in made.jobs}
    parts = [section("The filter", _filter(made.found))]
    for k, image in enumerate(made.images):
        parts.append(section(image.image, _image(image, by_path[image.path], k < _PICTURED)))
    if made.failed:
        rows = [[Cell(name), Cell(reason)] for name, reason in made.failed.items()]
        parts.append(section("Images without result", [table(("image", "reason"), rows)]))
    title = made.images[0].image if len(made.images) == 1 else f"{len(made.images)} images"
    return page(f"Restoration: {title}", "Images restored by a filter: where it comes from and what it did", parts)


def _filter(found: FoundFilter) -> list[str]:
    used, measured = found.filter, found.measured
    columns, rows = used.margin
    figures = [
        (f"{used.noise_gain:.3g} ×", "growth of noise", "the largest of all kernels" if len(used.kernels) > 1 else ""),
        (f"{2 * columns + 1} × {2 * rows + 1}", "pixels that the filter reaches", _count(len(used.kernels), "kernel")),
    ]
    figures += [] if measured is None else _measured_figures(measured)
    parts = [headline(figures), f"<p>{text(origin(found))}</p>"]
    parts += [] if measured is None else _measured_parts(measured)
    if measured is None and used.facts:
        parts.append(table(("entry of the filter", "value"), [cells(fact, 2) for fact in plain_facts(used)]))
    caption = "Weights, sections through the middle, and by what factor the filter changes the amplitude of waves."
    picture = draw_kernels(used.description or "restoration filter", distinct_kernels(used))
    parts.append(figure(picture, "Restoration filter", caption))
    for name, maps in field_maps(used, measured):
        caption = "In each part of the field. A dash: too few edges; whole field or other direction stand for it."
        parts.append(figure(draw_field(maps), f"Over the field, {name}", caption))
    return parts


def _measured_parts(measured: MeasuredFilter) -> list[str]:
    """Notes, rules, sharpness and table of the parts of bands and field."""
    drawn = distinct_parts(measured.parts)
    parts = [f"<p><b>Mind:</b> {text(note)}.</p>" for note in measured.notes]
    rules = list(dict.fromkeys(part.design.reason for part in drawn))
    for rule in rules:
        names = [part_name(part) for part in drawn if part.design.reason == rule]
        where = f"{'; '.join(names[:4])}{' …' if len(names) > 4 else ''}: " if len(rules) > 1 else ""
        parts.append(f"<p>Rule: {text(where + rule)}.</p>")
    for part in drawn[:MOST_DRAWN]:
        caption = (
            "Left: the share of an object pixel's light that falls on the pixels beside it (Kölbl's Z, A, B; rows / "
            "columns). Right: modulation transfer, and the curve that is expected after restoration, |MTF × response "
            "of the filter|. An exact inverse restores objects of whole pixels, which lifts the curve above 1."
        )
        parts.append(figure(draw_sharpness(axis_pictures(part)), f"Sharpness, {part_name(part)}", caption))
    rows = [row for part in drawn for row in part_rows(part)]
    parts.append(table(_PART_HEAD, [cells(row, 1) for row in rows[:_LISTED]]))
    if any(_STANDS_FOR in row[3] for row in rows[:_LISTED]):
        parts.append(f"<p>{_STANDS_FOR.strip()} too few edges; the other direction stands for this one.</p>")
    if len(rows) > _LISTED:
        parts.append(f"<p>{len(rows) - _LISTED} more rows; the filter file has them all.</p>")
    return parts


def _image(image: RestoredImage, job: Job, drawn: bool) -> list[str]:
    size, aligned = job.reader.size, job.reader.step(AlignStep)
    clipped = sum(image.below) + sum(image.above)
    figures = [
        (f"{size[0]} × {size[1]}", "pixels", f"{len(image.below)} band(s) of {image.dtype}"),
        (f"{100 * image.clipped_share:.3g} %", "clipped", f"{clipped} values beyond what the type holds"),
        (f"{100 * image.valid_share:.4g} %", "valid pixels", ""),
        (f"{image.noise_gain:.3g} ×", "growth of noise", "the largest of all kernels"),
    ]
    parts = [headline(figures)]
    lit = job.reader.step(FallOffStep)
    light = restoration_of(job.reader).restorer.linearisation.describe()
    parts.append(f"<p>{text(f'The result is {image.path.name}; light: {light}.')}</p>")
    if lit is not None:
        parts.append(f"<p>{text(f'Before the filter: {fall_off_line(lit.fall_off)}.')}</p>")
    if drawn:
        seen = compare(RasterReader(job.reader.info.path), RasterReader(image.path))
        window = seen.window
        place = f"Columns {window.col} to {window.stop[0] - 1}, rows {window.row} to {window.stop[1] - 1}"
        caption = f"{place}, where contrast is largest. Both have the same scale of grey values."
        parts.append(figure(draw_details(seen.before, seen.after), f"A detail of {image.image}", caption))
        if seen.ends is not None:
            caption = "Grey values near the ends, all bands. The last class holds what was clipped."
            parts.append(figure(draw_ends(seen.ends), "Ends of the histogram", caption))
    parts.append(table(_BAND_HEAD, [cells(row, 1) for row in _band_rows(image)]))
    if aligned is not None:
        parts.append("<p>Lateral chromatic aberration, corrected before the filter:</p>")
        parts.append(table(_CHROMATIC_HEAD, [cells(row, 2) for row in _chromatic_rows(aligned.model)]))
    return parts


def _count(number: int, name: str) -> str:
    return f"{number} {name}{'' if number == 1 else 's'}"


def _measured_figures(measured: MeasuredFilter) -> list[tuple[str, str, str]]:
    first = measured.parts[0]
    before = [one.modulation().mtf50 for one in first.sharpness]
    after = [_expected_mtf50(one, first.design.kernel, axis[2]) for one, axis in zip(first.sharpness, _AXES)]
    return [
        (_pair(before), "MTF50 along rows / columns", "cycles per pixel" + ("" if first.at is None else _at(first))),
        (_pair(after), "expected after restoration", "cycles per pixel; above 0.5 is beyond the Nyquist frequency"),
        (
            str(sum(part.edges for part in measured.parts)),
            "edges",
            f"in {_count(len(measured.mtf.images), 'image')}"
            + (f", {_count(len(measured.parts), 'part')} of bands and field" if len(measured.parts) > 1 else ""),
        ),
    ]


def _at(part: DesignedPart) -> str:
    return f", {part_name(part)}"


def _pair(values: Sequence[float]) -> str:
    return " / ".join(f"{v:.3f}" if isfinite(v) else "> 0.5" for v in values)


def origin(found: FoundFilter) -> str:
    """Return the origin of the filter in a sentence."""
    if found.measured is None:
        return f"The filter comes from {found.origin}." if found.origin else "There is no filter."
    names = [image.name for image in found.measured.mtf.images]
    listed = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"The filter was measured at edges of {listed}. Linearisation: {found.measured.mtf.linearisation}."


def distinct_parts(parts: Sequence[DesignedPart]) -> list[DesignedPart]:
    """Parts with edges of their own, and of each band one that stands for those without."""
    seen: set[int | None] = set()
    kept = []
    for part in parts:
        if part.edges == 0 and part.band in seen:
            continue
        if part.edges == 0:
            seen.add(part.band)
        kept.append(part)
    return kept


def part_name(part: DesignedPart) -> str:
    """Band and place of a part."""
    band = "all bands" if part.band is None else f"band {part.band}"
    if part.at is None:
        return band
    if part.edges == 0:
        return "whole field" if part.band is None else f"{band}, whole field"
    return f"{'' if part.band is None else f'{band} '}at {part.at[0]:.0f}, {part.at[1]:.0f}"


def _expected_mtf50(sharpness: Sharpness, kernel: np.ndarray, direction: tuple[float, float]) -> float:
    return MtfCurve(_FREQUENCY, _expected(sharpness.modulation(), kernel, direction)).mtf50


def _expected(curve: MtfCurve, kernel: np.ndarray, direction: tuple[float, float]) -> np.ndarray:
    """Modulation after restoration, |MTF × response of the filter|, at `_FREQUENCY`."""
    return np.asarray(_modulation(curve) * frequency_response(kernel, _FREQUENCY, direction))


def _modulation(curve: MtfCurve) -> np.ndarray:
    return np.interp(_FREQUENCY, curve.frequency, curve.modulation, right=np.nan)


def axis_pictures(part: DesignedPart) -> tuple[AxisPicture, ...]:
    """Sharpness along rows and columns, before and as expected after."""
    pictures = []
    for sharpness, (axis, name, direction) in zip(part.sharpness, _AXES):
        curve = sharpness.modulation()
        label = f"along {name}" + (" (by the others)" if axis in part.missing else "")
        pictures.append(
            AxisPicture(
                label=label,
                spread=sharpness.spread.side(),
                frequency=_FREQUENCY,
                modulation=_modulation(curve),
                expected=_expected(curve, part.design.kernel, direction),
            )
        )
    return tuple(pictures)


def part_rows(part: DesignedPart) -> list[tuple[str, ...]]:
    """Two rows of the table of parts: along rows and along columns."""
    rows = []
    conditions = (part.design.condition_x, part.design.condition_y)
    for sharpness, condition, (axis, name, direction) in zip(part.sharpness, conditions, _AXES):
        side = [f"{v:.3f}" for v in sharpness.spread.side()[:3]] + ["–", "–"]
        rows.append(
            (
                part_name(part),
                str(part.edges or "–"),
                part.design.method,
                name + (_STANDS_FOR if axis in part.missing else ""),
                *side[:3],
                f"{condition.neighbour_ratio:.3f}",
                f"{condition.smallest_singular:.3f} – {condition.largest_singular:.3f}",
                f"{condition.least_transfer:.3f} at {condition.at_frequency:.2f}",
                _pair([sharpness.modulation().mtf50]),
                _pair([_expected_mtf50(sharpness, part.design.kernel, direction)]),
                f"{part.design.noise_gain:.2f}",
            )
        )
    return rows


def plain_facts(used: RestorationFilter) -> list[tuple[str, str]]:
    """Return what the file of a filter states of its making."""
    facts = []
    for name, value in used.facts.items():
        listed = isinstance(value, list | tuple) and any(isinstance(v, dict) for v in value)
        facts.append((str(name), f"{len(value)}, see the file" if listed else str(value)))  # type: ignore[arg-type]
    return facts


def distinct_kernels(used: RestorationFilter) -> list[tuple[str, np.ndarray]]:
    """Kernels that differ, each named by its first place."""
    groups: dict[tuple[int | None, bytes], list[FilterKernel]] = {}
    for kernel in used.kernels:
        groups.setdefault((kernel.band, kernel.values.tobytes()), []).append(kernel)
    pictures = []
    for (band, _), kernels in groups.items():
        name = "all bands" if band is None else f"band {band}"
        at = kernels[0].at
        if at is not None:
            more = f" and {len(kernels) - 1} more" if len(kernels) > 1 else ""
            name = f"{'' if band is None else f'{name} '}at {at[0]:.0f}, {at[1]:.0f}{more}"
        pictures.append((name, kernels[0].values))
    return pictures


def field_maps(used: RestorationFilter, measured: MeasuredFilter | None) -> list[tuple[str, tuple[FieldMap, ...]]]:
    """Noise gain and MTF50 over the field of each band, where the places are a grid."""
    found = []
    for band in list(dict.fromkeys(kernel.band for kernel in used.kernels))[:_BANDS]:
        gains = {k.at: k.noise_gain for k in used.kernels if k.band == band and k.at is not None}
        columns, rows = (sorted({at[axis] for at in gains}) for axis in (0, 1))
        if len(gains) < 2 or len(gains) != len(columns) * len(rows):
            continue
        maps = [FieldMap("noise grows, times", np.array([[gains[x, y] for x in columns] for y in rows]), 2)]
        parts = {} if measured is None else {p.at: p for p in measured.parts if p.band == band and p.edges}
        for number, (axis, name, _) in enumerate(_AXES if parts else ()):
            values = np.full((len(rows), len(columns)), np.nan)
            for at, part in parts.items():
                assert at is not None
                if axis in part.missing:
                    continue
                values[rows.index(at[1]), columns.index(at[0])] = part.sharpness[number].modulation().mtf50
            maps.append(FieldMap(f"MTF50 along {name}", values, 3))
        found.append(("all bands" if band is None else f"band {band}", tuple(maps)))
    return found


def _band_rows(image: RestoredImage) -> list[tuple[str, ...]]:
    """Clipped pixels of each band."""
    valid = image.valid_share * image.pixels
    return [
        (str(band), str(below), str(above), f"{100 * (below + above) / valid:.3g} %" if valid else "–")
        for band, (below, above) in enumerate(zip(image.below, image.above), start=1)
    ]


def _chromatic_rows(model: ChromaticModel) -> list[tuple[str, ...]]:
    return [
        (
            f"{band['band']} against {model.reference}",
            str(band["kind"]),
            f"{band['shift'][0]:+.3f}",
            f"{band['shift'][1]:+.3f}",
            f"{band['corner']:+.3f}",
            "–" if band["residual"] is None else f"{band['residual']:.3f}",
            str(band["count"] - band["rejected"]),
            str(band["rejected"]),
        )
        for band in model_figures(model)["bands"]
    ]


_BAND_COLOURS = (RED, GREEN, BLUE, ORANGE)
#: Pairs and images that are shown.
_PAIRS, _TRENDS = 30, 4
#: Points of a trend along the longer side of an image.
_SIDE = 60
#: Points of light on slopes that are drawn, and classes of cos i of which the mean is.
_POINTS, _LIGHT_CLASSES = 4000, 20


@styled
def draw_balance(report: BalanceReport) -> bytes:
    """Overlaps, tables, maps and trends, as PNG."""
    pairs, found = report.pairs, report.balanced
    assert pairs is not None and found is not None
    shown = np.argsort(-pairs.before.mean(axis=1))[:_PAIRS]
    images = _spread(found)
    trends = bool(images) and bool(found.tones[0][0].terms)
    bands = min(len(found.tones[0]), len(_BAND_COLOURS))
    heights = [1.1 + 0.2 * len(shown), 3.0, 3.6, *([2.6] if trends else [])]
    fig = figure_of(10.0, sum(heights) + 0.6)
    rows = fig.add_gridspec(len(heights), 1, height_ratios=heights)
    _overlaps(fig.add_subplot(rows[0]), report, pairs, shown.tolist())
    cells = rows[1].subgridspec(1, bands)
    for band in range(bands):
        _tables(fig.add_subplot(cells[band]), found, band)
    _maps(fig, rows[2], pairs)
    if trends:
        cells = rows[3].subgridspec(1, len(images))
        for column, k in enumerate(images):
            _trend(fig, fig.add_subplot(cells[column]), report, found, k)
    return png(fig)


def _overlaps(axes: Any, report: BalanceReport, pairs: Pairs, shown: list[int]) -> None:
    """A line from before to after, for each pair and band."""
    bands = min(pairs.before.shape[1], len(_BAND_COLOURS))
    for band, colour in zip(range(bands), _BAND_COLOURS):
        y = np.arange(len(shown)) + (band - (bands - 1) / 2) * 0.22
        before, after = pairs.before[shown, band], pairs.after[shown, band]
        axes.hlines(y, after, before, color=colour, linewidth=1.2, alpha=0.5)
        axes.plot(before, y, "o", markersize=3.5, markerfacecolor="white", color=colour)
        axes.plot(after, y, "o", markersize=3.5, color=colour, label=f"band {band + 1}")
    names = [" – ".join(_ending(report.named(int(i))) for i in pairs.images[k]) for k in shown]
    axes.set_yticks(range(len(shown)), names, fontsize=7)
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.set_xlabel("root mean square of differences, grey values")
    more = "" if len(shown) == len(pairs.images) else f", the {len(shown)} worst of {len(pairs.images)}"
    axes.set_title(f"Overlaps before (open) and after (full){more}")
    axes.legend(loc="lower right")


def _tables(axes: Any, found: Balanced, band: int) -> None:
    """The tables of all images, with what stays the same."""
    every = [tone[band] for tone in found.tones]
    ends = [every[0].grey[0], every[0].grey[-1]]
    axes.plot(ends, ends, color=SOFT, linewidth=0.8, linestyle=":")
    for tone, sigmas in zip(every, (each[band] for each in found.sigmas)):
        becomes, grey = np.array(tone.becomes), np.array(tone.grey)
        if any(tone.curve):
            grey = np.interp(grey, tone.curve[1], tone.curve[0])
        if len(every) <= 8 and sigmas:
            axes.fill_between(
                grey, becomes - sigmas, becomes + sigmas, color=_BAND_COLOURS[band], alpha=0.12, linewidth=0
            )
        axes.plot(grey, becomes, color=_BAND_COLOURS[band], linewidth=1.0, alpha=max(0.15, 1.0 / np.sqrt(len(every))))
    axes.set(xlabel="grey value", xlim=ends, title=f"Tables, band {band + 1}")
    if band == 0:
        axes.set_ylabel("becomes (band: one σ)" if len(every) <= 8 and found.sigmas[0][0] else "becomes")


def _maps(fig: Any, row: Any, pairs: Pairs) -> None:
    """Draw where on the map images differ, before and after, with the same colours."""
    col, line = (np.round(pairs.places.T - pairs.places.min(axis=0)[:, None]) // SIDE).astype(int)
    most = float(np.quantile(pairs.before_there, 0.98))
    cells = row.subgridspec(1, 2)
    for k, (word, values) in enumerate((("before", pairs.before_there), ("after", pairs.after_there))):
        raster = np.full((line.max() + 1, col.max() + 1), np.nan)
        raster[line, col] = values
        axes = fig.add_subplot(cells[k])
        picture = axes.imshow(raster, cmap="viridis", vmin=0, vmax=max(most, 1e-9), interpolation="nearest")
        axes.set(xticks=[], yticks=[], title=f"Differences {word}")
        axes.grid(False)
        fig.colorbar(picture, ax=axes, fraction=0.04, label="grey values")


def _trend(fig: Any, axes: Any, report: BalanceReport, found: Balanced, k: int) -> None:
    """The trend of the first band over an image, beside its mean."""
    number = int(found.images[k])
    width, height = report.survey.sizes[number].tolist()
    x, y = (np.linspace(0, side - 1, max(2, round(_SIDE * side / max(width, height)))) for side in (width, height))
    trend = found.tones[k][0].trend(x[None, :], y[:, None], (width, height))
    picture = axes.imshow(trend, cmap="RdBu_r", vmin=0.6, vmax=1.4, extent=(0, width, height, 0))
    axes.contour(x, y, trend, levels=np.arange(0.2, 3, 0.1), colors=INK, linewidths=0.4)
    axes.set_title(f"Trend: {_ending(report.named(number), 16)}", fontsize=8)
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    fig.colorbar(picture, ax=axes, fraction=0.05)


def _ending(name: str, most: int = 22) -> str:
    """The end of a name, by which images differ."""
    return name if len(name) <= most else "…" + name[1 - most :]


def _spread(found: Balanced) -> list[int]:
    """Places of some images with tones, spread over all."""
    count = len(found.images)
    return sorted({int(k) for k in np.linspace(0, count - 1, min(_TRENDS, count))}) if count else []


@styled
def draw_light(report: IlluminationReport) -> bytes:
    """Draw grey values over the light on slopes: a row of plots before, a row after, as PNG."""
    bands = min(len(report.before), len(_BAND_COLOURS))
    lit = np.flatnonzero(report.sample.lit)
    some = lit[np.linspace(0, len(lit) - 1, min(_POINTS, len(lit))).astype(int)]
    fig = figure_of(1.0 + 3.2 * bands, 5.6)
    axes = fig.subplots(2, bands, sharex=True, sharey="col", squeeze=False)
    rows = zip(("before", "after"), (report.before, report.after), report.correlations, axes)
    for word, values, correlations, row in rows:
        for band, at in enumerate(row):
            _cloud(at, report, values[band], some, band)
            at.set_title(f"Band {band + 1} {word}: correlation {correlations[band]:+.3f}")
    for at in axes[1]:
        at.set_xlabel("cos i: 1 faces the sun")
    axes[0, 0].set_ylabel("grey value")
    axes[1, 0].set_ylabel("grey value")
    return png(fig)


def _cloud(axes: Any, report: IlluminationReport, values: Any, some: Any, band: int) -> None:
    """Draw pixels on which the sun shines, the means of classes, and the light on level ground."""
    light = report.sample.cos_i[some]
    axes.plot(light, values[some], ".", markersize=1.5, color=_BAND_COLOURS[band], alpha=0.35)
    edges = np.linspace(0, 1, _LIGHT_CLASSES + 1)
    of = np.digitize(light, edges) - 1
    each = [(light[of == k].mean(), values[some][of == k].mean()) for k in range(_LIGHT_CLASSES) if (of == k).sum() > 5]
    axes.plot(*np.array(each).T, color=INK, linewidth=1.2)
    axes.axvline(report.model.cos_z, color=SOFT, linewidth=0.8, linestyle=":")
    axes.set_xlim(0, 1)
