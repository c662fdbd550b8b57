"""Rendered towns, pyramids and bare ground in sun and shade, whose surface is known at every place of the map."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from photoplan.cameras.base import CentralCamera
from photoplan.io.project.file import load_project
from photoplan.project.cameras import central_without_pixels
from tools.command import inside
from tools.rendered_block import Flight, write_project
from tools.small_block import CRS, X0, Y0, write_image

_Doubles = NDArray[np.float64]
GROUND = 100.0


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex body: n · X <= d for each of its faces."""

    normals: _Doubles
    offsets: _Doubles
    grey: float
    texture: float
    middle: _Doubles
    radius: float
    """Of a ball around it."""

    @classmethod
    def box(cls, at: tuple[float, float], sides: tuple[float, float], turn: float, top: float, *look: float) -> Solid:
        """A box that stands below the ground."""
        c, s = np.cos(turn), np.sin(turn)
        a, b = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
        up, middle = np.array([0.0, 0.0, 1.0]), np.array([*at, 0.0])
        offsets = [a @ middle + sides[0] / 2, sides[0] / 2 - a @ middle, b @ middle + sides[1] / 2]
        offsets += [sides[1] / 2 - b @ middle, top, 5.0 - GROUND]
        ball = np.array([*at, (GROUND + top) / 2 - 5]), float(np.hypot(np.hypot(*sides) / 2, (top - GROUND) / 2 + 6))
        return cls(np.array([a, -a, b, -b, up, -up]), np.array(offsets), *look, *ball)

    @classmethod
    def pyramid(cls, at: tuple[float, float], half: float, turn: float, height: float, *look: float) -> Solid:
        """A pyramid over a square."""
        normals, offsets = [], []
        top = np.array([*at, GROUND + height])
        for k in range(4):
            n = np.array([height * np.cos(turn + k * np.pi / 2), height * np.sin(turn + k * np.pi / 2), half])
            n /= np.linalg.norm(n)
            normals.append(n)
            offsets.append(n @ top)
        ball = np.array([*at, GROUND]), 1.5 * half + height
        return cls(np.array([*normals, [0, 0, -1.0]]), np.array([*offsets, 5.0 - GROUND]), *look, *ball)

    def along(self, origin: _Doubles, way: _Doubles) -> tuple[_Doubles, NDArray[np.int64]]:
        """Where rays (n, 3) come in, in units of `way` (inf: they do not), and through which face."""
        out, faces = np.full(len(way), np.inf), np.zeros(len(way), np.int64)
        beside = self.middle - origin
        near = ((np.cross(beside, way) ** 2).sum(axis=1) < self.radius**2 * (way**2).sum(axis=1)).nonzero()[0]
        out[near], faces[near] = self._along(origin[near], way[near])
        return out, faces

    def _along(self, origin: _Doubles, way: _Doubles) -> tuple[_Doubles, NDArray[np.int64]]:
        slope, left = way @ self.normals.T, self.offsets - origin @ self.normals.T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = left / slope
        enter = np.where(slope < 0, at, -np.inf)
        face = np.argmax(enter, axis=1)
        first = enter[np.arange(len(enter)), face]
        last = np.where(slope > 0, at, np.inf).min(axis=1)
        outside = (first <= last) & ~((slope == 0) & (left < 0)).any(axis=1)
        return np.where(outside, first, np.inf), face

    def height(self, XY: _Doubles) -> _Doubles:
        """Its top over map points (n, 2); −inf beside it."""
        above = np.column_stack([XY, np.full(len(XY), 500.0)])
        down = np.broadcast_to([0.0, 0.0, -1.0], above.shape)
        at, _ = self.along(above, down)
        return np.where(np.isfinite(at), 500.0 - at, -np.inf)


