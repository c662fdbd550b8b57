"""A projection's field as a table: nodes over the part of the image that a tile needs, bilinear between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import ImageField

#: Widest and narrowest spacing of nodes, pixels.
_WIDEST, _NARROWEST = 256.0, 1.0
#: Intervals of nodes along each axis at which the spacing is tried out.
_SAMPLES = 24
#: The residual is that of the middles of cells and of their sides; what a third derivative adds beside them.
_BESIDE = 1.1


@dataclass(frozen=True, eq=False)
class FieldGrid:
    """How a field is tabulated, for one image and tolerance, whatever the tile.

    Nodes lie at `phase` plus whole multiples of `spacing`, so that tiles that overlap have them in common.
    """

    field: ImageField
    size: tuple[int, int]
    """Of the image, pixels."""
    phase: tuple[float, float]
    spacing: tuple[float, float]
    """Along x and y, pixels."""
    bounds: tuple[float, float, float, float]
    """Ideal positions x_min, y_min, x_max, y_max of all that lies in the image."""
    stretch: float
    """Largest factor by which the field makes a distance longer."""
    miss: float
    """Worst difference between interpolation and field where it was tried, pixels; that of a tile is measured again."""

    def nodes(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
        """Number of nodes around the ideal positions from `low` to `high`, about."""
        low, high = (np.clip(a, self.bounds[:2], self.bounds[2:]) for a in (low, high))
        return float(np.prod((high - low) / self.spacing + 2.0))

    def table(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> FieldTable:
        """Nodes around the ideal positions from `low` to `high`, (x, y) each, cut at `bounds`."""
        low = np.clip(low, self.bounds[:2], self.bounds[2:])
        high = np.clip(high, self.bounds[:2], self.bounds[2:])
        ends = [
            [int(np.floor((a[axis] - self.phase[axis]) / self.spacing[axis])) for a in (low, high)] for axis in range(2)
        ]
        starts = [p + s * np.arange(e[0], e[1] + 1.0) for p, s, e in zip(self.phase, self.spacing, ends)]
        nodes, residual = (self._smooth if self.field.breaks is None else self._bent)(starts)
        origin = np.round(nodes.mean(axis=(0, 1)))
        kept = (nodes - origin).astype(np.float32)
        rounding = float(np.spacing(np.abs(kept).max()))
        return FieldTable((float(starts[0][0]), float(starts[1][0])), origin, kept, residual + rounding)

    def _smooth(self, starts: list[NDArray[np.float64]]) -> tuple[NDArray[np.float64], float]:
        """Shifts at nodes, and what cells miss by the second differences of the nodes (and those around them)."""
        x, y = (np.r_[a[0] - s, a, a[-1] + s, a[-1] + 2 * s] for a, s in zip(starts, self.spacing))
        shifts, used = _shifts(self.field, self.size, self.spacing, x, y)
        across = shifts[1:-1, :-2] - 2 * shifts[1:-1, 1:-1] + shifts[1:-1, 2:]
        down = shifts[:-2, 1:-1] - 2 * shifts[1:-1, 1:-1] + shifts[2:, 1:-1]
        miss = (np.hypot(across[..., 0], across[..., 1]) + np.hypot(down[..., 0], down[..., 1])) / 8
        return shifts[1:-1, 1:-1], _BESIDE * float(miss[used[1:-1, 1:-1]].max(initial=0.0))

    def _bent(self, starts: list[NDArray[np.float64]]) -> tuple[NDArray[np.float64], float]:
        """Shifts at nodes, and what cells miss at their middles or at the breaks that cross them."""
        probed = [_probed(a, s, breaks) for a, s, breaks in zip(starts, self.spacing, _breaks(self.field))]
        x, y = (np.r_[lattice[:, :2].ravel(), lattice[-1, 2]] for lattice, _ in probed)
        shifts, used = _shifts(self.field, self.size, self.spacing, x, y)
        corners = (shifts[:-1:2, :-1:2], shifts[:-1:2, 2::2], shifts[2::2, :-1:2], shifts[2::2, 2::2])
        probes = (shifts[:-1:2, 1::2], shifts[1::2, :-1:2], shifts[1::2, 1::2])
        misses = _misses(corners, probes, (probed[0][1], probed[1][1]), used[1::2, 1::2])
        return shifts[::2, ::2], _BESIDE * float(misses.max())


@dataclass(frozen=True, eq=False)
class FieldTable:
    """The nodes that one tile needs."""

    first: tuple[float, float]
    """Ideal position of the first node."""
    origin: NDArray[np.float64]
    """A whole shift (x, y) that is not in `nodes`: what is left is small enough for single precision."""
    nodes: NDArray[np.float32]
    """(rows, columns, 2): real minus ideal position minus `origin`."""
    residual: float
    """Worst difference between interpolation and field, pixels."""


@lru_cache(maxsize=256)
def field_grid(field: ImageField, size: tuple[int, int], tolerance: float) -> FieldGrid:
    """The widest spacing whose bilinear interpolation misses the field by less than the tolerance.

    It is tried at intervals spread over the image, and wherever the field declares a break. Breaks at equal distances
    get nodes on them; others make the spacing as narrow as the bend asks for.
    """
    bounds = _ideal_bounds(field, size)
    phases, spacings = [], []
    for breaks in _breaks(field):
        gaps = np.diff(breaks)
        even = len(gaps) > 0 and np.ptp(gaps) <= 1e-9 * gaps[0]
        widest = min(_WIDEST, float(gaps.min())) if len(gaps) else _WIDEST
        phases.append(float(breaks[0]) if even else 0.0)
        spacings.append(widest if even else 2.0 ** np.floor(np.log2(widest)))
    while True:
        along_x, along_y, worst, stretch = _try_out(field, size, bounds, phases, spacings)
        if worst <= tolerance / _BESIDE or min(spacings) <= _NARROWEST:
            break
        share = min(tolerance / 3, max(along_x, along_y))
        finer = [0.5 if len(breaks) else 0.5**0.5 for breaks in _breaks(field)]
        cut = [max(s * f, _NARROWEST) for s, f in zip(spacings, finer)]
        spacings = [c if miss >= share else s for c, s, miss in zip(cut, spacings, (along_x, along_y))]
    return FieldGrid(
        field=field,
        size=size,
        phase=(phases[0], phases[1]),
        spacing=(spacings[0], spacings[1]),
        bounds=bounds,
        stretch=stretch,
        miss=_BESIDE * worst,
    )


def _breaks(field: ImageField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    breaks = field.breaks
    if breaks is None:
        return np.empty(0), np.empty(0)
    return np.asarray(breaks.columns, float), np.asarray(breaks.rows, float)


def _ideal_bounds(field: ImageField, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Ideal positions of the image's outer edge, and a little more: the edge is sampled."""
    t = np.linspace(0.0, 1.0, 257)[:, None]
    corners = np.array([(-0.5, -0.5), (size[0] - 0.5, -0.5), (size[0] - 0.5, size[1] - 0.5), (-0.5, size[1] - 0.5)])
    edge = np.concatenate([a + t * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])
    ideal = field.inverse(edge)
    low, high = np.nanmin(ideal, axis=0), np.nanmax(ideal, axis=0)
    margin = 2.0 + 1e-3 * (high - low)
    (x0, y0), (x1, y1) = (low - margin).tolist(), (high + margin).tolist()
    return x0, y0, x1, y1


