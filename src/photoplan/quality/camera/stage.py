"""Calibration of a camera by a stage that moves a target over its field (Behr 1989, appendix B, fig. B.4)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.least_squares import Fit, by_differences, solve
from photoplan.adjustment.statistics import chance_f, chance_gain
from photoplan.cameras.fiducials import Affine2D, AffineFacts, affine_facts
from photoplan.errors import GeometryError, InputError

Array = NDArray[np.float64]

#: Points of a calibration: three determine an affine transformation, the fourth checks it. More than
#: the most are no targets that somebody measured.
LEAST_POINTS = 4
MOST_POINTS = 10_000
_GON = 200.0 / math.pi
#: Chance of a false alarm for a gross error among all points, and for a systematic part of the residuals.
LEVEL = 0.001
#: Relative step of the numerical derivatives.
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class StageCalibration:
    """Affine transformation between stage and image, and what it means."""

    names: tuple[str, ...]
    stage: Array
    """Stage coordinates, shape (n, 2)."""
    measured: Array
    """Columns and rows, shape (n, 2), pixels."""
    to_image: Affine2D
    """From stage to image: X = a1 x + a2 y + a3, Y = a4 x + a5 y + a6."""
    to_stage: Affine2D
    """From image to stage."""
    covariance: Array
    """Of a1 … a6, shape (6, 6)."""
    residuals: Array
    """Measured minus transformed, shape (n, 2), pixels; of all points."""
    sigma: tuple[float, float]
    """Standard deviation of a column and of a row."""
    sigma0: float
    """M0: of both."""
    redundancy: int
    gross: tuple[str, ...]
    """Points that were left out: their residual is beyond chance."""
    facts: AffineFacts
    sigma_pixel_size: tuple[float, float]
    sigma_direction: tuple[float, float]
    """Of the two axes, radians."""
    sigma_shear: float
    systematic: float | None
    """Chance that residuals without system follow second-order terms as much; None: too few points."""

    @property
    def printed_rotation_y(self) -> float:
        """What fig. B.4 prints as rotation of the y axis: minus the sum of both directions, gon."""
        return -(self.facts.direction_x + self.facts.direction_y) * _GON


def stage_calibration(names: Iterable[str], stage: Array, measured: Array) -> StageCalibration:
    """Adjust the affine transformation from a stage's coordinates to columns and rows.

    A point whose studentised residual is beyond chance is left out, one after the other.
    """
    labels, S, P = _checked(names, stage, measured)
    used = np.ones(len(labels), bool)
    while True:
        A = np.column_stack([S, np.ones(len(S))])
        fit = solve(A[used], P[used])
        residuals = P - A @ fit.unknowns
        worst = _worst(fit, used)
        if worst is None:
            break
        used[worst] = False
        if used.sum() < max(LEAST_POINTS + 1, 0.7 * len(used)):
            lost = ", ".join(n for n, u in zip(labels, used) if not u)
            raise InputError(
                f"stage calibration: after {lost} no affine transformation fits the {int(used.sum())} points that are "
                "left; check the stage coordinates, their signs and their order"
            )
    columns, rows = np.sqrt((fit.residuals**2).sum(axis=0) / (fit.redundancy / 2))
    forward = Affine2D(*(float(v) for v in fit.unknowns.T.ravel()))
    covariance = np.asarray(np.kron(np.eye(2), fit.covariance), float)
    sizes, directions, shear = _sigmas(forward, covariance)
    return StageCalibration(
        names=labels,
        stage=S,
        measured=P,
        to_image=forward,
        to_stage=~forward,
        covariance=covariance,
        residuals=residuals,
        sigma=(float(columns), float(rows)),
        sigma0=fit.sigma0,
        redundancy=fit.redundancy,
        gross=tuple(n for n, u in zip(labels, used) if not u),
        facts=affine_facts(forward),
        sigma_pixel_size=sizes,
        sigma_direction=directions,
        sigma_shear=shear,
        systematic=_systematic(S[used], residuals[used]),
    )


def _checked(names: Iterable[str], stage: Array, measured: Array) -> tuple[tuple[str, ...], Array, Array]:
    labels = tuple(names)
    S, P = np.asarray(stage, float), np.asarray(measured, float)
    if S.shape != (len(labels), 2) or P.shape != S.shape:
        raise InputError(
            f"stage calibration: {len(labels)} names, stage coordinates of shape {S.shape}, measured of {P.shape}; two "
            "columns of equal length are needed"
        )
    if len(labels) > MOST_POINTS:
        raise InputError(f"stage calibration: {len(labels)} points; at most {MOST_POINTS} are taken")
    seen: set[str] = set()
    for name, s, p in zip(labels, S, P):
        if name in seen:
            raise InputError(
                f"stage calibration: point {name!r} is given twice; give each measurement a name of its own"
            )
        seen.add(name)
        if not (np.isfinite(s).all() and np.isfinite(p).all()):
            raise InputError(f"stage calibration: point {name!r} has a coordinate that is no finite number")
    if len(labels) < LEAST_POINTS:
        raise InputError(
            f"stage calibration: {len(labels)} points; {LEAST_POINTS} are needed, since three fit without any check"
        )
    for points, what in ((S, "stage coordinates"), (P, "measured positions")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if not spread[1] > 0.01 * spread[0]:
            raise GeometryError(
                f"stage calibration: the {what} lie on a line (or at one place); move the stage in both directions. "
                "Has a sign been lost?"
            )
    return labels, S, P


def _worst(fit: Fit, used: NDArray[np.bool_]) -> int | None:
    """The point whose residual is farthest beyond what the others allow; None: no gross error."""
    freedom = fit.redundancy
    if freedom < 6 or not fit.square > 1e-18 * float((fit.A**2).mean()):
        return None
    square = (fit.residuals**2).sum(axis=1) / np.clip(fit.redundancies, 1e-3, 1.0)
    # Without the point itself, so that a large error does not hide behind the sigma it makes.
    ratio = (square / 2.0) / np.maximum((fit.square - square) / (freedom - 2), 1e-300)
    k = int(ratio.argmax())
    return int(np.flatnonzero(used)[k]) if chance_f(ratio[k], 2, freedom - 2) * len(square) < LEVEL else None


def _sigmas(forward: Affine2D, covariance: Array) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Of pixel sizes, directions and shear, by differences."""
    start = np.array([forward.a1, forward.a2, forward.a3, forward.a4, forward.a5, forward.a6])

    def figures(elements: Array) -> Array:
        f = affine_facts(Affine2D(*(float(v) for v in elements)))
        # Next to their values, whose turn does not matter, angles have no jump.
        near = [math.remainder(a - b, math.tau) for a, b in zip(_angles(f), _angles(affine_facts(forward)))]
        return np.array([*f.pixel_size, *near])

    J = by_differences(figures, start, _STEP * float(np.abs(start[[0, 1, 3, 4]]).max()))
    s = [math.sqrt(max(float(v), 0.0)) for v in np.diag(J @ covariance @ J.T)]
    return (s[0], s[1]), (s[2], s[3]), s[4]


