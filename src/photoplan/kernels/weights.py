"""Resampling kernels (bilinear, bicubic, Lanczos) as polynomials: a row for each power, a column for each tap.

A position x lies between the pixels floor(x) and floor(x) + 1; with g = x − floor(x) − 1/2 every weight of the
nearest, bilinear and bicubic kernels *is* a polynomial in g, and those of the Lanczos kernel are one to 1e-8. So
all of them are evaluated by the same few multiplications, exactly enough for 16 bit and float, and no table of
rounded weights is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

LANCZOS_DEGREE = 12
TABLE_STEPS = 2048
STRETCH_FROM = 1.1
STRETCH_FULL = 1.3


@dataclass(frozen=True, eq=False)
class Kernel:
    """A separable resampling kernel."""

    name: str
    """Name that users write, such as ``bicubic``."""
    taps: int
    """Pixels along x and along y that carry weight: 1, 2, 4 or 6."""
    coefficients: NDArray[np.float64]
    """(degree + 1, taps): weight of tap j, at pixel floor(x) + j − taps / 2 + 1, is Σ coefficients[k, j] · gᵏ."""
    source: str
    """Where the kernel is defined."""

    def __post_init__(self) -> None:
        if self.coefficients.shape[1] != self.taps:
            raise ValueError(f"kernel {self.name}: {self.coefficients.shape[1]} columns for {self.taps} taps")
        self.coefficients.flags.writeable = False

    @property
    def margin(self) -> int:
        """Pixels beyond a position, rounded down or up, that the kernel reads at the source's own scale."""
        return self.taps // 2 + 1

    def weights(self, fraction: ArrayLike) -> NDArray[np.float64]:
        """Weights of the taps, shape (..., taps), for x − floor(x) = `fraction`; they add up to 1."""
        g = np.asarray(fraction, float)[..., None] - 0.5
        result = np.zeros((*g.shape[:-1], self.taps))
        for row in self.coefficients[::-1]:
            result = result * g + row
        return result


def weight_function(name: str, distance: ArrayLike) -> NDArray[np.float64]:
    """Weight of a pixel at `distance` pixels from the position, by the textbook formula (Lanczos: not normalised).

    Bicubic: the family of Keys with slope a at distance 1; a = −1 is Ecker 1991, eq. 4.15.
    """
    t = np.abs(np.asarray(distance, float))
    if name == "bilinear":
        return np.maximum(0.0, 1.0 - t)
    if name == "lanczos3":
        return np.where(t < 3.0, np.sinc(t) * np.sinc(t / 3.0), 0.0)
    a = {"bicubic": -0.5, "bicubic-1": -1.0}[name]
    near = 1.0 + t * t * ((a + 2.0) * t - (a + 3.0))
    far = a * (t * (t * (t - 5.0) + 8.0) - 4.0)
    return np.where(t < 1.0, near, np.where(t < 2.0, far, 0.0))


def _fit(name: str, taps: int, degree: int) -> NDArray[np.float64]:
    """Coefficients of the normalised weights, by interpolation at Chebyshev nodes of −1/2 … 1/2."""
    nodes = chebyshev.chebpts1(degree + 1)
    offsets = np.arange(taps) - taps // 2 + 1
    weights = weight_function(name, (nodes / 2.0 + 0.5)[:, None] - offsets)
    weights /= weights.sum(axis=1, keepdims=True)
    columns = [
        chebyshev.cheb2poly(chebyshev.chebfit(nodes, column, degree)) * 2.0 ** np.arange(degree + 1)
        for column in weights.T
    ]
    return np.ascontiguousarray(np.stack(columns, axis=1))


def _exact(name: str, taps: int, degree: int) -> NDArray[np.float64]:
    # The coefficients of these kernels are multiples of 1/64; the fit returns them up to rounding.
    return np.round(_fit(name, taps, degree) * 64.0) / 64.0


KERNELS: MappingProxyType[str, Kernel] = MappingProxyType(
    {
        each.name: each
        for each in (
            Kernel("nearest", 1, np.ones((1, 1)), "Ecker 1991, section 4.6.3.1"),
            Kernel("bilinear", 2, _exact("bilinear", 2, 1), "Ecker 1991, section 4.6.3.2"),
            Kernel("bicubic", 4, _exact("bicubic", 4, 3), "Keys, a = −0.5: reproduces a ramp"),
            Kernel("bicubic-1", 4, _exact("bicubic-1", 4, 3), "Ecker 1991, eq. 4.15; a = −1"),
            Kernel("lanczos3", 6, _fit("lanczos3", 6, LANCZOS_DEGREE), "windowed sinc, weights normalised to 1"),
        )
    }
)
"""The kernels by the names that users give."""


@lru_cache
def weight_table(name: str) -> NDArray[np.float32]:
    """Weights at distances of k / TABLE_STEPS pixels, k = 0 … reach · TABLE_STEPS + 1, for widened kernels.

    Linear interpolation between the steps is good to 2e-7, and most of that cancels when the weights are normalised.
    """
    kernel = KERNELS[name]
    distance = np.arange(kernel.taps // 2 * TABLE_STEPS + 1) / TABLE_STEPS
    # A pixel at distance t to the right of the position is tap floor(t) + taps / 2, at the fraction ceil(t) − t.
    tap = np.minimum(np.ceil(distance).astype(int) + kernel.taps // 2 - 1, kernel.taps - 1)
    tap = np.maximum(tap, kernel.taps // 2 - 1)
    values = kernel.weights(np.ceil(distance) - distance)[np.arange(len(distance)), tap]
    return np.append(values, 0.0).astype(np.float32)


def stretch(scale: ArrayLike) -> NDArray[np.float64]:
    """Factor by which a kernel is widened where one target pixel spans `scale` source pixels: 1 up to 1.1, `scale`
    from 1.3, linear between, so a product shows no step where the scale passes through 1."""
    s = np.asarray(scale, float)
    part = np.clip((s - STRETCH_FROM) / (STRETCH_FULL - STRETCH_FROM), 0.0, 1.0)
    return np.where(s >= STRETCH_FULL, s, 1.0 + part * (STRETCH_FULL - 1.0))
