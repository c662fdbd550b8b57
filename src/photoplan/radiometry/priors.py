"""Prior of colour balance: what is assumed of exposures, of the fall-off and of the images' own trends.

Overlaps do not determine a brightness that changes over the whole block as a polynomial of the degree of the trends:
exposures and trends of the images follow it, and every overlap stays equal. Such modes are held by this prior, a
hierarchical one whose variance components are estimated from the overlaps:

- the exposure of an image differs from that of the block, independently of its neighbours;
- the fall-off is one for all images of a camera: it is radial, with small departures from symmetry;
- a slope towards one direction of the ground (sun, haze) may be common to all images;
- what an image's trend has beside both is independent of its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from photoplan.radiometry.cells import Cells
from photoplan.radiometry.tone import powers_of, surface

_Floats = NDArray[np.float64]

#: Standard deviations of a table's bend between two intervals, parts of the range of grey values, and of its slope.
_BEND, _SLOPE = 0.02, 1.0
#: Initial standard deviations of the variance components: exposure, an image's own terms of degree 1 to 4; parts of the
#: brightness, terms at the corner of the image. They count as so many observations.
_FIRST, COUNTS = (0.10, 0.03, 0.02, 0.01, 0.01), 4.0
_BOUNDS = ((0.01, 1.0), (0.002, 0.3), (0.002, 0.3), (0.002, 0.2), (0.002, 0.2))
#: Standard deviations of the fall-off's radial terms r², r⁴, r⁶, of its other terms of degree 1 to 4, of the slope over
#: the ground that all images have, and of an image's departure from radial terms above its own degree.
_RADIAL, _OTHER, GROUND, _TIED = (0.5, 0.3, 0.2), (0.01, 0.01, 0.005, 0.005), 0.03, 0.002
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
        weak = np.diag(np.r_[np.full(2, 1 / GROUND), np.full(len(loose) - 2, 1 / _LEVEL)])
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
