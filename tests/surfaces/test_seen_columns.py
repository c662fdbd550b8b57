"""Columns of a picture that are vertical planes: one profile for each shows what a ray for each pixel meets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.function_surface import ArrayGrid
from tools.ray_twin import over_patches
from tools.thinned import examples, some

from photoplan.cameras.curvature import EarthBend, Exaggeration
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior, NoLens
from photoplan.geometry.grid import Window
from photoplan.geometry.local import LocalFrame
from photoplan.geometry.pose import Pose
from photoplan.kernels.jit import COMPILED
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.seen import Seen, SeenSurface
from photoplan.targets.view import FrameBundle, Panorama, ViewTarget, fan_of

MESH = 10.0
SIDE, SIZE = (50, (64, 40)) if COMPILED else (20, (9, 7))


def terrain_of(heights: np.ndarray) -> RasterSurface:
    """In parts of 16 meshes."""
    return RasterSurface(ArrayGrid(heights), (0.0, 0.0), (MESH, MESH), part=(16, 16))


def bounds_of(side: int) -> tuple[float, float, float, float]:
    return (-MESH / 2, -MESH * (side - 0.5), MESH * (side - 0.5), MESH / 2)


def cliffs(seed: int, rough: float, holes: float, side: int = SIDE) -> np.ndarray:
    """Rough ground with terraces between neighbouring posts, up to 60 m, and posts without height."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:side, :side]
    heights = 100 + 15 * np.sin(x / 3.3 + seed) * np.cos(y / 4.1) + rng.normal(0, rough, (side, side))
    heights += 20 * np.floor(2 + np.sin(x / 5 + y / 7))
    heights[rng.random((side, side)) < holes] = np.nan
    return heights.astype(np.float32)


def level_camera(eye: np.ndarray, azimuth: float, size: tuple[int, int] = SIZE, lens: object = None) -> FrameCamera:
    s, c = np.sin(azimuth), np.cos(azimuth)
    R = np.array([[c, 0, -s], [-s, 0, -c], [0, 1.0, 0]])
    return FrameCamera(Interior.digital(size, (40.0, 48.0), (2.3, -4.0)), lens or NoLens(), Pose(eye, R))


def target_of(kind: str, eye: np.ndarray, azimuth: float, warps: tuple = (), bend: float = 0.0) -> ViewTarget:
    center = eye
    for warp in warps:
        eye = warp(eye)
    if kind == "frame":
        return ViewTarget(FrameBundle(level_camera(eye, azimuth)), center, warps, bend)
    scale = SIZE[0] / (2 * np.pi if kind == "cylinder" else 3.0)
    bundle = Panorama(eye, SIZE, azimuth, scale, SIZE[1] * 0.4, kind == "sphere")
    return ViewTarget(bundle, center, warps, bend)


def by_rays(surface: SeenSurface, target: ViewTarget, window: Window) -> Seen:
    v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
    seen = surface.at(target, np.stack([u, v], axis=-1).reshape(-1, 2))
    return seen.reshaped(window.height, window.width)


def assert_same(seen: Seen, wanted: Seen, within: float = 1e-6) -> None:
    np.testing.assert_array_equal(seen.owner, wanted.owner)
    np.testing.assert_array_equal(seen.lost, wanted.lost)
    for name in ("XYZ", "uvh", "normal", "towards"):
        np.testing.assert_allclose(getattr(seen, name), getattr(wanted, name), rtol=0, atol=within, err_msg=name)


@settings(max_examples=examples(15, 40) if COMPILED else 4, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    kind=st.sampled_from(["frame", "cylinder", "sphere"]),
    rough=st.sampled_from([0.5, 5.0, 30.0]),
    holes=st.sampled_from([0.0, 0.0, 0.02, 0.3]),
    above=st.floats(-30, 150),
    bend=st.sampled_from([0.0, 5e-5]),
    factor=st.sampled_from([1.0, 2.5]),
    farthest=st.sampled_from([np.inf, 170.0]),
)
def test_profiles_show_what_rays_meet(seed, kind, rough, holes, above, bend, factor, farthest) -> None:
    """Eyes in and beside the terrain, above and below the ground; holes, cliffs, a round earth, raised ground."""
    heights = cliffs(seed, rough, holes)
    rng = np.random.default_rng(seed + 1)
    eye = np.array([*(rng.uniform(-0.2, 1.2, 2) * MESH * SIDE * (1, -1)), 130 + above])
    warps = (Exaggeration(120.0, factor),) if factor != 1 else ()
    warps += (EarthBend((eye[0], eye[1]), bend),) if bend else ()
    target = target_of(kind, eye, rng.uniform(0, 7), warps, bend / factor)
    surface = SeenSurface(terrain_of(heights), bounds_of(SIDE), farthest=farthest)
    assert target.upright
    whole = surface.look(target, target.window)
    assert_same(whole, by_rays(surface, target, target.window))
    # To the last bit from any tile.
    for window in target.window.tiles(23):
        part = surface.look(target, window)
        for name, values in vars(part).items():
            np.testing.assert_array_equal(values, getattr(whole, name)[window.slices(target.window)], err_msg=name)


