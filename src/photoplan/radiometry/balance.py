"""Colour balance of a block: tone curves, trends, adjustment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, vstack
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from photoplan.adjustment.least_squares import MEDIAN_1D, cauchy
from photoplan.radiometry.equations import (
    COUNTS,
    GROUND,
    STEEP,
    Band,
    BandState,
    Basis,
    Cells,
    Prior,
    Solved,
    factors,
    neighbours,
    placed,
)
from photoplan.radiometry.tone import Tone, powers_of, surface

_Floats = NDArray[np.float64]

#: Residuals of this many standard deviations weigh half; 95 % of the efficiency are kept at normally distributed ones.
_HALF = 2.385
#: Least slope of a table.
_LEAST_SLOPE = 0.05
#: What a table that may not fall weighs beside the observations; their least standard deviation, part of the range.
_HARD, _FLOOR = 1e4, 0.001
#: Parts of the ground that are darker than the two grey values at which the mean of all curves is held.
_HELD = (0.1, 0.9)
_ROUNDS, _CONVERGED = 30, 1e-3
#: Observations that err together by what the model leaves out; each counts as this part of one.
_CORRELATED = 16.0
#: Observations whose equations are made at once, at least.
_AT_ONCE = 120_000
#: Parts of the ground that are left out in turn, and draws of what was known beforehand.
_PARTS, _DRAWS = 16, 64
#: Rounds in which variance components are estimated, and random vectors for a trace.
_COMPONENTS, _PROBES = 15, 16


@dataclass(frozen=True, eq=False)
class Gauge:
    """Values that are held, since overlaps alone do not determine them."""

    parts: NDArray[np.int64]
    """Images (n,) of one number hang together; each part gets a gauge of its own."""
    fixed: int | None = None
    """The image that stays as it is; else the mean of a part's tables changes nothing, if there is no reference."""


@dataclass(frozen=True, eq=False)
class AdjustedBand:
    """Result for one band."""

    state: BandState
    sigma: float
    """Standard deviation of a quantile of an image in a cell, grey values."""
    rounds: int
    down: float
    """Part of the observations that count less than half."""
    prior: Prior
    """With the variance components that were found."""
    errors: _Floats
    """Errors of all unknowns, (unknowns, k): their sum of squares over k is the variance."""
    prior_errors: _Floats
    """The same if there were no observations, (unknowns, k)."""
    evidence: float
    """Logarithm of the observations' probability under the prior (Laplace's approximation), but for a constant."""
    curve_last: bool = True
    """True if curves act after trends."""
    relative: bool = False
    """True if only departures of the tables from their mean matter, since light becomes grey again by that mean."""

    @cached_property
    def sigmas(self) -> BandState:
        """Standard deviations of tables and trends, beside the gauge; of the ground none."""
        errors, parts, (images, nodes) = self.errors.copy(), self.prior.parts, self.state.tables.shape
        if self.relative:
            tables = errors[: images * self.state.width].reshape(images, self.state.width, -1)[:, :nodes]
            for part in np.unique(parts):
                tables[parts == part] -= tables[parts == part].mean(axis=0)
        blank = replace(self.state, ground=np.full(len(self.state.ground), np.nan))
        return blank.with_vector(np.sqrt(np.square(errors).sum(axis=1)))


@dataclass(frozen=True, eq=False)
class _Weights:
    """Weights at a state."""

    of: _Floats
    """Weights of the observations, inverse variances, (n,)."""
    ground: _Floats
    """Weights of what holds the ground, (groups,)."""
    moved: _Floats
    """Differences of the ground from that, (groups,)."""
    robust: _Floats
    """By the size of residuals, (n,)."""
    sigma: float


@dataclass(frozen=True, eq=False)
class _Normals:
    """Normal equations N x = g of the observations at a state, without the ground."""

    N: csr_array
    g: _Floats
    alone: _Floats
    """Step of the ground if images stay, (groups,)."""
    lost: csr_array
    """Change of that step with the unknowns of the images, (groups, unknowns)."""


