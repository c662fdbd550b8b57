"""Fiducial marks: layouts, templates drawn at the scale of a scan, location by correlation and matching, targets."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.adjustment.least_squares import Fit, solve
from photoplan.arrays import Floats, Floats32, Mask
from photoplan.cameras.fiducials import FiducialFit, MarkExample, MarkPart, MarkPattern
from photoplan.errors import InputError
from photoplan.kernels.matching import correlate, sample_template
from photoplan.kernels.raster import polygon_coverage

_LARGEST = 4096
"""Side of a template in pixels beyond which the scale must be wrong."""
_SHARP = 0.5
"""Standard deviation in pixels of the area of a pixel, about what a scanner's pixel blurs."""
_GRAIN = 0.8
"""Standard deviation in pixels by which an example is smoothed: interpolation lowers its grain between pixels, and
matching would be drawn there by a quarter of a pixel."""


@dataclass(frozen=True, eq=False)
class Template:
    """A mark in pixels."""

    values: Floats32
    """Grey values, shape (rows, columns); without meaning where the weight is 0."""
    weights: Floats32
    """How much each pixel counts, at least 0; 0: not compared. Same shape."""
    reference: tuple[float, float]
    """Column and row of the mark's reference point in `values`; (0, 0) is the centre of the first pixel."""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape != self.weights.shape:
            raise InputError(f"template of shape {self.values.shape} with weights of shape {self.weights.shape}")


def coverage(outline: Floats, shape: tuple[int, int]) -> Floats:
    """Share of each pixel's area that a polygon covers, exact."""
    total = np.empty((shape[0], shape[1] + 1))
    polygon_coverage(np.asarray(outline, np.float64) + 0.5, total)
    return np.clip(np.abs(total[:, :-1]), 0.0, 1.0)


def render(
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: Floats | Sequence[Sequence[float]],
    *,
    negative: bool = False,
    blur_px: float = 0.7,
    offset: tuple[float, float] = (0.0, 0.0),
) -> Template:
    """A mark as it appears in a scan.

    Parameters
    ----------
    pattern : MarkPattern or MarkExample
        What it looks like.
    mm_to_pixel : (2, 2)
        From millimetres (x right, y up) to columns and rows of the scan: scale, rotation, reflection, shear.
    negative : bool
        Exchange dark and bright.
    blur_px : float
        Standard deviation of the scan's blur in pixels, for drawn patterns; an example has its own.
    offset : (float, float)
        Columns and rows by which the reference point lies beside the centre of a pixel.

    Returns
    -------
    Template
        Values from 0 dark to 1 bright. Where the description states no tone, or more than half of what blurs into a
        pixel has none, the weight is 0.

    Raises
    ------
    InputError
        The matrix has no inverse, the blur is not sensible, or the mark is smaller than 3 pixels or larger than 4096.
    """
    matrix = np.array(mm_to_pixel, np.float64)
    if matrix.shape != (2, 2) or not np.isfinite(matrix).all() or np.linalg.det(matrix) == 0:
        raise InputError(f"mark {pattern.name!r}: scale {matrix.tolist()}; a 2x2 matrix with an inverse is needed")
    if not 0 <= blur_px <= 100:
        raise InputError(f"mark {pattern.name!r}: blur of {blur_px} px; 0 to 100 are allowed")
    shape, at = _frame(pattern, matrix, offset)
    if isinstance(pattern, MarkExample):
        values, weights = _resample(pattern, matrix, shape, at)
    else:
        values, weights = _draw(pattern, matrix, shape, at, blur_px)
    if negative:
        values = np.float32(1.0) - values
    return Template(values, weights, at)


