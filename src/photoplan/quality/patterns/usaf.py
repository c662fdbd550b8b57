"""USAF 1951 targets: search, bars, resolution."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import atan2, log2, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.adjustment.least_squares import solve
from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError
from photoplan.quality.patterns.bars import MOST_CLIPPED, least_squares, pattern_window

#: Half the side of the square that three bars fill, periods.
HALF = 1.25

#: Columns of horizontal and of vertical bars, and their row, in periods of the pair's first element from the centre
#: about which pairs are similar. Columns go to the right, rows downwards.
_PAIR: tuple[tuple[tuple[float, float, float], ...], ...] = (
    (
        (3.870, 0.369, 6.216),
        (-7.761, -4.649, -6.006),
        (-7.882, -5.107, -2.246),
        (-7.994, -5.518, 1.112),
        (-8.089, -5.885, 4.099),
        (-8.184, -6.218, 6.770),
    ),
    (
        (4.570, 2.824, -6.477),
        (4.639, 3.083, -4.386),
        (4.700, 3.312, -2.527),
        (4.756, 3.515, -0.841),
        (4.803, 3.701, 0.676),
        (4.847, 3.865, 1.994),
    ),
)


@dataclass(frozen=True)
class UsafElement:
    """Three bars of the target."""

    step: int
    """Group, counted from the largest one in the picture's pair (0, 1, 2, …)."""
    element: int
    """1 to 6."""
    horizontal: bool
    """The bars lie along the rows of the target; else along its columns."""
    x: float
    """Centre of the three bars, in periods of the first element of group 0."""
    y: float

    @property
    def period(self) -> float:
        """In periods of the first element of group 0."""
        return float(2.0 ** -(self.step + (self.element - 1) / 6.0))


