"""Reports of cameras: MTF, characterisation from image series, figures of a sensor's description."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from photoplan.arrays import Floats, Floats32
from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.products.mtf.edges import LightImage
from photoplan.products.mtf.patterns import MOST_PIXELS, PatternReport, PatternResult
from photoplan.products.mtf.result import EdgeGroup, ImageMtf, MeasuredEdge, MtfReport, means, rejected_words
from photoplan.quality.curves import Linearisation, gaussian_modulation
from photoplan.quality.patterns.bars import StarMtf
from photoplan.quality.patterns.usaf import UsafResult
from photoplan.report.page import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    SOFT,
    STYLE,
    Cell,
    axes_of,
    cells,
    figure,
    figure_of,
    findings_section,
    findings_table,
    headline,
    mpl,
    number,
    page,
    png,
    section,
    styled,
    table,
    text,
)

if TYPE_CHECKING:
    from photoplan.products.characterise.run import CharacteriseReport
    from photoplan.products.sensor import SensorReport


#: Images that get plots.
_PLOTTED = 30
#: Edges in a table.
_LISTED = 300
#: Longer side of the small copy of an image, pixels.
_SMALL = 1100
_ROWS_AT_ONCE = 1 << 22
_EDGE_HEAD = ("no.", "channel", "column", "row", "direction", "angle °", "length", "contrast/noise", "MTF50",
              "95 % interval", "FWHM px", "over %", "under %")  # fmt: skip


def mtf_page(made: MtfReport | PatternReport) -> str | None:
    """Return the report as one HTML document, if an image was measured; images are opened again for small copies."""
    if not made.images:
        return None
    if isinstance(made, PatternReport):
        return _pattern_page(made)
    parts = [_image(image, made.pixel_um, k < _PLOTTED) for k, image in enumerate(made.images)]
    if made.failed:
        rows = [[Cell(name), Cell(reason)] for name, reason in made.failed.items()]
        parts.append(section("Images without result", [table(("image", "reason"), rows)]))
    title = made.images[0].name if len(made.images) == 1 else f"{len(made.images)} images"
    return page(f"Sharpness: {title}", "Spread function and modulation transfer from edges", parts)


def _image(image: ImageMtf, pixel_um: float | None, drawn: bool) -> str:
    rejected = rejected_words(image.rejected) or "no edge"
    parts = [headline(_figures(image, pixel_um))]
    parts.append(f"<p>Linearisation: {text(image.linearisation)}. Rejected: {text(rejected)}.</p>")
    parts += [f"<p>{text(note)}</p>" for note in image.notes]
    if drawn:
        parts += _plots(image, [g for g in image.groups if g.cell is None])
    parts.append(findings_table(means(image.groups)))
    if image.total.laboratory is not None:
        head = ("cycles per pixel", "laboratory", "measured", "difference")
        lab = image.total.laboratory
        rows = [
            cells((f"{f:.4f}", f"{a:.3f}", number(m, 3), number(m - a, 3)))
            for f, a, m in zip(lab.frequency, lab.laboratory, lab.measured)
        ]
        parts.append(table(head, rows))
    parts.append(table(_EDGE_HEAD, [cells(_edge_row(edge), 2) for edge in image.edges[:_LISTED]]))
    return section(image.name, parts)


def _plots(image: ImageMtf, whole: list[EdgeGroup]) -> list[str]:
    channel = image.total.channel
    first = [edge for edge in image.edges if edge.channel == channel]
    own = [g for g in whole if g.channel == channel]
    directions = [g for g in own if g.direction is not None] or own
    channels = [g for g in whole if g.direction is None]
    parts = [
        figure(
            draw_overview(_small(image), image.size, first),
            f"Edges in {image.name}",
            "Measured edges, coloured by the frequency at which their modulation has fallen to a half.",
        ),
        figure(
            draw_curves(directions, image.total, first),
            "Modulation transfer",
            "Means of the edges with two standard deviations, single edges in grey. x: brightness changes along the "
            "rows; y: along the columns. Beyond the Nyquist frequency the image holds aliasing, not detail.",
        ),
        figure(
            draw_profiles(_best(first)),
            "Spread functions",
            "The edge with the smallest interval in each direction. Points: means of the pixels; band: 95 % interval.",
        ),
    ]
    if len(channels) > 1:
        caption = "Means of each channel over all directions, with two standard deviations."
        parts.insert(2, figure(draw_curves(channels, image.total), "Channels", caption))
    cells_of = image.cells_of(channel)
    if cells_of:
        caption = "MTF50 by position in the image, half of its 95 % interval, and the number of edges."
        parts.append(figure(draw_field(cells_of, image.grid), "Sharpness over the field", caption))
    return parts


def _figures(image: ImageMtf, pixel_um: float | None) -> list[tuple[str, str, str]]:
    total = image.total
    low, high = total.mtf50.interval
    per_mm = f", {1000 * total.mtf50.value / pixel_um:.1f} cycles/mm" if pixel_um else ""
    enhanced = image.enhancement
    return [
        (f"{total.mtf50.value:.3f}", "MTF50, cycles per pixel", f"{low:.3f} to {high:.3f}{per_mm}"),
        (f"{number(total.fwhm.value, 2)} px", "full width at half maximum", f"Gaussian {total.gaussian.fwhm:.2f} px"),
        (str(total.mtf50.edges), f"edges in {total.band}", f"{image.found} could have been measured"),
        (
            f"{100 * enhanced.size:.1f} %",
            "over- and undershoot",
            "edges are enhanced" if enhanced.enhanced else "no edge enhancement",
        ),
    ]


def _edge_row(edge: MeasuredEdge) -> tuple[str, ...]:
    m = edge.measured
    return (
        str(edge.number),
        edge.band,
        f"{edge.col:.1f}",
        f"{edge.row:.1f}",
        edge.direction + (f" ({edge.flight})" if edge.flight else "") + (" aligned" if edge.aligned else ""),
        f"{m.angle_deg:.1f}",
        f"{m.length:.0f}",
        f"{m.snr:.0f}",
        number(m.mtf50, 4),
        f"{number(m.mtf50_interval[0], 4)} – {number(m.mtf50_interval[1], 4)}",
        number(m.fwhm, 2),
        f"{100 * m.overshoot:.1f}",
        f"{100 * m.undershoot:.1f}",
    )


def _best(edges: list[MeasuredEdge]) -> list[MeasuredEdge]:
    """The edge with the smallest interval in each direction."""
    best = []
    for way in ("x", "y"):
        own = [edge for edge in edges if edge.direction == way]
        dense = [edge for edge in own if edge.measured.sampling == "super-sampled"] or own
        if dense:
            best.append(min(dense, key=lambda e: np.nan_to_num(np.ptp(e.measured.mtf50_interval), nan=9.0)))
    return best


def _small(image: ImageMtf) -> NDArray[np.uint8]:
    """A small copy of the first band, stretched; read by strips."""
    reader, (width, height) = RasterReader(image.file), image.size
    step = max(1, -(-max(width, height) // _SMALL))
    rows = max(1, _ROWS_AT_ONCE // width // step) * step
    parts = [
        reader.read(Window(0, row, width, min(rows, height - row)))[0][0][::step, ::step].astype(np.float32)
        for row in range(0, height, rows)
    ]
    grey = np.concatenate(parts)
    known = grey[np.isfinite(grey)]
    low, high = (float(v) for v in np.quantile(known, [0.005, 0.995])) if known.size else (0.0, 1.0)
    return (255 * np.clip((np.nan_to_num(grey, nan=low) - low) / max(high - low, 1e-12), 0, 1)).astype(np.uint8)


_WIDTH = 7.2
_COLOURS = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY)
#: Curves of single edges that are drawn.
_SINGLE = 80
_NORMAL_95 = 1.96


@styled
def draw_overview(small: NDArray[np.uint8], size: tuple[int, int], edges: Sequence[MeasuredEdge]) -> bytes:
    """The image with its edges, coloured by their MTF50."""
    width, height = size
    # Beside the picture are its axis and the colours.
    tall = float(np.clip((_WIDTH - 1.4) * height / width, 1.4, 9.0))
    fig, axes = axes_of(_WIDTH, tall + 0.6)
    box = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(small, cmap="gray", vmin=-60, vmax=300, extent=box, interpolation="antialiased")
    values = np.array([e.measured.mtf50 for e in edges])
    known = np.isfinite(values)
    low, high = (float(np.quantile(values[known], q)) for q in (0.05, 0.95)) if known.any() else (0.0, 0.5)
    lines = mpl.collections.LineCollection(
        [e.ends for e in edges], cmap="plasma", linewidths=2.4, capstyle="round", zorder=3
    )
    lines.set_array(np.where(known, values, low))
    lines.set_clim(low, high if high > low else low + 0.01)
    axes.add_collection(lines)
    fig.colorbar(lines, ax=axes, label="MTF50, cycles per pixel", shrink=0.8, pad=0.01)
    axes.set(xlim=box[:2], ylim=box[2:], xlabel="column px", ylabel="row px")
    axes.set_aspect("equal")
    axes.grid(False)
    return png(fig)


@styled
def draw_profiles(edges: Sequence[MeasuredEdge]) -> bytes:
    """Edge and line spread function of some edges, with 95 % intervals and the pixels' means."""
    fig = figure_of(_WIDTH, 2.5 * len(edges))
    for row, edge in zip(fig.subplots(len(edges), 2, squeeze=False), edges):
        m, title = edge.measured, f"{edge.direction}, edge {edge.number}"
        for axes, spread, name in zip(row, (m.esf, m.lsf), ("edge", "line")):
            at, value, reach = spread.positions, spread.values, _NORMAL_95 * spread.sigma
            axes.fill_between(at, value - reach, value + reach, color=SKY, alpha=0.45, linewidth=0)
            axes.plot(at, value, color=BLUE, linewidth=1.3)
            axes.set(xlabel="distance from the edge px", title=f"{title}: {name} spread function")
        row[0].plot(m.samples.positions, m.samples.values, ".", color=INK, markersize=2.5, zorder=3)
        near = 1.1 * _extent(m.lsf.positions, m.lsf.values)
        for axes in row:
            axes.set_xlim(-near, near)
    return png(fig)


