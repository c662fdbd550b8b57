"""Analysis `line_jitter`: straight edges as plumb lines."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence

import numpy as np

from photoplan.io.series.model import EdgeEntry
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.groups import FrameGroup, frame_groups
from photoplan.products.characterise.jitter_edge import Edge, measured_edge
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.quality.camera.line_jitter import grey_error
from photoplan.quality.camera.parallel_edges import EdgePair, above_control, compare_edges


def jitter_charts(edges: Sequence[Edge]) -> list[Chart]:
    """Deviations of every edge of a frame, and their spectra."""
    charts = [_deviations(edge) for edge in edges]
    curves = []
    for k, edge in enumerate(edges):
        s = edge.jitter.spectrum
        curves.append(Trace(1.0 / s.frequency, 100 * s.power, edge.entry.name, "line", colour=k))
        level = np.full(2, 100 * s.level)
        curves.append(Trace(1.0 / s.frequency[[0, -1]], level, "", "dashed", colour=k))
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
    curves = [Trace(line[j.used], j.deviation[j.used], "deviation", "points", colour=5)]
    if j.harmonics or j.fields_differ:
        if j.fields_differ:
            for first, name, colour in ((0, "even", 0), (1, "odd", 2)):
                rows_of = line % 2 == first
                curves.append(
                    Trace(line[rows_of], j.regular[rows_of], f"regular part, {name} rows", "line", colour=colour)
                )
        else:
            curves.append(Trace(line, j.regular, "periodic part", "line", colour=0))
    if j.spikes:
        shown = np.abs(j.deviation) <= 20 * max(j.sigma, 0.05)
        spikes = ~j.used & shown
        hidden = int((~shown & ~j.used).sum())
        label = "spikes" + (f" ({hidden} lie outside)" if hidden else "")
        curves.append(Trace(line[spikes], j.deviation[spikes], label, "points", colour=1))
    shape = "straight line" if j.degree == 1 else f"polynomial of degree {j.degree}"
    rows = "row" if edge.entry.direction == "vertical" else "column"
    return Chart(
        f"Edge {edge.entry.name}, {edge.frame.file.name}",
        f"Deviations d_i from the adjusted {shape} (Behr 1989, fig. 4.4), standard deviation {j.sigma:.3f} px.",
        rows,
        "deviation px",
        tuple(curves),
    )


_CHARTS = 4
"""Frames that are drawn."""


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    if not data.series.of("plumb"):
        return "plumb frames: a straight vertical edge, two parallel ones, or a horizontal one as control"
    if data.series.camera.bayer is not None:
        return "frames without a Bayer pattern: its rows show other colours in turn"
    return None


def analyse(data: SeriesData) -> Findings:
    """Every edge in every frame, pairs of vertical edges, and vertical ones beside the control."""
    measured = [(group, _measured(data, group)) for group in frame_groups(data, "plumb")]
    controls = [edges for _, found in measured for edges in found.values() if edges[0].entry.direction == "horizontal"]
    return joined([_group(data, group, found, controls) for group, found in measured])


def _measured(data: SeriesData, group: FrameGroup) -> dict[str, list[Edge]]:
    """Every edge of an entry in every frame, by the edge's name."""
    window = group.group.window
    roi = (window.col, window.row, window.width, window.height)
    direction = group.word("direction", ("vertical", "horizontal"))
    entries = group.group.entry.edges or (
        EdgeEntry(name="edge", roi=roi, direction="horizontal" if direction == "horizontal" else "vertical"),
    )
    degree = int(group.number("degree", 1, 1, 3)) if group.has("degree") else None
    found: dict[str, list[Edge]] = {e.name: [] for e in entries}
    for frame in group.frames:
        for entry in entries:
            found[entry.name].append(measured_edge(data, frame, entry, degree))
        data.watch(1)
    return found


def _group(data: SeriesData, group: FrameGroup, found: dict[str, list[Edge]], controls: list[list[Edge]]) -> Findings:
    # A control of the same frames comes first.
    own = [edges for edges in found.values() if edges[0].entry.direction == "horizontal"]
    control = next(iter(own or controls), None)
    vertical = [edges for edges in found.values() if edges[0].entry.direction == "vertical"]
    parts = [_figures(data, group, edges, control) for edges in found.values()]
    if len(vertical) > 1:
        parts.append(_pair(group, vertical[0], vertical[1]))
    elif vertical:
        parts.append(Findings(notes=(f"{group.label}: two parallel edges are needed to tell where jitter comes from",)))
    if control is None:
        parts.append(Findings(notes=(f"{group.label}: without a horizontal edge the method's noise is not checked",)))
    rows = tuple(_row(data, group, edge) for edges in found.values() for edge in edges)
    plots = [jitter_charts([edges[k] for edges in found.values()]) for k in range(min(_CHARTS, len(group.frames)))]
    table = Listing(_HEAD, rows, "Edges by frame")
    charts = tuple(chart for each in plots for chart in each)
    name = f"line_jitter_lines_{group.group.index + 1}.csv"
    return joined([*parts, Findings(tables={"edges": table}, plots=charts, files={name: _lines_text(found)})])


