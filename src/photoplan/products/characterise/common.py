"""Shared parts of the analyses of a camera: series of settings, black levels, refusals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import Findings, Subject, Trace, joined
from photoplan.io.series import Plane
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.quality.camera.photon_transfer import Saturation, find_saturation
from photoplan.quality.camera.sensor import Level

#: Share of saturated samples up to which a mean grey value is one.
MOST_SATURATED = 1e-2
#: Conditions that may be the abscissa of a run, with what axes say.
_ABSCISSAS = (
    ("exposure_ms", "exposure ms", "ms"),
    ("photons_per_pixel", "photons per pixel", "photon"),
    ("illumination", "illumination", "step"),
)


@dataclass(frozen=True)
class SettingsRun:
    """Settings that differ in one condition only, by its growing value."""

    settings: tuple[Setting, ...]
    name: str
    """Name of the condition, such as ``exposure_ms``."""
    axis: str
    unit: str
    label: str
    """Common condition of the settings, such as ``500 nm``."""

    @property
    def values(self) -> tuple[float, ...]:
        """The condition, increasing."""
        return tuple(float(getattr(setting.first, self.name)) for setting in self.settings)

    def saturation(self, data: SeriesData, plane: Plane) -> Saturation | None:
        """Return the level where it saturates; it has four levels at least."""
        levels = [data.levels(setting)[plane.name] for setting in self.settings]
        variance = np.array([level.temporal_variance for level in levels])
        return find_saturation(
            self.values,
            [level.mean for level in levels],
            black_if_known(data, self.settings[0], plane),
            [level.saturated_share for level in levels],
            variance if np.isfinite(variance).all() else None,
        )


def exposure_runs(data: SeriesData, kinds: Sequence[str], least: int) -> list[SettingsRun]:
    """Runs of at least so many settings of different exposure, photons or illumination (the first that differs)."""
    found: dict[tuple[object, ...], list[Setting]] = {}
    for setting in data.settings(*kinds):
        first = setting.first
        key = (first.group.index, first.kind, first.wavelength_nm, first.temperature_c, first.density)
        found.setdefault(key, []).append(setting)
    runs = (_run(settings) for settings in found.values())
    return [run for run in runs if run is not None and len(run.settings) >= least]


def no_run(data: SeriesData, kinds: Sequence[str], least: int, what: str) -> str | None:
    """Return why there is no run for an analysis; None if there is one."""
    if exposure_runs(data, kinds, least):
        return None
    return (
        f"{len(data.settings(*kinds))} settings of {' or '.join(kinds)} frames; {what} needs {least} that differ in "
        "exposure_ms (or photons_per_pixel, or illumination) and in nothing else"
    )


def no_pair(data: SeriesData) -> str | None:
    """Return why frames of one setting cannot be compared; None if they can."""
    enough = data.settings("dark", "flat", least=2)
    return None if enough else "no setting of dark or flat frames has two frames or more"


def of_runs(
    data: SeriesData, kinds: Sequence[str], least: int, what: str, analyse: Callable[..., Findings]
) -> Findings:
    """Return findings in every run and plane; `analyse` takes data, run, plane and the subject of the figures."""
    of = [(run, plane) for run in exposure_runs(data, kinds, least) for plane in data.planes]
    subjects = [Subject(plane.name, run.label) for run, plane in of]
    return joined([tried(s.named(what), analyse, data, *each, s) for each, s in zip(of, subjects)])


def _run(settings: Sequence[Setting]) -> SettingsRun | None:
    for name, axis, unit in _ABSCISSAS:
        values = [getattr(setting.first, name) for setting in settings]
        if None in values or len(set(values)) < 2 or len(set(values)) < len(values):
            continue
        ordered = tuple(sorted(settings, key=lambda s: float(getattr(s.first, name))))
        return SettingsRun(settings=ordered, name=name, axis=axis, unit=unit, label=_common(ordered))
    return None


def _common(settings: Sequence[Setting]) -> str:
    first = settings[0].first
    words = [first.group.entry.name] if first.group.entry.name else []
    for name, unit in (("wavelength_nm", "nm"), ("temperature_c", "°C"), ("density", "density")):
        value = getattr(first, name)
        if value is not None:
            words.append(f"{value:g} {unit}")
    return " ".join(words)


@dataclass(frozen=True)
class Black:
    """Grey value without light."""

    mean: float
    sigma: float
    level: Level | None
    """Setting of the dark frames that it comes from; None if it was stated."""
    rule: str
    """Its origin, for notes."""


def black_of(data: SeriesData, setting: Setting, plane: Plane) -> Black:
    """Black of a setting: dark frames of its exposure, else by lines through the nearest others, else what is stated.

    Dark frames of another temperature (by more than half a degree), and those that are cut off at black or
    saturated, do not count.
    """
    known: list[tuple[float, Level]] = []
    of_any: Level | None = None
    clipped = False
    for dark in data.settings("dark"):
        if not of_one_temperature(dark, setting):
            continue
        level = data.levels(dark)[plane.name]
        clipped = clipped or level.is_cut_off
        if level.is_cut_off or level.saturated_share > MOST_SATURATED:
            continue
        if dark.first.exposure_ms == setting.first.exposure_ms:
            return Black(level.mean, _sigma(level), level, "dark frames of the same exposure")
        if dark.first.exposure_ms is not None:
            known.append((dark.first.exposure_ms, level))
        else:
            of_any = level
    if known and setting.first.exposure_ms is not None:
        known.sort(key=lambda item: item[0])
        mean = _between(setting.first.exposure_ms, [(exposure, level.mean) for exposure, level in known])
        sigma = max(_sigma(level) for _, level in known)
        return Black(mean, sigma, None, "from dark frames of other exposures")
    if of_any is not None:
        return Black(of_any.mean, _sigma(of_any), None, "from dark frames without a stated exposure")
    stated = data.series.camera.black_level_dn
    why = "black is cut off in the dark frames" if clipped else "no dark frames that fit"
    return Black(stated, 0.0, None, f"{why}: black level {stated:g} DN, as black_level_dn says")


def black_if_known(data: SeriesData, setting: Setting, plane: Plane) -> float:
    """Black of a setting; NaN: neither dark frames nor the series file tell it."""
    black = black_of(data, setting, plane)
    told = black.sigma > 0 or black.level is not None or black.rule.startswith("from dark frames")
    return black.mean if told else data.stated_black


def _between(exposure: float, known: Sequence[tuple[float, float]]) -> float:
    """Value at an exposure by the line through the two nearest of the sorted points; that of a single one."""
    if len(known) == 1:
        return known[0][1]
    right = min(max(int(np.searchsorted([x for x, _ in known], exposure)), 1), len(known) - 1)
    (x0, y0), (x1, y1) = known[right - 1], known[right]
    return y0 + (y1 - y0) * (exposure - x0) / (x1 - x0)


def _sigma(level: Level) -> float:
    return level.mean_sigma if isfinite(level.mean_sigma) else 0.0


def of_one_temperature(dark: Setting, setting: Setting) -> bool:
    """Return whether dark frames fit a setting: to half a degree, if both state a temperature."""
    a, b = dark.first.temperature_c, setting.first.temperature_c
    return a is None or b is None or abs(a - b) <= 0.5


def dark_like(data: SeriesData, setting: Setting, least: int = 1) -> Setting | None:
    """Dark frames of the exposure and temperature of a setting."""
    fit = (s for s in data.settings("dark", least=least) if s.first.exposure_ms == setting.first.exposure_ms)
    return next((s for s in fit if of_one_temperature(s, setting)), None)


def dark_levels(data: SeriesData, plane: Plane, like: Setting) -> tuple[list[Level], list[float]]:
    """Levels of the dark settings with two frames or more, the shortest exposure first, and their exposures.

    Of those that have the temperature of a setting, or of the coolest where it states none.
    """
    settings = [s for s in data.settings("dark", least=2) if of_one_temperature(s, like)]
    coolest = min((s.first.temperature_c for s in settings if s.first.temperature_c is not None), default=0.0)
    settings = [s for s in settings if (s.first.temperature_c or coolest) <= coolest + 0.5]
    settings.sort(key=lambda s: s.exposure)
    return [data.levels(s)[plane.name] for s in settings], [s.exposure for s in settings]


def saturation_of(data: SeriesData, plane: Plane, levels: Sequence[Level]) -> float:
    """Grey value at which grey values stop: that of the series, or the largest that was seen of a clipped level."""
    stated = data.saturation_dn(plane.name)
    return stated if stated < inf else max((level.largest for level in levels), default=nan)


def tried(what: str, make: Callable[..., Findings], *given: Any) -> Findings:
    """The outcome, or the refusal of `what` with its reason where the data do not allow it."""
    try:
        return make(*given)
    except InputError as error:
        return Findings(refused={what: str(error)})


def used_and_rest(x: NDArray[Any], y: NDArray[Any], used: NDArray[np.bool_]) -> list[Trace]:
    """Points that an adjustment used, and the others, in two colours."""
    parts = ((used, "used", 0), (~used, "not used", 3))
    return [Trace(x[k], y[k], label, colour=colour) for k, label, colour in parts if k.any()]
