"""Simulated blocks by collinearity written out in a few lines, without anything of the adjustment or its cameras."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.lenses import NoLens
from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedPositions
from photoplan.geometry.pose import Pose
from photoplan.orientation.bundle.model import Block, BlockCamera, BlockImage

FOCAL, SIZE = 3600.0, (4000, 3000)


@dataclass(frozen=True)
class Make:
    """What is to be made."""

    seed: int = 0
    strips: int = 3
    images: int = 5
    height: float = 300.0
    relief: float = 15.0
    points: int = 160
    sigma: float = 0.4
    control: int = 10
    control_sigma: float = 0.03
    gnss: float | None = None
    start: tuple[float, float] = (2.0, 0.3)
    """Error of start positions (metres) and angles (degrees)."""
    free: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Truth:
    """A block and what it was made from."""

    block: Block
    centers: NDArray[np.float64]
    rotations: NDArray[np.float64]
    points: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    def with_ground(self, XYZ: NDArray[np.float64]) -> Block:
        """The block with other coordinates of control."""
        return replace(self.block, ground=replace(self.block.ground, XYZ=XYZ))


def pixels(X: NDArray[np.float64], center: NDArray[np.float64], R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Column and row of ground points (n, 3): x = −c p_x / p_z with p = Rᵀ (X − X0), then y turned down."""
    p = (X - center) @ R
    x, y = -FOCAL * p[:, 0] / p[:, 2], -FOCAL * p[:, 1] / p[:, 2]
    return np.column_stack([x + (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2 - y])


def plain_block(make: Make = Make()) -> Truth:
    """Strips with 65 % overlap along and 45 % across, control in a grid over the block."""
    rng = np.random.default_rng(make.seed)
    wide, long = make.height * SIZE[0] / FOCAL, make.height * SIZE[1] / FOCAL
    centers, turns = [], []
    for s in range(make.strips):
        for k in range(make.images):
            centers.append([0.55 * wide * s, 0.35 * long * k, make.height + rng.normal(0, 3)])
            turns.append([*rng.normal(0, 2.0, 2), 180.0 * (s % 2) + rng.normal(0, 3)])
    C, R = np.array(centers), Rotation.from_euler("XYZ", turns, degrees=True).as_matrix()
    low, high = C[:, :2].min(axis=0), C[:, :2].max(axis=0)
    XY = rng.uniform(low - 0.3 * long, high + 0.3 * long, (make.points, 2))
    rows = int(np.ceil(np.sqrt(make.control)))
    grid = np.array([(a, b) for a in np.linspace(0, 1, rows) for b in np.linspace(0, 1, rows)])
    grid = grid[rng.permutation(len(grid))[: make.control]] + rng.uniform(-0.08, 0.08, (make.control, 2))
    XY[: make.control] = low + grid * (high - low)
    Z = make.relief * np.sin(XY[:, 0] / 60) * np.cos(XY[:, 1] / 80)
    X = np.column_stack([XY, Z])
    names = [f"C{k}" if k < make.control else f"T{k}" for k in range(len(X))]
    seen = []
    for k in range(len(C)):
        xy = pixels(X, C[k], R[k])
        inside = ((xy > 5) & (xy < np.array(SIZE) - 6)).all(axis=1)
        xy = xy + rng.normal(0, make.sigma, xy.shape)
        seen += [(names[p], f"I{k}", float(xy[p, 0]), float(xy[p, 1])) for p in np.flatnonzero(inside)]
    known = X[: make.control] + rng.normal(0, make.control_sigma, (make.control, 3))
    ground = GroundPoints(
        tuple(names[: make.control]), known, np.full(known.shape, make.control_sigma), np.zeros(make.control, bool)
    )
    bad = Rotation.from_rotvec(np.radians(rng.normal(0, make.start[1], (len(C), 3)))).as_matrix()
    plane = Affine2D(1.0, 0.0, (SIZE[0] - 1) / 2, 0.0, -1.0, (SIZE[1] - 1) / 2)
    images = tuple(
        BlockImage(f"I{k}", "cam", plane, Pose(C[k] + rng.normal(0, make.start[0], 3), R[k] @ bad[k]))
        for k in range(len(C))
    )
    positions = None
    if make.gnss is not None:
        observed = C + rng.normal(0, make.gnss, C.shape)
        strips = tuple(f"S{k // make.images}" for k in range(len(C)))
        sigma = np.full(C.shape, make.gnss)
        positions = ObservedPositions(
            tuple(i.name for i in images), observed, sigma, strips, np.arange(len(C), dtype=float)
        )
    camera = BlockCamera(FOCAL, (0.0, 0.0), NoLens(), make.free)
    block = Block({"cam": camera}, images, ImagePoints.from_rows(seen, make.sigma), ground, positions)
    return Truth(block, C, R, dict(zip(names, X)))