@styled
def draw_curves(means: Sequence[EdgeGroup], total: EdgeGroup, edges: Sequence[MeasuredEdge] = ()) -> bytes:
    """Mean MTF curves with two standard deviations, beside the Gaussian and laboratory values of `total`.

    Of `edges`, those of the directions are drawn behind.
    """
    fig, axes = axes_of(_WIDTH, 3.9)
    for mean in means:
        own = [e.measured.mtf for e in edges if mean.direction in (None, e.direction)]
        for mtf in own[:_SINGLE]:
            axes.plot(mtf.frequency, mtf.modulation, color="#c9d2d8", linewidth=0.5, zorder=1)
    for mean, colour in zip(means, _COLOURS):
        curve = mean.curve
        sigma = 0.0 if curve.sigma is None else np.nan_to_num(curve.sigma)
        low, high = curve.modulation - 2 * sigma, curve.modulation + 2 * sigma
        axes.fill_between(curve.frequency, low, high, color=colour, alpha=0.22, linewidth=0, zorder=2)
        axes.plot(curve.frequency, curve.modulation, color=colour, linewidth=1.6, label=_label(mean), zorder=3)
    frequency = np.linspace(0.0, float(total.curve.frequency[-1]), 200)
    fwhm = total.gaussian.fwhm
    gaussian = gaussian_modulation(fwhm, frequency)
    label = f"Gaussian, FWHM {fwhm:.2f} px"
    axes.plot(frequency, gaussian, "--", color=INK, linewidth=1.0, label=label, zorder=4)
    if edges and total.laboratory is not None:
        lab = total.laboratory
        axes.plot(lab.frequency, lab.laboratory, "s", color=INK, markersize=5, label="laboratory", zorder=5)
    axes.axvline(0.5, color=SOFT, linewidth=0.8, linestyle=":")
    axes.annotate("Nyquist", (0.5, 1.0), (3, -3), textcoords="offset points", fontsize=7.5, color=SOFT, va="top")
    axes.axhline(0.5, color=SOFT, linewidth=0.6, linestyle=":")
    top = max(1.05, *(float(np.nanmax(m.curve.modulation)) for m in means)) + 0.03
    axes.set(xlim=(0, max(0.6, *(float(m.curve.frequency[-1]) for m in means))), ylim=(0, top))
    axes.set(xlabel="frequency, cycles per pixel", ylabel="modulation transfer")
    axes.legend(loc="upper right", fontsize=8)
    return png(fig)


