"""Scenes of the image formation model: shapes, test patterns and rendered surfaces, exact over small cells.

What a camera is needed for is its rays: frame and line cameras, fisheyes and maps seen from above alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import cos, pi, radians, sin
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.arrays import Floats, Floats32, Mask
from photoplan.cameras.base import Rays
from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import Hits, Terrain
from photoplan.surfaces.shifted import ray_paths

#: A side seen at less than this share of the other counts as none; the share is then wrong by less than that.
_THIN = 1e-7


def _over_cell(t: Floats, normal: tuple[float, float], side: float, first: _Wave, second: _Wave) -> Floats:
    """Mean over a square cell of a function of the distance t along a normal, from its first and second integrals.

    Seen along the normal a square is the convolution of two intervals, so the mean is a second difference.
    """
    long, short = sorted((abs(normal[0]) * side, abs(normal[1]) * side), reverse=True)
    if short < _THIN * long:
        return (first(t + long / 2.0) - first(t - long / 2.0)) / long
    outer, inner = (long + short) / 2.0, (long - short) / 2.0
    return (second(t + outer) - second(t + inner) - second(t - inner) + second(t - outer)) / (long * short)


_Wave = Callable[[Floats], Floats]


def edge_share(x: Floats, y: Floats, side: float, angle_deg: float) -> Floats:
    """Share to the right of a line through (0, 0) that is turned against the columns."""
    normal = (cos(radians(angle_deg)), sin(radians(angle_deg)))
    t = np.clip(normal[0] * x + normal[1] * y, -2.0 * side, 2.0 * side)
    return _over_cell(t, normal, side, lambda s: np.maximum(s, 0.0), lambda s: np.maximum(s, 0.0) ** 2 / 2.0)


def bar_share(x: Floats, y: Floats, side: float, period: float, angle_deg: float) -> Floats:
    """Share of bars that are half a period wide; a bar begins at (0, 0) and lies to its right."""
    normal = (cos(radians(angle_deg)), sin(radians(angle_deg)))
    half = period / 2.0

    def triangle(s: Floats) -> Floats:
        # Integral of the wave ±1 from 0; its mean is half / 2.
        inside = np.mod(s, period)
        return np.asarray(np.minimum(inside, period - inside))

    def parabolas(s: Floats) -> Floats:
        # Integral of the triangle less its mean: periodic.
        inside = np.mod(s, period)
        rest = np.maximum(inside - half, 0.0)
        falling = rest * half - rest**2 / 2.0
        rising = np.minimum(inside, half) ** 2 / 2.0
        return np.asarray(rising + falling - inside * half / 2.0)

    # The triangle's mean makes a term that is linear in s: it drops out of a second difference.
    mean = _over_cell(normal[0] * x + normal[1] * y, normal, side, triangle, parabolas)
    return 0.5 + 0.5 * mean


def sector_share(x: Floats, y: Floats, side: float, sectors: int) -> Floats:
    """Share of `sectors` bright sectors around (0, 0), as wide as the dark ones between them.

    Exact where no cell meets two borders; the cells at the middle are cut into 64 for that.
    """
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    share = _one_border(x, y, side, sectors)
    inner = np.hypot(x, y) < 1.5 * side / sin(pi / (2.0 * max(sectors, 1)))
    if inner.any():
        steps = (np.arange(8) - 3.5) * side / 8.0
        fine_x = x[inner][:, None, None] + steps[None, None, :]
        fine_y = y[inner][:, None, None] + steps[None, :, None]
        fine_x, fine_y = np.broadcast_arrays(fine_x, fine_y)
        share[inner] = _one_border(fine_x, fine_y, side / 8.0, sectors).mean((1, 2))
    return share


def _one_border(x: Floats, y: Floats, side: float, sectors: int) -> Floats:
    """Share of bright sectors in cells, each with regard to the nearest border only."""
    step = pi / sectors
    number = np.round(np.arctan2(y, x) / step)
    along = number * step
    normal_x, normal_y = -np.sin(along), np.cos(along)
    t = np.clip(normal_x * x + normal_y * y, -2.0 * side, 2.0 * side)
    a, b = np.abs(normal_x) * side, np.abs(normal_y) * side
    long, short = np.maximum(a, b), np.maximum(np.minimum(a, b), 1e-4 * side)
    outer, inner = (long + short) / 2.0, (long - short) / 2.0

    def second(s: Floats) -> Floats:
        return np.asarray(np.maximum(s, 0.0) ** 2 / 2.0)

    share = (second(t + outer) - second(t + inner) - second(t - inner) + second(t - outer)) / (long * short)
    return np.where(np.mod(number, 2) == 0, share, 1.0 - share)


def step_mean(x: Floats, side: float, steps: int, width: int) -> Floats:
    """Mean of a staircase from 0 to 1 with `steps` equal steps over `width`, x from its middle; outside its ends."""
    levels = np.arange(steps) / (steps - 1.0)
    borders = np.linspace(0.0, width, steps + 1)
    integral = np.concatenate([[0.0], np.cumsum(levels * width / steps)])

    def below(t: Floats) -> Floats:
        return np.asarray(np.interp(t, borders, integral) + np.maximum(t - width, 0.0))

    middle = x + width / 2.0
    return (below(middle + side / 2.0) - below(middle - side / 2.0)) / side


def disc_share(x: Floats, y: Floats, side: float, radius: float) -> Floats:
    """Share of cells that a disc around (0, 0) covers; the area of disc and square in closed form."""
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    distance = np.hypot(x, y)
    share = (distance < radius).astype(float)
    near = np.abs(distance - radius) <= side
    px, py, h = x[near], y[near], side / 2.0
    area = (
        _quarter(px + h, py + h, radius)
        - _quarter(px - h, py + h, radius)
        - _quarter(px + h, py - h, radius)
        + _quarter(px - h, py - h, radius)
    )
    share[near] = area / side**2
    return share


def _quarter(a: Floats, b: Floats, radius: float) -> Floats:
    """Area of the part of a disc with x ≤ a and y ≤ b."""
    a, b = np.clip(a, -radius, radius), np.clip(b, -radius, radius)
    level = np.abs(b)
    reach = np.sqrt(np.maximum(radius**2 - level**2, 0.0))
    # ∫ min(level, s(x)) dx from −radius to a, where s is half the chord: s outside ±reach, level between.
    capped = (
        _half_chords(np.minimum(a, -reach), radius)
        + level * (np.clip(a, -reach, reach) + reach)
        + _half_chords(np.maximum(a, reach), radius)
        - _half_chords(reach, radius)
    )
    return _half_chords(a, radius) + np.sign(b) * capped


def _half_chords(a: Floats, radius: float) -> Floats:
    """∫ √(r² − x²) dx from −r to a."""
    s = np.sqrt(np.maximum(radius**2 - a**2, 0.0))
    return (a * s + radius**2 * np.arcsin(np.clip(a / radius, -1.0, 1.0))) / 2.0 + pi * radius**2 / 4.0


#: Patterns by name: what their numbers mean, how many there may be, and those that are taken if none is given.
PATTERNS: dict[str, tuple[str, tuple[float, ...]]] = {
    "flat": ("the bright level everywhere", ()),
    "edge": ("ANGLE in degrees of the edge against the columns", (5.0,)),
    "bars": ("PERIOD in pixels, ANGLE in degrees of the bars against the columns", (8.0, 0.0)),
    "star": ("number of bright SECTORS", (36.0,)),
    "wedge": ("number of STEPS from dark to bright", (11.0,)),
    "discs": ("PITCH and DIAMETER in pixels, half the pitch if not given", (24.0, 0.0)),
}


class LightScene(Protocol):
    """What is imaged: mean values of cells, `oversampling` of them along each side of a pixel."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        ...

    @property
    def bands(self) -> int:
        """Number of bands."""
        ...

    @property
    def oversampling(self) -> int:
        """Cells along a side of a pixel."""
        ...

    @property
    def continuous(self) -> bool:
        """Whether the cells are means of a continuous scene; else the scene consists of even squares."""
        ...

    def cells(self, window: Window) -> Floats:
        """Cells of a window of pixels, shape (bands, height · k, width · k); it may reach beyond the image."""
        ...


