"""Normal equations of the bundle adjustment: points eliminated, the rest solved by a sparse factorisation.

What they do not determine is found by their smallest eigenvalues and named.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import identity
from scipy.sparse.linalg import ArpackError, LinearOperator, SuperLU, eigsh, splu

from photoplan.errors import DatumDefect, GeometryError
from photoplan.kernels.quadratic_forms import SparseRows, gathered, point_variances, row_variances
from photoplan.kernels.selected_inverse import SelectedInverse, aligned, fill_pattern, selected_inverse
from photoplan.orientation.bundle.datum import OfPoints, motions_of_points
from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.rows import Rows
from photoplan.orientation.bundle.unknowns import IMAGES, State

_Floats = NDArray[np.float64]

#: Part of a point's normal matrix that is added to its diagonal: far below rounding of any point that is determined.
_RIDGE = 1e-13
#: Eigenvalues of the normal equations, scaled to a unit diagonal, below which their direction is not determined.
SINGULAR = 1e-11
#: Smallest eigenvalues that are looked at: a block without datum has seven that vanish.
_COUNT = 12


@dataclass(frozen=True, eq=False)
class Reduced:
    """Reduced normal equations S x = b of all unknowns but points (Schur complement)."""

    rows: Rows
    S: sparse.csc_matrix
    """Scaled to a unit diagonal: S = D N D."""
    scale: _Floats
    """D."""
    b: _Floats
    V_inverse: _Floats
    """(points, 3, 3)."""
    N_pg: sparse.csr_matrix
    n_p: _Floats
    """(points, 3)."""

    @property
    def of_points(self) -> OfPoints:
        """What takes steps of the other unknowns to those of the points."""
        return OfPoints(self.V_inverse, self.N_pg)

    def solved(self, model: Model, state: State) -> tuple[_Floats, _Floats]:
        """As `solve`; what is not determined is named."""
        try:
            return self.solve()
        except GeometryError:
            check_rank(model, state, self)
            raise

    @cached_property
    def factor(self) -> SuperLU:
        """Factorisation without pivoting."""
        try:
            return splu(self.S, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:
            raise GeometryError(
                "the normal equations are singular: the observations do not determine all unknowns"
            ) from None

    def solve(self) -> tuple[_Floats, _Floats]:
        """Step of all unknowns but points, and of the points (m, 3)."""
        x = self.scale * self.factor.solve(self.scale * -self.b)
        back = (-self.n_p - (self.N_pg @ x).reshape(-1, 3))[:, :, None]
        return x, (self.V_inverse @ back)[:, :, 0]


def reduce_normals(rows: Rows, points: int, damping: float = 0.0) -> Reduced:
    """Form the normal equations and eliminate the points."""
    at, P = _on_points(rows)
    V = np.empty((points, 3, 3))
    for k in range(3):
        for n in range(k, 3):
            V[:, k, n] = V[:, n, k] = np.bincount(at, P[:, k] * P[:, n], points)
    e = rows.e[: len(at)]
    n_p = np.stack([np.bincount(at, P[:, k] * e, points) for k in range(3)], axis=-1).astype(float)
    # A point whose measurements have lost their weight (all but one ray, or all) must not make the equations singular:
    # it then stays where it is.
    trace = np.trace(V, axis1=1, axis2=2)[:, None]
    V[:, range(3), range(3)] *= 1.0 + damping
    V[:, range(3), range(3)] += _RIDGE * trace + (trace == 0.0)
    # A point whose measurements have all lost their weight stays where it is.
    with np.errstate(invalid="ignore"):
        V[~(np.linalg.det(V) > 0.0)] = np.eye(3)
    V_inverse = np.asarray(np.linalg.inv(V), np.float64)
    N_gg = (rows.A_global.T @ rows.A_global).tocsc()
    N_pg = (rows.A_points.T @ rows.A_global).tocsr()
    blocks = sparse.bsr_matrix((V_inverse, np.arange(points), np.arange(points + 1)), (3 * points, 3 * points))
    C = (blocks.tocsr() @ N_pg).tocsr()
    S = (N_gg - N_pg.T @ C).tocsc()
    b = rows.A_global.T @ rows.e - C.T @ n_p.ravel()
    diagonal = S.diagonal()
    if damping:
        S = (S + sparse.diags(damping * N_gg.diagonal())).tocsc()
        diagonal = S.diagonal()
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    D = sparse.diags(scale)
    return Reduced(
        rows=rows, S=(D @ S @ D).tocsc(), scale=scale, b=np.asarray(b).ravel(), V_inverse=V_inverse, N_pg=N_pg, n_p=n_p
    )


def _on_points(rows: Rows) -> tuple[NDArray[np.int64], _Floats]:
    """Point and coefficients (…, 3) of the rows that have a point; these come first."""
    count = int((rows.point >= 0).sum())
    return rows.point[:count], rows.A_points.data.reshape(-1, 3)


class Inverse:
    """Selected entries of the inverse of the reduced normal equations (cofactors, sigma0 = 1)."""

    def __init__(self, reduced: Reduced) -> None:
        factor = reduced.factor
        if not np.array_equal(factor.perm_r, factor.perm_c):
            raise GeometryError(
                "the normal equations are not positive definite: the unknowns are not determined. Are start "
                "orientations, positions, image points and control of the same block?"
            )
        order = factor.perm_c.astype(np.int64)
        pattern = _pattern(reduced, order)
        pointer, rows = fill_pattern(pattern.indptr.astype(np.int64), pattern.indices.astype(np.int64))
        L = factor.L.tocsc()
        values = aligned(pointer, rows, L.indptr.astype(np.int64), L.indices.astype(np.int64), L.data)
        diagonal, lower = selected_inverse(pointer, rows, values, factor.U.diagonal())
        self._Q = SelectedInverse(pointer=pointer, rows=rows, diagonal=diagonal, lower=lower, order=order)
        self._reduced = reduced

    def block(self, columns: NDArray[np.int64]) -> _Floats:
        """Cofactors of unknowns that occur together in an equation (or belong to one image), shape (m, m)."""
        scale = self._reduced.scale[columns]
        dense = gathered(self._Q, columns)
        return np.asarray(dense * scale[:, None] * scale[None, :])

    def variances(self) -> tuple[_Floats, _Floats]:
        """Cofactors of all points (m, 3, 3), and a Q aᵀ of all rows: 1 minus it is the redundancy number."""
        rows, reduced = self._reduced.rows, self._reduced
        at, P = _on_points(rows)
        scaled = (rows.A_global @ sparse.diags(reduced.scale)).tocsr()
        A = SparseRows(scaled.indptr.astype(np.int64), scaled.indices.astype(np.int64), scaled.data)
        order = np.argsort(at, kind="stable").astype(np.int64)
        pointer = np.searchsorted(at[order], np.arange(len(reduced.V_inverse) + 1)).astype(np.int64)
        covariance, with_point = point_variances(self._Q, A, P, pointer, order, reduced.V_inverse)
        others = np.arange(len(at), len(rows.e))
        return covariance, np.concatenate([with_point, row_variances(self._Q, A, others)])


def _pattern(reduced: Reduced, order: NDArray[np.int64]) -> sparse.csc_matrix:
    """Strictly lower triangle, in the order of elimination, of everything that can occur in S.

    Entries that happen to cancel belong to the pattern too, so it is made from ones.
    """
    A = reduced.rows.A_global
    ones = sparse.csr_matrix((np.ones(len(A.data)), A.indices, A.indptr), A.shape)
    N = reduced.N_pg
    points = sparse.csr_matrix((np.ones(len(N.data)), N.indices, N.indptr), N.shape)
    pattern = (ones.T @ ones + points.T @ points).tocoo()
    row, column = order[pattern.row], order[pattern.col]
    lower = row > column
    shape = pattern.shape
    out = sparse.csc_matrix((np.ones(int(lower.sum())), (row[lower], column[lower])), shape)
    out.sort_indices()
    return out


def check_rank(model: Model, state: State, reduced: Reduced) -> None:
    """Refuse equations that leave unknowns undetermined."""
    wrong = ~np.isfinite(np.asarray(reduced.S.sum(axis=1)).ravel())
    if wrong.any():
        owners = dict.fromkeys(
            kind.owners[k]
            for kind in model.columns.kinds
            if kind.width
            for k in np.flatnonzero(wrong[kind.part].reshape(-1, kind.width).any(axis=1))
        )
        shown = ", ".join(map(repr, list(owners)[:3])) + (f" and {len(owners) - 3} more" if len(owners) > 3 else "")
        raise GeometryError(
            f"the equations of {shown} are no numbers any more: an image point or an orientation there is so far off "
            "that the iterations left the block; look for it among what was changed last, or leave the image out"
        )
    values, vectors = _smallest(reduced)
    null = values < SINGULAR
    if not null.any():
        return
    # Back from scaled unknowns to metres, radians and the cameras' units.
    directions = vectors[:, null] * reduced.scale[:, None]
    names = _datum(model, state, directions, reduced.scale)
    names = names or _one_motion(model, state, directions)
    names = names or list(motions_of_points(state, reduced.of_points, directions) if model.projections else ())
    error = DatumDefect if names else GeometryError
    names = names or [model.columns.spelled(d, reduced.scale) for d in vectors[:, null].T]
    raise error(
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
    kind = model.columns.get(IMAGES)
    if kind is None:
        return []
    images = kind.part
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


def _one_motion(model: Model, state: State, directions: _Floats) -> list[str]:
    """A turn of the whole block about a line, where the one undetermined direction is that; otherwise empty."""
    kind = model.columns.get(IMAGES)
    if directions.shape[1] != 1 or kind is None:
        return []
    size, motions = state.images.motions()
    images, unit = kind.part, np.array([size] * 3 + [1.0] * 3)
    v = (directions[images, 0].reshape(-1, 6) / unit).ravel()
    A = np.column_stack([(motion / unit).ravel() for motion in motions.values()])
    parts, *_ = np.linalg.lstsq(A, v, rcond=None)
    if np.linalg.norm(A @ parts - v) > 0.05 * np.linalg.norm(v):
        return []
    part = dict(zip(motions, parts))
    turn = np.array([part[f"rotation of the block about {axis}"] for axis in "XYZ"])
    shift = size * np.array([part[f"position of the block in {axis}"] for axis in "XYZ"])
    if np.linalg.norm(turn) < 10.0 * abs(part["scale of the block"]):
        return []
    turn_square = float(turn @ turn)
    on = state.images.centers.mean(axis=0) + np.cross(turn, shift) / turn_square
    along = turn / np.sqrt(turn_square)
    along = along if along[np.argmax(np.abs(along))] > 0 else -along
    return [
        "rotation of the block about the line through X {:.0f}, Y {:.0f}, Z {:.0f} ".format(*on)
        + "in the direction {:.2f}, {:.2f}, {:.2f}, on which all that places it lies".format(*along)
    ]
