"""Polygons in space as triangles and as squares; heights inside them."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.thinned import examples
from tools.town import triangles_of

from photoplan.errors import InputError, UsageError
from photoplan.surfaces.polygon_faces import decompose


def area_of(triangles: np.ndarray) -> float:
    edges = np.diff(triangles, axis=1)
    return float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2)


def rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q


def star(count: int, seed: int) -> np.ndarray:
    """A ring with corners that jut out and in, in the plane (count, 2)."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return rng.uniform(3, 10, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@settings(max_examples=30, deadline=None)
@given(st.integers(3, 30), st.integers(0, 10_000), st.booleans())
def test_plane_polygons_are_filled_exactly_whichever_way_they_face(count: int, seed: int, hole: bool) -> None:
    outer = star(count, seed)
    flat = shapely.Polygon(outer)
    rings = [outer]
    if hole and count > 5:
        rings.append(np.array([(-1.0, -1), (1, -1), (0.5, 1)]))
        flat = flat.difference(shapely.Polygon(rings[1]))
    turn, shift = rotation(seed), np.array([2_600_000.0, 1_200_000.0, 400.0])
    space = [np.c_[ring, np.zeros(len(ring))] @ turn.T + shift for ring in rings]
    corners, polygon = triangles_of([space], ["star"], "test")
    assert (polygon == 0).all()
    assert area_of(corners) == pytest.approx(flat.area, rel=1e-6)
    back = (corners - shift) @ turn
    np.testing.assert_allclose(back[..., 2], 0, atol=1e-8)
    assert flat.buffer(1e-6).contains(shapely.MultiPoint(back[..., :2].mean(axis=1)))


def test_an_upright_wall_with_a_window_and_a_closed_ring() -> None:
    wall = np.array([(0.0, 0, 0), (10, 0, 0), (10, 0, 5), (0, 0, 5), (0, 0, 0)])
    window = np.array([(4.0, 0, 1), (6, 0, 1), (6, 0, 3), (4, 0, 3)])
    corners, _ = triangles_of([[wall, window]], ["wall"], "test")
    assert area_of(corners) == pytest.approx(46.0)
    assert (corners[..., 1] == 0).all()


def test_between_bent_vertices_heights_are_those_of_a_triangulation() -> None:
    bent = np.array([(0.0, 0, 0), (10, 0, 0), (10, 10, 4), (0, 10, 0)])
    corners, _ = triangles_of([[bent]], ["bent"], "test")
    assert len(corners) == 2
    assert {tuple(p) for p in corners.reshape(-1, 3).tolist()} == {tuple(p) for p in bent.tolist()}


def test_rings_that_touch_themselves_are_filled() -> None:
    """Corners that meet, a spike, a corner twice: as models of towns have them."""
    pinched = np.array([(0.0, 0), (4, 0), (2, 2), (4, 4), (0, 4), (2, 2)])
    spike = np.array([(0.0, 0), (4, 0), (4, 4), (2, 4), (2, 5), (2, 4), (0, 4)])
    double = np.array([(0.0, 0), (4, 0), (4, 0), (4, 4), (0, 4)])
    rings = [[np.c_[r, np.full(len(r), 7.0)]] for r in (pinched, spike, double)]
    corners, polygon = triangles_of(rings, ["a", "b", "c"], "test")
    assert [area_of(corners[polygon == k]) for k in range(3)] == pytest.approx([8.0, 16.0, 16.0])
    assert corners[..., 2] == pytest.approx(7.0)


def test_two_squares_of_one_ring_are_filled_where_a_line_leads_from_one_to_the_other() -> None:
    """Mended, they are a polygon of two parts and a line, which none of them belongs to."""
    ring = [(0, 0), (4, 0), (4, 4), (12, 4), (12, 0), (16, 0), (16, 4), (12, 4), (4, 4), (0, 4)]
    ring = [*ring[:6], (16, -3), (16, 0), *ring[6:]]
    corners, _ = triangles_of([[np.array([(x, y, 7.0) for x, y in ring])]], ["two"], "test")
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert np.abs(areas).sum() == pytest.approx(32.0)