@dataclass(frozen=True)
class PatternScene:
    """A test pattern of any extent, whose cells hold exact means; it goes on beyond the image.

    `edge`: bright to the right of a straight line. `bars`: half of each period bright, a bright bar begins at the
    middle. `star`: as many bright as dark sectors around the middle. `wedge`: steps from left to right. `discs`: dark
    discs on bright ground, one at the middle.
    """

    kind: str
    """A name of `PATTERNS`."""
    size: tuple[int, int]
    """Width and height, pixels."""
    numbers: tuple[float, ...] = ()
    """What `PATTERNS` says of the kind; missing ones are taken from there."""
    oversampling: int = 8
    """Cells along a side of a pixel."""
    levels: tuple[float, float] = (0.0, 1.0)
    """Values of dark and bright."""
    phase: tuple[float, float] = (0.0, 0.0)
    """By which the pattern's middle is moved from the image's middle, pixels along x and y."""
    bands: int = 1
    """Number of equal bands."""

    def __post_init__(self) -> None:
        if self.kind not in PATTERNS:
            raise InputError(f"pattern {self.kind!r}; allowed are {', '.join(PATTERNS)}")
        if min(self.size) < 1 or max(self.size) > 100_000 or not 1 <= self.oversampling <= 64 or self.bands < 1:
            raise InputError(
                f"pattern of {self.size[0]} × {self.size[1]} pixels, {self.bands} bands, oversampling "
                f"{self.oversampling}; allowed are sides up to 100000, one band or more and oversampling 1 to 64"
            )
        meaning, defaults = PATTERNS[self.kind]
        if len(self.numbers) > len(defaults) or not np.isfinite([*self.numbers, *self.levels, *self.phase]).all():
            raise InputError(f"pattern {self.kind}: numbers {self.numbers}; allowed are finite ones: {meaning}")
        object.__setattr__(self, "numbers", self.numbers + defaults[len(self.numbers) :])
        self._check()

    def _check(self) -> None:
        first = self.numbers[0] if self.numbers else 1.0
        least, most = {"edge": (-360.0, 360.0), "star": (1, 360), "wedge": (2, 10_000)}.get(self.kind, (1.0, 1e6))
        whole = self.kind in ("star", "wedge")
        if not least <= first <= most or (whole and first != int(first)):
            raise InputError(
                f"pattern {self.kind}:{first:g}; allowed is {'a whole number' if whole else 'a number'} from {least:g} "
                f"to {most:g} ({PATTERNS[self.kind][0]})"
            )
        if self.kind == "discs" and not 0.0 < self.diameter < self.numbers[0]:
            raise InputError(f"pattern discs: diameter {self.diameter:g} at pitch {first:g}; it must be smaller")

    @property
    def continuous(self) -> bool:
        """The cells are means of a continuous scene."""
        return True

    @property
    def diameter(self) -> float:
        """Of the discs, pixels."""
        return self.numbers[1] or self.numbers[0] / 2.0

    @property
    def middle(self) -> tuple[float, float]:
        """Column and row of the pattern's middle."""
        return (self.size[0] - 1) / 2.0 + self.phase[0], (self.size[1] - 1) / 2.0 + self.phase[1]

    def centres(self) -> Floats:
        """Column and row of the discs whose centres lie in the image, shape (n, 2), row by row."""
        pitch = self.numbers[0]
        axes = []
        for middle, side in zip(self.middle, self.size):
            first, last = np.ceil((-0.5 - middle) / pitch), np.floor((side - 0.5 - middle) / pitch)
            axes.append(middle + np.arange(first, last + 1) * pitch)
        y, x = np.meshgrid(axes[1], axes[0], indexing="ij")
        return np.stack([x.ravel(), y.ravel()], 1)

    def cells(self, window: Window) -> Floats:
        """Cells of a window of pixels, shape (bands, height · k, width · k)."""
        k = self.oversampling
        x = (np.arange(window.col * k, window.stop[0] * k) + 0.5) / k - 0.5 - self.middle[0]
        y = (np.arange(window.row * k, window.stop[1] * k) + 0.5) / k - 0.5 - self.middle[1]
        share = np.clip(_SHARES[self.kind](self, x[None, :], y[:, None], 1.0 / k), 0.0, 1.0)
        dark, bright = self.levels
        values = np.broadcast_to(dark + (bright - dark) * share, (y.size, x.size))
        return np.repeat(values[None], self.bands, 0)


