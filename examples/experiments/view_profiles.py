"""Views by profiles, as Herzner (1988) and Ecker (1991) make them: how many profiles and cuts they take.

A vertical plane through the point of view is a line in the picture through the vertical vanishing point. A profile of
the terrain in it gives the ground of all pixels along that line, at its cuts with rows or columns of the picture: each
cut sets the pixel next to it, at most half a pixel beside its ray.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.products.view.camera import CameraRequest, ViewGround, view_camera
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.seen import SeenSurface

Point = tuple[float, float]


@dataclass(frozen=True)
class Counted:
    """What a method takes for a picture."""

    profiles: int
    cuts: int
    """Cuts of profiles with rows or columns."""
    missing: int
    """Pixels that no cut has set."""
    largest: float
    """Largest distance of a pixel from the best of its cuts, pixels."""


class Picture:
    """Pixels of a picture and the best cut of each."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.off: NDArray[np.float64] = np.full(size[::-1], np.inf)
        self.profiles = self.cuts = 0

    def profile(self, vanishing: Point, through: Point, along_rows: bool, start: float, stop: float) -> None:
        """A profile in the plane of a point of the picture; cut with rows, or columns, from `start` to `stop`."""
        k = 1 if along_rows else 0
        lines = np.arange(np.ceil(min(start, stop) - 1e-9), np.floor(max(start, stop) + 1e-9) + 1)
        other = through[1 - k] + (lines - through[k]) * (through[1 - k] - vanishing[1 - k]) / (
            through[k] - vanishing[k]
        )
        pixel = np.rint(other)
        inside = (pixel >= 0) & (pixel < self.size[1 - k])
        lines, other, pixel = lines[inside].astype(int), other[inside], pixel[inside].astype(int)
        at = (lines, pixel) if along_rows else (pixel, lines)
        np.minimum.at(self.off, at, np.abs(other - pixel))
        self.profiles += 1
        self.cuts += len(lines)

    def counted(self) -> Counted:
        """What it took."""
        known = np.isfinite(self.off)
        return Counted(self.profiles, self.cuts, int((~known).sum()), float(self.off[known].max(initial=0.0)))


def by_border(size: tuple[int, int], vanishing: Point, stages: int = 1) -> Counted:
    """Profiles through the pixels of all sides that lines from the vanishing point leave by (Ecker 1991, §5.4.3).

    With stages (§5.7.2) every `stages`-th profile is whole; of the others the outer 1/2, 2/3, 3/4 … is kept: further
    inside, the lines of those that are longer lie closer than a pixel.
    """
    picture = Picture(size)
    for k, (side, wide) in enumerate([(0, size[0]), (size[1] - 1, size[0]), (0, size[1]), (size[0] - 1, size[1])]):
        rows = k < 2
        depth, near = (vanishing[1], size[1] - 1 - side) if rows else (vanishing[0], size[0] - 1 - side)
        inwards = -1.0 if side else 1.0
        if (depth - side) * inwards <= 0:
            continue
        # As far as the vanishing point, or the opposite side.
        last = min(max(depth, 0.0), float(size[1] - 1 if rows else size[0] - 1)) if side else min(depth, float(near))
        for pixel in range(wide):
            stage = pixel % stages
            part = 1.0 if stage == 0 else stage / (stage + 1)
            stop = side + part * (last - side) if stage == 0 else side + part * (depth - side)
            stop = stop if stage == 0 else stop + 1e-6 * inwards * -1
            picture.profile(vanishing, (pixel, side) if rows else (side, pixel), rows, side, stop)
    return picture.counted()


def by_angle(size: tuple[int, int], vanishing: Point) -> Counted:
    """Profiles that cut rows where they are steeper than 45°, columns elsewhere, no closer than they must (§5.7.1)."""
    picture = Picture(size)
    for rows in (True, False):
        k = 1 if rows else 0
        for way in (-1.0, 1.0):
            reach = (size[k] - 1 - vanishing[k]) if way > 0 else vanishing[k]
            nearest = max(0.0, -vanishing[k] if way > 0 else vanishing[k] - (size[k] - 1))
            if reach <= 0:
                continue
            for slope, far in _slopes(size[1 - k], vanishing[1 - k], max(nearest, 1e-9), reach):
                through = [0.0, 0.0]
                through[k], through[1 - k] = vanishing[k] + way * far, vanishing[1 - k] + slope * far
                start = vanishing[k] + way * nearest
                picture.profile(vanishing, (through[0], through[1]), rows, start, vanishing[k] + way * far)
    return picture.counted()


