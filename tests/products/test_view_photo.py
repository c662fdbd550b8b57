"""A photograph against its view: the same pixels, over the picture, in squares with it, and beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import inside
from tools.small_block import SIZE, Block, write_block

from photoplan.errors import UsageError
from photoplan.requests.view import PhotoRequest


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Block:
    return write_block(tmp_path_factory.mktemp("photo") / "block")


def picture(small: Block, out: Path, *words: object) -> np.ndarray:
    content = ("--content", "shade", "--samples", 1, "--overwrite", "-q")
    said = inside("view", small.project, "--camera", "one", *content, *words, "-o", out)
    assert said.code == 0, said.err
    with rasterio.open(out) as file:
        return file.read().astype(int)


@pytest.fixture(scope="module")
def image(small: Block) -> np.ndarray:
    with rasterio.open(small.images[0]) as file:
        values = file.read().astype(int)
    return values[[0, 1, 2] if len(values) >= 3 else [0, 0, 0]]


def test_over_it_with_an_opacity(small: Block, image: np.ndarray, tmp_path: Path) -> None:
    plain = picture(small, tmp_path / "v.png")
    for how, part in (("", 0.5), ("@0.3", 0.3), ("@1", 1.0)):
        got = picture(small, tmp_path / "v.png", "--photo", f"{small.images[0]}{how}")
        assert np.abs(got - (plain + part * (image - plain))).max() <= 0.5 + 1e-3
    assert np.abs(image - plain).mean() > 10


def test_in_squares_with_it(small: Block, image: np.ndarray, tmp_path: Path) -> None:
    plain = picture(small, tmp_path / "v.png")
    got = picture(small, tmp_path / "s.png", "--photo", f"{small.images[0]}@squares")
    side = -(-max(SIZE) // 16)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] // side
    np.testing.assert_array_equal(got, np.where((u + v) % 2, image, plain))


def test_beside_it_with_the_lines_of_both(small: Block, image: np.ndarray, tmp_path: Path) -> None:
    """Tiles of 512 pixels lie across the border; the matrix gives the ground of pixels of both."""
    lines = ("--lines", "contours:5@colour=#ff0000,width=2")
    plain, drawn = picture(small, tmp_path / "v.png"), picture(small, tmp_path / "l.png", *lines)
    got = picture(small, tmp_path / "b.png", "--photo", f"{small.images[0]}@beside")
    assert got.shape == (3, SIZE[1], 2 * SIZE[0])
    np.testing.assert_array_equal(got[..., : SIZE[0]], plain)
    np.testing.assert_array_equal(got[..., SIZE[0] :], image)
    both = picture(small, tmp_path / "b.png", "--photo", f"{small.images[0]}@beside", *lines)
    np.testing.assert_array_equal(both[..., : SIZE[0]], drawn)
    red = (drawn == [[[255]], [[0]], [[0]]]).all(axis=0)
    changed = (both[..., SIZE[0] :] != image).any(axis=0)
    assert red.sum() > 100 and changed[red].mean() > 0.99 and changed.mean() < 0.5


def test_what_does_not_belong_to_the_picture_is_refused(small: Block, tmp_path: Path) -> None:
    words = ("--from", 0, 0, "--altitude", 9e3, "--azimuth", 0, "--force", "--size", 40, 30, "-o", tmp_path / "n.png")
    said = inside("view", small.terrain, *words, "--photo", small.images[0])
    assert said.code != 0 and f"{SIZE[0]} × {SIZE[1]} pixels, the picture has 40 × 30" in said.err
    assert not (tmp_path / "n.png").exists()
    said = inside("view", small.terrain, *words, "--photo", tmp_path / "none.jpg")
    assert said.code != 0 and "none.jpg" in said.err
    for text in ("a.jpg@0", "a.jpg@2", "a.jpg@under"):
        with pytest.raises(UsageError, match=r"a\.jpg"):
            PhotoRequest.parse(text)
