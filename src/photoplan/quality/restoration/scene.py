"""Spectrum of the scene and noise of an image, found in the image itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from math import log, pi, sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from photoplan.errors import InputError

Array = NDArray[np.float64]
Transfer = Callable[[Array, Array], tuple[Array, Array]]
"""Modulation and its standard deviation at frequencies u along rows and v along columns, cycles per pixel; arrays that
broadcast."""

#: Side of the blocks whose spectra are averaged, pixels.
BLOCK = 64
#: Lowest frequency that is fitted, in steps of a block's spectrum: the window spreads the mean over those below.
_FIRST = 2.5
#: How many times the frequency square is repeated to each side, for what folds back.
FOLDS = 2
#: Range of the exponent of the power spectrum: 2 to 3 in photographs (Field 1987; Ruderman and Bialek 1994), 3 for
#: edges of any place and direction.
_EXPONENTS = (1.0, 3.9)
#: Where its search begins: the likelihood may have several maxima.
_STARTS = (2.0, 3.0)
#: Where the search for a white part of the scene begins: logarithms of its share.
_WHITE = (-3.0, -8.0)
#: The noise of an image, by that of its most even blocks: they may show scene besides, and compression clears them.
_LEAST, _MOST = 0.1, 30.0
#: Share of noise in a spectrum that counts as none.
_NO_NOISE = 1e-12
#: Largest smoothing of noise that is sought, pixels.
_SMOOTHED = 0.8


@dataclass(frozen=True)
class SceneStatistics:
    """Scene that a filter is designed for, in linear light.

    The scene's power spectrum is a power of the frequency and, besides, the same at all frequencies.
    """

    noise: float
    """Standard deviation of the noise, before it was smoothed."""
    contrast: float
    """Root mean square difference of neighbouring pixels as ideal apertures of one pixel without noise would see it."""
    exponent: float = 3.0
    """p of the power spectrum ν⁻ᵖ; 3: edges of any place and direction."""
    smoothed: float = 0.0
    """Sigma of a Gaussian, pixels, that took what is missing of white noise at high frequencies: compression (JPEG),
    interpolation of colours and denoising do."""
    texture: float = 0.0
    """Contrast of the part of the scene that has the same power at all frequencies: texture finer than pixels."""

    def __post_init__(self) -> None:
        some = self.contrast > 0.0 and self.texture >= 0.0
        if not self.noise >= 0.0 or not some or not _EXPONENTS[0] <= self.exponent <= _EXPONENTS[1]:
            raise InputError(
                f"noise {self.noise:g}, contrast {self.contrast:g}, exponent {self.exponent:g}; needed are noise of 0 "
                f"or more, contrast above 0 and an exponent from {_EXPONENTS[0]:g} to {_EXPONENTS[1]:g}"
            )

    def power(self, u: Array, v: Array) -> Array:
        """Power of the scene at frequencies other than 0, cycles per pixel; arrays that broadcast."""
        fractal = self.contrast**2 / _unit_contrast(self.exponent) * np.hypot(u, v) ** -self.exponent
        return np.asarray(fractal + self.texture**2 / _unit_contrast(0.0))

    def noise_power(self, u: Array, v: Array) -> Array:
        """Power of the noise at frequencies up to 0.5 cycles per pixel; arrays that broadcast."""
        return np.asarray(self.noise**2 * np.exp(-((2.0 * pi * self.smoothed) ** 2) * (u**2 + v**2)))


def frequency_grid(count: int = 64) -> tuple[Array, Array]:
    """Frequencies of all folds, u and v of shapes (folds, 1, count) and (folds, count, 1), none of them 0."""
    base = (np.arange(count) + 0.5) / count - 0.5
    down, right = (part.ravel() for part in np.mgrid[-FOLDS : FOLDS + 1, -FOLDS : FOLDS + 1])
    return base[None, None, :] + right[:, None, None], base[None, :, None] + down[:, None, None]


@lru_cache(maxsize=256)
def _unit_contrast(exponent: float) -> float:
    """Mean square difference of neighbours for the power spectrum ν⁻ᵖ."""
    u, v = frequency_grid()
    power = np.hypot(u, v) ** -exponent * (np.sinc(u) * np.sinc(v)) ** 2
    # Of both directions the mean.
    return float((power * 2.0 * (np.sin(pi * u) ** 2 + np.sin(pi * v) ** 2)).sum(axis=0).mean())


def block_spectra(grey: Array, usable: NDArray[np.bool_] | None = None) -> Array:
    """Power spectra of overlapping blocks under a Hann window, mean taken off."""
    side = min(BLOCK, *grey.shape)
    keep = np.isfinite(grey) if usable is None else np.isfinite(grey) & usable
    views = [
        np.lib.stride_tricks.sliding_window_view(a, (side, side))[:: side // 2, :: side // 2].reshape(-1, side, side)
        for a in (grey, keep)
    ]
    blocks = views[0][views[1].all(axis=(1, 2))]
    across = np.hanning(side + 2)[1:-1]
    window = np.outer(across, across)
    level = (blocks * window).sum(axis=(1, 2), keepdims=True) / window.sum()
    return np.asarray(np.abs(np.fft.fft2((blocks - level) * window)) ** 2 / (window**2).sum())


def scenes_of(
    spectrum: Array, transfer: Transfer, even: float, stated: float | None = None
) -> tuple[SceneStatistics, ...]:
    """Return what an image may show by its mean spectrum: what is fine in it is texture, or it is noise.

    A blurred white texture and noise that was smoothed have the same spectrum, and the mean spectrum alone cannot tell
    which it is. So there are two answers: noise of any size and smoothing, and no texture; and white noise, no more
    than the most even blocks show, and for the rest a texture. Where the image has none of both, they agree.
    """
    if stated is not None:
        return (fit_scene(spectrum, transfer, (stated, stated), textured=True),)
    return (
        fit_scene(spectrum, transfer, (_LEAST * even, _MOST * even)),
        fit_scene(spectrum, transfer, (_LEAST * even, even), textured=True),
    )


def fit_scene(
    spectrum: Array, transfer: Transfer, noise: tuple[float, float], *, textured: bool = False
) -> SceneStatistics:
    """Noise, contrast and exponent of the scene by which a mean spectrum is likeliest (Whittle 1953)."""
    side = spectrum.shape[0]
    base = np.fft.fftfreq(side)
    down, right = (part.ravel()[:, None] for part in np.mgrid[-FOLDS : FOLDS + 1, -FOLDS : FOLDS + 1])
    rows, columns = np.meshgrid(base, base, indexing="ij")
    used = np.hypot(rows, columns) >= min(_FIRST / side, 0.3)
    # The spectrum of an image is the same at opposite frequencies.
    used &= (rows > 0.0) | ((rows == 0.0) & (columns > 0.0)) | (rows == -0.5)
    u, v = columns[used][None] + right, rows[used][None] + down
    passed, logarithm = transfer(u, v)[0] ** 2, np.log(np.hypot(u, v))
    flat, square = passed.sum(axis=0), (2.0 * pi) ** 2 * (rows**2 + columns**2)[used]
    scale = float(spectrum[used].mean())
    seen = spectrum[used] / scale

    def loss(at: Array) -> tuple[float, Array]:
        scene = passed * np.exp(at[0] - at[1] * logarithm)
        signal, noisy, white = scene.sum(axis=0), np.exp(at[2] - at[3] * square), flat * np.exp(at[4])
        model = signal + noisy + white
        slope = (1.0 - seen / model) / model
        each = signal, -(scene * logarithm).sum(axis=0), noisy, -noisy * square, white
        return float((np.log(model) + seen / model).mean()), np.array([(slope * d).mean() for d in each])

    low, high = (log(max(n**2 / scale, _NO_NOISE)) for n in noise)
    smoothing = (0.0, 0.0 if textured else _SMOOTHED**2)
    bounds = ((-40.0, 20.0), _EXPONENTS, (low, high), smoothing, (-40.0, 20.0 if textured else -40.0))
    tried = []
    for exponent in _STARTS:
        power = (passed * np.exp(-exponent * logarithm)).sum(axis=0)
        starts = [(0.2, 0.0), (0.8, 0.0), *([] if textured else [(0.8, 0.2)])]
        for (share, smoothed), white in product(starts, _WHITE if textured else (-40.0,)):
            start = (-log(float(power.mean())), exponent, low + share * (high - low), smoothed, white)
            tried.append(scipy.optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds))
    factor, exponent, noisy, smoothed, white = min(tried, key=lambda one: float(one.fun)).x
    contrast = sqrt(scale * np.exp(factor) * _unit_contrast(float(exponent)))
    found = sqrt(scale * np.exp(noisy)) if noise[1] > 0.0 else 0.0
    texture = sqrt(scale * np.exp(white) * _unit_contrast(0.0)) if textured else 0.0
    return SceneStatistics(
        noise=found, contrast=contrast, exponent=float(exponent), smoothed=sqrt(smoothed), texture=texture
    )
