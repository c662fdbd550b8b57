"""Sensors: dark signal and fixed pattern measured; resolution, sizes and transfer functions from data sheets.

Beside them its noise budget in electrons (Behr 1989, §3.6.4, table 3.3, after Beynon), and figures of a video norm.

Lengths are in millimetres or micrometres as named; spatial frequencies are line pairs per millimetre (LP/mm), which are
cycles per millimetre.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log, log2, log10, nan, pi, sqrt
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, special

from photoplan.adjustment.least_squares import spread
from photoplan.arrays import Floats, Ints, Mask
from photoplan.errors import InputError
from photoplan.findings import with_sigma
from photoplan.quality.camera.geometry import StraightLine, fit_line
from photoplan.quality.curves import pupil_transfer

#: Share of zeros beyond which black is cut off, and mean and variance are not those of the signal.
ZERO_SHARE = 0.005
#: Pixels below which no figure is derived.
LEAST_PIXELS = 64


@dataclass(frozen=True)
class Level:
    """Summary of the frames of one condition; variances are squared grey values."""

    frames: int
    pixels: int
    mean: float
    """Grey value, mean over pixels and frames."""
    temporal_variance: float
    """Variance of a pixel from frame to frame, without the variation of the frames' means; NaN for a single frame."""
    spatial_variance: float
    """Variance of the mean image, with the rest of the temporal noise in it."""
    frame_mean_sigma: float
    """Standard deviation of the frames' means; NaN for a single frame."""
    saturated_share: float
    """Share of samples at or above saturation."""
    zero_share: float
    """Share of samples at zero, where black may be cut off; 0 where samples are negative too."""
    largest: float
    smallest: float

    @property
    def is_cut_off(self) -> bool:
        """Return whether black is cut off: more zeros than noise about a positive bias would give."""
        return self.zero_share > ZERO_SHARE

    @property
    def mean_sigma(self) -> float:
        """Standard deviation of `mean`: by the noise of pixels, or of whole frames where that is clearly larger."""
        if self.frames < 2:
            return float("nan")
        of_pixels = self.temporal_variance / self.pixels
        of_frames = self.frame_mean_sigma**2
        # About the 1 % point of the scatter that pixels alone would give to the means of so few frames.
        usual = of_pixels * (1 + 4 * np.sqrt(2 / (self.frames - 1)))
        return float(np.sqrt((of_frames if of_frames > usual else of_pixels) / self.frames))

    def sigma_of_mean(self, step: float) -> float:
        """The same; of a single frame, which says nothing of its noise, by rounding and the scatter between pixels."""
        if np.isfinite(self.mean_sigma):
            return self.mean_sigma
        return float(np.sqrt(max(self.spatial_variance, step**2 / 12) / self.pixels))

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the temporal variance."""
        return (self.frames - 1) * (self.pixels - 1)

    @property
    def variance_sigma(self) -> float:
        """Standard deviation of the temporal variance, for noise that is nearly Gaussian."""
        return float(self.temporal_variance * np.sqrt(2.0 / self.degrees)) if self.degrees else float("nan")


def cut_off(levels: Iterable[Level], of: str = "") -> str:
    """That black is cut off in some levels, as the beginning of a refusal; empty: it is not."""
    share = max((level.zero_share for level in levels if level.is_cut_off), default=0.0)
    return f"black is cut off: {100 * share:.3g} % of the samples{of} are zero" if share else ""


def check_level(level: Level) -> None:
    """Refuse a level that says nothing: too few pixels, or frames that are copies of each other."""
    if level.pixels < LEAST_PIXELS:
        raise InputError(f"{level.pixels} pixels count; {LEAST_PIXELS} or more are needed: give a larger roi or mask")
    if level.frames > 1 and not level.temporal_variance > 0 and level.saturated_share < 0.5 and level.zero_share < 0.5:
        raise InputError(
            f"the {level.frames} frames of mean {level.mean:.4g} DN do not differ in any pixel: they are copies of "
            "one file, or their noise was removed; give raw frames"
        )


@dataclass(frozen=True, eq=False)
class FrameStack:
    """Images of the frames of one condition."""

    level: Level
    mean: Floats
    """Mean image, shape (h, w)."""
    variance: Floats | None
    """Temporal variance of every pixel; None for a single frame."""
    counted: Mask | None
    """Pixels that the summary counts; None: all."""

    def only_counted(self, image: Floats) -> Floats:
        """Mean image or variance with NaN where pixels do not count."""
        return image if self.counted is None else np.where(self.counted, image, np.nan)


class StackSums:
    """Gathers frames one after the other: memory holds two images, however many frames there are."""

    def __init__(self, saturation: float, counted: Mask | None = None) -> None:
        self._saturation, self._counted = saturation, counted
        self._means: list[float] = []
        self._saturated = self._zero = 0
        self._largest, self._smallest = -np.inf, np.inf
        self._mean: Floats | None = None
        self._squares: Floats | None = None

    def add(self, frame: NDArray[Any]) -> None:
        """One more frame, shape (h, w)."""
        seen = frame if self._counted is None else frame[self._counted]
        if not seen.size:
            raise InputError("no pixel of the frame counts")
        values = frame.astype(np.float64)
        self._saturated += int(np.count_nonzero(seen >= self._saturation))
        self._zero += int(np.count_nonzero(seen == 0))
        self._largest = max(self._largest, float(seen.max()))
        self._smallest = min(self._smallest, float(seen.min()))
        self._means.append(float(np.mean(seen, dtype=np.float64)))
        if self._mean is None or self._squares is None:
            self._mean, self._squares = values, np.zeros_like(values)
            return
        if values.shape != self._mean.shape:
            raise InputError(f"frame of shape {values.shape}; the others have {self._mean.shape}")
        # Welford 1962: stable, and needs no second pass.
        difference = values - self._mean
        self._mean += difference / len(self._means)
        self._squares += difference * (values - self._mean)

    def stack(self) -> FrameStack:
        """Return the statistics of the frames."""
        count = len(self._means)
        if self._mean is None or self._squares is None:
            raise InputError("no frame given")
        mean, squares = self._mean, self._squares
        seen = mean.ravel() if self._counted is None else mean[self._counted]
        pixels = seen.size
        temporal = sigma = float("nan")
        if count > 1:
            inner = float(squares.sum() if self._counted is None else squares[self._counted].sum())
            between = float(np.sum((np.array(self._means) - np.mean(self._means)) ** 2))
            if pixels > 1:
                temporal = max(inner - pixels * between, 0.0) / ((count - 1) * (pixels - 1))
            sigma = float(np.sqrt(between / (count - 1)))
        level = Level(
            frames=count,
            pixels=pixels,
            mean=float(seen.mean()),
            temporal_variance=temporal,
            spatial_variance=float(seen.var(ddof=1)) if pixels > 1 else float("nan"),
            frame_mean_sigma=sigma,
            saturated_share=self._saturated / (count * pixels),
            zero_share=0.0 if self._smallest < 0 else self._zero / (count * pixels),
            largest=self._largest,
            smallest=self._smallest,
        )
        variance = squares / (count - 1) if count > 1 else None
        return FrameStack(level, mean, variance, self._counted)


@dataclass(frozen=True)
class DarkCurrent:
    """Dark current of a sensor at one temperature."""

    offset_dn: float
    """Grey value at no exposure."""
    offset_dn_sigma: float
    current_dn_s: float
    """Grey values per second."""
    current_dn_s_sigma: float
    line: StraightLine


@dataclass(frozen=True)
class DoublingTemperature:
    """By how many degrees the dark current doubles."""

    doubling_k: float
    doubling_k_sigma: float
    reference_c: float
    """Mean temperature."""
    current_at_reference: float
    """In the unit that was given."""


def dark_current(exposures_ms: Sequence[float], levels: Sequence[Level]) -> DarkCurrent:
    """Line of the mean dark grey value over the exposure."""
    cut = cut_off(levels, " of the dark frames")
    if cut:
        raise InputError(
            f"{cut}, so that their mean and noise are not those of the signal; raise the camera's black level"
        )
    if any(level.saturated_share > 1e-2 for level in levels):
        raise InputError("over 1 % of the samples of dark frames are saturated; take shorter exposures")
    if len(set(exposures_ms)) < 3:
        raise InputError(f"{len(set(exposures_ms))} different exposures of dark frames; the dark current needs 3")
    if any(level.frames < 2 for level in levels):
        raise InputError("a single dark frame at an exposure; the noise of its mean needs two or more")
    for level in levels:
        check_level(level)
    seconds = np.array(exposures_ms, float) / 1000.0
    sigma = np.array([max(level.mean_sigma, 1e-9) for level in levels])
    line = fit_line(seconds, [level.mean for level in levels], sigma)
    return DarkCurrent(
        offset_dn=line.offset,
        offset_dn_sigma=line.offset_sigma,
        current_dn_s=line.slope,
        current_dn_s_sigma=line.slope_sigma,
        line=line,
    )


def doubling_temperature(
    temperatures_c: Sequence[float], currents: Sequence[float], sigmas: Sequence[float]
) -> DoublingTemperature:
    """Doubling temperature from dark currents at two temperatures or more."""
    t, i, s = (np.array(v, float) for v in (temperatures_c, currents, sigmas))
    if len(set(t.tolist())) < 2:
        raise InputError(f"{len(set(t.tolist()))} temperature; the doubling temperature needs two or more")
    weak = i <= 3 * s
    if weak.any():
        k = int(np.argmax(weak))
        raise InputError(
            f"the dark current at {t[k]:g} °C is {with_sigma(i[k], s[k])}, not significantly positive; take longer "
            "exposures or leave this temperature out"
        )
    reference = float(t.mean())
    line = fit_line(t - reference, np.log(i), s / i)
    if line.slope <= 2 * line.slope_sigma:
        raise InputError("the dark current does not grow with temperature; check the temperatures of the frames")
    doubling = log(2.0) / line.slope
    current = float(np.exp(line.offset))
    return DoublingTemperature(doubling, doubling * line.slope_sigma / line.slope, reference, current)


#: Side of an image from which rows and columns can be told from pixels.
_LEAST_SIDE = 16


@dataclass(frozen=True)
class PatternVariance:
    """Spatial variances of a mean image in squared grey values; a small negative one is the noise of zero."""

    total: float
    total_sigma: float
    row: float
    """Variance of rows against each other."""
    row_sigma: float
    column: float
    column_sigma: float
    pixel: float
    pixel_sigma: float
    mean: float
    """Grey value."""
    filtered: bool
    """True if the slow variation was taken out."""


def pattern_variance(mean: Floats, temporal_variance: float, frames: int, *, filtered: bool = False) -> PatternVariance:
    """Spatial variances of the mean image of several frames."""
    height, width = mean.shape
    if min(height, width) < _LEAST_SIDE:
        raise InputError(f"image of {width} × {height} pixels; the fixed pattern needs {_LEAST_SIDE} × {_LEAST_SIDE}")
    if not np.isfinite(temporal_variance) or frames < 2:
        raise InputError("a single frame; the fixed pattern needs two or more, to tell it from the temporal noise")
    values = high_pass(mean) if filtered else mean
    white, line = (WHITE_SHARE, LINE_SHARE) if filtered else (1.0, 1.0)
    rest = temporal_variance / frames
    measured = float(values.var(ddof=1))
    of_rows = float(values.mean(axis=1).var(ddof=1)) / line
    of_columns = float(values.mean(axis=0).var(ddof=1)) / line
    # With q = pixel + rest: E[of_rows] = row + q / width, E[of_columns] = column + q / height and
    # E[measured] = line (row + column) + white q; without the filter line = white = 1.
    inner = (measured - line * (of_rows + of_columns)) / (white - line / width - line / height)
    row, column, pixel = of_rows - inner / width, of_columns - inner / height, inner - rest
    total = row + column + pixel
    measured_sigma = inner * sqrt(2 / (mean.size - 1))
    row_sigma = of_rows * sqrt(2 / (height - 1))
    column_sigma = of_columns * sqrt(2 / (width - 1))
    # What is left of the temporal noise is itself estimated.
    rest_sigma = rest * sqrt(2 / ((frames - 1) * (mean.size - 1)))
    pixel_sigma = sqrt(measured_sigma**2 + rest_sigma**2)
    total_sigma = sqrt(row_sigma**2 + column_sigma**2 + pixel_sigma**2)
    return PatternVariance(
        total=total,
        total_sigma=total_sigma,
        row=row,
        row_sigma=row_sigma,
        column=column,
        column_sigma=column_sigma,
        pixel=pixel,
        pixel_sigma=pixel_sigma,
        mean=float(mean.mean()),
        filtered=filtered,
    )


def signed_root(variance: float, sigma: float) -> tuple[float, float]:
    """Standard deviation of a variance and its sigma; 0 where the variance is not above zero."""
    if variance <= 0:
        return 0.0, sqrt(sigma) if sigma > 0 else 0.0
    root = sqrt(variance)
    return root, min(sigma / (2 * root), sqrt(sigma))


def prnu_percent(bright: PatternVariance, dark: PatternVariance | float = 0.0) -> tuple[float, float]:
    """Photo response non-uniformity in percent of the signal, and its sigma."""
    below, of_dark, of_dark_sigma = (
        (dark.mean, dark.total, dark.total_sigma) if isinstance(dark, PatternVariance) else (dark, 0.0, 0.0)
    )
    signal = bright.mean - below
    if signal <= 0:
        raise InputError(f"flat frames of mean {bright.mean:.4g} DN are not brighter than the dark ones")
    root, sigma = signed_root(bright.total - of_dark, sqrt(bright.total_sigma**2 + of_dark_sigma**2))
    return 100 * root / signal, 100 * sigma / signal


@dataclass(frozen=True, eq=False)
class Spectrogram:
    """Spectrum along rows or columns, mean over them."""

    frequency: Floats
    """Cycles per pixel of the plane, without 0."""
    amplitude: Floats
    """Root of the power, grey values; white noise of standard deviation s has s everywhere."""
    white: float
    """Level of the white part: the median."""
    excess: float
    """Whole power over that of the white part; 1 for white noise."""
    peak_frequency: float
    """Frequency of the largest peak that stands out (5 times its neighbourhood); NaN: there is none."""


def spectrogram(mean: Floats, axis: int) -> Spectrogram:
    """Spectrogram of a mean image along an axis: 1 along rows (horizontal), 0 along columns."""
    values = mean - mean.mean()
    length = values.shape[axis]
    power = (np.abs(np.fft.rfft(values, axis=axis)) ** 2).mean(axis=1 - axis) / length
    power, frequency = power[1:], np.fft.rfftfreq(length)[1:]
    white = float(np.median(power))
    excess = float(power.mean() / white) if white > 0 else nan
    peak = int(np.argmax(power))
    around = np.delete(power[max(0, peak - 8) : peak + 9], min(peak, 8))
    standing = around.size and power[peak] > 5 * float(np.median(around)) and power[peak] > 5 * white
    return Spectrogram(
        frequency=np.asarray(frequency, np.float64),
        amplitude=np.sqrt(power),
        white=sqrt(max(white, 0.0)),
        excess=excess,
        peak_frequency=float(frequency[peak]) if standing else nan,
    )


#: Sides of the boxes, pixels, and one row of the binomial filter, by the standard.
_BOXES = (7, 11)
_BINOMIAL = (0.25, 0.5, 0.25)
#: Side of a block of `background`, pixels.
BLOCK = 16


def _smooth(image: Floats) -> Floats:
    for side in _BOXES:
        image = ndimage.uniform_filter(image, side, mode="reflect")
    for axis in (0, 1):
        image = ndimage.correlate1d(image, _BINOMIAL, axis=axis, mode="reflect")
    return np.asarray(image)


def _share(image: Floats) -> float:
    return float(np.sum((image - _smooth(image))[:, 20] ** 2))


def _impulse() -> Floats:
    impulse = np.zeros((41, 41))
    impulse[20, 20] = 1.0
    return impulse


WHITE_SHARE = float(np.sum((_impulse() - _smooth(_impulse())) ** 2))
"""Part of the variance of white noise that `high_pass` leaves."""
LINE_SHARE = _share(np.repeat(_impulse()[:, 20:21], 41, axis=1))
"""Part of the variance of independent offsets of rows, or of columns, that it leaves."""


def high_pass(image: NDArray[Any]) -> Floats:
    """An image without its slow variation, shape (h, w); white noise keeps `WHITE_SHARE` of its variance."""
    values = np.asarray(image, np.float64)
    return values - _smooth(values)


def _median(block: Floats) -> float:
    known = block[~np.isnan(block)]
    return float(np.median(known)) if known.size else float("nan")


def background(image: NDArray[Any]) -> Floats:
    """Slow variation of an image by medians of blocks of 16 × 16 pixels, linear between their middles.

    NaN does not count; a block without a value takes that of the nearest block with one.
    """
    values = np.asarray(image, np.float64)
    height, width = values.shape
    rows, cols = max(1, height // BLOCK), max(1, width // BLOCK)
    y = np.linspace(0, height, rows + 1).astype(int)
    x = np.linspace(0, width, cols + 1).astype(int)
    medians = np.array([[_median(values[a:b, c:d]) for c, d in pairwise(x)] for a, b in pairwise(y)])
    if np.isnan(medians).any():
        medians = medians[
            tuple(ndimage.distance_transform_edt(np.isnan(medians), return_distances=False, return_indices=True))
        ]
    middle_y, middle_x = (y[:-1] + y[1:] - 1) / 2, (x[:-1] + x[1:] - 1) / 2
    along = np.array([np.interp(np.arange(width), middle_x, row) for row in medians])
    at = np.interp(np.arange(height), middle_y, np.arange(rows))
    low = np.minimum(at.astype(int), max(rows - 2, 0))
    part = (at - low)[:, None]
    return np.asarray(along[low] * (1 - part) + along[np.minimum(low + 1, rows - 1)] * part)


Kind = Literal["hot", "dark", "blinking", "row", "column"]
#: False alarms that are expected in a whole image.
_ALARMS = 0.01
#: Defects that are listed at most.
MOST = 5000
#: Lines to each side with whose running median a line is compared.
_REACH = 8
#: Side of the smallest image in which a pixel has surroundings.
LEAST_SIDE = 16


@dataclass(frozen=True)
class Defect:
    """One element; positions are those of the plane's array."""

    kind: Kind
    col: float
    """NaN for a whole row."""
    row: float
    """NaN for a whole column."""
    value: float
    """Deviation from the surroundings, grey values; for blinking the temporal standard deviation."""
    ratio: float
    """The same over the threshold."""


