"""Least squares of a block of facets: heights and grey values, their accuracy, and evidence for heights.

Unknown heights, grey values, radiometric parameters and variances are improved in turn: grey values by conjugate
gradients, the others given them; heights by normal equations from which the grey values are eliminated
(`kernels.facets`). Where they have converged, the sum of squares of all is least.

Around every post, patches of all images are compared at the height that was found and at all others within the reach
(of the pairs of images the better ones, as what hides a place from one spoils the pairs that it is in). Differences of
grey values at the right height have the variance s² of noise and of what resampling adds in proportion to texture;
elsewhere that of unrelated ground, U. So a height has the weight exp(-L) with L = n/2 (D/s² + ln s² - D/U - ln U), 0
where there is no texture: there all heights are as good. What a post alone does not decide, the posts around may.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.ndimage import maximum_filter
from scipy.optimize import nnls

from photoplan.arrays import Floats, Floats32, Mask
from photoplan.cameras.base import project, tremor_of
from photoplan.events import tell
from photoplan.geometry.grid import Window
from photoplan.kernels.facet_transfer import image_agreement, visible_posts
from photoplan.kernels.facets import (
    GREY_ENTRIES,
    MOMENTS,
    PAD,
    GreyFacets,
    Pixels,
    add_curvatures,
    add_grey,
    add_heights,
    add_means,
    add_random_errors,
    add_residuals,
    add_sensitivities,
    add_spline_residual,
    count_pixels,
    height_equations,
    rademacher,
    sample_grey,
    sample_pixels,
    sample_slopes,
    solve_grey,
    solve_heights,
    sort_pixels,
    variances,
)
from photoplan.matching.facets.observe import (
    Facets,
    Relief,
    Roughness,
    Sight,
    Smoother,
    Transfer,
    View,
    away_from_border,
    corners,
    first_guess,
    levelled,
    means_around,
    pixels_between,
    smoothed,
)

#: Facets over which squared slopes are averaged, twice: all that are seen, and those of noise, which change slowly.
_SEEN, _DRAWN = 3, 9
#: Least part that is taken to be texture: sums over so few facets tell no less from none.
_LEAST_TEXTURE = 0.05
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

    errors: Floats32
    """Errors of the coefficients: one standard deviation each, with their covariance."""
    density: Floats32
    """Weights that lay on each coefficient then."""
    shares: Floats
    """Part of the squared sensitivities in each facet that is texture, 0 to 1, shape (rows − 1, columns − 1)."""

    @classmethod
    def of(
        cls,
        sights: Sequence[Sight],
        weights: Sequence[Floats32],
        ground: GreyFacets,
        errors: Floats32,
        density: Floats32,
    ) -> GreyTexture:
        """From the surface and errors of its coefficients: see `FacetBlock`."""
        found = np.zeros((2, *ground.means.shape[:2]))
        for sight, w in zip(sights, weights):
            add_sensitivities(sight.places, w, ground, errors, found)
        seen, noise = (means_around(means_around(part, size), size) for part, size in zip(found, (_SEEN, _DRAWN)))
        return cls(errors, density, np.clip(1 - noise / np.maximum(seen, 1e-300), 0.0, 1.0))

    @property
    def at_posts(self) -> Floats:
        """The same around each post, at least _LEAST, shape (rows, columns)."""
        around = np.pad(self.shares, 1, mode="edge")
        mean = (around[:-1, :-1] + around[:-1, 1:] + around[1:, :-1] + around[1:, 1:]) / 4
        return np.asarray(np.maximum(mean, _LEAST_TEXTURE))

    def common(self, values: Floats32, ratio: int, counted: NDArray[np.uint8]) -> float:
        """Part of the variance of grey values at the posts that two images see that is not noise."""
        at = np.argwhere(counted > 1)[:, ::-1].astype(float)
        if not len(at):
            return 0.0
        found = np.empty((2, len(at)), np.float32)
        for out, coefficients in zip(found, (values, self.errors)):
            sample_grey(coefficients, ratio, at, out)
        return 1 - float(found[1].var()) / max(float(found[0].var()), 1e-30)


@cache
def shares() -> Floats:
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


#: The mean correction at which iterations end, grey facets (pixels).
ENOUGH = 0.01
#: Largest correction in one iteration, grey facets.
_FARTHEST = 2.0
#: Residuals from so many standard deviations on count less (Huber 1964), and what that takes from their variance.
_LIMIT, _TAKEN = 2.5, 0.978
#: Conjugate gradients of grey values: rounds at most, and the part of their standard deviations that is exact enough.
#: The same for errors that are drawn, whose slopes count.
_ROUNDS, _FULLY = (25, 0.1), (60, 0.03)
#: Rows of pixels that are sorted by facets in turn.
_ROWS = 32
#: Pixels beyond those that grey values need, part of all, without which a surface is not tried.
_TELLING = 0.05
_NONE = np.empty((0, 0), np.float32)
#: Conjugate gradients of heights: rounds at most, and the part of the equations that may be left.
_MOST, _LEFT = 400, 0.01
#: Part of the variance of grey values that is not noise from which on images are taken to show the same.
_COMMON = 0.5
#: Posts of a part whose variances are computed at once, and around it.
_SIDE, _MARGIN = 8, 8
#: Posts along the border of a block, and of what two views see of it, from which nothing is learnt about its roughness,
#: and the part of these that there has to be without the latter.
_BORDER, _LEFT_OVER = 6, 0.25
#: Times by which curvatures weigh more to see what they take away.
_STIFFER = 1.2
#: Least standard deviation of grey values, parts of the contrast: images without noise have residuals of rounding. The
#: part of the mean grey value that counts as contrast at least, as single precision rounds by parts of that.
_QUIET, _PALE = 1e-4, 0.1


@dataclass(eq=False)
class FacetBlock:
    """A level of a block while it is adjusted."""

    facets: Facets
    sights: list[Sight]
    transfers: list[Transfer]
    heights: Floats
    """At the posts, shape (rows, columns), metres."""
    roughness: Roughness
    sigmas: Floats
    """Standard deviation of the grey values of each view, in the system of the surface."""
    scale: float = 1.0
    """See `parallax`."""
    limits: tuple[Floats | float, Floats | float] = (-np.inf, np.inf)
    """Heights between which the surface stays, metres, of all or shape (rows, columns)."""
    reach: float = 0.0
    """How far the start of the heights may be wrong, metres."""
    coarse: bool = False
    """Whether grey facets are coarser than pixels or hardly finer, so that what they do not hold is told of these."""
    trusted: Mask | None = None
    """Posts around which pixels tell their noise, and heights how rough they are; None: all."""
    views: list[View] = field(default_factory=list)
    """Whose sights they are."""
    values: Floats32 = field(default_factory=lambda: np.empty((0, 0), np.float32))
    """Coefficients of the grey facets."""
    moves: list[float] = field(default_factory=list)
    """Mean correction of every iteration so far, pixels of the parallax between the outermost views."""
    system: Floats = field(default_factory=lambda: np.empty((0, 0, 0)))
    """Normal equations of the heights, of the pixels alone."""
    noise: Floats = field(default_factory=lambda: np.empty((0, 0)))
    """Right-hand side of the heights of independent errors of the pixels."""
    counted: NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 0), np.uint8))
    """Views that have pixels around each post."""
    sums: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """Of each view: Σ of robust factors times squared residuals in its own grey values; redundancy."""
    ways: Floats = field(default_factory=lambda: np.empty((0, 0, 2)))
    """Mean change of the pixels' places with height in each facet, posts per metre, (rows − 1, columns − 1, 2)."""
    residuals: list[Floats32] = field(default_factory=list)
    """Of every view's pixels, the surface's grey value less theirs in its system, shape (h, w); NaN: not used."""
    density: Floats32 = field(default_factory=lambda: _NONE)
    """Weights that lie on each coefficient."""
    texture: GreyTexture | None = None
    """None: not told from noise, which is as if all were texture."""
    _factors: list[Floats32] = field(default_factory=list)
    _pull: tuple[Floats, Floats] = (np.empty((0, 0)), np.empty((0, 0)))
    """Heights where the last equations were set up, and their right-hand side, of the pixels alone."""

    def adjust(self, most: int, radiometry: bool, texture: bool = False) -> None:
        """Iterate while heights are elsewhere than where equations were set up; perhaps with the radiometry improved in
        the first iteration, and texture told from noise, which takes one."""
        for k in range(most):
            if self.moves and not (texture and k == 0) and self._moved < ENOUGH:
                break
            tell(k / most)
            self.iterate(radiometry and k == 0, texture and k == 0)

    def iterate(self, radiometry: bool = True, texture: bool = False) -> None:
        """One correction of everything; perhaps with texture told from noise from then on."""
        relief = Relief.of(self.heights)
        # Memory is most while grey values are solved: old residuals go before, and places of one view alone are there
        # twice.
        self.residuals = []
        for n, sight in enumerate(self.sights):
            self.sights[n] = sight.onto(relief)
        grey, weights = self.observed()
        if not len(self.values):
            self._start(grey, weights)
        self.density, errors = self._solve_grey(grey, weights, texture)
        if radiometry:
            self._improve_radiometry(weights)
            grey, weights = self.observed()
        self._pull = self.heights, self._heights(grey, weights, errors)
        self._settle()
        self.moves.append(self._moved)

    @property
    def _moved(self) -> float:
        """Mean change of the heights since the equations were set up, pixels of parallax."""
        change = (self.heights - self._pull[0])[self.counted > 1]
        return float(np.sqrt(np.mean(change**2)) * self.scale) if change.size else 0.0

    def _settle(self) -> None:
        """Heights by the equations of the last iteration and the curvatures' weights as they are now."""
        before, right = self._pull
        (change,) = self._solved(right - self.roughness.gradient(before))
        self.heights = np.clip(before + np.clip(change, -_FARTHEST / self.scale, _FARTHEST / self.scale), *self.limits)

    @property
    def astray(self) -> Mask:
        """Posts that have come to the end of their limits: what is there is no height, shape (rows, columns)."""
        return np.asarray((self.heights <= self.limits[0]) | (self.heights >= self.limits[1]))

    def misfit(self, heights: Floats) -> float:
        """Variance of the grey values about a surface of these heights over their own; infinite if few pixels tell."""
        relief = Relief.of(heights)
        trial = replace(self, heights=heights, sights=[s.onto(relief) for s in self.sights], values=_NONE, _factors=[])
        trial.transfers = first_guess(trial.sights, self.facets)
        grey, weights = trial.observed()
        weights = [(w > 0).astype(np.float32) for w in weights]
        trial._start(grey, weights)
        density, _ = trial._solve_grey(grey, weights)
        total = sum(float(w.sum()) for w in weights)
        free = total - int((density > 0).sum())
        if free < _TELLING * sum(s.raw.size for s in self.sights):
            return float("inf")
        values = np.concatenate([g[w > 0] for g, w in zip(grey, weights)])
        surface = np.concatenate([trial.surface_at(s, w)[w > 0] for s, w in zip(trial.sights, weights)])
        return float(np.sum((values - surface) ** 2) / free / max(float(values.var()), 1e-12))

    def variances(self) -> Floats:
        """Of the heights, shape (rows, columns): of the pixels' noise, and of what smoothing takes away."""
        found = np.empty((2, *self.facets.shape))
        for out, stiffer in zip(found, (1.0, _STIFFER)):
            variances(self._equations(stiffer), _SIDE, _MARGIN, out)
        noise, taken = self.roughness.sandwich(self.heights, self._smoother(), found, _STIFFER)
        if self.texture is None:
            return noise + taken
        # Where nothing tells heights, what is known is how far the start may be wrong.
        if not self.texture.common(self.values, self.facets.ratio, self.counted) > _COMMON and self.reach > 0:
            return np.full(self.facets.shape, self.reach**2 / 3)
        return noise / self.texture.at_posts + taken

    def roughen(self, times: int) -> None:
        """Estimate the variances of the curvatures, and the heights with them."""
        for _ in range(times):
            self.roughness = self.roughness.estimated(self.heights, self._smoother())
            self._settle()

    def _smoother(self) -> Smoother:
        inside = away_from_border(self.counted > 1, _BORDER, _LEFT_OVER)
        if self.trusted is not None:
            inside &= self.trusted
        return Smoother(lambda rights: self._solved(*rights), self.noise, inside, self._signs)

    @cached_property
    def _signs(self) -> Floats:
        """Signs for every curvature: of a place always the same, so that neighbouring blocks learn the same."""
        left, top = np.rint(np.array([self.facets.left, -self.facets.top]) / self.facets.pitch).astype(int).tolist()
        out = np.empty((3, *self.facets.shape))
        rademacher(left, top, out)
        return out

    def _equations(self, stiffer: float = 1.0) -> Floats:
        """Normal equations of pixels and curvatures."""
        out = self.system.copy()
        add_curvatures(stiffer * self.roughness.weights, out)
        return out

    def _solved(self, *rights: Floats) -> Floats:
        """Solutions of the normal equations for right-hand sides, shape (k, rows, columns)."""
        out, system = np.zeros((len(rights), *self.facets.shape), np.float32), self._equations()
        for right, x in zip(rights, out):
            solve_heights(system, right, _MOST, _LEFT, x)
        return out.astype(float)

    def parallax(self) -> float:
        """How far the outermost views of a place part when its height changes, grey facets (pixels) per metre."""
        rows, columns = self.facets.shape
        lowest, highest = (np.full((rows - 1, columns - 1, 2), end) for end in (np.inf, -np.inf))
        count = np.zeros((rows - 1, columns - 1), int)
        for sight in self.sights:
            sums = np.zeros((rows - 1, columns - 1, 3))
            seen = np.isfinite(sight.places[..., 0]) & np.isfinite(sight.raw)
            add_means(sight.places, seen.astype(np.float32), sums)
            known = sums[..., 0] > 0
            ways = sums[known, 1:] / sums[known, :1]
            lowest[known], highest[known] = np.minimum(lowest[known], ways), np.maximum(highest[known], ways)
            count += known
        apart = (highest - lowest)[count > 1]
        return max(float(np.median(np.hypot(*apart.T))) * self.facets.ratio if len(apart) else 0.0, 1e-9)

    def grey_values(self, uv: Floats) -> Floats32:
        """Grey values of the surface at places (n, 2) of the posts inside the block."""
        out = np.empty(len(uv), np.float32)
        sample_grey(self.values, self.facets.ratio, uv, out)
        return out

    def observed(self) -> tuple[list[Floats32], list[Floats32]]:
        """Grey values of all views' pixels in the system of the surface, and their weights."""
        grey = [transfer.apply(sight, self.facets) for sight, transfer in zip(self.sights, self.transfers)]
        if not self._factors:
            self._factors = [np.ones(sight.raw.shape, np.float32) for sight in self.sights]
        weights = [
            np.where(np.isfinite(g), f / np.float32(s * s), np.float32(0))
            for g, f, s in zip(grey, self._factors, self.sigmas)
        ]
        if self.coarse and len(self.values):
            for sight, g, w in zip(self.sights, grey, weights):
                add_spline_residual(self.values, self.facets.ratio, sight.places, w, shares(), g)
        return grey, weights

    def _start(self, grey: Sequence[Floats32], weights: Sequence[Floats32]) -> None:
        """Coefficients that are the mean grey value."""
        total = sum(float(w.sum()) for w in weights) or 1.0
        mean = sum(float(np.nansum(g * w)) for g, w in zip(grey, weights)) / total
        shape = tuple((n - 1) * self.facets.ratio + 1 + 2 * PAD for n in self.facets.shape)
        self.values = np.full(shape, mean, np.float32)

    def _solve_grey(
        self, grey: Sequence[Floats32], weights: Sequence[Floats32], drawn: bool = False
    ) -> tuple[Floats32, Floats32 | None]:
        """The grey values of the surface; returns the weights that lie on each, and perhaps errors of theirs."""
        shape, ratio, errors = self.values.shape, self.facets.ratio, None
        counts = np.zeros((shape[0] - 2 * PAD, shape[1] - 2 * PAD), np.int32)
        for sight, w in zip(self.sights, weights):
            count_pixels(sight.places, w, ratio, counts)
        ends = np.cumsum(counts, dtype=np.int32).reshape(counts.shape) - counts
        pixels = np.empty((int(counts.sum()), 4), np.float32)
        # Some rows of all views in turn: what lies together is then still near when the next view comes there.
        for row in range(0, max(sight.raw.shape[0] for sight in self.sights), _ROWS):
            part = slice(row, row + _ROWS)
            for sight, g, w in zip(self.sights, grey, weights):
                sort_pixels(sight.places[part], g[part], w[part], ratio, ends, pixels)
        system = np.zeros((shape[0], GREY_ENTRIES, shape[1]), np.float32)
        right, density = np.zeros((2, *shape), np.float32)
        add_grey(pixels, ends, system, right, density)
        del pixels, ends, counts
        self.values = _solved_exactly(system, right, density, self.values, *_ROUNDS)
        if drawn:
            right[:] = 0.0
            for n, (sight, w) in enumerate(zip(self.sights, weights)):
                # Of each image others.
                add_random_errors(sight.places, (sight.first[0] + (n << 20), sight.first[1]), w, ratio, right)
            errors = _solved_exactly(system, right, density, np.zeros(shape, np.float32), *_FULLY)
        return density, errors

    def surface_at(self, sight: Sight, weights: Floats32) -> Floats32:
        """Grey values of the surface where a view's pixels lie; 0 where none is used."""
        out = np.empty(sight.raw.shape, np.float32)
        sample_pixels(self.values, self.facets.ratio, sight.places, weights, out)
        return out

    def _improve_radiometry(self, weights: Sequence[Floats32]) -> None:
        contrast = max(float(self.values.std()), 1e-6)
        new = [
            transfer.improved(sight, self.facets, w, self.surface_at(sight, w), contrast) if (w > 0).any() else transfer
            for sight, transfer, w in zip(self.sights, self.transfers, weights)
        ]
        self.transfers = levelled(new)

    def _heights(self, grey: Sequence[Floats32], weights: Sequence[Floats32], errors: Floats32 | None) -> Floats:
        """Normal equations of the heights (kept) and their right-hand side; new standard deviations and factors."""
        rows, columns = self.facets.shape
        sums, counted = np.zeros((rows - 1, columns - 1, 3)), np.zeros((rows, columns), np.uint8)
        for sight, w in zip(self.sights, weights):
            own = np.zeros_like(sums)
            add_means(sight.places, w, own)
            counted += corners(own[..., 0] > 0)
            sums += own
        self.ways = sums[..., 1:] / np.maximum(sums[..., :1], 1e-30)
        trusted = np.ones((rows, columns), bool) if self.trusted is None else self.trusted
        ground = GreyFacets(values=self.values, ratio=self.facets.ratio, means=self.ways, trusted=trusted)
        if errors is not None:
            self.texture = GreyTexture.of(self.sights, weights, ground, errors, self.density)
        found, moments = np.zeros((len(self.sights), 3)), np.zeros((rows - 1, columns - 1, MOMENTS))
        self.residuals = [np.empty(g.shape, np.float32) for g in grey]
        for n, (sight, g, w) in enumerate(zip(self.sights, grey, weights)):
            pixels = Pixels(first=sight.first, places=sight.places, grey=g, weights=w)
            add_heights(pixels, ground, self.sigmas[n], _LIMIT, moments, self.residuals[n], self._factors[n], found[n])
        self.system, (right, self.noise) = np.zeros((7, rows, columns)), np.zeros((2, rows, columns))
        height_equations(moments, self.system, right, self.noise)
        self.counted = counted
        used = sum(float(np.count_nonzero(w)) for w in weights)
        self._weigh(found, int((self.density > 0).sum()) * float(found[:, 2].sum()) / max(used, 1.0))
        return right

    def _weigh(self, found: Floats, unknowns: float) -> None:
        """Standard deviations of the views' grey values, by variance components (Förstner 1979)."""
        used = found[:, 0] > 0
        share = np.where(used, found[:, 0], 0.0) / self.sigmas**2
        # A pixel has as much of the unknowns as of the weights.
        redundancy = np.maximum(found[:, 0] - unknowns * share / max(share.sum(), 1e-30), 0.05 * found[:, 0])
        factor = np.sqrt(found[:, 1] / np.maximum(redundancy, 1.0) / _TAKEN)
        if used.sum() < 3:
            factor[used] = np.sqrt(found[used, 1].sum() / max(redundancy[used].sum(), 1.0) / _TAKEN)
        quiet = _QUIET * max(float(self.values.std()), _PALE * abs(float(self.values.mean())), 1e-6)
        gains = np.array([float(t.gains.mean()) for t in self.transfers])
        self.sums = np.column_stack([found[:, 1] * (self.sigmas * gains) ** 2 / _TAKEN, redundancy])
        self.sigmas = np.where(used, np.maximum(self.sigmas * np.clip(factor, 0.2, 5.0), quiet), self.sigmas)


