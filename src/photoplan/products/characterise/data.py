"""Series of a camera as the analyses take them: frames in groups, targets, regions, common figures."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import inf, isfinite, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import Findings, Subject, Trace, joined
from photoplan.geometry.grid import Window
from photoplan.io.series import (
    CONDITIONS,
    Plane,
    Series,
    SeriesFrame,
    SeriesGroup,
    TargetEntry,
    frame_pixels,
    plane_mask,
    series_planes,
    split,
)
from photoplan.quality.camera.photon_transfer import FullWell, Saturation, find_saturation
from photoplan.quality.camera.sensor import FrameStack, Level, StackSums
from photoplan.quality.curves import clipped_levels

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


#: Share of a window that may be saturated, and samples of it that are looked at for the value where frames are cut off.
_MOST, _SAMPLE = 0.01, 4096


@dataclass(frozen=True)
class FrameGroup:
    """The frames of one ``[[frames]]`` entry, in the order of their names (numbers in them by value).

    Whether a point in a name is that of a decimal, the times decide.
    """

    group: SeriesGroup
    frames: tuple[SeriesFrame, ...]

    @property
    def label(self) -> str:
        """Its name, else its number among the entries."""
        return self.group.entry.name or f"entry {self.group.index + 1}"

    def times(self) -> NDArray[np.float64]:
        """Time of each frame, seconds since the first."""
        for frame in self.frames:
            if frame.time_s is None:
                raise InputError(
                    f"{self.group.label}: {frame.file.name} has no time; give a field {{time_s}} in the name, a table "
                    'with a column time_s, or time_from = "exif"'
                )
        t = np.array([frame.time_s for frame in self.frames], float)
        back = np.flatnonzero(np.diff(t) <= 0.0)
        if back.size:
            k = int(back[0])
            raise InputError(
                f"{self.group.label}: {self.frames[k + 1].file.name} has the time {t[k + 1]:.10g} s, which does not "
                f"come after {t[k]:.10g} s of {self.frames[k].file.name} before it; correct the times"
            )
        return np.asarray(t - t[0])

    def pixels(self, data: SeriesData, window: Window | None = None) -> Iterator[dict[str, NDArray[Any]]]:
        """Pixels of a window (the roi) of every frame, by plane; in a row those that a mask leaves."""
        window = self.group.window if window is None else window
        inside = replace(self.group, window=window)
        masks = {plane.name: plane_mask(inside, plane) for plane in data.planes}
        for frame in self.frames:
            image = frame_pixels(frame, window)
            parts = {plane.name: split(image, plane, window) for plane in data.planes}
            yield {name: part if (mask := masks[name]) is None else part[mask] for name, part in parts.items()}

    def number(self, key: str, default: float, low: float, high: float) -> float:
        """A number among the entry's values."""
        value = self.group.entry.values.get(key, default)
        if isinstance(value, str) or not low <= value <= high:
            raise InputError(
                f"{self.group.label}: values.{key} is {value!r}; a number from {low:g} to {high:g} is needed"
            )
        return float(value)

    def word(self, key: str, allowed: tuple[str, ...]) -> str:
        """A word among the entry's values; the first allowed one where it has none."""
        value = self.group.entry.values.get(key, allowed[0])
        if value not in allowed:
            raise InputError(f"{self.group.label}: values.{key} is {value!r}; allowed are {', '.join(allowed)}")
        return str(value)

    def has(self, key: str) -> bool:
        """Whether the entry states a value."""
        return key in self.group.entry.values


@dataclass(frozen=True, eq=False)
class WindowMeans:
    """A window followed from frame to frame."""

    mean: NDArray[np.float64]
    """Grey value in each frame, shape (n,)."""
    variance: NDArray[np.float64]
    """Of a pixel, from the difference of two successive frames, without what the whole window changes; NaN of a single
    pixel; shape (n − 1,)."""
    pixels: int