@dataclass(frozen=True, eq=False)
class DefectList:
    """Defects of one kind and how they were told."""

    defects: tuple[Defect, ...]
    """The strongest first; `MOST` at most."""
    count: int
    """All of them."""
    threshold: float
    """Grey values; the median where it differs from place to place."""
    scatter: float
    """Standard deviation of what most pixels show, grey values."""
    deviation: Floats | None
    """Deviation of every pixel; None for lines and blinking."""


def _scatter(values: Floats, least: float) -> float:
    """Robust standard deviation, not below `least`."""
    return max(spread(values, None), least)


def _factor(count: int) -> float:
    """Return how many standard deviations a Gaussian value exceeds by chance in 0.01 of such images."""
    return float(-special.ndtri(_ALARMS / max(count, 1) / 2))


def find_defects(
    mean: Floats,
    temporal_variance: float,
    frames: int,
    kinds: tuple[Kind, ...],
    share: float = 0.0,
    step: float = 1.0,
    cut: bool = False,
) -> DefectList:
    """Pixels that differ from their surroundings.

    Notes
    -----
    The threshold is the number of scatters that Gaussian noise exceeds once in a hundred images; the scatter is at
    least that of rounding and of the temporal noise of the mean.
    """
    if min(mean.shape) < LEAST_SIDE:
        raise InputError(
            f"image of {mean.shape[1]} × {mean.shape[0]} pixels; defects are looked for in {LEAST_SIDE} × {LEAST_SIDE} "
            "pixels or more"
        )
    ground = background(mean)
    deviation = mean - ground
    rest = temporal_variance / frames if np.isfinite(temporal_variance) else 0.0
    scatter = _scatter(deviation, sqrt(step**2 / 12 / frames + max(rest, 0.0)))
    if cut:
        # From one to two standard deviations above the middle, which zeros and few hot pixels leave as they are.
        scatter = max(scatter, float(np.diff(np.nanquantile(deviation, (0.8413, 0.9772)))[0]))
    # A mean of few frames has rounded values: one step of the grey values in one of them is no defect.
    threshold = max(_factor(int(np.isfinite(mean).sum())) * scatter, 1.5 * step / frames)
    limit = np.maximum(threshold, share * np.abs(ground))
    found = np.zeros(mean.shape, bool)
    if "hot" in kinds:
        found |= deviation > limit
    if "dark" in kinds:
        found |= deviation < -limit
    listed = _strongest(
        found, lambda r, c: "hot" if deviation[r, c] > 0 else "dark", deviation, np.abs(deviation) / limit
    )
    return DefectList(
        defects=listed,
        count=int(found.sum()),
        threshold=float(np.nanmedian(limit)),
        scatter=scatter,
        deviation=deviation,
    )


