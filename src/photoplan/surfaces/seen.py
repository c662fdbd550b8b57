"""Profiles: the surface along a polyline, with a point wherever the surface bends (Ecker 1991, §5.4.4, fig. 5.9)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import CentralCamera
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.geometry.pose import dot
from photoplan.kernels.rays import LEFT
from photoplan.surfaces.base import Hits, Terrain
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.mesh import SNAP, on_grid
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.units import LineElement, Unit, UnitLayout
from photoplan.targets.map import Target
from photoplan.targets.view import Panorama, ViewTarget, fan_of

#: Breaks of a profile nearer than this, metres, are one …
SAME_PLACE = 1e-6
#: … and so are heights on both sides of a break nearer than this, metres.
SAME_HEIGHT = 1e-4


def profile(
    surface: HybridSurface | RasterSurface, polyline: ArrayLike, tolerance: float = 0.001
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Heights over a polyline, such that straight lines between them are the surface.

    There is a point at every vertex of the polyline and wherever it crosses a grid line, a line element or the edge of
    a triangle. Over a bilinear mesh the surface is a parabola: points are added until it is met to the tolerance.
    """
    line = _polyline(polyline)
    if not tolerance > 0:
        raise UsageError(f"tolerance {tolerance}; a height in metres above zero is needed")
    if isinstance(surface, HybridSurface):
        if surface.to_model_crs is not None:
            raise UsageError("profile over a model in another CRS; give the polyline in the model's CRS instead")
        cut = _cut_hybrid(surface, line)
    else:
        if surface.to_grid_crs is not None:
            raise UsageError("profile over a grid in another CRS; give the polyline in the grid's CRS instead")
        cut = _cut_raster(surface, line)
    return _between_breaks(surface, cut, tolerance)


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Parts of the polyline over which the surface does not bend, from a to b."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]

    @classmethod
    def of(cls, XY: NDArray[np.float64]) -> _Pieces:
        return cls(XY[:-1], XY[1:])

    @property
    def length(self) -> NDArray[np.float64]:
        return np.asarray(np.hypot(*(self.b - self.a).T))

    def at(self, t: float) -> NDArray[np.float64]:
        return self.a + t * (self.b - self.a)

    def cut(self, which: NDArray[np.int64], t: NDArray[np.float64]) -> _Pieces:
        """Broken at parts t of pieces `which`, but not into pieces without length."""
        near = SAME_PLACE / np.maximum(self.length, SAME_PLACE)[which]
        inside = (t > near) & (t < 1 - near)
        which, t = which[inside], t[inside]
        count = len(self.a)
        number = np.concatenate([np.arange(count), which])
        part = np.concatenate([np.zeros(count), t])
        order = np.lexsort((part, number))
        number, part = number[order], part[order]
        gap = np.append(True, (np.diff(number) != 0) | (np.diff(part) * self.length[number[1:]] > SAME_PLACE))
        number, part = number[gap], part[gap]
        start = self.a[number] + part[:, None] * (self.b - self.a)[number]
        last = np.append(np.diff(number) != 0, True)
        stop = np.where(last[:, None], self.b[number], np.roll(start, -1, axis=0))
        return _Pieces(start, stop)


def _polyline(polyline: ArrayLike) -> NDArray[np.float64]:
    XY = np.asarray(polyline, float)
    if XY.ndim != 2 or XY.shape[1] != 2 or not np.isfinite(XY).all():
        raise UsageError(f"polyline of shape {XY.shape}; finite X, Y of at least two points are needed")
    XY = XY[np.append(True, (np.diff(XY, axis=0) != 0).any(axis=1))] if len(XY) else XY
    if len(XY) < 2:
        raise UsageError("polyline without length; at least two different points are needed")
    return XY


def _element(XY: NDArray[np.float64]) -> LineElement:
    zero = np.zeros(len(XY))
    return LineElement(
        name="profile",
        kind="formline",
        code="",
        xyz=np.column_stack([XY, zero]),
        right=None,
        sigmas=zero,
        on_grid=np.zeros(len(XY), bool),
    )


