"""Terrain with objects: exact heights of a town, and hits against all triangles one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.function_surface import FunctionSurface
from tools.town import DECK, faces_of, houses, town_faces

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.objects import Faces, ObjectSurface, painted_surface
from photoplan.targets.map import MapTarget

FAR = np.array([500_000.0, 5_400_000.0, 0.0])


def place(resolution: float, side: float = 140.0) -> MapTarget:
    return MapTarget(MapGrid.covering((0, 0, side, side), resolution, "EPSG:32632"))


def centres(target: MapTarget) -> np.ndarray:
    v, u = np.mgrid[: target.window.height, : target.window.width].astype(float)
    return target.grid.to_map(np.stack([u, v], axis=-1))


def moved(faces: Faces, by) -> Faces:  # type: ignore[no-untyped-def]
    return Faces(faces.corners + by, faces.paints, faces.owner, faces.names)


@pytest.mark.parametrize("seed", range(3))
def test_relief_of_a_town_is_that_of_its_roofs(seed: int) -> None:
    town, target = houses(25, seed), place(0.37)
    surface = ObjectSurface(FunctionSurface(lambda X, Y: np.sin(X / 20)), town_faces(town))
    XY = centres(target)
    truth = np.max([np.sin(XY[..., 0] / 20), *(house.roof(XY) for house in town)], axis=0)
    relief = surface.relief(target, target.window)
    assert (truth > 2).mean() > 0.1
    np.testing.assert_allclose(relief, truth, atol=1e-5)
    np.testing.assert_allclose(surface.heights(XY), truth, atol=1e-9)


def test_tiles_of_the_relief_join() -> None:
    target, surface = place(0.5), ObjectSurface(LevelSurface(0.0), town_faces(houses(20, 5)))
    whole = surface.relief(target, target.window)
    for window in target.window.tiles(64):
        np.testing.assert_array_equal(surface.relief(target, window), whole[window.slices(target.window)])


def test_what_is_painted_is_the_surface_and_what_only_hides_is_not() -> None:
    target, deck = place(1.0), faces_of([DECK], paints=False)
    road = ObjectSurface(LevelSurface(2.0), deck)
    np.testing.assert_array_equal(road.relief(target, target.window), 2.0)
    assert painted_surface(road) is road.ground and painted_surface(LevelSurface(1.0)) == LevelSurface(1.0)
    bridge = ObjectSurface(LevelSurface(2.0), faces_of([DECK]))
    XY = centres(target)
    # The deck's plane: 9 m in the west, 12 m in the east, over the road and as far as its four edges.
    x, y = XY[..., 0], XY[..., 1]
    south = 62.3 + (x - 20) * 0.104
    on = (x >= 20) & (x <= 120) & (y >= south) & (y <= south + 10)
    np.testing.assert_allclose(bridge.relief(target, target.window), np.where(on, 9 + 0.03 * (x - 20), 2.0), atol=1e-5)
    # From above the deck is met, from below too, and under it the road.
    paths = np.array([[(70, 72, 50), (70, 72, -5)], [(70, 72, 5), (70, 72, 50)], [(70, 72, 5), (70, 72, -5)]], float)
    for surface in (road, bridge):
        hits = surface.first_hit(paths)
        np.testing.assert_allclose(hits.XYZ[:, 2], [10.5, 10.5, 2.0], atol=1e-9)
        np.testing.assert_allclose(hits.along, [39.5 / 55, 5.5 / 45, 0.3], atol=1e-9)
    assert np.isneginf(road.faces.heights([[0.0, 0.0], [np.nan, 3.0]])).all()


def test_a_hole_of_the_terrain_has_the_roof_above_it() -> None:
    holes = FunctionSurface(lambda X, Y: np.where(X < 70, np.nan, 0.0))
    surface, target = ObjectSurface(holes, faces_of([DECK])), place(1.0)
    relief, XY = surface.relief(target, target.window), centres(target)
    on = np.isfinite(surface.faces.heights(XY))
    np.testing.assert_array_equal(np.isnan(relief), (XY[..., 0] < 70) & ~on)


def crossings(corners: np.ndarray, path: np.ndarray) -> float:
    """Least parameter of a straight path over all triangles, by linear equations; inf if there is none."""
    d = path[1] - path[0]
    edges = np.stack([np.broadcast_to(-d, (len(corners), 3)), corners[:, 1] - corners[:, 0]], axis=-1)
    edges = np.concatenate([edges, (corners[:, 2] - corners[:, 0])[..., None]], axis=-1)
    regular = np.abs(np.linalg.det(edges)) > 1e-9
    t, b, c = np.linalg.solve(edges[regular], (path[0] - corners[regular, 0])[..., None])[..., 0].T
    met = (t >= 0) & (t <= 1) & (b >= 0) & (c >= 0) & (b + c <= 1)
    return float(t[met].min(initial=np.inf))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 60.0), st.sampled_from([0.0, 1.0, 30.0]))
def test_first_hits_are_those_of_all_triangles(seed: int, size: float, height: float) -> None:
    """Soups of triangles of any size; rays in any direction, upright and level ones among them."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(0, 100, (60, 1, 3)) * (1, 1, height / 100)
    corners = centre + rng.normal(0, size, (60, 3, 3)) * (1, 1, max(height / 100, 0.01))
    faces = moved(Faces(corners, np.ones(60, bool), np.zeros(60, np.int32), ("soup",)), FAR)
    paths = rng.uniform(-60, 160, (80, 2, 3)) * (1, 1, 0.5)
    paths[:20, 1, :2] = paths[:20, 0, :2]
    paths[20:30, 1, 2] = paths[20:30, 0, 2]
    paths[30:40, 1, 0] = paths[30:40, 0, 0]
    along, XYZ, face = faces.first_hit(paths + FAR)
    truth = np.array([crossings(corners, path) for path in paths])
    np.testing.assert_array_equal(face >= 0, np.isfinite(truth))
    met = face >= 0
    np.testing.assert_allclose(along[met], truth[met], atol=1e-8)
    start, end = paths[met, 0], paths[met, 1]
    np.testing.assert_allclose(XYZ[met] - FAR, start + truth[met, None] * (end - start), atol=1e-5)


