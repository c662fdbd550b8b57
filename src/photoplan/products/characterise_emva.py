"""EMVA 1288 result sheet of a series, from frames or from reduced figures."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, nan

import numpy as np

from photoplan.io.series_statistics import ReducedPoint
from photoplan.products.characterise_common import Run, exposure_runs, prefix, tried
from photoplan.products.characterise_data import SeriesData, Setting
from photoplan.products.characterise_result import Figure, Outcome, Table, joined
from photoplan.quality.emva import EmvaPoints, EmvaSheet, emva_sheet
from photoplan.quality.photon_transfer import is_clipped_dark
from photoplan.report.characterise_charts import Chart, Curve

__all__ = ["analyse", "missing"]

_LEAST = 5
#: What this sheet leaves to the analyses `fixed_pattern` and `dark_signal`.
_ELSEWHERE = "DSNU and PRNU are in fixed_pattern, the dark current in dark_signal; both need frames"


@dataclass(frozen=True)
class _Point:
    photons: float
    exposure: float | None
    mean: float
    variance: float
    samples: float


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


def _runs(data: SeriesData) -> list[Run]:
    return exposure_runs(data, ("flat",), _LEAST)


def analyse(data: SeriesData) -> Outcome:
    """Sheets of every plane and run."""
    if data.series.reduced_of("flat"):
        bright, dark = ([_reduced(p) for p in data.series.reduced_of(kind)] for kind in ("flat", "dark"))
        return tried("EMVA 1288", lambda: _sheet(bright, dark, "", ""))
    outcomes = []
    for run in _runs(data):
        for plane in data.planes:
            bright = [_point(data, s, plane.name) for s in run.settings if len(s.frames) >= 2]
            settings = [s for s in data.settings("dark") if len(s.frames) >= 2]
            clipped = [s for s in settings if is_clipped_dark(data.levels(s)[plane.name])]
            key = prefix("EMVA 1288", plane.name, run.label)
            if clipped:
                share = 100 * max(data.levels(s)[plane.name].zero_share for s in clipped)
                why = f"black is cut off: {share:.3g} % of the samples of dark frames are zero; raise the black level"
                outcomes.append(Outcome(refused={key: why}))
                continue
            dark = [_point(data, s, plane.name) for s in settings]
            outcomes.append(tried(key, lambda b=bright, d=dark, p=plane, r=run: _sheet(b, d, p.name, r.label)))  # type: ignore[misc]
    return joined(outcomes)


def _reduced(point: ReducedPoint) -> _Point:
    photons = nan if point.photons_per_pixel is None else point.photons_per_pixel
    return _Point(photons, point.exposure_ms, point.mean, point.variance, (point.frames - 1) * (point.pixels - 1))


def _point(data: SeriesData, setting: Setting, name: str) -> _Point:
    level = data.levels(setting)[name]
    photons = nan if setting.first.photons_per_pixel is None else setting.first.photons_per_pixel
    return _Point(photons, setting.first.exposure_ms, level.mean, level.temporal_variance, level.degrees)


def _sheet(bright: list[_Point], dark: list[_Point], plane: str, label: str) -> Outcome:
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
    )
    found = emva_sheet(points)
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
    return Outcome(
        figures,
        {prefix(what, plane, label): why for what, why in found.refused.items()},
        {"points": Table(head, tuple(rows), "Levels of the sheet")},
        _plots(found, p, prefix("EMVA 1288", plane, label)),
        (*notes, _ELSEWHERE),
        {prefix("sheet", plane, label).replace(" ", "_"): found.to_dict()},
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
                Curve(signal[s.used], variance[s.used], "used"),
                Curve(signal[~s.used], variance[~s.used], "not used", colour=3),
                Curve(grid, s.gain * grid, "line", "dashed", colour=1),
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
                    Curve(p.photons[good], signal[good] / noise[good], "measured"),
                    Curve(p.photons[good], ideal, "ideal", "dashed"),
                ),
                log_x=True,
                log_y=True,
            )
        )
    return tuple(charts)
