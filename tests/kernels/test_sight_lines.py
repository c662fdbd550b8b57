"""Lines of sight against a slow twin that looks at every crossing, and against what geometry knows."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tools.thinned import some

from photoplan.kernels.jit import COMPILED
from photoplan.kernels.rays import pyramid_of
from photoplan.kernels.visibility import least_visible_heights

SIZE = 41 if COMPILED else 15


def sight(heights, eye, target_height=0.0, radius=np.inf, stop=False):
    out = np.empty(heights.shape, np.float32)
    heights = np.ascontiguousarray(heights, np.float32)
    least_visible_heights(heights, pyramid_of(heights), (*eye, radius), (0, heights.shape[0]), target_height, stop, out)
    return out


def twin(heights, eye, row, col) -> float:
    """Needed height above ground, from all crossings with grid lines."""
    dx, dy = eye[0] - col, eye[1] - row
    top = h = float(heights[row, col])
    us = [(k - start) / step for start, step in ((col, dx), (row, dy)) if step for k in range(max(heights.shape))]
    for u in sorted(u for u in us if 1e-9 < u < 1 - 1e-12):
        x, y = col + u * dx, row + u * dy
        if abs(x - round(x)) > 1e-9 and abs(y - round(y)) > 1e-9:
            continue
        x, y = (round(v) if abs(v - round(v)) <= 1e-9 else v for v in (x, y))
        i, j = math.floor(x), math.floor(y)
        corners = [
            (j + b, i + a, (x - i if a else 1 - x + i) * (y - j if b else 1 - y + j)) for a in (0, 1) for b in (0, 1)
        ]
        ground = sum(w * float(heights[r, c]) for r, c, w in corners if w > 0)
        if ground == ground:
            top = max(top, ground / (1 - u))
    return top - h


@pytest.mark.parametrize("seed", some(range(4), 0))
@pytest.mark.parametrize("eye", [(0.4, 0.6), (0.5, 0.2), (1.0, 1.0), (0.31, 0.0)])
def test_same_as_the_twin_on_random_terrain(seed, eye):
    rng = np.random.default_rng(seed)
    heights = rng.normal(0, (0.1, 1.0, 3.0, 0.5)[seed], (SIZE, SIZE + 6)) - 2.0
    heights[rng.random(heights.shape) < 0.03] = np.nan
    heights = heights.astype(np.float32)
    place = eye[0] * (SIZE - 1) // 0.5 * 0.5 + 0.1 * (seed % 2), eye[1] * (SIZE - 1)
    found = sight(heights, place)
    truth = np.array([[twin(heights, place, j, i) for i in range(SIZE + 6)] for j in range(SIZE)])
    assert np.isfinite(found).mean() > 0.9
    np.testing.assert_allclose(found, truth, atol=2e-5, rtol=1e-5)


def test_asking_only_whether_gives_the_same_answer():
    rng = np.random.default_rng(9)
    heights = rng.normal(0, 1, (SIZE, SIZE)).astype(np.float32) - 3
    eye = (SIZE / 3, SIZE / 2)
    need = sight(heights, eye)
    for target in (0.0, 0.7, 2.0):
        whether = sight(heights, eye, target, stop=True)
        clear = np.abs(need - target) > 1e-4
        np.testing.assert_array_equal(np.isfinite(whether)[clear], (need <= target)[clear])
        assert 0.05 < np.isfinite(whether).mean() < 0.99


def test_a_slope_seen_from_above_hides_nothing_and_radius_ends_the_view():
    j, i = np.mgrid[:SIZE, :SIZE]
    heights = 0.5 * i - 0.25 * j - 20.0
    assert sight(heights, (SIZE / 2, SIZE / 2)).max() < 1e-5
    near = np.isfinite(sight(heights, (5.0, 6.0), radius=4.0))
    np.testing.assert_array_equal(near, np.hypot(i - 5, j - 6) <= 4)
