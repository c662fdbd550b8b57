"""Targets of perspective views and panoramas."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import CentralCamera, project
from photoplan.cameras.curvature import EarthBend, Exaggeration, Warp
from photoplan.cameras.framed import taken_apart
from photoplan.errors import UsageError
from photoplan.geometry.grid import Placement, Window
from photoplan.geometry.pose import Pose, dot

#: Rays that are bent are followed in at most so many pieces.
MOST_PIECES = 64
#: Tangents by which columns of a picture may differ from vertical planes: they are some roundings.
_UPRIGHT = 1e-13
#: Rays of a window that are looked at to find out how many pieces are needed.
_SAMPLE = 49
#: Part of a pixel by which rays may be off, where that is more than the tolerance in metres.
_PART = 0.01
#: Heights between which any ground lies, of the earth and of other bodies, metres.
_HEIGHTS = (-12_000.0, 30_000.0)
#: From so many rays on their places are polynomials of the direction; the degrees that are tried; and the length of the
#: mean of unit directions below which they are too wide for that.
_MANY, _DEGREES, _NARROW = 2000, (3, 5, 7), 0.8


def _stations(reach: float, pieces: int) -> NDArray[np.float64]:
    """Distances at which pieces of a ray end: the further away, the longer, since a pixel is larger there."""
    return reach * (np.arange(1, pieces + 1) / pieces) ** 2


def _turned(tangents: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit directions (n, 3) of tangents (n, 2) about the first of three axes (rows)."""
    ways = axes[0] + tangents @ axes[1:]
    return np.asarray(ways / np.sqrt(dot(ways, ways))[:, None])


