"""Which observations of a block take part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.orientation.bundle.block import Block


@dataclass(frozen=True, eq=False)
class Active:
    """Observations that are not taken out."""

    image: NDArray[np.bool_]
    """Of `block.observations`."""
    ground: NDArray[np.bool_]
    """Of the coordinates of `block.ground`, (g, 3)."""
    position: NDArray[np.bool_]
    """Of `block.positions`."""

    @classmethod
    def all_of(cls, block: Block) -> Active:
        """Nothing taken out."""
        positions = 0 if block.positions is None else len(block.positions.images)
        ground = np.ones((len(block.ground), 3), bool)
        return cls(np.ones(len(block.observations), bool), ground, np.ones(positions, bool))

    def equals(self, other: Active) -> bool:
        """Whether the same observations are active."""
        pairs = ((self.image, other.image), (self.ground, other.ground), (self.position, other.position))
        return all(np.array_equal(a, b) for a, b in pairs)
