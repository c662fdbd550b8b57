"""Measurements as arrays: filter values by class and group, lines dense enough and once on each side."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from tools.build_terrain import line, scattered, terrain

from photoplan.errors import GeometryError
from photoplan.surfaces.units import MeasuredTerrain, PointGroup
from photoplan.terrain.observations import SHARE, BuildSettings, Observations, observe, spacing_of

GROUND = np.column_stack([scattered(40.0, 1600, 1), np.full(1600, 100.0)])
WAY = np.array([[5.0, 5, 101], [20, 10, 104], [35, 5, 101]])


def seen(*lines, **filters: float) -> Observations:  # type: ignore[no-untyped-def]
    return observe(terrain(GROUND, *lines), BuildSettings(filters=filters))


def test_spacing_is_the_side_of_the_square_of_one_point() -> None:
    rng = np.random.default_rng(2)
    assert spacing_of(rng.uniform(0, 100, (10_000, 2))) == pytest.approx(1.0, rel=0.05)
    assert spacing_of(np.stack(np.meshgrid(np.arange(50.0), np.arange(50.0)), -1).reshape(-1, 2)) == pytest.approx(
        1.0, rel=0.35
    )
    assert spacing_of(np.array([[0.0, 0], [1, 0], [0, 1]])) > 0


def test_coordinates_are_near_zero_and_exact() -> None:
    far = GROUND + np.array([21_530_000.0, 6_782_000.0, 0])
    got = observe(terrain(far), BuildSettings())
    assert np.abs(got.xyz).max() < 60
    np.testing.assert_allclose(got.xyz + got.origin, far, atol=1e-8)


def test_breaklines_come_once_on_each_side_and_dense_enough() -> None:
    got = seen(line(WAY))
    data = got.xyz[got.points :] + got.origin
    n = len(data) // 2
    left, right = data[:n], data[n:]
    middle = (left + right) / 2
    steps = np.linalg.norm(np.diff(middle[:, :2], axis=0), axis=1)
    assert steps.max() <= got.spacing * 1.01
    gap = np.linalg.norm(left[:, :2] - right[:, :2], axis=1)
    assert (gap > 0).all() and (gap < 0.01 * got.spacing).all()
    across = left[1:, :2] - right[1:, :2]
    forward = np.diff(middle[:, :2], axis=0)
    assert (forward[:, 0] * across[:, 1] - forward[:, 1] * across[:, 0] > 0).all()
    np.testing.assert_array_equal(left[:, 2], right[:, 2])
    for vertex in WAY:
        assert np.abs(middle - vertex).max(axis=1).min() < 1e-2


def test_walls_have_their_own_height_on_each_side() -> None:
    got = seen(line(WAY, right=WAY[:, 2] - 3))
    data = got.xyz[got.points :]
    n = len(data) // 2
    np.testing.assert_allclose(data[:n, 2] - data[n:, 2], 3.0, atol=1e-12)


def test_form_lines_come_once_and_separate_nothing() -> None:
    got = seen(line(WAY, "formline"))
    assert got.lines.separating == 0 and len(got.barriers[0]) == 0
    assert len(got.xyz) - got.points == len(np.unique(got.xyz[got.points :, :2], axis=0))


def test_borders_without_heights_give_no_data() -> None:
    ring = np.array([[1.0, 1], [39, 1], [39, 39], [1, 39], [1, 1]])
    got = seen(line(np.column_stack([ring, np.full(5, np.nan)]), "border"))
    assert len(got.xyz) == got.points and np.isfinite(got.xyz).all()


def test_filter_values_own_before_class_before_share() -> None:
    own, other = line(WAY, sigma=0.01), line(WAY + np.array([0, 20, 0]), name="other")
    got = seen(own, other, breakline=0.07)
    variances = got.noise(np.full(len(got.xyz), 0.2))
    assert set(np.sqrt(variances[got.points :]).round(9)) == {0.01, 0.07}
    np.testing.assert_allclose(np.sqrt(variances[: got.points]), 0.2)
    shared = seen(line(WAY))
    variances = shared.noise(np.full(len(shared.xyz), 0.2))
    np.testing.assert_allclose(np.sqrt(variances[shared.points :]), 0.2 * SHARE["breakline"])
    assert set(SHARE) == {"mass", "spot", "breakline", "formline", "border", "hole"} and SHARE["mass"] == 1


def test_groups_keep_their_own_filter_values_and_numbers() -> None:
    groups = (
        PointGroup("a", "mass", GROUND[:900], np.arange(900)),
        PointGroup("b", "spot", GROUND[900:1500], np.arange(600), sigma=0.0),
        PointGroup("c", "mass", GROUND[1500:], np.arange(100)),
    )
    got = observe(MeasuredTerrain(groups), BuildSettings(filters={"mass": 0.1}))
    for together in (0.1, 0.5):  # what was stated, and what measuring and stubble make together
        sigma = np.sqrt(got.noise(np.full(1600, together)))
        assert set(sigma[got.group == 1]) == {0.0}
        np.testing.assert_allclose(sigma[got.group != 1], together)
    np.testing.assert_allclose(np.sqrt(got.noise(np.full(1600, 0.0)))[got.group == 1], 0.0)
    assert got.record[got.group == 2].tolist() == list(range(100))


def test_barriers_are_cut_where_they_have_turned_far() -> None:
    """No piece winds around a point."""
    t = np.linspace(0, 4 * np.pi, 200)
    spiral = np.column_stack([20 + (5 + t) * np.cos(t), 20 + (5 + t) * np.sin(t), np.full(200, 100.0)])
    got = seen(line(spiral))
    vertices, start = got.barriers
    assert len(start) > 8
    for first, last in itertools.pairwise(start):
        step = np.diff(vertices[first:last], axis=0)
        heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
        assert np.abs(heading - heading[0]).max() <= np.pi / 2 + 1e-9
    length = sum(np.linalg.norm(np.diff(vertices[a:b], axis=0), axis=1).sum() for a, b in itertools.pairwise(start))
    assert length == pytest.approx(np.linalg.norm(np.diff(spiral[:, :2], axis=0), axis=1).sum())
    boxes = got.barrier_boxes
    assert boxes.shape == (len(start) - 1, 4) and (boxes[:, :2] <= boxes[:, 2:]).all()


def test_fault_16_measurements_that_determine_no_surface() -> None:
    t = np.linspace(0, 9, 10)
    shift = 6_000_000.0
    for xyz, words in (
        (GROUND[:2], "at least three"),
        (np.column_stack([t, 3 * t, t**2]), "one line"),
        (np.column_stack([shift + t, shift + 3 * t, t**2]), "one line"),
        (np.repeat(GROUND[:1], 5, axis=0), "one line"),
    ):
        with pytest.raises(GeometryError, match=words):
            observe(terrain(xyz), BuildSettings())
    with pytest.raises(GeometryError, match="at least three points"):
        observe(MeasuredTerrain(), BuildSettings())


def test_two_lines_alone_make_a_terrain() -> None:
    got = observe(MeasuredTerrain((), (line(WAY), line(WAY + np.array([0, 20, 0]), name="b"))), BuildSettings())
    assert got.points == 0 and got.spacing > 0