@styled
def draw_field(groups: Sequence[EdgeGroup], grid: int) -> bytes:
    """MTF50 in the cells of the field, with half intervals and numbers of edges: of all edges and each direction."""
    known = np.array([g.mtf50.value for g in groups if np.isfinite(g.mtf50.value)])
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.5)
    pad = max(0.02, 0.1 * (high - low))
    step = _cell_size(groups[0])
    frame = (-0.5, grid * step[0] - 0.5, grid * step[1] - 0.5, -0.5)
    maps = [(way, own) for way in (None, "x", "y") if (own := [g for g in groups if g.direction == way])]
    fig = figure_of(_WIDTH, 3.2)
    row = fig.subplots(1, len(maps), squeeze=False)[0]
    shown = None
    for axes, (way, own) in zip(row, maps):
        values = np.full((grid, grid), np.nan)
        for group in own:
            values[group.cell] = group.mtf50.value
        limits = {"vmin": low - pad, "vmax": high + pad}
        shown = axes.imshow(values, cmap="viridis", aspect="auto", extent=frame, **limits)
        for group in own if grid <= 6 else ():
            assert group.cell is not None
            value, (first, last) = group.mtf50.value, group.mtf50.interval
            if np.isfinite(value):
                more = f"±{(last - first) / 2:.3f}\n" if np.isfinite(last - first) else ""
                words = f"{value:.3f}\n{more}n = {group.mtf50.edges}"
                colour = INK if value > (low + high) / 2 else "white"
                at = [(place + 0.5) * side - 0.5 for place, side in zip(group.cell[::-1], step)]
                axes.annotate(words, at, ha="center", va="center", fontsize=7, color=colour)
        axes.set(xlabel="column, pixels", title=way or "all")
        axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(4, integer=True))
        axes.grid(False)
    row[0].set_ylabel("row, pixels")
    for axes in row[1:]:
        axes.set_yticklabels([])
    fig.colorbar(shown, ax=list(row), label="MTF50, cycles per pixel", shrink=0.85)
    return png(fig)