@dataclass(frozen=True, eq=False)
class Town:
    """Solids on level ground."""

    solids: tuple[Solid, ...]
    grey: float = 110.0
    texture: float = 18.0
    sun: tuple[float, float, float] = (0.4, -0.45, 0.8)
    """Direction towards the sun."""
    shade: float = 0.0
    """Part of the light that shadows and faces away from the sun lose."""
    noise: float = 1.0
    """Standard deviation of a pixel, grey values."""
    pattern: float = 0.0
    """Standard deviation of the sensor's pattern, grey values: the same pixels in every image."""
    grain: float = 0.55
    """Pitch of the finest texture, metres."""
    _noise: list[_Doubles] = field(default_factory=list)

    def height(self, XY: _Doubles) -> _Doubles:
        """Of the surface at map points (..., 2)."""
        flat = np.reshape(XY, (-1, 2))
        return np.max([np.full(len(flat), GROUND), *(one.height(flat) for one in self.solids)], axis=0).reshape(
            np.shape(XY)[:-1]
        )

    def _lights(self, u: _Doubles, v: _Doubles, which: int) -> _Doubles:
        if not self._noise:
            rng = np.random.default_rng(77)
            fine = rng.normal(0, 1, (1024, 1024))
            total = np.zeros_like(fine)
            for sigma in (0.6, 1.5, 4.0, 12.0):
                part = gaussian_filter(fine := rng.normal(0, 1, fine.shape), sigma, mode="wrap")
                total += part / part.std()
            self._noise.append(total / total.std())
        at = np.stack([v / self.grain + 137.7 * which, u / self.grain + 71.3 * which])
        return map_coordinates(self._noise[0], at, order=1, mode="grid-wrap")

    def grey_values(self, origin: _Doubles, way: _Doubles) -> _Doubles:
        """What rays (n, 3) meet, grey values."""
        best, owner, faces = (GROUND - origin[:, 2]) / way[:, 2], np.full(len(way), -1), np.zeros(len(way), int)
        for k, one in enumerate(self.solids):
            at, face = one.along(origin, way)
            nearer = at < best
            best[nearer], owner[nearer], faces[nearer] = at[nearer], k, face[nearer]
        XYZ = origin + best[:, None] * way
        normals = np.tile([0.0, 0.0, 1.0], (len(way), 1))
        grey, texture = np.full(len(way), self.grey), np.full(len(way), self.texture)
        for k, one in enumerate(self.solids):
            own = owner == k
            normals[own], grey[own], texture[own] = one.normals[faces[own]], one.grey, one.texture
        level = np.abs(normals[:, 2]) > 0.1
        across = np.stack([-normals[:, 1], normals[:, 0]], axis=1)
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        u = np.where(level, XYZ[:, 0] - X0, ((XYZ[:, :2] - (X0, Y0)) * across).sum(axis=1))
        v = np.where(level, XYZ[:, 1] - Y0, XYZ[:, 2])
        out = grey + texture * np.where(level, self._lights(u, v, 0), self._lights(u, v, 3))
        if self.shade:
            sun = np.array(self.sun) / np.linalg.norm(self.sun)
            dark = normals @ sun <= 0
            lit = np.flatnonzero(~dark)
            start = XYZ[lit] + 1e-4 * normals[lit]
            for one in self.solids:
                at, _ = one.along(start, np.broadcast_to(sun, start.shape))
                dark[lit] |= np.isfinite(at) & (at > 0)
            out = np.where(dark, (1 - self.shade) * out, out)
        return out

    def image(self, camera: CentralCamera, rng: np.random.Generator, finer: int = 2) -> NDArray[np.uint8]:
        """What a camera records."""
        x, y = np.meshgrid(np.arange(camera.size[0]), np.arange(camera.size[1]))
        total = np.zeros(x.shape)
        for i in range(finer):
            for j in range(finer):
                xy = np.stack([x + (i + 0.5) / finer - 0.5, y + (j + 0.5) / finer - 0.5], axis=-1).reshape(-1, 2)
                total += self.grey_values(*camera.rays(xy)).reshape(x.shape)
        fixed = np.random.default_rng(4)
        pattern = fixed.normal(0, 1, x.shape) + fixed.normal(0, 1, x.shape[1]) + fixed.normal(0, 1, x.shape[0])[:, None]
        noisy = total / finer**2 + self.pattern * pattern / np.sqrt(3) + rng.normal(0, self.noise, x.shape)
        return np.clip(np.rint(noisy), 1, 255).astype(np.uint8)


