"""Grey wedge of a series: characteristic curve for each illumination (Behr 1989, fig. 4.12)."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

import numpy as np

from photoplan.errors import InputError
from photoplan.findings import Chart, Findings, Subject, Table, Trace, joined, spaced
from photoplan.geometry.grid import Window
from photoplan.io.series import Plane, SeriesFrame, plane_pixels
from photoplan.products.characterise.common import black_of, saturation_of, tried
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.quality.camera.geometry import GreyWedge, grey_wedge
from photoplan.quality.camera.sensor import Level, StackSums

_LEAST = 3


@dataclass(frozen=True)
class _Patch:
    density: float
    level: Level
    setting: Setting


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    frames = data.series.of("wedge")
    densities = {frame.density for frame in frames} - {None}
    densities |= {step.density for frame in frames for step in frame.group.entry.steps}
    if len(densities) >= _LEAST:
        return None
    return (
        f"wedge frames with {len(densities)} densities; a grey wedge needs {_LEAST}: give density, or steps with rois"
    )


def analyse(data: SeriesData) -> Findings:
    """Characteristic curve of every plane and illumination."""
    outcomes = []
    for plane in data.planes:
        patches: dict[str, list[_Patch]] = {}
        for setting in data.settings("wedge"):
            patches.setdefault(_label(setting.first), []).extend(_patches(data, setting, plane))
        for label, of_label in patches.items():
            of = Subject(plane.name, label)
            outcomes.append(tried(of.named("grey wedge"), _curve, data, of_label, plane, of))
    return joined(outcomes)


def _label(frame: SeriesFrame) -> str:
    light = "" if frame.illumination is None else f"illumination {frame.illumination:g}"
    time = "" if frame.exposure_ms is None else f"{frame.exposure_ms:g} ms"
    return spaced(frame.group.entry.name or "", light, time)


def _patches(data: SeriesData, setting: Setting, plane: Plane) -> list[_Patch]:
    """Statistics of each patch of the frames of one setting."""
    entry = setting.first.group.entry
    if not entry.steps:
        if setting.first.density is None:
            raise InputError(
                f"{setting.first.group.label}: {setting.first.file.name} states no density; give it or steps"
            )
        return [_Patch(setting.first.density, data.levels(setting)[plane.name], setting)]
    found = []
    size = data.series.size or (0, 0)
    for step in entry.steps:
        window = Window(*step.roi)
        if window.stop[0] > size[0] or window.stop[1] > size[1]:
            raise InputError(f"{setting.first.group.label}: step of density {step.density:g}: its roi leaves the image")
        sums = StackSums(data.saturation_dn(plane.name))
        for frame in setting.frames:
            sums.add(plane_pixels(frame, plane, window))
        found.append(_Patch(step.density, sums.stack().level, setting))
    return found


def _curve(data: SeriesData, patches: list[_Patch], plane: Plane, of: Subject) -> Findings:
    blacks = [black_of(data, patch.setting, plane) for patch in patches]
    signal = [patch.level.mean - black.mean for patch, black in zip(patches, blacks)]
    sigma = [patch.level.sigma_of_mean(data.step) for patch in patches]
    full = saturation_of(data, plane, [patch.level for patch in patches]) - blacks[0].mean
    found = grey_wedge([patch.density for patch in patches], signal, sigma, full)
    table = Table.of(
        "Patches of the wedge",
        plane=of.plane,
        at=of.at,
        density=found.density,
        transmission=found.transmission,
        signal_dn=found.signal,
        used=found.used,
    )
    return Findings(
        (
            of.figure("gamma", found.gamma, found.gamma_sigma, "gamma of the characteristic curve"),
            of.figure("wedge_error_percent", found.error_percent, nan, "largest deviation from proportionality", "%"),
            of.figure("used_range_percent", found.used_range_percent, nan, "part of the grey scale used", "%"),
        ),
        tables={"patches": table},
        plots=(_plot(found, of.named("Grey wedge")),),
        details={of.key("wedge"): found},
    )


def _plot(found: GreyWedge, title: str) -> Chart:
    grid = np.linspace(found.density.min(), found.density.max(), 60)
    return Chart(
        title=title,
        caption=f"Grey value over density; the dashed curve is a proportional sensor, gamma is {found.gamma:.3g}.",
        x_label="density",
        y_label="signal DN",
        curves=(
            Trace(found.density, found.signal, "measured", "line and points"),
            Trace(grid, found.slope * 10.0**-grid, "proportional", "dashed"),
        ),
    )
