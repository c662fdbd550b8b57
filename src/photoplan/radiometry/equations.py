"""Equations of one band: the same ground has its grey value in every image, quantile by quantile.

An image shows ground of grey value G as grey = F(G · v), or F(G) · v if its curve acts before the fall-off, as in a
print that was scanned unevenly. F is a table, the image's own; v, near 1, changes slowly over the image: fall-off,
haze, the angles of sun and view. Its logarithm is a polynomial, so that the product of two such causes is one again.
A quantile of an image in a cell is an observation of that; all images of a cell have the G of their quantiles in
common, which is an unknown as well, and is taken out of the equations before they are solved. Errors are those of the
grey values that images have: if tables were asked to make images equal, they would do so by taking their contrast away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from photoplan.radiometry.cells import Cells
from photoplan.radiometry.priors import Basis

_Floats = NDArray[np.float64]

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
    """(k,): hyperparameters of the prior, which no observation contains; see `photoplan.radiometry.priors`."""

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
    """(n, terms): the trend's basis, see `photoplan.radiometry.priors.Basis`."""
    nodes: _Floats
    """Grey values G of the tables, at equal steps."""
    reference: _Floats
    """Mean G of each group's cell as a reference has it, (groups,); NaN where there is none."""
    curve_last: bool = True
    """Whether F acts after v."""

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
        """Whether there is a reference."""
        return bool(np.isfinite(self.reference).any())

    def beside_reference(self, state: BandState) -> _Floats:
        """What the cell of each group lacks to its reference in the mean, (groups,); NaN where there is none."""
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
        """What the images show (n,), and its derivatives by G (n,)."""
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
