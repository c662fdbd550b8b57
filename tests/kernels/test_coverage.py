"""Areas of polygons in pixels; against Shapely in `orientation/test_mark_template.py`."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from photoplan.kernels.raster import polygon_coverage


def covered(outline: NDArray[np.float64], rows: int = 9, columns: int = 12) -> NDArray[np.float64]:
    total = np.full((rows, columns + 1), np.nan)
    polygon_coverage(np.ascontiguousarray(outline), total)
    return total[:, :-1]


def area(outline: NDArray[np.float64]) -> float:
    x, y = outline.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


STAR = np.array([(5.3, 1.2), (6.1, 3.4), (10.7, 3.4), (6.9, 5.0), (8.0, 7.7), (5.0, 6.0), (2.25, 7.7), (3, 5), (1, 3)])


@pytest.mark.parametrize("seed", range(5))
def test_the_sum_is_the_area_and_a_part_beyond_the_border_is_cut_off(seed: int) -> None:
    rng = np.random.default_rng(seed)
    outline = STAR + rng.uniform(-0.3, 0.3, STAR.shape)
    inside = covered(outline)
    assert abs(inside.sum()) == pytest.approx(abs(area(outline)), abs=1e-12)
    np.testing.assert_allclose(covered(outline[::-1]), -inside, atol=1e-13)
    for dx, dy in ((3, 0), (-4, 0), (0, 5), (0, -2), (40, 0), (-40, 1), (0, 40), (0, -40)):
        moved = covered(outline + np.array([dx, dy]))
        expected = np.zeros_like(inside)
        for row, column in np.ndindex(*inside.shape):
            if 0 <= row - dy < 9 and 0 <= column - dx < 12:
                expected[row, column] = inside[row - dy, column - dx]
        np.testing.assert_allclose(moved, expected, atol=1e-12)


def test_whole_pixels_and_edges_along_their_borders() -> None:
    box = np.array([(2.0, 1.0), (5.0, 1.0), (5.0, 4.0), (2.0, 4.0)])
    expected = np.zeros((9, 12))
    expected[1:4, 2:5] = 1
    np.testing.assert_array_equal(np.abs(covered(box)), expected)
    everything = np.array([(-1e9, -1e9), (1e9, -1e9), (1e9, 1e9), (-1e9, 1e9)])
    np.testing.assert_allclose(np.abs(covered(everything)), 1, atol=1e-6)


def test_an_edge_that_hardly_rises() -> None:
    box = np.array([(2.0, 1.0), (5.0, 1.0 + 1e-300), (5.0, 4.0 - 1e-16), (2.0, 4.0)])
    assert abs(covered(box)).sum() == pytest.approx(9, abs=1e-12)
