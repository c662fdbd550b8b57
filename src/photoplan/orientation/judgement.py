"""Judgement of a computed orientation: whether it can be right, and which other reading of its measurements would be.

Least squares finds a pose for mirrored, exchanged and wrongly scaled coordinates as well: it lies under the ground and
looks up, throws much of the control out, or misses it by many times what was stated. Whatever writes an orientation
asks here first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import PhotoplanError
from photoplan.orientation.resection import MeasuredPoints, Resected

_Floats = NDArray[np.float64]

#: Height below ground that no error of the ground explains, as part of the distance to it, and metres: a vault is seen
#: from below, a landscape is not.
_BELOW, _LEAST = 0.05, 30.0
#: Height systems may differ by so many metres where terrain and control are compared.
_SYSTEMS = 110.0
#: Part of the points that may be wrong, of at least so many.
_WRONG, _ENOUGH = 0.35, 6
#: sigma0 against what was stated, together with residuals in pixels, that no one means.
_SIGMA0, _PIXELS = 20.0, 10.0
#: sigma0 of a reading that fits, and part of the residuals of the reading as given that it may leave.
_FITS, _FIFTH = 3.0, 0.2
#: An international foot, metres.
FOOT = 0.3048


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of an orientation that was computed."""

    center: _Floats
    """(3,), metres."""
    R_ground_camera: _Floats
    ground: _Floats
    """Ground points that it was computed from, (n, 3)."""
    rejected: int
    """How many points were taken out."""
    points: int
    """Of how many."""
    sigma0: float
    """In units of what was stated; NaN: not known."""
    rms: float
    """Of the residuals, pixels; NaN: not known."""
    terrain: float = float("nan")
    """Height of the terrain below the station, metres; NaN: not known."""


def impossible(found: Evidence) -> str | None:
    """Why an orientation cannot be right, as a clause; None if it can."""
    below = _height_of_ground(found) - found.center[2]
    away = float(np.linalg.norm(found.ground - found.center, axis=1).mean()) if len(found.ground) else np.nan
    up = -found.R_ground_camera[2, 2] > 0
    if up and below > max(_LEAST, _BELOW * away):
        return f"the camera lies {below:.0f} m below its ground points and looks up: the solution is mirrored"
    if found.terrain - found.center[2] > _SYSTEMS:
        return f"the camera lies {found.terrain - found.center[2]:.0f} m below the terrain"
    return misfit(found.rejected, found.points, found.sigma0, found.rms)


def misfit(rejected: int, points: int, sigma0: float, rms: float) -> str | None:
    """Why measurements do not fit what was made of them (see `Evidence`), as a clause; None if they do."""
    if points >= _ENOUGH and rejected > _WRONG * points:
        return f"{rejected} of {points} points do not fit it"
    if sigma0 > _SIGMA0 and rms > _PIXELS:
        return f"residuals of {rms:.0f} px are {sigma0:.0f} times what was stated"
    return None


def of_resection(points: MeasuredPoints, found: Resected, terrain: float = float("nan")) -> Evidence:
    """Evidence of a single image."""
    return Evidence(
        center=found.pose.center,
        R_ground_camera=found.pose.R_ground_camera,
        ground=points.XYZ,
        rejected=int(found.rejected.sum()),
        points=len(points),
        sigma0=found.sigma0,
        rms=found.rms,
        terrain=terrain,
    )


def fitting(points: MeasuredPoints, height: int, resect: Callable[[MeasuredPoints], Resected], rms: float) -> str:
    """What the measurements of an image, read otherwise, would fit; as a sentence."""
    fits = []
    for what, other in other_points(points, height):
        try:
            tried = resect(other)
        except PhotoplanError:
            continue
        few = tried.rejected.sum() <= 0.2 * len(points) and tried.redundancy > 0
        close = tried.sigma0 < _FITS or tried.rms < _FIFTH * rms
        if few and close and impossible(of_resection(other, tried)) is None:
            used = int((~tried.rejected).sum())
            fits.append(f"with {what}, {used} of {len(points)} points fit to {tried.rms:.2f} px")
    return "; ".join(fits) or (
        "no exchange of axes, no other direction of y or Z and no other unit of heights fits either; check the names "
        "of points, the camera constant and the CRS"
    )


def _height_of_ground(found: Evidence) -> float:
    """Height of the ground points' plane at the station; NaN where they stand upright, as those of a facade do."""
    X = found.ground
    if len(X) < 3:
        return float("nan")
    middle = X.mean(axis=0)
    _, s, Vt = np.linalg.svd(X - middle)
    normal = Vt[2]
    if abs(normal[2]) < 0.7 or s[1] < 1e-9 * s[0]:
        return float("nan")
    return float(middle[2] - (normal[:2] @ (found.center[:2] - middle[:2])) / normal[2])


def other_points(points: MeasuredPoints, height: int) -> Iterator[tuple[str, MeasuredPoints]]:
    """The same measurements as they may have been meant, with words for it; `height` of the image in pixels."""
    xy, XYZ, Q = points.xy, points.XYZ, points.covariance
    swap = [1, 0, 2]
    yield "X and Y of control exchanged", replace(points, XYZ=XYZ[:, swap], covariance=Q[:, swap][:, :, swap])
    up = np.column_stack([xy[:, 0], height - 1 - xy[:, 1]])
    yield "y of image points upwards", replace(points, xy=up)
    yield "column and row of image points exchanged", replace(points, xy=xy[:, ::-1], sigma=points.sigma[:, ::-1])
    for what, scale in (
        ("heights of control in feet", [1.0, 1.0, FOOT]),
        ("heights of control in metres, X and Y in feet", [FOOT, FOOT, 1.0]),
        ("heights of control in millimetres", [1.0, 1.0, 1e-3]),
        ("Z of control counted downwards, or away from the camera", [1.0, 1.0, -1.0]),
    ):
        yield what, replace(points, XYZ=XYZ * scale)
