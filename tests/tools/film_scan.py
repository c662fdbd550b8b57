"""Scans of aerial film photographs, rendered from an orthophoto and its heights with nothing left unknown.

Independent of the package: rotation, lens, shrinkage, scanner and the rays to the ground are written out here, in both
directions. A pixel of the scan is followed back to the film as it lay in the camera, through the lens to the ground,
and takes the orthophoto's grey value there (cubic). Fiducial marks are drawn where the calibration has them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy import ndimage

__all__ = ["CALIBRATED", "Film", "Ground", "Scan", "read_ground", "render"]

Array = NDArray[np.float64]

#: Calibrated marks, millimetres: four corners and four middles of the sides, none quite where it was planned.
CALIBRATED = {
    "1": (-110.004, -109.997), "2": (110.006, 110.003), "3": (-109.995, 110.008), "4": (109.998, -110.005),
    "5": (-112.003, 0.006), "6": (111.994, -0.004), "7": (0.005, 112.007), "8": (-0.007, -111.996),
}  # fmt: skip
#: Half sides of the exposed picture and of the film, millimetres. Marks lie on the dark border between.
PICTURE, FILM = 107.0, 117.0
#: Steps in which a ray comes down to the ground, metres.
STEP = 0.25
#: A mark: a bright cross of thin lines in a ring, millimetres.
ARM, HALF_LINE, RING = 2.0, 0.14, (1.0, 1.3)


@dataclass(frozen=True)
class Film:
    """A camera, an exposure, a film and a scanner."""

    center: tuple[float, float, float]
    """Projection centre, metres."""
    opk_deg: tuple[float, float, float] = (1.1, -0.8, 93.0)
    """Rotations about X, then Y, then Z."""
    c: float = 152.87
    """Camera constant, millimetres."""
    principal_point: tuple[float, float] = (0.112, -0.083)
    """In the system of the marks, millimetres."""
    distortion: tuple[float, float] = (0.6, -5.5e-5)
    """a and b of the radial distortion a r + b r³ in micrometres at r in millimetres, outwards: 24 µm to −95 µm in the
    corners, as lenses of the fifties had it."""
    shrinkage: tuple[float, float] = (2.8e-4, 1.7e-4)
    """Of the film since its calibration, along x and y."""
    turn_deg: float = 0.7
    """How far the film lies turned on the scanner, clockwise."""
    offset: tuple[float, float] = (0.83, -0.46)
    """Of the film's middle from the scan's middle, millimetres to the right and down."""
    pitch: float = 0.127
    """Sampling distance of the scanner, millimetres."""
    side: float = 242.0
    """Side of the scan, millimetres."""
    marks: dict[str, tuple[float, float]] = field(default_factory=lambda: dict(CALIBRATED))

    @property
    def size(self) -> int:
        """Columns and rows of the scan."""
        return round(self.side / self.pitch)

    @property
    def dpi(self) -> float:
        """Sampling of the scanner, pixels per inch."""
        return 25.4 / self.pitch

    @cached_property
    def R(self) -> Array:
        """Camera axes to ground axes."""
        o, p, k = np.radians(self.opk_deg)
        X = np.array([[1, 0, 0], [0, math.cos(o), -math.sin(o)], [0, math.sin(o), math.cos(o)]])
        Y = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
        Z = np.array([[math.cos(k), -math.sin(k), 0], [math.sin(k), math.cos(k), 0], [0, 0, 1]])
        return X @ Y @ Z

    def shift(self, r: Array) -> Array:
        """Radial distortion, millimetres outwards at radius r."""
        a, b = self.distortion
        return 1e-3 * r * (a + b * r**2)

    def scan_of_film(self, xy: Array) -> Array:
        """Calibrated film coordinates (…, 2), millimetres, to column and row."""
        x, y = xy[..., 0] * (1 - self.shrinkage[0]), -xy[..., 1] * (1 - self.shrinkage[1])
        t = math.radians(self.turn_deg)
        right = math.cos(t) * x - math.sin(t) * y + self.offset[0]
        down = math.sin(t) * x + math.cos(t) * y + self.offset[1]
        return np.stack([right, down], axis=-1) / self.pitch + (self.size - 1) / 2

    def film_of_scan(self, at: Array) -> Array:
        """Column and row (…, 2) to calibrated film coordinates, millimetres."""
        right, down = np.moveaxis((at - (self.size - 1) / 2) * self.pitch - np.array(self.offset), -1, 0)
        t = math.radians(self.turn_deg)
        x, y = math.cos(t) * right + math.sin(t) * down, -math.sin(t) * right + math.cos(t) * down
        return np.stack([x / (1 - self.shrinkage[0]), -y / (1 - self.shrinkage[1])], axis=-1)

    def scan_of_ground(self, XYZ: Array) -> Array:
        """Ground points (…, 3) to column and row."""
        p = (XYZ - np.array(self.center)) @ self.R
        ideal = -self.c * p[..., :2] / p[..., 2:]
        r = np.hypot(ideal[..., 0], ideal[..., 1])
        real = ideal * (1 + self.shift(r) / np.maximum(r, 1e-12))[..., None]
        return self.scan_of_film(real + np.array(self.principal_point))

    def rays(self, at: Array) -> Array:
        """Directions (…, 3) on the ground, one unit down each, of the rays of column and row (…, 2)."""
        real = self.film_of_scan(at) - np.array(self.principal_point)
        ideal = real
        for _ in range(6):
            r = np.hypot(ideal[..., 0], ideal[..., 1])
            ideal = real / (1 + self.shift(r) / np.maximum(r, 1e-12))[..., None]
        d = np.concatenate([ideal, np.full((*ideal.shape[:-1], 1), -self.c)], axis=-1) @ self.R.T
        return d / -d[..., 2:]

    def table(self) -> tuple[list[float], list[float]]:
        """Radii and distortion in micrometres as a calibration report has them, with one decimal."""
        radii = [10.0 * k for k in range(16)]
        return radii, [round(float(v), 1) for v in 1000 * self.shift(np.array(radii))]


@dataclass(frozen=True)
class Ground:
    """An orthophoto and its heights."""

    picture: Array
    """Grey values, (rows, columns)."""
    place: tuple[float, float, float]
    """Outer left and top edge and the side of a pixel, metres."""
    heights: Array
    posts: tuple[float, float, float]
    """X and Y of the upper-left post, mesh width."""

    def height_at(self, X: Array, Y: Array) -> Array:
        """Bilinear heights."""
        x0, y0, mesh = self.posts
        return ndimage.map_coordinates(self.heights, [(y0 - Y) / mesh, (X - x0) / mesh], order=1, mode="nearest")

    def hit(self, center: tuple[float, float, float], d: Array) -> Array:
        """First ground points (n, 3) of rays with directions d (n, 3) that fall one unit each."""
        X0, Y0, Z0 = center
        x0, y0, mesh = self.posts

        def place(level: Array, d: Array) -> tuple[Array, Array]:
            return X0 + (Z0 - level) * d[:, 0], Y0 + (Z0 - level) * d[:, 1]

        # Looked for from above the highest terrain that a ray can meet, downwards in steps.
        top, bottom = float(self.heights.max()), float(self.heights.min())
        reach = math.ceil((top - bottom) * np.abs(d[:, :2]).max() / mesh) + 1
        X, Y = place(np.full(len(d), bottom), d)
        high = ndimage.maximum_filter(self.heights, 2 * reach + 1)
        level = ndimage.map_coordinates(high, [(y0 - Y) / mesh, (X - x0) / mesh], order=0, mode="nearest")
        open_ = np.arange(len(d))
        while open_.size:
            level[open_] -= STEP
            open_ = open_[self.height_at(*place(level[open_], d[open_])) < level[open_]]
        lower, upper = level, level + STEP
        for _ in range(9):
            middle = (upper + lower) / 2
            under = self.height_at(*place(middle, d)) >= middle
            lower, upper = np.where(under, middle, lower), np.where(under, upper, middle)
        return np.stack([*place(lower, d), lower], axis=1)

    def grey_at(self, X: Array, Y: Array) -> Array:
        """Cubic grey values; NaN outside."""
        left, top, cell = self.place
        at = [(top - Y) / cell - 0.5, (X - left) / cell - 0.5]
        return ndimage.map_coordinates(self.picture, at, order=3, cval=np.nan)


def read_ground(orthophoto: Path, terrain: Path) -> Ground:
    """Mean of an orthophoto's bands, and its heights."""
    with rasterio.open(orthophoto) as file:
        picture, t = file.read().astype(float).mean(axis=0), file.transform
    with rasterio.open(terrain) as file:
        heights, p = file.read(1).astype(float), file.transform
    return Ground(picture, (t.c, t.f, t.a), heights, (p.c + p.a / 2, p.f - p.a / 2, p.a))