def _slopes(width: int, centre: float, nearest: float, reach: float) -> Iterator[tuple[float, float]]:
    """Slopes of the profiles of a sector, and how far from the vanishing point the picture goes along each of them.

    Neighbours lie a pixel apart where the picture is still wide enough for both.
    """
    left, right = -0.5 - centre, width - 0.5 - centre

    def far(slope: float) -> float:
        edge = right if slope > 0 else left
        return float(min(reach, edge / slope if slope * edge > 0 else np.inf))

    first = max(-1.0, min(-centre / reach, left / nearest))
    last = min(1.0, max((width - 1 - centre) / reach, right / nearest))
    if first > last:
        return
    ends = {first, last}
    ends |= {float(np.clip(edge / reach, min(ends), max(ends))) for edge in (-centre, width - 1 - centre)}
    cuts = sorted(ends)
    for low, high in itertools.pairwise(cuts):
        slope = low
        while slope < high - 1e-3 / reach:
            yield slope, far(slope)
            slope += 1.0 / max(far(slope), far(min(slope + 1.0 / far(slope), high)), 1.0)
    yield cuts[-1], far(cuts[-1])


def cuts_by_ecker(m: int, stages: int) -> float:
    """Cuts for m × m pixels around the vanishing point, by his eq. 5.5; with one stage eq. 5.4."""
    return 2 * m**2 / stages * (1 + sum((i - 1) / i for i in range(1, stages + 1)))


@njit(nogil=True, error_model="numpy")
def seen_by_profiles(
    posts: NDArray[np.float32], at: tuple[float, float, float], azimuth: float, focal: float, out: NDArray[np.float64]
) -> None:
    """Ground (x, y in meshes, height) of each pixel of a level camera, shape (rows, columns, 3); NaN: sky.

    The best case of profiles: the vanishing point is at infinity, each column of the picture is one profile, and no
    pixel lies beside it. Ground is straight between the borders of meshes.

    Parameters
    ----------
    posts : ndarray, shape (rows, columns)
        Heights in mesh widths.
    at : tuple
        Column, row and height of the camera, in meshes.
    azimuth : float
        Radians.
    focal : float
        Camera constant, pixels.
    """
    rows, columns = out.shape[0], out.shape[1]
    out[:] = np.nan
    for u in range(columns):
        a = np.arctan((u - (columns - 1) / 2) / focal)
        dx, dy, scale = np.sin(azimuth + a), -np.cos(azimuth + a), focal / np.cos(a)
        s = s0 = 0.0
        row = rows - 1
        slope0 = -np.inf
        z0 = 0.0
        x, y = at[0], at[1]
        while row >= 0:
            # To the next border of meshes.
            nx = (np.floor(x + 1e-9) + 1 - x) / dx if dx > 0 else (np.ceil(x - 1e-9) - 1 - x) / dx
            ny = (np.floor(y + 1e-9) + 1 - y) / dy if dy > 0 else (np.ceil(y - 1e-9) - 1 - y) / dy
            s += min(nx, ny)
            x, y = at[0] + s * dx, at[1] + s * dy
            if not (0 <= x <= posts.shape[1] - 1 and 0 <= y <= posts.shape[0] - 1):
                break
            i, j = min(int(x), posts.shape[1] - 2), min(int(y), posts.shape[0] - 2)
            fx, fy = x - i, y - j
            upper = posts[j, i] + fx * (posts[j, i + 1] - posts[j, i])
            lower = posts[j + 1, i] + fx * (posts[j + 1, i + 1] - posts[j + 1, i])
            z = upper + fy * (lower - upper) - at[2]
            slope = z / s
            while row >= 0 and ((rows - 1) / 2 - row) / scale <= slope:
                # The ray of this row meets the piece of ground that ends here.
                k = ((rows - 1) / 2 - row) / scale
                hit = s
                if slope0 > -np.inf:
                    hit = s0 + (s - s0) * (k * s0 - z0) / ((k * s0 - z0) - (k * s - z))
                out[row, u, 0], out[row, u, 1] = at[0] + hit * dx, at[1] + hit * dy
                out[row, u, 2] = at[2] + k * hit
                row -= 1
            s0, z0, slope0 = s, z, slope