def _strongest(found: Mask, kind: Callable[[int, int], Kind], value: Floats, ratio: Floats) -> tuple[Defect, ...]:
    """The pixels that were found, by how far they are beyond the threshold."""
    rows, cols = np.nonzero(found)
    order = np.argsort(-ratio[rows, cols], kind="stable")[:MOST]
    return tuple(
        Defect(kind=kind(r, c), col=float(c), row=float(r), value=float(value[r, c]), ratio=float(ratio[r, c]))
        for r, c in zip(rows[order], cols[order])
    )


def find_blinking(variance: Floats, frames: int, step: float = 1.0) -> DefectList:
    """Pixels whose grey value changes from frame to frame far more than that of most."""
    if frames < 4:
        raise InputError(f"{frames} frames at a setting; blinking pixels need four or more")
    usual = float(np.nanmedian(variance)) * (frames - 1) / float(special.chdtri(frames - 1, 0.5))
    if usual < 1e-3 * step**2:
        raise InputError(
            "most pixels do not change at all from frame to frame (black cut off, or rounding): there is no noise with "
            "which a blinking pixel could be compared"
        )
    usual = max(usual, float(np.nanmean(np.minimum(variance, 16 * usual))))
    # Shot noise differs from pixel to pixel with its light, so the limit is taken generously.
    limit = 1.5 * usual * float(special.chdtri(frames - 1, _ALARMS / np.isfinite(variance).sum())) / (frames - 1)
    found, sigma = variance > limit, np.sqrt(variance)
    listed = _strongest(found, lambda r, c: "blinking", sigma, sigma / sqrt(limit))
    return DefectList(
        defects=listed, count=int(found.sum()), threshold=sqrt(limit), scatter=sqrt(usual), deviation=None
    )