@dataclass(frozen=True)
class Scan:
    """What was rendered, and what is true of it."""

    film: Film
    grey: NDArray[np.uint8]
    """Shape (rows, columns)."""

    @property
    def marks(self) -> dict[str, tuple[float, float]]:
        """Where the marks are, column and row."""
        found = {n: self.film.scan_of_film(np.array(at, float)) for n, at in self.film.marks.items()}
        return {n: (float(at[0]), float(at[1])) for n, at in found.items()}

    def write(self, path: Path) -> Path:
        """A grey TIFF that states its resolution."""
        size = self.film.size
        with rasterio.open(path, "w", driver="GTiff", width=size, height=size, count=1, dtype="uint8") as file:
            file.write(self.grey, 1)
            dpi = {f"TIFFTAG_{axis}RESOLUTION": f"{self.film.dpi:.6g}" for axis in "XY"}
            file.update_tags(TIFFTAG_RESOLUTIONUNIT=2, **dpi)
        return path


def render(film: Film, ground: Ground, noise: float = 5.0, seed: int = 0) -> Scan:
    """Scan of a photograph of the ground.

    Parameters
    ----------
    film, ground
        What is photographed, and how.
    noise : float
        Standard deviation of the grain, grey values.
    """
    size = film.size
    col, row = np.meshgrid(np.arange(size, dtype=float), np.arange(size, dtype=float))
    at = np.stack([col, row], axis=-1)
    plane = film.film_of_scan(at)
    edge = np.abs(plane).max(axis=-1)
    exposed = edge <= PICTURE
    grey = np.where(edge <= FILM, 24.0, 6.0)
    inside = np.flatnonzero(exposed)
    for part in np.array_split(inside, max(1, inside.size // 400_000)):
        XYZ = ground.hit(film.center, film.rays(at.reshape(-1, 2)[part]))
        r2 = (plane.reshape(-1, 2)[part] ** 2).sum(axis=1) / (film.c**2)
        vignetting = 1.0 / (1.0 + 0.35 * r2)
        grey.ravel()[part] = np.nan_to_num(40.0 + 0.8 * ground.grey_at(XYZ[:, 0], XYZ[:, 1]) * vignetting, nan=24.0)
    _draw_marks(film, grey)
    grey = ndimage.gaussian_filter(grey, 0.45)
    grey += np.random.default_rng(seed).normal(0.0, noise, grey.shape)
    return Scan(film, np.clip(np.round(grey), 1, 254).astype(np.uint8))


def _draw_marks(film: Film, grey: Array, fine: int = 8) -> None:
    """Each pixel is the mean of many points, taken on the film."""
    sub = (np.arange(fine) + 0.5) / fine - 0.5
    reach = math.ceil((ARM + 0.3) / film.pitch)
    for at in film.marks.values():
        middle = np.rint(film.scan_of_film(np.array(at, float))).astype(int)
        col, row = (np.arange(m - reach, m + reach + 1)[:, None] + sub for m in middle)
        points = np.stack(np.meshgrid(col.ravel(), row.ravel()), axis=-1)
        d = film.film_of_scan(points) - np.array(at)
        x, y = np.abs(d[..., 0]), np.abs(d[..., 1])
        r = np.hypot(x, y)
        bright = (np.minimum(x, y) <= HALF_LINE) & (np.maximum(x, y) <= ARM) | (r >= RING[0]) & (r <= RING[1])
        side = 2 * reach + 1
        share = bright.reshape(side, fine, side, fine).mean(axis=(1, 3))
        window = grey[middle[1] - reach : middle[1] + reach + 1, middle[0] - reach : middle[0] + reach + 1]
        window += share * (210.0 - window)
