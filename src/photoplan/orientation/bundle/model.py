"""The `Block` of a bundle adjustment: observations, unknowns and settings, and the model built from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field, replace
from functools import cached_property
from typing import cast

import numpy as np

from photoplan.adjustment.blocks import Kind, Layout, Unknowns
from photoplan.arrays import Floats, Ints, Mask
from photoplan.cameras.correctable import Correctable, Corrections
from photoplan.cameras.fiducials import Affine2D, Bilinear2D
from photoplan.cameras.lenses import Brown, Lens, NoLens, OpenCV
from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedAttitudes, ObservedPositions
from photoplan.errors import InputError, UsageError
from photoplan.geometry.pose import UNKNOWNS, Pose, rotation_vector, small_rotations

#: Parameters of a camera that can be unknowns, in the order of results: camera constant and principal point in the
#: unit of the image plane, coefficients of the lens without unit (as in `photoplan.cameras.lenses.Brown`).
PARAMETERS = ("c", "x0", "y0", "k1", "k2", "k3", "p1", "p2", "b1", "b2")

#: Shift of image points, (image indices (n,), poses of all images, ground points (n, 3)) → (n, 2) pixels, that is added
#: to the central projection: earth curvature, refraction. It must be smooth and small; its derivatives are neglected.
Bend = Callable[[Ints, "tuple[Pose, ...]", Floats], Floats]


@dataclass(frozen=True)
class BlockCamera:
    """A camera of the block."""

    c: float
    """Camera constant, in the unit of the image plane (millimetres, or pixels)."""
    principal_point: tuple[float, float]
    """x0, y0 in the image plane, same unit."""
    lens: Lens
    """`Brown`, `OpenCV` or `NoLens` where one of its coefficients is free; any where none is."""
    free: tuple[str, ...] = ()
    """Parameters that are unknowns, of `PARAMETERS`."""
    prior_sigma: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations with which free parameters are known beforehand; without an entry: not at all."""


@dataclass(frozen=True, eq=False)
class BlockImage:
    """An image of the block."""

    name: str
    camera: str
    plane_to_pixel: Affine2D | Bilinear2D
    """From the image plane (x right, y up) to pixels."""
    pose: Pose
    """Start value of the exterior orientation."""


#: From block points (n, 3) to map points (n, 3), and their derivatives ∂ map / ∂ block (n, 3, 3).
OnMap = Callable[[Floats], "tuple[Floats, Floats]"]


@dataclass(frozen=True, eq=False)
class BlockProjection:
    """An image of the block without a pose: its geometry is known but for corrections."""

    name: str
    group: str
    """Images that are measured alike, as messages call them: "rational polynomials"."""
    geometry: Correctable
    """Over map points."""
    sight: Callable[[Floats], tuple[Floats, Floats]]
    """From image points (n, 2) to about where they are seen from, and unit directions, in the block's system."""
    metres: float
    """About the size of a pixel on the ground."""
    away: float
    """About the distance from where it is seen to the ground, metres."""


@dataclass(frozen=True, eq=False)
class Block:
    """Input of a bundle adjustment: cameras, images, observations, and what is known a priori."""

    cameras: Mapping[str, BlockCamera]
    images: tuple[BlockImage, ...]
    observations: ImagePoints
    """With a standard deviation for every measurement; those in images that are not of the block are not used."""
    ground: GroundPoints
    """Control and check points; control with a standard deviation for every known coordinate."""
    positions: ObservedPositions | None = None
    attitudes: ObservedAttitudes | None = None
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Antenna minus projection centre, in camera axes, metres."""
    lever_arm_sigma: float = 0.0
    """Its standard deviation; 0: held fixed."""
    drift: str = "none"
    """none, shift or linear: of observed positions in each strip."""
    common: tuple[float, float, float] | None = None
    """Standard deviations of an error that all observed positions share, metres; None: there is none."""
    boresight: bool = False
    """Whether three rotations between observed attitudes and camera are unknowns."""
    boresight_sigma: float = 0.0
    """Their standard deviation a priori, radians; 0: not known."""
    start_points: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Start values of points, where they are known; others are intersected."""
    bend: Bend | None = None
    projections: tuple[BlockProjection, ...] = ()
    on_map: OnMap | None = None
    """Where projections see points of the block; None: map and block are one."""
    datum: bool = False
    """Whether positions and attitudes are approximate orientations that only place the block: their accuracy counts as
    stated, whatever the residuals are."""


