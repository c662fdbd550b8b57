"""Least-squares template matching: the place where a drawn mark fits the grey values best, with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.adjustment.linear import Fit, solve
from photoplan.cameras.mark_pattern import MarkExample, MarkPattern
from photoplan.kernels.correlation import sample_template
from photoplan.orientation.marks.template import draw

_PIXEL = 1 / 12
"""Variance of the area of a pixel about its centre."""
_ITERATIONS = 30
_SMALL = 1e-4
"""Shift in pixels at which the iteration ends."""
_FAR = 3.0
"""Pixels from the start at which it has lost the mark."""
_LAGS = tuple((dy, dx) for dy in range(4) for dx in range(-3, 4) if 0 < dy * dy + dx * dx <= 9 and (dy > 0 or dx > 0))


@dataclass(frozen=True, eq=False)
class FineTemplate:
    """A mark drawn with several samples in a pixel of the scan."""

    values: NDArray[np.float64]
    mask: NDArray[np.float64]
    """1 where it is compared."""
    reference: tuple[float, float]
    """Column and row of the reference point in `values`."""
    over: int
    """Samples in a pixel."""


@dataclass(frozen=True, eq=False)
class Match:
    """Result of least-squares matching."""

    x: float
    y: float
    """Place of the reference point in the window, pixels."""
    covariance: NDArray[np.float64]
    """Of x and y, shape (2, 2), pixels²; residuals that resemble their neighbours count less than independent ones."""
    gain: float
    """Grey values of the image for one of the template."""
    correlation: float
    """Correlation coefficient of image and fitted template."""
    sigma0: float
    """Standard deviation of a grey value."""
    iterations: int


def fine_template(
    pattern: MarkPattern | MarkExample, mm_to_pixel: NDArray[np.float64], blur_px: float, negative: bool
) -> FineTemplate:
    """A mark as the scan's optics blur it and its pixels gather it, sampled more densely than these."""
    coarse = draw(pattern, mm_to_pixel, negative=negative, blur_px=0.0)
    over = 4 if max(coarse.values.shape) < 400 else 2 if max(coarse.values.shape) < 800 else 1
    # An area and a Gaussian of the same variance do not differ by more than a thousandth once they are blurred.
    sigma = over * math.sqrt(blur_px**2 + _PIXEL)
    drawn = draw(pattern, over * np.asarray(mm_to_pixel, float), negative=negative, blur_px=sigma)
    pad = math.ceil((_FAR + 1) * over)
    known = np.pad(drawn.weights > 0.5, pad)
    # Cubic sampling reaches two samples far.
    mask = ndimage.binary_erosion(known, np.ones((5, 5), bool), border_value=0)
    # Pixels near the border of what is compared leave it while the template moves: they find the nearest tone there.
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    values = np.pad(drawn.values.astype(np.float64), pad)[tuple(nearest)]
    x, y = drawn.reference
    return FineTemplate(values, mask.astype(np.float64), (x + pad, y + pad), over)


