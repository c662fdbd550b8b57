"""Terrain seen from a point: against rays that are cut with every patch, wherever the vertical vanishes."""

from __future__ import annotations

import numpy as np
import pytest
from tools.function_surface import raster_surface
from tools.ray_twin import over_patches, over_triangles
from tools.thinned import some

from photoplan.cameras.curvature import EarthBend, Exaggeration
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior, NoLens
from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid
from photoplan.geometry.pose import Pose
from photoplan.kernels.jit import COMPILED
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.objects import Faces, ObjectSurface
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.seen import SeenSurface, ground_size
from photoplan.targets.map import MapTarget
from photoplan.targets.view import FrameBundle, Panorama, ViewTarget

LEFT, TOP, MESH, SIDE = 600_000.0, 5_200_000.0, 25.0, 24
SIZE = (60, 40) if COMPILED else (8, 6)
MIDDLE = np.array([LEFT + MESH * (SIDE - 1) / 2, TOP - MESH * (SIDE - 1) / 2, 0.0])
BOUNDS = (LEFT - 1, TOP - MESH * SIDE - 1, LEFT + MESH * SIDE + 1, TOP + 1)


def near(*offset: float) -> np.ndarray:
    return MIDDLE + np.array(offset)


def hills(seed: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIDE, :SIDE]
    return (300 + 40 * np.sin(x / 2.3) * np.cos(y / 3.1) + rng.normal(0, 4, (SIDE, SIDE))).astype(np.float32)


def looking(eye, at, roll=0.0, focal=60.0, size=SIZE, lens=None) -> FrameCamera:
    axis = np.subtract(at, eye, dtype=float)
    axis /= np.linalg.norm(axis)
    right = np.cross(axis, (0.0, 1.0, 0.0) if abs(axis[2]) > 0.99 else (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(right, axis), -axis], axis=1)
    c, s = np.cos(roll), np.sin(roll)
    R = R @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return FrameCamera(Interior.digital(size, (focal, focal * 1.2)), lens or NoLens(), Pose(np.array(eye, float), R))


VIEWS = {
    "vanishing point inside": looking(near(20, -30, 900), near(60, 50, 300)),
    "beside": looking(near(-400, -380, 480), near(0, 0, 300)),
    "at a corner": looking(near(-300, 200, 420), near(0, 0, 310), roll=0.7),
    "at infinity": looking(near(-330, 10, 370), near(0, 10, 370)),
    "looking up": looking(near(-100, 50, 330), near(0, 20, 352), focal=30),
}


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("bend", some([0.0, 4e-5], 1))
def test_ground_of_every_pixel_is_where_a_ray_first_meets_a_patch(name: str, bend: float) -> None:
    camera, heights = VIEWS[name], hills()
    terrain = raster_surface(heights, LEFT, TOP, MESH)
    c = camera.center
    assert terrain.heights(c[:2]) < c[2] or np.isnan(terrain.heights(c[:2]))
    warps = (EarthBend((c[0], c[1]), bend),) if bend else ()
    target = ViewTarget(FrameBundle(camera), c, warps, bend)
    seen = SeenSurface(terrain, BOUNDS).look(target, target.window)
    ways = target.bundle.directions(seen.uvh[..., :2]).reshape(-1, 3)
    wanted = over_patches(heights, LEFT, TOP, MESH, c, ways, bend).reshape(SIZE[::-1])
    sky = np.isnan(seen.uvh[..., 2])
    # Beyond the outer posts the surface goes on for half a mesh; the twin ends there.
    XY = seen.XYZ[..., :2]
    rim = ((XY < (LEFT, TOP - MESH * (SIDE - 1))) | (XY > (LEFT + MESH * (SIDE - 1), TOP))).any(axis=-1)
    np.testing.assert_array_equal(sky[~rim], np.isinf(wanted)[~rim])
    both = ~sky & ~rim
    assert both.mean() > 0.2
    away = np.abs(seen.uvh[both, 2] - wanted[both])
    assert np.mean(away < 1e-3) >= 0.9995
    # The same point on the map, and back.
    on_map = c + wanted[both, None] * ways.reshape(*sky.shape, 3)[both]
    on_map[:, 2] += bend * ((on_map - c)[:, :2] ** 2).sum(axis=1)
    assert np.mean(np.abs(seen.XYZ[both] - on_map).max(axis=1) < 1e-3) >= 0.9995
    np.testing.assert_allclose(target.to_view(seen.XYZ[both])[:, :2], seen.uvh[both, :2], atol=1e-5)
    np.testing.assert_allclose(target.to_ground(seen.uvh[both]), seen.XYZ[both], atol=1e-6)


