"""Lateral chromatic aberration as a model over the field: displacement of a band against a reference band."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import solve
from photoplan.adjustment.robust import spread
from photoplan.errors import GeometryError, InputError

_Array = NDArray[np.float64]
Term = tuple[int, int, float, float]
"""Powers i of u and j of v, and coefficients of the displacement along x and y."""

#: Highest degree of the terms that a model may have.
_MOST_DEGREE = 5
#: Standard deviations, by the median of residuals, beyond which a displacement does not count.
_GROSS = 4.5


def _one(i: int, j: int, axis: int) -> tuple[Term, ...]:
    return ((i, j, 1.0, 0.0),) if axis == 0 else ((i, j, 0.0, 1.0),)


def _full(degree: int) -> tuple[tuple[Term, ...], ...]:
    powers = [(n - j, j) for n in range(degree + 1) for j in range(n + 1)]
    return tuple(_one(i, j, axis) for i, j in powers for axis in (0, 1))


_SHIFT = (_one(0, 0, 0), _one(0, 0, 1))
_SCALE = (((1, 0, 1.0, 0.0), (0, 1, 0.0, 1.0)),)
_CUBIC = (((3, 0, 1.0, 0.0), (1, 2, 1.0, 0.0), (2, 1, 0.0, 1.0), (0, 3, 0.0, 1.0)),)

KINDS: dict[str, tuple[tuple[Term, ...], ...]] = {
    "none": (),
    "shift": _SHIFT,
    "scale": _SHIFT + _SCALE,
    "radial": _SHIFT + _SCALE + _CUBIC,
    "affine": _full(1),
    "affine + cubic": _full(1) + _CUBIC,
    "polynomial 2": _full(2),
    "polynomial 3": _full(3),
}
"""What each kind fits, simple ones first: shift; shift and scale; these and a radial cubic part; polynomials."""


@dataclass(frozen=True, eq=False)
class Displacements:
    """Measured displacements of a band against the reference: one number along one direction each."""

    place: _Array
    """Column and row in the reference band, shape (n, 2)."""
    direction: _Array
    """Unit vectors along which it was measured, shape (n, 2): both axes for a disc, the normal for an edge."""
    value: _Array
    """Displacement along it, pixels: where the band is minus where the reference is, shape (n,)."""
    sigma: _Array
    """Standard deviations, shape (n,)."""
    group: NDArray[np.int_]
    """Number of the disc or edge that each belongs to, shape (n,)."""

    def __post_init__(self) -> None:
        n = self.value.size
        if self.place.shape != (n, 2) or self.direction.shape != (n, 2) or self.sigma.shape != (n,):
            raise InputError("displacements: arrays of different lengths")
        if not all(np.isfinite(a).all() for a in (self.place, self.direction, self.value, self.sigma)):
            raise InputError("displacements: values must be finite")
        if n and not (self.sigma > 0.0).all():
            raise InputError("displacements: standard deviations must be positive")


@dataclass(frozen=True)
class Trial:
    """One kind of model, tried."""

    kind: str
    unknowns: int
    predicted: float
    """Root mean square of the errors of prediction of discs or edges that were left out one by one, pixels."""


@dataclass(frozen=True)
class BandModel:
    """Displacement of one band: Σ (a, b) uⁱ vʲ, u and v from the image's middle in units of half its diagonal."""

    band: int
    """Counted from 1."""
    terms: tuple[Term, ...]
    """(i, j, a, b) each; pixels. Empty: none."""
    sigmas: tuple[tuple[float, float], ...] = ()
    """Standard deviations of a and b of each term; empty: unknown."""
    kind: str = "polynomial"
    """How it was chosen, a name of `KINDS`."""
    residual: float = float("nan")
    """Root mean square of the residuals, pixels."""
    count: int = 0
    """Discs or edges that it was fitted to."""
    rejected: int = 0
    """Of these, left out as gross errors."""
    trials: tuple[Trial, ...] = ()
    """What was tried, for a report."""

    def __post_init__(self) -> None:
        if len(self.terms) > 60 or any(min(i, j) < 0 or i + j > _MOST_DEGREE for i, j, _, _ in self.terms):
            raise InputError(
                f"band {self.band}: terms of the displacement have powers from 0 to a degree of {_MOST_DEGREE}, at "
                "most 60 of them"
            )
        if not all(np.isfinite(v) and abs(v) <= 1000.0 for _, _, a, b in self.terms for v in (a, b)):
            raise InputError(f"band {self.band}: coefficients of the displacement are finite and below 1000 pixels")
        if self.sigmas and len(self.sigmas) != len(self.terms):
            raise InputError(f"band {self.band}: as many standard deviations as terms are needed")


