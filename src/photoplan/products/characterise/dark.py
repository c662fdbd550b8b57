"""Dark signal of a series: offset, dark current, temporal dark noise and doubling temperature."""

from __future__ import annotations

from math import sqrt

import numpy as np

from photoplan.errors import InputError
from photoplan.io.series.pixels import Plane
from photoplan.products.characterise.common import MOST_SATURATED, prefix, tried
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.quality.camera.dark_signal import DarkCurrent, dark_current, doubling_temperature
from photoplan.quality.camera.frame_statistics import Level

_LEAST = 3
Currents = dict[float | None, DarkCurrent]


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
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
    outcomes, currents = [], Currents()
    for temperature, settings in by_temperature.items():
        settings = sorted(settings, key=lambda s: s.first.exposure_ms or 0.0)
        levels = [data.levels(setting)[plane.name] for setting in settings]
        at = "" if temperature is None else f"{temperature:g} °C"
        key = prefix("dark current", plane.name, at)
        outcomes.append(
            tried(key, lambda s=settings, v=levels, t=temperature, a=at: _current(s, v, plane.name, (t, a), currents))  # type: ignore[misc]
        )
    stated = [temperature for temperature in by_temperature if temperature is not None]
    outcomes.append(_doubling(currents, plane.name, len(stated)))
    return joined(outcomes)


def _current(
    settings: list[Setting], levels: list[Level], name: str, at: tuple[float | None, str], currents: Currents
) -> Findings:
    exposures = [float(setting.first.exposure_ms or 0.0) for setting in settings]
    full = [k for k, level in enumerate(levels) if level.saturated_share > MOST_SATURATED]
    used = [k for k in range(len(levels)) if k not in full]
    if full and len(used) < _LEAST:
        raise InputError(
            f"over {100 * MOST_SATURATED:g} % of the samples are saturated from {exposures[full[0]]:g} ms on; take "
            "shorter exposures"
        )
    found = dark_current([exposures[k] for k in used], [levels[k] for k in used])
    currents[at[0]] = found
    shortest = levels[0]
    noise = sqrt(shortest.temporal_variance)
    where = {"plane": name, "at": at[1]}
    figures = (
        Figure(
            "dark_offset_dn", found.offset_dn, found.offset_dn_sigma, "dark grey value at no exposure", "DN", **where
        ),
        Figure("dark_current_dn_s", found.current_dn_s, found.current_dn_s_sigma, "dark current", "DN/s", **where),
        Figure(
            "dark_noise_dn",
            noise,
            shortest.variance_sigma / (2 * noise) if noise > 0 else 0.0,
            "temporal dark noise",
            "DN",
            remark=f"with rounding, at {exposures[0]:g} ms",
            **where,
        ),
    )
    means = [level.mean for level in levels]
    rows = tuple(
        (name, at[1], t, level.mean, level.mean_sigma, level.temporal_variance, "no" if k in full else "yes")
        for k, (t, level) in enumerate(zip(exposures, levels))
    )
    head = ("plane", "temperature", "exposure_ms", "mean_dn", "sigma_dn", "variance_dn2", "used")
    t = np.array(exposures) / 1000
    chart = Chart(
        f"Dark signal {' '.join(filter(None, [name, at[1]]))}".strip(),
        f"Dark current {found.current_dn_s:.4g} ± {found.current_dn_s_sigma:.2g} DN/s.",
        "exposure s",
        "mean grey value DN",
        (Trace(t, np.array(means), "dark frames"), Trace(t, found.line.at(t), "line", "dashed")),
    )
    return Findings(
        figures,
        tables={"levels": Listing(head, rows, "Dark frames")},
        plots=(chart,),
        notes=tuple(f"{settings[k].label}: saturated, not used" for k in full),
        details={prefix("dark_current", name, at[1]).replace(" ", "_"): found},
    )


def _doubling(currents: Currents, name: str, stated: int) -> Findings:
    known = {t: c for t, c in currents.items() if t is not None}
    key = prefix("doubling temperature", name)
    if stated < 2:
        why = f"the dark frames state {stated} temperatures; two or more are needed (temperature_c)"
        return Findings(refused={"doubling temperature": why})
    if len(known) < 2:
        return Findings(
            refused={key: f"a dark current is known at {len(known)} of {stated} temperatures; two are needed"}
        )
    temperatures = sorted(known)
    values = [known[t].current_dn_s for t in temperatures]
    sigmas = [known[t].current_dn_s_sigma for t in temperatures]
    try:
        found = doubling_temperature(temperatures, values, sigmas)
    except InputError as error:
        return Findings(refused={key: str(error)})
    grid = np.linspace(temperatures[0], temperatures[-1], 50)
    model = found.current_at_reference * 2 ** ((grid - found.reference_c) / found.doubling_k)
    chart = Chart(
        f"Dark current against temperature {name}".strip(),
        f"It doubles every {found.doubling_k:.3g} ± {found.doubling_k_sigma:.2g} K.",
        "temperature °C",
        "dark current DN/s",
        (
            Trace(np.array(temperatures), np.array(values), "measured", sigma=np.array(sigmas)),
            Trace(grid, model, "exponential", "dashed"),
        ),
        log_y=True,
    )
    figure = Figure(
        "doubling_temperature_k", found.doubling_k, found.doubling_k_sigma, "doubling temperature", "K", name
    )
    return Findings((figure,), plots=(chart,), details={prefix("doubling", name).replace(" ", "_"): found})
