"""Analysis `drift`: brightness that drifts and flickers over time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.groups import FrameGroup, central_window, frame_groups
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.quality.camera.brightness_drift import LEAST_MEASUREMENTS, BrightnessDrift, brightness_drift

#: Side of the window in the middle of the image (Behr 1989, §4.2.4).
WINDOW = 6


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    groups = frame_groups(data, "drift")
    if not groups:
        return f"frames of kind drift: an even surface at {LEAST_MEASUREMENTS} or more times"
    most = max(len(g.frames) for g in groups)
    return None if most >= LEAST_MEASUREMENTS else f"{LEAST_MEASUREMENTS} drift frames in one entry; there are {most}"


def analyse(data: SeriesData) -> Findings:
    """The figures of table 4.1 for every entry and plane."""
    return joined([_group(data, g) for g in frame_groups(data, "drift")])


def _group(data: SeriesData, group: FrameGroup) -> Findings:
    times = group.times()
    side = int(group.number("window", WINDOW * max(p.step for p in data.planes), 1, 100_000))
    window = central_window(group.group.window, side, group.group.label)
    means: dict[str, list[float]] = {p.name: [] for p in data.planes}
    noise: dict[str, list[float]] = {p.name: [] for p in data.planes}
    last: dict[str, NDArray[np.float64]] = {}
    for frame, planes in zip(group.frames, group.pixels(data, window)):
        for name, pixels in planes.items():
            values = pixels.astype(float)
            if float((values >= data.saturation_dn(name)).mean()) > 0.01:
                raise InputError(f"{group.group.label}: {frame.file.name} is saturated in the window; take less light")
            means[name].append(float(values.mean()))
            if name in last and values.size > 1:
                # Of a pixel, from the difference of two frames, without what the whole window changes.
                noise[name].append(float((values - last[name]).var(ddof=1)) / 2.0)
            last[name] = values
    parts = []
    for plane in data.planes:
        pixel = math.sqrt(float(np.mean(noise[plane.name])) / last[plane.name].size) if noise[plane.name] else None
        label = " ".join(filter(None, [group.label, plane.name]))
        found = brightness_drift(times, np.array(means[plane.name]), pixel, label)
        parts.append(_outcome(found, group.label, plane.name, side))
    return joined(parts)


def _outcome(found: BrightnessDrift, at: str, plane: str, side: int) -> Findings:
    n, root = found.count, math.sqrt(found.count)
    nan = math.nan

    def figure(name: str, value: float, sigma: float, label: str, unit: str = "DN", remark: str = "") -> Figure:
        return Figure(name=name, value=value, sigma=sigma, label=label, unit=unit, plane=plane, at=at, remark=remark)

    drift = "drifts" if found.drifts else "no more than noise"
    trend = "significant" if found.has_trend else "not significant"
    figures = [
        figure("mean_dn", found.mean, found.sigma / root, "mean Ī"),
        figure("minimum_dn", found.minimum, nan, "smallest I_min"),
        figure("maximum_dn", found.maximum, nan, "largest I_max"),
        figure("sigma_dn", found.sigma, found.sigma / math.sqrt(2.0 * (n - 1)), "standard deviation σ_I"),
        figure("largest_step_dn", found.largest_step, nan, "largest step Δ_I of successive measurements"),
        figure("short_term_sigma_dn", found.short_sigma, found.sigma_of_short, "short-term σ, from successive steps"),
        figure("long_term_sigma_dn", found.long_sigma, nan, "long-term σ", remark=drift),
        figure("trend_dn_per_hour", found.trend, found.sigma_trend, "trend", "DN/h", trend),
        figure("neumann_ratio", found.neumann, nan, "von Neumann ratio", "", "2 for noise, less for drift"),
    ]
    if found.pixel_noise is not None:
        figures.append(figure("pixel_noise_of_mean_dn", found.pixel_noise, nan, "noise of the pixels in a mean"))
    v, label = found.variation, " ".join(filter(None, [at, plane]))
    rows = [(label, float(t), float(y)) for t, y in zip(found.times, found.values)]
    lapses = [
        (label, float(a), float(b), int(c), float(d)) for a, b, c, d in zip(v.lapse, v.structure, v.pairs, v.allan)
    ]
    return Findings(
        tuple(figures),
        tables={
            "series": Listing(("series", "time_s", "mean_dn"), tuple(rows), "Mean grey value of the window"),
            "variation": Listing(
                ("series", "lapse_s", "structure_dn", "pairs", "allan_dn"),
                tuple(lapses),
                "Variation over lapses of time",
            ),
        },
        plots=_charts(found, label, side),
    )


def _charts(found: BrightnessDrift, label: str, side: int) -> tuple[Chart, ...]:
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
            f"Brightness over time, {label}",
            f"Mean of {side} × {side} pixels in the middle (Behr 1989, figs. 4.15 and 4.16), and the straight trend.",
            "minutes",
            "grey value",
            (Trace(minutes, found.values, "measured", "line and points"), Trace(minutes, line, "trend", "dashed")),
        ),
        Chart(
            f"Flicker and drift, {label}",
            "Root of half the mean squared difference of two measurements a lapse of time apart: level for white "
            "noise, rising for drift. The Allan deviation of means falls by the root of the lapse "
            "as long as noise is white.",
            "lapse s",
            "grey values",
            tuple(curves),
            log_x=True,
            log_y=True,
        ),
    )
