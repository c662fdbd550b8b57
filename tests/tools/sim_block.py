"""Simulated aerial blocks with known truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior
from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedAttitudes, ObservedPositions
from photoplan.geometry.pose import Pose, rotation_opk, small_rotations
from photoplan.orientation.bundle.model import Block, BlockCamera, BlockImage

SIZE = (4000, 3000)
FOCAL = 3600.0


@dataclass(frozen=True, eq=False)
class Simulated:
    """A block with errors, and the truth."""

    block: Block
    poses: tuple[Pose, ...]
    points: dict[str, np.ndarray]
    c: float
    gross: np.ndarray
    """Measurements that were given a gross error, mask."""


def simulate(
    seed: int,
    *,
    strips: int = 3,
    images: int = 6,
    relief: float = 60.0,
    height: float = 1000.0,
    sigma: float = 0.3,
    control_sigma: float = 0.03,
    gnss: float | None = None,
    attitude: float | None = None,
    gross: float = 0.0,
    free: tuple[str, ...] = (),
    lens: Brown | None = None,
    control: int = 9,
    per_image: int = 60,
    start: tuple[float, float] = (3.0, 0.003),
    tilt: float = 0.03,
    cross: bool = False,
    base: float = 0.4,
) -> Simulated:
    """A block of strips over rolling terrain, 60 % by 30 % overlap.

    `start` is the error of the start orientations (metres, radians), `gross` the part of the measurements with errors
    of 20 standard deviations to 200 pixels. With `cross` the last strip is flown across at another height;
    `base` is the distance of exposures in parts of the image on the ground.
    """
    rng = np.random.default_rng(seed)
    lens = lens or Brown()
    interior = Interior.digital(SIZE, (FOCAL, FOCAL))
    width, length = height * SIZE[0] / FOCAL, height * SIZE[1] / FOCAL
    poses = []
    for s in range(strips):
        for i in range(images):
            across = cross and s == strips - 1
            X, Y = (0.5 * width, base * length * i) if across else (0.7 * width * s, base * length * i)
            kappa = np.pi / 2 if across else np.pi * (s % 2)
            angles = rng.normal(0, tilt, 2)
            Z = height * (1.3 if across else 1.0) + rng.normal(0, 10)
            poses.append(Pose(np.array([X, Y, Z]), rotation_opk(angles[0], angles[1], kappa + rng.normal(0, tilt))))
    cameras = [FrameCamera(interior, lens, pose) for pose in poses]
    low, high = np.min([p.center[:2] for p in poses], axis=0), np.max([p.center[:2] for p in poses], axis=0)
    count = int(per_image * len(poses) / 2.2)
    XY = rng.uniform(low - 0.45 * length, high + 0.45 * length, (count, 2))
    corners = np.linspace(0, 1, max(2, int(np.sqrt(control))))
    grid = np.array([(a, b) for a in corners for b in corners]) * (high - low) + low
    XY[: len(grid)] = grid
    Z = relief * np.sin(XY[:, 0] / 300) * np.cos(XY[:, 1] / 400)
    XYZ = np.column_stack([XY, Z])
    names = [f"P{k}" for k in range(count)]
    rows, errors = [], []
    for k, camera in enumerate(cameras):
        xy = project(camera, XYZ)
        inside = np.isfinite(xy).all(axis=1) & (xy > 5).all(axis=1) & (xy < np.array(SIZE) - 6).all(axis=1)
        for p in np.flatnonzero(inside):
            off = rng.normal(0, sigma, 2)
            bad = rng.uniform() < gross
            if bad:
                turn = rng.uniform(0, 2 * np.pi)
                off = off + rng.uniform(20 * sigma, 200) * np.array([np.cos(turn), np.sin(turn)])
            rows.append((names[p], f"I{k}", *(xy[p] + off)))
            errors.append(bad)
    observations = ImagePoints.from_rows(rows, sigma)
    known = XYZ[: len(grid)] + rng.normal(0, control_sigma, (len(grid), 3))
    ground = GroundPoints(
        tuple(names[: len(grid)]), known, np.full((len(grid), 3), control_sigma), np.zeros(len(grid), bool)
    )
    turned = [p.R_ground_camera @ small_rotations(rng.normal(0, start[1], (1, 3)))[0] for p in poses]
    begun = [Pose(p.center + rng.normal(0, start[0], 3), R) for p, R in zip(poses, turned)]
    camera = BlockCamera(FOCAL, (0.0, 0.0), lens, free)
    chosen = tuple(BlockImage(f"I{k}", "cam", interior.plane_to_pixel, pose) for k, pose in enumerate(begun))
    block = Block({"cam": camera}, chosen, observations, ground)
    names_of_images = tuple(b.name for b in chosen)
    if gnss is not None:
        seen = np.array([p.center for p in poses]) + rng.normal(0, gnss, (len(poses), 3))
        strip = tuple(f"S{k // images}" for k in range(len(poses)))
        time = np.arange(len(poses), dtype=float)
        block = replace(
            block, positions=ObservedPositions(names_of_images, seen, np.full((len(poses), 3), gnss), strip, time)
        )
    if attitude is not None:
        off = small_rotations(rng.normal(0, attitude, (len(poses), 3)))
        R = np.array([p.R_ground_camera for p in poses]) @ off
        block = replace(block, attitudes=ObservedAttitudes(names_of_images, R, np.full((len(poses), 3), attitude)))
    return Simulated(block, tuple(poses), dict(zip(names, XYZ)), FOCAL, np.array(errors))
