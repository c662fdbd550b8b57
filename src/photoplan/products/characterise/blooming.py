"""Blooming of a series: onset and extent around the brightest object of scene frames."""

from __future__ import annotations

from math import isfinite, nan

import numpy as np

from photoplan.errors import InputError
from photoplan.findings import Chart, Findings, Subject, Table, Trace, joined, known
from photoplan.io.series import Plane
from photoplan.products.characterise.common import SettingsRun, black_of, exposure_runs, no_run, tried
from photoplan.products.characterise.data import SeriesData
from photoplan.quality.camera.drift import Blooming, find_blooming

_LEAST = 4
#: Pixels of all mean images that are held at once.
_MOST = 150_000_000


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return no_run(data, ("scene",), _LEAST, "blooming")


def analyse(data: SeriesData) -> Findings:
    """Onset and extent for every plane and run."""
    return joined([_run(data, run) for run in exposure_runs(data, ("scene",), _LEAST)])


def _run(data: SeriesData, run: SettingsRun) -> Findings:
    window = run.settings[0].first.group.window
    if window.size * len(run.settings) > _MOST:
        raise InputError(
            f"{run.settings[0].first.group.label}: {len(run.settings)} images of {window.width} × {window.height} "
            "pixels; blooming needs them together: give a roi around a bright object"
        )
    means = [data.mean_images(setting) for setting in run.settings]
    parts = []
    for plane in data.planes:
        of = Subject(plane.name, run.label)
        parts.append(tried(of.named("blooming"), _plane, data, run, plane, [each[plane.name] for each in means], of))
    return joined(parts)


def _plane(data: SeriesData, run: SettingsRun, plane: Plane, images: list[np.ndarray], of: Subject) -> Findings:
    blacks = [black_of(data, setting, plane).mean for setting in run.settings]
    full = data.saturation_dn(plane.name)
    if not isfinite(full):
        raise InputError("the largest grey value is not known; give camera.bits or camera.saturation_dn")
    found = find_blooming(run.values, images, blacks, full, data.step)
    blooms = isfinite(found.onset_dn)
    remark = f"{100 * found.onset_dn / (full - blacks[0]):.0f} % of the grey scale"
    longest = f"at {found.extent_exposure:g} {run.unit}"
    rows, columns = (n * plane.step if blooms else nan for n in (found.extent_rows, found.extent_columns))
    why = f"none up to an object of {found.last_without:.4g} DN (by its response): the neighbours grow as expected"
    table = Table.of(
        "Neighbours of the bright object",
        plane=of.plane,
        run=of.at,
        **{run.name: run.values},
        object_dn=found.object_dn,
        neighbours_excess_dn=found.excess_dn,
        sigma_dn=found.excess_sigma,
    )
    return Findings(
        known(
            of.figure("blooming_onset_dn", found.onset_dn, found.onset_dn_sigma, "onset of blooming", "DN", remark),
            of.figure("blooming_rows_px", rows, nan, "extent along columns", "px", longest),
            of.figure("blooming_columns_px", columns, nan, "extent along rows", "px", longest),
        ),
        {} if blooms else {of.named("blooming onset"): why},
        {"neighbours": table},
        (_plot(found, of.named("Blooming")),),
        details={of.key("blooming"): found},
    )


def _plot(found: Blooming, title: str) -> Chart:
    return Chart(
        title=title,
        caption="Grey value of the neighbours above what their response promises, over the grey value that the "
        "object's response promises.",
        x_label="object DN",
        y_label="excess of neighbours DN",
        curves=(Trace(found.object_dn, found.excess_dn, style="line and points", sigma=found.excess_sigma),),
        log_x=True,
        marks=((found.onset_dn, "onset"),) if isfinite(found.onset_dn) else (),
    )
