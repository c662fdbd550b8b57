"""What many edges of an image say together of its sharpness along rows and along columns."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, radians

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.edges.groups import sigma_of_interval
from photoplan.quality.edges.koelbl import spread_from_response
from photoplan.quality.edges.response import EdgeMeasurement
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.restoration.design import Sharpness

#: Edges that a direction needs.
LEAST_EDGES = 3
#: Pixels to each side that are asked of a spread function; less where edges are not seen as far.
_HALF = 5
#: A mean curve ends where the share of edges that know it falls below this.
_KNOWN = 0.5
#: Share by which the MTF50 of edges may differ from the upper quartile.
_AGREE = 0.08
#: Standard deviation by which the modulation of edges differs besides what they state.
_ALIKE = 0.01
#: Where mean spread and transfer functions are tabulated: pixels, cycles per pixel.
_POSITIONS = np.linspace(-10.0, 10.0, 401)
_FREQUENCIES = np.linspace(0.0, 1.0, 201)


def sharpness_of(edges: Sequence[EdgeMeasurement]) -> tuple[Sharpness, Sharpness, tuple[str, ...]]:
    """Spread function and MTF along rows (x) and along columns (y).

    Edges of the object that are not sharp themselves, such as those of shadows and embankments, are left out, as Kölbl
    sought the sharpest (2006, §3): the edges count whose MTF50 agrees with the upper quartile to 8 % or two of their
    own standard deviations. An edge counts for the direction that brightness rises in, with the cosine of twice its
    angle to it: edges that run diagonally count for neither. It also counts by its length and the square of its
    contrast over noise, up to four times the median edge, so that none decides alone.

    Where one direction has fewer than three edges, that of the other stands for it.
    """
    found = {name: _along(edges, axis) for name, axis in (("x", 0.0), ("y", 90.0))}
    x, y = found["x"], found["y"]
    if x is None and y is None:
        raise InputError(
            f"{len(edges)} edges in all directions; at least {LEAST_EDGES} along rows, or along columns, are needed. "
            "Give images with more edges, or a filter"
        )
    if x is None or y is None:
        one = x or y
        assert one is not None
        return one, one, ("x" if x is None else "y",)
    return x, y, ()


def _along(edges: Sequence[EdgeMeasurement], axis: float) -> Sharpness | None:
    """Sharpness in the direction of an axis, degrees; None if too few edges show it."""
    shares = np.array([max(0.0, cos(2.0 * radians(edge.angle_deg - axis))) for edge in edges])
    used = [edge for edge, share in zip(edges, shares, strict=True) if share > 0.1]
    if len(used) < LEAST_EDGES:
        return None
    # A profile of few phases is a model between its samples, and no help beyond 0.5 cycles/pixel.
    sampled = np.array([edge.sampling == "super-sampled" for edge in used])
    trusted = sampled if sampled.sum() >= LEAST_EDGES else np.ones(len(used), bool)
    strength = np.array([min(edge.snr, 1e6) ** 2 * edge.length for edge in used])
    strength = np.minimum(strength, 4.0 * np.median(strength[trusted])) * shares[shares > 0.1]
    used, strength = [edge for edge, kept in zip(used, trusted, strict=True) if kept], strength[trusted]
    keep = _sharp(used, strength)
    return _together([edge for edge, kept in zip(used, keep, strict=True) if kept], strength[keep])


def _sharp(edges: Sequence[EdgeMeasurement], strength: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which edges agree with the upper quartile of all; at least the three that are nearest to it."""
    mtf50 = np.array([edge.mtf50 for edge in edges])
    sigma = np.array([sigma_of_interval(edge.mtf50_interval, edge.confidence, edge.freedom) for edge in edges])
    known = np.isfinite(mtf50)
    if known.sum() < LEAST_EDGES:
        return np.ones(mtf50.size, bool)
    order = np.argsort(np.where(known, mtf50, np.inf))
    share = np.cumsum(np.where(known, strength, 0.0)[order])
    quartile = float(mtf50[order][int(np.searchsorted(share, 0.75 * share[-1]))])
    apart = np.where(known, np.abs(mtf50 - quartile), np.inf)
    keep = apart <= np.maximum(2.0 * np.nan_to_num(sigma), _AGREE * quartile)
    keep[np.argsort(apart)[:LEAST_EDGES]] = True
    return np.asarray(keep)


def _together(edges: Sequence[EdgeMeasurement], weights: NDArray[np.float64]) -> Sharpness:
    responses = [
        np.interp(_POSITIONS, edge.esf.positions, edge.esf.values, left=np.nan, right=np.nan) for edge in edges
    ]
    response = _mean(np.array(responses), weights[:, None])
    known = np.isfinite(response)
    reach = float(np.abs(_POSITIONS[known]).max()) if known.any() else 0.0
    reach = min(reach, -float(_POSITIONS[known].min()), float(_POSITIONS[known].max())) if known.any() else 0.0
    half = min(_HALF, int(reach - 0.5))
    if half < 1:
        raise InputError("the edges are not seen far enough to both sides for a spread function")
    spread, _ = spread_from_response(_POSITIONS[known], response[known], half)
    curves = [np.interp(_FREQUENCIES, edge.mtf.frequency, edge.mtf.modulation, right=np.nan) for edge in edges]
    own = np.array([_own_sigma(edge.mtf) for edge in edges])
    # What an edge knows of light that is spread far differs more from edge to edge than what it knows of the rest.
    each = weights[:, None] / (own**2 + _ALIKE**2)
    curve = _mean(np.array(curves), each)
    sigma = _sigma_of_mean(np.array(curves) - curve, own, each)
    known = np.isfinite(curve)
    end = int(np.argmin(known)) if not known.all() else known.size
    return Sharpness(spread, MtfCurve(_FREQUENCIES[:end], curve[:end], sigma[:end]))


def _own_sigma(curve: MtfCurve) -> NDArray[np.float64]:
    """Standard deviations that an edge states; 0 if it states none."""
    if curve.sigma is None:
        return np.zeros(_FREQUENCIES.size)
    return np.interp(_FREQUENCIES, curve.frequency, np.nan_to_num(curve.sigma))


def _sigma_of_mean(
    apart: NDArray[np.float64], own: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Standard deviation of a mean curve: the larger of what edges state and what they differ by; all (edges, n)."""
    known = np.isfinite(apart)
    share = np.where(known, weights, 0.0)
    share /= np.maximum(share.sum(axis=0), 1e-300)
    count = np.maximum(known.sum(axis=0), 2)
    stated = (share**2 * own**2).sum(axis=0)
    scatter = (share**2 * np.where(known, apart, 0.0) ** 2).sum(axis=0) * count / (count - 1)
    return np.asarray(np.sqrt(np.maximum(stated, scatter)))


def _mean(values: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weighted mean over the edges that know a place; NaN where too few do. Shapes (edges, n) to (n,)."""
    known = np.isfinite(values)
    each = np.where(known, weights, 0.0)
    total = each.sum(axis=0)
    enough = total >= _KNOWN * weights.sum(axis=0)
    mean = np.where(known, values, 0.0) * each
    return np.where(enough, mean.sum(axis=0) / np.where(enough, total, 1.0), np.nan)
