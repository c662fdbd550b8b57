"""What the control points of one image do not determine, by name and number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import GeometryError
from photoplan.geometry.pose import UNKNOWNS

Array = NDArray[np.float64]

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
    """Inverse normal equations of whitened equations (m, u) in natural units.

    Raises
    ------
    GeometryError
        A combination of unknowns is not determined: control on a line, cameras on the dangerous cylinder through three
        points, flat terrain with free camera constant. The message spells it.
    """
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
    said = [_change(names[k], float(step[k] * unknowns.units[k]), k, len(unknowns.free)) for k in parts]
    moved = float(np.linalg.norm(step)) * singular * unknowns.sigma
    together = f"{' and '.join(names[k] for k in parts)}" + (" apart" if len(parts) > 1 else "")
    way = "hold a parameter fixed or " if unknowns.free else ""
    return (
        f"{together}: {', '.join(said)} alter{'s' * (len(said) == 1)} all image points together by {moved:.2g} px; "
        f"{way}use control points that are spread over the image and differ in height"
    )


def _change(name: str, value: float, k: int, free: int) -> str:
    if k < 3:
        return f"{name} {value:+.4g} m"
    if k < 6:
        return f"{name} {np.degrees(value):+.3g}°"
    return f"{name} {value:+.4g}"
