"""Analysis `gain_control`: what an automatic gain does after a step of brightness."""

from __future__ import annotations

import math

import numpy as np

from photoplan.errors import InputError
from photoplan.findings import Chart, Findings, Subject, Table, Trace, joined, known, spaced
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.groups import FrameGroup, frame_groups, window_means
from photoplan.quality.camera.drift import LEAST_VALUES
from photoplan.quality.camera.video import GainControl, compare_transitions, gain_control


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    groups = frame_groups(data, "step")
    if not groups:
        return f"frames of kind step: one entry per transition, with {LEAST_VALUES} or more frames after it"
    most = max(len(g.frames) for g in groups)
    return None if most > LEAST_VALUES else f"{LEAST_VALUES + 1} step frames in one entry; there are {most}"


def analyse(data: SeriesData) -> Findings:
    """Every transition, and bright-dark against dark-bright; one that cannot be used is named, and left out."""
    parts: list[Findings] = []
    found: dict[str, list[GainControl]] = {}
    unfit: dict[str, InputError] = {}
    for group in frame_groups(data, "step"):
        try:
            transitions = _transitions(data, group)
        except InputError as error:
            unfit[spaced("transition", group.label)] = error
            continue
        for plane, (control, noise) in transitions.items():
            parts.append(_outcome(control, noise, Subject(plane, group.label), data.step))
            found.setdefault(plane, []).append(control)
    if not parts:
        raise next(iter(unfit.values()))
    left_out = Findings(refused={name: str(error) for name, error in unfit.items()})
    return joined([left_out, *parts, *(_asymmetry(controls, plane) for plane, controls in found.items())])


def _transitions(data: SeriesData, group: FrameGroup) -> dict[str, tuple[GainControl, tuple[float, float]]]:
    """The transition of an entry by plane, with the noise of a pixel before and after it."""
    times = group.times()
    step_time = group.number("step_time_s", 0.0, -1e12, 1e12) if group.has("step_time_s") else None
    if step_time is not None:
        first = group.frames[0].time_s
        assert first is not None
        step_time -= first
    advice = "what the gain does is hidden there. Take the series with less light, or choose a darker roi"
    out = {}
    for name, seen in window_means(data, group, group.group.window, advice).items():
        found = gain_control(times, seen.mean, step_time=step_time, name=spaced(group.label, name))
        # The pair across the step is left out.
        before, after = seen.variance[: found.first - 1], seen.variance[found.first :]
        sigmas = tuple(math.sqrt(float(part.mean())) if part.size else math.nan for part in (before, after))
        out[name] = found, (sigmas[0], sigmas[1])
    return out


def _outcome(found: GainControl, pixel: tuple[float, float], of: Subject, step: float) -> Findings:
    a, nan, dn = found.approach, math.nan, "DN"
    figures = [
        of.figure("before_dn", found.before, found.sigma_before or nan, "grey value before the step", dn),
        of.figure("step_dn", found.step, nan, "step of the scene", dn, found.direction),
    ]
    refused = {}
    if a.change is not None and a.sigma_change is not None:
        remark = f"chance of none {a.probability:.1g}; {a.verdict}"
        figures.append(of.figure("change_dn", a.change, a.sigma_change, "change by the gain control", dn, remark))
        assert a.time_constant is not None and a.sigma_time_constant is not None
        figures.append(of.figure("time_constant_s", a.time_constant, a.sigma_time_constant, "time constant", "s"))
        settled = a.time_within(max(0.5 * step, a.rms))
        if settled is not None:
            figures.append(of.figure("settled_s", settled, nan, "until within half a grey value or the noise", "s"))
    else:
        refused[f"change by the gain control, {found.name}"] = f"{a.verdict} (chance of none {a.probability:.2g})"
    of_frames = (nan if found.noise.before is None else found.noise.before, found.noise.after)
    for when, value in zip(("before", "after"), of_frames):
        figures.append(of.figure(f"frame_noise_{when}_dn", value, nan, f"noise of a frame's mean {when}", dn))
    for when, value in zip(("before", "after"), pixel):
        figures.append(of.figure(f"pixel_noise_{when}_dn", value, nan, f"noise of a pixel {when} the step", dn))
    t = found.times - found.times[found.first]
    curve = np.linspace(0.0, float(t[-1]), 200)
    caption = "Mean grey value of the window"
    chart = Chart(
        title=f"After the step, {found.name}",
        caption=f"{found.direction}: {a.verdict} (Behr 1989, fig. 4.17).",
        x_label="seconds since the step",
        y_label="grey value",
        curves=(Trace(t, found.values, "measured", "points"), Trace(curve, a.at(curve), "adjusted", "line")),
        marks=((0.0, "step"),),
    )
    table = Table.of(caption, series=found.name, time_s=found.times, mean_dn=found.values)
    return Findings(known(*figures), refused, {"series": table}, (chart,))


def _asymmetry(found: list[GainControl], plane: str) -> Findings:
    """The first transition of each direction compared."""
    dark = next((g for g in found if g.direction == "bright to dark"), None)
    bright = next((g for g in found if g.direction == "dark to bright"), None)
    if dark is None or bright is None:
        return Findings(notes=("transitions in both directions are needed to compare them",))
    try:
        a = compare_transitions(dark, bright)
    except InputError as error:
        return Findings(refused={"asymmetry": str(error)})
    remark = f"chance of equal changes {a.probability:.2g}"
    label = "change after bright to dark minus that after dark to bright"
    return Findings((Subject(plane).figure("asymmetry_dn", a.difference, a.sigma, label, "DN", remark),))
