"""Fiducial marks of a scan: found, measured, and joined to the interior orientation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from photoplan.adjustment.linear import solve
from photoplan.cameras.fiducials_fit import FiducialFit, fit_affine
from photoplan.errors import InputError, PhotoplanError
from photoplan.orientation.marks.found import FiducialResult, LocatedMark, MarksNotFound, MissingMark, SoughtMark
from photoplan.orientation.marks.layout import TURNS, MarkLayout, MarkPlacement, ScanTurn
from photoplan.orientation.marks.locate import LEAST_CORRELATION, Location
from photoplan.orientation.marks.measure import Measured, measure_marks
from photoplan.orientation.marks.search import MarkSearch, Scan, pixel_sizes, search_placements

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
