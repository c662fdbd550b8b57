"""Reasons why a region gives no figure of an edge: each with what was found, what is allowed and what to do.

Every function that refuses raises `InputError`. Places and distances are pixels; light is what the linearisation made
of grey values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.chances import chance_chi_square
from photoplan.adjustment.robust import spread
from photoplan.errors import InputError

#: Side of the squares beside the edge whose means are tested for structure, pixels.
CELL = 5
#: Chance of error of the tests: a clean edge is refused once in so many.
CHANCE = 1e-4


@dataclass(frozen=True)
class EdgeSettings:
    """What an edge must be like, and how its profile is described."""

    curve: int = 1
    """1: a straight line; 2: a parabola, for edges that a lens bends."""
    reach: float = 16.0
    """Distance in pixels up to which pixels are used (8 standard deviations of wider edges); light that is spread
    farther is estimated. Infinite: the whole region, for evenly lit targets: uneven light across the edge looks like
    stray light."""
    blocks: int = 20
    """Into how many independent profiles an edge is split at most; a block has two rows at least."""
    confidence: float = 0.95
    """Probability that an interval holds the true figure."""
    least_length: float = 12.0
    """Shortest edge, pixels."""
    least_snr: float = 5.0
    """Smallest ratio of step to noise of a pixel."""
    most_clipped: float = 0.01
    """Largest share of clipped pixels on a side."""
    most_structure: float = 0.03
    """Largest structure beside the edge that is not noise, root mean square relative to the step."""
    most_uncertain: float = 0.5
    """Widest interval of MTF50 to each side, relative to it."""
    most_bend: float = 0.1
    """Largest deviation from the line, root mean square in pixels, that is more than noise."""

    def __post_init__(self) -> None:
        if self.curve not in (1, 2):
            raise InputError(f"the line of an edge has degree 1 (straight) or 2 (parabola); given: {self.curve}")
        if self.blocks < 5:
            raise InputError(f"an interval needs 5 blocks of an edge at least; given: {self.blocks}")
        if not self.reach >= 4.0:
            raise InputError(f"the reach of an edge is 4 pixels at least; given: {self.reach}")
        if not 0.5 <= self.confidence < 1.0:
            raise InputError(f"a confidence is 0.5 or more and below 1; given: {self.confidence}")


@dataclass(frozen=True, eq=False)
class EdgeResiduals:
    """What a profile leaves of the pixels, relative to the step, with where they are; shape (n,) each."""

    across: NDArray[np.float64]
    along: NDArray[np.float64]
    distance: NDArray[np.float64]
    value: NDArray[np.float64]
    spread: NDArray[np.float64]
    """Line spread function at the pixels, per pixel."""
    width: float
    """Standard deviation of the line spread function, pixels."""


def check_region(image: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask of the valid and finite pixels; refuse what is no region: wrong shape, too small, too large, empty."""
    if image.ndim != 2 or valid.shape != image.shape:
        raise InputError(
            f"a region is an array of rows and columns with a mask like it; given: {image.shape}, {valid.shape}"
        )
    if min(image.shape) < 8:
        raise InputError(f"a region for an edge has 8 × 8 pixels at least; given: {image.shape[1]} × {image.shape[0]}")
    if image.size > 16_000_000:
        raise InputError(
            f"a region for an edge has 16 million pixels at most; given: {image.shape[1]} × {image.shape[0]}"
        )
    # The pixels along an oblique edge fill a small part of the rectangle around them.
    valid = valid & np.isfinite(image)
    if np.count_nonzero(valid) < 100:
        raise InputError(f"the region has {np.count_nonzero(valid)} valid pixels; 100 at least are needed")
    return valid


def check_clipping(
    light: NDArray[np.float64], distance: NDArray[np.float64], limits: tuple[float, float] | None, most: float
) -> None:
    """Refuse an edge with a clipped side: its profile is cut off, and no figure of it is right."""
    if limits is None:
        return
    low, high = limits
    slack = 1e-9 * max(abs(low), abs(high), 1e-300)
    for side, name in ((distance < 0.0, "dark"), (distance > 0.0, "bright")):
        values = light[side]
        if values.size == 0:
            continue
        share = float(np.mean((values <= low + slack) | (values >= high - slack)))
        if share > most:
            raise InputError(
                f"saturated edge: {100 * share:.1f} % of the pixels on its {name} side are clipped ({low:g} or "
                f"{high:g}), allowed are {100 * most:g} %; take an image with another exposure"
            )


def check_step(step: float, noise: float, grain: float, settings: EdgeSettings) -> None:
    """Refuse a region without a significant step, a step drowned in noise, and pixels that one edge does not
    explain.
    """
    if not step > 1.5 * noise or not step > 1.5 * grain:
        raise InputError(
            f"no edge: both sides differ by {step:.3g}, while single pixels deviate by {noise:.3g} from one edge"
        )
    if step < settings.least_snr * noise:
        if noise > 1.7 * grain:
            raise InputError(
                f"the sides of the edge are not even: pixels deviate from one edge by {100 * noise / step:.0f} % of "
                f"its step, {noise / grain if grain > 0.0 else np.inf:.1f} times their noise (a second edge, a corner "
                "or texture); choose a cleaner or narrower region"
            )
        raise InputError(
            f"edge too noisy: the step is {step / noise:.1f} times a pixel's noise, at least {settings.least_snr:g} "
            "are needed; use a stronger edge, or the mean of several images"
        )


