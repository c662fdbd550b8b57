"""Which pixels of a tile a source sees, against lines of sight that are walked step by step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion, map_coordinates
from tools.function_surface import FunctionSurface, raster_surface
from tools.pinhole import Pinhole

from photoplan.cameras.base import project
from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.plan import sources as visibility
from photoplan.plan.ground import TileGround
from photoplan.plan.sources import hidden_pixels, sight_lines
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.shifted import ShiftedSurface
from photoplan.targets.map import MapTarget

SIDE, MESH = 140, 1.0


def town(seed: int = 0) -> np.ndarray:
    """Posts of waves with houses on them."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    posts = 6 * np.sin(u / 25) + 4 * np.cos(v / 15)
    for _ in range(14):
        row, col = rng.integers(0, SIDE - 20, 2)
        height, width = rng.integers(5, 20, 2)
        posts[row : row + height, col : col + width] += rng.uniform(3, 18)
    return posts.astype(np.float32)


def target() -> MapTarget:
    """Pixels whose centres are the posts of a town."""
    return MapTarget(MapGrid.covering((0, 0, SIDE * MESH, SIDE * MESH), MESH, "EPSG:32632"))


def surface_of(posts: np.ndarray):  # type: ignore[no-untyped-def]
    return raster_surface(posts, MESH / 2, SIDE * MESH - MESH / 2, MESH)


def tile(surface, window: Window) -> TileGround:  # type: ignore[no-untyped-def]
    place = target()
    return TileGround.of(place, window, surface.relief(place, window))