def _discs(scene: PatternScene, x: Floats, y: Floats, side: float) -> Floats:
    pitch = scene.numbers[0]
    near = [v - np.round(v / pitch) * pitch for v in (x, y)]
    return 1.0 - disc_share(near[0], near[1], side, scene.diameter / 2.0)


#: Share of a pattern's bright part in cells of a side at x and y from its middle.
_SHARES: dict[str, Callable[[PatternScene, Floats, Floats, float], Floats]] = {
    "flat": lambda scene, x, y, side: np.ones((1, 1)),
    "edge": lambda scene, x, y, side: edge_share(x, y, side, scene.numbers[0]),
    "bars": lambda scene, x, y, side: bar_share(x, y, side, scene.numbers[0], scene.numbers[1]),
    "star": lambda scene, x, y, side: sector_share(x, y, side, int(scene.numbers[0])),
    "wedge": lambda scene, x, y, side: step_mean(x, side, int(scene.numbers[0]), scene.size[0]) + 0.0 * y,
    "discs": _discs,
}


def parse_pattern(text: str) -> tuple[str, tuple[float, ...]] | None:
    """Kind and numbers of a pattern such as ``edge:5`` or ``bars:6,45``; None: the text does not begin with
    a pattern.
    """
    kind, colon, rest = text.partition(":")
    if kind not in PATTERNS:
        return None
    try:
        numbers = tuple(float(part) for part in rest.split(",")) if colon else ()
    except ValueError:
        raise UsageError(f"scene {text!r}; after the colon stand numbers: {PATTERNS[kind][0]}") from None
    return kind, numbers


