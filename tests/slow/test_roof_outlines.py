"""Outlines of roofs in surfaces of a rendered town of narrow houses, close to each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools import rendered_town
from tools.rendered_block import Flight
from tools.rendered_town import GROUND, Solid, Town
from tools.small_block import X0, Y0

pytestmark = pytest.mark.slow
SIDE = 40.0


def narrow_houses(seed: int) -> Town:
    """Boxes of 4 to 14 m, 5 to 11 m wide, on lots of 18 m."""
    rng, houses = np.random.default_rng(seed), []
    for x in np.arange(-36, 37, 18.0):
        for y in np.arange(-36, 37, 18.0):
            at = X0 + x + rng.uniform(-2, 2), Y0 + y + rng.uniform(-2, 2)
            sides, turn = (rng.uniform(5, 11), rng.uniform(6, 16)), rng.uniform(0, np.pi)
            look = GROUND + rng.uniform(4, 14), rng.uniform(60, 180), rng.uniform(9, 18)
            houses.append(Solid.box(at, sides, turn, *look))
    return Town(tuple(houses))


def outside(house: Solid, XY: np.ndarray) -> np.ndarray:
    """Distance from the outline at places, negative inside."""
    return np.max([XY @ n[:2] - d for n, d in zip(house.normals[:4], house.offsets[:4])], axis=0)


def growth(scene: Town, path: Path) -> np.ndarray:
    """By how many posts the outlines of houses grow in a surface, means along each outline, (houses,)."""
    with rasterio.open(path) as file:
        heights, post = file.read(1).astype(float), file.res[0]
        col, row = np.meshgrid(np.arange(file.width) + 0.5, np.arange(file.height) + 0.5)
        XY = np.stack(file.transform @ (col, row), axis=-1)
    away = [outside(house, XY) for house in scene.solids]
    found = []
    for k, house in enumerate(scene.solids):
        if max(abs(house.middle[0] - X0), abs(house.middle[1] - Y0)) > SIDE - 12:
            continue
        lone = np.min([each for j, each in enumerate(away) if j != k], axis=0) >= 3
        near = (away[k] > -4) & (away[k] < 6) & lone & np.isfinite(heights)
        high = heights > (house.offsets[4] + GROUND) / 2
        excess = (near & high & (away[k] > 0)).sum() - float((near & ~high & (away[k] < 0)).sum())
        part = (near & (np.abs(away[k]) < 3)).sum() / (np.abs(away[k]) < 3).sum()
        length = 2 * sum(house.offsets[j] + house.offsets[j + 1] for j in (0, 2))
        found.append(excess * post / length / max(part, 0.3))
    return np.array(found)


def test_roofs_grow_by_less_than_a_post(tmp_path: Path) -> None:
    scene = narrow_houses(7)
    path = rendered_town.write_town(
        tmp_path, scene, Flight((X0, Y0), GROUND + 110, (22.0, 24.0), (4, 2), (400, 380), 400.0)
    )
    bounds = (X0 - SIDE, Y0 - SIDE, X0 + SIDE, Y0 + SIDE)
    rendered_town.surface(path, "--resolution", 0.6, "--bounds", *bounds, "--start", GROUND + 7, "--reach", 14)
    posts, judged = (
        growth(scene, tmp_path / "products" / "surface.tif"),
        rendered_town.judge(scene, tmp_path / "products", 0.69),
    )
    print(posts, judged)
    assert len(posts) == 9 and posts.mean() < 0.6 and posts.max() < 1.0
    assert judged.untold < 0.03 and judged.right > 0.8
