"""Which filter restores an image: the one of least expected error, or the exact inverse for whoever asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import pi, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.restoration.filters import FilterKernel
from photoplan.quality.restoration.inverse import Condition, condition_of, exact_inverse
from photoplan.quality.restoration.regularised import Expectation, curve_transfer, sharpest
from photoplan.quality.restoration.scene import SceneStatistics
from photoplan.quality.spread import GAUSSIAN_WIDTH, SpreadFunction


def radial_filter(
    inverse_x: NDArray[np.float64], inverse_y: NDArray[np.float64] | None = None, distance_digits: int | None = None
) -> NDArray[np.float64]:
    """Two-dimensional filter whose row and column sums are given one-dimensional inverses, turned about its centre.

    The rotation assumption: the weight depends on the distance r from the centre, linearly between the whole distances
    0, 1, 2 … of the main axes, and is 0 beyond the last but one; where the axes differ, it goes over from one to the
    other with the squared cosine of the direction. The weights on the axes follow from the row and column sums, as
    many linear equations as unknowns. Kölbl states this principle (2006, §3); with distances rounded to two digits it
    gives the printed filters of figures 4 and 6 to the last digit.

    Parameters
    ----------
    inverse_x, inverse_y : ndarray, shape (2 n + 1,)
        Inverses along a row and along a column, symmetric; None for y: the same. Their sums must be equal.
    distance_digits : int, optional
        Decimals to which distances are rounded; None: exact.

    Returns
    -------
    ndarray, shape (2 n + 1, 2 n + 1)

    Raises
    ------
    InputError
        Inverses of different length, not symmetric, or with different sums.
    """
    across = np.asarray(inverse_x, float)
    along = across if inverse_y is None else np.asarray(inverse_y, float)
    _check(across, along)
    half = across.size // 2
    weights = _axis_weights(half, distance_digits)
    # Column sums are the inverse along a row, row sums the one along a column; both sides are equal by symmetry.
    equations = np.concatenate([weights.sum(axis=0)[half:], weights.sum(axis=1)[half:]])
    right = np.concatenate([across[half:], along[half:]])
    axes = np.linalg.lstsq(equations, right, rcond=None)[0]
    return np.asarray(weights @ axes)


def point_spread(x: SpreadFunction, y: SpreadFunction) -> NDArray[np.float64]:
    """Point spread function whose sums are the spread functions along a row and along a column.

    Between the axes by the rotation assumption of `radial_filter`; both spread functions are made symmetric, and the
    shorter one is continued with 0. Shape (2 n + 1, 2 n + 1), sum 1.
    """
    half = max(x.half, y.half)
    across, along = (np.pad(one.side(), (0, half - one.half)) for one in (x, y))
    return radial_filter(np.concatenate([across[:0:-1], across]), np.concatenate([along[:0:-1], along]))


def separable_filter(
    inverse_x: NDArray[np.float64], inverse_y: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Two-dimensional filter as the product of the inverses: exact if the spread function itself is such a product.

    Shape (2 n + 1, 2 n + 1). Its noise gain is the product of both, much larger than that of `radial_filter`.
    """
    across = np.asarray(inverse_x, float)
    along = across if inverse_y is None else np.asarray(inverse_y, float)
    return np.outer(along, across)


def _check(across: NDArray[np.float64], along: NDArray[np.float64]) -> None:
    if across.shape != along.shape or across.ndim != 1 or across.size % 2 == 0 or across.size < 3:
        raise InputError(
            f"both inverses have the same odd number of values, at least 3; given: {across.shape} and {along.shape}"
        )
    for name, values in (("along rows", across), ("along columns", along)):
        if np.abs(values - values[::-1]).max() > 1e-9 * np.abs(values).max():
            raise InputError(f"the inverse {name} is not symmetric; a filter turned about its centre cannot hold it")
    if abs(across.sum() - along.sum()) > 1e-9 * max(1.0, abs(along.sum())):
        raise InputError(
            f"the inverses add up to {across.sum():.6g} along rows and {along.sum():.6g} along columns; divide each by "
            "its sum"
        )


