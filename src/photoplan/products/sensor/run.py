"""`photoplan sensor`: figures of a sensor from its description, as values and table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from photoplan.io.product import check_output
from photoplan.io.sensor_file import SensorDescription, read_sensor
from photoplan.io.tables import write_table
from photoplan.plain import pick
from photoplan.products.sensor.figures import SensorFigure, sensor_figures


@dataclass(frozen=True)
class SensorRequest:
    """What is asked."""

    file: Path
    """The description."""
    csv: Path | None = None
    """Table to write."""
    overwrite: bool = False
    dry_run: bool = False
    """Compute, write nothing."""


@dataclass(frozen=True)
class SensorReport:
    """Figures of a sensor."""

    described: SensorDescription
    figures: tuple[SensorFigure, ...]
    csv: Path | None
    """Table that was written."""

    def json_fields(self) -> dict[str, object]:
        """Without the description."""
        return {"name": self.described.name, "figures": self.figures}

    def __str__(self) -> str:
        lines = [self.described.name]
        section = ""
        wide = max(len(figure.meaning) for figure in self.figures)
        for figure in self.figures:
            if figure.section != section:
                section = figure.section
                lines.append(f"[{section}]")
            value = f"{short_number(figure.value)} {figure.unit}".rstrip()
            stated = "" if figure.stated is None else f"  (stated: {short_number(figure.stated)})"
            lines.append(f"  {figure.meaning:<{wide}}  {value:<18}  {figure.source}{stated}")
        return "\n".join(lines)


def short_number(value: float) -> str:
    """A figure with four digits, without an exponent where that is short."""
    if value == 0.0 or 1e-4 <= abs(value) < 1e4:
        return f"{value:.4g}"
    return f"{value:,.0f}".replace(",", " ") if 1e4 <= abs(value) < 1e9 else f"{value:.3e}"


def describe_sensor(request: SensorRequest) -> SensorReport:
    """Compute the figures of a description and write what is asked.

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
    figures = sensor_figures(described, str(request.file))
    written = None if request.dry_run else request.csv
    if written is not None:
        head = ("section", "name", "value", "unit", "stated", "meaning", "source")
        rows = (pick(figure, *head).values() for figure in figures)
        write_table(written, head, [["" if value is None else value for value in row] for row in rows])
    return SensorReport(described, figures, written)