def adjust(band: Band, gauge: Gauge, prior: Prior, *, judged: bool = True) -> AdjustedBand:
    """Tables and trends of one band."""
    images = len(gauge.parts)
    state, span = band.start(images, prior.common), float(np.ptp(band.nodes))
    H, held = _gauge(band, state, gauge)
    flat, robust = np.zeros((images, len(band.nodes) - 1), bool), np.ones(len(band.grey))
    rounds = 0
    while True:
        rounds += 1
        weights = _weigh(band, state, robust, gauge.fixed is None)
        found = _normals(band, state, weights)
        robust, x = weights.robust, state.vector
        P, wanted, component = prior.rows()
        rising, missing = _rising(band, state, flat)
        hard = _HARD * float(found.N.diagonal().max())
        N = found.N + P.T @ P + hard * (rising.T @ rising)
        solved = Solved.of(N, H)
        step = solved.step(found.g + P.T @ (wanted - P @ x) + hard * (rising.T @ missing), held - H @ x)
        state = state.with_vector(x + step)
        state = replace(state, ground=state.ground + found.alone - found.lost @ step)
        falling = np.diff(state.tables, axis=1) < _LEAST_SLOPE * band.step * (1 - 1e-6)
        done = float(np.abs(step).max()) < _CONVERGED * span and not (falling & ~flat).any()
        if done or rounds == _ROUNDS:
            break
        flat |= falling
        if rounds <= _COMPONENTS:
            prior = _with_components(prior, solved, P, wanted, component, state.vector)
    weights = _weigh(band, state, robust, gauge.fixed is None)
    known = Solved.of(csr_array(P.T @ P), H)
    errors, before = np.zeros((2, state.vector.size, 0))
    if judged:
        drawn = P.T @ np.random.default_rng(0).normal(size=(P.shape[0], _DRAWS)) / np.sqrt(_DRAWS)
        errors = np.concatenate([_without_parts(band, state, weights, solved, N), solved.step(drawn, 0.0)], axis=1)
        before = known.step(drawn, 0.0)
    return AdjustedBand(
        state=state,
        sigma=weights.sigma,
        rounds=rounds,
        down=float((robust < 0.5).mean()),
        prior=prior,
        errors=errors,
        prior_errors=before,
        evidence=_evidence(band, state, weights, known, Solved.of(found.N + P.T @ P, H))
        + prior.log_density
        - float(np.square(wanted - P @ state.vector).sum()) / 2,
        curve_last=band.curve_last,
        relative=band.curve_last and gauge.fixed is None and not band.referred,
    )


def _evidence(band: Band, state: BandState, weights: _Weights, known: Solved, solved: Solved) -> float:
    """Logarithm of the probability of the observations given the prior's equations `known`, beside its own terms."""
    residual, count = band.grey - band.predicted(state)[0], float(band.weight.sum()) / _CORRELATED
    misfit = float((weights.of * residual**2).sum()) / 2 + count * float(np.log(weights.sigma))
    return (known.log_determinant - solved.log_determinant) / 2 - misfit


def _with_components(
    prior: Prior, solved: Solved, P: csr_array, wanted: _Floats, component: NDArray[np.int64], x: _Floats
) -> Prior:
    """The prior with variance components re-estimated by one step of expectation and maximisation."""
    missing, rng = wanted - P @ x, np.random.default_rng(0)
    squares, counts = np.zeros((2, len(prior.sigmas)))
    for k in range(len(prior.sigmas)):
        rows = component == k
        counts[k] = rows.sum()
        if counts[k]:
            probes = rng.choice([-1.0, 1.0], (int(counts[k]), _PROBES))
            D = P[np.flatnonzero(rows)]
            trace = float((probes * (D @ solved.step(D.T @ probes, 0.0))).sum()) / _PROBES
            squares[k] = float(np.square(missing[rows]).sum()) + trace
    return replace(prior, sigmas=prior.updated(squares, counts))


def _weigh(band: Band, state: BandState, robust: _Floats, own: bool) -> _Weights:
    """Weights at a state; `own`: whether a reference holds the ground."""
    shown, slope = band.predicted(state)
    residual = band.grey - shown
    w = band.weight * robust * slope**2
    # The part of its own error that an observation shows beside the others of its group.
    size = residual / np.sqrt(np.maximum(1.0 - w / np.bincount(band.group, w)[band.group], 0.1))
    sigma = max(float(np.median(np.abs(size))) / MEDIAN_1D, _FLOOR * float(np.ptp(band.nodes)))
    robust = cauchy(size / sigma, _HALF)
    moved, share = _held(band, state, sigma) if own and band.referred else np.zeros((2, len(state.ground)))
    # The reference errs together with what is compared to it.
    share /= _CORRELATED
    of = band.weight * robust / (_CORRELATED * sigma**2)
    return _Weights(of=of, ground=share, moved=moved, robust=robust, sigma=sigma)


