"""Finding a USAF-1951 target in a picture: bars, threes of bars, and the affine transformation that explains them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.adjustment.linear import solve
from photoplan.errors import InputError

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


Array = NDArray[np.float64]

#: Bars that are looked at, the largest first.
_MOST_BARS = 3000
#: Threes of bars that are compared with the layout; a target shows far fewer.
_MOST_THREES = 300
#: Threes that have to agree.
_LEAST_MATCHES = 5


@dataclass(frozen=True, eq=False)
class UsafPlace:
    """Where the target is in the picture."""

    matrix: Array
    """(2, 2): from periods of the first element of the largest group to pixels."""
    origin: Array
    """(2,): column and row of the centre about which the pairs of groups are similar."""
    matched: int
    """Threes of bars that fit."""
    rms: float
    """Their distances from their places, root mean square of one coordinate, pixels."""
    bright: bool
    """The bars are brighter than what is around them."""

    shifts: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    """By how much pairs of groups lie beside their places, pixels."""

    def pixel(self, x: float, y: float, pair: int = 0) -> Array:
        """Column and row of a point of the layout that belongs to a pair of groups."""
        return np.asarray(self.origin + self.matrix @ np.array([x, y]) + np.array(self.shifts.get(pair, (0.0, 0.0))))

    def shifted(self, pair: int, shift: Array) -> UsafPlace:
        """The place with another shift of a pair."""
        return replace(self, shifts={**self.shifts, pair: (float(shift[0]), float(shift[1]))})


@dataclass(frozen=True, eq=False)
class _Bar:
    centre: Array
    along: Array
    length: float


@dataclass(frozen=True, eq=False)
class _Three:
    centre: Array
    across: Array
    """Unit vector across the bars."""
    period: float


def find_usaf(values: Array, what: str) -> UsafPlace:
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


def _bars(values: Array) -> list[_Bar]:
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
    best: tuple[int, Array, Array] | None = None
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


def _turns(seed: _Three, item: UsafElement) -> list[Array]:
    """Similarities that lay an item on a three: both senses of each axis."""
    scale = seed.period / item.period
    across, along = scale * seed.across, scale * np.array([-seed.across[1], seed.across[0]])
    axes = (along, across) if item.horizontal else (across, along)
    return [np.stack([sx * axes[0], sy * axes[1]], axis=1) for sx in (1.0, -1.0) for sy in (1.0, -1.0)]


def _matches(
    threes: Sequence[_Three], items: Sequence[UsafElement], matrix: Array, origin: Array, tolerance: float
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
