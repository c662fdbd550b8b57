"""Which resampling kernel moves edges, by how much, and what it does to contrast.

Everything follows from the weights that a kernel gives to the pixels around a position. `t` in [0, 1) is the phase:
how far the position lies to the right of pixel 0.

Source of bicubic a = −1: Ecker 1991, eq. 4.15 (after Moik 1980); of bilinear: Behr 1989, eq. 5.12.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def nearest(s: Array) -> Array:
    """One inside half a pixel."""
    return np.where((s >= -0.5) & (s < 0.5), 1.0, 0.0)


def bilinear(s: Array) -> Array:
    """A triangle of half-width one pixel."""
    return np.maximum(0.0, 1.0 - np.abs(s))


def cubic(a: float) -> Callable[[Array], Array]:
    """Cubic convolution with slope `a` at one pixel; a = −1 is Ecker 1991, eq. 4.15."""

    def weight(s: Array) -> Array:
        s = np.abs(s)
        inner = (a + 2) * s**3 - (a + 3) * s**2 + 1
        outer = a * (s**3 - 5 * s**2 + 8 * s - 4)
        return np.where(s < 1, inner, np.where(s < 2, outer, 0.0))

    return weight


def lanczos3(s: Array) -> Array:
    """sinc windowed by the middle lobe of a sinc three times as wide."""
    return np.where(np.abs(s) < 3, np.sinc(s) * np.sinc(s / 3), 0.0)


KERNELS: dict[str, Callable[[Array], Array]] = {
    "nearest": nearest,
    "bilinear": bilinear,
    "bicubic a = −0.5": cubic(-0.5),
    "bicubic a = −1": cubic(-1.0),
    "Lanczos-3": lanczos3,
}
#: Pixels that may contribute to a position between pixels 0 and 1.
TAPS = np.arange(-2, 4)


def weights(kernel: str, t: Array) -> Array:
    """Weights of the pixels `TAPS` at phases t, shape (len(t), 6); their sum is one at every phase."""
    w = KERNELS[kernel](np.asarray(t, float)[:, None] - TAPS)
    return w / w.sum(axis=1, keepdims=True)


def ramp_deviation(kernel: str, t: Array) -> Array:
    """Value on the ramp g(x) = x minus the true value t, grey values per unit of slope.

    An edge, a line or any other detail that is resampled at one phase has its centre of gravity moved by just this
    many pixels, with the sign reversed: both are the first moment of the weights.
    """
    return weights(kernel, t) @ TAPS - t


def ramp_deviation_cubic(a: float, t: Array) -> Array:
    """The same for cubic convolution in closed form: (a + ½) · 2t(1 − t)(2t − 1)."""
    return (a + 0.5) * 2 * t * (1 - t) * (2 * t - 1)


def edge(x: Array, position: float, blur: float = 0.5) -> Array:
    """Grey values 0 to 1 of pixels centred at x that see an edge through a Gaussian blur and the pixel's aperture."""
    if blur == 0:
        return np.clip(x + 0.5 - position, 0.0, 1.0)

    def integral(s: float) -> float:
        z = s / blur
        return 0.5 * s * (1 + math.erf(z / math.sqrt(2))) + blur * math.exp(-z * z / 2) / math.sqrt(2 * math.pi)

    return np.array([integral(v + 0.5 - position) - integral(v - 0.5 - position) for v in np.atleast_1d(x)])


def edge_centroid_shift(kernel: str, t: float) -> float:
    """Centre of gravity of an edge after resampling a whole row at phase t, minus its true place, pixels.

    Measured, not derived: a row with an edge is resampled pixel by pixel and the position taken from the gradient.
    """
    x = np.arange(-30.0, 31.0)
    true = 0.3
    row = edge(x, true)
    w = weights(kernel, np.array([t]))[0]
    out = np.convolve(row, w[::-1], mode="valid")
    place = x[2 : 2 + len(out)] + t
    gradient = np.diff(out)
    return float((gradient * (place[1:] + place[:-1]) / 2).sum() / gradient.sum() - true)


def half_level_shift(kernel: str, position: float, blur: float = 0.5, step: float = 1e-3) -> float:
    """Where the interpolated edge crosses half height, minus where the edge is; pixels.

    `position` in [0, 1) is the edge's place between two pixels. This is what a person digitising an enlarged product
    sees, and it includes what the pixels themselves have lost.
    """
    x = np.arange(-8.0, 10.0)
    row = edge(x, position, blur)
    fine = np.arange(-1.5, 2.5, step) + step / 2
    base = np.floor(fine).astype(int)
    w = weights(kernel, fine - base)
    value = (w * row[(base + 8)[:, None] + TAPS]).sum(axis=1)
    above = int(np.argmax(value > 0.5))
    if kernel == "nearest":
        return float(fine[above] - step / 2 - position)
    part = (0.5 - value[above - 1]) / (value[above] - value[above - 1])
    return float(fine[above - 1] + part * step - position)


def overshoot(kernel: str, blur: float = 0.5) -> float:
    """How far an edge from 0 to 1 runs over 1, worst of all phases."""
    t = np.linspace(0, 1, 101)[:-1]
    w = weights(kernel, t)
    worst = 0.0
    for position in np.linspace(0, 1, 21):
        row = edge(np.arange(-8.0, 10.0), float(position), blur)
        for base in range(-3, 4):
            worst = max(worst, float((w @ row[base + 8 + TAPS]).max()) - 1.0)
    return worst


def transfer(kernel: str, frequency: Array, phases: int = 256) -> Array:
    """Contrast of a fine sine pattern after resampling, mean over all phases; frequency in cycles per pixel."""
    t = (np.arange(phases) + 0.5) / phases
    w = weights(kernel, t)
    wave = np.exp(2j * np.pi * np.asarray(frequency)[:, None, None] * (TAPS[None, None, :] - t[None, :, None]))
    return (w[None] * wave).sum(axis=2).mean(axis=1).real
