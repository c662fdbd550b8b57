"""What an interior orientation means: scales, pixel sizes, directions of the axes, shear, shrinkage of the film."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.plane import Affine2D, Bilinear2D
from photoplan.errors import InputError


@dataclass(frozen=True)
class AffineFacts:
    """The derivative of a plane transformation, taken apart."""

    scale: tuple[float, float]
    """Pixels per unit of the image plane along its x and its y axis (Behr 1989, app. B: scale factors)."""
    pixel_size: tuple[float, float]
    """The inverse: how far one pixel reaches along the plane's x and y axis, in the plane's unit (Behr: pixel size)."""
    direction_x: float
    """Direction of the plane's x axis in the scan, counted from columns to rows, that is clockwise as one looks at the
    scan, 0 to 2 π (Behr: rotation of the x axis)."""
    direction_y: float
    """Direction of the plane's y axis in the same way; 3 π / 2 for a scan that is upright."""
    shear: float
    """Angle between the two axes minus a right angle, radians."""
    mirrored: bool
    """Whether the scan shows the plane through its back."""

    @property
    def rotation(self) -> float:
        """How far the picture is turned in the scan, clockwise, −π to π: x and y axis in the mean.

        0: x to the right, y up. Of a mirrored scan: x to the left, y up, since `photoplan fiducials` too exchanges left
        and right first and turns then.
        """
        if self.mirrored:
            return _half_turn(self.direction_x + math.pi + self.shear / 2)
        return _half_turn(self.direction_x - self.shear / 2)


@dataclass(frozen=True)
class Shrinkage:
    """How much shorter the film is than when its camera was calibrated, as parts of the length."""

    x: float
    """Along the image's x axis; negative where it has grown."""
    y: float
    """Along its y axis."""
    sigma: tuple[float, float] = (math.nan, math.nan)
    """Standard deviations of both, from the adjustment of the marks; NaN: not known."""

    @property
    def mean(self) -> float:
        """Of both axes."""
        return (self.x + self.y) / 2


def affine_facts(transformation: Affine2D | Bilinear2D) -> AffineFacts:
    """Take a transformation from image plane (y up) to scan (rows down) apart, at the plane's origin."""
    x, y = transformation.derivative(np.zeros(2)).T
    scale = float(np.hypot(*x)), float(np.hypot(*y))
    direction_x, direction_y = (math.atan2(v[1], v[0]) % math.tau for v in (x, y))
    mirrored = bool(transformation.determinant > 0)
    # From x to y it is a quarter turn anticlockwise, of a mirrored scan clockwise.
    turn = _half_turn(direction_y - direction_x) * (1.0 if mirrored else -1.0)
    size = 1.0 / scale[0], 1.0 / scale[1]
    return AffineFacts(
        scale=scale,
        pixel_size=size,
        direction_x=direction_x,
        direction_y=direction_y,
        shear=turn - math.pi / 2,
        mirrored=mirrored,
    )


def film_shrinkage(
    transformation: Affine2D | Bilinear2D, pitch: tuple[float, float], covariance: NDArray[np.float64] | None = None
) -> Shrinkage:
    """Shrinkage of the film since its calibration, if the scanner's sampling distance is known.

    It includes what the scanner errs: only that of a calibrated scanner is true to some hundredths of a permille.
    """
    if not all(math.isfinite(p) and p > 0 for p in pitch):
        raise InputError(f"sampling distance {pitch} of the scan; two positive numbers are needed")
    on_film = np.asarray(pitch, float)[:, None] * transformation.derivative(np.zeros(2))
    length = np.linalg.norm(on_film, axis=0)
    sigma = (math.nan, math.nan)
    if covariance is not None:
        # Coefficients of x, of y: the first two of each row of the transformation.
        second = len(covariance) // 2
        along = on_film / length * np.asarray(pitch, float)[:, None]
        parts = (covariance[np.ix_([k, k + second], [k, k + second])] for k in (0, 1))
        variances = [float(along[:, k] @ part @ along[:, k]) for k, part in enumerate(parts)]
        sigma = (math.sqrt(variances[0]), math.sqrt(variances[1]))
    x, y = 1.0 - length
    return Shrinkage(float(x), float(y), sigma)


def residuals_on_film(
    transformation: Affine2D | Bilinear2D, plane: ArrayLike, residuals: ArrayLike
) -> NDArray[np.float64]:
    """Residuals in the scan as residuals in the image plane: x right, y up, in its unit, shape (n, 2)."""
    J = transformation.derivative(np.asarray(plane, float))
    return np.linalg.solve(J, np.asarray(residuals, float)[..., None])[..., 0]


def _half_turn(angle: float) -> float:
    """The same direction from −π to π."""
    return math.remainder(angle, math.tau)
