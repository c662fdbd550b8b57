"""Simulated blocks of images with known exposure, haze, vignetting and change, as cells of a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from photoplan.radiometry.balance import AdjustedBand
from photoplan.radiometry.equations import Cells, cells_of
from photoplan.radiometry.tone import Tone, powers_of, surface

#: Pixels of the map along the sides of an image, and from one to the next: 62 % overlap in both directions.
IMAGE, BASE = 256, 96
POWERS = powers_of(2)
PLACES = tuple(each.ravel() for each in np.meshgrid(*[(np.arange(9) + 0.5) * IMAGE / 9 - 0.5] * 2))
"""Columns and rows of an image at which trends are compared."""


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

    def tables(self, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the images show of ground of some grey values, (images, nodes)."""
        return np.asarray(self.low[:, None] + self.factor[:, None] * nodes)

    def tones(self) -> dict[int, tuple[Tone]]:
        """What gives the ground back."""
        ends, grey = np.array([0.0, 255.0]), self.tables(np.array([0.0, 255.0]))
        terms = [tuple((i, j, float(c)) for (i, j), c in zip(POWERS, trend)) for trend in self.trends]
        return {k: (Tone(tuple(grey[k].tolist()), tuple(ends.tolist()), terms[k]),) for k in range(len(grey))}

    def trend_errors(self, made: AdjustedBand) -> NDArray[np.float64]:
        """Rms error of the trend over each image, (images,)."""
        trend, _, mean = self.compared(made)
        shapes = surface(*PLACES, (IMAGE, IMAGE), POWERS)
        return np.asarray(np.sqrt(((trend / mean[:, None] - (1 + self.trends @ shapes.T)) ** 2).mean(axis=1)))

    def compared(self, made: AdjustedBand) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Trends found at `PLACES` of the images (images, places), their standard deviations, and the trends' means."""
        basis, width = made.prior.basis, made.state.width
        shapes = basis.at(*PLACES, (IMAGE, IMAGE))
        trend = np.exp(made.state.trends @ shapes.T)
        errors = made.errors[: len(trend) * width].reshape(len(trend), width, -1)[:, -len(basis.kinds) :]
        sigma = np.sqrt(np.square(shapes @ errors).sum(axis=2))
        return trend, sigma, trend.mean(axis=1)


def block_of(
    rows: int, columns: int, seed: int = 0, change: float = 0.0, noise: float = 1.0, reference: bool = False
) -> tuple[Scene, Truth]:
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
        while (view != ground[at][:IMAGE, :IMAGE]).mean() < change:
            (r, c), (high, wide) = rng.integers(-20, IMAGE - 20, 2), rng.integers(30, 70, 2)
            view[max(r, 0) : r + high, max(c, 0) : c + wide] += rng.choice([-40, 40])
        grey = (low[k] + factor[k] * view) * (1 + shapes @ trends[k]) + rng.normal(0, noise, view.shape)
        values[k, 0][at][:IMAGE, :IMAGE] = np.clip(np.rint(grey), 0, 255)
        valid[k][at][:IMAGE, :IMAGE] = True
    known = (ground[None].astype(np.float32), np.ones(ground.shape, bool)) if reference else None
    cells = cells_of(values, valid, np.arange(count), reference=known)
    cells.uv[:] -= np.stack([cells.image % columns, cells.image // columns], axis=1)[:, None] * BASE
    sizes = np.tile([IMAGE, IMAGE], (count, 1))
    return Scene(cells, sizes), Truth(low, factor, trends, sizes)
