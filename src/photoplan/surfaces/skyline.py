"""The skyline of a view: in every column of the picture the highest ground that is seen, to a small part of a pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.surfaces.seen import Seen, SeenSurface
from photoplan.targets.view import ViewTarget

_Floats = NDArray[np.float64]

#: Rows between the rays that look for ground in each column, pixels: what is less high and hangs in the sky is missed.
_COARSE = 8
#: Halvings from there on: a thousandth of a pixel.
_HALVINGS = 13


def skyline_of(target: ViewTarget, surface: SeenSurface, beyond: int = 0) -> Seen:
    """The highest ground of each column, by rising columns; `Seen.uvh` has the places in the picture.

    A column that shows no sky, or no ground, has none. Terrain without overhangs has one border between ground and
    sky in a vertical plane: it is found by halving.
    """

    def hit(x: _Floats, y: _Floats) -> NDArray[np.bool_]:
        return np.asarray(surface.at(target, np.stack([x, y], axis=-1)).owner >= 0)

    width, height = target.bundle.size
    rows = np.append(np.arange(-0.5 - beyond, height - 0.5 + beyond, _COARSE), height - 0.5 + beyond)
    x = np.arange(-beyond, width + beyond, dtype=float)
    below, top = np.full(len(x), np.nan), np.full(len(x), rows[0])
    for before, row in zip(rows[:1].tolist() + rows[:-1].tolist(), rows.tolist()):
        todo = np.flatnonzero(np.isnan(below))
        if not len(todo):
            break
        met = todo[hit(x[todo], np.full(len(todo), row))]
        below[met], top[met] = row, before
    there = np.isfinite(below) & (below > rows[0])
    x, low, high = x[there], below[there], top[there]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        below_edge = hit(x, middle)
        low, high = np.where(below_edge, middle, low), np.where(below_edge, high, middle)
    return surface.at(target, np.stack([x, low], axis=-1))
