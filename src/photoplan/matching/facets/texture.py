"""Texture told from noise: what part of the slopes with which pixels tell heights is the ground's own.

Grey values of the surface hold noise, whose slopes add to the sensitivities of the pixels to height: Σ p (a − ā)² with
them is larger than with those of the texture, by the part 1 / w. But misfits change with height by the texture's
slopes alone. So a right-hand side Σ p (a − ā) v changes by w of these sums with a metre, and scatters as all of them.
So what noise adds to the variances of heights is larger by a factor between 1, where curvatures hold them, and
1 / w², where pixels alone do; 1 / w is taken. Heights are solved with all of the sums: what does not fit yet, or never,
looks like noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.facets_grey import sample_grey
from photoplan.kernels.facets_height import GreyFacets, add_sensitivities
from photoplan.matching.facets.means import means_around
from photoplan.matching.facets.observe import Sight

_Floats = NDArray[np.float32]
_Doubles = NDArray[np.float64]

#: Facets over which squared slopes are averaged, twice: all that are seen, and those of noise, which change slowly.
_SEEN, _DRAWN = 3, 9
#: Least part that is taken to be texture: sums over so few facets tell no less from none.
_LEAST = 0.05


@dataclass(frozen=True, eq=False)
class GreyTexture:
    """What errors that are drawn tell of the grey values of a block."""

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
