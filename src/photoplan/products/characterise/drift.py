"""Analysis `drift`: brightness that drifts and flickers over time."""

from __future__ import annotations

import math

import numpy as np

from photoplan.findings import Chart, Findings, Subject, Table, Trace, joined, spaced
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.groups import FrameGroup, central_window, frame_groups, window_means
from photoplan.quality.camera.drift import LEAST_MEASUREMENTS, BrightnessDrift, brightness_drift

#: Side of the window in the middle of the image (Behr 1989, §4.2.4).
WINDOW = 6


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
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
    parts = []
    for name, seen in window_means(data, group, window, "take less light").items():
        pixel = math.sqrt(float(seen.variance.mean()) / seen.pixels) if seen.pixels > 1 else None
        of = Subject(name, group.label)
        parts.append(_outcome(brightness_drift(times, seen.mean, pixel, spaced(group.label, name)), of, side))
    return joined(parts)


def _outcome(found: BrightnessDrift, of: Subject, side: int) -> Findings:
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
    return Findings(tuple(figures), tables={"series": series, "variation": lapses}, plots=_charts(found, label, side))


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