def walked(posts: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Pixels whose straight line to a source lies below bilinear ground at some place, eight a pixel.

    `toward` (rows, cols, 3): where the source is seen from each pixel, as (u, v, h).
    """
    v, u = np.mgrid[:SIDE, :SIDE].astype(float)
    start = np.stack([u, v, posts.astype(float)], axis=-1).reshape(-1, 3)
    way = toward.reshape(-1, 3) - start
    end = np.where(way[:, 2] > 0, (posts.max() - start[:, 2]) / way[:, 2], 1.0).clip(max=1.0)
    pixels = np.abs(way[:, :2]).max(axis=-1)
    hidden, on = np.zeros(len(start), bool), np.arange(len(start))
    for step in range(1, 16 * SIDE):
        on = on[(step / 8 < end[on] * pixels[on]) & ~hidden[on]]
        place = start[on] + (step / 8 / pixels[on])[:, None] * way[on]
        ground = map_coordinates(posts, [place[:, 1], place[:, 0]], order=1, cval=-1e9)
        hidden[on] = ground > place[:, 2] + 1e-3
    return hidden.reshape(posts.shape)


def inside(camera, posts: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    v, u = np.mgrid[:SIDE, :SIDE].astype(float)
    xy = project(camera, target().to_ground(np.stack([u, v, posts], axis=-1)))
    return ((xy >= -0.5) & (xy <= np.array(camera.size) - 0.5)).all(axis=-1)


def at(point) -> np.ndarray:  # type: ignore[no-untyped-def]
    """A point of the map as (u, v, h) for every pixel."""
    uv = target().grid.to_pixel(np.array(point[:2], float))
    return np.broadcast_to([*uv, point[2]], (SIDE, SIDE, 3))


def agree(found: np.ndarray, truth: np.ndarray) -> None:
    """All but half a pixel at borders of hidden areas, and those seldom."""
    other = found != truth
    border = binary_dilation(truth, np.ones((3, 3))) & ~binary_erosion(truth, np.ones((3, 3)))
    assert not (other & ~border).any()
    assert other.mean() < 0.004


CAMERAS = {
    "vertical": Pinhole(Pose.from_angles((70, 75, 120), (0.02, -0.03, 0.4)), 900, (1200, 900)),
    "oblique, lens": Pinhole(Pose.from_angles((70, -40, 90), (0.75, 0.05, 0.2)), 700, (1200, 900), -0.05),
    "oblique": Pinhole(Pose.from_angles((70, -40, 90), (0.75, 0.05, 0.2)), 700, (1200, 900)),
    "beside, below the roofs": Pinhole(Pose.from_angles((-30, 70, 14), (0.0, -1.4, 0.0)), 400, (1200, 900)),
}


@pytest.mark.parametrize("name", ["vertical", "oblique, lens", "beside, below the roofs"])
def test_hidden_pixels_are_those_of_lines_that_are_walked(name: str) -> None:
    camera, posts = CAMERAS[name], town()
    surface = surface_of(posts)
    found = hidden_pixels(camera, tile(surface, target().window), surface)
    truth = walked(posts, at(camera.center)) & inside(camera, posts)
    assert 0.01 < truth.mean() < 0.9
    agree(found, truth)


class Pushbroom:
    """Flown northwards over X = 70 in a height of 90, a column of the image for 0.1 m across and along it."""

    size, field, breaks = (4000, 2000), None, None

    def project_homogeneous(self, XYZ):  # type: ignore[no-untyped-def]
        X, Y, Z = np.moveaxis(np.asarray(XYZ, float), -1, 0)
        w = 90.0 - Z
        return np.stack([900.0 * (X - 70.0) + 2000.0 * w, (150.0 - Y) / 0.1 * w, w], axis=-1)


def test_a_line_camera_hides_across_its_flight_only() -> None:
    """Every line has a centre of its own; there is none for the image."""
    posts = town(3)
    surface = surface_of(posts)
    camera = Pushbroom()
    v, u = np.mgrid[:SIDE, :SIDE].astype(float)
    uvh = np.stack([u, v, posts.astype(float)], axis=-1)
    above = at((70.0, 0.0, 90.0)).copy()
    above[..., 1] = v
    lines = sight_lines(camera, target(), uvh[::30, ::30].copy())
    straight = above[::30, ::30] - uvh[::30, ::30]
    np.testing.assert_allclose(lines.step * lines.length[..., None], straight, atol=1e-6)
    found = hidden_pixels(camera, tile(surface, target().window), surface)
    truth = walked(posts, above) & inside(camera, posts)
    assert truth.mean() > 0.01
    agree(found, truth)


def test_tiles_join_whatever_hides_lies_beyond_them() -> None:
    camera, surface = CAMERAS["oblique"], surface_of(town())
    whole = hidden_pixels(camera, tile(surface, target().window), surface)
    for window in target().window.tiles(64):
        np.testing.assert_array_equal(
            hidden_pixels(camera, tile(surface, window), surface), whole[window.slices(target().window)]
        )


def test_what_is_further_away_than_a_raster_reaches_is_found_on_the_terrain(monkeypatch: pytest.MonkeyPatch) -> None:
    camera, surface = CAMERAS["oblique, lens"], surface_of(town())
    ground = tile(surface, Window(40, 30, 80, 80))
    near = hidden_pixels(camera, ground, surface)
    assert near.any()
    monkeypatch.setattr(visibility, "MOST_AROUND", 3)
    far = hidden_pixels(camera, ground, surface)
    agree(far, near)
    monkeypatch.setattr(visibility._OverTerrain, "_met", lambda self, uvh, *more: np.zeros(len(uvh), bool))
    assert hidden_pixels(camera, ground, surface).sum() < far.sum() - 20


def test_blocks_that_are_not_looked_at_hide_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    skipped = 0
    for _ in range(12):
        posts = town(int(rng.integers(1000))) * np.float32(rng.uniform(0.2, 1.0))
        posts[rng.random(posts.shape) < 0.001] = np.nan
        surface = surface_of(posts)
        pose = Pose.from_angles((*rng.uniform(0, 140, 2), rng.uniform(60, 200)), (*rng.uniform(-0.3, 0.3, 2), 1.0))
        camera, ground = Pinhole(pose, 500, (1200, 900)), tile(surface, target().window)
        quick = hidden_pixels(camera, ground, surface)
        with monkeypatch.context() as patch:
            real = visibility.free_blocks

            def nowhere(*args):  # type: ignore[no-untyped-def]
                nonlocal skipped
                quiet = real(*args)  # noqa: B023
                skipped += int(quiet.sum())
                return np.zeros_like(quiet)

            patch.setattr(visibility, "free_blocks", nowhere)
            np.testing.assert_array_equal(quick, hidden_pixels(camera, ground, surface))
    assert skipped > 300


def test_nothing_hides_level_ground_and_holes() -> None:
    camera, level = CAMERAS["vertical"], LevelSurface(3.0)
    assert not hidden_pixels(camera, tile(level, Window(0, 0, 90, 70)), level).any()
    holes = FunctionSurface(lambda X, Y: np.where(X < 20, np.nan, 0.0 * X))
    assert not hidden_pixels(camera, tile(holes, Window(0, 0, 90, 70)), holes).any()
    nothing = FunctionSurface(lambda X, Y: np.nan * X)
    assert not hidden_pixels(camera, tile(nothing, Window(0, 0, 90, 70)), nothing).any()


def test_other_products_than_maps_are_refused() -> None:
    ground = tile(LevelSurface(0.0), Window(0, 0, 20, 20))
    object.__setattr__(ground, "target", object())
    with pytest.raises(UsageError, match="known for maps"):
        hidden_pixels(CAMERAS["vertical"], ground, LevelSurface(0.0))


def test_a_tower_beyond_a_level_tile_hides_its_ground() -> None:
    posts = np.zeros((SIDE, SIDE), np.float32)
    posts[60:70, 64:68] = 30.0
    camera, surface, window = CAMERAS["oblique"], surface_of(posts), Window(40, 0, 64, 58)
    whole = hidden_pixels(camera, tile(surface, target().window), surface)[window.slices(target().window)]
    assert whole.sum() > 50
    np.testing.assert_array_equal(hidden_pixels(camera, tile(surface, window), surface), whole)


FINE = 0.5


def fine_town(side: int = 240) -> np.ndarray:
    """Posts of 0.5 m: waves, with buildings whose walls are one mesh wide."""
    rng = np.random.default_rng(1)
    u, v = np.meshgrid(np.arange(side), np.arange(side))
    posts = 3 * np.sin(u / 45) + 2 * np.cos(v / 30)
    for _ in range(14):
        row, col = rng.integers(5, side - 50, 2)
        height, width = rng.integers(12, 40, 2)
        posts[row : row + height, col : col + width] = rng.uniform(5, 15)
    return posts.astype(np.float32)


def walked_over_posts(posts: np.ndarray, XYZ: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Places (..., 3) whose line to a centre lies below the posts' bilinear surface, in steps of 1/16 mesh."""
    places = XYZ.reshape(-1, 3)
    way = center - places
    end = np.clip((posts.max() - places[:, 2]) / way[:, 2], 0, 1)
    steps = 16 * np.abs(way[:, :2]).max(axis=-1) * end / FINE
    hidden, on = np.zeros(len(places), bool), np.arange(len(places))
    for step in range(1, int(steps.max()) + 1):
        on = on[(step < steps[on]) & ~hidden[on]]
        at = places[on] + (step / steps[on] * end[on])[:, None] * way[on]
        rows, columns = ((len(posts) - 0.5) - at[:, 1] / FINE, at[:, 0] / FINE - 0.5)
        hidden[on] = map_coordinates(posts, [rows, columns], order=1, cval=-1e9) > at[:, 2] + 1e-3
    return hidden.reshape(XYZ.shape[:-1])


def turned(XY: np.ndarray) -> np.ndarray:
    """To a map whose axes are turned by a degree."""
    c, s = np.cos(np.radians(1.0)), np.sin(np.radians(1.0))
    return np.asarray(XY) @ np.array([[c, s], [-s, c]])


CARRIES = {"posts": None, "posts of another map": turned}


@pytest.mark.parametrize("carry", CARRIES)
@pytest.mark.parametrize("resolution", [pytest.param(0.2, marks=pytest.mark.slow), 0.5, 1.0, 2.0])
def test_hidden_ground_is_as_large_whatever_the_pixels(resolution: float, carry: str) -> None:
    """Walls of the terrain's own posts stay as steep as they are in pixels of four times their width."""
    posts = fine_town()
    side = len(posts) * FINE
    surface = replace(raster_surface(posts, FINE / 2, side - FINE / 2, FINE), to_grid_crs=CARRIES[carry])
    place = MapTarget(MapGrid.covering((4.0, 4.0, side - 4, side - 4), resolution, "EPSG:32632"))
    camera = Pinhole(Pose.from_angles((60, 55, 200), (0.02, -0.03, 0.4)), 900, (1600, 1500))
    ground = TileGround.of(place, place.window, surface.relief(place, place.window))
    found = hidden_pixels(camera, ground, surface)
    v, u = np.mgrid[: place.window.height, : place.window.width].astype(float)
    XYZ = place.to_ground(np.stack([u, v, ground.relief], axis=-1))
    center = np.array(camera.center)
    if CARRIES[carry]:
        XYZ, center = (np.concatenate([turned(p[..., :2]), p[..., 2:]], axis=-1) for p in (XYZ, center))
    truth = walked_over_posts(posts, XYZ, center)
    assert truth.mean() > 0.02
    assert found.sum() == pytest.approx(truth.sum(), rel=0.03)
    assert (found != truth).mean() < 0.001


def test_coarse_tiles_join_and_are_looked_at_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    posts = fine_town()
    surface = raster_surface(posts, FINE / 2, len(posts) * FINE - FINE / 2, FINE)
    place = MapTarget(MapGrid.covering((4.0, 4.0, 116.0, 116.0), 2.0, "EPSG:32632"))
    camera = CAMERAS["oblique"]

    def hidden(window: Window) -> np.ndarray:
        return hidden_pixels(camera, TileGround.of(place, window, surface.relief(place, window)), surface)

    whole = hidden(place.window)
    assert whole.mean() > 0.05
    monkeypatch.setattr(visibility, "MOST_POSTS", 40)
    np.testing.assert_array_equal(hidden(place.window), whole)
    for window in place.window.tiles(20):
        np.testing.assert_array_equal(hidden(window), whole[window.slices(place.window)])


def test_ground_in_other_heights_hides_what_it_hides() -> None:
    """A shift of heights that is a slope: the same as posts that are shifted."""
    posts = fine_town()
    rise = 0.1 * FINE * np.arange(len(posts))
    low, high = (raster_surface(h, FINE / 2, len(posts) * FINE - FINE / 2, FINE) for h in (posts, posts + rise))
    shifted = ShiftedSurface(low, lambda XY: (np.asarray(XY)[..., 0] - FINE / 2) * 0.1)
    place = MapTarget(MapGrid.covering((4.0, 4.0, 116.0, 116.0), 1.0, "EPSG:32632"))
    a, b = (
        hidden_pixels(CAMERAS["oblique"], TileGround.of(place, place.window, s.relief(place, place.window)), s)
        for s in (shifted, high)
    )
    assert b.mean() > 0.05 and (a != b).mean() < 0.001
