"""Do the observations determine the unknowns? If not: which unknowns, by name."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import identity
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh, splu

from photoplan.errors import GeometryError
from photoplan.orientation.bundle_model import Model
from photoplan.orientation.bundle_normal import Reduced
from photoplan.orientation.bundle_state import State

__all__ = ["SINGULAR", "check_rank"]

_Floats = NDArray[np.float64]

#: Eigenvalues of the normal equations, scaled to a unit diagonal, below which their direction is not determined.
SINGULAR = 1e-11
#: Smallest eigenvalues that are looked at: a block without datum has seven that vanish.
_COUNT = 12


def check_rank(model: Model, state: State, reduced: Reduced) -> None:
    """Refuse equations that leave unknowns undetermined.

    Raises
    ------
    GeometryError
        The message names the combinations of unknowns that nothing determines.
    """
    values, vectors = _smallest(reduced)
    null = values < SINGULAR
    if not null.any():
        return
    # Back from scaled unknowns to metres, radians and the cameras' units.
    directions = vectors[:, null] * reduced.scale[:, None]
    names = _datum(model, state, directions) or [_spelled(model, d, reduced.scale) for d in vectors[:, null].T]
    raise GeometryError(
        f"the observations leave {int(null.sum())} direction{'s' if null.sum() > 1 else ''} of the unknowns free: "
        + "; ".join(dict.fromkeys(names))
        + ". Give control points or observed positions that fix them, or fewer free parameters"
    )


def _smallest(reduced: Reduced) -> tuple[_Floats, _Floats]:
    """Smallest eigenvalues of the scaled normal equations, with their vectors."""
    n = reduced.S.shape[0]
    if n <= 400:
        values, vectors = np.linalg.eigh(reduced.S.toarray())
        return values[:_COUNT], vectors[:, :_COUNT]
    shift = 1e-10
    factor = splu((reduced.S + shift * identity(n)).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0)
    solve = LinearOperator((n, n), matvec=factor.solve, dtype=float)
    start = np.random.default_rng(0).normal(size=n)
    try:
        values, vectors = eigsh(reduced.S, k=_COUNT, sigma=-shift, OPinv=solve, which="LM", v0=start, tol=1e-4)
    except ArpackError:
        return np.ones(1), np.zeros((n, 1))
    return values, vectors


def _datum(model: Model, state: State, directions: _Floats) -> list[str]:
    """Names of the block's motions among the undetermined directions; empty if there are others."""
    n = model.columns.images
    middle = state.centers.mean(axis=0)
    away = state.centers - middle
    size = max(1.0, float(np.abs(away).max()))
    motions: dict[str, _Floats] = {}
    for k, axis in enumerate("XYZ"):
        move = np.zeros((n, 6))
        move[:, k] = size
        motions[f"position of the block in {axis}"] = move
        turn = np.zeros((n, 6))
        about = np.eye(3)[k]
        turn[:, :3] = np.cross(about, away)
        turn[:, 3:] = about @ state.rotations
        motions[f"rotation of the block about {axis}"] = turn
    grow = np.zeros((n, 6))
    grow[:, :3] = away
    motions["scale of the block"] = grow
    part = directions[: 6 * n] / np.tile([size] * 3 + [1.0] * 3, n)[:, None]
    basis, _ = np.linalg.qr(part)
    named = []
    for name, motion in motions.items():
        v = (motion / ([size] * 3 + [1.0] * 3)).ravel()
        length = np.linalg.norm(v)
        if length > 0 and np.linalg.norm(basis.T @ v) > 0.98 * length:
            named.append(name)
    return named if len(named) >= directions.shape[1] else []


def _spelled(model: Model, direction: _Floats, scale: _Floats) -> str:
    """The unknowns with the largest part in a direction of scaled unknowns."""
    share = direction**2
    order = np.argsort(-share)[:6]
    wanted = [int(k) for k in order if share[k] > 0.05 * share[order[0]]]
    step = direction * scale
    return " with ".join(f"{_name(model, k)} ({step[k]:+.2g})" for k in wanted)


def _name(model: Model, column: int) -> str:
    columns = model.columns
    if column < 6 * columns.images:
        what = ("X0", "Y0", "Z0", "rotation about x", "rotation about y", "rotation about z")[column % 6]
        return f"{what} of image {model.image_names[column // 6]!r}"
    for name, first in columns.cameras.items():
        free = model.block.cameras[name].free
        if first <= column < first + len(free):
            return f"{free[column - first]} of camera {name!r}"
    if 0 <= columns.lever <= column < columns.lever + 3:
        return f"lever arm {'xyz'[column - columns.lever]}"
    if 0 <= columns.boresight <= column < columns.boresight + 3:
        return f"boresight about {'xyz'[column - columns.boresight]}"
    for name, first in columns.strips.items():
        if first <= column < first + 6:
            return f"drift of strip {name!r} in {'XYZ'[(column - first) % 3]}"
    return f"unknown {column}" if math.isfinite(column) else ""
