"""Robust planes without the point itself, neighbours on one side, and groups of points that hang together."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.kernels.local_planes import (
    component_borders,
    connected_components,
    fit_planes,
    local_scales,
    neighbour_differences,
    separate_across_lines,
)


def test_planes_do_without_the_point_itself_and_without_outliers() -> None:
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(0, 5, (12, 2)), np.zeros(12)])
    xyz[:, 2] = 2.0 + 0.5 * xyz[:, 0] - 0.25 * xyz[:, 1]
    xyz[[3, 7], 2] += [4.0, -9.0]
    near = np.array([[j for j in range(12) if j != i] for i in range(12)], np.int32)
    result, used = np.empty((12, 3)), np.ones(12, bool)
    fit_planes(xyz, near, used, np.arange(12), result)
    assert result[:, 1:] == pytest.approx(np.tile([0.5, -0.25], (12, 1)), abs=1e-2)  # a weak prior for level ground
    assert np.flatnonzero(np.abs(result[:, 0]) > 0.1).tolist() == [3, 7]
    used[5:] = False
    fit_planes(xyz, near, used, np.arange(12), result)
    assert np.isnan(result).all()


def test_neighbours_beyond_a_line_are_none() -> None:
    xyz = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [2, 5, 0]], float)
    near = np.array([[1, 2, 3]] * 4, np.int32)
    separate_across_lines(xyz, near, np.array([0]), np.array([[1.0, -1, 1, 2]]), np.array([0]), np.array([0, 1]))
    assert near[0].tolist() == [-1, 2, 3] and near[1].tolist() == [1, 2, 3]


def test_scales_are_standard_deviations_and_robust() -> None:
    misfit = np.random.default_rng(1).normal(0, 3.0, 41)
    near, used, result = np.arange(41, dtype=np.int32)[None], np.ones(41, bool), np.empty(1)
    local_scales(misfit, near, used, np.array([0]), result)
    assert result[0] == pytest.approx(3.0, rel=0.35)
    before = result[0]
    misfit[[20, 30]] = 1e6
    local_scales(misfit, near, used, np.array([0]), result)
    assert result[0] < 1.3 * before


def test_a_raised_group_hangs_together_and_its_border_breaks() -> None:
    """A row of ten points; three in the middle lie 5 m higher."""
    xyz = np.column_stack([np.arange(10.0), np.zeros(10), 0.5 * np.arange(10.0)])
    xyz[4:7, 2] += 5
    near = np.column_stack([np.arange(10) - 1, (np.arange(10) + 2) % 11 - 1]).astype(np.int32)
    off, middle, label, border = np.empty((10, 2)), np.empty(10), np.empty(10, np.int64), np.empty((10, 6))
    neighbour_differences(xyz, near, np.tile([0.5, 0.0], (10, 1)), off, middle)
    assert np.isnan(off[0, 0]) and off[4].tolist() == [5, 0] and middle[5] == 0
    connected_components(near, off, np.ones(10), 2.0, label)
    assert label.tolist() == [0] * 4 + [4] * 3 + [7] * 3
    component_borders(near, off, np.ones(10), 2.0, label, border)
    assert border[4].tolist() == [4, 4, 0, 20, 0, 20] and border[0].tolist() == [2, 0, 2, 0, 10, 10]