def test_polygons_without_an_inside_give_nothing() -> None:
    line = np.array([(0.0, 0, 0), (5, 0, 0), (9, 0, 0)])
    corners, polygon = triangles_of([[line], [line[:2]]], ["line", "two"], "test")
    assert corners.shape == (0, 3, 3) and not len(polygon)


def test_fault_19_polygons_that_cross_themselves_or_have_no_height_are_named() -> None:
    bow = np.array([(0.0, 0, 1), (4, 4, 1), (4, 0, 1), (0, 4, 1)])
    askew = np.array([(0.0, 0, 1), (8, 6, 1), (8, 0, 1), (0, 3, 1)])
    blind = np.array([(0.0, 0, 1), (4, 0, np.nan), (4, 4, 1)])
    lost = np.array([(0.0, 0, 1), (np.inf, 0, 1), (4, 4, 1)])
    vast = 1e300 * np.array([(0.0, 0, 1), (4, 0, 1), (4, 4, 1)])
    good = np.array([(0.0, 0, 1), (4, 0, 1), (4, 4, 1)])
    shapes = {"bow": bow, "askew": askew, "good": good, "blind": blind, "lost": lost, "vast": vast}
    with pytest.raises(InputError) as told:
        triangles_of([[ring] for ring in shapes.values()], [*shapes], "town.gpkg")
    text = str(told.value)
    assert text.startswith("town.gpkg: 5 polygons") and "'good'" not in text
    for part in (
        "'bow' crosses itself",
        "'askew' crosses itself",
        "'blind' has vertices without a height",
        "'lost' has coordinates that lie nowhere on a map",
        "'vast' has coordinates that lie nowhere on a map",
    ):
        assert part in text
    hole = np.array([(1.0, 1, 1), (9, 1, 1), (1, 9, 1)])
    square = np.array([(0.0, 0, 1), (4, 0, 1), (4, 4, 1), (0, 4, 1)])
    with pytest.raises(InputError, match=r"(?s)test: 1 polygon cannot.*'leaky' crosses itself"):
        triangles_of([[square, hole]], ["leaky"], "test")


@settings(max_examples=examples(12, 30), deadline=None)
@given(st.integers(3, 20), st.integers(0, 10_000))
def test_squares_cover_a_polygon_to_the_finest_and_never_overlap(count: int, seed: int) -> None:
    hole = shapely.Polygon([(-1, -1), (1, -1), (0.5, 1)])
    polygon = shapely.Polygon(star(count, seed) + np.array([40.3, 17.1])).difference(
        shapely.affinity.translate(hole, 40.3, 17.1)
    )
    squares = decompose(polygon, (0.0, 0.0), 4.0, 4)
    boxes = shapely.box(*squares.bounds.T)
    np.testing.assert_allclose(shapely.area(boxes).sum(), shapely.union_all(boxes).area)
    whole = squares.level < 4
    assert shapely.contains(polygon, boxes[whole]).all()
    middle = squares.bounds[~whole].reshape(-1, 2, 2).mean(axis=1)
    assert shapely.contains_xy(polygon, *middle.T).all()
    # What is missing or too much lies within a finest square of the border.
    border = polygon.boundary.buffer(0.25 * np.sqrt(2) + 1e-9)
    assert polygon.symmetric_difference(shapely.union_all(boxes)).difference(border).area < 1e-9
    np.testing.assert_allclose(squares.side, 4.0 / 2.0**squares.level)


def test_squares_come_depth_first_northwest_northeast_southwest_southeast() -> None:
    """Behr 1989, fig. 6.5 to 6.7: an L of three quarters, whose fourth quarter has one square of its own."""
    shape = shapely.union_all([shapely.box(0, 0, 4, 8), shapely.box(4, 4, 8, 8), shapely.box(4, 2, 6, 4)])
    squares = decompose(shape, (0.0, 8.0), 8.0, 3)
    assert squares.bounds.tolist() == [[0, 4, 4, 8], [4, 4, 8, 8], [0, 0, 4, 4], [4, 2, 6, 4]]
    assert squares.level.tolist() == [1, 1, 1, 2]


def test_too_many_squares_are_refused() -> None:
    with pytest.raises(UsageError, match="choose larger ones"):
        decompose(shapely.box(0, 0, 1e6, 1e6), (0.0, 0.0), 1000.0, 20)