def _solved_exactly(
    system: Floats32, right: Floats32, density: Floats32, values: Floats32, rounds: int, enough: float
) -> Floats32:
    """Coefficients of grey facets from their normal equations and the weights on each of them, beginning with `values`:
    as exact as a part of their own standard deviations. Those that hardly any pixel knows stay near what they were."""
    usual = np.float32(density[density > 0].mean() if (density > 0).any() else 1.0)
    system[:, 0] += np.float32(1e-4) * usual
    right += np.float32(1e-4) * usual * values
    solve_grey(system, right, smoothed(density) + np.float32(0.05) * usual, values, rounds, enough)
    return values


#: Grey values along a patch over which the errors that were drawn are averaged.
_PATCH = 17
#: Least part of the pixels around a post that are redundant.
_LEAST = 0.1
#: Root mean square of residuals up to which pixels fit: four standard deviations of it, of two images. Posts along the
#: surroundings in which heights are that a wrong one may have.
_FITS, _SURROUNDINGS = 1.3, 9


def grey_places(block: FacetBlock, window: Window, margin: int) -> Floats:
    """Places of the grey values of a window, which begins `margin` posts inside a block, in columns and rows of its
    posts; shape (m · rows, m · columns, 2)."""
    m = block.facets.ratio
    part = (np.arange(m) + 0.5) / m - 0.5
    u, v = ((margin + np.arange(n)[:, None] + part).reshape(-1) for n in (window.width, window.height))
    return np.stack(np.meshgrid(u, v), axis=-1)


