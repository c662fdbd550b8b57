"""Light fall-off measured in a flat image: natural and artificial part, told apart where they can be (Behr, §4.2.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.adjustment.iterate import by_differences
from photoplan.adjustment.robust import spread
from photoplan.errors import GeometryError, InputError
from photoplan.quality.camera.fall_off_adjust import (
    CONSTANT,
    POINT,
    Blocks,
    FallOffFit,
    FallOffSettings,
    adjust,
    design,
    moved,
    separability,
    significant,
    to_blocks,
    weakest,
)
from photoplan.quality.camera.fall_off_model import FallOffModel

Array = NDArray[np.float64]

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
    residuals: Array | None = None
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


def _result(blocks: Blocks, fit: FallOffFit, of_corners: Array, rank: str, shares: dict[str, float]) -> FallOff:
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


def _corner_places(size: tuple[int, int]) -> tuple[Array, Array]:
    """Columns and rows of the centres of the four corner pixels."""
    right, lower = size[0] - 1.0, size[1] - 1.0
    return np.array([0.0, right, 0.0, right]), np.array([0.0, 0.0, lower, lower])


def _corner_sigmas(fit: FallOffFit) -> Array:
    """Standard deviations of the brightness in the corners, by differences."""
    x, y = _corner_places(fit.model.size)
    k, linear = len(fit.free), fit.linear

    def relative(unknowns: Array) -> Array:
        model = moved(fit.model, fit.free, unknowns[:k])
        return replace(model, coefficients=tuple(unknowns[k + 1 :] / unknowns[k])).relative(x, y)

    steps = np.repeat([1e-5, 1e-5 * abs(linear[0])], [k, len(linear)])
    J = by_differences(relative, np.concatenate([np.zeros(k), linear]), steps)
    return np.asarray(np.sqrt(np.maximum(np.diag(J @ fit.covariance @ J.T), 0.0)))


def _corners(model: FallOffModel, sigmas: Array) -> tuple[Corner, ...]:
    """Fall-off in the centres of the four corner pixels."""
    names = ("upper left", "upper right", "lower left", "lower right")
    places = _corner_places(model.size)
    apart = model.camera_constant is not None
    parts = zip(names, sigmas, model.natural(*places), model.artificial(*places))
    return tuple(
        Corner(n, float(1.0 - a * b), float(s), *((float(1.0 - a), float(1.0 - b)) if apart else (None, None)))
        for n, s, a, b in parts
    )


def _dirt(blocks: Blocks, residuals: Array, relative: Array) -> tuple[Dirt, ...]:
    """Connected blocks that stand out, the deepest first."""
    known = np.isfinite(residuals)
    # In grey values: the relative noise is larger in the corners.
    limit = _DIRTY * spread(residuals[known])
    if not limit > 0.0:
        return ()
    pieces, _ = ndimage.label(known & (np.abs(residuals) > limit), np.ones((3, 3)))
    found = []
    for number, place in enumerate(ndimage.find_objects(pieces), 1):
        values = np.where(pieces[place] == number, relative[place], 0.0)
        rows, columns = (s for s in place)
        deepest = float(values.flat[int(np.abs(values).argmax())])
        x0, y0 = blocks.corner(columns.start, rows.start)
        x1, y1 = blocks.corner(columns.stop, rows.stop)
        found.append(
            Dirt(x=(x0 + x1) / 2.0, y=(y0 + y1) / 2.0, width=round(x1 - x0), height=round(y1 - y0), depth=deepest)
        )
    return tuple(sorted(found, key=lambda d: -abs(d.depth))[:_MOST_DIRT])
