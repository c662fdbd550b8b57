"""MTF from patterns: bars and Siemens stars."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, PhotoplanError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Findings, Result, Table, with_sigma
from photoplan.geometry.grid import Window
from photoplan.io.tables import write_table
from photoplan.plain import pick
from photoplan.products.mtf.edges import ENCODED, LUMINANCE, LightImage, check_files, measure_edges, unique_names
from photoplan.products.mtf.result import MtfReport
from photoplan.project.steps import linearisation_of
from photoplan.quality.curves import Linearisation, MtfCurve
from photoplan.quality.patterns.bars import (
    BarCurve,
    StarMtf,
    StarRules,
    bar_curve,
    clipped_pixels,
    coltman_mtf,
    measure_bars,
    measure_star,
)
from photoplan.quality.patterns.usaf import UsafBars, UsafResult, UsafRules, measure_usaf
from photoplan.requests.quality import MtfRequest


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
    """Window of each frequency group of bars, in their order."""
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

    @property
    def heading(self) -> str:
        """The pattern as a whole, in words."""
        found, window = self.found, self.window
        if isinstance(found, UsafResult):
            return (
                f"USAF-1951 target: groups {', '.join(map(str, found.groups))} seen; {found.place.matched} threes of "
                f"bars placed within {found.place.rms:.2f} px; {found.pixel_um:.4g} µm a pixel on the target"
            )
        if isinstance(found, StarMtf):
            return (
                f"star of {found.sectors} {found.wave} sectors, centre column {found.centre[0] + window.col:.2f}, "
                f"row {found.centre[1] + window.row:.2f}"
            )
        return f"bars, full contrast from {found.levels_from}"

    @property
    def table(self) -> Table:
        """The figures: of each direction of a star, each group of bars, or the limits of a target."""
        found = self.found
        if isinstance(found, UsafResult):
            head: tuple[str, ...] = ("bars", "resolved up to", "LP/mm on the target", "cy/px", "contrast transfer")
            rows = [_limit(name, found.limit(horizontal=name == "horizontal")) for name in ("horizontal", "vertical")]
        elif isinstance(found, StarMtf):
            head = ("direction", "MTF50 cy/px", "MTF10 cy/px", "from cy/px", "to cy/px")
            curves = [("all", found.mtf), *((f"{angle:.1f}°", curve) for angle, curve in found.directional.items())]
            rows = [
                (name, _reached(c.mtf50), _reached(c.mtf10), f"{c.frequency[1]:.3f}", f"{c.frequency[-1]:.3f}")
                for name, c in curves
            ]
        else:
            head = ("bars", "frequency", "direction", "contrast transfer", "MTF", *["by Coltman"] * self.coltman)
            series = [found.contrast, found.mtf, *([coltman_mtf(found.contrast)] if self.coltman else [])]
            rows = [
                (str(k), f"{group.frequency:.4f} cy/px", f"{group.angle_deg:.1f}°", *(_value(c, k) for c in series))
                for k, group in enumerate(found.groups, 1)
            ]
        return Table(head, tuple(rows), printed=True)


def _kind(bars: UsafBars) -> str:
    return "horizontal" if bars.horizontal else "vertical"


def _points(curve: MtfCurve) -> Iterator[tuple[float, float, float]]:
    sigma = np.full(curve.frequency.size, np.nan) if curve.sigma is None else curve.sigma
    yield from zip(curve.frequency.tolist(), curve.modulation.tolist(), sigma.tolist())


def _value(curve: MtfCurve, k: int) -> str:
    """Return a value of a curve, whose first is that at frequency 0."""
    return with_sigma(float(curve.modulation[k]), nan if curve.sigma is None else float(curve.sigma[k]))


def _reached(value: float) -> str:
    return f"{value:.4f}" if isfinite(value) else "not reached"


def _limit(name: str, last: UsafBars | None) -> tuple[str, ...]:
    if last is None:
        return (name, "none", "", "", "")
    place = f"group {last.group}, element {last.element}"
    return name, place, f"{last.lp_mm:.2f}", f"{last.frequency:.3f}", with_sigma(last.contrast, last.sigma)


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
        """Remarks on the patterns."""
        return tuple(dict.fromkeys(note for result in self.results for note in result.notes))

    def json_fields(self) -> dict[str, Any]:
        """Its results as patterns."""
        return pick(self, "file", "size", "linearisation", image="name", patterns="results")


@dataclass(frozen=True, eq=False)
class PatternReport(Result):
    """Patterns of all images."""

    pattern: str
    images: tuple[ImagePattern, ...]
    failed: Mapping[str, str]
    """Reasons of the failures, by name of the image."""
    linearisation: Linearisation
    pixel_um: float | None
    csv: Path | None

    def json_fields(self) -> dict[str, Any]:
        """Return the images with their patterns, and the linearisation in words."""
        return {
            **pick(self, "pattern", "images", "csv", pixel_size_um="pixel_um"),
            "linearisation": self.linearisation.describe(),
            "failed": [{"image": name, "reason": reason} for name, reason in self.failed.items()],
        }

    def outcome(self) -> list[Findings]:
        """Return the figures of each pattern."""
        return [
            Findings(
                tables={"figures": found.table},
                title=f"{image.name}, {found.band}: {found.heading} · {image.linearisation}",
            )
            for image in self.images
            for found in image.results
        ]

    def remarks(self) -> list[str]:
        """Return the notes of each image."""
        return [f"{image.name}: {note}" for image in self.images for note in image.notes]

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


Array = NDArray[np.float64]
Roi = tuple[int, int, int, int]

#: Pixels of the largest window that is read at once.
MOST_PIXELS = 1 << 26


def measure_mtf(request: MtfRequest, events: Events = SILENT) -> MtfReport | PatternReport:
    """Measure edges or, if `pattern` is set, patterns of all images; one that fails does not stop the others.

    Returns
    -------
    MtfReport or PatternReport
        Positions, values and standard deviations of each edge, by direction, channel and place; or of each pattern.

    Raises
    ------
    UsageError
        Options contradict each other, an output exists, or a window leaves an image.
    InputError
        The linearisation table or the laboratory values cannot be used.
    """
    if request.pattern is None:
        return measure_edges(request, events)
    check_files(request)
    linearisation = linearisation_of(request.linearisation or "linear")
    results: list[ImagePattern] = []
    failed: dict[str, str] = {}
    names = dict(zip(request.images, unique_names(request.images)))
    encoded = False
    for path in request.images:
        try:
            image = LightImage.open(path, linearisation)
            if request.linearisation is None and image.reader.dtype == "uint8":
                encoded = True
            results.append(_measure(names[path], image, request))
        except (ResourceError, UsageError):
            raise
        except PhotoplanError as error:
            failed[names[path]] = str(error)
    if encoded:
        events.talk(f"note: {ENCODED}")
    done = bool(results)
    made = PatternReport(
        pattern=request.pattern,
        images=tuple(results),
        failed=failed,
        linearisation=linearisation,
        pixel_um=request.pixel_um,
        csv=request.csv if done else None,
    )
    if made.csv is not None:
        write_table(made.csv, *made.csv_rows)
    return made


def _windows(image: LightImage, rois: tuple[Roi, ...]) -> list[Window]:
    """Windows that are asked for; the whole image if none is."""
    width, height = image.size
    for col, row, w, h in rois:
        if min(w, h) < 1 or col < 0 or row < 0 or col + w > width or row + h > height:
            raise UsageError(
                f"`roi` {col} {row} {w} {h} (column, row, width, height): leaves {image.reader.path} of {width} × "
                f"{height} pixels"
            )
    windows = [Window(*roi) for roi in rois] or [Window(0, 0, width, height)]
    for window in windows:
        if window.width * window.height > MOST_PIXELS:
            raise InputError(
                f"{image.reader.path}: a window of {window.width} × {window.height} pixels; give the pattern "
                "alone with `roi` column row width height"
            )
    return windows


def _read(image: LightImage, window: Window, channel: int) -> tuple[Array, NDArray[np.bool_]]:
    """Light of a window (NaN: no value), and which pixels are cut off."""
    picture = image.picture(window, channel)
    light = np.array(picture.grey, np.float64)
    if picture.valid is not None:
        light[~picture.valid] = np.nan
    stored, _ = image.reader.read(window)
    used = stored[:3] if channel == LUMINANCE and len(stored) >= 3 else stored[max(channel, 1) - 1][None]
    clipped = np.logical_or.reduce([clipped_pixels(band) for band in used])
    if picture.saturated is not None:
        clipped |= picture.saturated
    return light, clipped


def _measure(name: str, image: LightImage, request: MtfRequest) -> ImagePattern:
    """The patterns of an image in every channel that is asked for."""
    path, results = image.reader.path, list[PatternResult]()
    windows = _windows(image, request.rois)
    levels = _levels(image.linearisation, image.reader.dtype, request.levels)
    for channel in image.channels(request.band):
        band = image.channel_name(channel)
        if request.pattern == "bars":
            groups = []
            for k, window in enumerate(windows):
                light, clipped = _read(image, window, channel)
                groups.append(measure_bars(light, clipped=clipped, what=f"{path}: {_place(window, k, windows)}"))
            try:
                curve = bar_curve(groups, levels)
            except InputError as error:
                raise InputError(f"{path}: {error} (`levels` LOW HIGH)") from None
            parts = tuple(window for _, window in sorted(zip(groups, windows), key=lambda part: part[0].frequency))
            results.append(
                PatternResult(
                    image=name,
                    file=path,
                    band=band,
                    window=_hull(windows),
                    found=curve,
                    parts=parts,
                    coltman=request.coltman,
                    pixel_um=request.pixel_um,
                )
            )
            continue
        for k, window in enumerate(windows):
            light, clipped = _read(image, window, channel)
            what = f"{path}: {_place(window, k, windows)}"
            if request.pattern == "star":
                rules = StarRules(sectors=request.sectors, levels=levels)
                found = measure_star(light, rules, clipped=clipped, what=what)
                results.append(PatternResult(name, path, band, window, found=found, pixel_um=request.pixel_um))
            else:
                usaf = UsafRules(request.group, None if request.group is not None else request.pixel_um)
                target = measure_usaf(light, usaf, clipped=clipped, what=what)
                results.append(
                    PatternResult(
                        image=name,
                        file=path,
                        band=band,
                        window=window,
                        found=target,
                        pixel_um=request.pixel_um,
                        notes=_stretched(light),
                    )
                )
    return ImagePattern(
        name=name, file=path, size=image.size, linearisation=image.linearisation.describe(), results=tuple(results)
    )


def _levels(
    linearisation: Linearisation, dtype: np.dtype[np.generic] | str, levels: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Light of given grey values, on the scale of the pixels."""
    if levels is None:
        return None
    scale = 1.0 if linearisation.kind == "table" else linearisation.full_scale(dtype)
    grey = np.array(levels, np.float64)
    if not (np.isfinite(grey).all() and 0.0 <= grey[0] < grey[1]):
        raise UsageError(
            f"`levels` {levels[0]:g} {levels[1]:g}; the grey value of dark areas, then that of bright ones"
        )
    if linearisation.kind == "srgb":
        # As floating point the full scale is 1.
        low, high = linearisation.to_linear(grey / scale)
    else:
        low, high = linearisation.to_linear(grey) / scale
    return float(min(low, high)), float(max(low, high))


def _place(window: Window, number: int, windows: list[Window]) -> str:
    if len(windows) == 1:
        return "the pattern"
    return f"pattern {number + 1} (column {window.col}, row {window.row}, {window.width} × {window.height})"


def _stretched(light: Array) -> tuple[str, ...]:
    """A note where the bright end is much more even than the dark one: it may be saturated or compressed."""
    low, high = float(light.min()), float(light.max())
    step = 0.005 * (high - low)
    bright, dark = float((light >= high - step).mean()), float((light <= low + step).mean())
    if bright < 0.03 or dark > 0.3 * bright:
        return ()
    return (
        f"{100 * bright:.0f} % of the pixels lie within 0.5 % of the highest value: the bright end seems saturated or "
        "compressed. What is resolved holds; contrast transfers are those of the picture as it is",
    )


def _hull(windows: list[Window]) -> Window:
    """The smallest window that holds all of them."""
    col, row = min(w.col for w in windows), min(w.row for w in windows)
    return Window(col, row, max(w.col + w.width for w in windows) - col, max(w.row + w.height for w in windows) - row)