def _axis_weights(half: int, digits: int | None) -> NDArray[np.float64]:
    """How each weight follows from those on the axes, shape (2 n + 1, 2 n + 1, 1 + 2 n): centre, x axis, y axis."""
    offset = np.arange(-half, half + 1.0)
    x, y = np.meshgrid(offset, offset)
    distance = np.hypot(x, y)
    if digits is not None:
        distance = np.round(distance, digits)
    with np.errstate(invalid="ignore", divide="ignore"):
        share_x = np.where(distance > 0.0, x**2 / (x**2 + y**2), 0.5)
    below = np.floor(distance + 1e-12).astype(int)
    weights = np.zeros((*distance.shape, 1 + 2 * half))
    for whole, part in ((below, 1.0 - (distance - below)), (below + 1, distance - below)):
        for ring in range(half + 1):
            here = np.where(whole == ring, part, 0.0)
            if ring == 0:
                weights[..., 0] += here
            else:
                weights[..., ring] += here * share_x
                weights[..., half + ring] += here * (1.0 - share_x)
    return weights


#: Sizes that are tried until nothing that matters is cut off an exact inverse, pixels to each side.
_HALVES = (5, 7, 10, 14, 20, 28)
#: Share of an inverse that may be cut off.
_CUT_OFF = 0.002
#: Width of the 95 % interval of MTF50, by its value, beyond which a spread function is practically unknown.
_UNKNOWN = 0.5
#: Smoothing of noise that is worth a word, pixels.
_SMOOTHED = 0.1
#: How messages call the methods.
_NAMES = {"none": "as it is", "regularised": "regularised", "exact": "exact"}


@dataclass(frozen=True, eq=False)
class Sharpness:
    """What is known of an image's sharpness in one direction."""

    spread: SpreadFunction
    curve: MtfCurve | None = None
    """MTF, also beyond 0.5 cycles/pixel; None: that of the Gaussian of one pixel's aperture with the same spread."""

    def modulation(self) -> MtfCurve:
        """The curve, or its Gaussian stand-in."""
        if self.curve is not None:
            return self.curve
        # The discrete spread function holds the aperture twice: that of the sensor and that of the object pixel.
        variance = (self.spread.gaussian_fwhm() / GAUSSIAN_WIDTH) ** 2 - 2.0 / 12.0
        frequency = np.linspace(0.0, 2.0, 201)
        optics = np.exp(-2.0 * (pi * frequency) ** 2 * max(variance, 0.0))
        return MtfCurve(frequency, optics * np.abs(np.sinc(frequency)))

    @property
    def doubt(self) -> str:
        """Why the spread function is practically unknown, with figures; empty if it is known."""
        curve = self.modulation()
        low, high = curve.mtf50_interval()
        value = float(np.nan_to_num(curve.mtf50, nan=curve.frequency[-1]))
        return f"MTF50 {value:.2f}, interval {low:.2f} to {high:.2f}" if high - low > _UNKNOWN * value else ""


@dataclass(frozen=True)
class DesignOptions:
    """What a user decides."""

    method: Literal["auto", "exact", "regularised"] = "auto"
    rotation: Literal["radial", "separable"] = "radial"
    """How an exact inverse becomes two-dimensional."""
    half: int | None = None
    """Pixels to each side; None: 5, or as many as an exact inverse needs."""
    aperture: float = 1.0
    """Side of the ideal aperture that 'regularised' aims at, pixels."""


@dataclass(frozen=True, eq=False)
class Design:
    """A designed kernel and why it is as it is."""

    kernel: NDArray[np.float64]
    """Shape (2 m + 1, 2 n + 1), sum 1; one row or one column where the other direction stays as it is."""
    method: Literal["none", "exact", "regularised"]
    reason: str
    """The rule that chose the method, with its figures."""
    condition_x: Condition
    condition_y: Condition
    expected: Mapping[str, float] = field(default_factory=dict)
    """Expected root mean square error in light by method, ``none`` for the image as it is; empty if unknown."""

    @property
    def noise_gain(self) -> float:
        """By what factor noise grows."""
        return FilterKernel(self.kernel).noise_gain

    @property
    def expectation(self) -> str:
        """The expected errors, for people; empty if they are unknown."""
        return ", ".join(f"{error:.3g} {_NAMES[method]}" for method, error in self.expected.items())


