"""What a space resection is given, what of it is not determined, and what comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.chances import reach_t
from photoplan.cameras.base import Camera
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.geometry.pose import UNKNOWNS, Pose
from photoplan.orientation.bundle.block import PARAMETERS

Array = NDArray[np.float64]

#: Parameters of the camera that can be unknowns.
FREE = PARAMETERS


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """Points of one image with their ground coordinates."""

    names: tuple[str, ...]
    xy: Array
    """Measured column and row, (n, 2), pixels."""
    sigma: Array
    """Their standard deviations, (n, 2), pixels."""
    XYZ: Array
    """Ground coordinates, (n, 3), metres."""
    covariance: Array
    """Of those, (n, 3, 3), m²; zero: free of error."""

    def __post_init__(self) -> None:
        n = len(self.names)
        for name, shape in (("xy", (n, 2)), ("sigma", (n, 2)), ("XYZ", (n, 3)), ("covariance", (n, 3, 3))):
            value = np.array(np.broadcast_to(np.asarray(getattr(self, name), float), shape))
            bad = ~np.isfinite(value).all(axis=tuple(range(1, value.ndim)))
            if bad.any():
                raise InputError(f"point {self.names[int(bad.argmax())]!r}: its {name} is not finite")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if not (self.sigma > 0).all():
            raise InputError("standard deviations of image points must be positive")

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class ResectSettings:
    """How a resection is done."""

    free: tuple[str, ...] = ()
    """Parameters of the camera that are unknowns: c, x0, y0, and coefficients of the lens by their names with y up."""
    camera_constant_known: bool = True
    """False: c is an unknown, and the stated one is not even a start value."""
    critical: float = 4.0
    """Normalised residual, in units of sigma0, from which a point is taken out as a gross error."""

    def __post_init__(self) -> None:
        unknown = [name for name in self.free if name not in FREE]
        if unknown:
            raise UsageError(f"free parameter {unknown[0]!r}; resection of one image allows {', '.join(FREE)}")
        chosen = set(self.free) | (set() if self.camera_constant_known else {"c"})
        object.__setattr__(self, "free", tuple(p for p in FREE if p in chosen))


@dataclass(frozen=True, eq=False)
class Resected:
    """Result of a resection. Covariances hold sigma0 already."""

    pose: Pose
    interior: Interior
    """As given, or with the parameters that were free."""
    lens: Lens
    covariance: Array
    """(6 + k, 6 + k): projection centre in metres, small rotations about the camera's x, y, z axes in radians
    (R ← R · exp[δ]×), then the free parameters in the unit of the image plane."""
    free: tuple[str, ...]
    residuals: Array
    """Computed minus measured position of every point, (n, 2), pixels (column, row); of rejected points too."""
    redundancies: Array
    """Redundancy numbers of the measurements, (n, 2); NaN for rejected points."""
    normalised: Array
    """Residuals divided by their standard deviations (those before the adjustment, without sigma0), (n, 2); NaN where
    no other point controls the measurement."""
    rejected: NDArray[np.bool_]
    """Points taken out as gross errors, (n,)."""
    sigma0: float
    """Standard deviation of unit weight; 1 without redundancy."""
    redundancy: int
    notes: tuple[str, ...] = ()
    """What a user should know: errors that cannot be located …"""

    @property
    def rms(self) -> float:
        """Root mean square of the residuals of one coordinate over the points that take part, pixels."""
        return float(np.sqrt((self.residuals[~self.rejected] ** 2).mean()))

    @property
    def reach_95(self) -> float:
        """Standard deviations within which 95 % of the errors lie: more than 1.96, since few points tell sigma0 badly.

        NaN without redundancy.
        """
        return reach_t(0.95, self.redundancy)


#: The camera in ground coordinates that a pose makes: with earth curvature and refraction.
CameraOf = Callable[[Interior, Lens, Pose], Camera]


#: Largest standard deviation of an unknown, in units of its natural size (distance of the points, radian, camera
#: constant): with more the linear adjustment says nothing any more.
UNDETERMINED = 0.1
#: Smaller singular values than this part of the largest are rounding.
_ROUNDING = 1e-10


@dataclass(frozen=True, eq=False)
class ResectionUnknowns:
    """How the unknowns of a resection are called."""

    where: str
    """Begin of messages: "image 'a': its 5 control points"."""
    units: Array
    """Natural size of each unknown, (u,)."""
    free: tuple[str, ...]
    """Names of those after the pose."""
    sigma: float
    """Standard deviation of a measurement, pixels."""


def refuse_undetermined(A: Array, sigma0: float, unknowns: ResectionUnknowns) -> Array:
    """Inverse normal equations of whitened equations (m, u) in natural units."""
    s, Vt = np.linalg.svd(A, full_matrices=False)[1:]
    worst = Vt[-1]
    if len(A) >= A.shape[1] and s[-1] > _ROUNDING * s[0] and max(1.0, sigma0) / s[-1] <= UNDETERMINED:
        return np.asarray((Vt.T / s**2) @ Vt, float)
    raise GeometryError(f"{unknowns.where} do not determine {_spelled(worst, float(s[-1]), unknowns)}")


def _spelled(direction: Array, singular: float, unknowns: ResectionUnknowns) -> str:
    """A combination of unknowns that leaves the image as it is, in numbers."""
    share = np.abs(direction)
    parts = [int(k) for k in np.argsort(-share) if share[k] > 0.1 * share.max()]
    names = [*UNKNOWNS, *unknowns.free]
    # One percent of the natural size of what changes most.
    step = direction * (0.01 / direction[parts[0]])
    said = [_change(names[k], float(step[k] * unknowns.units[k]), k) for k in parts]
    moved = float(np.linalg.norm(step)) * singular * unknowns.sigma
    together = f"{' and '.join(names[k] for k in parts)}" + (" apart" if len(parts) > 1 else "")
    way = "hold a parameter fixed or " if unknowns.free else ""
    return (
        f"{together}: {', '.join(said)} alter{'s' * (len(said) == 1)} all image points together by {moved:.2g} px; "
        f"{way}use control points that are spread over the image and differ in height"
    )


def _change(name: str, value: float, k: int) -> str:
    if k < 3:
        return f"{name} {value:+.4g} m"
    if k < 6:
        return f"{name} {np.degrees(value):+.3g}°"
    return f"{name} {value:+.4g}"
