"""How images pass into each other along seams: by weights, only where both see the same surface.

The weight of an image is the share of a square window around the pixel that it owns, twice over, so that weights bend
at no place and, where three meet, still add up to one. An image that does not see a pixel, or hardly (beside its border
and beside what hides ground from it), has no weight there, and gains it over half the width: nothing is carried across
an occlusion, and no new seam appears at its edge. Where detail passes by bands (Burt and Adelson 1983), each band has
such weights of its own, of the width of its detail.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.plan.owner import Share


@dataclass(frozen=True)
class Feather:
    """Weights of images along seams."""

    width: int
    """Of the strip in which images pass into each other, pixels."""
    bands: bool = False
    """Whether finer detail passes in narrower strips: each half as wide as the next."""

    @property
    def reach(self) -> int:
        """Pixels around a tile that decide about its weights."""
        return 2 * ((self.width + 2) // 4)

    @property
    def reaches(self) -> tuple[int, ...]:
        """`reach` of each band, from the finest; of one, if all detail passes alike."""
        found = [self.reach]
        while self.bands and found[0] >= 4:
            found.insert(0, 2 * (found[0] // 4))
        return tuple(found)

    def around(self, window: Window) -> Window:
        """A window of a product with what decides about it, also beyond the product."""
        r = self.reach
        return Window(window.col - r, window.row - r, window.width + 2 * r, window.height + 2 * r)

    def weights(
        self, share: Share, wide: Window, window: Window
    ) -> dict[int, tuple[NDArray[np.float32], NDArray[np.bool_]]]:
        """Weights of the images that share pixels of a window, by row of the table of sources, shape (bands, height,
        width); all 0 where one alone paints. With each the pixels of `wide` that it sees or owns.
        """
        owner = share.owner
        assert owner is not None
        rows = [int(value) - 1 for value in np.unique(owner) if value]
        at = window.slices(wide)
        if len(rows) < 2 or not self.reach:
            return {}
        painted = owner[at] > 0
        found = {}
        for row in rows:
            mine = owner == row + 1
            parts = [_twice(mine, reach // 2)[at] for reach in self.reaches]
            if not parts[-1].any():
                continue
            sees = share.clear[row]
            weights = np.stack([part * _from_edge(sees, r)[at] for part, r in zip(parts, self.reaches)])
            weights[:, ~painted] = 0.0
            # Whom nobody else can stand in for keeps what is his.
            weights[mine[at] & (weights == 0)] = np.finfo(np.float32).tiny
            found[row] = weights.astype(np.float32), sees | mine
        several = sum((weights[-1] > 0).astype(np.uint8) for weights, _ in found.values()) > 1
        shared = {row: (np.where(several, weights, np.float32(0)), seen) for row, (weights, seen) in found.items()}
        return {row: (weights, seen) for row, (weights, seen) in shared.items() if weights.any()}


def feather_of(metres: float, resolution: float, tile: int, bands: bool = False) -> Feather | None:
    """The feather of a width in metres, by bands or not; None: it is less than a pixel to both sides."""
    if not (np.isfinite(metres) and metres >= 0):
        raise UsageError(f"`feather` {metres:g}; a width in metres is needed, 0 for none")
    made = Feather(round(min(metres / resolution, 1e9)), bands)
    if made.reach > tile:
        raise UsageError(
            f"`feather` {metres:g} m is {made.width} pixels; at most {2 * tile} are possible with tiles of {tile}: "
            "give a smaller width, or a larger `tile`"
        )
    return made if made.reach else None


def _twice(mine: NDArray[np.bool_], half: int) -> NDArray[np.float64]:
    """Mean over a window of 2 · half + 1 pixels, of the mean over such windows; in whole numbers, so that it does not
    depend on where an array begins. Beyond the array there is nothing."""
    total = mine.astype(np.int64)
    for axis in (0, 1, 0, 1):
        sums = np.cumsum(np.pad(total, [(half + 1, half) if k == axis else (0, 0) for k in (0, 1)]), axis=axis)
        n = total.shape[axis]
        total = np.take(sums, np.arange(2 * half + 1, n + 2 * half + 1), axis) - np.take(sums, np.arange(n), axis)
    return np.asarray(total / float(2 * half + 1) ** 4)


def _from_edge(sees: NDArray[np.bool_], reach: int) -> NDArray[np.float64]:
    """0 where an image does not see, growing with the distance from there to 1 at `reach` pixels."""
    if sees.all():
        return np.ones(sees.shape)
    # Products without seams do without it: a tenth of a second of their start.
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415

    return np.asarray(np.minimum(distance_transform_edt(sees) / (reach + 1), 1.0))