def _corners(pattern: MarkPattern | MarkExample) -> Floats:
    """Corners of what is compared about the reference point, shape (4, 2), millimetres."""
    if isinstance(pattern, MarkPattern):
        x0, y0, x1, y1 = pattern.window
    else:
        rows, columns = pattern.values.shape
        x, y = pattern.reference
        x0, x1 = (-0.5 - x) * pattern.pixel_mm, (columns - 0.5 - x) * pattern.pixel_mm
        y0, y1 = (y - rows + 0.5) * pattern.pixel_mm, (y + 0.5) * pattern.pixel_mm
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _frame(
    pattern: MarkPattern | MarkExample, matrix: Floats, offset: tuple[float, float]
) -> tuple[tuple[int, int], tuple[float, float]]:
    """Rows and columns of the template, and where the reference point is in it."""
    corners = _corners(pattern) @ matrix.T + offset
    # The window's outline may fall on a pixel's border by rounding: a thousandth of a pixel is no pixel more.
    first = np.floor(corners.min(axis=0) + 0.501).astype(np.int64)
    last = np.ceil(corners.max(axis=0) - 0.501).astype(np.int64)
    columns, rows = (last - first + 1).tolist()
    if min(rows, columns) < 3 or max(rows, columns) > _LARGEST:
        raise InputError(
            f"mark {pattern.name!r}: {columns} x {rows} px at this scale; 3 to {_LARGEST} are allowed. "
            "Check the size of the mark and of the scan's pixels"
        )
    return (rows, columns), (float(offset[0] - first[0]), float(offset[1] - first[1]))


def _draw(
    pattern: MarkPattern, matrix: Floats, shape: tuple[int, int], at: tuple[float, float], blur_px: float
) -> tuple[Floats32, Floats32]:
    """Values and weights of a drawn pattern; each part covers those before it in proportion to its share of a pixel."""
    margin = int(np.ceil(4 * blur_px)) + 1
    wide = (shape[0] + 2 * margin, shape[1] + 2 * margin)
    origin = np.add(at, margin)
    known = np.full(wide, 0.0 if np.isnan(pattern.background) else 1.0)
    tones = known * np.nan_to_num(pattern.background)
    for part in pattern.parts:
        outline = part.outline @ matrix.T + origin
        first = np.clip(np.floor(outline.min(axis=0)), 0, (wide[1], wide[0])).astype(np.int64)
        last = np.clip(np.ceil(outline.max(axis=0)) + 1, first, (wide[1], wide[0])).astype(np.int64)
        box = (slice(first[1], last[1]), slice(first[0], last[0]))
        if known[box].size == 0:
            continue
        share = coverage(outline - first, known[box].shape)
        known[box] *= 1 - share
        tones[box] *= 1 - share
        if not np.isnan(part.tone):
            known[box] += share
            tones[box] += share * part.tone
    if blur_px > 0:
        known = ndimage.gaussian_filter(known, blur_px, mode="nearest")
        tones = ndimage.gaussian_filter(tones, blur_px, mode="nearest")
    inner = (slice(margin, -margin), slice(margin, -margin))
    known, tones = known[inner], tones[inner]
    window = coverage(_corners(pattern) @ matrix.T + at, shape)
    weights = np.clip(2 * known - 1, 0.0, 1.0) * window
    values = np.divide(tones, known, out=np.zeros(shape), where=known > 0.5)
    return values.astype(np.float32), weights.astype(np.float32)