@dataclass(frozen=True, eq=False)
class Active:
    """Observations that are not taken out."""

    image: Mask
    """Of `block.observations`."""
    ground: Mask
    """Of the coordinates of `block.ground`, (g, 3)."""
    position: Mask
    """Of `block.positions`."""

    @classmethod
    def all_of(cls, block: Block) -> Active:
        """Nothing taken out."""
        positions = 0 if block.positions is None else len(block.positions.images)
        ground = np.ones((len(block.ground), 3), bool)
        return cls(np.ones(len(block.observations), bool), ground, np.ones(positions, bool))

    def equals(self, other: Active) -> bool:
        """Whether the same observations are active."""
        pairs = ((self.image, other.image), (self.ground, other.ground), (self.position, other.position))
        return all(np.array_equal(a, b) for a, b in pairs)


@dataclass(frozen=True)
class AdjustSettings:
    """How the adjustment is done."""

    robust: bool = True
    """Whether observations that do not fit lose weight while iterating (Huber, then a redescending function)."""
    critical: float = 4.0
    """Normalised residual from which an observation is taken out as a gross error."""
    variance_components: bool = True
    """Whether the groups' standard deviations are estimated and used."""
    correlation: bool = True
    """Whether it is regarded that errors of neighbouring image points are alike, where their residuals show it."""
    iterations: int = 40
    """Most iterations."""
    covariance: bool = True
    """Whether covariances, redundancy numbers and normalised residuals are computed."""


@dataclass(frozen=True)
class Group:
    """Observations of one kind with one variance factor."""

    name: str
    """As users call it: "image points, camera RC30", "control, height" …"""
    count: int
    """Observed numbers (not points)."""
    redundancy: float
    """Sum of the redundancy numbers; NaN where they were not computed."""
    rms: float
    """Root mean square of the residuals in the unit of the observations."""
    unit: str
    factor: float
    """Standard deviation found divided by the one that was stated (root of vᵀPv / redundancy); NaN where too little
    checks the group to estimate it, and it counts as stated."""


@dataclass(frozen=True, eq=False)
class Correlation:
    """Errors of image points that are alike over some distance, of the images of one camera or group."""

    group: str
    """Of the images: "camera RC30"."""
    effect: float
    """Measurements that count as one for an orientation."""
    reach: float
    """Distance over which errors are alike, pixels."""
    distance: Floats
    """Outer limits of classes of distance, (m,), pixels."""
    rho: Floats
    """Correlation of residuals in each class, (m,); NaN: too few pairs."""


@dataclass(frozen=True, eq=False)
class AdjustedCamera:
    """Interior orientation after the adjustment."""

    name: str
    c: float
    principal_point: tuple[float, float]
    lens: Lens
    free: tuple[str, ...]
    """The parameters that were unknowns."""
    covariance: Floats
    """Of those, shape (k, k), sigma0 included; NaN without covariance."""


@dataclass(frozen=True, eq=False)
class AdjustedCorrections:
    """A set of corrections after the adjustment."""

    key: str
    values: Floats
    """(owners, parameters)."""
    covariance: Floats
    """Of each owner, (owners, parameters, parameters); NaN without covariance."""
    known: Floats
    """What each value was known to beforehand: standard deviations; infinite: not at all. As `values`."""
    joint: Mapping[str, Floats] = field(default_factory=dict)
    """Of knots: the covariances of four that follow each other, from each on, with the first owner of another set of
    the same images before them, by the key of that set; empty: there is none. (owners − 3, n, n)."""