def _cell_size(group: EdgeGroup) -> tuple[float, float]:
    """Width and height of a cell of the field, pixels."""
    assert group.bounds is not None
    left, top, right, bottom = group.bounds
    return right - left, bottom - top


def _label(group: EdgeGroup) -> str:
    name = group.band if group.direction is None else group.direction
    flight = "" if group.flight is None else f" ({group.flight} flight)"
    return f"{name}{flight}: MTF50 {number(group.mtf50.value, 3)}"


def _extent(at: Floats, value: Floats) -> float:
    """Return the distance to which a line spread function is drawn, pixels."""
    large = np.abs(at[np.abs(value) > 0.02 * np.abs(value).max()])
    return float(np.clip(1.6 * large.max(initial=1.0), 3.0, float(np.abs(at).max())))


_WIDTH_PATTERNS = 6.2
_COLOURS_PATTERNS = (BLUE, RED, GREEN, ORANGE)
#: Modulations whose frequencies are shown by direction.
_LEVELS = (0.8, 0.5, 0.2, 0.1)
#: Longest side of a picture, pixels.
_SIDE = 900


@styled
def draw_curves_patterns(result: PatternResult) -> bytes:
    """Transfer against frequency, with two standard deviations."""
    curves = _curves(result)
    mtf = any(kind == "mtf" for _, kind, _ in curves)
    fig, axes = axes_of(_WIDTH_PATTERNS, 3.5)
    for (name, kind, (frequency, value, sigma)), colour in zip(curves, _COLOURS_PATTERNS):
        dashed = "--" if kind == "contrast" and mtf else "-"
        axes.plot(frequency, value, dashed, color=colour, linewidth=1.3, label=name)
        known = np.isfinite(sigma)
        if frequency.size < 40 or isinstance(result.found, UsafResult):
            axes.errorbar(frequency[known], value[known], 2.0 * sigma[known], fmt="o", color=colour,
                          markersize=3.2, linewidth=0.9)  # fmt: skip
        else:
            low, high = value - 2.0 * sigma, value + 2.0 * sigma
            axes.fill_between(frequency, low, high, color=colour, alpha=0.2, linewidth=0)
    longest = max([0.5, *(float(f.max()) for _, _, (f, _, _) in curves if f.size)])
    lowest = min([0.0, *(float(np.nanmin(v)) for _, _, (_, v, _) in curves if v.size)])
    axes.axvline(0.5, color=SOFT, linewidth=0.8, linestyle=":")
    axes.set(xlim=(0, longest * 1.02), ylim=(max(lowest, -0.3) - 0.02, 1.12), xlabel="cycles per pixel",
             ylabel="modulation transfer" if mtf else "contrast transfer of bars")  # fmt: skip
    if result.pixel_um is not None and mtf:
        scale = 1000.0 / result.pixel_um
        top = axes.secondary_xaxis("top", functions=(lambda f: f * scale, lambda f: f / scale))
        top.set_xlabel("line pairs per mm")
    axes.legend(loc="upper right")
    return png(fig)


