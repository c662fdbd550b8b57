"""Layouts of fiducial marks, and what is found."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.fiducials import FiducialFit, MarkExample, MarkPattern
from photoplan.errors import InputError

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
    mm: NDArray[np.float64]
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
    def matrix(self) -> NDArray[np.float64]:
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
    matrix: NDArray[np.float64]
    """From millimetres to columns and rows, shape (2, 2)."""
    shift: NDArray[np.float64]
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

    def __call__(self, mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of the image plane (..., 2) to column and row."""
        return mm @ self.matrix.T + self.shift


def fit_placement(
    mm: NDArray[np.float64], xy: NDArray[np.float64], mirrored: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
    candidates: Sequence[NDArray[np.float64]],
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
    layout: MarkLayout,
    candidates: Sequence[NDArray[np.float64]],
    found: Mapping[str, tuple[float, float, float]],
    blunt: float,
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
    candidates: Sequence[NDArray[np.float64]],
    pair: tuple[int, int],
    turn: ScanTurn,
    px_per_mm: float,
    scale_tolerance: float,
    gate: float,
) -> NDArray[np.float64]:
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


def _best_near(
    candidates: NDArray[np.float64], xy: NDArray[np.float64], gate: float
) -> tuple[float, float, float] | None:
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
    residuals_um: NDArray[np.float64]
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
