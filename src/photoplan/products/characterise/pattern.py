"""Fixed pattern of a series: DSNU, PRNU, their rows, columns and pixels, spectrograms."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite, nan

import numpy as np

from photoplan.errors import InputError
from photoplan.io.series.pixels import Plane
from photoplan.plain import plain
from photoplan.products.characterise.common import black_of, of_one_temperature, prefix, tried
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.quality.camera.fixed_pattern import (
    PatternVariance,
    Spectrogram,
    pattern_variance,
    prnu_percent,
    signed_root,
    spectrogram,
)
from photoplan.quality.camera.frame_statistics import FrameStack, check_level
from photoplan.quality.camera.photon_transfer import is_clipped_dark

#: Share of saturation that the standard asks of bright frames.
_HALF = 0.5


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    if _best_dark(data) is not None or _flats(data):
        return None
    return "no setting of dark or flat frames has two frames or more"


def _best_dark(data: SeriesData, flat: Setting | None = None) -> Setting | None:
    """The dark setting with the most frames, of the flat frames' temperature."""
    settings = [
        s for s in data.settings("dark") if len(s.frames) >= 2 and (flat is None or of_one_temperature(s, flat))
    ]
    return max(settings, key=lambda s: len(s.frames), default=None)


def _flats(data: SeriesData) -> list[Setting]:
    return [s for s in data.settings("flat") if len(s.frames) >= 2]


def analyse(data: SeriesData) -> Findings:
    """DSNU and PRNU of every plane."""
    return joined([_plane(data, plane) for plane in data.planes])


def _plane(data: SeriesData, plane: Plane) -> Findings:
    outcomes = []
    dark: PatternVariance | None = None
    flat = _half_bright(data, plane)
    setting = _matching_dark(data, flat)
    if setting is not None:
        stack = data.stacks(setting)[plane.name]
        outcomes.append(tried(prefix("DSNU", plane.name), lambda: _dsnu(stack, plane, setting.label)))
        if not is_clipped_dark(stack.level) and outcomes[0].figures:
            dark = _variance(stack, filtered=False)
    if flat is None:
        why = "no flat frames, two or more at a setting, between 5 % and 95 % of saturation"
        outcomes.append(Findings(refused={prefix("PRNU", plane.name): why}))
    else:
        outcomes.append(tried(prefix("PRNU", plane.name), lambda: _prnu(data, flat, plane, dark)))
    return joined(outcomes)


def _half_bright(data: SeriesData, plane: Plane) -> Setting | None:
    """The flat setting whose mean is nearest to half of saturation."""
    full = data.saturation_dn(plane.name)
    best, distance = None, np.inf
    for setting in _flats(data):
        level = data.levels(setting)[plane.name]
        share = (level.mean - black_of(data, setting, plane).mean) / full if isfinite(full) else _HALF
        if 0.05 <= share <= 0.95 and level.saturated_share < 1e-3 and abs(share - _HALF) < distance:
            best, distance = setting, abs(share - _HALF)
    return best


def _matching_dark(data: SeriesData, flat: Setting | None) -> Setting | None:
    """Dark frames of the same exposure as the flat ones, else those with the most frames."""
    if flat is not None:
        for setting in data.settings("dark"):
            same = setting.first.exposure_ms == flat.first.exposure_ms and of_one_temperature(setting, flat)
            if same and len(setting.frames) >= 2:
                return setting
    return _best_dark(data, flat)


def _variance(stack: FrameStack, filtered: bool) -> PatternVariance:
    check_level(stack.level)
    if stack.level.saturated_share > 1e-2:
        raise InputError("over 1 % of the samples are saturated, which hides the pattern")
    if stack.counted is not None:
        raise InputError("a mask or brightest is in use; rows and columns need a rectangle: give a roi instead")
    return pattern_variance(stack.mean, stack.level.temporal_variance, stack.level.frames, filtered=filtered)


def _dsnu(stack: FrameStack, plane: Plane, label: str) -> Findings:
    if is_clipped_dark(stack.level):
        raise InputError(
            f"black is cut off: {100 * stack.level.zero_share:.3g} % of the samples are zero, which hides the pattern; "
            "raise the camera's black level"
        )
    found = _variance(stack, filtered=False)
    return joined(
        [
            _parts(found, "dsnu", "DSNU", plane.name, "DN", 1.0, label),
            _spectra(stack, plane, f"dark {plane.name}".strip()),
        ]
    )


