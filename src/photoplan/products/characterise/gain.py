"""Analysis `gain_control`: what an automatic gain does after a step of brightness."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.groups import FrameGroup, frame_groups
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.quality.camera.approach import LEAST_VALUES
from photoplan.quality.camera.gain_control import GainControl, compare_transitions, gain_control


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    groups = frame_groups(data, "step")
    if not groups:
        return f"frames of kind step: one entry per transition, with {LEAST_VALUES} or more frames after it"
    most = max(len(g.frames) for g in groups)
    return None if most > LEAST_VALUES else f"{LEAST_VALUES + 1} step frames in one entry; there are {most}"


def analyse(data: SeriesData) -> Findings:
    """Every transition, and bright-dark against dark-bright."""
    parts: list[Findings] = []
    found: dict[str, list[GainControl]] = {}
    for group in frame_groups(data, "step"):
        for plane, (control, noise) in _transitions(data, group).items():
            parts.append(_outcome(control, noise, (group.label, plane), data.step))
            found.setdefault(plane, []).append(control)
    return joined([*parts, *(_asymmetry(controls, plane) for plane, controls in found.items())])


def _transitions(data: SeriesData, group: FrameGroup) -> dict[str, tuple[GainControl, tuple[float, float]]]:
    """The transition of an entry by plane, with the noise of a pixel before and after it."""
    times = group.times()
    step_time = group.number("step_time_s", 0.0, -1e12, 1e12) if group.has("step_time_s") else None
    if step_time is not None:
        first = group.frames[0].time_s
        assert first is not None
        step_time -= first
    means: dict[str, list[float]] = {p.name: [] for p in data.planes}
    noise: dict[str, list[float]] = {p.name: [] for p in data.planes}
    last: dict[str, NDArray[np.float64]] = {}
    for frame, planes in zip(group.frames, group.pixels(data)):
        for name, pixels in planes.items():
            values = pixels.astype(float)
            if float((values >= data.saturation_dn(name)).mean()) > 0.01:
                raise InputError(
                    f"{group.group.label}: {frame.file.name} is saturated; what the gain does is hidden there. Take "
                    "the series with less light, or choose a darker roi"
                )
            means[name].append(float(values.mean()))
            if name in last:
                noise[name].append(float((values - last[name]).var()) / 2.0)
            last[name] = values
    out = {}
    for plane in data.planes:
        label = " ".join(filter(None, [group.label, plane.name]))
        found = gain_control(times, np.array(means[plane.name]), step_time=step_time, name=label)
        k, n = found.first, noise[plane.name]
        # The pair across the step is left out.
        before = math.sqrt(float(np.mean(n[: k - 1]))) if k > 1 else math.nan
        out[plane.name] = found, (before, math.sqrt(float(np.mean(n[k:]))))
    return out


def _outcome(found: GainControl, pixel: tuple[float, float], of: tuple[str, str], step: float) -> Findings:
    (at, plane), (a, refused) = of, (found.approach, {})
    nan = math.nan

    def figure(name: str, value: float, sigma: float, label: str, unit: str = "DN", remark: str = "") -> Figure:
        return Figure(name=name, value=value, sigma=sigma, label=label, unit=unit, plane=plane, at=at, remark=remark)

    figures = [figure("before_dn", found.before, found.sigma_before or nan, "grey value before the step")]
    figures.append(figure("step_dn", found.step, nan, "step of the scene", remark=found.direction))
    if a.change is not None and a.sigma_change is not None:
        remark = f"chance of none {a.probability:.1g}; {a.verdict}"
        figures.append(figure("change_dn", a.change, a.sigma_change, "change by the gain control", remark=remark))
        assert a.time_constant is not None and a.sigma_time_constant is not None
        figures.append(figure("time_constant_s", a.time_constant, a.sigma_time_constant, "time constant", "s"))
        settled = a.time_within(max(0.5 * step, a.rms))
        if settled is not None:
            figures.append(figure("settled_s", settled, nan, "until within half a grey value or the noise", "s"))
    else:
        refused[f"change by the gain control, {found.name}"] = f"{a.verdict} (chance of none {a.probability:.2g})"
    if found.noise.before is not None:
        figures.append(figure("frame_noise_before_dn", found.noise.before, nan, "noise of a frame's mean before"))
    figures.append(figure("frame_noise_after_dn", found.noise.after, nan, "noise of a frame's mean after"))
    for value, when in zip(pixel, ("before", "after")):
        if math.isfinite(value):
            figures.append(figure(f"pixel_noise_{when}_dn", value, nan, f"noise of a pixel {when} the step"))
    t = found.times - found.times[found.first]
    curve = np.linspace(0.0, float(t[-1]), 200)
    rows = tuple((found.name, float(x), float(y)) for x, y in zip(found.times, found.values))
    return Findings(
        tuple(figures),
        refused,
        {"series": Listing(("series", "time_s", "mean_dn"), rows, "Mean grey value of the window")},
        (
            Chart(
                f"After the step, {found.name}",
                f"{found.direction}: {a.verdict} (Behr 1989, fig. 4.17).",
                "seconds since the step",
                "grey value",
                (Trace(t, found.values, "measured", "points"), Trace(curve, a.at(curve), "adjusted", "line")),
                marks=((0.0, "step"),),
            ),
        ),
    )


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
    return Findings((Figure("asymmetry_dn", a.difference, a.sigma, label, "DN", plane, remark=remark),))
