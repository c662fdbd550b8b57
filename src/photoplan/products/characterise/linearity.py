"""Linearity of a series: error by EMVA 1288, response and slopes between neighbouring exposures."""

from __future__ import annotations

from math import isfinite, sqrt

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.series.pixels import Plane
from photoplan.products.characterise.common import (
    MOST_SATURATED,
    SettingsRun,
    black_of,
    exposure_runs,
    prefix,
    saturation_of,
    tried,
)
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.quality.camera.frame_statistics import Level, check_level
from photoplan.quality.camera.linearity import HIGH, Linearity, linearity
from photoplan.quality.camera.photon_transfer import is_clipped_dark
from photoplan.quality.camera.saturation import find_saturation

_KINDS = ("flat", "scene")
_LEAST = 3


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    if exposure_runs(data, _KINDS, _LEAST):
        return None
    count = len(data.settings(*_KINDS))
    return (
        f"{count} settings of flat or scene frames; linearity needs {_LEAST} that differ in exposure_ms (or "
        "photons_per_pixel, or illumination) and in nothing else"
    )


def analyse(data: SeriesData) -> Findings:
    """Linearity of every plane and run."""
    outcomes = [
        tried(prefix("linearity", plane.name, run.label), lambda r=run, p=plane: _run(data, r, p))  # type: ignore[misc]
        for run in exposure_runs(data, _KINDS, _LEAST)
        for plane in data.planes
    ]
    return joined(outcomes)


def _run(data: SeriesData, run: SettingsRun, plane: Plane) -> Findings:
    levels = [data.levels(setting)[plane.name] for setting in run.settings]
    for level in levels:
        check_level(level)
    blacks = [black_of(data, setting, plane) for setting in run.settings]
    signal = [level.mean - black.mean for level, black in zip(levels, blacks)]
    # A single frame says nothing of its noise: shot noise is not known either, so that rounding and the scatter between
    # pixels stand in for it.
    sigmas = [
        level.mean_sigma if isfinite(level.mean_sigma) else sqrt(level.spatial_variance / level.pixels)
        for level in levels
    ]
    sigma = [sqrt(s**2 + black.sigma**2) for s, black in zip(sigmas, blacks)]
    full = _full(data, plane, run, levels, signal)
    if not full > 0:
        raise InputError(f"the frames are not brighter than black ({blacks[-1].mean:.4g} DN)")
    partly = np.array([level.saturated_share > MOST_SATURATED for level in levels])
    found = linearity(run.values, signal, sigma, full, ~partly)
    rules = tuple(dict.fromkeys(black.rule for black in blacks))
    # Where black hides a part of the pixels, the mean of the others is not the signal.
    hidden = np.array([is_clipped_dark(level) for level in levels])
    return Findings(
        _figures(found, run, plane.name, (found.signal < HIGH * full) & ~hidden & ~partly),
        refused={
            prefix("signal over exposure", plane.name, run.label, f"{found.exposure[k]:g} {run.unit}"): (
                f"black is cut off: {100 * levels[k].zero_share:.3g} % of the samples are zero"
            )
            for k in np.flatnonzero(hidden)
        },
        tables={"levels": _table(found, run, plane.name)},
        plots=_plots(found, run, plane.name, full),
        notes=tuple(f"{prefix(plane.name, run.label)}: {rule}".lstrip(": ") for rule in rules if "cut off" in rule),
        details={prefix("linearity", plane.name, run.label).replace(" ", "_"): found},
    )


def _figures(found: Linearity, run: SettingsRun, plane: str, known: NDArray[np.bool_]) -> tuple[Figure, ...]:
    """Error, response of the line, and response of every level whose mean is that of the signal."""
    unit = f"DN/{run.unit}"
    where = {"plane": plane, "at": run.label}
    error, sigma = found.error_percent, found.error_percent_sigma
    count = f"{np.count_nonzero(found.used)} levels"
    figures = [
        Figure("linearity_error_percent", error, sigma, "linearity error", "%", remark=count, **where),
        Figure("response", found.slope, found.slope_sigma, "response", unit, **where),
    ]
    for k in np.flatnonzero(known):
        at = prefix(run.label, f"{found.exposure[k]:g} {run.unit}")
        response, of_response = float(found.response[k]), float(found.response_sigma[k])
        figures.append(Figure("response_at", response, of_response, "signal over exposure", unit, plane, at))
    return tuple(figures)


def _full(data: SeriesData, plane: Plane, run: SettingsRun, levels: list[Level], signal: list[float]) -> float:
    """Signal at saturation: where this run shows it, else what the camera can write."""
    if len(levels) >= 4:
        variance = np.array([level.temporal_variance for level in levels])
        shares = [level.saturated_share for level in levels]
        found = find_saturation(run.values, signal, 0.0, shares, variance if np.isfinite(variance).all() else None)
        if found is not None:
            return found.level_dn
    return saturation_of(data, plane, levels) - (levels[-1].mean - signal[-1])


def _table(found: Linearity, run: SettingsRun, name: str) -> Listing:
    head = ("plane", "run", run.name, "signal_dn", "response", "segment_slope", "deviation_percent", "used")
    rows = tuple(
        (name, run.label, float(x), float(y), float(r), float(s), float(d), int(u))
        for x, y, r, s, d, u in zip(
            found.exposure, found.signal, found.response, found.segment, found.deviation_percent, found.used
        )
    )
    return Listing(head, rows, f"Signal and response; slopes in DN/{run.unit}")


def _plots(found: Linearity, run: SettingsRun, name: str, full: float) -> tuple[Chart, ...]:
    title = prefix("Linearity", name, run.label)
    low = found.signal < 0.999 * full
    grid = np.linspace(0.0, float(found.exposure[found.used].max()) * 1.05, 60)
    curves = [
        Trace(found.exposure[k], found.signal[k], label, colour=c)
        for k, label, c in ((found.used, "used", 0), (~found.used & low, "not used", 3))
        if k.any()
    ]
    line = Trace(grid, found.offset + found.slope * grid, "least relative deviations", "dashed", colour=1)
    caption = f"Linearity error {found.error_percent:.3g} %, from 5 % to 95 % of saturation."
    used = found.used
    return (
        Chart(f"{title}: signal", caption, run.axis, "signal DN", (*curves, line)),
        Chart(
            f"{title}: deviation",
            "Relative deviation from the line.",
            run.axis,
            "deviation %",
            (Trace(found.exposure[used], found.deviation_percent[used], style="line and points"),),
        ),
    )
