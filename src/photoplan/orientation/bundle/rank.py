"""Do the observations determine the unknowns? If not: which unknowns, by name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import identity
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh, splu

from photoplan.errors import GeometryError
from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.normal import Reduced
from photoplan.orientation.bundle.state import State

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
    names = names or [_spelled(model, d, reduced.scale) for d in vectors[:, null].T]
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
    # A direction in which a camera, a lever arm or a drift changes too is no motion of the block.
    if np.abs(directions[6 * n :] / reduced_scale[6 * n :, None]).max(initial=0.0) > 0.01:
        return []
    named = []
    for name, motion in motions.items():
        v = (motion / ([size] * 3 + [1.0] * 3)).ravel()
        length = np.linalg.norm(v)
        if length > 0 and np.linalg.norm(basis.T @ v) > 0.98 * length:
            named.append(name)
    return named if len(named) >= directions.shape[1] else []


def _spelled(model: Model, direction: _Floats, scale: _Floats) -> str:
    """The unknowns with a part in a direction of scaled unknowns; those of images by their kind."""
    images = model.columns.images
    share = direction**2
    of_images = share[: 6 * images].reshape(images, 6)
    parts: list[tuple[float, str]] = []
    for k, kind in enumerate(("X0", "Y0", "Z0", "rotation about x", "rotation about y", "rotation about z")):
        total = float(of_images[:, k].sum())
        if total > 0.02:
            parts.append((total, f"{kind} of {_images(model, of_images[:, k])}"))
    # Few against many: a camera's share is small, but it is the point.
    for column in np.flatnonzero(share[6 * images :] > 1e-6) + 6 * images:
        parts.append((1.0, f"{_name(model, int(column))} ({direction[column] * scale[column]:+.2g})"))
    return " with ".join(text for _, text in sorted(parts, key=lambda p: -p[0]))


def _images(model: Model, share: _Floats) -> str:
    """The images with a large share, by name where they are few."""
    large = np.flatnonzero(share > 0.1 * share.max())
    names = ", ".join(repr(model.image_names[k]) for k in large[:3])
    return f"image{'s' if len(large) > 1 else ''} {names}" + (f" and {len(large) - 3} more" if len(large) > 3 else "")


def _name(model: Model, column: int) -> str:
    """Name of an unknown that is not an image's."""
    columns = model.columns
    for name, first in columns.cameras.items():
        free = model.block.cameras[name].free
        if first <= column < first + len(free):
            return f"{free[column - first]} of camera {name!r}"
    if 0 <= columns.lever <= column < columns.lever + 3:
        return f"lever arm {'xyz'[column - columns.lever]}"
    if 0 <= columns.boresight <= column < columns.boresight + 3:
        return f"boresight about {'xyz'[column - columns.boresight]}"
    name, first = next((n, f) for n, f in columns.strips.items() if f <= column < f + 6)
    return f"drift of strip {name!r} in {'XYZ'[(column - first) % 3]}"
