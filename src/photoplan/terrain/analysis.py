"""Analyses of terrain: what is visible, where water flows, ground points of one image."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera
from photoplan.codec import storable
from photoplan.errors import InputError, UsageError
from photoplan.events import Map
from photoplan.geometry.local import MEAN_RADIUS
from photoplan.kernels import terrain as kernels
from photoplan.kernels.rays import pyramid_of
from photoplan.kernels.visibility import least_visible_heights
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.objects import without_objects
from photoplan.surfaces.shifted import intersect

#: Rows that one task of a thread computes.
ROWS = 32


@dataclass(frozen=True)
class Observer:
    """Observer of a visibility map."""

    column: float
    """Column of the grid (0 = middle of the first pixel); need not be whole."""
    row: float
    eye: float
    """Height of the eye in the height system of the grid, metres."""
    name: str = ""


@dataclass(frozen=True)
class SightSettings:
    """Options of lines of sight."""

    target_height: float = 0.0
    """Height of the targets above ground, metres."""
    radius: float = math.inf
    """Distance beyond which nothing is looked at, metres."""
    curvature: bool = True
    """Whether the earth is round."""
    refraction: float = 0.13
    """Coefficient of refraction k = earth radius / radius of the line of sight (Ecker 1991, §5.7.6)."""
    earth_radius: float = MEAN_RADIUS
    """Metres."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.target_height) and self.target_height >= 0):
            raise UsageError(f"target height {self.target_height} m; zero or a positive number of metres is needed")
        if not self.radius > 0:
            raise UsageError(f"radius {self.radius} m; a positive number of metres is needed")
        if not -1 <= self.refraction < 1:
            raise UsageError(f"refraction coefficient {self.refraction}; from -1 to below 1, usual is 0.13")
        if not self.earth_radius > 0:
            raise UsageError(f"earth radius {self.earth_radius} m; a positive number of metres is needed")

    @property
    def bend(self) -> float:
        """Drop of the ground below the tangent line of sight per squared distance, 1/m: (1 − k) / 2R.

        Earth curvature lowers it by s² / 2R (Ecker 1991, eq. 5.6), refraction raises it by k s² / 2R (eq. 5.7).
        """
        return (1.0 - self.refraction) / (2.0 * self.earth_radius) if self.curvature else 0.0


def horizon(eye_height: float, settings: SightSettings) -> float:
    """Distance of the horizon over a smooth earth, metres; infinite without curvature."""
    return math.sqrt(eye_height / settings.bend) if settings.bend > 0 else math.inf


def needed_heights(
    heights: NDArray[np.float32],
    mesh: float,
    observer: Observer,
    settings: SightSettings,
    *,
    only_whether: bool,
    run: Map = map,
) -> NDArray[np.float32]:
    """Height above ground from which every post of a grid can be seen.

    Every line of sight is followed from the post to the eye and compared with bilinear terrain at all grid lines that
    it crosses; blocks of meshes that lie below it are skipped by a pyramid of their maxima, which changes no result.
    See `kernels.visibility` for what remains as error.
    """
    rows, columns = heights.shape
    if rows < 2 or columns < 2:
        raise InputError(f"a grid of {columns} × {rows} posts; lines of sight need at least two each way")
    if not (-0.5 <= observer.column <= columns - 0.5 and -0.5 <= observer.row <= rows - 0.5):
        raise InputError(f"observer {observer.name or ''} stands outside the terrain")
    relative = np.empty(heights.shape, np.float32)
    across = np.square(np.arange(columns) - observer.column)
    for row in range(rows):
        distance2 = (across + (row - observer.row) ** 2) * mesh**2
        relative[row] = heights[row].astype(float) - observer.eye - distance2 * settings.bend
    pyramid = pyramid_of(relative)
    out = np.empty(heights.shape, np.float32)
    eye = (float(observer.column), float(observer.row), settings.radius / mesh)

    def part(first: int) -> NDArray[np.float32]:
        rows_here = (first, min(first + ROWS, rows))
        least_visible_heights(relative, pyramid, eye, rows_here, float(settings.target_height), only_whether, out)
        return out[slice(*rows_here)]

    for number, found in enumerate(run(part, range(0, rows, ROWS))):
        out[number * ROWS : (number + 1) * ROWS] = found
    return out


