"""Which filter restores an image: the exact inverse where there is one and noise allows, else least squares."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.restoration.filter_design import radial_filter, separable_filter
from photoplan.quality.restoration.filters import FilterKernel
from photoplan.quality.restoration.inverse import Condition, condition_of, exact_inverse
from photoplan.quality.restoration.regularised import SceneStatistics, curve_transfer, regularised_filter
from photoplan.quality.spread import GAUSSIAN_WIDTH, SpreadFunction

#: Sizes that are tried until nothing that matters is cut off an exact inverse, pixels to each side.
_HALVES = (5, 7, 10, 14, 20, 28)
#: Share of an inverse that may be cut off.
_CUT_OFF = 0.002


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


@dataclass(frozen=True)
class DesignOptions:
    """What a user decides."""

    method: Literal["auto", "exact", "regularised"] = "auto"
    rotation: Literal["radial", "separable"] = "radial"
    """How an exact inverse becomes two-dimensional."""
    half: int | None = None
    """Pixels to each side; None: 5, or as many as an exact inverse needs."""
    most_noise_gain: float = 6.0
    """Exact inverses that amplify noise more than this are not used by 'auto' (Kölbl 2006, §1: factors 2 to 5)."""
    aperture: float = 1.0
    """Side of the ideal aperture that 'regularised' aims at, pixels."""


@dataclass(frozen=True, eq=False)
class Design:
    """A designed kernel and why it is as it is."""

    kernel: NDArray[np.float64]
    """Shape (2 half + 1, 2 half + 1), sum 1."""
    method: Literal["exact", "regularised"]
    reason: str
    """The rule that chose the method, with its figures."""
    condition_x: Condition
    condition_y: Condition

    @property
    def noise_gain(self) -> float:
        """By what factor noise grows."""
        return FilterKernel(self.kernel).noise_gain


def design_filter(
    x: Sharpness, y: Sharpness, scene: SceneStatistics | None = None, options: DesignOptions | None = None
) -> Design:
    """Restoration filter of an image whose sharpness is known along rows and along columns.

    Parameters
    ----------
    x, y : Sharpness
        Along a row (across columns) and along a column.
    scene : SceneStatistics, optional
        Noise and contrast; needed where the result is regularised.
    options : DesignOptions, optional

    Raises
    ------
    InputError
        The exact inverse is asked for and its condition does not hold, or the scene is needed and missing.
    """
    asked = options or DesignOptions()
    conditions = (condition_of(x.spread), condition_of(y.spread))
    broken = [
        f"{name}: {c}" for name, c in zip(("along rows", "along columns"), conditions, strict=True) if not c.holds
    ]
    exact: NDArray[np.float64] | None = None
    if asked.method != "regularised" and not broken:
        exact = _exact(x.spread, y.spread, asked)
    if asked.method == "exact":
        if exact is None:
            raise InputError(
                "the image cannot be restored exactly: " + "; ".join(broken) + ". Objects that have fused cannot be "
                "told apart; use `method` regularised"
            )
        return Design(exact, "exact", "exact, as asked for; the condition holds", *conditions)
    if exact is not None and asked.method == "auto":
        gain = FilterKernel(exact).noise_gain
        if gain <= asked.most_noise_gain:
            reason = (
                f"exact: the condition holds and noise grows {gain:.1f} times, not more than {asked.most_noise_gain:g}"
            )
            return Design(exact, "exact", reason, *conditions)
        why = f"the exact inverse would amplify noise {gain:.1f} times, allowed are {asked.most_noise_gain:g}"
    else:
        why = "as asked for" if asked.method == "regularised" else "; ".join(broken)
    if scene is None:
        raise InputError(f"a regularised filter ({why}) needs the noise and the contrast of the scene; state both")
    kernel = regularised_filter(
        curve_transfer(x.modulation(), y.modulation()), scene, asked.half or _HALVES[0], asked.aperture
    )
    reason = (
        f"regularised ({why}): least square error for edges of any place and direction, noise {scene.noise:.3g}, "
        f"neighbouring pixels that differ by {scene.contrast:.3g} (rms), ideal aperture {asked.aperture:g} px"
    )
    return Design(kernel, "regularised", reason, *conditions)


def _exact(x: SpreadFunction, y: SpreadFunction, asked: DesignOptions) -> NDArray[np.float64]:
    """Two-dimensional filter of the exact inverses, large enough, sum 1."""
    for half in _HALVES if asked.half is None else (asked.half,):
        inverses = [exact_inverse(_symmetric(s), half, 8 * half + 41) for s in (x, y)]
        cut = max(float(abs(i.sum() - 1.0)) + abs(float(i[0])) for i in inverses)
        if cut < _CUT_OFF * sqrt(2.0 * half + 1.0):
            break
    ones = [inverse / inverse.sum() for inverse in inverses]
    return radial_filter(*ones) if asked.rotation == "radial" else separable_filter(*ones)


def _symmetric(spread: SpreadFunction) -> SpreadFunction:
    """Both sides averaged: a filter turned about its centre has no other."""
    return SpreadFunction.symmetric(spread.side())