@dataclass(frozen=True, eq=False)
class AdjustedStrip:
    """Drift of the observed positions of a strip: position = antenna + shift + rate · (time − epoch)."""

    name: str
    shift: Floats
    """(3,), metres."""
    rate: Floats
    """(3,), metres per second; zero with shift only."""
    epoch: float
    sigma: Floats
    """Of shift and rate, (6,); NaN where it was no unknown."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Result of a bundle adjustment. Covariances and standard deviations hold sigma0 already."""

    images: tuple[str, ...]
    poses: tuple[Pose, ...]
    pose_covariance: Floats
    """(n, 6, 6): projection centre in metres, then small rotations about the camera's x, y, z axes in radians
    (R ← R · exp[δ]×); NaN without covariance."""
    pose_camera_covariance: tuple[Floats, ...]
    """For each image that of its pose with the free parameters of its camera, (6, k)."""
    cameras: tuple[AdjustedCamera, ...]
    points: tuple[str, ...]
    """All points that were adjusted: tie, control and check points."""
    XYZ: Floats
    """(m, 3)."""
    point_covariance: Floats
    """(m, 3, 3); NaN without covariance."""
    rays: Ints
    """Measurements of each point that take part, (m,)."""
    left_out: tuple[tuple[str, str], ...]
    """Points and images that could not take part: name and reason."""
    residuals: Floats
    """Computed minus measured position of every image measurement, (k, 2), pixels (column, row); NaN: not used."""
    redundancies: Floats
    """Redundancy numbers of the measurements, (k, 2), 0 to 1; NaN: not used or not computed."""
    normalised: Floats
    """Residuals divided by their standard deviations, (k, 2)."""
    rejected: Mask
    """Measurements that were taken out as gross errors, (k,); `residuals` and `normalised` then are those against the
    result without them, NaN where their point or image had not enough left."""
    ground_residuals: Floats
    """Adjusted minus given coordinates of every ground point, (g, 3), metres; NaN: not known or not seen."""
    ground_normalised: Floats
    """Normalised residuals of control, (g, 3); NaN for check points."""
    ground_rejected: Mask
    """Control taken out as a gross error, coordinate by coordinate, (g, 3)."""
    position_residuals: Floats
    """Computed minus observed positions, (n_positions, 3), metres."""
    position_rejected: Mask
    """(n_positions,)."""
    attitude_residuals: Floats
    """Small rotations computed minus observed, (n_attitudes, 3), radians."""
    lever_arm: Floats
    """(3,), metres."""
    lever_arm_sigma: Floats
    """(3,); zero where held fixed."""
    boresight: Floats
    """(3,), radians; zero where it was no unknown."""
    boresight_sigma: Floats
    strips: tuple[AdjustedStrip, ...]
    common: tuple[float, float, float] | None
    """See `Block.common`; found from positions that agree among each other far better than stated."""
    groups: tuple[Group, ...]
    sigma0: float
    """Standard deviation of unit weight: 1 where the stated standard deviations are right."""
    redundancy: int
    unknowns: int
    iterations: int
    correlations: tuple[Correlation, ...] = ()
    """Of cameras whose image points have clearly correlated errors; orientations and their covariances regard it."""
    projections: tuple[str, ...] = ()
    """Images without poses that took part."""
    corrections: tuple[AdjustedCorrections, ...] = ()
    """Of these, in the order of their first image."""
    by_prior: tuple[str, ...] = ()
    """Motions of the block that nothing but what corrections are known to beforehand determines."""
    other_control: tuple[str, ...] = ()
    """Control points of the largest other set that agrees within itself; empty where all of it agrees."""


#: Keys of the kinds of unknowns; those of a camera are "camera NAME".
IMAGES, LEVER, BORESIGHT, DRIFT = "images", "lever arm", "boresight", "drift"
COMMON = "common error of positions"