def _cut_hybrid(surface: HybridSurface, XY: NDArray[np.float64]) -> _Pieces:
    """Broken at grid lines and at the edges of triangles."""
    layout = surface.source.layout
    meshes = np.zeros((layout.rows, layout.columns), np.int64)
    rough = _Pieces.of(on_grid(_element(XY), layout, meshes).xyz[:, :2])
    units: dict[tuple[int, int], Unit] = {}
    for shift in (SNAP / 10, -SNAP / 10):
        for column, row in np.unique(_unit_numbers(rough, layout, shift), axis=0):
            inside = 0 <= column < layout.columns and 0 <= row < layout.rows
            unit = surface.source.unit(int(column), int(row)) if inside else None
            if unit is not None:
                units[int(column), int(row)] = unit
                meshes[row, column] = unit.meshes
    pieces = _Pieces.of(on_grid(_element(XY), layout, meshes).xyz[:, :2])
    which, parts = [np.empty(0, np.int64)], [np.empty(0)]
    for shift in (SNAP / 10, -SNAP / 10):
        at = _unit_numbers(pieces, layout, shift)
        for (column, row), unit in units.items():
            here = np.flatnonzero((at == [column, row]).all(axis=1))
            if unit.faces is not None and here.size:
                number, t = _edge_cuts(unit, pieces.a[here], pieces.b[here], shift)
                which.append(here[number])
                parts.append(t)
    return pieces.cut(np.concatenate(which), np.concatenate(parts))


def _unit_numbers(pieces: _Pieces, layout: UnitLayout, shift: float) -> NDArray[np.int64]:
    """Column and row of the unit of each piece; along a border, the shift decides."""
    x, y = pieces.at(0.5).T
    at = np.stack([x - layout.left, layout.top - y], axis=1) / layout.side
    return np.floor(at + shift).astype(np.int64)


