"""Marks measured at full resolution where a coarse placement says they lie."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import solve
from photoplan.cameras.mark_pattern import MarkExample, MarkPattern
from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.orientation.marks.edges import fit_edges
from photoplan.orientation.marks.layout import FILM, MarkLayout, MarkPlacement, fit_placement
from photoplan.orientation.marks.locate import BLURS, Location, best_blur, locate_mark
from photoplan.orientation.marks.search import Scan
from photoplan.orientation.marks.template import draw

_BLUR = 0.7
"""Standard deviation of blur with which measuring begins, pixels."""
_NEAR_PX = 3.0
"""Pixels from where the first measurement has a mark in which the second one seeks it."""
_NEAR_MM = 0.35
"""Millimetres from a coarse candidate in which its mark is sought."""
_KNOWN = (0.002, 0.002)
"""Standard deviations of rotation (radians) and scale at a mark, once an affine transformation joins all marks."""
_EDGES_USED, _EDGES_RMS, _EDGES_AGREE = 0.4, 1.5, 1.5
"""Least share of a mark's edges that is seen, their largest distance and difference from the correlation, pixels."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Marks by name, as the placement names them."""

    placement: MarkPlacement
    found: Mapping[str, Location]
    """Places in the scan."""
    missed: Mapping[str, tuple[float, str]]
    """Best correlation and reason of those that were not found."""
    expected: Mapping[str, tuple[float, float]]
    """Column and row where the other marks say each one is."""
    matrix: NDArray[np.float64]
    """From millimetres to columns and rows, as the last templates were drawn, shape (2, 2)."""
    blur_px: float

    @property
    def px_per_mm(self) -> float:
        """Pixels in a millimetre."""
        return math.sqrt(abs(float(np.linalg.det(self.matrix))))


@dataclass(frozen=True, eq=False)
class _Look:
    """How marks look in a round of measuring, and where they are sought."""

    matrix: NDArray[np.float64]
    blur_px: float
    negative: bool
    least: float
    expected: NDArray[np.float64]
    radius: Mapping[str, float]
    sigmas: tuple[float, float] = (0.035, 0.02)
    """Standard deviations of rotation (radians) and scale of the matrix."""


def measure_marks(scan: Scan, layout: MarkLayout, placement: MarkPlacement, least: float) -> Measured:
    """Measure all marks: as the placement draws them, then as the affine transformation and blur so found do."""
    scale = 1.0 / placement.pixel_mm
    wide = FILM * layout.extent * scale + _NEAR_PX
    start = dict.fromkeys(placement.found, _NEAR_MM * scale + _NEAR_PX)
    expected = placement(layout.mm)
    for name, (x, y, _) in placement.found.items():
        expected[layout.names.index(name)] = x, y
    look = _Look(
        matrix=placement.matrix,
        blur_px=_BLUR,
        negative=placement.negative,
        least=least,
        expected=expected,
        radius=start,
    )
    found, missed = _round(scan, layout, look, wide)
    blur = _BLUR
    for _ in range(2):
        matrix, expected = _refit(layout, placement, found)
        blur = _blur(scan, layout, look, found)
        radius = dict.fromkeys(found, _NEAR_PX)
        for name, at in found.items():
            expected[layout.names.index(name)] = at.x, at.y
        look = _Look(
            matrix=matrix,
            blur_px=blur,
            negative=placement.negative,
            least=least,
            expected=expected,
            radius=radius,
            sigmas=_KNOWN,
        )
        found, missed = _round(scan, layout, look, wide)
    _, expected = _refit(layout, placement, found)
    where = {name: (float(x), float(y)) for name, (x, y) in zip(layout.names, expected)}
    return Measured(placement=placement, found=found, missed=missed, expected=where, matrix=look.matrix, blur_px=blur)


def mark_window(scan: Scan, xy: tuple[float, float], half: tuple[int, int]) -> tuple[NDArray[np.float32], int, int]:
    """Grey values around a place, 2 half + 1 pixels wide and high, NaN beyond the scan; column and row of the first."""
    col, row = (round(v) - h for v, h in zip(xy, half))
    width, height = (2 * h + 1 for h in half)
    grey = np.full((height, width), np.nan, np.float32)
    c0, r0 = max(col, 0), max(row, 0)
    c1, r1 = min(col + width, scan.size[0]), min(row + height, scan.size[1])
    if c1 > c0 and r1 > r0:
        grey[r0 - row : r1 - row, c0 - col : c1 - col] = scan.grey(Window(c0, r0, c1 - c0, r1 - r0))
    return grey, col, row