def _normals(band: Band, state: BandState, weights: _Weights) -> _Normals:
    """Normal equations of observations that have weights; the ground is taken out of them, cells by cells."""
    starts = np.flatnonzero(np.diff(band.cell, prepend=-1))
    firsts = starts[np.unique(np.searchsorted(starts, np.arange(0, len(band.cell), _AT_ONCE)).clip(0, len(starts) - 1))]
    found, groups = [], []
    for first, end in zip(firsts, [*firsts[1:].tolist(), len(band.cell)]):
        rows, of = np.arange(first, end), slice(int(band.group[first:end].min()), int(band.group[first:end].max()) + 1)
        some = band.some(rows)
        ground = replace(state, ground=state.ground[of])
        mine = replace(weights, of=weights.of[rows], ground=weights.ground[of], moved=weights.moved[of])
        found.append(_normals_of(replace(some, group=some.group - of.start), ground, mine))
        groups.append(np.arange(of.start, of.stop))
    N, g = found[0].N, found[0].g
    for each in found[1:]:
        N, g = N + each.N, g + each.g
    alone = np.zeros(len(state.ground))
    alone[np.concatenate(groups)] = np.concatenate([each.alone for each in found])
    return _Normals(N, g, alone, csr_array(vstack([each.lost for each in found])))


def _normals_of(band: Band, state: BandState, weights: _Weights) -> _Normals:
    """The same of some cells."""
    groups = _sums(band.group, len(state.ground))
    (shown, slope), A = band.predicted(state), band.design(state)
    residual, w = band.grey - shown, weights.of
    total = np.maximum(groups @ (w * slope**2) + weights.ground, 1e-300)
    pull = groups @ (w * slope * residual) + weights.ground * weights.moved
    B = _scaled(A, w)
    lost = _scaled(groups @ _scaled(B, slope), 1 / total)
    N = A.T @ B - lost.T @ _scaled(lost, total)
    return _Normals(N, B.T @ residual - lost.T @ pull, pull / total, lost)


def _held(band: Band, state: BandState, sigma: float) -> tuple[_Floats, _Floats]:
    """Return the differences of the ground from the reference, and their weights."""
    share = np.bincount(band.group, band.weight) / np.bincount(band.group)
    moved = band.beside_reference(state)
    known = np.isfinite(moved)
    moved[~known] = 0.0
    least = max(float(np.median(np.abs(moved[known]))) / MEDIAN_1D, sigma)
    return moved, np.where(known, share * cauchy(moved / least, _HALF), 0.0) / least**2


def _scaled(A: csr_array, by: _Floats) -> csr_array:
    """A matrix with its rows multiplied; without the copies of its indices that the library makes."""
    return csr_array((A.data * np.repeat(by, np.diff(A.indptr)), A.indices, A.indptr), shape=A.shape)


def _sums(of: NDArray[np.int64], count: int) -> csr_array:
    """The matrix that adds up observations of one number, of `count` numbers."""
    starts = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=count))])
    order = np.argsort(of, kind="stable")
    parts = np.ones(len(of)), order.astype(np.int32), starts.astype(np.int32)
    return csr_array(parts, shape=(count, len(of)))


def _gauge(band: Band, state: BandState, gauge: Gauge) -> tuple[_Floats, _Floats]:
    """Conditions H x = held on the unknowns of the images."""
    nodes, width = state.tables.shape[1], state.width
    rows: list[_Floats] = []
    held: list[float] = []
    for part in np.unique(gauge.parts):
        members = np.flatnonzero(gauge.parts == part)
        fixed = members[members == gauge.fixed]
        if band.referred and not len(fixed):
            continue
        used = fixed if len(fixed) else members
        # Where curves act last, fall-off is multiplied in light: overlaps determine the mean curve but for two values.
        few = band.curve_last and not len(fixed)
        k = np.clip(np.searchsorted(band.nodes, np.quantile(band.own, _HELD)), 1, nodes - 2)
        for node in np.unique(k).tolist() if few else range(nodes):
            row = np.zeros(state.vector.size)
            row[used * width + node] = 1 / len(used)
            rows.append(row)
            held.append(float(band.nodes[node]))
    return np.array(rows).reshape(-1, state.vector.size), np.array(held)


def _rising(band: Band, state: BandState, flat: NDArray[np.bool_]) -> tuple[csr_array, _Floats]:
    """Tables that may not fall: their rises as rows, and what these lack."""
    width = state.width
    image, k = np.nonzero(flat)
    first, n = image * width + k, len(image)
    columns = np.stack([first, first + 1], axis=1).ravel()
    rows = csr_array((np.tile([-1.0, 1.0], n), columns, np.arange(0, 2 * n + 1, 2)), shape=(n, state.vector.size))
    return rows, _LEAST_SLOPE * band.step - np.diff(state.tables, axis=1)[image, k]