#: Rays that are followed at once.
_BATCH = 200_000
#: Rows of the table of objects' colours.
_TINTS = 4096
#: Where light comes from: from the north-west, halfway up.
_LIGHT = np.array([-0.5, 0.5, np.sqrt(0.5)])
#: Mean grey values of objects, before shading; of the ground; and the standard deviation of the pattern on all of them.
_OBJECTS, _GROUND, _CONTRAST = (110.0, 215.0), (105.0, 125.0, 90.0), 15.0
#: Waves of the pattern, and the longest wavelength in those of the shortest.
_WAVES, _LONGEST = 32, 12.0


@dataclass(frozen=True)
class FromAbove:
    """A map grid as a camera: what lies uppermost at its pixels, by vertical rays."""

    grid: MapGrid
    top: float
    """A height that nothing exceeds, metres."""

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.grid.width, self.grid.height

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[Floats, Floats]:
        """Points above the pixels, and the way down."""
        XY = self.grid.to_map(xy)
        origin = np.concatenate([XY, np.full((*XY.shape[:-1], 1), self.top)], axis=-1)
        return origin, np.broadcast_to(np.array([0.0, 0.0, -1.0]), origin.shape)


class Texture(Protocol):
    """Colours of a scene."""

    @property
    def bands(self) -> int:
        """Number of bands."""
        ...

    def __call__(self, hits: Hits) -> Floats:
        """Grey values, 0 to 255, of what neighbouring rays meet, shape (bands, n); 0 where they meet nothing."""
        ...


