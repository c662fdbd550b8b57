"""EMVA 1288 result sheet of a series, from frames or from reduced figures."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, isfinite, nan, sqrt

import numpy as np

from photoplan.errors import InputError
from photoplan.io.series.pixels import Plane
from photoplan.io.series.statistics import ReducedPoint
from photoplan.products.characterise import dark as characterise_dark
from photoplan.products.characterise import pattern as characterise_pattern
from photoplan.products.characterise.common import SettingsRun, exposure_runs, of_one_temperature, prefix, tried
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.products.characterise.transfer import reduced_level
from photoplan.quality.camera.dark_signal import dark_current
from photoplan.quality.camera.emva import EmvaPoints, EmvaSheet, emva_sheet
from photoplan.quality.camera.frame_statistics import Level
from photoplan.quality.camera.photon_transfer import is_clipped_dark

_LEAST = 5
#: Figures of other analyses that belong to the sheet: name there, name here, words, unit, and whether K divides them.
_TAKEN = (
    ("dsnu_dn", "dsnu_e", "DSNU", "e", True),
    ("prnu_percent", "prnu_percent", "PRNU", "%", False),
    ("dark_current_dn_s", "dark_current_e_s", "dark current", "e/s", True),
    ("doubling_temperature_k", "doubling_temperature_k", "doubling temperature", "K", False),
)


@dataclass(frozen=True)
class _Point:
    photons: float
    exposure: float | None
    mean: float
    variance: float
    samples: float
    mean_sigma: float


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    if len(data.series.reduced_of("flat")) >= _LEAST:
        if data.series.reduced_of("dark"):
            return None
        return "reduced figures of dark frames"
    pairs = [run for run in _runs(data) if sum(len(s.frames) >= 2 for s in run.settings) >= _LEAST]
    if not pairs:
        return f"flat frames, two or more at each of {_LEAST} exposures or photons per pixel, from dark to saturated"
    if not any(len(s.frames) >= 2 for s in data.settings("dark")):
        return "dark frames, two or more at the exposures of the flat ones"
    return None


def _runs(data: SeriesData) -> list[SettingsRun]:
    return exposure_runs(data, ("flat",), _LEAST)


def analyse(data: SeriesData) -> Findings:
    """Sheets of every plane and run."""
    if data.series.reduced_of("flat"):
        return _of_reduced(data)
    outcomes = []
    others = _others(data)
    for run in _runs(data):
        for plane in data.planes:
            key = prefix("EMVA 1288", plane.name, run.label)
            found = tried(key, lambda p=plane, r=run: _of_frames(data, r, p))  # type: ignore[misc]
            gain = next((f for f in found.figures if f.name == "gain_dn_e"), None)
            taken = Findings() if gain is None else _taken(others, plane, gain, run.label)
            outcomes += [found, taken]
    return joined(outcomes)


def _of_reduced(data: SeriesData) -> Findings:
    bright, dark = ([_reduced(p) for p in data.series.reduced_of(kind)] for kind in ("flat", "dark"))
    found = tried("EMVA 1288", lambda: _sheet(bright, dark, ("", ""), 1.0))
    gain = next((f for f in found.figures if f.name == "gain_dn_e"), None)
    no_images = Findings(refused={"DSNU and PRNU": "reduced figures hold no images; give frames"})
    if gain is None:
        return found
    points = [p for p in data.series.reduced_of("dark") if p.exposure_ms is not None]
    levels = [reduced_level(data, p) for p in points]
    exposures = [p.exposure_ms or 0.0 for p in points]
    return joined([found, tried("dark current", lambda: _dark_current(exposures, levels, gain)), no_images])


def _dark_current(exposures: list[float], levels: list[Level], gain: Figure) -> Findings:
    found = dark_current(exposures, levels)
    value, sigma = _in_electrons(found.current_dn_s, found.current_dn_s_sigma, gain)
    return Findings((Figure("dark_current_e_s", value, sigma, "dark current", "e/s"),))


def _in_electrons(value: float, sigma: float, gain: Figure) -> tuple[float, float]:
    """Grey values and their standard deviation in electrons."""
    return value / gain.value, hypot(sigma, value * gain.sigma / gain.value) / gain.value


def _others(data: SeriesData) -> Findings:
    """What the analyses of the pattern and of the dark signal say."""
    parts = [module for module in (characterise_pattern, characterise_dark) if module.missing(data) is None]
    return joined([module.analyse(data) for module in parts])


def _taken(others: Findings, plane: Plane, gain: Figure, label: str) -> Findings:
    """Figures of other analyses in the units of the sheet, and those that they refused."""
    figures, refused = [], {}
    for there, here, words, unit, divided in _TAKEN:
        known = [f for f in others.figures if f.name == there and f.plane == plane.name]
        for f in known:
            value, sigma = _in_electrons(f.value, f.sigma, gain) if divided else (f.value, f.sigma)
            figures.append(Figure(here, value, sigma, words, unit, plane.name, prefix(label, f.at)))
        if not known:
            why = [w for what, w in others.refused.items() if what.lower().startswith(words.lower())]
            refused[prefix(words, plane.name, label)] = why[0] if why else "the series lacks frames for it"
    return Findings(tuple(figures), refused)


def _of_frames(data: SeriesData, run: SettingsRun, plane: Plane) -> Findings:
    bright = [_point(data, s, plane.name) for s in run.settings if len(s.frames) >= 2]
    darks = [s for s in data.settings("dark") if len(s.frames) >= 2]
    settings = [s for s in darks if of_one_temperature(s, run.settings[0])]
    levels = [data.levels(s)[plane.name] for s in settings]
    clipped = [level for level in levels if is_clipped_dark(level)]
    if clipped:
        share = 100 * max(level.zero_share for level in clipped)
        raise InputError(
            f"black is cut off: {share:.3g} % of the samples of dark frames are zero; raise the camera's black level"
        )
    dark = [_point(data, s, plane.name) for s in settings]
    return _sheet(bright, dark, (plane.name, run.label), data.step)


def _reduced(point: ReducedPoint) -> _Point:
    photons = nan if point.photons_per_pixel is None else point.photons_per_pixel
    degrees, of_mean = (point.frames - 1) * (point.pixels - 1), sqrt(point.variance / point.frames / point.pixels)
    return _Point(photons, point.exposure_ms, point.mean, point.variance, degrees, of_mean)


def _point(data: SeriesData, setting: Setting, name: str) -> _Point:
    level = data.levels(setting)[name]
    photons = nan if setting.first.photons_per_pixel is None else setting.first.photons_per_pixel
    return _Point(
        photons, setting.first.exposure_ms, level.mean, level.temporal_variance, level.degrees, level.mean_sigma
    )


def _sheet(bright: list[_Point], dark: list[_Point], of: tuple[str, str], step: float) -> Findings:
    plane, label = of
    by_exposure = {point.exposure: point for point in dark}
    pairs = [(p, by_exposure[p.exposure]) for p in bright if p.exposure in by_exposure]
    notes = []
    if len(pairs) < len(bright):
        notes.append(
            f"{prefix(plane, label)}: {len(bright) - len(pairs)} levels have no dark frames of their exposure".lstrip(
                ": "
            )
        )
    points = EmvaPoints(
        np.array([p.photons for p, _ in pairs], float),
        np.array([p.mean for p, _ in pairs], float),
        np.array([p.variance for p, _ in pairs], float),
        np.array([d.mean for _, d in pairs], float),
        np.array([d.variance for _, d in pairs], float),
        np.array([p.samples for p, _ in pairs], float),
        np.array([hypot(p.mean_sigma, d.mean_sigma) for p, d in pairs], float),
    )
    found = emva_sheet(points, step)
    where = {"plane": plane, "at": label}
    figures = tuple(
        Figure(name, value, sigma, words, unit, **where)
        for name, value, sigma, words, unit in _lines(found)
        if isfinite(value)
    )
    p = points.sorted()
    head = ("plane", "at", "photons", "mean_dn", "variance_dn2", "dark_mean_dn", "dark_variance_dn2", "used")
    columns = (p.photons, p.mean, p.variance, p.dark_mean, p.dark_variance, found.used)
    rows: list[tuple[str | float | int, ...]] = [(plane, label, *(float(v) for v in row)) for row in zip(*columns)]
    return Findings(
        figures,
        {prefix(what, plane, label): why for what, why in found.refused.items()},
        {"points": Listing(head, tuple(rows), "Levels of the sheet")},
        _plots(found, p, prefix("EMVA 1288", plane, label)),
        tuple(notes),
        {prefix("sheet", plane, label).replace(" ", "_"): found},
    )


def _lines(s: EmvaSheet) -> list[tuple[str, float, float, str, str]]:
    line = s.linearity
    return [
        (
            "quantum_efficiency_percent",
            s.quantum_efficiency_percent,
            s.quantum_efficiency_percent_sigma,
            "quantum efficiency η",
            "%",
        ),
        ("gain_dn_e", s.gain, s.gain_sigma, "system gain K", "DN/e"),
        ("responsivity_dn_photon", s.responsivity, s.responsivity_sigma, "responsivity R", "DN/photon"),
        ("temporal_dark_noise_dn", s.temporal_dark_noise_dn, nan, "temporal dark noise", "DN"),
        (
            "temporal_dark_noise_e",
            s.temporal_dark_noise_e,
            s.temporal_dark_noise_e_sigma,
            "temporal dark noise σ_d",
            "e",
        ),
        ("saturation_photons", s.saturation_photons, nan, "saturation capacity", "photons"),
        ("saturation_e", s.saturation_e, s.saturation_e_sigma, "saturation capacity", "e"),
        ("threshold_photons", s.threshold_photons, nan, "absolute sensitivity threshold", "photons"),
        ("threshold_e", s.threshold_e, nan, "absolute sensitivity threshold", "e"),
        ("dynamic_range_db", s.dynamic_range_db, nan, "dynamic range", "dB"),
        ("snr_max_db", s.snr_max_db, nan, "largest signal-to-noise ratio", "dB"),
        (
            "linearity_error_percent",
            line.error_percent if line else nan,
            line.error_percent_sigma if line else nan,
            "linearity error LE",
            "%",
        ),
    ]


def _plots(s: EmvaSheet, p: EmvaPoints, title: str) -> tuple[Chart, ...]:
    signal, variance = p.mean - p.dark_mean, p.variance - p.dark_variance
    grid = np.linspace(0, float(signal[s.used].max()), 30)
    charts = [
        Chart(
            f"{title}: photon transfer",
            f"K = {s.gain:.5g} DN/e from levels up to 70 % of saturation.",
            "signal DN",
            "variance above dark DN²",
            (
                Trace(signal[s.used], variance[s.used], "used"),
                Trace(signal[~s.used], variance[~s.used], "not used", colour=3),
                Trace(grid, s.gain * grid, "line", "dashed", colour=1),
            ),
        )
    ]
    if isfinite(s.quantum_efficiency_percent):
        noise = np.sqrt(p.variance)
        good = (signal > 0) & (np.arange(signal.size) <= s.saturation_index)
        ideal = np.sqrt(p.photons[good])
        charts.append(
            Chart(
                f"{title}: signal-to-noise ratio",
                "Measured, and that of an ideal sensor that counts every photon.",
                "photons per pixel",
                "signal-to-noise ratio",
                (
                    Trace(p.photons[good], signal[good] / noise[good], "measured"),
                    Trace(p.photons[good], ideal, "ideal", "dashed"),
                ),
                log_x=True,
                log_y=True,
            )
        )
    return tuple(charts)
