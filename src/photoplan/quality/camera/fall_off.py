"""Fall-off of light: its model, and its measurement from images of a uniform surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from photoplan.adjustment.least_squares import bisquare, by_differences, solve, spread
from photoplan.arrays import Floats, Floats32
from photoplan.errors import GeometryError, InputError
from photoplan.geometry.grid import Window

_AT_ONCE = 1 << 21
"""Pixels whose gain is computed at once."""
MOST_DEGREE = 10
_FAINT = 0.01
"""Brightness as part of that at the principal point below which nothing can be corrected."""


@dataclass(frozen=True)
class FallOffModel:
    """Brightness of an even surface over the image, relative to the principal point."""

    size: tuple[int, int]
    """Width and height of the image, pixels."""
    principal_point: tuple[float, float]
    """Column and row where the brightness is 1, from which the radius counts."""
    camera_constant: float | None
    """Pixels, of the natural part; None: there is none apart, the terms hold everything."""
    terms: tuple[tuple[int, int], ...]
    """(n, m) for r^n cos(m θ), (n, −m) for r^n sin(m θ); r in half diagonals of the image, θ from columns to rows."""
    coefficients: tuple[float, ...]
    """Of the terms in the artificial part, 1 + Σ."""
    dark: float = 0.0
    """Grey value of no light, which is taken off before the gain is applied and added after it."""

    def __post_init__(self) -> None:
        if min(self.size) < 1 or len(self.terms) != len(self.coefficients):
            raise InputError(
                f"light fall-off for an image of {self.size} with {len(self.terms)} terms and {len(self.coefficients)} "
                "coefficients; a size and one coefficient for each term are needed"
            )
        for n, m in self.terms:
            if not 1 <= n <= MOST_DEGREE or abs(m) > n or (n - m) % 2:
                raise InputError(
                    f"light fall-off: term ({n}, {m}); allowed are degrees 1 to {MOST_DEGREE} with |m| up to the "
                    "degree and as even or odd as it"
                )
        numbers = (*self.principal_point, *self.coefficients, self.dark)
        if not all(math.isfinite(v) for v in numbers):
            raise InputError("light fall-off: principal point, coefficients and dark must be finite numbers")
        if self.camera_constant is not None and not 0.0 < self.camera_constant < math.inf:
            raise InputError(f"light fall-off: camera constant {self.camera_constant}; a positive number is needed")

    @property
    def half_diagonal(self) -> float:
        """The unit of the radius, pixels."""
        return math.hypot(*self.size) / 2.0

    def natural(self, x: Floats, y: Floats) -> Floats:
        """cos⁴ω at columns and rows; 1 where there is no natural part."""
        x, y = np.asarray(x, float) - self.principal_point[0], np.asarray(y, float) - self.principal_point[1]
        if self.camera_constant is None:
            return np.ones(np.broadcast_shapes(x.shape, y.shape))
        return (1.0 + (x**2 + y**2) / self.camera_constant**2) ** -2

    def artificial(self, x: Floats, y: Floats) -> Floats:
        """What the natural part leaves, 1 at the principal point."""
        unit = self.half_diagonal
        u = (np.asarray(x, float) - self.principal_point[0]) / unit
        v = (np.asarray(y, float) - self.principal_point[1]) / unit
        total = np.ones(np.broadcast_shapes(u.shape, v.shape))
        for term, factor in zip(self.terms, self.coefficients):
            total += factor * term_values(u, v, term)
        return total

    def relative(self, x: Floats, y: Floats) -> Floats:
        """Brightness at columns and rows, 1 at the principal point."""
        return self.natural(x, y) * self.artificial(x, y)


def term_values(u: Floats, v: Floats, term: tuple[int, int]) -> Floats:
    """r^n cos(m θ), or for negative m r^n sin(|m| θ), of u = r cos θ and v = r sin θ."""
    n, m = term
    square = u * u + v * v
    turned = (u + 1j * v) ** abs(m)
    return np.asarray((turned.imag if m < 0 else turned.real) * square ** ((n - abs(m)) // 2))


def surface_terms(degree: int) -> tuple[tuple[int, int], ...]:
    """All terms up to a degree: together they span the general polynomial in columns and rows of that degree."""
    return tuple(
        (n, s * m) for n in range(1, degree + 1) for m in range(n % 2, n + 1, 2) for s in ((1, -1) if m else (1,))
    )


def correct_fall_off(pixels: NDArray[Any], window: Window, model: FallOffModel) -> tuple[NDArray[Any], int]:
    """Apply the gain, 1 / relative brightness, to the pixels of a window."""
    if pixels.ndim not in (2, 3) or pixels.shape[-2:] != (window.height, window.width):
        raise InputError(f"pixels of shape {pixels.shape} for a window of {window.width} × {window.height}")
    if window.col < 0 or window.row < 0 or window.stop[0] > model.size[0] or window.stop[1] > model.size[1]:
        raise InputError(
            f"light fall-off is known for an image of {model.size[0]} × {model.size[1]} pixels; the window {window} "
            "leaves it: use the correction of this camera at this image size"
        )
    if pixels.dtype.kind not in "uif":
        raise InputError(f"pixels of type {pixels.dtype}; whole numbers or floats are needed")
    out = np.empty_like(pixels)
    clipped = 0
    rows = max(1, _AT_ONCE // max(window.width, 1))
    x = np.arange(window.col, window.stop[0], dtype=float)[None, :]
    for first in range(0, window.height, rows):
        part = slice(first, min(first + rows, window.height))
        gain = _gain(model, x, window.row + np.arange(part.start, part.stop, dtype=float)[:, None])
        values = (pixels[..., part, :].astype(np.float64) - model.dark) * gain + model.dark
        if pixels.dtype.kind in "ui":
            limits = np.iinfo(pixels.dtype)
            np.rint(values, out=values)
            clipped += int(np.count_nonzero((values < limits.min) | (values > limits.max)))
            np.clip(values, limits.min, limits.max, out=values)
        out[..., part, :] = values
    return out, clipped


def gain_image(model: FallOffModel, factor: int = 1) -> Floats32:
    """Gains 1 / relative brightness at the middles of blocks of `factor` × `factor` pixels, shape (h, w) / factor.

    Blocks at the right and lower border may reach beyond the image.
    """
    if factor < 1:
        raise InputError(f"gain image reduced by {factor}; 1 or more is allowed")
    width, height = (-(-side // factor) for side in model.size)
    x = (np.arange(width) + 0.5)[None, :] * factor - 0.5
    out = np.empty((height, width), np.float32)
    rows = max(1, _AT_ONCE // width)
    for first in range(0, height, rows):
        y = (np.arange(first, min(first + rows, height)) + 0.5)[:, None] * factor - 0.5
        out[first : first + rows] = _gain(model, x, y)
    return out


def largest_gain(model: FallOffModel) -> float:
    """The largest gain, 1 / relative brightness, of 65 × 65 places over the image, its corners among them."""
    x, y = (np.linspace(0.0, side - 1.0, 65) for side in model.size)
    return float(_gain(model, x[None, :], y[:, None]).max())


def _gain(model: FallOffModel, x: NDArray[np.floating], y: NDArray[np.floating]) -> Floats:
    relative = model.relative(np.asarray(x, float), np.asarray(y, float))
    if relative.min() < _FAINT:
        raise InputError(
            f"light fall-off: the model gives {100 * relative.min():.2g} % of the central brightness inside the image; "
            "it does not hold there and corrects nothing: fit it again with a lower degree"
        )
    return 1.0 / relative


#: Standard deviations above which a term counts.
SIGNIFICANT = 4.0


@dataclass(frozen=True)
class FallOffSettings:
    """What is known, and what is estimated."""

    natural: Literal["given", "estimated", "none"] = "none"
    """Camera constant of cos⁴ω: given, estimated from the fall-off, or no natural part apart from the terms."""
    camera_constant: float | None = None
    """Pixels; needed where it is given."""
    principal_point: tuple[float, float] | None = None
    """Column and row; None: the middle of the image."""
    estimate_principal_point: bool = False
    """Whether it is estimated too."""
    artificial: Literal["surface", "radial", "none"] = "surface"
    """A general polynomial surface, one of even powers of the radius, or no artificial part."""
    degree: int = 6
    dark: float = 0.0
    """Grey value of no light that was left in the flat image; it is passed on to the model."""

    def __post_init__(self) -> None:
        if (self.natural == "given") != (self.camera_constant is not None):
            raise InputError(
                f"natural light fall-off {self.natural!r} with camera constant {self.camera_constant}; give the camera "
                "constant with 'given' and only with it"
            )
        if self.camera_constant is not None and not 0.0 < self.camera_constant < math.inf:
            raise InputError(f"camera constant {self.camera_constant} px; a positive number is needed")
        if not 2 <= self.degree <= MOST_DEGREE:
            raise InputError(f"polynomial of degree {self.degree}; 2 to {MOST_DEGREE} are allowed")

    def terms(self) -> tuple[tuple[int, int], ...]:
        """Terms that are tried for the artificial part."""
        if self.artificial == "none":
            return ()
        found = surface_terms(self.degree)
        return found if self.artificial == "surface" else tuple(t for t in found if t[1] == 0)


#: Unknowns of the natural part.
CONSTANT, POINT = "camera constant", ("column of the principal point", "row of the principal point")


@dataclass(frozen=True, eq=False)
class FallOffFit:
    """Unknowns: those of the natural part first, see `moved`, then level and level · coefficients."""

    model: FallOffModel
    linear: Floats
    covariance: Floats
    weights: Floats
    residuals: Floats
    free: tuple[str, ...]


def design(blocks: Blocks, model: FallOffModel) -> Floats:
    """Columns of the linear unknowns for all known blocks, shape (n, 1 + terms): the level, then each term."""
    u, v = ((at - p) / model.half_diagonal for at, p in zip((blocks.x, blocks.y), model.principal_point))
    natural = model.natural(blocks.x, blocks.y)
    return natural[:, None] * np.column_stack([np.ones_like(u), *(term_values(u, v, t) for t in model.terms)])


def moved(model: FallOffModel, free: tuple[str, ...], step: Floats) -> FallOffModel:
    """A model whose natural part has gone a step: log of the camera constant, principal point in half diagonals."""
    by, unit, c, point = dict(zip(free, step)), model.half_diagonal, model.camera_constant, list(model.principal_point)
    if CONSTANT in by and c is not None:
        c = float(np.clip(c * math.exp(by[CONSTANT]), 0.05 * unit, 1e3 * unit))
    for k, (name, side) in enumerate(zip(POINT, model.size)):
        if name in by:
            point[k] = float(np.clip(point[k] + by[name] * unit, -side, 2.0 * side))
    return replace(model, principal_point=(point[0], point[1]), camera_constant=c)


def adjust(
    blocks: Blocks, settings: FallOffSettings, terms: tuple[tuple[int, int], ...], weights: Floats | None = None
) -> FallOffFit:
    """Gauss-Newton for the unknowns of the natural part beside the linear ones.

    Weights are those of the blocks, shape (n,); None: all equal.
    """
    free = ((CONSTANT,) if settings.natural == "estimated" else ()) + (
        POINT if settings.estimate_principal_point else ()
    )
    start = settings.principal_point or ((blocks.size[0] - 1) / 2.0, (blocks.size[1] - 1) / 2.0)
    c = settings.camera_constant if settings.natural != "estimated" else _start_constant(blocks, start)
    model = FallOffModel(
        size=blocks.size,
        principal_point=start,
        camera_constant=c,
        terms=terms,
        coefficients=(0.0,) * len(terms),
        dark=settings.dark,
    )
    y = blocks.known
    w = np.ones_like(y) if weights is None else weights
    for step in range(40):
        fit = solve(design(blocks, model), y, w)
        by = solve(_design_with(blocks, model, fit.unknowns, free), -fit.residuals, w).unknowns[: len(free)]
        change = np.clip(by, -0.3, 0.3)
        model = moved(model, free, change)
        if weights is None and step < 30:
            size = spread(fit.residuals)
            w = bisquare(fit.residuals / size) if size > 0.0 else np.ones_like(y)
        if step >= 6 and np.abs(change).max(initial=0.0) < 1e-7:
            break
    fit = solve(design(blocks, model), y, w)
    linear, residuals = fit.unknowns, -fit.residuals
    return FallOffFit(
        model=replace(model, coefficients=tuple(float(a) for a in linear[1:] / linear[0])),
        linear=linear,
        covariance=_covariance(blocks, _design_with(blocks, model, linear, free), residuals, w),
        weights=w,
        residuals=residuals,
        free=free,
    )


def _start_constant(blocks: Blocks, point: tuple[float, float]) -> float:
    """From the curvature at the principal point, where cos⁴ω falls by 2 r² / c²."""
    plain = FallOffModel(
        size=blocks.size,
        principal_point=point,
        camera_constant=None,
        terms=((1, 1), (1, -1), (2, 0)),
        coefficients=(0.0, 0.0, 0.0),
    )
    found = solve(design(blocks, plain), blocks.known).unknowns
    fall = -found[3] / found[0]
    if not fall > 1e-4:
        raise GeometryError(
            "the brightness does not fall off from the principal point; no camera constant can be estimated from it. "
            "Give the camera constant, or ask for no natural part"
        )
    return plain.half_diagonal * math.sqrt(2.0 / fall)


def _design_with(blocks: Blocks, model: FallOffModel, linear: Floats, free: tuple[str, ...]) -> Floats:
    """Derivatives by all unknowns, those of the natural part by differences."""
    by = by_differences(lambda step: design(blocks, moved(model, free, step)) @ linear, np.zeros(len(free)), 1e-4)
    return np.column_stack([by, design(blocks, model)])


def _covariance(blocks: Blocks, J: Floats, residuals: Floats, w: Floats) -> Floats:
    """Of all unknowns; larger by what neighbouring residuals resemble each other, as fewer blocks are independent."""
    used = w > 0.0
    freedom = max(int(used.sum()) - J.shape[1], 1)
    # Weights below 1 make residuals smaller than they are: the variance is that of the spread's robust measure.
    variance = spread(residuals[used]) ** 2 * used.sum() / freedom
    return solve(J, residuals, w).cofactors * variance * blocks.inflation(np.where(used, residuals, np.nan))


def separability(blocks: Blocks, fit: FallOffFit) -> dict[str, float]:
    """For each estimated unknown, the sine of the angle between its effect and what all others can do."""
    whole = _design_with(blocks, fit.model, fit.linear, fit.free)
    shares = {}
    for k, name in enumerate(fit.free):
        rest = solve(np.delete(whole, k, axis=1), whole[:, k], fit.weights).square
        shares[name] = math.sqrt(rest / float(fit.weights @ whole[:, k] ** 2))
    return shares


def significant(blocks: Blocks, fit: FallOffFit) -> tuple[tuple[int, int], ...]:
    """Terms that are significant after all of lower degree, and those of the same direction below them."""
    terms = fit.model.terms
    if not terms:
        return ()
    root = np.sqrt(fit.weights)
    A = design(blocks, fit.model) * root[:, None]
    Q, _ = np.linalg.qr(A / np.linalg.norm(A, axis=0))
    used = fit.weights > 0.0
    size = spread(fit.residuals[used])
    size *= math.sqrt(blocks.inflation(np.where(used, fit.residuals, np.nan)))
    effect = np.abs(Q.T @ (blocks.known * root))[1:]
    strong = {term for term, e in zip(terms, effect) if e > SIGNIFICANT * max(size, 1e-300)}
    return tuple(t for t in terms if any(s[1] == t[1] and s[0] >= t[0] for s in strong))


def weakest(fit: FallOffFit) -> tuple[int, int] | None:
    """The least significant term of those that are the highest of their direction; None: all of these count.

    What `significant` keeps may have carried a part of terms of higher degree, since terms are not at right angles to
    each other on a rectangle.
    """
    first, terms = len(fit.free) + 1, fit.model.terms
    sigmas = np.sqrt(np.maximum(np.diag(fit.covariance)[first:], 1e-300))
    tops = {m: max(n for n, other in terms if other == m) for _, m in terms}
    values = {term: abs(a) / s for term, a, s in zip(terms, fit.linear[1:], sigmas) if tops[term[1]] == term[0]}
    term = min(values, key=values.__getitem__, default=None)
    return term if term is not None and values[term] < SIGNIFICANT else None


#: Blocks along the longer side.
ACROSS = 96
"""Tukey's constant: 95 % efficient for normal noise."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Means of square blocks of an image."""

    size: tuple[int, int]
    """Width and height of the image, pixels."""
    side: int
    """Of a block, pixels."""
    offset: tuple[int, int]
    """Column and row of the first block's first pixel."""
    values: Floats
    """Shape (rows, columns); NaN: not known."""

    @property
    def known(self) -> Floats:
        """Values of the blocks that have one, shape (n,)."""
        return self.values[np.isfinite(self.values)]

    @property
    def x(self) -> Floats:
        """Columns of their middles, shape (n,)."""
        return self._middles(1)

    @property
    def y(self) -> Floats:
        """Rows of their middles, shape (n,)."""
        return self._middles(0)

    def corner(self, column: int, row: int) -> tuple[float, float]:
        """Column and row of the upper left corner of a block."""
        return self.offset[0] + column * self.side - 0.5, self.offset[1] + row * self.side - 0.5

    def spread_out(self, known: Floats) -> Floats:
        """Values of the known blocks where they lie, NaN elsewhere, shape (rows, columns)."""
        out = np.full(self.values.shape, np.nan)
        out[np.isfinite(self.values)] = known
        return out

    def neighbour_correlation(self, known: Floats) -> float:
        """Correlation of values of blocks beside and below each other; NaN among them is left out."""
        return float(np.mean(self._correlations(known)))

    def inflation(self, known: Floats) -> float:
        """By how much variances grow as neighbours are not independent (first-order Markov process in both ways)."""
        count = int(np.isfinite(known).sum())
        factor = 1.0
        for r in self._correlations(known):
            r = min(r, 0.9)
            if r > 3.0 / math.sqrt(max(count, 1)):
                factor *= (1.0 + r) / (1.0 - r)
        return factor

    def _correlations(self, known: Floats) -> tuple[float, float]:
        field = self.spread_out(known)
        field = field - np.nanmean(field)
        variance = float(np.nanmean(field**2))
        if not variance > 0.0:
            return 0.0, 0.0
        beside = float(np.nanmean(field[:, 1:] * field[:, :-1])) / variance
        below = float(np.nanmean(field[1:] * field[:-1])) / variance
        return beside, below

    def _middles(self, axis: int) -> Floats:
        index = np.indices(self.values.shape)[axis][np.isfinite(self.values)]
        return self.offset[1 - axis] + index * self.side + (self.side - 1) / 2.0


