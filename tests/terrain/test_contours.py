"""Contours: on the surface, whole, in order; bending and stopping where the terrain does; never crossing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import shapely
from tools.thinned import some

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.surfaces.mesh import constrained_faces
from photoplan.surfaces.units import MeshFaces
from photoplan.terrain import contours as contours
from photoplan.terrain.contours import ContourLine, ContourOptions, SurfacePart, grid_parts, trace_contours

CORNER = (512_000.0, 5_200_000.0)


@dataclass(frozen=True)
class Grid:
    """Heights in memory."""

    heights: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        rows, columns = self.heights.shape
        return columns, rows

    def read(self, window: Window) -> np.ndarray:
        return self.heights[window.row : window.stop[1], window.col : window.stop[0]].astype(np.float32)


def traced(
    heights: np.ndarray, mesh: tuple[float, float] = (1.0, 1.0), side: int = 16, **options: Any
) -> list[ContourLine]:
    options = {"interval": 1.0} | options
    return list(trace_contours(grid_parts(Grid(heights), CORNER, mesh, side=side), ContourOptions(**options)))


def function(f: Any, n: int, width: float) -> np.ndarray:
    """Heights of f(x, y) at (n + 1)² posts over a square of a width round (0, 0)."""
    at = np.linspace(-width / 2, width / 2, n + 1)
    return f(at[None, :], -at[:, None])


def local(line: ContourLine, width: float) -> np.ndarray:
    """Vertices as `function` counts them."""
    return line.xy - [CORNER[0] + width / 2, CORNER[1] - width / 2]


def tin_part(xyz: np.ndarray, corners: np.ndarray, creases: Any = ()) -> SurfacePart:
    """Any triangulation as one mesh."""
    low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    faces = MeshFaces(
        xyz, np.zeros(len(xyz), np.float32), corners.astype(np.int32), np.array([0, len(corners)], np.int64)
    )
    mesh = float(high[0] - low[0]), float(high[1] - low[1])
    return SurfacePart(0, 0, (float(low[0]), float(high[1])), mesh, np.full((2, 2), np.nan), faces, creases)


def bilinear(heights: np.ndarray, mesh: tuple[float, float], xy: np.ndarray) -> np.ndarray:
    """Heights of a grid, in plain words; on the edge of two meshes of either that has a surface."""
    u, v = (xy[:, 0] - CORNER[0]) / mesh[0], (CORNER[1] - xy[:, 1]) / mesh[1]
    found = np.full(len(xy), np.nan)
    for du in (-1e-8, 1e-8):
        for dv in (-1e-8, 1e-8):
            i = np.clip(np.floor(v + dv).astype(int), 0, heights.shape[0] - 2)
            j = np.clip(np.floor(u + du).astype(int), 0, heights.shape[1] - 2)
            s, t = u - j, v - i
            upper = heights[i, j] * (1 - s) + heights[i, j + 1] * s
            lower = heights[i + 1, j] * (1 - s) + heights[i + 1, j + 1] * s
            found = np.where(np.isnan(found), upper * (1 - t) + lower * t, found)
    return found


def assert_apart(lines: list[ContourLine]) -> None:
    """No two lines have a point in common, and none meets itself."""
    shapes = [shapely.LineString(line.xy) for line in lines]
    assert all(shape.is_simple for shape in shapes)
    tree = shapely.STRtree(shapes)
    left, right = tree.query(shapes, predicate="intersects")
    assert not (left != right).any(), [shapely.intersection(shapes[i], shapes[j]) for i, j in zip(left, right) if i < j]


def rough(seed: int, n: int = 40) -> np.ndarray:
    """Noise of several intervals from post to post, with holes."""
    rng = np.random.default_rng(seed)
    heights = rng.normal(0, 2.0, (n + 1, n + 1)).astype(np.float32)
    heights[rng.random(heights.shape) < 0.01] = np.nan
    return heights


# -- where the lines are -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mesh", [(1.0, 1.0), (2.0, 0.5)])
def test_vertices_lie_on_the_bilinear_surface_to_a_micrometre(mesh: tuple[float, float]) -> None:
    heights = rough(1)
    lines = traced(heights, mesh, interval=0.7, base=0.1)
    for line in lines:
        z = bilinear(heights.astype(float), mesh, line.xy)
        assert np.abs(z - line.height).max() < 2e-6
    assert len(lines) > 300


def test_a_plane_has_straight_lines_in_their_places() -> None:
    """z = 3 x / 10 + y / 10 + 50: every line satisfies it, ends at the border, has the length of its chord."""
    lines = traced(function(lambda x, y: 0.3 * x + 0.1 * y + 50, 64, 64.0), interval=2.0)
    assert sorted(line.height for line in lines) == [float(h) for h in range(38, 64, 2)]
    for line in lines:
        x, y = local(line, 64.0).T
        np.testing.assert_allclose(0.3 * x + 0.1 * y + 50, line.height, atol=2e-5)
        assert np.isclose(np.abs([x[0], y[0]]).max(), 32.0) and np.isclose(np.abs([x[-1], y[-1]]).max(), 32.0)
        assert line.length == pytest.approx(float(np.hypot(*(line.xy[-1] - line.xy[0]))), rel=1e-9)


def test_a_cone_has_circles_that_converge_with_the_square_of_the_mesh() -> None:
    worst = []
    for n in (32, 64, 128):
        rings = traced(function(lambda x, y: 100.3 - np.hypot(x, y), n, 64.0), (64 / n, 64 / n), interval=5.0)
        rings = [ring for ring in rings if ring.closed and ring.height < 99]
        assert [r.height for r in sorted(rings, key=lambda r: r.height)] == [70.0, 75.0, 80.0, 85.0, 90.0, 95.0]
        worst.append(max(np.abs(np.hypot(*local(r, 64.0).T) - (100.3 - r.height)).max() for r in rings))
        for ring in rings:
            radius = 100.3 - ring.height
            assert ring.length == pytest.approx(2 * np.pi * radius, rel=0.12 / (radius * n / 32) ** 1)
    order = np.log2(np.array(worst[:-1]) / worst[1:])
    assert (order > 1.6).all(), (worst, order)


def test_a_saddle_has_its_hyperbolas() -> None:
    """z = x y / 8 is bilinear: vertices lie on x y = 8 h, and the chords stay within a sixteenth of the twist."""
    lines = traced(function(lambda x, y: x * y / 8, 32, 32.0), interval=1.0, base=0.25)
    for line in lines:
        x, y = local(line, 32.0).T
        np.testing.assert_allclose(x * y / 8, line.height, atol=2e-6)
        x, y = (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2
        assert np.abs(x * y / 8 - line.height).max() <= 1 / 8 / 16 + 1e-6
        assert not line.closed
    # Two branches of each level that reaches the square.
    assert len(lines) == 2 * len({line.height for line in lines})


def test_higher_ground_is_on_the_right() -> None:
    heights = rough(5, 24)
    for line in traced(heights, interval=0.5):
        step = np.diff(line.xy, axis=0)
        size = np.hypot(*step.T)[:, None]
        middle, across = (line.xy[1:] + line.xy[:-1]) / 2, np.column_stack([step[:, 1], -step[:, 0]]) / size
        good = size[:, 0] > 1e-2
        if not good.any():
            continue
        right = bilinear(heights.astype(float), (1.0, 1.0), middle + 1e-4 * across)
        left = bilinear(heights.astype(float), (1.0, 1.0), middle - 1e-4 * across)
        # Where a chord cuts a hyperbola short it may lie off it; slopes still have their side.
        assert (right[good] > left[good]).mean() > 0.97


def test_tops_and_hollows_are_told_apart() -> None:
    top = traced(function(lambda x, y: 10.5 - np.hypot(x, y), 16, 12.0))
    hollow = traced(function(lambda x, y: np.hypot(x, y) - 0.5, 16, 12.0))
    assert {line.depression for line in top if line.closed} == {False}
    assert {line.depression for line in hollow if line.closed} == {True}
    assert any(line.closed for line in hollow)
    assert not any(line.depression for line in hollow if not line.closed)


def test_index_contours_are_counted_from_the_base() -> None:
    lines = traced(function(lambda x, y: x + 20 + 0 * y, 16, 32.0), (2.0, 2.0), interval=2.0, base=1.0, index=5)
    assert {line.height for line in lines if line.index} == {11.0, 21.0, 31.0}
    assert len(lines) > 10


# -- parts ---------------------------------------------------------------------------------------------------------


def canonical(lines: list[ContourLine]) -> set[Any]:
    """Lines without the place where a ring begins, and without their order."""
    found = set()
    for line in lines:
        points = [tuple(p) for p in np.round(line.xy, 7).tolist()]
        if line.closed:
            points = points[:-1]
            at = points.index(min(points))
            points = points[at:] + points[:at]
        found.add((line.height, line.closed, tuple(points)))
    return found


@pytest.mark.parametrize("options", [{}, {"smooth": True}])
def test_parts_do_not_show(options: dict[str, Any]) -> None:
    """Lines over parts of 5, 7 and all meshes are the same, whole lines; smoothing comes after joining."""
    heights = rough(2, 22)
    whole = canonical(traced(heights, side=100, interval=0.9, base=0.05, **options))
    for side in (5, 7):
        assert canonical(traced(heights, side=side, interval=0.9, base=0.05, **options)) == whole


def test_every_line_is_closed_or_ends_at_a_border() -> None:
    """With holes: each end lies on an edge of a mesh that lacks a post, or on the outer border."""
    heights = rough(3)
    empty = np.isnan(heights)
    gone = empty[:-1, :-1] | empty[1:, :-1] | empty[:-1, 1:] | empty[1:, 1:]
    gone = np.pad(gone, 1, constant_values=True)
    for line in traced(heights):
        if line.closed:
            continue
        for x, y in (line.xy[0], line.xy[-1]):
            j, i = x - CORNER[0], CORNER[1] - y
            around = {
                (int(np.floor(i + a)) + 1, int(np.floor(j + b)) + 1) for a in (-1e-6, 1e-6) for b in (-1e-6, 1e-6)
            }
            assert any(gone[i0, j0] for i0, j0 in around) and not all(gone[i0, j0] for i0, j0 in around)


def test_neighbouring_parts_whose_heights_are_rounded_otherwise_still_join() -> None:
    """Two parts whose shared posts differ by 1 mm in height and 1e-7 m in place: whole lines, equal vertices."""
    heights = function(lambda x, y: 0.02 * x + 0.1 * y, 20, 20.0)
    parts = list(grid_parts(Grid(heights), CORNER, (1.0, 1.0), side=10))
    moved = [
        replace(p, heights=p.heights + 1e-3, origin=(p.origin[0] + 1e-7, p.origin[1])) if p.column else p for p in parts
    ]
    # 0.02 x passes the level at the border of the parts within the difference.
    lines = list(trace_contours(moved, ContourOptions(0.1, base=-0.05)))
    assert len(lines) == len(list(trace_contours(parts, ContourOptions(0.1, base=-0.05))))
    assert_apart(lines)


def test_bounds_cut_whole_meshes() -> None:
    heights = rough(4)
    bounds = (CORNER[0] + 10.5, CORNER[1] - 20.5, CORNER[0] + 20.5, CORNER[1] - 10.5)
    lines = list(trace_contours(grid_parts(Grid(heights), CORNER, (1.0, 1.0), bounds, 8), ContourOptions(1.0)))
    cut = Grid(heights[10:22, 10:22])
    corner = CORNER[0] + 10, CORNER[1] - 10
    assert canonical(lines) == canonical(list(trace_contours(grid_parts(cut, corner, (1.0, 1.0)), ContourOptions(1.0))))


# -- heights exactly at a level -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_posts_at_levels_break_and_double_nothing(seed: int) -> None:
    """Whole numbers: most posts lie at a level, with flats, saddles and tops at it."""
    rng = np.random.default_rng(seed)
    heights = rng.integers(0, 4, (31, 31)).astype(np.float32)
    lines = traced(heights)
    assert_apart(lines)
    for line in lines:
        assert np.abs(bilinear(heights.astype(float), (1.0, 1.0), line.xy) - line.height).max() < 1e-6
        if not line.closed:
            assert all(
                min(*(p - [CORNER[0], CORNER[1] - 30]), *([CORNER[0] + 30, CORNER[1]] - p)) < 1e-9
                for p in line.xy[[0, -1]]
            )


def test_a_flat_at_a_level_has_one_ring_round_it_and_a_top_at_it_none() -> None:
    heights = np.zeros((9, 9), np.float32)
    heights[3:6, 3:6] = 1.0
    (ring,) = traced(heights)
    assert ring.closed and not ring.depression
    assert shapely.Polygon(ring.xy).area == pytest.approx(4.0, abs=1e-4)
    heights[3:6, 3:6] = 0.0
    heights[4, 4] = 1.0
    assert traced(heights) == []
    # A hollow whose floor lies at the level is above it: nothing either.
    assert traced(1 + heights) == []


# -- edges of the terrain -------------------------------------------------------------------------------------------


def roof() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z = 10 − |x| / 2 over 20 m, triangulated with its oblique ridge x = 0.3 y as a breakline."""
    rng = np.random.default_rng(9)
    at = np.linspace(-10, 10, 9)
    ridge = np.column_stack([0.3 * at, at])
    edge = np.array([[x, y] for x in (-10, -5, 5, 10) for y in at])
    inner = rng.uniform(-9.5, 9.5, (150, 2))
    xy = np.concatenate([ridge, edge, inner[np.abs(inner[:, 0] - 0.3 * inner[:, 1]) > 0.3]])
    z = 10 - np.abs(xy[:, 0] - 0.3 * xy[:, 1]) / 2 - 0.05 * xy[:, 1]
    links = np.column_stack([np.arange(8), np.arange(1, 9)])
    return np.column_stack([xy, z]), constrained_faces(xy, links), ridge


