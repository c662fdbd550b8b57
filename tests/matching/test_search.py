"""Heights searched on planes, against a block that stands on level ground; cameras are parallel rays."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from matching.test_facets import Pixels

from photoplan.cameras.base import Vantage
from photoplan.geometry.grid import MapGrid, Window
from photoplan.matching.facets.block import edge_variances, misfit_variances
from photoplan.matching.facets.observe import Pyramid, View
from photoplan.matching.facets.reconstruct import Planes, Search, search

SIDE, TALL = 200, 30.0
BLOCK = (slice(60, 120), slice(70, 140))


@dataclass(frozen=True)
class Parallel:
    """Rays that all go by `slope` pixels of one metre along X for each metre of height."""

    slope: float
    field = None
    vantage = Vantage(np.array([100.0, -100.0, 1e5]), reach=1e6)

    def project_homogeneous(self, XYZ: np.ndarray) -> np.ndarray:
        x = XYZ[..., 0] - 0.5 + self.slope * XYZ[..., 2]
        return np.stack([x, -XYZ[..., 1] - 0.5, np.ones(x.shape)], axis=-1)

    def derivatives(self, XYZ: np.ndarray) -> np.ndarray:
        return np.array([[1.0, 0.0, self.slope], [0.0, -1.0, 0.0]])


def seen(slope: float, texture: np.ndarray) -> np.ndarray:
    """What such a camera sees of the block: for every pixel the first thing on its ray, from above."""
    tall = np.zeros((SIDE, SIDE), bool)
    tall[BLOCK] = True
    rows, columns = np.mgrid[:SIDE, :SIDE]
    out, met = np.zeros((SIDE, SIDE)), np.zeros((SIDE, SIDE), bool)
    for z in np.linspace(TALL, 0, 61):
        at = columns - slope * z
        near = np.clip(np.rint(at).astype(int), 0, SIDE - 1)
        left, part = np.clip(np.floor(at).astype(int), 0, SIDE - 2), at - np.floor(at)
        # What was met higher up hides this.
        hit = ~met & (tall[rows, near] if z > 0 else True)
        out = np.where(hit, texture[rows, left] * (1 - part) + texture[rows, left + 1] * part, out)
        met |= hit
    return out


def test_a_block_on_level_ground() -> None:
    """30 m, which is 15 pixels of parallax between the outer ones of three cameras, found from ground 5 m below."""
    rng = np.random.default_rng(3)
    texture = rng.normal(100, 20, (SIDE, SIDE))
    views = []
    for slope in (-0.25, 0.0, 0.25):
        image = seen(slope, texture) + rng.normal(0, 2, (SIDE, SIDE))
        views.append(View(Parallel(slope), Pyramid(Pixels(image), span=3)))
    grid = MapGrid(0.0, 0.0, 2.0, 100, 100, "EPSG:32633")
    window = Window(20, 20, 60, 60)
    how = Search(Planes(2.0, 0.0), 2, 0, 1, 6.0)
    found = search(views, grid, window, how, lambda XY: np.full(XY.shape[:-1], -5.0), 60.0)
    assert found is not None
    uv = found.facets.to_posts(grid.to_map(np.array([20.0, 20.0]))).astype(int)
    heights, margin = (a[uv[1] : uv[1] + 60, uv[0] : uv[0] + 60] for a in (found.heights, found.margin))
    true = np.zeros((100, 100))
    true[30:60, 35:70] = TALL
    off, sure = np.abs(heights - true[20:80, 20:80]), margin > 0.5
    spread = np.sqrt(found.variance[uv[1] : uv[1] + 60, uv[0] : uv[0] + 60])
    print((off < 1).mean(), sure.mean(), (off[sure] < 1).mean(), (off > 5 * spread + 1).mean(), (spread > 1).mean())
    assert (off < 1).mean() > 0.9 and sure.mean() > 0.7 and (off[sure] < 1).mean() > 0.97
    # Where it went wrong it says so, and only near the block's edges does it doubt.
    assert (off > 5 * spread + 1).mean() < 0.002 and (spread > 1).mean() < 0.1


def test_many_images_of_which_few_see_each_place() -> None:
    """Eight images, two of which see each quarter of the ground: pairs that do not see a place do not count for it."""
    rng = np.random.default_rng(5)
    texture = rng.normal(100, 20, (SIDE, SIDE))
    views = []
    for part in range(4):
        for side in (-0.25, 0.25):
            slope = side + 0.1 * (part - 1.5)
            image = seen(slope, texture) + rng.normal(0, 2, (SIDE, SIDE))
            rows = np.arange(SIDE)
            image[(rows < 50 * part - 8) | (rows > 50 * part + 58)] = np.nan
            views.append(View(Parallel(slope), Pyramid(Pixels(image), span=3)))
    grid = MapGrid(0.0, 0.0, 2.0, 100, 100, "EPSG:32633")
    window = Window(20, 20, 60, 60)
    how = Search(Planes(2.0, 0.0), 2, 0, 1, 6.0)
    found = search(views, grid, window, how, lambda XY: np.full(XY.shape[:-1], -5.0), 60.0)
    assert found is not None
    uv = found.facets.to_posts(grid.to_map(np.array([20.0, 20.0]))).astype(int)
    heights = found.heights[uv[1] : uv[1] + 60, uv[0] : uv[0] + 60]
    true = np.zeros((100, 100))
    true[30:60, 35:70] = TALL
    close = (np.abs(heights - true[20:80, 20:80]) < 1).mean()
    print(close)
    assert close > 0.85


def test_beside_a_step_a_height_may_be_any_of_it() -> None:
    heights = np.zeros((6, 7))
    heights[:, 4:] = 9.0
    heights[:3, :2] = 2.0
    block = SimpleNamespace(heights=heights, scale=1.0, facets=SimpleNamespace(shape=(6, 7), ratio=3))
    found = edge_variances(block)  # 9 pixels of parallax over three are a wall, 2 are a slope
    assert np.allclose(found[:, 3:5], 81 / 12) and (np.delete(found, (3, 4), axis=1) == 0).all()


def test_a_post_whose_height_no_two_images_show_is_not_found_elsewhere() -> None:
    """Ground that a second image sees only where it would lie lower: what matches there by chance is not believed."""
    rng = np.random.default_rng(8)
    texture = rng.normal(100, 20, (SIDE, SIDE))
    views = []
    for slope in (-0.25, 0.25):
        image = texture + rng.normal(0, 2, (SIDE, SIDE))
        if slope > 0:
            image[:, 100:] = np.nan
        views.append(View(Parallel(slope), Pyramid(Pixels(image), span=3)))
    grid = MapGrid(0.0, 0.0, 2.0, 100, 100, "EPSG:32633")
    window = Window(20, 20, 60, 60)
    found = search(
        views, grid, window, Search(Planes(2.0, 0.0), 2, 0, 1, 6.0), lambda XY: np.zeros(XY.shape[:-1]), 60.0
    )
    assert found is not None
    uv = found.facets.to_posts(grid.to_map(np.array([20.0, 20.0]))).astype(int)
    heights, spread = (a[uv[1] : uv[1] + 60, uv[0] : uv[0] + 60] for a in (found.heights, np.sqrt(found.variance)))
    off = np.abs(heights)
    print((off[:, :25] < 1).mean(), (off > 5 * spread + 1).mean(axis=0))
    assert (off[:, :25] < 1).mean() > 0.98
    assert (off > 5 * spread + 1).mean() < 0.01


def test_where_pixels_do_not_fit_a_height_may_be_any_of_those_around() -> None:
    heights = np.zeros((20, 20))
    heights[:, 10:] = 6.0
    misfit = np.ones((20, 20))
    misfit[6, 9], misfit[6, 2], misfit[3, 9], misfit[0, 0] = 2.6, 2.6, 1.3, np.nan
    found = misfit_variances(SimpleNamespace(heights=heights), misfit)
    # Three quarters of the squared residuals are not noise; what lies on even ground is not farther off than that.
    assert np.isclose(found[6, 9], 0.75**2 * 36 / 12) and np.count_nonzero(found) == 1
