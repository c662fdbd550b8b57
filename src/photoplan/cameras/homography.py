"""The projection of a plane: four points determine it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import GeometryError, InputError


@dataclass(frozen=True, eq=False)
class Homography:
    """x = (a1 X + a2 Y + a3) / (c1 X + c2 Y + 1), y = (b1 X + …) / (…) (Ecker 1991, eq. 3.4).

    `f @ g` is g followed by f, `~f` the inverse.
    """

    matrix: NDArray[np.float64]
    """(3, 3), known up to a factor."""

    def __post_init__(self) -> None:
        M = np.array(self.matrix, float)
        if M.shape != (3, 3) or not np.isfinite(M).all() or np.linalg.cond(M) > 1e15:
            raise GeometryError("homography: a regular matrix of 3 × 3 finite numbers is needed")
        M.setflags(write=False)
        object.__setattr__(self, "matrix", M)

    @classmethod
    def from_points(cls, XY: ArrayLike, xy: ArrayLike) -> Homography:
        """From four or more pairs of points.

        Parameters
        ----------
        XY, xy : array_like, shape (n, 2)
            Points of the plane and of its image; four determine the eight coefficients, more are adjusted
            (algebraic error in normalised coordinates).

        Raises
        ------
        InputError
            Less than four pairs, or coordinates that are not finite.
        GeometryError
            Three of four points lie on a line.
        """
        XY, xy = np.asarray(XY, float), np.asarray(xy, float)
        if XY.ndim != 2 or XY.shape != xy.shape or XY.shape[1] != 2 or len(XY) < 4:
            raise InputError(f"homography: {XY.shape} and {xy.shape} points; at least four pairs (n, 2) are needed")
        if not (np.isfinite(XY).all() and np.isfinite(xy).all()):
            raise InputError("homography: every coordinate must be a finite number")
        S, T = _normalisation(XY), _normalisation(xy)
        P, p = _apply(S, XY), _apply(T, xy)
        one, zero = np.ones(len(P)), np.zeros(len(P))
        X, Y, x, y = *P.T, *p.T
        rows = np.concatenate(
            [
                np.stack([X, Y, one, zero, zero, zero, -x * X, -x * Y, -x], axis=1),
                np.stack([zero, zero, zero, X, Y, one, -y * X, -y * Y, -y], axis=1),
            ]
        )
        _, singular, Vt = np.linalg.svd(rows)
        M = (np.linalg.inv(T) @ Vt[-1].reshape(3, 3) @ S).astype(np.float64)
        if singular[7] < 1e-9 * singular[0] or np.linalg.cond(Vt[-1].reshape(3, 3)) > 1e9:
            raise GeometryError("homography: the points do not determine it; of four points no three may be collinear")
        if abs(M[2, 2]) > 1e-12 * np.abs(M).max():
            M /= M[2, 2]
        return cls(M)

    def __call__(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Points of the plane to image points, shapes (..., 2); NaN on the vanishing line."""
        XY = np.asarray(XY, float)
        return _apply(self.matrix, XY)

    def __invert__(self) -> Homography:
        return Homography(np.linalg.inv(self.matrix).astype(np.float64))

    def __matmul__(self, other: Homography) -> Homography:
        return Homography(self.matrix @ other.matrix)


def _apply(M: NDArray[np.float64], XY: NDArray[np.float64]) -> NDArray[np.float64]:
    h = XY @ M[:, :2].T + M[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(h[..., 2:] != 0, h[..., :2] / h[..., 2:], np.nan)


def _normalisation(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Moves the points' centroid to the origin and their mean distance to √2."""
    middle = points.mean(axis=0)
    spread = float(np.linalg.norm(points - middle, axis=1).mean())
    if spread == 0.0:
        raise GeometryError("homography: all points coincide")
    s = np.sqrt(2.0) / spread
    return np.array([[s, 0.0, -s * middle[0]], [0.0, s, -s * middle[1]], [0.0, 0.0, 1.0]])
