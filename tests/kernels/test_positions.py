"""Positions that the engine uses, against double precision."""

from __future__ import annotations

import numpy as np
import pytest
from kernel_reference import Mapping

from photoplan.kernels.jit import COMPILED
from photoplan.kernels.positions import RUN, positions

SIDE = 700 if COMPILED else 24


def camera(scale, tilt, window):
    """A tilted frame camera over a map, w = 1 in the middle; the positions lie around the middle of the window."""
    c, s = np.cos(0.4), np.sin(0.4)
    w = [tilt / SIDE, -tilt / SIDE / 2, -4e-4, 1.0 - tilt / 4 + 4e-4 * 50]
    middle = np.array([window / 2, window / 2.3])
    rows = []
    for direction, at, per_metre in (
        (scale * np.array([c, -s]), middle[0], 0.2),
        (scale * np.array([s, c]), middle[1], -0.3),
    ):
        rows.append(
            [*(direction + at * np.array(w[:2])), per_metre + at * w[2], at * w[3] - direction.sum() * SIDE / 2]
        )
    return Mapping([*rows, w])


@pytest.mark.parametrize("window", [600, 9000])
@pytest.mark.parametrize("scale", [0.2, 1.0, 6.0, 40.0])
@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_pinhole_is_exact_to_a_thousandth_of_a_pixel(scale, tilt, window):
    """For a box of any size, over 300 m of relief; at 40 source pixels per pixel, to a thousandth of those."""
    mapping = camera(scale, tilt, window)
    relief = np.random.default_rng(0).uniform(-100, 200, (SIDE, SIDE)).astype(np.float32)
    u, v = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    x, y = mapping.xy(u, v, relief)
    for rects, levels in (
        ([[0, 0, SIDE, SIDE]], (-100.0, 200.0)),
        ([[0, 0, 9, SIDE], [9, 0, SIDE, SIDE]], (-100.0, 0.0, 37.0, 200.0)),
    ):
        found = positions(mapping.anchors(rects, levels), relief).astype(float)
        # What float32 cannot hold of the result itself is not the engine's error.
        rounding = np.spacing(np.abs(np.stack([x, y], axis=-1)).astype(np.float32)) / 2
        error = np.abs(found - np.stack([x, y], axis=-1)) - rounding
        assert error.max() < max(1e-3, 1e-3 * scale / 10)
    assert (scale, tilt, window) != (1.0, 0.0, 600) or error.max() < 1e-4


def test_boxes_need_not_agree_and_each_takes_its_heights():
    low, high = Mapping.similarity(shift=(5.0, 5.0)), Mapping.similarity(shift=(25.0, 8.0))
    anchors = low.anchors([[0, 0, 6, 6]], (0.0, 10.0, 20.0))
    anchors[3][1] = high.anchors([[0, 0, 6, 6]], (10.0, 20.0))[3][0]
    relief = np.array([[-5.0, 0.0, 9.99, 10.0, 20.0, 33.0]], np.float32)
    found = positions(anchors, relief)
    np.testing.assert_allclose(found[0, :, 0], np.arange(6) + np.array([5, 5, 5, 25, 25, 25]), atol=1e-5)


def test_no_relief_or_no_rectangle_gives_nan():
    relief = np.zeros((4, 5), np.float32)
    relief[1, 2] = np.nan
    found = positions(Mapping.similarity().anchors([[0, 0, 5, 3]], (0.0, 1.0)), relief)
    expected = np.zeros((4, 5), bool)
    expected[3], expected[1, 2] = True, True
    np.testing.assert_array_equal(np.isnan(found), np.stack([expected, expected], axis=-1))


def test_flat_box_of_no_thickness():
    found = positions(
        Mapping.similarity(shift=(2.5, 0.0)).anchors([[0, 0, 5, 3]], (7.0, 7.0)), np.full((3, 5), 7, np.float32)
    )
    np.testing.assert_allclose(found[0, :, 0], np.arange(5) + 2.5, atol=1e-6)


def test_crop_has_the_same_positions_bit_by_bit():
    mapping = camera(1.0, 0.2, 3000)
    relief = np.random.default_rng(1).uniform(0, 50, (SIDE, SIDE)).astype(np.float32)
    anchors = mapping.anchors([[0, 0, 5, SIDE], [5, 0, SIDE, SIDE]], (0.0, 20.0, 50.0))
    whole = positions(anchors, relief)
    for rows, cols in ((slice(3, 9), slice(2, SIDE - 1)), (slice(0, SIDE), slice(min(RUN, SIDE // 2) + 3, SIDE))):
        part = positions(anchors, relief[rows, cols], (cols.start, rows.start))
        np.testing.assert_array_equal(part, whole[rows, cols])
