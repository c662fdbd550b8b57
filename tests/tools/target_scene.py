"""A wall and a vault with a pillar before them, and images of them, rendered by tracing rays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray

from photoplan.geometry.pose import angles_from_rotation

Array = NDArray[np.float64]
E, N, Z = 500_000.0, 5_300_000.0, 100.0
SIZE, CONSTANT = (480, 360), 420.0
PIXEL = 0.02
GREY = 12
"""Of the pillar: darker than all texture."""


def texture(u: Array, v: Array) -> Array:
    """Grey values of a surface, waves of 0.3 m and longer."""
    waves = np.sin(u * 9.0 + 0.7) * np.cos(v * 7.0) + np.sin(u * 21.0 + v * 13.0)
    return 130.0 + 40.0 * waves + 8.0 * u


@dataclass(frozen=True)
class Shot:
    """A photograph: where it was taken from, and at what."""

    center: tuple[float, float, float]
    at: tuple[float, float, float]
    gain: float = 1.0

    @property
    def rotation(self) -> Array:
        """Axes of the camera as columns; it looks against its third one."""
        back = np.subtract(self.center, self.at)
        back /= np.linalg.norm(back)
        right = np.cross((0.0, 0.0, 1.0), back)
        if np.linalg.norm(right) < 1e-6:
            right = np.array([1.0, 0.0, 0.0])
        right /= np.linalg.norm(right)
        return np.column_stack([right, np.cross(back, right), back])

    def rays(self) -> Array:
        """Directions of all pixels (height, width, 3)."""
        width, height = SIZE
        x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, (height - 1) / 2 - np.arange(height))
        return np.stack([x, y, np.full_like(x, -CONSTANT)], axis=-1) @ self.rotation.T


@dataclass(frozen=True)
class Place:
    """A target, what stands before it, and the images of it; coordinates are counted from E, N, Z."""

    stated: str
    bounds: tuple[float, float, float, float]
    surface: Callable[[Array, Array], tuple[Array, Array, Array]]
    """Distance in lengths of rays at which they meet the surface (inf: never), and u, v there; of origins and rays."""
    ground: Callable[[Array, Array], Array]
    """Points of u, v on the surface."""
    pillar: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Lowest and highest corner of a box."""
    shots: tuple[Shot, ...]

    def grid(self) -> tuple[Array, Array]:
        """u and v of the pixels of a product."""
        u0, v0, u1, v1 = self.bounds
        return np.meshgrid(np.arange(u0 + PIXEL / 2, u1, PIXEL), np.arange(v1 - PIXEL / 2, v0, -PIXEL))

    def sees(self, shot: Shot) -> NDArray[np.bool_]:
        """Pixels of a product that an image sees: nothing comes before them, and they face it."""
        XYZ = self.ground(*self.grid())
        way = XYZ - shot.center
        first = self.surface(np.broadcast_to(shot.center, way.shape), way)[0]
        clear = np.isinf(into_box(np.asarray(shot.center), way, self.pillar, 1.0)) & (first > 1 - 1e-6)
        p = way @ shot.rotation
        x, y = (CONSTANT * p[..., k] / -p[..., 2] for k in (0, 1))
        return clear & (p[..., 2] < 0) & (np.abs(x) < SIZE[0] / 2 - 3) & (np.abs(y) < SIZE[1] / 2 - 3)

    def photograph(self, shot: Shot) -> NDArray[np.uint8]:
        """Render an image, 3 × 3 rays a pixel."""
        rays, total = shot.rays(), np.zeros(SIZE[::-1])
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                d = rays + shot.rotation @ (dx / 3, dy / 3, 0.0)
                t, u, v = self.surface(np.broadcast_to(shot.center, d.shape), d)
                seen = np.where(np.isfinite(t), texture(u, v) * shot.gain, 0.0)
                total += np.where(into_box(np.asarray(shot.center), d, self.pillar, np.inf) < t, GREY, seen)
        return np.clip(np.rint(total / 9), 0, 255).astype(np.uint8)


