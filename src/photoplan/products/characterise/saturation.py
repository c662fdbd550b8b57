"""Saturation of a series: grey value, sign and exposure."""

from __future__ import annotations

from math import nan

import numpy as np

from photoplan.findings import Chart, Findings, Subject, Trace, known
from photoplan.io.series import Plane
from photoplan.products.characterise.common import MOST_SATURATED, SettingsRun, no_run, of_runs
from photoplan.products.characterise.data import SeriesData
from photoplan.quality.camera.sensor import check_level

_KINDS = ("flat", "scene")
_LEAST = 4
_WORDS = {
    "clipping": "grey values stop at the largest that is written",
    "response": "the response falls below the line",
    "variance": "the temporal variance falls",
}
_FULL = "the elements are full, below the largest grey value"


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return no_run(data, _KINDS, _LEAST, "saturation")


def analyse(data: SeriesData) -> Findings:
    """Saturation of every plane and run."""
    return of_runs(data, _KINDS, _LEAST, "saturation", _run)


def _run(data: SeriesData, run: SettingsRun, plane: Plane, of: Subject) -> Findings:
    levels = [data.levels(setting)[plane.name] for setting in run.settings]
    for level in levels:
        check_level(level)
    mean = np.array([level.mean for level in levels])
    found = run.saturation(data, plane)
    if found is None:
        share = levels[-1].saturated_share
        spot = f", {100 * share:.3g} % of its samples are saturated: give them a roi, a mask or brightest"
        why = f"not reached: the brightest level has a mean of {mean[-1]:.4g} DN"
        return Findings(refused={of.named("saturation"): why + (spot if share > MOST_SATURATED else "")})
    words = _FULL if found.rule == "clipping" and plane.name in data.wells else _WORDS[found.rule]
    between = f"between {found.last_unsaturated:g} and {found.first_saturated:g} {run.unit}"
    at, sigma = found.exposure, found.exposure_sigma
    chart = Chart(
        title=of.named("Saturation"),
        caption=f"Saturated {between}: {words}.",
        x_label=run.axis,
        y_label="mean grey value DN",
        curves=(Trace(np.array(run.values), mean, style="line and points"),),
        log_x=True,
        marks=((found.first_saturated, "saturated"),),
    )
    return Findings(
        known(
            of.figure("saturation_dn", found.level_dn, nan, "saturation", "DN", f"{between}: {words}"),
            of.figure("saturation_exposure", at, sigma, "exposure at saturation", run.unit),
        ),
        plots=(chart,),
        details={of.key("saturation"): found},
    )
