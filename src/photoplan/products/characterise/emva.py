"""EMVA 1288 result sheet of a series, from frames or from reduced figures."""

from __future__ import annotations

from math import hypot, isfinite, nan

import numpy as np

from photoplan.errors import InputError
from photoplan.findings import Chart, Estimate, Findings, Subject, Table, Trace, joined, known
from photoplan.io.series import ReducedPoint
from photoplan.products.characterise.data import (
    SeriesData,
    Setting,
    SettingsRun,
    exposure_runs,
    of_one_temperature,
    tried,
    used_and_rest,
)
from photoplan.products.characterise.noise import analyse_dark_signal as analyse_dark
from photoplan.products.characterise.noise import analyse_fixed_pattern as analyse_pattern
from photoplan.products.characterise.noise import missing_for_dark_signal as missing_dark
from photoplan.products.characterise.noise import missing_for_fixed_pattern as missing_pattern
from photoplan.products.characterise.noise import reduced_level
from photoplan.quality.camera.photon_transfer import EmvaPoints, EmvaSheet, emva_sheet
from photoplan.quality.camera.sensor import Level, cut_off, dark_current

_LEAST = 5
#: Figures of other analyses that belong to the sheet: name there, name here, words, unit, and whether K divides them.
_TAKEN = (
    ("dsnu_dn", "dsnu_e", "DSNU", "e", True),
    ("prnu_percent", "prnu_percent", "PRNU", "%", False),
    ("dark_current_dn_s", "dark_current_e_s", "dark current", "e/s", True),
    ("doubling_temperature_k", "doubling_temperature_k", "doubling temperature", "K", False),
)


#: Photons per pixel (NaN: not stated), exposure and grey values of a setting.
_Point = tuple[float, float | None, Level]