@dataclass(frozen=True)
class ChromaticModel:
    """Lateral chromatic aberration of an image or camera."""

    size: tuple[int, int]
    """Width and height of the images, pixels."""
    reference: int
    """Band that stays, counted from 1."""
    bands: tuple[BandModel, ...]
    """The others; a band that is missing stays too."""
    description: str = ""
    """How it was measured."""

    def __post_init__(self) -> None:
        numbers = [band.band for band in self.bands]
        if min(self.size) < 1 or self.reference < 1 or any(n < 1 for n in numbers):
            raise InputError("chromatic model: sizes are positive, bands are counted from 1")
        if len(set(numbers)) < len(numbers) or self.reference in numbers:
            raise InputError("chromatic model: a band is described twice, or the reference is displaced")

    @property
    def half_diagonal(self) -> float:
        """Unit of u and v, pixels."""
        return hypot(*self.size) / 2.0

    def displacement(self, band: int, x: _Array, y: _Array) -> tuple[_Array, _Array]:
        """Where a band lies against the reference at columns x and rows y (which broadcast): dx and dy, pixels."""
        mine = [each for each in self.bands if each.band == band]
        u = (np.asarray(x, float) - (self.size[0] - 1) / 2.0) / self.half_diagonal
        v = (np.asarray(y, float) - (self.size[1] - 1) / 2.0) / self.half_diagonal
        shape = np.broadcast_shapes(u.shape, v.shape)
        dx, dy = np.zeros(shape), np.zeros(shape)
        for i, j, a, b in mine[0].terms if mine else ():
            part = u**i * v**j
            dx += a * part
            dy += b * part
        return dx, dy

    def largest(self, band: int) -> float:
        """The largest length of the displacement on the image's frame and a net inside, pixels."""
        x = np.linspace(0.0, self.size[0] - 1.0, 33)[None, :]
        y = np.linspace(0.0, self.size[1] - 1.0, 33)[:, None]
        return float(np.hypot(*self.displacement(band, x, y)).max())

    def corner(self, band: int) -> float:
        """Lateral aberration in the corners: mean of the radial displacement there less that of the middle, pixels."""
        w, h = self.size[0] - 1.0, self.size[1] - 1.0
        x, y = np.array([0.0, w, 0.0, w, w / 2.0]), np.array([0.0, 0.0, h, h, h / 2.0])
        dx, dy = self.displacement(band, x, y)
        away = np.stack([x[:4] - w / 2.0, y[:4] - h / 2.0]) / max(hypot(w, h) / 2.0, 1e-9)
        return float(((dx[:4] - dx[4]) * away[0] + (dy[:4] - dy[4]) * away[1]).mean())


def fit_band(band: int, size: tuple[int, int], measured: Displacements, kind: str | None = None) -> BandModel:
    """Fit the displacement of a band over the field.

    Of the kinds the simplest is taken that predicts discs or edges which were left out about as well as the best: its
    squared errors of prediction exceed those of the best by less than their own standard error (cross-validation,
    leaving out one at a time). Gross errors beyond 4.5 times the robust spread of the residuals are left out.
    """
    if kind is not None and kind not in KINDS:
        raise InputError(f"kind of model {kind!r}; allowed are {', '.join(KINDS)}")
    groups = np.unique(measured.group).size
    if groups < 4:
        raise GeometryError(
            f"band {band}: {groups} discs or edges are common with the reference; at least 4 are needed, spread over "
            "the image"
        )
    kept, tried = _without_gross(size, measured, kind)
    chosen = kind or _chosen(tried)
    fit = _solve(chosen, size, measured, kept)
    if fit is None:
        raise GeometryError(f"band {band}: the displacements do not determine the model {chosen!r}; give more of them")
    terms, sigmas = _terms(chosen, fit.unknowns, fit.cofactors)
    rejected = groups - np.unique(measured.group[kept]).size
    trials = tuple(Trial(t.kind, t.unknowns.size, t.predicted) for t in tried)
    return BandModel(
        band=band,
        terms=terms,
        sigmas=sigmas,
        kind=chosen,
        residual=fit.rms,
        count=groups,
        rejected=rejected,
        trials=trials,
    )


@dataclass(frozen=True, eq=False)
class _Solved:
    kind: str
    unknowns: _Array
    cofactors: _Array
    residual: _Array
    rms: float
    errors: _Array
    """Squared errors of prediction of each group that was left out, in units of its variance."""
    scale: float
    """Standard deviation of a displacement, root mean square, pixels."""

    @property
    def predicted(self) -> float:
        return self.scale * float(np.sqrt(self.errors.mean()))


