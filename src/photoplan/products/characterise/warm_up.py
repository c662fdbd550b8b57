"""Analysis `warm_up`: targets that move while the camera warms up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import Chart, Estimate, Findings, Subject, Table, Trace, joined, known
from photoplan.io.series import MeasuredPositions
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.groups import FrameGroup, frame_groups
from photoplan.products.characterise.targets import locate_targets
from photoplan.quality.camera.drift import LEAST_VALUES, Course, WarmUp, warm_up

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


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    if data.series.of("target") or any(p.entry.kind == "target" for p in data.series.positions):
        return None
    return f"target frames (or a table of positions) at {LEAST_VALUES} or more times after switching on"


def analyse(data: SeriesData) -> Findings:
    """Shift, scale and rotation of every entry and table over time."""
    inputs = [_of_frames(data, group) for group in frame_groups(data, "target")]
    inputs += [_of_table(p) for p in data.series.positions if p.entry.kind == "target"]
    parts = []
    for each in inputs:
        try:
            found = warm_up(each.times, each.positions, model=each.model, reference=each.reference)
        except InputError as error:
            raise type(error)(f"{each.label}: {error}") from None
        parts.append(_outcome(found, each))
    return joined(parts)


def _of_frames(data: SeriesData, group: FrameGroup) -> _Input:
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


def _outcome(found: WarmUp, given: _Input) -> Findings:
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
        figures=known(*figures), refused=refused, tables={"epochs": table}, plots=_charts(found, at), notes=notes
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


def _charts(found: WarmUp, at: str) -> tuple[Chart, ...]:
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
