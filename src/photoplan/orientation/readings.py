"""Which reading of an orientation table fits measured points: units, order of rotations, direction, axes.

A table of numbers does not say what they mean. Where image points of known ground points exist, every reading predicts
where they should have been measured. The right one is off by the accuracy of the measurement, a wrong one by much more,
unless the difference is below the noise: with nearly vertical images two orders of rotation may differ by hundredths of
a pixel. So all readings that the points do not tell apart are listed, not one of them chosen.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.errors import GeometryError, InputError
from photoplan.geometry.rotation import ANGLE_UNITS, ROTATION_ORDERS, rotation_from_angles

DIRECTIONS = ("camera-to-ground", "ground-to-camera")
CAMERA_AXES = ("up-back", "down-forward")
TURNS = (0, 90, 180, 270)
#: Most points by which all readings are ranked; they are taken evenly from all. The best ones are then compared by all.
SAMPLE, BEST = 2000, 24
#: Fewest points.
ENOUGH = 3
#: A reading is taken for wrong if it is worse than the best by so many standard errors, or if its median distance is
#: larger than so many times the best one's. Images are taken as independent of each other, points of one image are not;
#: the factor is for few images.
CLEAR, FACTOR = 4.0, 2.0
#: Residuals beyond so many medians count as so large: gross errors do not decide.
CUT = 5.0


@dataclass(frozen=True)
class Reading:
    """One way to read the numbers of a table."""

    angle_unit: str = "deg"
    rotation: str = "opk"
    """Order of the angles, the first is the primary rotation."""
    direction: str = "camera-to-ground"
    """What the matrix of the angles does."""
    camera_axes: str = "up-back"
    """Directions of the camera's y and z: up and towards the viewer, or down and forwards as in computer vision."""
    turned: int = 0
    """Angle by which the image is turned against the camera's axes, counter-clockwise, degrees."""
    mirrored: bool = False
    """Whether left and right of the image are exchanged."""
    swapped: bool = False
    """Whether X and Y of the projection centres are exchanged."""

    @property
    def changes(self) -> int:
        """How much the reading differs from the usual one; of two that fit equally the simpler is listed first."""
        return sum(getattr(self, name) != getattr(USUAL, name) for name in self.__dataclass_fields__)


USUAL = Reading()


@dataclass(frozen=True)
class FittedReading:
    """A reading and what it makes of the measured points."""

    reading: Reading
    median: float
    """Median distance between measured and predicted image points, pixels; infinite if most are behind the camera."""
    worse: float
    """By how many standard errors its squared distances are larger than those of the best; 0 for the best."""


@dataclass(frozen=True, eq=False)
class StatedPoses:
    """Orientations as a file states them, the meaning of the numbers left open; or as matrices."""

    names: tuple[str, ...]
    centers: NDArray[np.float64]
    """Projection centres, shape (n, 3), metres."""
    angles: NDArray[np.float64] | None = None
    """Numbers called ω, φ, κ, shape (n, 3), in this order whatever the order of rotations."""
    matrices: NDArray[np.float64] | None = None
    """Rotation matrices, shape (n, 3, 3), where the file states these; units and orders are then without meaning."""

    def rotations(self, unit: str, order: str) -> NDArray[np.float64]:
        """Matrices of the angles, shape (n, 3, 3)."""
        if self.matrices is not None:
            return self.matrices
        assert self.angles is not None
        at = ["opk".index(letter) for letter in order]
        return np.stack([rotation_from_angles(a[at] * (2 * np.pi / ANGLE_UNITS[unit]), order) for a in self.angles])


@dataclass(frozen=True, eq=False)
class Sights:
    """Measured directions to known points."""

    image: NDArray[np.int64]
    """Index of the image in the poses, shape (m,)."""
    XYZ: NDArray[np.float64]
    """Ground points, shape (m, 3), metres, in the system of the projection centres."""
    tangents: NDArray[np.float64]
    """Ideal image coordinates divided by the camera constant, shape (m, 2), x right, y up, free of distortion."""
    focal: NDArray[np.float64]
    """Camera constant in pixels, shape (m,)."""


def sights_of(
    names: Sequence[str], cameras: Mapping[str, tuple[Interior, Lens]], observed: ImagePoints, ground: GroundPoints
) -> Sights:
    """Sights of all measured points whose ground coordinates are known in full."""
    index = {name: k for k, name in enumerate(names)}
    known = {name: k for k, name in enumerate(ground.names) if np.isfinite(ground.XYZ[k]).all()}
    parts = []
    for k, name in enumerate(observed.images):
        rows = np.flatnonzero(observed.image == k)
        rows = rows[[observed.points[p] in known for p in observed.point[rows]]] if len(rows) else rows
        if name not in index or name not in cameras or not len(rows):
            continue
        interior, lens = cameras[name]
        t = lens.undistort(interior.tangent_to_pixel.inverse(observed.xy[rows]))
        XYZ = ground.XYZ[[known[observed.points[p]] for p in observed.point[rows]]]
        scale = float(np.sqrt(abs(np.linalg.det(interior.tangent_to_pixel.derivative(np.zeros(2))))))
        parts.append((np.full(len(rows), index[name]), XYZ, t, np.full(len(rows), scale)))
    count = sum(len(p[0]) for p in parts)
    if count < ENOUGH:
        raise InputError(
            f"{count} image points are of ground points with known X, Y, Z in oriented images; at least {ENOUGH} are "
            "needed to tell readings apart (are points and images called the same in all files?)"
        )
    image, XYZ, tangents, focal = (np.concatenate(column) for column in zip(*parts))
    good = np.isfinite(tangents).all(axis=1)
    return Sights(image[good].astype(np.int64), XYZ[good], tangents[good], focal[good])


