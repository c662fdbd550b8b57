"""The unknowns of a bundle adjustment: blocks of values, each with the rule by which a step changes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.blocks import Kind, Layout, Unknowns
from photoplan.cameras.correctable import Corrections
from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.lenses.brown import Brown
from photoplan.cameras.lenses.none import NoLens
from photoplan.cameras.lenses.opencv import OpenCV
from photoplan.errors import UsageError
from photoplan.geometry.pose import UNKNOWNS, Pose
from photoplan.geometry.rotation import rotation_vector, small_rotations
from photoplan.orientation.bundle.block import Block

_Floats = NDArray[np.float64]

#: Keys of the kinds of unknowns; those of a camera are "camera NAME".
IMAGES, LEVER, BORESIGHT, DRIFT = "images", "lever arm", "boresight", "drift"
COMMON = "common error of positions"


@dataclass(frozen=True, eq=False)
class Poses:
    """Exterior orientations."""

    centers: _Floats
    """(n, 3)."""
    rotations: _Floats
    """R_ground_camera, (n, 3, 3)."""

    def moved(self, step: _Floats) -> Poses:
        """See `Unknowns`."""
        return Poses(self.centers + step[:, :3], self.rotations @ small_rotations(step[:, 3:]))

    def motions(self) -> tuple[float, dict[str, _Floats]]:
        """What moves all images together: the size of the block, and steps (n, 6) by their names."""
        n = len(self.centers)
        if not n:
            return 1.0, {}
        away = self.centers - self.centers.mean(axis=0)
        size = float(np.abs(away).max()) or 1.0
        motions: dict[str, _Floats] = {}
        for k, axis in enumerate("XYZ"):
            motions[f"position of the block in {axis}"] = np.tile(size * np.eye(6)[k], (n, 1))
            about = np.eye(3)[k]
            motions[f"rotation of the block about {axis}"] = np.hstack([np.cross(about, away), about @ self.rotations])
        motions["scale of the block"] = np.hstack([away, np.zeros((n, 3))])
        return size, motions


@dataclass(frozen=True)
class CameraState:
    """Interior orientation as it is now."""

    c: float
    x0: float
    y0: float
    lens: Lens
    free: tuple[str, ...] = ()
    """Parameters that are unknowns."""

    def parameter(self, name: str) -> float:
        """Value of a parameter by its name in `photoplan.orientation.bundle.block.PARAMETERS`."""
        if name in ("c", "x0", "y0"):
            return float(getattr(self, name))
        lens = self.lens
        if isinstance(lens, OpenCV):
            # OpenCV's y points down: its p2 is Brown's p1, and minus its p1 is Brown's p2.
            return {"p1": lens.p2, "p2": -lens.p1}.get(name, float(getattr(lens, name, 0.0)))
        return float(getattr(lens, name, 0.0))

    def value(self, parameter: int) -> float:
        """A free parameter by its number."""
        return self.parameter(self.free[parameter])

    def moved(self, step: _Floats) -> CameraState:
        """See `Unknowns`."""
        values = {name: self.parameter(name) + float(d) for name, d in zip(self.free, step[0])}
        c, x0, y0 = (values.pop(name, getattr(self, name)) for name in ("c", "x0", "y0"))
        lens = self.lens
        if values and isinstance(lens, OpenCV):
            turned = {"p1": ("p2", 1.0), "p2": ("p1", -1.0)}
            values = {turned[n][0] if n in turned else n: v * turned.get(n, ("", 1.0))[1] for n, v in values.items()}
            lens = OpenCV(**{**asdict(lens), **values})
        elif values and isinstance(lens, Brown):
            lens = Brown(**{**asdict(lens), **values})
        return replace(self, c=c, x0=x0, y0=y0, lens=lens)


@dataclass(frozen=True, eq=False)
class Vectors:
    """Numbers that steps are added to, a row for each block: a lever arm, shifts and rates of strips."""

    values: _Floats
    """(n, w); a step may be of the first columns only."""

    def value(self, parameter: int) -> float:
        """A value of the first block."""
        return float(self.values[0, parameter])

    def moved(self, step: _Floats) -> Vectors:
        """See `Unknowns`."""
        values = self.values.copy()
        values[:, : step.shape[1]] += step
        return Vectors(values)


@dataclass(frozen=True, eq=False)
class Turn:
    """A rotation, from observed to true camera axes."""

    R: _Floats
    """(3, 3)."""

    def value(self, parameter: int) -> float:
        """Rotation about an axis, radians."""
        return float(rotation_vector(self.R)[parameter])

    def moved(self, step: _Floats) -> Turn:
        """See `Unknowns`."""
        return Turn(self.R @ small_rotations(step)[0])


@dataclass(frozen=True, eq=False)
class State:
    """Values of all that may be unknown."""

    blocks: Mapping[str, Unknowns]
    """By their keys."""
    strips: tuple[str, ...]
    """What the rows of the drift belong to."""
    XYZ: _Floats
    """Points (m, 3): blocks too, but so many that they are eliminated."""

    @property
    def images(self) -> Poses:
        """Exterior orientations."""
        return cast(Poses, self.blocks[IMAGES])

    @property
    def lever(self) -> _Floats:
        """Antenna minus projection centre, in camera axes, (3,)."""
        return cast(Vectors, self.blocks[LEVER]).values[0]

    @property
    def boresight(self) -> _Floats:
        """Rotation from observed to true camera axes, (3, 3)."""
        return cast(Turn, self.blocks[BORESIGHT]).R

    @property
    def drift(self) -> _Floats:
        """Shift and rate of each strip, (s, 6)."""
        return cast(Vectors, self.blocks[DRIFT]).values

    def camera(self, name: str) -> CameraState:
        """Interior orientation of a camera."""
        return cast(CameraState, self.blocks[f"camera {name}"])

    @property
    def common(self) -> _Floats:
        """Error that all observed positions share, (3,)."""
        return cast(Vectors, self.blocks[COMMON]).values[0]

    def known(self, key: str) -> CameraState | Vectors | Turn:
        """Blocks of which something may be known beforehand."""
        return cast("CameraState | Vectors | Turn", self.blocks[key])

    def corrections(self, key: str) -> _Floats:
        """Values of a set of corrections, (owners, parameters)."""
        return cast(Vectors, self.blocks[key]).values

    def poses(self) -> tuple[Pose, ...]:
        """Exterior orientations as values."""
        return tuple(Pose(c, R) for c, R in zip(self.images.centers, self.images.rotations))

    def moved(self, layout: Layout, step: _Floats, points: _Floats) -> State:
        """The state after a step: `step` in the order of the layout, `points` (m, 3)."""
        return replace(self, blocks=layout.moved(self.blocks, step), XYZ=self.XYZ + points)

    def carried(self, start: State) -> State:
        """The start of another selection of the block, with the values that this state has found for all but images."""
        found = {key: block for key, block in self.blocks.items() if key in start.blocks and key not in (IMAGES, DRIFT)}
        before = dict(zip(self.strips, self.drift))
        drift = [before.get(name, row) for name, row in zip(start.strips, start.drift)]
        return replace(start, blocks={**start.blocks, **found, DRIFT: Vectors(np.array(drift).reshape(-1, 6))})


def layout_of(
    block: Block,
    images: tuple[str, ...],
    cameras: tuple[str, ...],
    strips: tuple[str, ...],
    sets: Sequence[Corrections] = (),
) -> Layout:
    """The unknowns of a block: orientations, what is free of cameras, lever arm, boresight and drift, corrections."""
    width = {"none": 0, "shift": 3, "linear": 6}.get(block.drift)
    if width is None:
        raise UsageError(f"drift {block.drift!r}; allowed are none, shift, linear")
    lever = block.positions is not None and block.lever_arm_sigma > 0
    boresight = block.boresight and block.attitudes is not None and not set(block.attitudes.images).isdisjoint(images)
    common = block.positions is not None and block.common is not None
    drift = tuple(f"drift of {{}} in {axis}" for axis in "XYZXYZ"[:width])
    return Layout.of(
        [
            Kind(IMAGES, images, tuple(f"{name} of {{}}" for name in UNKNOWNS), "image"),
            *(
                Kind(f"camera {name}", (name,), tuple(f"{p} of {{}}" for p in block.cameras[name].free), "camera")
                for name in cameras
            ),
            Kind(LEVER, ("",), tuple(f"lever arm {axis}" for axis in "xyz") if lever else ()),
            Kind(BORESIGHT, ("",), tuple(f"boresight about {axis}" for axis in "xyz") if boresight else ()),
            Kind(DRIFT, strips, drift, "strip"),
            Kind(COMMON, ("",), tuple(f"{COMMON} in {axis}" for axis in "XYZ") if common else ()),
            *(Kind(each.key, each.owners, each.parameters, each.owner) for each in sets),
        ]
    )


def start_state(
    block: Block,
    cameras: tuple[str, ...],
    strips: tuple[str, ...],
    poses: list[Pose],
    XYZ: _Floats,
    sets: Sequence[Corrections] = (),
) -> State:
    """Start values of the images that take part, their cameras, strips and corrections, and the points (m, 3)."""
    blocks: dict[str, Unknowns] = {
        IMAGES: Poses(
            np.array([p.center for p in poses]).reshape(-1, 3),
            np.array([p.R_ground_camera for p in poses]).reshape(-1, 3, 3),
        ),
        LEVER: Vectors(np.array([block.lever_arm], float)),
        BORESIGHT: Turn(np.eye(3)),
        DRIFT: Vectors(np.zeros((len(strips), 6))),
        COMMON: Vectors(np.zeros((1, 3))),
        **{each.key: Vectors(np.array(each.values, float)) for each in sets},
    }
    for name in cameras:
        given = block.cameras[name]
        lens = given.lens
        if isinstance(lens, NoLens) and any(p not in ("c", "x0", "y0") for p in given.free):
            lens = Brown()
        blocks[f"camera {name}"] = CameraState(given.c, *given.principal_point, lens, given.free)
    return State(blocks, strips, XYZ)
