"""Cleaned terrain: lines meet in common vertices only, and what contradicts is reported with its names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tools.effort import at_most
from tools.thinned import examples

from photoplan.errors import GeometryError, InputError
from photoplan.surfaces.mesh import constrained_faces
from photoplan.surfaces.units import MeasuredLine, MeasuredTerrain, PointGroup
from photoplan.terrain.clean import Finding, clean, domain_of

EAST, NORTH = 21_530_000.0, 6_782_000.0
SHIFT = np.array([EAST, NORTH, 0.0])


def line(xyz: object, kind: str = "breakline", name: str = "a", **more: object) -> MeasuredLine:
    table = np.asarray(xyz, float) + SHIFT
    return MeasuredLine(name, kind, table, **more)  # type: ignore[arg-type]


def group(xyz: object, name: str = "p", kind: str = "mass", sigma: float | None = None) -> PointGroup:
    table = np.asarray(xyz, float).reshape(-1, 3) + SHIFT
    return PointGroup(name, kind, table, np.arange(1, len(table) + 1), sigma)  # type: ignore[arg-type]


CORNERS = group([[-100, -100, 0], [100, -100, 0], [0, 100, 0]], "corners")


def cleaned(
    *lines: MeasuredLine, points: tuple[PointGroup, ...] = (CORNERS,), **options: float
) -> tuple[MeasuredTerrain, list[Finding]]:
    out, found = clean(MeasuredTerrain(points, lines), **options)
    return out, list(found)


def network(measured: MeasuredTerrain) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """All different places, and the segments of lines as pairs of their numbers."""
    every = [g.xyz[:, :2] for g in measured.points] + [x.xyz[:, :2] for x in measured.lines]
    xy, number = np.unique(np.concatenate(every), axis=0, return_inverse=True)
    number = number.ravel()
    at, edges = measured.count, [np.empty((0, 2), np.int64)]
    for each in measured.lines:
        part = number[at : at + len(each.xyz)]
        at += len(part)
        edges.append(np.stack([part[:-1], part[1:]], axis=1))
    return xy, np.unique(np.sort(np.concatenate(edges), axis=1), axis=0)


def assert_meets_in_vertices(measured: MeasuredTerrain) -> None:
    """Two segments have at most vertices in common: by exact predicates, and by the triangulation that keeps them."""
    xy, edges = network(measured)
    assert (edges[:, 0] != edges[:, 1]).all()
    faces = constrained_faces(xy, edges)
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert {tuple(e) for e in edges.tolist()} <= {tuple(s) for s in sides.tolist()}
    segments = shapely.linestrings(xy[edges] - xy.mean(axis=0))
    pairs = shapely.STRtree(segments).query(segments, predicate="crosses")
    assert not pairs.size


def height_at(measured: MeasuredTerrain, name: str, x: float, y: float) -> list[float]:
    """Heights of the vertices of a line at a place."""
    return [
        float(z)
        for each in measured.lines
        if each.name.startswith(name)
        for X, Y, z in each.xyz
        if abs(X - EAST - x) < 1e-3 and abs(Y - NORTH - y) < 1e-3
    ]


def test_lines_without_contradiction_stay_as_they_are() -> None:
    lines = (line([[0, 0, 1], [10, 0, 2]], name="a"), line([[0, 5, 1], [10, 5, 2], [20, 5, 1]], name="b"))
    out, found = cleaned(*lines)
    assert not found
    for before, after in zip(lines, out.lines, strict=True):
        np.testing.assert_array_equal(before.xyz, after.xyz)
    np.testing.assert_array_equal(out.points[0].xyz, CORNERS.xyz)


def test_fault_19_crossing_with_different_heights_is_reported_and_joined() -> None:
    a = line([[-10, 0, 10], [10, 0, 14]], name="a")
    b = line([[0, -10, 13], [0, 10, 13]], name="b")
    out, found = cleaned(a, b)
    (only,) = found
    assert only.kind == "crossing heights"
    assert only.names == ("a", "b")
    assert np.hypot(only.X - EAST, only.Y - NORTH) < 1e-6
    assert "12.000" in only.text and "13.000" in only.text
    assert height_at(out, "a", 0, 0) == height_at(out, "b", 0, 0) == [12.5]
    np.testing.assert_array_equal(out.lines[0].xyz[1, :2], out.lines[1].xyz[1, :2])


def test_the_height_of_a_crossing_is_weighted_by_the_standard_deviations() -> None:
    a = line([[-10, 0, 12], [10, 0, 12]], name="a", sigma=0.1)
    b = line([[0, -10, 13], [0, 10, 13]], name="b", sigma=0.2)
    out, _ = cleaned(a, b)
    expected = (12 / 0.01 + 13 / 0.04) / (1 / 0.01 + 1 / 0.04)
    assert height_at(out, "a", 0, 0) == pytest.approx([expected], abs=1e-12)


def test_a_crossing_of_equal_height_is_silent() -> None:
    a = line([[-10, 0, 10], [10, 0, 14]], name="a")
    out, found = cleaned(a, line([[0, -10, 12], [0, 10, 12]], name="b"))
    assert not found
    assert [len(each.xyz) for each in out.lines] == [3, 3]
    assert_meets_in_vertices(out)


def test_heights_at_crossings_are_interpolated_along_the_line() -> None:
    wall = line([[0, 0, 10], [8, 0, 18]], name="wall", right=np.array([0.0, 4.0]))
    a = line([[0, 5, 10], [8, 5, 18]], name="a")
    b = line([[2, -5, 12], [2, 20, 12]], name="b")
    out, _ = cleaned(wall, a, b)
    assert height_at(out, "a", 2, 5) == height_at(out, "b", 2, 5) == pytest.approx([12.0])
    (kept,) = (x for x in out.lines if x.right is not None)
    assert kept.xyz[1, 2] == pytest.approx(12.0) and kept.right is not None and kept.right[1] == pytest.approx(1.0)


def test_fault_19_three_lines_through_one_place_get_one_vertex() -> None:
    star = [line([[-np.cos(t), -np.sin(t), 5], [np.cos(t), np.sin(t), 5]], name=str(t)) for t in (0.1, 1.1, 2.1)]
    out, _ = cleaned(*star)
    xy, _ = network(out)
    assert len(xy) == 3 + 6 + 1
    assert_meets_in_vertices(out)


def test_overlapping_lines_share_their_segments() -> None:
    out, found = cleaned(line([[0, 0, 1], [10, 0, 1]], name="a"), line([[4, 0, 1], [14, 0, 1]], name="b"))
    assert not found
    _, edges = network(out)
    assert len(edges) == 3
    assert_meets_in_vertices(out)


def test_an_end_that_misses_a_line_by_less_than_the_tolerance_becomes_its_vertex() -> None:
    out, _ = cleaned(line([[0, 0, 1], [10, 0, 1]], name="a"), line([[5, 0.0002, 1], [5, 8, 1]], name="b"))
    assert len(out.lines[0].xyz) == 3
    assert_meets_in_vertices(out)


def test_fault_19_coincident_points_with_different_heights_are_reported_one_by_one() -> None:
    good = group([[1, 1, 5.0], [3, 3, 7.0]], "good", sigma=0.05)
    poor = group([[1.0004, 1, 5.5], [3, 3, 7.0], [3, 2, 8.0]], "poor", sigma=0.1)
    out, found = cleaned(points=(CORNERS, poor, good))
    pairs = [f for f in found if f.names]
    assert len(pairs) == 1 and pairs[0].kind == "coincident points"
    assert set(pairs[0].names) == {"poor (record 1)", "good (record 1)"}
    kept = {g.name: g for g in out.points}
    assert len(kept["good"].xyz) == 2 and len(kept["poor"].xyz) == 1
    assert kept["good"].xyz[0, 2] == pytest.approx((5 / 0.0025 + 5.5 / 0.01) / (1 / 0.0025 + 1 / 0.01))
    assert kept["good"].xyz[1, 2] == 7.0


def test_points_on_lines_become_vertices() -> None:
    a = line([[0, 0, 1], [10, 0, 1]], name="a")
    out, found = cleaned(a, points=(CORNERS, group([[5, 0.0004, 1.02], [10, 0, 1.0], [7, 3, 2.0]])))
    assert [f.kind for f in found] == ["points on lines"]
    assert len(out.points[1].xyz) == 1
    assert height_at(out, "a", 5, 0.0004) == pytest.approx([1.01])
    out, found = cleaned(a, points=(CORNERS, group([[5, 0, 2.0]])))
    assert [f.kind for f in found] == ["points on lines", "crossing heights"]
    assert "p (record 1) 2.000 m" in found[1].text


def test_a_wall_keeps_two_heights_and_cuts_lines_that_meet_it() -> None:
    wall = line([[0, -10, 5], [0, 10, 5]], name="wall", right=np.array([2.0, 2.0]))
    road = line([[-10, 0, 5], [10, 0, 2]], name="road")
    out, found = cleaned(wall, road)
    assert not found
    (kept,) = (x for x in out.lines if x.right is not None)
    np.testing.assert_array_equal(kept.xyz[:, 2], 5.0)
    np.testing.assert_array_equal(kept.right, 2.0)
    # The wall leads north: west of it is its left, where the road comes from.
    west, east = (x for x in out.lines if x.name.startswith("road"))
    assert west.xyz[-1, 2] == 5.0 and east.xyz[0, 2] == 2.0
    assert_meets_in_vertices(out)
    ends = (line([[-10, 0, 5], [0, 0, 5]], name="west"), line([[0, 0, 2], [10, 0, 2]], name="east"))
    out, found = cleaned(wall, *ends)
    assert not found
    assert height_at(out, "west", 0, 0) == [5.0] and height_at(out, "east", 0, 0) == [2.0]
    _, found = cleaned(wall, line([[-10, 0, 9], [10, 0, 9]], name="road"))
    assert [f.kind for f in found] == ["line at wall"]


def test_a_line_along_a_wall_is_left_to_the_wall() -> None:
    wall = line([[0, 0, 5], [10, 0, 5]], name="wall", right=np.array([2.0, 2.0]))
    out, _ = cleaned(wall, line([[-5, 0, 5], [15, 0, 5]], name="edge"))
    lengths = {x.name: shapely.LineString(x.xyz[:, :2]).length for x in out.lines}
    assert lengths == pytest.approx({"wall": 10, "edge part 1": 5, "edge part 2": 5})


def test_a_point_on_a_wall_is_named() -> None:
    wall = line([[0, -10, 5], [0, 10, 5]], name="wall", right=np.array([2.0, 2.0]))
    _, found = cleaned(wall, points=(CORNERS, group([[0, 3, 5.0]])))
    assert [(f.kind, f.names) for f in found] == [("point on wall", ("p (record 1)",))]


def test_borders_follow_the_heights_of_lines() -> None:
    border = line([[-5, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0], [-5, -5, 0]], "border", "border")
    out, found = cleaned(border, line([[-8, 0, 20], [8, 0, 20]], name="a"), points=(group([[0, 1, 20]]),))
    assert [f.kind for f in found] == ["line outside"]
    assert height_at(out, "border", 5, 0) == height_at(out, "a", 5, 0) == [20.0]


def test_repeated_vertices_and_lines_without_length_are_found() -> None:
    a = line([[0, 0, 1], [0, 0, 1], [5, 0, 1], [5, 0, 3], [9, 0, 1]], name="a")
    b = line([[0, 9, 1], [0.0005, 9, 1]], name="b")
    out, found = cleaned(a, b)
    assert [(f.kind, f.names) for f in found] == [("repeated vertices", ("a",)), ("line without length", ("b",))]
    assert len(out.lines) == 1 and len(out.lines[0].xyz) == 3


def square(side: float, middle: tuple[float, float] = (0, 0), kind: str = "border", name: str = "s") -> MeasuredLine:
    x, y, h = *middle, side / 2
    xy = [[x - h, y - h], [x + h, y - h], [x + h, y + h], [x - h, y + h], [x - h, y - h]]
    return line(np.column_stack([xy, np.full(5, np.nan)]), kind, name)


def test_the_domain_is_borders_without_holes_but_with_islands() -> None:
    rings = (square(4, name="island"), square(20), square(8, kind="hole"))
    out, found = cleaned(*rings, points=(group([[9, 9, 0], [0, 9, 0], [1, 1, 0]]),))
    domain = domain_of(out)
    assert not found
    assert domain.area == pytest.approx(400 - 64 + 16)
    assert domain.is_valid
    assert domain_of(MeasuredTerrain((CORNERS,))) is None
    holes = domain_of(MeasuredTerrain((CORNERS,), (square(8, kind="hole"),)))
    assert not shapely.contains_xy(holes, EAST, NORTH)
    assert shapely.contains_xy(holes, EAST + 50, NORTH - 50)


def test_fault_19_points_lines_and_holes_outside_are_named() -> None:
    lines = (square(20), square(2, (30, 30), "hole", "far"), line([[0, 0, 1], [50, 1, 1]], name="a"))
    _, found = cleaned(*lines, points=(group([[0, 1, 1], [1, 5, 1], [40, 0, 1]]),))
    assert {f.kind for f in found} == {"points outside", "hole outside", "line outside"}
    assert "1 of 3 points" in next(f.text for f in found if f.kind == "points outside")


def test_fault_19_self_crossing_border_is_reported_and_counts_by_parity() -> None:
    bow = line([[0, 0, 0], [10, 10, 0], [10, 0, 0], [0, 10, 0], [0, 0, 0]], "border", "bow")
    out, found = cleaned(bow, points=(group([[1, 5, 0], [9, 5, 0], [8, 5, 0]]),))
    assert [f.kind for f in found] == ["self-crossing border"]
    assert "bow" in found[0].text
    assert domain_of(out).area == pytest.approx(50)


def test_fault_19_small_gaps_are_closed_and_large_ones_refused() -> None:
    open_ring = line([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], "border", "ring")
    out, found = cleaned(open_ring, points=(group([[1, 1, 0], [5, 5, 0], [2, 3, 0]]),))
    assert [f.kind for f in found] == ["unclosed border"]
    np.testing.assert_array_equal(out.lines[0].xyz[0], out.lines[0].xyz[-1])
    with pytest.raises(GeometryError, match=r"ring: the border line is not closed: 10\.000 m"):
        cleaned(line([[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0], [0, 10, 0]], "border", "ring"))


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0, 0, 0], [1, 1, 1]], "2 different places"),
        ([[0, 0, 0], [0, 0, 0], [1, 1, 1], [1, 1, 1.01]], "2 different places"),
        ([[i, 2 * i, 7] for i in range(5)], "one straight line"),
    ],
)
def test_fault_16_degenerate_data_are_refused_by_name(points: list[list[float]], message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        cleaned(points=(group(points),))


def test_coordinates_of_no_map_are_refused() -> None:
    with pytest.raises(InputError, match="no projected CRS"):
        cleaned(points=(PointGroup("p", "mass", np.full((3, 3), 1e12), np.arange(3)),))


KINDS = ("breakline", "breakline", "formline", "hole", "border")


@st.composite
def terrains(draw: st.DrawFn) -> tuple[MeasuredTerrain, bool]:
    """Lines on a lattice of a side between 0.1 mm and 1 m, with or without noise: everything meets everything.

    The second value says that different places are far apart: then cleaning twice changes nothing.
    """
    side = draw(st.sampled_from([1.0, 0.01, 0.002, 0.001, 0.0005, 0.0001]))
    noise = draw(st.sampled_from([0.0, 1e-9, 1e-4, 1e-3]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    lines = []
    for number in range(draw(st.integers(1, 10))):
        count = draw(st.integers(2, 7))
        xy = np.array(draw(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=count, max_size=count)))
        xyz = np.column_stack([xy * side + rng.normal(0, noise, xy.shape), rng.integers(0, 3, count)])
        kind = draw(st.sampled_from(KINDS))
        if kind in ("border", "hole"):
            xyz = np.concatenate([xyz, xyz[:1]])
        right = rng.integers(0, 3, len(xyz)).astype(float) if kind == "breakline" and rng.random() < 0.4 else None
        lines.append(line(xyz, kind, str(number), right=right))
    points = group(np.column_stack([rng.integers(0, 7, (9, 2)) * side, rng.integers(0, 3, 9)]), "points")
    return MeasuredTerrain((CORNERS, points), tuple(lines)), side == 1.0 and noise == 0.0


@settings(max_examples=examples(25, 150), deadline=None, derandomize=True)
@given(terrains())
def test_fault_19_any_lines_can_be_triangulated_after_cleaning(case: tuple[MeasuredTerrain, bool]) -> None:
    measured, exact = case
    try:
        out, _ = clean(measured)
    except GeometryError as error:
        assert "leave no area" in str(error) or "not closed" in str(error)
        return
    assert_meets_in_vertices(out)
    for each in out.lines:
        assert each.kind in ("border", "hole") or np.isfinite(each.xyz).all()
        assert (each.right is None) or np.isfinite(each.right).all()
    if not exact:
        return
    twice, found = clean(out)
    assert sum(len(x.xyz) for x in twice.lines) == sum(len(x.xyz) for x in out.lines)
    assert not any(f.kind in ("crossing heights", "joined vertices") for f in found)


def test_work_that_does_not_end_is_ended_by_joining_vertices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("photoplan.terrain.clean.ROUNDS", 1)
    rng = np.random.default_rng(7)
    lines = [line(np.column_stack([rng.uniform(0, 0.02, (3, 2)), np.zeros(3)]), name=str(i)) for i in range(40)]
    out, found = cleaned(*lines)
    assert {f.kind for f in found} >= {"joined vertices"}
    assert_meets_in_vertices(out)


def test_cleaning_does_not_depend_on_the_order_of_lines_far_from_each_other() -> None:
    rng = np.random.default_rng(5)
    lines = [line(np.column_stack([rng.uniform(-50, 50, (4, 2)), np.full(4, 3.0)]), name=str(i)) for i in range(30)]
    one, _ = cleaned(*lines)
    other, _ = cleaned(*lines[::-1])
    assert sum(len(x.xyz) for x in one.lines) == sum(len(x.xyz) for x in other.lines)
    assert_meets_in_vertices(one)


@pytest.mark.slow
def test_twenty_thousand_segments_take_a_second() -> None:
    """Asked: 6,000 vertices in under 2 s, 500,000 segments in under 60 s."""
    rng = np.random.default_rng(2)
    start = rng.uniform(0, 1000, (6000, 1, 2))
    xy = start + np.cumsum(rng.normal(0, 3, (6000, 4, 2)), axis=1)
    lines = [line(np.column_stack([p, np.full(4, 1.0)]), name=str(i)) for i, p in enumerate(xy)]
    with at_most(10):
        out, found = cleaned(*lines)
    assert not found
    assert sum(len(x.xyz) for x in out.lines) > 26_000


def test_real_survey_is_clean(shared: Path) -> None:
    from photoplan.io.terrain.files import read_measured

    measured = read_measured([shared / "data" / "m3_road_survey" / "M3_Terrain.mm.xml"])
    out, found = clean(measured)
    assert not found
    assert out.count == 14_235
    assert_meets_in_vertices(out)