def find_lines(mean: Floats, step: float = 1.0) -> DefectList:
    """Whole rows and columns brighter or darker than their neighbours: by their medians against running ones.

    `step` is the distance of neighbouring grey values. NaN does not count, nor do lines with fewer than 16 values.
    """
    listed: list[Defect] = []
    worst_limit = worst_scatter = 0.0
    kinds: tuple[tuple[Kind, int], ...] = (("row", 1), ("column", 0))
    for kind, axis in kinds:
        count = np.isfinite(mean).sum(axis=axis)
        seen = np.flatnonzero(count >= LEAST_SIDE)
        if not seen.size:
            continue
        lines = mean.take(seen, 1 - axis)
        profile = np.nanmedian(lines, axis=axis, keepdims=True)
        # Medians of grey values come in steps, so that something of the mean helps; a few hot pixels make no line.
        around = lines - profile
        most = 3 * _scatter(around, step * sqrt(1 / 12))
        mixed = profile.ravel() + 0.1 * np.nanmean(np.clip(around, -most, most), axis=axis)
        deviation = mixed - ndimage.median_filter(mixed, 2 * min(_REACH, mixed.size - 1) + 1, mode="mirror")
        pixel = _scatter(mean - background(mean), step * sqrt(1 / 12))
        of_pixels = pixel / np.sqrt(count[seen]) + 0.02 * step
        scatter = np.maximum(_scatter(deviation, 0.0), of_pixels)
        # A quarter more: the scatter of a hundred lines is itself known to a tenth only.
        limit = np.maximum(1.25 * _factor(seen.size) * scatter, 0.5 * step)
        for k in np.flatnonzero(np.abs(deviation) > limit):
            col, row = (float("nan"), float(seen[k])) if kind == "row" else (float(seen[k]), float("nan"))
            listed.append(
                Defect(
                    kind=kind, col=col, row=row, value=float(deviation[k]), ratio=float(abs(deviation[k]) / limit[k])
                )
            )
        worst_limit = max(worst_limit, float(np.median(limit)))
        worst_scatter = max(worst_scatter, float(np.median(scatter)))
    listed.sort(key=lambda d: -d.ratio)
    return DefectList(
        defects=tuple(listed[:MOST]), count=len(listed), threshold=worst_limit, scatter=worst_scatter, deviation=None
    )


