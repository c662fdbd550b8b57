"""Displacement between bands from discs that are seen in both."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from photoplan.errors import InputError
from photoplan.quality.colour.discs import Disc
from photoplan.quality.colour.model import Displacements

#: A centre is not known better than this, whatever its fit says: print, lens and mosaic are not perfect, pixels.
_FLOOR = 0.002


def disc_displacements(reference: Sequence[Disc], band: Sequence[Disc], farthest: float | None = None) -> Displacements:
    """Match discs of two bands, each with its nearest in the other, and difference their centres.

    Parameters
    ----------
    reference, band : sequence of Disc
        Discs of the reference band, and of the band whose displacement is sought.
    farthest : float, optional
        Distance up to which two discs can be the same, pixels; None: a third of the distance of the nearest
        neighbours in the chart, at most 30.

    Raises
    ------
    InputError
        Fewer than four discs are in both bands.
    """
    here = np.array([[d.x, d.y] for d in reference]).reshape(-1, 2)
    there = np.array([[d.x, d.y] for d in band]).reshape(-1, 2)
    if farthest is None:
        farthest = 30.0
        if len(here) > 1:
            farthest = min(farthest, float(np.median(cKDTree(here).query(here, 2)[0][:, 1])) / 3.0)
    pairs = []
    if len(here) and len(there):
        apart, nearest = cKDTree(there).query(here)
        back = cKDTree(here).query(there)[1]
        pairs = [(i, int(k)) for i, k in enumerate(nearest) if back[k] == i and apart[i] <= farthest]
        pairs = [(i, k) for i, k in pairs if 0.7 < reference[i].radius / band[k].radius < 1.4]
    if len(pairs) < 4:
        raise InputError(
            f"{len(pairs)} discs are the same in both bands (of {len(here)} and {len(there)}, up to {farthest:.1f} "
            "pixels apart); at least 4 are needed"
        )
    place, direction, value, sigma, group = [], [], [], [], []
    for number, (i, k) in enumerate(pairs):
        a, b = reference[i], band[k]
        spreads = (np.hypot(a.sigma_x, b.sigma_x), np.hypot(a.sigma_y, b.sigma_y))
        for axis, (difference, spread) in enumerate(zip((b.x - a.x, b.y - a.y), spreads)):
            place.append((a.x, a.y))
            direction.append((1.0, 0.0) if axis == 0 else (0.0, 1.0))
            value.append(difference)
            sigma.append(float(np.hypot(spread, _FLOOR)))
            group.append(number)
    return Displacements(np.array(place), np.array(direction), np.array(value), np.array(sigma), np.array(group))
