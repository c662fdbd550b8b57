"""How two sets of the same places on the ground lie to each other: shifted, turned, scaled, scattered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Agreement:
    """A similarity in the plane that takes one set to the other, by least squares; NaN where it is not determined."""

    count: int
    """Places that both sets have."""
    shift: float
    """Distance of the middles, metres."""
    turn: float
    """Rotation, radians, counter-clockwise."""
    sigma_turn: float
    """Its standard deviation, errors of neighbouring places taken as independent."""
    scale: float
    scatter: float
    """Standard deviation of a coordinate about the similarity, metres."""
    spread: float
    """Root mean square distance of the places from their middle, metres."""


def agreement(a: ArrayLike, b: ArrayLike) -> Agreement:
    """Similarity from places `a` to `b`, both (n, 2) or more columns, of which X and Y are used; NaN: not known."""
    p, q = (np.asarray(v, float)[:, :2] @ [1.0, 1.0j] for v in (a, b))
    both = np.isfinite(p) & np.isfinite(q)
    p, q = p[both], q[both]
    n, nan = len(p), float("nan")
    if not n:
        return Agreement(count=0, shift=nan, turn=nan, sigma_turn=nan, scale=nan, scatter=nan, spread=nan)
    shift = abs((q - p).mean())
    p, q = p - p.mean(), q - q.mean()
    square = float((np.abs(p) ** 2).sum())
    spread = float(np.sqrt(square / n))
    if n < 3 or square == 0:
        return Agreement(count=n, shift=shift, turn=nan, sigma_turn=nan, scale=nan, scatter=nan, spread=spread)
    factor = (np.conj(p) @ q) / square
    scatter = float(np.sqrt((np.abs(q - factor * p) ** 2).sum() / (2 * n - 4)))
    turn, scale = float(np.angle(factor)), float(abs(factor))
    return Agreement(
        count=n,
        shift=float(shift),
        turn=turn,
        sigma_turn=scatter / float(np.sqrt(square)),
        scale=scale,
        scatter=scatter,
        spread=spread,
    )


def misfit(a: ArrayLike, b: ArrayLike) -> float:
    """Sum of squared differences of places that both sets know, apart from a common shift, square metres."""
    d = np.asarray(b, float)[:, :2] - np.asarray(a, float)[:, :2]
    d = d[np.isfinite(d).all(axis=1)]
    return float(((d - d.mean(axis=0)) ** 2).sum())
