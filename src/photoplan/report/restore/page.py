"""Report of a restoration as one HTML document."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

from photoplan.io.raster import RasterReader
from photoplan.products.chromatic import model_figures
from photoplan.products.restore.design import DesignedPart, MeasuredFilter
from photoplan.products.restore.execute import Job, RestoredImage
from photoplan.products.restore.filter import FoundFilter
from photoplan.products.restore.run import RestoreReport
from photoplan.project.align import AlignStep
from photoplan.project.fall_off import FallOffStep, fall_off_line
from photoplan.project.restored import restoration_of
from photoplan.quality.colour.model import ChromaticModel
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.restoration.design import Sharpness
from photoplan.quality.restoration.filters import FilterKernel, RestorationFilter
from photoplan.report.page import Cell, cells, figure, headline, page, section, table, text
from photoplan.report.restore.filters import MOST_DRAWN, draw_kernels, frequency_response
from photoplan.report.restore.plots import (
    AxisPicture,
    FieldMap,
    compare,
    draw_details,
    draw_ends,
    draw_field,
    draw_sharpness,
)

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


def restore_page(found: FoundFilter, jobs: Sequence[Job], made: RestoreReport) -> str:
    """The report as one HTML document; images and results are opened again for details."""
    by_path = {job.target: job for job in jobs}
    parts = [section("The filter", _filter(found))]
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
    """Where the filter comes from, in a sentence."""
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
    """What a filter's file says of its making."""
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
