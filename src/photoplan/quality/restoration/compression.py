"""What compression by blocks (JPEG) has left of a scene, found in the pixels.

Such a compression rounds the cosine transform of blocks of 8 pixels to steps that grow with the frequency. Where the
coefficients lie on multiples of a step the image was compressed. A rounded coefficient shows the scene with an error
that grows with the scene, as no noise does; where all are rounded to zero, what the spectrum of the image still shows
comes from the borders of the blocks, and to sharpen it does harm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn

from photoplan.quality.restoration.scene import block_spectra

Array = NDArray[np.float64]

#: Side of the blocks that are compressed, pixels.
BLOCK = 8
#: Steps that are tried, grey values.
_STEPS = range(2, 121)
#: Mean cosine of a coefficient's place between multiples of a step from which on the step is found; 1: on them all.
_ON_STEPS = 0.5
#: Share of the coefficients that are not rounded to zero, and number of them, that a step needs.
_SEEN, _COUNT = 0.002, 8
#: Share of the frequencies that must show steps, for the image to count as compressed.
_COMPRESSED = 0.2
#: Part of an image's power that coefficients must hold for it to be the scene's and not that of borders of blocks.
_HELD = 0.3


def kept_by_compression(pixels: Array) -> Array:
    """Share of what an image shows at each frequency that is the scene, as compression by blocks has left it.

    It is the slope of the scene on the rounded coefficients, for a Laplacian distribution of the coefficients (Lam and
    Goodman 2000) by the share of them that are zero.
    """
    parts = pixels.reshape(pixels.shape[0], pixels.shape[1] // BLOCK, BLOCK, -1, BLOCK).swapaxes(2, 3)
    coefficients = dctn(parts.reshape(-1, BLOCK, BLOCK), axes=(1, 2), norm="ortho").reshape(-1, BLOCK * BLOCK)
    steps = np.array([0.0, *(_step(row) for row in coefficients.T[1:])])
    if (steps > 0.0).mean() < _COMPRESSED:
        return np.ones((BLOCK, BLOCK))
    kept = np.array([_slope(row, step) for row, step in zip(coefficients.T, steps, strict=True)])
    spectrum = np.mean([block_spectra(window).mean(axis=0) for window in pixels], axis=0)
    at = np.arange(BLOCK) * spectrum.shape[0] // (2 * BLOCK)
    seen = (spectrum[np.ix_(at, at)] + spectrum[np.ix_(-at, at)]) / 2.0
    held = (coefficients**2).mean(axis=0).reshape(BLOCK, BLOCK) > _HELD * seen
    # The window of the spectra spreads the mean over the lowest frequencies.
    held[:2, :2] = True
    return np.asarray(kept.reshape(BLOCK, BLOCK) * held)


def at_frequencies(kept: Array, u: Array, v: Array) -> Array:
    """What `kept_by_compression` found at frequencies up to 0.5 cycles per pixel; arrays that broadcast."""
    at = np.arange(BLOCK) / (2.0 * BLOCK)
    along, down = (np.stack([np.interp(np.abs(f), at, unit) for unit in np.eye(BLOCK)]) for f in (u, v))
    return np.asarray(np.einsum("ij,i...,j...->...", kept, down, along))


def _step(values: Array) -> float:
    """Step of which coefficients are multiples; 0 if there is none."""
    best, found = _ON_STEPS, 0.0
    size = np.sort(np.abs(values))
    for step in _STEPS:
        beyond = size[np.searchsorted(size, step / 2.0) :]
        if beyond.size < max(_COUNT, _SEEN * size.size):
            break
        on = float(np.cos(2.0 * np.pi * beyond / step).mean())
        if on >= best:
            best, found = on, float(step)
    return found


def _slope(values: Array, step: float) -> float:
    """Slope of true on rounded coefficients; 1 where no step is known."""
    size = np.abs(np.rint(values / step)) if step > 0.0 else np.zeros(1)
    if not size.any():
        return 1.0
    rate = -2.0 * np.log(max(1.0 - float((size == 0.0).mean()), 1e-6))
    if rate <= 0.0:
        return 1.0
    # The mean of a Laplacian distribution within a step lies so much nearer to 0 than its middle.
    nearer = 0.5 / np.tanh(rate / 2.0) - 1.0 / rate
    return float(1.0 - nearer * size.mean() / (size**2).mean())
