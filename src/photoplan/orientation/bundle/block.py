"""A block of images as the bundle adjustment takes it, and what comes out: in one Cartesian system, metres.

Maps are not Cartesian; `photoplan.products.adjust.run` carries a project's inputs here and the result back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.correctable import Correctable
from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedAttitudes, ObservedPositions
from photoplan.cameras.plane import Affine2D, Bilinear2D
from photoplan.geometry.pose import Pose

#: Parameters of a camera that can be unknowns, in the order of results: camera constant and principal point in the
#: unit of the image plane, coefficients of the lens without unit (as in `photoplan.cameras.lenses.brown.Brown`).
PARAMETERS = ("c", "x0", "y0", "k1", "k2", "k3", "p1", "p2", "b1", "b2")

#: Shift of image points, (image indices (n,), poses of all images, ground points (n, 3)) → (n, 2) pixels, that is added
#: to the central projection: earth curvature, refraction. It must be smooth and small; its derivatives are neglected.
Bend = Callable[[NDArray[np.int64], "tuple[Pose, ...]", NDArray[np.float64]], NDArray[np.float64]]


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
OnMap = Callable[[NDArray[np.float64]], "tuple[NDArray[np.float64], NDArray[np.float64]]"]


@dataclass(frozen=True, eq=False)
class BlockProjection:
    """An image of the block without a pose: its geometry is known but for corrections."""

    name: str
    group: str
    """Images that are measured alike, as messages call them: "rational polynomials"."""
    geometry: Correctable
    """Over map points."""
    sight: Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
    """From image points (n, 2) to about where they are seen from, and unit directions, in the block's system."""
    metres: float
    """About the size of a pixel on the ground."""
    away: float
    """About the distance from where it is seen to the ground, metres."""


@dataclass(frozen=True, eq=False)
class Block:
    """Everything that is observed and that is known beforehand."""

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

    image: NDArray[np.bool_]
    """Of `block.observations`."""
    ground: NDArray[np.bool_]
    """Of the coordinates of `block.ground`, (g, 3)."""
    position: NDArray[np.bool_]
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
    distance: NDArray[np.float64]
    """Outer limits of classes of distance, (m,), pixels."""
    rho: NDArray[np.float64]
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
    covariance: NDArray[np.float64]
    """Of those, shape (k, k), sigma0 included; NaN without covariance."""


@dataclass(frozen=True, eq=False)
class AdjustedCorrections:
    """A set of corrections after the adjustment."""

    key: str
    values: NDArray[np.float64]
    """(owners, parameters)."""
    covariance: NDArray[np.float64]
    """Of each owner, (owners, parameters, parameters); NaN without covariance."""
    known: NDArray[np.float64]
    """What each value was known to beforehand: standard deviations; infinite: not at all. As `values`."""
    joint: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Of knots: the covariances of four that follow each other, from each on, with the first owner of another set of
    the same images before them, by the key of that set; empty: there is none. (owners − 3, n, n)."""


@dataclass(frozen=True, eq=False)
class AdjustedStrip:
    """Drift of the observed positions of a strip: position = antenna + shift + rate · (time − epoch)."""

    name: str
    shift: NDArray[np.float64]
    """(3,), metres."""
    rate: NDArray[np.float64]
    """(3,), metres per second; zero with shift only."""
    epoch: float
    sigma: NDArray[np.float64]
    """Of shift and rate, (6,); NaN where it was no unknown."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Result of a bundle adjustment. Covariances and standard deviations hold sigma0 already."""

    images: tuple[str, ...]
    poses: tuple[Pose, ...]
    pose_covariance: NDArray[np.float64]
    """(n, 6, 6): projection centre in metres, then small rotations about the camera's x, y, z axes in radians
    (R ← R · exp[δ]×); NaN without covariance."""
    pose_camera_covariance: tuple[NDArray[np.float64], ...]
    """For each image that of its pose with the free parameters of its camera, (6, k)."""
    cameras: tuple[AdjustedCamera, ...]
    points: tuple[str, ...]
    """All points that were adjusted: tie, control and check points."""
    XYZ: NDArray[np.float64]
    """(m, 3)."""
    point_covariance: NDArray[np.float64]
    """(m, 3, 3); NaN without covariance."""
    rays: NDArray[np.int64]
    """Measurements of each point that take part, (m,)."""
    left_out: tuple[tuple[str, str], ...]
    """Points and images that could not take part: name and reason."""
    residuals: NDArray[np.float64]
    """Computed minus measured position of every image measurement, (k, 2), pixels (column, row); NaN: not used."""
    redundancies: NDArray[np.float64]
    """Redundancy numbers of the measurements, (k, 2), 0 to 1; NaN: not used or not computed."""
    normalised: NDArray[np.float64]
    """Residuals divided by their standard deviations, (k, 2)."""
    rejected: NDArray[np.bool_]
    """Measurements that were taken out as gross errors, (k,); `residuals` and `normalised` then are those against the
    result without them, NaN where their point or image had not enough left."""
    ground_residuals: NDArray[np.float64]
    """Adjusted minus given coordinates of every ground point, (g, 3), metres; NaN: not known or not seen."""
    ground_normalised: NDArray[np.float64]
    """Normalised residuals of control, (g, 3); NaN for check points."""
    ground_rejected: NDArray[np.bool_]
    """Control taken out as a gross error, coordinate by coordinate, (g, 3)."""
    position_residuals: NDArray[np.float64]
    """Computed minus observed positions, (n_positions, 3), metres."""
    position_rejected: NDArray[np.bool_]
    """(n_positions,)."""
    attitude_residuals: NDArray[np.float64]
    """Small rotations computed minus observed, (n_attitudes, 3), radians."""
    lever_arm: NDArray[np.float64]
    """(3,), metres."""
    lever_arm_sigma: NDArray[np.float64]
    """(3,); zero where held fixed."""
    boresight: NDArray[np.float64]
    """(3,), radians; zero where it was no unknown."""
    boresight_sigma: NDArray[np.float64]
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
