"""Turbulent flights: what a trajectory does from line to line, apart from its smooth part."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera
from photoplan.cameras.line_look import LineLook
from photoplan.cameras.line_sight import FOUND, LineSight, to_sphere
from photoplan.cameras.line_straight import StraightFlight
from photoplan.cameras.line_track import LineTrack
from photoplan.geometry.body import BodyGround
from photoplan.geometry.motion import Course, rotations
from photoplan.geometry.near import NearGround

_Floats = NDArray[np.float64]
_Rows = NDArray[np.int64]
#: Lines between the knots of the smooth part, at least; twice as many, and so on, until it flies evenly.
_KNOTS = 128
#: Evenly: a point that stays in the line's way is met this much earlier or later than half way along, at most.
_EVEN = (0.6, 1.7)
#: What moves a pixel by less than this from where the smooth part has it is not worth a table.
_LEAST = 0.05
#: Lines whose largest shift is kept.
_BLOCK = 64
#: The lowest ground, metres: from there shifts are largest.
_LOWEST = -500.0
#: Shifts are looked for at columns as near as this to those that are asked for, in so many steps at most.
_NEAR, _TURNS = 0.05, 4
#: Lines at which it is told how often ground is seen.
_TOLD = 300
#: Rows by which the smooth part may bend between the points that enclose a piece of ground, and to which it is found.
_AROUND, _ROUGHLY = 16.0, 0.5
#: Parts begin and end at multiples of so many lines, so that pieces of ground beside each other have the same.
_SHARED = 256


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments at which points are seen."""

    point: _Rows
    """Number of the point, (k,), not decreasing."""
    xy: _Floats
    """Position in the image, (k, 2)."""


class _LineImage(Camera, Hashable, Protocol):
    """What is asked of an image of a line here."""

    @property
    def track(self) -> LineTrack: ...
    @property
    def look(self) -> LineLook: ...
    @property
    def ground(self) -> BodyGround: ...
    @property
    def near(self) -> NearGround: ...
    @property
    def sight(self) -> LineSight: ...
    def along(self, track: LineTrack) -> Self: ...
    def seen_from(self, P: _Floats, close: float = FOUND) -> _Floats: ...
    def moments(self, XYZ: ArrayLike) -> Moments: ...


_L = TypeVar("_L", bound=_LineImage)


