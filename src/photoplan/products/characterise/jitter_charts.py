"""Plots of line jitter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from photoplan.products.characterise.charts import Chart, Curve
from photoplan.products.characterise.jitter_edge import Edge


def jitter_charts(edges: Sequence[Edge]) -> list[Chart]:
    """Deviations of every edge of a frame, and their spectra."""
    charts = [_deviations(edge) for edge in edges]
    curves = []
    for k, edge in enumerate(edges):
        s = edge.jitter.spectrum
        curves.append(Curve(1.0 / s.frequency, 100 * s.power, edge.entry.name, "line", colour=k))
        level = np.full(2, 100 * s.level)
        curves.append(Curve(1.0 / s.frequency[[0, -1]], level, "", "dashed", colour=k))
    file = edges[0].frame.file.name
    charts.append(
        Chart(
            f"Periods, {file}",
            "Share of the deviations' sum of squares that an oscillation of each period explains; dashed: what noise "
            "exceeds anywhere with a chance of 1 ‰.",
            "period, lines",
            "% explained",
            tuple(curves),
            log_x=True,
        )
    )
    return charts


def _deviations(edge: Edge) -> Chart:
    j, line = edge.jitter, edge.first_line + edge.jitter.line
    curves = [Curve(line[j.used], j.deviation[j.used], "deviation", "points", colour=5)]
    if j.harmonics or j.fields_differ:
        if j.fields_differ:
            for first, name, colour in ((0, "even", 0), (1, "odd", 2)):
                rows_of = line % 2 == first
                curves.append(
                    Curve(line[rows_of], j.regular[rows_of], f"regular part, {name} rows", "line", colour=colour)
                )
        else:
            curves.append(Curve(line, j.regular, "periodic part", "line", colour=0))
    if j.spikes:
        shown = np.abs(j.deviation) <= 20 * max(j.sigma, 0.05)
        spikes = ~j.used & shown
        hidden = int((~shown & ~j.used).sum())
        label = "spikes" + (f" ({hidden} lie outside)" if hidden else "")
        curves.append(Curve(line[spikes], j.deviation[spikes], label, "points", colour=1))
    shape = "straight line" if j.degree == 1 else f"polynomial of degree {j.degree}"
    rows = "row" if edge.entry.direction == "vertical" else "column"
    return Chart(
        f"Edge {edge.entry.name}, {edge.frame.file.name}",
        f"Deviations d_i from the adjusted {shape} (Behr 1989, fig. 4.4), standard deviation {j.sigma:.3f} px.",
        rows,
        "deviation px",
        tuple(curves),
    )