def test_paths_of_several_pieces_and_rays_that_rise_over_a_round_earth() -> None:
    wall = faces_of([[np.array([(50.0, -10.0, 0.0), (50, 10, 0), (50, 10, 30), (50, -10, 30)])]])
    path = np.array([[(0, 0, 10), (20, 0, 20), (100, 0, 20)], [(0, 0, 10), (20, 0, 20), (40, 0, 20)]], float)
    along, XYZ, face = wall.first_hit(path)
    assert along[0] == pytest.approx(1 + 30 / 80) and face[1] == -1 and np.isnan(along[1])
    np.testing.assert_allclose(XYZ[0], (50, 0, 20))
    level = np.array([[(0, 0, 28), (100, 0, 28)], [(0, 0, 25), (100, 0, 25)]], float)
    bend = 1e-3
    along, XYZ, face = wall.first_hit(level, bend)
    assert face[0] == -1 and face[1] >= 0
    np.testing.assert_allclose(XYZ[1], (50, 0, 25 + bend * 50**2), atol=1e-3)
    assert np.isnan(wall.first_hit(np.full((1, 2, 3), np.nan))[0]).all()


def test_the_nearer_of_ground_and_faces_is_met() -> None:
    town = houses(20, 9)
    surface = ObjectSurface(LevelSurface(0.0), town_faces(town))
    rng = np.random.default_rng(1)
    ends = np.concatenate([rng.uniform(0, 140, (300, 2)), np.full((300, 1), -0.5)], axis=1)
    paths = np.stack([np.broadcast_to((70.0, 70.0, 120.0), ends.shape), ends], axis=1)
    hits = surface.first_hit(paths)
    roofs = np.array([crossings(surface.faces.corners, path) for path in paths])
    ground = 120 / 120.5
    np.testing.assert_allclose(hits.along, np.minimum(roofs, ground), atol=1e-9)
    assert 50 < (roofs < ground).sum() < 250


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_height_ranges_hold_the_surface(seed: int) -> None:
    rng = np.random.default_rng(seed)
    surface, target = ObjectSurface(LevelSurface(3.0), town_faces(houses(8, seed))), place(1.0)
    relief = surface.relief(target, target.window)
    low = rng.integers(0, 100, 2)
    window = Window(int(low[0]), int(low[1]), *(int(n) for n in rng.integers(1, 40, 2)))
    corners = target.grid.to_map([(window.col - 0.5, window.stop[1] - 0.5), (window.stop[0] - 0.5, window.row - 0.5)])
    found = surface.height_range(corners.ravel())
    part = relief[window.slices(target.window)]
    assert found[0] <= part.min() and part.max() <= found[1]
    np.testing.assert_array_equal(surface.height_range([-50, -50, -40, -40]), [3.0, 3.0])


def test_cells_stay_few_however_the_triangles_lie() -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 1, (400, 3, 3))
    corners[:200] *= (50_000, 50_000, 10)
    corners[200:] += rng.uniform(0, 50_000, (200, 1, 3)) * (1, 1, 0)
    faces = Faces(corners, np.ones(400, bool), np.zeros(400, np.int32), ("all",))
    start, members, *_ = faces.in_cells[1]
    assert len(start) + len(members) < 100_000
    XY = rng.uniform(0, 50_000, (50, 2))
    paths = np.stack([np.c_[XY, np.full(50, 20.0)], np.c_[XY, np.full(50, -1.0)]], axis=1)
    top = 20 - 21 * np.array([crossings(corners, path) for path in paths])
    np.testing.assert_allclose(faces.heights(XY), top, atol=1e-6)


def test_faces_that_are_none_are_refused() -> None:
    with pytest.raises(UsageError, match="without a triangle"):
        Faces(np.empty((0, 3, 3)), np.empty(0, bool), np.empty(0, np.int32), ())
    with pytest.raises(UsageError, match="no numbers"):
        Faces(np.full((1, 3, 3), np.nan), np.ones(1, bool), np.zeros(1, np.int32), ("a",))
    with pytest.raises(UsageError, match="role and owner"):
        Faces(np.zeros((2, 3, 3)), np.ones(1, bool), np.zeros(1, np.int32), ("a",))