@pytest.mark.parametrize("options", [{}, {"smooth": True}, {"smooth": True, "simplify": True, "band": 0.49}])
def test_contours_of_a_roof_bend_on_its_ridge(options: dict[str, Any]) -> None:
    xyz, corners, ridge = roof()
    lines = list(trace_contours([tin_part(xyz, corners, [ridge])], ContourOptions(0.1, base=0.03, **options)))
    bends = []
    for line in lines:
        x, y = line.xy.T
        side = np.sign(np.round(x - 0.3 * y, 9))
        turn = np.diff(np.arctan2(*np.diff(line.xy, axis=0).T))
        turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        at = np.flatnonzero((side[1:-1] == 0) & (side[:-2] * side[2:] < 0)) + 1
        assert (side[:-1] * side[1:] >= 0).all()  # no chord passes the ridge without a vertex on it
        bends += [turn[i - 1] for i in at]
        # On the ridge z = 10 − 0.05 y: smoothing has not moved the vertex.
        np.testing.assert_allclose(10 - 0.05 * y[at], line.height, atol=1e-6)
    assert len(bends) >= 8
    if options:
        # Their neighbours may move inside their bands; the bend stays a bend of one vertex.
        assert min(bends) > 0.1
    else:
        # Two planes with gradients (0.5, −0.2) and (−0.5, 0.1): the lines' directions stand at right angles to them.
        expected = 2 * np.pi - abs(np.arctan2(-0.2, 0.5) - np.arctan2(0.1, -0.5))
        np.testing.assert_allclose(bends, expected, atol=1e-6)


