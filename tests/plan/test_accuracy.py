"""Accuracy of every product pixel: formulas of the sources, another way to compute it, and simulated blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tools.function_surface import FunctionSurface
from tools.source_errors import moved, pose_errors

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior, NoLens
from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.plan.accuracy import (
    IndependentError,
    SourceErrors,
    displacement_by_height,
    displacement_by_kappa,
    displacement_by_tilt,
    figures_at,
    resampling_sigma,
    tile_accuracy,
)
from photoplan.targets.map import MapTarget
from photoplan.terrain.analysis import MonoplotErrors, monoplot

SIZE, FOCAL, HEIGHT = (1200, 900), 1000.0, 1000.0
WIDE = Brown(k1=-0.08, k2=0.02, p1=1e-3)
ROLLING = FunctionSurface(lambda X, Y: 40 * np.sin(X / 150) * np.cos(Y / 190))
LEVEL = FunctionSurface(lambda X, Y: 0.0 * X)


def camera_at(omega: float = 0.0, phi: float = 0.0, lens=NoLens()) -> FrameCamera:  # noqa: B008
    interior = Interior.digital(SIZE, (FOCAL, FOCAL))
    return FrameCamera(interior, lens, Pose.from_angles([0.0, 0.0, HEIGHT], (omega, phi, 0.3)))


def target_of(half: float = 300.0, pixel: float = 10.0) -> MapTarget:
    return MapTarget(MapGrid.covering((-half, -half, half, half), pixel, "EPSG:32633"))


def constant(sigma: float):
    return lambda target, window: np.full((window.height, window.width), sigma)


def test_terrain_moves_as_table_4_3_says() -> None:
    """Eq. 4.18: on level ground the displacement is radial and the ellipse is a line away from the nadir point."""
    target, camera = target_of(), camera_at()
    found = tile_accuracy(target, target.window, LEVEL, constant(2.0), {0: SourceErrors(camera, ())})
    v, u = np.mgrid[0 : target.window.height, 0 : target.window.width]
    XY = target.grid.to_map(np.stack([u, v], axis=-1).astype(float))
    r = np.hypot(XY[..., 0], XY[..., 1])
    ground = displacement_by_height(r * 0.15 / HEIGHT, HEIGHT, 2.0) * HEIGHT / 0.15
    np.testing.assert_allclose(found[3], ground, rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose(found[2], 2.0, rtol=1e-6)
    assert found[4].max() < 0.02 * ground.max()
    azimuth = np.degrees(np.arctan2(XY[..., 0], XY[..., 1])) % 180
    away = np.abs((found[5] - azimuth + 90) % 180 - 90)
    assert away[r > 50].max() < 0.5


def test_orientation_moves_as_equations_4_20_to_4_29_say() -> None:
    camera, small = camera_at(), 1e-4
    camera = replace(camera, pose=Pose(camera.center, np.eye(3)))
    target = MapTarget(MapGrid.covering((395.0, 395.0, 405.0, 405.0), 1.0, "EPSG:32633"))
    w = 0.4

    def radial(change: np.ndarray) -> float:
        cause = IndependentError("one", moved(camera, change), moved(camera, -change))
        found = tile_accuracy(target, target.window, LEVEL, constant(0.0), {0: SourceErrors(camera, (cause,))})
        return float(np.hypot(found[0], found[1]).mean())

    tilt, kappa = (f(small, 1.0, w) * HEIGHT for f in (displacement_by_tilt, displacement_by_kappa))
    expected = [0.3, 0.3, 0.3 * w * np.sqrt(2), tilt, tilt, kappa]
    moves = np.diag([0.3, 0.3, 0.3, small, small, small])
    np.testing.assert_allclose([radial(m) for m in moves], expected, rtol=5e-3)


@pytest.mark.parametrize("camera", [camera_at(), camera_at(lens=WIDE), camera_at(0.5, -0.3), camera_at(0.6, 0.2, WIDE)])
def test_agrees_with_monoplotting(camera: FrameCamera) -> None:
    """The other way round: from the image points of the pixels to the ground, with derivatives in closed form."""
    ahead = camera.rays([(n - 1) / 2 for n in SIZE])[1]
    x, y = (camera.center - ahead * HEIGHT / ahead[2])[:2]
    target, sigma = MapTarget(MapGrid.covering((x - 200, y - 200, x + 200, y + 200), 25.0, "EPSG:32633")), 0.7
    position, angles, image = (0.3, 0.2, 0.5), (2e-4, 3e-4, 1e-4), 0.4
    pose = camera.pose
    R = pose.R_ground_camera
    causes = []
    for k in range(3):
        move = np.zeros(6)
        move[k] = position[k]
        causes.append(IndependentError("centre", moved(camera, move), moved(camera, -move)))
        turn = np.r_[0.0, 0.0, 0.0, R.T @ (np.eye(3)[k] * angles[k])]
        causes.append(IndependentError("angles", moved(camera, turn), moved(camera, -turn)))
    errors = SourceErrors(camera, tuple(causes), image)
    # Slopes as monoplotting has them: over a mesh of a pixel, which here is nearly a plane.
    tilted = FunctionSurface(lambda X, Y: 0.25 * X - 0.15 * Y)
    found = tile_accuracy(target, target.window, tilted, constant(sigma), {0: errors})
    v, u = np.mgrid[0 : target.window.height, 0 : target.window.width]
    XY = target.grid.to_map(np.stack([u, v], axis=-1).astype(float)).reshape(-1, 2)
    xy = project(camera, np.column_stack([XY, tilted.heights(XY)]))
    inside = ((xy > 0) & (xy < np.array(SIZE) - 1)).all(axis=1)
    assert inside.sum() > 50
    plotted = monoplot(camera, xy, tilted, (-500.0, 500.0), MonoplotErrors(image, sigma, position, angles), 25.0)
    np.testing.assert_allclose(found[:3].reshape(3, -1).T[inside], plotted.sigmas[inside], rtol=5e-3)


def test_between_nodes_as_at_every_pixel() -> None:
    """Smooth figures are interpolated to a hundredth of the largest, relief or not."""
    camera, target = camera_at(0.5, 0.2, WIDE), target_of(250, 5.0)
    covariance = np.diag([0.3, 0.3, 0.5, 2e-4, 3e-4, 1e-4]) ** 2
    errors = {0: pose_errors(camera, covariance, 0.2)}
    whole = tile_accuracy(target, target.window, ROLLING, constant(0.5), errors)
    pixels = [Window(c, r, 1, 1) for c, r in ((0, 0), (50, 50), (99, 3), (20, 80), (71, 64))]
    for one in pixels:
        strict = tile_accuracy(target, one, ROLLING, constant(0.5), errors)[:5, 0, 0]
        np.testing.assert_allclose(whole[:5, one.row, one.col], strict, rtol=0.02)


def test_where_nothing_is_painted_nothing_is_said() -> None:
    camera, target = camera_at(), target_of(100, 10.0)
    hole = FunctionSurface(lambda X, Y: np.where(np.hypot(X, Y) < 30, np.nan, 0.0))
    owner = np.ones((target.window.height, target.window.width), np.uint16)
    owner[:5] = 0
    found = tile_accuracy(target, target.window, hole, constant(1.0), {0: SourceErrors(camera, ())}, owner)
    there = np.isfinite(hole.relief(target, target.window)) & (owner > 0)
    assert (np.isfinite(found).all(axis=0) == there).all()
    with pytest.raises(UsageError, match="source 0 paints"):
        tile_accuracy(target, target.window, hole, constant(1.0), {1: SourceErrors(camera, ())}, owner)


def test_each_pixel_has_the_errors_of_its_own_source() -> None:
    target = target_of(100, 10.0)
    near, far = (SourceErrors(camera_at(), (), image) for image in (0.5, 2.0))
    owner = np.ones((target.window.height, target.window.width), np.uint16)
    owner[:, 10:] = 2
    found = tile_accuracy(target, target.window, LEVEL, constant(0.0), {0: near, 1: far}, owner)
    pixel = HEIGHT / FOCAL
    np.testing.assert_allclose(found[3, :, :10], 0.5 * pixel, rtol=1e-4)
    np.testing.assert_allclose(found[3, :, 10:], 2.0 * pixel, rtol=1e-4)


def test_a_wall_is_not_a_slope() -> None:
    """Roof and ground beside a wall have their own slopes, and the error does not grow towards the wall."""
    target, camera = target_of(100, 10.0), camera_at()
    house = FunctionSurface(lambda X, Y: np.where(X > 3, 30.0, 0.0))
    found = tile_accuracy(target, target.window, house, constant(1.0), {0: SourceErrors(camera, ())})
    np.testing.assert_allclose(found[2], 1.0, rtol=1e-6)


def test_turned_away_from_the_camera_is_not_said() -> None:
    away = FunctionSurface(lambda X, Y: -10.0 * (X - 395))
    target = MapTarget(MapGrid.covering((400.0, 0.0, 420.0, 20.0), 1.0, "EPSG:32633"))
    assert np.isnan(tile_accuracy(target, target.window, away, constant(1.0), {0: SourceErrors(camera_at(), ())})).all()


def test_figures_of_resampling() -> None:
    """Nearest 1/√12; the others by the phase of a wave of four pixels: the more taps, the less."""
    named = [resampling_sigma(k) for k in ("nearest", "bilinear", "bicubic-1", "lanczos3")]
    assert named[0] == pytest.approx(12**-0.5)
    np.testing.assert_allclose(named[1:], [0.0324, 0.0204, 0.0048], atol=5e-5)


def test_a_projection_needs_no_centre() -> None:
    """A parallel projection: the run of its rays is the same everywhere, and a shift stays a shift."""

    class Parallel:
        size, field, breaks = SIZE, None, None

        def __init__(self, shift: float = 0.0) -> None:
            self.shift = shift

        def project_homogeneous(self, XYZ):
            X, Y, Z = np.moveaxis(np.asarray(XYZ, float), -1, 0)
            return np.stack([X + 0.5 * Z + self.shift, -Y, np.ones_like(X)], axis=-1)

    target = target_of(100, 10.0)
    errors = SourceErrors(Parallel(), (IndependentError("shift", Parallel(0.4), Parallel(-0.4)),))
    found = tile_accuracy(target, target.window, LEVEL, constant(2.0), {0: errors})
    np.testing.assert_allclose(found[0], np.hypot(0.5 * 2.0, 0.4), rtol=1e-6)
    assert found[1].max() < 1e-6
    assert figures_at(errors, target, np.zeros((4, 3))).shape == (4, 14)
