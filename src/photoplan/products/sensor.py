"""Figures of a sensor from its description, as values and as a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import degrees, radians
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.errors import InputError
from photoplan.events import SILENT, Events
from photoplan.findings import Bars, Chart, Estimate, Findings, Result, Trace
from photoplan.io.product import check_output
from photoplan.io.quality_files import (
    ChargeTransfer,
    Chip,
    Noise,
    OpticsEntry,
    PictureEntry,
    SensorDescription,
    Video,
    Viewing,
    read_sensor,
)
from photoplan.io.tables import write_table
from photoplan.plain import pick
from photoplan.quality.camera import sensor
from photoplan.quality.camera.sensor import NoiseBudget, VideoNorm
from photoplan.requests.quality import SensorRequest


@dataclass(frozen=True)
class SensorReport(Result):
    """Figures of a sensor."""

    described: SensorDescription
    sections: tuple[Findings, ...]
    """Figures of each table of the description."""
    csv: Path | None
    """Table that was written."""

    @property
    def figures(self) -> list[dict[str, Any]]:
        """The figures with the keys of JSON and table."""
        return [
            {"section": each.title, **pick(f, "name", "value", "unit", "stated", meaning="label", source="remark")}
            for each in self.sections
            for f in each.figures
        ]

    def json_fields(self) -> dict[str, object]:
        """Return the name and the figures."""
        return {"name": self.described.name, "figures": self.figures}

    def outcome(self) -> list[Findings]:
        """Return the name, then the figures of each table of the description."""
        return [Findings(title=self.described.name), *self.sections]


def describe_sensor(request: SensorRequest, events: Events = SILENT) -> SensorReport:
    """Compute the figures that a description determines, and write them as a table if `csv` is set.

    Raises
    ------
    UsageError
        The table exists or is the input.
    InputError
        The description cannot be used.
    """
    if request.csv is not None:
        check_output(request.csv, [request.file], overwrite=request.overwrite)
    described = read_sensor(request.file)
    sections = sensor_figures(described, str(request.file))
    for f in (figure for each in sections for figure in each.figures):
        if f.stated is not None and abs(f.value - f.stated) > 0.01 * abs(f.stated):
            events.talk(f"{f.name}: {f.value:.4g} by {f.remark}; {f.stated:g} is stated")
    report = SensorReport(described, sections, None if request.dry_run else request.csv)
    if report.csv is not None:
        head = ("section", "name", "value", "unit", "stated", "meaning", "source")
        rows = [["" if row[key] is None else row[key] for key in head] for row in report.figures]
        write_table(report.csv, head, rows)
    return report


_AXES = ("x", "y")
_ALONG = ("across", "down")
#: Parts of the Nyquist frequency at which transfer functions are printed.
SHARES = (0.25, 0.5, 0.75, 1.0)


Found = Iterator[tuple[str, str, float, str, str]]


def sensor_figures(described: SensorDescription, file: str) -> tuple[Findings, ...]:
    """Return every figure that a description determines, and plots, by the tables of the description."""
    parts: list[tuple[str, Found]] = []
    if described.viewing is not None:
        parts.append(("viewing", _viewing(described.viewing)))
    if described.video is not None:
        parts.append(("video", _video(described.video)))
    if described.sensor is not None:
        parts.append(("sensor", _chip(described.sensor)))
    if described.image is not None:
        parts.append(("image", _picture(described.image, described.sensor)))
    if described.transfer is not None:
        parts.append(("transfer", _transfer(described.transfer)))
    if described.noise is not None:
        parts.append(("noise", _noise(described)))
    if described.optics is not None:
        parts.append(("optics", _optics(described.optics, described.sensor)))
    estimates = {
        part: tuple(
            Estimate(name, value, label=label, unit=unit, remark=source, stated=described.stated.get(name))
            for name, label, value, unit, source in found
        )
        for part, found in parts
    }
    values = {figure.name: figure.value for figures in estimates.values() for figure in figures}
    for name in described.stated:
        if name not in values:
            raise InputError(
                f"{file}: stated.{name}: no such figure follows from the description; those that do are "
                f"{', '.join(sorted(values)) or 'none'}"
            )
    plots = _plots(described, values)
    return tuple(Findings(figures, plots=tuple(plots.get(part, ())), title=part) for part, figures in estimates.items())


def _plots(described: SensorDescription, values: Mapping[str, float]) -> dict[str, list[Chart | Bars]]:
    """Return plots by the table that they belong to."""
    found: dict[str, list[Chart | Bars]] = {}
    if described.transfer is not None:
        own = described.transfer.inefficiency * described.transfer.transfers
        ratio = np.linspace(0.0, 0.5, 201)
        curves = [
            Trace(ratio, np.exp(-product * (1.0 - np.cos(2.0 * np.pi * ratio))), label, "line")
            for product, label in [
                (own, f"this sensor, nε = {own:.3g}"),
                *((other, f"{other:g}") for other in (0.01, 0.1, 0.3, 0.7, 2.0)),
            ]
        ]
        found["transfer"] = [
            Chart(
                title="Modulation after charge transfer",
                caption="Also of other transfer inefficiency products nε. 0.5 is the Nyquist frequency. "
                "Behr 1989, eq. 3.15.",
                x_label="signal frequency through clock frequency",
                y_label="modulation that is left",
                curves=tuple(curves),
            )
        ]
    chip, optics = described.sensor, described.optics
    periods = {} if chip is None else {f"element, {along}": pitch for along, pitch in zip(_ALONG, chip.pitch)}
    periods |= {
        f"pixel, {along}": values[f"pixel_{axis}_um"]
        for axis, along in zip(_AXES, _ALONG)
        if f"pixel_{axis}_um" in values
    }
    if periods:
        period = np.geomspace(min(periods.values()) / 2.0, max(periods.values()) * 2.0, 200)
        points = [
            Trace(np.array([value]), np.array([500.0 / value]), f"{name}: {500.0 / value:.1f} LP/mm")
            for name, value in periods.items()
        ]
        place = "image" if any(name.startswith("pixel") for name in periods) else "sensor"
        found[place] = [
            Chart(
                title="Nyquist frequency",
                caption="Half the reciprocal of the period. Behr 1989, eq. 3.23.",
                x_label="period of sampling µm",
                y_label="Nyquist frequency LP/mm",
                curves=(Trace(period, 500.0 / period, style="line"), *points),
            )
        ]
    budget = noise_budget(described)
    if budget is not None and budget.sources():
        text = "The total is the root of the sum of squares, since the sources are independent."
        found["noise"] = [Bars("Noise budget", text, {**budget.sources(), "total": budget.total}, "electrons")]
    if chip is not None and (chip.sensitive_um is not None or optics is not None):
        key = "optics" if optics is not None else "sensor"
        found.setdefault(key, []).append(
            Chart(
                title="Modulation transfer",
                caption="The sensor can do no better than both together.",
                x_label="spatial frequency LP/mm",
                y_label="modulation",
                curves=tuple(_curves(chip, optics)),
                marks=tuple((500.0 / pitch, "Nyquist") for pitch in dict.fromkeys(chip.pitch)),
            )
        )
    return found


def _curves(chip: Chip, optics: OpticsEntry | None) -> Iterator[Trace]:
    """Yield the transfer functions of lens and sensitive width."""
    frequency = np.linspace(0.0, 2.0 * max(float(sensor.nyquist(pitch)) for pitch in chip.pitch), 201)
    lens = np.ones_like(frequency)
    if optics is not None:
        lens = sensor.diffraction_mtf(frequency, sensor.diffraction_cutoff(optics.f_number, optics.wavelength_nm))
        yield Trace(frequency, lens, "perfect lens", "line")
    if chip.sensitive_um is None:
        return
    same = chip.sensitive_um[0] == chip.sensitive_um[1]
    for width, along in zip(chip.sensitive_um[: 1 if same else 2], _ALONG):
        place = "" if same else f", {along}"
        aperture = sensor.aperture_mtf(frequency, width)
        yield Trace(frequency, aperture, f"sensitive width{place}", "line")
        if optics is not None:
            yield Trace(frequency, aperture * lens, f"both{place}", "line")


def _viewing(table: Viewing) -> Found:
    angle, eye = radians(table.angle_deg), radians(table.eye_resolution_arcmin / 60.0)
    aspect = table.aspect[0] / table.aspect[1]
    lines = sensor.lines_from_viewing(angle, eye)
    if table.distance_m is not None:
        height = sensor.viewed_length(table.distance_m, angle)
        spacing = 1000.0 * sensor.viewed_length(table.distance_m, eye)
        yield "picture_height_m", "height of the picture that is viewed", height, "m", "Behr 1989, eq. 3.1"
        yield "line_spacing_mm", "spacing of its lines", spacing, "mm", "Behr 1989, eq. 3.2"
    yield "viewing_lines", "lines that the eye needs", lines, "lines", "Behr 1989, eq. 3.3"
    columns = sensor.columns_of(lines, aspect)
    yield "viewing_columns", "points in a line", columns, "points", "Behr 1989, eq. 3.4"
    yield "viewing_points", "points of the picture", sensor.points_of(lines, aspect), "points", "Behr 1989, eq. 3.5"


def _video(table: Video) -> Found:
    norm = VideoNorm(
        lines=table.lines,
        line_s=table.line_us * 1e-6,
        line_blanking_s=table.line_blanking_us * 1e-6,
        frame_blanking_s=table.frame_blanking_us * 1e-6,
        aspect=table.aspect[0] / table.aspect[1],
        kell_factor=table.kell_factor,
        fields=table.fields,
    )
    printed = "Behr 1989, table 3.1"
    yield "line_hz", "lines a second", norm.line_hz, "Hz", printed
    yield "frame_hz", "frames a second", norm.frame_hz, "Hz", printed
    yield "field_hz", "fields a second", norm.field_hz, "Hz", printed
    points = sensor.points_of(norm.lines, norm.aspect)
    yield "video_points", "points of the picture", points, "points", "Behr 1989, eq. 3.5"
    yield "bandwidth_mhz", "bandwidth without blanking", norm.plain_hz / 1e6, "MHz", "Behr 1989, eq. 3.6, 3.7"
    yield "columns_factor", "lines lengthened by blanking", norm.columns_factor, "", "Behr 1989, eq. 3.8, 3.9"
    yield "lines_factor", "lines added by blanking", norm.lines_factor, "", "Behr 1989, eq. 3.10"
    yield "blanking_factor", "bandwidth widened by blanking", norm.blanking_factor, "", "Behr 1989, eq. 3.11"
    yield "bandwidth_blanked_mhz", "bandwidth with blanking", norm.blanked_hz / 1e6, "MHz", "Behr 1989, eq. 3.11"
    yield "resolved_lines", "lines resolved with the Kell factor", norm.resolved_lines, "lines", "Behr 1989, §3.1"
    yield "bandwidth_kell_mhz", "bandwidth with Kell factor", norm.kell_hz / 1e6, "MHz", "Behr 1989, eq. 3.12"
    least = sensor.sampling_hz(norm.kell_hz) / 1e6
    yield "least_sampling_mhz", "lowest frequency of sampling", least, "MHz", "Behr 1989, eq. 3.13"


def _chip(table: Chip) -> Found:
    for k, (axis, along) in enumerate(zip(_AXES, _ALONG)):
        pitch = table.pitch[k]
        given = "as given" if table.size_mm is not None else "element times number"
        yield f"sensor_{axis}_mm", f"size of the sensor, {along}", table.size[k], "mm", given
        yield f"element_{axis}_um", f"size of an element, {along}", pitch, "µm", f"Behr 1989, eq. 3.{19 + k}"
        limit = float(sensor.nyquist(pitch))
        yield f"nyquist_element_{axis}_lp_mm", f"Nyquist frequency, {along}", limit, "LP/mm", "Behr 1989, eq. 3.23"
        if table.sensitive_um is None:
            continue
        for share in SHARES:
            mtf = float(sensor.aperture_mtf(share * limit, table.sensitive_um[k]))
            name, words = f"mtf_aperture_{axis}_{100 * share:.0f}", f"MTF of the sensitive width at {share:g} Nyquist"
            yield name, f"{words}, {along}", mtf, "", "|sinc(f w)|"


def _picture(table: PictureEntry, chip: Chip | None) -> Found:
    for k, (axis, along) in enumerate(zip(_AXES, _ALONG)):
        if table.pixels is not None:
            pairs = sensor.line_resolution(table.pixels[k])
            equation = f"Behr 1989, eq. 3.{18 - k}"
            yield f"resolution_{axis}_lp", f"line resolution, {along}", pairs, "LP", equation
            if chip is not None:
                dense = pairs / chip.size[k]
                yield (
                    f"resolution_{axis}_lp_mm",
                    f"the same on the sensor, {along}",
                    dense,
                    "LP/mm",
                    "Behr 1989, §3.6.6",
                )
        size = _pixel(table, k)
        if size is not None:
            yield f"pixel_{axis}_um", f"size of a pixel, {along}", size, "µm", f"Behr 1989, eq. 3.{21 + k}"
            limit = float(sensor.nyquist(size))
            words = f"Nyquist frequency of the pixels, {along}"
            yield f"nyquist_pixel_{axis}_lp_mm", words, limit, "LP/mm", "Behr 1989, eq. 3.23"
    if table.bits is not None:
        yield "grey_steps", "steps of grey", 2.0**table.bits, "", "Behr 1989, §3.4"
        sigma = sensor.quantisation_sigma(1.0)
        yield "quantisation_grey", "noise of quantisation", sigma, "grey values", "Behr 1989, eq. 3.14"
        share = 100.0 * sensor.quantisation_sigma(0.5**table.bits)
        yield "quantisation_percent", "the same, of the range", share, "%", "Behr 1989, eq. 3.14"
    if table.sampling_mhz is not None:
        highest = table.sampling_mhz / 2.0
        yield "highest_signal_mhz", "highest frequency that sampling keeps", highest, "MHz", "Behr 1989, eq. 3.13"
        if table.jitter_ns is not None:
            yield from _jitter(table.jitter_ns * 1e-9, table.sampling_mhz * 1e6, table)


def _pixel(table: PictureEntry, axis: int) -> float | None:
    if table.pixel_um is not None:
        return table.pixel_um[axis]
    if table.reference_mm is None or table.reference_pixels is None:
        return None
    return sensor.pixel_um(table.reference_mm, table.reference_pixels[axis])


def _jitter(jitter_s: float, sampling_hz: float, table: PictureEntry) -> Found:
    shift = sensor.jitter_pixels(jitter_s, sampling_hz)
    yield "jitter_px", "error of position by jitter", shift, "px", "Behr 1989, eq. 4.5 (product)"
    step = table.grey_step if table.grey_step is not None else 2.0**table.bits - 1.0 if table.bits else None
    if step is not None:
        grey = sensor.jitter_grey(jitter_s, step, 1.0 / sampling_hz)
        words = f"error of grey by jitter at a step of {step:g}"
        yield "jitter_grey", words, grey, "grey values", "Behr 1989, eq. 4.6, 4.7"


def _transfer(table: ChargeTransfer) -> Found:
    product = table.inefficiency * table.transfers
    yield "transfer_product", "transfer inefficiency product", product, "", "Behr 1989, §3.6.4"
    for ratio in table.signal_to_clock:
        where, at = f"{ratio:g}".replace(".", "_"), f"at {ratio:g} of the clock frequency"
        left = float(sensor.transfer_modulation(product, ratio))
        turn = float(sensor.transfer_phase(product, ratio))
        yield f"transfer_modulation_{where}", f"modulation left {at}", left, "", "Behr 1989, eq. 3.15"
        yield f"transfer_phase_{where}_deg", f"shift of phase {at}", degrees(turn), "°", "Behr 1989, eq. 3.16"


def noise_budget(described: SensorDescription) -> NoiseBudget | None:
    """The noise of a described sensor; None if it is not described."""
    table = described.noise
    if table is None:
        return None
    signal = table.signal_e if table.signal_e is not None else table.full_well_e
    assert signal is not None
    shift = described.transfer
    amplifier = table.read_noise_e
    if table.output_capacitance_pf is not None:
        amplifier = sensor.amplifier_noise(table.output_capacitance_pf)
    bits = described.image.bits if described.image is not None else None
    rounding = None
    if bits is not None and table.full_well_e is not None:
        rounding = sensor.quantisation_sigma(table.full_well_e / 2.0**bits)
    return NoiseBudget(
        signal_e=signal,
        dark_e=_dark(table, signal),
        transfer=None if shift is None else sensor.transfer_noise(signal, shift.inefficiency, shift.transfers),
        amplifier=amplifier,
        quantisation=rounding,
    )


def _dark_current(table: Noise) -> float | None:
    """Electrons per second at the temperature of use."""
    if table.dark_current_e_per_s is None or table.temperature_c is None or table.dark_reference_c is None:
        return table.dark_current_e_per_s
    return sensor.dark_at(
        table.dark_current_e_per_s, table.temperature_c, table.dark_reference_c, table.dark_doubling_c
    )


def _dark(table: Noise, signal: float) -> float | None:
    current = _dark_current(table)
    if current is not None:
        assert table.exposure_s is not None
        return current * table.exposure_s
    return table.dark_e if table.dark_share is None else table.dark_share * signal


_NOISE = {
    "shot": ("noise of the light", "√N, Behr 1989, table 3.3"),
    "dark": ("noise of the dark current", "√N, Behr 1989, table 3.3"),
    "transfer": ("noise of shifting charges", "√(2 ε n N), Behr 1989, table 3.3"),
    "amplifier": ("noise of amplifier and reading", "400 √C or as given, Behr 1989, table 3.3"),
    "quantisation": ("noise of quantisation", "Behr 1989, eq. 3.14"),
}


def _noise(described: SensorDescription) -> Found:
    table, budget = described.noise, noise_budget(described)
    assert table is not None and budget is not None
    yield "signal_e", "signal", budget.signal_e, "e⁻", "as given" if table.signal_e is not None else "full well"
    current = _dark_current(table)
    if current is not None and table.temperature_c is not None:
        words = f"dark current at {table.temperature_c:g} °C"
        yield "dark_current_e_s", words, current, "e⁻/s", "Behr 1989, §3.6.4"
    if budget.dark_e is not None:
        yield "dark_e", "dark signal", budget.dark_e, "e⁻", "Behr 1989, §3.6.4"
    for name, value in budget.sources().items():
        meaning, source = _NOISE[name]
        yield f"noise_{name}_e", meaning, value, "e⁻", source
    yield "noise_total_e", "total noise", budget.total, "e⁻", "root of the sum of squares"
    yield "noise_sum_e", "plain sum of the sources", budget.plain_sum, "e⁻", "total of Behr 1989, table 3.3"
    yield "signal_to_noise", "signal through total noise", budget.signal_to_noise, "", "signal / total"
    yield "signal_to_noise_db", "the same", budget.signal_to_noise_db, "dB", "20 log10"
    yield "signal_to_noise_bit", "the same", budget.signal_to_noise_bits, "bit", "log2"
    if table.full_well_e is not None and budget.without_signal > 0.0:
        spread = table.full_well_e / budget.without_signal
        yield "dynamic_range", "full well through the noise without light", spread, "", "full well / noise in the dark"


def _optics(table: OpticsEntry, chip: Chip | None) -> Found:
    cutoff = sensor.diffraction_cutoff(table.f_number, table.wavelength_nm)
    yield "diffraction_limit_lp_mm", "diffraction limit of the lens", cutoff, "LP/mm", "1 / (λ N)"
    airy = 2.44 * table.wavelength_nm * table.f_number / 1000.0
    yield "airy_um", "diameter of the Airy disc", airy, "µm", "2.44 λ N"
    if chip is None:
        return
    for k, (axis, along) in enumerate(zip(_AXES, _ALONG)):
        limit = float(sensor.nyquist(chip.pitch[k]))
        for share in SHARES:
            lens = float(sensor.diffraction_mtf(share * limit, cutoff))
            name, at = f"{axis}_{100 * share:.0f}", f"at {share:g} Nyquist, {along}"
            yield f"mtf_diffraction_{name}", f"MTF of a perfect lens {at}", lens, "", "disc autocorrelation"
            if chip.sensitive_um is not None:
                both = lens * float(sensor.aperture_mtf(share * limit, chip.sensitive_um[k]))
                yield f"mtf_both_{name}", f"MTF of lens and sensitive width {at}", both, "", "product of both"
