"""What became of measurements of test patterns, as values, lines, table rows and JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.geometry.grid import Window
from photoplan.plain import pick
from photoplan.quality.linearise import Linearisation
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.patterns.bar_curve import BarCurve, coltman_mtf
from photoplan.quality.patterns.siemens import StarMtf
from photoplan.quality.patterns.usaf import UsafBars, UsafResult


@dataclass(frozen=True, eq=False)
class PatternResult:
    """One pattern in one channel."""

    image: str
    """Name, which no other image of the report has."""
    file: Path
    band: str
    window: Window
    """All that was measured lies in it."""
    found: BarCurve | StarMtf | UsafResult
    parts: tuple[Window, ...] = ()
    """Of bars: the window of each frequency group, in the order of these."""
    coltman: bool = False
    """Convert the contrast transfer of bars into an MTF."""
    pixel_um: float | None = None
    """Distance of pixels on the sensor, micrometres."""
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Names it within the report."""
        w = self.window
        return f"{self.image}, {self.band}, column {w.col}, row {w.row}, {w.width} × {w.height}"

    def curves(self) -> dict[str, tuple[str, MtfCurve]]:
        """Curves by name: ``mtf`` or ``contrast``, and the curve."""
        if isinstance(self.found, BarCurve):
            curves = {"contrast transfer": ("contrast", self.found.contrast), "mtf": ("mtf", self.found.mtf)}
            if self.coltman:
                curves["mtf by Coltman's series"] = ("mtf", coltman_mtf(self.found.contrast))
            return curves
        if isinstance(self.found, StarMtf):
            single = {f"mtf at {angle:g}°": ("mtf", curve) for angle, curve in self.found.directional.items()}
            return {"mtf": ("mtf", self.found.mtf), **single}
        return {}

    def json_fields(self) -> dict[str, Any]:
        """Figures of the kind of pattern, and its curves by name."""
        values: dict[str, Any] = {"roi": _roi(self.window), **pick(self, "band", "notes")}
        if isinstance(self.found, BarCurve):
            values |= _bars(self.found, self.parts)
        elif isinstance(self.found, StarMtf):
            values |= _star(self.found, self.window)
        else:
            values |= _usaf(self.found, self.window)
        for name, (_, curve) in self.curves().items():
            entry = pick(curve, "modulation", "sigma", "mtf50", "mtf10", cycles_per_px="frequency")
            if self.pixel_um is not None:
                entry["lp_per_mm"] = curve.frequency * 1000.0 / self.pixel_um
            key = name.replace(" by Coltman's series", "_coltman").replace(" ", "_")
            if " at " in name:
                values.setdefault("directions", []).append({"direction_deg": float(name.split()[-1][:-1]), **entry})
            else:
                values[key] = entry
        return values

    def rows(self) -> Iterator[list[object]]:
        """Rows of the table: curve, direction, group, element, frequency, value, standard deviation, resolved."""
        head = [self.image, self.band, self.window.col, self.window.row]
        if isinstance(self.found, UsafResult):
            for bars in self.found.bars:
                kind = [_kind(bars), bars.group, bars.element, bars.frequency, bars.lp_mm, bars.contrast, bars.sigma]
                yield [*head, "contrast transfer", *kind, bars.resolved]
            return
        for name, (_, curve) in self.curves().items():
            label, _, direction = name.partition(" at ")
            for f, m, s in _points(curve):
                yield [*head, label, direction.rstrip("°"), "", "", f, "", m, s, ""]

    def lines(self) -> list[str]:
        """What is printed."""
        if isinstance(self.found, UsafResult):
            return _usaf_lines(self.found)
        if isinstance(self.found, StarMtf):
            star = self.found
            lines = [
                f"star of {star.sectors} {star.wave} sectors, centre column {star.centre[0] + self.window.col:.2f}, "
                f"row {star.centre[1] + self.window.row:.2f}: {_figures(star.mtf)}"
            ]
            return lines + [f"  {angle:5.1f}°  {_figures(curve)}" for angle, curve in star.directional.items()]
        found = self.found
        lines = [f"bars, full contrast from {found.levels_from}"]
        series = coltman_mtf(found.contrast) if self.coltman else None
        for k, group in enumerate(found.groups, 1):
            lines.append(
                f"  {group.frequency:.4f} cy/px at {group.angle_deg:.1f}°  contrast transfer "
                f"{_value(found.contrast, k)}  MTF {_value(found.mtf, k)}"
                + (f"  by Coltman {_value(series, k)}" if series is not None else "")
            )
        return lines


def _kind(bars: UsafBars) -> str:
    return "horizontal" if bars.horizontal else "vertical"


def _points(curve: MtfCurve) -> Iterator[tuple[float, float, float]]:
    sigma = np.full(curve.frequency.size, np.nan) if curve.sigma is None else curve.sigma
    yield from zip(curve.frequency.tolist(), curve.modulation.tolist(), sigma.tolist())


def _value(curve: MtfCurve, k: int) -> str:
    sigma = "" if curve.sigma is None else f" ± {curve.sigma[k]:.4f}"
    return f"{curve.modulation[k]:.4f}{sigma}"