def test_objects_hide_the_ground_and_are_told_by_their_number() -> None:
    terrain, camera = LevelSurface(100.0), looking(near(-80, -60, 160), near(0, 0, 104))
    rng = np.random.default_rng(2)
    at = MIDDLE + np.stack([*rng.uniform(-30, 30, (2, 30)), rng.uniform(102, 125, 30)], axis=1)
    corners = at[:, None] + rng.normal(0, 8, (30, 3, 3)) * (1, 1, 0.3)
    corners[..., 2] = np.maximum(corners[..., 2], 101.0)
    owner = np.arange(30, dtype=np.int32) // 3
    faces = Faces(corners, np.ones(30, bool), owner, tuple(map(str, range(10))))
    target = ViewTarget.of_camera(camera)
    seen = SeenSurface(ObjectSurface(terrain, faces)).look(target, target.window)
    ways = target.bundle.directions(seen.uvh[..., :2]).reshape(-1, 3)
    first, which = over_triangles(corners, camera.center, ways)
    with np.errstate(divide="ignore"):
        ground = np.where(ways[:, 2] < 0, (100 - camera.center[2]) / ways[:, 2], np.inf)
    on_face = first < ground
    wanted = np.where(on_face, owner[which] + 1, 0).reshape(SIZE[::-1])
    np.testing.assert_array_equal(seen.owner, wanted)
    assert len(np.unique(wanted)) > 5 or not COMPILED
    np.testing.assert_allclose(seen.uvh[..., 2].ravel(), np.minimum(first, ground), rtol=1e-9)
    # Normals stand on the faces and look at the camera.
    n = seen.normal.reshape(-1, 3)[on_face]
    edges = corners[which[on_face]]
    np.testing.assert_allclose((n * (edges[:, 1] - edges[:, 0])).sum(axis=1), 0, atol=1e-9)
    assert (seen.incidence < np.pi / 2 + 1e-9).all()


@pytest.mark.parametrize("km, drop", [(1, "0.08"), (10, "7.84"), (100, "783.70")])
def test_a_round_earth_lowers_far_ground_by_table_5_1_of_ecker(km: int, drop: str) -> None:
    warp = EarthBend((0.0, 0.0), 1 / (2 * 6_380_000))
    assert f"{100 - warp([0.0, 1000.0 * km, 100.0])[2]:.2f}" == drop
    np.testing.assert_allclose(warp.inverse(warp([3e4, 4e4, 7.0])), [3e4, 4e4, 7.0], atol=1e-9)
    step = np.eye(3) * 0.5
    at = np.array([3e4, 4e4, 7.0])
    for each, J in ((warp, warp.jacobian(at)), (Exaggeration(5.0, 2.5), np.diag([1, 1, 2.5]))):
        np.testing.assert_allclose((each(at + step) - each(at - step)).T, J, atol=1e-6)


