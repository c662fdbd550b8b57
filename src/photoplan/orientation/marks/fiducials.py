"""The search for the fiducial marks of a scan, without approximate values, and their measurement."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from scipy import ndimage

from photoplan.adjustment.least_squares import solve
from photoplan.arrays import Floats, Floats32
from photoplan.cameras.fiducials import FiducialFit, MarkExample, MarkPattern, fit_affine
from photoplan.errors import InputError, PhotoplanError
from photoplan.geometry.grid import Window
from photoplan.orientation.marks.locate import (
    BLURS,
    FILM,
    FLOOR,
    LEAST_CORRELATION,
    TURNS,
    FiducialResult,
    LocatedMark,
    Location,
    MarkLayout,
    MarkPlacement,
    MarksNotFound,
    MissingMark,
    ScanTurn,
    SoughtMark,
    Template,
    best_blur,
    combine,
    correlation_surface,
    draw,
    fit_placement,
    locate_mark,
)
from photoplan.orientation.marks.single import fit_edges

SIDE = 20
"""Pixels that the smaller side of the smallest mark has in the coarse search, about."""
CANDIDATES = 12
"""Candidates of a mark and tone."""
SLACK_MM = 2.0
"""How far a mark may lie beyond where the scan's outline lets it."""
STEP = 0.04
"""Relative step of the scales that are tried."""
WIDEST = 1.36
"""How much larger than the marks' extent a scan's shorter side may be when its scale is not known."""
USUAL = 1.13
"""How much larger it mostly is."""
SURE = 0.45
"""Correlation per mark beyond chance, with all marks found, at which no other scale is tried."""


