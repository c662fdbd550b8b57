"""Report of MTF measurements as one HTML document."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.products.mtf.result import EdgeGroup, ImageMtf, MeasuredEdge, MtfReport, rejected_words
from photoplan.report.mtf.plots import MtfPlots
from photoplan.report.page import Cell, cells, figure, headline, number, page, section, table, text

#: Images that get plots.
_PLOTTED = 30
#: Edges in a table.
_LISTED = 300
#: Longer side of the small copy of an image, pixels.
_SMALL = 1100
_ROWS_AT_ONCE = 1 << 22
_GROUP_HEAD = ("edges of", "MTF50 cy/px", "95 % interval", "MTF10", "FWHM px", "Gaussian px", "rms", "edges")
_EDGE_HEAD = ("no.", "channel", "column", "row", "direction", "angle °", "length", "contrast/noise", "MTF50",
              "95 % interval", "FWHM px", "over %", "under %")  # fmt: skip


def mtf_page(made: MtfReport, mpl: Any) -> str:
    """The report as one HTML document; images are opened again for small copies."""
    plots = MtfPlots(mpl)
    parts = [_image(image, made.pixel_um, plots if k < _PLOTTED else None) for k, image in enumerate(made.images)]
    if made.failed:
        rows = [[Cell(name), Cell(reason)] for name, reason in made.failed.items()]
        parts.append(section("Images without result", [table(("image", "reason"), rows)]))
    title = made.images[0].name if len(made.images) == 1 else f"{len(made.images)} images"
    return page(f"Sharpness: {title}", "Spread function and modulation transfer from edges", parts)


def _image(image: ImageMtf, pixel_um: float | None, plots: MtfPlots | None) -> str:
    rejected = rejected_words(image.rejected) or "no edge"
    parts = [headline(_figures(image, pixel_um))]
    parts.append(f"<p>Linearisation: {text(image.linearisation)}. Rejected: {text(rejected)}.</p>")
    parts += [f"<p>{text(note)}</p>" for note in image.notes]
    whole = [g for g in image.groups if g.cell is None]
    if plots is not None:
        parts += _plots(image, whole, plots)
    parts.append(table(_GROUP_HEAD, [cells(_group_row(group), 1) for group in whole]))
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


def _plots(image: ImageMtf, whole: list[EdgeGroup], plots: MtfPlots) -> list[str]:
    channel = image.total.channel
    first = [edge for edge in image.edges if edge.channel == channel]
    own = [g for g in whole if g.channel == channel]
    directions = [g for g in own if g.direction is not None] or own
    channels = [g for g in whole if g.direction is None]
    parts = [
        figure(
            plots.overview(_small(image), image.size, first),
            f"Edges in {image.name}",
            "Measured edges, coloured by the frequency at which their modulation has fallen to a half.",
        ),
        figure(
            plots.curves(directions, image.total, first),
            "Modulation transfer",
            "Means of the edges with two standard deviations, single edges in grey. x: brightness changes along the "
            "rows; y: along the columns. Beyond the Nyquist frequency the image holds aliasing, not detail.",
        ),
        figure(
            plots.profiles(_best(first)),
            "Spread functions",
            "The edge with the smallest interval in each direction. Points: means of the pixels; band: 95 % interval.",
        ),
    ]
    if len(channels) > 1:
        caption = "Means of each channel over all directions, with two standard deviations."
        parts.insert(2, figure(plots.curves(channels, image.total), "Channels", caption))
    cells_of = image.cells_of(channel)
    if cells_of:
        caption = "MTF50 by position in the image, half of its 95 % interval, and the number of edges."
        parts.append(figure(plots.field(cells_of, image.grid), "Sharpness over the field", caption))
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


def _group_row(group: EdgeGroup) -> tuple[str, ...]:
    low, high = group.mtf50.interval
    where = group.direction or "all"
    return (
        f"{group.band}, {where}" + (f" ({group.flight})" if group.flight else ""),
        number(group.mtf50.value, 4),
        f"{number(low, 4)} – {number(high, 4)}",
        number(group.mtf10.value, 3),
        number(group.fwhm.value, 2),
        number(group.gaussian.fwhm, 2),
        number(group.gaussian.rms, 3),
        str(group.mtf50.edges),
    )


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
