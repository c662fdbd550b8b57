"""Report of a sensor's figures, with plots of charge transfer, Nyquist frequency, noise and transfer functions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from photoplan.io.quality_files import Chip, SensorDescription
from photoplan.products.sensor import SensorReport, noise_budget, short_number
from photoplan.quality import sensor
from photoplan.quality.sensor import NoiseBudget
from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, PURPLE, RED, SOFT, axes_of, png, styled
from photoplan.report.page import Cell, figure, page, section, table

Array = NDArray[np.float64]

_WIDTH = 6.2
_COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE)
_TITLES = {
    "viewing": "Viewing",
    "video": "Video norm",
    "sensor": "Sensor",
    "image": "Digital image",
    "transfer": "Charge transfer",
    "noise": "Noise",
    "optics": "Lens",
}


@styled
def draw_transfer(product: float) -> bytes:
    """Modulation against signal through clock frequency, for some transfer inefficiency products (fig. 3.15)."""
    ratio = np.linspace(0.0, 0.5, 201)
    fig, axes = axes_of(_WIDTH, 3.4)
    for others in (0.01, 0.1, 0.3, 0.7, 2.0):
        curve = np.exp(-others * (1.0 - np.cos(2.0 * np.pi * ratio)))
        axes.plot(ratio, curve, color=SOFT, linewidth=0.9)
        axes.annotate(f"{others:g}", (0.5, curve[-1]), (4, 0), textcoords="offset points", fontsize=8,
                      color=SOFT, va="center", annotation_clip=False)  # fmt: skip
    curve = np.exp(-product * (1.0 - np.cos(2.0 * np.pi * ratio)))
    axes.plot(ratio, curve, color=BLUE, linewidth=2.0, label=f"this sensor, nε = {product:.3g}")
    axes.set(xlim=(0, 0.5), ylim=(0, 1.05), xlabel="signal frequency through clock frequency",
             ylabel="modulation that is left")  # fmt: skip
    fig.legend(loc="outside upper left")
    return png(fig)


@styled
def draw_nyquist(periods: Mapping[str, float]) -> bytes:
    """Nyquist frequency against the period of sampling (fig. 3.17), with the periods of this sensor."""
    low, high = min(periods.values()) / 2.0, max(periods.values()) * 2.0
    period = np.geomspace(low, high, 200)
    fig, axes = axes_of(_WIDTH, 3.4)
    axes.plot(period, 500.0 / period, color=INK, linewidth=1.2)
    same = {value: [n for n, v in periods.items() if v == value] for value in periods.values()}
    for (value, names), colour in zip(same.items(), _COLOURS):
        axes.plot([value, value, low], [0, 500.0 / value, 500.0 / value], color=colour, linewidth=0.8)
        label = "\n".join([*names, f"{value:.4g} µm, {500.0 / value:.1f} LP/mm"])  # one line is too wide
        axes.plot([value], [500.0 / value], "o", color=colour, label=label)
    axes.set(xlim=(low, high), ylim=(0, 500.0 / min(periods.values()) * 1.3), xlabel="period of sampling µm",
             ylabel="Nyquist frequency LP/mm")  # fmt: skip
    axes.legend(loc="upper right")
    return png(fig)


@styled
def draw_noise(budget: NoiseBudget) -> bytes:
    """Noise of each source as bars, and the total."""
    sources = budget.sources()
    fig, axes = axes_of(_WIDTH, 0.75 + 0.36 * (len(sources) + 1))
    names = [*sources, "total"]
    values = [*sources.values(), budget.total]
    axes.barh(names, values, color=[BLUE] * len(sources) + [INK], height=0.62)
    for k, value in enumerate(values):
        label = f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"
        axes.annotate(label, (value, k), (4, 0), textcoords="offset points", va="center", fontsize=8.5)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set(xlim=(0, 1.14 * max(values)), xlabel="electrons")
    return png(fig)


@styled
def draw_curves(curves: Mapping[str, tuple[Array, Array]], chip: Chip) -> bytes:
    """Transfer functions of lens and sensitive width."""
    fig, axes = axes_of(_WIDTH, 3.4)
    for (name, (frequency, modulation)), colour in zip(curves.items(), _COLOURS):
        wide = 2.0 if name.startswith("both") else 1.2
        axes.plot(frequency, modulation, color=colour, linewidth=wide, label=name)
    for pitch in dict.fromkeys(chip.pitch):
        limit = 500.0 / pitch
        axes.axvline(limit, color=SOFT, linewidth=0.9, linestyle="--")
        axes.annotate("Nyquist", (limit, 1.02), (3, 0), textcoords="offset points", fontsize=8, color=SOFT)
    longest = max(frequency[-1] for frequency, _ in curves.values())
    axes.set(xlim=(0, longest), ylim=(0, 1.09), xlabel="spatial frequency LP/mm", ylabel="modulation")
    fig.legend(loc="outside upper left", ncols=3)
    return png(fig)


def sensor_page(found: SensorReport) -> str:
    """The report as one HTML document."""
    pictures = _pictures(found)
    parts = []
    for key, title in _TITLES.items():
        figures = [f for f in found.figures if f.section == key]
        if not figures:
            continue
        compared = any(f.stated is not None for f in figures)
        head = ("figure", "value", *(("stated elsewhere",) if compared else ()), "from")
        rows = [
            [
                Cell(f.meaning),
                Cell(_value(f.value, f.unit), True),
                *((Cell(_value(f.stated, f.unit), True),) if compared else ()),
                Cell(f.source),
            ]
            for f in figures
        ]
        parts.append(section(title, [table(head, rows), *pictures.get(key, [])]))
    return page(f"Sensor: {found.described.name}", "Figures of a sensor, computed from its description", parts)


def _value(value: float | None, unit: str) -> str:
    return "" if value is None else f"{short_number(value)} {unit}".rstrip()


def _pictures(made: SensorReport) -> dict[str, list[str]]:
    """Pictures of each section."""
    found: dict[str, list[str]] = {}
    described = made.described
    if described.transfer is not None:
        text = "Grey: other transfer inefficiency products nε. 0.5 is the Nyquist frequency. Behr 1989, eq. 3.15."
        product = described.transfer.inefficiency * described.transfer.transfers
        found["transfer"] = [figure(draw_transfer(product), "Modulation after charge transfer", text)]
    periods = _periods(made)
    if periods:
        text = "Half the reciprocal of the period. Behr 1989, eq. 3.23."
        place = "image" if any(name.startswith("pixel") for name in periods) else "sensor"
        found[place] = [figure(draw_nyquist(periods), "Nyquist frequency", text)]
    budget = noise_budget(described)
    if budget is not None and budget.sources():
        text = "The total is the root of the sum of squares, since the sources are independent."
        found["noise"] = [figure(draw_noise(budget), "Noise budget", text)]
    curves = _curves(described)
    if curves and described.sensor is not None:
        text = "The sensor can do no better than both together."
        key = "optics" if described.optics is not None else "sensor"
        found.setdefault(key, []).append(figure(draw_curves(curves, described.sensor), "Modulation transfer", text))
    return found


def _periods(made: SensorReport) -> dict[str, float]:
    """Periods of sampling by name, micrometres."""
    chip, periods = made.described.sensor, {}
    if chip is not None:
        periods = {"element, across": chip.pitch[0], "element, down": chip.pitch[1]}
    by_name = {figure.name: figure.value for figure in made.figures}
    for axis, along in (("x", "across"), ("y", "down")):
        if f"pixel_{axis}_um" in by_name:
            periods[f"pixel, {along}"] = by_name[f"pixel_{axis}_um"]
    return periods


def _curves(described: SensorDescription) -> dict[str, tuple[Array, Array]]:
    """Transfer functions by name: frequencies in LP/mm and modulation."""
    chip, optics = described.sensor, described.optics
    if chip is None or (chip.sensitive_um is None and optics is None):
        return {}
    frequency = np.linspace(0.0, 2.0 * max(float(sensor.nyquist(pitch)) for pitch in chip.pitch), 201)
    curves = {}
    lens = np.ones_like(frequency)
    if optics is not None:
        lens = sensor.diffraction_mtf(frequency, sensor.diffraction_cutoff(optics.f_number, optics.wavelength_nm))
        curves["perfect lens"] = frequency, lens
    if chip.sensitive_um is None:
        return curves
    same = chip.sensitive_um[0] == chip.sensitive_um[1]
    for width, along in zip(chip.sensitive_um[: 1 if same else 2], ("across", "down")):
        place = "" if same else f", {along}"
        aperture = sensor.aperture_mtf(frequency, width)
        curves[f"sensitive width{place}"] = frequency, aperture
        if optics is not None:
            curves[f"both{place}"] = frequency, aperture * lens
    return curves