@dataclass(frozen=True, eq=False)
class LineTremor(Generic[_L]):
    """A trajectory as a smooth one, and shifts against it that change from line to line (see `cameras.base.Tremor`)."""

    smooth: _L
    """As the smooth part of the trajectory would see the ground."""
    rough: _L
    """The whole."""
    largest: _Floats
    """Largest shifts along x and y of blocks of lines, the first before, the last behind the image, (k, 2), pixels."""

    def part(self, XYZ: _Floats) -> StraightPart | None:
        """See `Tremor`."""
        seen = self.smooth.seen_from(self.smooth.near(XYZ.reshape(-1, 3)), _ROUGHLY)[:, 1]
        seen = seen[np.isfinite(seen)]
        if not len(seen):
            return None
        rows = self._rows(float(seen.min()) - _AROUND, float(seen.max()) + _AROUND)
        # Lines whose orientation is not known are not looked at; between the lines their neighbours count, too.
        begin, end = self.rough.track.oriented
        first, last = max(rows[0], int(np.floor(begin))), min(rows[1], int(np.ceil(end)))
        if last <= first:
            return None
        first, last = max(first // _SHARED * _SHARED, int(np.floor(begin))), -(-last // _SHARED) * _SHARED
        return _straight_part(self.rough, first, min(last, int(np.ceil(end))))

    def _rows(self, low: float, high: float) -> tuple[int, int]:
        """First and last row at which anything can be seen that the smooth part sees from row `low` to `high` on."""
        begin = np.arange(len(self.largest)) * _BLOCK - _BLOCK
        far = self.largest[:, 1]
        some = (begin + _BLOCK + far >= low) & (begin - far <= high)
        if not some.any():
            return int(np.floor(low)), int(np.ceil(high))
        first = np.maximum(begin, low - far)[some].min()
        return int(np.floor(first)), int(np.ceil(np.minimum(begin + _BLOCK, high + far)[some].max()))

    def passages(self, P: _Floats) -> tuple[_Rows, _Floats, NDArray[np.bool_]]:
        """Where points (n, 3), from the origin of `rough.near`, pass through the line; see `LineSight.crossings`.

        From the first point to the last, and of each from the first row to the last.
        """
        near = self.smooth.seen_from(P + (self.rough.near.origin - self.smooth.near.origin))[:, 1]
        block = np.clip(np.nan_to_num(near) // _BLOCK + 1, 0, len(self.largest) - 1).astype(np.int64)
        reach = np.where(np.isfinite(near), self._local[block], -1)
        parts = [(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, bool))]
        for each in np.unique(reach[reach >= 0]).tolist():
            mine = np.flatnonzero(reach == each)
            point, rows, stays = self.rough.sight.crossings(P[mine], near[mine], each)
            parts.append((mine[point], rows, stays))
        point, rows, stays = (np.concatenate(column) for column in zip(*parts))
        order = np.lexsort((rows[:, 0], point))
        return point[order], rows[order], stays[order]

    def first(self, P: _Floats) -> tuple[_Rows, _Floats]:
        """The passage of each point that counts: number of the point (k,), and the rows between which it is (k, 2).

        That is the first by which it is on the other side at the next line, from the line before the image on; where
        there is none, the last before.
        """
        point, rows, stays = self.passages(P)
        point, rows = point[stays], rows[stays]
        line = np.floor(rows[:, 0])
        order = np.lexsort((np.where(line >= -1, line, 1e9 - line), point))
        point, rows = point[order], rows[order]
        one = np.r_[True, point[1:] != point[:-1]] if len(point) else np.empty(0, bool)
        return point[one], rows[one]

    def told(self, height: float) -> str:
        """See `Tremor`; of pixels spread over the image."""
        width, lines = self.rough.size
        rows = np.unique(np.linspace(0, lines - 1, _TOLD).round())
        columns = np.linspace(0, width - 1, 5)
        ground = self.rough.rays(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2), height)[0]
        ground = ground[np.isfinite(ground[:, 0])]
        x, y = self.largest[1:-1].max(axis=0)
        shaken = (
            f"a turbulent flight: lines lie up to {x:.1f} pixels beside, {y:.1f} before or behind the smooth course"
        )
        count = np.bincount(self.rough.moments(ground).point, minlength=len(ground)) if len(ground) else np.zeros(1)
        if not (count > 1).any():
            return f"{shaken}; no ground is seen twice"
        return (
            f"{shaken}; {100 * (count > 1).mean():.2g} % of the pixels show ground that is seen several times, up to "
            f"{count.max()} times: the first moment counts"
        )

    @cached_property
    def _local(self) -> _Rows:
        """Rows as far as which passages can lie from a block of lines, to powers of two, (k,)."""
        count = len(self.largest)
        away = np.maximum(np.abs(np.arange(count)[:, None] - np.arange(count)[None]) - 1, 0) * _BLOCK
        far = np.where(away <= self.largest[None, :, 1], self.largest[None, :, 1], 0.0).max(axis=1)
        return np.asarray(2 ** np.ceil(np.log2(np.maximum(far, 1.0) + 1.0)), np.int64)


@dataclass(frozen=True, eq=False)
class StraightPart:
    """Some lines against a flight that is straight and does not turn (see `cameras.base.TremorPart`).

    From there a point is met earlier or later by a time that grows with its distance, and at a column that does not
    depend on it: what is left of the trajectory is linear in the height.
    """

    smooth: StraightFlight
    rough: _LineImage
    rows: tuple[int, int]

    def shifts(self, columns: _Floats, rows: _Floats, heights: Sequence[float]) -> _Floats:
        """See `TremorPart`."""
        rough, ground = self.rough, self.rough.ground
        S, R = rough.track(rows)
        known = rough.track.is_oriented(rows) | (rows < 0.0) | (rows > rough.size[1] - 1.0)
        sea = np.linalg.norm(S, axis=1) - ground.height(S)
        wanted = np.broadcast_to(columns, (len(rows), len(columns)))
        S, real = np.repeat(S, len(columns), axis=0), wanted
        out = []
        for height in heights:
            radius = np.repeat(sea + self._lift(height), len(columns))
            for _ in range(_TURNS):
                tangents = rough.look.tangents(real.ravel()).reshape(*real.shape, 2)
                d = tangents @ np.swapaxes(R[:, :, :2], 1, 2) + R[:, None, :, 2]
                d = (d / np.linalg.norm(d, axis=2, keepdims=True)).reshape(-1, 3)
                seen = self.smooth.seen(S + to_sphere(S, d, radius)[:, None] * d).reshape(*real.shape, 2)
                miss = wanted - seen[..., 0]
                shift = np.stack([real - seen[..., 0], rows[:, None] - seen[..., 1]], axis=-1)
                real = real + miss
                if not (np.abs(miss) > _NEAR).any():
                    break
            out.append(np.where(known[:, None, None], shift, np.nan))
        return np.stack(out)

    def _lift(self, height: float) -> float:
        """Height above the ellipsoid of a height on the ground of the project, in the middle."""
        flight, ground = self.smooth, self.rough.ground
        S, d = flight.place[None], flight.R @ np.array([*flight.look.tangents(self._middle)[0], 1.0])
        d = d[None] / np.linalg.norm(d)
        below = S + to_sphere(S, d, np.linalg.norm(S, axis=1) - ground.height(S) + height)[:, None] * d
        lift = height + float((ground.height(below) - ground.to_map(below)[:, 2])[0])
        return lift if np.isfinite(lift) else height

    @property
    def _middle(self) -> _Floats:
        """Column in the middle of the line, (1,)."""
        return np.array([(self.rough.size[0] - 1) / 2])