@pytest.mark.parametrize("kind", ["frame", "cylinder", "sphere"])
@pytest.mark.parametrize("bend", some([0.0, 4e-5], 1))
def test_profiles_show_what_a_ray_cut_with_every_patch_meets(kind: str, bend: float) -> None:
    heights = cliffs(3, 4.0, 0.0, side=24)
    eye = np.array([118.3, -121.9, 175.0])
    target = target_of(kind, eye, 0.4, (EarthBend((eye[0], eye[1]), bend),) if bend else (), bend)
    seen = SeenSurface(terrain_of(heights), bounds_of(24)).look(target, target.window)
    ways = target.bundle.directions(seen.uvh[..., :2]).reshape(-1, 3)
    wanted = over_patches(heights, 0.0, 0.0, MESH, eye, ways, bend).reshape(SIZE[::-1])
    # Beyond the outer posts the surface goes on for half a mesh; the twin ends there.
    rim = ((seen.XYZ[..., :2] < (0, -MESH * 23)) | (seen.XYZ[..., :2] > (MESH * 23, 0))).any(axis=-1)
    sky = np.isnan(seen.uvh[..., 2])
    np.testing.assert_array_equal(sky[~rim], np.isinf(wanted)[~rim])
    both = ~sky & ~rim
    assert both.mean() > 0.15 or not COMPILED
    np.testing.assert_allclose(seen.uvh[both, 2], wanted[both], atol=1e-3)


def test_level_ground_near_below_the_eye_and_straight_along_the_posts() -> None:
    """Eyes over a post, looking along rows and columns of posts and down to the nadir."""
    heights = np.full((SIDE, SIDE), 7.0, np.float32)
    eye = np.array([MESH * (SIDE // 2), -MESH * (SIDE // 2), 9.0])
    surface = SeenSurface(terrain_of(heights), bounds_of(SIDE))
    bundle = Panorama(eye, (8, 91), 0.0, 8 / (2 * np.pi), 0.0, spherical=True)
    for scale in (bundle.scale, 90 / (np.pi / 2)):
        target = ViewTarget(Panorama(eye, (8, 91), np.pi / 2, scale, 0.0, spherical=True), eye)
        seen = surface.look(target, target.window)
        assert_same(seen, by_rays(surface, target, target.window))
        there = seen.owner == 0
        np.testing.assert_allclose(seen.XYZ[there, 2], 7.0, atol=1e-9)
    # The last row is the nadir.
    np.testing.assert_allclose(seen.XYZ[90, :, :2], np.broadcast_to(eye[:2], (8, 2)), atol=1e-9)


def test_only_columns_that_are_vertical_planes_are_profiles() -> None:
    eye = np.array([600_100.0, 5_200_000.0, 150.0])
    window = Window(0, 0, *SIZE)
    level = level_camera(eye, 1.0)
    assert fan_of(ViewTarget.of_camera(level), window, 1e4, 0.01) is not None

    def turned(angle: float, axis: int) -> FrameCamera:
        s, c = np.sin(angle), np.cos(angle)
        R = np.roll([[1.0, 0, 0], [0, c, -s], [0, s, c]], axis, axis=(0, 1))
        return level.turned(R)

    for camera in (turned(1e-6, 0), turned(1e-6, 2), turned(np.pi, 2), level_camera(eye, 1.0, lens=Brown(k1=0.01))):
        assert fan_of(ViewTarget.of_camera(camera), window, 1e4, 0.01) is None
    strict = ViewTarget(FrameBundle(level), eye, (LocalFrame("EPSG:32633", (float(eye[0]), float(eye[1]))),))
    assert fan_of(strict, window, 1e4, 0.01) is None
    # Terrain in another CRS is seen by rays.
    grid = terrain_of(cliffs(1, 1.0, 0.0))
    moved = RasterSurface(grid.grid, grid.origin, grid.mesh, lambda XY: XY - (5000.0, 0.0), grid.part)
    target = target_of("frame", np.array([5100.0, -100.0, 250.0]), 2.0)
    seen = SeenSurface(moved, (5000.0, -500, 5500, 0)).look(target, target.window)
    assert_same(seen, by_rays(SeenSurface(moved, (5000.0, -500, 5500, 0)), target, target.window), 0)
    assert (seen.owner == 0).any() or not COMPILED