def window_means(data: SeriesData, group: FrameGroup, window: Window, advice: str) -> dict[str, WindowMeans]:
    """Means of a window in every frame of an entry, by plane."""
    means: dict[str, list[float]] = {p.name: [] for p in data.planes}
    variances: dict[str, list[float]] = {p.name: [] for p in data.planes}
    last: dict[str, NDArray[np.float64]] = {}
    samples: dict[str, list[NDArray[np.float64]]] = {p.name: [] for p in data.planes}
    for frame, planes in zip(group.frames, group.pixels(data, window)):
        for name, pixels in planes.items():
            values = pixels.astype(float)
            if float((values >= data.saturation_dn(name)).mean()) > _MOST:
                raise InputError(f"{group.group.label}: {frame.file.name} is saturated in the window; {advice}")
            means[name].append(float(values.mean()))
            if name in last:
                variances[name].append(float((values - last[name]).var(ddof=1)) / 2.0 if values.size > 1 else nan)
            last[name] = values
            samples[name].append(values.ravel()[:: max(1, values.size // _SAMPLE)])
    for parts in samples.values():
        top = clipped_levels(np.concatenate(parts))[1]
        for frame, part in zip(group.frames, parts):
            if float((part >= top).mean()) > _MOST:
                raise InputError(
                    f"{group.group.label}: {frame.file.name} is saturated in the window: the frames are cut off at "
                    f"{top:g} DN; {advice}"
                )
    return {n: WindowMeans(np.array(m), np.array(variances[n]), last[n].size) for n, m in means.items()}


def frame_groups(data: SeriesData, kind: str) -> tuple[FrameGroup, ...]:
    """Entries with frames of a kind, in the order of the file."""
    found: dict[int, list[SeriesFrame]] = {}
    for frame in data.series.of(kind):
        found.setdefault(frame.group.index, []).append(frame)
    return tuple(FrameGroup(frames[0].group, _ordered(frames)) for frames in found.values())


def _ordered(frames: list[SeriesFrame]) -> tuple[SeriesFrame, ...]:
    whole, decimal = (tuple(sorted(frames, key=lambda f: _natural(f, n))) for n in (r"([0-9]+)", r"([0-9]*\.?[0-9]+)"))
    return decimal if _grows(decimal) and not _grows(whole) else whole


def _grows(frames: tuple[SeriesFrame, ...]) -> bool:
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    return len(times) == len(frames) and all(a < b for a, b in pairwise(times))


def _natural(frame: SeriesFrame, number: str) -> tuple[tuple[int, str | float], ...]:
    parts = re.split(number, frame.file.name)
    return tuple((1, float(p[:15])) if re.fullmatch(number, p) else (0, p) for p in parts)


def central_window(window: Window, side: int, where: str) -> Window:
    """A square in the middle of a window."""
    if side > min(window.width, window.height):
        raise InputError(
            f"{where}: a window of {side} × {side} pixels in an area of {window.width} × {window.height}; state "
            "a smaller values.window"
        )
    return Window(window.col + (window.width - side) // 2, window.row + (window.height - side) // 2, side, side)


#: Largest part of the frames in which a target may be lost.
_MOST_LOST = 0.2
_LARGEST = 25_000_000


@dataclass(frozen=True)
class Located:
    """A target in a frame."""

    target: str
    frame: SeriesFrame
    x: float
    y: float
    """Column and row in the image; NaN where it was not found."""
    sigma: float
    why: str
    """Why it was not found; empty: it was."""


def targets_of(group: FrameGroup) -> tuple[TargetEntry, ...]:
    """The targets of an entry: those named, else one in the roi."""
    return group.group.entry.targets or (TargetEntry(name="target"),)


def locate_targets(data: SeriesData, group: FrameGroup) -> dict[str, list[Located]]:
    """Every target in every frame, by correlation, paraboloid and matching (Behr 1989, eq. 4.1 to 4.4)."""
    found: dict[str, list[Located]] = {t.name: [] for t in targets_of(group)}
    for frame in group.frames:
        for target in targets_of(group):
            found[target.name].append(_locate(data, group, frame, target))
    for name, places in found.items():
        lost = [p for p in places if p.why]
        if len(lost) > _MOST_LOST * len(places):
            raise InputError(
                f"{group.group.label}: target {name} is not found in {len(lost)} of {len(places)} frames; first in "
                f"{lost[0].frame.file.name}: {lost[0].why}. Give it a roi in which it alone lies"
            )
    return found


def _locate(data: SeriesData, group: FrameGroup, frame: SeriesFrame, target: TargetEntry) -> Located:
    from photoplan.orientation.marks.locate import locate_target  # noqa: PLC0415 - slow to import, rarely needed

    window = _window(data, group, target)
    # The first band; of a colour pattern the mean of each cell would move the target by less than its sigma.
    grey = frame_pixels(frame, window)[0].astype(np.float32)
    where = f"target {target.name}"
    peak = float(grey.max() if target.bright else grey.min())
    if target.bright and peak >= data.saturation_dn(data.planes[0].name) and (grey >= peak).mean() > 0.5:
        return Located(
            target=target.name,
            frame=frame,
            x=math.nan,
            y=math.nan,
            sigma=math.nan,
            why=f"{where}: the window is saturated",
        )
    try:
        at = locate_target(grey, bright=target.bright).location
    except InputError as error:
        return Located(target=target.name, frame=frame, x=math.nan, y=math.nan, sigma=math.nan, why=str(error))
    sigma = max(at.sigma_x, at.sigma_y)
    return Located(target=target.name, frame=frame, x=window.col + at.x, y=window.row + at.y, sigma=sigma, why="")


def _window(data: SeriesData, group: FrameGroup, target: TargetEntry) -> Window:
    window = group.group.window if target.roi is None else Window(*target.roi)
    assert data.series.size is not None
    if window.stop[0] > data.series.size[0] or window.stop[1] > data.series.size[1]:
        raise InputError(
            f"{group.group.label}: target {target.name}: roi {[window.col, window.row, window.width, window.height]} "
            f"leaves the image of {data.series.size[0]} × {data.series.size[1]} pixels"
        )
    if window.size > _LARGEST:
        raise InputError(
            f"{group.group.label}: target {target.name}: a window of {window.size} pixels is searched; give it a roi"
        )
    return window


#: What tells settings apart, and the units. Light is told by its photons; time is no setting.
_CONDITIONS = (("kind", ""), *(each for each in CONDITIONS.items() if each[0] not in ("irradiance_uw_cm2", "time_s")))
#: Share of saturated pixels up to which a frame may be the reference of `brightest`.
_UNSATURATED = 1e-3


@dataclass(frozen=True)
class Setting:
    """Frames of one entry that were taken under one condition."""

    frames: tuple[SeriesFrame, ...]

    @property
    def first(self) -> SeriesFrame:
        """A frame that stands for all."""
        return self.frames[0]

    @property
    def exposure(self) -> float:
        """Milliseconds; 0 where it is not stated."""
        return self.first.exposure_ms or 0.0

    @property
    def label(self) -> str:
        """Its condition in words, such as ``flat 25 ms 500 nm``."""
        words = [self.first.kind]
        for name, unit in _CONDITIONS[1:]:
            value = getattr(self.first, name)
            if value is not None:
                words.append(f"{value:g} {unit}".strip() if unit else f"{name} {value:g}")
        return " ".join(words)


@dataclass(frozen=True, eq=False)
class SeriesData:
    """A series whose frames are read when an analysis asks; memory holds one frame and the images of one condition."""

    series: Series
    wells: Mapping[str, FullWell] = field(default_factory=dict)
    """Planes that are full below the largest grey value of the series."""
    step: float = 1.0
    """Distance of neighbouring grey values."""
    planes: tuple[Plane, ...] = field(init=False)
    _levels: dict[tuple[int, str], dict[str, Level]] = field(default_factory=dict, init=False)
    _last: dict[tuple[int, str], dict[str, FrameStack]] = field(default_factory=dict, init=False)
    _masks: dict[tuple[int, str, float | None], NDArray[np.bool_] | None] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "planes", series_planes(self.series) if self.series.size else (Plane("", 0),))

    @property
    def stated_black(self) -> float:
        """Grey value without light as the series states it; NaN: it does not."""
        camera = self.series.camera
        return camera.black_level_dn if "black_level_dn" in camera.model_fields_set else nan

    def settings(self, *kinds: str, least: int = 1) -> tuple[Setting, ...]:
        """Conditions under which at least so many frames of these kinds were taken, in the order of the file."""
        found: dict[tuple[object, ...], list[SeriesFrame]] = {}
        for frame in self.series.of(*kinds):
            key = (frame.group.index, *(getattr(frame, name) for name, _ in _CONDITIONS))
            found.setdefault(key, []).append(frame)
        return tuple(Setting(tuple(frames)) for frames in found.values() if len(frames) >= least)

    def saturation_dn(self, plane: str) -> float:
        """Grey value from which on samples of a plane count as saturated."""
        well = self.wells.get(plane)
        return self.series.saturation_dn if well is None else min(self.series.saturation_dn, well.least_dn)

    def pixels(self, frame: SeriesFrame) -> dict[str, NDArray[Any]]:
        """Pixels of a frame by plane, each of shape (h, w)."""
        pixels = frame_pixels(frame)
        return {plane.name: split(pixels, plane, frame.group.window) for plane in self.planes}

    def stacks(self, setting: Setting) -> dict[str, FrameStack]:
        """Mean image, temporal variance and summary of a condition, by plane."""
        key = _key(setting)
        if key not in self._last:
            self._last.clear()  # before the next images need its place
            sums = {
                plane.name: StackSums(self.saturation_dn(plane.name), self.counted(setting, plane))
                for plane in self.planes
            }
            for frame in setting.frames:
                for name, pixels in self.pixels(frame).items():
                    sums[name].add(pixels)
            self._last[key] = {name: total.stack() for name, total in sums.items()}
            self._levels[key] = {name: stack.level for name, stack in self._last[key].items()}
        return self._last[key]

    def mean_images(self, setting: Setting) -> dict[str, NDArray[np.float32]]:
        """Mean images of a condition by plane, whatever pixels count."""
        sums: dict[str, NDArray[np.float64]] = {}
        for frame in setting.frames:
            for name, pixels in self.pixels(frame).items():
                sums[name] = sums[name] + pixels if name in sums else pixels.astype(np.float64)
        return {name: (total / len(setting.frames)).astype(np.float32) for name, total in sums.items()}

    def levels(self, setting: Setting) -> dict[str, Level]:
        """Summaries of a condition by plane; kept, so that frames are read once for all analyses that need no more."""
        key = _key(setting)
        if key not in self._levels:
            self.stacks(setting)
        return self._levels[key]

    def counted(self, setting: Setting, plane: Plane) -> NDArray[np.bool_] | None:
        """Pixels of a plane that count by mask and by `brightest`; None: all."""
        entry = setting.first.group.entry
        wavelength = setting.first.wavelength_nm if entry.brightest is not None else None
        key = (setting.first.group.index, plane.name, wavelength)
        if key not in self._masks:
            mask = plane_mask(setting.first.group, plane)
            if entry.brightest is not None:
                mask = self._brightest(setting, plane, mask)
            self._masks[key] = mask
        return self._masks[key]

    def _brightest(self, setting: Setting, plane: Plane, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        """Pixels above the quantile of the reference frame."""
        group, entry = setting.first.group, setting.first.group.entry
        assert entry.brightest is not None
        frames = [
            f
            for f in self.series.frames
            if f.group.index == group.index and f.wavelength_nm == setting.first.wavelength_nm
        ]
        for pixels in self._references(frames, plane, entry.brightest_exposure_ms):
            seen = pixels if mask is None else pixels[mask]
            if entry.brightest_exposure_ms is None and (seen >= self.saturation_dn(plane.name)).mean() > _UNSATURATED:
                continue
            found = pixels > np.quantile(seen, 1.0 - entry.brightest)
            found = found if mask is None else found & mask
            if found.any():
                return np.asarray(found)
        raise InputError(
            f"{group.label}: brightest = {entry.brightest:g}: no frame of {setting.label} can be the reference (all "
            "are saturated, even, or have another exposure); give brightest_exposure_ms, a roi or a mask"
        )

    def _references(self, frames: list[SeriesFrame], plane: Plane, exposure: float | None) -> Iterator[NDArray[Any]]:
        timed = sorted((f for f in frames if f.exposure_ms is not None), key=lambda f: -(f.exposure_ms or 0.0))
        for frame in timed:
            if exposure is None or np.isclose(frame.exposure_ms or 0.0, exposure, rtol=1e-6):
                yield split(frame_pixels(frame), plane, frame.group.window)


def _key(setting: Setting) -> tuple[int, str]:
    return setting.first.group.index, "|".join(str(frame.file) for frame in setting.frames)
