"""Where the ground can be seen from a camera at all: what keeps a small image off a large terrain model."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import CentralCamera
from photoplan.plan.coverage import image_border
from photoplan.surfaces.base import Surface

Bounds = tuple[float, float, float, float]

#: Terrain further from the projection centre than this is not looked at, metres.
FAR = 30_000.0
#: Rays are followed sideways for this many heights above the lowest ground (87° from the nadir).
_FLATTEST = 20.0
#: Side of the pieces in which a large part of the terrain is looked through, metres: only one is in memory.
_PIECE = 500.0
#: Points per side of the lattice that is asked for a first height where there is no ground below the camera.
_LATTICE = 9
_ROUNDS = 12


def reach(camera: CentralCamera, surface: Surface, bounds: Bounds | None) -> Bounds:
    """Map bounds outside of which nothing of the surface can fall into the image.

    Rays of the image's border are cut with two levels; between them they stay inside the bounds of these points. If
    the ground inside the bounds does not leave the two levels, no ray can have met ground elsewhere; otherwise the
    levels are moved apart. So terrain far from the footprint is never read.

    Parameters
    ----------
    camera : CentralCamera
    surface : Surface
    bounds : (float, float, float, float) or None
        Outer edges of the surface; None: it is everywhere.

    Returns
    -------
    (float, float, float, float)
        Inside `bounds`; a square metre of it if nothing can be seen.
    """
    x, y, z = camera.center
    near = (x - FAR, y - FAR, x + FAR, y + FAR)
    if bounds is not None:
        near = _common(near, bounds)
    if not _holds(near):
        return _corner(bounds or near, x, y)
    low = high = some_height(surface, near, x, y)
    if not np.isfinite(low):
        low, high = _height_range(surface, near)
    for _ in range(_ROUNDS):
        if not low < z:
            low, high = _height_range(surface, near)
            if not low < z:
                return _corner(near, x, y)
        cut = _common(near, _between(camera, low, high))
        if not _holds(cut):
            return _corner(near, x, y)
        found = _height_range(surface, cut)
        if not np.isfinite(found[0]):
            # There is a hole where the rays come down: what lies below these levels decides.
            found = _height_range(surface, near)
            if not np.isfinite(found[0]):
                return _corner(near, x, y)
        if low <= found[0] and found[1] <= high:
            return cut
        # A little more than was found, so that slopes do not take many rounds.
        low, high = min(low, found[0]) - 0.02 * abs(z - found[0]), max(high, found[1])
    return near


def _between(camera: CentralCamera, low: float, high: float) -> Bounds:
    """Bounds of all points that rays of the image pass between two levels."""
    x, y, z = camera.center
    xy = np.concatenate([image_border(camera.size), [[(s - 1) / 2 for s in camera.size]]])
    far = _FLATTEST * (z - low)
    offsets = [_feet(camera, xy, low)]
    offsets.append(_feet(camera, xy, high) if high < z else np.zeros((1, 2)))
    out = np.clip(np.concatenate(offsets), -far, far)
    margin = 0.05 * float(np.ptp(out, axis=0).max())
    low_xy, high_xy = out.min(axis=0) - margin, out.max(axis=0) + margin
    return (x + low_xy[0], y + low_xy[1], x + high_xy[0], y + high_xy[1])


def _feet(camera: CentralCamera, xy: NDArray[np.float64], level: float) -> NDArray[np.float64]:
    """Where rays meet a level, X and Y from the projection centre (n, 2); infinite for those that do not go down."""
    origin, direction = camera.rays(xy, level)
    with np.errstate(divide="ignore", invalid="ignore"):
        foot = origin[:, :2] + direction[:, :2] * ((level - origin[:, 2]) / direction[:, 2])[:, None]
        out = np.where(direction[:, 2:] < 0, foot - camera.center[:2], direction[:, :2] * np.inf)
    return np.nan_to_num(out, nan=0.0, posinf=np.inf, neginf=-np.inf)


def some_height(surface: Surface, near: Bounds, x: float, y: float) -> float:
    """Height at a point, or else in the middle of what some points inside `near` have; NaN if all of them have none."""
    below = float(surface.heights(np.array([x, y])))
    if np.isfinite(below):
        return below
    part = (np.arange(_LATTICE) + 0.5) / _LATTICE
    X, Y = near[0] + part * (near[2] - near[0]), near[1] + part * (near[3] - near[1])
    # One at a time: a surface may read all that lies between the points of one question.
    some = [float(surface.heights(np.array([u, v]))) for u in X for v in Y]
    return float(np.nanmedian(some)) if np.isfinite(some).any() else math.nan


def _height_range(surface: Surface, bounds: Bounds) -> tuple[float, float]:
    """Lowest and highest ground, looked through in pieces; NaN, NaN where there is none."""
    columns, rows = (max(1, math.ceil((bounds[i + 2] - bounds[i]) / _PIECE)) for i in (0, 1))
    u, v = np.linspace(bounds[0], bounds[2], columns + 1), np.linspace(bounds[1], bounds[3], rows + 1)
    low, high = math.inf, -math.inf
    for j in range(rows):
        for i in range(columns):
            piece = surface.height_range((float(u[i]), float(v[j]), float(u[i + 1]), float(v[j + 1])))
            if np.isfinite(piece[0]):
                low, high = min(low, piece[0]), max(high, piece[1])
    return (low, high) if low <= high else (math.nan, math.nan)


def _common(a: Bounds, b: Bounds) -> Bounds:
    return (max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3]))


def _holds(bounds: Bounds) -> bool:
    return bounds[0] < bounds[2] and bounds[1] < bounds[3]


def _corner(bounds: Bounds, x: float, y: float) -> Bounds:
    """The square metre of some bounds that is nearest to a point."""
    left, bottom = min(max(x, bounds[0]), bounds[2]), min(max(y, bounds[1]), bounds[3])
    left, bottom = min(left, bounds[2] - 1), min(bottom, bounds[3] - 1)
    return (left, bottom, left + 1, bottom + 1)
