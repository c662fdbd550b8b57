"""What objects hide: shadows known by geometry, all triangles one by one, and a depth buffer in the image."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from scipy.ndimage import maximum_filter, minimum_filter
from tools.depth_buffer import depth_buffer, hidden_in_buffer, posts_as_triangles
from tools.function_surface import raster_surface
from tools.pinhole import Pinhole
from tools.thinned import some
from tools.town import DECK, House, faces_of, houses, town_faces

from photoplan.cameras.base import project
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.plan.ground import TileGround
from photoplan.plan.sources import hidden_pixels
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.objects import ObjectSurface
from photoplan.targets.map import MapTarget

SIDE = 140.0


def target(resolution: float = 0.5) -> MapTarget:
    return MapTarget(MapGrid.covering((0, 0, SIDE, SIDE), resolution, "EPSG:32632"))


def tile(surface, place: MapTarget, window: Window | None = None) -> TileGround:  # type: ignore[no-untyped-def]
    window = window or place.window
    return TileGround.of(place, window, surface.relief(place, window))


def centres(place: MapTarget) -> np.ndarray:
    v, u = np.mgrid[: place.window.height, : place.window.width].astype(float)
    return place.grid.to_map(np.stack([u, v], axis=-1))


def camera(center, angles=(0.0, 0.0, 0.3), focal=900.0, k1=0.0) -> Pinhole:  # type: ignore[no-untyped-def]
    return Pinhole(Pose.from_angles(center, angles), focal, (1200, 900), k1)


def shadow(center, ring, level: float) -> shapely.Polygon:  # type: ignore[no-untyped-def]
    """What a plane polygon hides of a level, from a point."""
    ring, center = np.asarray(ring, float), np.asarray(center, float)
    return shapely.Polygon((center + (ring - center) * ((center[2] - level) / (center[2] - ring[:, 2:])))[:, :2])


def near(polygon, XY: np.ndarray, distance: float) -> np.ndarray:  # type: ignore[no-untyped-def]
    return shapely.distance(polygon.boundary, shapely.points(XY)) <= distance


@pytest.mark.parametrize("k1", some([0.0, -0.05], 0))
def test_the_shadow_of_a_bridge_is_its_deck_seen_from_the_centre(k1: float) -> None:
    """Exact but for what is within 0.1 mm of the border; the road below is hidden by what overhangs it."""
    place, center, road = target(), (70.0, 30.0, 150.0), 2.0
    surface = ObjectSurface(LevelSurface(road), faces_of([DECK], paints=False))
    hidden = hidden_pixels(camera(center, k1=k1), tile(surface, place), surface)
    deck, XY = shadow(center, DECK[0], road), centres(place)
    clear = ~near(deck, XY, 1e-4 if k1 == 0 else 0.05)
    np.testing.assert_array_equal(hidden[clear], shapely.contains_xy(deck, *XY.T).T[clear])
    assert hidden.sum() > 3000
    # Painted, the deck is seen, and hides what its own pixels do not cover.
    bridge = ObjectSurface(LevelSurface(road), faces_of([DECK]))
    hidden = hidden_pixels(camera(center, k1=k1), tile(bridge, place), bridge)
    on = np.isfinite(bridge.faces.heights(XY))
    np.testing.assert_array_equal(hidden[clear], (shapely.contains_xy(deck, *XY.T).T & ~on)[clear])


def test_a_house_hides_what_its_roof_and_walls_hide() -> None:
    place, center = target(), np.array((20.0, 100.0, 90.0))
    house = House(80.0, 60.0, 0.4, 24.0, 14.0, -1.0, 18.0, 18.0)
    surface = ObjectSurface(LevelSurface(0.0), faces_of(house.polygons))
    hidden = hidden_pixels(camera(center, focal=400), tile(surface, place), surface)
    roof = np.c_[house.outline, np.full(4, 18.0)]
    base = shapely.Polygon(house.outline)
    whole = shapely.union_all([shadow(center, roof, 0.0), base]).convex_hull
    XY = centres(place)
    seen = camera(center, focal=400)
    xy = project(seen, np.c_[XY.reshape(-1, 2), surface.heights(XY).ravel()]).reshape(XY.shape)
    inside = ((xy >= -0.5) & (xy <= np.array(seen.size) - 0.5)).all(axis=-1)
    clear = ~near(whole, XY, 0.06) & ~near(base, XY, 0.06)
    truth = shapely.contains_xy(whole, *XY.T).T & ~shapely.contains_xy(base, *XY.T).T & inside
    np.testing.assert_array_equal(hidden[clear], truth[clear])
    assert truth.sum() > 800


def met(corners: np.ndarray, place: np.ndarray, center: np.ndarray, short: float) -> bool:
    """Whether a triangle is met on the way from a place to a centre, beyond `short` metres, by linear equations."""
    d = center - place
    edges = np.stack([np.broadcast_to(-d, (len(corners), 3)), corners[:, 1] - corners[:, 0]], axis=-1)
    edges = np.concatenate([edges, (corners[:, 2] - corners[:, 0])[..., None]], axis=-1)
    regular = np.abs(np.linalg.det(edges)) > 1e-9
    t, b, c = np.linalg.solve(edges[regular], (place - corners[regular, 0])[..., None])[..., 0].T
    inside = (b >= 0) & (c >= 0) & (b + c <= 1) & (t <= 1)
    return bool((inside & (t * np.linalg.norm(d) > short)).any())


@pytest.mark.parametrize("seed", some(range(3), 0))
def test_a_town_hides_what_its_triangles_hide_one_by_one(seed: int) -> None:
    place, town = target(1.0), houses(30, seed)
    surface = ObjectSurface(LevelSurface(0.0), town_faces(town))
    center = np.array((70.0, -30.0, 60.0)) if seed else np.array((70.0, 75.0, 150.0))
    source = camera(center, (0.9, 0.0, 0.0) if seed else (0.0, 0.0, 0.3), 500)
    ground = tile(surface, place)
    hidden = hidden_pixels(source, ground, surface)
    XY = centres(place)
    rng = np.random.default_rng(seed)
    some = rng.choice(XY.shape[0] * XY.shape[1], 600, replace=False)
    places = np.c_[XY.reshape(-1, 2)[some], ground.relief.ravel()[some]]
    xy = project(source, places)
    inside = ((xy >= -0.5) & (xy <= np.array(source.size) - 0.5)).all(axis=-1)
    truth = np.array([met(surface.faces.corners, p, center, 0.1) for p in places]) & inside
    assert 0.1 < truth.mean() < 0.9
    assert (hidden.ravel()[some] != truth).sum() <= 1


def depth_over_half_a_part(source: Pinhole, surface: ObjectSurface, XY: np.ndarray, finer: int) -> np.ndarray:
    """By how much the depth of the surface at map points changes over half a part of a pixel of the image, metres."""

    def seen(at: np.ndarray):  # type: ignore[no-untyped-def]
        XYZ = np.concatenate([at, surface.heights(at)[..., None]], axis=-1)
        return np.concatenate([project(source, XYZ), source.project_homogeneous(XYZ)[..., 2:]], axis=-1)

    change = np.stack([(seen(XY + step) - seen(XY - step)) / 0.04 for step in 0.02 * np.eye(2)], axis=-1)
    slope = np.linalg.solve(np.swapaxes(change[..., :2, :], -1, -2), change[..., 2, :, None])[..., 0]
    return np.abs(slope).sum(axis=-1) / (2 * finer)


@pytest.mark.parametrize("name", some(["vertical", "oblique", "low"], 1))
def test_lines_of_sight_agree_with_a_depth_buffer_in_the_image(name: str) -> None:
    """Hills, houses and a bridge. A pixel is at a silhouette if parts of the image within half a pixel of its place
    differ in whether they show something nearer: all others agree, and of all pixels 99.8 %."""
    source = {
        "vertical": camera((70, 70, 160), (0.02, -0.03, 0.4), 1000),
        "oblique": camera((70, -60, 130), (0.75, 0.05, 0.2), 900),
        "low": camera((-50, 70, 45), (0.0, -1.2, 0.0), 700),
    }[name]
    place = target(1.0)
    XY = centres(place)
    at = np.stack(np.meshgrid(np.arange(0, SIDE + 1, 5), np.arange(SIDE, -1, -5)), axis=-1)
    hills = raster_surface(6 * np.sin(at[..., 0] / 25) + 4 * np.cos(at[..., 1] / 15), 0, SIDE, 5.0)
    town = houses(25, 4, ground=lambda xy: float(hills.heights(np.array(xy))))
    polygons = [p for house in town for p in house.polygons] + [[DECK[0] + (0, 0, 8)]]
    surface = ObjectSurface(hills, faces_of(polygons))
    ground = tile(surface, place)
    hidden = hidden_pixels(source, ground, surface)
    finer = 3
    triangles = np.concatenate([surface.faces.corners, posts_as_triangles(hills.heights(at), at)])
    buffer = depth_buffer(source, triangles, finer)
    places = np.concatenate([XY, ground.relief[..., None].astype(float)], axis=-1)
    assert 0.02 < hidden.mean() < 0.9
    every, some = (hidden_in_buffer(source, places, f(buffer, 3), finer, 0.1) for f in (minimum_filter, maximum_filter))
    clear = every == some
    assert clear.mean() > 0.7
    assert not (hidden != every)[clear].any()
    # A buffer has one depth for all of a part, and a surface that is seen flatly many.
    near = 0.02 + depth_over_half_a_part(source, surface, XY, finer)
    assert (hidden != hidden_in_buffer(source, places, buffer, finer, near)).mean() <= 0.002


def test_tiles_join_and_what_hides_may_lie_beyond_them() -> None:
    place = target()
    surface = ObjectSurface(LevelSurface(0.0), town_faces(houses(30, 2)))
    for source in (camera((70, 70, 120)), camera((70, -60, 90), (0.75, 0.05, 0.2))):
        whole = hidden_pixels(source, tile(surface, place), surface)
        assert whole.mean() > 0.02
        for window in place.window.tiles(64):
            part = hidden_pixels(source, tile(surface, place, window), surface)
            np.testing.assert_array_equal(part, whole[window.slices(place.window)])


def test_houses_are_hidden_by_hills_and_hide_behind_each_other() -> None:
    place = target(1.0)
    posts = np.zeros((140, 140), np.float32)
    posts[:, 40:44] = 30.0
    ridge = raster_surface(posts, 0.5, SIDE - 0.5, 1.0)
    low, high = House(60, 70, 0.0, 10, 10, 0, 6, 6), House(110, 70, 0.0, 10, 10, 0, 60, 60)
    surface = ObjectSurface(ridge, faces_of([*low.polygons, *high.polygons]))
    hidden = hidden_pixels(camera((-60, 70, 70), (0.0, -1.1, 0.0), 400), tile(surface, place), surface)
    assert hidden[66:74, 56:64].all()
    assert not hidden[66:74, 106:114].any()


def test_fault_34_coincident_objects_and_a_line_along_a_wall_flicker_nowhere() -> None:
    place = target(1.0)
    house = House(70.0, 70.0, 0.0, 20.0, 20.0, -1.0, 15.0, 15.0)
    once = ObjectSurface(LevelSurface(0.0), faces_of(house.polygons))
    twice = ObjectSurface(LevelSurface(0.0), faces_of([*house.polygons, *house.polygons]))
    # Straight above the southern wall: its plane holds the centre.
    for center in ((70.0, 60.0, 100.0), (70.0, 70.0, 100.0)):
        a, b = (hidden_pixels(camera(center), tile(s, place), s) for s in (once, twice))
        np.testing.assert_array_equal(a, b)
        # The roof is seen, its own surface does not hide it.
        assert not a[61:79, 61:79].any()
    inside = hidden_pixels(camera((70.0, 70.0, 5.0), focal=300), tile(once, place), once)
    assert inside[65:75, 65:75].sum() == 0


def test_what_lies_behind_the_source_hides_nothing() -> None:
    place = target(1.0)
    surface = ObjectSurface(LevelSurface(0.0), faces_of([[DECK[0] + np.array([0, 0, 100])]], paints=False))
    assert not hidden_pixels(camera((70.0, 70.0, 90.0)), tile(surface, place), surface).any()