def _figures(curve: MtfCurve) -> str:
    words = [
        f"{name} {value:.4f}" for name, value in (("MTF50", curve.mtf50), ("MTF10", curve.mtf10)) if isfinite(value)
    ]
    first, last = curve.frequency[1], curve.frequency[-1]
    return f"{'  '.join(words) or 'stays above 0.5'}  ({first:.3f} to {last:.3f} cy/px)"


def _roi(window: Window) -> list[int]:
    return [window.col, window.row, window.width, window.height]


def _bars(found: BarCurve, windows: Sequence[Window]) -> dict[str, Any]:
    own = ("angle_deg", "phase", "duty", "periods", "low", "high", "modulation", "modulation_sigma", "fundamental",
           "fundamental_sigma", "aligned")  # fmt: skip
    groups = [
        {"roi": _roi(window), **pick(g, *own, cycles_per_px="frequency")} for g, window in zip(found.groups, windows)
    ]
    return {"groups": groups, **pick(found, "low", "high", "levels_from")}


def _star(found: StarMtf, window: Window) -> dict[str, Any]:
    return {
        "col": found.centre[0] + window.col,
        "row": found.centre[1] + window.row,
        "col_sigma": found.centre_sigma[0],
        "row_sigma": found.centre_sigma[1],
        **pick(found, "sectors", "wave", "low", "high", "levels_from", "radii"),
    }


def _three(bars: UsafBars | None, *more: str) -> dict[str, Any] | None:
    own = ("group", "element", "contrast", "sigma", *more)
    return None if bars is None else pick(bars, *own, lp_per_mm="lp_mm", cycles_per_px="frequency")


def _usaf(found: UsafResult, window: Window) -> dict[str, Any]:
    elements = [
        {
            **(_three(b, "resolved", "seen") or {}),
            "bars": _kind(b),
            "col": b.centre[0] + window.col,
            "row": b.centre[1] + window.row,
        }
        for b in found.bars
    ]
    return {
        **pick(found, "groups", "resolved_groups", pixel_on_target_um="pixel_um"),
        **pick(found.place, "matched", "rms"),
        "limit_horizontal": _three(found.limit(horizontal=True)),
        "limit_vertical": _three(found.limit(horizontal=False)),
        "elements": elements,
    }


def _usaf_lines(found: UsafResult) -> list[str]:
    groups = ", ".join(map(str, found.groups))
    lines = [
        f"USAF-1951 target: groups {groups} seen; {found.place.matched} threes of bars placed within "
        f"{found.place.rms:.2f} px; {found.pixel_um:.4g} µm a pixel on the target"
    ]
    for horizontal in (True, False):
        kind = "horizontal" if horizontal else "vertical"
        last = found.limit(horizontal=horizontal)
        if last is None:
            lines.append(f"  {kind} bars: none is resolved")
            continue
        lines.append(
            f"  {kind} bars resolved up to group {last.group}, element {last.element}: {last.lp_mm:.2f} LP/mm, "
            f"{last.frequency:.3f} cy/px, contrast transfer {last.contrast:.3f} ± {last.sigma:.3f}"
        )
    return lines


@dataclass(frozen=True, eq=False)
class ImagePattern:
    """Measurements in one image."""

    name: str
    file: Path
    size: tuple[int, int]
    linearisation: str
    results: tuple[PatternResult, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know."""
        return tuple(dict.fromkeys(note for result in self.results for note in result.notes))

    def json_fields(self) -> dict[str, Any]:
        """Its results as patterns."""
        return pick(self, "file", "size", "linearisation", image="name", patterns="results")

    def __str__(self) -> str:
        lines = [f"{self.name}: {self.linearisation}"]
        for result in self.results:
            first, *rest = result.lines()
            lines += [f"  {result.band}: {first}", *(f"  {line}" for line in rest)]
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class PatternReport:
    """What became of all images."""

    pattern: str
    images: tuple[ImagePattern, ...]
    failed: Mapping[str, str]
    """Why, by name of the image."""
    linearisation: Linearisation
    pixel_um: float | None
    csv: Path | None

    def json_fields(self) -> dict[str, Any]:
        """The linearisation in words."""
        return {
            **pick(self, "pattern", "images", "csv", pixel_size_um="pixel_um"),
            "linearisation": self.linearisation.describe(),
            "failed": [{"image": name, "reason": reason} for name, reason in self.failed.items()],
        }

    @property
    def csv_rows(self) -> tuple[Sequence[str], list[list[object]]]:
        """Header, and a row for each point of each curve, or each three bars of a USAF target."""
        header = ["image", "band", "col", "row", "curve", "direction", "group", "element", "cycles_per_px", "lp_per_mm",
                  "value", "sigma", "resolved"]  # fmt: skip
        rows = [[_field(v) for v in row] for image in self.images for r in image.results for row in r.rows()]
        return header, rows


def _field(value: object) -> object:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{float(value):.6g}" if isfinite(value) else ""
    return value
