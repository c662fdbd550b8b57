"""How a block moves as a whole: what directions of its unknowns do to the points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.rows import Rows
from photoplan.orientation.bundle.unknowns import State

_Floats = NDArray[np.float64]
#: Part of what is known of a direction that comes from corrections being known beforehand, from which on it is all.
_PRIOR = 0.9
#: Part of a motion that has to lie in the directions.
_WHOLE = 0.95
#: More unknowns than this are not looked through.
_MANY = 600


class OfPoints(NamedTuple):
    """What takes steps of the other unknowns to those of the points."""

    V_inverse: _Floats
    """Inverse normal matrices of the points, (m, 3, 3)."""
    N_pg: sparse.csr_matrix
    """Their normal matrix with the other unknowns, (3m, n)."""


def by_prior(model: Model, state: State, rows: Rows, points: OfPoints) -> tuple[str, ...]:
    """Motions of the block of which only what corrections are known to beforehand says anything."""
    count = model.columns.count
    if not model.sets or not 0 < count <= _MANY:
        return ()
    known = rows.A_global[model.parts.smooth]
    K = (known.T @ known).toarray()
    V_inverse, N_pg = points
    m = len(V_inverse)
    blocks = sparse.bsr_matrix((V_inverse, np.arange(m), np.arange(m + 1)), (3 * m, 3 * m))
    N = (rows.A_global.T @ rows.A_global - N_pg.T @ (blocks @ N_pg)).toarray()
    scale = 1.0 / np.sqrt(np.diag(N))
    values, vectors = linalg.eigh(K * np.outer(scale, scale), N * np.outer(scale, scale))
    return motions_of_points(state, points, vectors[:, values > _PRIOR] * scale[:, None])


def motions_of_points(state: State, points: OfPoints, directions: _Floats) -> tuple[str, ...]:
    """Motions of all points as one (shifts, turns, scale) that lie in directions (n, q) of the other unknowns."""
    V_inverse, N_pg = points
    if not directions.shape[1] or len(V_inverse) < 3:
        return ()
    moved = -np.einsum("mij,mjq->miq", V_inverse, (N_pg @ directions).reshape(len(V_inverse), 3, -1))
    steps = moved.reshape(3 * len(V_inverse), -1)
    length = np.linalg.norm(steps, axis=0)
    U, s, _ = np.linalg.svd(steps / np.where(length > 0, length, 1.0), full_matrices=False)
    basis = U[:, s > 1e-6 * max(float(s[0]), 1e-300)]
    away = state.XYZ - state.XYZ.mean(axis=0)
    motions = {}
    for along, axis in zip(np.eye(3), "XYZ"):
        motions[f"position of the block in {axis}"] = np.tile(along, (len(away), 1))
        motions[f"rotation of the block about {axis}"] = np.cross(along, away)
    motions["scale of the block"] = away
    found = []
    for name, motion in motions.items():
        g = motion.ravel() / max(float(np.linalg.norm(motion)), 1e-300)
        if np.linalg.norm(basis.T @ g) > _WHOLE:
            found.append(name)
    return tuple(found)
