"""The figures of an adjusted block, in metres and in the units of the project."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.io.project.cameras import image_size
from photoplan.orientation.bundle.block import BlockImage, Group
from photoplan.orientation.check_points import CheckAccuracy
from photoplan.products.adjust.block import MapResult
from photoplan.products.adjust.cameras import Calibrated
from photoplan.products.adjust.geometry import FoundParameter

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
class CorrectionFigures:
    """An image without a pose: its residuals and its correction."""

    name: str
    group: str
    measurements: int
    rejected: int
    mean: tuple[float, float]
    rms: tuple[float, float]
    worst: float
    parameters: tuple[FoundParameter, ...]
    seconds: _Floats
    """Time of each measurement that takes part, (k,); empty where time means nothing."""
    residuals: _Floats
    """Of these, (k, 2), pixels."""
    over_time: tuple[_Floats, _Floats] | None
    """Times and corrections that change with them: metres, radians."""
    angles: tuple[_Floats, _Floats] | None = None
    """Times, and ω, φ, κ of the adjusted trajectory, radians."""


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
    sigma_rate: tuple[float, float, float]


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
    corrections: tuple[CorrectionFigures, ...]
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


#: Measurements in a cell on average, and cells along the longer side at least and at most.
_PER_CELL, _FEWEST, _MOST = 25, 4, 18
#: Cells with fewer measurements are not shown.
_LEAST = 4


def residual_fields(result: MapResult, used: NDArray[np.bool_]) -> tuple[ResidualField, ...]:
    """Fields of all cameras that have enough measurements.

    Residuals are turned from pixels into the image plane (x right, y up), where the images of a film camera agree, and
    scaled back so that their length stays in pixels.
    """
    points, block = result.prepared.inputs.points, result.prepared.block
    of = {image.name: image for image in block.images}
    at, turned = np.full((len(points), 2), np.nan), np.full((len(points), 2), np.nan)
    camera = np.full(len(points), "", object)
    for k, name in enumerate(points.images):
        rows = np.flatnonzero((points.image == k) & used)
        if len(rows) and name in of:
            at[rows], turned[rows] = _in_plane(of[name], points.xy[rows], result.adjusted.residuals[rows])
            camera[rows] = of[name].camera
    out = []
    for name in block.cameras:
        mine = camera == name
        if mine.sum() >= _LEAST * _FEWEST**2:
            out.append(_field(result, name, at[mine], turned[mine]))
    return tuple(out)


def _in_plane(image: BlockImage, xy: _Floats, residuals: _Floats) -> tuple[_Floats, _Floats]:
    """Places in the image plane, and residuals along its axes in pixels."""
    transformation = image.plane_to_pixel
    at = transformation.inverse(xy)
    ends = transformation.inverse(xy + residuals)
    middle = np.median(at, axis=0)
    pixel = float(np.sqrt(abs(np.linalg.det(transformation.derivative(middle)))))
    return at, (ends - at) * pixel


def _field(result: MapResult, name: str, at: _Floats, residuals: _Floats) -> ResidualField:
    frame = _frame(result, name)
    width, height = frame[2] - frame[0], frame[3] - frame[1]
    cells = max(1.0, len(at) / _PER_CELL)
    side = max(np.sqrt(width * height / cells), max(width, height) / _MOST)
    side = min(side, max(width, height) / _FEWEST)
    columns, rows = max(1, round(width / side)), max(1, round(height / side))
    column = np.clip(((at[:, 0] - frame[0]) / width * columns).astype(int), 0, columns - 1)
    row = np.clip(((at[:, 1] - frame[1]) / height * rows).astype(int), 0, rows - 1)
    cell = row * columns + column
    count = np.bincount(cell, minlength=rows * columns)
    mean = np.stack([np.bincount(cell, residuals[:, k], rows * columns) for k in (0, 1)], axis=1)
    shown = np.flatnonzero(count >= _LEAST)
    middles = np.stack(
        [frame[0] + (shown % columns + 0.5) * width / columns, frame[1] + (shown // columns + 0.5) * height / rows],
        axis=1,
    )
    camera = result.prepared.inputs.project.cameras[name]
    unit = "mm" if camera.type == "film" or (camera.camera_constant_mm and not camera.principal_point_px) else "px"
    return ResidualField(
        camera=name,
        unit=unit,
        at=middles,
        mean=mean[shown] / count[shown, None],
        count=count[shown],
        frame=frame,
        noise=float(np.sqrt((residuals**2).mean())),
    )


def _frame(result: MapResult, name: str) -> tuple[float, float, float, float]:
    """Corners of the camera's image format in the image plane: of its first image."""
    project = result.prepared.inputs.project
    image = next(i for i in result.prepared.block.images if i.camera == name)
    width, height = image_size(project.cameras[name], project.image(image.name))
    corners = np.array([(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)])
    plane = image.plane_to_pixel.inverse(corners)
    low, high = plane.min(axis=0), plane.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