def test_contours_stop_at_a_wall() -> None:
    """Two terraces 0 + x/10 and 5 + x/10 with a wall at y = 0: its vertices are twice there, in two heights."""
    xs = np.linspace(0, 10, 6)
    low = np.array([[x, y, x / 10] for y in (-10.0, 0.0) for x in xs])
    high = np.array([[x, y, 5 + x / 10] for y in (0.0, 10.0) for x in xs])
    corners = constrained_faces(low[:, :2], np.empty((0, 2), np.int64))
    upper = constrained_faces(high[:, :2], np.empty((0, 2), np.int64)) + len(low)
    part = tin_part(np.concatenate([low, high]), np.concatenate([corners, upper]))
    lines = list(trace_contours([part], ContourOptions(0.25, base=0.125)))
    assert {round(line.height, 3) for line in lines} == {0.125, 0.375, 0.625, 0.875, 5.125, 5.375, 5.625, 5.875}
    for line in lines:
        assert sorted(line.xy[[0, -1], 1].tolist()) == ([-10.0, 0.0] if line.height < 2 else [0.0, 10.0])


def test_triangles_meet_bilinear_meshes_without_a_gap() -> None:
    """A strip of bilinear meshes, one mesh of it as triangles with posts of its own rounding."""
    heights = function(lambda x, y: 0.7 * x + 0.2 * y, 4, 4.0)
    vertices, corners, start = [], [], [0]
    for m in range(16):
        if m in (5, 6):
            i, j = divmod(m, 4)
            first = len(vertices)
            at = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
            vertices += [(CORNER[0] + b + 1e-8, CORNER[1] - a, heights[a, b] + 1e-6) for a, b in at]
            corners += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
        start.append(len(corners))
    faces = MeshFaces(
        np.array(vertices), np.zeros(len(vertices), np.float32), np.array(corners, np.int32), np.array(start)
    )
    part = SurfacePart(0, 0, CORNER, (1.0, 1.0), heights, faces)
    lines = list(trace_contours([part], ContourOptions(0.3, base=0.01)))
    assert len(lines) == len({line.height for line in lines})
    for line in lines:
        assert np.isclose(np.abs(local(line, 4.0)[[0, -1]]).max(axis=1), 2.0, atol=1e-6).all()