def _without_parts(band: Band, state: BandState, weights: _Weights, solved: Solved, N: csr_array) -> _Floats:
    """Errors of the unknowns, (n, parts), by what they become without a part of the ground (Tukey 1958).

    What lies near each other errs together; so parts are blocks of cells, drawn by lot, where there are enough.
    """
    unit = band.block if band.block.max() + 1 >= _PARTS else band.cell
    units = int(unit.max()) + 1
    # Of a narrow block the cells may be fewer than parts.
    count = min(_PARTS, units)
    part = np.random.default_rng(0).permutation(units) % count
    of, ground = part[unit], np.zeros(len(state.ground), np.int64)
    ground[band.group] = of
    moved = np.zeros((count, state.vector.size))
    if count < 2:
        return moved.T
    for k in range(count):
        rows = np.flatnonzero(of == k)
        some = replace(weights, of=weights.of[rows], ground=weights.ground * (ground == k))
        one = _normals(band.some(rows), state, some)
        moved[k] = solved.without(one.N, N, -one.g)
    # What residuals change with the unknowns under robust weights, beside what the weights alone say.
    kept = max(float(np.mean(2 * weights.robust**2 - weights.robust) / np.mean(weights.robust)), 0.2)
    moved /= kept
    return np.asarray(np.sqrt((count - 1) / count) * (moved - moved.mean(axis=0)).T)


#: Nodes of a table in the adjustment, and grey values of the table that comes of it.
NODES, ENTRIES = 17, 33
#: Images in cells that are adjusted: some 100 for each of 500 images, all of a smaller block.
_MOST_ROWS = 50_000
#: Where a shoulder begins, parts of the range from its ends; what of the pixels may lie beyond it without one.
_SHOULDER, _BEYOND = 0.12, 0.0005
#: Pairs of rows that are compared at once.
_CHUNK = 50_000
#: Degree of the polynomial by which a trend is written, and places along both sides of an image from which it is found.
_FITTED, _ALONG = 6, 33
#: Part by which the misfit of curves before the fall-off must be less, so that they are taken to act before it.
_LESS = 0.02
#: Places along both sides of an image at which slopes and bends of the whole block are found.
_PLACES = 8
#: An image whose grey values differ by less than this part of the range is all of one colour.
_EVEN = 0.01


@dataclass(frozen=True)
class BlockMode:
    """A change of brightness over the whole block, parts of the brightness from the block's middle to its edge."""

    name: str
    value: float
    """Part of it in the exposures and trends that were found."""
    sigma: float
    """Standard deviation of what the balanced images still have of it."""
    prior: float
    """Standard deviation before overlaps were compared."""
    order: float
    """Difference, contained in `sigma`, if curves and fall-off act in the other order."""

    @property
    def held(self) -> bool:
        """Return whether it is the prior that determines it, not the overlaps."""
        return self.sigma > 0.5 * self.prior


@dataclass(frozen=True, eq=False)
class Balanced:
    """Tones of the images of one block."""

    images: NDArray[np.int64]
    """Numbers of those that have tones."""
    tones: tuple[tuple[Tone, ...], ...]
    """For each of them one for each band."""
    sigmas: tuple[tuple[tuple[float, ...], ...], ...]
    """Standard deviations of what the tables' grey values become, in the same order."""
    parts: NDArray[np.int64]
    """Images of one number hang together by what they show."""
    bands: tuple[AdjustedBand, ...]
    """Results of each band's adjustment."""
    contrast: tuple[float, ...]
    """Local contrast of the block after the adjustment, per band, before a common factor made it what it was."""
    modes: tuple[BlockMode, ...]
    """Modes that overlaps hardly determine, the largest standard deviation of all bands; none for factors from
    ratios."""
    shoulder: bool
    """True if a common shoulder keeps bright and dark grey values inside the range."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Differences between images of a pair, root mean square of single pixels of the map."""

    images: NDArray[np.int64]
    """Numbers of both, (n, 2)."""
    pixels: NDArray[np.int64]
    """Pixels that are compared, (n,)."""
    before: _Floats
    """(n, bands), grey values."""
    after: _Floats
    places: _Floats
    """Columns and rows of the cells on the map, (m, 2)."""
    before_there: _Floats
    """The same of all pairs in each cell, mean of the bands, (m,)."""
    after_there: _Floats


