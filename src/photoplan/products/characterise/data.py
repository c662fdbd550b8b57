"""Frames of a series for the analyses: grouped by condition, split into planes, gathered into statistics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.series import CONDITIONS, Plane, Series, SeriesFrame, frame_pixels, plane_mask, series_planes, split
from photoplan.quality.camera.photon_transfer import FullWell
from photoplan.quality.camera.sensor import FrameStack, Level, StackSums

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