def to_blocks(image: NDArray[np.floating]) -> Blocks:
    """Reduce an image to about `ACROSS` blocks along its longer side, each the mean of the middle half of its values.

    Single dust grains, hot and dead pixels leave such a mean alone, and it is finer than the steps of grey values.
    A block with an unknown pixel (NaN) is unknown. Pixels at the borders that fill no block are left out.
    """
    height, width = image.shape
    side = max(1, round(max(height, width) / ACROSS))
    rows, columns = height // side, width // side
    left, top = (width - columns * side) // 2, (height - rows * side) // 2
    values = np.empty((rows, columns))
    n = side * side
    low, high = n // 4, n - n // 4
    for row in range(rows):
        strip = np.asarray(image[top + row * side : top + (row + 1) * side, left : left + columns * side], float)
        parts = strip.reshape(side, columns, side).transpose(1, 0, 2).reshape(columns, n)
        known = np.isfinite(parts).all(axis=1)
        values[row] = np.where(known, np.sort(parts, axis=1)[:, low:high].mean(axis=1), np.nan)
    return Blocks((width, height), side, (left, top), values)


#: Least part of what an unknown changes that no other one can do as well.
SEPARABLE = 0.05
_KNOWN = 0.1
"""Largest standard deviation of an estimated camera constant as part of it."""
_DIRTY = 5.5
#: Stains that are listed, the deepest.
_MOST_DIRT = 100
_UNEVEN, _STRUCTURE = 0.02, 0.5
"""Residual as part of the brightness, and correlation of neighbours, above which the surface is not even."""


