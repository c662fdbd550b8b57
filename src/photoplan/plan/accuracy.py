"""Standard deviations of the position of each product pixel, and the error budget."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Projection, project
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.anchors import FIGURES, ground_errors, interpolate_trilinear
from photoplan.kernels.weights import KERNELS
from photoplan.surfaces.base import Surface
from photoplan.targets.map import Target

#: Distance of an image corner from the principal point, 23 cm film format, metres (Ecker 1991, tables 4.2, 4.3).
FILM_CORNER = 0.140


def displacement_by_height(radius: ArrayLike, flying_height: ArrayLike, error: ArrayLike) -> NDArray[np.float64]:
    """Radial displacement in the image by a height error: Δr = r ΔZ / h (Ecker 1991, eq. 4.18, table 4.3).

    An error of the projection centre's height acts in the same way (eq. 4.21).
    """
    return np.asarray(radius, float) * np.asarray(error, float) / np.asarray(flying_height, float)


def admissible_height_error(
    radius: ArrayLike, flying_height: ArrayLike, displacement: ArrayLike = 25e-6
) -> NDArray[np.float64]:
    """Height error that displaces a point at `radius` by `displacement` in the image (Behr 1989, §6.1.2, fig. 6.4)."""
    return np.asarray(displacement, float) * np.asarray(flying_height, float) / np.asarray(radius, float)


def displacement_by_shift(shift: ArrayLike, scale_number: ArrayLike) -> NDArray[np.float64]:
    """Displacement in the image by an error in X0, Y0: Δr = ΔR / m_b (Ecker 1991, eq. 4.20)."""
    return np.asarray(shift, float) / np.asarray(scale_number, float)


def admissible_shift(displacement: ArrayLike, scale_number: ArrayLike) -> NDArray[np.float64]:
    """Error in X0, Y0 that displaces the image by `displacement`; inverse of `displacement_by_shift`."""
    return np.asarray(displacement, float) * np.asarray(scale_number, float)


def displacement_by_tilt(angle: ArrayLike, c: ArrayLike, w: ArrayLike) -> NDArray[np.float64]:
    """Displacement by an error in ω or φ: c √(2w⁴ + 2w² + 1) Δω (Ecker 1991, eq. 4.27, 4.28).

    `w` is the tangent of the field angle along either axis at an image corner, X / Z = Y / Z there (0.733 for
    wide-angle film); at the principal point it is 0.
    """
    w2 = np.asarray(w, float) ** 2
    return np.asarray(c, float) * np.sqrt(2.0 * w2 * w2 + 2.0 * w2 + 1.0) * np.asarray(angle, float)


def displacement_by_kappa(angle: ArrayLike, c: ArrayLike, w: ArrayLike) -> NDArray[np.float64]:
    """Displacement by an error in κ: c w √2 Δκ (Ecker 1991, eq. 4.29); `w` as in `displacement_by_tilt`."""
    return np.asarray(c, float) * np.asarray(w, float) * math.sqrt(2.0) * np.asarray(angle, float)


@dataclass(frozen=True)
class OrientationEffect:
    """What the standard deviations of an exterior orientation mean in the image corners, metres in the image."""

    X: float
    Y: float
    Z: float
    omega: float
    phi: float
    kappa: float


def orientation_effect(
    center_sd: tuple[float, float, float],
    angles_sd: tuple[float, float, float],
    c: float,
    flying_height: float,
    *,
    scale_number: float | None = None,
    radius: float = FILM_CORNER,
    w: float = 0.733,
) -> OrientationEffect:
    """Displacements in the image corners by errors of the orientation, one by one (Ecker 1991, table in §8.2.2)."""
    scale = flying_height / c if scale_number is None else scale_number
    return OrientationEffect(
        X=float(displacement_by_shift(center_sd[0], scale)),
        Y=float(displacement_by_shift(center_sd[1], scale)),
        Z=float(displacement_by_height(radius, flying_height, center_sd[2])),
        omega=float(displacement_by_tilt(angles_sd[0], c, w)),
        phi=float(displacement_by_tilt(angles_sd[1], c, w)),
        kappa=float(displacement_by_kappa(angles_sd[2], c, w)),
    )


#: Bands of an accuracy raster with their units.
BANDS = (
    ("sigma_x", "m"),
    ("sigma_y", "m"),
    ("sigma_z", "m"),
    ("semi_major", "m"),
    ("semi_minor", "m"),
    ("azimuth", "degree"),
)
#: Figures between nodes are good to this part of them.
_TOLERANCE = 0.01
#: Most nodes along u or v, and along the depth.
_MOST_NODES = (33, 9)
#: Classes of errors of position, and the powers of ten of metres between which they lie.
_CLASSES, _COUNTED = 400, (-5.0, 3.0)
#: Cycles per pixel at which the position of a resampled pattern is judged: half of what an image can hold.
_FREQUENCY = 0.25

DepthErrors = Callable[[Target, Window], NDArray[np.floating]]
"""Gives the standard deviation of the depth of every pixel of a window, metres; NaN where it is not known."""


@dataclass(frozen=True, eq=False)
class IndependentError:
    """One of the independent errors of a source, as what it does to its projection."""

    name: str
    """What it is called in a budget; causes of one name are parts of one contribution."""
    plus: Projection
    """The projection with the error, `step` standard deviations large."""
    minus: Projection
    """With its opposite."""
    step: float = 1.0

    def __post_init__(self) -> None:
        if not self.step > 0:
            raise UsageError(
                f"cause {self.name!r} is {self.step} standard deviations large; a positive number is needed"
            )

    def displacement(self, XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
        """What one standard deviation does to image positions of ground points (..., 3), pixels, (..., 2)."""
        return (project(self.plus, XYZ) - project(self.minus, XYZ)) / (2 * self.step)


@dataclass(frozen=True, eq=False)
class SourceErrors:
    """What is not known exactly of a source."""

    projection: Projection
    causes: tuple[IndependentError, ...]
    """Independent of each other; correlated unknowns are several causes, along the axes of their covariance."""
    image: float = 0.0
    """Standard deviation of each image coordinate, pixels: anchors, resampling."""

    def __post_init__(self) -> None:
        if not self.image >= 0:
            raise UsageError(f"standard deviation {self.image} px in the image; zero or a positive number is needed")


def figures_at(errors: SourceErrors, target: Target, uvh: NDArray[np.float64]) -> NDArray[np.float64]:
    """Figures of places (..., 3) that `photoplan.kernels.anchors.ground_errors` takes, strictly."""
    here = target.to_ground(uvh)
    metre = np.linalg.norm(target.to_ground(uvh + np.array([1.0, 0, 0])) - here, axis=-1)
    size = np.stack(np.broadcast_arrays(1.0, 1.0, metre), axis=-1)
    offsets = np.eye(3)[:, None] * np.array([-1.0, 1.0])[:, None] * size[..., None, None, :]
    ends = target.to_ground(uvh[..., None, None, :] + offsets)
    # The axis that held the offsets goes last: derivatives by u, v, h.
    J = np.swapaxes(ends[..., 1, :] - ends[..., 0, :], -1, -2) / (2 * size[..., None, :])
    xy = project(errors.projection, ends)
    A = np.swapaxes(xy[..., 1, :] - xy[..., 0, :], -1, -2) / (2 * size[..., None, :])
    image = errors.image**2 * np.eye(2) + np.zeros((*uvh.shape[:-1], 2, 2))
    for cause in errors.causes:
        d = cause.displacement(here)
        image += d[..., :, None] * d[..., None, :]
    (a, b), (c, d) = np.moveaxis(A[..., :2], (-2, -1), (0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
        inverse /= (a * d - b * c)[..., None, None]
        run = (inverse @ A[..., 2:])[..., 0]
        E = inverse @ image @ np.swapaxes(inverse, -1, -2)
    covariance = np.stack([E[..., 0, 0], E[..., 0, 1], E[..., 1, 1]], axis=-1)
    return np.concatenate([run, covariance, J.reshape(*J.shape[:-2], 9)], axis=-1)


def tile_accuracy(
    target: Target,
    window: Window,
    surface: Surface,
    depth_errors: DepthErrors,
    sources: Mapping[int, SourceErrors],
    owner: NDArray[np.uint16] | None = None,
) -> NDArray[np.float32]:
    """Return standard deviations of X, Y, Z and the error ellipse of every pixel of a tile; see `ground_errors`."""
    around = Window(window.col - 1, window.row - 1, window.width + 2, window.height + 2)
    relief = np.asarray(surface.relief(target, around), np.float64)
    slope = _slope(relief)
    depth = np.ascontiguousarray(relief[1:-1, 1:-1], np.float32)
    sigma = np.asarray(depth_errors(target, window), np.float64)
    out = np.full((6, *depth.shape), np.nan, np.float32)
    if owner is None:
        if len(sources) != 1:
            raise UsageError(f"accuracy of {len(sources)} sources; say which of them paints a pixel")
        owner = np.full(depth.shape, next(iter(sources)) + 1, np.uint16)
    for number in np.unique(owner[owner > 0]):
        if int(number) - 1 not in sources:
            raise UsageError(f"source {int(number) - 1} paints pixels, and nothing is known of its errors")
        mine = (owner == number) & np.isfinite(depth)
        if mine.any():
            figures = _figures(sources[int(number) - 1], target, window, np.where(mine, depth, np.float32(np.nan)))
            part = np.empty((6, int(mine.sum())), np.float32)
            ground_errors(figures[mine], slope[mine], sigma[mine], part)
            out[:, mine] = part
    return out


def _slope(relief: NDArray[np.float64]) -> NDArray[np.float64]:
    """∂h/∂u, ∂h/∂v of all but the outermost pixels, (height, width, 2), each the gentler of both sides; 0: not known.

    At a wall it is that of the roof or of the ground that the pixel shows, and not the wall's.
    """
    inner = relief[1:-1, 1:-1]
    slopes = []
    for before, after in ((relief[1:-1, :-2], relief[1:-1, 2:]), (relief[:-2, 1:-1], relief[2:, 1:-1])):
        down, up = inner - before, after - inner
        slopes.append(np.where((np.abs(down) <= np.abs(up)) | np.isnan(up), down, up))
    return np.nan_to_num(np.stack(slopes, axis=-1))


def _figures(errors: SourceErrors, target: Target, window: Window, depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Figures of the pixels of a tile whose depth is not NaN, (height, width, 14)."""
    low, high = float(np.nanmin(depth)), float(np.nanmax(depth))
    pad = 0.01 + 1e-6 * max(abs(low), abs(high))
    low, high = low - pad, high + pad
    counts = np.array([2, 2, 2])
    most = np.array([_MOST_NODES[1], _MOST_NODES[0], _MOST_NODES[0]])
    while True:
        nodes = figures_at(errors, target, _lattice(window, low, high, 2 * counts - 1))
        rough = np.array([_miss(nodes, axis) > _TOLERANCE for axis in range(3)])
        if not (rough & (2 * counts - 1 < most)).any():
            break
        counts = np.where(rough, np.minimum(2 * counts - 1, (most + 1) // 2), counts)
    figures = np.empty((*depth.shape, FIGURES))
    interpolate_trilinear(np.ascontiguousarray(nodes), low, high, depth, figures)
    # Beside the border of what the source shows a node may lie beyond it.
    lost = np.isfinite(depth) & np.isnan(figures).any(axis=-1)
    if lost.any():
        row, col = np.nonzero(lost)
        uvh = np.stack([col + window.col, row + window.row, depth[lost].astype(float)], axis=-1)
        figures[lost] = figures_at(errors, target, uvh)
    return figures


def _lattice(window: Window, low: float, high: float, counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Places (layers, rows, cols, 3) from the first to the last pixel and from the lowest to the highest depth."""
    ends = ((low, high), (window.row, window.stop[1] - 1), (window.col, window.stop[0] - 1))
    h, v, u = np.meshgrid(*(np.linspace(*end, n) for end, n in zip(ends, counts)), indexing="ij")
    return np.stack([u, v, h], axis=-1)


def _miss(nodes: NDArray[np.float64], axis: int) -> float:
    """Largest error of every other node along an axis if it were interpolated, as a part of the largest figure."""
    along = np.moveaxis(nodes, axis, 0)
    miss = np.abs(along[1::2] - (along[:-1:2] + along[2::2]) / 2)
    # Runs by that of a ray at 45°, variances by the largest of them.
    metre = np.abs(nodes[..., 5:]).max()
    variance = np.nan_to_num(nodes[..., [2, 4]]).max(initial=0.0) + 1e-300
    scale = np.array([1 / metre] * 2 + [variance] * 3 + [metre] * 9)
    return float(np.nan_to_num(miss / scale).max(initial=0.0))


def radial_counts(accuracy: NDArray[np.float32]) -> dict[str, list[int]]:
    """How many pixels have which error of position √(σ_X² + σ_Y²): tiles' counts add up, medians do not."""
    radial = np.hypot(accuracy[0], accuracy[1])
    log = np.log10(np.clip(radial[np.isfinite(radial)], 10.0 ** _COUNTED[0], 10.0 ** _COUNTED[1]))
    counts = np.histogram(log, _CLASSES, _COUNTED)[0]
    return {"radial_errors": counts.tolist()}


def radial_error(counts: Sequence[int], share: float) -> float:
    """Error of position, metres, that a share of the counted pixels does not exceed, to 2 %; NaN where none is."""
    if not sum(counts):
        return float("nan")
    below = np.concatenate([[0.0], np.cumsum(counts) / sum(counts)])
    return float(10.0 ** np.interp(share, below, np.linspace(*_COUNTED, _CLASSES + 1)))


def resampling_sigma(kernel: str) -> float:
    """Standard deviation of the position of what a kernel resamples, pixels of the source.

    It is the phase error of a wave of four pixels, over all places between pixels; the nearest pixel is off by 1/√12.
    """
    weights = KERNELS[kernel]
    if weights.taps == 1:
        return float(1 / np.sqrt(12))
    place = (np.arange(512) + 0.5) / 512
    offsets = np.arange(weights.taps) - weights.taps // 2 + 1
    wave = np.exp(2j * np.pi * _FREQUENCY * (offsets - place[:, None]))
    phase = np.angle((weights.weights(place) * wave).sum(axis=1))
    return float(np.sqrt(np.mean((phase / (2 * np.pi * _FREQUENCY)) ** 2)))


def in_image(kernel: str, tolerance: float) -> float:
    """Standard deviation of image coordinates by resampling and by anchors within a tolerance, pixels."""
    own = resampling_sigma(kernel) if kernel else 0.0
    return float(np.hypot(own, tolerance / np.sqrt(3)))