def judge_readings(poses: StatedPoses, sights: Sights) -> tuple[FittedReading, ...]:
    """All readings with their errors: those that fit, the best first and of equals the simpler; then the others."""
    step = np.linspace(0, len(sights.image) - 1, min(SAMPLE, len(sights.image))).astype(int)
    few = Sights(sights.image[step], sights.XYZ[step], sights.tangents[step], sights.focal[step])
    ranked = []
    for reading, q in _readings(poses, few):
        ranked.append((float(np.median(_distances(q, few, reading))), reading))
    ranked.sort(key=lambda r: (round(r[0], 6), r[1].changes))
    if not np.isfinite(ranked[0][0]):
        raise GeometryError(
            "under no reading do the cameras see the ground points; do orientation and ground points lie in one "
            "coordinate system, and are heights of one kind?"
        )
    off = {r: _distances(_components(poses, sights, r), sights, r) for _, r in ranked[:BEST]}
    order = sorted(off, key=lambda r: (round(_cost(off[r], off[ranked[0][1]]), 9), r.changes))
    best = off[order[0]]
    first = [FittedReading(r, float(np.median(off[r])), _worse(off[r], best, sights.image)) for r in order]
    fits = fitting(first)
    rest = [r for r in first if r not in fits]
    rest += [FittedReading(r, median, np.inf) for median, r in ranked[BEST:]]
    return (*fits, *sorted(rest, key=lambda r: r.median))


def fitting(results: Sequence[FittedReading]) -> tuple[FittedReading, ...]:
    """The readings that the points do not tell apart from the best, which is the first."""
    return tuple(r for r in results if r.worse < CLEAR and r.median <= FACTOR * results[0].median + 1e-6)


def _cost(off: NDArray[np.float64], best: NDArray[np.float64]) -> float:
    """Mean of the squared distances, gross ones cut, in units of the best median."""
    unit = max(float(np.median(best)), 1e-9)
    return float(np.mean(np.minimum(off / unit, CUT) ** 2))


def _worse(off: NDArray[np.float64], best: NDArray[np.float64], image: NDArray[np.int64]) -> float:
    unit = max(float(np.median(best)), 1e-9)
    difference = np.minimum(off / unit, CUT) ** 2 - np.minimum(best / unit, CUT) ** 2
    count = np.bincount(image)
    mean = np.bincount(image, difference)[count > 0] / count[count > 0]
    if len(mean) < ENOUGH:
        return 0.0
    error = float(mean.std(ddof=1) / np.sqrt(len(mean)))
    return float(mean.mean()) / error if error > 1e-9 else 0.0


def turn_matrix(camera_axes: str, turned: int) -> NDArray[np.float64]:
    """Matrix (3, 3) that takes camera axes as a file means them to x right, y up, z towards the viewer."""
    c, s = {0: (1.0, 0.0), 90: (0.0, 1.0), 180: (-1.0, 0.0), 270: (0.0, -1.0)}[turned]
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    flip = np.diag([1.0, -1.0, -1.0]) if camera_axes == "down-forward" else np.eye(3)
    return turn @ flip


def _readings(poses: StatedPoses, sights: Sights) -> Iterator[tuple[Reading, NDArray[np.float64]]]:
    """Every reading with the components of the rays along the axes of the camera that the file means."""
    conventions = [("deg", "opk")] if poses.matrices is not None else list(product(ANGLE_UNITS, ROTATION_ORDERS))
    others = list(product(CAMERA_AXES, TURNS, (False, True)))
    for unit, order in conventions:
        R = poses.rotations(unit, order)
        for swapped, direction in product((False, True), DIRECTIONS):
            q = _along(R, poses.centers, sights, direction, swapped)
            for axes, turned, mirrored in others:
                yield (
                    Reading(
                        angle_unit=unit,
                        rotation=order,
                        direction=direction,
                        camera_axes=axes,
                        turned=turned,
                        mirrored=mirrored,
                        swapped=swapped,
                    ),
                    q,
                )


def _components(poses: StatedPoses, sights: Sights, reading: Reading) -> NDArray[np.float64]:
    R = poses.rotations(reading.angle_unit, reading.rotation)
    return _along(R, poses.centers, sights, reading.direction, reading.swapped)


def _along(
    R: NDArray[np.float64], centers: NDArray[np.float64], sights: Sights, direction: str, swapped: bool
) -> NDArray[np.float64]:
    d = sights.XYZ - (centers[:, [1, 0, 2]] if swapped else centers)[sights.image]
    paths = "mji,mj->mi" if direction == DIRECTIONS[0] else "mij,mj->mi"
    return np.asarray(np.einsum(paths, R[sights.image], d), np.float64)


def _distances(q: NDArray[np.float64], sights: Sights, reading: Reading) -> NDArray[np.float64]:
    """Distances of measured and predicted points (m,), pixels; infinite behind the camera."""
    p = q @ turn_matrix(reading.camera_axes, reading.turned).T
    depth = -p[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t = p[:, :2] / depth[:, None]
        t = t * (-1.0, 1.0) if reading.mirrored else t
        off = np.hypot(*(t - sights.tangents).T) * sights.focal
    return np.where(depth > 0, off, np.inf)
