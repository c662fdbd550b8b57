"""Which filter restores an image: the one of least expected error, or the exact inverse for whoever asks for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from photoplan.quality.restoration.scene import SceneStatistics, Transfer
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
#: What a filter may leave of the error at most where the scenes that an image may show speak for different ones.
_CLEAR = 0.98
#: Smoothing of noise that is worth a word, pixels.
_SMOOTHED = 0.1
Method = Literal["none", "exact", "regularised"]
_AS_IT_IS = np.ones((1, 1))
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
    method: Method
    reason: str
    """The rule that chose the method, with its figures."""
    condition_x: Condition
    condition_y: Condition
    expected: Mapping[str, float] = field(default_factory=dict)
    """Expected root mean square error in light by method, ``none`` for the image as it is; empty if unknown."""
    scene: SceneStatistics | None = None
    """What the errors are expected for: the first of the scenes, or where nothing is done that in which a filter would
    gain least."""

    @property
    def noise_gain(self) -> float:
        """By what factor noise grows."""
        return FilterKernel(self.kernel).noise_gain

    @property
    def expectation(self) -> str:
        """The expected errors, for people; empty if they are unknown."""
        return ", ".join(f"{error:.3g} {_NAMES[method]}" for method, error in self.expected.items())


def design_filter(
    x: Sharpness,
    y: Sharpness,
    scenes: Sequence[SceneStatistics] = (),
    options: DesignOptions | None = None,
    kept: NDArray[np.float64] | None = None,
) -> Design:
    """Restoration filter of an image whose sharpness is known along rows and along columns.

    Along a direction whose MTF50 has an interval wider than half its value the image stays as it is. Of filters that
    are expected to gain in one scene and lose in another the one counts that gains most in its worst scene; `auto`
    takes none that does not gain in all.

    Parameters
    ----------
    x, y : Sharpness
        Along a row (across columns) and along a column.
    scenes : sequence of SceneStatistics
        Noise and spectrum that the image may have, the likeliest first; only an exact inverse that is asked for can do
        without.
    kept : ndarray, shape (8, 8), optional
        What compression has left of the scene (`kept_by_compression`); None: all.

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
    _refuse(asked, doubts, broken, scenes)
    exact: dict[Method, NDArray[np.float64]] = {}
    if asked.method != "regularised" and not broken and not doubts:
        exact["exact"] = _exact(x.spread, y.spread, asked)
    notes = [f"not inverted, practically unknown {doubt}" for doubt in doubts]
    if asked.method == "auto" and broken:
        notes.append("no exact inverse " + "; ".join(broken))
    if not scenes:
        return Design(exact["exact"], "exact", "; ".join(["exact: as asked for", *notes]), *conditions)
    curves = [one.modulation() if not one.doubt else _ideal_curve(asked.aperture) for one in (x, y)]
    choice = _Choice.of(curve_transfer(*curves), scenes, asked.aperture, kept)
    half = asked.half or _HALVES[0]
    regularised = choice.regularised((0 if y.doubt else half, 0 if x.doubt else half))
    kernels: dict[Method, NDArray[np.float64]] = {"regularised": regularised, **exact}
    method, why = (asked.method, "as asked for") if asked.method != "auto" else choice.method(kernels)
    index = choice.worst(regularised) if method == "none" else 0
    every: dict[str, NDArray[np.float64]] = {"none": _AS_IT_IS, **{str(name): each for name, each in kernels.items()}}
    expected = {name: choice.models[index].error(each) for name, each in every.items()}
    if kept is not None and kept.min() < 1.0:
        notes.append(f"compression has left {100 * kept.mean():.0f} % of the fine detail")
    notes.append(f"{_told(scenes[index])}, ideal aperture {asked.aperture:g} px")
    if expected[method] > expected["none"]:
        notes.append("more error is expected than the image has as it is")
    kernel = kernels.get(method, _AS_IT_IS)
    return Design(kernel, method, f"{method}: " + "; ".join([why, *notes]), *conditions, expected, scenes[index])