@dataclass(frozen=True, eq=False)
class Poses:
    """Exterior orientations."""

    centers: Floats
    """(n, 3)."""
    rotations: Floats
    """R_ground_camera, (n, 3, 3)."""

    def moved(self, step: Floats) -> Poses:
        """See `Unknowns`."""
        return Poses(self.centers + step[:, :3], self.rotations @ small_rotations(step[:, 3:]))

    def motions(self) -> tuple[float, dict[str, Floats]]:
        """What moves all images together: the size of the block, and steps (n, 6) by their names."""
        n = len(self.centers)
        if not n:
            return 1.0, {}
        away = self.centers - self.centers.mean(axis=0)
        size = float(np.abs(away).max()) or 1.0
        motions: dict[str, Floats] = {}
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
        """Value of a parameter by its name in `photoplan.orientation.bundle.model.PARAMETERS`."""
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

    def moved(self, step: Floats) -> CameraState:
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

    values: Floats
    """(n, w); a step may be of the first columns only."""

    def value(self, parameter: int) -> float:
        """A value of the first block."""
        return float(self.values[0, parameter])

    def moved(self, step: Floats) -> Vectors:
        """See `Unknowns`."""
        values = self.values.copy()
        values[:, : step.shape[1]] += step
        return Vectors(values)


@dataclass(frozen=True, eq=False)
class Turn:
    """A rotation, from observed to true camera axes."""

    R: Floats
    """(3, 3)."""

    def value(self, parameter: int) -> float:
        """Rotation about an axis, radians."""
        return float(rotation_vector(self.R)[parameter])

    def moved(self, step: Floats) -> Turn:
        """See `Unknowns`."""
        return Turn(self.R @ small_rotations(step)[0])


@dataclass(frozen=True, eq=False)
class State:
    """Values of all that may be unknown."""

    blocks: Mapping[str, Unknowns]
    """By their keys."""
    strips: tuple[str, ...]
    """What the rows of the drift belong to."""
    XYZ: Floats
    """Points (m, 3): blocks too, but so many that they are eliminated."""

    @property
    def images(self) -> Poses:
        """Exterior orientations."""
        return cast(Poses, self.blocks[IMAGES])

    @property
    def lever(self) -> Floats:
        """Antenna minus projection centre, in camera axes, (3,)."""
        return cast(Vectors, self.blocks[LEVER]).values[0]

    @property
    def boresight(self) -> Floats:
        """Rotation from observed to true camera axes, (3, 3)."""
        return cast(Turn, self.blocks[BORESIGHT]).R

    @property
    def drift(self) -> Floats:
        """Shift and rate of each strip, (s, 6)."""
        return cast(Vectors, self.blocks[DRIFT]).values

    def camera(self, name: str) -> CameraState:
        """Interior orientation of a camera."""
        return cast(CameraState, self.blocks[f"camera {name}"])

    @property
    def common(self) -> Floats:
        """Error that all observed positions share, (3,)."""
        return cast(Vectors, self.blocks[COMMON]).values[0]

    def known(self, key: str) -> CameraState | Vectors | Turn:
        """Blocks of which something may be known beforehand."""
        return cast("CameraState | Vectors | Turn", self.blocks[key])

    def corrections(self, key: str) -> Floats:
        """Values of a set of corrections, (owners, parameters)."""
        return cast(Vectors, self.blocks[key]).values

    def poses(self) -> tuple[Pose, ...]:
        """Exterior orientations as values."""
        return tuple(Pose(c, R) for c, R in zip(self.images.centers, self.images.rotations))

    def moved(self, layout: Layout, step: Floats, points: Floats) -> State:
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
    XYZ: Floats,
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


#: Standard deviation of coordinates that are held fixed, in units of an image point's on the ground: small against
#: anything that is measured, in any unit of length, and large enough for the arithmetic.
FIXED = 1e-5


@dataclass(frozen=True)
class RowParts:
    """Where the kinds of observations stand in the vector of rows."""

    image: slice
    ground: slice
    position: slice
    attitude: slice
    known: slice
    """What is known beforehand of unknowns."""
    smooth: slice
    """What is known beforehand of corrections, as linear functions of them."""


