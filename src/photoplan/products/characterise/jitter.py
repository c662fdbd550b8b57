"""Analysis `line_jitter`: straight edges as plumb lines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photoplan.errors import InputError
from photoplan.findings import Chart, Estimate, Findings, Subject, Table, Trace, joined
from photoplan.geometry.grid import Window
from photoplan.io.series import EdgeEntry, SeriesFrame, frame_pixels
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.groups import FrameGroup, frame_groups
from photoplan.quality.camera.geometry import EdgeLines, correlate_edge, fit_edge
from photoplan.quality.camera.sensor import jitter_grey
from photoplan.quality.camera.video import LineJitter, above_control, compare_edges, line_jitter, mean_correlation

#: Frames that are drawn.
_CHARTS = 4


@dataclass(frozen=True, eq=False)
class Edge:
    """An edge in a frame."""

    entry: EdgeEntry
    frame: SeriesFrame
    window: Window
    fitted: EdgeLines
    jitter: LineJitter
    """Jitter of the least-squares positions."""
    correlated: LineJitter
    """Jitter of the positions by correlation and parabola."""

    @property
    def first_line(self) -> int:
        """Row (column, of a horizontal edge) of the image in which line 0 lies."""
        return self.window.row if self.entry.direction == "vertical" else self.window.col

    @property
    def field_offset(self) -> float:
        """Odd rows minus even rows of the image."""
        return -self.jitter.field_offset if self.first_line % 2 else self.jitter.field_offset


def measured_edge(data: SeriesData, frame: SeriesFrame, entry: EdgeEntry, degree: int | None) -> Edge:
    """An edge of a frame by least squares and by correlation, and the jitter of both."""
    window = Window(*entry.roi)
    assert data.series.size is not None
    if window.stop[0] > data.series.size[0] or window.stop[1] > data.series.size[1]:
        raise InputError(
            f"{frame.group.label}: edge {entry.name}: roi {list(entry.roi)} leaves the image of "
            f"{data.series.size[0]} × {data.series.size[1]} pixels"
        )
    grey = frame_pixels(frame, window)[0].astype(float)
    lines = grey if entry.direction == "vertical" else grey.T
    name = f"{frame.file.name}, edge {entry.name}"
    saturation = data.saturation_dn(data.planes[0].name)
    fitted = fit_edge(lines, name=name, saturation=saturation if math.isfinite(saturation) else None)
    by_correlation = correlate_edge(lines, fitted, name=name)
    return Edge(
        entry=entry,
        frame=frame,
        window=window,
        fitted=fitted,
        jitter=line_jitter(fitted.position, name, degree),
        correlated=line_jitter(by_correlation.position, name, degree),
    )


def _charts(edges: Sequence[Edge]) -> list[Chart]:
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
            title=f"Periods, {file}",
            caption="Share of the deviations' sum of squares that an oscillation of each period explains; dashed: "
            "what noise exceeds anywhere with a chance of 1 ‰.",
            x_label="period, lines",
            y_label="% explained",
            curves=tuple(curves),
            log_x=True,
        )
    )
    return charts


def _deviations(edge: Edge) -> Chart:
    j, line = edge.jitter, edge.first_line + edge.jitter.line
    curves = [Trace(line[j.used], j.deviation[j.used], "deviation", "points", colour=5)]
    if j.fields_differ:
        for first, name, colour in ((0, "even", 0), (1, "odd", 2)):
            of = line % 2 == first
            curves.append(Trace(line[of], j.regular[of], f"regular part, {name} rows", "line", colour=colour))
    elif j.harmonics:
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
        title=f"Edge {edge.entry.name}, {edge.frame.file.name}",
        caption=f"Deviations d_i from the adjusted {shape} (Behr 1989, fig. 4.4), standard deviation {j.sigma:.3f} px.",
        x_label=rows,
        y_label="deviation px",
        curves=tuple(curves),
    )


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
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
    plots = [_charts([edges[k] for edges in found.values()]) for k in range(min(_CHARTS, len(group.frames)))]
    every = [edge for edges in found.values() for edge in edges]
    table = _table(every)
    charts = tuple(chart for each in plots for chart in each)
    name = f"line_jitter_lines_{group.group.index + 1}.csv"
    return joined([*parts, Findings(tables={"edges": table}, plots=charts, files={name: _lines(every)})])


def _mean(values: list[float], sigmas: list[float]) -> tuple[float, float]:
    """Mean over frames with its standard deviation: from their scatter, of a single frame its own."""
    if len(values) < 2:
        return values[0], sigmas[0]
    return float(np.mean(values)), float(np.std(values, ddof=1)) / math.sqrt(len(values))


def _figures(data: SeriesData, group: FrameGroup, edges: list[Edge], control: list[Edge] | None) -> Findings:
    entry, jitters = edges[0].entry, [e.jitter for e in edges]
    of = Subject(at=f"{group.label}, {entry.name}" if len(frame_groups(data, "plumb")) > 1 else entry.name)
    lines = [len(j.line) for j in jitters]
    figures: list[Estimate] = []

    def add(name: str, values: list[float], label: str, unit: str = "px") -> None:
        """A standard deviation over the lines of each frame, whose own accuracy follows from their number."""
        sigmas = [v / math.sqrt(2.0 * max(n - 3, 1)) for v, n in zip(values, lines)]
        figures.append(of.figure(name, *_mean(values, sigmas), label, unit))

    sigma = [j.sigma for j in jitters]
    add("sigma_px", sigma, "standard deviation of d_i, least squares")
    add("sigma_correlation_px", [e.correlated.sigma for e in edges], "the same by correlation (eq. 4.8 to 4.10)")
    add("pixel_noise_px", [float(np.nanmean(e.fitted.sigma)) for e in edges], "of it from noise of the pixels")
    add("neighbours_px", [j.neighbour_sigma for j in jitters], "difference of neighbouring lines, rms")
    add("residual_px", [j.residual_sigma for j in jitters], "without fields and periodic parts")
    if entry.direction == "vertical":
        offset = _mean([e.field_offset for e in edges], [j.sigma_field_offset for j in jitters])
        remark = "significant" if any(j.fields_differ for j in jitters) else "not significant"
        figures.append(of.figure("field_offset_px", *offset, "odd rows minus even rows", "px", remark))
        greys = [jitter_grey(e.jitter.sigma, e.fitted.gradient, 1.0) for e in edges]
        grey = _mean(greys, [math.nan] * len(edges))
        figures.append(of.figure("grey_error_dn", *grey, "grey error at the edge by jitter (eq. 4.6)", "DN"))
        if group.has("pixel_frequency_hz"):
            clock = group.number("pixel_frequency_hz", 1.0, 1.0, 1e12)
            add("jitter_ns", [1e9 * s / clock for s in sigma], "standard deviation as time (eq. 4.5)", "ns")
        if control is not None:
            beyond = [above_control(j, control[k % len(control)].jitter) for k, j in enumerate(jitters)]
            remark = f"chance of none {max(b.probability for b in beyond):.1g}"
            both = _mean([b.sigma for b in beyond], [b.sigma_sigma for b in beyond])
            figures.append(of.figure("jitter_px", *both, "beyond the control", "px", remark))
    refused = {}
    if not any(j.harmonics for j in jitters):
        refused[f"periodic part, {of.at}"] = "no oscillation is significant (chance of a false alarm below 1 ‰)"
    figures += _periodic(data, edges, of.at)
    spikes, missed = sum(len(j.spikes) for j in jitters), sum(len(j.missing) for j in jitters)
    figures.append(of.figure("spikes", spikes, math.nan, "lines with spikes", "", f"of {sum(lines)}"))
    figures.append(of.figure("missing_lines", missed, math.nan, "lines without an edge"))
    return Findings(tuple(figures), refused, notes=_curved(edges, of.at))


def _periodic(data: SeriesData, edges: list[Edge], at: str) -> list[Estimate]:
    """Return the findings of the first frame that has some; the table holds all frames."""
    edge = next((e for e in edges if e.jitter.harmonics), None)
    if edge is None:
        return []
    camera, figures = data.series.camera, []
    others = f"; of {edge.frame.file.name}, the others are in the table" if len(edges) > 1 else ""
    for k, h in enumerate(edge.jitter.harmonics, 1):
        of, chance = Subject(at=f"{at}, oscillation {k}"), f"chance of a false alarm {h.probability:.1g}{others}"
        figures.append(of.figure("amplitude_px", h.amplitude, h.sigma_amplitude, "amplitude", "px", chance))
        figures.append(of.figure("period_lines", h.period, h.sigma_period, "period", "lines"))
        if camera.line_frequency_hz is not None and edge.entry.direction == "vertical":
            hertz = h.hertz(1.0 / camera.line_frequency_hz, camera.interlaced)
            remark = "two rows of the image are one line of a field" if camera.interlaced else ""
            figures.append(
                of.figure("frequency_hz", hertz, hertz * h.sigma_period / h.period, "frequency", "Hz", remark)
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
    for prefix, what, of_pairs in (("", "", pairs), ("random_", " without fields and periodic parts", random)):
        of, verdict = Subject(at=at), of_pairs[0].verdict
        r = mean_correlation(of_pairs)
        figures.append(of.figure(f"{prefix}correlation", *r, f"correlation of the deviations{what}", "", verdict))
        common = _mean([p.common_sigma for p in of_pairs], [p.sigma_common for p in of_pairs])
        figures.append(of.figure(f"{prefix}common_px", *common, f"common part{what}", "px"))
        for k, edges in enumerate((first, second)):
            own = float(np.sqrt(np.mean([p.own_sigma[k] ** 2 for p in of_pairs])))
            mine = Subject(at=edges[0].entry.name)
            figures.append(mine.figure(f"{prefix}own_px", own, math.nan, f"own part{what}", "px"))
    shared, single = (sum(len(s) for s in each) for each in zip(*((p.common_spikes, p.single_spikes) for p in pairs)))
    note = f"{group.label}: {shared} spikes in both edges, {single} in one only" if shared or single else ""
    return Findings(tuple(figures), notes=(note,) if note else ())


def _table(edges: Sequence[Edge]) -> Table:
    jitters = [e.jitter for e in edges]
    first = [j.harmonics[0] if j.harmonics else None for j in jitters]
    return Table.of(
        "Edges by frame",
        edge=[e.entry.name for e in edges],
        frame=[e.frame.file.name for e in edges],
        lines=[len(j.line) for j in jitters],
        sigma_px=[j.sigma for j in jitters],
        sigma_correlation_px=[e.correlated.sigma for e in edges],
        residual_px=[j.residual_sigma for j in jitters],
        field_offset_px=[e.field_offset for e in edges],
        sigma_field_offset_px=[j.sigma_field_offset for j in jitters],
        degree=[j.degree for j in jitters],
        sagitta_px=[j.sagitta for j in jitters],
        amplitude_px=["" if h is None else h.amplitude for h in first],
        period_lines=["" if h is None else h.period for h in first],
        phase_rad=["" if h is None else h.phase for h in first],
        spikes=[" ".join(f"{e.first_line + s.line}:{s.deviation:+.2f}" for s in e.jitter.spikes[:50]) for e in edges],
        contrast_dn=[e.fitted.contrast for e in edges],
        width_px=[e.fitted.width for e in edges],
    )


def _lines(edges: Sequence[Edge]) -> Table:
    """Every line of every edge."""
    rows = [
        (e.entry.name, e.frame.file.name, e.first_line + int(line), f"{p:.5f}", f"{d:.5f}", f"{r:.5f}", int(used))
        for e in edges
        for line, p, d, r, used in zip(
            e.jitter.line, e.jitter.position, e.jitter.deviation, e.jitter.regular, e.jitter.used
        )
    ]
    return Table(("edge", "frame", "line", "position_px", "deviation_px", "regular_px", "used"), tuple(rows))
