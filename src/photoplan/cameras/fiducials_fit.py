"""Interior orientation of scanned film: from calibrated and measured fiducial marks to a plane transformation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import Fit, solve
from photoplan.cameras.plane import Affine2D, Bilinear2D
from photoplan.errors import GeometryError, InputError

#: Marks as name → (x, y), or as rows (name, x, y) of a file, in which a name may by mistake occur twice.
Marks = Mapping[str, tuple[float, float]] | Iterable[tuple[str, float, float]]

_Design = Callable[[NDArray[np.float64]], NDArray[np.float64]]

#: Transformations and how many marks each needs. A similarity could do with two, but two marks check nothing.
MODELS = {"similarity": 3, "affine": 3, "bilinear": 4}

#: Film shrinks by a few parts in ten thousand; residuals beyond this part of the marks' extent are blunders.
BLUNDER = 0.005


@dataclass(frozen=True, eq=False)
class FiducialFit:
    """Result of the adjustment."""

    transformation: Affine2D | Bilinear2D
    """From the image plane (millimetres, x right, y up) to pixels."""
    names: tuple[str, ...]
    """The marks that were used."""
    residuals: NDArray[np.float64]
    """Transformed minus measured position of each mark, shape (n, 2), pixels."""
    redundancy: int
    """Observations minus unknowns: 0 means that nothing checks the marks."""
    sigma0: float
    """Standard deviation of one measured coordinate, pixels; NaN without redundancy."""
    covariance: NDArray[np.float64]
    """Of the coefficients, in the transformation's order, shape (6, 6) or (8, 8); NaN without redundancy. Of a
    similarity, whose six coefficients are functions of four, it has rank 4."""
    missing: tuple[str, ...]
    """Calibrated marks that were not measured."""
    model: str = "affine"
    """One of `MODELS`."""

    def __str__(self) -> str:
        check = f"sigma0 {self.sigma0:.3f} px" if self.redundancy else "no redundancy: the marks are not checked"
        lines = [f"{self.model} interior orientation from {len(self.names)} fiducial marks, {check}"]
        lines += [f"  {n:>8}  vx {v[0]:+8.3f}  vy {v[1]:+8.3f} px" for n, v in zip(self.names, self.residuals)]
        if self.missing:
            lines.append(f"  not measured: {', '.join(self.missing)}")
        return "\n".join(lines)


def fit_marks(model: str, plane_mm: Marks, scan_px: Marks, *, mirrored: bool = False) -> FiducialFit:
    """`fit_similarity`, `fit_affine` or `fit_bilinear`, by the name of the model."""
    fits = {"similarity": fit_similarity, "affine": fit_affine, "bilinear": fit_bilinear}
    if model not in fits:
        raise InputError(f"interior orientation {model!r}; allowed are {', '.join(fits)}")
    return fits[model](plane_mm, scan_px, mirrored=mirrored)


def fit_affine(plane_mm: Marks, scan_px: Marks, *, mirrored: bool = False) -> FiducialFit:
    """Affine transformation from image plane to scan by least squares (Ecker 1991, eq. 4.2; Behr 1989, eq. 5.2)."""
    common = _pair(plane_mm, scan_px, "affine")
    found = _adjust(common.plane, common.scan, _affine_design)
    _check_marks(common, found.residuals, found.unknowns, mirrored)
    return _result(common, Affine2D(*found.unknowns), found, "affine")


def fit_bilinear(plane_mm: Marks, scan_px: Marks, *, mirrored: bool = False) -> FiducialFit:
    """Bilinear transformation from image plane to scan by least squares (Ecker 1991, eq. 4.3).

    Four marks determine it without any check, so they are first compared with an affine transformation. Parameters
    and errors are those of `fit_affine`, with at least four marks.
    """
    common = _pair(plane_mm, scan_px, "bilinear")
    affine = _adjust(common.plane, common.scan, _affine_design)
    _check_marks(common, affine.residuals, affine.unknowns, mirrored)
    found = _adjust(common.plane, common.scan, _bilinear_design)
    return _result(common, Bilinear2D(*found.unknowns), found, "bilinear")


def fit_similarity(plane_mm: Marks, scan_px: Marks, *, mirrored: bool = False) -> FiducialFit:
    """Similarity (shift, rotation, one scale; turned over, where the scan is) from image plane to scan.

    x' = p x + q y + s, y' = q x − p y + t, since rows run down and y runs up; of a mirrored scan x' = p x − q y + s,
    y' = q x + p y + t. It serves where film and scanner are known to be true to scale, and marks few or bad. Marks are
    first compared with an affine transformation. Parameters and errors are those of `fit_affine`; an `InputError` also
    tells scales that differ in x and y by more than film does.
    """
    common = _pair(plane_mm, scan_px, "similarity")
    affine = _adjust(common.plane, common.scan, _affine_design)
    _check_marks(common, affine.residuals, affine.unknowns, mirrored)
    found = _adjust_similarity(common.plane, common.scan, mirrored)
    off = np.linalg.norm(found.residuals, axis=1)
    limit = BLUNDER * float(np.ptp(common.scan, axis=0).max())
    if off.max() > limit:
        listed = ", ".join(f"{n} {v:.1f}" for n, v in zip(common.names, off))
        raise InputError(
            f"fiducial marks: a similarity leaves residuals (px: {listed}) above {limit:.1f} px. Either a mark is "
            "wrong, or the scan's pixels are not square: then use an affine transformation"
        )
    return _result(common, Affine2D(*found.unknowns), found, "similarity")


@dataclass(frozen=True, eq=False)
class _Pairs:
    names: tuple[str, ...]
    plane: NDArray[np.float64]
    scan: NDArray[np.float64]
    missing: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Adjusted:
    unknowns: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residuals: NDArray[np.float64]
    redundancy: int
    sigma0: float


def _result(common: _Pairs, transformation: Affine2D | Bilinear2D, found: _Adjusted, model: str) -> FiducialFit:
    return FiducialFit(
        transformation=transformation,
        names=common.names,
        residuals=found.residuals,
        redundancy=found.redundancy,
        sigma0=found.sigma0,
        covariance=found.covariance,
        missing=common.missing,
        model=model,
    )


def _pair(plane_mm: Marks, scan_px: Marks, model: str) -> _Pairs:
    least = MODELS[model]
    plane, scan = _table(plane_mm, "calibrated"), _table(scan_px, "measured")
    unknown = [name for name in scan if name not in plane]
    if unknown:
        raise InputError(
            f"measured fiducial mark {_list(unknown)} is not calibrated; the calibration has {_list(plane)}"
        )
    names = tuple(name for name in plane if name in scan)
    missing = tuple(name for name in plane if name not in scan)
    if len(names) < least:
        raise InputError(
            f"{len(names)} fiducial marks ({_list(names) or 'none'}) for {model} interior orientation; "
            f"{least} are needed. Not measured: {_list(missing) or 'none'}"
        )
    P, p = np.array([plane[n] for n in names]), np.array([scan[n] for n in names])
    for points, what in ((P, "calibrated"), (p, "measured")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] < 0.01 * spread[0]:
            raise GeometryError(f"the {what} fiducial marks {_list(names)} lie on a line; marks beside it are needed")
    return _Pairs(names, P, p, missing)


def _table(marks: Marks, what: str) -> dict[str, tuple[float, float]]:
    rows = [(n, *xy) for n, xy in marks.items()] if isinstance(marks, Mapping) else list(marks)
    table: dict[str, tuple[float, float]] = {}
    for name, x, y in rows:
        if name in table:
            raise InputError(f"{what} fiducial mark {name!r} is given twice; remove one of the two")
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(f"{what} fiducial mark {name!r} at ({x}, {y}); two finite numbers are needed")
        table[name] = (float(x), float(y))
    if len(table) > 1:
        extent = max(np.ptp([v[k] for v in table.values()]) for k in (0, 1))
        for (a, p), (b, q) in itertools.combinations(table.items(), 2):
            if math.dist(p, q) <= BLUNDER * extent:
                raise InputError(
                    f"{what} fiducial marks {a!r} and {b!r} have the same place ({p[0]:g}, {p[1]:g}); one is wrong"
                )
    return table


def _affine_design(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([xy, np.ones(len(xy))])


def _bilinear_design(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([xy, xy[:, 0] * xy[:, 1], np.ones(len(xy))])


def _adjust(plane: NDArray[np.float64], scan: NDArray[np.float64], design: _Design) -> _Adjusted:
    """Least squares with one design for columns and rows."""
    fit = _solve(design(plane), scan)
    covariance = np.asarray(np.kron(np.eye(2), fit.cofactors) * fit.sigma0**2, float)
    return _Adjusted(
        unknowns=fit.unknowns.T.ravel(),
        covariance=covariance,
        residuals=fit.residuals,
        redundancy=fit.redundancy,
        sigma0=fit.sigma0,
    )


def _adjust_similarity(plane: NDArray[np.float64], scan: NDArray[np.float64], mirrored: bool) -> _Adjusted:
    """Least squares with columns and rows in one; unknowns are the six coefficients of an affine transformation."""
    turn = 1.0 if mirrored else -1.0
    # Coefficients a1 … a6 of p, q, s, t.
    J = np.array([[1, 0, 0, 0], [0, -turn, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [turn, 0, 0, 0], [0, 0, 0, 1]], float)
    fit = _solve(np.kron(np.eye(2), _affine_design(plane)) @ J, scan.T.ravel())
    covariance = J @ fit.covariance @ J.T if fit.redundancy else np.full((6, 6), math.nan)
    return _Adjusted(
        unknowns=J @ fit.unknowns,
        covariance=covariance,
        residuals=fit.residuals.reshape(2, -1).T,
        redundancy=fit.redundancy,
        sigma0=fit.sigma0,
    )


def _solve(A: NDArray[np.float64], observed: NDArray[np.float64]) -> Fit:
    fit = solve(A, observed)
    if fit.rank < A.shape[1]:
        raise GeometryError("the fiducial marks do not determine the transformation; marks at other places are needed")
    return fit


def _check_marks(common: _Pairs, residuals: NDArray[np.float64], affine: NDArray[np.float64], mirrored: bool) -> None:
    """Refuse residuals that no film has and scans of the wrong handedness, and say what would explain them."""
    off = np.linalg.norm(residuals, axis=1)
    limit = BLUNDER * float(np.ptp(common.scan, axis=0).max())
    turned = not _has_handedness(affine, mirrored)
    if off.max() <= limit and not turned:
        return
    exchanged = _exchanged(common, limit, mirrored)
    if off.max() <= limit:
        raise InputError(_turned_message(mirrored, exchanged))
    if exchanged:
        raise InputError(
            f"fiducial marks {' or '.join(exchanged)} are exchanged: residuals reach {off.max():.1f} px, and "
            f"less than {limit:.1f} px when these two change places"
        )
    listed = ", ".join(f"{n} {v:.1f}" for n, v in zip(common.names, off))
    raise InputError(
        f"fiducial marks: {_suspect(common)}; residuals (px: {listed}) exceed {limit:.1f} px, more than film deforms. "
        "Measure again, or check that the calibration belongs to this camera"
    )


def _exchanged(common: _Pairs, limit: float, mirrored: bool) -> list[str]:
    """Pairs of marks that make all residuals small, with the right handedness, when they change places."""
    pairs = []
    for i, j in itertools.combinations(range(len(common.names)), 2):
        order = list(range(len(common.names)))
        order[i], order[j] = j, i
        found = _adjust(common.plane, common.scan[order], _affine_design)
        if np.linalg.norm(found.residuals, axis=1).max() <= limit and _has_handedness(found.unknowns, mirrored):
            pairs.append(f"{common.names[i]!r} and {common.names[j]!r}")
    return pairs


def _has_handedness(affine: NDArray[np.float64], mirrored: bool) -> bool:
    # Image plane y up, rows downwards: the determinant of an unmirrored scan is negative.
    return bool((affine[0] * affine[4] - affine[1] * affine[3] > 0) == mirrored)


def _turned_message(mirrored: bool, exchanged: list[str]) -> str:
    also = f"; or the marks {' or '.join(exchanged)} are exchanged" if exchanged else ""
    if mirrored:
        return f"the fiducial marks are not mirrored in the scan, but mirrored = true was stated{also}"
    return (
        "the scan is mirrored: its fiducial marks run the other way round than the calibrated ones. If the film was "
        "scanned through its back, set `mirrored = true`; if marks and angles are stated with the scene at z > 0 (ω is "
        'then near half a circle for an aerial photograph), set `scene = "z > 0"` under [orientation] instead; else '
        f"check that rows are counted downwards and y upwards{also}"
    )


def _suspect(common: _Pairs) -> str:
    """The mark without which the others fit best; all, where nothing tells them apart."""
    n = len(common.names)
    if n < 5:
        return f"one of {_list(common.names)} is wrong (four marks cannot tell which)"
    left = []
    for k in range(n):
        rest = np.arange(n) != k
        left.append(_adjust(common.plane[rest], common.scan[rest], _affine_design).sigma0)
    return f"{common.names[int(np.argmin(left))]!r} is wrong"


def _list(names: Iterable[str]) -> str:
    return ", ".join(map(repr, names))