def _resample(
    example: MarkExample, matrix: Floats, shape: tuple[int, int], at: tuple[float, float]
) -> tuple[Floats32, Floats32]:
    """Values and weights of an example, cubic; smoothed first, more where the scan's pixels are larger than its own."""
    given = np.asarray(example.values, np.float64)
    valid = np.isfinite(given)
    if not valid.any() or np.ptp(given[valid]) == 0:
        raise InputError(f"example of mark {example.name!r} has no contrast; cut another one")
    low, high = given[valid].min(), given[valid].max()
    known = valid.astype(np.float64)
    tones = np.where(valid, (given - low) / (high - low), 0.0)
    larger = 1 / (example.pixel_mm * np.sqrt(abs(np.linalg.det(matrix))))
    sigma = max(_GRAIN, _SHARP * np.sqrt(max(larger**2 - 1, 0.0)))
    known = ndimage.gaussian_filter(known, sigma, mode="nearest")
    tones = ndimage.gaussian_filter(tones, sigma, mode="nearest")
    rows, columns = np.indices(shape, dtype=np.float64)
    millimetres = np.stack([columns - at[0], rows - at[1]], axis=-1) @ np.linalg.inv(matrix).T
    column = example.reference[0] + millimetres[..., 0] / example.pixel_mm
    row = example.reference[1] - millimetres[..., 1] / example.pixel_mm
    sampled = [ndimage.map_coordinates(each, [row, column], order=3, mode="mirror") for each in (known, tones)]
    height, width = given.shape
    least, right, bottom = -1e-6, width - 1 + 1e-6, height - 1 + 1e-6
    inside = (column >= least) & (column <= right) & (row >= least) & (row <= bottom)
    weights = np.where(inside, np.clip(2 * sampled[0] - 1, 0.0, 1.0), 0.0)
    values = np.divide(sampled[1], sampled[0], out=np.zeros(shape), where=sampled[0] > 0.5)
    return values.astype(np.float32), weights.astype(np.float32)


def draw(
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: Floats | Sequence[Sequence[float]],
    *,
    negative: bool = False,
    blur_px: float = 0.7,
) -> Template:
    """What `render` draws, or drew for the same pattern, matrix, tone and blur; see there."""
    matrix = np.asarray(mm_to_pixel, float)
    return _drawn(pattern, matrix.shape, tuple(matrix.ravel().tolist()), negative, float(blur_px))


@lru_cache(maxsize=48)
def _drawn(
    pattern: MarkPattern | MarkExample, shape: tuple[int, int], matrix: tuple[float, ...], negative: bool, blur: float
) -> Template:
    return render(pattern, np.array(matrix).reshape(shape), negative=negative, blur_px=blur)


FILM = 0.005
"""Part of the marks' extent by which film and scanner move a mark at most against a similarity."""
SMALL_TURN = math.radians(6.0)
"""Rotation of the film on the scanner beside a multiple of 90°, radians."""
FLOOR = 0.3
"""Correlation that texture reaches by chance: only what exceeds it speaks for a placement."""
RIVAL = 0.85
"""Share of the chosen candidate's correlation from which another one is reported."""


#: Marks with arms, which lie in any direction.
TURNABLE = ("cross", "ring_cross", "dot_cross")


@dataclass(frozen=True, eq=False)
class MarkLayout:
    """Calibrated marks and what each looks like."""

    names: tuple[str, ...]
    mm: Floats
    """Coordinates in the image plane, x right, y up, millimetres, shape (n, 2)."""
    patterns: tuple[MarkPattern | MarkExample, ...]

    def __post_init__(self) -> None:
        if self.mm.shape != (len(self.names), 2) or len(self.patterns) != len(self.names):
            raise InputError(f"{len(self.names)} marks, {self.mm.shape} coordinates and {len(self.patterns)} patterns")

    @classmethod
    def of(
        cls, marks: Mapping[str, tuple[float, float]], patterns: Mapping[str, MarkPattern | MarkExample]
    ) -> MarkLayout:
        """From tables by name."""
        bare = [name for name in marks if name not in patterns]
        if bare:
            raise InputError(f"fiducial mark {', '.join(map(repr, bare))}: what it looks like is not described")
        mm = np.array([marks[n] for n in marks], float).reshape(-1, 2)
        return cls(tuple(marks), mm, tuple(patterns[n] for n in marks))

    def with_marks(self, factor: float) -> MarkLayout:
        """The same places with marks of another size."""
        return replace(self, patterns=tuple(pattern.scaled(factor) for pattern in self.patterns))

    def with_turned_marks(self, degrees: float) -> MarkLayout | None:
        """The same places with marks turned anticlockwise; None if this changes nothing or a mark is an example."""
        if any(isinstance(p, MarkExample) or p.name not in TURNABLE for p in self.patterns):
            return None
        return replace(self, patterns=tuple(p.turned(degrees) for p in self.patterns if isinstance(p, MarkPattern)))

    @property
    def extent(self) -> float:
        """Longer side of the rectangle around all marks, millimetres."""
        return float(np.ptp(self.mm, axis=0).max())


