"""Noise of an image: of pure noise without bias, and apart from edges, ramps and texture elsewhere."""

import numpy as np
import pytest
from tools.blurred_scenes import any_edges, taken

from photoplan.quality.restoration.design import BLOCK_IMAGE_NOISE as BLOCK
from photoplan.quality.restoration.design import block_noise, image_noise


def test_pure_noise():
    rng = np.random.default_rng(11)
    found = [image_noise(block_noise(rng.normal(100.0, 2.5, (480, 480)))) for _ in range(10)]
    assert np.mean(found) == pytest.approx(2.5, rel=0.01)
    assert np.std(found) < 0.05


def test_ramps_and_edges_along_the_grid_are_no_noise():
    row, col = np.mgrid[:96, :96]
    scene = 3.0 * row - 2.0 * col + np.where(col > 40, 100.0, 0.0) + np.where(row > 50, 30.0, 0.0)
    assert block_noise(scene) == pytest.approx(0.0, abs=1e-10)
    assert np.isnan(image_noise(block_noise(np.full((96, 96), 7.0))))


def test_a_scene_with_edges_does_not_count_as_noise():
    rng = np.random.default_rng(12)
    image, _ = taken(any_edges(rng), 0.6, rng, noise=1.0)
    assert image_noise(block_noise(image)) == pytest.approx(1.0, rel=0.06)
    assert image_noise(block_noise(image)) < 0.5 * float(np.median(np.abs(np.diff(image, axis=1)))) * 2.5


def test_blocks_with_invalid_pixels_are_left_out():
    rng = np.random.default_rng(13)
    grey = rng.normal(0.0, 1.0, (5 * BLOCK, 4 * BLOCK + 7))
    valid = np.ones(grey.shape, bool)
    valid[0, 0] = valid[2 * BLOCK, BLOCK] = False
    grey[0, 0] = 1e9
    assert block_noise(grey, valid).shape == (18,)
    grey[0, 0] = np.nan
    assert block_noise(grey).shape == (19,)
    assert block_noise(grey[:10, :10]).size == 0
