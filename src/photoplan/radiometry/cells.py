"""What images of the same ground show, cell by cell of a map: enough to compare them, little enough to keep."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.codec import storable

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