def grey_sigmas(block: FacetBlock, at: Floats, height_variances: Floats) -> Floats32:
    """Standard deviations of grey values at places (n, m, 2) of a grid.

    Errors of the pixels are drawn and carried through the normal equations: what comes out has the covariance of the
    grey facets. Its squares, in units of what the pixels around a place weigh, change slowly, so that one draw and
    means over patches are enough. An error dZ of the height shows a place that lies beside by k·dZ, with k the mean of
    the images.
    """
    assert block.texture is not None
    ratio, places = block.facets.ratio, at.reshape(-1, 2)
    drawn, known, before = (np.empty(len(places), np.float32) for _ in range(3))
    fields = block.texture.errors, smoothed(block.density), smoothed(block.texture.density)
    for out, values in zip((drawn, known, before), fields):
        sample_grey(values, ratio, places, out)
    least = np.float32(1e-3 * max(float(block.density.mean()), 1e-30))
    single = 1 / np.maximum(known.reshape(at.shape[:2]), least)
    times = means_around((drawn**2 * np.maximum(before, least)).reshape(at.shape[:2]), _PATCH)
    slopes = np.empty((len(places), 2), np.float32)
    sample_slopes(block.values, ratio, places, slopes)
    j, i = (
        np.clip(at[..., k].astype(int), 0, n - 2) for k, n in ((1, block.facets.shape[0]), (0, block.facets.shape[1]))
    )
    beside = (slopes.reshape(at.shape) * block.ways[j, i]).sum(axis=-1)
    return np.sqrt(times * single + beside**2 * height_variances).astype(np.float32)