@dataclass(frozen=True, eq=False)
class LogHistogram:
    """Histogram of deviations of pixels, measured and expected for Gaussian noise."""

    deviation: Floats
    """Middles of the classes, grey values."""
    count: Ints
    model: Floats
    """Expected counts of a Gaussian with the robust scatter."""


def log_histogram(deviation: Floats, scatter: float) -> LogHistogram:
    """Histogram for a logarithmic axis, over the whole range; classes of a third of the scatter, 4000 at most."""
    low, high = float(deviation.min()), float(deviation.max())
    classes = int(np.clip(3 * (high - low) / scatter, 20, 4000)) if scatter > 0 else 200
    edges = np.linspace(low, high if high > low else low + 1.0, classes + 1)
    count, _ = np.histogram(deviation, edges)
    model = np.diff(special.ndtr((edges - float(np.median(deviation))) / scatter)) * deviation.size
    return LogHistogram((edges[:-1] + edges[1:]) / 2, count, model)


def line_resolution(points: float) -> float:
    """Line pairs that a number of picture points tells apart (Behr 1989, eq. 3.17 and 3.18)."""
    return points / 2.0


def element_um(side_mm: float, elements: int) -> float:
    """Period of the elements along a side of the sensor, gaps included (Behr 1989, eq. 3.19 and 3.20)."""
    return 1000.0 * side_mm / elements


