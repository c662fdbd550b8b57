"""Angle conventions: plausibility of an orientation, and whether another convention fits its measurements.

Least squares finds a pose for mirrored, exchanged and wrongly scaled coordinates as well: it lies under the ground and
looks up, throws much of the control out, or misses it by many times what was stated. Whatever writes an orientation
asks here first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from photoplan.arrays import Floats, Ints
from photoplan.cameras.lenses import Interior, Lens
from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.errors import GeometryError, InputError, PhotoplanError
from photoplan.geometry.bounds import HIGHEST_FLIGHT
from photoplan.geometry.pose import ANGLE_UNITS, FLIP, ROTATION_ORDERS, angle_in_radians, rotation_from_angles

if TYPE_CHECKING:  # orthophotos start without the bundle adjustment
    from photoplan.orientation.resection import MeasuredPoints, Resected

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
class Convention:
    """One way to read the numbers of a table."""

    angle_unit: str = "deg"
    rotation: str = "opk"
    """Order of the angles, the first is the primary rotation."""
    direction: str = "camera-to-ground"
    """Direction of the matrix of the angles."""
    camera_axes: str = "up-back"
    """Directions of the camera's y and z: up and towards the viewer, or down and forwards as in computer vision."""
    turned: int = 0
    """Angle by which the image is turned against the camera's axes, counter-clockwise, degrees."""
    mirrored: bool = False
    """True if left and right of the image are exchanged."""
    swapped: bool = False
    """True if X and Y of the projection centres are exchanged."""

    @property
    def changes(self) -> int:
        """Return how much the reading differs from the usual one; of two that fit equally the simpler is listed
        first."""
        return sum(getattr(self, name) != getattr(USUAL, name) for name in self.__dataclass_fields__)


USUAL = Convention()


@dataclass(frozen=True)
class FittedConvention:
    """A reading and what it makes of the measured points."""

    reading: Convention
    median: float
    """Median distance between measured and predicted image points, pixels; infinite if most are behind the camera."""
    worse: float
    """By how many standard errors its squared distances are larger than those of the best; 0 for the best."""


@dataclass(frozen=True, eq=False)
class StatedPoses:
    """Orientations as a file states them, the meaning of the numbers left open; or as matrices."""

    names: tuple[str, ...]
    centers: Floats
    """Projection centres, shape (n, 3), metres."""
    angles: Floats | None = None
    """Numbers called ω, φ, κ, shape (n, 3), in this order whatever the order of rotations."""
    matrices: Floats | None = None
    """Rotation matrices, shape (n, 3, 3), where the file states these; units and orders are then without meaning."""

    def rotations(self, unit: str, order: str) -> Floats:
        """Matrices of the angles, shape (n, 3, 3)."""
        if self.matrices is not None:
            return self.matrices
        assert self.angles is not None
        at = ["opk".index(letter) for letter in order]
        return rotation_from_angles(angle_in_radians(self.angles[:, at], unit), order)


@dataclass(frozen=True, eq=False)
class Sights:
    """Measured directions to known points."""

    image: Ints
    """Index of the image in the poses, shape (m,)."""
    XYZ: Floats
    """Ground points, shape (m, 3), metres, in the system of the projection centres."""
    tangents: Floats
    """Ideal image coordinates divided by the camera constant, shape (m, 2), x right, y up, free of distortion."""
    focal: Floats
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


def judge_conventions(poses: StatedPoses, sights: Sights) -> tuple[FittedConvention, ...]:
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
    first = [FittedConvention(r, float(np.median(off[r])), _worse(off[r], best, sights.image)) for r in order]
    fits = fitting(first)
    rest = [r for r in first if r not in fits]
    rest += [FittedConvention(r, median, np.inf) for median, r in ranked[BEST:]]
    return (*fits, *sorted(rest, key=lambda r: r.median))


def fitting(results: Sequence[FittedConvention]) -> tuple[FittedConvention, ...]:
    """The readings that the points do not tell apart from the best, which is the first."""
    return tuple(r for r in results if r.worse < CLEAR and r.median <= FACTOR * results[0].median + 1e-6)


def _cost(off: Floats, best: Floats) -> float:
    """Mean of the squared distances, gross ones cut, in units of the best median."""
    unit = max(float(np.median(best)), 1e-9)
    return float(np.mean(np.minimum(off / unit, CUT) ** 2))


