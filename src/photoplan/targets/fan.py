"""Pictures whose columns are vertical planes: what is needed to follow a column instead of each of its pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.targets.view import ViewTarget

#: Rays steeper than this, metres of height per metre on the map, are no part of a fan.
STEEPEST = 1e3


@dataclass(frozen=True, eq=False)
class Fan:
    """The rays of a window: those of a column lie in a vertical plane, straight but for the target's `bend`."""

    ways: NDArray[np.float64]
    """Directions of the columns on the map, of length one, shape (width, 2)."""
    level: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Metres on the map per metre of depth: what columns (width,) and rows (height,) have of it, to be multiplied."""
    rise: NDArray[np.float64]
    """Metres of height on the map per metre there, of the rows in a column whose own part of it is one, shape
    (height,); it falls from row to row."""
    rows: tuple[int, int]
    """The first of the rows that are not too steep, and the one after the last."""
    up: NDArray[np.bool_]
    """Whether the rays of a row do not go down where they start, shape (height,)."""

    @property
    def steeper(self) -> NDArray[np.float64]:
        """What `rise` is times in each column, shape (width,)."""
        return np.asarray(1.0 / self.level[0])


def fan_of(target: ViewTarget, window: Window, reach: float, tolerance: float) -> Fan | None:
    """Rays of a window as planes; None: they are none, or bent otherwise than `ViewTarget.bend`."""
    if not target.upright:
        return None
    # Of the whole picture, so that all windows have the same numbers.
    width, height = target.bundle.size
    u, v = np.arange(width, dtype=float), np.arange(height, dtype=float)
    down = target.bundle.directions(np.stack([np.zeros(height), v], axis=-1))
    rows = np.hypot(down[:, 0], down[:, 1])
    middle = v[np.argmax(np.nan_to_num(rows))]
    across = target.bundle.directions(np.stack([u, np.full(width, middle)], axis=-1))
    columns = np.hypot(across[:, 0], across[:, 1])
    with np.errstate(invalid="ignore"):
        flat = np.flatnonzero(np.abs(down[:, 2]) < STEEPEST * rows)
    if not len(flat):
        return None
    top, end = int(flat[0]), int(flat[-1]) + 1
    rise = np.full(height, np.nan)
    paths = target.rays(down[top:end], reach, tolerance)
    if paths.shape[1] != 2:
        return None
    gone = paths[:, 1] - paths[:, 0]
    rise[top:end] = gone[:, 2] / np.hypot(gone[:, 0], gone[:, 1])
    here, there = slice(window.row, window.stop[1]), slice(window.col, window.stop[0])
    first, last = (min(max(row - window.row, 0), window.height) for row in (top, end))
    return Fan(
        ways=across[there, :2] / columns[there, None],
        level=(columns[there] / columns[0], rows[here]),
        rise=rise[here],
        rows=(first, last),
        up=~(down[here, 2] < 0),
    )
