"""Edges that a spread function can be measured at: straight, alone, between two even sides, not saturated."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from math import ceil, floor, isnan, sqrt

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.edges.candidates import StraightEdge, find_lines, range_of
from photoplan.quality.edges.strip import Blur, Strip, strip_along

#: Why an edge is not measured, as messages say it.
REASONS = {
    "curved": "curved",
    "invalid": "in invalid pixels or at the border of the image",
    "saturated": "saturated",
    "two_sided": "with another edge beside them",
    "textured": "with texture beside them",
    "weak": "with too little contrast for their noise",
    "blurred": "wider than the window",
    "short": "clean over too short a length",
    "refused": "refused when they were measured",
}
#: Widths of half a window that are tried, pixels.
_HALVES = (20, 16, 13, 11, 9, 7)
#: Wider ones, where they are asked for.
_WIDE = (26, 33, 42, 52)
#: Good blocks that must lie before and behind a gap.
_RUN = 5


@dataclass(frozen=True)
class EdgeRules:
    """What an edge must be like."""

    least_length: float = 20.0
    """Pixels."""
    least_snr: float = 8.0
    """Contrast over the noise of both sides."""
    evenness: float = 0.05
    """Share of the contrast by which the sides may change in a systematic way."""
    least_contrast: float = 0.05
    """Share of the range of grey values of the picture."""
    halves: tuple[int, ...] = _HALVES
    """Half widths of the window that are tried, pixels."""

    @classmethod
    def within(cls, half: int, least_length: float, least_snr: float) -> EdgeRules:
        """Rules with windows that reach no farther than half a width, pixels."""
        halves = (*(h for h in _WIDE + _HALVES if h < half), half)
        return cls(halves=halves, least_length=least_length, least_snr=least_snr)

    def __post_init__(self) -> None:
        if not 8.0 <= self.least_length <= 10_000.0:
            raise InputError(f"least length of an edge {self.least_length:g} px; 8 to 10000 px are allowed")
        if not self.halves or min(self.halves) < 5 or max(self.halves) > 100:
            raise InputError(f"half widths of a window {self.halves}; 5 to 100 px are allowed")
        if not self.least_snr >= 3.0:
            raise InputError(f"least contrast over noise {self.least_snr:g}; at least 3 is needed")


@dataclass(frozen=True, eq=False)
class EdgePicture:
    """A picture, or a part of one, in which edges are sought."""

    grey: NDArray[np.float32]
    """Values proportional to light, shape (h, w)."""
    valid: NDArray[np.bool_] | None = None
    """True = may be used; None: all."""
    saturated: NDArray[np.bool_] | None = None
    """True = at an end of the range of values; None: none."""
    span: float = field(default=float("nan"))
    """Range of the values of the whole picture; NaN: that of this part."""

    def __post_init__(self) -> None:
        if self.grey.ndim != 2:
            raise InputError(f"a picture of one band has rows and columns; given is shape {self.grey.shape}")
        for mask in (self.valid, self.saturated):
            if mask is not None and mask.shape != self.grey.shape:
                raise InputError(f"a mask of shape {mask.shape} for a picture of shape {self.grey.shape}")
        if isnan(self.span):
            object.__setattr__(self, "span", range_of(self.grey, self.valid))


@dataclass(frozen=True, eq=False)
class EdgeRegion:
    """An edge, and the pixels around it that belong to it and to nothing else."""

    line: StraightEdge
    """In pixel coordinates of the picture that was searched."""
    half: int
    """Pixels reach so far to both sides of the line."""
    contrast: float
    """Bright minus dark side, grey values of the picture."""
    snr: float
    """Contrast over the standard deviation of the sides."""
    aligned: bool
    """Too nearly parallel to rows or columns for all positions within a pixel to occur along it."""
    gaps: tuple[tuple[float, float], ...] = ()
    """Stretches that are left out, from and to distances along the line from its middle, pixels."""
    of: int = 0
    """Number of the straight line that it is a part of."""

    @property
    def merit(self) -> float:
        """Order in which edges are preferred: those with little noise in the mean, slanted ones first."""
        return self.snr * sqrt(self.line.length) * (0.5 if self.aligned else 1.0)

    def window(self, size: tuple[int, int]) -> tuple[int, int, int, int]:
        """Column, row, width and height of the smallest window around its pixels in a picture of a size."""
        xs, ys = zip(*self.line.ends)
        reach = self.half + 2
        col, row = max(0, floor(min(xs)) - reach), max(0, floor(min(ys)) - reach)
        right, bottom = min(size[0], ceil(max(xs)) + reach + 1), min(size[1], ceil(max(ys)) + reach + 1)
        return col, row, right - col, bottom - row

    def mask(self, window: tuple[int, int, int, int]) -> NDArray[np.bool_]:
        """Its pixels in a window (column, row, width, height), shape (height, width), True = belongs to it."""
        col, row, width, height = window
        line = self.line
        dx = np.arange(width) + (col - line.x)
        dy = (np.arange(height) + (row - line.y))[:, None]
        along = dx * line.tx + dy * line.ty
        across = dy * line.tx - dx * line.ty
        mask = (np.abs(along) <= line.length / 2) & (np.abs(across) <= self.half)
        for start, end in self.gaps:
            mask &= (along < start) | (along > end)
        return np.asarray(mask)


def find_edges(picture: EdgePicture, rules: EdgeRules | None = None) -> tuple[list[EdgeRegion], Counter[str]]:
    """Edges of a picture that can be measured.

    Returns
    -------
    list of EdgeRegion
        The best first.
    Counter
        How many others were rejected for what, by the keys of `REASONS`.
    """
    rules = rules or EdgeRules()
    lines, reasons = find_lines(picture.grey, picture.valid, rules.least_length)
    found: list[EdgeRegion] = []
    for line in lines:
        region, reason = examine(picture, line, rules)
        if region is None:
            reasons[reason] += 1
        else:
            found.append(region)
    found.sort(key=lambda region: -region.merit)
    return found, reasons


def examine(picture: EdgePicture, line: StraightEdge, rules: EdgeRules) -> tuple[EdgeRegion | None, str]:
    """The part of a line where both sides are clean, in the widest window that allows it."""
    strip = strip_along(picture.grey, picture.valid, picture.saturated, line, max(rules.halves))
    if strip is None:
        return None, "invalid"
    blur = strip.blur()
    if blur is None:
        return None, strip.worst_reason()
    least_contrast = rules.least_contrast * picture.span
    best: tuple[float, EdgeRegion] | None = None
    reasons: Counter[str] = Counter()
    for half in sorted(rules.halves, reverse=True):
        if half < blur.least_half:
            break
        region, reason = _clean_part(strip, blur, half, rules, least_contrast)
        if region is None:
            reasons[reason] += 1
            continue
        # A narrower window must make the edge much longer: tails of the spread function need width.
        score = region.line.length * half**0.5
        if best is None or score > 1.25 * best[0]:
            best = score, region
        if region.line.length > 0.8 * line.length:
            break
    if best is not None:
        return best[1], ""
    return None, reasons.most_common(1)[0][0] if reasons else "blurred"


def _clean_part(
    strip: Strip, blur: Blur, half: int, rules: EdgeRules, least_contrast: float
) -> tuple[EdgeRegion | None, str]:
    sides = strip.sides(blur, half)
    good, why = sides.good_blocks(rules.evenness)
    start, end = _longest(_bridged(good))
    step = strip.block
    length = (end - start) * step
    if length < rules.least_length:
        return None, why.most_common(1)[0][0] if why else "short"
    # A short clean part of a line that is mostly not clean is so by chance.
    if length < 2 * rules.least_length and length < 0.5 * strip.line.length and why:
        return None, why.most_common(1)[0][0]
    chosen = good.copy()
    chosen[:start] = chosen[end:] = False
    part = sides.blocks(chosen)
    reason = part.reason(rules.evenness, rules.least_snr)
    if reason or part.contrast < least_contrast:
        return None, reason or "weak"
    line = strip.line.part(start * step, start * step + length)
    bad = np.flatnonzero(~good[start:end])
    gaps = tuple((float(k * step - length / 2), float((k + 1) * step - length / 2)) for k in bad)
    return EdgeRegion(
        line=line, half=half, contrast=part.contrast, snr=part.snr, aligned=_is_aligned(line), gaps=gaps
    ), ""


def _bridged(good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Good blocks, and one or two others between long runs of good ones: the edge goes on behind a spot."""
    bridged = good.copy()
    for k in range(_RUN, len(good) - _RUN):
        for width in (1, 2):
            after = good[k + width : k + width + _RUN]
            if not good[k] and len(after) == _RUN and after.all() and good[k - _RUN : k].all():
                bridged[k : k + width] = True
    return bridged


def _longest(good: NDArray[np.bool_]) -> tuple[int, int]:
    """First and last + 1 of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]])))
    if not edges.size:
        return 0, 0
    starts, ends = edges[::2], edges[1::2]
    k = int(np.argmax(ends - starts))
    return int(starts[k]), int(ends[k])


def _is_aligned(line: StraightEdge) -> bool:
    """Whether the edge crosses less than one row or column of pixels along its length."""
    return min(abs(line.tx), abs(line.ty)) * line.length < 1.0