def _worse(off: Floats, best: Floats, image: Ints) -> float:
    unit = max(float(np.median(best)), 1e-9)
    difference = np.minimum(off / unit, CUT) ** 2 - np.minimum(best / unit, CUT) ** 2
    count = np.bincount(image)
    mean = np.bincount(image, difference)[count > 0] / count[count > 0]
    if len(mean) < ENOUGH:
        return 0.0
    error = float(mean.std(ddof=1) / np.sqrt(len(mean)))
    return float(mean.mean()) / error if error > 1e-9 else 0.0


def turn_matrix(camera_axes: str, turned: int) -> Floats:
    """Matrix (3, 3) that takes camera axes as a file means them to x right, y up, z towards the viewer."""
    c, s = {0: (1.0, 0.0), 90: (0.0, 1.0), 180: (-1.0, 0.0), 270: (0.0, -1.0)}[turned]
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    flip = FLIP if camera_axes == "down-forward" else np.eye(3)
    return turn @ flip


def _readings(poses: StatedPoses, sights: Sights) -> Iterator[tuple[Convention, Floats]]:
    """Every reading with the components of the rays along the axes of the camera that the file means."""
    conventions = [("deg", "opk")] if poses.matrices is not None else list(product(ANGLE_UNITS, ROTATION_ORDERS))
    others = list(product(CAMERA_AXES, TURNS, (False, True)))
    for unit, order in conventions:
        R = poses.rotations(unit, order)
        for swapped, direction in product((False, True), DIRECTIONS):
            q = _along(R, poses.centers, sights, direction, swapped)
            for axes, turned, mirrored in others:
                yield (
                    Convention(
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


def _components(poses: StatedPoses, sights: Sights, reading: Convention) -> Floats:
    R = poses.rotations(reading.angle_unit, reading.rotation)
    return _along(R, poses.centers, sights, reading.direction, reading.swapped)


def _along(R: Floats, centers: Floats, sights: Sights, direction: str, swapped: bool) -> Floats:
    d = sights.XYZ - (centers[:, [1, 0, 2]] if swapped else centers)[sights.image]
    paths = "mji,mj->mi" if direction == DIRECTIONS[0] else "mij,mj->mi"
    return np.asarray(np.einsum(paths, R[sights.image], d), np.float64)


def _distances(q: Floats, sights: Sights, reading: Convention) -> Floats:
    """Distances of measured and predicted points (m,), pixels; infinite behind the camera."""
    p = q @ turn_matrix(reading.camera_axes, reading.turned).T
    depth = -p[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t = p[:, :2] / depth[:, None]
        t = t * (-1.0, 1.0) if reading.mirrored else t
        off = np.hypot(*(t - sights.tangents).T) * sights.focal
    return np.where(depth > 0, off, np.inf)


#: What units are called.
NAMES = {"deg": "degrees", "gon": "gon", "rad": "radians"}
#: True and declared units that are thought of, by the project's. `photoplan init` writes tables of gon and radians in
#: degrees, so what was declared there may have been any.
_UNITS = {
    "deg": (("gon", "deg"), ("rad", "deg"), ("deg", "gon"), ("deg", "rad")),
    "gon": (("rad", "gon"), ("deg", "gon")),
    "rad": (("gon", "rad"), ("deg", "rad")),
}


@dataclass(frozen=True)
class AlternativeConvention:
    """One way to read three angles and a projection centre."""

    unit: str | None = None
    """Unit that the numbers are in, a key of `ANGLE_UNITS`; None: as declared."""
    order: str | None = None
    """Rotation order; None: as declared."""
    transposed: bool = False
    """The matrix takes ground to camera."""
    camera_flipped: bool = False
    """The camera's axes are y down, z forwards."""
    ground_flipped: bool = False
    """The ground's axes are Y south, Z down."""
    swapped: bool = False
    """X and Y of the projection centre are exchanged."""
    declared: str = "deg"
    """Unit that is declared."""

    @property
    def changes(self) -> int:
        """Differences from the declared reading."""
        return sum(getattr(self, name) != getattr(DECLARED, name) for name in _CHANGES)

    def sentence(self, mirrored: bool = False) -> str:
        """Say what the user would have to declare or repair; `mirrored`: the scan is stated to be mirrored.

        A film that was scanned the right way round but whose marks run the other way, with angles that look up, is
        described with the scene at z > 0: turning the angles alone would mirror the ground.
        """
        if mirrored and (self.camera_flipped or self.ground_flipped):
            scene = (
                "the orientation looks like one with the scene at z > 0, whose marks and angles both run the other "
                'way; set `scene = "z > 0"` under [orientation] and remove `mirrored` from the camera'
            )
            return "; ".join([*replace(self, camera_flipped=False, ground_flipped=False)._parts(), scene])
        return "; ".join(self._parts())

    def _parts(self) -> list[str]:
        parts = []
        if self.unit is not None:
            parts.append(
                f"the angles look like {NAMES[self.unit]} that were declared as {NAMES[self.declared]}; "
                f"declare `angle_unit` {self.unit}"
            )
        if self.order is not None:
            parts.append(f"the rotation order looks like {self.order}; declare `rotation` {self.order}")
        if self.transposed:
            parts.append("the rotation looks like ground to camera; declare `rotation_direction` ground-to-camera")
        if self.camera_flipped:
            parts.append("the camera's axes look like y down, z forwards, as in computer vision")
        if self.ground_flipped:
            parts.append("omega looks turned by 180°, as for ground axes Y south, Z down")
        if self.swapped:
            parts.append("X and Y of the projection centres look exchanged")
        return parts

    def apply(self, center: Floats, angles: Floats, order: str) -> tuple[Floats, Floats]:
        """Projection centre (3,) and R_ground_camera (3, 3) of declared numbers (radians) under this reading."""
        if self.unit is not None:
            angles = angles * (ANGLE_UNITS[self.declared] / ANGLE_UNITS[self.unit])
        if self.order is not None:
            # An angle keeps its axis; only the sequence of rotations changes.
            named = dict(zip(order, angles))
            order, angles = self.order, np.array([named[letter] for letter in self.order])
        R = rotation_from_angles(angles, order)
        if self.transposed:
            R = R.T
        if self.camera_flipped:
            R = R * (1.0, -1.0, -1.0)
        if self.ground_flipped:
            R = np.array([[1.0], [-1.0], [-1.0]]) * R
        return (center[[1, 0, 2]] if self.swapped else center), R


DECLARED = AlternativeConvention()
_CHANGES = ("unit", "order", "transposed", "camera_flipped", "ground_flipped", "swapped")


def readings(order: str, unit: str = "deg") -> list[AlternativeConvention]:
    """All readings with one change, then those with two; `order` and `unit` are those of the project."""
    others = [o for o in ROTATION_ORDERS if o != order]
    units = [partial(AlternativeConvention, unit=true, declared=stated) for true, stated in _UNITS[unit]]
    one = [made() for made in units]
    one += [AlternativeConvention(transposed=True), AlternativeConvention(camera_flipped=True)]
    one += [AlternativeConvention(ground_flipped=True), AlternativeConvention(swapped=True)]
    one += [AlternativeConvention(order=o) for o in others]
    two = [made(order=o) for made in units for o in others]
    two += [made(transposed=True) for made in units]
    two += [made(camera_flipped=True) for made in units] + [made(ground_flipped=True) for made in units]
    two += [AlternativeConvention(order=o, transposed=True) for o in others]
    two += [AlternativeConvention(order=o, camera_flipped=True) for o in others]
    two += [
        AlternativeConvention(transposed=True, camera_flipped=True),
        AlternativeConvention(transposed=True, ground_flipped=True),
    ]
    return one + two


Heights = Callable[[Floats], Floats]

#: Images that are looked at under other readings.
SAMPLE_PLAUSIBILITY = 12
#: A reading is taken as better by its tilts only if all stay below this, and half of the declared ones are above the
#: second; degrees. Between them lies everything that oblique images may be.
UPRIGHT, OBLIQUE = 10.0, 20.0
#: Images whose lines are looked at.
LINES = 400
#: Side of the area in which heights are asked for at once, metres.
CELL = 1000.0
#: Points that count as the image's middle.
INNER = 10
#: Images needed before tilts or flight lines say anything.
#: Slopes below the horizon (sines) from which a ray, and the middle of an image, may be expected to meet terrain.
DOWNWARD, MIDDLE_DOWNWARD = 0.01, 0.1


@dataclass(frozen=True, eq=False)
class JudgedView:
    """Data of an image that the check requires."""

    name: str
    center: Floats
    """Projection centre (3,) in the terrain's CRS and height system."""
    angles: Floats
    """Three angles (3,) in radians, in the sequence of `order`."""
    order: str
    """Rotation order that is declared."""
    tangents: Floats
    """Ideal directions (n, 2) of points spread over the image, x right, y up; the first is the image's middle."""
    pixel: float
    """Angle of a pixel in the middle, radians."""
    unit: str = "deg"
    """Unit of the angles in the project."""
    mirrored: bool = False
    """True if the camera is stated to be scanned through the back of its film."""

    @property
    def R_ground_camera(self) -> Floats:
        """Rotation matrix as declared."""
        return rotation_from_angles(self.angles, self.order)


@dataclass(frozen=True)
class ImagePlausibility:
    """Consequences of the orientation of one image."""

    name: str
    tilt: float
    """Angle between optical axis and nadir, degrees."""
    azimuth: float
    """Direction in which the axis is tilted, degrees from north, clockwise."""
    height_above_ground: float
    """Height of the projection centre above the terrain below it, metres; NaN where there is none."""
    gsd: float
    """Side of the middle pixel across the line of sight on the ground, metres; NaN if it sees no ground."""
    on_terrain: float
    """Share of the image that sees the terrain."""
    middle_on_terrain: bool
    """True if the middle of the image does; for a level photograph, whether any part shows terrain or an object."""
    fault: str | None
    """Reason why the orientation cannot be right; None if the image is plausible."""
    level: bool = False
    """True if the image shows the horizon, and its middle lies near or above it: much of it cannot show terrain."""


def look(view: JudgedView, heights: Heights, objects: Floats | None = None) -> ImagePlausibility:
    """Look at one image as its orientation is declared; `objects` (n, 3, 3) are triangles that it may show."""
    found = _look(view, view.center, view.R_ground_camera, heights)
    if found.level and found.on_terrain == 0 and objects is not None and _shows(view, objects):
        return replace(found, fault=None, middle_on_terrain=True)
    return found


def _shows(view: JudgedView, triangles: Floats) -> bool:
    """Return whether the ray of any of the view's points meets one of the triangles (n, 3, 3)."""
    a, b, c = np.moveaxis((triangles - view.center) @ view.R_ground_camera, 1, 0)
    # A ray lies inside the three planes through the camera and the sides of a triangle.
    sides = np.stack([np.cross(a, b), np.cross(b, c), np.cross(c, a)])
    for t in view.tangents:
        ray = np.array([*t, -1.0])
        inside = np.sign(sides @ ray)
        volume = np.sign(np.einsum("ij,ij->i", a, sides[1]))
        if ((inside == volume).all(axis=0) & (volume != 0)).any():
            return True
    return False


def _look(view: JudgedView, center: Floats, R: Floats, heights: Heights) -> ImagePlausibility:
    axis = -R[:, 2]
    tilt = float(np.degrees(np.arccos(np.clip(-axis[2], -1, 1))))
    azimuth = float(np.degrees(np.arctan2(axis[0], axis[1])) % 360) if tilt > 1e-9 else 0.0
    below = float(heights(center[None, :2])[0])
    points = _footprint(center, R, view.tangents, below, heights)
    seen = np.isfinite(points[:, 2])
    d = np.column_stack([view.tangents, -np.ones(len(view.tangents))]) @ R.T
    slope = -d[:, 2] / np.linalg.norm(d, axis=1)
    downward = slope > DOWNWARD
    level = bool(slope[0] < MIDDLE_DOWNWARD and not downward.all())
    inner = np.argsort(np.linalg.norm(view.tangents - view.tangents[0], axis=1))[:INNER]
    # A hole in the terrain under the very middle is not a sign of anything, nor is sky in a level photograph.
    middle = bool(seen[0] or seen[inner].mean() > 0.5 or (level and seen.any()))
    distance = float(np.linalg.norm(points[inner[seen[inner]][0]] - center)) if seen[inner].any() else np.nan
    fault = None
    if center[2] <= below:
        fault = f"projection centre {below - center[2]:.1f} m below the terrain; are the height systems the same?"
    elif center[2] - below > HIGHEST_FLIGHT:
        fault = f"projection centre {center[2] - below:.3g} m above the terrain; are heights in millimetres?"
    elif not seen.any():
        above = "looks above the horizon and " if level and not downward.any() else ""
        fault = f"{above}sees nothing of the terrain (tilt {tilt:.1f}°)"
    return ImagePlausibility(
        name=view.name,
        tilt=tilt,
        azimuth=azimuth,
        height_above_ground=float(center[2] - below),
        gsd=distance * view.pixel,
        on_terrain=float(seen[downward].mean()) if downward.any() else 0.0,
        middle_on_terrain=middle,
        fault=fault,
        level=level,
    )


def _footprint(center: Floats, R: Floats, tangents: Floats, below: float, heights: Heights) -> Floats:
    """Terrain points (n, 3) that the tangents see, to some metres; NaN where they see none."""
    d = np.column_stack([tangents, -np.ones(len(tangents))]) @ R.T
    d[~(d[:, 2] < 0)] = np.nan
    level = np.full(len(d), below)
    points = np.full((len(d), 3), np.nan)
    if not np.isfinite(below):
        # The camera does not stand over the terrain: begin with heights that the rays come by.
        level[:] = _level_near(center, d, heights)
    for _ in range(5):
        with np.errstate(invalid="ignore"):
            points = center + d * ((level - center[2]) / d[:, 2])[:, None]
        there = np.isfinite(points[:, 0])
        found = np.full(len(d), np.nan)
        if there.any():
            found[there] = _ground(heights, points[there, :2])
        # A ray that has left the terrain stays on its last level, it may come back in the next step.
        level = np.where(np.isfinite(found), found, level)
    points[:, 2] = found
    return points


def _ground(heights: Heights, XY: Floats) -> Floats:
    """Heights at points that may lie far apart: asked for cell by cell, so that no large window is ever read."""
    out = np.full(len(XY), np.nan)
    cells, of = np.unique(np.floor(XY / CELL), axis=0, return_inverse=True)
    for k in range(len(cells)):
        mine = of.reshape(-1) == k
        out[mine] = heights(XY[mine])
    return out


def _level_near(center: Floats, d: Floats, heights: Heights) -> float:
    """A terrain height under the rays, for a camera that does not stand over the terrain; NaN if there is none."""
    flat = d[np.isfinite(d[:, 2])]
    if not len(flat):
        return np.nan
    reach = np.geomspace(10.0, 30_000.0, 20)
    rays = flat[:: max(1, len(flat) // 5)]
    points = center[:2] + reach[:, None, None] * (rays[:, :2] / np.abs(rays[:, 2:]))
    found = _ground(heights, points.reshape(-1, 2))
    good = np.isfinite(found)
    return float(np.median(found[good])) if good.any() else np.nan


def better_convention(views: Sequence[JudgedView], images: Sequence[ImagePlausibility], heights: Heights) -> str | None:
    """Sentence on the reading that fits where the declared one does not."""
    views, images = list(views), tuple(images)
    chosen = _sample(views, images)
    sample, declared = [views[k] for k in chosen], [images[k] for k in chosen]
    evidence = _Evidence.of(views, declared, DECLARED)
    if not evidence.doubtful:
        return None
    beside = sum(not image.middle_on_terrain for image in declared)
    ranked: list[tuple[tuple[float, ...], AlternativeConvention, list[ImagePlausibility]]] = []
    for reading in readings(sample[0].order, sample[0].unit):
        # What one change explains needs no second, except where only the second makes the images upright.
        if ranked and reading.changes > ranked[0][1].changes and (ranked[0][0][0] < 0 or len(sample) < ENOUGH):
            break
        if not _possible(reading, evidence.largest):
            continue
        seen = _seen(sample, reading, heights, beside)
        if seen is None:
            continue
        other = _Evidence.of(views, seen, reading)
        if other.better_than(evidence, reading):
            upright = -float(other.steepest < UPRIGHT)
            rank = (upright, reading.changes, -round(other.on_terrain, 2), -round(other.alike, 2))
            ranked.append((rank, reading, seen))
            ranked.sort(key=lambda r: r[0])
    if not ranked:
        return None
    mirrored = any(view.mirrored for view in sample)
    equal = list(dict.fromkeys(r.sentence(mirrored) for rank, r, _ in ranked if rank == ranked[0][0]))
    lines = _alignment(views, DECLARED), _alignment(views, ranked[0][1])
    return _sentence(" — or: ".join(equal[:3]), (declared, ranked[0][2]), lines)


def _seen(
    views: list[JudgedView], reading: AlternativeConvention, heights: Heights, most: int
) -> list[ImagePlausibility] | None:
    """Return what images show by a reading; None as soon as `_Evidence.better_than` is out of reach.

    That is where one has a fault, or more than `most` of them look beside the terrain.
    """
    seen: list[ImagePlausibility] = []
    for view in views:
        seen.append(_look(view, *reading.apply(view.center, view.angles, view.order), heights))
        if seen[-1].fault is not None or sum(not image.middle_on_terrain for image in seen) > most:
            return None
    return seen


@dataclass(frozen=True)
class _Evidence:
    """Evidence of a sample of images for a reading."""

    faults: int
    middles: float
    """Share of images whose middle is on the terrain."""
    on_terrain: float
    median_tilt: float
    steepest: float
    alike: float
    """Agreement of the angles between image axes and flight lines in all images, 0 to 1."""
    offset: float
    """Mean angle between image axes and flight lines, degrees, modulo 90."""
    largest: float
    """Largest declared angle, parts of a full circle."""
    count: int
    level: float
    """Share of level photographs, whose axes need not follow flight lines."""

    @classmethod
    def of(cls, views: list[JudgedView], images: list[ImagePlausibility], reading: AlternativeConvention) -> _Evidence:
        tilts = [i.tilt for i in images]
        alike, offset = _alignment(views, reading)
        return cls(
            faults=sum(i.fault is not None for i in images),
            middles=float(np.mean([i.middle_on_terrain for i in images])),
            on_terrain=float(np.mean([i.on_terrain for i in images])),
            median_tilt=float(np.median(tilts)),
            steepest=max(tilts),
            alike=alike,
            offset=offset,
            largest=float(max(np.abs(v.angles).max() for v in views) / (2 * np.pi)),
            count=len(views),
            level=float(np.mean([i.level for i in images])),
        )

    @property
    def tilted(self) -> bool:
        return self.count >= ENOUGH and self.median_tilt > OBLIQUE

    @property
    def astray(self) -> bool:
        """Image axes lie in no relation to the flight lines, in a block where that means something."""
        return self.count >= 2 * ENOUGH and self.level < 0.5 and (self.alike < 0.85 or abs(self.offset) > 15)

    @property
    def doubtful(self) -> bool:
        return bool(self.faults) or self.middles < 0.8 or self.tilted or self.astray

    def better_than(self, declared: _Evidence, reading: AlternativeConvention) -> bool:
        """Return whether this reading removes what is wrong with the declared one; what only looks different is not
        better."""
        if self.faults or self.middles < declared.middles:
            return False
        # The terrain may end inside the block, so it is the gain that counts, not a share.
        if self.on_terrain > declared.on_terrain + 0.2 and (declared.faults or self.middles > declared.middles + 0.2):
            return True
        if declared.tilted and self.steepest < UPRIGHT:
            return True
        if not declared.astray or self.count < 2 * ENOUGH:
            return False
        if declared.alike < 0.85:
            return self.alike > 0.97 and abs(self.offset) < 5
        # All images lie alike, but askew. Only readings that people really mix up count then, since a heading that was
        # kept askew to the lines on purpose looks the same.
        usual = reading.changes == 1 and (reading.unit == "rad" or reading.transposed)
        return usual and self.alike > 0.9 and abs(self.offset) < 8


def _possible(reading: AlternativeConvention, largest: float) -> bool:
    """Return whether the largest declared angle, in parts of a full circle, can be what the reading takes it for."""
    if reading.unit == "rad":
        return largest * ANGLE_UNITS[reading.declared] < ANGLE_UNITS["rad"]
    if reading.unit is None or reading.declared != "rad":
        return True
    # Angles divided by 57 are upright whatever they were: only more than a full circle lets one think of that, and only
    # more than 360 of gon.
    return largest > 1.0 and (reading.unit == "gon") == (largest * ANGLE_UNITS["rad"] > ANGLE_UNITS["deg"])


def _sample(views: list[JudgedView], images: tuple[ImagePlausibility, ...]) -> list[int]:
    """Images for other readings: faulty ones first, then spread over the block."""
    faulty = [k for k, i in enumerate(images) if i.fault is not None or not i.middle_on_terrain]
    spread = [int(k) for k in np.linspace(0, len(views) - 1, min(SAMPLE_PLAUSIBILITY, len(views)))]
    return list(dict.fromkeys(faulty[: SAMPLE_PLAUSIBILITY // 2] + spread))[:SAMPLE_PLAUSIBILITY]


def _alignment(views: list[JudgedView], reading: AlternativeConvention) -> tuple[float, float]:
    """Return how image axes lie to the flight lines: their agreement in all images (0 to 1), and the mean difference
    (degrees).

    The line through an image and its nearest neighbour is along or across a strip, so angles count modulo 90°.
    """
    posed = [reading.apply(v.center, v.angles, v.order) for v in views[:LINES]]
    XY = np.array([center[:2] for center, _ in posed])
    if len(XY) < 2:
        return 1.0, 0.0
    apart = np.linalg.norm(XY[:, None] - XY, axis=2)
    np.fill_diagonal(apart, np.inf)
    to = XY[apart.argmin(axis=1)] - XY
    line = np.arctan2(to[:, 1], to[:, 0])
    kappa = np.array([np.arctan2(R[1, 0], R[0, 0]) for _, R in posed])
    mean = np.mean(np.exp(4j * (kappa - line)))
    return float(np.abs(mean)), float(np.degrees(np.angle(mean)) / 4)


def _sentence(
    what: str, seen: tuple[list[ImagePlausibility], list[ImagePlausibility]], lines: tuple[tuple[float, float], ...]
) -> str:
    """Return what would have to be declared, and what is better then: tilts, middles on the terrain, axes and flight
    lines."""

    def tilts(images: list[ImagePlausibility]) -> str:
        low, high = min(i.tilt for i in images), max(i.tilt for i in images)
        return f"{low:.0f}–{high:.0f}°" if round(low) != round(high) else f"{low:.0f}°"

    def middles(images: list[ImagePlausibility]) -> str:
        return f"{sum(i.middle_on_terrain for i in images)} of {len(images)} images look at the terrain"

    def axes(alike: float, offset: float) -> str:
        return f"{abs(offset):.0f}° off the flight lines" if alike > 0.85 else "in no relation to the flight lines"

    pairs = [[tell(images) for images in seen] for tell in (tilts, middles)] + [[axes(*each) for each in lines]]
    forms = "tilts are then {1} instead of {0}", "{1} instead of {0}", "image axes are {1} instead of {0}"
    told = [form.format(*pair) for form, pair in zip(forms, pairs) if pair[0] != pair[1]]
    where = "; it is declared to `photoplan init`, or under [orientation] in the project file" if "`" in what else ""
    return f"{what}: {', '.join(told)}{where}"


#: Height below ground that no error of the ground explains, as part of the distance to it, and metres: a vault is seen
#: from below, a landscape is not.
_BELOW, _LEAST = 0.05, 30.0
#: Height systems may differ by so many metres where terrain and control are compared.
_SYSTEMS = 110.0
#: Part of the points that may be wrong, of at least so many.
_WRONG, _ENOUGH = 0.35, 6
#: sigma0 against what was stated, together with residuals in pixels, that no one means.
_SIGMA0, _PIXELS = 20.0, 10.0
#: sigma0 of a reading that fits, and part of the residuals of the reading as given that it may leave.
_FITS, _FIFTH = 3.0, 0.2
#: An international foot, metres.
FOOT = 0.3048


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of an orientation that was computed."""

    center: Floats
    """(3,), metres."""
    R_ground_camera: Floats
    ground: Floats
    """Ground points that it was computed from, (n, 3)."""
    rejected: int
    """How many points were taken out."""
    points: int
    """Of how many."""
    sigma0: float
    """In units of what was stated; NaN: not known."""
    rms: float
    """Of the residuals, pixels; NaN: not known."""
    terrain: float = float("nan")
    """Height of the terrain below the station, metres; NaN: not known."""


def rejection_reason(found: Evidence) -> str | None:
    """Why an orientation cannot be right, as a clause; None if it can."""
    below = _height_of_ground(found) - found.center[2]
    away = float(np.linalg.norm(found.ground - found.center, axis=1).mean()) if len(found.ground) else np.nan
    up = -found.R_ground_camera[2, 2] > 0
    if up and below > max(_LEAST, _BELOW * away):
        return f"the camera lies {below:.0f} m below its ground points and looks up: the solution is mirrored"
    if found.terrain - found.center[2] > _SYSTEMS:
        return f"the camera lies {found.terrain - found.center[2]:.0f} m below the terrain"
    return misfit(found.rejected, found.points, found.sigma0, found.rms)


def misfit(rejected: int, points: int, sigma0: float, rms: float) -> str | None:
    """Why measurements do not fit what was made of them (see `Evidence`), as a clause; None if they do."""
    if points >= _ENOUGH and rejected > _WRONG * points:
        return f"{rejected} of {points} points do not fit it"
    if sigma0 > _SIGMA0 and rms > _PIXELS:
        return f"residuals of {rms:.0f} px are {sigma0:.0f} times what was stated"
    return None


def of_resection(points: MeasuredPoints, found: Resected, terrain: float = float("nan")) -> Evidence:
    """Evidence of a single image."""
    return Evidence(
        center=found.pose.center,
        R_ground_camera=found.pose.R_ground_camera,
        ground=points.XYZ,
        rejected=int(found.rejected.sum()),
        points=len(points),
        sigma0=found.sigma0,
        rms=found.rms,
        terrain=terrain,
    )


def fitting_convention(
    points: MeasuredPoints, height: int, resect: Callable[[MeasuredPoints], Resected], rms: float
) -> str:
    """What the measurements of an image, read otherwise, would fit; as a sentence."""
    fits = []
    for what, other in other_points(points, height):
        try:
            tried = resect(other)
        except PhotoplanError:
            continue
        few = tried.rejected.sum() <= 0.2 * len(points) and tried.redundancy > 0
        close = tried.sigma0 < _FITS or tried.rms < _FIFTH * rms
        if few and close and rejection_reason(of_resection(other, tried)) is None:
            used = int((~tried.rejected).sum())
            fits.append(f"with {what}, {used} of {len(points)} points fit to {tried.rms:.2f} px")
    return "; ".join(fits) or (
        "no exchange of axes, no other direction of y or Z and no other unit of heights fits either; check the names "
        "of points, the camera constant and the CRS"
    )


def _height_of_ground(found: Evidence) -> float:
    """Height of the ground points' plane at the station; NaN where they stand upright, as those of a facade do."""
    X = found.ground
    if len(X) < 3:
        return float("nan")
    middle = X.mean(axis=0)
    _, s, Vt = np.linalg.svd(X - middle)
    normal = Vt[2]
    if abs(normal[2]) < 0.7 or s[1] < 1e-9 * s[0]:
        return float("nan")
    return float(middle[2] - (normal[:2] @ (found.center[:2] - middle[:2])) / normal[2])


def other_points(points: MeasuredPoints, height: int) -> Iterator[tuple[str, MeasuredPoints]]:
    """The same measurements as they may have been meant, with words for it; `height` of the image in pixels."""
    xy, XYZ, Q = points.xy, points.XYZ, points.covariance
    swap = [1, 0, 2]
    yield "X and Y of control exchanged", replace(points, XYZ=XYZ[:, swap], covariance=Q[:, swap][:, :, swap])
    up = np.column_stack([xy[:, 0], height - 1 - xy[:, 1]])
    yield "y of image points upwards", replace(points, xy=up)
    yield "column and row of image points exchanged", replace(points, xy=xy[:, ::-1], sigma=points.sigma[:, ::-1])
    for what, scale in (
        ("heights of control in feet", [1.0, 1.0, FOOT]),
        ("heights of control in metres, X and Y in feet", [FOOT, FOOT, 1.0]),
        ("heights of control in millimetres", [1.0, 1.0, 1e-3]),
        ("Z of control counted downwards, or away from the camera", [1.0, 1.0, -1.0]),
    ):
        yield what, replace(points, XYZ=XYZ * scale)