def match_template(image: NDArray[np.floating], template: FineTemplate, x: float, y: float) -> Match | None:
    """Shift, gain and offset with an even change of brightness, from all pixels that the template covers.

    The image's grey values are observations as they are; the template is moved and sampled, so that noise is not
    smoothed by interpolation. The covariance follows from the normal equations; where residuals resemble those of
    their neighbours (grain, compression, a mark unlike its description) by their correlation up to 3 pixels.
    """
    grey = np.asarray(image, np.float64)
    start = (x, y)
    fitted = None
    # The pixels that are compared are chosen at the start, and once more where that has led.
    for _ in range(2):
        fitted = _fit(grey, template, (x, y), start)
        if fitted is None:
            return None
        x, y = fitted.x, fitted.y
    assert fitted is not None
    return _result(fitted)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Where the iteration ended: place, fit, grey values, template values, pixels that are compared."""

    x: float
    y: float
    fit: Fit
    grey: NDArray[np.float64]
    T: NDArray[np.float64]
    used: NDArray[np.bool_]
    iterations: int


def _fit(
    image: NDArray[np.float64], template: FineTemplate, at: tuple[float, float], start: tuple[float, float]
) -> _Fitted | None:
    """Least squares with the pixels that the template covers at a place; None if it does not converge."""
    x, y = at
    sampled = np.empty((4, *image.shape))
    _sample(template, x, y, sampled)
    used = (sampled[3] > 0.5) & np.isfinite(image)
    if used.sum() < max(30, 0.5 * template.mask.sum() / template.over**2):
        return None
    rows, columns = np.nonzero(used)
    g = image[used]
    flat = np.column_stack([np.ones_like(g), columns - at[0], rows - at[1]])
    gain = float(solve(np.column_stack([sampled[0][used], flat]), g).unknowns[0])
    for iteration in range(1, _ITERATIONS + 1):
        T, Tx, Ty = (layer[used] for layer in sampled[:3])
        A = np.column_stack([-gain * Tx, -gain * Ty, T, flat])
        fit = solve(A, g)
        if fit.rank < A.shape[1]:
            return None
        step = np.clip(fit.unknowns[:2], -0.5, 0.5)
        gain = float(fit.unknowns[2])
        x, y = x + float(step[0]), y + float(step[1])
        if max(abs(x - start[0]), abs(y - start[1])) > _FAR or not math.isfinite(x + y):
            return None
        if np.abs(step).max() < _SMALL:
            return _Fitted(x=x, y=y, fit=fit, grey=g, T=T, used=used, iterations=iteration)
        _sample(template, x, y, sampled)
    return None


def _result(fitted: _Fitted) -> Match:
    fit, g, T = fitted.fit, fitted.grey, fitted.T
    covariance = _covariance(fit.influence, fit.residuals, fitted.used, fit.sigma0)
    trend = fit.A[:, 3:] @ fit.unknowns[3:]
    r = float(np.corrcoef(T, g - trend)[0, 1]) if np.ptp(T) > 0 and np.ptp(g - trend) > 0 else 0.0
    return Match(
        x=fitted.x,
        y=fitted.y,
        covariance=covariance,
        gain=float(fit.unknowns[2]),
        correlation=r,
        sigma0=fit.sigma0,
        iterations=fitted.iterations,
    )


def _sample(template: FineTemplate, x: float, y: float, out: NDArray[np.float64]) -> None:
    k, (rx, ry) = float(template.over), template.reference
    sample_template(template.values, template.mask, np.array([[k, 0.0, rx - k * x], [0.0, k, ry - k * y]]), out)


def _covariance(
    influence: NDArray[np.float64], residuals: NDArray[np.float64], used: NDArray[np.bool_], sigma0: float
) -> NDArray[np.float64]:
    """Covariance of the shift: BᵀCB, with the influence B of each grey value on it and the correlation of residuals."""
    B = np.zeros((2, *used.shape))
    B[:, used] = influence[:2]
    v = np.zeros(used.shape)
    v[used] = residuals
    there = used.astype(float)
    variance = float(residuals @ residuals) / len(residuals)
    meat = np.einsum("irc,jrc->ij", B, B)
    if variance > 0:
        sums: dict[int, list[float]] = {}
        parts: dict[int, NDArray[np.float64]] = {}
        for dy, dx in _LAGS:
            here, other = _shifted(dy, dx)
            key = dy * dy + dx * dx
            count = float((there[here] * there[other]).sum())
            product = float((v[here] * v[other]).sum())
            cross = np.einsum("irc,jrc->ij", B[(slice(None), *here)], B[(slice(None), *other)])
            old = sums.get(key, [0.0, 0.0])
            sums[key] = [old[0] + product, old[1] + count]
            parts[key] = parts.get(key, np.zeros((2, 2))) + cross + cross.T
        for key, (product, count) in sums.items():
            rho = product / max(count, 1.0) / variance
            if rho > 3.0 / math.sqrt(max(count, 1.0)):
                meat = meat + rho * parts[key]
    white = np.einsum("irc,jrc->ij", B, B)
    # Correlated residuals never tell more than independent ones.
    if np.linalg.eigvalsh(meat - white)[0] < 0:
        values, vectors = np.linalg.eigh(meat - white)
        meat = white + (vectors * np.maximum(values, 0.0)) @ vectors.T
    return sigma0**2 * meat


def _shifted(dy: int, dx: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Index of all pixels that have a neighbour at (dy, dx), and of these neighbours; dy ≥ 0."""
    return (
        (slice(0, -dy or None), slice(max(0, -dx), -dx if dx > 0 else None)),
        (slice(dy, None), slice(max(0, dx), dx if dx < 0 else None)),
    )