def design_filter(
    x: Sharpness, y: Sharpness, scene: SceneStatistics | None = None, options: DesignOptions | None = None
) -> Design:
    """Restoration filter of an image whose sharpness is known along rows and along columns.

    Along a direction whose MTF50 has an interval wider than half its value the image stays as it is.

    Parameters
    ----------
    x, y : Sharpness
        Along a row (across columns) and along a column.
    scene : SceneStatistics, optional
        Noise and spectrum; only an exact inverse that is asked for can do without.
    options : DesignOptions, optional

    Raises
    ------
    InputError
        The exact inverse is asked for and its condition does not hold or the spread function is practically unknown,
        the latter in both directions whatever is asked for, or the scene is needed and missing.
    """
    asked = options or DesignOptions()
    both = dict(zip(("along rows", "along columns"), (x, y), strict=True))
    conditions = (condition_of(x.spread), condition_of(y.spread))
    doubts = [f"{name}: {one.doubt}" for name, one in both.items() if one.doubt]
    broken = [f"{name}: {c}" for name, c in zip(both, conditions, strict=True) if not c.holds]
    if len(doubts) == 2 or (doubts and asked.method == "exact"):
        raise InputError(
            "the spread function is practically unknown "
            + "; ".join(doubts)
            + ". It is not inverted; give images with "
            "more or clearer edges, or a filter"
        )
    if asked.method == "exact" and broken:
        raise InputError(
            "the image cannot be restored exactly: " + "; ".join(broken) + ". Objects that have fused cannot be told "
            "apart; use `method` regularised"
        )
    kernels: dict[Literal["none", "exact", "regularised"], NDArray[np.float64]] = {"none": np.ones((1, 1))}
    expected: dict[str, float] = {}
    if scene is not None:
        curves = [one.modulation() if not one.doubt else _ideal_curve(asked.aperture) for one in (x, y)]
        transfer = curve_transfer(*curves)
        model = Expectation.of(transfer, scene, asked.aperture)
        half = asked.half or _HALVES[0]
        kernels["regularised"] = model.best((0 if y.doubt else half, 0 if x.doubt else half))
    elif asked.method != "exact":
        raise InputError("a filter of least error needs the noise and the contrast of the scene; state both")
    if asked.method != "regularised" and not broken and not doubts:
        kernels["exact"] = _exact(x.spread, y.spread, asked)
    if scene is not None:
        expected = {method: model.error(kernel) for method, kernel in kernels.items()}
    method = asked.method if asked.method != "auto" else min(kernels, key=lambda each: expected[each])
    why = ["as asked for" if asked.method != "auto" else "least expected error"]
    if asked.method == "auto" and scene is not None:
        # The error that is expected is a mean over what the MTF may be; an image that is sharp already must not suffer.
        worst = Expectation.of(sharpest(transfer), scene, asked.aperture)
        before, after = worst.error(kernels["none"]), worst.error(kernels[method])
        if after > before:
            why = [
                f"were the MTF at the upper end of its interval, {method} would leave {after:.3g} and not {before:.3g}"
            ]
            method = "none"
    why += [f"not inverted, practically unknown {doubt}" for doubt in doubts]
    if asked.method == "auto" and broken:
        why.append("no exact inverse " + "; ".join(broken))
    if scene is not None:
        smoothed = f", smoothed by {scene.smoothed:.2f} px" if scene.smoothed > _SMOOTHED else ""
        why.append(
            f"noise {scene.noise:.3g}{smoothed}, neighbouring pixels of an ideal image differ by {scene.contrast:.3g} "
            f"(rms), spectrum of the scene ν^-{scene.exponent:.2f}, ideal aperture {asked.aperture:g} px"
        )
        if expected[method] > expected["none"]:
            why.append("more error is expected than the image has as it is")
    return Design(kernels[method], method, f"{method}: " + "; ".join(why), *conditions, expected)


def _ideal_curve(aperture: float) -> MtfCurve:
    """MTF of an ideal aperture: nothing is left to be restored."""
    frequency = np.linspace(0.0, 4.0, 401)
    return MtfCurve(frequency, np.abs(np.sinc(aperture * frequency)))


def _exact(x: SpreadFunction, y: SpreadFunction, asked: DesignOptions) -> NDArray[np.float64]:
    """Two-dimensional filter of the exact inverses, large enough, sum 1."""
    for half in _HALVES if asked.half is None else (asked.half,):
        # Both sides averaged: a filter turned about its centre has no other.
        inverses = [exact_inverse(SpreadFunction.symmetric(s.side()), half, 8 * half + 41) for s in (x, y)]
        cut = max(float(abs(i.sum() - 1.0)) + abs(float(i[0])) for i in inverses)
        if cut < _CUT_OFF * sqrt(2.0 * half + 1.0):
            break
    ones = [inverse / inverse.sum() for inverse in inverses]
    return radial_filter(*ones) if asked.rotation == "radial" else separable_filter(*ones)