class Scan(Protocol):
    """Grey values of a scan, by windows."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        ...

    def grey(self, window: Window, factor: int = 1) -> Floats32:
        """Means of blocks of `factor` × `factor` pixels of a window whose sides it divides; NaN: no valid pixel."""
        ...


@dataclass(frozen=True, eq=False)
class MarkSearch:
    """What is sought in which scan."""

    scan: Scan
    layout: MarkLayout
    turns: tuple[ScanTurn, ...]
    """Turns of the film that come into question."""
    negatives: tuple[bool, ...]
    """Tones that come into question."""
    scale_tolerance: float = STEP
    """Part of the scale by which the true one may differ from those that are tried."""
    _surfaces: dict[tuple[int, int, Window], Floats] = field(default_factory=dict, repr=False)
    _templates: list[tuple[int, float, Template]] = field(default_factory=list, repr=False)


def pixel_sizes(layout: MarkLayout, size: tuple[int, int]) -> tuple[float, ...]:
    """Sides of a pixel in millimetres that are worth trying for a scan of unknown resolution, the likely ones first.

    All marks lie in the scan, and its shorter side is not much longer than their extent.
    """
    short = min(np.ptp(layout.mm, axis=0))
    short = float(short) if short > 0.5 * layout.extent else layout.extent
    count = math.ceil(math.log(WIDEST) / STEP)
    wider = [1.01 * WIDEST ** (k / count) for k in range(count + 1)]
    return tuple(short * w / min(size) for w in sorted(wider, key=lambda w: abs(math.log(w / USUAL))))


def search_placements(search: MarkSearch, pixels_mm: Sequence[float]) -> list[MarkPlacement]:
    """The best placement for every turn and tone, best first."""
    best: dict[tuple[ScanTurn, bool], MarkPlacement] = {}
    for pixel_mm in pixels_mm:
        search._surfaces.clear()
        search._templates.clear()
        factor = _factor(search.layout, pixel_mm)
        for turn in search.turns:
            surfaces = [_surface(search, k, turn, pixel_mm, factor) for k in range(len(search.layout.names))]
            for negative in search.negatives:
                peaks = [_peaks(s, negative, factor) for s in surfaces]
                found = combine(
                    search.layout, peaks, turn, negative, 1 / pixel_mm, search.scale_tolerance, 2.0 * factor
                )
                key = turn, negative
                if found is not None and (key not in best or found.score > best[key].score):
                    best[key] = found
        if any(p.score >= SURE * len(p.found) and len(p.found) == len(search.layout.names) for p in best.values()):
            break
    return sorted(best.values(), key=lambda p: -p.score)


@dataclass(frozen=True, eq=False)
class _Surface:
    values: Floats
    origin: tuple[float, float]
    """Column and row in the scan of values[0, 0]."""
    apart: int
    """Two candidates are not nearer than this, coarse pixels."""


def _factor(layout: MarkLayout, pixel_mm: float) -> int:
    """Pixels of the scan in a coarse one."""
    side = min(_side(pattern) for pattern in layout.patterns)
    return max(1, round(side / SIDE / pixel_mm))


def _side(pattern: MarkPattern | MarkExample) -> float:
    """Shorter side of what is compared, millimetres."""
    if isinstance(pattern, MarkExample):
        return min(pattern.values.shape) * pattern.pixel_mm
    x0, y0, x1, y1 = pattern.window
    return min(x1 - x0, y1 - y0)


def _surface(search: MarkSearch, k: int, turn: ScanTurn, pixel_mm: float, factor: int) -> _Surface | None:
    """Correlation of mark k with all places where it may lie; None: nowhere."""
    index, template = _template(search, search.layout.patterns[k], turn, pixel_mm * factor)
    region = _region(search, k, turn, pixel_mm, factor)
    if region is None:
        return None
    a, b = template.values.shape
    rx, ry = (math.ceil(v) for v in template.reference)
    # The template may reach beyond the scan, where nothing is compared.
    x0, y0 = region.col - rx, region.row - ry
    key = index, factor, Window(x0 + 10**6, y0 + 10**6, region.width + b, region.height + a)
    if key not in search._surfaces:
        grey = _padded(search.scan, x0, y0, region.width + b, region.height + a, factor)
        search._surfaces[key] = correlation_surface(grey, template)[0]
    ox, oy = x0 + template.reference[0], y0 + template.reference[1]
    half = (factor - 1) / 2
    return _Surface(search._surfaces[key], (factor * ox + half, factor * oy + half), max(2, round(0.5 * min(a, b))))


def _template(
    search: MarkSearch, pattern: MarkPattern | MarkExample, turn: ScanTurn, coarse_mm: float
) -> tuple[int, Template]:
    """Number and template of a pattern; turns that leave it as it is share one."""
    made = draw(pattern, turn.matrix / coarse_mm, blur_px=0.7)
    for number, (owner, size, other) in enumerate(search._templates):
        same = owner == id(pattern) and size == coarse_mm and other.values.shape == made.values.shape
        if same and np.allclose(other.values, made.values, atol=0.02) and np.allclose(other.weights, made.weights):
            return number, other
    search._templates.append((id(pattern), coarse_mm, made))
    return len(search._templates) - 1, made


def _region(search: MarkSearch, k: int, turn: ScanTurn, pixel_mm: float, factor: int) -> Window | None:
    """Coarse pixels where mark k may lie if all marks lie in the scan, turned by a few degrees; None: nowhere."""
    places = search.layout.mm @ turn.matrix.T / pixel_mm
    low, high = places.min(axis=0), places.max(axis=0)
    tolerance = (SLACK_MM + 0.035 * search.layout.extent) / pixel_mm
    size = np.array(search.scan.size, float)
    slack = size - (high - low)
    if (slack < -tolerance).any():
        return None
    first = np.clip(places[k] - low - tolerance + np.minimum(slack, 0), 0, size - 1)
    last = np.clip(places[k] - low + np.maximum(slack, 0) + tolerance, 0, size - 1)
    (c0, r0), (c1, r1) = np.floor(first / factor).astype(int), np.ceil(last / factor).astype(int)
    return Window(int(c0), int(r0), int(c1 - c0 + 1), int(r1 - r0 + 1))


def _padded(scan: Scan, col: int, row: int, width: int, height: int, factor: int) -> Floats32:
    """Coarse pixels of a window that may leave the scan, where they are NaN."""
    most = Window(0, 0, scan.size[0] // factor, scan.size[1] // factor)
    c0, r0 = max(col, 0), max(row, 0)
    c1, r1 = min(col + width, most.width), min(row + height, most.height)
    grey = np.full((height, width), np.nan, np.float32)
    if c1 > c0 and r1 > r0:
        window = Window(c0 * factor, r0 * factor, (c1 - c0) * factor, (r1 - r0) * factor)
        grey[r0 - row : r1 - row, c0 - col : c1 - col] = scan.grey(window, factor)
    return grey


def _peaks(surface: _Surface | None, negative: bool, factor: int) -> Floats:
    """Highest local maxima (minima of a negative): column, row in the scan, correlation; shape (k, 3)."""
    if surface is None:
        return np.empty((0, 3))
    values = np.nan_to_num(-surface.values if negative else surface.values, nan=-1.0)
    top = (ndimage.maximum_filter(values, 2 * surface.apart + 1, mode="constant", cval=-1.0) == values) & (
        values > FLOOR
    )
    rows, columns = np.nonzero(top)
    order = np.argsort(-values[rows, columns], kind="stable")[:CANDIDATES]
    rows, columns = rows[order], columns[order]
    x, y = columns * factor + surface.origin[0], rows * factor + surface.origin[1]
    return np.column_stack([x, y, values[rows, columns]])


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
    matrix: Floats
    """From millimetres to columns and rows, as the last templates were drawn, shape (2, 2)."""
    blur_px: float

    @property
    def px_per_mm(self) -> float:
        """Pixels in a millimetre."""
        return math.sqrt(abs(float(np.linalg.det(self.matrix))))


@dataclass(frozen=True, eq=False)
class _Look:
    """How marks look in a round of measuring, and where they are sought."""

    matrix: Floats
    blur_px: float
    negative: bool
    least: float
    expected: Floats
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


def mark_window(scan: Scan, xy: tuple[float, float], half: tuple[int, int]) -> tuple[Floats32, int, int]:
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


def _by_edges(at: Location, grey: Floats32, pattern: MarkPattern | MarkExample, look: _Look) -> Location:
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


def _refit(layout: MarkLayout, placement: MarkPlacement, found: Mapping[str, Location]) -> tuple[Floats, Floats]:
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


TIE = 0.03
"""Correlation per mark below which two ways of turning the scan fit equally well."""
CLEARLY = 3.0
"""How many times larger the residuals of a wrong turn must be."""
FILM_MM = 0.005
"""What film deforms beside an affine transformation, at least; millimetres."""
DEFORMED_MM = 0.1
"""Residuals in millimetres from which a mark may be a false one: office scanners leave 0.07."""
RIVALS = 4
"""Look-alikes that are named."""
#: Sizes of the marks relative to the description that are tried if those as described are not found.
OTHER_SIZES = (0.7, 0.8, 0.9, 1.12, 1.25, 1.4)
#: Directions of crosses, degrees, that are tried where none is found as described; the usual one first.
OTHER_DIRECTIONS = (45.0, 22.5, 67.5)
#: Mean correlation below which other directions are tried although marks are found, and by which these must fit better.
_SURE, _BETTER = 0.9, 0.05
STATED_TOLERANCE = 0.03
"""Part by which the resolution that a file states may be wrong."""


@dataclass(frozen=True)
class FiducialSearch:
    """What is known of a scan; None: to be found out."""

    pixel_mm: float | None = None
    """Side of a pixel on the film, millimetres."""
    rotation: int | None = None
    """Degrees counter-clockwise by which the upright picture was turned: 0, 90, 180, 270."""
    mirrored: bool | None = None
    """Whether left and right are exchanged."""
    usual_mirrored: bool = False
    """What is taken where the marks fit both."""
    negative: bool | None = None
    """Whether dark and bright are exchanged against the patterns."""
    least_correlation: float = LEAST_CORRELATION
    """A place that correlates less is no mark."""

    def __post_init__(self) -> None:
        if self.rotation not in (None, 0, 90, 180, 270):
            raise InputError(f"rotation of {self.rotation}°; allowed are 0, 90, 180 and 270")
        if self.pixel_mm is not None and not (math.isfinite(self.pixel_mm) and self.pixel_mm > 0):
            raise InputError(f"pixels of {self.pixel_mm} mm; a positive number is needed")
        if not 0 < self.least_correlation < 1:
            raise InputError(f"least correlation {self.least_correlation}; a number between 0 and 1 is needed")


def find_fiducials(scan: Scan, layout: MarkLayout, known: FiducialSearch = FiducialSearch()) -> FiducialResult:
    """All marks of a scan, without any approximate values.

    If they are not found, crosses are tried in other directions. If none is found though the scan's resolution is
    known, marks of neighbouring sizes are tried, and then both together.
    """
    try:
        found = _find(scan, layout, known)
    except MarksNotFound as error:
        if (turned := _turned(scan, layout, known)) is not None:
            return turned
        # A search for every size among all resolutions would take minutes.
        if known.pixel_mm is None or any(mark.found for mark in error.sought):
            raise
        others: list[tuple[float, float, FiducialResult]] = []
        for degrees in (0.0, OTHER_DIRECTIONS[0]):
            turned_layout = layout.with_turned_marks(degrees) if degrees else layout
            if turned_layout is None or any(_correlation(each) >= _SURE for *_, each in others):
                break
            sizes = [(degrees, factor, _resized(scan, turned_layout, known, factor)) for factor in OTHER_SIZES]
            others += [(turn, factor, each) for turn, factor, each in sizes if each is not None]
        if not others:
            raise
        degrees, factor, best = max(others, key=lambda other: sum(mark.correlation for mark in other[2].marks))
        said = (
            f"the marks are not found as described, but {factor:g} times as large; mend their sizes in the camera's "
            "description"
        )
        if degrees:
            said = (
                f"the marks are not found as described, but with their crosses turned by {degrees:g}° and "
                f"{factor:g} times as large: add {degrees:g} to the entry rotation, and mend their sizes in the "
                "camera's description"
            )
        return replace(best, notes=(said, *best.notes))
    # Rings fit without their crosses, too, but worse.
    if (fits := _correlation(found)) < _SURE:
        other = _turned(scan, layout, replace(known, pixel_mm=found.pixel_mm))
        if other is not None and _correlation(other) > fits + _BETTER:
            return other
    return found


def _correlation(result: FiducialResult) -> float:
    """Mean correlation of the marks that were found."""
    return float(np.mean([mark.correlation for mark in result.marks]))


def _turned(scan: Scan, layout: MarkLayout, known: FiducialSearch) -> FiducialResult | None:
    """Marks whose crosses lie in another direction than described, if so many agree that it cannot be chance."""
    found: list[tuple[float, FiducialResult]] = []
    # A search among all resolutions takes as long as the first one: only the usual other direction is tried then.
    for degrees in OTHER_DIRECTIONS if known.pixel_mm is not None else OTHER_DIRECTIONS[:1]:
        other = layout.with_turned_marks(degrees)
        if other is None:
            return None
        try:
            result = _find(scan, other, known, wide=known.pixel_mm is None)
        except PhotoplanError:
            continue
        if result.fit.redundancy and result.sigma0_um < 1000 * DEFORMED_MM:
            found.append((degrees, result))
    if not found:
        return None
    degrees, result = max(found, key=lambda each: _correlation(each[1]))
    said = (
        f"the marks do not fit as described, but with their crosses turned by {degrees:g}°: add {degrees:g} to the "
        "entry rotation in the camera's description of its marks"
    )
    return replace(result, notes=(said, *result.notes))


def _resized(scan: Scan, layout: MarkLayout, known: FiducialSearch, factor: float) -> FiducialResult | None:
    """Marks of another size, where so many of them agree that it cannot be chance."""
    try:
        found = _find(scan, layout.with_marks(factor), known, wide=False)
    except PhotoplanError:
        return None
    return found if found.fit.redundancy and found.sigma0_um < 1000 * DEFORMED_MM else None


def _find(scan: Scan, layout: MarkLayout, known: FiducialSearch, wide: bool = True) -> FiducialResult:
    """Marks of the described size.

    Coarse pixels are searched for what correlates with the marks as they look in each possible turn and tone; the
    similarity that joins the most and best candidates says where each mark must lie; there it is measured twice, the
    second time with the mark drawn as the affine transformation and the blur of the first have it.
    """
    turns = tuple(t for t in TURNS if known.rotation in (None, t.rotation) and known.mirrored in (None, t.mirrored))
    placements, notes = _search(scan, layout, known, turns, wide)
    if not placements:
        raise MarksNotFound(_nothing(layout, scan), _expected(layout, scan, known))
    ties = _ties(placements)
    chosen = _usual(ties, known)
    measured = measure_marks(scan, layout, chosen, known.least_correlation)
    better = _better_turn(scan, layout, known, measured) if measured.missed else None
    if better is not None:
        notes.append(better)
    if len(measured.found) < 3:
        raise MarksNotFound(_too_few(layout, measured, better), _sought(measured))
    measured, dropped = _without_false(layout, measured)
    turn, fit, names, said = _decide(layout, measured, ties, chosen, known)
    return _result(layout, measured, turn, fit, names, (*notes, *said, *dropped))


def _search(
    scan: Scan, layout: MarkLayout, known: FiducialSearch, turns: tuple[ScanTurn, ...], everywhere: bool
) -> tuple[list[MarkPlacement], list[str]]:
    """Placements, best first; a resolution that is stated but does not fit is said and left, if `everywhere`."""
    negatives = (False, True) if known.negative is None else (known.negative,)
    notes: list[str] = []
    if known.pixel_mm is not None:
        found = search_placements(
            MarkSearch(scan=scan, layout=layout, turns=turns, negatives=negatives, scale_tolerance=STATED_TOLERANCE),
            [known.pixel_mm],
        )
        if not everywhere or (found and _convincing(found[0], layout)):
            return found, notes
    wide = search_placements(MarkSearch(scan, layout, turns, negatives), pixel_sizes(layout, scan.size))
    if known.pixel_mm is not None and not (wide and _convincing(wide[0], layout)):
        return found or wide, []
    if known.pixel_mm is not None and abs(math.log(wide[0].pixel_mm / known.pixel_mm)) > STATED_TOLERANCE:
        notes.append(
            f"pixels of {1000 * known.pixel_mm:.4g} µm, as stated, do not fit the marks; other sizes were tried"
        )
    return wide, notes


def _convincing(placement: MarkPlacement, layout: MarkLayout) -> bool:
    return len(placement.found) >= min(3, len(layout.names)) and placement.score >= 0.25 * len(placement.found)


def _ties(placements: Sequence[MarkPlacement]) -> list[MarkPlacement]:
    """Placements that fit as well as the best one."""
    best = placements[0]
    margin = TIE * len(best.found)
    return [
        p
        for p in placements
        if p.negative == best.negative and len(p.found) == len(best.found) and p.score >= best.score - margin
    ]


def _usual(ties: Sequence[MarkPlacement], known: FiducialSearch) -> MarkPlacement:
    """Among equals the one that is not turned, and mirrored as usual with this camera."""
    return min(ties, key=lambda p: (p.turn.mirrored != known.usual_mirrored, p.turn.rotation))


def _decide(
    layout: MarkLayout, measured: Measured, ties: Sequence[MarkPlacement], chosen: MarkPlacement, known: FiducialSearch
) -> tuple[ScanTurn, FiducialFit, dict[str, str], list[str]]:
    """Turn, adjustment and new names of the marks; among equal turns the residuals decide, if they can."""
    fits: list[tuple[float, MarkPlacement, FiducialFit, dict[str, str]]] = []
    for p in ties:
        names = _renamed(layout, measured, chosen, p)
        if names is None:
            continue
        fit = fit_affine(_calibrated(layout), _places(measured, names), mirrored=p.turn.mirrored)
        fits.append((fit.sigma0, p, fit, names))
    if len(fits) == 1:
        return fits[0][1].turn, fits[0][2], fits[0][3], []
    fits.sort(key=lambda f: f[0])
    left = fits
    if fits[0][2].redundancy:
        noise = max(fits[0][0], FILM_MM / chosen.pixel_mm, _typical_sigma(measured))
        left = [f for f in fits if f[0] <= CLEARLY * noise]
    told = ""
    if len(left) < len(fits):
        best, second = left[0], fits[len(left)]
        told = f"by the calibrated values: sigma0 {best[0]:.2f} px, the next ({second[1].turn}) {second[0]:.2f} px"
    if len(left) == 1:
        return left[0][1].turn, left[0][2], left[0][3], [f"rotation {left[0][1].turn} is told {told}"]
    usual = _usual([f[1] for f in left], known)
    taken = next(f for f in left if f[1] is usual)
    listed = ", ".join(str(f[1].turn) for f in sorted(left, key=lambda f: (f[1].turn.mirrored, f[1].turn.rotation)))
    said = (
        f"the marks fit every one of these rotations of the scan: {listed}; {usual.turn} is assumed. "
        f"State `rotation` and `mirrored` if that is wrong{f' (others are excluded {told})' if told else ''}"
    )
    return taken[1].turn, taken[2], taken[3], [said]


def _renamed(
    layout: MarkLayout, measured: Measured, chosen: MarkPlacement, other: MarkPlacement
) -> dict[str, str] | None:
    """Names under the chosen turn → names under another one; None if the places are not the same."""
    gate = 0.05 * layout.extent / chosen.pixel_mm
    renamed = {}
    for name, at in measured.found.items():
        off = np.hypot(*(other(layout.mm) - (at.x, at.y)).T)
        k = int(off.argmin())
        if off[k] > gate:
            return None
        renamed[name] = layout.names[k]
    return renamed if len(set(renamed.values())) == len(renamed) else None


def _calibrated(layout: MarkLayout) -> dict[str, tuple[float, float]]:
    return {name: (float(x), float(y)) for name, (x, y) in zip(layout.names, layout.mm)}


def _places(measured: Measured, names: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    return {names[name]: (at.x, at.y) for name, at in measured.found.items() if name in names}


def _typical_sigma(measured: Measured) -> float:
    return float(np.median([max(at.sigma_x, at.sigma_y) for at in measured.found.values()]))


def _without_false(layout: MarkLayout, measured: Measured) -> tuple[Measured, list[str]]:
    """Leave out one mark that contradicts at least four others that agree; with four marks none can be told."""
    notes: list[str] = []
    names = list(measured.found)
    while len(names) >= 5:
        everything = _sigma0(layout, measured, names)
        left = [_sigma0(layout, measured, [n for n in names if n != name]) for name in names]
        k = int(np.argmin(left))
        pixel_mm = 1 / measured.px_per_mm
        if everything * pixel_mm < 0.02 or left[k] > everything / 4:
            break
        notes.append(
            f"mark {names[k]!r} is left out: with it sigma0 is {1000 * everything * pixel_mm:.0f} µm, "
            f"without it {1000 * left[k] * pixel_mm:.0f} µm; something else was taken for it"
        )
        names.pop(k)
    kept = {n: measured.found[n] for n in names}
    false = {n: at for n, at in measured.found.items() if n not in kept}
    missed = {**measured.missed, **{n: (at.correlation, "contradicts the other marks") for n, at in false.items()}}
    return replace(measured, found=kept, missed=missed), notes


def _sigma0(layout: MarkLayout, measured: Measured, names: Sequence[str]) -> float:
    P = layout.mm[[layout.names.index(n) for n in names]]
    p = np.array([(measured.found[n].x, measured.found[n].y) for n in names])
    return solve(np.column_stack([P, np.ones(len(P))]), p).sigma0


def _result(
    layout: MarkLayout,
    measured: Measured,
    turn: ScanTurn,
    fit: FiducialFit,
    names: dict[str, str],
    notes: Sequence[str],
) -> FiducialResult:
    marks = {names[old]: _located(names[old], at) for old, at in measured.found.items()}
    to_mm = np.linalg.inv(fit.transformation.derivative(np.zeros(2)))
    residuals = fit.residuals @ to_mm.T * 1000.0
    missing = []
    for name in fit.missing:
        k = layout.names.index(name)
        x, y = fit.transformation(layout.mm[k])
        # The name that this corner had in the turn in which it was measured.
        old = min(measured.missed, key=lambda n: math.dist(measured.expected[n], (x, y)))
        missing.append(
            MissingMark(
                name=name, correlation=measured.missed[old][0], x=float(x), y=float(y), reason=measured.missed[old][1]
            )
        )
    said = list(notes)
    if fit.redundancy == 0:
        said.append("three marks: the affine transformation has no redundancy, nothing checks them")
    elif np.abs(residuals).max() > 1000 * DEFORMED_MM:
        said.append(
            f"residuals of {np.abs(residuals).max():.0f} µm are more than film deforms: the scanner is not true, or "
            "one of the marks is something else (look at `pictures`), or the calibration another camera's"
        )
    rivals = sorted(measured.placement.rivals, key=lambda rival: -rival[3])
    if len(rivals) > RIVALS:
        said.append(f"{len(rivals)} places look like marks and are none; the first are named")
    for name, x, y, r in rivals[:RIVALS]:
        said.append(
            f"another place looks like mark {names.get(name, name)!r}: ({x:.0f}, {y:.0f}), correlation {r:.2f}; "
            "it does not lie where the other marks say"
        )
    order = [marks[n] for n in layout.names if n in marks]
    return FiducialResult(
        marks=tuple(order),
        missing=tuple(missing),
        fit=fit,
        residuals_um=residuals,
        turn=turn,
        negative=measured.placement.negative,
        blur_px=measured.blur_px,
        placement=measured.placement,
        notes=tuple(said),
    )


def _located(name: str, at: Location) -> LocatedMark:
    return LocatedMark(
        name=name,
        x=at.x,
        y=at.y,
        sigma_x=at.sigma_x,
        sigma_y=at.sigma_y,
        correlation=at.correlation,
        method=at.method,
        paraboloid=None if at.peak is None else (at.peak.x, at.peak.y),
        matching=None if at.match is None else (at.match.x, at.match.y),
    )


def _nothing(layout: MarkLayout, scan: Scan) -> str:
    width, height = scan.size
    return (
        f"none of the {len(layout.names)} fiducial marks found in the scan of {width} × {height} px; not found: "
        f"{', '.join(layout.names)}. Check that the camera's marks look as described and that the scan shows them; "
        "state its resolution with `scan_resolution`"
    )


def _expected(layout: MarkLayout, scan: Scan, known: FiducialSearch) -> tuple[SoughtMark, ...]:
    """Where the marks of an upright scan of usual size would lie."""
    pixel_mm = known.pixel_mm or pixel_sizes(layout, scan.size)[0]
    turn = next(t for t in TURNS if known.rotation in (None, t.rotation) and known.mirrored in (None, t.mirrored))
    places = layout.mm @ turn.matrix.T / pixel_mm
    places += (np.array(scan.size) - 1) / 2 - (places.min(axis=0) + places.max(axis=0)) / 2
    return tuple(
        SoughtMark(name=n, x=float(x), y=float(y), found=False, correlation=math.nan)
        for n, (x, y) in zip(layout.names, places)
    )


def _sought(measured: Measured) -> tuple[SoughtMark, ...]:
    found = (
        SoughtMark(name=name, x=at.x, y=at.y, found=True, correlation=at.correlation)
        for name, at in measured.found.items()
    )
    lost = (SoughtMark(name, *measured.expected[name], False, r) for name, (r, _) in measured.missed.items())
    return (*found, *lost)


def _better_turn(scan: Scan, layout: MarkLayout, known: FiducialSearch, measured: Measured) -> str | None:
    """What to say if the scan is turned in a way that was excluded, but fits more marks; None: it is not."""
    excluded = tuple(
        t for t in TURNS if known.rotation not in (None, t.rotation) or known.mirrored not in (None, t.mirrored)
    )
    if not excluded:
        return None
    search = MarkSearch(
        scan=scan,
        layout=layout,
        turns=excluded,
        negatives=(measured.placement.negative,),
        scale_tolerance=STATED_TOLERANCE,
    )
    others = search_placements(search, [measured.placement.pixel_mm])
    best = max(others, key=lambda p: (len(p.found), p.score), default=None)
    if best is None or len(best.found) < 3 or len(best.found) <= len(measured.found) or not _convincing(best, layout):
        return None
    return (
        f"turned by {measured.placement.turn}, as stated, the scan shows {len(measured.found)} of {len(layout.names)} "
        f"marks; turned by {best.turn} it would show {len(best.found)}: check `rotation` and `mirrored`"
    )


def _too_few(layout: MarkLayout, measured: Measured, better: str | None) -> str:
    lost = []
    for name, (r, reason) in measured.missed.items():
        x, y = measured.expected[name]
        lost.append(f"{name!r} ({reason}{f', best correlation {r:.2f}' if math.isfinite(r) else ''}, {x:.0f} {y:.0f})")
    found = ", ".join(f"{n!r} ({at.correlation:.2f})" for n, at in measured.found.items()) or "none"
    hint = "" if better is None else f" ({better})"
    return (
        f"{len(measured.found)} of {len(layout.names)} fiducial marks found, three are needed. Found: {found}. "
        f"Not found: {'; '.join(lost)}. Check that the camera's marks look as described{hint}, or measure by hand"
    )
