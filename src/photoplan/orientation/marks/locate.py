"""One mark in a window of a scan: correlation, paraboloid, least-squares matching."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.mark_pattern import MarkExample, MarkPattern
from photoplan.errors import InputError
from photoplan.kernels.correlation import correlate
from photoplan.orientation.marks.match import Match, fine_template, match_template
from photoplan.orientation.marks.template import Template, draw

LEAST_CORRELATION = 0.6
"""Correlation below which a place is no mark: grain and texture stay below it, see the page on fiducial marks."""
AGREE = 0.7
"""Pixels by which matching and paraboloid may differ; beyond, matching has slipped and the paraboloid stands."""
BLURS = (0.0, 0.4, 0.7, 1.0, 1.4, 2.0, 2.8)
"""Standard deviations of blur that are tried, pixels."""
LEAST_SHARE = 0.75
"""Share of the template that must lie on valid pixels."""
_HALF = 2
_Y, _X = (a.ravel().astype(float) for a in np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1])
_DESIGN = np.column_stack([_X**2, _X, _Y**2, _Y, np.ones_like(_X)])
_INVERSE = np.linalg.inv(_DESIGN.T @ _DESIGN)


@dataclass(frozen=True)
class Peak:
    """Place of the highest correlation."""

    x: float
    """Column in the array of coefficients."""
    y: float
    """Row in the array of coefficients."""
    sigma_x: float
    sigma_y: float
    """Standard deviations, from how well the paraboloid fits; pixels."""
    height: float
    """Value of the paraboloid at its top."""


def paraboloid_peak(correlation: NDArray[np.floating], row: int, column: int) -> Peak | None:
    """Top of the paraboloid through the 5 × 5 neighbourhood of a maximum (Behr 1989, eq. 4.2–4.4)."""
    top, left = row - _HALF, column - _HALF
    if top < 0 or left < 0:
        return None
    part = np.asarray(correlation[top : row + _HALF + 1, left : column + _HALF + 1], float)
    if part.shape != (2 * _HALF + 1,) * 2 or not np.isfinite(part).all():
        return None
    z = part.ravel()
    a, b, c, d, e = _INVERSE @ (_DESIGN.T @ z)
    if a >= 0.0 or c >= 0.0:
        return None
    x, y = -b / (2.0 * a), -d / (2.0 * c)
    if max(abs(x), abs(y)) > _HALF:
        return None
    residuals = _DESIGN @ np.array([a, b, c, d, e]) - z
    variance = float(residuals @ residuals) / (len(z) - 5)
    # ∂x/∂(a, b) and ∂y/∂(c, d)
    fx, fy = np.array([-x / a, -0.5 / a]), np.array([-y / c, -0.5 / c])
    sx = math.sqrt(variance * float(fx @ _INVERSE[:2, :2] @ fx))
    sy = math.sqrt(variance * float(fy @ _INVERSE[2:4, 2:4] @ fy))
    return Peak(x=column + x, y=row + y, sigma_x=sx, sigma_y=sy, height=float(e + 0.5 * (b * x + d * y)))


@dataclass(frozen=True, eq=False)
class Location:
    """Where a mark is in a window."""

    x: float
    y: float
    """Column and row of the reference point; NaN if nothing correlates."""
    sigma_x: float
    sigma_y: float
    """Standard deviations, pixels."""
    correlation: float
    """Highest correlation coefficient (Behr 1989, eq. 4.1), at a whole pixel."""
    method: str
    """`matching` (least squares), `paraboloid`, `edges` (by `marks.measure`), or `pixel` where the maximum lies at
    the border of the search."""
    peak: Peak | None
    """Top of the paraboloid (Behr 1989, eq. 4.4), in the window's pixels."""
    match: Match | None
    """Result of least-squares matching; None: it did not converge."""

    def moved(self, columns: float, rows: float) -> Location:
        """The same in pixels of an image in which the window begins at (columns, rows)."""
        peak = self.peak and replace(self.peak, x=self.peak.x + columns, y=self.peak.y + rows)
        match = self.match and replace(self.match, x=self.match.x + columns, y=self.match.y + rows)
        return replace(self, x=self.x + columns, y=self.y + rows, peak=peak, match=match)