@dataclass(frozen=True)
class ScanTurn:
    """How the upright picture was turned before it was scanned."""

    rotation: int
    """Degrees counter-clockwise, as one looks at the scan: 0, 90, 180, 270."""
    mirrored: bool
    """Left and right were exchanged, before it was turned."""

    @property
    def matrix(self) -> Floats:
        """From millimetres (x right, y up) to directions of columns and rows, shape (2, 2)."""
        c, s = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][self.rotation // 90]
        sign = -1.0 if self.mirrored else 1.0
        return np.array([[c * sign, -s], [-s * sign, -c]])

    def __str__(self) -> str:
        return f"{self.rotation}°{' mirrored' if self.mirrored else ''}"


TURNS = tuple(ScanTurn(rotation, mirrored) for mirrored in (False, True) for rotation in (0, 90, 180, 270))


@dataclass(frozen=True, eq=False)
class MarkPlacement:
    """A similarity from the image plane to the scan, and the candidates that it joins."""

    turn: ScanTurn
    negative: bool
    matrix: Floats
    """From millimetres to columns and rows, shape (2, 2)."""
    shift: Floats
    """Column and row of the image plane's origin."""
    found: Mapping[str, tuple[float, float, float]]
    """Column, row and correlation of each mark that has a candidate where the others say."""
    score: float
    """Sum of the correlations beyond what chance gives."""
    rivals: tuple[tuple[str, float, float, float], ...] = ()
    """Look-alikes that were not chosen: name of the mark, column, row, correlation."""

    @property
    def pixel_mm(self) -> float:
        """Side of a pixel, millimetres."""
        return 1.0 / math.sqrt(abs(float(np.linalg.det(self.matrix))))

    def __call__(self, mm: Floats) -> Floats:
        """Points of the image plane (..., 2) to column and row."""
        return mm @ self.matrix.T + self.shift


def fit_placement(mm: Floats, xy: Floats, mirrored: bool) -> tuple[Floats, Floats]:
    """Matrix (2, 2) and shift (2,) of the similarity that fits points best; two points at least."""
    # As complex numbers; rows run down, so that an upright scan mirrors the plane, and a mirrored one does not.
    z = mm[:, 0] + 1j * mm[:, 1]
    w = xy[:, 0] + 1j * xy[:, 1]
    if not mirrored:
        z = z.conj()
    dz, dw = z - z.mean(), w - w.mean()
    k = complex((dz.conj() @ dw) / (dz.conj() @ dz).real)
    sign = 1.0 if mirrored else -1.0
    matrix = np.array([[k.real, -sign * k.imag], [k.imag, sign * k.real]])
    return matrix, xy.mean(axis=0) - matrix @ mm.mean(axis=0)


def combine(
    layout: MarkLayout,
    candidates: Sequence[Floats],
    turn: ScanTurn,
    negative: bool,
    px_per_mm: float,
    scale_tolerance: float,
    blunt: float,
) -> MarkPlacement | None:
    """The similarity that joins the most and best candidates.

    Every pair of candidates of every pair of marks gives one; it is dropped where scale or rotation are impossible,
    and scored by what the other marks have near the places that it predicts.
    """
    best: tuple[float, int, int, int, int] | None = None
    gate = FILM * layout.extent * px_per_mm + blunt
    for i, j in itertools.combinations(range(len(layout.names)), 2):
        if not (len(candidates[i]) and len(candidates[j])):
            continue
        scores = _scores(layout, candidates, (i, j), turn, px_per_mm, scale_tolerance, gate)
        a, b = divmod(int(scores.argmax()), scores.shape[1])
        if scores[a, b] > 0 and (best is None or scores[a, b] > best[0]):
            best = float(scores[a, b]), i, j, a, b
    if best is None:
        return None
    total, i, j, a, b = best
    pair = np.array([candidates[i][a, :2], candidates[j][b, :2]])
    matrix, shift = fit_placement(layout.mm[[i, j]], pair, turn.mirrored)
    found = {}
    for k, name in enumerate(layout.names):
        nearest = _best_near(candidates[k], layout.mm[k] @ matrix.T + shift, gate)
        if nearest is not None:
            found[name] = nearest
    index = [layout.names.index(n) for n in found]
    matrix, shift = fit_placement(layout.mm[index], np.array([f[:2] for f in found.values()]), turn.mirrored)
    rivals = _rivals(layout, candidates, found, blunt)
    return MarkPlacement(
        turn=turn, negative=negative, matrix=matrix, shift=shift, found=found, score=total, rivals=rivals
    )


def _rivals(
    layout: MarkLayout, candidates: Sequence[Floats], found: Mapping[str, tuple[float, float, float]], blunt: float
) -> tuple[tuple[str, float, float, float], ...]:
    """Candidates nearly as good as the chosen one that are no other mark."""
    rivals = []
    for name, listed in zip(layout.names, candidates):
        if name not in found:
            continue
        for x, y, r in listed:
            taken = any(math.hypot(x - f[0], y - f[1]) <= 2 * blunt for f in found.values())
            if r >= RIVAL * found[name][2] and not taken:
                rivals.append((name, float(x), float(y), float(r)))
    return tuple(rivals)


def _scores(
    layout: MarkLayout,
    candidates: Sequence[Floats],
    pair: tuple[int, int],
    turn: ScanTurn,
    px_per_mm: float,
    scale_tolerance: float,
    gate: float,
) -> Floats:
    """Score of every pair of candidates of two marks, shape (k_i, k_j); −1: impossible."""
    i, j = pair
    ci, cj = candidates[i], candidates[j]
    mm = layout.mm[:, 0] + 1j * layout.mm[:, 1]
    z = mm if turn.mirrored else mm.conj()
    wi, wj = ci[:, 0] + 1j * ci[:, 1], cj[:, 0] + 1j * cj[:, 1]
    k = (wj[None, :] - wi[:, None]) / (z[j] - z[i])
    direction = turn.matrix[:, 0] @ np.array([1.0, 1j])
    angle = np.abs(np.angle(k / direction))
    fits = (np.abs(np.abs(k) / px_per_mm - 1.0) <= scale_tolerance) & (angle <= SMALL_TURN)
    score = ci[:, None, 2] + cj[None, :, 2] - 2 * FLOOR
    for m in range(len(layout.names)):
        if m in pair or not len(candidates[m]):
            continue
        predicted = wi[:, None] + k * (z[m] - z[i])
        wm = candidates[m][:, 0] + 1j * candidates[m][:, 1]
        near = np.abs(predicted[..., None] - wm) <= gate
        score = score + np.where(near, candidates[m][:, 2] - FLOOR, 0.0).max(axis=-1)
    return np.where(fits, score, -1.0)


def _best_near(candidates: Floats, xy: Floats, gate: float) -> tuple[float, float, float] | None:
    near = candidates[np.hypot(*(candidates[:, :2] - xy).T) <= gate] if len(candidates) else candidates
    if not len(near):
        return None
    x, y, r = near[int(near[:, 2].argmax())]
    return float(x), float(y), float(r)


@dataclass(frozen=True, eq=False)
class LocatedMark:
    """A mark where it was found."""

    name: str
    x: float
    y: float
    """Column and row of its reference point, (0, 0) the centre of the upper-left pixel."""
    sigma_x: float
    sigma_y: float
    """Standard deviations, pixels."""
    correlation: float
    """With the template, at the nearest whole pixel."""
    method: str
    """`matching` (least squares), `paraboloid`, or `edges` where image content lies beside the mark."""
    paraboloid: tuple[float, float] | None
    """Column and row by the paraboloid (Behr 1989, eq. 4.4)."""
    matching: tuple[float, float] | None
    """Column and row by least-squares matching; None: it did not converge."""


@dataclass(frozen=True)
class MissingMark:
    """A mark that was not found."""

    name: str
    correlation: float
    """The best near where the other marks say; NaN: that lies outside the scan."""
    x: float
    y: float
    """Where the other marks say, column and row."""
    reason: str


@dataclass(frozen=True, eq=False)
class FiducialResult:
    """Marks of a scan and its interior orientation."""

    marks: tuple[LocatedMark, ...]
    missing: tuple[MissingMark, ...]
    fit: FiducialFit
    """Affine transformation from millimetres to pixels."""
    residuals_um: Floats
    """Transformed minus measured position of each mark in `fit`, in the image plane (x right, y up), micrometres."""
    turn: ScanTurn
    """How the upright picture was turned before it was scanned."""
    negative: bool
    blur_px: float
    """Standard deviation of the scan's blur that fits best, pixels."""
    placement: MarkPlacement
    """The similarity that led to the marks."""
    notes: tuple[str, ...]
    """What a user should know, one sentence each."""

    @property
    def pixel_mm(self) -> float:
        """Side of a pixel on the film, millimetres."""
        t = self.fit.transformation.derivative(np.zeros(2))
        return 1.0 / math.sqrt(abs(float(np.linalg.det(t))))

    @property
    def sigma0_um(self) -> float:
        """Standard deviation of a coordinate from the residuals, micrometres; NaN with three marks."""
        return self.fit.sigma0 * self.pixel_mm * 1000.0


@dataclass(frozen=True)
class SoughtMark:
    """Where a mark of a scan was sought that cannot be oriented."""

    name: str
    x: float
    y: float
    """Column and row: where it was found, or where it is expected."""
    found: bool
    correlation: float
    """The best there; NaN: none."""


class MarksNotFound(InputError):
    """Fewer than three marks of a scan were found."""

    def __init__(self, message: str, sought: tuple[SoughtMark, ...]) -> None:
        super().__init__(message)
        self.sought = sought


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

    values: Floats
    mask: Floats
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
    covariance: Floats
    """Of x and y, shape (2, 2), pixels²; residuals that resemble their neighbours count less than independent ones."""
    gain: float
    """Grey values of the image for one of the template."""
    correlation: float
    """Correlation coefficient of image and fitted template."""
    sigma0: float
    """Standard deviation of a grey value."""
    iterations: int


def fine_template(
    pattern: MarkPattern | MarkExample, mm_to_pixel: Floats, blur_px: float, negative: bool
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
    grey: Floats
    T: Floats
    used: Mask
    iterations: int


def _fit(image: Floats, template: FineTemplate, at: tuple[float, float], start: tuple[float, float]) -> _Fitted | None:
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


def _sample(template: FineTemplate, x: float, y: float, out: Floats) -> None:
    k, (rx, ry) = float(template.over), template.reference
    sample_template(template.values, template.mask, np.array([[k, 0.0, rx - k * x], [0.0, k, ry - k * y]]), out)


def _covariance(influence: Floats, residuals: Floats, used: Mask, sigma0: float) -> Floats:
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
        parts: dict[int, Floats] = {}
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
) -> tuple[Floats, tuple[float, float]]:
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
    mm_to_pixel: Floats,
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
    mm_to_pixel: Floats,
    at: tuple[float, float],
    negative: bool,
) -> Floats:
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


