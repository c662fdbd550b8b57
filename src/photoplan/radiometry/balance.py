"""From what images show of the same ground to a tone for each of their bands, and what that brings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from photoplan.radiometry.adjust import AdjustedBand, Gauge, adjust
from photoplan.radiometry.cells import Cells, neighbours
from photoplan.radiometry.equations import Band
from photoplan.radiometry.priors import COUNTS, Basis, Prior, placed
from photoplan.radiometry.ratio import factors
from photoplan.radiometry.tone import Tone, powers_of, surface

_Floats = NDArray[np.float64]

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
    """Of the exposures and trends that were found."""
    sigma: float
    """Standard deviation of what the balanced images still have of it."""
    prior: float
    """Standard deviation before overlaps were compared."""
    order: float
    """What it differs, contained in `sigma`, if curves and fall-off act in the other order."""

    @property
    def held(self) -> bool:
        """Whether it is the prior that determines it, not the overlaps."""
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
    """What each band's adjustment found."""
    contrast: tuple[float, ...]
    """Local contrast of the block after the adjustment, per band, before a common factor made it what it was."""
    modes: tuple[BlockMode, ...]
    """What overlaps hardly determine, the largest standard deviation of all bands; none for factors from ratios."""
    shoulder: bool
    """Whether a common shoulder keeps bright and dark grey values inside the range."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """How much images of a pair differ, root mean square of single pixels of the map."""

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
        One factor for each image and band instead of tables, see `photoplan.radiometry.ratio`.
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
    found: list[tuple[AdjustedBand, AdjustedBand]] = []
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

        def fitted(band: int, last: bool, judged: bool) -> AdjustedBand:
            equations = replace(Band.of(inner, band, sizes[images], basis, nodes), curve_last=last)
            prior = Prior(
                basis=basis, nodes=nodes, level=_level(equations), cameras=kinds.reshape(-1), parts=parts, turns=turns
            )
            return adjust(equations, Gauge(parts, place), prior, judged=judged)

        for band in range(cells.bands):
            found.append((fitted(band, False, False), fitted(band, True, True)))
            done()
        misfits = np.log([[each.sigma for each in both] for both in found]).mean(axis=0)
        if misfits[0] < misfits[1] - _LESS:
            found = [(last, fitted(band, False, True)) for band, (_, last) in enumerate(found)]
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
    """How images differ before and after; those without tones stay as they are."""
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
    """Whether more pixels leave the range than may."""
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
