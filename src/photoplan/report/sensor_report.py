"""Report of a sensor's figures, with plots of charge transfer, Nyquist frequency, noise and transfer functions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, PURPLE, RED, SOFT, STYLE, axes_of, load_matplotlib, png
from photoplan.report.page import Cell, figure, page, section, table

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


@dataclass(frozen=True)
class SensorFacts:
    """What the report shows."""

    rows: tuple[tuple[str, str, str, str, str], ...]
    """Section, meaning, value, stated value, source of each figure."""
    periods_um: Mapping[str, float]
    """Periods of sampling by name."""
    sensitive_um: tuple[float, float] | None
    pitch_um: tuple[float, float] | None
    cutoff_lp_mm: float | None
    transfer_product: float | None
    noise_e: Mapping[str, float]
    """Noise of each source, electrons."""
    total_e: float | None
    curves: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]
    """Transfer functions: frequencies in LP/mm and modulation."""


class SensorPlots:
    """Draws; made before any work, so that a missing library is known at once.

    Raises
    ------
    UsageError
        When made: matplotlib is not installed.
    """

    def __init__(self) -> None:
        self._mpl = load_matplotlib("a report", "leave --report out")

    def transfer(self, product: float) -> bytes:
        """Modulation against signal through clock frequency, for some transfer inefficiency products (fig. 3.15)."""
        ratio = np.linspace(0.0, 0.5, 201)
        with self._mpl.rc_context(STYLE):
            fig, axes = axes_of(self._mpl, _WIDTH, 3.4)
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

    def nyquist(self, periods: Mapping[str, float]) -> bytes:
        """Nyquist frequency against the period of sampling (fig. 3.17), with the periods of this sensor."""
        low, high = min(periods.values()) / 2.0, max(periods.values()) * 2.0
        period = np.geomspace(low, high, 200)
        with self._mpl.rc_context(STYLE):
            fig, axes = axes_of(self._mpl, _WIDTH, 3.4)
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

    def noise(self, sources: Mapping[str, float], total: float) -> bytes:
        """Noise of each source as bars, and the total."""
        with self._mpl.rc_context(STYLE):
            fig, axes = axes_of(self._mpl, _WIDTH, 0.75 + 0.36 * (len(sources) + 1))
            names = [*sources, "total"]
            values = [*sources.values(), total]
            axes.barh(names, values, color=[BLUE] * len(sources) + [INK], height=0.62)
            for k, value in enumerate(values):
                label = f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"
                axes.annotate(label, (value, k), (4, 0), textcoords="offset points", va="center", fontsize=8.5)
            axes.invert_yaxis()
            axes.grid(visible=False, axis="y")
            axes.set(xlim=(0, 1.14 * max(values)), xlabel="electrons")
            return png(fig)

    def curves(self, facts: SensorFacts) -> bytes:
        """Transfer functions of lens and sensitive width."""
        with self._mpl.rc_context(STYLE):
            fig, axes = axes_of(self._mpl, _WIDTH, 3.4)
            for (name, (frequency, modulation)), colour in zip(facts.curves.items(), _COLOURS):
                wide = 2.0 if name.startswith("both") else 1.2
                axes.plot(frequency, modulation, color=colour, linewidth=wide, label=name)
            for pitch in dict.fromkeys(facts.pitch_um or ()):
                limit = 500.0 / pitch
                axes.axvline(limit, color=SOFT, linewidth=0.9, linestyle="--")
                axes.annotate("Nyquist", (limit, 1.02), (3, 0), textcoords="offset points", fontsize=8, color=SOFT)
            longest = max(frequency[-1] for frequency, _ in facts.curves.values())
            axes.set(xlim=(0, longest), ylim=(0, 1.09), xlabel="spatial frequency LP/mm", ylabel="modulation")
            fig.legend(loc="outside upper left", ncols=3)
            return png(fig)


def sensor_report(name: str, facts: SensorFacts, plots: SensorPlots) -> str:
    """The report as one HTML document."""
    pictures = _pictures(facts, plots)
    parts = []
    for key, title in _TITLES.items():
        rows = [row[1:] for row in facts.rows if row[0] == key]
        if not rows:
            continue
        compared = any(row[2] for row in rows)
        head = ("figure", "value", *(("stated elsewhere",) if compared else ()), "from")
        cells = [
            [Cell(what), Cell(value, True), *((Cell(stated, True),) if compared else ()), Cell(source)]
            for what, value, stated, source in rows
        ]
        parts.append(section(title, [table(head, cells), *pictures.get(key, [])]))
    return page(f"Sensor: {name}", "Figures of a sensor, computed from its description", parts)


def _pictures(facts: SensorFacts, plots: SensorPlots) -> dict[str, list[str]]:
    """Pictures of each section."""
    found: dict[str, list[str]] = {}
    if facts.transfer_product is not None:
        text = "Grey: other transfer inefficiency products nε. 0.5 is the Nyquist frequency. Behr 1989, eq. 3.15."
        found["transfer"] = [figure(plots.transfer(facts.transfer_product), "Modulation after charge transfer", text)]
    if facts.periods_um:
        text = "Half the reciprocal of the period. Behr 1989, eq. 3.23."
        place = "image" if any(name.startswith("pixel") for name in facts.periods_um) else "sensor"
        found[place] = [figure(plots.nyquist(facts.periods_um), "Nyquist frequency", text)]
    if facts.noise_e and facts.total_e is not None:
        text = "The total is the root of the sum of squares, since the sources are independent."
        found["noise"] = [figure(plots.noise(facts.noise_e, facts.total_e), "Noise budget", text)]
    if facts.curves:
        text = "The sensor can do no better than both together."
        key = "optics" if facts.cutoff_lp_mm is not None else "sensor"
        found.setdefault(key, []).append(figure(plots.curves(facts), "Modulation transfer", text))
    return found