@dataclass(frozen=True)
class Term:
    """A term of the artificial part."""

    n: int
    m: int
    coefficient: float
    sigma: float


@dataclass(frozen=True)
class Corner:
    """Brightness that is lost in a corner against the principal point, parts of it."""

    name: str
    total: float
    sigma: float
    natural: float | None
    """None: not told apart."""
    artificial: float | None


@dataclass(frozen=True)
class Dirt:
    """A place that differs from the smooth surface: dust, a scratch, a stain."""

    x: float
    y: float
    """Column and row of its middle."""
    width: int
    height: int
    """Of the blocks that it covers, pixels."""
    depth: float
    """Largest difference, part of the brightness there; negative: darker."""


@dataclass(frozen=True, eq=False)
class FallOff:
    """Result of the adjustment."""

    model: FallOffModel
    level: float
    """Grey value at the principal point, above dark."""
    sigma_level: float
    terms: tuple[Term, ...]
    camera_constant: float | None
    sigma_camera_constant: float | None
    """None: given, or not determined."""
    sigma_principal_point: tuple[float, float] | None
    """None: it was given."""
    corners: tuple[Corner, ...]
    rank: str
    """What the fall-off does not determine, and why; empty: everything asked is determined."""
    separability: dict[str, float] = field(default_factory=dict)
    """For every estimated unknown of the natural part: which share of its effect no other unknown can imitate."""
    residual_rms: float = math.nan
    """Of the blocks after correction, parts of the brightness."""
    residual_largest: float = math.nan
    neighbour_correlation: float = math.nan
    """Of residuals of neighbouring blocks: 0 for noise; more tells structure that the model does not describe."""
    range_before: float = math.nan
    """Brightest minus darkest block before the correction, part of the level."""
    dirt: tuple[Dirt, ...] = ()
    blocks: Blocks | None = None
    residuals: Floats | None = None
    """Relative residuals of the blocks, measured minus model, shape (h, w); NaN: block not known."""

    @property
    def asymmetry(self) -> float:
        """Largest difference of two corners' brightness, part of that at the principal point."""
        totals = [c.total for c in self.corners]
        return max(totals) - min(totals)


