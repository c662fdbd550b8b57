"""The facts of MTF measurements as the report shows them."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.products.mtf.image import LightImage
from photoplan.products.mtf.result import EdgeGroup, ImageMtf, MeasuredEdge, MtfReport, rejected_words
from photoplan.quality.spread import gaussian_modulation
from photoplan.report.mtf_plots import CellFacts, CurveFacts, EdgeFacts, MtfPlots, ProfileFacts
from photoplan.report.mtf_report import MtfImageFacts, mtf_report

#: Longer side of the small copy of an image, pixels.
_SMALL = 1100
_FACTOR = 1.96
_ROWS_AT_ONCE = 1 << 22


def mtf_page(made: MtfReport, images: Mapping[Path, LightImage], plots: MtfPlots) -> str:
    """The HTML report.

    Parameters
    ----------
    made : MtfReport
    images : mapping
        The images by their files, for the small copies.
    plots : MtfPlots
    """
    facts = [_facts(image, images[image.file], made.pixel_um) for image in made.images]
    names = [image.name for image in made.images]
    return mtf_report(names[0] if len(names) == 1 else f"{len(names)} images", facts, made.failed, plots)


def _facts(image: ImageMtf, pixels: LightImage, pixel_um: float | None) -> MtfImageFacts:
    total = image.total
    channel = total.channel
    first = [edge for edge in image.edges if edge.channel == channel]
    whole = [g for g in image.groups if g.cell is None]
    own = [g for g in whole if g.channel == channel]
    directions = [g for g in own if g.direction is not None]
    frequency = np.linspace(0.0, float(total.curve.frequency[-1]), 200)
    gaussian = gaussian_modulation(total.gaussian.fwhm, frequency)
    lab = None if total.lab is None else (total.lab.frequency, total.lab.laboratory)
    channels = [g for g in whole if g.direction is None]
    return MtfImageFacts(
        image.name,
        image.size,
        image.linearisation,
        tuple(_figures(image, pixel_um)),
        _small(pixels),
        tuple(EdgeFacts(edge.ends, edge.measured.mtf50) for edge in first),
        tuple(_group_row(group) for group in whole),
        tuple(_edge_row(edge) for edge in image.edges),
        tuple(_profiles(first)),
        tuple(_curve(group, first) for group in (directions or own)),
        tuple(_curve(group, []) for group in channels) if len(channels) > 1 else (),
        (frequency, gaussian, f"Gaussian, FWHM {total.gaussian.fwhm:.2f} px"),
        lab,
        tuple(_lab_rows(total)),
        tuple(_maps(image, channel)),
        rejected_words(image.rejected),
        image.notes,
    )


def _figures(image: ImageMtf, pixel_um: float | None) -> list[tuple[str, str, str]]:
    total = image.total
    low, high = total.mtf50.interval
    per_mm = f", {1000 * total.mtf50.value / pixel_um:.1f} cycles/mm" if pixel_um else ""
    enhanced = image.enhancement
    return [
        (f"{total.mtf50.value:.3f}", "MTF50, cycles per pixel", f"{low:.3f} to {high:.3f}{per_mm}"),
        (f"{_text(total.fwhm.value, 2)} px", "full width at half maximum", f"Gaussian {total.gaussian.fwhm:.2f} px"),
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
        _text(group.mtf50.value, 4),
        f"{_text(low, 4)} – {_text(high, 4)}",
        _text(group.mtf10.value, 3),
        _text(group.fwhm.value, 2),
        _text(group.gaussian.fwhm, 2),
        _text(group.gaussian.rms, 3),
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
        _text(m.mtf50, 4),
        f"{_text(m.mtf50_interval[0], 4)} – {_text(m.mtf50_interval[1], 4)}",
        _text(m.fwhm, 2),
        f"{100 * m.overshoot:.1f}",
        f"{100 * m.undershoot:.1f}",
    )


def _profiles(edges: list[MeasuredEdge]) -> list[ProfileFacts]:
    """The best edge in each direction."""
    facts = []
    for way in ("x", "y"):
        own = [edge for edge in edges if edge.direction == way]
        dense = [edge for edge in own if edge.measured.sampling == "super-sampled"] or own
        if not dense:
            continue
        edge = min(dense, key=lambda e: np.nan_to_num(np.ptp(e.measured.mtf50_interval), nan=9.0))
        m = edge.measured
        facts.append(
            ProfileFacts(
                f"{way}, edge {edge.number}",
                (m.esf.positions, m.esf.values, m.esf.sigma),
                (m.lsf.positions, m.lsf.values, m.lsf.sigma),
                (m.samples.positions, m.samples.values),
                _FACTOR,
            )
        )
    return facts


def _curve(group: EdgeGroup, edges: list[MeasuredEdge]) -> CurveFacts:
    label = group.band if group.direction is None else group.direction
    if group.flight is not None:
        label += f" ({group.flight} flight)"
    own = [e.measured.mtf for e in edges if group.direction in (None, e.direction)]
    curve = group.curve
    sigma = np.zeros_like(curve.modulation) if curve.sigma is None else np.nan_to_num(curve.sigma)
    single = tuple((mtf.frequency, mtf.modulation) for mtf in own)
    return CurveFacts(f"{label}: MTF50 {_text(group.mtf50.value, 3)}", curve.frequency, curve.modulation, sigma, single)


def _lab_rows(group: EdgeGroup) -> list[tuple[str, ...]]:
    lab = group.lab
    if lab is None:
        return []
    return [
        (f"{f:.4f}", f"{a:.3f}", _text(m, 3), _text(m - a, 3))
        for f, a, m in zip(lab.frequency, lab.laboratory, lab.measured)
    ]


def _maps(image: ImageMtf, channel: int) -> list[CellFacts]:
    groups = image.groups_of(channel, cells=True)
    if not groups:
        return []
    cells = max(max(g.cell) for g in groups if g.cell is not None) + 1
    cells = max(cells, image.grid)
    maps = []
    for way in (None, "x", "y"):
        value, reach = np.full((2, cells, cells), np.nan)
        count = np.zeros((cells, cells), np.int64)
        for group in (g for g in groups if g.direction == way and g.cell is not None):
            assert group.cell is not None
            value[group.cell] = group.mtf50.value
            reach[group.cell] = (group.mtf50.interval[1] - group.mtf50.interval[0]) / 2
            count[group.cell] = group.mtf50.edges
        if count.any():
            maps.append(CellFacts("all" if way is None else way, value, reach, count))
    return maps


def _small(image: LightImage) -> NDArray[np.uint8]:
    """A small copy of the first band, stretched; read by strips."""
    width, height = image.size
    step = max(1, -(-max(width, height) // _SMALL))
    rows = max(1, _ROWS_AT_ONCE // width // step) * step
    parts = [
        image.reader.read(Window(0, row, width, min(rows, height - row)))[0][0][::step, ::step].astype(np.float32)
        for row in range(0, height, rows)
    ]
    grey = np.concatenate(parts)
    known = grey[np.isfinite(grey)]
    low, high = (float(v) for v in np.quantile(known, [0.005, 0.995])) if known.size else (0.0, 1.0)
    return (255 * np.clip((np.nan_to_num(grey, nan=low) - low) / max(high - low, 1e-12), 0, 1)).astype(np.uint8)


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if isfinite(value) else "–"