@styled
def draw_polar(star: StarMtf) -> bytes:
    """Frequencies at which the modulation falls to some levels, by direction."""
    fig = figure_of(_WIDTH_PATTERNS, 4.2)
    axes = fig.add_subplot(projection="polar")
    angles = np.array(list(star.directional))
    for level, colour in zip(_LEVELS, _COLOURS_PATTERNS):
        reach = np.array([curve.falls_to(level) for curve in star.directional.values()])
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


def draw_picture(result: PatternResult, light: Floats32) -> bytes:
    """The light of the pattern's window, thinned, and what was found in it."""
    rows, columns = light.shape
    step = _thinning(result.window)
    marks = _marks(result)
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        fig, axes = axes_of(_WIDTH_PATTERNS, float(np.clip((_WIDTH_PATTERNS - 0.5) * rows / columns + 0.5, 1.4, 8.5)))
        low, high = np.nanquantile(light, [0.005, 0.995])
        axes.imshow(light, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
        for wanted, colour, name in ((True, GREEN, "resolved"), (False, RED, "not resolved")):
            some = [(x / step, y / step, label) for (x, y), label, resolved in marks if resolved == wanted]
            if some:
                axes.plot(*list(zip(*some))[:2], "+", color=colour, markersize=7, label=name)
            for x, y, label in some:
                axes.annotate(label, (x, y), (3, 3), textcoords="offset points", fontsize=6.5, color=colour)
        for number, part in enumerate(result.parts, 1):
            place = (part.col - result.window.col) / step - 0.5, (part.row - result.window.row) / step - 0.5
            side = part.width / step, part.height / step
            axes.add_patch(mpl.patches.Rectangle(place, *side, fill=False, edgecolor=RED))
            box = {"boxstyle": "square,pad=0.2", "facecolor": RED, "edgecolor": "none"}
            axes.annotate(str(number), place, (3, -3), textcoords="offset points", va="top", fontsize=8,
                          color="white", bbox=box)  # fmt: skip
        axes.set(xlabel="column px", ylabel="row px")
        if len({resolved for _, _, resolved in marks}) > 1:
            fig.legend(loc="outside upper right", ncols=2, labelcolor=INK)
        return png(fig)


def _pattern_page(made: PatternReport) -> str:
    parts = []
    for result in (result for image in made.images for result in image.results):
        found = [f"<p>{text(result.heading)}</p>", findings_table(result.table)]
        found += [f"<p>{text(note)}</p>" for note in result.notes]
        if any(frequency.size for _, _, (frequency, _, _) in _curves(result)):
            caption = "With two standard deviations; the dotted line is the Nyquist frequency."
            found.append(figure(draw_curves_patterns(result), "Transfer", caption))
        if isinstance(result.found, StarMtf) and result.found.directional:
            caption = "Frequency in cycles per pixel at which the modulation falls to a level, by its direction."
            found.append(figure(draw_polar(result.found), "Transfer by direction", caption))
        # Bars may lie far apart.
        if result.window.size <= MOST_PIXELS:
            light = _light(result, made.linearisation)
            found.append(figure(draw_picture(result, light), "Pattern", "What was found, marked at its place."))
        parts.append(section(result.name, found))
    kind = made.linearisation.describe()
    return page("Test patterns", f"Modulation and contrast transfer of images; linearisation: {kind}", parts)


def _curves(result: PatternResult) -> list[tuple[str, str, tuple[Floats, Floats, Floats]]]:
    """Curves over all directions: name, ``mtf`` or ``contrast``, and frequency, value and standard deviation."""
    found = result.found
    if not isinstance(found, UsafResult):
        return [
            (name, kind, (c.frequency, c.modulation, np.full(c.frequency.size, np.nan) if c.sigma is None else c.sigma))
            for name, (kind, c) in result.curves().items()
            if " at " not in name
        ]
    curves = []
    for horizontal in (True, False):
        rows = [b for b in found.bars if b.horizontal == horizontal and isfinite(b.contrast)]
        f, c, s = np.array([[b.frequency, b.contrast, b.sigma] for b in rows]).reshape(-1, 3).T
        curves.append((f"{'horizontal' if horizontal else 'vertical'} bars", "contrast", (f, c, s)))
    return curves


def _marks(result: PatternResult) -> list[tuple[tuple[float, float], str, bool]]:
    """Places in the window with a label, and whether they are resolved."""
    found = result.found
    if isinstance(found, UsafResult):
        return [(b.centre, "" if b.horizontal else f"{b.group}.{b.element}", b.resolved) for b in found.bars]
    return [(found.centre, "centre", True)] if isinstance(found, StarMtf) else []


def _light(result: PatternResult, linearisation: Linearisation) -> Floats32:
    """Light of the pattern's window, one of some pixels."""
    image = LightImage.open(result.file, linearisation)
    step = _thinning(result.window)
    return np.asarray(image.picture(result.window, image.channels(None)[0]).grey[::step, ::step], np.float32)


def _thinning(window: Window) -> int:
    """Return the number of pixels along a side of which one is in the picture."""
    return max(1, -(-max(window.width, window.height) // _SIDE))


#: Titles of the sections of a sensor's report.
_TITLES = {
    "viewing": "Viewing",
    "video": "Video norm",
    "sensor": "Sensor",
    "image": "Digital image",
    "transfer": "Charge transfer",
    "noise": "Noise",
    "optics": "Lens",
}


def characterise_page(made: CharacteriseReport) -> str:
    """Return the findings of every analysis, and what could not be known, as one HTML document."""
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
    sections = [findings_section(found) for found in made.outcome()]
    others = [[run.analysis.title, run.state, run.missing or run.failed or ""] for run in made.runs if not run.outcome]
    if others:
        sections.append(section("Not done", [table(("analysis", "state", "why"), others)]))
    title = f"Camera characterisation: {series.camera.name or series.path.stem}"
    return page(title, f"From the image series {series.path.name}", [head, *remarks, *sections])


def sensor_page(found: SensorReport) -> str:
    """Return figures and plots of charge transfer, noise and transfer functions as one HTML document."""
    parts = [findings_section(replace(each, title=_TITLES[each.title])) for each in found.sections]
    return page(f"Sensor: {found.described.name}", "Figures of a sensor, computed from its description", parts)