def check_one_peak(positions: NDArray[np.float64], line: NDArray[np.float64], sigma: NDArray[np.float64]) -> None:
    """Refuse a line spread function with a second peak: a second edge beside the first.

    A peak counts if it lies 3 pixels or more from the main one, has a sixth of its height and four standard deviations,
    and the line between both falls below half of it (ripples of edge enhancement stay far below that).
    """
    top = int(np.argmax(line))
    for side in (slice(top, None), slice(top, None, -1)):
        away, height, error = np.abs(positions[side] - positions[top]), line[side], sigma[side]
        valley = np.minimum.accumulate(height)
        second = (away >= 3.0) & (height > line[top] / 6.0) & (height > 4.0 * error) & (valley < 0.5 * height)
        if second.any():
            i = int(np.argmax(np.where(second, height, 0.0)))
            raise InputError(
                f"the sides of the edge are not even: a second edge {away[i]:.1f} pixels beside the first one, "
                f"{100 * height[i] / line[top]:.0f} % as steep; choose a narrower region"
            )


def check_overshoot(overshoot: float, undershoot: float) -> None:
    """Refuse a profile that goes farther beyond a level than from one to the other: a line."""
    most = max(overshoot, undershoot)
    if most > 1.0:
        raise InputError(
            f"no edge but a line: beside it light goes {100 * most:.0f} % of the step beyond both sides; choose "
            "a region with one edge"
        )


def check_certainty(mtf50: float, reach: float, most: float) -> None:
    """Refuse an edge whose MTF50 is hardly known; one that is not determined at all (NaN) says so itself."""
    if reach > most * mtf50:
        raise InputError(
            f"edge too noisy or too short: MTF50 would be {mtf50:.3f} ± {reach:.3f} cycles per pixel, allowed are "
            f"{100 * most:g} %; use a longer or stronger edge"
        )


def grain(pixels: NDArray[np.float64], along: NDArray[np.float64], across: NDArray[np.float64]) -> float:
    """Noise of a pixel from differences of neighbours along the edge; robust, so that the edge itself hardly counts."""
    order = np.lexsort((along, across))
    near = (np.diff(along[order]) == 1.0) & (np.diff(across[order]) == 0.0)
    steps = np.diff(pixels[order])[near]
    return spread(steps) / float(np.sqrt(2.0)) if steps.size else 0.0


def check_line(residuals: EdgeResiduals, most: float, curve: int) -> float:
    """Root mean square deviation of the edge from its line beyond noise, pixels; refuse a bent edge.

    Each row's shift is that of least squares, Σ r · LSF / Σ LSF²; shifts of the rows are compared with what the pixels'
    noise explains, as means over stretches of the edge.
    """
    row = residuals.along.astype(np.intp)
    row -= row.min()
    near = residuals.spread > 0.05 * residuals.spread.max()
    weight = np.bincount(row[near], residuals.spread[near] ** 2, row.max() + 1)
    moment = np.bincount(row[near], (residuals.value * residuals.spread)[near], row.max() + 1)
    good = weight > 0.5 * np.median(weight[weight > 0.0])
    if np.count_nonzero(good) < 12:
        return 0.0
    rows = int(np.count_nonzero(good))
    groups = np.arange(rows) // max(4, rows // 12)
    total, sums = np.bincount(groups, weight[good]), np.bincount(groups, moment[good])
    shift = sums / total
    noise = float(residuals.value[near].var())
    excess = float((shift**2).mean() - noise * (1.0 / total).mean())
    chance = chance_chi_square((shift**2 * total).sum() / max(noise, 1e-30), shift.size)
    deviation = float(np.sqrt(max(excess, 0.0)))
    if chance < CHANCE and deviation > most:
        advice = ("measure it as a curve of degree 2, or " if curve == 1 else "") + "choose a shorter region"
        raise InputError(
            f"bent edge: it deviates from its line by {deviation:.2f} pixels (root mean square), allowed are {most:g}; "
            f"{advice}"
        )
    return deviation


def check_sides(residuals: EdgeResiduals, most: float) -> float:
    """Structure beside the edge that noise does not explain, root mean square relative to the step; refuse too much.

    Means over squares of 5 × 5 pixels on either side are compared with the noise of single pixels, which follows from
    differences of neighbours along the edge (χ² test); a second edge, a corner or a texture all show so.
    """
    far = np.abs(residuals.distance) > 2.0 * residuals.width
    value = residuals.value[far]
    across, along = residuals.across[far].astype(np.intp), residuals.along[far].astype(np.intp)
    if value.size < 4 * CELL * CELL:
        return 0.0
    across, along = across - across.min(), along - along.min()
    frame = np.full((along.max() + 1, across.max() + 1), np.nan)
    frame[along, across] = value
    steps = np.diff(frame, axis=0)
    steps = steps[np.isfinite(steps)]
    noise = spread(steps) ** 2 / 2.0 if steps.size else 0.0
    noise = max(noise, float((steps**2).mean()) / 2.0 if steps.size else 0.0)
    side = (residuals.distance[far] > 0.0).astype(np.intp)
    cell = (along // CELL * (across.max() // CELL + 1) + across // CELL) * 2 + side
    count = np.bincount(cell)
    sums = np.bincount(cell, value)[count >= 5]
    count = count[count >= 5]
    if count.size < 4:
        return 0.0
    square = sums**2 / count
    chance = chance_chi_square(square.sum() / max(noise, 1e-30), count.size)
    structure = float(np.sqrt(max((square.sum() - noise * count.size) / count.sum(), 0.0)))
    if chance < CHANCE and structure > most:
        largest = float(np.abs(sums / count).max())
        what = "a second edge, a corner or another object" if largest > 0.25 else "texture"
        raise InputError(
            f"the sides of the edge are not even: {what} of {100 * structure:.1f} % of the step (root mean square; "
            f"up to {100 * largest:.0f} %) where {100 * most:g} % are allowed; choose a cleaner or narrower region"
        )
    return structure
