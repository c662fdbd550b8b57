"""Contrast transfer and limiting resolution from a picture of a USAF-1951 target.

What is measured is the contrast transfer of three bars: the difference between bars and gaps against that of wide
areas. It is not an MTF: the bars are no sine wave, and there are only three.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log2

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import solve
from photoplan.errors import InputError
from photoplan.quality.patterns.pixels import MOST_CLIPPED, pattern_window
from photoplan.quality.patterns.usaf_bars import ThreeBars, measure_three, place_pair
from photoplan.quality.patterns.usaf_find import UsafElement, UsafPlace, find_usaf, usaf_frequency, usaf_layout

Array = NDArray[np.float64]

#: Side of the largest window, pixels.
_MOST_SIDE = 4096
#: Part of the full contrast by which a grey square stands out.
_SEEN = 0.1
#: Cycles per pixel beyond which three bars meet too few pixels.
_FINEST = 0.48
#: A contrast with a larger standard deviation is not known.
_UNKNOWN = 0.25


@dataclass(frozen=True)
class UsafRules:
    """How the target is read."""

    group: int | None = None
    """Number of the largest group in the picture; None: from `pixel_um`."""
    pixel_um: float | None = None
    """Size of a pixel on the target, micrometres."""
    least_contrast: float = 0.1
    """Contrast transfer from which on bars are resolved, if it is three standard deviations too."""

    def __post_init__(self) -> None:
        if self.group is not None and not -6 <= self.group <= 12:
            raise InputError(f"group {self.group}; targets have groups -6 to 12")
        if self.pixel_um is not None and not 1e-6 < self.pixel_um < 1e9:
            raise InputError(f"a pixel of {self.pixel_um:g} µm on the target; it is positive")
        if not 0.0 < self.least_contrast < 1.0:
            raise InputError(f"a least contrast of {self.least_contrast:g}; it lies between 0 and 1")


@dataclass(frozen=True)
class UsafBars:
    """Three bars of an element."""

    group: int
    element: int
    horizontal: bool
    """The bars lie along the target's rows: they show the transfer across them."""
    lp_mm: float
    """Line pairs per millimetre on the target."""
    frequency: float
    """Cycles per pixel."""
    centre: tuple[float, float]
    """Column and row."""
    contrast: float
    """Contrast transfer; negative where bars and gaps seem exchanged; NaN where the pixels do not tell."""
    sigma: float
    """NaN with it."""
    resolved: bool
    seen: bool
    """The element is seen at least as a grey square."""


@dataclass(frozen=True, eq=False)
class UsafResult:
    """What a USAF-1951 target says of an image."""

    place: UsafPlace
    bars: tuple[UsafBars, ...]
    """All that are inside of the picture, from large to small."""
    pixel_um: float
    """Size of a pixel on the target, from the number of the group, micrometres."""
    full: float
    """Difference of light between wide bars and gaps, mean."""

    @property
    def groups(self) -> tuple[int, ...]:
        """Groups of which something is seen, be it as grey squares."""
        return tuple(sorted({bars.group for bars in self.bars if bars.seen}))

    @property
    def resolved_groups(self) -> tuple[int, ...]:
        """Groups of which some bars are resolved."""
        return tuple(sorted({bars.group for bars in self.bars if bars.resolved}))

    def limit(self, *, horizontal: bool) -> UsafBars | None:
        """The last element that is resolved with all coarser ones, of one direction of bars; None: not even one."""
        last = None
        for bars in self.bars:
            if bars.horizontal != horizontal:
                continue
            if not bars.resolved:
                break
            last = bars
        return last


