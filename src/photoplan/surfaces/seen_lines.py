"""Lines and points on or over terrain as a view shows them: which parts of them are seen, and where in the picture.

A line is cut finely enough for the picture, draped over the ground where it states no height, and asked point by point
whether anything is in the way of its ray; where that changes the place is found by halving. A point is asked a tenth of
a pixel above itself: rounding does not hide what lies on the ground, and a line on a crest is seen up to its end.
(Ecker 1991, §5.7.11, eq. 5.10–5.11 compares distances at five pixels, and has no answer along the horizon.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.surfaces.seen import SeenSurface, pixel_size
from photoplan.targets.panorama import Panorama
from photoplan.targets.view import ViewTarget

#: Lines are cut into steps of so many pixels in the picture and near it, and of so many elsewhere.
_STEP, _COARSE = 1.0, 64.0
#: Times that a change between seen and hidden is halved: places of changes are good to a sixteenth of a step.
_HALVINGS = 4
#: Points are asked this far above themselves, pixels; features that stand for more than a place, such as summits, more.
LIFT, LIFT_OF_POINTS = 0.1, 1.5
#: How far outside the picture lines are followed, pixels.
_BEYOND = 4.0
#: What a ray may be off at the distance of a point.
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines one after the other."""

    XYZ: NDArray[np.float64]
    """Vertices on the map, shape (n, 3); NaN height: on the ground."""
    line: NDArray[np.int64]
    """Number of the line of each vertex, ascending, shape (n,)."""