@lru_cache
def _nodes(
    degree: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Places at which polynomials are fitted and checked (n, 2), what solves them, and their powers at the latter."""
    nodes = np.cos(np.pi * (np.arange(degree + 3) + 0.5) / (degree + 3))
    others = np.cos(np.pi * np.arange(degree + 4) / (degree + 3))
    fitted, checked = (np.asarray(np.stack(np.meshgrid(n, n), axis=-1).reshape(-1, 2), float) for n in (nodes, others))
    return fitted, checked, np.asarray(np.linalg.pinv(_powers(fitted, degree)), float), _powers(checked, degree)


def _powers(x: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Products of powers (n, terms) of two variables (n, 2), up to a degree."""
    u, v = np.polynomial.chebyshev.chebvander(x.T, degree)
    return np.stack([u[:, i] * v[:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


class Bundle(Protocol):
    """Straight rays from one point through the pixels of a picture, in Cartesian space."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture, pixels."""
        ...

    @property
    def center(self) -> NDArray[np.float64]:
        """The point, shape (3,)."""
        ...

    @property
    def upright(self) -> bool:
        """Whether each column lies in a vertical plane, and the rays of a row are equal but for a factor of their level
        part; the first row is the uppermost."""
        ...

    def directions(self, uv: ArrayLike) -> NDArray[np.float64]:
        """What is added to the point per unit of depth at pixels (..., 2), shape (..., 3); NaN: no ray."""
        ...

    def pixels(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Pixel and depth (..., 3) of points (..., 3); NaN where no ray leads there."""
        ...


class Posed(CentralCamera, Protocol):
    """A camera whose rays are straight, and which has an axis."""

    @property
    def pose(self) -> Pose:
        """Its exterior orientation."""
        ...

    def directions(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Directions (..., 3) of the rays of image points (..., 2), as long as it takes to go one metre into depth."""
        ...

    def turned(self, R: NDArray[np.float64], longer: float) -> Posed:
        """It with its axes turned by R, shape (3, 3), about themselves, and a camera constant that is longer."""
        ...

    def moved(self, aside: float) -> Posed:
        """It from so many metres to the right along the rows of its picture."""
        ...


@dataclass(frozen=True, eq=False)
class FrameBundle:
    """The rays of a frame camera with its lens; depth is that along its axis."""

    camera: Posed

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture, pixels."""
        return self.camera.size

    @property
    def center(self) -> NDArray[np.float64]:
        """Projection centre."""
        return self.camera.center

    @property
    def upright(self) -> bool:
        """That of a level camera without roll, lens and shear: looked at in five columns and rows."""
        u, v = (np.linspace(-0.5, side - 0.5, 5) for side in self.size)
        d = self.directions(np.stack(np.meshgrid(u, v), axis=-1))
        apart = max(np.abs(d[..., :2] - d[:1, :, :2]).max(), np.abs(d[..., 2] - d[:, :1, 2]).max())
        return bool(apart < _UPRIGHT and d[0, 0, 2] > d[-1, 0, 2])

    @property
    def _axis(self) -> NDArray[np.float64]:
        """The direction of view."""
        return np.asarray(-self.camera.pose.R_ground_camera[:, 2])

    def directions(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Directions (..., 3) whose part along the axis is one."""
        return self.camera.directions(uv)

    def pixels(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Pixel and depth (..., 3); NaN at and behind the camera's plane."""
        XYZ = np.asarray(XYZ, float)
        return np.concatenate([project(self.camera, XYZ), ((XYZ - self.center) @ self._axis)[..., None]], axis=-1)


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """A picture as it is seen from a point: pixels of a bundle of rays, which warps may bend."""

    bundle: Bundle
    center: NDArray[np.float64]
    """The point of view in map coordinates, shape (3,)."""
    warps: tuple[Warp, ...] = ()
    """What leads from the map to the Cartesian space of the bundle: exaggeration, refraction, a round earth."""
    bend: float = 0.0
    """What straight rays of the bundle rise on the map, nearly, per squared distance, 1/m: it decides into how many
    pieces rays are cut, not where they are."""
    breaks: None = field(default=None, init=False)
    """It is nowhere bent."""

    @classmethod
    def of_camera(cls, camera: CentralCamera) -> ViewTarget:
        """What a camera sees, with its lens, curvature and refraction as they are.

        Raises
        ------
        UsageError
            Its rays do not meet in a point.
        """
        parts = taken_apart(camera)
        if parts is None:
            raise UsageError(f"a view from {type(camera).__name__}; its rays do not meet in a point")
        straight, warps, curvature = parts
        return cls(FrameBundle(straight), camera.center, warps, curvature / 2)

    def moved(self, aside: float) -> ViewTarget:
        """A plane picture from so many metres to the right along its rows; its axes and warps stay."""
        assert isinstance(self.bundle, FrameBundle)
        camera = self.bundle.camera.moved(aside)
        return replace(self, bundle=FrameBundle(camera), center=self._on_map(camera.center))

    @property
    def upright(self) -> bool:
        """Whether the columns of the picture are vertical planes on the map, see `Bundle.upright`."""
        return self.bundle.upright and all(isinstance(warp, EarthBend | Exaggeration) for warp in self.warps)

    @property
    def window(self) -> Window:
        """All pixels of the picture."""
        return Window(0, 0, *self.bundle.size)

    @property
    def placement(self) -> Placement:
        """A picture lies on no map."""
        return Placement(self.bundle.size)

    def to_ground(self, uvh: ArrayLike) -> NDArray[np.float64]:
        """Pixels and depth (..., 3) to map coordinates (..., 3); NaN where there is no ray."""
        uvh = np.asarray(uvh, float)
        return self._on_map(self.bundle.center + uvh[..., 2:] * self.bundle.directions(uvh[..., :2]))

    def to_view(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map coordinates (..., 3) to pixel and depth (..., 3), whether anything is in between or not; the inverse."""
        return self.bundle.pixels(self.to_cartesian(XYZ))

    def to_cartesian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map coordinates (..., 3) to the space of the bundle, where rays are straight."""
        p = np.asarray(XYZ, float)
        for warp in self.warps:
            p = warp(p)
        return p

    def distance(self, uvh: ArrayLike) -> NDArray[np.float64]:
        """Length of the ray to places (..., 3), shape (...), metres of the bundle's space."""
        uvh = np.asarray(uvh, float)
        ways = self.bundle.directions(uvh[..., :2])
        return np.asarray(uvh[..., 2] * np.sqrt(dot(ways, ways)))

    def rays(self, ways: NDArray[np.float64], reach: float, tolerance: float) -> NDArray[np.float64]:
        """Rays on the map, less what `bend` raises them: for `Terrain.first_hit`.

        Parameters
        ----------
        ways : ndarray, shape (n, 3)
            Their directions, of whatever length, see `Bundle.directions`.
        reach : float
            Their length, metres.
        tolerance : float
            By how much a ray may leave the pieces of its path, measured at their middles, metres.

        Returns
        -------
        ndarray, shape (n, k, 3)
        """
        pieces = 1
        unit = ways / np.sqrt(dot(ways, ways))[:, None]
        if self.warps:
            sample = unit[:: max(1, len(unit) // _SAMPLE)]
            while pieces < MOST_PIECES and not self._is_close(sample, reach, pieces, tolerance):
                pieces *= 2
        return self._path(unit, _stations(reach, pieces), tolerance)

    def _is_close(self, unit: NDArray[np.float64], reach: float, pieces: int, tolerance: float) -> bool:
        """Whether pieces follow rays within the tolerance wherever there may be ground."""
        ends = np.append(0.0, _stations(reach, pieces))
        middles = (ends[1:] + ends[:-1]) / 2
        path, between = self._strict(unit, ends), self._strict(unit, middles)
        with np.errstate(invalid="ignore"):  # what lies on no map is at infinity
            off = np.linalg.norm(between - (path[:, 1:] + path[:, :-1]) / 2, axis=-1)
            off[~self._near_ground(between)] = 0.0
        return bool(np.nanmax(off / self._tolerances(middles, tolerance), initial=0.0) <= 1.0)

    def _near_ground(self, path: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether places of paths (..., 3) are as high as ground may be."""
        away = path[..., :2] - self.center[:2]
        height = path[..., 2] + self.bend * dot(away, away)
        return np.asarray((height > _HEIGHTS[0]) & (height < _HEIGHTS[1]))

    def _tolerances(self, along: NDArray[np.float64], tolerance: float) -> NDArray[np.float64]:
        """By how much rays may be off at distances (k,), metres: far away a part of a pixel is more."""
        middle = (np.array(self.bundle.size, float) - 1) / 2
        here, beside = self.bundle.directions(np.stack([middle, middle + np.array([1.0, 0.0])]))
        angle = float(np.linalg.norm(beside - here) / np.linalg.norm(here))
        return np.maximum(tolerance, (_PART * angle if np.isfinite(angle) else 0.0) * along)

    def _path(self, unit: NDArray[np.float64], along: NDArray[np.float64], tolerance: float) -> NDArray[np.float64]:
        """Places (n, k + 1, 3) on the map at distances (k,) of rays with unit directions (n, 3), and their start."""
        path = np.empty((len(along) + 1, len(unit), 3)).swapaxes(0, 1)
        path[:, 0] = self.center
        smooth = self._smooth(unit, along, tolerance) if self.warps and len(unit) > _MANY else None
        path[:, 1:] = self._strict(unit, along) if smooth is None else smooth
        return path

    def _strict(self, unit: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
        """Places (n, k, 3) of rays on the map, less what `bend` raises them."""
        path = self._on_map(self.bundle.center + along[:, None] * unit[:, None])
        if self.warps:
            away = path[..., :2] - self.center[:2]
            with np.errstate(invalid="ignore"):
                path[..., 2] -= self.bend * dot(away, away)
        return path

    def _smooth(
        self, unit: NDArray[np.float64], along: NDArray[np.float64], tolerance: float
    ) -> NDArray[np.float64] | None:
        """`_strict` by polynomials of the direction, to a tenth of the tolerance; None: there are none.

        The map is so smooth that a few hundred rays tell where ten thousands of one window are.
        """
        middle = unit.mean(axis=0)
        if not np.linalg.norm(middle) > _NARROW:
            return None
        axes = np.linalg.svd(middle[None])[2]
        axes[0] *= np.sign(axes[0] @ middle)
        t = unit @ axes.T
        t = t[:, 1:] / t[:, :1]
        low, high = t.min(axis=0), t.max(axis=0)
        half = np.maximum((high - low) / 2, 1e-9)
        x = (t - (low + high) / 2) / half
        most = self._tolerances(along, tolerance)[:, None] / 10.0
        for degree in _DEGREES:
            fitted, checked, solve, at_checked = _nodes(degree)
            known = [
                self._strict(_turned(n * half + (low + high) / 2, axes), along) - self.center for n in (fitted, checked)
            ]
            if not all(np.isfinite(places).all() for places in known):
                return None
            solved = solve @ known[0].reshape(len(fitted), -1)
            miss = (at_checked @ solved).reshape(known[1].shape) - known[1]
            if (np.abs(miss) <= most)[self._near_ground(known[1] + self.center)].all():
                return np.asarray((_powers(x, degree) @ solved).reshape(len(x), len(along), 3) + self.center)
        return None

    def _on_map(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        for warp in reversed(self.warps):
            points = warp.inverse(points)
        return points


@dataclass(frozen=True, eq=False)
class Panorama:
    """The rays of a panorama: columns are directions on the map, clockwise, at equal angles.

    On a cylinder (h = horizontal distance) verticals stay straight and rows are tangents of elevations; on a sphere (an
    equirectangular panorama, h = distance) rows are elevations at equal angles.
    """

    center: NDArray[np.float64]
    """The point of view, shape (3,)."""
    size: tuple[int, int]
    """Width and height, pixels."""
    azimuth: float
    """Direction of the middle, radians clockwise from north."""
    scale: float
    """Pixels per radian."""
    horizon: float
    """Row of the horizon."""
    spherical: bool = False
    upright: bool = field(default=True, init=False)
    """Columns are vertical planes."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0 and min(self.size) >= 1):
            raise UsageError(f"panorama of {self.size} pixels, {self.scale} per radian; positive numbers are needed")
        if self.size[0] > 2 * math.pi * self.scale * (1 + 1e-9):
            raise UsageError(f"panorama over {math.degrees(self.size[0] / self.scale):.6g}°; at most 360 are there")

    def directions(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Directions (..., 3): of horizontal length one on a cylinder, of length one on a sphere."""
        uv = np.asarray(uv, float)
        azimuth = self.azimuth + (uv[..., 0] - (self.size[0] - 1) / 2) / self.scale
        rise = (self.horizon - uv[..., 1]) / self.scale
        level, up = np.ones_like(rise), rise
        if self.spherical:
            level, up = np.where(np.abs(rise) <= math.pi / 2, np.cos(rise), np.nan), np.sin(rise)
        return np.stack([level * np.sin(azimuth), level * np.cos(azimuth), up], axis=-1)

    def pixels(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Pixel and depth (..., 3), columns within half a turn of the middle; NaN at the point of view itself."""
        away = np.asarray(XYZ, float) - self.center
        level = np.hypot(away[..., 0], away[..., 1])
        turn = np.arctan2(away[..., 0], away[..., 1]) - self.azimuth
        turn = (turn + math.pi) % (2 * math.pi) - math.pi
        with np.errstate(divide="ignore", invalid="ignore"):
            rise = np.arctan2(away[..., 2], level) if self.spherical else away[..., 2] / level
        h = np.linalg.norm(away, axis=-1) if self.spherical else level
        out = np.stack([(self.size[0] - 1) / 2 + self.scale * turn, self.horizon - self.scale * rise, h], axis=-1)
        out[~(h > 0)] = np.nan
        return out


#: Rays steeper than this, metres of height per metre on the map, are no part of a fan.
STEEPEST = 1e3


@dataclass(frozen=True, eq=False)
class Fan:
    """The rays of a window: those of a column lie in a vertical plane, straight but for the target's `bend`."""

    ways: NDArray[np.float64]
    """Directions of the columns on the map, of length one, shape (width, 2)."""
    level: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Metres on the map per metre of depth: what columns (width,) and rows (height,) have of it, to be multiplied."""
    rise: NDArray[np.float64]
    """Metres of height on the map per metre there, of the rows in a column whose own part of it is one, shape
    (height,); it falls from row to row."""
    rows: tuple[int, int]
    """The first of the rows that are not too steep, and the one after the last."""
    up: NDArray[np.bool_]
    """Whether the rays of a row do not go down where they start, shape (height,)."""

    @property
    def steeper(self) -> NDArray[np.float64]:
        """What `rise` is times in each column, shape (width,)."""
        return np.asarray(1.0 / self.level[0])


def fan_of(target: ViewTarget, window: Window, reach: float, tolerance: float) -> Fan | None:
    """Rays of a window as planes; None: they are none, or bent otherwise than `ViewTarget.bend`."""
    if not target.upright:
        return None
    # Of the whole picture, so that all windows have the same numbers.
    width, height = target.bundle.size
    u, v = np.arange(width, dtype=float), np.arange(height, dtype=float)
    down = target.bundle.directions(np.stack([np.zeros(height), v], axis=-1))
    rows = np.hypot(down[:, 0], down[:, 1])
    middle = v[np.argmax(np.nan_to_num(rows))]
    across = target.bundle.directions(np.stack([u, np.full(width, middle)], axis=-1))
    columns = np.hypot(across[:, 0], across[:, 1])
    with np.errstate(invalid="ignore"):
        flat = np.flatnonzero(np.abs(down[:, 2]) < STEEPEST * rows)
    if not len(flat):
        return None
    top, end = int(flat[0]), int(flat[-1]) + 1
    rise = np.full(height, np.nan)
    paths = target.rays(down[top:end], reach, tolerance)
    if paths.shape[1] != 2:
        return None
    gone = paths[:, 1] - paths[:, 0]
    rise[top:end] = gone[:, 2] / np.hypot(gone[:, 0], gone[:, 1])
    here, there = slice(window.row, window.stop[1]), slice(window.col, window.stop[0])
    first, last = (min(max(row - window.row, 0), window.height) for row in (top, end))
    return Fan(
        ways=across[there, :2] / columns[there, None],
        level=(columns[there] / columns[0], rows[here]),
        rise=rise[here],
        rows=(first, last),
        up=~(down[here, 2] < 0),
    )
