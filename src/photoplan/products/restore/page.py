"""Facts of a restoration filter as its report shows them."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

from photoplan.products.restore.design import DesignedPart, MeasuredFilter
from photoplan.products.restore.filter import FoundFilter
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.restoration.design import Sharpness
from photoplan.quality.restoration.filters import FilterKernel, RestorationFilter
from photoplan.report.filter_plots import KernelPicture, frequency_response
from photoplan.report.restore_plots import AxisPicture, FieldMap
from photoplan.report.restore_report import STANDS_FOR, FilterFacts, PartFacts

_FREQUENCY = np.linspace(0.0, 0.5, 101)
_AXES = (("x", "rows", (1.0, 0.0)), ("y", "columns", (0.0, 1.0)))
#: Bands whose field is drawn.
_BANDS = 6


def filter_facts(found: FoundFilter) -> FilterFacts:
    """What the report shows of a filter."""
    used, measured = found.filter, found.measured
    columns, rows = used.margin
    size = f"{2 * columns + 1} × {2 * rows + 1}"
    figures = [
        (f"{used.noise_gain:.3g} ×", "growth of noise", "the largest of all kernels" if len(used.kernels) > 1 else ""),
        (size, "pixels that the filter reaches", _count(len(used.kernels), "kernel")),
    ]
    drawn: list[DesignedPart] = []
    if measured is not None:
        figures += _measured_figures(measured)
        drawn = _distinct(measured.parts)
    return FilterFacts(
        tuple(figures),
        _origin(found),
        () if measured is None else measured.notes,
        tuple(PartFacts(_name(part), _pictures(part), part.design.reason) for part in drawn),
        tuple(row for part in drawn for row in _rows(part)),
        () if measured is not None else tuple(_plain_facts(used)),
        used.description or "restoration filter",
        tuple(_kernels(used)),
        tuple(_maps(used, measured)),
    )


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
    return f", {_name(part)}"


def _pair(values: Sequence[float]) -> str:
    return " / ".join(f"{v:.3f}" if isfinite(v) else "> 0.5" for v in values)


def _origin(found: FoundFilter) -> str:
    """Where the filter comes from, in a sentence."""
    if found.measured is None:
        return f"The filter comes from {found.origin}." if found.origin else "There is no filter."
    names = [image.name for image in found.measured.mtf.images]
    listed = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"The filter was measured at edges of {listed}. Linearisation: {found.measured.mtf.linearisation}."


def _distinct(parts: Sequence[DesignedPart]) -> list[DesignedPart]:
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


def _name(part: DesignedPart) -> str:
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


def _pictures(part: DesignedPart) -> tuple[AxisPicture, ...]:
    pictures = []
    for sharpness, (axis, name, direction) in zip(part.sharpness, _AXES):
        curve = sharpness.modulation()
        label = f"along {name}" + (" (by the others)" if axis in part.missing else "")
        pictures.append(
            AxisPicture(
                label,
                sharpness.spread.side(),
                _FREQUENCY,
                _modulation(curve),
                _expected(curve, part.design.kernel, direction),
            )
        )
    return tuple(pictures)


def _rows(part: DesignedPart) -> list[tuple[str, ...]]:
    """Two rows of the table of parts: along rows and along columns."""
    rows = []
    conditions = (part.design.condition_x, part.design.condition_y)
    for sharpness, condition, (axis, name, direction) in zip(part.sharpness, conditions, _AXES):
        side = [f"{v:.3f}" for v in sharpness.spread.side()[:3]] + ["–", "–"]
        rows.append(
            (
                _name(part),
                str(part.edges or "–"),
                part.design.method,
                name + (STANDS_FOR if axis in part.missing else ""),
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


def _plain_facts(used: RestorationFilter) -> list[tuple[str, str]]:
    """What a filter's file says of its making."""
    facts = []
    for name, value in used.facts.items():
        listed = isinstance(value, list | tuple) and any(isinstance(v, dict) for v in value)
        facts.append((str(name), f"{len(value)}, see the file" if listed else str(value)))  # type: ignore[arg-type]
    return facts


def _kernels(used: RestorationFilter) -> list[KernelPicture]:
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
        pictures.append(KernelPicture(name, kernels[0].values))
    return pictures


def _maps(used: RestorationFilter, measured: MeasuredFilter | None) -> list[tuple[str, tuple[FieldMap, ...]]]:
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
