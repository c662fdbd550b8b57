"""Stated accuracies of product pixels against the truth of simulated blocks: normalised errors are about 1."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tools.function_surface import FunctionSurface
from tools.sim_block import FOCAL, SIZE, simulate
from tools.source_errors import moved, pose_errors
from tools.thinned import some

from photoplan.cameras.base import project
from photoplan.cameras.fiducials import Affine2D, Bilinear2D
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import rotation_vector
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.model import AdjustSettings
from photoplan.plan.accuracy import tile_accuracy
from photoplan.targets.map import MapTarget

#: Terrain as the blocks have it, its standard deviation, and that of a pixel's position in the image.
RELIEF = FunctionSurface(lambda X, Y: 60 * np.sin(X / 300) * np.cos(Y / 400))
TERRAIN, IMAGE = 0.25, 0.29
PIXELS = 8
PLAIN = AdjustSettings(robust=False, variance_components=False, correlation=False)
LENS = Brown(k1=-0.05, k2=0.01, p1=5e-4)
INTERIOR = Interior.digital(SIZE, (FOCAL, FOCAL))
A = INTERIOR.plane_to_pixel
assert isinstance(A, Affine2D)
#: A film that shrank more in one corner.
WARPED = replace(INTERIOR, plane_to_pixel=Bilinear2D(A.a1, A.a2, 2e-6, A.a3, A.a4, A.a5, -3e-6, A.a6))
#: Interior orientation, lens, tilt of the images (radians).
CAMERAS = {
    "vertical": (INTERIOR, Brown(), 0.03),
    "lens": (INTERIOR, LENS, 0.03),
    "bilinear": (WARPED, LENS, 0.03),
    "oblique": (INTERIOR, LENS, 0.2),
}


def seen_there(camera: FrameCamera, xy: np.ndarray, near: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Where a camera sees image points (n, 2) on the terrain, each `above` it, by Newton's method."""

    def at(XY: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        XYZ = np.column_stack([XY, RELIEF.heights(XY) + above])
        return XYZ, project(camera, XYZ) - xy

    XY = near[:, :2].copy()
    for _ in range(5):
        miss = at(XY)[1]
        J = np.stack([(at(XY + 0.1 * e)[1] - at(XY - 0.1 * e)[1]) / 0.2 for e in np.eye(2)], axis=-1)
        XY -= np.linalg.solve(J, miss[..., None])[..., 0]
    return at(XY)[0]


def errors_of_a_block(seed: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Normalised errors (2, n, 3) in X, Y, Z, and stated sigmas (n, 3).

    First with orientations drawn from the covariance of the adjustment, then with the errors that it really makes.
    """
    interior, lens, tilt = CAMERAS[kind]
    rng = np.random.default_rng(1000 + seed)
    simulated = simulate(seed, strips=2, images=4, lens=lens, start=(1.0, 0.001), tilt=tilt, gnss=0.2)
    found = adjust_block(simulated.block, PLAIN)
    covariance = found.pose_covariance
    drawn, real, stated = [], [], []
    for k, name in enumerate(found.images):
        pose, truth = found.poses[k], simulated.poses[int(name.removeprefix("I"))]
        camera = FrameCamera(interior, lens, pose)
        # Film and errors of the orientation go together in the test's images alone: the block is measured without film.
        change = np.r_[truth.center - pose.center, rotation_vector(pose.R_ground_camera.T @ truth.R_ground_camera)]
        cameras = [moved(camera, rng.multivariate_normal(np.zeros(6), covariance[k])), moved(camera, change)]
        xy = rng.uniform(0.03, 0.97, (PIXELS, 2)) * SIZE
        places = seen_there(camera, xy, np.tile(pose.center, (PIXELS, 1)), np.zeros(PIXELS))
        grid = MapGrid.covering((-4e3, -4e3, 8e3, 8e3), 1.0, "EPSG:32633")
        target = MapTarget(grid)
        u, v = ((places[:, 0] - grid.left) // 1.0).astype(int), ((grid.top - places[:, 1]) // 1.0).astype(int)
        XYZ = target.to_ground(np.column_stack([u, v, np.zeros(PIXELS)]))
        XYZ[:, 2] = RELIEF.heights(XYZ[:, :2])
        errors = {0: pose_errors(camera, covariance[k], IMAGE)}
        sigma = np.array(
            [
                tile_accuracy(target, Window(a, b, 1, 1), RELIEF, lambda *_: np.array([[TERRAIN]]), errors)[:3, 0, 0]
                for a, b in zip(u, v)
            ]
        )
        shown = project(camera, XYZ) + rng.normal(0, IMAGE, (PIXELS, 2))
        above = rng.normal(0, TERRAIN, PIXELS)
        off = [(seen_there(true, shown, XYZ, above) - XYZ) / sigma for true in cameras]
        drawn.append(off[0])
        real.append(off[1])
        stated.append(sigma)
    return np.array([np.concatenate(drawn), np.concatenate(real)]), np.concatenate(stated)


@pytest.mark.parametrize(("kind", "blocks"), some([("oblique", 2), *((kind, 200) for kind in CAMERAS)], 0))
def test_normalised_errors_of_pixels(kind: str, blocks: int) -> None:
    found = [errors_of_a_block(seed, kind)[0] for seed in range(blocks)]
    rms = np.sqrt(np.mean(np.square(np.concatenate(found, axis=1)), axis=1))
    print(kind, blocks, rms.round(3).tolist())
    assert (np.abs(rms - 1) < 0.1).all()