_SMALLEST, _MARGIN = 2.0, 3.0
"""Least diameter, and background that is compared around the target, pixels."""
_STEPS = 8
"""Steps of a pixel in which discs are drawn: a disc that is a little too large or small lies where it lies."""


@dataclass(frozen=True, eq=False)
class MarkTarget:
    """A round target."""

    location: Location
    """Its middle in the window."""
    diameter: float
    """Pixels, at half of its contrast."""
    bright: bool
    """Whether it is brighter than what surrounds it."""


def locate_target(image: NDArray[np.floating], *, bright: bool = True) -> MarkTarget:
    """Middle and diameter of the one round target in a window (Behr 1989, §4.1.1, eq. 4.1–4.4).

    Halfway between the extreme grey values lies the threshold; the largest extent of what exceeds it, in rows and
    columns, is the diameter. A disc of this size is then drawn, with the edge as wide as it fits best, and located by
    correlation, paraboloid and least-squares matching. Unlike the source, only the largest connected piece beyond the
    threshold is measured: a bright grain elsewhere would enlarge the target.
    """
    grey = np.asarray(image, float) if bright else -np.asarray(image, float)
    if grey.ndim != 2 or not np.isfinite(grey).any() or np.nanmax(grey) <= np.nanmin(grey):
        raise InputError("window without variation of grey values: no target in it")
    # Behind a median a single grain is no extreme.
    calm = ndimage.median_filter(np.where(np.isfinite(grey), grey, np.nanmin(grey)), 3)
    beyond = calm > (calm.min() + calm.max()) / 2
    pieces, count = ndimage.label(beyond)
    if not count:
        raise InputError("window without variation of grey values: no target in it")
    sizes = ndimage.sum_labels(beyond, pieces, np.arange(1, count + 1))
    piece = pieces == 1 + int(np.argmax(sizes))
    rows, columns = np.nonzero(piece)
    diameter = float(max(piece.sum(axis=0).max(), piece.sum(axis=1).max()))
    where = f"target of {diameter:.0f} px near column {columns.mean():.0f}, row {rows.mean():.0f}"
    if diameter < _SMALLEST:
        raise InputError(f"{where}: too small to be measured; scan it more finely")
    half = diameter / 2 + _MARGIN
    if (
        min(columns.mean(), rows.mean()) < half
        or (np.array(grey.shape)[::-1] - 1 - (columns.mean(), rows.mean()) < half).any()
    ):
        raise InputError(f"{where}: touches the border of the window; give a larger window, or another one")
    near = float(columns.mean()), float(rows.mean())
    one = np.array([[1.0, 0.0], [0.0, -1.0]])
    # The area at half contrast is that of the disc, whatever the blur.
    area = _area(grey, piece)
    diameter = 2 * math.sqrt(area / math.pi)
    disc = _disc(round(diameter * _STEPS) / _STEPS)
    tried = best_blur(grey, disc, one, near, False)
    blur = BLURS[int(np.nanargmax(tried))] if np.isfinite(tried).any() else 0.7
    at = locate_mark(grey, disc, one, blur_px=blur, near=(*near, half))
    if not at.correlation >= LEAST_CORRELATION:
        raise InputError(
            f"{where}: correlates by {at.correlation:.2f} with a disc, less than {LEAST_CORRELATION:g}: no round target"
        )
    return MarkTarget(at, diameter, bright)


def _area(grey: Floats, piece: Mask) -> float:
    """Area of a target in pixels: its grey values above the background, divided by its contrast."""
    wide = ndimage.binary_dilation(piece, iterations=4)
    ring = ndimage.binary_dilation(wide, iterations=2) & ~wide & np.isfinite(grey)
    background = float(np.median(grey[ring])) if ring.any() else float(np.nanmin(grey))
    core = ndimage.binary_erosion(piece, iterations=2)
    top = float(np.median(grey[core])) if core.sum() >= 5 else float(np.nanmax(grey[piece]))
    inside = wide & np.isfinite(grey)
    return max(float((grey[inside] - background).sum()) / (top - background), 1.0)


@lru_cache(maxsize=16)
def _disc(diameter: float) -> MarkPattern:
    """The same object for the same diameter, so that templates of a target in many frames are drawn once."""
    angle = np.linspace(0, 2 * math.pi, 72, endpoint=False)
    circle = diameter / 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    half = diameter / 2 + _MARGIN - 0.5
    return MarkPattern("target", (MarkPart(circle, 1.0),), 0.0, (-half, -half, half, half))