@dataclass(frozen=True)
class SolidTexture:
    """A pattern that fills space, and a colour of its own for each object: known at every place without a raster.

    The pattern is a sum of waves of random direction (a solid texture: Perlin 1985; Peachey 1985). No face shows a
    shorter wavelength than space has, and nothing breaks where faces meet; so what is finer than a pixel never appears,
    and positions can be found by matching anywhere. Faces are shaded by their slope, so that roofs show their ridges.
    """

    finest: float
    """Shortest wavelength, metres."""
    seed: int = 0
    bands: int = 3

    @cached_property
    def _waves(self) -> tuple[Floats, Floats]:
        """Wave vectors (3, m), radians per metre, and phases (m,)."""
        rng = np.random.default_rng([self.seed, 0])
        way = rng.normal(size=(3, _WAVES))
        length = self.finest * _LONGEST ** np.linspace(0.0, 1.0, _WAVES)
        return way / np.linalg.norm(way, axis=0) * (2 * np.pi / length), rng.uniform(0, 2 * np.pi, _WAVES)

    @cached_property
    def _tints(self) -> Floats:
        """Mean grey values of objects, shape (_TINTS, bands)."""
        return np.random.default_rng([self.seed, 1]).uniform(*_OBJECTS, (_TINTS, self.bands))

    def __call__(self, hits: Hits) -> Floats:
        """Grey values, see `Texture`."""
        waves, phases = self._waves
        pattern = np.cos(hits.XYZ @ waves + phases).sum(axis=1) * (_CONTRAST * np.sqrt(2.0 / _WAVES))
        ground = np.resize(_GROUND, self.bands)
        shade = 0.6 + 0.4 * np.abs(hits.normal @ _LIGHT)
        mean = np.where(hits.owner[:, None] <= 0, ground, self._tints[hits.owner % _TINTS] * shade[:, None])
        return np.nan_to_num(np.clip(mean.T + pattern, 1.0, 255.0))


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """What a camera sees of a surface, as a scene for the image formation model.

    Cells are values at their middles; a pixel's light is the mean of oversampling² of them or, with a spread function,
    as many as that reaches.
    """

    camera: Rays
    surface: Terrain
    texture: Texture
    heights: tuple[float, float]
    """Between which the surface lies, metres; see `ray_paths` for curved rays."""
    oversampling: int = 2

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        return self.camera.size

    @property
    def bands(self) -> int:
        """Those of the texture."""
        return self.texture.bands

    @property
    def continuous(self) -> bool:
        """The scene is no mosaic of squares."""
        return True

    def cells(self, window: Window) -> Floats:
        """Cells of a window of pixels, shape (bands, height · k, width · k); where rays meet nothing they are 0."""
        k = self.oversampling
        x = (np.arange(window.width * k) + 0.5) / k - 0.5 + window.col
        y = (np.arange(window.height * k) + 0.5) / k - 0.5 + window.row
        out = np.empty((self.bands, len(y), len(x)))
        rows = max(1, _BATCH // len(x))
        for first in range(0, len(y), rows):
            part = slice(first, first + rows)
            xy = np.stack(np.meshgrid(x, y[part]), axis=-1).reshape(-1, 2)
            out[:, part] = self.texture(self.hits(xy)).reshape(self.bands, -1, len(x))
        return out

    def means(self, window: Window) -> tuple[NDArray[np.uint8], Mask]:
        """Means of the cells of pixels, shape (bands, height, width), and those that show something everywhere."""
        k = self.oversampling
        cells = self.cells(window).reshape(self.bands, window.height, k, window.width, k)
        valid = np.asarray((cells > 0).all(axis=(0, 2, 4)))
        return np.rint(cells.mean(axis=(2, 4)) * valid).astype(np.uint8), valid

    def places(self, window: Window, origin: Floats) -> Floats32:
        """X, Y, Z from an origin (3,) and object at the middles of pixels, shape (4, height, width); NaN: nothing."""
        y, x = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        hits = self.hits(np.stack([x, y], axis=-1).reshape(-1, 2))
        owner = np.where(np.isfinite(hits.along), hits.owner, np.nan)
        return np.column_stack([hits.XYZ - origin, owner]).T.reshape(4, *x.shape).astype(np.float32)

    def hits(self, xy: ArrayLike) -> Hits:
        """What the rays of image points (n, 2) meet first."""
        return self.surface.first_hit(ray_paths(self.camera, xy, self.heights))
