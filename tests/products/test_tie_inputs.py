"""What tie points start from: what is known of cameras and places, and how pairs follow from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tools.small_block import BASE, X0, Y0, Z0, Block, texture, write_block, write_image

from photoplan.errors import InputError
from photoplan.io.project.file import load_project
from photoplan.matching.features import Guide
from photoplan.products.tie import TieImage, chosen_pairs, guide_of, open_images

NAMES = ["one", "two", "three"]
FILM = """format = 1
crs = "EPSG:32633"

[cameras.film]
type = "film"
camera_constant_mm = 153.0
size = [200, 150]
fiducials_mm = { A = [-10.0, 7.0], B = [10.0, 7.0], C = [10.0, -7.0], D = [-10.0, -7.0] }
"""


@pytest.fixture
def block(tmp_path: Path) -> Block:
    return write_block(tmp_path / "block")


def opened(path: Path, use_orientation: bool = True) -> tuple[list[TieImage], list[str]]:
    project = load_project(path)
    return open_images(project, project.select(), use_orientation)


def test_with_orientation_and_terrain_footprints_decide(block: Block) -> None:
    images, notes = opened(block.project)
    assert notes == [] and all(i.placed and i.calibration is not None for i in images)
    pairs, chosen = chosen_pairs(images, "auto")
    assert pairs == [(0, 1), (0, 2), (1, 2)] and "common ground" in chosen
    xy = np.array([[100.0, 75.0], [20.0, 30.0]])
    guide = guide_of(images[0], images[1], xy)
    assert isinstance(guide, Guide) and guide.radius == pytest.approx(0.15 * 250)
    back = guide_of(images[1], images[0], guide.xy)
    assert back is not None
    # The two images stand over ground of slightly different height.
    np.testing.assert_allclose(back.xy, xy, atol=4.0)


def test_without_orientation_nothing_is_guided(block: Block) -> None:
    images, _ = opened(block.project, use_orientation=False)
    assert not any(i.placed for i in images) and all(i.position is None for i in images)
    assert chosen_pairs(images, "auto") == ([(0, 1), (0, 2), (1, 2)], "all pairs")
    assert guide_of(images[0], images[1], np.zeros((1, 2))) is None
    assert chosen_pairs(images * 11, "auto")[0] is None


def test_positions_alone_choose_neighbours(block: Block) -> None:
    rows = [f"{n},{X0 + far},{Y0},{Z0}" for n, far in zip(NAMES, (0, BASE, 50 * BASE))]
    (block.folder / "gnss.csv").write_text("name,x,y,z\n" + "\n".join(rows) + "\n")
    text = block.project.read_text()
    head, *images = text.split("[[images]]")
    images = ["".join(x for x in i.splitlines(True) if not x.startswith(("center", "angles"))) for i in images]
    path = block.folder / "gnss.toml"
    path.write_text("[[images]]".join([head, *images]) + '\n[observations]\npositions = "gnss.csv"\n')
    found, _ = opened(path)
    assert not any(i.placed for i in found)
    pairs, chosen = chosen_pairs(found, "auto")
    assert pairs is not None and "position" in chosen
    assert [{found[i].name, found[j].name} for i, j in pairs] == [{"one", "two"}]


def film(tmp_path: Path, fiducials: str) -> tuple[list[TieImage], list[str]]:
    for name in "ab":
        write_image(tmp_path / f"{name}.tif", texture(bands=1))
    entries = [f'\n[[images]]\nname = "{n}"\nfile = "{n}.tif"\ncamera = "film"\n{fiducials}' for n in "ab"]
    path = tmp_path / "film.toml"
    path.write_text(FILM + "".join(entries))
    return opened(path)


def test_film_scans_have_features_inside_their_marks(tmp_path: Path) -> None:
    images, notes = film(
        tmp_path, "fiducials = { A = [20.0, 15.0], B = [180.0, 15.0], C = [180.0, 127.0], D = [20.0, 127.0] }\n"
    )
    assert notes == [] and images[0].calibration is not None
    assert images[0].grey.area == pytest.approx((20 + 3.2, 15 + 2.24, 180 - 3.2, 127 - 2.24))


def test_film_scans_without_marks_are_verified_without_a_camera(tmp_path: Path) -> None:
    images, notes = film(tmp_path, "")
    assert [i.calibration for i in images] == [None, None] and images[0].grey.area is None
    assert len(notes) == 2 and "fiducial marks not measured" in notes[0]


def test_an_image_of_another_size_is_refused(block: Block) -> None:
    write_image(block.images[0], texture(size=(210, 150)))
    with pytest.raises(InputError, match="210 × 150 pixels, but camera"):
        opened(block.project)
