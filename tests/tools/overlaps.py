"""Simulated blocks of images with known exposure, haze, vignetting and change, as cells of a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from photoplan.radiometry.balance import Balanced
from photoplan.radiometry.cells import SIDE, Cells, cells_of
from photoplan.radiometry.tone import powers_of, surface

#: Pixels of the map along the sides of an image, and from one to the next: 62 % overlap in both directions.
IMAGE, BASE = 160, 64
POWERS = powers_of(2)


@dataclass(frozen=True, eq=False)
class Scene:
    """What images show."""

    cells: Cells
    sizes: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Truth:
    """What was done to the images: grey = (low + factor · ground) · trend."""

    low: NDArray[np.float64]
    factor: NDArray[np.float64]
    trends: NDArray[np.float64]
    """(images, terms)."""
    sizes: NDArray[np.int64]

    def trend_error(self, made: Balanced) -> float:
        """Largest rms over an image of the gain's error, beside what all images have in common."""
        x, y = np.meshgrid(np.linspace(0, IMAGE - 1, 9), np.linspace(0, IMAGE - 1, 9))
        shapes = surface(x, y, (IMAGE, IMAGE), POWERS).reshape(-1, len(POWERS))
        found = np.array([[c for _, _, c in tone[0].terms] for tone in made.tones])
        error = (found - self.trends) @ shapes.T
        error -= error.mean(axis=0)
        return float(np.sqrt((error**2).mean(axis=1)).max())


def block_of(rows: int, columns: int, seed: int = 0, change: float = 0.0, noise: float = 1.0) -> tuple[Scene, Truth]:
    """Images in a regular block over one ground, one band, and what was done to them."""
    rng = np.random.default_rng(seed)
    height, width = (IMAGE + (n - 1) * BASE for n in (rows, columns))
    parts = sum(s * gaussian_filter(rng.normal(size=(height, width)), s) for s in (1, 4, 20))
    ground = 125 + 28 * (parts - parts.mean()) / parts.std()
    count = rows * columns
    low, factor = rng.uniform(0, 25, count), rng.uniform(0.75, 1.05, count)
    vignetting = np.array([0, 0, -0.25, 0, -0.25])
    trends = vignetting + rng.normal(0, 0.03, (count, len(POWERS)))
    x, y = np.meshgrid(np.arange(IMAGE), np.arange(IMAGE))
    shapes = surface(x, y, (IMAGE, IMAGE), POWERS)
    values = np.zeros((count, 1, height, width), np.float32)
    valid = np.zeros((count, height, width), bool)
    for k in range(count):
        at = np.s_[k // columns * BASE :, k % columns * BASE :]
        view = ground[at][:IMAGE, :IMAGE].copy()
        for _ in range(round(change * IMAGE**2 / SIDE**2)):
            r, c = rng.integers(0, IMAGE - SIDE, 2)
            view[r : r + SIDE, c : c + SIDE] += rng.choice([-40, 40])
        grey = (low[k] + factor[k] * view) * (1 + shapes @ trends[k]) + rng.normal(0, noise, view.shape)
        values[k, 0][at][:IMAGE, :IMAGE] = np.clip(np.rint(grey), 0, 255)
        valid[k][at][:IMAGE, :IMAGE] = True
    cells, middle = cells_of(values, valid, np.arange(count))
    cells.uv[:] = middle - np.stack([cells.image % columns, cells.image // columns], axis=1) * BASE
    sizes = np.tile([IMAGE, IMAGE], (count, 1))
    return Scene(cells, sizes), Truth(low, factor, trends, sizes)