def _edge_cuts(
    unit: Unit, a: NDArray[np.float64], b: NDArray[np.float64], shift: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Pieces a–b, each in one mesh, against the edges of its triangles: number of the piece, and part of it."""
    faces = unit.faces
    assert faces is not None
    x, y = ((a + b) / 2).T
    at = np.stack([x - unit.left, unit.top - y], axis=1) / unit.width
    col, row = np.clip(np.floor(at + shift * unit.meshes), 0, unit.meshes - 1).astype(np.int64).T
    mesh = row * unit.meshes + col
    count = faces.start[mesh + 1] - faces.start[mesh]
    piece = np.repeat(np.arange(len(a)), count)
    face = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count) + faces.start[mesh][piece]
    corners = faces.vertices[faces.corners[face]][:, :, :2]
    start, step = a[piece], (b - a)[piece]
    found_piece, found = [], []
    for k in range(3):
        p, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        across = step[:, 0] * edge[:, 1] - step[:, 1] * edge[:, 0]
        away = p - start
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (away[:, 0] * edge[:, 1] - away[:, 1] * edge[:, 0]) / across
            s = (away[:, 0] * step[:, 1] - away[:, 1] * step[:, 0]) / across
        hit = (s > -1e-9) & (s < 1 + 1e-9) & (t > 0) & (t < 1)
        found_piece.append(piece[hit])
        found.append(t[hit])
    return np.concatenate(found_piece), np.concatenate(found)


def _cut_raster(surface: RasterSurface, XY: NDArray[np.float64]) -> _Pieces:
    """Broken at the lines between posts, and where the continued edge ends."""
    pieces = _Pieces.of(XY)
    size = surface.grid.size
    which, parts = [], []
    for axis, sign in ((0, 1.0), (1, -1.0)):
        a, b = (sign * (end[:, axis] - surface.origin[axis]) / surface.mesh[axis] for end in (pieces.a, pieces.b))
        low, high = np.minimum(a, b), np.maximum(a, b)
        first = np.clip(np.ceil(low), 0, size[axis]).astype(np.int64)
        last = np.clip(np.floor(high), -1, size[axis] - 1).astype(np.int64)
        count = np.maximum(last - first + 1, 0)
        number = np.repeat(np.arange(len(a)), count)
        post = np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count) + first[number]
        number = np.concatenate([number, np.tile(np.arange(len(a)), 2)])
        at = np.concatenate([post, np.repeat([-0.5, size[axis] - 0.5], len(a))])
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (at - a[number]) / (b - a)[number]
        good = np.isfinite(t)
        which.append(number[good])
        parts.append(t[good])
    return pieces.cut(np.concatenate(which), np.concatenate(parts))


def _between_breaks(
    surface: HybridSurface | RasterSurface, pieces: _Pieces, tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Points of the profile: over each piece a parabola through three heights inside it, where there is no doubt."""
    quarter, half, three = (surface.heights(pieces.at(t)) for t in (0.25, 0.5, 0.75))
    bend = 8 * (quarter - 2 * half + three)
    slope = 2 * (three - quarter) - bend
    begin = half - slope / 2 - bend / 4
    with np.errstate(invalid="ignore"):
        parts = np.ceil(np.sqrt(np.abs(bend) / (4 * tolerance)))
    parts = np.where(np.isfinite(parts), np.maximum(parts, 1), 1).astype(np.int64)
    number = np.repeat(np.arange(len(parts)), parts + 1)
    step = np.arange(len(number)) - np.repeat(np.cumsum(parts + 1) - parts - 1, parts + 1)
    t = step / parts[number]
    Z = begin[number] + t * (slope[number] + t * bend[number])
    lengths = pieces.length
    from_start = np.cumsum(lengths) - lengths
    distance = np.maximum.accumulate(from_start[number] + t * lengths[number])
    XY = pieces.a[number] + t[:, None] * (pieces.b - pieces.a)[number]
    keep = _distinct(Z, step == 0)
    return distance[keep], XY[keep, 0], XY[keep, 1], Z[keep]


def _distinct(Z: NDArray[np.float64], first: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points that are needed: one where two pieces meet at one height, none inside gaps."""
    lost = np.isnan(Z)
    keep = np.ones(len(Z), bool)
    same = np.append(False, (np.abs(np.diff(Z)) <= SAME_HEIGHT) | (lost[1:] & lost[:-1])) & first
    keep &= ~same
    inner_gap = lost & np.append(False, lost[:-1]) & np.append(lost[1:], False)
    return keep & ~inner_gap


#: How far one sees where terrain has no end, metres; and how deep the earth's surface reaches.
_FAR, _DEEP = 300_000.0, 12_000.0
#: Rays that are followed at once: each takes about half a kilobyte, and what stays near the processor is fast.
MOST_RAYS = 1 << 14
#: What is a little longer on the ground than on the map.
_STRETCH = 1.01


#: Steps of half a pixel.
_HALVES = (0.5, 0.0), (0.0, 0.5)
#: Cosine of the flattest incidence that sizes of pixels know.
_EDGE_ON = 1e-6
#: Places of shadows are lifted by this, metres, and part of their distance from the eye.
_LIFT, _LIFT_PART = 0.02, 1e-6
#: A photo shows a place if what is met first on its ray is no nearer than the place by more than this, of its distance.
_SAME = 1e-4


@dataclass(frozen=True, eq=False)
class Seen:
    """View buffer: content of pixels of a view, shape (n, …) or (height, width, …)."""

    XYZ: NDArray[np.float64]
    """Ground on the map, metres; NaN: sky."""
    uvh: NDArray[np.float64]
    """The pixels, with the depth that the view's target gives to this ground."""
    normal: NDArray[np.float64]
    """See `Hits.normal`."""
    towards: NDArray[np.float64]
    """Direction from the ground to the point of view, on the map, of length one."""
    owner: NDArray[np.int64]
    """0: terrain; else the number of an object, from one; −1: sky."""
    lost: NDArray[np.bool_]
    """Sky although the ray points downwards: it passes the border of the terrain, or a hole of it."""

    @property
    def incidence(self) -> NDArray[np.float64]:
        """Angle between the line of sight and the normal of what it meets, radians, 0 to π/2; NaN: sky."""
        return np.arccos(np.clip(dot(self.normal, self.towards), 0.0, 1.0))

    def part(self, rows: slice, cols: slice) -> Seen:
        """Some rows and columns."""
        return Seen(**{name: a[rows, cols] for name, a in vars(self).items()})

    def reshaped(self, *shape: int) -> Seen:
        """The same, with another first shape."""
        return Seen(**{name: a.reshape(*shape, *a.shape[1:]) for name, a in vars(self).items()})


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """Terrain, with objects if it has some, as the surface of views."""

    terrain: Terrain
    bounds: tuple[float, float, float, float] | None = None
    """Outer edges of the terrain; None: it has no end."""
    farthest: float = np.inf
    """Beyond this distance nothing is seen, metres."""
    bound: float = 0.01
    """Largest error of the ground across the line of sight, metres; it matters for rays that are not straight."""

    def __post_init__(self) -> None:
        if not (self.bound > 0 and self.farthest > 0):
            raise UsageError(f"error bound {self.bound} m, view to {self.farthest} m; positive numbers are needed")

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Depth of what each pixel of a window shows, shape (height, width), metres; NaN: sky."""
        return self.look(target, window).uvh[..., 2].astype(np.float32)

    def look(self, target: Target, window: Window) -> Seen:
        """Return what the pixels of a window show, shape (height, width, …).

        By a profile for each column where columns are vertical planes and the terrain is a grid of heights; else by a
        ray for each pixel. Both see the same.
        """
        if isinstance(target, ViewTarget) and isinstance(self.terrain, RasterSurface):
            seen = self._by_columns(self.terrain, target, window)
            if seen is not None:
                return seen
        v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        return self.at(target, np.stack([u, v], axis=-1).reshape(-1, 2)).reshaped(window.height, window.width)

    def at(self, target: Target, uv: NDArray[np.float64]) -> Seen:
        """Return what pixels (n, 2), whole or not, show.

        Raises
        ------
        UsageError
            The target is no view.
        """
        if not isinstance(target, ViewTarget):
            raise UsageError(f"terrain is seen in views, not in {type(target).__name__}")
        if len(uv) > MOST_RAYS:
            parts = [vars(self.at(target, part)) for part in np.array_split(uv, -(-len(uv) // MOST_RAYS))]
            return Seen(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
        ways = target.bundle.directions(uv)
        hits = self.terrain.first_hit(target.rays(ways, self._reach(target), self.bound / 2), target.bend)
        # The depth of the ray's own point: a hit lies beside it by the rounding of its pieces.
        away = target.to_cartesian(hits.XYZ) - target.bundle.center
        squared = dot(ways, ways)
        depth = dot(away, ways) / squared
        if np.isfinite(self.farthest):
            gone = depth * np.sqrt(squared) > self.farthest
            hits.XYZ[gone], hits.normal[gone], hits.owner[gone], depth[gone] = np.nan, np.nan, -1, np.nan
        return Seen(
            XYZ=hits.XYZ,
            uvh=np.column_stack([uv, depth]),
            normal=hits.normal,
            towards=_back(target, hits),
            owner=hits.owner,
            lost=(hits.owner < 0) & (ways[:, 2] < 0),
        )

    def in_shadow(self, target: ViewTarget, seen: Seen, sun: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Pixels whose ground looks away from the sun, in a direction (3,), or that something stands before."""
        dark = seen.normal @ sun <= 0
        ask = np.flatnonzero((~dark & (seen.owner >= 0)).ravel())
        start = seen.XYZ.reshape(-1, 3)[ask]
        start = start + np.array([0, 0, 1.0]) * (_LIFT + _LIFT_PART * target.distance(seen.uvh).ravel()[ask, None])
        away = 50_000.0
        if self.bounds is not None:
            xmin, ymin, xmax, ymax = self.bounds
            away = float(np.hypot(xmax - xmin, ymax - ymin))
        length = min(away / max(float(np.hypot(sun[0], sun[1])), 1e-6), 20_000 / max(float(sun[2]), 1e-6))
        hits = self.terrain.first_hit(np.stack([start, start + length * sun], axis=1))
        dark.ravel()[ask[np.isfinite(hits.along)]] = True
        return np.asarray(dark)

    def _by_columns(self, terrain: RasterSurface, target: ViewTarget, window: Window) -> Seen | None:
        """Return what pixels show, by profiles; None: they are of no use here."""
        reach = self._reach(target)
        fan = fan_of(target, window, reach, self.bound / 2)
        if fan is None:
            return None
        ends = target.center[:2] + min(reach, self.farthest) * fan.ways
        shown = terrain.fan_hit(target.center, ends, (fan.rise, fan.steeper), fan.rows, target.bend)
        if shown is None:
            return None
        XYZ, normal, towards, away, owner = shown
        uvh = np.empty(XYZ.shape)
        uvh[..., 0] = np.arange(window.col, window.stop[0])
        uvh[..., 1] = np.arange(window.row, window.stop[1])[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            uvh[..., 2] = away / fan.level[0] / fan.level[1][:, None]
        left, ground = owner == LEFT, owner == 0
        seen = Seen(XYZ=XYZ, uvh=uvh, normal=normal, towards=towards, owner=owner, lost=(owner < 0) & ~fan.up[:, None])
        if np.isfinite(self.farthest):
            gone = np.zeros(owner.shape, bool)
            gone[ground] = target.distance(uvh[ground]) > self.farthest
            XYZ[gone], normal[gone], towards[gone], uvh[gone, 2], owner[gone] = np.nan, np.nan, np.nan, np.nan, -1
            seen.lost[gone & ~fan.up[:, None]] = True
        if left.any():
            own = self.at(target, uvh[left][:, :2])
            for name, values in vars(seen).items():
                values[left] = getattr(own, name)
        return seen

    def _reach(self, target: ViewTarget) -> float:
        """Length at which rays have left the terrain, to its side or below it."""
        away = _FAR
        if self.bounds is not None:
            b = np.array(self.bounds).reshape(2, 2)
            away = float(np.linalg.norm(np.abs(b - target.center[:2]).max(axis=0))) + 1.0
        down = target.to_cartesian(target.center - (0.0, 0.0, abs(float(target.center[2])) + _DEEP))
        depth = float(np.linalg.norm(down - target.bundle.center))
        return _STRETCH * float(min(np.hypot(away, depth), max(self.farthest, depth)))


def _back(target: ViewTarget, hits: Hits) -> NDArray[np.float64]:
    """Directions of rays on the map where they end, backwards, of length one."""
    way = target.center - hits.XYZ
    way[:, 2] -= target.bend * dot(way[:, :2], way[:, :2])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(way / np.sqrt(dot(way, way))[:, None])


def pixel_size(target: ViewTarget, uvh: NDArray[np.float64]) -> NDArray[np.float64]:
    """Side of a square of the area that pixels (..., 3) cover at their depth, across the line of sight, metres."""
    flat, area = uvh.reshape(-1, 3), np.empty(uvh[..., 2].size)
    for start in range(0, len(flat), MOST_RAYS):
        uv = flat[start : start + MOST_RAYS, :2]
        here = target.bundle.directions(uv)
        (ax, ay, az), (bx, by, bz) = (np.moveaxis(target.bundle.directions(uv + s) - here, -1, 0) for s in _HALVES)
        # The solid angle of the pixel, times the squared distance, per unit of depth.
        x, y, z = np.moveaxis(here, -1, 0)
        volume = (ay * bz - az * by) * x + (az * bx - ax * bz) * y + (ax * by - ay * bx) * z
        area[start : start + MOST_RAYS] = 4 * np.abs(volume) / np.sqrt(dot(here, here))
    return np.asarray(np.abs(uvh[..., 2]) * np.sqrt(area).reshape(uvh.shape[:-1]))


def ground_size(target: ViewTarget, seen: Seen) -> NDArray[np.float64]:
    """Side of a square of the area that each pixel covers on what it shows, metres; NaN: sky; edge-on very large."""
    return np.asarray(pixel_size(target, seen.uvh) / np.sqrt(np.maximum(np.cos(seen.incidence), _EDGE_ON)))


def best_photos(cameras: Sequence[CentralCamera], seen: Seen, surface: SeenSurface) -> NDArray[np.uint16]:
    """The camera, counted from one, that sees the ground of each pixel best; 0: none sees it.

    Best is the one that is nearest, counted in its own pixels: the pixel in its middle, at that distance, is smallest.
    """
    shape = seen.owner.shape
    there = np.flatnonzero(seen.owner.ravel() >= 0)
    flat = {name: getattr(seen, name).reshape(-1, 3)[there] for name in ("XYZ", "normal")}
    targets = [ViewTarget.of_camera(camera) for camera in cameras]
    size = np.full((len(cameras), len(there)), np.inf)
    places: list[NDArray[np.float64]] = []
    for row, target in enumerate(targets):
        uvh = target.to_view(flat["XYZ"])
        places.append(uvh)
        half = np.array(target.bundle.size) / 2
        inside = (uvh[:, 2] > 0) & (np.abs(uvh[:, :2] + 0.5 - half) < half).all(axis=1)
        # By the distance alone: sizes on slopes change from mesh to mesh, and each photo shall paint a region.
        way = target.center - flat["XYZ"][inside]
        faces = (flat["normal"][inside] * way).sum(axis=1) > 0
        middle = pixel_size(target, np.append(half - 0.5, 1.0))
        size[row, inside] = np.where(faces, middle * np.linalg.norm(way, axis=1), np.inf)
    asked = np.zeros(size.shape, bool)
    while True:
        best = np.argmin(size, axis=0)
        open_ = np.isfinite(size[best, np.arange(len(there))]) & ~asked[best, np.arange(len(there))]
        if not open_.any():
            break
        for row in np.unique(best[open_]).tolist():
            at = np.flatnonzero(open_ & (best == row))
            uvh = places[row][at]
            found = surface.at(targets[row], uvh[:, :2]).uvh[:, 2]
            asked[row, at] = True
            size[row, at[found < uvh[:, 2] * (1 - _SAME)]] = np.inf
    owner = np.zeros(shape, np.uint16)
    seen_by = np.isfinite(size.min(axis=0, initial=np.inf))
    owner.reshape(-1)[there[seen_by]] = best[seen_by] + 1
    return owner


#: Lines are cut into steps of so many pixels in the picture and near it, and of so many elsewhere.
_STEP, _COARSE = 1.0, 64.0
#: Times that a change between seen and hidden is halved: places of changes are good to a sixteenth of a step.
_HALVINGS = 4
#: Points are asked this far above themselves, pixels; features that stand for more than a place, such as summits, more.
LIFT, LIFT_OF_POINTS = 0.1, 1.5
#: How far outside the picture lines are followed, pixels.
_BEYOND = 4.0
#: What a ray may be off at the distance of a point.
_SAME_SEEN_LINES = 1e-9


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines one after the other."""

    XYZ: NDArray[np.float64]
    """Vertices on the map, shape (n, 3); NaN height: on the ground."""
    line: NDArray[np.int64]
    """Number of the line of each vertex, ascending, shape (n,)."""


@dataclass(frozen=True, eq=False)
class SeenLines:
    """Visible parts of lines in a rendering."""

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
    """Test of visibility of places in a view."""

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
        """Return whether nothing is in the way of places (n, 3) that are at these pixels and depths."""
        out = np.zeros(len(XYZ), bool)
        with np.errstate(invalid="ignore"):
            ask = np.flatnonzero((uvh[:, 2] > 0) & (self.target.distance(uvh) <= self.surface.farthest))
        if not len(ask):
            return out
        above = XYZ[ask].copy()
        above[:, 2] += np.maximum(self.lift * pixel_size(self.target, uvh[ask]), 2 * self.surface.bound)
        place = self.target.to_view(above)
        met = self.surface.at(self.target, place[:, :2]).uvh[:, 2]
        out[ask] = ~(met < place[:, 2] * (1 - _SAME_SEEN_LINES))
        return out

    def points(self, XYZ: NDArray[np.float64]) -> SeenPoints:
        """Points (n, 3) as the picture shows them."""
        XYZ = self.draped(XYZ)
        uvh = self.target.to_view(XYZ)
        shown = self.inside(uvh[:, :2])
        shown[shown] = self.free(XYZ[shown], uvh[shown])
        return SeenPoints(XYZ, uvh[:, :2], self.target.distance(uvh), shown)

    def lines(self, lines: Lines) -> SeenLines:
        """Return what the picture shows of lines, each cut into the parts that are seen."""
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


_Floats = NDArray[np.float64]

#: Rows between the rays that look for ground in each column, pixels: what is less high and hangs in the sky is missed.
_COARSE_SKYLINE = 8
#: Halvings from there on: a thousandth of a pixel.
_HALVINGS_SKYLINE = 13


def skyline_of(target: ViewTarget, surface: SeenSurface, beyond: int = 0) -> Seen:
    """The highest ground of each column, by rising columns; `Seen.uvh` has the places in the picture.

    A column that shows no sky, or no ground, has none. Terrain without overhangs has one border between ground and
    sky in a vertical plane: it is found by halving.
    """

    def hit(x: _Floats, y: _Floats) -> NDArray[np.bool_]:
        return np.asarray(surface.at(target, np.stack([x, y], axis=-1)).owner >= 0)

    width, height = target.bundle.size
    rows = np.append(np.arange(-0.5 - beyond, height - 0.5 + beyond, _COARSE_SKYLINE), height - 0.5 + beyond)
    x = np.arange(-beyond, width + beyond, dtype=float)
    below, top = np.full(len(x), np.nan), np.full(len(x), rows[0])
    for before, row in zip(rows[:1].tolist() + rows[:-1].tolist(), rows.tolist()):
        todo = np.flatnonzero(np.isnan(below))
        if not len(todo):
            break
        met = todo[hit(x[todo], np.full(len(todo), row))]
        below[met], top[met] = row, before
    there = np.isfinite(below) & (below > rows[0])
    x, low, high = x[there], below[there], top[there]
    for _ in range(_HALVINGS_SKYLINE):
        middle = (low + high) / 2
        below_edge = hit(x, middle)
        low, high = np.where(below_edge, middle, low), np.where(below_edge, high, middle)
    return surface.at(target, np.stack([x, low], axis=-1))