def pixel_um(reference_mm: float, pixels: float) -> float:
    """Size of a pixel of the image from a known length and the pixels that it covers (Behr 1989, eq. 3.21, 3.22)."""
    return 1000.0 * reference_mm / pixels


def nyquist(period_um: ArrayLike) -> Floats:
    """Highest frequency that a period of sampling carries, LP/mm (Behr 1989, eq. 3.23)."""
    return np.asarray(1000.0 / (2.0 * np.asarray(period_um, float)))


def transfer_modulation(product: float, signal_to_clock: ArrayLike) -> Floats:
    """Modulation that is left after shifting charges (Behr 1989, eq. 3.15)."""
    turn = 2.0 * pi * np.asarray(signal_to_clock, float)
    return np.asarray(np.exp(-product * (1.0 - np.cos(turn))))


def transfer_phase(product: float, signal_to_clock: ArrayLike) -> Floats:
    """Shift of phase by shifting charges, radians (Behr 1989, eq. 3.16); parameters as `transfer_modulation`.

    It is the lag that is left over when the delay that low frequencies have, the product in elements, is taken away;
    the whole lag is ``product * sin(2 π f_s / f_c)``.
    """
    turn = 2.0 * pi * np.asarray(signal_to_clock, float)
    return np.asarray(-product * (turn - np.sin(turn)))


