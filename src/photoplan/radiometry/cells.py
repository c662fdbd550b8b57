"""What images of the same ground show, cell by cell of a map: enough to compare them, little enough to keep."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Side of a cell, pixels of the map.
SIDE = 16
#: Quantiles and single pixels that are kept of each image in a cell.
LEVELS, PIXELS = 12, 8
#: An image counts in a cell if it shows this part of it, and all of them together this one.
_SHOWN, _COMMON = 0.5, 0.25


@dataclass(frozen=True, eq=False)
class Cells:
    """Rows of images in cells; rows of one cell hold the same pixels of the map."""

    cell: NDArray[np.int64]
    """Number of the cell, (m,)."""
    image: NDArray[np.int64]
    """Number of the image, (m,)."""
    uv: NDArray[np.float64]
    """Column and row of the cell's middle in the image, (m, 2)."""
    share: NDArray[np.float64]
    """Part of the cell that is compared, (m,)."""
    levels: NDArray[np.float32]
    """Quantiles of the grey values, the cumulative histogram read the other way, (m, bands, LEVELS)."""
    pixels: NDArray[np.float32]
    """Grey values of some places, (m, bands, PIXELS)."""

    def __len__(self) -> int:
        return len(self.cell)

    def some(self, rows: NDArray[Any]) -> Cells:
        """Some rows."""
        return Cells(*(getattr(self, each.name)[rows] for each in fields(self)))

    @classmethod
    def joined(cls, parts: Iterable[Cells]) -> Cells:
        """All rows of many, sorted by cell."""
        every = list(parts)
        whole = cls(*(np.concatenate([getattr(part, each.name) for part in every]) for each in fields(cls)))
        return whole.some(np.lexsort((whole.image, whole.cell)))

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
    values: NDArray[np.float32], valid: NDArray[np.bool_], images: NDArray[np.int64], first: int = 0
) -> tuple[Cells, NDArray[np.int64]]:
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

    Returns
    -------
    cells : Cells
        With places in the images still unknown, NaN.
    middle : ndarray, shape (m, 2)
        Column and row of each row's cell in the part.
    """
    height, width = valid.shape[1:]
    corners = [(row, col) for row in range(0, height, SIDE) for col in range(0, width, SIDE)]
    found: list[tuple[Any, ...]] = []
    middle: list[tuple[float, float]] = []
    for number, (row, col) in enumerate(corners, first):
        at = np.s_[..., row : row + SIDE, col : col + SIDE]
        seen = valid[at].reshape(len(images), -1)
        rows = _comparable(seen)
        if not len(rows):
            continue
        common = seen[rows].all(axis=0)
        grey = values[at].reshape(*values.shape[:2], -1)[rows][..., common]
        levels = np.quantile(grey, (np.arange(LEVELS) + 0.5) / LEVELS, axis=-1).transpose(1, 2, 0)
        some = grey[..., np.linspace(0, grey.shape[-1] - 1, PIXELS).astype(int)]
        found += [(number, images[k], common.sum() / SIDE**2, levels[r], some[r]) for r, k in enumerate(rows)]
        middle += [(col + SIDE / 2 - 0.5, row + SIDE / 2 - 0.5)] * len(rows)
    cell, image, share, level, pixel = zip(*found) if found else ((), (), (), (), ())
    bands = values.shape[1]
    cells = Cells(
        np.array(cell, np.int64),
        np.array(image, np.int64),
        np.full((len(cell), 2), np.nan),
        np.array(share, float),
        np.array(level, np.float32).reshape(-1, bands, LEVELS),
        np.array(pixel, np.float32).reshape(-1, bands, PIXELS),
    )
    return cells, np.array(middle, float).reshape(-1, 2)


def _comparable(seen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Images whose common part of a cell is large enough; those that show least of it are left out for that."""
    shown = seen.sum(axis=1)
    rows = np.flatnonzero(shown >= _SHOWN * SIDE**2)
    while len(rows) > 1 and seen[rows].all(axis=0).sum() < _COMMON * SIDE**2:
        rows = np.delete(rows, np.argmin(shown[rows]))
    return np.asarray(rows, np.int64)
