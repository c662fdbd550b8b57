"""A shift or an affine mapping through the vectors of a registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import solve
from photoplan.adjustment.robust import huber, spread
from photoplan.matching.register import FOUND, PatchDisplacements
from photoplan.plain import pick

_Floats = NDArray[np.float64]

MODELS = ("none", "shift", "affine")
#: Residuals count less beyond so many robust standard deviations.
_LIMIT = 2.0


@dataclass(frozen=True, eq=False)
class SmoothModel:
    """A smooth displacement: d = d0 + A (xy − middle), for dx and dy."""

    kind: str
    middle: tuple[float, float]
    """Pixels of the first image."""
    unknowns: _Floats
    """d0 and, of an affine mapping, the derivatives along columns and rows; a row for dx, one for dy, (2, u)."""
    covariances: _Floats
    """Of each row, (2, u, u)."""
    rms: tuple[float, float]
    """Residuals of dx and of dy, pixels."""

    def __call__(self, at: _Floats) -> _Floats:
        """Displacements at pixels (n, 2)."""
        return np.asarray(_columns(at, self.middle, self.unknowns.shape[1]) @ self.unknowns.T)

    def json_fields(self) -> dict[str, Any]:
        """Unknowns with their covariances."""
        names = ("d0", "along_columns", "along_rows")[: self.unknowns.shape[1]]
        sigma = np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))
        axes = {
            axis: {
                **dict(zip(names, self.unknowns[k].tolist())),
                "sigma": dict(zip(names, sigma[k].tolist())),
                "covariance": self.covariances[k].tolist(),
            }
            for k, axis in enumerate(("dx", "dy"))
        }
        return {**pick(self, "kind", "middle", rms_px="rms"), **axes}


def _columns(at: _Floats, middle: tuple[float, float], unknowns: int) -> _Floats:
    off = np.asarray(at, float) - np.array(middle)
    return np.column_stack([np.ones(len(off)), off])[:, :unknowns]


def fit_smooth(found: PatchDisplacements, kind: str, overlap: float) -> SmoothModel | None:
    """A shift or an affine mapping through the vectors by robust least squares; None for the kind `none`.

    Parameters
    ----------
    found : PatchDisplacements
    kind : str
        See `MODELS`.
    overlap : float
        So many patches share a pixel: vectors are no more independent than as many fewer.

    Notes
    -----
    Covariances hold the misfit of the vectors (sigma0): what is not smooth is taken for noise.
    """
    good = found.state == FOUND
    unknowns = {"shift": 1, "affine": 3}.get(kind, 0)
    if not unknowns or good.sum() < 2 * unknowns:
        return None
    at, d, sigma = found.at[good].astype(float), found.moved[good], found.sigma[good]
    column, row = at.mean(axis=0).tolist()
    middle = column, row
    A = _columns(at, middle, unknowns)
    rows, covariances, rms = [], [], []
    for axis in range(2):
        # Vectors are believed by their own accuracy, but none far more than others: the misfit is the field's.
        weight = 1 / np.maximum(sigma[:, axis], np.median(sigma[:, axis])) ** 2
        fit = solve(A, d[:, axis], weight)
        for _ in range(10):
            size = fit.residuals * np.sqrt(weight)
            fit = solve(A, d[:, axis], weight * huber(size / max(spread(size), 1e-9), _LIMIT))
        rows.append(fit.unknowns)
        covariances.append(fit.covariance * max(overlap, 1.0))
        rms.append(float(np.sqrt((fit.residuals**2).mean())))
    return SmoothModel(
        kind=kind, middle=middle, unknowns=np.array(rows), covariances=np.array(covariances), rms=(rms[0], rms[1])
    )
