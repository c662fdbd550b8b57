"""Stability of a camera: brightness drift, line jitter, warm-up drift, stage calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import Chart, Estimate, Findings, Subject, Table, Trace, joined, known, spaced
from photoplan.geometry.grid import Window
from photoplan.io.series import EdgeEntry, MeasuredPositions, SeriesFrame, frame_pixels
from photoplan.products.characterise.data import (
    FrameGroup,
    SeriesData,
    central_window,
    frame_groups,
    locate_targets,
    window_means,
)
from photoplan.quality.camera.drift import (
    LEAST_MEASUREMENTS,
    LEAST_VALUES,
    BrightnessDrift,
    Course,
    WarmUp,
    brightness_drift,
    warm_up,
)
from photoplan.quality.camera.geometry import (
    LEAST_POINTS,
    EdgeLines,
    StageCalibration,
    b4_lines,
    correlate_edge,
    fit_edge,
    stage_calibration,
)
from photoplan.quality.camera.sensor import jitter_grey
from photoplan.quality.camera.video import LineJitter, above_control, compare_edges, line_jitter, mean_correlation

#: Side of the window in the middle of the image (Behr 1989, §4.2.4).
WINDOW = 6


def missing_for_drift(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    groups = frame_groups(data, "drift")
    if not groups:
        return f"frames of kind drift: an even surface at {LEAST_MEASUREMENTS} or more times"
    most = max(len(g.frames) for g in groups)
    return None if most >= LEAST_MEASUREMENTS else f"{LEAST_MEASUREMENTS} drift frames in one entry; there are {most}"


def analyse_drift(data: SeriesData) -> Findings:
    """The figures of table 4.1 for every entry and plane."""
    return joined([_drift_of_group(data, g) for g in frame_groups(data, "drift")])


def _drift_of_group(data: SeriesData, group: FrameGroup) -> Findings:
    times = group.times()
    side = int(group.number("window", WINDOW * max(p.step for p in data.planes), 1, 100_000))
    window = central_window(group.group.window, side, group.group.label)
    parts = []
    for name, seen in window_means(data, group, window, "take less light").items():
        pixel = math.sqrt(float(seen.variance.mean()) / seen.pixels) if seen.pixels > 1 else None
        of = Subject(name, group.label)
        parts.append(_drift_findings(brightness_drift(times, seen.mean, pixel, spaced(group.label, name)), of, side))
    return joined(parts)


def _drift_findings(found: BrightnessDrift, of: Subject, side: int) -> Findings:
    n, nan, sigma = found.count, math.nan, found.sigma
    trend = "significant" if found.has_trend else "not significant"
    drift = "drifts" if found.drifts else "no more than noise"
    figures = [
        of.figure("mean_dn", found.mean, sigma / math.sqrt(n), "mean Ī", "DN"),
        of.figure("minimum_dn", found.minimum, nan, "smallest I_min", "DN"),
        of.figure("maximum_dn", found.maximum, nan, "largest I_max", "DN"),
        of.figure("sigma_dn", sigma, sigma / math.sqrt(2.0 * (n - 1)), "standard deviation σ_I", "DN"),
        of.figure("largest_step_dn", found.largest_step, nan, "largest step Δ_I of successive measurements", "DN"),
        of.figure(
            "short_term_sigma_dn", found.short_sigma, found.sigma_of_short, "short-term σ, from successive steps", "DN"
        ),
        of.figure("long_term_sigma_dn", found.long_sigma, nan, "long-term σ", "DN", drift),
        of.figure("trend_dn_per_hour", found.trend, found.sigma_trend, "trend", "DN/h", trend),
        of.figure("neumann_ratio", found.neumann, nan, "von Neumann ratio", "", "2 for noise, less for drift"),
    ]
    if found.pixel_noise is not None:
        figures.append(
            of.figure("pixel_noise_of_mean_dn", found.pixel_noise, nan, "noise of the pixels in a mean", "DN")
        )
    v, label = found.variation, spaced(of.at, of.plane)
    caption = "Mean grey value of the window"
    series = Table.of(caption, series=label, time_s=found.times, mean_dn=found.values)
    lapses = Table.of(
        "Variation over lapses of time",
        series=label,
        lapse_s=v.lapse,
        structure_dn=v.structure,
        pairs=v.pairs,
        allan_dn=v.allan,
    )
    return Findings(
        tuple(figures), tables={"series": series, "variation": lapses}, plots=_drift_charts(found, label, side)
    )


def _drift_charts(found: BrightnessDrift, label: str, side: int) -> tuple[Chart, ...]:
    minutes = found.times / 60.0
    line = found.trend * (found.times - found.times.mean()) / 3600.0 + found.mean
    v = found.variation
    curves = [Trace(v.lapse, v.structure, "structure function", "line and points")]
    if np.isfinite(v.allan).any():
        curves.append(Trace(v.lapse, v.allan, "Allan deviation of means", "line and points"))
        white = found.short_sigma * np.sqrt(v.lapse[0] / v.lapse)
        curves.append(Trace(v.lapse, white, "Allan deviation of white noise", "dashed"))
    return (
        Chart(
            title=f"Brightness over time, {label}",
            caption=f"Mean of {side} × {side} pixels in the middle (Behr 1989, figs. 4.15 and 4.16), and the "
            "straight trend.",
            x_label="minutes",
            y_label="grey value",
            curves=(
                Trace(minutes, found.values, "measured", "line and points"),
                Trace(minutes, line, "trend", "dashed"),
            ),
        ),
        Chart(
            title=f"Flicker and drift, {label}",
            caption="Root of half the mean squared difference of two measurements a lapse of time apart: level for "
            "white noise, rising for drift. The Allan deviation of means falls by the root of the lapse "
            "as long as noise is white.",
            x_label="lapse s",
            y_label="grey values",
            curves=tuple(curves),
            log_x=True,
            log_y=True,
        ),
    )


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


def _line_jitter_charts(edges: Sequence[Edge]) -> list[Chart]:
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


def missing_for_line_jitter(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    if not data.series.of("plumb"):
        return "plumb frames: a straight vertical edge, two parallel ones, or a horizontal one as control"
    if data.series.camera.bayer is not None:
        return "frames without a Bayer pattern: its rows show other colours in turn"
    return None


def analyse_line_jitter(data: SeriesData) -> Findings:
    """Every edge in every frame, pairs of vertical edges, and vertical ones beside the control."""
    measured = [(group, _measured(data, group)) for group in frame_groups(data, "plumb")]
    controls = [edges for _, found in measured for edges in found.values() if edges[0].entry.direction == "horizontal"]
    return joined([_line_jitter_of_group(data, group, found, controls) for group, found in measured])


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


def _line_jitter_of_group(
    data: SeriesData, group: FrameGroup, found: dict[str, list[Edge]], controls: list[list[Edge]]
) -> Findings:
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
    plots = [
        _line_jitter_charts([edges[k] for edges in found.values()]) for k in range(min(_CHARTS, len(group.frames)))
    ]
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


Array = NDArray[np.float64]

#: Distance from the end, pixels, that counts as warm.
BOUND = 0.05
_UNITS = {"px": (1.0, "px"), "parts": (1e6, "ppm"), "rad": (1e6, "µrad")}
_LABELS = {
    "shift_x": "shift of columns",
    "shift_y": "shift of rows",
    "scale": "scale",
    "scale_x": "scale of columns",
    "scale_y": "scale of rows",
    "rotation": "rotation",
    "shear": "shear",
}


@dataclass(frozen=True, eq=False)
class _Input:
    label: str
    times: Array
    positions: dict[str, Array]
    model: str | None
    reference: str
    bound: float
    notes: tuple[str, ...] = ()


def missing_for_warm_up(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    if data.series.of("target") or any(p.entry.kind == "target" for p in data.series.positions):
        return None
    return f"target frames (or a table of positions) at {LEAST_VALUES} or more times after switching on"


def analyse_warm_up(data: SeriesData) -> Findings:
    """Shift, scale and rotation of every entry and table over time."""
    inputs = [_warm_up_of_frames(data, group) for group in frame_groups(data, "target")]
    inputs += [_of_table(p) for p in data.series.positions if p.entry.kind == "target"]
    parts = []
    for each in inputs:
        try:
            found = warm_up(each.times, each.positions, model=each.model, reference=each.reference)
        except InputError as error:
            raise type(error)(f"{each.label}: {error}") from None
        parts.append(_warm_up_findings(found, each))
    return joined(parts)


def _warm_up_of_frames(data: SeriesData, group: FrameGroup) -> _Input:
    """Targets located in frames; frames at one time are repetitions."""
    for frame in group.frames:
        if frame.time_s is None:
            group.times()  # names the frame
    t = np.array([frame.time_s for frame in group.frames], float)
    back = np.flatnonzero(np.diff(t) < 0.0)
    if back.size:
        group.times()
    places = locate_targets(data, group)
    rows = {name: np.array([(p.x, p.y) for p in found]) for name, found in places.items()}
    times, positions = _epochs(t, rows)
    model = group.word("model", ("auto", "shift", "similarity", "affine"))
    lost = sum(bool(p.why) for found in places.values() for p in found)
    return _Input(
        label=group.label,
        times=times,
        positions=positions,
        model=None if model == "auto" else model,
        reference=group.word("reference", ("first", "mean")),
        bound=group.number("bound_px", BOUND, 1e-6, 1e6),
        notes=(f"{group.label}: targets not found in {lost} places",) if lost else (),
    )


def _epochs(t: Array, rows: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
    """Frames of one time as repetitions: times (m,), positions (m, r, 2)."""
    times, epoch = np.unique(t, return_inverse=True)
    count = np.bincount(epoch)
    out = {name: np.full((len(times), int(count.max()), 2), np.nan) for name in rows}
    place = np.zeros(len(times), int)
    for k, e in enumerate(epoch):
        for name, xy in rows.items():
            out[name][e, place[e]] = xy[k]
        place[e] += 1
    return times, out


def _of_table(table: MeasuredPositions) -> _Input:
    times = np.unique([line.time_s for line in table.lines if line.time_s is not None])
    last = -math.inf
    gathered: dict[str, dict[float, list[tuple[float, float]]]] = {}
    for line in table.lines:
        assert line.time_s is not None
        if line.time_s < last:
            raise InputError(
                f"{table.file}: time {line.time_s:.10g} s of target {line.name} comes after {last:.10g} s; sort the "
                "lines by time"
            )
        last = line.time_s
        gathered.setdefault(line.name, {}).setdefault(line.time_s, []).append((line.x, line.y))
    most = max(len(xy) for of in gathered.values() for xy in of.values())
    positions = {}
    for name, of in gathered.items():
        positions[name] = np.full((len(times), most, 2), np.nan)
        for k, time in enumerate(times):
            found = of.get(float(time), [])
            positions[name][k, : len(found)] = np.array(found).reshape(-1, 2)
    return _Input(label=table.label, times=times, positions=positions, model=None, reference="first", bound=BOUND)


def _warm_up_findings(found: WarmUp, given: _Input) -> Findings:
    at, nan, of = given.label, math.nan, Subject(at=given.label)
    figures: list[Estimate] = []
    refused: dict[str, str] = {}
    for axis, sigma in zip("xy", found.repeat_sigma or ()):
        words = f"standard deviation of a single measurement in {axis}"
        of_sigma = sigma / math.sqrt(2.0 * found.repeat_redundancy)
        figures.append(of.figure(f"repeat_sigma_{axis}_px", sigma, of_sigma, words, "px"))
    for axis, sigma in zip("xy", found.sigma0):
        words = f"standard deviation of an epoch's position in {axis}"
        figures.append(of.figure(f"epoch_sigma_{axis}_px", sigma, nan, words, "px"))
    for course in found.courses:
        more, why = _course(course, of, given.bound)
        figures += more
        refused |= why
    for target in found.targets:
        mine = Subject(at=f"{at}, {target.name}")
        for axis, value in zip("xy", target.largest):
            figures.append(mine.figure(f"movement_{axis}_px", value, nan, f"largest movement in {axis}", "px"))
    against = "the first epoch" if found.reference == "first" else "the mean of the epochs"
    notes = (
        *given.notes,
        f"{at}: {found.model} against {against}; the shift is that of column {found.centre[0]:.0f}, "
        f"row {found.centre[1]:.0f}",
        *(f"{at}: {note}" for note in found.notes),
    )
    values = {f"{c.name}{s}": v for c in found.courses for s, v in (("", c.values), ("_sigma", c.sigmas))}
    caption = "Parameters by epoch (shifts px, scales in parts, angles rad)"
    table = Table.of(caption, series=at, time_s=found.times, **values)
    return Findings(
        figures=known(*figures),
        refused=refused,
        tables={"epochs": table},
        plots=_warm_up_charts(found, at),
        notes=notes,
    )


def _course(course: Course, of: Subject, bound: float) -> tuple[list[Estimate], dict[str, str]]:
    """Size, time constant and time until warm of one parameter."""
    factor, unit = _UNITS[course.unit]
    label, name = _LABELS[course.name], course.name
    suffix = {"px": "px", "ppm": "ppm", "µrad": "urad"}[unit]
    largest = factor * course.largest
    figures = [of.figure(f"{name}_range_{suffix}", largest, math.nan, f"{label}, largest range", unit)]
    a = course.approach
    if a is None:
        return figures, {}
    if a.change is None or a.sigma_change is None or a.time_constant is None or a.sigma_time_constant is None:
        return figures, {f"warm-up of {label}, {of.at}": f"{a.verdict} (chance of none {a.probability:.2g})"}
    remark, words = f"chance of none {a.probability:.1g}", f"{label}, warm-up drift"
    change, sigma = factor * a.change, factor * a.sigma_change
    figures.append(of.figure(f"{name}_drift_{suffix}", change, sigma, words, unit, remark))
    words = f"{label}, time constant"
    figures.append(of.figure(f"{name}_time_s", a.time_constant, a.sigma_time_constant, words, "s"))
    within = a.time_within(bound) if unit == "px" else None
    if within is not None:
        words = f"{label}, time until within {bound:g} px of the end"
        figures.append(of.figure(f"{name}_warm_s", within, math.nan, words, "s"))
    return figures, {}


def _warm_up_charts(found: WarmUp, at: str) -> tuple[Chart, ...]:
    minutes = found.times / 60.0
    curve = np.linspace(0.0, float(found.times[-1]), 300)
    charts = []
    groups = (
        ("shift", ("shift_x", "shift_y")),
        ("scale", ("scale", "scale_x", "scale_y")),
        ("rotation", ("rotation", "shear")),
    )
    for what, names in groups:
        courses = [c for c in found.courses if c.name in names]
        curves = []
        for k, c in enumerate(courses):
            factor, unit = _UNITS[c.unit]
            curves.append(
                Trace(
                    x=minutes,
                    y=factor * c.values,
                    label=_LABELS[c.name],
                    style="points",
                    sigma=factor * c.sigmas,
                    colour=k,
                )
            )
            if c.approach is not None and c.approach.change is not None:
                curves.append(Trace(curve / 60.0, factor * c.approach.at(curve), "", "line", colour=k))
        if curves:
            caption = "Measured with standard deviations, and the exponential course where there is one"
            caption += " (Behr 1989, fig. 4.2)."
            charts.append(
                Chart(
                    title=f"Warm-up, {what}, {at}",
                    caption=caption,
                    x_label="minutes",
                    y_label=f"{what} {unit}",
                    curves=tuple(curves),
                )
            )
    moved = [
        Trace(minutes, t.shift[:, axis], f"{t.name}, {word}", "line", colour=2 * k + axis)
        for k, t in enumerate(found.targets[:3])
        for axis, word in enumerate(("column", "row"))
    ]
    caption = "Each target against the reference; targets that move by different amounts tell a change of scale."
    charts.append(
        Chart(title=f"Targets, {at}", caption=caption, x_label="minutes", y_label="movement px", curves=tuple(moved))
    )
    return tuple(charts)


_GON = 200.0 / math.pi


@dataclass(frozen=True, eq=False)
class _Points:
    label: str
    unit: str
    names: tuple[str, ...]
    stage: Array
    measured: Array
    notes: tuple[str, ...] = ()


def missing_for_stage(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    if any(p.entry.kind == "stage" for p in data.series.positions) or len(data.series.of("stage")) >= LEAST_POINTS:
        return None
    return f"{LEAST_POINTS} or more stage frames with stage_x and stage_y, or a table of positions of kind stage"


def analyse_stage(data: SeriesData) -> Findings:
    """Affine transformation between stage and image, for every target and table."""
    points = [p for group in frame_groups(data, "stage") for p in _stage_of_frames(data, group)]
    points += [
        _Points(
            label=table.label,
            unit=table.entry.unit,
            names=tuple(line.name for line in table.lines),
            stage=np.array([line.stage for line in table.lines], float).reshape(-1, 2),
            measured=np.array([(line.x, line.y) for line in table.lines], float),
        )
        for table in data.series.positions
        if table.entry.kind == "stage"
    ]
    parts = []
    for k, each in enumerate(points, 1):
        try:
            found = stage_calibration(each.names, each.stage, each.measured)
        except InputError as error:
            raise type(error)(f"{each.label}: {error}") from None
        parts.append(_stage_findings(found, each, k))
    return joined(parts)


def _stage_of_frames(data: SeriesData, group: FrameGroup) -> list[_Points]:
    stage = []
    for frame in group.frames:
        values = [frame.values.get(key) for key in ("stage_x", "stage_y")]
        if not all(isinstance(v, float | int) and math.isfinite(v) for v in values):
            raise InputError(
                f"{group.group.label}: {frame.file.name} lacks stage_x or stage_y; give a table with columns file, "
                "stage_x and stage_y, or fields of these names in the pattern"
            )
        stage.append([float(v) for v in values if v is not None])
    unit = str(group.group.entry.values.get("unit", "um"))[:20]
    out = []
    for name, places in locate_targets(data, group).items():
        seen = [k for k, p in enumerate(places) if not p.why]
        lost = [f"{p.frame.file.name}: {p.why}" for p in places if p.why]
        label = group.label if len(group.group.entry.targets) < 2 else f"{group.label}, {name}"
        out.append(
            _Points(
                label=label,
                unit=unit,
                names=tuple(group.frames[k].file.stem for k in seen),
                stage=np.array(stage)[seen],
                measured=np.array([(places[k].x, places[k].y) for k in seen]),
                notes=tuple(f"{label}: not found in {text}" for text in lost),
            )
        )
    return out


def _stage_findings(found: StageCalibration, given: _Points, number: int) -> Findings:
    at, unit, f, of = given.label, given.unit, found.facts, Subject(at=given.label)
    n = len(found.names) - len(found.gross)
    figures = []
    for axis, scale, size, sigma in zip("xy", f.scale, f.pixel_size, found.sigma_pixel_size):
        words = f"scale factor in {axis}"
        figures.append(of.figure(f"scale_{axis}", scale, scale * sigma / size, words, f"px/{unit}"))
        figures.append(of.figure(f"pixel_size_{axis}", size, sigma, f"pixel size in {axis}", unit))
    for axis, value, sigma in zip("xy", (f.direction_x, f.direction_y), found.sigma_direction):
        words = f"rotation of the {axis} axis"
        figures.append(of.figure(f"rotation_{axis}_gon", value * _GON, sigma * _GON, words, "gon"))
    figures.append(of.figure("shear_gon", f.shear * _GON, found.sigma_shear * _GON, "shear", "gon"))
    for axis, value in zip("xy", found.sigma):
        of_value = value / math.sqrt(2 * (n - 3))
        figures.append(of.figure(f"mean_error_{axis}_px", value, of_value, f"mean error {axis}", "px"))
    figures.append(of.figure("m0_px", found.sigma0, found.sigma0 / math.sqrt(2 * found.redundancy), "M0", "px"))
    both = [[float(getattr(t, f"a{k}")) for k in range(1, 7)] for t in (found.to_image, found.to_stage)]
    elements = dict(zip(("a1", "a2", "a3", "b1", "b2", "b3"), zip(*both)))
    points = Table.of(
        "Points, residuals measured minus transformed",
        series=at,
        point=found.names,
        **dict(zip(("stage_x", "stage_y"), found.stage.T)),
        **dict(zip(("x_px", "y_px"), found.measured.T)),
        **dict(zip(("residual_x_px", "residual_y_px"), found.residuals.T)),
        remark=["gross error" if name in found.gross else "" for name in found.names],
    )
    matrices = Table.of("Affine matrices", series=at, way=("stage to image", "image to stage"), **elements)
    return Findings(
        tuple(figures),
        tables={"matrices": matrices, "points": points},
        plots=(_chart(found, at),),
        notes=(*given.notes, *_notes(found, at)),
        files={f"stage_calibration_{number}.txt": ("\n".join(b4_lines(found, unit)) + "\n").encode()},
    )


def _notes(found: StageCalibration, at: str) -> list[str]:
    notes = [f"{at}: gross errors left out: {', '.join(found.gross)}"] if found.gross else []
    if found.facts.mirrored:
        notes.append(f"{at}: the image is mirrored against the stage")
    if found.systematic is not None and found.systematic < 0.001:
        notes.append(
            f"{at}: the residuals are systematic (second-order terms, chance of none {found.systematic:.1g}): "
            "distortion, or a stage that is not straight"
        )
    return notes


def _chart(found: StageCalibration, at: str) -> Chart:
    """Residual vectors (Behr 1989, figs. B.2 and B.3), enlarged."""
    x, y = found.measured.T
    return Chart(
        title=f"Residuals, {at}",
        caption=f"Measured minus transformed, enlarged as the legend says; mean errors {found.sigma[0]:.2f} and "
        f"{found.sigma[1]:.2f} px (Behr 1989, figs. B.2 and B.3).",
        x_label="column px",
        y_label="row px (upwards in the figure)",
        curves=(Trace(x, y, "points", "points"), Trace(x, y, "residuals", vectors=found.residuals)),
    )
