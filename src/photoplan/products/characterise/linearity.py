"""Linearity of a series: error by EMVA 1288, response and slopes between neighbouring exposures."""

from __future__ import annotations

from math import hypot

import numpy as np

from photoplan.errors import InputError
from photoplan.findings import Chart, Findings, Subject, Table, Trace
from photoplan.io.series import Plane
from photoplan.products.characterise.common import (
    MOST_SATURATED,
    SettingsRun,
    black_of,
    no_run,
    of_runs,
    saturation_of,
    used_and_rest,
)
from photoplan.products.characterise.data import SeriesData
from photoplan.quality.camera.photon_transfer import HIGH, Linearity, linearity
from photoplan.quality.camera.sensor import check_level, cut_off

_KINDS = ("flat", "scene")
_LEAST = 3


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return no_run(data, _KINDS, _LEAST, "linearity")


def analyse(data: SeriesData) -> Findings:
    """Linearity of every plane and run."""
    return of_runs(data, _KINDS, _LEAST, "linearity", _run)


def _run(data: SeriesData, run: SettingsRun, plane: Plane, of: Subject) -> Findings:
    levels = [data.levels(setting)[plane.name] for setting in run.settings]
    for level in levels:
        check_level(level)
    blacks = [black_of(data, setting, plane) for setting in run.settings]
    signal = [level.mean - black.mean for level, black in zip(levels, blacks)]
    sigma = [hypot(level.sigma_of_mean(data.step), black.sigma) for level, black in zip(levels, blacks)]
    # Where this run shows saturation, else what the camera can write.
    seen = run.saturation(data, plane) if len(levels) >= 4 else None
    top = saturation_of(data, plane, levels) if seen is None else seen.level_dn
    full = top - blacks[-1].mean
    if not full > 0:
        raise InputError(f"the frames are not brighter than black ({blacks[-1].mean:.4g} DN)")
    partly = np.array([level.saturated_share > MOST_SATURATED for level in levels])
    found = linearity(run.values, signal, sigma, full, ~partly)
    rules = dict.fromkeys(black.rule for black in blacks)
    # Where black hides a part of the pixels, the mean of the others is not the signal.
    hidden = np.array([level.is_cut_off for level in levels])
    unit = f"DN/{run.unit}"
    at = [of.under(f"{x:g} {run.unit}") for x in found.exposure]
    plain_mean = (found.signal < HIGH * full) & ~hidden & ~partly
    count = f"{np.count_nonzero(found.used)} levels"
    error, of_error = found.error_percent, found.error_percent_sigma
    figures = [
        of.figure("linearity_error_percent", error, of_error, "linearity error", "%", count),
        of.figure("response", found.slope, found.slope_sigma, "response", unit),
    ]
    for k in np.flatnonzero(plain_mean):
        response, sigma_k = float(found.response[k]), float(found.response_sigma[k])
        figures.append(at[k].figure("response_at", response, sigma_k, "signal over exposure", unit))
    return Findings(
        figures=tuple(figures),
        refused={at[k].named("signal over exposure"): cut_off([levels[k]]) for k in np.flatnonzero(hidden)},
        tables={"levels": _table(found, run, of)},
        plots=_plots(found, run, of, full),
        notes=tuple(f"{of.named()}: {rule}".lstrip(": ") for rule in rules if "cut off" in rule),
        details={of.key("linearity"): found},
    )


def _table(found: Linearity, run: SettingsRun, of: Subject) -> Table:
    return Table.of(
        f"Signal and response; slopes in DN/{run.unit}",
        plane=of.plane,
        run=of.at,
        **{run.name: found.exposure},
        signal_dn=found.signal,
        response=found.response,
        segment_slope=found.segment,
        deviation_percent=found.deviation_percent,
        used=found.used,
    )


def _plots(found: Linearity, run: SettingsRun, of: Subject, full: float) -> tuple[Chart, ...]:
    title, used = of.named("Linearity"), found.used
    grid = np.linspace(0.0, float(found.exposure[used].max()) * 1.05, 60)
    line = Trace(grid, found.offset + found.slope * grid, "least relative deviations", "dashed", colour=1)
    seen = used | (found.signal < 0.999 * full)
    points = used_and_rest(found.exposure[seen], found.signal[seen], used[seen])
    caption = f"Linearity error {found.error_percent:.3g} %, from 5 % to 95 % of saturation."
    deviations = Trace(found.exposure[used], found.deviation_percent[used], style="line and points")
    return (
        Chart(title=f"{title}: signal", caption=caption, x_label=run.axis, y_label="signal DN", curves=(*points, line)),
        Chart(
            title=f"{title}: deviation",
            caption="Relative deviation from the line.",
            x_label=run.axis,
            y_label="deviation %",
            curves=(deviations,),
        ),
    )
