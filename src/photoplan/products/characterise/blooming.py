"""Blooming of a series: onset and extent around the brightest object of scene frames."""

from __future__ import annotations

from math import isfinite, nan

import numpy as np

from photoplan.errors import InputError
from photoplan.io.series.pixels import Plane
from photoplan.products.characterise.common import SettingsRun, black_of, exposure_runs, prefix, tried
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.quality.camera.blooming import Blooming, find_blooming

_LEAST = 4
#: Pixels of all mean images that are held at once.
_MOST = 150_000_000


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    if exposure_runs(data, ("scene",), _LEAST):
        return None
    return (
        f"{len(data.settings('scene'))} settings of scene frames; blooming needs {_LEAST} that differ in exposure_ms "
        "(or illumination) and in nothing else"
    )


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
    images: dict[str, list[np.ndarray]] = {plane.name: [] for plane in data.planes}
    for setting in run.settings:
        for name, image in data.mean_images(setting).items():
            images[name].append(image)
    return joined(
        [
            tried(
                prefix("blooming", plane.name, run.label),
                lambda p=plane: _plane(data, run, p, images[p.name]),  # type: ignore[misc]
            )
            for plane in data.planes
        ]
    )


def _plane(data: SeriesData, run: SettingsRun, plane: Plane, images: list[np.ndarray]) -> Findings:
    blacks = [black_of(data, setting, plane).mean for setting in run.settings]
    if not isfinite(data.saturation_dn(plane.name)):
        raise InputError("the largest grey value is not known; give camera.bits or camera.saturation_dn")
    found = find_blooming(run.values, images, blacks, data.saturation_dn(plane.name), data.step)
    where = {"plane": plane.name, "at": run.label}
    figures: list[Figure] = []
    refused: dict[str, str] = {}
    if isfinite(found.onset_dn):
        remark = f"{100 * found.onset_dn / (data.saturation_dn(plane.name) - blacks[0]):.0f} % of the grey scale"
        longest = f"at {found.extent_exposure:g} {run.unit}"
        figures += [
            Figure(
                "blooming_onset_dn",
                found.onset_dn,
                found.onset_dn_sigma,
                "onset of blooming",
                "DN",
                remark=remark,
                **where,
            ),
            Figure(
                "blooming_rows_px",
                found.extent_rows * plane.step,
                nan,
                "extent along columns",
                "px",
                remark=longest,
                **where,
            ),
            Figure(
                "blooming_columns_px",
                found.extent_columns * plane.step,
                nan,
                "extent along rows",
                "px",
                remark=longest,
                **where,
            ),
        ]
    else:
        refused[prefix("blooming onset", plane.name, run.label)] = (
            f"none up to an object of {found.last_without:.4g} DN (by its response): the neighbours grow as expected"
        )
    head = ("plane", "run", run.name, "object_dn", "neighbours_excess_dn", "sigma_dn")
    rows = tuple(
        (plane.name, run.label, x, float(o), float(e), float(s))
        for x, o, e, s in zip(run.values, found.object_dn, found.excess_dn, found.excess_sigma)
    )
    return Findings(
        tuple(figures),
        refused,
        {"neighbours": Listing(head, rows, "Neighbours of the bright object")},
        (_plot(found, prefix("Blooming", plane.name, run.label)),),
        details={prefix("blooming", plane.name, run.label).replace(" ", "_"): found},
    )


def _plot(found: Blooming, title: str) -> Chart:
    return Chart(
        title,
        "Grey value of the neighbours above what their response promises, over the grey value that the object's "
        "response promises.",
        "object DN",
        "excess of neighbours DN",
        (Trace(found.object_dn, found.excess_dn, style="line and points", sigma=found.excess_sigma),),
        log_x=True,
        marks=((found.onset_dn, "onset"),) if isfinite(found.onset_dn) else (),
    )