def _refuse(asked: DesignOptions, doubts: list[str], broken: list[str], scenes: Sequence[SceneStatistics]) -> None:
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
    if not scenes and asked.method != "exact":
        raise InputError("a filter of least error needs the noise and the contrast of the scene; state both")


def _told(scene: SceneStatistics) -> str:
    """Noise and spectrum of a scene, for people."""
    smoothed = f", smoothed by {scene.smoothed:.2f} px" if scene.smoothed > _SMOOTHED else ""
    white = f" and a white part of {scene.texture:.3g}" if scene.texture > 0.1 * scene.contrast else ""
    return (
        f"noise {scene.noise:.3g}{smoothed}, neighbouring pixels of an ideal image differ by {scene.contrast:.3g} "
        f"(rms), spectrum of the scene ν^-{scene.exponent:.2f}{white}"
    )


@dataclass(frozen=True, eq=False)
class _Choice:
    """Expectations of all that an image may show, and the filter that they speak for."""

    scenes: Sequence[SceneStatistics]
    plain: Sequence[Expectation]
    """One for each scene, as if nothing were lost by compression: what filters are designed by."""
    models: Sequence[Expectation]
    """The same with what is lost: what filters are judged by."""
    sharp: Sequence[Expectation]
    """The judges, were the image as sharp as it may be."""

    @classmethod
    def of(
        cls, transfer: Transfer, scenes: Sequence[SceneStatistics], aperture: float, kept: NDArray[np.float64] | None
    ) -> _Choice:
        """Of an image of a modulation transfer."""
        cases = ((transfer, None), (transfer, kept), (sharpest(transfer), kept))
        return cls(scenes, *([Expectation.of(h, s, aperture, lost) for s in scenes] for h, lost in cases))

    def worst(self, kernel: NDArray[np.float64]) -> int:
        """The scene in which a filter gains least."""
        return int(np.argmax([model.gain(kernel) for model in self.models]))

    def gain(self, kernel: NDArray[np.float64]) -> float:
        """What a filter leaves of the error in its worst scene."""
        return self.models[self.worst(kernel)].gain(kernel)

    def regularised(self, half: tuple[int, int]) -> NDArray[np.float64]:
        """Of the best filters of each scene and of their mean the one that gains most in its worst scene."""
        means = [Expectation.mean(self.plain)] if len(self.plain) > 1 else []
        return min((model.best(half) for model in [*self.plain, *means]), key=self.gain)

    def method(self, kernels: Mapping[Method, NDArray[np.float64]]) -> tuple[Method, str]:
        """Method of least expected error in the worst scene, and why."""
        method = min(kernels, key=lambda each: self.gain(kernels[each]))
        kernel = kernels[method]
        gains = [model.gain(kernel) for model in self.models]
        if max(gains) > 1.0 > min(gains):
            told = "; ".join(f"{100 * g:.0f} % ({_told(s)})" for s, g in zip(self.scenes, gains, strict=True))
            return "none", (
                f"fine texture and noise cannot be told apart here, and {method} might do harm: of the error it would "
                f"leave {told}. State the noise if you know it"
            )
        if max(gains) > (_CLEAR if max(gains) - min(gains) > 1.0 - _CLEAR else 1.0):
            return "none", f"{method} is expected to leave {100 * max(gains):.0f} % of the error"
        # The error that is expected is a mean over what the MTF may be; an image that is sharp already must not suffer.
        left = max(self.sharp, key=lambda model: model.gain(kernel))
        if left.gain(kernel) > 1.0:
            before, after = left.error(_AS_IT_IS), left.error(kernel)
            return "none", (
                f"were the MTF at the upper end of its interval, {method} would leave {after:.3g} and not {before:.3g}"
            )
        return method, "least expected error"


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
