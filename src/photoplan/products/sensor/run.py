"""`photoplan sensor`: figures of a sensor from its description, as values, table and report."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import UsageError
from photoplan.io.disk import write_atomically
from photoplan.io.product import check_output
from photoplan.io.sensor_file import SensorDescription, read_sensor
from photoplan.products.sensor.figures import Figure, noise_budget, sensor_figures
from photoplan.quality.sensor import figures as sensor
from photoplan.report.sensor_report import SensorFacts, SensorPlots, sensor_report


@dataclass(frozen=True)
class SensorRequest:
    """What is asked."""

    file: Path
    """The description."""
    report: Path | None = None
    """HTML to write."""
    csv: Path | None = None
    """Table to write."""
    overwrite: bool = False
    dry_run: bool = False
    """Compute, write nothing."""


@dataclass(frozen=True)
class SensorReport:
    """Figures of a sensor."""

    name: str
    figures: tuple[Figure, ...]
    written: tuple[Path, ...]
    """Files that were written."""

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {
            "name": self.name,
            "figures": [figure.to_dict() for figure in self.figures],
            "written": [str(path) for path in self.written],
        }

    def __str__(self) -> str:
        lines = [self.name]
        section = ""
        wide = max(len(figure.meaning) for figure in self.figures)
        for figure in self.figures:
            if figure.section != section:
                section = figure.section
                lines.append(f"[{section}]")
            value = f"{number(figure.value)} {figure.unit}".rstrip()
            stated = "" if figure.stated is None else f"  (stated: {number(figure.stated)})"
            lines.append(f"  {figure.meaning:<{wide}}  {value:<18}  {figure.source}{stated}")
        return "\n".join(lines)


def number(value: float) -> str:
    """A figure with four digits, without an exponent where that is short."""
    if value == 0.0 or 1e-4 <= abs(value) < 1e4:
        return f"{value:.4g}"
    return f"{value:,.0f}".replace(",", " ") if 1e4 <= abs(value) < 1e9 else f"{value:.3e}"


def describe_sensor(request: SensorRequest) -> SensorReport:
    """Compute the figures of a description and write what is asked.

    Raises
    ------
    UsageError
        An output exists or is the input, or a report is asked without matplotlib.
    InputError
        The description cannot be used.
    """
    outputs = [path for path in (request.report, request.csv) if path is not None]
    if len({path.resolve() for path in outputs}) < len(outputs):
        raise UsageError(f"{outputs[0]}: report and table are the same file; give two names")
    for path in outputs:
        check_output(path, [request.file], overwrite=request.overwrite)
    plots = SensorPlots() if request.report is not None else None
    described = read_sensor(request.file)
    figures = sensor_figures(described, str(request.file))
    if request.dry_run:
        return SensorReport(described.name, figures, ())
    if request.csv is not None:
        write_atomically(request.csv, _table(figures).encode("utf-8"))
    if request.report is not None:
        assert plots is not None
        text = sensor_report(described.name, _facts(described, figures), plots)
        write_atomically(request.report, text.encode("utf-8", errors="replace"))
    return SensorReport(described.name, figures, tuple(outputs))


def _table(figures: Sequence[Figure]) -> str:
    """Figures as comma-separated values."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["section", "name", "value", "unit", "stated", "meaning", "source"])
    for f in figures:
        stated = "" if f.stated is None else repr(f.stated)
        writer.writerow([f.section, f.name, repr(f.value), f.unit, stated, f.meaning, f.source])
    return out.getvalue()


def _facts(described: SensorDescription, figures: Sequence[Figure]) -> SensorFacts:
    """What the report shows."""
    chip, optics, shift = described.sensor, described.optics, described.transfer
    periods: dict[str, float] = {}
    if chip is not None:
        periods |= {"element, across": chip.pitch[0], "element, down": chip.pitch[1]}
    by_name = {figure.name: figure.value for figure in figures}
    for axis, along in (("x", "across"), ("y", "down")):
        if f"pixel_{axis}_um" in by_name:
            periods[f"pixel, {along}"] = by_name[f"pixel_{axis}_um"]
    budget = noise_budget(described)
    return SensorFacts(
        rows=tuple(
            (f.section, f.meaning, f"{number(f.value)} {f.unit}".rstrip(), _stated(f), f.source) for f in figures
        ),
        periods_um=periods,
        sensitive_um=None if chip is None else chip.sensitive_um,
        pitch_um=None if chip is None else chip.pitch,
        cutoff_lp_mm=None if optics is None else sensor.diffraction_cutoff(optics.f_number, optics.wavelength_nm),
        transfer_product=None if shift is None else shift.inefficiency * shift.transfers,
        noise_e={} if budget is None else budget.sources(),
        total_e=None if budget is None else budget.total,
        curves=_curves(described),
    )


def _stated(figure: Figure) -> str:
    return "" if figure.stated is None else f"{number(figure.stated)} {figure.unit}".rstrip()


def _curves(described: SensorDescription) -> dict[str, tuple[tuple[float, ...], tuple[float, ...]]]:
    """Transfer functions to draw: name, frequencies in LP/mm, modulation."""
    chip, optics = described.sensor, described.optics
    if chip is None or (chip.sensitive_um is None and optics is None):
        return {}
    highest = max(float(sensor.nyquist(pitch)) for pitch in chip.pitch)
    frequency = [2.0 * highest * k / 200 for k in range(201)]
    curves: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {}
    lens = [1.0] * len(frequency)
    if optics is not None:
        cutoff = sensor.diffraction_cutoff(optics.f_number, optics.wavelength_nm)
        lens = sensor.diffraction_mtf(frequency, cutoff).tolist()
        curves["perfect lens"] = tuple(frequency), tuple(lens)
    if chip.sensitive_um is None:
        return curves
    same = chip.sensitive_um[0] == chip.sensitive_um[1]
    for width, along in zip(chip.sensitive_um[: 1 if same else 2], ("across", "down")):
        place = "" if same else f", {along}"
        aperture = sensor.aperture_mtf(frequency, width).tolist()
        curves[f"sensitive width{place}"] = tuple(frequency), tuple(aperture)
        if optics is not None:
            curves[f"both{place}"] = tuple(frequency), tuple(a * b for a, b in zip(aperture, lens))
    return curves