def fit_fall_off(flat: NDArray[np.floating], settings: FallOffSettings | None = None) -> FallOff:
    """Fit a model of light fall-off to the image of an evenly lit surface.

    The image is reduced to blocks, each the mean of the middle half of its values, and adjusted with weights that
    leave out dirt. Terms that are not significant are dropped. Where an estimated camera constant cannot be told from
    the polynomial, it is not stated: the whole is then modelled by the terms alone, and `rank` says so.
    """
    settings = settings or FallOffSettings()
    blocks = _checked(flat)
    terms, rank, shares = settings.terms(), "", {}
    fit = adjust(blocks, settings, terms)
    if fit.free:
        shares = separability(blocks, fit)
        rank = _rank(fit, shares, settings)
        if rank and settings.artificial == "none":
            raise GeometryError(rank)
        if rank:
            settings = replace(settings, natural="none", camera_constant=None, estimate_principal_point=False)
            fit = adjust(blocks, settings, terms)
    kept = significant(blocks, fit)
    if kept != fit.model.terms:
        fit = adjust(blocks, settings, kept, fit.weights)
    while (weak := weakest(fit)) is not None:
        fit = adjust(blocks, settings, tuple(term for term in fit.model.terms if term != weak), fit.weights)
    symmetric = fit.model.camera_constant is not None or any(m == 0 for _, m in fit.model.terms)
    # No fall-off was seen: how well that is known, a term of it says.
    judged = fit if symmetric else adjust(blocks, settings, ((2, 0), *fit.model.terms), fit.weights)
    found = _result(blocks, fit, _corner_sigmas(judged), rank, shares)
    # A surface that is not general leaves asymmetry too; only the general one can say that nothing smooth fits.
    general = settings.artificial == "surface"
    if general and found.residual_rms > _UNEVEN and found.neighbour_correlation > _STRUCTURE:
        raise InputError(
            f"flat image: {100 * found.residual_rms:.1f} % (rms) is left beside any smooth surface, and neighbouring "
            f"blocks resemble each other ({found.neighbour_correlation:.2f}): it shows a structure, not an evenly lit "
            "surface. Take flat frames of one, or out of focus"
        )
    return found


