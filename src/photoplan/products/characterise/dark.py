"""Dark signal of a series: offset, dark current, temporal dark noise and doubling temperature."""

from __future__ import annotations

from math import sqrt

import numpy as np

from photoplan.errors import InputError
from photoplan.findings import Chart, Findings, Subject, Table, Trace, joined, with_sigma
from photoplan.io.series import Plane
from photoplan.products.characterise.common import MOST_SATURATED, tried
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.quality.camera.sensor import DarkCurrent, Level, dark_current, doubling_temperature

_LEAST = 3


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    exposures = {setting.first.exposure_ms for setting in data.settings("dark")} - {None}
    if len(exposures) >= _LEAST:
        return None
    return f"dark frames at {len(exposures)} stated exposures; the dark signal needs {_LEAST}"


def analyse(data: SeriesData) -> Findings:
    """Dark current of every plane and temperature, and the doubling temperature."""
    return joined([_plane(data, plane) for plane in data.planes])


def _plane(data: SeriesData, plane: Plane) -> Findings:
    by_temperature: dict[float | None, list[Setting]] = {}
    for setting in data.settings("dark"):
        if setting.first.exposure_ms is not None:
            by_temperature.setdefault(setting.first.temperature_c, []).append(setting)
    outcomes, currents = [], {}
    for temperature, settings in by_temperature.items():
        of = Subject(plane.name, "" if temperature is None else f"{temperature:g} °C")
        settings = sorted(settings, key=lambda s: s.exposure)
        levels = [data.levels(setting)[plane.name] for setting in settings]
        outcomes.append(tried(of.named("dark current"), _current, settings, levels, of))
        current = outcomes[-1].details.get(of.key("dark_current"))
        if temperature is not None and current is not None:
            currents[temperature] = current
    stated = sum(temperature is not None for temperature in by_temperature)
    key = Subject(plane.name).named("doubling temperature")
    return joined([*outcomes, tried(key, _doubling, currents, Subject(plane.name), stated)])


def _current(settings: list[Setting], levels: list[Level], of: Subject) -> Findings:
    exposures = np.array([setting.exposure for setting in settings])
    used = np.array([level.saturated_share <= MOST_SATURATED for level in levels])
    if not used.all() and np.count_nonzero(used) < _LEAST:
        raise InputError(
            f"over {100 * MOST_SATURATED:g} % of the samples are saturated from {exposures[~used][0]:g} ms on; take "
            "shorter exposures"
        )
    found = dark_current(exposures[used].tolist(), [level for level, use in zip(levels, used) if use])
    shortest = levels[0]
    noise = sqrt(shortest.temporal_variance)
    of_noise = shortest.variance_sigma / (2 * noise) if noise > 0 else 0.0
    remark = f"with rounding, at {exposures[0]:g} ms"
    figures = (
        of.figure("dark_offset_dn", found.offset_dn, found.offset_dn_sigma, "dark grey value at no exposure", "DN"),
        of.figure("dark_current_dn_s", found.current_dn_s, found.current_dn_s_sigma, "dark current", "DN/s"),
        of.figure("dark_noise_dn", noise, of_noise, "temporal dark noise", "DN", remark),
    )
    means = np.array([level.mean for level in levels])
    table = Table.of(
        "Dark frames",
        plane=of.plane,
        temperature=of.at,
        exposure_ms=exposures,
        mean_dn=means,
        sigma_dn=[level.mean_sigma for level in levels],
        variance_dn2=[level.temporal_variance for level in levels],
        used=["yes" if use else "no" for use in used],
    )
    t = exposures / 1000
    chart = Chart(
        title=of.named("Dark signal"),
        caption=f"Dark current {with_sigma(found.current_dn_s, found.current_dn_s_sigma, 'DN/s')}.",
        x_label="exposure s",
        y_label="mean grey value DN",
        curves=(Trace(t, means, "dark frames"), Trace(t, found.line.at(t), "line", "dashed")),
    )
    return Findings(
        figures,
        tables={"levels": table},
        plots=(chart,),
        notes=tuple(f"{setting.label}: saturated, not used" for setting, use in zip(settings, used) if not use),
        details={of.key("dark_current"): found},
    )


def _doubling(known: dict[float, DarkCurrent], of: Subject, stated: int) -> Findings:
    if stated < 2:
        why = f"the dark frames state {stated} temperatures; two or more are needed (temperature_c)"
        return Findings(refused={"doubling temperature": why})
    if len(known) < 2:
        raise InputError(f"a dark current is known at {len(known)} of {stated} temperatures; two are needed")
    temperatures = sorted(known)
    values = [known[t].current_dn_s for t in temperatures]
    sigmas = [known[t].current_dn_s_sigma for t in temperatures]
    found = doubling_temperature(temperatures, values, sigmas)
    grid = np.linspace(temperatures[0], temperatures[-1], 50)
    model = found.current_at_reference * 2 ** ((grid - found.reference_c) / found.doubling_k)
    chart = Chart(
        title=of.named("Dark current against temperature"),
        caption=f"It doubles every {with_sigma(found.doubling_k, found.doubling_k_sigma, 'K')}.",
        x_label="temperature °C",
        y_label="dark current DN/s",
        curves=(
            Trace(np.array(temperatures), np.array(values), "measured", sigma=np.array(sigmas)),
            Trace(grid, model, "exponential", "dashed"),
        ),
        log_y=True,
    )
    figure = of.figure("doubling_temperature_k", found.doubling_k, found.doubling_k_sigma, "doubling temperature", "K")
    return Findings((figure,), plots=(chart,), details={of.key("doubling"): found})
