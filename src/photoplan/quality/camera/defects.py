"""Defect elements: pixels, rows and columns that do not behave as their neighbours (Behr 1989, §4.2.6).

A pixel is compared with the median of its surroundings; what counts as noise is the scatter that most pixels have
(median of absolute deviations), so that defects do not hide themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from photoplan.adjustment.robust import spread
from photoplan.errors import InputError
from photoplan.quality.camera.fixed_pattern import background

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
    deviation: NDArray[np.float64] | None
    """Deviation of every pixel; None for lines and blinking."""


def _scatter(values: NDArray[np.float64], least: float) -> float:
    """Robust standard deviation, not below `least`."""
    return max(spread(values, None), least)


def _factor(count: int) -> float:
    """How many standard deviations a Gaussian value exceeds by chance in 0.01 of such images."""
    return float(-special.ndtri(_ALARMS / max(count, 1) / 2))


def find_defects(
    mean: NDArray[np.float64],
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


def _strongest(
    found: NDArray[np.bool_], kind: Callable[[int, int], Kind], value: NDArray[np.float64], ratio: NDArray[np.float64]
) -> tuple[Defect, ...]:
    """The pixels that were found, by how far they are beyond the threshold."""
    rows, cols = np.nonzero(found)
    order = np.argsort(-ratio[rows, cols], kind="stable")[:MOST]
    return tuple(
        Defect(kind=kind(r, c), col=float(c), row=float(r), value=float(value[r, c]), ratio=float(ratio[r, c]))
        for r, c in zip(rows[order], cols[order])
    )


def find_blinking(variance: NDArray[np.float64], frames: int, step: float = 1.0) -> DefectList:
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


def find_lines(mean: NDArray[np.float64], step: float = 1.0) -> DefectList:
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
    """How many pixels deviate by how much, and how many would by Gaussian noise."""

    deviation: NDArray[np.float64]
    """Middles of the classes, grey values."""
    count: NDArray[np.int64]
    model: NDArray[np.float64]
    """Expected counts of a Gaussian with the robust scatter."""


def log_histogram(deviation: NDArray[np.float64], scatter: float) -> LogHistogram:
    """Histogram for a logarithmic axis, over the whole range; classes of a third of the scatter, 4000 at most."""
    low, high = float(deviation.min()), float(deviation.max())
    classes = int(np.clip(3 * (high - low) / scatter, 20, 4000)) if scatter > 0 else 200
    edges = np.linspace(low, high if high > low else low + 1.0, classes + 1)
    count, _ = np.histogram(deviation, edges)
    model = np.diff(special.ndtr((edges - float(np.median(deviation))) / scatter)) * deviation.size
    return LogHistogram((edges[:-1] + edges[1:]) / 2, count, model)