def _round(
    scan: Scan, layout: MarkLayout, look: _Look, wide: float
) -> tuple[dict[str, Location], dict[str, tuple[float, str]]]:
    """Every mark once: those found, and those missed with correlation and reason."""
    found, missed = {}, {}
    for k, name in enumerate(layout.names):
        radius = look.radius.get(name, wide)
        at = _locate(scan, layout, k, look, radius)
        if at is None or not math.isfinite(at.correlation):
            missed[name] = math.nan, "lies outside the scan or on pixels without variation"
        elif at.correlation < look.least:
            missed[name] = at.correlation, f"nothing correlates by {look.least:g}"
        elif at.method == "pixel":
            missed[name] = at.correlation, "the best place lies at the border of the scan or of the search"
        else:
            found[name] = at
    return found, missed


def _locate(scan: Scan, layout: MarkLayout, k: int, look: _Look, radius: float) -> Location | None:
    pattern, (x, y) = layout.patterns[k], look.expected[k]
    template = draw(pattern, look.matrix, negative=look.negative, blur_px=look.blur_px)
    a, b = template.values.shape
    # Three pixels more than the search needs, for the neighbourhood of the maximum and for matching.
    half = tuple(math.ceil(max(r + 1, s - r) + radius) + 4 for r, s in zip(template.reference, (b, a)))
    grey, col, row = mark_window(scan, (x, y), half)
    if not np.isfinite(grey).any():
        return None
    try:
        at = locate_mark(
            grey, pattern, look.matrix, negative=look.negative, blur_px=look.blur_px, near=(x - col, y - row, radius)
        )
    except InputError:
        return None
    return _by_edges(at, grey, pattern, look).moved(col, row)


def _by_edges(at: Location, grey: NDArray[np.float32], pattern: MarkPattern | MarkExample, look: _Look) -> Location:
    """The place by the mark's edges where image content lies beside it; as it was, if they do not confirm it."""
    if not isinstance(pattern, MarkPattern) or not math.isnan(pattern.background) or not math.isfinite(at.x):
        return at
    fit = fit_edges(grey, pattern, look.matrix, (at.x, at.y), negative=look.negative, sigmas=look.sigmas)
    if fit is None or fit.used < _EDGES_USED or fit.rms > _EDGES_RMS:
        return at
    if math.hypot(fit.x - at.x, fit.y - at.y) > _EDGES_AGREE + 3 * math.hypot(fit.sigma_x, fit.sigma_y):
        return at
    return replace(at, x=fit.x, y=fit.y, sigma_x=fit.sigma_x, sigma_y=fit.sigma_y, method="edges")


def _blur(scan: Scan, layout: MarkLayout, look: _Look, found: Mapping[str, Location]) -> float:
    """The blur with which the marks correlate best on the whole."""
    sums = np.zeros(len(BLURS))
    for name, at in found.items():
        k = layout.names.index(name)
        template = draw(layout.patterns[k], look.matrix, blur_px=0.0)
        half = tuple(
            s // 2 + math.ceil(abs(r - s / 2)) + 5 for r, s in zip(template.reference, template.values.shape[::-1])
        )
        grey, col, row = mark_window(scan, (at.x, at.y), half)
        tried = best_blur(grey, layout.patterns[k], look.matrix, (at.x - col, at.y - row), look.negative)
        if np.isfinite(tried).all():
            sums += tried
    if not sums.any():
        return look.blur_px
    k = int(sums.argmax())
    if k in (0, len(BLURS) - 1):
        return BLURS[k]
    # Between the values that were tried: the top of the parabola through the best and its neighbours.
    top = np.polyfit(BLURS[k - 1 : k + 2], sums[k - 1 : k + 2], 2)
    return float(np.clip(-top[1] / (2 * top[0]), BLURS[k - 1], BLURS[k + 1])) if top[0] < 0 else BLURS[k]


def _refit(
    layout: MarkLayout, placement: MarkPlacement, found: Mapping[str, Location]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matrix of the affine transformation (similarity, below four marks), and where it puts all marks."""
    if len(found) < 2:
        return placement.matrix, placement(layout.mm)
    index = [layout.names.index(n) for n in found]
    xy = np.array([(at.x, at.y) for at in found.values()])
    matrix, shift = fit_placement(layout.mm[index], xy, placement.turn.mirrored)
    if len(found) > 3:
        A = np.column_stack([layout.mm[index], np.ones(len(index))])
        if np.linalg.matrix_rank(A, tol=1e-3 * layout.extent) == 3:
            solution = solve(A, xy).unknowns
            matrix, shift = solution[:2].T, solution[2]
    return matrix, layout.mm @ matrix.T + shift
