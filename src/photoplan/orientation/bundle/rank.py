"""Do the observations determine the unknowns? If not: which unknowns, by name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import identity
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh, splu

from photoplan.errors import GeometryError
from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.normal import Reduced
from photoplan.orientation.bundle.unknowns import State

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
    names = _datum(model, state, directions, reduced.scale)
    names = names or [model.columns.spelled(d, reduced.scale) for d in vectors[:, null].T]
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


def _datum(model: Model, state: State, directions: _Floats, reduced_scale: _Floats) -> list[str]:
    """Names of the block's motions among the undetermined directions; empty if there are others."""
    size, motions = state.images.motions()
    images = model.columns.kinds[0].part
    unit = np.array([size] * 3 + [1.0] * 3)
    basis, _ = np.linalg.qr(directions[images] / np.tile(unit, len(state.images.centers))[:, None])
    # A direction in which a camera, a lever arm or a drift changes too is no motion of the block.
    if np.abs(directions[images.stop :] / reduced_scale[images.stop :, None]).max(initial=0.0) > 0.01:
        return []
    named = []
    for name, motion in motions.items():
        v = (motion / unit).ravel()
        length = np.linalg.norm(v)
        if length > 0 and np.linalg.norm(basis.T @ v) > 0.98 * length:
            named.append(name)
    return named if len(named) >= directions.shape[1] else []