def _checked(flat: NDArray[np.floating]) -> Blocks:
    if flat.ndim != 2 or min(flat.shape) < 16:
        raise InputError(f"flat image of shape {flat.shape}; at least 16 × 16 pixels are needed")
    blocks = to_blocks(flat)
    known = blocks.values[np.isfinite(blocks.values)]
    if known.size < 0.5 * blocks.values.size or known.size < 64:
        raise InputError(
            f"flat image: {known.size} of {blocks.values.size} blocks have values; half of them are needed"
        )
    if not float(np.median(known)) > 0.0:
        raise InputError("flat image: no brightness above the dark frame; is it a dark frame itself?")
    return blocks


def _rank(fit: FallOffFit, shares: dict[str, float], settings: FallOffSettings) -> str:
    """Which unknowns cannot be told apart; empty: none."""
    sigmas = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    lost = [
        f"{name} ({100 * (1 - share**2):.2f} % of what it changes, the other unknowns can do as well; its standard "
        f"deviation would be {100 * sigma:.0f} % of {'it' if name == CONSTANT else 'half the diagonal'})"
        for (name, share), sigma in zip(shares.items(), sigmas)
        if share < SEPARABLE or not sigma < _KNOWN
    ]
    if not lost:
        return ""
    # Without an artificial part the level is the only other unknown: the fall-off is then too weak.
    other = f"the {settings.artificial} polynomial" if settings.artificial != "none" else "the noise"
    return (
        f"natural and artificial light fall-off are not told apart: {'; '.join(lost)} cannot be separated from "
        f"{other}. Give the camera constant and principal point of a calibration, or ask for one of the two parts alone"
    )


