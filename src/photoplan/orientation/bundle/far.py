"""Points whose distance their rays hardly tell, or not at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.normal import reduce_normals
from photoplan.orientation.bundle.rows import Rows
from photoplan.orientation.bundle.unknowns import State

_Floats = NDArray[np.float64]

#: Standard deviation of a point along its rays, as part of its distance, above which the rays count as parallel.
PARALLEL = 0.25
#: Part of its longest ray below which another ray of a point is too short: the point has come into that projection
#: centre, where it is on the image's ray whatever was measured.
INSIDE = 1e-3
#: By how much a step may stretch the distance of a point at most.
_STRETCH = 100.0


def loose_points(model: Model, state: State, rows: Rows) -> frozenset[str]:
    """Points whose distance their rays do not tell, by name; control that holds a point counts as well.

    Rays are parallel within their accuracy; or they have brought the point into a projection centre.
    """
    inverse = reduce_normals(rows, len(model.point_names)).V_inverse
    away = np.linalg.norm(state.XYZ - _middles(model, state), axis=1)
    rays = np.bincount(model.point, minlength=len(away))
    far = (np.linalg.eigvalsh(inverse)[:, 2] > (PARALLEL * away) ** 2) & (rays >= 2)
    length = np.linalg.norm(state.XYZ[model.point] - model.origins(state.images.centers), axis=1)
    longest = np.zeros(len(away))
    np.maximum.at(longest, model.point, length)
    far[model.point[length < INSIDE * longest[model.point]]] = True
    return frozenset(model.point_names[k] for k in np.flatnonzero(far))


def along_rays(model: Model, state: State, step: _Floats) -> _Floats:
    """Steps of points (m, 3) as steps of direction and inverse distance, in which image points are nearly linear.

    Small steps stay what they are. A point that has to go far away gets there in a few steps instead of by doubling its
    distance, and none passes through its cameras (Civera, Davison and Montiel 2008, IEEE Trans. Robotics 24).
    """
    at = state.XYZ - _middles(model, state)
    distance = np.linalg.norm(at, axis=1, keepdims=True)
    distance[distance == 0.0] = 1.0
    u = at / distance
    along = (u * step).sum(axis=1, keepdims=True)
    stretch = 1.0 / np.maximum(1.0 - along / distance, 1.0 / _STRETCH)
    across = step - u * along
    return np.asarray(stretch * (at + across) - at)


def _middles(model: Model, state: State) -> _Floats:
    """Middle of the cameras that see each point, (m, 3)."""
    m = len(state.XYZ)
    rays = np.maximum(np.bincount(model.point, minlength=m), 1)
    centers = model.origins(state.images.centers)
    return np.stack([np.bincount(model.point, centers[:, k], m) / rays for k in range(3)], axis=-1)
