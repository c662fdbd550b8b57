"""Observation equations of facets: image pyramids, means, grey values, radiometry, curvature."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from photoplan.arrays import Floats, Floats32, Mask
from photoplan.cameras.base import Camera, project, tremor_of
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.facet_transfer import (
    CELL,
    add_radiometry,
    facet_curvatures,
    solve_radiometry,
    steepness,
    to_surface_grey,
    transfer,
)
from photoplan.kernels.facets import curvature_gradient
from photoplan.kernels.matching import box_means
from photoplan.matching.features import Grey


def means_around(values: NDArray[np.floating], patch: int) -> Floats:
    """Means over patches of patch × patch values, fewer at the border, shape (rows, columns); an even patch has one
    more before than behind."""
    out = np.empty(values.shape)
    box_means(np.ascontiguousarray(values, float), patch // 2, patch - patch // 2, out)
    return out


def smoothed(values: Floats32) -> Floats32:
    """Means of three by three."""
    padded = np.pad(values, 1, mode="edge")
    across = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
    return (across[:-2] + across[1:-1] + across[2:]) / np.float32(9)


def corners(facets: Mask) -> Mask:
    """Posts at the corners of any of these facets: shape (rows, columns) of (rows − 1, columns − 1)."""
    around = np.pad(facets, 1)
    return around[:-1, :-1] | around[:-1, 1:] | around[1:, :-1] | around[1:, 1:]


def away_from_border(seen: Mask, border: int, least: float) -> Mask:
    """Of what is seen of a block, what is `border` values away from its border and from what is not seen along that.

    Where less than the part `least` of what is seen would be left, the latter does not count. Holes do not, either:
    heights hang together around them. All of shape (rows, columns).
    """
    inner = np.zeros_like(seen)
    inner[border:-border, border:-border] = True
    inner &= seen
    if seen.all():
        return inner
    parts, _ = ndimage.label(~seen)
    edge = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    beside = ndimage.maximum_filter(np.isin(parts, edge[edge > 0]), 2 * border + 1)
    away: Mask = inner & ~beside
    return away if np.count_nonzero(away) >= least * np.count_nonzero(inner) else inner


#: Low-pass filters (Kaiser, Schmolla and Wrobel 1992, in Schlüter 2001, table 1), by how many pixels they span.
FILTERS = {
    3: np.array([1, 2, 1]) / 4,
    5: np.array([1, 4, 6, 4, 1]) / 16,
    # The printed coefficients add up to 0.999.
    11: np.array([51, 0, -87, 0, 298, 475, 298, 0, -87, 0, 51]) / 999,
}
#: Pixels of a block along a side.
_SIDE = 256


@dataclass(eq=False)
class Pyramid:
    """Levels of an image, read by windows; level 0 is the image. Safe to call from several threads.

    Pixel (i, j) of a level lies at (i, j)·2^level of the image: filters are symmetric about the pixels that are kept.
    """

    image: Grey
    span: int = 11
    """Pixels that the low-pass filter spans."""
    kept: int = 64 << 20
    """Bytes of blocks that are kept for the next window."""
    _blocks: OrderedDict[tuple[int, int, int], Floats32] = field(default_factory=OrderedDict, init=False, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def size(self, level: int) -> tuple[int, int]:
        """Width and height of a level."""
        width, height = self.image.size
        return ((width - 1) >> level) + 1, ((height - 1) >> level) + 1

    def read(self, level: int, window: Window) -> Floats32:
        """Grey values of any window of a level, shape (height, width); NaN where there are none."""
        if level == 0:
            return self.image.read(window)
        out = np.full((window.height, window.width), np.nan, np.float32)
        inside = window & Window(0, 0, *self.size(level))
        for row in range(inside.row // _SIDE, -(-inside.stop[1] // _SIDE)):
            for col in range(inside.col // _SIDE, -(-inside.stop[0] // _SIDE)):
                block = Window(col * _SIDE, row * _SIDE, _SIDE, _SIDE)
                part = block & inside
                out[part.slices(window)] = self._block(level, block)[part.slices(block)]
        return out

    def _block(self, level: int, block: Window) -> Floats32:
        key = level, block.col, block.row
        with self._lock:
            if key in self._blocks:
                self._blocks.move_to_end(key)
                return self._blocks[key]
        reach = self.span // 2
        finer = Window(
            2 * block.col - reach, 2 * block.row - reach, 2 * block.width + 2 * reach, 2 * block.height + 2 * reach
        )
        made = halved(self.read(level - 1, finer), FILTERS[self.span])
        with self._lock:
            self._blocks[key] = made
            while len(self._blocks) * _SIDE**2 * 4 > max(self.kept, 4 * _SIDE**2):
                # The oldest of the finest level: a block is made of four times as many pixels as one of a level finer.
                del self._blocks[min(self._blocks, key=lambda one: one[0])]
        return made


def halved(fine: Floats32, low_pass: Floats) -> Floats32:
    """Filter along rows and columns and keep every second pixel, the first of them where the filter first fits.

    Pixels without a value count nothing; where they have most of the weight there is none.
    """
    valid = np.isfinite(fine)
    values, whole = np.where(valid, fine, np.float32(0)), bool(valid.all())
    total = _along(_along(values, low_pass, 0), low_pass, 1)
    if whole:
        return total
    weight = _along(_along(valid.astype(np.float32), low_pass, 0), low_pass, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(weight > 0.6, total / weight, np.float32(np.nan))


def _along(values: Floats32, low_pass: Floats, axis: int) -> Floats32:
    count = (values.shape[axis] - len(low_pass) + 1 + 1) // 2
    out: Floats32 | None = None
    for k, share in enumerate(low_pass):
        if share:
            index = [slice(None), slice(None)]
            index[axis] = slice(k, k + 2 * count - 1, 2)
            part = values[tuple(index)] * np.float32(share)
            out = part if out is None else out + part
    assert out is not None
    return out


#: Posts around a window that are adjusted with it and belong to its neighbours: half a patch of the roughness, the
#: border of which nothing is learnt, and some more.
MARGIN = 24
#: Rays are followed for pixels this far apart, or closer where rays between them would be off by more than this part of
#: a grey facet; they are bent if straight ones would be.
_STEP, _OFF = 32, 0.001
#: Times by which pixels lie closer on a facet than on level ground from which on they are left out: on a wall, whose
#: grey values are finer than the facets of the map, or beside the edge of what hides the ground behind it.
_WALL = 3.0
#: Points along a side of a block that are projected to find its pixels, and heights: some may lie beyond where a line
#: has seen.
_POINTS, _HEIGHTS = 9, 5


@dataclass(frozen=True)
class Facets:
    """A block of height facets on a map: posts and, between them, finer grey facets."""

    left: float
    """X of the first post."""
    top: float
    """Y of the first post."""
    pitch: float
    """Side of a height facet, metres."""
    shape: tuple[int, int]
    """Rows and columns of posts, at least 2 each."""
    ratio: int
    """Grey facets along a side of a height facet."""

    def to_posts(self, XY: ArrayLike) -> Floats:
        """Map points (..., 2) to column and row of the posts."""
        XY = np.asarray(XY, float)
        return np.stack([(XY[..., 0] - self.left) / self.pitch, (self.top - XY[..., 1]) / self.pitch], axis=-1)

    def to_map(self, uv: ArrayLike) -> Floats:
        """Inverse of `to_posts`."""
        uv = np.asarray(uv, float)
        return np.stack([self.left + uv[..., 0] * self.pitch, self.top - uv[..., 1] * self.pitch], axis=-1)

    def sampled(self, values: Floats, XY: ArrayLike) -> Floats:
        """Values at the posts (..., rows, columns), bilinear at map points (n, m, 2) of a grid, shape (..., n, m);
        beyond the border those of the border."""
        uv = self.to_posts(XY)
        rows, columns = self.shape
        x, y = np.clip(uv[0, :, 0], 0, columns - 1), np.clip(uv[:, 0, 1], 0, rows - 1)
        i, j = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
        a, b = x - i, (y - j)[:, None]
        upper, lower = values.take(j, -2), values.take(j + 1, -2)
        upper = upper.take(i, -1) * (1 - a) + upper.take(i + 1, -1) * a
        lower = lower.take(i, -1) * (1 - a) + lower.take(i + 1, -1) * a
        return np.asarray(upper * (1 - b) + lower * b)

    @property
    def posts(self) -> Floats:
        """X, Y of all posts, shape (rows, columns, 2)."""
        v, u = np.mgrid[: self.shape[0], : self.shape[1]]
        return self.to_map(np.stack([u, v], axis=-1))


def facets_of(grid: MapGrid, window: Window, level: int, ratio: int, margin: int = MARGIN) -> Facets:
    """Facets of a level over a window of a map and `margin` posts around it.

    Posts of a level are every 2^level-th pixel of the map, counted from its first: the same for every window.
    """
    step = 1 << level
    first = np.array([window.col, window.row]) // step - margin
    last = -(-(np.array(window.stop) - 1) // step) + margin
    left, top = grid.to_map(first * step)
    columns, rows = (last - first + 1).tolist()
    return Facets(left=float(left), top=float(top), pitch=grid.resolution * step, shape=(rows, columns), ratio=ratio)


def levels_done(window: Window, coarsest: int, level: int, part: float) -> float:
    """How much of all levels of a window is done when so much of one is: they cost as much as they have facets."""
    sides = [(window.width / 2**k + 2 * MARGIN, window.height / 2**k + 2 * MARGIN) for k in range(coarsest + 1)]
    facets = [across * along for across, along in sides]
    return (sum(facets[level + 1 :]) + part * facets[level]) / sum(facets)


@dataclass(frozen=True, eq=False)
class View:
    """An image that takes part."""

    camera: Camera
    pyramid: Pyramid
    finer: int = 0
    """Levels by which its pixels are smaller than usual ones: it takes part reduced by as many more."""


@dataclass(frozen=True, eq=False)
class Relief:
    """A surface that pixels are carried to."""

    heights: Floats
    """At the posts, shape (rows, columns), metres."""
    bent: Floats
    """See `facet_transfer.facet_curvatures`."""
    steep: Floats
    """See `facet_transfer.steepness`."""

    @classmethod
    def of(cls, heights: Floats) -> Relief:
        """From heights at the posts."""
        rows, columns = heights.shape
        bent, steep = np.empty((2, rows, columns)), np.empty((-(-(rows - 1) // CELL), -(-(columns - 1) // CELL)))
        facet_curvatures(heights, bent)
        steepness(heights, steep)
        return cls(heights, bent, steep)


@dataclass(frozen=True, eq=False)
class Sight:
    """What a view has of a block: pixels of a window of one of its levels, and how their rays run."""

    raw: Floats32
    """Grey values, shape (h, w); NaN where there are none."""
    ways: Floats
    """Rays of every so many pixels, see `facet_transfer.transfer`; (m, n, 8)."""
    steps: tuple[int, int]
    """How many pixels to the right and down."""
    level: float
    """Height that is 0 for them, metres."""
    first: tuple[int, int]
    """Column and row of the first pixel."""
    places: Floats32 = field(default_factory=lambda: np.empty((0, 0, 4), np.float32))
    """Where the pixels lie on the surface, see `facet_transfer.transfer`."""
    on: Floats | None = None
    """Heights of the surface that they were carried to."""

    def onto(self, relief: Relief) -> Sight:
        """The same pixels, carried to a surface."""
        if self.on is relief.heights:
            return self
        places = np.empty((*self.raw.shape, 4), np.float32)
        transfer(self.ways, *self.steps, relief.heights - self.level, relief.bent, relief.steep, _WALL, places)
        return replace(self, places=places, on=relief.heights)


def look(view: View, level: int, facets: Facets, heights: tuple[float, float]) -> Sight | None:
    """Pixels of a level of a view that may look at a block between two heights, metres; None: there are none."""
    seen = pixels_between(view, level, facets, heights)
    return (
        None
        if seen is None
        else _followed(view.camera, seen[1], seen[0], level + view.finer, facets, _known(view, heights))
    )


def pixels_between(
    view: View, level: int, facets: Facets, heights: tuple[float, float]
) -> tuple[Window, Floats32] | None:
    """Window of a level of a view that may look at a block between two heights, metres, and its grey values, shape
    (h, w); None: there is none."""
    low, high = _known(view, heights)
    if not low < high:
        return None
    level += view.finer
    window = _window(view, level, facets, (low, high))
    if window.width < 2 or window.height < 2:
        return None
    raw = view.pyramid.read(level, window)
    return (window, raw) if np.isfinite(raw).any() else None


def _known(view: View, heights: tuple[float, float]) -> tuple[float, float]:
    """The part of a range of heights that a view may see."""
    low, high = heights
    return max(low, view.camera.vantage.floor), min(high, float(view.camera.vantage.point[2]) - 1e-3)


def _window(view: View, level: int, facets: Facets, heights: tuple[float, float]) -> Window:
    """Pixels of a level around the positions of a block between two heights, inside the image."""
    rows, columns = facets.shape
    v, u = np.meshgrid(np.linspace(0, rows - 1, _POINTS), np.linspace(0, columns - 1, _POINTS), indexing="ij")
    XY = facets.to_map(np.stack([u, v], axis=-1)).reshape(-1, 2)
    XYZ = np.concatenate([np.column_stack([XY, np.full(len(XY), z)]) for z in np.linspace(*heights, _HEIGHTS)])
    xy = project(view.camera, XYZ) / 2**level
    xy = xy[np.isfinite(xy).all(axis=1)]
    if not len(xy):
        return Window(0, 0, 0, 0)
    width, height = view.pyramid.size(level)
    first = np.clip(np.floor(xy.min(axis=0)) - 1, 0, (width, height)).astype(int)
    last = np.clip(np.ceil(xy.max(axis=0)) + 2, 0, (width, height)).astype(int)
    size = np.maximum(last - first, 0)
    return Window(int(first[0]), int(first[1]), int(size[0]), int(size[1]))


def _followed(
    camera: Camera, raw: Floats32, window: Window, level: int, facets: Facets, levels: tuple[float, float]
) -> Sight:
    """Rays of a lattice of pixels, as fine along each axis as it takes for straight lines between them to be good."""
    size, first, scale = (window.width, window.height), np.array([window.col, window.row]), 2.0**level
    # Where a flight shakes each line of the image stands for itself.
    right, down = _STEP, _STEP if tremor_of(camera) is None else 1

    def cross(at: Floats, z: float) -> Floats:
        return facets.to_posts(_on_level(camera, (at + first) * scale, z))

    def worst(found: Floats, expected: Floats) -> float:
        return float(np.nanmax(np.abs(found - expected), initial=0.0)) * facets.ratio

    while True:
        x, y = (np.arange(max(2, -(-(n - 1) // step) + 1)) * step for n, step in zip(size, (right, down)))
        at = np.stack(np.meshgrid(x, y), axis=-1).astype(float)
        low, high = (cross(at, z) for z in levels)
        off = np.zeros(2)
        for nodes, z in ((low, levels[0]), (high, levels[1])):
            if right > 1:
                off[0] = max(
                    off[0], worst(cross(at[:, :-1] + np.array([right / 2, 0.0]), z), (nodes[:, :-1] + nodes[:, 1:]) / 2)
                )
            if down > 1:
                off[1] = max(off[1], worst(cross(at[:-1] + np.array([0.0, down / 2]), z), (nodes[:-1] + nodes[1:]) / 2))
        if (off <= _OFF).all():
            break
        right, down = (max(1, step // 2) if far > _OFF else step for step, far in zip((right, down), off))
    half, mean, way = (levels[1] - levels[0]) / 2, (low + high) / 2, (high - low) / 2
    # With heights t from -1 to 1: mean + bend (t² - 1), and way t + twist (t³ - t).
    bend, twist = np.zeros_like(mean), np.zeros_like(mean)
    inner = [sum(levels) / 2 + part * half for part in (-0.5, 0.5)]
    some = tuple(slice(None, None, max(1, n // _POINTS)) for n in at.shape[:2])
    if worst(cross(at[some], inner[1]), (mean + way / 2)[some]) > _OFF:
        below, above = (cross(at, z) for z in inner)
        bend, twist = (4 * mean - 2 * (below + above)) / 3, (4 * (way - above + below)) / 3
    coefficients = mean - bend, (way - twist) / half, bend / half**2, twist / half**3
    ways = np.concatenate(coefficients, axis=-1)
    first_pixel = window.col, window.row
    return Sight(raw=raw, ways=ways, steps=(right, down), level=sum(levels) / 2, first=first_pixel)


def _on_level(camera: Camera, xy: NDArray[Any], height: float) -> Floats:
    """X, Y where rays of image points (..., 2) come down to a height; NaN where they do not."""
    origin, direction = camera.rays(xy.reshape(-1, 2), height)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (height - origin[:, 2]) / direction[:, 2]
        XY = np.where(direction[:, 2:] < 0, origin[:, :2] + along[:, None] * direction[:, :2], np.nan)
    return XY.reshape(xy.shape)


#: Posts between nodes of the lattice of parameters.
PATCH = 24
#: What neighbouring nodes may differ by, parts of the contrast: weak, a patch of pixels knows its own far better.
_CHANGE = 0.02


@dataclass(frozen=True, eq=False)
class Transfer:
    """g = offset + gain · G for the grey values g of an image and G of the surface, bilinear over a lattice.

    Schlüter 2001, eq. 1 has h1 + h2 · g = G, hence h2 = 1/gain and h1 = −offset/gain.
    """

    offsets: Floats
    """At the nodes, shape (rows, columns)."""
    gains: Floats
    left: float
    top: float
    """X and Y of the first node."""
    pitch: float
    """Between nodes, metres."""

    def on(self, facets: Facets) -> Transfer:
        """The parameters at the lattice of other facets; beyond the border those of the border."""
        new = blank(facets)
        XY = new._nodes.posts
        offsets, gains = self._nodes.sampled(self.offsets, XY), self._nodes.sampled(self.gains, XY)
        return replace(new, offsets=offsets, gains=gains)

    def apply(self, sight: Sight, facets: Facets) -> Floats32:
        """Grey values of a view's pixels in the system of the surface, shape (h, w); NaN off the surface."""
        out = np.empty(sight.raw.shape, np.float32)
        to_surface_grey(sight.places, sight.raw, self.offsets, self.gains, self._lattice(facets), out)
        return out

    def improved(self, sight: Sight, facets: Facets, weights: Floats32, surface: Floats32, contrast: float) -> Transfer:
        """Least squares from grey values of the surface at the pixels' places (h, w) and their weights."""
        rows, columns = self.offsets.shape
        n = rows * columns
        system, right = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
        lattice = self._lattice(facets)
        add_radiometry(sight.places, sight.raw, weights, surface, (rows, columns), lattice, system, right)
        self._tie(system, right, contrast)
        solve_radiometry(system, right)
        offsets, gains = right[:n].reshape(rows, columns), right[n:].reshape(rows, columns)
        return replace(self, offsets=offsets, gains=np.maximum(gains, 0.05))

    @property
    def _nodes(self) -> Facets:
        rows, columns = self.offsets.shape
        return Facets(left=self.left, top=self.top, pitch=self.pitch, shape=(rows, columns), ratio=1)

    def _lattice(self, facets: Facets) -> tuple[float, float, float]:
        u, v = facets.to_posts((self.left, self.top))
        return float(u), float(v), self.pitch / facets.pitch

    def _tie(self, system: Floats, right: Floats, contrast: float) -> None:
        """Neighbours differ little; and what no pixel knows stays as it is."""
        rows, columns = self.offsets.shape
        n = rows * columns
        index = np.arange(n).reshape(rows, columns)
        pairs = np.concatenate([
            np.stack([index[:, :-1], index[:, 1:]], axis=-1).reshape(-1, 2),
            np.stack([index[:-1], index[1:]], axis=-1).reshape(-1, 2),
        ])  # fmt: skip
        for first, p in ((0, 1 / (_CHANGE * contrast) ** 2), (n, 1 / _CHANGE**2)):
            a, b = pairs.T + first
            np.add.at(system, (a, a), p)
            np.add.at(system, (b, b), p)
            np.add.at(system, (a, b), -p)
            np.add.at(system, (b, a), -p)
            every = np.arange(first, first + n)
            system[every, every] += 1e-6 * p
        right[:n] += 1e-6 * self.offsets.reshape(-1) / (_CHANGE * contrast) ** 2
        right[n:] += 1e-6 * self.gains.reshape(-1) / _CHANGE**2


