"""Fixed pattern of a series: DSNU, PRNU, their rows, columns and pixels, spectrograms."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite, nan

import numpy as np

from photoplan.errors import InputError
from photoplan.findings import Chart, Findings, Subject, Table, Trace, joined
from photoplan.io.series import Plane
from photoplan.plain import plain
from photoplan.products.characterise.common import black_of, dark_like, no_pair, of_one_temperature, tried
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.quality.camera.sensor import (
    FrameStack,
    PatternVariance,
    Spectrogram,
    check_level,
    cut_off,
    pattern_variance,
    prnu_percent,
    signed_root,
    spectrogram,
)

#: Share of saturation that the standard asks of bright frames.
_HALF = 0.5

missing = no_pair


def analyse(data: SeriesData) -> Findings:
    """DSNU and PRNU of every plane."""
    return joined([_plane(data, plane) for plane in data.planes])


def _plane(data: SeriesData, plane: Plane) -> Findings:
    of, outcomes = Subject(plane.name), []
    dark: PatternVariance | None = None
    flat = _half_bright(data, plane)
    setting = _matching_dark(data, flat)
    if setting is not None:
        stack = data.stacks(setting)[plane.name]
        outcomes.append(tried(of.named("DSNU"), _dsnu, stack, plane, setting.label))
        if outcomes[0].figures:
            dark = _variance(stack, filtered=False)
    if flat is None:
        why = "no flat frames, two or more at a setting, between 5 % and 95 % of saturation"
        outcomes.append(Findings(refused={of.named("PRNU"): why}))
    else:
        outcomes.append(tried(of.named("PRNU"), _prnu, data, flat, plane, dark))
    return joined(outcomes)


def _half_bright(data: SeriesData, plane: Plane) -> Setting | None:
    """The flat setting whose mean is nearest to half of saturation."""
    full = data.saturation_dn(plane.name)
    best, distance = None, np.inf
    for setting in data.settings("flat", least=2):
        level = data.levels(setting)[plane.name]
        share = (level.mean - black_of(data, setting, plane).mean) / full if isfinite(full) else _HALF
        if 0.05 <= share <= 0.95 and level.saturated_share < 1e-3 and abs(share - _HALF) < distance:
            best, distance = setting, abs(share - _HALF)
    return best


def _matching_dark(data: SeriesData, flat: Setting | None) -> Setting | None:
    """Dark frames of the same exposure as the flat ones, else those with the most frames, of their temperature."""
    same = None if flat is None else dark_like(data, flat, least=2)
    fit = [s for s in data.settings("dark", least=2) if flat is None or of_one_temperature(s, flat)]
    return same or max(fit, key=lambda s: len(s.frames), default=None)


def _variance(stack: FrameStack, filtered: bool) -> PatternVariance:
    check_level(stack.level)
    if stack.level.saturated_share > 1e-2:
        raise InputError("over 1 % of the samples are saturated, which hides the pattern")
    if stack.counted is not None:
        raise InputError("a mask or brightest is in use; rows and columns need a rectangle: give a roi instead")
    return pattern_variance(stack.mean, stack.level.temporal_variance, stack.level.frames, filtered=filtered)


def _dsnu(stack: FrameStack, plane: Plane, label: str) -> Findings:
    cut = cut_off([stack.level])
    if cut:
        raise InputError(f"{cut}, which hides the pattern; raise the camera's black level")
    found = _variance(stack, filtered=False)
    return joined([_parts(found, ("dsnu", "DSNU", "dn"), plane, 1.0, label), _spectra(stack, plane, "dark")])


def _prnu(data: SeriesData, flat: Setting, plane: Plane, dark: PatternVariance | None) -> Findings:
    stack, of = data.stacks(flat)[plane.name], Subject(plane.name)
    raw = _variance(stack, filtered=False)
    even = _variance(stack, filtered=True)
    black = dark.mean if dark is not None else data.series.camera.black_level_dn
    signal = raw.mean - black
    if signal <= 3 * np.sqrt(stack.level.temporal_variance):
        raise InputError(f"flat frames ({raw.mean:.4g} DN) are not clearly brighter than black ({black:.4g} DN)")
    figures = [
        of.figure(kind, *prnu_percent(found, black if dark is None else dark), "PRNU", "%", remark)
        for kind, found, remark in (
            ("prnu_percent", even, "slow variation of the light taken out"),
            ("prnu_unfiltered_percent", raw, "with the light's unevenness"),
        )
    ]
    notes = () if dark is not None else (f"{of.plane} PRNU: no dark pattern taken out".strip(),)
    parts = _parts(even, ("bright", "bright pattern", "percent"), plane, 100 / signal, flat.label)
    return joined([Findings(tuple(figures), notes=notes), parts, _spectra(stack, plane, "flat")])


def _parts(found: PatternVariance, named: tuple[str, str, str], plane: Plane, factor: float, label: str) -> Findings:
    """Total, rows, columns and pixels of a pattern as figures."""
    (key, words, suffix), of, figures = named, Subject(plane.name), []
    unit = {"dn": "DN", "percent": "%"}[suffix]
    for part in ("total", "row", "column", "pixel"):
        variance = getattr(found, part)
        value, sigma = signed_root(variance, getattr(found, f"{part}_sigma"))
        name, what = (f"{key}_{suffix}", words) if part == "total" else (f"{key}_{part}_{suffix}", f"{words}, {part}s")
        remark = "not above zero" if variance <= 0 else ""
        figures.append(of.figure(name, value * factor, sigma * factor, what, unit, remark))
    return Findings(tuple(figures), details={of.key(key): {**plain(found), "setting": label}})


def _spectra(stack: FrameStack, plane: Plane, what: str) -> Findings:
    """Spectrograms along rows and columns, with frequencies in pixels of the image."""
    of = Subject(plane.name)
    along = {way: _of_image(spectrogram(stack.mean, axis), plane.step) for way, axis in (("rows", 1), ("columns", 0))}
    tables = [
        Table.of(
            "Spectrograms", image=of.named(what), along=way, frequency_cycles_px=s.frequency, amplitude_dn=s.amplitude
        )
        for way, s in along.items()
    ]
    figures = [
        of.figure(f"excess_{what}_{way}", s.excess, nan, f"power over white noise along {way}, {what}", "", _peak(s))
        for way, s in along.items()
    ]
    chart = Chart(
        title=f"Spectrogram, {of.named(what)}",
        caption="Root of the power; white noise is level, peaks are periodic patterns.",
        x_label="frequency cycles/px",
        y_label="amplitude DN",
        curves=tuple(Trace(s.frequency, s.amplitude, f"along {way}", "line") for way, s in along.items()),
        log_y=True,
    )
    parts = [Findings(tables={"spectrograms": table}) for table in tables]
    return joined([Findings(tuple(figures), plots=(chart,)), *parts])


def _of_image(s: Spectrogram, step: int) -> Spectrogram:
    """With frequencies in cycles per pixel of the image, of which a colour has every second one."""
    return replace(s, frequency=s.frequency / step, peak_frequency=s.peak_frequency / step)


def _peak(s: Spectrogram) -> str:
    return f"peak at {s.peak_frequency:.4g} cycles/px" if isfinite(s.peak_frequency) else ""