def _result(blocks: Blocks, fit: FallOffFit, of_corners: Floats, rank: str, shares: dict[str, float]) -> FallOff:
    k, level, C, model = len(fit.free), float(fit.linear[0]), fit.covariance, fit.model
    factors, c = np.array(model.coefficients), model.camera_constant
    # a_k = (level · a_k) / level
    L = np.column_stack([-factors / level, np.eye(len(factors)) / level])
    sigmas = np.sqrt(np.maximum(np.diag(L @ C[k:, k:] @ L.T), 0.0))
    free = {name: math.sqrt(max(float(C[i, i]), 0.0)) for i, name in enumerate(fit.free)}
    constant = free.get(CONSTANT)
    across, down = (free.get(name) for name in POINT)
    unit = model.half_diagonal
    computed = design(blocks, model) @ fit.linear
    relative, clean = fit.residuals / computed, fit.weights > 0.0
    field = blocks.spread_out(relative)
    return FallOff(
        model=model,
        level=level,
        sigma_level=math.sqrt(float(C[k, k])),
        terms=tuple(Term(n, m, float(f), float(s)) for (n, m), f, s in zip(model.terms, factors, sigmas)),
        camera_constant=c,
        sigma_camera_constant=None if constant is None or c is None else constant * c,
        sigma_principal_point=None if across is None or down is None else (across * unit, down * unit),
        corners=_corners(model, of_corners),
        rank=rank,
        separability=shares,
        residual_rms=float(np.sqrt(np.mean(relative[clean] ** 2))),
        residual_largest=float(np.abs(relative[clean]).max()),
        neighbour_correlation=blocks.neighbour_correlation(np.where(clean, fit.residuals, np.nan)),
        range_before=float(np.ptp(computed)) / level,
        dirt=_dirt(blocks, blocks.spread_out(fit.residuals), field),
        blocks=blocks,
        residuals=field,
    )