def blank(facets: Facets) -> Transfer:
    """Offset 0 and gain 1 on the lattice of some facets: whichever block, its nodes lie at the same places."""
    pitch = PATCH * facets.pitch
    first, top = np.floor(facets.left / pitch + 1e-6), np.ceil(facets.top / pitch - 1e-6)
    right = facets.left + (facets.shape[1] - 1) * facets.pitch
    bottom = facets.top - (facets.shape[0] - 1) * facets.pitch
    columns = max(2, int(np.ceil(right / pitch - 1e-6) - first) + 1)
    rows = max(2, int(top - np.floor(bottom / pitch + 1e-6)) + 1)
    offsets, gains = np.zeros((rows, columns)), np.ones((rows, columns))
    return Transfer(offsets=offsets, gains=gains, left=first * pitch, top=top * pitch, pitch=pitch)


def first_guess(sights: Sequence[Sight], facets: Facets) -> list[Transfer]:
    """Parameters from means and contrasts of the pixels that lie on the surface."""
    found = []
    for sight in sights:
        values = sight.raw[np.isfinite(sight.raw) & np.isfinite(sight.places[..., 0])]
        found.append((float(values.mean()), float(values.std())) if values.size > 8 else (np.nan, np.nan))
    mean, contrast = np.nanmean(found, axis=0)
    out = []
    for own, spread in found:
        new = blank(facets)
        gain = spread / contrast if contrast > 0 and spread > 0.05 * contrast else 1.0
        out.append(replace(new, offsets=new.offsets + np.nan_to_num(own - gain * mean), gains=new.gains * gain))
    return out