def _angles(facts: AffineFacts) -> tuple[float, float, float]:
    return facts.direction_x, facts.direction_y, facts.shear


def _systematic(S: Array, residuals: Array) -> float | None:
    """F-test of second-order terms in the residuals (figs. B.2 and B.3 let one suspect them)."""
    n = len(S)
    if n < 9:
        return None
    d = (S - S.mean(axis=0)) / np.maximum(np.ptp(S, axis=0), 1e-300)
    x, y = d.T
    A = np.column_stack([np.ones(n), x, y, x * x, x * y, y * y])
    fit = solve(A, residuals)
    if fit.rank < 6 or not fit.square > 1e-24:
        return None
    return chance_gain(float((residuals**2).sum()), fit.square, 6, fit.redundancy)


def b4_lines(found: StageCalibration, unit: str) -> tuple[str, ...]:
    """The result as text in the order of fig. B.4."""
    f, b, facts = found.to_image, found.to_stage, found.facts
    lines = [
        "Affine transformation  X = a1 x + a2 y + a3,  Y = b1 x + b2 y + b3",
        "",
        "Stage to image: rotation and scale, shift (pixels)",
        f"{f.a1:17.10f} {f.a2:17.10f} {f.a3:10.2f}",
        f"{f.a4:17.10f} {f.a5:17.10f} {f.a6:10.2f}",
        "",
        *(f"Scale factor in {c}   : {s:.10f}" for c, s in zip("xy", facts.scale)),
        *(
            f"Pixel size in {c}     : {s:.2f} {unit} ± {e:.1g}"
            for c, s, e in zip("xy", facts.pixel_size, found.sigma_pixel_size)
        ),
        f"Rotation of x axis   : {facts.direction_x * _GON:.2f} gon",
        f"Rotation of y axis   : {facts.direction_y * _GON:.2f} gon (fig. B.4 prints minus the sum of both, "
        f"{found.printed_rotation_y:.2f})",
        f"Shear                : {facts.shear * _GON:.2f} gon",
        "",
        f"Image to stage: rotation and scale, shift ({unit})",
        f"{b.a1:17.10f} {b.a2:17.10f} {b.a3:10.2f}",
        f"{b.a4:17.10f} {b.a5:17.10f} {b.a6:10.2f}",
        "",
        "Point       Stage x     Stage y   Column      Row  Residuals",
    ]
    for name, s, p, v in zip(found.names, found.stage, found.measured, found.residuals):
        mark = "  gross error, left out" if name in found.gross else ""
        lines.append(f"{name:<8} {s[0]:10.2f}  {s[1]:10.2f}  {p[0]:7.2f}  {p[1]:7.2f}  {_two(v[0])} {_two(v[1])}{mark}")
    lines += ["", f"Mean errors {found.sigma[0]:.2f} {found.sigma[1]:.2f}    M0 = {found.sigma0:.2f}"]
    return tuple(lines)


def _two(value: float) -> str:
    """Two decimals without a minus before zero."""
    return f"{round(float(value), 2) + 0.0:6.2f}"