def even_images(cells: Cells, images: int, span: float) -> NDArray[np.bool_]:
    """Images that are all of one colour, black ones among them, (images,); `span`: range of their type."""
    low, high = np.full(images, np.inf), np.full(images, -np.inf)
    np.minimum.at(low, cells.image, cells.levels[..., 0].min(axis=1))
    np.maximum.at(high, cells.image, cells.levels[..., -1].max(axis=1))
    return np.asarray(np.isfinite(low) & (high - low < _EVEN * span))


def parts_of(cells: Cells, images: int) -> NDArray[np.int64]:
    """A number for each image (images,), the same for those that hang together."""
    shape = images, int(cells.cell.max(initial=0)) + 1
    # Graphs of SciPy 1.11 take numbers of 32 bits alone.
    at = cells.image.astype(np.int32), cells.cell.astype(np.int32)
    seen = coo_array((np.ones(len(cells)), at), shape=shape).tocsr()
    return np.asarray(connected_components(seen @ seen.T, directed=False)[1], np.int64)


def balanced(
    cells: Cells,
    sizes: NDArray[np.int64],
    limits: tuple[float, float],
    *,
    degree: int = 2,
    cameras: NDArray[np.int64] | None = None,
    fixed: int | None = None,
    factor: bool = False,
    done: Callable[[], None] = lambda: None,
) -> Balanced:
    """Tones by which images agree where they show the same ground.

    Parameters
    ----------
    cells : Cells
        Of all images.
    sizes : ndarray, shape (images, 2)
        Width and height of the images.
    limits : (float, float)
        Least and largest grey value of their type.
    degree : int
        Of the trend over an image; 0: tables alone, 1 and more: with the fall-off that all images of a camera have.
        Trends of degree 2 at least are estimated in any case; otherwise tables would take them for exposures.
    cameras : ndarray, shape (images,), optional
        Numbers of the images' cameras; one for all if left out.
    fixed : int, optional
        Number of the image that stays as it is; else the block keeps its mean and its contrast.
    factor : bool
        One factor for each image and band instead of tables, see `photoplan.radiometry.equations`.
    done : callable
        Called after each band.
    """
    shared = cells.shared
    images, of = np.unique(shared.image, return_inverse=True)
    inner = replace(shared, image=np.asarray(of, np.int64).reshape(-1))
    parts = parts_of(inner, len(images))
    place = None if fixed is None else int(np.flatnonzero(images == fixed)[0])
    inner = _thinned(inner)
    nodes = np.linspace(*limits, NODES)
    bands: list[AdjustedBand] = []
    modes: tuple[BlockMode, ...] = ()
    if factor:
        ends = np.array(limits)
        scale = factors(inner, len(images), parts, place, placed(inner, sizes[images], len(images))[1])
        raw = [[Tone(limits, (float(f * ends[0]), float(f * ends[1]))) for f in each] for each in scale]
        for _ in range(cells.bands):
            done()
    else:
        basis = Basis(max(degree, 2))
        kinds = (
            np.zeros(len(images), np.int64) if cameras is None else np.unique(cameras[images], return_inverse=True)[1]
        )
        turns, middles = placed(inner, sizes[images], len(images))

        def fitted(band: int, last: bool, ground: float, judged: bool = False) -> AdjustedBand:
            equations = replace(Band.of(inner, band, sizes[images], basis, nodes), curve_last=last)
            prior = Prior(
                basis=basis,
                nodes=nodes,
                level=_level(equations),
                cameras=kinds.reshape(-1),
                parts=parts,
                turns=turns,
                ground=ground,
            )
            return adjust(equations, Gauge(parts, place), prior, judged=judged)

        tried: dict[float, list[tuple[AdjustedBand, AdjustedBand]]] = {GROUND: [], STEEP: []}
        for band in range(cells.bands):
            for ground, fits in tried.items():
                fits.append((fitted(band, False, ground), fitted(band, True, ground)))
            done()
        evidence = [[[each.evidence for each in both] for both in fits] for fits in tried.values()]
        usual, steep = np.sum(evidence, axis=1)
        # Curves that act in the other order than assumed look like a slope: it must be likelier under both orders.
        ground = STEEP if (steep > usual).all() else GROUND
        misfits = np.log([[each.sigma for each in both] for both in tried[ground]]).mean(axis=0)
        last = bool(misfits[0] >= misfits[1] - _LESS)
        others = [first if last else second for first, second in tried[ground]]
        found = [(other, fitted(band, last, ground, judged=True)) for band, other in enumerate(others)]
        bands = [chosen for _, chosen in found]
        made = [
            [_tone(nodes, each, k, parts, degree, (int(size[0]), int(size[1]))) for each in bands]
            for k, size in enumerate(sizes[images])
        ]
        raw = [[tone for tone, _ in each] for each in made]
        modes = _modes(found, middles, sizes[images])
        if place is not None:
            # It keeps its trend: the others follow its table at the trend's mean.
            raw = [
                [_mapped(tone, partial(_linear, 0.0, mean)) for tone, (_, mean) in zip(each, made[place])]
                for each in raw
            ]
            raw[place] = [Tone(limits, limits)] * cells.bands
    seen = cells.some(np.isin(cells.image, images))
    kept = _kept(seen, images, sizes, raw)
    contrast = tuple(1.0 / kept[:, 1])
    if factor or place is not None or np.isfinite(cells.reference).any():
        kept[:] = 0.0, 1.0
    moved = [[_mapped(tone, partial(_linear, *kept[b])) for b, tone in enumerate(each)] for each in raw]
    beyond = _beyond(seen, images, sizes, moved, limits)
    if beyond:
        bent = [[_mapped(_entered(tone), partial(shoulder, limits=limits)) for tone in each] for each in moved]
        moved = [each if k == place else bent[k] for k, each in enumerate(moved)]
    sigmas = tuple(
        tuple(_sigmas(nodes, each, k, raw[k][b], moved[k][b]) for b, each in enumerate(bands)) or ((),) * cells.bands
        for k in range(len(images))
    )
    return Balanced(
        images=images,
        tones=tuple(map(tuple, moved)),
        sigmas=sigmas,
        parts=parts,
        bands=tuple(bands),
        contrast=contrast,
        modes=modes,
        shoulder=beyond,
    )


