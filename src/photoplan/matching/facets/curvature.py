"""Adaptive regularisation: curvatures of the heights as observations whose variances are estimated.

A second difference of the heights is observed to be zero (Wrobel, Kaiser and Hausladen 1992). How little that says,
its variance, is a component estimated from the heights themselves, in patches and for each direction, since terrain is
rough here and smooth there. Differences follow Student's distribution, which lets breaklines be: those far larger than
others around, since all those of a smooth hill may be larger than what their band, below, tells.

Terrain's curvatures are not independent, so that the variance of those from post to post says little of those over
the distance by which a surface is smoothed. With N = S + R of pixels and curvatures, what smoothing takes away of a
surface z is N⁻¹ R z; of the smoothed one, N⁻¹ R N⁻¹ S z: a band of wavelengths around those where pixels and
curvatures weigh alike. Variances are such that this band holds what independent curvatures would put there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.facets_pull import pull
from photoplan.matching.facets.means import means_around
from photoplan.matching.facets.observe import Facets

_Doubles = NDArray[np.float64]

#: Posts along a patch that has its own variances.
_PATCH = 24
#: Degrees of freedom of the curvatures.
_FREEDOM = 4.0
#: Steps to the usual size of the curvatures of a patch, each of which takes more than half of what is left of the way.
_STEPS = 5
#: The part with which the mean of a block takes part in the variances of each patch, and what these change at once.
_SHARED, _STEADY, _MOST = 0.25, 0.5, 64.0


@dataclass(frozen=True, eq=False)
class Smoother:
    """The normal equations of an adjustment."""

    solve: Callable[[Sequence[_Doubles]], _Doubles]
    """N⁻¹ of right-hand sides, shape (k, rows, columns)."""
    noise: _Doubles
    """A right-hand side of errors of the pixels, shape (rows, columns)."""
    inside: NDArray[np.bool_]
    """Posts that tell: seen by some images, and away from the border."""
    signs: _Doubles
    """Of the curvatures that are drawn, 1 or −1, shape (3, rows, columns)."""

    def mean(self, values: _Doubles, shared: float, wide: bool = False) -> _Doubles:
        """Means of what tells over patches, twice if `wide`, and in the part `shared` of the block, (rows, columns)."""
        number = max(float(np.count_nonzero(self.inside)), 1.0)
        telling = np.where(self.inside, values, 0.0)
        whole = float(telling.sum()) / number
        own, share = (_means(_means(part) if wide else part) for part in (telling, self.inside.astype(float)))
        few = 1.0 / _PATCH**2
        return np.asarray((1 - shared) * (own + few * whole) / (share + few) + shared * whole)


@dataclass(frozen=True, eq=False)
class Roughness:
    """Curvatures along columns, along rows and across, at the posts of a block."""

    squares: _Doubles
    """Their variances, shape (3, rows, columns), m²."""
    factors: _Doubles
    """Robust factors of their weights, the same shape; 0 where a curvature is not inside."""

    @classmethod
    def uniform(cls, shape: tuple[int, int], sigma: float) -> Roughness:
        """One standard deviation everywhere, metres."""
        return cls(np.full((3, *shape), sigma**2), _inside(shape).astype(float))

    def on(self, own: Facets, finer: Facets) -> Roughness:
        """The same variances at the posts of other facets, all curvatures counting alike."""
        return Roughness(own.sampled(self.squares, finer.posts), _inside(finer.shape).astype(float))

    @property
    def weights(self) -> _Doubles:
        """Of the curvatures, shape (3, rows, columns)."""
        return self.factors / self.squares

    def gradient(self, heights: _Doubles) -> _Doubles:
        """Half the gradient of the weighted sum of their squares, shape (rows, columns)."""
        out = np.empty(heights.shape)
        pull(self.weights, heights, out)
        return out

    def around(self, heights: _Doubles) -> Roughness:
        """The same variances, with the robust factors of heights (rows, columns)."""
        found, inside = curvatures(heights) ** 2, self.factors > 0
        single = found / _usual(found, self.squares, inside)
        return Roughness(self.squares, np.where(inside, (_FREEDOM + 1) / (_FREEDOM + single), 0.0))

    def estimated(self, heights: _Doubles, smoother: Smoother) -> Roughness:
        """Variances with which the band around the smoothing length holds what it does in heights (rows, columns)."""
        mean = partial(smoother.mean, wide=True)
        seen, drawn, noise = (band**2 for band in self._bands(heights, smoother, 1)[0][0])
        usual = np.maximum(mean(drawn + noise, 0.0), 1e-300)
        weighed = seen * (_FREEDOM + 1) / (_FREEDOM + seen / usual)
        # In parts of what is usual at a place, all places count alike.
        change = mean((weighed - noise) / usual, _STEADY) / np.maximum(mean(drawn / usual, _STEADY), 1e-30)
        # Of smooth terrain it falls with the 2.5th power of the variance: whole steps would not settle.
        return Roughness(self.squares * np.sqrt(np.clip(change, 1 / _MOST, _MOST)), self.factors).around(heights)

    def sandwich(
        self, heights: _Doubles, smoother: Smoother, variances: _Doubles, stiffer: float
    ) -> tuple[_Doubles, _Doubles]:
        """Variances of heights (rows, columns), of the pixels' noise and of what smoothing takes away.

        `variances` are the diagonals of N⁻¹ with these weights and with weights `stiffer` times as large, (2, rows,
        columns): how much they fall is the part N⁻¹ R N⁻¹ that independent curvatures would have. The real one is
        Σ B² P over wavelengths, if smoothing takes the part B of a power P. Of B² = (1 − B)² (B² + 2 B³ + 3 B⁴ + …)
        the first terms are seen in the smoothed surface; the others are those of independent curvatures, as many
        times as the third is.
        """
        whole = variances[0]
        prior = np.clip(-np.log(variances[1] / whole) / np.log(stiffer), 0.0, 1.0) * whole
        bands, taken = self._bands(heights, smoother, 2)
        mean = smoother.mean
        usual = np.maximum(mean(taken**2, 0.0), 1e-300)
        known, rest = np.zeros_like(prior), np.ones_like(prior)
        for n, (a, b) in enumerate(((0, 0), (0, 1), (1, 1))):
            seen, drawn, noise = (bands[a][k] * bands[b][k] / usual for k in range(3))
            # Of noise that happens to be less than it is expected to be, nothing is left.
            known += (n + 1) * np.maximum(mean(seen - noise, _SHARED), 0.0)
            rest -= (n + 1) * mean(drawn, _SHARED)
        times = mean(seen - noise, 1.0) / np.maximum(mean(drawn, 1.0), 1e-30)
        share = np.clip(known + np.maximum(times, 0.0) * np.maximum(rest, 0.0), 0.0, _MOST)
        return whole - prior, share * prior

    def _bands(self, heights: _Doubles, smoother: Smoother, count: int) -> tuple[list[_Doubles], _Doubles]:
        """(N⁻¹ R)ⁿ of a smoothed surface, n = 1 … count: of heights, and expected ones of independent curvatures and
        of noise, each of shape (3, rows, columns); and what smoothing takes away of the second, not yet smoothed."""
        drawn = _transposed(np.sqrt(self.weights) * smoother.signs)
        first, taken, noise = smoother.solve([self.gradient(heights), drawn, smoother.noise])
        again = smoother.solve([self.gradient(taken), self.gradient(noise)])
        bands = [np.stack([first, taken - again[0], again[1]])]
        for _ in range(count - 1):
            bands.append(smoother.solve([self.gradient(band) for band in bands[-1]]))
        return bands, taken


def _usual(found: _Doubles, least: _Doubles, inside: NDArray[np.bool_]) -> _Doubles:
    """What squares of curvatures usually are around each: the scale of Student's distribution that is most probable for
    those of a patch (by the EM algorithm, Lange, Little and Taylor 1989), not below `least`; all (3, rows, columns)."""
    share = np.maximum(np.stack([_means(part.astype(float)) for part in inside]), 1.0 / _PATCH**2)
    scale = least
    for _ in range(_STEPS):
        weighed = np.where(inside, found * (_FREEDOM + 1) / (_FREEDOM + found / scale), 0.0)
        scale = np.maximum(np.stack([_means(part) for part in weighed]) / share, least)
    return scale


def _transposed(c: _Doubles) -> _Doubles:
    """The transpose of `curvatures`, shape (rows, columns), for c that are 0 where they are not inside."""
    out = np.zeros(c.shape[1:])
    for shift, a in ((-1, 1.0), (0, -2.0), (1, 1.0)):
        out += a * np.roll(c[0], shift, axis=1) + a * np.roll(c[1], shift, axis=0)
    for k in range(4):
        out += (1.0 if k in (0, 3) else -1.0) * np.roll(c[2], (k // 2, k % 2), axis=(0, 1))
    return out


def curvatures(heights: _Doubles) -> _Doubles:
    """Second differences along columns, along rows and across, shape (3, rows, columns); 0 where not inside."""
    out = np.zeros((3, *heights.shape))
    out[0, :, 1:-1] = heights[:, 2:] - 2 * heights[:, 1:-1] + heights[:, :-2]
    out[1, 1:-1] = heights[2:] - 2 * heights[1:-1] + heights[:-2]
    out[2, :-1, :-1] = heights[:-1, :-1] - heights[:-1, 1:] - heights[1:, :-1] + heights[1:, 1:]
    return out


def _inside(shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Which of `curvatures` are inside."""
    out = np.zeros((3, *shape), bool)
    out[0, :, 1:-1] = out[1, 1:-1] = out[2, :-1, :-1] = True
    return out


def _means(values: _Doubles) -> _Doubles:
    """Means around each post over squares of `_PATCH` posts, shape (rows, columns)."""
    return means_around(values, _PATCH)
