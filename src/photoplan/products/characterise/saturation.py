"""Saturation of a series: grey value, sign and exposure."""

from __future__ import annotations

from math import isfinite, nan

import numpy as np

from photoplan.io.series.pixels import Plane
from photoplan.products.characterise.common import (
    MOST_SATURATED,
    SettingsRun,
    black_if_known,
    exposure_runs,
    prefix,
    tried,
)
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.result import Chart, Figure, Findings, Trace, joined
from photoplan.quality.camera.frame_statistics import check_level
from photoplan.quality.camera.saturation import find_saturation

_KINDS = ("flat", "scene")
_LEAST = 4
_WORDS = {
    "clipping": "grey values stop at the largest that is written",
    "response": "the response falls below the line",
    "variance": "the temporal variance falls",
}
_FULL = "the elements are full, below the largest grey value"


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    if exposure_runs(data, _KINDS, _LEAST):
        return None
    return (
        f"{len(data.settings(*_KINDS))} settings of flat or scene frames; saturation needs {_LEAST} that differ in "
        "exposure_ms (or photons_per_pixel, or illumination) and in nothing else"
    )


def analyse(data: SeriesData) -> Findings:
    """Saturation of every plane and run."""
    return joined(
        [
            tried(prefix("saturation", plane.name, run.label), lambda r=run, p=plane: _run(data, r, p))  # type: ignore[misc]
            for run in exposure_runs(data, _KINDS, _LEAST)
            for plane in data.planes
        ]
    )


def _run(data: SeriesData, run: SettingsRun, plane: Plane) -> Findings:
    levels = [data.levels(setting)[plane.name] for setting in run.settings]
    for level in levels:
        check_level(level)
    mean = np.array([level.mean for level in levels])
    variance = np.array([level.temporal_variance for level in levels])
    found = find_saturation(
        run.values,
        mean,
        black_if_known(data, run.settings[0], plane),
        [level.saturated_share for level in levels],
        variance if np.isfinite(variance).all() else None,
    )
    key = prefix("saturation", plane.name, run.label)
    if found is None:
        share = levels[-1].saturated_share
        spot = f", {100 * share:.3g} % of its samples are saturated: give them a roi, a mask or brightest"
        why = f"not reached: the brightest level has a mean of {mean[-1]:.4g} DN"
        return Findings(refused={key: why + (spot if share > MOST_SATURATED else "")})
    where = {"plane": plane.name, "at": run.label}
    words = _FULL if found.rule == "clipping" and plane.name in data.wells else _WORDS[found.rule]
    between = f"between {found.last_unsaturated:g} and {found.first_saturated:g} {run.unit}"
    figures = [
        Figure("saturation_dn", found.level_dn, nan, "saturation", "DN", remark=f"{between}: {words}", **where),
    ]
    if isfinite(found.exposure):
        figures.append(
            Figure(
                "saturation_exposure", found.exposure, found.exposure_sigma, "exposure at saturation", run.unit, **where
            )
        )
    x = np.array(run.values)
    chart = Chart(
        prefix("Saturation", plane.name, run.label),
        f"Saturated {between}: {words}.",
        run.axis,
        "mean grey value DN",
        (Trace(x, mean, style="line and points"),),
        log_x=True,
        marks=((found.first_saturated, "saturated"),),
    )
    return Findings(tuple(figures), plots=(chart,), details={key.replace(" ", "_"): found})