def measure_usaf(
    light: NDArray[np.floating],
    rules: UsafRules,
    *,
    clipped: NDArray[np.bool_] | None = None,
    what: str = "USAF target",
) -> UsafResult:
    """Contrast transfer of every element in a picture, and the limiting resolution.

    Parameters
    ----------
    light : ndarray
        Shape (rows, columns), proportional to light; the target may be turned, mirrored, bright or dark.
    rules : UsafRules
        With the group's number or the size of a pixel: the target looks the same at every scale.
    clipped : ndarray, optional
        True where a pixel is cut off at an end of its range, same shape.
    what : str
        Names the picture in messages.

    Raises
    ------
    InputError
        No target is found, its number is unknown or contradicts its layout, its bars are clipped or none is wide enough
        to show the full contrast.
    """
    values = pattern_window(light, None, what, 32, _MOST_SIDE)
    place = find_usaf(values, what)
    first = _first_group(place, rules, what)
    sign = 1.0 if place.bright else -1.0
    found: list[tuple[UsafElement, ThreeBars]] = []
    layout = list(usaf_layout(10))
    for pair in range(1, 5):
        items = [item for item in layout if item.step // 2 == pair]
        place = place_pair(sign * values, place, items)
    for item in layout:
        three = measure_three(sign * values, clipped, place, item)
        if three is not None and three.frequency < 0.75:
            found.append((item, three))
    full = _full(found, what)
    bars = tuple(_bars(item, three, full, first, rules) for item, three in found)
    pixel = 1000.0 / usaf_frequency(first, 1) / float(np.sqrt(abs(np.linalg.det(place.matrix))))
    mean = float(np.mean([full @ np.array([1.0, *three.centre]) for _, three in found]))
    return UsafResult(place, bars, pixel, mean)


def _first_group(place: UsafPlace, rules: UsafRules, what: str) -> int:
    """Number of the layout's group 0, which is even."""
    scale = float(np.sqrt(abs(np.linalg.det(place.matrix))))
    if rules.group is None and rules.pixel_um is None:
        raise InputError(
            f"{what}: the target looks the same at every scale; give the number of its largest group, or the size of a "
            "pixel on the target"
        )
    if rules.pixel_um is not None:
        exact = log2(1000.0 / (scale * rules.pixel_um))
        number = 2 * round(exact / 2.0)
        if abs(exact - number) > 0.25:
            raise InputError(
                f"{what}: with pixels of {rules.pixel_um:g} µm the first element of the largest pair of groups has "
                f"{2.0**exact:.4g} LP/mm, which is that of no even group; look at the size of a pixel on the target"
            )
        if rules.group is not None and rules.group not in (number, number + 1):
            raise InputError(f"{what}: pixels of {rules.pixel_um:g} µm say that the largest group is {number}, not "
                             f"{rules.group}")  # fmt: skip
        return number
    assert rules.group is not None
    if rules.group % 2:
        raise InputError(
            f"{what}: the largest group is {rules.group} as given, but its layout is that of an even one (first "
            "element at the lower right, the others at the left)"
        )
    return rules.group


def _full(found: Sequence[tuple[UsafElement, ThreeBars]], what: str) -> Array:
    """Difference of light between wide bars and gaps as level and slopes over the picture."""
    flat = [three for _, three in found if three.flat]
    if not flat:
        raise InputError(
            f"{what}: no bars are wide enough to show the full contrast, so that no contrast transfer is known; take "
            "more of the target into the picture"
        )
    cut = [three for three in flat if three.clipped > MOST_CLIPPED]
    if cut:
        share = max(three.clipped for three in cut)
        raise InputError(
            f"{what}: up to {100 * share:.0f} % of the pixels of wide bars are saturated or clipped; the full contrast "
            "is unknown, expose shorter"
        )
    levels = np.array([three.difference for three in flat])
    if len(flat) >= 6:
        columns = np.array([[1.0, *three.centre] for three in flat])
        if np.linalg.matrix_rank(columns - [0.0, *columns[:, 1:].mean(axis=0)], 1.0) == 3:
            return solve(columns, levels).unknowns
    return np.array([float(levels.mean()), 0.0, 0.0])


def _bars(item: UsafElement, three: ThreeBars, full: Array, first: int, rules: UsafRules) -> UsafBars:
    level = float(full @ np.array([1.0, *three.centre]))
    contrast = three.difference / level
    sigma = three.sigma / level
    if three.frequency > _FINEST or sigma > _UNKNOWN:
        contrast = sigma = float("nan")
    group = first + item.step
    resolved = bool(contrast >= rules.least_contrast and contrast > 3.0 * sigma)
    square = bool(three.square / level > _SEEN and three.square > 3.0 * three.square_sigma)
    return UsafBars(
        group=group,
        element=item.element,
        horizontal=item.horizontal,
        lp_mm=usaf_frequency(group, item.element),
        frequency=three.frequency,
        centre=three.centre,
        contrast=contrast,
        sigma=sigma,
        resolved=resolved,
        seen=resolved or square,
    )