@dataclass(frozen=True)
class Timed:
    """One picture by all methods, seconds of one processor."""

    profiles: float
    """Places alone, straight between borders of meshes."""
    columns: float
    """As photoplan sees it, column by column: normals, depths and directions as well."""
    rays: float
    """The same with a ray for each pixel."""
    apart: float
    """Part of the pixels whose places by profiles and by rays are farther apart than a tenth of a mesh."""
    same: float
    """Largest difference of places by columns and by rays, meshes."""


class _Posts:
    def __init__(self, posts: NDArray[np.float32]) -> None:
        self.posts, self.size = posts, (posts.shape[1], posts.shape[0])

    def read(self, window: Window) -> NDArray[np.float32]:
        return self.posts[window.row : window.stop[1], window.col : window.stop[0]]


def timed(side: int, size: tuple[int, int], seed: int = 1) -> Timed:
    """A level camera 0.1 of the side above rough terrain of so many posts, over flat earth."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    frequency[0, 0] = 1.0
    waves = rng.normal(size=frequency.shape) + 1j * rng.normal(size=frequency.shape)
    posts = np.fft.irfft2(waves * frequency**-2.2, (side, side))
    posts = (posts / posts.std() * side / 60).astype(np.float32)
    col, row = int(0.1 * side), int(0.9 * side)
    z = float(posts[row, col]) + side / 20
    focal = size[0] / 2 / np.tan(np.radians(30))
    out = np.empty((size[1], size[0], 3))
    bounds = (0.0, 1.0 - side, side - 1.0, 0.0)
    terrain = RasterSurface(_Posts(posts), (0.0, 0.0), (1.0, 1.0))
    ground = ViewGround(terrain, bounds, "EPSG:32632", None, None, ())
    request = CameraRequest(position=(col, -row), altitude=z, azimuth=45.0, size=size, curvature="none", refraction=0.0)
    target = view_camera(request, ground).target
    surface = SeenSurface(ground.terrain, ground.bounds)
    v, u = np.mgrid[: size[1], : size[0]].astype(float)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    spent = []
    for _ in range(2):  # the first compiles, and learns ranges of heights
        marks = [time.thread_time()]
        seen_by_profiles(posts, (col, row, z), np.radians(45.0), focal, out)
        marks.append(time.thread_time())
        columns = surface.look(target, target.window)
        marks.append(time.thread_time())
        seen = surface.at(target, pixels).reshaped(size[1], size[0])
        marks.append(time.thread_time())
        spent.append(np.diff(marks))
    apart = np.linalg.norm(out * (1, -1, 1) - seen.XYZ, axis=-1) > 0.1
    apart |= np.isnan(out[..., 2]) != np.isnan(seen.XYZ[..., 2])
    off = np.where(columns.owner == seen.owner, np.abs(columns.XYZ - seen.XYZ).max(axis=-1), np.inf)
    return Timed(*spent[-1], float(apart.mean()), float(np.nanmax(off)))


CASES: dict[str, tuple[tuple[int, int], Point]] = {
    "in the middle": ((120, 120), (59.5, 59.5)),
    "inside, beside the middle": ((120, 80), (30.3, 25.7)),
    "opposite a side": ((120, 80), (59.5, 200.0)),
    "opposite a corner": ((120, 80), (-150.0, 260.0)),
    "at infinity": ((120, 80), (59.5, 1e9)),
}


def main() -> None:
    """Print the tables of the page."""
    for m in (120,):
        for n in range(1, 6):
            print(m, n, by_border((m, m), (59.5, 59.5), n), cuts_by_ecker(m, n))
    for name, (size, vanishing) in CASES.items():
        print(name, by_border(size, vanishing), by_angle(size, vanishing), "rays", size[0] * size[1])
    for side, size in ((700, (1024, 763)), (4000, (2000, 1500))):
        print(side, size, timed(side, size))


if __name__ == "__main__":
    main()
