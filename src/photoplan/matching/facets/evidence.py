"""Evidence of images for each height of a surface: whether they agree there, and whether they agree at others as well.

Around every post, patches of all images are compared at the height that was found and at all others within the reach
(of the pairs of images the better ones, as what hides a place from one spoils the pairs that it is in). Differences of
grey values at the right height have the variance s² of noise and of what resampling adds in proportion to texture;
elsewhere that of unrelated ground, U. So a height has the weight exp(-L) with L = n/2 (D/s² + ln s² - D/U - ln U), 0
where there is no texture: there all heights are as good. What a post alone does not decide, the posts around may.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.optimize import nnls

from photoplan.cameras.base import project, tremor_of
from photoplan.kernels.facet_transfer import image_agreement, visible_posts
from photoplan.matching.facets.block import FacetBlock
from photoplan.matching.facets.judged import edge_variances
from photoplan.matching.facets.means import means_around
from photoplan.matching.facets.observe import pixels_between

_Floats = NDArray[np.float32]
_Doubles = NDArray[np.float64]
_Variances = Callable[[_Doubles], _Doubles]

#: Cells of a patch to each side, and how many of its grey values count as independent.
_HALF, _INDEPENDENT = 2, 8.0
#: Distance of the heights that are tried, pixels of parallax, how many at most to each side, and the distance up to
#: which they are the same height.
_STEP, _MOST, _SAME = 0.5, 96, 1.0
#: Posts between places that are projected, and pixels of parallax between their heights.
_SPACING, _RISE = 8, 6.0
#: Posts along the squares over which evidence is added, and what a post of these adds to it.
_AROUND, _ADDED = (5, 11), 0.3
#: Root mean square of differences above which a height may be any of those of the posts next to it, and along how many.
_FITS, _BESIDE = 1.5, 3
#: What grey values vary by more than noise does before they are texture, parts of the variance of differences.
_CHANCE = 0.5
#: Slope of a patch, pixels of parallax over its half, above which it is also tried level.
_SLOPING = 0.25
#: Probability that images agree at no height, parts of all heights that are tried; posts along the surroundings in
#: whose range the height then is.
_NONE, _RANGE = 0.3, 17
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
    variance: _Doubles
    """Variance of the choice among the heights within the reach, m²."""
    probability: _Doubles
    """Probability that the height is right to a pixel of parallax."""
    fit: _Doubles
    """Root mean square of residuals, or of differences between images if these are less, 1 is expected; NaN: none."""


def visible(block: FacetBlock) -> NDArray[np.bool_]:
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
    block: FacetBlock, level: int, low: _Doubles, high: _Doubles, inner: tuple[slice, slice], misfit: _Doubles
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
    counts = [int(np.clip(np.ceil(end / step), 2, _MOST)) for end in span]
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

    def tried(k: int, wanted: NDArray[np.bool_]) -> tuple[_Doubles, _Doubles]:
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
    every = maximum_filter(every, _AROUND[-1])
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
        for size in (1, *_AROUND):
            # Posts around count as they stand relative to their own heights: a roof is lifted as a whole.
            total = L
            if size > 1:
                # What a wide square decides is what its posts without texture of their own decide together.
                alike = flat > 0.5 if size > _AROUND[0] else every
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
    none = {size: _NONE * sum(counts) * np.exp(np.minimum(each.lowest, 50.0) + rare) for size, each in choices.items()}
    variance, agreed = _decided(choices, none, heights, fit)
    beside = (
        np.maximum(maximum_filter(heights, _BESIDE) - heights, heights + maximum_filter(-heights, _BESIDE)) ** 2 / 3
    )
    variance += (1.0 - (_FITS / np.maximum(np.nan_to_num(fit), _FITS)) ** 2) * beside
    return HeightEvidence(seen.sum(axis=0).astype(np.uint8), variance, agreed, fit)


class _Choice:
    """Choice among heights by evidence that was added over squares of a size; the first one is the surface's own."""

    def __init__(self, here: _Doubles) -> None:
        self._here = self._barrier = here
        self.lowest = here
        """Evidence of the best height so far."""
        self.sums = np.stack([np.ones(here.shape), *np.zeros((2, *here.shape))])
        """Sums of p, of p times the squared distance, and of p of other heights, relative to the best height's p."""

    def add(self, total: _Doubles, k: int, offset: float, allowed: _Doubles, flat: _Doubles) -> None:
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
    choices: Mapping[int, _Choice], none: Mapping[int, _Doubles], heights: _Doubles, fit: _Doubles
) -> tuple[_Doubles, _Doubles]:
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


def _open(L: _Doubles) -> _Doubles:
    """Return by how much evidence leaves a height undecided, 0 to 1."""
    return np.clip((L - _UNDECIDED) / 2 + 0.5, 0.0, 1.0)


def _projected(
    block: FacetBlock, level: int, bottom: float, top: float
) -> tuple[list[tuple[int, _Floats]], _Doubles, float]:
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


def _expected(squares: _Doubles, unrelated: _Doubles, trusted: NDArray[np.bool_] | None) -> _Variances:
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


def _lacking(squares: _Doubles, unrelated: _Doubles, variances: _Variances) -> _Doubles:
    """Half the excess of -2 ln p of the differences, taken as those of a right height, over that of unrelated ones."""
    s2 = variances(unrelated)
    # Patches of noise alone differ by chance, and heights were fitted to them.
    U = np.maximum(unrelated - _CHANCE * s2, s2)
    with np.errstate(invalid="ignore", divide="ignore"):
        L = _INDEPENDENT / 2 * (squares / s2 + np.log(s2) - squares / U - np.log(U))
    return np.nan_to_num(L, nan=0.0, posinf=50.0)