def parts(heights: NDArray[np.float32]) -> int:
    """Items that `needed_heights` gives to `run`."""
    return -(-len(heights) // ROWS)


FlowMethod = Literal["d8", "dinf"]
#: Bytes of one cell while it is computed.
CELL_BYTES = 80


@storable
@dataclass(frozen=True, eq=False)
class Flow:
    """Flow over a grid; all arrays have its shape."""

    filled: NDArray[np.float32]
    """Heights with pits filled up to where they spill, metres."""
    direction: NDArray[np.int8]
    """Direction of the flow, 0 = east, 1 = north-east … 7 = south-east; −1: it leaves the terrain, −2: no terrain."""
    area: NDArray[np.float64]
    """Area whose water comes through the cell, its own included, m²; NaN without terrain."""
    length: NDArray[np.float32]
    """Horizontal length of the way to the next outlet below, or to the edge of the terrain, metres."""
    longest: NDArray[np.float32]
    """Horizontal length of the longest way that leads to the cell, metres."""
    catchment: NDArray[np.int32]
    """Number of the next outlet below (from 1, in the order given); 0: the water leaves elsewhere; −1: no terrain."""
    leaves: NDArray[np.bool_]
    """Cells where water leaves the terrain."""


def flow_of(
    heights: NDArray[np.float32], cell: float, outlets: Sequence[tuple[int, int]] = (), method: FlowMethod = "d8"
) -> Flow:
    """Flow over a grid of heights.

    Pits are filled; every cell flows to the neighbour with the steepest way down, on plains towards where the plain
    spills. Water leaves over the edge of the grid and where terrain is missing.

    Parameters
    ----------
    heights : ndarray, shape (rows, cols), float32
        NaN = no terrain.
    cell : float
        Side of a cell, metres.
    outlets : sequence of (row, column)
        Cells whose catchments are wanted; without any, those are numbered where water leaves the terrain.
    method : str
        How upstream areas are summed: ``"d8"`` to one neighbour, ``"dinf"`` split between two, which is smoother on
        slopes. Lengths and catchments follow ``"d8"`` in any case.

    Raises
    ------
    UsageError
        The method is unknown.
    InputError
        There is no terrain, or an outlet lies where there is none.
    """
    if method not in get_args(FlowMethod):
        raise UsageError(f"method {method!r}; allowed are {', '.join(get_args(FlowMethod))}")
    heights = np.ascontiguousarray(heights, np.float32)
    shape, columns = heights.shape, heights.shape[1]
    missing = np.isnan(heights)
    if missing.all():
        raise InputError("no terrain: the grid holds no height")
    filled = np.empty(shape, np.float32)
    order, origin = np.empty(heights.size, np.int32), np.full(heights.size, -1, np.int32)
    count = kernels.flood(heights, filled, order, origin)
    order = order[:count]
    receiver = np.empty(heights.size, np.int32)
    kernels.steepest(filled, origin, receiver)
    area = np.where(missing, np.nan, cell**2).ravel()
    if method == "dinf":
        kernels.accumulate_split(filled, order, receiver, area)
    else:
        kernels.accumulate(order, receiver, area)
    leaves = receiver == -1
    labels = _outlets(heights, outlets) if outlets else _numbered(order, leaves)
    stops = (labels > 0) & bool(outlets)
    length, longest = np.full(heights.size, np.nan, np.float32), np.where(missing, np.nan, 0).astype(np.float32).ravel()
    kernels.downstream(order, receiver, columns, stops, length)
    kernels.upstream_length(order, receiver, columns, longest)
    kernels.label_upstream(order, receiver, labels)
    labels[missing.ravel()] = -1
    direction = np.empty(shape, np.int8)
    kernels.directions(receiver, direction)
    return Flow(
        filled=filled,
        direction=direction,
        area=area.reshape(shape),
        length=length.reshape(shape) * np.float32(cell),
        longest=longest.reshape(shape) * np.float32(cell),
        catchment=labels.reshape(shape),
        leaves=leaves.reshape(shape),
    )


def _outlets(heights: NDArray[np.float32], outlets: Sequence[tuple[int, int]]) -> NDArray[np.int32]:
    rows, columns = heights.shape
    labels = np.zeros(heights.size, np.int32)
    for number, (row, column) in enumerate(outlets, 1):
        if not (0 <= row < rows and 0 <= column < columns) or np.isnan(heights[row, column]):
            raise InputError(f"outlet {number} lies where there is no terrain; move it, or snap it to the flow")
        at = row * columns + column
        if labels[at]:
            raise InputError(f"outlets {labels[at]} and {number} lie in one cell; leave one out, or take smaller cells")
        labels[at] = number
    return labels


def _numbered(order: NDArray[np.int32], leaves: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Numbers from 1 for the cells where water leaves, from low to high."""
    labels = np.zeros(len(leaves), np.int32)
    out = order[leaves[order]]
    labels[out] = np.arange(1, len(out) + 1)
    return labels


def snapped(area: NDArray[np.float64], row: float, column: float, reach: float) -> tuple[int, int]:
    """The cell with the largest upstream area within `reach` cells of a place; the cell itself for reach 0."""
    rows, columns = area.shape
    j, i = np.mgrid[
        max(0, round(row - reach)) : min(rows, round(row + reach) + 1),
        max(0, round(column - reach)) : min(columns, round(column + reach) + 1),
    ]
    near = np.hypot(j - row, i - column) <= max(reach, 0.75)
    if reach < 0.5:
        near &= (j == round(row)) & (i == round(column))
    found = np.where(near, area[j, i], np.nan) if j.size else np.empty(0)
    if not np.isfinite(found).any():
        raise InputError("no terrain there")
    best = np.unravel_index(np.nanargmax(found), found.shape)
    return int(j[best]), int(i[best])


REASONS = {
    "": "met",
    "outside": "outside the image",
    "no ray": "its lens, polynomials or trajectory have no ray there",
    "up": "looks above the horizon",
    "below": "the camera is below the terrain",
    "none": "meets no terrain",
}
"""Why an image point has no ground point."""
#: Places along each ray at which holes of the terrain are looked for.
HOLE_STEPS = 64


@dataclass(frozen=True)
class MonoplotErrors:
    """Standard deviations that ground points inherit."""

    image: float = 0.5
    """Standard deviation of each image coordinate, pixels."""
    terrain: float | Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Standard deviation of terrain heights, metres: one number, or a function of map points (n, 2), if known."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviations of the projection centre, X, Y, Z, metres."""
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviations of the three rotations about `axes`, radians."""
    axes: NDArray[np.float64] | None = None
    """Axes of these rotations in ground space, shape (3, 3), a row for each; None: X, Y, Z."""

    def __post_init__(self) -> None:
        numbers = [self.image, *self.position, *self.angles]
        if isinstance(self.terrain, int | float):
            numbers.append(self.terrain)
        if not all(math.isfinite(n) and n >= 0 for n in numbers):
            raise UsageError(f"standard deviations {numbers}; zero or positive numbers are needed")


@dataclass(frozen=True, eq=False)
class MonoplotPoints:
    """Ground points of image points, in their order."""

    XYZ: NDArray[np.float64]
    """Shape (n, 3), metres; NaN where there is none."""
    covariance: NDArray[np.float64]
    """Shape (n, 3, 3), m²; NaN where there is no point, or the terrain's standard deviation is unknown."""
    angle: NDArray[np.float64]
    """Angle between ray and terrain, radians, shape (n,): the flatter, the less exact; below 0 the terrain is seen
    from behind."""
    hole: NDArray[np.bool_]
    """True where the ray crosses a place without terrain before it meets some, shape (n,)."""
    reasons: NDArray[np.str_]
    """Keys of `REASONS`, shape (n,)."""

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Standard deviations of X, Y, Z, shape (n, 3), metres."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def monoplot(
    camera: Camera,
    xy: ArrayLike,
    terrain: Terrain,
    height_range: tuple[float, float],
    errors: MonoplotErrors,
    mesh: float,
) -> MonoplotPoints:
    """Return where the rays of image points first meet a surface.

    With A = ∂(x, y)/∂(X, Y, Z) and the terrain's slope s = ∂h/∂(X, Y), small changes obey

        ( A  ) dP = ( dxy − A (dP of the camera's motion) )
        (−s 1)      ( dh                                  )

    whose solution carries the covariances of image point, orientation and terrain over to the ground point. The slope
    is that between points half a mesh away on both sides.
    """
    xy = np.asarray(xy, float).reshape(-1, 2)
    reasons = _before(camera, xy, terrain, height_range)
    XYZ = np.full((len(xy), 3), np.nan)
    asked = np.flatnonzero(reasons == "")
    if len(asked):
        XYZ[asked] = intersect(camera, xy[asked], terrain, height_range)
    reasons[np.isnan(XYZ[:, 0]) & (reasons == "")] = "none"
    slope = _slope(terrain, XYZ[:, :2], mesh / 2)
    direction = _directions(camera, xy, XYZ[:, 2])
    normal = np.column_stack([-slope, np.ones(len(xy))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    angle = np.where(np.isnan(XYZ[:, 0]), np.nan, np.arcsin(np.clip(-(normal * direction).sum(axis=1), -1, 1)))
    covariance = _covariance(camera, XYZ, slope, errors)
    return MonoplotPoints(
        XYZ=XYZ,
        covariance=covariance,
        angle=angle,
        hole=_holes(camera, xy, XYZ, terrain, height_range[1]),
        reasons=reasons,
    )


def _before(
    camera: Camera, xy: NDArray[np.float64], terrain: Terrain, height_range: tuple[float, float]
) -> NDArray[np.str_]:
    """Reasons that are known before the terrain is looked at."""
    reasons = np.full(len(xy), "", "U8")
    if not np.isfinite(height_range).all():
        reasons[:] = "none"
        return reasons
    width, height = camera.size
    inside = (xy >= -0.5).all(axis=1) & (xy[:, 0] <= width - 0.5) & (xy[:, 1] <= height - 0.5)
    reasons[~inside] = "outside"
    direction = _directions(camera, xy, np.full(len(xy), height_range[0]))
    reasons[inside & np.isnan(direction[:, 2])] = "no ray"
    reasons[inside & (direction[:, 2] >= 0)] = "up"
    # A camera below a bridge is not below the ground.
    vantage = camera.vantage
    if vantage.central and float(without_objects(terrain).heights(vantage.point[:2])) > vantage.point[2]:
        reasons[:] = "below"
    return reasons


def _directions(camera: Camera, xy: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions of the rays near some heights, (n, 3)."""
    if not np.isfinite(heights).any():
        return np.full((len(xy), 3), np.nan)
    return camera.rays(xy, float(np.nanmean(heights)))[1]


def _slope(terrain: Terrain, XY: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """∂h/∂X, ∂h/∂Y at map points (n, 2); one-sided beside holes, level where nothing is known around."""
    here = terrain.heights(XY)
    slope = np.empty_like(XY)
    for k in range(2):
        step = np.zeros(2)
        step[k] = reach
        up, down = terrain.heights(XY + step), terrain.heights(XY - step)
        both = (up - down) / (2 * reach)
        one = np.where(np.isfinite(up), up - here, here - down) / reach
        slope[:, k] = np.where(np.isfinite(both), both, np.where(np.isfinite(one), one, 0.0))
    return slope


def _covariance(
    camera: Camera, XYZ: NDArray[np.float64], slope: NDArray[np.float64], errors: MonoplotErrors
) -> NDArray[np.float64]:
    """Covariance matrices (n, 3, 3) of ground points."""
    out = np.full((len(XYZ), 3, 3), np.nan)
    if errors.terrain is None:
        return out
    there = np.isfinite(XYZ[:, 0])
    P, n = XYZ[there], int(there.sum())
    A = camera.derivatives(P)
    # A camera that moves by t and turns by ε about its centre shows P where it would have shown P − t − ε × (P − C).
    r = P - camera.vantage.point
    axes = np.eye(3) if errors.axes is None else errors.axes
    turned = np.stack([np.cross(axis, r) for axis in axes], axis=-1)
    motion = np.concatenate([A, A @ turned], axis=2)
    orientation = (motion * np.square([*errors.position, *errors.angles])) @ motion.transpose(0, 2, 1)
    inner = np.zeros((n, 3, 3))
    inner[:, :2, :2] = orientation + errors.image**2 * np.eye(2)
    heights = errors.terrain(P[:, :2]) if callable(errors.terrain) else errors.terrain
    inner[:, 2, 2] = np.square(heights)
    M = np.zeros((n, 3, 3))
    M[:, :2], M[:, 2, :2], M[:, 2, 2] = A, -slope[there], 1.0
    regular = np.abs(np.linalg.det(M)) > 1e-12
    inverse = np.full_like(M, np.nan)
    inverse[regular] = np.linalg.inv(M[regular])
    out[there] = inverse @ inner @ inverse.transpose(0, 2, 1)
    return out


def _holes(
    camera: Camera, xy: NDArray[np.float64], XYZ: NDArray[np.float64], terrain: Terrain, high: float
) -> NDArray[np.bool_]:
    """Return whether rays cross places without terrain between the highest terrain and the point."""
    crossed = np.zeros(len(xy), bool)
    there = np.flatnonzero(np.isfinite(XYZ[:, 0]))
    if not len(there):
        return crossed
    top = min(high, float(camera.vantage.point[2]))
    origin, direction = camera.rays(xy[there], top)
    t = (top - origin[:, 2]) / direction[:, 2]
    start = origin + t[:, None] * direction
    for part in np.linspace(0, 1, HOLE_STEPS, endpoint=False):
        place = start + part * (XYZ[there] - start)
        crossed[there] |= np.isnan(terrain.heights(place[:, :2]))
    return crossed
