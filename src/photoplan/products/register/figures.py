"""What the vectors of a registration say as a whole: figures, and a shift or an affine mapping through them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import solve
from photoplan.adjustment.robust import huber, spread
from photoplan.matching.register import FOUND, STATES, PatchDisplacements
from photoplan.plain import pick

_Floats = NDArray[np.float64]

PERCENTILES = (50.0, 90.0, 95.0, 99.0, 99.7)
MODELS = ("none", "shift", "affine")
#: Residuals count less beyond so many robust standard deviations.
_LIMIT = 2.0


@dataclass(frozen=True)
class RegisterFigures:
    """Figures of a field of vectors, pixels of the first image."""

    patches: int
    counts: dict[str, int]
    """Patches by what became of them, see `photoplan.matching.register.STATES`."""
    median: tuple[float, float]
    rms: tuple[float, float]
    """Of dx and of dy."""
    spread: tuple[float, float]
    """Standard deviation of dx and of dy about their means."""
    percentiles: dict[str, float]
    """Of the vectors' lengths."""
    largest: float
    """Longest vector."""
    quarter: float
    """Share of the vectors not longer than a quarter of a pixel, 0 to 1."""
    half: float
    """Share not longer than half a pixel."""
    sigma: tuple[float, float]
    """Median standard deviation of dx and of dy."""
    factor: float
    """Median of the factors by which standard deviations of the fits were multiplied: noise of pixels is alike."""
    correlation: float
    """Median."""

    def json_fields(self) -> dict[str, Any]:
        """All of it, with its unit."""
        own = ("patches", "counts", "factor", "correlation")
        pixels = ("median", "rms", "spread", "percentiles", "largest", "sigma")
        shares = {"share_within_quarter_px": self.quarter, "share_within_half_px": self.half}
        return {**pick(self, *own), **{f"{name}_px": getattr(self, name) for name in pixels}, **shares}


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


def figures_of(found: PatchDisplacements) -> RegisterFigures:
    """Figures of the vectors that were found; there is one at least."""
    good = found.state == FOUND
    d, length = found.moved[good], np.linalg.norm(found.moved[good], axis=1)
    values = np.percentile(length, PERCENTILES).tolist()
    return RegisterFigures(
        patches=len(good),
        counts=dict(zip(STATES, np.bincount(found.state, minlength=len(STATES)).tolist())),
        median=_two(np.median(d, axis=0)),
        rms=_two(np.sqrt((d**2).mean(axis=0))),
        spread=_two(d.std(axis=0)),
        percentiles={f"{p:g}": v for p, v in zip(PERCENTILES, values)},
        largest=float(length.max()),
        quarter=float((length <= 0.25).mean()),
        half=float((length <= 0.5).mean()),
        sigma=_two(np.median(found.sigma[good], axis=0)),
        factor=float(np.median(found.factor[good])),
        correlation=float(np.median(found.correlation[good])),
    )


def _two(values: _Floats) -> tuple[float, float]:
    a, b = values.tolist()
    return a, b


def _columns(at: _Floats, middle: tuple[float, float], unknowns: int) -> _Floats:
    off = np.asarray(at, float) - np.array(middle)
    return np.column_stack([np.ones(len(off)), off])[:, :unknowns]


def fit_smooth(found: PatchDisplacements, kind: str, overlap: float) -> SmoothModel | None:
    """A shift or an affine mapping through the vectors by robust least squares; None for the kind `none`.

    Parameters
    ----------
    found : Displacements
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
    middle = _two(at.mean(axis=0))
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