def levelled(transfers: Sequence[Transfer]) -> list[Transfer]:
    """The same differences between images, with mean offset 0 and mean gain 1 at every node: what fixes the surface's
    own grey values."""
    offset = np.mean([t.offsets for t in transfers], axis=0)
    gain = np.mean([t.gains for t in transfers], axis=0)
    return [replace(t, offsets=t.offsets - t.gains * offset / gain, gains=t.gains / gain) for t in transfers]


#: Posts along a patch that has its own variances.
_PATCH = 24
#: Degrees of freedom of the curvatures.
_FREEDOM = 4.0
#: Steps to the usual size of the curvatures of a patch, each of which takes more than half of what is left of the way.
_STEPS = 5
#: The part with which the mean of a block takes part in the variances of each patch, and what these change at once.
_SHARED, _STEADY, _MOST = 0.25, 0.5, 64.0


@dataclass(frozen=True, eq=False)
class Smoother:
    """The normal equations of an adjustment."""

    solve: Callable[[Sequence[Floats]], Floats]
    """N⁻¹ of right-hand sides, shape (k, rows, columns)."""
    noise: Floats
    """A right-hand side of errors of the pixels, shape (rows, columns)."""
    inside: Mask
    """Posts that tell: seen by some images, and away from the border."""
    signs: Floats
    """Of the curvatures that are drawn, 1 or −1, shape (3, rows, columns)."""

    def mean(self, values: Floats, shared: float, wide: bool = False) -> Floats:
        """Means of what tells over patches, twice if `wide`, and in the part `shared` of the block, (rows, columns)."""
        number = max(float(np.count_nonzero(self.inside)), 1.0)
        telling = np.where(self.inside, values, 0.0)
        whole = float(telling.sum()) / number
        own, share = (_means(_means(part) if wide else part) for part in (telling, self.inside.astype(float)))
        few = 1.0 / _PATCH**2
        return np.asarray((1 - shared) * (own + few * whole) / (share + few) + shared * whole)


