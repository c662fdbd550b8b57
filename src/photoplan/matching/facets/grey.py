"""Grey facets: their texture told from noise, and waves between coefficients of facets coarser than pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.facets import GreyFacets, add_sensitivities, sample_grey
from photoplan.matching.facets.means import means_around
from photoplan.matching.facets.observe import Sight

_Floats = NDArray[np.float32]
_Doubles = NDArray[np.float64]

#: Facets over which squared slopes are averaged, twice: all that are seen, and those of noise, which change slowly.
_SEEN, _DRAWN = 3, 9
#: Least part that is taken to be texture: sums over so few facets tell no less from none.
_LEAST = 0.05
#: Coefficients along a row or column, waves of how many radians a facet they give (2.6 facets long), parts of a facet.
_TAPS, _SHORTEST, _PARTS = 8, 2.4, 128
_WAVES = 60


@dataclass(frozen=True, eq=False)
class GreyTexture:
    """Texture of a block and its noise: the part of the slopes of grey values that is the ground's own.

    Grey values of the surface hold noise, whose slopes add to the sensitivities of the pixels to height: Σ p (a − ā)²
    with them is larger than with those of the texture, by the part 1 / w. But misfits change with height by the
    texture's slopes alone. So a right-hand side Σ p (a − ā) v changes by w of these sums with a metre, and scatters as
    all of them. So what noise adds to the variances of heights is larger by a factor between 1, where curvatures hold
    them, and 1 / w², where pixels alone do; 1 / w is taken. Heights are solved with all of the sums: what does not fit
    yet, or never, looks like noise.
    """

    errors: _Floats
    """Errors of the coefficients: one standard deviation each, with their covariance."""
    density: _Floats
    """Weights that lay on each coefficient then."""
    shares: _Doubles
    """Part of the squared sensitivities in each facet that is texture, 0 to 1, shape (rows − 1, columns − 1)."""

    @classmethod
    def of(
        cls,
        sights: Sequence[Sight],
        weights: Sequence[_Floats],
        ground: GreyFacets,
        errors: _Floats,
        density: _Floats,
    ) -> GreyTexture:
        """From the surface and errors of its coefficients: see `FacetBlock`."""
        found = np.zeros((2, *ground.means.shape[:2]))
        for sight, w in zip(sights, weights):
            add_sensitivities(sight.places, w, ground, errors, found)
        seen, noise = (means_around(means_around(part, size), size) for part, size in zip(found, (_SEEN, _DRAWN)))
        return cls(errors, density, np.clip(1 - noise / np.maximum(seen, 1e-300), 0.0, 1.0))

    @property
    def at_posts(self) -> _Doubles:
        """The same around each post, at least _LEAST, shape (rows, columns)."""
        around = np.pad(self.shares, 1, mode="edge")
        mean = (around[:-1, :-1] + around[:-1, 1:] + around[1:, :-1] + around[1:, 1:]) / 4
        return np.asarray(np.maximum(mean, _LEAST))

    def common(self, values: _Floats, ratio: int, counted: NDArray[np.uint8]) -> float:
        """Part of the variance of grey values at the posts that two images see that is not noise."""
        at = np.argwhere(counted > 1)[:, ::-1].astype(float)
        if not len(at):
            return 0.0
        found = np.empty((2, len(at)), np.float32)
        for out, coefficients in zip(found, (values, self.errors)):
            sample_grey(coefficients, ratio, at, out)
        return 1 - float(found[1].var()) / max(float(found[0].var()), 1e-30)


@cache
def shares() -> NDArray[np.float64]:
    """Return shares of the coefficients next to a place, see `add_missed`: those with which waves have, by least
    squares, the size that cubic facets give them, and nothing else.

    A cubic spline through samples of a wave with k radians a facet has beside it one with k − 2π, about (k / (2π − k))⁴
    as large. Pixels that lie nearly as the facets do see it as a shift of the first, over as long a stretch as they
    keep in step, and hardly as residuals. The same coefficients with more of their neighbours give the wave alone.
    """
    k = np.linspace(0, _SHORTEST, _WAVES)
    sizes = np.sinc(k / (2 * np.pi)) ** 4
    at = np.arange(_TAPS) - (_TAPS // 2 - 1)
    out = np.empty((_PARTS + 1, _TAPS))
    for n in range(_PARTS + 1):
        turns = k[:, None] * (at - n / _PARTS)
        equations = np.concatenate([np.cos(turns), np.sin(turns)])
        out[n] = np.linalg.lstsq(equations, np.concatenate([sizes, np.zeros(_WAVES)]), rcond=None)[0]
    return np.asarray(out / out.sum(axis=1, keepdims=True))
