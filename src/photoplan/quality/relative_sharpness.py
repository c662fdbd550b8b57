"""How sharp images are compared with each other, by patches of the same ground that several of them show.

In each patch, what fine detail there is, is compared with what is twice as coarse: the quotient of both does not know
contrast and exposure. It knows the ground, which all images of a patch have in common; so its logarithm is that of the
patch plus that of the image, and medians tell both apart, whatever single patches show (things that move, that lean).
Noise is fine detail, too: what an image has of it in its quietest places is taken off before.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

#: Side of the blocks in which the quietest places are sought, pixels.
BLOCK = 8
#: The share of blocks that show noise alone.
_QUIET = 0.1
#: Images are judged by no fewer patches.
_LEAST = 3
_ROUNDS = 30


def detail_energies(grey: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean squares of fine and of coarser detail in blocks of a patch, shape (2, rows, cols)."""
    once = _smooth(grey)
    twice = _smooth(once)
    fine, coarse = (grey[2:-2, 2:-2] - once)[2:-2, 2:-2], once[2:-2, 2:-2] - twice
    rows, cols = (size // BLOCK for size in fine.shape)
    parts = np.square([fine, coarse])[:, : rows * BLOCK, : cols * BLOCK]
    return np.asarray(parts.reshape(2, rows, BLOCK, cols, BLOCK).mean(axis=(2, 4)))


def _smooth(grey: NDArray[np.float64]) -> NDArray[np.float64]:
    """Binomial means of five pixels along both axes; two pixels less on every side."""
    for _ in range(2):
        grey = (grey[:-4] + grey[4:] + 4 * (grey[1:-3] + grey[3:-1]) + 6 * grey[2:-2]).T / 16
    return grey


def detail_quotients(energies: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Logarithms (n,), base 2, of the quotients of amplitudes of fine and coarser detail in patches of one image.

    Energies are those of `detail_energies`; NaN where a patch shows no more than noise.
    """
    if not len(energies):
        return np.empty(0)
    noise = np.quantile(np.concatenate([each.reshape(2, -1) for each in energies], axis=1), _QUIET, axis=1)
    fine, coarse = np.transpose([each.mean(axis=(1, 2)) - noise for each in energies])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((fine > 0) & (coarse > 0), 0.5 * np.log2(fine / coarse), np.nan)


def blur_of(quotients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Blur of images (n,) from logarithms of quotients of patches and images (m, n); NaN where a patch is not shown."""
    seen = np.isfinite(quotients)
    # A patch that one image shows tells nothing of others.
    use = np.where(seen & (seen.sum(axis=1) > 1)[:, None], quotients, np.nan)
    sharp = np.zeros(use.shape[1])
    use[:, np.isfinite(use).sum(axis=0) < _LEAST] = np.nan
    known, rows = np.isfinite(use).any(axis=0), np.isfinite(use).any(axis=1)
    for _ in range(_ROUNDS if rows.any() else 0):
        ground = np.nanmedian(use[rows] - sharp, axis=1)
        sharp[known] = np.nanmedian(use[np.ix_(rows, known)] - ground[:, None], axis=0)
    sharp[~known] = sharp[known].max(initial=0.0)
    return np.asarray(sharp.max() - sharp)