def _corner_places(size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Columns and rows of the centres of the four corner pixels."""
    right, lower = size[0] - 1.0, size[1] - 1.0
    return np.array([0.0, right, 0.0, right]), np.array([0.0, 0.0, lower, lower])


def _corner_sigmas(fit: FallOffFit) -> Floats:
    """Standard deviations of the brightness in the corners, by differences."""
    x, y = _corner_places(fit.model.size)
    k, linear = len(fit.free), fit.linear

    def relative(unknowns: Floats) -> Floats:
        model = moved(fit.model, fit.free, unknowns[:k])
        return replace(model, coefficients=tuple(unknowns[k + 1 :] / unknowns[k])).relative(x, y)

    steps = np.repeat([1e-5, 1e-5 * abs(linear[0])], [k, len(linear)])
    J = by_differences(relative, np.concatenate([np.zeros(k), linear]), steps)
    return np.asarray(np.sqrt(np.maximum(np.diag(J @ fit.covariance @ J.T), 0.0)))


def _corners(model: FallOffModel, sigmas: Floats) -> tuple[Corner, ...]:
    """Fall-off in the centres of the four corner pixels."""
    names = ("upper left", "upper right", "lower left", "lower right")
    places = _corner_places(model.size)
    apart = model.camera_constant is not None
    parts = zip(names, sigmas, model.natural(*places), model.artificial(*places))
    return tuple(
        Corner(n, float(1.0 - a * b), float(s), *((float(1.0 - a), float(1.0 - b)) if apart else (None, None)))
        for n, s, a, b in parts
    )


def _dirt(blocks: Blocks, residuals: Floats, relative: Floats) -> tuple[Dirt, ...]:
    """Connected blocks that stand out, the deepest first."""
    known = np.isfinite(residuals)
    # In grey values: the relative noise is larger in the corners.
    limit = _DIRTY * spread(residuals[known])
    if not limit > 0.0:
        return ()
    pieces, _ = scipy.ndimage.label(known & (np.abs(residuals) > limit), np.ones((3, 3)))
    found = []
    for number, place in enumerate(scipy.ndimage.find_objects(pieces), 1):
        values = np.where(pieces[place] == number, relative[place], 0.0)
        rows, columns = (s for s in place)
        deepest = float(values.flat[int(np.abs(values).argmax())])
        x0, y0 = blocks.corner(columns.start, rows.start)
        x1, y1 = blocks.corner(columns.stop, rows.stop)
        found.append(
            Dirt(x=(x0 + x1) / 2.0, y=(y0 + y1) / 2.0, width=round(x1 - x0), height=round(y1 - y0), depth=deepest)
        )
    return tuple(sorted(found, key=lambda d: -abs(d.depth))[:_MOST_DIRT])
