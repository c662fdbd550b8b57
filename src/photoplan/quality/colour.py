"""Chromatic aberration: discs, displacements, model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import hypot
from typing import Any

import numpy as np
import scipy  # loads its parts when they are used: a restored image needs none of them
from numpy.typing import NDArray

from photoplan.adjustment.least_squares import Equations, Fit, levenberg, solve, spread
from photoplan.arrays import Floats, Mask
from photoplan.errors import GeometryError, InputError
from photoplan.quality.edges.find import EdgeRegion

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
"""Terms that each kind fits, simple ones first: shift; shift and scale; these and a radial cubic part; polynomials."""


@dataclass(frozen=True, eq=False)
class Displacements:
    """Measured displacements of a band against the reference: one number along one direction each."""

    place: Floats
    """Column and row in the reference band, shape (n, 2)."""
    direction: Floats
    """Unit vectors along which it was measured, shape (n, 2): both axes for a disc, the normal for an edge."""
    value: Floats
    """Displacement along it, pixels: where the band is minus where the reference is, shape (n,)."""
    sigma: Floats
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
    """Rule by which it was chosen, a name of `KINDS`."""
    residual: float = float("nan")
    """Root mean square of the residuals, pixels."""
    count: int = 0
    """Discs or edges that it was fitted to."""
    rejected: int = 0
    """Number of these that were left out as gross errors."""
    trials: tuple[Trial, ...] = ()
    """Models that were tried, for a report."""

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
    """Method of the measurement."""

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

    def displacement(self, band: int, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the place of a band against the reference at columns x and rows y (which broadcast): dx and dy,
        pixels."""
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
    unknowns: Floats
    cofactors: Floats
    residual: Floats
    rms: float
    errors: Floats
    """Squared errors of prediction of each group that was left out, in units of its variance."""
    scale: float
    """Standard deviation of a displacement, root mean square, pixels."""

    @property
    def predicted(self) -> float:
        return self.scale * float(np.sqrt(self.errors.mean()))


def _columns(kind: str, size: tuple[int, int], measured: Displacements) -> Floats:
    """Design matrix, shape (n, unknowns)."""
    half = hypot(*size) / 2.0
    u = (measured.place[:, 0] - (size[0] - 1) / 2.0) / half
    v = (measured.place[:, 1] - (size[1] - 1) / 2.0) / half
    out = np.zeros((u.size, len(KINDS[kind])))
    for k, terms in enumerate(KINDS[kind]):
        for i, j, a, b in terms:
            out[:, k] += u**i * v**j * (a * measured.direction[:, 0] + b * measured.direction[:, 1])
    return out


def _solve(kind: str, size: tuple[int, int], measured: Displacements, kept: Mask) -> _Solved | None:
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


def _without_gross(size: tuple[int, int], measured: Displacements, kind: str | None) -> tuple[Mask, list[_Solved]]:
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


def _terms(kind: str, unknowns: Floats, cofactors: Floats) -> tuple[tuple[Term, ...], tuple[tuple[float, float], ...]]:
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


#: Half the side of the part of an image that a disc is fitted in, in radii.
_REACH = 1.7
#: Steps of a fit; those that have not settled by then are no discs.
_ROUNDS = 25
#: A disc is the same in all directions to within this ratio of its axes; anything longer is no disc of a chart.
_MOST_AXES = 2.5


#: Radii of what counts as a disc, pixels.
_RADII = (2.5, 500.0)
#: Times the noise of a pixel that the step at the border has at least.
_LEAST_CONTRAST = 8.0
#: Standard deviation of a coordinate, pixels; a centre known less well is left out.
_MOST_SIGMA = 0.1
#: More spots than this are no chart.
_MOST_SPOTS = 20_000


@dataclass(frozen=True)
class Disc:
    """A disc, located."""

    x: float
    """Column of the centre."""
    y: float
    """Row of the centre."""
    sigma_x: float
    """Standard deviation of the column, pixels."""
    sigma_y: float
    """Standard deviation of the row, pixels."""
    radius: float
    """Root of the product of both half axes, pixels."""
    blur: float
    """Standard deviation of the Gaussian across the border, pixels."""
    contrast: float
    """Ground minus disc, grey values; the largest of the planes of a mosaic."""
    noise: float
    """Standard deviation of the residuals, grey values."""