@lru_cache(maxsize=64)
def _straight_part(rough: _LineImage, first: int, last: int) -> StraightPart:
    return StraightPart(_straightened(rough, first, last), rough, (first, last))


def smoothed(camera: _L) -> LineTremor[_L] | None:
    """A trajectory without what changes from line to line, and that; None: there is next to nothing of it."""
    knots = _KNOTS
    while True:
        smooth = camera.along(_smooth_track(camera.track, knots))
        largest, even = _largest(camera, smooth)
        if even or knots >= 2 * camera.track.lines:
            break
        knots *= 2
    return LineTremor(smooth, camera, largest) if largest[1:-1].max() > _LEAST else None


def _straightened(camera: _LineImage, first: int, last: int) -> StraightFlight:
    """Positions at an even speed and one attitude, as the lines from `first` to `last` have on average."""
    start, poses = camera.track.poses
    some = poses[first - start : last + 1 - start]
    place, q = some[:, :3].mean(axis=0), some[:, 3:].mean(axis=0)
    away = np.arange(first, last + 1.0) - (first + last) / 2
    return StraightFlight(
        look=camera.look,
        ground=camera.ground,
        lines=camera.track.lines,
        middle=(first + last) / 2,
        place=place,
        speed=away @ (some[:, :3] - place) / (away @ away),
        R=rotations(q[None])[0],
    )


def _smooth_track(track: LineTrack, knots: int) -> LineTrack:
    """Splines through the poses of all lines; its times are rows."""
    first, poses = track.poses
    begin, end = track.whole_rows
    from scipy.interpolate import make_lsq_spline  # noqa: PLC0415 - frame images start without it

    rows, poses = np.arange(begin, end + 1.0), poses[begin - first : end + 1 - first]
    origin = poses.mean(axis=0)
    inner = np.linspace(rows[0], rows[-1], max(1, len(rows) // knots) + 1)
    spline = make_lsq_spline(rows, poses - origin, np.r_[[inner[0]] * 3, inner, [inner[-1]] * 3], k=3)
    within = rows[0], rows[-1]

    def at(row: _Floats) -> _Floats:
        # Beyond its ends a spline swings.
        inside = np.clip(row, *within)
        return np.asarray(spline(inside) + origin + (row - inside)[:, None] * spline(inside, 1))

    return _by_rows(track, lambda row: at(row)[:, :3], lambda row: at(row)[:, 3:])


def _by_rows(track: LineTrack, positions: Course, attitudes: Course) -> LineTrack:
    """A trajectory whose times are rows."""
    return replace(
        track,
        knots=np.zeros(1),
        moments=np.zeros(1),
        rates=np.ones(1),
        positions=positions,
        attitudes=attitudes,
        known=(-1e9, 1e9),
        per_line=False,
    )


def _largest(camera: _LineImage, calm: _LineImage) -> tuple[_Floats, bool]:
    """Largest shifts of blocks of lines, (k, 2), and whether the smooth part flies evenly.

    The first block lies before the image, the last behind it.
    """
    rough, smooth = (LineSight(each.track, each.look) for each in (camera, calm))
    lines, columns = rough.track.lines, np.array([0.0, (rough.look.columns - 1) / 2, rough.look.columns - 1.0])
    rows = np.arange(-_BLOCK, (-(-lines // _BLOCK) + 1) * _BLOCK, dtype=float)
    y, x = np.repeat(rows, 3), np.tile(columns, len(rows))
    S, d = rough.rays(np.column_stack([x, y]))
    P = S + to_sphere(S, d, np.linalg.norm(S, axis=1) - camera.ground.height(S) + _LOWEST)[:, None] * d
    miss, column = smooth.across(P, y)
    slope = smooth.across(P, y + 1.0)[0] - miss
    usual = np.median(slope)
    shift = np.abs(np.column_stack([x - column, miss / np.where(slope * usual > 0.1 * usual**2, slope, usual)]))
    part = slope / usual
    even = bool((part > _EVEN[0]).all() and (part < _EVEN[1]).all())
    blocks = np.nan_to_num(shift).reshape(-1, 3 * _BLOCK, 2).max(axis=1)
    # Shifts are those of a straight flight from line to line; they hold to a tenth.
    return 1.1 * blocks + 0.01, even