def usaf_layout(groups: int) -> Iterator[UsafElement]:
    """All elements of so many groups, from large to small."""
    for step in range(groups):
        scale = 0.25 ** (step // 2)
        for k, (horizontal, vertical, row) in enumerate(_PAIR[step % 2]):
            yield UsafElement(step=step, element=k + 1, horizontal=True, x=scale * horizontal, y=scale * row)
            yield UsafElement(step=step, element=k + 1, horizontal=False, x=scale * vertical, y=scale * row)


def usaf_frequency(group: int, element: int) -> float:
    """Line pairs per millimetre of an element (MIL-STD-150A)."""
    return float(2.0 ** (group + (element - 1) / 6.0))


#: Bars that are looked at, the largest first.
_MOST_BARS = 3000
#: Threes of bars that are compared with the layout; a target shows far fewer.
_MOST_THREES = 300
#: Threes that have to agree.
_LEAST_MATCHES = 5


@dataclass(frozen=True, eq=False)
class UsafPlace:
    """Where the target is in the picture."""

    matrix: Floats
    """(2, 2): from periods of the first element of the largest group to pixels."""
    origin: Floats
    """(2,): column and row of the centre about which the pairs of groups are similar."""
    matched: int
    """Threes of bars that fit."""
    rms: float
    """Their distances from their places, root mean square of one coordinate, pixels."""
    bright: bool
    """The bars are brighter than what is around them."""

    shifts: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    """By how much pairs of groups lie beside their places, pixels."""

    def pixel(self, x: float, y: float, pair: int = 0) -> Floats:
        """Column and row of a point of the layout that belongs to a pair of groups."""
        return np.asarray(self.origin + self.matrix @ np.array([x, y]) + np.array(self.shifts.get(pair, (0.0, 0.0))))

    def shifted(self, pair: int, shift: Floats) -> UsafPlace:
        """The place with another shift of a pair."""
        return replace(self, shifts={**self.shifts, pair: (float(shift[0]), float(shift[1]))})


@dataclass(frozen=True, eq=False)
class _Bar:
    centre: Floats
    along: Floats
    length: float


@dataclass(frozen=True, eq=False)
class _Three:
    centre: Floats
    across: Floats
    """Unit vector across the bars."""
    period: float


def find_usaf(values: Floats, what: str) -> UsafPlace:
    """The place of the target."""
    best: UsafPlace | None = None
    for bright in (True, False):
        threes = _threes(_bars(values if bright else -values))
        place = _place(threes, bright)
        if place is not None and (best is None or place.matched > best.matched):
            best = place
    if best is None:
        raise InputError(
            f"{what}: no USAF-1951 target is found; at least {_LEAST_MATCHES} elements have to be sharp enough to part "
            "their bars, and they need the layout of MIL-STD-150A"
        )
    return best


def _bars(values: Floats) -> list[_Bar]:
    """Bright rectangles about five times as long as wide, at several scales of the local threshold."""
    bars: list[_Bar] = []
    side = max(values.shape)
    for share in (3, 8, 20, 45):
        size = max(7, int(side / share) | 1)
        high, low = ndimage.maximum_filter(values, size), ndimage.minimum_filter(values, size)
        middle = ndimage.uniform_filter((high + low) / 2.0, size)
        reach = ndimage.uniform_filter(high - low, size)
        mask = (values > middle) & (reach > 0.15 * float(np.ptp(values)))
        labels, count = ndimage.label(mask)
        if count:
            bars += _rectangles(labels, count)
    bars.sort(key=lambda bar: -bar.length)
    return bars[:_MOST_BARS]


def _rectangles(labels: NDArray[np.int32], count: int) -> list[_Bar]:
    flat = labels.ravel()
    used = np.flatnonzero(flat)
    label = flat[used]
    y, x = np.divmod(used, labels.shape[1])
    area = np.bincount(label, minlength=count + 1).astype(float)
    area[0] = 1.0
    cx, cy = np.bincount(label, x, count + 1) / area, np.bincount(label, y, count + 1) / area
    dx, dy = x - cx[label], y - cy[label]
    xx, yy, xy = (np.bincount(label, v, count + 1) / area for v in (dx * dx, dy * dy, dx * dy))
    # Second moments of a rectangle are a twelfth of the squares of its sides; those of a pixel are added.
    half, root = (xx + yy) / 2.0, np.sqrt(((xx - yy) / 2.0) ** 2 + xy**2)
    length, width = np.sqrt(12.0 * (half + root) + 1.0), np.sqrt(np.maximum(12.0 * (half - root) + 1.0, 1.0))
    turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    full = area / (length * width)
    fits = (area >= 8) & (length / width > 2.4) & (length / width < 9.0) & (full > 0.75) & (full < 1.25)
    fits[0] = False
    chosen = np.flatnonzero(fits)
    chosen = chosen[np.argsort(-length[chosen])][:_MOST_BARS]
    return [
        _Bar(np.array([cx[k], cy[k]]), np.array([np.cos(turn[k]), np.sin(turn[k])]), float(length[k])) for k in chosen
    ]


def _threes(bars: Sequence[_Bar]) -> list[_Three]:
    """Bars with an equal neighbour at the same distance on either side."""
    threes: list[_Three] = []
    if len(bars) < 3:
        return threes
    centres = np.array([bar.centre for bar in bars])
    lengths = np.array([bar.length for bar in bars])
    alongs = np.array([bar.along for bar in bars])
    for bar in bars:
        if len(threes) >= 2 * _MOST_THREES:
            break
        across = np.array([-bar.along[1], bar.along[0]])
        offset = centres - bar.centre
        u, v = offset @ across / bar.length, offset @ bar.along / bar.length
        alike = (np.abs(lengths / bar.length - 1.0) < 0.15) & (np.abs(alongs @ bar.along) > 0.98)
        near = alike & (np.abs(v) < 0.12) & (np.abs(np.abs(u) - 0.4) < 0.11)
        for right in np.flatnonzero(near & (u > 0.0)):
            for left in np.flatnonzero(near & (u < 0.0)):
                period = float(u[right] - u[left]) / 2.0 * bar.length
                if abs(u[right] + u[left]) > 0.05 + 1.0 / bar.length:
                    continue
                centre = (centres[right] + centres[left] + bar.centre) / 3.0
                if not any(np.hypot(*(t.centre - centre)) < 0.3 * period for t in threes):
                    ends = centres[right] - centres[left]
                    threes.append(_Three(centre, ends / np.hypot(*ends), period))
    threes.sort(key=lambda three: -three.period)
    return threes[:_MOST_THREES]


def _place(threes: Sequence[_Three], bright: bool) -> UsafPlace | None:
    """The similarity that explains most threes, refined to an affine transformation."""
    if len(threes) < _LEAST_MATCHES:
        return None
    items = list(usaf_layout(8))
    best: tuple[int, Floats, Floats] | None = None
    for seed in threes[:6]:
        for item in items[:24]:
            for matrix in _turns(seed, item):
                origin = seed.centre - matrix @ np.array([item.x, item.y])
                matches = _matches(threes, items, matrix, origin, 0.8)
                if best is None or len(matches) > best[0]:
                    best = len(matches), matrix, origin
    assert best is not None
    _, matrix, origin = best
    rms = np.inf
    for tolerance in (0.8, 0.6, 0.5, 0.5):
        matches = _matches(threes, items, matrix, origin, tolerance)
        if len(matches) < _LEAST_MATCHES:
            return None
        design = np.array([[items[k].x, items[k].y, 1.0] for _, k in matches])
        wanted = np.array([threes[t].centre for t, _ in matches])
        if np.linalg.matrix_rank(design, 1e-3 * float(np.abs(design).max())) < 3:
            return None
        fit = solve(design, wanted)
        matrix, origin = fit.unknowns[:2].T, fit.unknowns[2]
        rms = float(np.sqrt((fit.residuals**2).mean()))
    return UsafPlace(matrix=matrix, origin=origin, matched=len(matches), rms=rms, bright=bright)


def _turns(seed: _Three, item: UsafElement) -> list[Floats]:
    """Similarities that lay an item on a three: both senses of each axis."""
    scale = seed.period / item.period
    across, along = scale * seed.across, scale * np.array([-seed.across[1], seed.across[0]])
    axes = (along, across) if item.horizontal else (across, along)
    return [np.stack([sx * axes[0], sy * axes[1]], axis=1) for sx in (1.0, -1.0) for sy in (1.0, -1.0)]


def _matches(
    threes: Sequence[_Three], items: Sequence[UsafElement], matrix: Floats, origin: Floats, tolerance: float
) -> list[tuple[int, int]]:
    """Threes and the item that each of them is: near, of its period and direction."""
    places = np.array([[item.x, item.y] for item in items]) @ matrix.T + origin
    units = np.array([[0.0, 1.0] if item.horizontal else [1.0, 0.0] for item in items]) @ matrix.T
    steps = np.hypot(units[:, 0], units[:, 1])
    periods = steps * np.array([item.period for item in items])
    centres = np.array([three.centre for three in threes])
    away = np.hypot(*(places[None, :, :] - centres[:, None, :]).transpose(2, 0, 1))
    aligned = np.abs(np.array([three.across for three in threes]) @ units.T) / steps
    same = np.abs(np.array([three.period for three in threes])[:, None] / periods - 1.0) < 0.1
    away[~((away < tolerance * periods) & same & (aligned > 0.97))] = np.inf
    nearest = away.argmin(axis=1)
    return [(t, int(k)) for t, k in enumerate(nearest) if np.isfinite(away[t, k])]


#: Half the part of the bars' length that is used, periods: their ends are blurred.
_MIDDLE = 0.75
#: Half the part of a bar whose mean is its level, periods, where bars are wide.
_REACH = 0.125
#: Bars with fewer cycles per pixel have levels of their own; those with more are measured by their waves.
_WIDE = 0.1
#: Cycles per pixel of the highest harmonic wave that is fitted.
_LAST_WAVE = 0.8


@dataclass(frozen=True)
class ThreeBars:
    """What three bars show."""

    frequency: float
    """Cycles per pixel across them."""
    centre: tuple[float, float]
    """Column and row."""
    difference: float
    """Mean of the three bars less mean of both gaps; positive where the bars are seen as they are."""
    sigma: float
    flat: bool
    """The middle of bars and gaps is flat: the difference is that of wide areas."""
    clipped: float
    """Share of its pixels that are cut off."""
    square: float
    """Mean light of the square that they fill less that around it: finest bars run together to a grey square."""
    square_sigma: float


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Pixels around three bars."""

    u: Floats
    """Across the bars from the middle one, periods."""
    v: Floats
    """Along the bars from their middle, periods."""
    light: Floats
    clipped: Floats
    centre: Floats
    frequency: float
    across: Floats
    """Unit vector."""


def _pixels(values: Floats, clipped: Mask | None, place: UsafPlace, item: UsafElement, reach: float) -> _Pixels | None:
    """Pixels up to so many periods from the centre; None where the element is not inside of the picture."""
    x_axis, y_axis = (place.matrix * item.period).T
    across, along = (y_axis, x_axis) if item.horizontal else (x_axis, y_axis)
    centre = place.pixel(item.x, item.y, item.step // 2)
    size = np.array(values.shape[::-1])
    signs = [(a, b) for a in (-1, 1) for b in (-1, 1)]
    bars = np.array([centre + HALF * (a * across + b * along) for a, b in signs])
    if (bars < 0.0).any() or (bars > size - 1).any():
        return None
    corners = np.array([centre + reach * (a * across + b * along) for a, b in signs])
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 1, size)
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]]
    u, v = np.linalg.inv(np.stack([across, along], axis=1)) @ np.stack([x.ravel() - centre[0], y.ravel() - centre[1]])
    part = (slice(low[1], high[1]), slice(low[0], high[0]))
    cut = np.zeros(u.size) if clipped is None else clipped[part].ravel().astype(float)
    frequency = float(np.hypot(*along)) / float(abs(across[0] * along[1] - across[1] * along[0]))
    return _Pixels(
        u=u,
        v=v,
        light=values[part].ravel(),
        clipped=cut,
        centre=centre,
        frequency=frequency,
        across=across / float(np.hypot(*across)),
    )


def measure_three(values: Floats, clipped: Mask | None, place: UsafPlace, item: UsafElement) -> ThreeBars | None:
    """Difference between bars and gaps; None where the element is not inside of the picture, or has too few pixels.

    Bars are placed along their normal by their own wave, if it stands out; a linear change of light across them is
    taken away.
    """
    pixels = _pixels(values, clipped, place, item, 2.2)
    if pixels is None:
        return None
    u = pixels.u - _shift(pixels.u, pixels.v, pixels.light)
    inside = (np.abs(u) <= HALF) & (np.abs(pixels.v) <= _MIDDLE)
    if inside.sum() < 8:
        return None
    part, light = u[inside], pixels.light[inside]
    try:
        wide = pixels.frequency < _WIDE
        found = _wide(part, light) if wide else _fine(part, light, pixels.frequency)
    except InputError:
        return None
    far = np.maximum(np.abs(u), np.abs(pixels.v))
    square, around = pixels.light[far <= 1.0], pixels.light[(far > 1.6) & (far <= 2.2)]
    if min(square.size, around.size) < 4:
        return None
    return ThreeBars(
        pixels.frequency,
        (float(pixels.centre[0]), float(pixels.centre[1])),
        *found,
        float(pixels.clipped[inside].mean()),
        float(square.mean() - np.median(around)),
        float(around.std()),
    )


def place_pair(values: Floats, place: UsafPlace, items: Sequence[UsafElement]) -> UsafPlace:
    """Shift one pair of groups so that its bars lie where the picture has bars.

    Makers place the inner pairs to a fraction of a millimetre; each pair is shifted by the sum of the correlations of
    its elements with three bars, up to a period of its first element.
    """
    pair = items[0].step // 2
    shift = np.zeros(2)
    for horizontal in (False, True):
        unit, steps = np.zeros(2), np.linspace(-1.0, 1.0, 65)
        score = np.zeros(steps.size)
        for item in items:
            if item.horizontal != horizontal:
                continue
            pixels = _pixels(values, None, place, item, 2.8)
            if pixels is None or pixels.frequency > 0.4:
                continue
            # Steps are periods of the pair's first element.
            own = steps * 2.0 ** ((item.step % 2) + (item.element - 1) / 6.0)
            near = np.abs(pixels.v) <= _MIDDLE
            u, light = pixels.u[near], pixels.light[near]
            score = score + np.array([_correlation(u - s, light) for s in own])
            unit = pixels.across / pixels.frequency * items[0].period / item.period
        if score.any():
            shift += float(steps[int(np.argmax(score))]) * unit
    return place.shifted(pair, shift)


def _correlation(u: Floats, light: Floats) -> float:
    """Correlation of pixels with three bars and the dark on both sides of them."""
    part = np.abs(u) <= 1.75
    if part.sum() < 12:
        return 0.0
    bars = np.where(np.abs(u[part]) <= HALF + 0.25, 0.5 + 0.5 * np.cos(2.0 * pi * u[part]), 0.0)
    grey = light[part] - light[part].mean()
    bars = bars - bars.mean()
    size = sqrt(float(grey @ grey) * float(bars @ bars))
    return float(grey @ bars) / size if size > 0.0 else 0.0


def _shift(u: Floats, v: Floats, light: Floats) -> float:
    """By how much the bars lie beside their place, periods; 0 where their wave does not stand out."""
    shift = 0.0
    for _ in range(3):
        inside = (np.abs(u - shift) <= HALF) & (np.abs(v) <= _MIDDLE)
        if inside.sum() < 12:
            return 0.0
        turn = 2.0 * pi * (u[inside] - shift)
        columns = np.stack([np.ones_like(turn), turn, np.cos(turn), np.sin(turn)], axis=1)
        try:
            solution, covariance, _ = least_squares(columns, light[inside])
        except InputError:
            return 0.0
        a, b = float(solution[2]), float(solution[3])
        if a * a + b * b < 25.0 * (covariance[2, 2] + covariance[3, 3]):
            return 0.0
        shift += atan2(b, a) / (2.0 * pi)
        if abs(shift) > 0.3:
            return 0.0
    return shift


def _wide(u: Floats, light: Floats) -> tuple[float, float, bool]:
    """Difference of the means in the middle of bars and gaps."""
    level: list[tuple[float, float, float]] = []
    for k in (-1.0, -0.5, 0.0, 0.5, 1.0):
        away = np.abs(u - k)
        inner, outer = light[away <= _REACH / 2.0], light[(away > _REACH / 2.0) & (away <= _REACH)]
        if min(inner.size, outer.size) < 2:
            return _fine(u, light, _WIDE)
        level.append((float(inner.mean()), float(outer.mean()), float(inner.var(ddof=1)) / inner.size))
    inner_mean, outer_mean, variance = np.array(level).T
    # The mean of bars -1, 0, 1 and gaps -0.5, 0.5 have one centre: a linear change of light cancels.
    weights = np.array([1 / 3, -1 / 2, 1 / 3, -1 / 2, 1 / 3])
    difference = float(weights @ inner_mean)
    bend = difference - float(weights @ outer_mean)
    sigma = sqrt(float(weights**2 @ variance))
    return difference, sigma, bool(abs(bend) < 0.015 * abs(difference) + 2.0 * sigma and difference > 20.0 * sigma)


def _fine(u: Floats, light: Floats, frequency: float) -> tuple[float, float, bool]:
    """Difference of bars and gaps by waves with the bars' period, beside a level with slope and curvature.

    Harmonic waves are taken in as far as blur leaves them and the places of the pixels tell them apart.
    """
    turn = 2.0 * pi * u
    columns = [np.ones_like(u), u, u**2]
    # The level's curvature is the same for bars and gaps but for their mean squares, 2/3 and 1/4.
    weights = [0.0, 0.0, 2.0 / 3.0 - 0.25]
    best: tuple[float, float] | None = None
    least = np.inf
    for k in (1, 3, 5):
        if best is not None and k * frequency > _LAST_WAVE:
            break
        columns += [np.cos(k * turn), np.sin(k * turn)]
        weights += [2.0, 0.0]
        if u.size < 2 * len(columns):
            break
        try:
            solution, covariance, residuals = least_squares(np.stack(columns, axis=1), light)
        except InputError:
            break
        combine = np.array(weights)
        variance = max(float(combine @ covariance @ combine), 0.0)
        # What the places of the pixels alone make of noise.
        power = float(residuals @ residuals) / max(u.size - len(columns), 1)
        spread = variance / power if power > 0.0 else least
        if best is not None and spread > 3.0 * least:
            break
        least = min(least, spread)
        best = float(combine @ solution), sqrt(variance)
    if best is None:
        raise InputError("too few pixels for three bars")
    return *best, False


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
    light: NDArray[np.floating], rules: UsafRules, *, clipped: Mask | None = None, what: str = "USAF target"
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
    bars = tuple(_bars_usaf(item, three, full, first, rules) for item, three in found)
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


def _full(found: Sequence[tuple[UsafElement, ThreeBars]], what: str) -> Floats:
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


def _bars_usaf(item: UsafElement, three: ThreeBars, full: Floats, first: int, rules: UsafRules) -> UsafBars:
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