def missing_for_emva1288(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    if len(data.series.reduced_of("flat")) >= _LEAST:
        return None if data.series.reduced_of("dark") else "reduced figures of dark frames"
    if not any(sum(len(s.frames) >= 2 for s in run.settings) >= _LEAST for run in _runs(data)):
        return f"flat frames, two or more at each of {_LEAST} exposures or photons per pixel, from dark to saturated"
    return None if data.settings("dark", least=2) else "dark frames, two or more at the exposures of the flat ones"


def _runs(data: SeriesData) -> list[SettingsRun]:
    return exposure_runs(data, ("flat",), _LEAST)


def analyse_emva1288(data: SeriesData) -> Findings:
    """Sheets of every plane and run."""
    if data.series.reduced_of("flat"):
        return _of_reduced(data)
    outcomes = []
    parts = ((missing_pattern, analyse_pattern), (missing_dark, analyse_dark))
    others = [found(data) for lacks, found in parts if lacks(data) is None]
    for run in _runs(data):
        for plane in data.planes:
            of = Subject(plane.name, run.label)
            found = tried(of.named("EMVA 1288"), _of_frames, data, run, of)
            gain = next((f for f in found.figures if f.name == "gain_dn_e"), None)
            outcomes += [found] if gain is None else [found, _taken(joined(others), gain, of)]
    return joined(outcomes)


def _of_reduced(data: SeriesData) -> Findings:
    bright, darks = ([_reduced(data, p) for p in data.series.reduced_of(kind)] for kind in ("flat", "dark"))
    found = tried("EMVA 1288", _sheet, bright, darks, Subject(), 1.0)
    gain = next((f for f in found.figures if f.name == "gain_dn_e"), None)
    if gain is None:
        return found
    timed = [(exposure, level) for _, exposure, level in darks if exposure is not None]
    no_images = Findings(refused={"DSNU and PRNU": "reduced figures hold no images; give frames"})
    return joined([found, tried("dark current", _dark_current, timed, gain), no_images])


def _dark_current(timed: list[tuple[float, Level]], gain: Estimate) -> Findings:
    found = dark_current([exposure for exposure, _ in timed], [level for _, level in timed])
    in_electrons = _in_electrons(found.current_dn_s, found.current_dn_s_sigma, gain)
    return Findings((Estimate("dark_current_e_s", *in_electrons, "dark current", "e/s"),))


def _in_electrons(value: float, sigma: float, gain: Estimate) -> tuple[float, float]:
    """Grey values and their standard deviation in electrons."""
    return value / gain.value, hypot(sigma, value * gain.sigma / gain.value) / gain.value


def _taken(others: Findings, gain: Estimate, of: Subject) -> Findings:
    """Figures of other analyses in the units of the sheet, and those that they refused."""
    figures, refused = [], {}
    for there, here, words, unit, divided in _TAKEN:
        known_there = [f for f in others.figures if f.name == there and f.plane == of.plane]
        for f in known_there:
            both = _in_electrons(f.value, f.sigma, gain) if divided else (f.value, f.sigma)
            figures.append(of.under(f.at).figure(here, *both, words, unit))
        if not known_there:
            why = [w for what, w in others.refused.items() if what.lower().startswith(words.lower())]
            refused[of.named(words)] = why[0] if why else "the series lacks frames for it"
    return Findings(tuple(figures), refused)


def _of_frames(data: SeriesData, run: SettingsRun, of: Subject) -> Findings:
    settings = [s for s in data.settings("dark", least=2) if of_one_temperature(s, run.settings[0])]
    darks = [_point(data, s, of.plane) for s in settings]
    cut = cut_off([level for _, _, level in darks], " of dark frames")
    if cut:
        raise InputError(f"{cut}; raise the camera's black level")
    bright = [_point(data, s, of.plane) for s in run.settings if len(s.frames) >= 2]
    return _sheet(bright, darks, of, data.step)


def _reduced(data: SeriesData, point: ReducedPoint) -> _Point:
    photons = nan if point.photons_per_pixel is None else point.photons_per_pixel
    return photons, point.exposure_ms, reduced_level(data, point)


def _point(data: SeriesData, setting: Setting, name: str) -> _Point:
    photons = nan if setting.first.photons_per_pixel is None else setting.first.photons_per_pixel
    return photons, setting.first.exposure_ms, data.levels(setting)[name]


def _sheet(bright: list[_Point], darks: list[_Point], of: Subject, step: float) -> Findings:
    by_exposure = {exposure: level for _, exposure, level in darks}
    pairs = [(photons, level, by_exposure[at]) for photons, at, level in bright if at in by_exposure]
    lacking = f"{of.named()}: {len(bright) - len(pairs)} levels have no dark frames of their exposure".lstrip(": ")
    rows = [
        (p, a.mean, a.temporal_variance, b.mean, b.temporal_variance, a.degrees, hypot(a.mean_sigma, b.mean_sigma))
        for p, a, b in pairs
    ]
    points = EmvaPoints(*np.array(rows, float).reshape(-1, 7).T).sorted()
    found = emva_sheet(points, step)
    table = Table.of(
        "Levels of the sheet",
        plane=of.plane,
        at=of.at,
        photons=points.photons,
        mean_dn=points.mean,
        variance_dn2=points.variance,
        dark_mean_dn=points.dark_mean,
        dark_variance_dn2=points.dark_variance,
        used=found.used,
    )
    return Findings(
        figures=_figures(found, of),
        refused={of.named(what): why for what, why in found.refused.items()},
        tables={"points": table},
        plots=_plots(found, points, of.named("EMVA 1288")),
        notes=(lacking,) if len(pairs) < len(bright) else (),
        details={of.key("sheet"): found},
    )


def _figures(s: EmvaSheet, of: Subject) -> tuple[Estimate, ...]:
    efficiency, of_efficiency = s.quantum_efficiency_percent, s.quantum_efficiency_percent_sigma
    noise, of_noise = s.temporal_dark_noise_e, s.temporal_dark_noise_e_sigma
    line = s.linearity
    error, of_error = (nan, nan) if line is None else (line.error_percent, line.error_percent_sigma)
    return known(
        of.figure("quantum_efficiency_percent", efficiency, of_efficiency, "quantum efficiency η", "%"),
        of.figure("gain_dn_e", s.gain, s.gain_sigma, "system gain K", "DN/e"),
        of.figure("responsivity_dn_photon", s.responsivity, s.responsivity_sigma, "responsivity R", "DN/photon"),
        of.figure("temporal_dark_noise_dn", s.temporal_dark_noise_dn, nan, "temporal dark noise", "DN"),
        of.figure("temporal_dark_noise_e", noise, of_noise, "temporal dark noise σ_d", "e"),
        of.figure("saturation_photons", s.saturation_photons, nan, "saturation capacity", "photons"),
        of.figure("saturation_e", s.saturation_e, s.saturation_e_sigma, "saturation capacity", "e"),
        of.figure("threshold_photons", s.threshold_photons, nan, "absolute sensitivity threshold", "photons"),
        of.figure("threshold_e", s.threshold_e, nan, "absolute sensitivity threshold", "e"),
        of.figure("dynamic_range_db", s.dynamic_range_db, nan, "dynamic range", "dB"),
        of.figure("snr_max_db", s.snr_max_db, nan, "largest signal-to-noise ratio", "dB"),
        of.figure("linearity_error_percent", error, of_error, "linearity error LE", "%"),
    )


def _plots(s: EmvaSheet, p: EmvaPoints, title: str) -> tuple[Chart, ...]:
    signal, variance = p.mean - p.dark_mean, p.variance - p.dark_variance
    grid = np.linspace(0, float(signal[s.used].max()), 30)
    charts = [
        Chart(
            title=f"{title}: photon transfer",
            caption=f"K = {s.gain:.5g} DN/e from levels up to 70 % of saturation.",
            x_label="signal DN",
            y_label="variance above dark DN²",
            curves=(*used_and_rest(signal, variance, s.used), Trace(grid, s.gain * grid, "line", "dashed", colour=1)),
        )
    ]
    if isfinite(s.quantum_efficiency_percent):
        noise = np.sqrt(p.variance)
        good = (signal > 0) & (np.arange(signal.size) <= s.saturation_index)
        ideal = np.sqrt(p.photons[good])
        charts.append(
            Chart(
                title=f"{title}: signal-to-noise ratio",
                caption="Measured, and that of an ideal sensor that counts every photon.",
                x_label="photons per pixel",
                y_label="signal-to-noise ratio",
                curves=(
                    Trace(p.photons[good], signal[good] / noise[good], "measured"),
                    Trace(p.photons[good], ideal, "ideal", "dashed"),
                ),
                log_x=True,
                log_y=True,
            )
        )
    return tuple(charts)