def test_level_ground_over_a_round_earth_ends_at_its_horizon() -> None:
    """With k of 0.13, eyes 100 m above the sea see it for sqrt(2 R h / (1 − k)) metres."""
    b = (1 - 0.13) / (2 * 6_380_000)
    camera = looking((0.0, 0, 100), (0.0, 1000, 100), focal=20_000, size=(3, 501))
    target = ViewTarget(FrameBundle(camera), camera.center, (EarthBend((0.0, 0.0), b),), b)
    seen = SeenSurface(LevelSurface(0.0)).look(target, target.window)
    dip = 2 * np.sqrt(100 * b)
    first_row = np.flatnonzero(np.isfinite(seen.uvh[:, 1, 2]))[0]
    assert first_row == np.ceil(250 + 24_000 * dip)
    fall = (np.arange(first_row, 501) - 250) / 24_000
    away = (fall - np.sqrt(fall**2 - 400 * b)) / (2 * b)
    assert away[0] > 0.9 * np.sqrt(100 / b)
    np.testing.assert_allclose(seen.XYZ[first_row:, 1, 1], away, rtol=1e-9)


def test_exaggerated_ground_keeps_what_lies_at_the_reference_height() -> None:
    camera, terrain = VIEWS["beside"], raster_surface(hills(), LEFT, TOP, MESH)
    plain = SeenSurface(terrain, BOUNDS)
    middle = plain.at(ViewTarget.of_camera(camera), np.array([[(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2]]))
    stretch = Exaggeration(float(middle.XYZ[0, 2]), 3.0)
    c = stretch.inverse(camera.center)
    target = ViewTarget(FrameBundle(camera), c, (stretch,))
    again = plain.at(target, middle.uvh[:, :2])
    np.testing.assert_allclose(again.XYZ, middle.XYZ, atol=1e-6)
    seen = plain.look(target, target.window)
    there = np.isfinite(seen.uvh[..., 2])
    stretched = raster_surface(stretch.reference + (hills() - stretch.reference) * 3, LEFT, TOP, MESH)
    twin = SeenSurface(stretched, BOUNDS).look(ViewTarget.of_camera(camera), target.window)
    np.testing.assert_array_equal(there, np.isfinite(twin.uvh[..., 2]))
    np.testing.assert_allclose(seen.uvh[there, 2], twin.uvh[there, 2], atol=2e-3)


def test_a_lens_bends_the_rays_and_ground_is_measured_through_it() -> None:
    camera = looking(near(-400, -380, 480), near(0, 0, 300), lens=Brown(k1=-0.08))
    target = ViewTarget.of_camera(camera)
    seen = SeenSurface(raster_surface(hills(), LEFT, TOP, MESH), BOUNDS).look(target, target.window)
    there = np.isfinite(seen.uvh[..., 2])
    np.testing.assert_allclose(target.to_view(seen.XYZ[there]), seen.uvh[there], atol=1e-5)


@pytest.mark.parametrize("spherical", [False, True])
def test_panoramas_see_all_around(spherical: bool) -> None:
    bundle = Panorama(np.array([10.0, 20, 50]), (90, 40), 1.0, 90 / (2 * np.pi), 10.0, spherical)
    target = ViewTarget(bundle, bundle.center)
    seen = SeenSurface(LevelSurface(0.0)).look(target, target.window)
    there = np.isfinite(seen.uvh[..., 2])
    assert not there[:10].any() and there[12:33].all()
    np.testing.assert_allclose(target.to_view(seen.XYZ[there]), seen.uvh[there], atol=1e-6)
    away = seen.XYZ - (10, 20, 50)
    turn = np.arctan2(away[20, :, 0], away[20, :, 1])
    np.testing.assert_allclose(np.diff(np.unwrap(turn)), 2 * np.pi / 90, atol=1e-9)
    with pytest.raises(UsageError, match="at most 360"):
        Panorama(bundle.center, (91, 40), 1.0, 90 / (2 * np.pi), 10.0)


def test_pixels_on_level_ground_have_the_size_that_the_camera_gives_them() -> None:
    camera = looking((0.0, 0, 100), (0.0, 0, 0), size=(31, 31), focal=200)
    target = ViewTarget.of_camera(camera)
    seen = SeenSurface(LevelSurface(0.0)).look(target, target.window)
    np.testing.assert_allclose(ground_size(target, seen)[:, ::10], 100 / 200 / np.sqrt(1.2), rtol=1e-3)
    np.testing.assert_allclose(seen.incidence[15, 15], 0, atol=1e-6)
    assert seen.incidence[15, 30] == pytest.approx(np.arctan(15 / 200), rel=1e-6)


def test_what_is_farther_than_asked_is_not_seen_and_targets_must_be_views() -> None:
    camera = looking((0.0, 0, 100), (0.0, 100, 80))
    target, surface = ViewTarget.of_camera(camera), SeenSurface(LevelSurface(0.0), farthest=600.0)
    seen = surface.look(target, target.window)
    assert np.nanmax(target.distance(seen.uvh)) <= 600 and (seen.owner[np.isnan(seen.uvh[..., 2])] == -1).all()
    with pytest.raises(UsageError, match="views"):
        surface.relief(MapTarget(MapGrid(0, 10, 1, 10, 10, "EPSG:32633")), target.window)


class CountedGrid:
    """Posts in memory that count how often they are read."""

    def __init__(self, heights: np.ndarray) -> None:
        self.heights, self.reads = heights, 0

    @property
    def size(self) -> tuple[int, int]:
        return self.heights.shape[1], self.heights.shape[0]

    def read(self, window):
        self.reads += 1
        return self.heights[window.row : window.stop[1], window.col : window.stop[0]]


def test_what_rays_fly_over_is_read_once_and_then_known() -> None:
    grid = CountedGrid(np.zeros((640, 640), np.float32))
    terrain = RasterSurface(grid, (0.0, 640.0), (1.0, 1.0), part=(32, 32))
    down = np.array([[(5.0, 5.0, 400.0), (630.0, 630.0, -1.0)]] * 3)
    first = terrain.first_hit(down)
    count = grid.reads
    again = terrain.first_hit(down + np.array([0.2, 0, 0]))
    # Only the part in which they end, and no more than its neighbour.
    assert 20 < count < 200 and grid.reads - count <= 2
    np.testing.assert_allclose(again.XYZ[:, 1:], first.XYZ[:, 1:], atol=1e-9)


def test_fault_34_coincident_objects_and_tiles_do_not_flicker() -> None:
    camera = looking(near(-80, -60, 160), near(0, 0, 104))
    roof = near(0, 0, 0) + np.array([[(-20, -20, 110.0), (20, -20, 112), (0, 25, 118)]])
    faces = Faces(np.concatenate([roof, roof]), np.ones(2, bool), np.array([0, 1], np.int32), ("one", "same"))
    surface = SeenSurface(ObjectSurface(raster_surface(hills() - 270, LEFT, TOP, MESH), faces), BOUNDS)
    target = ViewTarget.of_camera(camera)
    whole = surface.look(target, target.window)
    assert set(np.unique(whole.owner)) == {-1, 0, 1} or not COMPILED
    for window in target.window.tiles(17):
        part = surface.look(target, window)
        for name, values in vars(part).items():
            np.testing.assert_array_equal(values, getattr(whole, name)[window.slices(target.window)], err_msg=name)


def test_fault_21_holes_let_rays_through_and_are_counted() -> None:
    heights = hills()
    heights[8:14, 8:14] = np.nan
    surface = SeenSurface(raster_surface(heights, LEFT, TOP, MESH), BOUNDS)
    target = ViewTarget.of_camera(VIEWS["vanishing point inside"])
    seen = surface.look(target, target.window)
    sky = seen.owner == -1
    assert sky.any() and np.isnan(seen.XYZ[sky]).all() and np.isnan(seen.incidence[sky]).all()
    # The camera looks down: all that shows no ground is counted.
    np.testing.assert_array_equal(seen.lost, sky)
    assert np.isfinite(seen.XYZ[~sky]).all()
    # A camera below the ground sees nothing until its rays have come out.
    buried = surface.look(ViewTarget.of_camera(looking(near(-100, 0, 100), near(0, 0, 90))), target.window)
    assert (buried.owner == -1).all()