def find_discs(
    grey: NDArray[Any], saturation: float | None = None, planes: NDArray[np.int_] | None = None
) -> tuple[Disc, ...]:
    """Locate all discs that lie wholly in an image, dark on bright ground or bright on dark."""
    limit = saturation
    if limit is None:
        limit = float(np.iinfo(grey.dtype).max) if grey.dtype.kind in "iu" else float("inf")
    values = np.asarray(grey, np.float64)
    values = np.where(values >= limit, np.inf, values)
    numbers = np.zeros(values.shape, int) if planes is None else planes
    found: list[Disc] = []
    refused: dict[str, int] = {}
    for start in _spots(_even(values, numbers)):
        result = _located(values, numbers, start)
        if isinstance(result, Disc):
            found.append(result)
        else:
            refused[result] = refused.get(result, 0) + 1
    if not found:
        told = "; ".join(f"{count} spots: {why}" for why, count in refused.items()) or "no round spot at all"
        raise InputError(
            f"no disc was found in {values.shape[1]} × {values.shape[0]} pixels ({told}); needed are round, "
            f"unsaturated spots of {_RADII[0]:g} to {_RADII[1]:g} pixels radius on even ground"
        )
    return tuple(found)


def _even(values: Floats, planes: NDArray[np.int_]) -> Floats:
    """An image to look for spots in: the planes of a mosaic brought to one level, gaps filled by their neighbours."""
    out = np.full(values.shape, np.nan)
    for plane in np.unique(planes[planes >= 0]):
        mine = (planes == plane) & ~np.isnan(values)
        if mine.any():
            high = np.percentile(np.minimum(values[mine], 1e30), 95)
            out[mine] = np.minimum(values[mine], high) / high if high > 0.0 else 0.0
    known = np.isfinite(out)
    if not known.any():
        raise InputError("no pixel of the image has a value; there are no discs to be found")
    width = 1.0 if len(np.unique(planes[planes >= 0])) == 1 and (planes >= 0).all() else 1.2
    weight = scipy.ndimage.gaussian_filter(known.astype(float), width)
    smooth = scipy.ndimage.gaussian_filter(np.where(known, out, 0.0), width)
    return np.asarray(smooth / np.maximum(weight, 1e-9))


