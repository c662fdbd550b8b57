"""Scans with fiducial marks at known places: marks are written as distances to circles and lines, not as polygons."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.cameras.fiducials import MarkPart, MarkPattern
from photoplan.geometry.grid import Window

__all__ = ["CORNERS", "ArrayScan", "Simulated", "ring_cross_pattern", "ring_cross_tone", "simulate"]

Array = NDArray[np.float64]

CORNERS = {"1": (-26.003, -25.998), "2": (26.002, 25.997), "3": (-25.996, 26.004), "4": (25.999, -26.001)}
RADIUS, LINE, ARM, FREE = 0.9, 0.18, 1.5, 0.35
FINE = 5
"""Samples of a pixel along each side."""


class ArrayScan:
    """A scan in memory."""

    def __init__(self, pixels: NDArray[np.floating]) -> None:
        self.pixels = np.asarray(pixels, np.float32)
        self.largest = 0

    @property
    def size(self) -> tuple[int, int]:
        return self.pixels.shape[1], self.pixels.shape[0]

    def grey(self, window: Window, factor: int = 1) -> NDArray[np.float32]:
        assert window.width % factor == 0 and window.height % factor == 0
        assert window.col >= 0 and window.row >= 0 and (np.array(window.stop) <= self.size).all()
        self.largest = max(self.largest, window.size // factor**2)
        part = self.pixels[window.row : window.stop[1], window.col : window.stop[0]]
        return part.reshape(window.height // factor, factor, window.width // factor, factor).mean((1, 3), np.float32)


def ring_cross_tone(x: Array, y: Array) -> Array:
    """1 on a ring with a diagonal cross, 0 beside it; millimetres about its centre."""
    r = np.hypot(x, y)
    u, v = (x + y) / np.sqrt(2), (y - x) / np.sqrt(2)
    ring = np.abs(r - RADIUS) <= LINE / 2
    arms = (
        (np.minimum(np.abs(u), np.abs(v)) <= LINE / 3)
        & (np.maximum(np.abs(u), np.abs(v)) <= ARM)
        & (np.maximum(np.abs(u), np.abs(v)) >= FREE)
    )
    return (ring | arms).astype(float)


def ring_cross_pattern() -> MarkPattern:
    """The description of the same mark, as polygons."""
    a = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    circle = np.column_stack([np.cos(a), np.sin(a)])
    parts = [MarkPart(circle * (RADIUS + LINE / 2), 1.0), MarkPart(circle * (RADIUS - LINE / 2), 0.0)]
    for k in range(4):
        c, s = np.cos(np.pi / 4 + k * np.pi / 2), np.sin(np.pi / 4 + k * np.pi / 2)
        bar = np.array([(FREE, -LINE / 3), (ARM, -LINE / 3), (ARM, LINE / 3), (FREE, LINE / 3)])
        parts.append(MarkPart(bar @ np.array([[c, s], [-s, c]]), 1.0))
    return MarkPattern("ring_cross", tuple(parts), 0.0, (-1.4, -1.4, 1.4, 1.4))


@dataclass(frozen=True)
class Simulated:
    """How a scan is made."""

    marks: dict[str, tuple[float, float]] = field(default_factory=lambda: dict(CORNERS))
    pixel_mm: float = 0.1
    rotation: int = 0
    """Counter-clockwise, degrees."""
    mirrored: bool = False
    negative: bool = False
    small_turn: float = 0.0
    """Clockwise, degrees."""
    shrinkage: tuple[float, float] = (0.0004, -0.0003)
    blur: float = 0.8
    noise: float = 9.0
    offset: tuple[float, float] = (0.0, 0.0)
    """Of the film from the scan's middle, millimetres."""
    side: float = 66.0
    picture: float = 22.5
    """Half side of the exposed picture."""
    covered: tuple[str, ...] = ()
    false: tuple[tuple[float, float], ...] = ()
    """Further marks that are none, millimetres."""
    contrast: float = 180.0


def simulate(made: Simulated, seed: int) -> tuple[Array, dict[str, tuple[float, float]]]:
    """Grey values, and the true column and row of every mark."""
    rng = np.random.default_rng(seed)
    n = round(made.side / made.pixel_mm)
    t = np.radians(made.small_turn)
    k = np.radians(made.rotation)
    flip = np.diag([-1.0 if made.mirrored else 1.0, 1.0])
    turn = np.array([[np.cos(k), -np.sin(k)], [np.sin(k), np.cos(k)]]) @ flip  # right and up
    down = np.diag([1.0, -1.0]) @ turn  # columns and rows
    small = np.array([[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]])
    matrix = small @ down @ np.diag(1.0 + np.array(made.shrinkage)) / made.pixel_mm
    shift = (n - 1) / 2 + np.array(made.offset) / made.pixel_mm
    rows, columns = np.indices((n, n), dtype=float)
    mm = np.stack([columns - shift[0], rows - shift[1]], -1) @ np.linalg.inv(matrix).T
    inside = np.abs(mm).max(axis=-1) < made.picture
    texture = ndimage.gaussian_filter(rng.normal(size=(n, n)), 2.5) + ndimage.gaussian_filter(
        rng.normal(size=(n, n)), 9
    )
    tone = np.where(inside, 0.45 + 1.5 * texture, 0.0)
    half = int(np.ceil(2.2 / made.pixel_mm))
    truth = {}
    drawn = [(name, xy) for name, xy in made.marks.items()] + [("", xy) for xy in made.false]
    for name, xy in drawn:
        at = matrix @ np.array(xy) + shift
        if name:
            truth[name] = (float(at[0]), float(at[1]))
        if name in made.covered:
            continue
        c0, r0 = np.round(at).astype(int) - half
        fine = (np.arange((2 * half + 1) * FINE) + 0.5) / FINE - 0.5
        px = np.stack(np.meshgrid(c0 + fine - at[0], r0 + fine - at[1]), -1)
        d = px @ np.linalg.inv(matrix).T
        share = ring_cross_tone(d[..., 0], d[..., 1]).reshape(2 * half + 1, FINE, 2 * half + 1, FINE).mean((1, 3))
        part = tone[r0 : r0 + 2 * half + 1, c0 : c0 + 2 * half + 1]
        part[:] = part * (1 - share) + share
    grey = 40 + made.contrast * ndimage.gaussian_filter(tone, made.blur)
    if made.negative:
        grey = 255.0 - grey
    return grey + rng.normal(0, made.noise, grey.shape), truth