def quantisation_sigma(step: float) -> float:
    """Standard deviation of rounding to steps of a size, in its unit (Behr 1989, eq. 3.14)."""
    return step / sqrt(12.0)


def jitter_pixels(jitter_s: float, sampling_hz: float) -> float:
    """Error of position by an error of the time of sampling, pixels (Behr 1989, eq. 4.5, as a product).

    The source prints the quotient; its figures, 20 ns and 10 MHz, give the printed 0.2 pixel as the product.
    """
    return jitter_s * sampling_hz


def jitter_grey(jitter_s: float, grey_step: float, rise_s: float) -> float:
    """Largest error of grey by an error of the time of sampling, or of the place (Behr 1989, eq. 4.6).

    The source's eq. 4.7, 20 ns · 255 / 100 ns, is 51 grey values; it prints 20, which a step of 100 grey values, named
    in its text, would make.
    """
    return jitter_s * grey_step / rise_s


def aperture_mtf(frequency: ArrayLike, width_um: float) -> Floats:
    """MTF of the sensitive width of an element: \\|sin(π f w) / (π f w)\\|; frequency in LP/mm."""
    return np.asarray(np.abs(np.sinc(np.asarray(frequency, float) * width_um / 1000.0)))


def diffraction_cutoff(f_number: float, wavelength_nm: float) -> float:
    """Frequency beyond which a lens with a circular stop transfers nothing in incoherent light: 1/(λ N), LP/mm."""
    return 1e6 / (wavelength_nm * f_number)


def diffraction_mtf(frequency: ArrayLike, cutoff: float) -> Floats:
    """MTF of a perfect lens with a circular stop in incoherent light, see `pupil_transfer`."""
    if not cutoff > 0.0:
        raise InputError(f"a diffraction limit of {cutoff:g} LP/mm; it is positive")
    return pupil_transfer(np.abs(np.asarray(frequency, float)) / cutoff)


#: By how many kelvin the dark current doubles (Behr 1989, §3.6.4).
DOUBLING_C = 10.0


def transfer_noise(signal_e: float, inefficiency: float, transfers: float) -> float:
    """Noise of shifting charges, electrons: √(2 ε n N) (Behr 1989, §3.6.4)."""
    return sqrt(2.0 * inefficiency * transfers * signal_e)


def amplifier_noise(capacitance_pf: float) -> float:
    """Noise of resetting the output capacitance, electrons: 400 √C (Behr 1989, table 3.3)."""
    return 400.0 * sqrt(capacitance_pf)


def dark_at(current: float, temperature_c: float, reference_c: float, doubling_c: float = DOUBLING_C) -> float:
    """Dark current at a temperature from that at another one; it doubles every `doubling_c` (Behr 1989, §3.6.4)."""
    return float(current * 2.0 ** ((temperature_c - reference_c) / doubling_c))


@dataclass(frozen=True)
class NoiseBudget:
    """Sources of noise of one reading, electrons; None where a source is not described."""

    signal_e: float
    """Electrons of the signal."""
    dark_e: float | None = None
    """Electrons of the dark current."""
    transfer: float | None = None
    """Noise of shifting charges."""
    amplifier: float | None = None
    """Noise of the amplifier, or all noise of reading."""
    quantisation: float | None = None
    """Noise of rounding to grey values."""

    def __post_init__(self) -> None:
        if not self.signal_e > 0.0:
            raise InputError(f"a signal of {self.signal_e:g} electrons; it is positive")

    @property
    def shot(self) -> float:
        """Noise of the light: √N."""
        return sqrt(self.signal_e)

    @property
    def dark(self) -> float | None:
        """Noise of the dark current: √N."""
        return None if self.dark_e is None else sqrt(self.dark_e)

    def sources(self) -> dict[str, float]:
        """Noise of each described source, electrons."""
        every = {
            "shot": self.shot,
            "dark": self.dark,
            "transfer": self.transfer,
            "amplifier": self.amplifier,
            "quantisation": self.quantisation,
        }
        return {name: value for name, value in every.items() if value is not None}

    @property
    def total(self) -> float:
        """Root of the sum of squares: the sources are independent."""
        return sqrt(sum(value**2 for value in self.sources().values()))

    @property
    def plain_sum(self) -> float:
        """Sum of the sources, an upper bound; the total that Behr 1989, table 3.3 prints."""
        return sum(self.sources().values())

    @property
    def without_signal(self) -> float:
        """Noise that stays without light: the root of the sum of squares of dark, amplifier and quantisation."""
        left = {name: v for name, v in self.sources().items() if name in ("dark", "amplifier", "quantisation")}
        return sqrt(sum(value**2 for value in left.values()))

    @property
    def signal_to_noise(self) -> float:
        """Signal through total noise."""
        return self.signal_e / self.total

    @property
    def signal_to_noise_db(self) -> float:
        """The same in decibels: 20 log10."""
        return 20.0 * log10(self.signal_to_noise)

    @property
    def signal_to_noise_bits(self) -> float:
        """The same in bits: log2."""
        return log2(self.signal_to_noise)


