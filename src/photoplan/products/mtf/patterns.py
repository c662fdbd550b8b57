"""MTF and contrast transfer of images from test patterns: bars, Siemens stars, USAF-1951 targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, PhotoplanError, ResourceError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.tables import write_table
from photoplan.products.mtf.image import LUMINANCE, LightImage
from photoplan.products.mtf.pattern_result import ImagePattern, PatternReport, PatternResult
from photoplan.products.mtf.request import ENCODED, check_files, unique_names
from photoplan.project.linearisation import linearisation_of
from photoplan.quality.linearise import Linearisation
from photoplan.quality.patterns.bar_curve import bar_curve
from photoplan.quality.patterns.bars import measure_bars
from photoplan.quality.patterns.pixels import clipped_pixels
from photoplan.quality.patterns.siemens import StarRules, measure_star
from photoplan.quality.patterns.usaf import UsafRules, measure_usaf

Array = NDArray[np.float64]
Roi = tuple[int, int, int, int]

#: Pixels of the largest window that is read at once.
MOST_PIXELS = 1 << 26


@dataclass(frozen=True)
class PatternRequest:
    """What is asked."""

    images: tuple[Path, ...]
    pattern: Literal["bars", "star", "usaf"]
    rois: tuple[Roi, ...] = ()
    """Column, row, width, height: frequency groups of bars, or stars, or targets; none: the whole image."""
    linearisation: str | None = None
    """``linear``, ``srgb``, or the name of a table; None: linear, with a warning where that is unlikely."""
    band: str | None = None
    """Number of a band, or ``all``; None: luminance, or the only band."""
    pixel_um: float | None = None
    """Distance of pixels, micrometres: on the sensor; of USAF targets on the target."""
    sectors: int | None = None
    """Bright sectors of stars; None: counted."""
    group: int | None = None
    """Number of the largest group of USAF targets in the picture."""
    levels: tuple[float, float] | None = None
    """Grey values of wide dark and bright areas, for bars and stars; None: found in the pattern."""
    coltman: bool = False
    """Convert the contrast transfer of bars into an MTF by Coltman's series too."""
    csv: Path | None = None
    overwrite: bool = False


def measure_patterns(request: PatternRequest, talk: Callable[[str], None] = lambda text: None) -> PatternReport:
    """Measure the patterns of all images; one that fails does not stop the others.

    Raises
    ------
    UsageError
        Options contradict each other, an output exists, or a window leaves an image.
    InputError
        The linearisation table cannot be used.
    """
    _check(request)
    linearisation = linearisation_of(request.linearisation or "linear")
    results: list[ImagePattern] = []
    failed: dict[str, str] = {}
    names = dict(zip(request.images, unique_names(request.images)))
    encoded = False
    for path in request.images:
        try:
            image = LightImage.open(path, linearisation)
            if request.linearisation is None and image.reader.dtype == "uint8":
                encoded = True
            results.append(_measure(names[path], image, request))
        except (ResourceError, UsageError):
            raise
        except PhotoplanError as error:
            failed[names[path]] = str(error)
    if encoded:
        talk(f"note: {ENCODED}")
    done = bool(results)
    made = PatternReport(
        pattern=request.pattern,
        images=tuple(results),
        failed=failed,
        linearisation=linearisation,
        pixel_um=request.pixel_um,
        csv=request.csv if done else None,
    )
    if made.csv is not None:
        write_table(made.csv, *made.csv_rows)
    return made


def _check(request: PatternRequest) -> None:
    """Refuse what cannot be meant before any work."""
    if request.sectors is not None and request.pattern != "star":
        raise UsageError(f"`sectors` goes with `pattern` star, not {request.pattern}")
    if request.group is not None and request.pattern != "usaf":
        raise UsageError(f"`group` goes with `pattern` usaf, not {request.pattern}")
    if request.coltman and request.pattern != "bars":
        raise UsageError(f"`coltman` goes with `pattern` bars, not {request.pattern}")
    if request.levels is not None and request.pattern == "usaf":
        raise UsageError("`levels` goes with `pattern` bars or star; a USAF target shows its levels itself")
    if request.pixel_um is not None and not 1e-3 <= request.pixel_um <= 1e6:
        raise UsageError(f"`pixel_size` {request.pixel_um:g}; 0.001 to 1000000 micrometres are allowed")
    check_files(request.images, (request.linearisation,), request.csv, request.overwrite)


def _windows(image: LightImage, rois: tuple[Roi, ...]) -> list[Window]:
    """Windows that are asked for; the whole image if none is."""
    width, height = image.size
    for col, row, w, h in rois:
        if min(w, h) < 1 or col < 0 or row < 0 or col + w > width or row + h > height:
            raise UsageError(
                f"`roi` {col} {row} {w} {h} (column, row, width, height): leaves {image.reader.path} of {width} × "
                f"{height} pixels"
            )
    windows = [Window(*roi) for roi in rois] or [Window(0, 0, width, height)]
    for window in windows:
        if window.width * window.height > MOST_PIXELS:
            raise InputError(
                f"{image.reader.path}: a window of {window.width} × {window.height} pixels; give the pattern "
                "alone with `roi` column row width height"
            )
    return windows