# -- smoothing and simplifying ---------------------------------------------------------------------------------------


#: Of each kind of ground, whole numbers and rough, one; all in `make test-slow`.
SEEDS = [pytest.param(seed, marks=[] if seed in (1, 4) else pytest.mark.slow) for seed in range(6)]


@pytest.mark.parametrize("simplify", some([False, True], 1))
@pytest.mark.parametrize("seed", SEEDS)
def test_smoothed_lines_never_cross(seed: int, simplify: bool) -> None:
    rng = np.random.default_rng(seed)
    heights = rough(seed) if seed % 2 else rng.integers(0, 6, (36, 36)).astype(np.float32)
    before = traced(heights, interval=0.5)
    lines = traced(heights, interval=0.5, smooth=True, simplify=simplify, band=0.49)
    assert_apart(lines)
    assert len(lines) == len(before)
    assert sorted(line.height for line in lines) == sorted(line.height for line in before)


@pytest.mark.parametrize("seed", SEEDS)
def test_lines_anywhere_inside_their_bands_never_cross(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """What smoothing may do at worst: every vertex at a random place of its range, half of them at its ends."""
    rng = np.random.default_rng(seed)

    def anywhere(places: np.ndarray, closed: bool, passes: int) -> None:
        s = np.clip(rng.uniform(-0.5, 1.5, (len(places), 1)), 0, 1)
        places[:, :2] = places[:, 2:4] + s * (places[:, 4:6] - places[:, 2:4])

    monkeypatch.setattr(contours, "smooth_line", anywhere)
    heights = rough(seed, 30) if seed % 2 else rng.integers(0, 6, (31, 31)).astype(np.float32)
    lines = traced(heights, interval=0.5, smooth=True, simplify=seed > 3, band=0.49)
    assert_apart(lines)
    off = [np.abs(bilinear(heights.astype(float), (1.0, 1.0), line.xy) - line.height).max() for line in lines]
    assert 0.24 < max(off) <= 0.245 + 1e-6


def test_smoothing_stays_in_its_band_and_turns_less() -> None:
    rng = np.random.default_rng(11)
    y, x = np.mgrid[:81, :81]
    heights = (100 - 0.3 * np.hypot(x - 40, y - 40) + rng.normal(0, 0.05, x.shape)).astype(np.float32)

    def turning(lines: list[ContourLine]) -> float:
        total = 0.0
        for line in lines:
            turn = np.diff(np.arctan2(*np.diff(line.xy, axis=0).T))
            total += float(np.abs((turn + np.pi) % (2 * np.pi) - np.pi).sum())
        return total

    raw, smooth = traced(heights), traced(heights, smooth=True, band=0.3)
    assert turning(smooth) < 0.5 * turning(raw)
    for line in smooth:
        off = np.abs(bilinear(heights.astype(float), (1.0, 1.0), line.xy) - line.height)
        assert off.max() <= 0.3 + 1e-6
    assert (
        max(np.abs(bilinear(heights.astype(float), (1.0, 1.0), line.xy) - line.height).max() for line in smooth) > 0.02
    )


def test_simplified_lines_stay_in_their_band_and_have_few_vertices() -> None:
    """On a plane every line between its two ends is straight: two vertices remain."""
    lines = traced(function(lambda x, y: 0.31 * x + 0.17 * y, 40, 40.0), base=0.0123, simplify=True)
    assert {len(line.xy) for line in lines} == {2}
    heights = function(lambda x, y: 50 - 0.1 * (x**2 + y**2) / 10, 40, 40.0)
    lines = traced(heights, simplify=True, band=0.2)
    assert sum(len(line.xy) for line in lines) < 0.4 * sum(len(line.xy) for line in traced(heights))
    for line in lines:
        dense = shapely.segmentize(shapely.LineString(line.xy), 0.05)
        z = bilinear(heights.astype(np.float32).astype(float), (1.0, 1.0), np.array(dense.coords))
        assert np.abs(z - line.height).max() <= 0.2 + 0.01


# -- wrong use -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [{"interval": 0.0}, {"interval": np.nan}, {"interval": 1.0, "band": 0.5}, {"interval": 1.0, "index": -1}],
)
def test_options_that_cannot_be_meant_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        ContourOptions(**options)


def test_an_interval_far_below_the_heights_is_refused() -> None:
    with pytest.raises(UsageError, match="larger interval"):
        traced(rough(1), interval=1e-6)
