"""Equations of colour balance: cells, priors, ratios, solution."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_array, diags, hstack
from scipy.sparse.linalg import SuperLU, lsqr, splu

from photoplan.codec import storable
from photoplan.radiometry.tone import powers_of, surface

#: Side of a cell, pixels of the map.
SIDE = 16
#: Quantiles and single pixels that are kept of each image in a cell.
LEVELS, PIXELS = 12, 8
#: Cells along the side of what may change at once, a field for instance: their errors are not independent.
BLOCK = 8
#: An image counts in a cell if it shows this part of it, and all of them together this one.
_SHOWN, _COMMON = 0.5, 0.25


@storable
@dataclass(frozen=True, eq=False)
class Cells:
    """Rows of images in cells; rows of one cell hold the same pixels of the map."""

    cell: NDArray[np.int64]
    """Number of the cell, (m,)."""
    block: NDArray[np.int64]
    """Number of the block of `BLOCK` × `BLOCK` cells that it lies in, (m,)."""
    image: NDArray[np.int64]
    """Number of the image, (m,)."""
    uv: NDArray[np.float32]
    """Column and row in the image of the cell's middle and of the places of `pixels`, (m, 1 + PIXELS, 2)."""
    place: NDArray[np.float64]
    """Column and row of the cell's middle on the map, (m, 2)."""
    share: NDArray[np.float64]
    """Part of the cell that is compared, (m,)."""
    levels: NDArray[np.float32]
    """Quantiles of the grey values, the cumulative histogram read the other way, (m, bands, LEVELS)."""
    pixels: NDArray[np.float32]
    """Grey values of some places, (m, bands, PIXELS)."""
    reference: NDArray[np.float32]
    """Mean of the reference over what is compared, (m, bands); NaN where there is none."""

    def __len__(self) -> int:
        return len(self.cell)

    def some(self, rows: NDArray[Any]) -> Cells:
        """Some rows; itself, if these are all."""
        if rows.dtype == np.bool_ and rows.all():
            return self
        return Cells(*(getattr(self, each.name)[rows] for each in fields(self)))

    @classmethod
    def joined(cls, parts: Iterable[Cells]) -> Cells:
        """All rows of many, sorted by cell."""
        every = list(parts)

        def whole(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(part, name) for part in every])

        order = np.lexsort((whole("image"), whole("cell")))
        return cls(*(whole(each.name)[order] for each in fields(cls)))

    @property
    def shared(self) -> Cells:
        """The rows of cells that more than one image shows."""
        _, inverse, count = np.unique(self.cell, return_inverse=True, return_counts=True)
        return self.some(count[inverse] > 1)

    @property
    def bands(self) -> int:
        """Number of bands."""
        return int(self.levels.shape[1])