def _read(image: LightImage, window: Window, channel: int) -> tuple[Array, NDArray[np.bool_]]:
    """Light of a window (NaN: no value), and which pixels are cut off."""
    picture = image.picture(window, channel)
    light = np.array(picture.grey, np.float64)
    if picture.valid is not None:
        light[~picture.valid] = np.nan
    stored, _ = image.reader.read(window)
    used = stored[:3] if channel == LUMINANCE and len(stored) >= 3 else stored[max(channel, 1) - 1][None]
    clipped = np.logical_or.reduce([clipped_pixels(band) for band in used])
    if picture.saturated is not None:
        clipped |= picture.saturated
    return light, clipped


def _measure(name: str, image: LightImage, request: PatternRequest) -> ImagePattern:
    """The patterns of an image in every channel that is asked for."""
    path, results = image.reader.path, list[PatternResult]()
    windows = _windows(image, request.rois)
    levels = _levels(image.linearisation, image.reader.dtype, request.levels)
    for channel in image.channels(request.band):
        band = image.channel_name(channel)
        if request.pattern == "bars":
            groups = []
            for k, window in enumerate(windows):
                light, clipped = _read(image, window, channel)
                groups.append(measure_bars(light, clipped=clipped, what=f"{path}: {_place(window, k, windows)}"))
            try:
                curve = bar_curve(groups, levels)
            except InputError as error:
                raise InputError(f"{path}: {error} (`levels` LOW HIGH)") from None
            parts = tuple(window for _, window in sorted(zip(groups, windows), key=lambda part: part[0].frequency))
            results.append(
                PatternResult(
                    image=name,
                    file=path,
                    band=band,
                    window=_hull(windows),
                    found=curve,
                    parts=parts,
                    coltman=request.coltman,
                    pixel_um=request.pixel_um,
                )
            )
            continue
        for k, window in enumerate(windows):
            light, clipped = _read(image, window, channel)
            what = f"{path}: {_place(window, k, windows)}"
            if request.pattern == "star":
                rules = StarRules(sectors=request.sectors, levels=levels)
                found = measure_star(light, rules, clipped=clipped, what=what)
                results.append(PatternResult(name, path, band, window, found=found, pixel_um=request.pixel_um))
            else:
                usaf = UsafRules(request.group, None if request.group is not None else request.pixel_um)
                target = measure_usaf(light, usaf, clipped=clipped, what=what)
                results.append(
                    PatternResult(
                        image=name,
                        file=path,
                        band=band,
                        window=window,
                        found=target,
                        pixel_um=request.pixel_um,
                        notes=_stretched(light),
                    )
                )
    return ImagePattern(
        name=name, file=path, size=image.size, linearisation=image.linearisation.describe(), results=tuple(results)
    )


def _levels(
    linearisation: Linearisation, dtype: np.dtype[np.generic] | str, levels: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Light of given grey values, on the scale of the pixels."""
    if levels is None:
        return None
    scale = 1.0 if linearisation.kind == "table" else linearisation.full_scale(dtype)
    grey = np.array(levels, np.float64)
    if not (np.isfinite(grey).all() and 0.0 <= grey[0] < grey[1]):
        raise UsageError(
            f"`levels` {levels[0]:g} {levels[1]:g}; the grey value of dark areas, then that of bright ones"
        )
    if linearisation.kind == "srgb":
        # As floating point the full scale is 1.
        low, high = linearisation.to_linear(grey / scale)
    else:
        low, high = linearisation.to_linear(grey) / scale
    return float(min(low, high)), float(max(low, high))


def _place(window: Window, number: int, windows: list[Window]) -> str:
    if len(windows) == 1:
        return "the pattern"
    return f"pattern {number + 1} (column {window.col}, row {window.row}, {window.width} × {window.height})"


def _stretched(light: Array) -> tuple[str, ...]:
    """A note where the bright end is much more even than the dark one: it may be saturated or compressed."""
    low, high = float(light.min()), float(light.max())
    step = 0.005 * (high - low)
    bright, dark = float((light >= high - step).mean()), float((light <= low + step).mean())
    if bright < 0.03 or dark > 0.3 * bright:
        return ()
    return (
        f"{100 * bright:.0f} % of the pixels lie within 0.5 % of the highest value: the bright end seems saturated or "
        "compressed. What is resolved holds; contrast transfers are those of the picture as it is",
    )


def _hull(windows: list[Window]) -> Window:
    """The smallest window that holds all of them."""
    col, row = min(w.col for w in windows), min(w.row for w in windows)
    return Window(col, row, max(w.col + w.width for w in windows) - col, max(w.row + w.height for w in windows) - row)
