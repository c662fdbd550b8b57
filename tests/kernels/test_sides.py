"""Sides of lines as coordinates: a jump across the line, smooth around its ends, the same however it is turned."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import shapely
from collocation_twin import side, stacked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from photoplan.kernels.prediction import clip_lines, sides_of

BENT = np.array([[0.0, 0.0], [4.0, 1.0], [7.0, 0.5], [10.0, 3.0]])


def sides(xy: NDArray[np.float64], *lines: NDArray[np.float64]) -> NDArray[np.float64]:
    vertices, start = stacked(list(lines))
    result = np.empty((len(xy), len(lines)))
    sides_of(np.asarray(xy, float), vertices, start, len(lines), result)
    return result


def clipped(box: list[float], *lines: NDArray[np.float64], room: int = 40) -> list[NDArray[np.float64]]:
    vertices, start = stacked(list(lines))
    out, out_start = np.empty((400, 2)), np.empty(room + 1, np.int64)
    count = clip_lines(vertices, start, np.array(box, float), out, out_start)
    return [out[out_start[k] : out_start[k + 1]].copy() for k in range(count)]


def test_sides_are_the_sine_of_half_the_angle() -> None:
    xy = np.random.default_rng(1).uniform(-5, 15, (60, 2))
    np.testing.assert_allclose(sides(xy, BENT)[:, 0], side(xy, BENT), atol=1e-12)


def test_sides_jump_by_two_across_the_middle_of_a_line() -> None:
    middles = (BENT[1:] + BENT[:-1]) / 2
    step = np.diff(BENT, axis=0)
    normal = np.c_[-step[:, 1], step[:, 0]] / np.linalg.norm(step, axis=1)[:, None]
    straight = np.array([[-1000.0, 0.0], [1000.0, 0.0]])
    jump = sides(np.array([[0.0, 1e-6]]), straight) - sides(np.array([[0.0, -1e-6]]), straight)
    assert abs(jump[0, 0]) == pytest.approx(2.0, abs=1e-6)
    both = sides(middles + 1e-7 * normal, BENT) - sides(middles - 1e-7 * normal, BENT)
    # A bent line subtends less than a straight angle from inside, more from outside: the angle jumps by 2π exactly.
    angle = 2 * np.arcsin(sides(middles - 1e-7 * normal, BENT)[:, 0])
    assert (np.abs(both) > 1.8).all() and np.sign(both[0]) == np.sign(jump[0])
    np.testing.assert_allclose(np.abs(both[:, 0]), np.abs(2 * np.sin(angle / 2)), atol=1e-5)


def test_sides_are_smooth_around_the_end_of_a_line() -> None:
    """On a circle around the end the coordinate passes through all values, but for the jump at the line itself."""
    line = np.array([[-1000.0, 0.0], [0.0, 0.0]])
    for radius in (0.01, 1.0):
        phi = np.linspace(-np.pi + 1e-6, np.pi - 1e-6, 721)
        values = sides(radius * np.c_[np.cos(phi), np.sin(phi)], line)[:, 0]
        assert np.abs(np.diff(values)).max() < 1.01 * (phi[1] - phi[0]) / 2
        np.testing.assert_allclose(np.abs(values), np.abs(np.sin(phi / 2)), atol=1e-3)
        assert np.ptp(values) == pytest.approx(2.0, abs=1e-3)


@given(st.floats(-3, 3), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(0.1, 100))
@settings(max_examples=20, deadline=None)
def test_sides_do_not_change_when_all_is_turned_moved_and_scaled(angle: float, dx: float, dy: float, k: float) -> None:
    xy = np.random.default_rng(2).uniform(-5, 15, (20, 2))
    turn = k * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = sides(xy @ turn.T + (dx, dy), BENT @ turn.T + (dx, dy))
    np.testing.assert_allclose(moved, sides(xy, BENT), atol=1e-7)


def test_a_line_drawn_the_other_way_round_has_opposite_sides() -> None:
    xy = np.random.default_rng(3).uniform(-5, 15, (20, 2))
    np.testing.assert_allclose(sides(xy, BENT[::-1].copy()), -sides(xy, BENT), atol=1e-14)


def test_further_vertices_on_a_line_change_nothing() -> None:
    dense = np.vstack([np.linspace(a, b, 6)[:-1] for a, b in itertools.pairwise(BENT)] + [BENT[-1:]])
    xy = np.random.default_rng(4).uniform(-5, 15, (40, 2))
    np.testing.assert_allclose(sides(xy, dense), sides(xy, BENT), atol=1e-12)


@given(st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_clipped_lines_are_the_whole_lines_inside_the_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = [0.0, 0.0, 10.0, 6.0]
    lines = [np.cumsum(rng.normal(0, 4, (rng.integers(2, 9), 2)), axis=0) + rng.uniform(-3, 12, 2) for _ in range(3)]
    pieces = clipped(box, *lines)
    area = shapely.box(*box)
    want = shapely.intersection(area, shapely.MultiLineString(lines))
    got = shapely.intersection(area, shapely.MultiLineString(pieces))
    assert got.length == pytest.approx(want.length, abs=1e-9)
    assert want.length == 0 or shapely.hausdorff_distance(want, got, 0.05) < 1e-6


def test_clipped_sides_are_those_of_a_line_that_goes_on() -> None:
    """A straight road of many vertices through a small box."""
    t = np.linspace(-2000, 2000, 401)
    road = np.c_[t, 0.3 * t]
    pieces = clipped([-15.0, -15.0, 15.0, 15.0], road)
    assert len(pieces) == 1 and len(pieces[0]) < 12
    xy = np.random.default_rng(5).uniform(-15, 15, (200, 2))
    assert np.abs(sides(xy, pieces[0]) - sides(xy, road)).max() < 0.02


def test_lines_that_end_inside_the_box_are_not_prolonged_there() -> None:
    line = np.array([[-50.0, 5.0], [-2.0, 5.0], [5.0, 5.0]])
    (piece,) = clipped([0.0, 0.0, 10.0, 10.0], line)
    np.testing.assert_array_equal(piece[-1], [5.0, 5.0])
    assert piece[0, 0] < -100 and piece[0, 1] == 5.0


def test_lines_without_room_are_left_out() -> None:
    lines = [np.array([[0.0, k], [10.0, k]]) for k in range(6)]
    assert len(clipped([0, 0, 10, 10], *lines, room=4)) == 4
    assert clipped([20, 20, 30, 30], *lines) == []