def _mean(values: list[float], sigmas: list[float]) -> tuple[float, float]:
    """Mean over frames with its standard deviation: from their scatter, of a single frame its own."""
    if len(values) < 2:
        return values[0], sigmas[0]
    return float(np.mean(values)), float(np.std(values, ddof=1)) / math.sqrt(len(values))


def _figures(data: SeriesData, group: FrameGroup, edges: list[Edge], control: list[Edge] | None) -> Findings:
    entry, figures, refused = edges[0].entry, [], {}
    at = f"{group.label}, {entry.name}" if len(frame_groups(data, "plumb")) > 1 else entry.name
    lines = [len(e.jitter.line) for e in edges]

    def add(
        name: str, values: list[float], sigmas: list[float], label: str, unit: str = "px", remark: str = ""
    ) -> None:
        figures.append(Figure(name, *_mean(values, sigmas), label, unit, "", at, remark))

    def with_spread(values: list[float]) -> tuple[list[float], list[float]]:
        return values, [v / math.sqrt(2.0 * max(n - 3, 1)) for v, n in zip(values, lines)]

    sigma = [e.jitter.sigma for e in edges]
    add("sigma_px", *with_spread(sigma), "standard deviation of d_i, least squares")
    by_correlation = [e.correlated.sigma for e in edges]
    add("sigma_correlation_px", *with_spread(by_correlation), "the same by correlation (eq. 4.8 to 4.10)")
    formal = [float(np.nanmean(e.fitted.sigma)) for e in edges]
    add("pixel_noise_px", *with_spread(formal), "of it from noise of the pixels")
    beside = [e.jitter.neighbour_sigma for e in edges]
    add("neighbours_px", *with_spread(beside), "difference of neighbouring lines, rms")
    add("residual_px", *with_spread([e.jitter.residual_sigma for e in edges]), "without fields and periodic parts")
    if entry.direction == "vertical":
        offsets, theirs = [e.field_offset for e in edges], [e.jitter.sigma_field_offset for e in edges]
        remark = "significant" if any(e.jitter.fields_differ for e in edges) else "not significant"
        add("field_offset_px", offsets, theirs, "odd rows minus even rows", remark=remark)
        greys = [grey_error(e.jitter.sigma, e.fitted.gradient) for e in edges]
        add("grey_error_dn", greys, [math.nan] * len(edges), "grey error at the edge by jitter (eq. 4.6)", "DN")
        if group.has("pixel_frequency_hz"):
            clock = group.number("pixel_frequency_hz", 1.0, 1.0, 1e12)
            nanoseconds = [1e9 * s / clock for s in sigma]
            add("jitter_ns", *with_spread(nanoseconds), "standard deviation as time (eq. 4.5)", "ns")
        if control is not None:
            beyond = [above_control(e.jitter, control[k % len(control)].jitter) for k, e in enumerate(edges)]
            remark = f"chance of none {max(b.probability for b in beyond):.1g}"
            add(
                "jitter_px",
                [b.sigma for b in beyond],
                [b.sigma_sigma for b in beyond],
                "beyond the control",
                "px",
                remark,
            )
    if not any(e.jitter.harmonics for e in edges):
        refused[f"periodic part, {at}"] = "no oscillation is significant (chance of a false alarm below 1 ‰)"
    figures += _periodic(data, edges, at)
    spikes = sum(len(e.jitter.spikes) for e in edges)
    figures.append(
        Figure(
            name="spikes",
            value=spikes,
            sigma=math.nan,
            label="lines with spikes",
            unit="",
            plane="",
            at=at,
            remark=f"of {sum(lines)}",
        )
    )
    lost = sum(len(e.jitter.missing) for e in edges)
    figures.append(Figure("missing_lines", lost, math.nan, "lines without an edge", "", "", at))
    return Findings(tuple(figures), refused, notes=_curved(edges, at))


def _periodic(data: SeriesData, edges: list[Edge], at: str) -> list[Figure]:
    """Of the first frame in which there is one; the table holds all frames."""
    camera = data.series.camera
    figures = []
    edge = next((e for e in edges if e.jitter.harmonics), None)
    for k, h in enumerate(edge.jitter.harmonics if edge is not None else (), 1):
        which = f"{at}, oscillation {k}"
        chance = f"chance of a false alarm {h.probability:.1g}"
        if len(edges) > 1:
            chance += f"; of {edge.frame.file.name}, the others are in the table" if edge is not None else ""
        figures.append(
            Figure(
                name="amplitude_px",
                value=h.amplitude,
                sigma=h.sigma_amplitude,
                label="amplitude",
                unit="px",
                plane="",
                at=which,
                remark=chance,
            )
        )
        figures.append(Figure("period_lines", h.period, h.sigma_period, "period", "lines", "", which))
        if camera.line_frequency_hz is not None and edge is not None and edge.entry.direction == "vertical":
            hertz = h.hertz(1.0 / camera.line_frequency_hz, camera.interlaced)
            remark = "two rows of the image are one line of a field" if camera.interlaced else ""
            sigma = hertz * h.sigma_period / h.period
            figures.append(
                Figure(
                    name="frequency_hz",
                    value=hertz,
                    sigma=sigma,
                    label="frequency",
                    unit="Hz",
                    plane="",
                    at=which,
                    remark=remark,
                )
            )
    return figures