def _try_out(
    field: ImageField,
    size: tuple[int, int],
    bounds: tuple[float, float, float, float],
    phases: list[float],
    spacings: list[float],
) -> tuple[float, float, float, float]:
    """Misses along x, along y and anywhere, and the largest stretch, at intervals spread over the bounds."""
    axes, fractions = [], []
    for axis, breaks in enumerate(_breaks(field)):
        spread = np.linspace(bounds[axis], bounds[axis + 2], _SAMPLES)
        some = breaks[:: max(1, len(breaks) // _SAMPLES)]
        some = some[(some > bounds[axis]) & (some < bounds[axis + 2])]
        first = np.unique(np.floor((np.r_[spread, some] - phases[axis]) / spacings[axis]))
        lattice, fraction = _probed(phases[axis] + spacings[axis] * first, spacings[axis], breaks)
        axes.append(lattice.ravel())
        fractions.append(fraction)
    shifts, used = _shifts(field, size, spacings, *axes)
    corners = (shifts[::3, ::3], shifts[::3, 2::3], shifts[2::3, ::3], shifts[2::3, 2::3])
    probes = (shifts[::3, 1::3], shifts[1::3, ::3], shifts[1::3, 1::3])
    along_x, along_y, middle = _misses(corners, probes, (fractions[0], fractions[1]), used[1::3, 1::3])
    by_x, by_y = (corners[1] - corners[0]) / spacings[0], (corners[2] - corners[0]) / spacings[1]
    stretch = 1.0 + float(np.maximum(np.abs(by_x), np.abs(by_y)).sum(axis=-1).max())
    return along_x, along_y, max(along_x, along_y, middle), stretch


def _probed(
    first: NDArray[np.float64], spacing: float, breaks: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Intervals (n, 3): first node, probe, last node; and where the probe lies between them.

    The probe is the middle, or the break nearest to it if there is one inside.
    """
    fraction = np.full(len(first), 0.5)
    if len(breaks):
        middle = first + 0.5 * spacing
        after = np.clip(np.searchsorted(breaks, middle), 1, len(breaks) - 1) if len(breaks) > 1 else 0
        before = np.maximum(np.asarray(after) - 1, 0)
        nearest = np.where(np.abs(breaks[before] - middle) < np.abs(breaks[after] - middle), before, after)
        at = (breaks[nearest] - first) / spacing
        fraction = np.where((at > 1e-9) & (at < 1 - 1e-9), at, 0.5)
    return np.stack([first, first + fraction * spacing, first + spacing], axis=1), fraction


def _shifts(
    field: ImageField, size: tuple[int, int], near: Sequence[float], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Real minus ideal positions on a lattice, (rows, columns, 2), and which places lie in the image or `near`."""
    ideal = np.stack(np.broadcast_arrays(x[None], y[:, None]), axis=-1)
    real = field(ideal)
    used = (real > np.subtract(-0.5, near)) & (real < np.add(np.subtract(size, 0.5), near))
    return real - ideal, np.asarray(used.all(axis=-1))


def _misses(
    corners: tuple[Any, ...],
    probes: tuple[Any, ...],
    fractions: tuple[NDArray[np.float64], NDArray[np.float64]],
    used: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Worst miss of bilinear interpolation: on cells' upper sides, left sides, and inside; shape (3,).

    corners: upper left, upper right, lower left, lower right; probes: upper side, left side, inside. Cells that are not
    `used` do not count.
    """
    a, b, c, d = corners
    fx, fy = fractions[0][None, :, None], fractions[1][:, None, None]
    upper, left = a + fx * (b - a), a + fy * (c - a)
    inside = upper + fy * (c + fx * (d - c) - upper)
    places = zip((upper, left, inside), probes)
    return np.array([np.hypot(*np.moveaxis((g - p)[used], -1, 0)).max(initial=0.0) for g, p in places])