def town(seed: int, side: float = 60.0, tallest: float = 20.0, **options: float) -> Town:
    """Boxes of 3 to 20 m on lots of 22 m."""
    rng = np.random.default_rng(seed)
    solids = []
    for x in np.arange(-side + 8, side, 22.0):
        for y in np.arange(-side + 8, side, 22.0):
            at = (X0 + x + rng.uniform(-3, 3), Y0 + y + rng.uniform(-3, 3))
            sides = tuple(rng.uniform(7, 14, 2))
            top = GROUND + rng.uniform(3, tallest)
            solids.append(
                Solid.box(at, sides, rng.uniform(0, np.pi), top, rng.uniform(70, 160), rng.uniform(10, 20))  # type: ignore[arg-type]
            )
    return Town(tuple(solids), **options)  # type: ignore[arg-type]


def write_town(folder: Path, scene: Town, flight: Flight, seed: int = 1) -> Path:
    """A project with rendered images."""
    path = write_project(folder, CRS, f"height = {GROUND}", "", flight)
    (folder / "rendered").mkdir()
    project, rng = load_project(path), np.random.default_rng(seed)
    for image in project.images:
        pixels = scene.image(central_without_pixels(project, image.name), rng)
        write_image(folder / "rendered" / f"{image.name}.tif", pixels[None])
    return path


@dataclass(frozen=True, eq=False)
class Judged:
    """Heights of a surface against the truth; in pixels of parallax unless another unit is stated."""

    off: _Doubles
    """Least difference to the true heights within half a post, NaN without a height, shape (rows, columns)."""
    sigma: _Doubles
    fit: _Doubles
    true: _Doubles
    """Metres."""
    heights: _Doubles
    """Metres."""

    @property
    def known(self) -> NDArray[np.bool_]:
        return np.isfinite(self.off)

    @property
    def right(self) -> float:
        """Part of the heights that are right to half a pixel."""
        return float((self.off[self.known] <= 0.5).mean())

    @property
    def vague(self) -> float:
        """Part of those that claim more than a pixel."""
        return float((self.sigma[self.known & (self.off <= 0.5)] > 1).mean())

    @property
    def untold(self) -> float:
        """Part of the heights wrong by more than a pixel that lie beyond three standard deviations."""
        wrong = self.known & (self.off > 1)
        return float((self.off > 3 * self.sigma)[wrong].mean()) if wrong.any() else 0.0

    @property
    def poor_fit(self) -> float:
        return float((self.fit[self.known] > 2).mean())

    def __str__(self) -> str:
        wrong = float((self.off[self.known] > 1).mean())
        return (
            f"known {self.known.mean():.1%}, right {self.right:.1%}, vague {self.vague:.1%}; wrong {wrong:.1%}, "
            f"untold {self.untold:.1%}; fits badly {self.poor_fit:.1%}, sigma {np.nanmedian(self.sigma):.3f}, "
            f"{np.nanmax(self.sigma):.1f} px at most"
        )


def judge(scene: Town, products: Path, pixel: float) -> Judged:
    """Compare a surface with its scene; `pixel`: height of a pixel of parallax, metres."""
    read = {}
    for kind in ("", "_sigma", "_fit"):
        with rasterio.open(products / f"surface{kind}.tif") as file:
            read[kind] = file.read(1).astype(float)
            col, row = np.meshgrid(np.arange(file.width) + 0.5, np.arange(file.height) + 0.5)
            X, Y = file.transform @ (col, row)
    heights, true = read[""], scene.height(np.stack([X, Y], axis=-1))
    off = np.abs(heights - true)
    return Judged(off / pixel, read["_sigma"] / pixel, read["_fit"], true, heights)


def surface(path: Path, *words: object) -> str:
    """Run `photoplan surface`; what it printed."""
    said = inside("surface", path, *words, "--workers", 1, "--no-quicklook")
    assert said.code == 0, said.err
    return said.err
