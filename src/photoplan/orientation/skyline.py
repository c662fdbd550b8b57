"""Turns of a camera that bring the skyline of terrain onto the edge of the sky in a photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.least_squares import Equations, bisquare, by_differences, levenberg, spread
from photoplan.errors import GeometryError

_Floats = NDArray[np.float64]

#: Unknowns: small turns about the camera's axes x (right), y (up) and z (backwards), radians, and the logarithm of a
#: factor of the camera constant.
UNKNOWNS = ("pitch", "azimuth", "roll", "focal")
#: Steps of the derivatives, and standard deviations beyond which a parameter is not determined, in their unit.
_STEP, _UNDETERMINED = 1e-5, 0.02
#: Rounds in which weights are found.
_ROUNDS = 8
#: Least spread of residuals that weights are based on, pixels.
_LEAST_SPREAD = 0.05
#: Points of a skyline farther apart than this, pixels, have no line between them.
_GAP = 3.0
#: Parts of the largest eigenvalue of normal equations with a diagonal of ones that are no more than rounding.
_ROUNDING = 1e-10
#: Rounds in which autocovariances are restored, and the most that a fit may have taken, part of the variance.
_RESTORED, _MOST_TAKEN = 6, 0.3


@dataclass(frozen=True, eq=False)
class SkylineFit:
    """What the skyline says of a camera."""

    step: _Floats
    """Change of the unknowns, by `UNKNOWNS`, (3,) or (4,)."""
    covariance: _Floats
    """Of them; neighbouring columns resemble each other, which counts."""
    used: int
    """Columns whose weight is above zero."""
    columns: int
    """Columns with an edge and a skyline."""
    correlated: float
    """Columns that say no more than one: 1 where neighbours err independently."""


def fit_skyline(pixels: Callable[[_Floats], _Floats], distance: _Floats, edge: _Floats, unknowns: int) -> SkylineFit:
    """Robust least squares of distances between a skyline and an edge, measured across the skyline.

    Neighbouring columns of terrain and photograph err together: the covariance has the autocorrelation of the
    residuals in it, as far as it is positive. Near terrain shows its errors of height more than far one: how much of
    the residuals' size falls with the distance is estimated from them.
    """
    start = np.zeros(unknowns)
    where = _columns(pixels(start), edge)
    if len(where) < 10 * unknowns:
        raise GeometryError(
            f"{len(where)} columns show skyline and edge; {10 * unknowns} are needed for {unknowns} angles"
        )

    def rows(step: _Floats) -> _Floats:
        xy = pixels(step)
        order = np.argsort(xy[:, 0], kind="stable")
        return np.asarray(np.interp(where, xy[order, 0], xy[order, 1]))

    across = 1.0 / np.hypot(1.0, np.gradient(rows(start), where))

    def distances(step: _Floats) -> _Floats:
        return np.asarray((rows(step) - edge[where]) * across)

    first = pixels(start)[:, 0]
    order = np.argsort(first, kind="stable")
    nearness = np.median(distance) / np.interp(where, first[order], distance[order])
    weight, size = np.ones(len(where)), np.ones(len(where))
    for _ in range(_ROUNDS):
        found = _round(distances, start, np.sqrt(weight) / size)
        start = found.state
        v = distances(start)
        size = _sizes(v, nearness)
        weight = bisquare(v / size / max(spread(v / size), _LEAST_SPREAD))
    A = by_differences(distances, start, _STEP)
    covariance, correlated = _covariance(A / size[:, None], v / size, weight, where)
    _refuse_undetermined(covariance)
    return SkylineFit(
        step=start, covariance=covariance, used=int(np.count_nonzero(weight)), columns=len(where), correlated=correlated
    )


def _columns(xy: _Floats, edge: _Floats) -> NDArray[np.int64]:
    """Columns with an edge between points of the skyline that are neighbours."""
    x = np.sort(xy[np.isfinite(xy[:, 0]), 0])
    at = np.flatnonzero(np.isfinite(edge))
    right = np.searchsorted(x, at)
    inside = (right > 0) & (right < len(x))
    at, right = at[inside], right[inside]
    return np.asarray(at[x[right] - x[right - 1] <= _GAP])


def _sizes(v: _Floats, nearness: _Floats) -> _Floats:
    """Sizes of errors up to a factor: of the edge, the same everywhere, and of heights, larger where they are near.

    The mixture that makes the residuals most likely (with Laplace's density, which gross errors hardly move).
    """
    best = None
    for part in np.linspace(0.0, 1.0, 11).tolist():
        size = np.hypot(1.0 - part, part * nearness)
        told = float(np.log(size).mean() + np.log(max(float((np.abs(v) / size).mean()), 1e-12)))
        if best is None or told < best[0]:
            best = told, size
    assert best is not None
    return best[1]


def _round(distances: Callable[[_Floats], _Floats], start: _Floats, root: _Floats) -> Equations[_Floats]:
    def equations(step: _Floats) -> tuple[_Floats, _Floats]:
        return by_differences(distances, step, _STEP) * root[:, None], distances(step) * root

    return levenberg(start, equations, lambda state, step: state + step)


def _covariance(A: _Floats, v: _Floats, weight: _Floats, where: NDArray[np.int64]) -> tuple[_Floats, float]:
    """Covariance (u, u) with the autocorrelation of the residuals, and its length in columns."""
    span = int(where[-1] - where[0]) + 1
    B, e, w = np.zeros((span, A.shape[1])), np.zeros(span), np.zeros(span)
    at = where - where[0]
    B[at], e[at], w[at] = A * weight[:, None], v * weight, weight
    square = np.array(
        [float(e[k:] @ e[: span - k]) / max(float(w[k:] @ w[: span - k]), 1e-9) for k in range(span // 3)]
    )
    square, correlated = _restored(square, A.shape[1], float(weight.sum()))
    meat = square[0] * (B.T @ B)
    for k in range(1, len(square)):
        both = B[k:].T @ B[: span - k]
        meat += square[k] * (both + both.T)
    normal = (A.T * weight) @ A
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    free = values < _ROUNDING * values[-1]
    if free.any():
        way = np.abs(vectors[:, free] / scale[:, None])
        return np.diag(np.where((way > 0.1 * way.max(axis=0)).any(axis=1), np.inf, 0.0)), correlated
    inverse = np.linalg.inv(normal)
    plain = square[0] * (inverse @ ((B.T @ B) @ inverse))
    out = inverse @ meat @ inverse
    if (np.diag(out) < np.diag(plain)).any():
        out = plain * correlated
    # A small change of an observation moves the unknowns by the slope of weight times residual, not by the weight.
    slope = np.where(weight > 0, np.sqrt(weight) * (5.0 * np.sqrt(weight) - 4.0), 0.0)
    return np.asarray(out * (weight.sum() / max(float(slope.sum()), 0.3 * float(weight.sum()))) ** 2), correlated


def _restored(square: _Floats, unknowns: int, count: float) -> tuple[_Floats, float]:
    """Autocovariances of errors, as far as positive, and the columns that err together, from those of residuals.

    A fit takes out of them what unknowns can follow, which is slow: as much in each lag as unknowns times columns that
    err together have of all.
    """
    errors, correlated = square, 1.0
    for _ in range(_RESTORED):
        stop = int(np.argmax(errors <= 0)) if (errors <= 0).any() else len(errors)
        errors = errors[: max(stop, 1)]
        correlated = max(1.0 + 2.0 * float(errors[1:].sum() / max(errors[0], 1e-300)), 1.0)
        errors = square + min(unknowns * correlated / count, _MOST_TAKEN) * square[0]
    stop = int(np.argmax(errors <= 0)) if (errors <= 0).any() else len(errors)
    return errors[: max(stop, 1)], correlated


def _refuse_undetermined(covariance: _Floats) -> None:
    sigma = np.sqrt(np.diag(covariance))
    weak = [name for name, value in zip(UNKNOWNS, sigma) if not value <= _UNDETERMINED]
    if weak:
        told = ", ".join(
            f"{name} ±{value:.2g}" + (" of itself" if name == "focal" else " rad")
            for name, value in zip(UNKNOWNS, sigma)
            if name in weak
        )
        raise GeometryError(
            f"the skyline does not determine {' and '.join(weak)} ({told}); a level or straight horizon tells no "
            "azimuth: leave `focal` as it is, or orient by control points (`photoplan resect`)"
        )