def _curved(edges: list[Edge], at: str) -> tuple[str, ...]:
    bent = [e for e in edges if e.jitter.degree > 1]
    if not bent:
        return ()
    worst = max(bent, key=lambda e: e.jitter.sagitta)
    return (
        f"{at}: the edge is curved in {len(bent)} of {len(edges)} frames, by up to {worst.jitter.sagitta:.2f} px; "
        f"deviations refer to a polynomial of degree {worst.jitter.degree}. Fall-off of light and distortion do this",
    )


def _pair(group: FrameGroup, first: list[Edge], second: list[Edge]) -> Findings:
    """Two vertical edges over all frames."""
    both = [(a.jitter, b.jitter, b.first_line - a.first_line) for a, b in zip(first, second)]
    pairs = [compare_edges(*each) for each in both]
    random = [compare_edges(*each, periodic=False) for each in both]
    at = f"{first[0].entry.name} and {second[0].entry.name}"
    figures = []
    for prefix, what, of in (("", "", pairs), ("random_", " without fields and periodic parts", random)):
        r, sigma = _correlation(of)
        label = f"correlation of the deviations{what}"
        figures.append(
            Figure(
                name=f"{prefix}correlation",
                value=r,
                sigma=sigma,
                label=label,
                unit="",
                plane="",
                at=at,
                remark=of[0].verdict,
            )
        )
        common, of_common = _mean([p.common_sigma for p in of], [p.sigma_common for p in of])
        figures.append(Figure(f"{prefix}common_px", common, of_common, f"common part{what}", "px", "", at))
        for k, edges in enumerate((first, second)):
            own = float(np.sqrt(np.mean([p.own_sigma[k] ** 2 for p in of])))
            name = edges[0].entry.name
            figures.append(Figure(f"{prefix}own_px", own, math.nan, f"own part{what}", "px", "", name))
    shared, single = (sum(len(s) for s in each) for each in zip(*((p.common_spikes, p.single_spikes) for p in pairs)))
    note = f"{group.label}: {shared} spikes in both edges, {single} in one only" if shared or single else ""
    return Findings(tuple(figures), notes=(note,) if note else ())


def _correlation(pairs: Sequence[EdgePair]) -> tuple[float, float]:
    """Mean over frames and its standard deviation."""
    z = [math.atanh(min(max(p.correlation, -0.999999), 0.999999)) for p in pairs]
    sigma = float(np.mean([(p.high - p.low) / (2 * 1.96) for p in pairs])) / math.sqrt(len(pairs))
    return math.tanh(float(np.mean(z))), sigma


_HEAD = (
    "edge",
    "frame",
    "lines",
    "sigma_px",
    "sigma_correlation_px",
    "residual_px",
    "field_offset_px",
    "sigma_field_offset_px",
    "degree",
    "sagitta_px",
    "amplitude_px",
    "period_lines",
    "phase_rad",
    "spikes",
    "contrast_dn",
    "width_px",
)


def _row(data: SeriesData, group: FrameGroup, edge: Edge) -> tuple[str | float | int, ...]:
    j = edge.jitter
    h = j.harmonics[0] if j.harmonics else None
    spikes = " ".join(f"{edge.first_line + s.line}:{s.deviation:+.2f}" for s in j.spikes[:50])
    return (
        edge.entry.name,
        edge.frame.file.name,
        len(j.line),
        j.sigma,
        edge.correlated.sigma,
        j.residual_sigma,
        edge.field_offset,
        j.sigma_field_offset,
        j.degree,
        j.sagitta,
        "" if h is None else h.amplitude,
        "" if h is None else h.period,
        "" if h is None else h.phase,
        spikes,
        edge.fitted.contrast,
        edge.fitted.width,
    )


def _lines_text(found: Mapping[str, Sequence[Edge]]) -> bytes:
    """Every line of every edge as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("edge", "frame", "line", "position_px", "deviation_px", "regular_px", "used"))
    for edge in (edge for edges in found.values() for edge in edges):
        j, where = edge.jitter, (edge.entry.name, edge.frame.file.name)
        for line, p, d, r, u in zip(j.line, j.position, j.deviation, j.regular, j.used):
            writer.writerow((*where, edge.first_line + int(line), f"{p:.5f}", f"{d:.5f}", f"{r:.5f}", int(u)))
    return text.getvalue().encode()