def into_box(origin: Array, d: Array, box: tuple[Sequence[float], Sequence[float]], end: float) -> Array:
    """Lengths of rays at which they enter a box before an end; inf where they do not."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = ((np.asarray(corner) - origin) / d for corner in box)
    near, far = np.fmax.reduce(np.fmin(a, b), axis=-1), np.fmin.reduce(np.fmax(a, b), axis=-1)
    return np.where((near <= far) & (near > 0) & (near < end), near, np.inf)


def wall() -> Place:
    """A wall of azimuth 180° (it faces south) through the origin, 4 m wide and 3 m high."""

    def met(origin: Array, d: Array) -> tuple[Array, Array, Array]:
        t = -origin[..., 1] / d[..., 1]
        t = np.where((t > 0) & (origin[..., 1] < 0), t, np.inf)
        at = origin + np.where(np.isfinite(t), t, 0.0)[..., None] * d
        return t, at[..., 0], at[..., 2]

    return Place(
        stated=f"wall:{E},{N},{Z},180",
        bounds=(-2.0, -1.5, 2.0, 1.5),
        surface=met,
        ground=lambda u, v: np.stack([u, np.zeros_like(u), v], axis=-1),
        pillar=((-0.15, -1.3, -2.0), (0.15, -1.0, 0.8)),
        shots=(Shot((-1.6, -5.0, 0.2), (-0.3, 0.0, 0.0)), Shot((1.5, -4.6, -0.3), (0.3, 0.0, 0.0), 0.85)),
    )


RADIUS = 3.0
SIDE = -1.0
"""Of who looks north from below, the vault's u grows to the west."""


def barrel() -> Place:
    """A vault of a radius about an axis to the north, seen from near its axis; u goes along the arc."""

    def met(origin: Array, d: Array) -> tuple[Array, Array, Array]:
        a, b = (d[..., (0, 2)] ** 2).sum(axis=-1), (origin[..., (0, 2)] * d[..., (0, 2)]).sum(axis=-1)
        c = (origin[..., (0, 2)] ** 2).sum(axis=-1) - RADIUS**2
        t = (-b + np.sqrt(np.maximum(b * b - a * c, 0.0))) / a
        at = origin + t[..., None] * d
        return t, SIDE * RADIUS * np.arctan2(at[..., 0], at[..., 2]), at[..., 1]

    def ground(u: Array, v: Array) -> Array:
        angle = SIDE * u / RADIUS
        return np.stack([RADIUS * np.sin(angle), v, RADIUS * np.cos(angle)], axis=-1)

    return Place(
        stated=f"vault:{E},{N},{Z},0,{RADIUS}",
        bounds=(-2.0, -1.5, 2.0, 1.5),
        surface=met,
        ground=ground,
        pillar=((-0.2, -0.2, 1.2), (0.2, 0.2, 1.6)),
        shots=(Shot((-1.0, -0.6, -1.0), (0.1, 0.0, 3.0)), Shot((1.1, 0.5, -0.8), (-0.1, 0.0, 3.0), 0.85)),
    )


@dataclass(frozen=True)
class Made:
    place: Place
    path: Path


def write(place: Place, folder: Path, more: str = "") -> Made:
    """Write images, the pillar as a mesh, and the project with more tables."""
    images = []
    for number, shot in enumerate(place.shots):
        name = f"i{number}"
        with rasterio.open(folder / f"{name}.tif", "w", driver="GTiff", width=SIZE[0], height=SIZE[1], count=1,
                           dtype="uint8") as file:  # fmt: skip
            file.write(place.photograph(shot), 1)
        angles = np.degrees(angles_from_rotation(shot.rotation)).tolist()
        center = np.add(shot.center, (E, N, Z)).tolist()
        images.append(
            f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\ncamera = "c"\ncenter = {center}\n'
            f"angles = {angles}\nsigma_center = [0.01, 0.01, 0.01]\nsigma_angles = [0.01, 0.01, 0.01]\n"
        )
    low, high = (np.add(corner, (E, N, Z)) for corner in place.pillar)
    corners = [[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)]
    faces = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    (folder / "pillar.obj").write_text(
        "".join("v {} {} {}\n".format(*corner) for corner in corners)
        + "".join("f {} {} {} {}\n".format(*face) for face in faces)
    )
    path = folder / "project.toml"
    path.write_text(
        f'format = 1\ncrs = "EPSG:32633"\n[terrain]\nheight = {Z - 5}\nheight_system = "ellipsoidal"\n'
        '[orientation]\nheight_system = "ellipsoidal"\n'
        '[[objects]]\nfile = "pillar.obj"\ncrs = "EPSG:32633"\nheight_system = "same"\n'
        f"[cameras.c]\nsize = {list(SIZE)}\nfocal_px = {CONSTANT}\n" + more + "".join(images)
    )
    return Made(place, path)