def _spots(even: Floats) -> Iterator[tuple[float, float, float]]:
    """Centre and radius of round spots: connected parts beyond the middle between ground and disc."""
    low, high = np.percentile(even, [1, 99])
    # Discs cover less of the image than the ground.
    picture = even if (even < (low + high) / 2.0).mean() < 0.5 else -even
    disc = np.percentile(picture, 1)
    side = max(16, min(picture.shape) // 4)
    ground = _blocks(picture, side)
    rows = np.minimum(np.arange(picture.shape[0]) // side, ground.shape[0] - 1)
    columns = np.minimum(np.arange(picture.shape[1]) // side, ground.shape[1] - 1)
    level = scipy.ndimage.uniform_filter(ground[rows[:, None], columns[None, :]], side)
    labels, count = scipy.ndimage.label(picture < (level + disc) / 2.0)
    if count > _MOST_SPOTS:
        raise InputError(f"{count} spots in the image; at most {_MOST_SPOTS} are a chart of discs: choose a part of it")
    for index, box in enumerate(scipy.ndimage.find_objects(labels), 1):
        area = labels[box] == index
        height, width = area.shape
        radius = float(np.sqrt(area.sum() / np.pi))
        inside = box[0].start > 0 and box[1].start > 0
        inside &= box[0].stop < even.shape[0] and box[1].stop < even.shape[1]
        long = max(height, width) / max(min(height, width), 1)
        full = area.sum() / (np.pi / 4.0 * height * width)
        if not inside or not _RADII[0] <= radius <= _RADII[1] or long > _MOST_AXES:
            continue
        if 0.8 < full < 1.2:
            y, x = scipy.ndimage.center_of_mass(area)
            yield x + box[1].start, y + box[0].start, radius


def _blocks(picture: Floats, side: int) -> Floats:
    """Level of the ground in blocks: what three quarters of the pixels stay below."""
    rows, columns = max(1, picture.shape[0] // side), max(1, picture.shape[1] // side)
    return np.array(
        [
            [np.percentile(part, 75) for part in np.array_split(strip, columns, 1)]
            for strip in np.array_split(picture, rows, 0)
        ]
    )


def _located(values: Floats, planes: NDArray[np.int_], start: tuple[float, float, float]) -> Disc | str:
    """The disc at a place, or why it is none."""
    x0, y0, radius = start
    reach = _REACH * radius + 2.0
    if any(at - radius < 2.0 or at + radius > side - 3.0 for at, side in zip((y0, x0), values.shape)):
        return "too near the border"
    part = tuple(
        slice(max(int(np.floor(at - reach)), 0), min(int(np.ceil(at + reach)) + 1, side))
        for at, side in zip((y0, x0), values.shape)
    )
    y, x = np.mgrid[part]
    near = (np.hypot(x - x0, y - y0) <= reach) & (planes[part] >= 0)
    grey, number = values[part][near], planes[part][near]
    if np.isinf(grey).any():
        return "saturated"
    if np.isnan(grey).any():
        return "pixels without value"
    used, index = np.unique(number, return_inverse=True)
    fit = _DiscFit(x[near] - x0, y[near] - y0, grey, index, used.size)
    return fit.run(start)


class _DiscFit:
    """Gauss-Newton of one disc.

    Unknown: centre, size, two of the shape, blur, and per plane the grey of the ground with its slopes and the step.
    """

    def __init__(self, x: Floats, y: Floats, grey: Floats, plane: NDArray[np.int_], planes: int) -> None:
        self.x, self.y, self.grey, self.plane, self.planes = x, y, grey, plane, planes
        self.share = np.stack([plane == k for k in range(planes)], 1).astype(float)

    def run(self, start: tuple[float, float, float]) -> Disc | str:
        """The disc, or why it is none."""
        first = np.array([0.0, 0.0, np.log(start[2]), 0.0, 0.0, np.log(0.08 * start[2] + 0.5)])
        found = levenberg(
            first, self._equations, lambda shape, step: shape + np.clip(step[:6], *_bounds(start[2])), _ROUNDS
        )
        return self._disc(found, start)

    def _cover(self, shape: Floats) -> Floats:
        """Share of the disc in each pixel: the normal distribution of the distance from the ellipse."""
        u, v = self.x - shape[0], self.y - shape[1]
        radius, p, q = np.exp(shape[2]), shape[3], shape[4]
        form = u * u * (1.0 + p) + v * v * (1.0 - p) + 2.0 * q * u * v
        length = np.sqrt(np.maximum(form, 1e-12))
        gradient = np.hypot(u * (1.0 + p) + q * v, v * (1.0 - p) + q * u)
        distance = (length - radius) * length / np.maximum(gradient, 1e-9)
        return np.asarray(scipy.special.ndtr(-distance / np.exp(shape[5])))

    def _basis(self, cover: Floats) -> Floats:
        """Columns of what enters linearly: ground, its slopes relative to it, and step, for every plane."""
        ground = self.share
        slopes = np.concatenate([ground * self.x[:, None], ground * self.y[:, None]], 1)
        # Light that falls unevenly is as uneven inside the disc; a share of a slope there is left to the noise.
        return np.concatenate([ground, slopes * (1.0 - cover)[:, None], ground * cover[:, None]], 1)

    def _equations(self, shape: Floats) -> tuple[Floats, Floats]:
        """Derivatives by the shape and by the grey values that fit best to it, and residuals."""
        basis = self._basis(self._cover(shape))
        fit = solve(basis, self.grey)
        columns = []
        for k in range(6):
            moved = shape.copy()
            moved[k] += 1e-5
            columns.append((self._basis(self._cover(moved)) - basis) @ fit.unknowns / 1e-5)
        return np.column_stack([*columns, basis]), fit.residuals

    def _disc(self, found: Equations[Floats], start: tuple[float, float, float]) -> Disc | str:
        shape, noise = found.state, found.sigma0
        if found.redundancy < 10:
            return "too few pixels"
        cofactors = found.cofactors()
        if cofactors is None:
            return "not determined"
        levels = solve(self._basis(self._cover(shape)), self.grey).unknowns
        sigma = noise * np.sqrt(np.maximum(np.diag(cofactors)[:2], 0.0))
        steps = -levels[-self.planes :]
        contrast = float(steps[np.argmax(np.abs(steps))])
        axes = np.sqrt(np.maximum(1.0 - shape[3] ** 2 - shape[4] ** 2, 1e-9))
        radius = float(np.exp(shape[2]) / np.sqrt(axes))
        # A curved border that is blurred has its half level further inside.
        radius += float(np.exp(2.0 * shape[5])) / (2.0 * radius)
        if not np.isfinite([*shape, *sigma]).all() or max(np.abs(shape[:2])) > 0.5 * start[2]:
            return "no disc"
        if not 0.5 * start[2] < radius < 2.0 * start[2] or np.exp(shape[5]) > 0.7 * radius:
            return "too blurred"
        if abs(contrast) < _LEAST_CONTRAST * max(noise, 1.0 / np.sqrt(12.0) if _whole(self.grey) else 0.0):
            return "too weak"
        if sigma.max() > _MOST_SIGMA:
            return "centre too uncertain"
        x, y = start[0] + float(shape[0]), start[1] + float(shape[1])
        return Disc(
            x=x,
            y=y,
            sigma_x=float(sigma[0]),
            sigma_y=float(sigma[1]),
            radius=radius,
            blur=float(np.exp(shape[5])),
            contrast=contrast,
            noise=noise,
        )


def _whole(grey: Floats) -> bool:
    return bool((grey == np.round(grey)).all())


def _bounds(radius: float) -> tuple[Floats, Floats]:
    """Steps that one round may go at most."""
    most = np.array([0.3 * radius, 0.3 * radius, 0.2, 0.2, 0.2, 0.5])
    return -most, most


#: A centre is not known better than this, whatever its fit says: print, lens and mosaic are not perfect, pixels.
_FLOOR = 0.002


def disc_displacements(reference: Sequence[Disc], band: Sequence[Disc]) -> Displacements:
    """Match discs of two bands, each with its nearest in the other, and difference their centres.

    Two can be the same up to a third of the distance of nearest neighbours in the chart, at most 30 pixels.
    """
    here = np.array([[d.x, d.y] for d in reference]).reshape(-1, 2)
    there = np.array([[d.x, d.y] for d in band]).reshape(-1, 2)
    farthest = 30.0
    if len(here) > 1:
        farthest = min(farthest, float(np.median(scipy.spatial.cKDTree(here).query(here, 2)[0][:, 1])) / 3.0)
    pairs = []
    if len(here) and len(there):
        apart, nearest = scipy.spatial.cKDTree(there).query(here)
        back = scipy.spatial.cKDTree(here).query(there)[1]
        pairs = [(i, int(k)) for i, k in enumerate(nearest) if back[k] == i and apart[i] <= farthest]
        pairs = [(i, k) for i, k in pairs if 0.7 < reference[i].radius / band[k].radius < 1.4]
    if len(pairs) < 4:
        raise InputError(
            f"{len(pairs)} discs are the same in both bands (of {len(here)} and {len(there)}, up to {farthest:.1f} "
            "pixels apart); at least 4 are needed"
        )
    both = [(reference[i], band[k]) for i, k in pairs]
    value = np.array([(b.x - a.x, b.y - a.y) for a, b in both])
    spreads = np.array([(np.hypot(a.sigma_x, b.sigma_x), np.hypot(a.sigma_y, b.sigma_y)) for a, b in both])
    n = len(pairs)
    return Displacements(
        place=np.repeat([(a.x, a.y) for a, _ in both], 2, axis=0),
        direction=np.tile(np.eye(2), (n, 1)),
        value=value.ravel(),
        sigma=np.hypot(spreads, _FLOOR).ravel(),
        group=np.repeat(np.arange(n), 2),
    )


#: Steps of a fit at most.
_ROUNDS_DISPLACEMENTS = 30
#: Least step at an edge in units of the noise of a pixel, in each band.
_LEAST_SNR = 5.0
#: A position is not known better than this whatever its fit says, pixels.
_FLOOR_DISPLACEMENTS = 0.005


def edge_displacements(
    reference: Floats, band: Floats, edges: Sequence[EdgeRegion], saturation: float = float("inf")
) -> Displacements:
    """Displacements of a band along the normals of edges that were found in the reference.

    In each band the step of a normal distribution is fitted to the pixels of an edge; the direction comes from the
    reference. The difference of both positions is free of what both bands share, such as the object's own edge; where
    the bands are blurred unsymmetrically and differently, that enters.
    """
    rows = []
    height, width = reference.shape
    for number, edge in enumerate(edges):
        window = edge.window((width, height))
        part = (slice(window[1], window[1] + window[3]), slice(window[0], window[0] + window[2]))
        mask = edge.mask(window) & np.isfinite(reference[part]) & np.isfinite(band[part])
        if mask.sum() < 60 or max(reference[part][mask].max(), band[part][mask].max()) >= saturation:
            continue
        line = edge.line
        x = (np.arange(window[2]) + (window[0] - line.x))[None, :]
        y = (np.arange(window[3]) + (window[1] - line.y))[:, None]
        along = (x * line.tx + y * line.ty)[mask]
        across = (y * line.tx - x * line.ty)[mask]
        first = _step(along, across, reference[part][mask], None)
        if first is None:
            continue
        second = _step(along, across, band[part][mask], first[2])
        if second is None:
            continue
        # `across` grows along (−ty, tx).
        rows.append((line.x, line.y, -line.ty, line.tx, second[0] - first[0], np.hypot(first[1], second[1]), number))
    if len(rows) < 4:
        raise InputError(
            f"{len(rows)} of {len(edges)} edges can be measured in both bands; at least 4 are needed: clean, straight, "
            "unsaturated, with contrast in both"
        )
    table = np.array(rows)
    sigma = np.hypot(table[:, 5], _FLOOR_DISPLACEMENTS)
    return Displacements(
        place=table[:, :2], direction=table[:, 2:4], value=table[:, 4], sigma=sigma, group=table[:, 6].astype(int)
    )


def _step(along: Floats, across: Floats, grey: Floats, slope: float | None) -> tuple[float, float, float] | None:
    """Position of a blurred step across, its standard deviation, and the slope of its line; None: no clear step."""
    unknown = 3 if slope is None else 2

    def shares(at: Floats) -> Floats:
        return np.asarray(scipy.special.ndtr((across - at[0] - at[2] * along) / np.exp(at[1])))

    def levels(at: Floats) -> Fit:
        return solve(np.stack([np.ones(grey.size), shares(at)], 1), grey)

    def equations(at: Floats) -> tuple[Floats, Floats]:
        """Derivatives of the grey values by position, blur, slope of the line and both levels, and residuals."""
        fit = levels(at)
        moved = [at + 1e-5 * np.eye(3)[k] for k in range(unknown)]
        columns = [fit.unknowns[1] * (shares(there) - fit.A[:, 1]) / 1e-5 for there in moved]
        return np.column_stack([*columns, fit.A]), fit.residuals

    def moved(at: Floats, step: Floats) -> Floats | None:
        trial = at + np.pad(np.clip(step[:unknown], -1.0, 1.0), (0, 3 - unknown))
        return trial if abs(trial[1]) <= 4.0 else None

    found = levenberg(np.array([0.0, 0.0, slope or 0.0]), equations, moved, _ROUNDS_DISPLACEMENTS)
    free, noise, cofactors = found.state, found.sigma0, found.cofactors()
    if cofactors is None:
        return None
    sigma = noise * float(np.sqrt(cofactors[0, 0]))
    reach = float(np.abs(across).max())
    if not np.isfinite([sigma, *free]).all() or abs(free[0]) > 0.6 * reach or np.exp(free[1]) > 0.5 * reach:
        return None
    if abs(levels(free).unknowns[1]) < _LEAST_SNR * noise or sigma > 0.3:
        return None
    return float(free[0]), sigma, float(free[2])


#: Side of the windows, pixels.
_WINDOW = 48
#: Steps of a match at most.
_MATCHING_ROUNDS = 15
#: Least correlation of both bands in a window: below it they do not show the same structure.
_LEAST_CORRELATION = 0.9
#: A match with a larger standard deviation, pixels, says nothing of fractions of a pixel.
#: Windows of natural scenes are not known better than this, since colours change across edges, pixels.
_MATCHING_FLOOR = 0.01
#: Pixels around a window in which its counterpart may lie, with room for interpolation.
_MARGIN = 6


def patch_displacements(
    reference: Floats, band: Floats, saturation: float = float("inf"), most: int = 400
) -> Displacements:
    """Displacements of a band in windows, by least squares matching with brightness and contrast as unknowns.

    Every edge and texture of a window takes part, whatever its direction; where colours change together with
    brightness, single windows are displaced by that, which the model over the field averages and tests.
    """
    height, width = reference.shape
    reach = _WINDOW + 2 * _MARGIN
    rows = np.arange(0, height - reach + 1, _WINDOW)
    columns = np.arange(0, width - reach + 1, _WINDOW)
    corners = [(int(r), int(c)) for r in rows for c in columns]
    step = max(1, -(-len(corners) // most))
    found = []
    for row, column in corners[::step]:
        part = (slice(row, row + reach), slice(column, column + reach))
        here, there = reference[part], band[part]
        if not (np.isfinite(here).all() and np.isfinite(there).all()):
            continue
        if max(here.max(), there.max()) >= saturation:
            continue
        match = _matched(here, there)
        if match is not None:
            middle = (reach - 1) / 2.0
            found.append((column + middle, row + middle, *match))
    if len(found) < 4:
        raise InputError(
            f"{len(found)} of {len(corners[::step])} windows of {_WINDOW} × {_WINDOW} pixels show the same structure "
            "in both bands (correlation from 0.9); at least 4 are needed"
        )
    table = np.array(found)
    n = len(found)
    place = np.repeat(table[:, :2], 2, 0)
    direction = np.tile(np.eye(2), (n, 1))
    sigma = np.hypot(table[:, 4:6].ravel(), _MATCHING_FLOOR)
    return Displacements(
        place=place, direction=direction, value=table[:, 2:4].ravel(), sigma=sigma, group=np.repeat(np.arange(n), 2)
    )


def _matched(here: Floats, there: Floats) -> tuple[float, float, float, float] | None:
    """Displacement along x and y and their standard deviations; None: the windows do not match."""
    inner = (slice(_MARGIN, -_MARGIN), slice(_MARGIN, -_MARGIN))
    spline = scipy.ndimage.spline_filter(there, order=3)
    y, x = np.mgrid[_MARGIN : here.shape[0] - _MARGIN, _MARGIN : here.shape[1] - _MARGIN].astype(float)
    grey = here[inner].ravel()
    if grey.std() < 1e-9 or there[inner].std() < 1e-9:
        return None
    # Slopes of the reference, at whole pixels: their noise has nothing to do with that of the interpolated band, and
    # by symmetry nothing with that of the reference. Slopes of the band would pull the result to whole pixels.
    slopes = [each[inner].ravel() for each in np.gradient(here)[::-1]]
    contrast, moved = there[inner].std() / here[inner].std(), np.zeros(2)
    for _ in range(_MATCHING_ROUNDS):
        at = [y + moved[1], x + moved[0]]
        values = scipy.ndimage.map_coordinates(spline, at, order=3, prefilter=False).ravel()
        # band(place + displacement) = contrast · reference + brightness.
        matrix = np.stack([-contrast * slopes[0], -contrast * slopes[1], grey, np.ones(grey.size)], 1)
        fit = solve(matrix, values)
        unknowns = fit.unknowns
        if fit.condition < 1e-4:
            return None
        moved += np.clip(unknowns[:2], -1.0, 1.0)
        if np.abs(moved).max() > _MARGIN - 3 or unknowns[2] <= 0.0:
            return None
        contrast = unknowns[2]
        if np.abs(unknowns[:2]).max() < 1e-4:
            break
    sigma = fit.sigmas[:2]
    if sigma.max() > _MOST_SIGMA:
        return None
    if np.corrcoef(values, grey)[0, 1] < _LEAST_CORRELATION:
        return None
    return float(moved[0]), float(moved[1]), float(sigma[0]), float(sigma[1])