def _prnu(data: SeriesData, flat: Setting, plane: Plane, dark: PatternVariance | None) -> Findings:
    stack = data.stacks(flat)[plane.name]
    raw = _variance(stack, filtered=False)
    even = _variance(stack, filtered=True)
    black = dark.mean if dark is not None else data.series.camera.black_level_dn
    signal = raw.mean - black
    if signal <= 3 * np.sqrt(stack.level.temporal_variance):
        raise InputError(f"flat frames ({raw.mean:.4g} DN) are not clearly brighter than black ({black:.4g} DN)")
    name = plane.name
    figures = []
    for kind, found, remark in (
        ("prnu_percent", even, "slow variation of the light taken out"),
        ("prnu_unfiltered_percent", raw, "with the light's unevenness"),
    ):
        value, sigma = prnu_percent(found, dark if dark is not None else _no_pattern(black))
        figures.append(Figure(kind, value, sigma, "PRNU", "%", name, remark=remark))
    notes = () if dark is not None else (f"{prefix(name, 'PRNU')}: no dark pattern taken out",)
    whole = Findings(tuple(figures), notes=notes)
    parts = _parts(even, "bright", "bright pattern", name, "%", 100 / signal, flat.label)
    return joined([whole, parts, _spectra(stack, plane, f"flat {name}".strip())])


def _no_pattern(black: float) -> PatternVariance:
    return PatternVariance(
        total=0,
        total_sigma=0,
        row=0,
        row_sigma=0,
        column=0,
        column_sigma=0,
        pixel=0,
        pixel_sigma=0,
        mean=black,
        temporal_rest=0,
        filtered=False,
    )


def _parts(found: PatternVariance, key: str, words: str, plane: str, unit: str, factor: float, label: str) -> Findings:
    """Total, rows, columns and pixels of a pattern as figures, variances as a table."""
    figures = []
    for part, variance, sigma in (
        ("", found.total, found.total_sigma),
        ("row", found.row, found.row_sigma),
        ("column", found.column, found.column_sigma),
        ("pixel", found.pixel, found.pixel_sigma),
    ):
        value, of_value = signed_root(variance, sigma)
        name = "_".join(filter(None, [key, part, "percent" if unit == "%" else "dn"]))
        what = f"{words}, {part}s" if part else words
        remark = "not above zero" if variance <= 0 else ""
        figures.append(Figure(name, value * factor, of_value * factor, what, unit, plane, remark=remark))
    return Findings(tuple(figures), details={prefix(key, plane).replace(" ", "_"): {**plain(found), "setting": label}})


def _spectra(stack: FrameStack, of: Plane, title: str) -> Findings:
    """Spectrograms along rows and columns, with frequencies in pixels of the image."""
    plane = of.name
    along = {way: _of_image(spectrogram(stack.mean, axis), of.step) for way, axis in (("rows", 1), ("columns", 0))}
    head = ("image", "along", "frequency_cycles_px", "amplitude_dn")
    rows = tuple((title, way, float(f), float(a)) for way, s in along.items() for f, a in zip(s.frequency, s.amplitude))
    figures = [
        Figure(
            f"excess_{title.split()[0]}_{way}",
            s.excess,
            nan,
            f"power over white noise along {way}, {title.split()[0]}",
            "",
            plane,
            remark=_peak(s),
        )
        for way, s in along.items()
    ]
    curves = tuple(Trace(s.frequency, s.amplitude, f"along {way}", "line") for way, s in along.items())
    chart = Chart(
        f"Spectrogram, {title}",
        "Root of the power; white noise is level, peaks are periodic patterns.",
        "frequency cycles/px",
        "amplitude DN",
        curves,
        log_y=True,
    )
    return Findings(tuple(figures), tables={"spectrograms": Listing(head, rows, "Spectrograms")}, plots=(chart,))


def _of_image(s: Spectrogram, step: int) -> Spectrogram:
    """With frequencies in cycles per pixel of the image, of which a colour has every second one."""
    return replace(s, frequency=s.frequency / step, peak_frequency=s.peak_frequency / step)


def _peak(s: Spectrogram) -> str:
    return f"peak at {s.peak_frequency:.4g} cycles/px" if isfinite(s.peak_frequency) else ""