@dataclass(frozen=True, eq=False)
class Roughness:
    """Curvatures along columns, along rows and across, at the posts of a block."""

    squares: Floats
    """Their variances, shape (3, rows, columns), m²."""
    factors: Floats
    """Robust factors of their weights, the same shape; 0 where a curvature is not inside."""

    @classmethod
    def uniform(cls, shape: tuple[int, int], sigma: float) -> Roughness:
        """One standard deviation everywhere, metres."""
        return cls(np.full((3, *shape), sigma**2), _inside(shape).astype(float))

    def on(self, own: Facets, finer: Facets) -> Roughness:
        """The same variances at the posts of other facets, all curvatures counting alike."""
        return Roughness(own.sampled(self.squares, finer.posts), _inside(finer.shape).astype(float))

    @property
    def weights(self) -> Floats:
        """Of the curvatures, shape (3, rows, columns)."""
        return self.factors / self.squares

    def gradient(self, heights: Floats) -> Floats:
        """Half the gradient of the weighted sum of their squares, shape (rows, columns)."""
        out = np.empty(heights.shape)
        curvature_gradient(self.weights, heights, out)
        return out

    def around(self, heights: Floats) -> Roughness:
        """The same variances, with the robust factors of heights (rows, columns)."""
        found, inside = curvatures(heights) ** 2, self.factors > 0
        single = found / _usual(found, self.squares, inside)
        return Roughness(self.squares, np.where(inside, (_FREEDOM + 1) / (_FREEDOM + single), 0.0))

    def estimated(self, heights: Floats, smoother: Smoother) -> Roughness:
        """Variances with which the band around the smoothing length holds what it does in heights (rows, columns)."""
        mean = partial(smoother.mean, wide=True)
        seen, drawn, noise = (band**2 for band in self._bands(heights, smoother, 1)[0][0])
        usual = np.maximum(mean(drawn + noise, 0.0), 1e-300)
        weighed = seen * (_FREEDOM + 1) / (_FREEDOM + seen / usual)
        # In parts of what is usual at a place, all places count alike.
        change = mean((weighed - noise) / usual, _STEADY) / np.maximum(mean(drawn / usual, _STEADY), 1e-30)
        # Of smooth terrain it falls with the 2.5th power of the variance: whole steps would not settle.
        return Roughness(self.squares * np.sqrt(np.clip(change, 1 / _MOST, _MOST)), self.factors).around(heights)

    def sandwich(self, heights: Floats, smoother: Smoother, variances: Floats, stiffer: float) -> tuple[Floats, Floats]:
        """Variances of heights (rows, columns), of the pixels' noise and of what smoothing takes away.

        `variances` are the diagonals of N⁻¹ with these weights and with weights `stiffer` times as large, (2, rows,
        columns): how much they fall is the part N⁻¹ R N⁻¹ that independent curvatures would have. The real one is
        Σ B² P over wavelengths, if smoothing takes the part B of a power P. Of B² = (1 − B)² (B² + 2 B³ + 3 B⁴ + …)
        the first terms are seen in the smoothed surface; the others are those of independent curvatures, as many
        times as the third is.
        """
        whole = variances[0]
        prior = np.clip(-np.log(variances[1] / whole) / np.log(stiffer), 0.0, 1.0) * whole
        bands, taken = self._bands(heights, smoother, 2)
        mean = smoother.mean
        usual = np.maximum(mean(taken**2, 0.0), 1e-300)
        known, rest = np.zeros_like(prior), np.ones_like(prior)
        for n, (a, b) in enumerate(((0, 0), (0, 1), (1, 1))):
            seen, drawn, noise = (bands[a][k] * bands[b][k] / usual for k in range(3))
            # Of noise that happens to be less than it is expected to be, nothing is left.
            known += (n + 1) * np.maximum(mean(seen - noise, _SHARED), 0.0)
            rest -= (n + 1) * mean(drawn, _SHARED)
        times = mean(seen - noise, 1.0) / np.maximum(mean(drawn, 1.0), 1e-30)
        share = np.clip(known + np.maximum(times, 0.0) * np.maximum(rest, 0.0), 0.0, _MOST)
        return whole - prior, share * prior

    def _bands(self, heights: Floats, smoother: Smoother, count: int) -> tuple[list[Floats], Floats]:
        """(N⁻¹ R)ⁿ of a smoothed surface, n = 1 … count: of heights, and expected ones of independent curvatures and
        of noise, each of shape (3, rows, columns); and what smoothing takes away of the second, not yet smoothed."""
        drawn = _transposed(np.sqrt(self.weights) * smoother.signs)
        first, taken, noise = smoother.solve([self.gradient(heights), drawn, smoother.noise])
        again = smoother.solve([self.gradient(taken), self.gradient(noise)])
        bands = [np.stack([first, taken - again[0], again[1]])]
        for _ in range(count - 1):
            bands.append(smoother.solve([self.gradient(band) for band in bands[-1]]))
        return bands, taken