@dataclass(frozen=True, eq=False)
class Model:
    """The block's observations as arrays; points and images that cannot take part are already gone."""

    block: Block
    image_names: tuple[str, ...]
    """Those with poses first, then `projections`."""
    image_rows: Ints
    """Number of each image with a pose in `block.images`, (n,)."""
    projections: tuple[BlockProjection, ...]
    keys: tuple[tuple[str, ...], ...]
    """Of the sets of corrections of each projection."""
    sets: tuple[Corrections, ...]
    """All these sets, each once."""
    camera_names: tuple[str, ...]
    camera_of: Ints
    """Camera of each image with a pose, then the group of each projection: an index into `groups`."""
    groups: tuple[str, ...]
    """Cameras as messages call them, then the groups of the projections."""
    plane: Floats
    """Bilinear coefficients b1 … b8 from image plane to pixels of each image, (n, 8)."""
    point_names: tuple[str, ...]
    observation: Ints
    """Number of each measurement in `block.observations`, (k,)."""
    image: Ints
    point: Ints
    xy: Floats
    sigma: Floats
    ground: Ints
    """Ground point of each control row, an index into `block.ground`, (c,)."""
    ground_axis: Ints
    """Coordinate of each control row: 0, 1, 2."""
    ground_point: Ints
    """Point of each control row, an index into `point_names`."""
    ground_white: Floats
    """What the residuals of the three coordinates are multiplied with in a control row, (c, 3)."""
    position: Ints
    """Image of each observed position."""
    position_row: Ints
    """Its number in `block.positions`."""
    strip_of: Ints
    """Strip of each observed position, an index into `strip_names`."""
    strip_names: tuple[str, ...]
    tau: Floats
    """Time of each observed position since its strip's epoch."""
    epochs: Floats
    attitude: Ints
    attitude_row: Ints
    columns: Layout
    """The unknowns that are not points."""
    known: tuple[tuple[str, int, float, float], ...]
    """What is known beforehand: key and parameter of the unknown, value, standard deviation."""

    @cached_property
    def parts(self) -> RowParts:
        """Where the kinds of observations stand."""
        smooth = sum(each.known.shape[0] for each in self.sets)
        known = len(self.known), smooth
        sizes = (2 * len(self.image), len(self.ground), 3 * len(self.position), 3 * len(self.attitude), *known)
        ends = np.cumsum(sizes).tolist()
        return RowParts(*(slice(end - size, end) for end, size in zip(ends, sizes)))

    @property
    def rows(self) -> int:
        """Number of all rows."""
        return int(self.parts.smooth.stop)

    @cached_property
    def framed(self) -> Ints:
        """Measurements in images with poses."""
        return np.flatnonzero(self.image < len(self.image_rows))

    @cached_property
    def posed(self) -> Model:
        """The same model with these measurements only."""
        mine = self.framed
        if len(mine) == len(self.image):
            return self
        return replace(
            self,
            observation=self.observation[mine],
            image=self.image[mine],
            point=self.point[mine],
            xy=self.xy[mine],
            sigma=self.sigma[mine],
        )

    @cached_property
    def of_projections(self) -> tuple[tuple[BlockProjection, tuple[str, ...], Ints], ...]:
        """Each projection with the keys of its sets and its measurements."""
        first = len(self.image_rows)
        return tuple((p, self.keys[k], np.flatnonzero(self.image == first + k)) for k, p in enumerate(self.projections))

    @cached_property
    def seen_from(self) -> Floats:
        """About where the measurements in projections are seen from, (k, 3); NaN for those in images with poses."""
        out = np.full((len(self.image), 3), np.nan)
        for projection, _, mine in self.of_projections:
            out[mine] = projection.sight(self.xy[mine])[0]
        return out

    def origins(self, centers: Floats) -> Floats:
        """Where every measurement is seen from, (k, 3), with projection centres (n, 3)."""
        if not self.projections:
            return np.asarray(centers[self.image])
        out = self.seen_from.copy()
        out[self.framed] = centers[self.image[self.framed]]
        return out

    @property
    def observed(self) -> int:
        """Rows of observations, without what is known beforehand."""
        return int(self.parts.attitude.stop)


