"""Least squares for light fall-off: unknowns of the natural part beside a polynomial, with robust weights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import solve
from photoplan.adjustment.robust import bisquare, spread
from photoplan.errors import GeometryError, InputError
from photoplan.quality.camera.fall_off_blocks import Blocks
from photoplan.quality.camera.fall_off_model import MOST_DEGREE, half_diagonal, surface_terms, term_values

Array = NDArray[np.float64]

#: Standard deviations above which a term counts.
SIGNIFICANT = 4.0


@dataclass(frozen=True)
class FallOffSettings:
    """What is known, and what is estimated."""

    natural: Literal["given", "estimated", "none"] = "none"
    """Camera constant of cos⁴ω: given, estimated from the fall-off, or no natural part apart from the terms."""
    camera_constant: float | None = None
    """Pixels; needed where it is given."""
    principal_point: tuple[float, float] | None = None
    """Column and row; None: the middle of the image."""
    estimate_principal_point: bool = False
    """Whether it is estimated too."""
    artificial: Literal["surface", "radial", "none"] = "surface"
    """A general polynomial surface, one of even powers of the radius, or no artificial part."""
    degree: int = 6
    dark: float = 0.0
    """Grey value of no light that was left in the flat image; it is passed on to the model."""

    def __post_init__(self) -> None:
        if (self.natural == "given") != (self.camera_constant is not None):
            raise InputError(
                f"natural light fall-off {self.natural!r} with camera constant {self.camera_constant}; give the camera "
                "constant with 'given' and only with it"
            )
        if self.camera_constant is not None and not 0.0 < self.camera_constant < math.inf:
            raise InputError(f"camera constant {self.camera_constant} px; a positive number is needed")
        if not 2 <= self.degree <= MOST_DEGREE:
            raise InputError(f"polynomial of degree {self.degree}; 2 to {MOST_DEGREE} are allowed")

    def terms(self) -> tuple[tuple[int, int], ...]:
        """Terms that are tried for the artificial part."""
        if self.artificial == "none":
            return ()
        found = surface_terms(self.degree)
        return found if self.artificial == "surface" else tuple(t for t in found if t[1] == 0)


@dataclass(frozen=True, eq=False)
class FallOffFit:
    """Unknowns: those of the natural part first (log of the camera constant, point), then level and level · terms."""

    point: tuple[float, float]
    camera_constant: float | None
    terms: tuple[tuple[int, int], ...]
    linear: Array
    covariance: Array
    weights: Array
    residuals: Array
    free: tuple[str, ...]


def columns(blocks: Blocks, point: tuple[float, float], c: float | None, terms: tuple[tuple[int, int], ...]) -> Array:
    """Design of the linear unknowns for all known blocks, shape (n, 1 + terms): the level, then each term.

    The principal point is in pixels, and the camera constant c too; without one there is no natural part.
    """
    unit = half_diagonal(blocks.size)
    u, v = (blocks.x - point[0]) / unit, (blocks.y - point[1]) / unit
    natural = np.ones_like(u) if c is None else (1.0 + (u**2 + v**2) * (unit / c) ** 2) ** -2
    return natural[:, None] * np.column_stack([np.ones_like(u), *(term_values(u, v, t) for t in terms)])


def adjust(
    blocks: Blocks, settings: FallOffSettings, terms: tuple[tuple[int, int], ...], weights: Array | None = None
) -> FallOffFit:
    """Gauss-Newton for the unknowns of the natural part beside the linear ones.

    Weights are those of the blocks, shape (n,); None: all equal.
    """
    free = (("camera constant",) if settings.natural == "estimated" else ()) + (
        ("column of the principal point", "row of the principal point") if settings.estimate_principal_point else ()
    )
    start = settings.principal_point or ((blocks.size[0] - 1) / 2.0, (blocks.size[1] - 1) / 2.0)
    c = settings.camera_constant if settings.natural != "estimated" else _start_constant(blocks, start)
    y = blocks.known
    w = np.ones_like(y) if weights is None else weights
    point = start
    for step in range(40):
        A = columns(blocks, point, c, terms)
        fit = solve(A, y, w)
        linear, residuals = fit.unknowns, -fit.residuals
        change = 0.0
        if free:
            J = np.column_stack([_derivatives(blocks, (point, c), (terms, linear), free), A])
            found = solve(J, residuals, w).unknowns
            point, c, change = _moved(point, c, found, free, blocks.size)
        if weights is None and step < 30:
            size = spread(residuals)
            w = bisquare(residuals / size) if size > 0.0 else np.ones_like(y)
        if step >= 6 and change < 1e-7:
            break
    A = columns(blocks, point, c, terms)
    fit = solve(A, y, w)
    linear, residuals = fit.unknowns, -fit.residuals
    J = np.column_stack([_derivatives(blocks, (point, c), (terms, linear), free), A]) if free else A
    return FallOffFit(
        point=point,
        camera_constant=c,
        terms=terms,
        linear=linear,
        covariance=_covariance(blocks, J, residuals, w),
        weights=w,
        residuals=residuals,
        free=free,
    )


def _start_constant(blocks: Blocks, point: tuple[float, float]) -> float:
    """From the curvature at the principal point, where cos⁴ω falls by 2 r² / c²."""
    A = columns(blocks, point, None, ((1, 1), (1, -1), (2, 0)))
    found = solve(A, blocks.known).unknowns
    fall = -found[3] / found[0]
    if not fall > 1e-4:
        raise GeometryError(
            "the brightness does not fall off from the principal point; no camera constant can be estimated from it. "
            "Give the camera constant, or ask for no natural part"
        )
    return half_diagonal(blocks.size) * math.sqrt(2.0 / fall)


def _derivatives(
    blocks: Blocks,
    place: tuple[tuple[float, float], float | None],
    model: tuple[tuple[tuple[int, int], ...], Array],
    free: tuple[str, ...],
) -> Array:
    """By the logarithm of the camera constant and the principal point in half diagonals, by differences."""
    (point, c), (terms, linear) = place, model
    h, unit = 1e-4, half_diagonal(blocks.size)
    parts = []
    for name in free:
        sides = []
        for sign in (1.0, -1.0):
            p, d = list(point), c
            if name == "camera constant":
                assert c is not None
                d = c * math.exp(sign * h)
            else:
                p[0 if name.startswith("column") else 1] += sign * h * unit
            sides.append(columns(blocks, (p[0], p[1]), d, terms) @ linear)
        parts.append((sides[0] - sides[1]) / (2.0 * h))
    return np.column_stack(parts)


def _moved(
    point: tuple[float, float], c: float | None, found: Array, free: tuple[str, ...], size: tuple[int, int]
) -> tuple[tuple[float, float], float | None, float]:
    unit = half_diagonal(size)
    p, largest = list(point), 0.0
    for name, value in zip(free, found):
        step = float(np.clip(value, -0.3, 0.3))
        largest = max(largest, abs(step))
        if name == "camera constant":
            assert c is not None
            c = float(np.clip(c * math.exp(step), 0.05 * unit, 1e3 * unit))
        else:
            k = 0 if name.startswith("column") else 1
            p[k] = float(np.clip(p[k] + step * unit, -size[k], 2.0 * size[k]))
    return (p[0], p[1]), c, largest


def _covariance(blocks: Blocks, J: Array, residuals: Array, w: Array) -> Array:
    """Of all unknowns; larger by what neighbouring residuals resemble each other, as fewer blocks are independent."""
    used = w > 0.0
    freedom = max(int(used.sum()) - J.shape[1], 1)
    # Weights below 1 make residuals smaller than they are: the variance is that of the spread's robust measure.
    variance = spread(residuals[used]) ** 2 * used.sum() / freedom
    return solve(J, residuals, w).cofactors * variance * blocks.inflation(np.where(used, residuals, np.nan))


def separability(blocks: Blocks, fit: FallOffFit) -> dict[str, float]:
    """For each estimated unknown, the sine of the angle between its effect and what all others can do."""
    J = _derivatives(blocks, (fit.point, fit.camera_constant), (fit.terms, fit.linear), fit.free)
    A = columns(blocks, fit.point, fit.camera_constant, fit.terms)
    whole = np.column_stack([J, A])
    shares = {}
    for k, name in enumerate(fit.free):
        rest = solve(np.delete(whole, k, axis=1), whole[:, k], fit.weights).square
        shares[name] = math.sqrt(rest / float(fit.weights @ whole[:, k] ** 2))
    return shares


def significant(blocks: Blocks, fit: FallOffFit) -> tuple[tuple[int, int], ...]:
    """Terms that are significant after all of lower degree, and those of the same direction below them."""
    if not fit.terms:
        return ()
    root = np.sqrt(fit.weights)
    A = columns(blocks, fit.point, fit.camera_constant, fit.terms) * root[:, None]
    Q, _ = np.linalg.qr(A / np.linalg.norm(A, axis=0))
    used = fit.weights > 0.0
    size = spread(fit.residuals[used])
    size *= math.sqrt(blocks.inflation(np.where(used, fit.residuals, np.nan)))
    effect = np.abs(Q.T @ (blocks.known * root))[1:]
    strong = {term for term, e in zip(fit.terms, effect) if e > SIGNIFICANT * max(size, 1e-300)}
    return tuple(t for t in fit.terms if any(s[1] == t[1] and s[0] >= t[0] for s in strong))


def weakest(fit: FallOffFit) -> tuple[int, int] | None:
    """The least significant term of those that are the highest of their direction; None: all of these count.

    What `significant` keeps may have carried a part of terms of higher degree, since terms are not at right angles to
    each other on a rectangle.
    """
    first = len(fit.free) + 1
    sigmas = np.sqrt(np.maximum(np.diag(fit.covariance)[first:], 1e-300))
    tops = {m: max(n for n, other in fit.terms if other == m) for _, m in fit.terms}
    values = {term: abs(a) / s for term, a, s in zip(fit.terms, fit.linear[1:], sigmas) if tops[term[1]] == term[0]}
    term = min(values, key=values.__getitem__, default=None)
    return term if term is not None and values[term] < SIGNIFICANT else None
