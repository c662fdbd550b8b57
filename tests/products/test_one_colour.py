"""Images of one grey value: which are, and that a mosaic names them as `balance` and `seams` do."""

from __future__ import annotations

import numpy as np
import pytest
from tools.command import Here
from tools.small_block import SIZE, Block, write_image

from photoplan.engine.execute import ArrayReader
from photoplan.products.plausibility import one_colour


def test_a_black_image_is_named_by_a_mosaic(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    write_image(small.images[2], np.zeros((3, *SIZE[::-1]), np.uint8))
    words = ("--resolution", 4, "--tile", 128, "--no-quicklook", "--no-overviews")
    said = photoplan("mosaic", small.project, *words)
    assert said.code == 0
    assert said.err.count("note: 'three' has the grey value 0 everywhere; look at its file, or take the image out") == 1
    assert said.err.count("everywhere") == 1


def test_one_other_pixel_anywhere_is_enough() -> None:
    pixels = np.full((1, 1100, 1300), 7, np.uint16)
    assert one_colour(ArrayReader(pixels)) == 7.0
    for row, col in ((0, 0), (5, 650), (1099, 1299)):
        other = pixels.copy()
        other[0, row, col] = 8
        assert one_colour(ArrayReader(other)) is None
        # What is not valid does not count.
        valid = other[0] == 7
        assert one_colour(ArrayReader(other, valid)) == 7.0
    assert one_colour(ArrayReader(pixels, np.zeros(pixels.shape[1:], bool))) is None
    # A blue image is not of one grey value; parts of different grey are not, either.
    assert one_colour(ArrayReader(np.concatenate([pixels, pixels + 1]))) is None
    halves = pixels.copy()
    halves[0, 1024:] = 9
    assert one_colour(ArrayReader(halves)) is None