def _thinned(cells: Cells) -> Cells:
    """So many cells as an adjustment needs, drawn by lot."""
    if len(cells) <= _MOST_ROWS:
        return cells
    number, of = np.unique(cells.cell, return_inverse=True)
    taken = np.random.default_rng(0).random(len(number)) < _MOST_ROWS / len(cells)
    # Images with few cells keep all of them.
    count = np.bincount(cells.image)
    few = count < 2 * _MOST_ROWS / len(count)
    taken[of[few[cells.image]]] = True
    return cells.some(np.flatnonzero(taken[of]))


def shoulder(value: _Floats, limits: tuple[float, float]) -> _Floats:
    """Grey values bent so that they stay between limits; in the middle they are what they were."""
    low, high = limits
    room = _SHOULDER * (high - low)
    top, bottom = high - room, low + room
    out = np.where(value > top, high - room * np.exp(-np.maximum(value - top, 0.0) / room), value)
    return np.asarray(np.where(value < bottom, low + room * np.exp(-np.maximum(bottom - value, 0.0) / room), out))


def pairs_of(cells: Cells, tones: dict[int, Sequence[Tone]], sizes: NDArray[np.int64]) -> Pairs:
    """Return how images differ before and after; those without tones stay as they are."""
    a, b = neighbours(cells)
    pair, of, count = np.unique(
        np.stack([cells.image[a], cells.image[b]], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    cell = np.unique(cells.cell, return_inverse=True)[1]
    first = np.unique(cell, return_index=True)[1]
    times = np.bincount(cell[a], minlength=len(first))
    found, maps = [], []
    for values in (cells.pixels.astype(float), _values(cells, tones, sizes)):
        mean = np.empty((len(a), cells.bands))
        for at in range(0, len(a), _CHUNK):
            some = np.s_[at : at + _CHUNK]
            mean[some] = np.square(values[a[some]] - values[b[some]]).mean(axis=2)
        total = np.zeros((len(pair), cells.bands))
        np.add.at(total, of.reshape(-1), mean)
        found.append(np.sqrt(total / count[:, None]))
        maps.append(np.sqrt(np.bincount(cell[a], mean.mean(axis=1), len(first)) / np.maximum(times, 1)))
    return Pairs(
        images=pair,
        pixels=count * cells.pixels.shape[2],
        before=found[0],
        after=found[1],
        places=cells.place[first],
        before_there=maps[0],
        after_there=maps[1],
    )


def _modes(
    found: Sequence[tuple[AdjustedBand, AdjustedBand]], middles: _Floats, sizes: NDArray[np.int64]
) -> tuple[BlockMode, ...]:
    """Slopes and bends over the block, from the exposures and trends of its images where they are nearest."""
    names = ("slope east", "slope north", "bend east", "twist", "bend north")
    side = (np.arange(_PLACES) + 0.5) / _PLACES - 0.5
    part, nearest = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2), cKDTree(middles)
    uv = part * (sizes / np.hypot(*sizes.T)[:, None])[:, None]
    places = middles[:, None] + np.einsum("kni,kij->knj", uv, found[0][1].prior.turns)
    shown = nearest.query(places)[1] == np.arange(len(middles))[:, None]
    low, high = places[shown].min(axis=0), places[shown].max(axis=0)
    X, Y = ((places[shown] - (low + high) / 2) / np.maximum((high - low) / 2, 1e-9)).T
    share = np.linalg.pinv(np.stack([np.ones_like(X), X, Y, X**2, X * Y, Y**2], axis=1), rcond=1e-6)[1:]
    every: list[list[BlockMode]] = []
    for other, band in found:
        prior, width, x, at = band.prior, band.state.width, band.state.vector, 0
        terms, nodes = len(prior.basis.kinds), len(prior.nodes)
        M, camera = np.zeros((2, len(names), len(x)))
        for k, size in enumerate(sizes):
            x_, y_ = (part[shown[k]] * size + (size - 1) / 2).T
            shapes = prior.basis.at(x_, y_, (int(size[0]), int(size[1])))
            mine = share[:, at : at + len(shapes)]
            at += len(shapes)
            M[:, k * width : k * width + nodes] = mine.sum(axis=1)[:, None] * prior.level
            M[:, k * width + nodes : (k + 1) * width] = mine @ shapes
            first = len(middles) * width + prior.cameras[k] * terms
            camera[:, first : first + terms] += mine @ shapes
        start = np.tile(np.r_[prior.nodes, np.zeros(terms)], len(middles))
        value = (M - camera) @ (x - np.r_[start, np.zeros(len(x) - len(start))])
        order = np.abs(M @ (x - other.state.vector))
        # Variance components come from few images: errors have the distribution of Student, not of Gauss.
        freedom = COUNTS + max(len(middles) - 3, 0)
        sigma = np.sqrt(np.square(M @ band.errors).sum(axis=1) * freedom / (freedom - 2) + order**2)
        before = np.sqrt(np.square((M - camera) @ band.prior_errors).sum(axis=1))
        every.append([BlockMode(*each) for each in zip(names, *np.stack([value, sigma, before, order]).tolist())])
    return tuple(max(same, key=lambda mode: mode.sigma) for same in zip(*every))


def _level(band: Band) -> _Floats:
    """Weights over a table's nodes by which its departure from identity is an exposure, a part of the brightness."""
    own = band.own
    k = np.clip(np.searchsorted(band.nodes, own) - 1, 0, len(band.nodes) - 2)
    part = (own - band.nodes[k]) / band.step
    weight = np.bincount(k, 1 - part, len(band.nodes)) + np.bincount(k + 1, part, len(band.nodes))
    return np.asarray(weight / max(float(weight @ np.abs(band.nodes)), 1e-12))


def _tone(
    nodes: _Floats, found: AdjustedBand, image: int, parts: NDArray[np.int64], degree: int, size: tuple[int, int]
) -> tuple[Tone, float]:
    """The tone of an image: its table the other way, with equal steps of grey between entries; and its trend's mean."""
    prior, basis, own = found.prior, found.prior.basis, found.state.trends[image]
    x, y = (each.ravel() for each in np.meshgrid(*((np.arange(_ALONG) + 0.5) * side / _ALONG - 0.5 for side in size)))
    surfaces = basis.at(x, y, size)
    mean = float(np.exp(surfaces @ own).mean())
    terms: tuple[tuple[int, int, float], ...] = ()
    if degree:
        # Terms above the degree are those of the camera alone.
        shared = found.state.common[prior.cameras[image] * len(basis.kinds) :][: len(basis.kinds)]
        trend = np.exp(surfaces @ np.where(np.abs(basis.kinds) > degree, shared, own))
        powers = powers_of(_FITTED)
        fit = np.linalg.lstsq(surface(x, y, size, powers), trend / trend.mean() - 1, rcond=None)[0]
        terms = tuple((i, j, float(c)) for (i, j), c in zip(powers, fit))
    grey = np.linspace(nodes[0], nodes[-1], ENTRIES)
    if found.curve_last:
        # Light becomes grey again by the mean curve of the images.
        curve = tuple(found.state.tables[image].tolist()), tuple((nodes / mean).tolist())
        becomes = np.interp(
            grey, nodes, found.state.tables[parts == parts[image]].mean(axis=0) if found.relative else nodes
        )
        tone = Tone(tuple(grey.tolist()), tuple(becomes.tolist()), terms, curve)
        return (tone if terms else tone.at_mean_trend(ENTRIES)), mean
    table = Tone(tuple((found.state.tables[image] * mean).tolist()), tuple(nodes.tolist()))
    return Tone(tuple(grey.tolist()), tuple(table.table(grey).tolist()), terms), mean


def _entered(tone: Tone) -> Tone:
    """The same tone with as many entries as a bent table needs."""
    grey = np.linspace(tone.grey[0], tone.grey[-1], ENTRIES)
    return replace(tone, grey=tuple(grey.tolist()), becomes=tuple(tone.table(grey).tolist()))


def _mapped(tone: Tone, function: Callable[[_Floats], _Floats]) -> Tone:
    """A tone after which a rising function comes."""
    becomes = np.maximum.accumulate(function(np.asarray(tone.becomes)))
    return replace(tone, becomes=tuple(becomes.tolist()))


def _linear(shift: float, factor: float, value: _Floats) -> _Floats:
    return shift + factor * value


def _values(cells: Cells, tones: dict[int, Sequence[Tone]], sizes: NDArray[np.int64]) -> _Floats:
    """The cells' pixels after the tones, (m, bands, pixels)."""
    return _toned(cells, cells.pixels, tones, sizes)


def _toned(
    cells: Cells, values: NDArray[np.float32], tones: dict[int, Sequence[Tone]], sizes: NDArray[np.int64]
) -> _Floats:
    """Grey values of the cells' pixels, or of their middle, after the tones, (m, bands, n)."""
    out = values.astype(float)
    places = cells.uv[:, 1:] if values is cells.pixels else cells.uv[:, :1]
    order = np.argsort(cells.image, kind="stable")
    starts = np.searchsorted(cells.image[order], np.arange(len(sizes) + 1))
    for image, tone in tones.items():
        rows = order[starts[image] : starts[image + 1]]
        (x, y), size = np.moveaxis(places[rows], -1, 0), (int(sizes[image][0]), int(sizes[image][1]))
        for band, each in enumerate(tone):
            out[rows, band] = each.of(out[rows, band], x, y, size)
    return out


def _kept(
    cells: Cells, images: NDArray[np.int64], sizes: NDArray[np.int64], tones: Sequence[Sequence[Tone]]
) -> _Floats:
    """For each band the shift and the factor by which the block keeps its mean and its local contrast, (bands, 2)."""
    low, high = cells.levels.shape[2] // 5, -1 - cells.levels.shape[2] // 5
    after = _toned(cells, cells.levels, dict(zip(images.tolist(), tones)), sizes)
    before = cells.levels.astype(float)
    spread = [(each[..., high] - each[..., low]).sum(axis=0) for each in (before, after)]
    factor = np.where(spread[1] > 0, spread[0] / np.maximum(spread[1], 1e-12), 1.0)
    shift = before.mean(axis=(0, 2)) - factor * after.mean(axis=(0, 2))
    return np.stack([shift, factor], axis=1)


def _beyond(
    cells: Cells,
    images: NDArray[np.int64],
    sizes: NDArray[np.int64],
    tones: Sequence[Sequence[Tone]],
    limits: tuple[float, float],
) -> bool:
    """Return whether more pixels leave the range than may."""
    after = _values(cells, dict(zip(images.tolist(), tones)), sizes)
    inside = (cells.pixels > limits[0]) & (cells.pixels < limits[1])
    beyond = inside & ((after <= limits[0]) | (after >= limits[1]))
    return bool(beyond.mean(axis=(0, 2)).max(initial=0.0) > _BEYOND)


def _sigmas(nodes: _Floats, found: AdjustedBand, image: int, before: Tone, after: Tone) -> tuple[float, ...]:
    """Standard deviations of a table's entries, scaled by what came after the adjustment."""
    light, becomes = np.asarray(before.becomes), np.asarray(after.becomes)
    shown = np.interp(light, nodes, found.sigmas.tables[image])
    if any(after.curve):
        # Errors of the curve are those of grey values; its entries are light.
        shown = shown / np.interp(light, nodes, np.gradient(found.state.tables[image], nodes))
    return tuple((shown * np.gradient(becomes, np.asarray(after.grey))).tolist())