def check_free(name: str, camera: BlockCamera) -> None:
    """Refuse parameters that a camera's lens does not have."""
    unknown = [p for p in camera.free if p not in PARAMETERS]
    if unknown:
        raise UsageError(f"camera {name!r}: parameter {unknown[0]!r}; allowed are {', '.join(PARAMETERS)}")
    coefficients = [p for p in camera.free if p not in ("c", "x0", "y0")]
    if not coefficients:
        return
    if isinstance(camera.lens, OpenCV):
        missing = [p for p in coefficients if p in ("b1", "b2")]
        if missing:
            raise UsageError(f"camera {name!r}: an OpenCV lens has no {', '.join(missing)}; a Brown lens has them")
    elif not isinstance(camera.lens, Brown | NoLens):
        raise UsageError(
            f"camera {name!r}: {', '.join(coefficients)} cannot be free with its lens ({type(camera.lens).__name__}); "
            "free c, x0, y0 only, or describe the lens by Brown's coefficients as distortion"
        )


def build_model(block: Block, images: list[int], measured: Ints, points: list[str]) -> Model:
    """Arrays of a block."""
    seen = block.observations
    chosen = [block.images[k] for k in images if k < len(block.images)]
    projections = tuple(block.projections[k - len(block.images)] for k in images if k >= len(block.images))
    of_each = [p.geometry.corrections for p in projections]
    sets = {each.key: each for own in of_each for each in own}
    image_index = {n: k for k, n in enumerate([*(b.name for b in chosen), *(p.name for p in projections)])}
    point_index = {name: k for k, name in enumerate(points)}
    camera_names = tuple(dict.fromkeys(b.camera for b in chosen))
    for name in camera_names:
        check_free(name, block.cameras[name])
    sigma = seen.sigma[measured]
    if not np.isfinite(sigma).all():
        raise InputError("image points without a standard deviation; every measurement needs one")
    ground = _ground_rows(block, point_index)
    position, position_row = _observed(block.positions.images if block.positions else (), image_index)
    strips, strip_of, tau, epochs = _strips(block, position_row)
    attitude, attitude_row = _observed(block.attitudes.images if block.attitudes else (), image_index)
    columns = layout_of(block, tuple(b.name for b in chosen), camera_names, strips, tuple(sets.values()))
    groups = tuple(dict.fromkeys(p.group for p in projections))
    of = [camera_names.index(b.camera) for b in chosen]
    of += [len(camera_names) + groups.index(p.group) for p in projections]
    return Model(
        block=block,
        image_names=tuple(image_index),
        image_rows=np.array(images[: len(chosen)], np.int64),
        projections=projections,
        keys=tuple(tuple(each.key for each in own) for own in of_each),
        sets=tuple(sets.values()),
        camera_names=camera_names,
        camera_of=np.array(of, np.int64),
        groups=(*(f"camera {name}" for name in camera_names), *groups),
        plane=np.array([_bilinear(b.plane_to_pixel) for b in chosen]).reshape(-1, 8),
        point_names=tuple(points),
        observation=measured,
        image=np.array([image_index.get(n, -1) for n in seen.images], np.int64)[seen.image[measured]],
        point=np.array([point_index.get(n, -1) for n in seen.points], np.int64)[seen.point[measured]],
        xy=seen.xy[measured],
        sigma=sigma,
        ground=ground[0],
        ground_axis=ground[1],
        ground_point=ground[2],
        ground_white=ground[3],
        position=position,
        position_row=position_row,
        strip_of=strip_of,
        strip_names=strips,
        tau=tau,
        epochs=epochs,
        attitude=attitude,
        attitude_row=attitude_row,
        columns=columns,
        known=_known(block, columns),
    )


def _bilinear(plane: Affine2D | Bilinear2D) -> tuple[float, ...]:
    if isinstance(plane, Affine2D):
        return (plane.a1, plane.a2, 0.0, plane.a3, plane.a4, plane.a5, 0.0, plane.a6)
    return astuple(plane)