def fit(block: FacetBlock) -> Floats:
    """Root mean square of the standardised residuals around each post, shape (rows, columns); NaN without pixels.

    1 is what is expected: squares are divided by the redundancy, what grey values and height take of the pixels.
    """
    sums = np.zeros((*block.facets.shape, 3))
    for sight, residuals in zip(block.sights, standardised(block)):
        add_residuals(sight.places, residuals, 1, sums)
    count, squares = means_around(sums[..., 0], 3), means_around(sums[..., 2], 3)
    free = np.maximum(count - block.facets.ratio**2 - 1, _LEAST * count)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sums[..., 0] > 0, np.sqrt(squares / free), np.nan)


def pixel_noise(raw: Floats32) -> float:
    """Standard deviation of the noise of pixels by themselves, from differences that slopes of grey values do not have
    (Immerkær 1996), robustly; 0 without pixels."""
    a = np.array([1.0, -2.0, 1.0])
    found = ndimage.convolve1d(ndimage.convolve1d(raw.astype(float), a, axis=0), a, axis=1)[1:-1, 1:-1]
    found = np.abs(found[np.isfinite(found)])
    return float(np.median(found)) / (0.6745 * 6.0) if found.size else 0.0


def edge_variances(block: FacetBlock) -> Floats:
    """Variances of heights beside edges, shape (rows, columns), m²; 0 elsewhere.

    Where neighbours part by more parallax than lies between them, not all images see the facet that joins them (a
    gradient of disparity above 1: Burt and Julesz 1980), so that nothing tells where on it the edge is: any of its
    heights may be that of either post.
    """
    out = np.zeros(block.facets.shape)
    for axis in (0, 1):
        jump = np.abs(np.diff(block.heights, axis=axis))
        jump = np.where(jump * block.scale > block.facets.ratio, jump, 0.0) ** 2 / 12
        before, after = [slice(None)] * 2, [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        for side in (tuple(before), tuple(after)):
            out[side] = np.maximum(out[side], jump)
    return out


def misfit_variances(block: FacetBlock, misfit: Floats) -> Floats:
    """Variances of heights around which pixels do not fit, shape (rows, columns), m²; 0 where they do.

    A height that is not where it should be may be any of those around it. How probable that is: the square of the part
    of the squared residuals that noise does not explain, as a little more of it tells little (noise differs from place
    to place). So a rounded edge says so, and a region that went wrong as far as there is relief in it.
    """
    wrong = (1.0 - (_FITS / np.maximum(np.nan_to_num(misfit), _FITS)) ** 2) ** 2
    around = ndimage.maximum_filter(block.heights, _SURROUNDINGS) - ndimage.minimum_filter(block.heights, _SURROUNDINGS)
    return np.asarray(wrong * around**2 / 12)


def residual_pictures(block: FacetBlock) -> list[Floats32]:
    """Mean standardised residual of each view's pixels in every grey value's cell, shape (m · rows, m · columns); NaN
    without pixels. The first cell is that of the first post less half a facet."""
    m, pictures = block.facets.ratio, []
    for sight, residuals in zip(block.sights, standardised(block)):
        sums = np.zeros((m * block.facets.shape[0], m * block.facets.shape[1], 3))
        add_residuals(sight.places, residuals, m, sums)
        with np.errstate(divide="ignore", invalid="ignore"):
            pictures.append((sums[..., 1] / sums[..., 0]).astype(np.float32))
    return pictures


def standardised(block: FacetBlock) -> list[Floats32]:
    """Residuals of every view's pixels, the surface's grey value less theirs, in their standard deviations; NaN: not
    used."""
    return [residuals / np.float32(sigma) for residuals, sigma in zip(block.residuals, block.sigmas)]


_Variances = Callable[[Floats], Floats]

#: Cells of a patch to each side, and how many of its grey values count as independent.
_HALF, _INDEPENDENT = 2, 8.0
#: Distance of the heights that are tried, pixels of parallax, how many at most to each side, and the distance up to
#: which they are the same height.
_STEP, _MOST_HEIGHTS, _SAME = 0.5, 96, 1.0
#: Posts between places that are projected, and pixels of parallax between their heights.
_SPACING, _RISE = 8, 6.0
#: Posts along the squares over which evidence is added, and what a post of these adds to it.
_SQUARES, _ADDED = (5, 11), 0.3
#: Root mean square of differences above which a height may be any of those of the posts next to it, and along how many.
_MISFIT, _BESIDE = 1.5, 3
#: What grey values vary by more than noise does before they are texture, parts of the variance of differences.
_CHANCE = 0.5
#: Slope of a patch, pixels of parallax over its half, above which it is also tried level.
_SLOPING = 0.25
#: Probability that images agree at no height, parts of all heights that are tried; posts along the surroundings in
#: whose range the height then is.
_NO_HEIGHT, _RANGE = 0.3, 17
#: By how much other heights lie below what is between, to be another choice, and those nearer than a pixel; evidence
#: above which nothing is decided; times the variance of differences above which a post is against its height.
_RISES, _RISES_NEAR, _UNDECIDED, _AGAINST = 1.0, 4.0, -3.0, 4.0
#: Evidence below which a post is beyond doubt; heights up to so many pixels of parallax away are tried at all posts,
#: others at every third of those beyond doubt.
_STRONG, _NEARBY, _THIRD = -8.0, 1.5, 3
#: Part of the variance of grey values that resampling may add at most.
_RESAMPLED = 0.3


@dataclass(frozen=True, eq=False)
class HeightEvidence:
    """Evidence for the posts of a block, all of shape (rows, columns)."""

    count: NDArray[np.uint8]
    """Images that see the post."""
    variance: Floats
    """Variance of the choice among the heights within the reach, m²."""
    probability: Floats
    """Probability that the height is right to a pixel of parallax."""
    fit: Floats
    """Root mean square of residuals, or of differences between images if these are less, 1 is expected; NaN: none."""


def visible(block: FacetBlock) -> Mask:
    """Return which views see the posts of a block over its surface, shape (views, rows, columns)."""
    facets, heights = block.facets, block.heights
    XYZ = np.concatenate([facets.posts, heights[..., None]], axis=-1)
    out = np.zeros((len(block.views), *facets.shape), bool)
    for view, seen in zip(block.views, out):
        xy = project(view.camera, XYZ)
        inside = ((xy > -0.5) & (xy < np.array(view.camera.size) - 0.5)).all(axis=-1)
        J = np.asarray(view.camera.derivatives(XYZ))
        determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            du = -(J[..., 1, 1] * J[..., 0, 2] - J[..., 0, 1] * J[..., 1, 2]) / determinant
            dv = -(J[..., 0, 0] * J[..., 1, 2] - J[..., 1, 0] * J[..., 0, 2]) / determinant
        ways = np.nan_to_num(np.stack([du, -dv], axis=-1) / facets.pitch)
        visible_posts(heights, ways, float(heights.max()), 1.0 / block.scale, seen)
        seen &= inside
    return out


def evidence(
    block: FacetBlock, level: int, low: Floats, high: Floats, inner: tuple[slice, slice], misfit: Floats
) -> HeightEvidence | None:
    """Compare the images of a block at heights between two surfaces (rows, columns); `level`: of the pyramids, `inner`:
    the posts that are asked for; `misfit`: see `judged.fit`.

    None: an image was taken on a turbulent flight, along whose lines places are not even.
    """
    if any(tremor_of(view.camera) is not None for view in block.views):
        return None
    facets, heights = block.facets, block.heights
    rows, columns = facets.shape
    seen = visible(block)
    step = _STEP / block.scale
    span = float(np.max(high - heights)), float(np.max(heights - low))
    counts = [int(np.clip(np.ceil(end / step), 2, _MOST_HEIGHTS)) for end in span]
    bottom, top = float(heights.min()) - counts[1] * step, float(heights.max()) + counts[0] * step
    stack, lattice, rise = _projected(block, level, bottom, top)
    if len(stack) < 2:
        return None
    used = [n for n, _ in stack]
    raws = np.full((len(stack), *np.max([raw.shape for _, raw in stack], axis=0)), np.nan, np.float32)
    for out, (_, raw) in zip(raws, stack):
        out[: raw.shape[0], : raw.shape[1]] = raw
    gains = np.array([block.transfers[n]._nodes.sampled(block.transfers[n].gains, facets.posts) for n in used])
    noise, own = block.sigmas[used] ** 2, np.ascontiguousarray(seen[used])
    slopes = np.stack([np.gradient(heights, axis=1), np.gradient(heights, axis=0)])
    sloping = np.abs(slopes).max(axis=0) * block.scale * _HALF / facets.ratio > _SLOPING
    levels = np.zeros_like(slopes)

    def tried(k: int, wanted: Mask) -> tuple[Floats, Floats]:
        """Differences and those of unrelated grey values, of patches that follow the surface, and of level ones."""
        found = np.full((2, 2, rows, columns), np.nan, np.float32)
        z = (heights + k * step - bottom) / rise
        for (a, b), turned, some in zip(found, (slopes, levels), (wanted, wanted & sloping)):
            image_agreement(raws, lattice, float(_SPACING), z, turned / rise, facets.ratio, _HALF, gains, noise, own,
                            some, a, b)  # fmt: skip
        better = sloping & ~(found[0, 0] <= found[1, 0])
        return tuple(np.where(better, found[1, e], found[0, e]).astype(float) for e in (0, 1))

    every = np.zeros(facets.shape, bool)
    every[inner] = True
    every = maximum_filter(every, _SQUARES[-1])
    here = tried(0, every)
    variances = _expected(*here, block.trusted)
    # Where images agree beyond doubt, heights farther away are tried at some posts, which stand for those around.
    strong = _lacking(*here, variances) < _STRONG
    some = np.zeros_like(strong)
    some[::_THIRD, ::_THIRD] = True
    at = np.ix_(*(np.minimum(np.arange(n) // _THIRD * _THIRD, n - 1) for n in facets.shape))
    spoken = strong & ~some & strong[at]
    choices: dict[int, _Choice] = {}
    edges = edge_variances(block)[inner] > 0
    for k in (*range(counts[0] + 1), *range(-1, -counts[1] - 1, -1)):
        far = abs(k) * _STEP > _NEARBY
        L = _lacking(*(here if k == 0 else tried(k, every & (~strong | some) if far else every)), variances)
        if far:
            L = np.where(spoken, L[at], L)
        offset = k * step
        allowed = (heights + offset >= low - step) & (heights + offset <= high + step) | (abs(k) <= 2)
        if k == 0:
            flat = _open(L)
        for size in (1, *_SQUARES):
            # Posts around count as they stand relative to their own heights: a roof is lifted as a whole.
            total = L
            if size > 1:
                # What a wide square decides is what its posts without texture of their own decide together.
                alike = flat > 0.5 if size > _SQUARES[0] else every
                total = L + _ADDED * (size**2 - 1) * means_around(np.where(alike, np.minimum(L, 4.0), 0.0), size)
            if k == 0:
                # Another height takes a break of the surface, if the images agree around, in the widest square (the
                # last): as rare as breaks are.
                rare = (1.0 - _open(total)) * np.log((edges.sum() + 1) / (edges.size + 1))
                choices[size] = _Choice(total)
            else:
                choices[size].add(total, k, offset, np.where(allowed, total - rare, np.inf), flat)
    with np.errstate(invalid="ignore"):
        # All pixels fit, or those of the images that agree best: what hides a place from one image is no misfit.
        fit = np.fmin(misfit, np.sqrt(here[0] / variances(here[1])))
    none = {
        size: _NO_HEIGHT * sum(counts) * np.exp(np.minimum(each.lowest, 50.0) + rare) for size, each in choices.items()
    }
    variance, agreed = _decided(choices, none, heights, fit)
    beside = (
        np.maximum(maximum_filter(heights, _BESIDE) - heights, heights + maximum_filter(-heights, _BESIDE)) ** 2 / 3
    )
    variance += (1.0 - (_MISFIT / np.maximum(np.nan_to_num(fit), _MISFIT)) ** 2) * beside
    return HeightEvidence(seen.sum(axis=0).astype(np.uint8), variance, agreed, fit)


class _Choice:
    """Choice among heights by evidence that was added over squares of a size; the first one is the surface's own."""

    def __init__(self, here: Floats) -> None:
        self._here = self._barrier = here
        self.lowest = here
        """Evidence of the best height so far."""
        self.sums = np.stack([np.ones(here.shape), *np.zeros((2, *here.shape))])
        """Sums of p, of p times the squared distance, and of p of other heights, relative to the best height's p."""

    def add(self, total: Floats, k: int, offset: float, allowed: Floats, flat: Floats) -> None:
        """Add the k-th height to one side, from near to far; `allowed` is `total` as far as the height may be taken."""
        if abs(k) == 1:
            self._barrier = self._here
        # The same valley is no other choice, unless there is none: gradually, as evidence has noise.
        distant = abs(k) * _STEP > _SAME
        rises = _RISES if distant else _RISES_NEAR
        other = np.clip(self._barrier - rises - total, 0.0, 1.0)
        if distant:
            other = np.maximum(other, _open(self._here))
        self._barrier = np.maximum(self._barrier, total)
        least = np.minimum(self.lowest, allowed)
        kept, p = np.exp(least - self.lowest), np.exp(least - allowed)
        for n, weight in enumerate((1.0, np.maximum(other, flat) * offset**2, other)):
            self.sums[n] = self.sums[n] * kept + p * weight
        self.lowest = least


def _decided(
    choices: Mapping[int, _Choice], none: Mapping[int, Floats], heights: Floats, fit: Floats
) -> tuple[Floats, Floats]:
    """Return the variance of the choice and the probability of the height, from squares of those sizes that are surest;
    `none` is the weight of no height at all."""
    around = np.maximum(maximum_filter(heights, _RANGE) - heights, heights + maximum_filter(-heights, _RANGE)) ** 2 / 3
    variance, agreed = np.zeros((2, *heights.shape))
    against = np.nan_to_num(fit) ** 2 > _AGAINST
    for size, choice in choices.items():
        whole = choice.sums[0] + none[size]
        right = 1.0 - (choice.sums[2] + none[size]) / whole
        # What a post decides against its height the posts around do not overrule.
        better = (right > agreed) & ~against | (size == 1)
        variance = np.where(better, (choice.sums[1] + none[size] * around) / whole, variance)
        agreed = np.where(better, right, agreed)
    return variance, agreed


def _open(L: Floats) -> Floats:
    """Return by how much evidence leaves a height undecided, 0 to 1."""
    return np.clip((L - _UNDECIDED) / 2 + 0.5, 0.0, 1.0)


def _projected(
    block: FacetBlock, level: int, bottom: float, top: float
) -> tuple[list[tuple[int, Floats32]], Floats, float]:
    """Pixels of views that see the block between two heights, where places on a lattice over it lie in them, and the
    distance of its heights."""
    facets = block.facets
    rows, columns = facets.shape
    u, v = (np.arange(-(-(n - 1) // _SPACING) + 1) * float(_SPACING) for n in (columns, rows))
    XY = facets.to_map(np.stack(np.meshgrid(u, v), axis=-1))
    count = max(2, int(np.ceil((top - bottom) * block.scale / _RISE)) + 1)
    rise = (top - bottom) / (count - 1)
    stack, places = [], []
    for n, view in enumerate(block.views):
        found = pixels_between(view, level, facets, (bottom, top))
        if found is None:
            continue
        window, raw = found
        XYZ = np.stack([np.concatenate([XY, np.full((*XY.shape[:2], 1), bottom + k * rise)], -1) for k in range(count)])
        places.append(project(view.camera, XYZ) / 2 ** (level + view.finer) - (window.col, window.row))
        stack.append((n, raw))
    return stack, np.ascontiguousarray(places), rise


def _expected(squares: Floats, unrelated: Floats, trusted: Mask | None) -> _Variances:
    """Function that returns the variance of differences at right heights from that of unrelated ones: a + b U, from
    medians over posts of like texture."""
    known = np.isfinite(squares) & np.isfinite(unrelated)
    if trusted is not None and (known & trusted).sum() > 0.05 * known.sum():
        known &= trusted
    D, U = squares[known], unrelated[known]
    if D.size < 50:
        return lambda U: 1.0 + 0.05 * U
    order = np.argsort(U)
    parts = [part for part in np.array_split(order, 10) if len(part)]
    x, y = np.array([np.median(U[part]) for part in parts]), np.array([np.median(D[part]) for part in parts])
    y = np.maximum(y, 1e-3)  # images without noise
    (a, b), _ = nnls(np.column_stack([np.ones_like(x), x]) / y[:, None], np.ones_like(y))
    return lambda U: max(a, 0.2) + min(b, _RESAMPLED) * U


def _lacking(squares: Floats, unrelated: Floats, variances: _Variances) -> Floats:
    """Half the excess of -2 ln p of the differences, taken as those of a right height, over that of unrelated ones."""
    s2 = variances(unrelated)
    # Patches of noise alone differ by chance, and heights were fitted to them.
    U = np.maximum(unrelated - _CHANCE * s2, s2)
    with np.errstate(invalid="ignore", divide="ignore"):
        L = _INDEPENDENT / 2 * (squares / s2 + np.log(s2) - squares / U - np.log(U))
    return np.nan_to_num(L, nan=0.0, posinf=50.0)