def correlation_surface(
    image: NDArray[np.floating], template: Template, least_share: float = LEAST_SHARE
) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """Correlation coefficients of a template at all places of an image."""
    h, w = image.shape
    a, b = template.values.shape
    if h < a or w < b:
        raise InputError(f"window of {w} × {h} px is smaller than the mark's {b} × {a} px; give a larger one")
    surface = np.empty((h - a + 1, w - b + 1))
    correlate(
        np.ascontiguousarray(image, np.float32),
        np.ascontiguousarray(template.values),
        np.ascontiguousarray(template.weights),
        least_share,
        surface,
    )
    return surface, template.reference


def locate_mark(
    image: NDArray[np.floating],
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: NDArray[np.float64],
    *,
    negative: bool = False,
    blur_px: float = 0.7,
    near: tuple[float, float, float] | None = None,
) -> Location:
    """Place of a mark in a window whose scale and rotation are known."""
    surface, (ox, oy) = correlation_surface(image, draw(pattern, mm_to_pixel, negative=negative, blur_px=blur_px))
    if near is not None:
        rows, columns = np.indices(surface.shape)
        far = np.hypot(columns + ox - near[0], rows + oy - near[1]) > near[2]
        inside = np.where(far, np.nan, surface)
    else:
        inside = surface
    if not np.isfinite(inside).any():
        return Location(
            x=math.nan,
            y=math.nan,
            sigma_x=math.nan,
            sigma_y=math.nan,
            correlation=math.nan,
            method="pixel",
            peak=None,
            match=None,
        )
    row, column = np.unravel_index(int(np.nanargmax(inside)), inside.shape)
    r = float(inside[row, column])
    top = paraboloid_peak(surface, int(row), int(column))
    peak = top and Peak(x=top.x + ox, y=top.y + oy, sigma_x=top.sigma_x, sigma_y=top.sigma_y, height=top.height)
    x, y = (peak.x, peak.y) if peak else (column + ox, row + oy)
    match = match_template(image, fine_template(pattern, mm_to_pixel, blur_px, negative), x, y)
    if match is not None and match.gain > 0 and max(abs(match.x - x), abs(match.y - y)) <= AGREE:
        sx, sy = np.sqrt(np.diag(match.covariance))
        return Location(
            x=match.x,
            y=match.y,
            sigma_x=float(sx),
            sigma_y=float(sy),
            correlation=r,
            method="matching",
            peak=peak,
            match=match,
        )
    if peak is not None:
        return Location(
            x=x,
            y=y,
            sigma_x=peak.sigma_x,
            sigma_y=peak.sigma_y,
            correlation=r,
            method="paraboloid",
            peak=peak,
            match=match,
        )
    pixel = math.sqrt(1 / 12)
    return Location(
        x=float(x), y=float(y), sigma_x=pixel, sigma_y=pixel, correlation=r, method="pixel", peak=None, match=match
    )


def best_blur(
    image: NDArray[np.floating],
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: NDArray[np.float64],
    at: tuple[float, float],
    negative: bool,
) -> NDArray[np.float64]:
    """Highest correlation within a pixel of a place, for each of `BLURS`; NaN where the image is too small."""
    found = []
    for blur in BLURS:
        template = draw(pattern, mm_to_pixel, negative=negative, blur_px=blur)
        a, b = template.values.shape
        col, row = (math.floor(at[k] - template.reference[k]) - 1 for k in (0, 1))
        part = image[max(row, 0) : row + a + 4, max(col, 0) : col + b + 4]
        if part.shape[0] < a or part.shape[1] < b:
            found.append(math.nan)
            continue
        surface, _ = correlation_surface(part, template)
        found.append(float(np.nanmax(surface)) if np.isfinite(surface).any() else math.nan)
    return np.array(found)