def _usual(found: Floats, least: Floats, inside: Mask) -> Floats:
    """What squares of curvatures usually are around each: the scale of Student's distribution that is most probable for
    those of a patch (by the EM algorithm, Lange, Little and Taylor 1989), not below `least`; all (3, rows, columns)."""
    share = np.maximum(np.stack([_means(part.astype(float)) for part in inside]), 1.0 / _PATCH**2)
    scale = least
    for _ in range(_STEPS):
        weighed = np.where(inside, found * (_FREEDOM + 1) / (_FREEDOM + found / scale), 0.0)
        scale = np.maximum(np.stack([_means(part) for part in weighed]) / share, least)
    return scale


def _transposed(c: Floats) -> Floats:
    """The transpose of `curvatures`, shape (rows, columns), for c that are 0 where they are not inside."""
    out = np.zeros(c.shape[1:])
    for shift, a in ((-1, 1.0), (0, -2.0), (1, 1.0)):
        out += a * np.roll(c[0], shift, axis=1) + a * np.roll(c[1], shift, axis=0)
    for k in range(4):
        out += (1.0 if k in (0, 3) else -1.0) * np.roll(c[2], (k // 2, k % 2), axis=(0, 1))
    return out


def curvatures(heights: Floats) -> Floats:
    """Second differences along columns, along rows and across, shape (3, rows, columns); 0 where not inside."""
    out = np.zeros((3, *heights.shape))
    out[0, :, 1:-1] = heights[:, 2:] - 2 * heights[:, 1:-1] + heights[:, :-2]
    out[1, 1:-1] = heights[2:] - 2 * heights[1:-1] + heights[:-2]
    out[2, :-1, :-1] = heights[:-1, :-1] - heights[:-1, 1:] - heights[1:, :-1] + heights[1:, 1:]
    return out


def _inside(shape: tuple[int, int]) -> Mask:
    """Which of `curvatures` are inside."""
    out = np.zeros((3, *shape), bool)
    out[0, :, 1:-1] = out[1, 1:-1] = out[2, :-1, :-1] = True
    return out


def _means(values: Floats) -> Floats:
    """Means around each post over squares of `_PATCH` posts, shape (rows, columns)."""
    return means_around(values, _PATCH)
