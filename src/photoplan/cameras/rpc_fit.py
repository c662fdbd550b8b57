"""Rational polynomials that stand for another camera: fitted by least squares, with what they leave of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera, project
from photoplan.cameras.rpc import BOUND, RationalFunctions, terms
from photoplan.errors import GeometryError
from photoplan.geometry.crs import nearest_turn
from photoplan.geometry.geodetic import GeodeticGround

#: Rounds of the weighting by the denominator; it stands still after three.
_ROUNDS = 6
#: Singular values below this part of the largest tell nothing: several quotients are then the same function. What
#: rounding leaves of them may put a pole into the volume; then the next is tried, which takes one with less of them.
_RANKS = (1e-13, 1e-11, 1e-9)
#: A denominator is to stay above this part of its value in the middle, as far out as polynomials are followed.
_POLE = 0.05
#: Image points along a side and heights at which a camera is fitted, and those between them at which it is checked.
_FIT, _CHECK = (21, 9), (18, 7)


@dataclass(frozen=True, eq=False)
class FittedRpc:
    """Rational polynomials, and how well they stand for the camera at places between those of the fit."""

    functions: RationalFunctions
    rms: tuple[float, float]
    """Of column and row, pixels."""
    worst: float
    """Largest distance, pixels."""


def fitted_functions(geodetic: ArrayLike, xy: ArrayLike) -> RationalFunctions:
    """Rational polynomials through points.

    The equation v · den(n) = num(n) is linear in the coefficients; divided by the denominator of the round before its
    residuals are those in the image (Tao & Hu 2001, eq. 12–16).
    """
    ground, image = (np.array(values, float) for values in (geodetic, xy))
    if len(ground):
        ground[:, 0] = nearest_turn(ground[:, 0], ground[0, 0], 360.0)
    low, high = (f(np.concatenate([image, ground], axis=1), axis=0) for f in (np.min, np.max))
    offset, scale = (low + high) / 2, (high - low) / 2
    if len(ground) < 39 or not (np.isfinite(scale).all() and (scale > 0).all()):
        raise GeometryError(
            f"{len(ground)} points with extents {', '.join(f'{2 * s:.3g}' for s in scale)} (column, row, longitude, "
            "latitude, height); polynomials need 39 and more that are spread over a volume"
        )
    normalised = (ground - offset[2:]) / scale[2:]
    T, beyond = terms(normalised), terms(BOUND * normalised)
    quotients = [_without_pole(T, beyond, v) for v in ((image - offset[:2]) / scale[:2]).T]
    return RationalFunctions(
        image_offset=(float(offset[0]), float(offset[1])),
        image_scale=(float(scale[0]), float(scale[1])),
        ground_offset=(float(nearest_turn(offset[2], 0.0, 360.0)), float(offset[3]), float(offset[4])),
        ground_scale=(float(scale[2]), float(scale[3]), float(scale[4])),
        coefficients=np.concatenate(quotients),
    )


def fit_rpc(camera: Camera, ground: GeodeticGround, heights: tuple[float, float]) -> FittedRpc:
    """Rational polynomials for all that a camera sees between two heights of the ground."""
    XYZ = _seen(camera, heights, _FIT)
    functions = fitted_functions(ground(XYZ), project(camera, XYZ))
    between = _seen(camera, heights, _CHECK)
    miss = functions(ground(between)) - project(camera, between)
    if not np.isfinite(miss).all():
        raise GeometryError("polynomials that follow it have a pole in the image; there are none to write")
    rms = np.sqrt((miss**2).mean(axis=0))
    return FittedRpc(functions, (float(rms[0]), float(rms[1])), float(np.hypot(*miss.T).max()))


def _seen(camera: Camera, heights: tuple[float, float], count: tuple[int, int]) -> NDArray[np.float64]:
    """Ground points (n, 3) of a regular grid of image points at regular heights."""
    part = np.linspace(0.0, 1.0, count[0])
    xy = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) * camera.size - 0.5
    planes = []
    for level in np.linspace(*heights, count[1]):
        origin, direction = camera.rays(xy, float(level))
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (level - origin[:, 2]) / direction[:, 2]
        points = origin + along[:, None] * direction
        if not (np.isfinite(points).all() and (along >= 0).all()):
            raise GeometryError(
                f"not all of the image looks down to the height {level:.0f} m; polynomials are for images that do"
            )
        planes.append(points)
    return np.concatenate(planes)


def _without_pole(T: NDArray[np.float64], beyond: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """The quotient of most terms whose denominator does not vanish; the last where all do."""
    for rank in _RANKS:
        found = _quotient(T, v, rank)
        if min((T @ found[1]).min(), (beyond @ found[1]).min()) > _POLE:
            break
    return found


def _quotient(T: NDArray[np.float64], v: NDArray[np.float64], rank: float) -> NDArray[np.float64]:
    """Numerator and denominator (2, 20), the first coefficient of which is 1, with v ≈ (T num) / (T den)."""
    weight: NDArray[np.float64] = np.ones(len(v))
    solution: NDArray[np.float64] = np.zeros(39)
    for _ in range(_ROUNDS):
        A = np.concatenate([T, -v[:, None] * T[:, 1:]], axis=1) * weight[:, None]
        solution = np.asarray(np.linalg.lstsq(A, v * weight, rcond=rank)[0], np.float64)
        weight = np.asarray(1.0 / (1.0 + T[:, 1:] @ solution[20:]), np.float64)
    return np.stack([solution[:20], np.concatenate([[1.0], solution[20:]])])