def viewed_length(distance: float, angle_rad: float) -> float:
    """Length that is seen under a small angle from a distance, in its unit (Behr 1989, eq. 3.1 and 3.2)."""
    return distance * angle_rad


def lines_from_viewing(viewing_angle_rad: float, eye_resolution_rad: float) -> float:
    """Lines that the eye tells apart within the viewing angle (Behr 1989, eq. 3.3)."""
    return viewing_angle_rad / eye_resolution_rad


def columns_of(lines: float, aspect: float) -> float:
    """Square picture points in a line of a picture with an aspect ratio width/height (Behr 1989, eq. 3.4)."""
    return lines * aspect


def points_of(lines: float, aspect: float) -> float:
    """Square picture points of the whole picture (Behr 1989, eq. 3.5)."""
    return lines * columns_of(lines, aspect)


def bandwidth_hz(points: float, frame_hz: float) -> float:
    """Half a period for each picture point (Behr 1989, eq. 3.6; with eq. 3.5 it is eq. 3.7)."""
    return 0.5 * points * frame_hz


def blanking_corrected(length: float, blanking: float, period: float) -> float:
    """A line or picture lengthened by the part of its time that is blanked (Behr 1989, eq. 3.8 to 3.10)."""
    if not 0.0 <= blanking < period:
        raise InputError(f"a blanking of {blanking:g} in a period of {period:g}; it is shorter than the period")
    return length / (1.0 - blanking / period)


def sampling_hz(highest_hz: float) -> float:
    """The lowest frequency of sampling that keeps a signal (Behr 1989, eq. 3.13)."""
    return 2.0 * highest_hz


@dataclass(frozen=True)
class VideoNorm:
    """A video norm such as CCIR (Behr 1989, table 3.1)."""

    lines: int
    """Of a frame, blanked ones included."""
    line_s: float
    """Time of a line."""
    line_blanking_s: float
    """Part of it that is blanked."""
    frame_blanking_s: float
    """Part of a frame's time that is blanked."""
    aspect: float
    """Width through height of the picture."""
    kell_factor: float = 1.0
    """Share of the lines that the discrete lines resolve."""
    fields: int = 2
    """Of a frame: 2 with interlace."""

    def __post_init__(self) -> None:
        blanking_corrected(1.0, self.line_blanking_s, self.line_s)
        blanking_corrected(1.0, self.frame_blanking_s, self.frame_s)
        if not 0.0 < self.kell_factor <= 1.0:
            raise InputError(f"a Kell factor of {self.kell_factor:g}; it lies between 0 and 1")

    @property
    def frame_s(self) -> float:
        """Time of a frame."""
        return self.lines * self.line_s

    @property
    def line_hz(self) -> float:
        """Lines a second."""
        return 1.0 / self.line_s

    @property
    def frame_hz(self) -> float:
        """Frames a second."""
        return 1.0 / self.frame_s

    @property
    def field_hz(self) -> float:
        """Fields a second."""
        return self.fields * self.frame_hz

    @property
    def columns_factor(self) -> float:
        """By which blanking lengthens a line (Behr 1989, eq. 3.9)."""
        return blanking_corrected(1.0, self.line_blanking_s, self.line_s)

    @property
    def lines_factor(self) -> float:
        """By which blanking adds to the lines (Behr 1989, eq. 3.10)."""
        return blanking_corrected(1.0, self.frame_blanking_s, self.frame_s)

    @property
    def plain_hz(self) -> float:
        """Bandwidth without blanking (Behr 1989, eq. 3.7)."""
        return bandwidth_hz(points_of(self.lines, self.aspect), self.frame_hz)

    @property
    def blanking_factor(self) -> float:
        """By which blanking widens the band (Behr 1989, eq. 3.11)."""
        return self.columns_factor / self.lines_factor

    @property
    def blanked_hz(self) -> float:
        """Bandwidth with blanking (Behr 1989, eq. 3.11)."""
        return self.plain_hz * self.blanking_factor

    @property
    def kell_hz(self) -> float:
        """Bandwidth with blanking and Kell factor (Behr 1989, eq. 3.12)."""
        return self.kell_factor * self.blanked_hz

    @property
    def resolved_lines(self) -> float:
        """Lines that are resolved with the Kell factor (Behr 1989, §3.1)."""
        return self.kell_factor * self.lines