def _columns(kind: str, size: tuple[int, int], measured: Displacements) -> _Array:
    """Design matrix, shape (n, unknowns)."""
    half = hypot(*size) / 2.0
    u = (measured.place[:, 0] - (size[0] - 1) / 2.0) / half
    v = (measured.place[:, 1] - (size[1] - 1) / 2.0) / half
    out = np.zeros((u.size, len(KINDS[kind])))
    for k, terms in enumerate(KINDS[kind]):
        for i, j, a, b in terms:
            out[:, k] += u**i * v**j * (a * measured.direction[:, 0] + b * measured.direction[:, 1])
    return out


def _solve(kind: str, size: tuple[int, int], measured: Displacements, kept: NDArray[np.bool_]) -> _Solved | None:
    """Weighted least squares of one kind; None: it is not determined, or leaves too little to test it by."""
    columns = _columns(kind, size, measured)
    matrix = columns / measured.sigma[:, None]
    groups = [np.flatnonzero(measured.group[kept] == g) for g in np.unique(measured.group[kept])]
    if kept.sum() < 1.5 * matrix.shape[1] + 2:
        return None
    fit = solve(matrix[kept], (measured.value / measured.sigma)[kept])
    if fit.rank < matrix.shape[1]:
        return None
    try:
        errors = [float(np.mean(fit.without(rows) ** 2)) for rows in groups]
    except np.linalg.LinAlgError:
        return None
    scale = float(np.sqrt(np.mean(measured.sigma[kept] ** 2)))
    residual = measured.value - columns @ fit.unknowns
    rms = float(np.sqrt(np.mean(residual[kept] ** 2)))
    cofactors = fit.cofactors * max(fit.square / max(fit.redundancy, 1), 1.0)
    return _Solved(
        kind=kind,
        unknowns=fit.unknowns,
        cofactors=cofactors,
        residual=residual,
        rms=rms,
        errors=np.array(errors),
        scale=scale,
    )


def _without_gross(
    size: tuple[int, int], measured: Displacements, kind: str | None
) -> tuple[NDArray[np.bool_], list[_Solved]]:
    """Rows that are no gross errors against the best kind, and all kinds fitted to these."""
    kept = np.ones(measured.value.size, bool)
    for _ in range(5):
        tried = [s for s in (_solve(k, size, measured, kept) for k in KINDS) if s is not None]
        if not tried:
            raise GeometryError("the displacements do not determine even a shift; give more discs or edges")
        best = next((s for s in tried if s.kind == (kind or _chosen(tried))), tried[-1])
        scaled = np.abs(best.residual) / measured.sigma
        limit = _GROSS * max(spread(scaled[kept]), 1e-6)
        bad = np.unique(measured.group[scaled > limit])
        now = ~np.isin(measured.group, bad)
        if (now == kept).all() or now.sum() < 0.6 * now.size:
            break
        kept = now
    tried = [s for s in (_solve(k, size, measured, kept) for k in KINDS) if s is not None]
    return kept, tried


def _chosen(tried: list[_Solved]) -> str:
    """The simplest kind that predicts about as well as the best."""
    best = min(tried, key=lambda s: float(s.errors.mean()))
    for each in sorted(tried, key=lambda s: s.unknowns.size):
        worse = each.errors - best.errors
        spread = float(worse.std(ddof=1)) / np.sqrt(worse.size) if worse.size > 1 else 0.0
        if each is best or float(worse.mean()) <= spread:
            return each.kind
    return best.kind


def _terms(kind: str, unknowns: _Array, cofactors: _Array) -> tuple[tuple[Term, ...], tuple[tuple[float, float], ...]]:
    """A fitted kind as polynomials, with standard deviations of the coefficients."""
    value: dict[tuple[int, int], list[float]] = {}
    variance: dict[tuple[int, int], list[float]] = {}
    for k, terms in enumerate(KINDS[kind]):
        for i, j, a, b in terms:
            both = value.setdefault((i, j), [0.0, 0.0])
            spread = variance.setdefault((i, j), [0.0, 0.0])
            for axis, share in enumerate((a, b)):
                both[axis] += share * float(unknowns[k])
                # Two columns of one kind never meet in one coefficient of the cubic; elsewhere they are one each.
                spread[axis] += share**2 * float(cofactors[k, k])
    powers = sorted(value, key=lambda p: (sum(p), p[1]))
    terms = tuple((i, j, value[i, j][0], value[i, j][1]) for i, j in powers)
    return terms, tuple((variance[p][0] ** 0.5, variance[p][1] ** 0.5) for p in powers)
