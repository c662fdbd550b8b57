"""The figures of an adjusted block, in metres and in the units of the project."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.orientation.bundle.block import Group
from photoplan.orientation.check_points import CheckAccuracy
from photoplan.products.adjust.cameras import Calibrated

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ImageFigures:
    """One image."""

    name: str
    strip: str
    """Empty where no strips are known."""
    measurements: int
    """That take part."""
    rejected: int
    mean: tuple[float, float]
    """Mean residual, column and row, pixels."""
    rms: tuple[float, float]
    worst: float
    """Largest normalised residual; NaN: not computed."""
    center: tuple[float, float, float]
    sigma_center: tuple[float, float, float]
    """Metres."""
    sigma_angles: tuple[float, float, float]
    """In the unit of the project."""


@dataclass(frozen=True, eq=False)
class GroundFigures:
    """One control or check point."""

    name: str
    check: bool
    rays: int
    XYZ: tuple[float, float, float]
    """As given; NaN: not known."""
    residual: tuple[float, float, float]
    """Adjusted minus given, metres."""
    stated: tuple[float, float, float]
    """Stated standard deviations, metres."""
    normalised: tuple[float, float, float]
    rejected: tuple[bool, bool, bool]
    covariance: _Floats
    """Of the adjusted X, Y, Z, (3, 3), m²."""


@dataclass(frozen=True)
class NamedMeasurement:
    """One measurement of a point in an image, or a coordinate of control, that is to be named."""

    what: str
    residual: str
    normalised: float
    rejected: bool


@dataclass(frozen=True, eq=False)
class StripFigures:
    """Observed positions of one strip."""

    name: str
    count: int
    rejected: int
    mean: tuple[float, float, float]
    """Mean residual, computed minus observed, metres."""
    rms: tuple[float, float, float]
    shift: tuple[float, float, float]
    """NaN where it was no unknown."""
    rate: tuple[float, float, float]
    sigma_shift: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class ResidualField:
    """Mean residuals of one camera's images in cells of the image plane."""

    camera: str
    unit: str
    """Of the image plane: mm or px."""
    at: _Floats
    """Middles of the cells, (n, 2), x right, y up."""
    mean: _Floats
    """Mean residual (computed minus measured), (n, 2), pixels, x right, y up."""
    count: NDArray[np.int64]
    frame: tuple[float, float, float, float]
    """xmin, ymin, xmax, ymax of the image plane."""
    noise: float
    """Standard deviation of one residual, pixels."""


@dataclass(frozen=True, eq=False)
class AdjustFigures:
    """All figures of a block."""

    title: str
    crs: str
    """Name of the CRS and the height system."""
    sigma0: float
    redundancy: int
    unknowns: int
    iterations: int
    seconds: float
    rms_pixels: float
    """Root mean square of image residuals, pixels (one coordinate)."""
    measurements: int
    rejected: int
    points: int
    mean_rays: float
    angle_unit: str
    groups: tuple[Group, ...]
    images: tuple[ImageFigures, ...]
    ground: tuple[GroundFigures, ...]
    check: CheckAccuracy | None
    cameras: tuple[Calibrated, ...]
    strips: tuple[StripFigures, ...]
    lever_arm: tuple[tuple[float, float, float], tuple[float, float, float]] | None
    """Value and standard deviation, metres; None: no positions."""
    boresight: tuple[tuple[float, float, float], tuple[float, float, float]] | None
    """In the unit of the project; None: no unknown."""
    gross: tuple[NamedMeasurement, ...]
    """Gross errors, largest first."""
    worst: tuple[NamedMeasurement, ...]
    """Largest normalised residuals of what was kept."""
    left_out: tuple[tuple[str, str], ...]
    normalised: _Floats
    """Normalised residuals of image points that take part, flat."""
    critical: float
    robust: bool
    tie_XY: _Floats
    """(m, 2), metres."""
    point_sigma: tuple[float, float, float]
    """Root mean square of the standard deviations of tie points in X, Y, Z, metres."""
    fields: tuple[ResidualField, ...]
    notes: tuple[str, ...]
    inputs: tuple[tuple[str, str], ...]
    settings: tuple[tuple[str, str], ...]