def cells_of(
    values: NDArray[np.float32],
    valid: NDArray[np.bool_],
    images: NDArray[np.int64],
    first: int = 0,
    reference: tuple[NDArray[np.float32], NDArray[np.bool_]] | None = None,
) -> Cells:
    """Cells of a part of the map, in squares of `SIDE` pixels from its corner.

    Parameters
    ----------
    values : ndarray, shape (images, bands, height, width)
    valid : ndarray of bool, shape (images, height, width)
        Where an image shows the ground and nothing hides it.
    images : ndarray, shape (images,)
        Their numbers.
    first : int
        Number of the first cell.
    reference : (ndarray, shape (bands, height, width), ndarray of bool, shape (height, width)), optional
        What the mean of the images is to be, and where it is known.

    Returns
    -------
    Cells
        `uv` and `place` are columns and rows of the part, not yet of images and map.
    """
    height, width = valid.shape[1:]
    bands = values.shape[1]
    kept: dict[str, list[Any]] = {each.name: [] for each in fields(Cells)}
    corners = [(row, col) for row in range(0, height, SIDE) for col in range(0, width, SIDE)]
    for number, (row, col) in enumerate(corners, first):
        at = np.s_[..., row : row + SIDE, col : col + SIDE]
        seen = valid[at].reshape(len(images), -1)
        rows = _comparable(seen)
        if not len(rows):
            continue
        common = np.flatnonzero(seen[rows].all(axis=0))
        grey = values[at].reshape(*values.shape[:2], -1)[rows][..., common]
        some = np.linspace(0, len(common) - 1, PIXELS).astype(int)
        down, right = np.divmod(common[some], valid[at].shape[2])
        middle = (SIDE - 1) / 2
        places = np.stack([np.r_[middle, right] + col, np.r_[middle, down] + row], axis=1)
        known = np.full(bands, np.nan)
        if reference is not None:
            there = reference[1][at].ravel()[common]
            if there.mean() >= _SHOWN:
                known = reference[0][at].reshape(bands, -1)[:, common[there]].mean(axis=1)
        kept["cell"] += [number] * len(rows)
        kept["block"] += [first + row // (BLOCK * SIDE) * width + col // (BLOCK * SIDE)] * len(rows)
        kept["image"] += images[rows].tolist()
        kept["uv"] += [places] * len(rows)
        kept["share"] += [len(common) / SIDE**2] * len(rows)
        kept["levels"].append(np.quantile(grey, (np.arange(LEVELS) + 0.5) / LEVELS, axis=-1).transpose(1, 2, 0))
        kept["pixels"].append(grey[..., some])
        kept["reference"] += [known] * len(rows)
    none = np.zeros((0, bands, LEVELS)), np.zeros((0, bands, PIXELS))
    return Cells(
        cell=np.array(kept["cell"], np.int64),
        block=np.array(kept["block"], np.int64),
        image=np.array(kept["image"], np.int64),
        uv=np.array(kept["uv"], np.float32).reshape(-1, 1 + PIXELS, 2),
        place=np.array(kept["uv"], float).reshape(-1, 1 + PIXELS, 2)[:, 0],
        share=np.array(kept["share"], float),
        levels=np.concatenate([none[0], *kept["levels"]]).astype(np.float32),
        pixels=np.concatenate([none[1], *kept["pixels"]]).astype(np.float32),
        reference=np.array(kept["reference"], np.float32).reshape(-1, bands),
    )


def neighbours(cells: Cells) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of all pairs of images in one cell, the one with the lower number first; `cells` are sorted."""
    first = []
    for apart in range(1, len(cells)):
        near = np.flatnonzero(cells.cell[apart:] == cells.cell[:-apart])
        if not len(near):
            break
        first.append(np.stack([near, near + apart]))
    both = np.concatenate([np.empty((2, 0), np.int64), *first], axis=1)
    return both[0], both[1]


def _comparable(seen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Images whose common part of a cell is large enough; those that show least of it are left out for that."""
    shown = seen.sum(axis=1)
    rows = np.flatnonzero(shown >= _SHOWN * SIDE**2)
    while len(rows) > 1 and seen[rows].all(axis=0).sum() < _COMMON * SIDE**2:
        rows = np.delete(rows, np.argmin(shown[rows]))
    return np.asarray(rows, np.int64)


_Floats = NDArray[np.float64]

#: Standard deviations of a table's bend between two intervals, parts of the range of grey values, and of its slope.
_BEND, _SLOPE = 0.02, 1.0
#: Initial standard deviations of the variance components: exposure, an image's own terms of degree 1 to 4; parts of the
#: brightness, terms at the corner of the image. They count as so many observations.
_FIRST, COUNTS = (0.10, 0.03, 0.02, 0.01, 0.01), 4.0
_BOUNDS = ((0.01, 1.0), (0.002, 0.3), (0.002, 0.3), (0.002, 0.2), (0.002, 0.2))
#: Standard deviations of the fall-off's radial terms r², r⁴, r⁶, of its other terms of degree 1 to 4, and of an image's
#: departure from radial terms above its own degree.
_RADIAL, _OTHER, _TIED = (0.5, 0.3, 0.2), (0.01, 0.01, 0.005, 0.005), 0.002
#: Standard deviations of the slope over the ground that all images have: usual, and where the sun brightens one side.
GROUND, STEEP = 0.03, 0.2
#: Of the mean exposure beside the gauge.
_LEVEL = 1.0


@dataclass(frozen=True, eq=False)
class Basis:
    """Terms of a trend's logarithm: polynomials uⁱ vʲ up to a degree, and the radial r⁴ and r⁶ if that is lower."""

    degree: int
    powers: tuple[tuple[int, int], ...] = field(init=False)
    """Powers (i, j) of all polynomials that occur."""
    kinds: tuple[int, ...] = field(init=False)
    """For each term its degree, or minus the degree of a radial one, (terms,)."""
    C: _Floats = field(init=False)
    """Coefficients of the polynomials for those of the terms, (polynomials, terms)."""

    def __post_init__(self) -> None:
        own, every = powers_of(self.degree), powers_of(6)
        rows = [np.eye(len(every))[every.index(power)] for power in own]
        kinds = [i + j for i, j in own]
        for half in (2, 3):
            if 2 * half > self.degree:
                rows.append(_radial(every, half))
                kinds.append(-2 * half)
        C = np.array(rows).T
        used = np.asarray(C.any(axis=1))
        object.__setattr__(self, "powers", tuple(p for p, k in zip(every, used) if k))
        object.__setattr__(self, "kinds", tuple(kinds))
        object.__setattr__(self, "C", C[used])

    def at(self, x: NDArray[Any], y: NDArray[Any], size: tuple[int, int]) -> _Floats:
        """Return the terms at columns and rows of an image, (n, terms)."""
        return surface(x, y, size, self.powers) @ self.C

    def radial(self, half: int) -> _Floats:
        """Return the coefficients (terms,) of r² raised to `half`."""
        if -2 * half in self.kinds:
            return np.array([float(kind == -2 * half) for kind in self.kinds])
        return np.asarray(np.linalg.lstsq(self.C, _radial(self.powers, half), rcond=None)[0])


def _radial(powers: tuple[tuple[int, int], ...], half: int) -> _Floats:
    """Coefficients of (u² + v²) raised to `half`."""
    return np.array([float(comb(half, i // 2)) * (i + j == 2 * half and i % 2 == 0) for i, j in powers])


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior of one band as equations of weight one, P x = wanted, and which rows belong to which variance component."""

    basis: Basis
    nodes: _Floats
    level: _Floats
    """(nodes,): weights by which a table's departure from identity becomes an exposure, a part of the brightness."""
    cameras: NDArray[np.int64]
    """(images,)."""
    parts: NDArray[np.int64]
    """(images,): connected parts of the block."""
    turns: _Floats
    """(images, 2, 2): slopes over the image that a slope over the ground (east, north) becomes."""
    sigmas: tuple[float, ...] = _FIRST
    """Standard deviations of the exposure and of the images' own terms of degree 1 to 4."""
    ground: float = GROUND
    """Standard deviation of the slope over the ground that all images have."""

    @property
    def common(self) -> int:
        """Number of hyperparameters: fall-off of each camera, slope over the ground, mean exposure of each part."""
        return (int(self.cameras.max()) + 1) * len(self.basis.kinds) + 2 + int(self.parts.max()) + 1

    def rows(self) -> tuple[csr_array, _Floats, NDArray[np.int64]]:
        """Return P, wanted, and the variance component of each row (0 exposure, 1 to 4 own terms, -1 fixed)."""
        terms, nodes, images = len(self.basis.kinds), len(self.nodes), len(self.cameras)
        width, step = nodes + terms, float(self.nodes[1] - self.nodes[0])
        first = images * width
        slope_at = first + (int(self.cameras.max()) + 1) * terms
        level_at = slope_at + 2
        bend = np.diff(np.eye(nodes), 2, axis=0) / (_BEND * np.ptp(self.nodes))
        slope = np.diff(np.eye(nodes), axis=0) / (_SLOPE * step)
        blocks: list[tuple[NDArray[np.int64], _Floats, _Floats, NDArray[np.int64]]] = []
        table = np.concatenate([bend, slope])
        wanted = np.r_[np.zeros(nodes - 2), np.full(nodes - 1, 1.0 / _SLOPE)]
        own = np.array([_TIED if kind < 0 else self.sigmas[kind] for kind in self.basis.kinds])
        component = np.array([max(kind, -1) for kind in self.basis.kinds])
        linear = [k for k, kind in enumerate(self.basis.kinds) if kind == 1]
        for image, (camera, part) in enumerate(zip(self.cameras.tolist(), self.parts.tolist())):
            at = image * width + np.arange(nodes)
            blocks.append((at, table, wanted, np.full(len(table), -1)))
            exposure = np.r_[self.level, -1.0][None] / self.sigmas[0]
            blocks.append(
                (np.r_[at, level_at + part], exposure, exposure[0, :-1] @ self.nodes + np.zeros(1), np.zeros(1, int))
            )
            tie = np.concatenate([np.eye(terms), -np.eye(terms), np.zeros((terms, 2))], axis=1)
            tie[linear, 2 * terms :] = -self.turns[image]
            columns = np.r_[
                image * width + nodes + np.arange(terms),
                first + camera * terms + np.arange(terms),
                slope_at,
                slope_at + 1,
            ]
            blocks.append((columns, tie / own[:, None], np.zeros(terms), component))
        known = self._fall_off()
        for camera in range(int(self.cameras.max()) + 1):
            blocks.append((first + camera * terms + np.arange(terms), known, np.zeros(terms), np.full(terms, -1)))
        loose = np.arange(slope_at, first + self.common)
        weak = np.diag(np.r_[np.full(2, 1 / self.ground), np.full(len(loose) - 2, 1 / _LEVEL)])
        blocks.append((loose, weak, np.zeros(len(loose)), np.full(len(loose), -1)))
        columns = np.concatenate([np.tile(at, len(A)) for at, A, _, _ in blocks])
        counts = np.concatenate([np.full(len(A), len(at)) for at, A, _, _ in blocks])
        values = np.concatenate([A.ravel() for _, A, _, _ in blocks])
        starts = np.r_[0, np.cumsum(counts)]
        P = csr_array(
            (values, columns.astype(np.int32), starts.astype(np.int32)), shape=(len(counts), first + self.common)
        )
        P.eliminate_zeros()
        return P, np.concatenate([each for _, _, each, _ in blocks]), np.concatenate([each for *_, each in blocks])

    def _fall_off(self) -> _Floats:
        """A square root of the fall-off's inverse covariance, (terms, terms)."""
        other = [_TIED if kind < 0 else _OTHER[kind - 1] for kind in self.basis.kinds]
        covariance = np.diag(np.square(other))
        for half, sigma in enumerate(_RADIAL, 1):
            covariance += sigma**2 * np.outer(self.basis.radial(half), self.basis.radial(half))
        return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T)

    @property
    def log_density(self) -> float:
        """Logarithm of the density of the variance components before observations, but for a constant."""
        s = np.array(self.sigmas)
        return float(-COUNTS * (np.log(s) + np.square(_FIRST / s) / 2).sum())

    def updated(self, squares: _Floats, counts: _Floats) -> tuple[float, ...]:
        """Return standard deviations from the expected squares of the rows of each component."""
        found = []
        for sigma, first, bounds, square, count in zip(self.sigmas, _FIRST, _BOUNDS, squares, counts):
            variance = (COUNTS * first**2 + square * sigma**2) / (COUNTS + count)
            found.append(float(np.clip(np.sqrt(variance), *bounds)))
        return tuple(found)


def placed(cells: Cells, sizes: NDArray[np.int64], images: int) -> tuple[_Floats, _Floats]:
    """Return where images lie on the map.

    First the slopes over u and v that a unit slope over the ground (column, -row of the map) becomes, (images, 2, 2),
    then their middles, (images, 2).

    The ground's unit is the mean half diagonal of the images on the map.
    """
    found, middles = np.zeros((images, 2, 2)), np.zeros((images, 2))
    for image in range(images):
        rows = cells.image == image
        half = np.hypot(*sizes[image]) / 2
        uv = (cells.uv[rows, 0].astype(float) - (sizes[image] - 1) / 2) / half
        place = cells.place[rows] * [1.0, -1.0]
        middles[image] = place.mean(axis=0)
        if np.linalg.matrix_rank(uv - uv.mean(axis=0), tol=1e-3) == 2:
            found[image] = np.linalg.lstsq(uv - uv.mean(axis=0), place - middles[image], rcond=None)[0]
            middles[image] -= uv.mean(axis=0) @ found[image]
    scale = np.sqrt(np.abs(np.linalg.det(found)))
    unit = float(scale[scale > 0].mean()) if (scale > 0).any() else 1.0
    return found / unit, (middles - middles.mean(axis=0)) / unit


#: Initial standard deviations of exposures and of the factor of a pair, parts of the brightness; what they count as.
_FIRST_RATIO, _COUNTS = (0.10, 0.01), 2.0
#: Least standard deviations.
_LEAST = (0.01, 0.0005)
_ROUNDS = 30


def factors(
    cells: Cells,
    images: int,
    parts: NDArray[np.int64],
    fixed: int | None = None,
    middles: _Floats | None = None,
) -> _Floats:
    """Factors by which images agree, (images, bands).

    For two images, the second of which is fixed, the factor of the first is f = 1/n Σ M₂ₖ / M₁ₖ, with the means M of
    both in n cells. For more images the logarithms of the factors of all pairs are adjusted, each with the weight n.
    A slope of brightness that all images have would accumulate from pair to pair. It is an unknown of its own, with a
    standard deviation a priori; so is the exposure of each image, whose standard deviation comes from the overlaps.
    """
    mean = np.maximum(cells.levels.mean(axis=2, dtype=float), 1e-6)
    first, second = neighbours(cells)
    ordered = np.stack([cells.image[first], cells.image[second]], axis=1)
    pair, of, count = np.unique(ordered, axis=0, return_inverse=True, return_counts=True)
    total = np.zeros((len(pair), mean.shape[1]))
    np.add.at(total, of.reshape(-1), mean[second] / mean[first])
    if fixed is not None:
        # The formula is that of the image that is changed: the other way round where the first is fixed.
        away = np.zeros_like(total)
        np.add.at(away, of.reshape(-1), mean[first] / mean[second])
        total = np.where((pair[:, 0] == fixed)[:, None], count[:, None] ** 2 / away, total)
    root = np.sqrt(count)
    rows = np.repeat(np.arange(len(pair)), 2)
    A = csr_array((np.outer(root, [1.0, -1.0]).ravel(), (rows, pair.ravel())), shape=(len(pair), images))
    y = np.log(total / count[:, None]) * root[:, None]
    if images == 2:
        found = np.stack([lsqr(A, band, atol=1e-12, btol=1e-12)[0] for band in y.T], axis=1)
    else:
        away = np.zeros((images, 2)) if middles is None else middles
        whole = csr_array(hstack([A, csr_array(A @ away)]))
        found = np.stack([_adjusted(whole, band, images) for band in y.T], axis=1)
    for part in np.unique(parts):
        members = np.flatnonzero(parts == part)
        found[members] -= found[fixed] if fixed in members else found[members].mean(axis=0)
    return np.asarray(np.exp(found))


def _adjusted(A: csr_array, y: _Floats, images: int) -> _Floats:
    """Logarithms of the factors (images,) with prior and variance components; rows of A have the pairs' weights."""
    # Both variance components by expectation and maximisation, with the whole inverse: its unknowns are few.
    exposure, pair = _FIRST_RATIO
    scale = float(np.sqrt(A[:, :images].power(2).sum() / (2 * len(y))))
    N, g = (A.T @ A).toarray(), A.T @ y
    x = np.zeros(N.shape[0])
    for _ in range(_ROUNDS):
        known = np.r_[np.full(images, exposure**-2), np.full(2, GROUND**-2)]
        C = np.linalg.inv(N / (scale * pair) ** 2 + np.diag(known))
        x = C @ g / (scale * pair) ** 2
        left = float(np.square(y - A @ x).sum() + (N * C).sum()) / scale**2
        own = float(np.square(x[:images]).sum() + np.trace(C[:images, :images]))
        exposure = max(float(np.sqrt((_COUNTS * _FIRST_RATIO[0] ** 2 + own) / (_COUNTS + images))), _LEAST[0])
        pair = max(float(np.sqrt((_COUNTS * _FIRST_RATIO[1] ** 2 + left) / (_COUNTS + len(y)))), _LEAST[1])
    return x[:images]


#: What is added to the diagonal, a part of it: conditions determine what equations leave open.
_RIDGE = 1e-9
#: Most turns of an iteration, and the part of a solution that its last one changes.
_TURNS, _LEFT = 60, 0.001


@dataclass(frozen=True, eq=False)
class Solved:
    """Equations N x = g, factored, under conditions H x = held."""

    factor: SuperLU
    H: _Floats
    back: _Floats
    """Matrix that fulfils the conditions if they lack one, N⁻¹ Hᵀ (H N⁻¹ Hᵀ)⁻¹."""

    @classmethod
    def of(cls, N: csr_array, H: _Floats) -> Solved:
        """Factor equations with a positive definite matrix."""
        whole = csc_matrix(N + diags(_RIDGE * N.diagonal()))
        # SciPy 1.11 factors matrices with places of 32 bits alone.
        whole.indices, whole.indptr = (each.astype(np.intc, copy=False) for each in (whole.indices, whole.indptr))
        # An order that fills little: a band would be as wide as the block, and its cost an image grow with that.
        factor = splu(whole, permc_spec="COLAMD", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        if not len(H):
            return cls(factor, H, H.T)
        W = factor.solve(np.ascontiguousarray(H.T))
        return cls(factor, H, np.linalg.solve(H @ W, W.T).T)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of N where the conditions leave the unknowns free, but for a constant."""
        whole = float(np.log(np.abs(self.factor.U.diagonal())).sum())
        if not len(self.H):
            return whole
        return whole + float(np.linalg.slogdet(self.H @ self.factor.solve(np.ascontiguousarray(self.H.T)))[1])

    def step(self, g: _Floats, missing: _Floats | float) -> _Floats:
        """Solutions for right sides (unknowns,) or (unknowns, k) that fulfil the conditions."""
        free = self.factor.solve(np.ascontiguousarray(g))
        return np.asarray(free + self.back @ (missing - self.H @ free)) if len(self.H) else np.asarray(free)

    def without(self, part: csr_array, whole: csr_array, g: _Floats) -> _Floats:
        """Solution of (whole − part) x = g under H x = 0, where `whole` are the equations that were factored.

        Conjugate gradients with the factored equations as preconditioner (Gould, Hribar & Nocedal 2001): the more the
        part had to say, the more turns.
        """
        x, left = np.zeros_like(g), g
        z = self.step(left, 0.0)
        way, size = z, float(left @ z)
        for _ in range(_TURNS):
            pushed = whole @ way - part @ way
            curve = float(way @ pushed)
            if not (curve > 0 and size > 0):
                break
            x, left = x + size / curve * way, left - size / curve * pushed
            if size / curve * np.linalg.norm(way) < _LEFT * np.linalg.norm(x):
                break
            z = self.step(left, 0.0)
            before, size = size, float(left @ z)
            way = z + size / before * way
        return x


#: Largest logarithm of a trend while it is being found.
_MOST = 1.5


@dataclass(frozen=True, eq=False)
class BandState:
    """Unknowns of all images of one band."""

    tables: _Floats
    """(images, nodes): F at the nodes."""
    trends: _Floats
    """(images, terms): coefficients of the logarithm of v."""
    ground: _Floats
    """(groups,): G of what the images of a cell have in common."""
    common: _Floats
    """(k,): hyperparameters of the prior, which no observation contains; see `photoplan.radiometry.equations`."""

    @property
    def width(self) -> int:
        """Unknowns of an image."""
        return self.tables.shape[1] + self.trends.shape[1]

    @property
    def vector(self) -> _Floats:
        """Unknowns of all images, then the common ones, (images · width + k,)."""
        return np.concatenate([np.concatenate([self.tables, self.trends], axis=1).ravel(), self.common])

    def with_vector(self, vector: _Floats) -> BandState:
        """The same ground with other images."""
        count, nodes = self.tables.size + self.trends.size, self.tables.shape[1]
        each = vector[:count].reshape(len(self.tables), self.width)
        return replace(self, tables=each[:, :nodes], trends=each[:, nodes:], common=vector[count:])


@dataclass(frozen=True, eq=False)
class Band:
    """The observations of one band: one for every quantile of every image in every cell."""

    image: NDArray[np.int64]
    """(n,)."""
    group: NDArray[np.int64]
    """Cell and quantile, (n,)."""
    cell: NDArray[np.int64]
    """(n,)."""
    block: NDArray[np.int64]
    """(n,): observations of one block may err together."""
    grey: _Floats
    """(n,)."""
    weight: _Floats
    """(n,): quantiles of a cell together count as two observations, a part of a cell less."""
    surfaces: _Floats
    """(n, terms): the trend's basis, see `photoplan.radiometry.equations.Basis`."""
    nodes: _Floats
    """Grey values G of the tables, at equal steps."""
    reference: _Floats
    """Mean G of each group's cell as a reference has it, (groups,); NaN where there is none."""
    curve_last: bool = True
    """True if F acts after v."""

    @classmethod
    def of(cls, cells: Cells, band: int, sizes: NDArray[np.int64], basis: Basis, nodes: _Floats) -> Band:
        """Observations of shared cells; `sizes` (images, 2): width and height."""
        many = cells.levels.shape[2]
        _, first, cell = np.unique(cells.cell, return_index=True, return_inverse=True)
        surfaces = np.zeros((len(cells), len(basis.kinds)))
        for size in np.unique(sizes, axis=0):
            rows = (sizes[cells.image] == size).all(axis=1)
            surfaces[rows] = basis.at(cells.uv[rows, 0, 0], cells.uv[rows, 0, 1], (int(size[0]), int(size[1])))
        return cls(
            image=np.repeat(cells.image, many),
            group=(cell[:, None] * many + np.arange(many)).ravel(),
            cell=np.repeat(cell, many),
            block=np.repeat(np.unique(cells.block, return_inverse=True)[1], many),
            grey=cells.levels[:, band].astype(float).ravel(),
            weight=np.repeat(cells.share * 2.0 / many, many),
            surfaces=np.repeat(surfaces, many, axis=0),
            nodes=nodes,
            reference=np.repeat(cells.reference[first, band].astype(float), many),
        )

    def some(self, rows: NDArray[np.int64]) -> Band:
        """Some observations."""
        names = ("image", "group", "cell", "block", "grey", "weight", "surfaces")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @property
    def step(self) -> float:
        """Between two nodes."""
        return float(self.nodes[1] - self.nodes[0])

    @property
    def referred(self) -> bool:
        """Return whether there is a reference."""
        return bool(np.isfinite(self.reference).any())

    def beside_reference(self, state: BandState) -> _Floats:
        """Return the mean difference of the cell of each group from its reference, (groups,); NaN if there is none."""
        group_cell = np.empty(len(self.reference), np.int64)
        group_cell[self.group] = self.cell
        mean = np.bincount(group_cell, state.ground) / np.bincount(group_cell)
        return np.asarray(self.reference - mean[group_cell])

    @property
    def own(self) -> _Floats:
        """Mean grey value of the images of each group, (groups,)."""
        return np.asarray(np.bincount(self.group, self.grey) / np.bincount(self.group))

    def start(self, images: int, common: int) -> BandState:
        """All images show what they have in the mean."""
        trends = np.zeros((images, self.surfaces.shape[1]))
        return BandState(np.tile(self.nodes, (images, 1)), trends, self.own, np.zeros(common))

    def predicted(self, state: BandState) -> tuple[_Floats, _Floats]:
        """Return what the images show (n,), and its derivatives by G (n,)."""
        v, k, part = self._at(state)
        low, high = state.tables[self.image, k], state.tables[self.image, k + 1]
        shown = low + part * (high - low)
        return shown if self.curve_last else shown * v, (high - low) / self.step * v

    def _at(self, state: BandState) -> tuple[_Floats, NDArray[np.int64], _Floats]:
        """Trends, and where tables are asked: number of the node before, and part of the way to the next."""
        v = np.exp(np.clip((self.surfaces * state.trends[self.image]).sum(axis=1), -_MOST, _MOST))
        ground = state.ground[self.group]
        at = ((ground * v if self.curve_last else ground) - self.nodes[0]) / self.step
        k = np.clip(np.floor(at), 0, len(self.nodes) - 2).astype(np.int64)
        return v, k, at - k

    def design(self, state: BandState) -> csr_array:
        """Derivatives of what the images show by their unknowns, (n, unknowns)."""
        v, k, part = self._at(state)
        low, high = state.tables[self.image, k], state.tables[self.image, k + 1]
        if self.curve_last:
            by_trend, v = (high - low) / self.step * state.ground[self.group] * v, np.ones_like(v)
        else:
            by_trend = (low + part * (high - low)) * v
        values = np.column_stack([(1 - part) * v, part * v, by_trend[:, None] * self.surfaces])
        first = self.image * state.width
        terms = len(self.nodes) + np.arange(self.surfaces.shape[1])
        columns = np.column_stack([first + k, first + k + 1, first[:, None] + terms]).astype(np.int32)
        starts = np.arange(0, values.size + 1, values.shape[1], dtype=np.int32)
        shape = len(self.grey), state.vector.size
        return csr_array((values.ravel(), columns.ravel(), starts), shape=shape)
