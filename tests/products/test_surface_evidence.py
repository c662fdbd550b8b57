"""What a surface states of itself in a small rendered town, and where a face lies in shade."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.rendered_block import Flight
from tools.rendered_town import GROUND, Judged, Solid, Town, judge, surface, write_town
from tools.small_block import X0, Y0

#: Six images 120 m up, pixels of 0.5 m, B : H between the outermost 0.5.
FLIGHT = Flight((X0, Y0), GROUND + 120, (30.0, 25.0), (3, 2), (190, 180), 240.0)
PIXEL = 0.5 * 120 / 65
WORDS = ("--resolution", 1.5, "--bounds", X0 - 27, Y0 - 27, X0 + 27, Y0 + 27, "--start", GROUND + 8, "--reach", 16)


def made(folder: Path, scene: Town) -> Judged:
    path = write_town(folder, scene, FLIGHT)
    surface(path, *WORDS)
    judged = judge(scene, folder / "products", PIXEL)
    print(judged)
    return judged


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> tuple[Judged, Path]:
    boxes = (
        ((-13, -11), (15, 12), 0.3, 12, 100, 18),
        ((14, -12), (13, 13), 0.9, 6, 150, 15),
        ((2, 14), (16, 12), 0.1, 17, 80, 18),
    )
    solids = [
        Solid.box((X0 + at[0], Y0 + at[1]), sides, turn, GROUND + height, grey, texture)
        for at, sides, turn, height, grey, texture in boxes
    ]
    folder = tmp_path_factory.mktemp("town")
    return made(folder, Town(tuple(solids), grain=1.0)), folder / "products"


def test_textured_roofs_do_not_claim_the_reach(town: tuple[Judged, Path]) -> None:
    judged, _ = town
    assert judged.right > 0.7 and judged.vague < 0.1
    inside = judged.known & (judged.off < 0.5) & (judged.sigma < 1)
    assert inside.mean() > 0.6


def test_wrong_heights_beside_walls_say_so(town: tuple[Judged, Path]) -> None:
    judged, _ = town
    assert judged.untold < 0.05


def test_heights_that_are_right_fit(town: tuple[Judged, Path]) -> None:
    judged, _ = town
    assert (judged.fit[judged.known & (judged.off < 0.5)] > 2).mean() < 0.1


def test_places_that_fewer_than_two_images_see_have_no_height(tmp_path: Path) -> None:
    """A yard of 6 m between walls of 30 m: at most one image looks down to its ground."""
    ring = [((0, 9), (24, 12)), ((0, -9), (24, 12)), ((9, 0), (12, 8)), ((-9, 0), (12, 8))]
    solids = tuple(Solid.box((X0 + x, Y0 + y), sides, 0.0, GROUND + 30, 120, 18) for (x, y), sides in ring)
    path = write_town(
        tmp_path, Town(solids, grain=1.0), Flight((X0 + 15, Y0), GROUND + 120, (30.0, 25.0), (2, 1), (190, 180), 240.0)
    )
    words = ("--resolution", 1.5, "--bounds", X0 - 14, Y0 - 14, X0 + 14, Y0 + 14, "--reach", 36, "--search")
    surface(path, *words, "--start", GROUND + 15)
    with rasterio.open(tmp_path / "products" / "surface.tif") as file:
        heights = file.read(1)
    with rasterio.open(tmp_path / "products" / "surface_sigma.tif") as file:
        sigma = file.read(1)
    middle = slice(len(heights) // 2 - 1, len(heights) // 2 + 2)
    yard, doubt = heights[middle, middle], sigma[middle, middle]
    assert (np.isnan(yard) | (np.abs(yard - GROUND) < 3 * doubt)).all(), (yard, doubt)


def test_a_face_in_shade_whose_sensor_pattern_is_no_texture(tmp_path: Path) -> None:
    """What stands there is not known to a pixel where noise and the sensor's pattern are all that is seen."""
    pyramid = Solid.pyramid((X0, Y0), 18, 0.5, 15, 120, 15)
    scene = Town((pyramid,), shade=0.97, sun=(0.9, -0.2, 0.25), pattern=0.7, noise=0.8, grain=1.0)
    judged = made(tmp_path, scene)
    assert judged.untold < 0.05 and judged.vague < 0.3