def _observed(names: tuple[str, ...], image_index: dict[str, int]) -> tuple[Ints, Ints]:
    rows = [k for k, name in enumerate(names) if name in image_index]
    return np.array([image_index[names[k]] for k in rows], np.int64), np.array(rows, np.int64)


def _strips(block: Block, rows: Ints) -> tuple[tuple[str, ...], Ints, Floats, Floats]:
    """Names of the strips, strip and time since its epoch of each observed position, and the epochs."""
    if block.positions is None:
        return (), np.empty(0, np.int64), np.empty(0), np.empty(0)
    names = [block.positions.strip[k] for k in rows]
    strips = tuple(dict.fromkeys(names))
    of = np.array([strips.index(n) for n in names], np.int64)
    time = block.positions.time[rows]
    epochs = np.array([time[of == s].mean() for s in range(len(strips))])
    return strips, of, time - epochs[of] if len(of) else np.empty(0), epochs


def _on_ground(block: Block) -> float:
    """About the standard deviation of an image point on the ground, from the start orientations; metres."""
    known = block.ground.XYZ[np.isfinite(block.ground.XYZ).all(axis=1)]
    if not len(known):
        return 1.0
    angles, away = [], []
    sigma = float(np.median(block.observations.sigma)) if len(block.observations) else 1.0
    for image in block.images:
        camera = block.cameras[image.camera]
        pixel = np.sqrt(abs(np.linalg.det(image.plane_to_pixel.derivative(np.array(camera.principal_point)))))
        angles.append(sigma / (camera.c * pixel))
        away.append(np.median(np.linalg.norm(known - image.pose.center, axis=1)))
    return float(np.median([*np.array(angles) * np.array(away), *(sigma * p.metres for p in block.projections)]))


def _ground_rows(block: Block, point_index: dict[str, int]) -> tuple[Ints, Ints, Ints, Floats]:
    """Control rows: ground point, coordinate, point, and the whitening of their residuals."""
    ground = block.ground
    fixed = FIXED * _on_ground(block)
    rows: list[tuple[int, int, int]] = []
    white: list[Floats] = []
    for k, name in enumerate(ground.names):
        if ground.check[k] or name not in point_index:
            continue
        known = np.flatnonzero(np.isfinite(ground.XYZ[k]))
        W = np.zeros((3, 3))
        if ground.covariance is not None and np.isfinite(ground.covariance[k][np.ix_(known, known)]).all():
            Q = ground.covariance[k][np.ix_(known, known)] + fixed**2 * np.eye(len(known))
            W[np.ix_(known, known)] = np.linalg.inv(np.linalg.cholesky(Q))
        else:
            sigma = np.maximum(ground.sigma[k][known], fixed)
            if not np.isfinite(sigma).all():
                raise InputError(f"control point {name!r} has no standard deviation; state one for each coordinate")
            W[known, known] = 1.0 / sigma
        for axis in known:
            rows.append((k, int(axis), point_index[name]))
            white.append(W[axis])
    table = np.array(rows, np.int64).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2], np.array(white).reshape(-1, 3)


def _known(block: Block, columns: Layout) -> tuple[tuple[str, int, float, float], ...]:
    known: list[tuple[str, int, float, float]] = []
    for name, given in block.cameras.items():
        if columns.get(f"camera {name}") is not None:
            before = CameraState(given.c, *given.principal_point, given.lens)
            for k, what in enumerate(given.free):
                if what in given.prior_sigma:
                    known.append((f"camera {name}", k, before.parameter(what), given.prior_sigma[what]))
    if columns.get(LEVER) is not None:
        known += [(LEVER, k, block.lever_arm[k], block.lever_arm_sigma) for k in range(3)]
    if columns.get(COMMON) is not None and block.common is not None:
        known += [(COMMON, k, 0.0, block.common[k]) for k in range(3)]
    if columns.get(BORESIGHT) is not None and block.boresight_sigma > 0:
        known += [(BORESIGHT, k, 0.0, block.boresight_sigma) for k in range(3)]
    return tuple(known)