@dataclass(frozen=True, eq=False)
class SeenLines:
    """What a picture shows of lines."""

    uv: NDArray[np.float64]
    """Vertices in pixels, shape (n, 2)."""
    piece: NDArray[np.int64]
    """Number of the piece of each, ascending; a line has a piece for each part that is seen."""
    line: NDArray[np.int64]
    """Line of each piece."""


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points as a picture shows them, shape (n, …)."""

    XYZ: NDArray[np.float64]
    """With heights; NaN where there is no ground for one."""
    uv: NDArray[np.float64]
    """Pixels; NaN behind the camera."""
    distance: NDArray[np.float64]
    shown: NDArray[np.bool_]
    """In the picture, and nothing is in the way."""


@dataclass(frozen=True, eq=False)
class LinesOfSight:
    """What asks whether places are seen in a view."""

    target: ViewTarget
    surface: SeenSurface
    lift: float = LIFT
    """Pixels."""

    def draped(self, XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
        """Places (n, 3) with heights of the ground where they have none."""
        flat = np.isnan(XYZ[:, 2])
        if flat.any():
            XYZ = XYZ.copy()
            XYZ[flat, 2] = self.surface.terrain.heights(XYZ[flat, :2])
        return XYZ

    def inside(self, uv: NDArray[np.float64], beyond: float = 0.0) -> NDArray[np.bool_]:
        """Pixels (n, 2) that are in the picture, or so many pixels outside it."""
        with np.errstate(invalid="ignore"):
            size = np.array(self.target.bundle.size) + beyond
            return np.asarray(((uv >= -0.5 - beyond) & (uv <= size - 0.5)).all(axis=1))

    def free(self, XYZ: NDArray[np.float64], uvh: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether nothing is in the way of places (n, 3) that are at these pixels and depths."""
        out = np.zeros(len(XYZ), bool)
        with np.errstate(invalid="ignore"):
            ask = np.flatnonzero((uvh[:, 2] > 0) & (self.target.distance(uvh) <= self.surface.farthest))
        if not len(ask):
            return out
        above = XYZ[ask].copy()
        above[:, 2] += np.maximum(self.lift * pixel_size(self.target, uvh[ask]), 2 * self.surface.bound)
        place = self.target.to_view(above)
        met = self.surface.at(self.target, place[:, :2]).uvh[:, 2]
        out[ask] = ~(met < place[:, 2] * (1 - _SAME))
        return out

    def points(self, XYZ: NDArray[np.float64]) -> SeenPoints:
        """Points (n, 3) as the picture shows them."""
        XYZ = self.draped(XYZ)
        uvh = self.target.to_view(XYZ)
        shown = self.inside(uvh[:, :2])
        shown[shown] = self.free(XYZ[shown], uvh[shown])
        return SeenPoints(XYZ, uvh[:, :2], self.target.distance(uvh), shown)

    def lines(self, lines: Lines) -> SeenLines:
        """What the picture shows of lines, each cut into the parts that are seen."""
        XYZ, line, level = self._cut(lines)
        uvh = self.target.to_view(XYZ)
        near = self.inside(uvh[:, :2], _BEYOND)
        seen = near.copy()
        seen[near] = self.free(XYZ[near], uvh[near])
        follows = (line[1:] == line[:-1]) & ~self._wraps(uvh[:, :2])
        change = np.flatnonzero(follows & (seen[1:] != seen[:-1]) & near[1:] & near[:-1])
        at, last = self._changes(XYZ, level, seen, change)
        # A vertex that is seen, or the place where that changes: runs of them are pieces.
        order = np.concatenate([np.arange(len(XYZ)), change + 0.5])
        uv = np.concatenate([uvh[:, :2], at])
        use = np.concatenate([seen, last])
        breaks = np.concatenate([np.arange(len(XYZ))[1:][~follows] - 0.25])
        return _runs(order, uv, use, line, breaks)

    def _changes(
        self, XYZ: NDArray[np.float64], level: NDArray[np.bool_], seen: NDArray[np.bool_], change: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Pixels at which lines disappear or appear between a vertex and the next one, and whether each is there."""
        draped = level[change] | level[change + 1]
        first, second = XYZ[change], XYZ[change + 1]
        shown, hidden = np.where(seen[change, None], (first, second), (second, first))
        for _ in range(_HALVINGS):
            middle = (shown + hidden) / 2
            middle[draped, 2] = np.nan
            middle = self.draped(middle)
            free = self.free(middle, self.target.to_view(middle))[:, None]
            shown, hidden = np.where(free, middle, shown), np.where(free, hidden, middle)
        uv = self.target.to_view(shown)[:, :2]
        return uv, np.asarray(np.isfinite(uv).all(axis=1))

    def _wraps(self, uv: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Steps that lead round the back of a panorama."""
        bundle = self.target.bundle
        if not isinstance(bundle, Panorama):
            return np.zeros(max(len(uv) - 1, 0), bool)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.abs(np.diff(uv[:, 0])) > math.pi * bundle.scale)

    def _cut(self, lines: Lines) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
        """Vertices with more of them in between, their lines, and whether they lie on the ground."""
        angle = self._least_angle()
        XYZ, line, level = self.draped(lines.XYZ), lines.line, np.isnan(lines.XYZ[:, 2])
        for step, everywhere in ((_COARSE, True), (_STEP, False)):
            while True:
                parts = self._parts(XYZ, line, level, step * angle, everywhere)
                if not (parts > 1).any():
                    break
                XYZ, line, level = self._finer(XYZ, line, level, parts)
        return XYZ, line, level

    def _parts(
        self,
        XYZ: NDArray[np.float64],
        line: NDArray[np.int64],
        level: NDArray[np.bool_],
        angle: float,
        everywhere: bool,
    ) -> NDArray[np.int64]:
        """Parts into which each step from vertex to vertex is cut, so that none is longer than an angle by its
        distance from the eye."""
        # Where there is no ground its height does not matter, but the line may come back to it.
        a, way = np.where(np.isnan(XYZ), self.target.center, XYZ)[:-1], np.diff(XYZ, axis=0)
        way[np.isnan(way[:, 2]), 2] = 0.0
        length = np.linalg.norm(way, axis=1)
        # What lies on the ground need not be cut finer than the bound where that has a step.
        along = np.where(level[1:] | level[:-1], np.hypot(way[:, 0], way[:, 1]), length)
        with np.errstate(invalid="ignore", divide="ignore"):
            t = np.clip(np.nan_to_num(((self.target.center - a) * way).sum(axis=1) / length**2), 0, 1)
            nearest = np.linalg.norm(a + t[:, None] * way - self.target.center, axis=1)
            wanted = np.ceil(np.nan_to_num(length / (angle * np.maximum(nearest, 1e-3 * length)), posinf=1.0) - 1e-9)
        if not everywhere:
            near = self.inside(self.target.to_view(XYZ)[:, :2], _COARSE)
            wanted[~(near[1:] | near[:-1])] = 1
        wanted[(line[1:] != line[:-1]) | (along <= self.surface.bound)] = 1
        return np.clip(wanted, 1, 64).astype(np.int64)

    def _finer(
        self, XYZ: NDArray[np.float64], line: NDArray[np.int64], flat: NDArray[np.bool_], parts: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
        """With `parts` parts in each step; on the ground where a step has an end on it."""
        whose = np.repeat(np.arange(len(parts)), parts)
        k = np.arange(len(whose)) - np.repeat(np.cumsum(parts) - parts, parts)
        t = (k / parts[whose])[:, None]
        new = np.where(t == 0, XYZ[whose], XYZ[whose] * (1 - t) + XYZ[np.minimum(whose + 1, len(XYZ) - 1)] * t)
        level = np.where(k == 0, flat[whose], flat[whose] | flat[np.minimum(whose + 1, len(XYZ) - 1)])
        drape = level & (k > 0)
        if drape.any():
            new[drape, 2] = self.surface.terrain.heights(new[drape, :2])
        return (
            np.concatenate([new, XYZ[-1:]]),
            np.concatenate([line[whose], line[-1:]]),
            np.concatenate([level, flat[-1:]]),
        )

    def _least_angle(self) -> float:
        """The smallest angle that a pixel covers, radians."""
        width, height = self.target.bundle.size
        u, v = np.meshgrid(np.linspace(0, width - 1, 5), np.linspace(0, height - 1, 5))
        uvh = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
        with np.errstate(invalid="ignore"):
            angles = pixel_size(self.target, uvh) / self.target.distance(uvh)
        return max(float(np.nanmin(np.where(angles > 0, angles, np.nan))), 1e-7)


def _runs(
    order: NDArray[np.float64],
    uv: NDArray[np.float64],
    use: NDArray[np.bool_],
    line: NDArray[np.int64],
    breaks: NDArray[np.float64],
) -> SeenLines:
    """Pieces of consecutive vertices that are used; `breaks` are places between vertices where lines end."""
    at = np.concatenate([order, breaks])
    sort = np.argsort(at, kind="stable")
    kept = np.concatenate([use, np.zeros(len(breaks), bool)])[sort]
    run = np.cumsum(~kept)[kept]
    places = sort[kept]
    count = np.unique(run, return_counts=True)[1]
    whole = np.repeat(count > 1, count)
    run, places = run[whole], places[whole]
    _, first, piece = np.unique(run, return_index=True, return_inverse=True)
    owner = line[np.floor(at[places[first]]).astype(np.int64)] if len(first) else np.empty(0, np.int64)
    return SeenLines(uv[places], piece.reshape(-1).astype(np.int64), owner)
